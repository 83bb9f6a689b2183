"""The figures of a scene: from above with its cameras and objects, and the 3D view before and after they were added."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud
from scenefuse.cloud.tiled_cloud import TiledCloud, open_cloud
from scenefuse.core.stage import read_json, value
from scenefuse.core.transforms import Array, box_corners
from scenefuse.photos.geodesy import length_unit, scene_frame
from scenefuse.photos.sheets import TILE_PX, Cell, draw_scale, draw_sheet, save_png
from scenefuse.photos.workspace import View as PhotoView
from scenefuse.photos.workspace import read_views
from scenefuse.report.facts import scene_title
from scenefuse.report.render import MAX_DRAWN, Camera, brightened, orbit_camera, point_radii, render
from scenefuse.report.values import read_table
from scenefuse.report.view import view_of, within, write_view

RED, BLUE = "#d6261f", "#0b4ea2"
# By the number of photos, from none to nine or more.
OVERLAP_COLORS = colormaps["RdYlGn"].resampled(10)(range(10), bytes=True)[:, :3]


def draw_scene(
    *,
    name: str,
    dense: Path,
    georeferenced: Path | None = None,
    residuals: Path | None = None,
    georeference_json: Path | None = None,
    objects: list[Path],
    failed: tuple[str, ...] = (),
    figure: Path,
) -> None:
    """Draw a scene from above and obliquely with its cameras and objects, the cameras' errors and their overlap.

    Args:
        name: the scene's name, for the title.
        dense: the scene's dense cloud.
        georeferenced: COLMAP model in the same frame; None where the scene was given as a cloud.
        residuals: what is left at positions by GPS (residuals.tsv); None where the scene was given as a cloud.
        georeference_json: says the unit of lengths, and whether up on the picture is north.
        objects: result folders of the scene's objects; the bounding box of registration/full/crop.ply is drawn.
        failed: names of the objects that failed; they get no box.
        figure: output PNG.

    Raises:
        StageError: an input is missing.
    """
    scene = open_cloud(dense)
    every = max(1, -(-len(scene) // MAX_DRAWN))
    (cloud,) = brightened(concatenate([part for _, part in scene.parts(every)]))
    views = [] if georeferenced is None else read_views(georeferenced)
    shown = [folder for folder in objects if folder.name not in failed]
    crops = {f.name: read_cloud(f / "registration/full/crop.ply").points for f in shown}
    boxes = {name: box_corners(crop.min(0), crop.max(0)) for name, crop in crops.items()}
    drawn = "" if every == 1 else f" (one in {every} is drawn)"
    note = f"{len(scene):,} points before completion{drawn}, objects (boxes): {len(boxes)}, "
    note += f"cameras (red): {len(views)}" if georeferenced else "given as a cloud"
    errors = pd.DataFrame() if residuals is None else read_table(residuals)
    frame = None if georeference_json is None else scene_frame(read_json(georeference_json))
    place = length_unit(georeference_json), frame is not None and frame.has_north
    save_png(figure, _scene_sheet(scene_title(name), note, cloud, views, boxes, errors, place))


def _scene_sheet(
    title: str,
    note: str,
    cloud: Cloud,
    views: list[PhotoView],
    boxes: dict[str, Array],
    errors: pd.DataFrame,
    place: tuple[str, bool],
) -> Figure:
    """The scene from above and obliquely, with boxes of 8 corners; where it has cameras, their errors and overlap.

    Place is the unit of lengths, and whether the map's upper edge lies in the north.
    """
    radii, size = point_radii(cloud.points), (2 * TILE_PX[0], 2 * TILE_PX[1])
    ground = box_corners(*np.percentile(cloud.points, [1, 99], axis=0))
    centres = np.array([view.centre for view in views]).reshape(-1, 3)
    above = orbit_camera(ground, -90.0, 90.0, size, orthographic=True)
    oblique = orbit_camera(np.concatenate([ground, centres]), -60.0, 30.0, size)
    rows: list[list[Cell]] = [[("from above", render(cloud, above, radii)), ("oblique", render(cloud, oblique, radii))]]
    if views:
        counts = np.zeros(len(cloud), np.int64)
        for view in views:
            counts[view.visible(cloud.points)[0]] += 1
        most = len(OVERLAP_COLORS) - 1
        overlap = render(cloud, above, radii, OVERLAP_COLORS[np.minimum(counts, most)])
        errors_below = render(cloud, above, radii, (215, 215, 215))
        rows.append([("how many photos show each place", overlap), ("cameras against their GPS", errors_below)])
    sheet = draw_sheet(title, note, rows, size)
    axes: Any
    for axes, camera in zip(sheet.axes, (above, oblique)):
        axes.scatter(
            *np.transpose(camera.project(centres)[0]), s=8, c=RED, edgecolors="white", linewidths=0.3, zorder=3
        )
        for label, corners in boxes.items():
            _draw_box(axes, camera.project(corners)[0], label)
    if views:
        for number, color in enumerate(OVERLAP_COLORS):
            label = f"{number}" + (" or more" if number == most else "")
            sheet.axes[2].plot([], [], "s", color=color / 255, label=label)
        sheet.axes[2].legend(
            loc="upper center", bbox_to_anchor=(0.5, 0.0), borderpad=0.2, frameon=False,
            ncols=most + 1, handletextpad=0, columnspacing=0.4, fontsize="x-small",
        )  # fmt: skip
        _draw_errors(sheet.axes[3], above, {view.name: view.centre for view in views}, errors)
    for axes in sheet.axes[: 3 if views else 1 : 2]:
        draw_scale(axes, above.focal_px, *place)
    return sheet


def _draw_errors(axes: Any, camera: Camera, centres: dict[str, Array], errors: pd.DataFrame) -> None:
    """An ellipse at each camera, its half axes the errors east and north, enlarged; its colour the error upwards."""
    errors = errors[errors.kind == "position"].dropna(subset=["east_m", "north_m"]) if len(errors) else errors
    errors = errors[errors.name.isin(centres)] if len(errors) else errors
    if errors.empty:
        axes.set_visible(False)
        return
    pixels = camera.project(np.array([centres[name] for name in errors.name]))[0]
    sides = errors[["east_m", "north_m"]].abs().to_numpy()
    # A large error reaches half way to the next camera, in a round factor: few ellipses overlap.
    apart = np.median(cKDTree(pixels).query(pixels, k=2)[0][:, 1]) if len(pixels) > 1 else 0.1 * camera.height_px
    factor = 0.5 * float(apart) / camera.focal_px / max(float(np.percentile(sides.max(1), 90)), 1e-9)
    factor = float(f"{factor:.0e}")
    limit, widths = float(errors.up_m.abs().max()) or 1.0, 2 * factor * camera.focal_px * sides
    shapes = EllipseCollection(
        widths[:, 0], widths[:, 1], np.zeros(len(errors)), units="xy", offsets=pixels, offset_transform=axes.transData,
        cmap="coolwarm", norm=Normalize(-limit, limit), alpha=0.75, edgecolor="black",
    )  # fmt: skip
    shapes.set_array(errors.up_m.fillna(0.0).to_numpy())
    axes.add_collection(shapes)
    axes.scatter(*pixels.T, s=2, c="black", zorder=4)
    scale = axes.figure.colorbar(shapes, cax=axes.inset_axes((0.5, -0.03, 0.4, 0.02)), orientation="horizontal")
    scale.ax.tick_params(labelsize="x-small", pad=1)
    axes.text(0.46, -0.02, "above GPS (m)", fontsize="small", ha="right", va="center", transform=axes.transAxes)
    axes.set_title(f"{axes.get_title()}: east, north × {factor:,.3g}", fontsize="medium", pad=3)


def _draw_box(axes: Any, corners_px: Array, label: str) -> None:
    """The twelve edges of a projected box, and its name above it."""
    for a in range(8):
        for bit in (1, 2, 4):
            if not a & bit:
                axes.plot(*corners_px[[a, a | bit]].T, color=BLUE, linewidth=1.2)
    place = corners_px[:, 0].mean(), corners_px[:, 1].min()
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5}
    axes.text(*place, label, ha="center", va="bottom", color=BLUE, zorder=5, bbox=box)


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
    # A tile of an object lies behind those of the scene's points.
    tiles = np.flatnonzero(whole.starts[:-1] >= value(about, "scene_points"))
    boxes = list(zip(whole.low[tiles], whole.high[tiles]))
    before, after = _read(scene, every, boxes), _read(whole, every, boxes)
    # Stray points far out would take the precision of the positions, and the picture.
    low, high = np.percentile(before.points[_evenly(before.points, every)], [0.1, 99.9], axis=0)
    before, after = (cloud[within(cloud.points, low, high, margin=0.1)] for cloud in (before, after))
    low, high = np.percentile(before.points[_evenly(before.points, every)], [1, 99], axis=0)
    # As in the scene's figure, a little higher: the objects do not hide each other.
    view = view_of(before, after, low, high, sources, length_unit(georeference_json), -60.0, 35.0, boxes)
    if every > 1:
        view = replace(view, before_points=len(scene), after_points=len(whole))
    write_view(folder, view)
    of = "" if every == 1 else f"; of the scene away from its objects one in {every} was looked at"
    print(f"{folder}/view.ply: {len(view.cloud):,} points{of}", flush=True)


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
