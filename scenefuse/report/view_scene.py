"""The 3D view of a scene, before and after all its objects were added."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, concatenate
from scenefuse.cloud.tiled_cloud import TiledCloud, open_cloud
from scenefuse.core.stage import read_json, value
from scenefuse.core.transforms import Array
from scenefuse.photos.geodesy import length_unit
from scenefuse.report.render import MAX_DRAWN
from scenefuse.report.view import REMOVED, View, merge, thin, within, write_view

# Points of a scene's view; with those of three objects, the page stays well below 15 MB.
VIEW_POINTS = 250_000


def view_scene(*, dense: Path, completed: Path, completed_json: Path, georeference_json: Path, folder: Path) -> None:
    """Write a scene's 3D view: view.ply (its points before and after, thinned) and view.json.

    Args:
        dense: the scene's cloud.
        completed: the scene with its objects, in the same frame.
        completed_json: holds the meaning of the field `source`, and the number of the scene's points.
        georeference_json: holds the unit of the scene's lengths.
        folder: where both files are written.

    Raises:
        StageError: an input is missing or damaged.
    """
    scene, whole, about = open_cloud(dense), open_cloud(completed), read_json(completed_json)
    sources = {int(number): name for number, name in value(about, "sources").items()}
    every = max(1, -(-len(scene) // MAX_DRAWN))
    boxes = _objects(whole, value(about, "scene_points"))
    before, after = _read(scene, every, boxes), _read(whole, every, boxes)
    # Stray points far out would take the precision of the positions, and the picture.
    low, high = np.percentile(before.points[_evenly(before.points, every)], [0.1, 99.9], axis=0)
    before, after = (cloud[within(cloud.points, low, high, margin=0.1)] for cloud in (before, after))
    low, high = np.percentile(before.points[_evenly(before.points, every)], [1, 99], axis=0)
    counts = (len(before), len(after)) if every == 1 else (len(scene), len(whole))
    points = merge(before, after)
    points.fields["near"][:] = _near_objects(points)
    thinned = thin(points, VIEW_POINTS)
    unit = length_unit(georeference_json)
    # As in the scene's figure, a little higher: the objects do not hide each other.
    write_view(folder, View(thinned, sources, unit, low, high, -60.0, 35.0, *counts))
    of = "" if every == 1 else f"; of the scene away from its objects one in {every} was looked at"
    print(f"{folder}/view.ply: {len(thinned):,} of {len(points):,} points{of}", flush=True)


def _objects(completed: TiledCloud, scene_points: int) -> list[tuple[Array, Array]]:
    """Boxes around what each object added: its tile lies behind those of the scene's points."""
    tiles = np.flatnonzero(completed.starts[:-1] >= scene_points)
    return list(zip(completed.low[tiles], completed.high[tiles]))


def _read(cloud: TiledCloud, every: int, boxes: list[tuple[Array, Array]]) -> Cloud:
    """One in `every` points of a cloud, and all in some boxes and of objects."""
    found = []
    for _, part in cloud.parts():
        chosen = _evenly(part.points, every) | (part.fields.get("source", np.zeros(len(part))) != 0)
        for low, high in boxes if every > 1 else []:
            chosen |= within(part.points, low, high)
        found.append(part[chosen])
    return concatenate(found)


def _evenly(points: Array, every: int) -> NDArray[np.bool_]:
    """(N,) one in `every` points, by a hash of their positions: the same ones before and after."""
    bits = np.ascontiguousarray(points).view(np.uint64)
    mixed = (bits * np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)).sum(1)
    return np.asarray((mixed >> np.uint64(33)) % np.uint64(every) == 0)


def _near_objects(points: Cloud) -> NDArray[np.bool_]:
    """(N,) whether points lie in the box of what was added from an object; all where nothing was added."""
    source = points.fields["source"]
    boxes = [
        np.percentile(points.points[source == number], [1, 99], axis=0)
        for number in np.unique(source)
        if number not in (0, REMOVED)
    ]
    if not boxes:
        return np.ones(len(points), dtype=bool)
    return np.any([within(points.points, low, high) for low, high in boxes], axis=0)
