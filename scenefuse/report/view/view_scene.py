"""The 3D view of a scene, before and after all its objects were added."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.io.clouds import Cloud, read_cloud
from scenefuse.io.units import length_unit
from scenefuse.report.view.view_file import View, write_view
from scenefuse.report.view.view_points import REMOVED, merge, thin, within
from scenefuse.stage import read_json, value

VIEW_POINTS = 250_000
"""Of a scene's view; see the note at that of an object."""
AZIMUTH_DEG, ELEVATION_DEG = -60.0, 35.0
"""As in the scene's figure, a little higher: the objects do not hide each other."""


def view_scene(*, dense: Path, completed: Path, completed_json: Path, georeference_json: Path, folder: Path) -> None:
    """Write a scene's 3D view: view.ply (its points before and after, thinned) and view.json.

    Args:
        dense: the scene's cloud.
        completed: the scene with its objects, in the same frame.
        completed_json: says what the numbers of the field `source` mean.
        georeference_json: says the unit of the scene's lengths.
        folder: where both files are written.

    Raises:
        StageError: an input is missing or damaged.
    """
    before, after = read_cloud(dense), read_cloud(completed)
    sources = {int(number): name for number, name in value(read_json(completed_json), "sources").items()}
    # Stray points far out would take the precision of the positions, and the picture.
    low, high = np.percentile(before.points, [0.1, 99.9], axis=0)
    before, after = (cloud[within(cloud.points, low, high, margin=0.1)] for cloud in (before, after))
    low, high = np.percentile(before.points, [1, 99], axis=0)
    points = merge(before, after)
    points.fields["near"][:] = _near_objects(points)
    thinned = thin(points, VIEW_POINTS)
    unit = length_unit(georeference_json)
    view = View(thinned, sources, unit, low, high, AZIMUTH_DEG, ELEVATION_DEG, len(before), len(after))
    write_view(folder, view)
    print(f"{folder}/view.ply: {len(thinned):,} of {len(points):,} points", flush=True)


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
