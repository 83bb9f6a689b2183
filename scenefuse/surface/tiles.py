"""3D Tiles of a completed scene for web viewers: its points, and the surfaces of its objects, placed on the Earth.

Sources: 3D Tiles 1.1 (OGC 22-025r4); glTF content is turned from y up to z up by the viewer.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, read_cloud
from scenefuse.core.stage import StageError, atomic_directory, read_json, value, write_json
from scenefuse.core.transforms import Array
from scenefuse.core.version import VERSION
from scenefuse.fuse.measure import Evidence
from scenefuse.photos.geodesy import length_unit
from scenefuse.surface.gltf import CLASSES, earth_from_scene, metres_per_unit, place_of_scene, write_glb, write_points
from scenefuse.surface.make_surface import read_surface
from scenefuse.surface.mesh import Surface
from scenefuse.surface.texture import TEXTURED_FACES

# Points of a tile: about a megabyte, which loads at once.
TILE_SIZE = 50_000
# Pixels of error that viewers allow a tile: so many times as much is stated, lest gaps of as many pixels show.
ALLOWED_PX = 16
Tile = dict[str, Any]


def make_tiles(
    *, cloud: Path, report: Path, objects: list[Path], georeference_json: Path | None = None, folder: Path
) -> None:
    """Write points/tileset.json and surfaces/tileset.json; `asset.extras` says what their feature ids are.

    Points lie in an octree, each in one tile. A surface has two tiles, a coarse one and the whole.
    Where the scene has a place in the world the tiles have it too; heights are taken as those above the ellipsoid.

    Args:
        cloud: the completed scene.
        report: its JSON, for what each `source` is.
        objects: result folders of its objects, with surface.ply and surface.glb.
        georeference_json: JSON of the scene.
        folder: output.

    Raises:
        StageError: the scene has no points.
    """
    points, metres = read_cloud(cloud), metres_per_unit(length_unit(georeference_json))
    if not len(points):
        raise StageError(f"{cloud} holds no points; there is nothing to make tiles of")
    place = earth_from_scene(georeference_json, points.points.mean(0))
    extras = place_of_scene(georeference_json)
    ids = {"sources": value(read_json(report), "sources"), "evidence": {k.name.lower(): int(k) for k in Evidence}}
    if place is not None:
        place[:3, :3] /= metres
    points = replace(points, points=metres * points.points)
    with atomic_directory(folder) as output:
        for name in ("points", "surfaces"):
            (output / name).mkdir()
        order = np.random.default_rng(0).permutation(len(points))
        _write(output / "points", [_points_tile(points, order, "r", output / "points")], place, extras | ids)
        tiles = []
        for path in objects:
            surface = read_surface(path / "surface.ply")
            if len(surface.faces):
                whole = (path / "surface.glb").read_bytes()
                (output / "surfaces" / f"{path.name}.glb").write_bytes(whole)
                tiles.append(_surface_tile(path.name, surface, metres, extras, output / "surfaces"))
        _write(output / "surfaces", tiles, place, extras | CLASSES)


def clustered(surface: Surface, size: float) -> Surface:
    """A surface with one vertex in each cube of a size; faces that fall together go."""
    cell = np.floor((surface.vertices.points - surface.vertices.points.min(0)) / size).astype(np.int64)
    _, first, number, count = np.unique(cell, axis=0, return_index=True, return_inverse=True, return_counts=True)
    vertices = surface.vertices[first]
    middle = np.stack([np.bincount(number, axis) for axis in surface.vertices.points.T], axis=1) / count[:, None]
    faces = number[surface.faces]
    kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    _, once = np.unique(np.sort(faces[kept], axis=1), axis=0, return_index=True)
    kept = np.flatnonzero(kept)[np.sort(once)]
    return replace(surface, vertices=replace(vertices, points=middle), faces=faces[kept], classes=surface.classes[kept])


def _points_tile(points: Cloud, chosen: NDArray[np.int64], name: str, folder: Path) -> Tile:
    """A tile of the first of the chosen points, which are in random order, and of the others in its octants."""
    here, others = chosen[:TILE_SIZE], chosen[TILE_SIZE:]
    write_points(folder / f"{name}.glb", points[here], {})
    low, high = points.points[chosen].min(0), points.points[chosen].max(0)
    # Points of a surface that is as wide as the tile lie so far apart.
    apart = float((high - low).max() / np.sqrt(TILE_SIZE)) if len(others) else 0.0
    tile = _tile(low, high, f"{name}.glb", apart)
    if len(others):
        octant = (points.points[others] > (low + high) / 2) @ [1, 2, 4]
        parts = [(k, others[octant == k]) for k in range(8)]
        tile["children"] = [_points_tile(points, part, f"{name}{k}", folder) for k, part in parts if len(part)]
    return tile


def _surface_tile(name: str, surface: Surface, metres: float, extras: dict[str, Any], folder: Path) -> Tile:
    """The tile of a surface in a coarse one, which is shown from afar: a quarter of the faces of a painted surface."""
    points, coarse = metres * surface.vertices.points, surface
    corners = surface.vertices.points[surface.faces]
    size = float(np.median(np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)))
    # What is painted has fewer faces, whose corners lie a little beside these.
    low, high = points.min(0) - metres * size, points.max(0) + metres * size
    whole = _tile(low, high, f"{name}.glb", 0.0)
    while len(coarse.faces) > TEXTURED_FACES / 4:
        size *= 2
        coarse = clustered(surface, size)
    if coarse is surface:
        return whole
    write_glb(folder / f"{name}_coarse.glb", coarse, extras, metres)
    return _tile(low, high, f"{name}_coarse.glb", metres * size) | {"refine": "REPLACE", "children": [whole]}


def _tile(low: Array, high: Array, uri: str, error: float) -> Tile:
    """A tile of a file in a box, whose points or vertices lie an error apart, in metres; 0 for all that there are."""
    half = np.diag((high - low) / 2)
    return {
        "boundingVolume": {"box": [*((low + high) / 2), *half.ravel()]},
        "geometricError": ALLOWED_PX * error,
        "content": {"uri": uri},
    }


def _write(folder: Path, tiles: list[Tile], place: Array | None, extras: dict[str, Any]) -> None:
    """tileset.json of some tiles."""
    boxes = np.array([tile["boundingVolume"]["box"] for tile in tiles] or [[0.0] * 12])
    half = boxes[:, [3, 7, 11]]
    low, high = (boxes[:, :3] - half).min(0), (boxes[:, :3] + half).max(0)
    # As far away as the whole looks like a pixel, nothing of it is shown.
    error = float(np.linalg.norm(high - low))
    root: Tile = {"boundingVolume": _tile(low, high, "", error)["boundingVolume"], "geometricError": error}
    root |= {"refine": "ADD", **({"children": tiles} if tiles else {})}
    if place is not None:
        root["transform"] = place.T.ravel().tolist()
    asset = {"version": "1.1", "generator": f"scenefuse {VERSION}", "extras": extras}
    write_json(folder / "tileset.json", {"asset": asset, "geometricError": error, "root": root})
