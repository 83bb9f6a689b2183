"""The figures of a scene: from above with its cameras and objects, and the 3D view before and after they were added."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud
from scenefuse.cloud.tiled_cloud import TiledCloud, open_cloud
from scenefuse.core.stage import read_json, value
from scenefuse.core.transforms import Array, box_corners
from scenefuse.photos.geodesy import length_unit
from scenefuse.photos.sheets import Image, add_axes, new_figure, save_png, to_image
from scenefuse.photos.workspace import read_views
from scenefuse.report.render import MAX_DRAWN, orbit_camera, point_radii, render
from scenefuse.report.view import REMOVED, VIEW_POINTS, View, merge, thin, within, write_view


def draw_scene(
    *,
    name: str,
    dense: Path,
    georeferenced: Path | None = None,
    objects: list[Path],
    failed: tuple[str, ...] = (),
    figure: Path,
) -> None:
    """Draw a scene from above and obliquely with its camera positions and the boxes of its objects.

    Args:
        name: the scene's name, for the title.
        dense: the scene's dense cloud.
        georeferenced: COLMAP model in the same frame; None where the scene was given as a cloud.
        objects: result folders of the scene's objects; the bounding box of registration/full/crop.ply is drawn.
        failed: names of the objects that failed; they get no box.
        figure: output PNG, below 1 MB.

    Raises:
        StageError: an input is missing.
    """
    scene = open_cloud(dense)
    every = max(1, -(-len(scene) // MAX_DRAWN))
    cloud = concatenate([part for _, part in scene.parts(every)])
    views = [] if georeferenced is None else read_views(georeferenced)
    centres = np.array([view.centre for view in views]).reshape(-1, 3)
    shown = [folder for folder in objects if folder.name not in failed]
    crops = {f.name: read_cloud(f / "registration/full/crop.ply").points for f in shown}
    boxes = {name: box_corners(crop.min(0), crop.max(0)) for name, crop in crops.items()}
    cameras = "given as a cloud, no cameras" if georeferenced is None else f"cameras (red): {len(centres)}"
    drawn = "" if every == 1 else f" (one in {every} is drawn)"
    note = f"{len(scene):,} points{drawn}, {cameras}, objects (boxes): {len(boxes)}"
    save_png(figure, _scene_sheet(name, note, cloud, centres, boxes))


def _scene_sheet(name: str, note: str, cloud: Cloud, centres: Array, boxes: dict[str, Array]) -> Image:
    """The scene from above and obliquely; cameras at `centres` (N, 3), boxes of 8 corners."""
    radii = point_radii(cloud.points)
    ground = box_corners(*np.percentile(cloud.points, [1, 99], axis=0))
    views = {
        "from above": orbit_camera(ground, -90.0, 90.0, (640, 520), orthographic=True),
        "oblique": orbit_camera(np.concatenate([ground, centres]), -60.0, 30.0, (760, 520)),
    }
    size = (640 + 760 + 24, 520 + 66)
    sheet = new_figure(size)
    sheet.text(8 / size[0], 1 - 10 / size[1], f"Scene {name}", fontsize=12, fontweight="bold", va="top")
    sheet.text(8 / size[0], 1 - 32 / size[1], note, fontsize=9.5, color="#444444", va="top")
    left = 8
    for title, camera in views.items():
        axes = add_axes(sheet, (left, 60, camera.width_px, camera.height_px), size)
        axes.imshow(render(cloud, camera, radii))
        axes.set(xlim=(0, camera.width_px), ylim=(camera.height_px, 0))
        axes.text(8, 20, title, fontsize=10, bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none"})
        x, y = camera.project(centres)[0].T
        axes.scatter(x, y, s=14, c="#d6261f", edgecolors="white", linewidths=0.5, zorder=3)
        for label, corners in boxes.items():
            _draw_box(axes, camera.project(corners)[0], label)
        left += camera.width_px + 8
    return to_image(sheet)


def _draw_box(axes: Any, corners_px: Array, label: str) -> None:
    """The twelve edges of a projected box, and its name above it."""
    for a in range(8):
        for bit in (1, 2, 4):
            if not a & bit:
                axes.plot(*corners_px[[a, a | bit]].T, color="#0b4ea2", linewidth=1.2, zorder=4)
    x, y = corners_px[:, 0].mean(), corners_px[:, 1].min() - 6
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5}
    axes.text(x, y, label, ha="center", va="bottom", fontsize=9.5, color="#0b4ea2", zorder=5, bbox=box)


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
