"""The stage that makes the surface of one completed object."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from scenefuse.cloud.clouds import Cloud, cloud_of, read_cloud, records_of
from scenefuse.cloud.readers.ply import FIELD, in_file
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError, atomic_file, quantity, read_json, threads, value, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS, MAX_PHOTOS
from scenefuse.geometry.photo_check import moved_view, read_photos, showing
from scenefuse.photos.geodesy import frame_notes, length_unit
from scenefuse.photos.workspace import View, Workspace, read_views
from scenefuse.surface.gltf import metres_per_unit, place_of_scene, write_glb
from scenefuse.surface.mesh import FaceClass, Surface, make_mesh
from scenefuse.surface.texture import Textured, textured


@dataclass(frozen=True)
class SurfaceInputs:
    """What the surface of one object is made of."""

    fused: Path
    """The object in its surroundings (PLY)."""
    fusion_json: Path | None = None
    """JSON of the fusion, for the object's place in the scene; without it the scene's cameras alone are used."""
    object_workspace: Path | None = None
    """The object's undistorted COLMAP workspace, where it has photos."""
    scene_workspace: Path | None = None
    """The scene's, in the frame of its cloud."""
    georeference_json: Path | None = None
    """JSON of the scene, for its unit and its place in the world."""


def make_surface(*, inputs: SurfaceInputs, surface: Path, glb: Path, report: Path) -> None:
    """Make the surface of an object in its surroundings, each face classed by what photos know of the place (F7).

    Where the points have no surface, the files are empty and the report says why.

    Args:
        inputs: see SurfaceInputs.
        surface: output PLY in the scene's frame; vertices have `evidence`, `deviation` and `class`, faces `class`.
        glb: output GLB in metres, y up; the scene's place in the world is in `asset.extras`.
        report: output JSON: areas and their shares.
    """
    use_threads(threads())
    views = placed_views(inputs)
    try:
        found, reason = mesh_of(inputs, views), ""
    except StageError as error:
        print(f"no surface: {error}", flush=True)
        found, reason = _nothing(), str(error)
    write_surface(surface, found, frame_notes(inputs.georeference_json))
    painted, why = paint(found, views)
    unit, place = length_unit(inputs.georeference_json), place_of_scene(inputs.georeference_json)
    if painted is None:
        write_glb(glb, found, place, metres_per_unit(unit))
    else:
        write_glb(glb, painted.surface, place, metres_per_unit(unit), painted.uv, painted.picture)
    content = surface_report(found, unit) | {
        "reason": quantity(reason, ""),
        "texture": quantity(why, ""),
        "textured": quantity(0.0 if painted is None else painted.shown_share, "of the area that is not bridged"),
    }
    write_json(report, content)


def paint(surface: Surface, views: list[tuple[Path, View]]) -> tuple[Textured | None, str]:
    """The surface with a picture from photos, and where that is from; None where there are none.

    Args:
        surface: in the scene's frame.
        views: cameras there, each with its workspace.
    """
    chosen = [views[k] for k in showing([view for _, view in views], surface.vertices.points, 2 * MAX_PHOTOS)]
    if not chosen:
        return None, "the colours of the points: no photo shows the surface"

    def read(number: int) -> NDArray[np.uint8]:
        folder, view = chosen[number]
        return np.asarray(Workspace(folder, [], view.centre[None], [], []).rgb(view).pixels)

    try:
        painted = textured(surface, [view for _, view in chosen], read)
    except StageError as error:
        print(f"no texture: {error}", flush=True)
        return None, f"the colours of the points: {error}"
    return painted, f"{len(chosen)} photos" if painted else "the colours of the points: no photo shows the surface"


def placed_views(inputs: SurfaceInputs) -> list[tuple[Path, View]]:
    """The cameras of both sides in the scene's frame, each with its workspace; an object without a place has none."""
    found = []
    matrix = None if inputs.fusion_json is None else value(read_json(inputs.fusion_json), "scene_from_object")
    if inputs.object_workspace is not None and matrix is not None:
        pose = Sim3.from_matrix(np.array(matrix))
        own = read_views(inputs.object_workspace / "sparse")
        found += [(inputs.object_workspace, moved_view(view, pose)) for view in own]
    if inputs.scene_workspace is not None:
        found += [(inputs.scene_workspace, view) for view in read_views(inputs.scene_workspace / "sparse")]
    return found


def mesh_of(inputs: SurfaceInputs, views: list[tuple[Path, View]]) -> Surface:
    """The surface of the completed cloud, by the photos of both sides; errors as of `make_mesh`."""
    cloud, cameras = read_cloud(inputs.fused), [view for _, view in views]
    for folder in dict.fromkeys(folder for folder, _ in views):
        own = Workspace(folder, [view for of, view in views if of == folder], cloud.points, [], [])
        photos = read_photos(own, cloud.points)
        if len(photos.views) >= CONFIRMING_PHOTOS:
            # The object's, which come first, show it best.
            return make_mesh(cloud, cameras, photos)
    return make_mesh(cloud, cameras)


def _nothing() -> Surface:
    """A surface without faces."""
    kinds = {"evidence": np.uint8, "deviation": np.float32, "class": np.uint8}
    fields: dict[str, NDArray[Any]] = {name: np.zeros(0, kind) for name, kind in kinds.items()}
    vertices = Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32), None, fields)
    return Surface(vertices, np.zeros((0, 3), np.int64), np.zeros(0, np.uint8), 0.0)


def surface_report(surface: Surface, unit: str) -> dict[str, Any]:
    """Areas by class, and their shares of all that is closed or could be."""
    areas = surface.areas()
    by_class = {kind.name.lower(): float(areas[surface.classes == kind].sum()) for kind in FaceClass}
    by_class["open"] = surface.open_area
    total = sum(by_class.values())
    return {
        "status": quantity("made" if len(surface.faces) else "empty", ""),
        "faces": quantity(len(surface.faces), "faces"),
        **{f"{name}_area": quantity(area, f"{unit}2") for name, area in by_class.items()},
        **{name: quantity(area / total if total else None, "of the area") for name, area in by_class.items()},
        "notes": quantity(list(surface.notes), ""),
    }


def write_surface(path: Path, surface: Surface, comments: Sequence[str] = ()) -> None:
    """Write a binary PLY mesh, with these lines in its header."""
    records = records_of(surface.vertices, path)
    records.dtype.names = tuple(map(in_file, records.dtype.names or ()))
    layout = [("vertex_indices", "<i4", (3,)), ("class", "u1")]
    faces = np.empty(len(surface.faces), [("corners", "u1"), *layout])
    faces["corners"], faces["vertex_indices"], faces["class"] = 3, surface.faces, surface.classes
    # plyfile writes lists one by one, in seconds: it only describes them.
    described = PlyElement.describe(records, "vertex"), PlyElement.describe(np.empty(len(faces), layout), "face")
    header = PlyData(described, byte_order="<", comments=comments).header
    with atomic_file(path) as temporary:
        temporary.write_bytes(f"{header}\n".encode() + records.tobytes() + faces.tobytes())


def read_surface(path: Path) -> Surface:
    """Read what `write_surface` wrote; the area of open gaps is not in it.

    Raises:
        StageError: it is missing or cut short.
    """
    try:
        content = PlyData.read(str(path), known_list_len={"face": {"vertex_indices": 3}})
        table, faces = content["vertex"].data, content["face"].data
        columns = {name.removeprefix(FIELD): np.asarray(table[name]) for name in table.dtype.names}
        indices = faces["vertex_indices"].astype(np.int64)
    except Exception as error:
        raise StageError(f"{path} is no surface ({error}); make it again with scenefuse export") from None
    return Surface(cloud_of(columns), indices, np.asarray(faces["class"]), 0.0)
