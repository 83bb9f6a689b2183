"""The figures of an object: what was missing, what was added, how it fits (paper Figures 2, 3, 5)."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, read_cloud, spacing
from scenefuse.cloud.tiled_cloud import open_cloud
from scenefuse.core.stage import StageError, atomic_directory, read_json, value
from scenefuse.core.transforms import Array, Sim3, box_around, rotation_between
from scenefuse.fuse.fuse_object import is_placed
from scenefuse.fuse.missing import Lack
from scenefuse.fuse.write import after_fusion
from scenefuse.photos.sheets import Image, Sheet, add_axes, draw_sheet, new_figure, save_png, to_image
from scenefuse.report.object_sheet import SIDES_DEG, cloud_sheet, inner, object_sheet, sides, upright
from scenefuse.report.render import luminance, orbit_camera, point_radii, render
from scenefuse.report.values import load, unit_of
from scenefuse.report.view import REMOVED, VIEW_POINTS, View, merge, thin, within, write_view

COLORS = {
    "scene": (205, 208, 212),
    "crop": (40, 95, 185),
    "object": (245, 170, 85),
    Lack.NEVER_SEEN: (214, 38, 31),
    Lack.UNTEXTURED: (52, 101, 196),
    Lack.CONTRADICTED: (150, 60, 170),
}
# How far around the object, as shares of its diagonal: sideways enough to see what it stands on.
REACH = (0.35, 0.35, 0.15)
# Clouds and the radii of their points' discs.
Discs = list[tuple[Cloud, NDArray[np.float32]]]


@dataclass(frozen=True)
class Surroundings:
    """The clouds of one object in the scene's frame, turned so that z points up.

    Attributes:
        before: the scene around the object.
        after: the same part of the scene after fusion.
        crop: the object's part of the scene, as registration saw it.
        object_cloud: the object at its estimated pose, or None when there is no pose.
        framed: (N, 3) points every picture has to show.
        fused: whether the object was fused.
        decision: status and reason.
        unit: of the scene's lengths.
        missing: cells of the object's surface that the completed scene lacks; None where they were not looked for.
        stations: (S, 3) places to photograph these from, best first.
    """

    before: Cloud
    after: Cloud
    crop: Cloud
    object_cloud: Cloud | None
    framed: Array
    fused: bool
    decision: str
    unit: str
    missing: Cloud | None
    stations: Array


@dataclass(frozen=True)
class FigureInputs:
    """What the figures of one object show."""

    name: str
    """The object's name, for titles."""
    scene: Path
    """The scene's dense cloud, scene frame."""
    fused: Path
    """The object's surroundings after fusion, with the field `source` (0 scene, 1 object)."""
    checked: Path
    """What fusion changed in the scene."""
    crop: Path
    """The object's part of the scene, scene frame."""
    crop_json: Path
    """JSON of the crop; `up_in_scene` is the direction opposite to gravity, z when absent."""
    object_cloud: Path
    """The object's cloud in its own frame."""
    fine_json: Path
    """JSON of the fine registration: status, reason, scene_from_object."""
    missing: Path
    """Cells of the object's surface that are still missing (PLY, scene frame)."""
    missing_json: Path
    """JSON of the same."""
    next_photos: Path
    """CSV of the stations from where photos would show them."""
    workspace: Path | None = None
    """The object's undistorted COLMAP workspace (images/, sparse/); None where it has no photos."""
    masks: Path | None = None
    """Folder of the object's masks, {photo}.png, where it has some."""
    stages: tuple[Path, ...] = ()
    """Folders of stages 1 to 4, each with depth_maps/; the last with renders/ too; none where its cloud was given."""


def draw_object(*, inputs: FigureInputs, figures: Path) -> None:
    """Draw the figures of one object (paper Figures 2, 3 and 5).

    Writes before_after.png (the surroundings before and after fusion from four sides and from below), before.png and
    after.png (one large view of each, the side that changed most), missing.png (what is still missing, and from where
    photos would show it), registration.png (object over crop, with the decision) and object.png (frames, masks, depth
    of the four stages, renders, the object's cloud, alone where it was given); of a fused object view.ply and view.json
    too, for the 3D view of the report page.

    Args:
        inputs: see FigureInputs.
        figures: output folder of PNG files, each below 1 MB, and the view.

    Raises:
        StageError: a cloud or JSON is missing or damaged.
    """
    join = read_surroundings(inputs)
    clouds = [
        (cloud, point_radii(cloud.points, source=cloud.fields.get("source"))) for cloud in (join.before, join.after)
    ]
    azimuth_deg = _most_changed(clouds, join.framed)
    pictures = {
        "before_after": _before_after(inputs.name, join, clouds),
        "registration": _registration(inputs.name, join),
        **dict(zip(("before", "after"), _large(clouds, join.framed, azimuth_deg))),
    }
    if join.fused and join.missing is not None:
        pictures["missing"] = _missing(inputs.name, join, join.missing, clouds[1][1])
    cloud = join.object_cloud or read_cloud(inputs.object_cloud)
    if inputs.workspace is not None:
        cloud = join.object_cloud or upright(cloud, inputs.workspace)
    if inputs.workspace is None or inputs.masks is None or not inputs.stages:
        pictures["object"] = cloud_sheet(inputs.name, cloud, inputs.workspace is not None)
    else:
        pictures["object"] = object_sheet(inputs.name, cloud, inputs.workspace, inputs.masks, list(inputs.stages))
    with atomic_directory(figures) as folder:
        for name, picture in pictures.items():
            save_png(folder / f"{name}.png", picture)
            print(f"{name}.png", flush=True)
        if join.fused:
            write_view(folder, _view(inputs.name, join, azimuth_deg))


def draw_lone_object(
    *,
    name: str,
    object_cloud: Path,
    sparse_json: Path,
    workspace: Path,
    masks: Path,
    stages: tuple[Path, ...],
    figures: Path,
) -> None:
    """Draw an object that lies in no scene: object.png (as `draw_object` does), and its cloud for the page's 3D view.

    Args:
        name: the object's, for the titles.
        object_cloud: its cloud (PLY), in its own frame.
        sparse_json: holds the unit of its lengths, where it is metres.
        workspace: its undistorted COLMAP workspace.
        masks: folder of its masks, {photo}.png.
        stages: folders of its four training stages.
        figures: output folder.
    """
    cloud = upright(read_cloud(object_cloud), workspace)
    sheet = object_sheet(name, cloud, workspace, masks, list(stages))
    framed = inner(cloud.points)
    low, high = framed.min(0), framed.max(0)
    points = thin(merge(cloud, cloud), VIEW_POINTS)
    unit = read_json(sparse_json).get("length_unit", {}).get("value", "object units")
    view = View(points, {0: name}, unit, low, high, SIDES_DEG[0], 18.0, len(cloud), len(cloud))
    with atomic_directory(figures) as folder:
        save_png(folder / "object.png", sheet)
        write_view(folder, view)


def _view(name: str, join: Surroundings, azimuth_deg: float) -> View:
    """The 3D view of an object: its surroundings before and after, thinned."""
    points, low, high = merge(join.before, join.after), join.framed.min(0), join.framed.max(0)
    points.fields["near"][:] = within(points.points, low, high)
    thinned = thin(points, VIEW_POINTS)
    found = set(thinned.fields["source"].tolist()) - {0, REMOVED}
    sources = {0: "scene"} | {number: f"added from {name}" for number in found}
    counts = len(join.before), len(join.after)
    return View(thinned, sources, join.unit, low, high, azimuth_deg, 18.0, *counts)


def _before_after(name: str, join: Surroundings, clouds: Discs) -> Image:
    """Rows before and after; four sides from slightly above, and from below with the surroundings cut away."""
    tile = (350, 290)
    low, high = join.framed.min(0), join.framed.max(0)
    margin = 0.06 * float(np.linalg.norm(high - low)) * np.array([1.0, 1.0, 0.0])
    rows: list[list[Image | None]] = []
    for cloud, radii in clouds:
        near = ((cloud.points >= low - margin) & (cloud.points <= high + margin))[:, :2].all(1)
        from_below = orbit_camera(join.framed, SIDES_DEG[0], -14.0, tile)
        rows.append([*sides(cloud, join.framed, radii, tile, 22.0), render(cloud[near], from_below, radii[near])])
    after = "after" if join.fused else "after (not fused)"
    columns = [f"azimuth {a:.0f}°" for a in SIDES_DEG] + ["from below, surroundings cut away"]
    return draw_sheet(Sheet(f"{name}: before and after", join.decision, rows, ["before", after], columns, {}, tile))


def _missing(name: str, join: Surroundings, cells: Cloud, radii: NDArray[np.float32]) -> Image:
    """What is still missing, coloured by why, from above with the stations, and from the best of these."""
    tile = (430, 350)
    kinds = cells.fields["missing"] if len(cells) else np.zeros(0, np.uint8)
    shade = 0.6 + 0.4 * _brightness(join.after)[:, None]
    colors = np.concatenate(
        [COLORS["scene"] * shade, np.array([COLORS[kind] for kind in kinds.tolist()]).reshape(-1, 3)]
    )
    side = 1.2 * float(np.median(radii)) if len(cells) < 2 else 0.8 * spacing(cells.points)
    cloud, sizes = Cloud(np.concatenate([join.after.points, cells.points])), np.append(radii, np.full(len(cells), side))
    middle = (join.framed.min(0) + join.framed.max(0)) / 2
    toward = join.stations[: len(SIDES_DEG) - 1] - middle
    turns = np.degrees(np.arctan2(toward[:, 1], toward[:, 0])).tolist()
    heights = np.degrees(np.arctan2(toward[:, 2], np.linalg.norm(toward[:, :2], axis=1))).tolist()
    away = np.linalg.norm(toward, axis=1)
    titles = [f"from station {k}, {distance:.3g} {join.unit} away" for k, distance in enumerate(away, 1)]
    for azimuth in SIDES_DEG[len(turns) + 1 :]:
        turns, heights, titles = [*turns, azimuth], [*heights, 22.0], [*titles, f"azimuth {azimuth:.0f}°"]
    images: list[Image | None] = [_plan_view(join, cloud, sizes, colors.astype(np.uint8), tile)]
    for turn, height in zip(turns, heights):
        images.append(render(cloud, orbit_camera(join.framed, turn, height, tile), sizes, colors.astype(np.uint8)))
    counts = ", ".join(f"{kind.name.lower().replace('_', ' ')} {(kinds == kind).sum()}" for kind in Lack)
    shown = f", the best {len(away)} shown" if len(away) < len(join.stations) else ""
    note = f"missing cells: {counts} (red, blue, purple); stations: {len(join.stations)}{shown}; see next_photos.csv"
    columns = ["from above, with the stations", *titles]
    return draw_sheet(Sheet(f"{name}: what is still missing", note, [images], [], columns, {}, tile))


def _plan_view(join: Surroundings, cloud: Cloud, radii: Array, colors: Image, tile: tuple[int, int]) -> Image:
    """The object from above, and the numbered stations around it."""
    camera = orbit_camera(
        np.concatenate([join.framed, join.stations]), -90.0, 90.0, tile, orthographic=True, margin=0.1
    )
    sheet = new_figure(tile)
    axes = add_axes(sheet, (0, 0, *tile), tile)
    axes.imshow(render(cloud, camera, radii, colors))
    axes.set(xlim=(0, tile[0]), ylim=(tile[1], 0))
    middle = camera.project(join.framed.mean(0, keepdims=True))[0][0]
    for station, (x, y) in enumerate(camera.project(join.stations)[0], 1):
        axes.annotate("", middle, (x, y), arrowprops={"arrowstyle": "->", "color": "#888888", "shrinkB": 40})
        axes.scatter([x], [y], s=150, c="#d6261f", edgecolors="white", zorder=3)
        axes.text(x, y, str(station), ha="center", va="center", fontsize=9, color="white", zorder=4)
    return to_image(sheet)


def _registration(name: str, join: Surroundings) -> Image:
    """The object over the crop from three sides."""
    tile, dots = (480, 390), point_radii(join.crop.points)
    radii = 0.5 * np.minimum(dots, np.float32(np.median(dots)))
    colors, framed = np.tile(np.array(COLORS["crop"], np.uint8), (len(join.crop), 1)), join.crop.points
    if join.object_cloud is not None:
        framed = np.concatenate([framed, join.object_cloud.points])
        radii = np.concatenate([radii, point_radii(join.object_cloud.points)])
        colors = np.concatenate([colors, np.tile(np.array(COLORS["object"], np.uint8), (len(join.object_cloud), 1))])
    # Small dots of the crop over the closed surface of the object; without normals both are shaded by depth alone.
    cloud = Cloud(framed)
    views = {"side, azimuth 30°": (30.0, 12.0), "side, azimuth 120°": (120.0, 12.0), "from above": (-90.0, 90.0)}
    images: list[Image | None] = [
        render(cloud, orbit_camera(framed, a, e, tile, orthographic=True), radii, colors) for a, e in views.values()
    ]
    note = f"{join.decision}. Blue: crop of the scene, orange: object" + (
        "" if join.object_cloud is not None else " (no pose)"
    )
    return draw_sheet(Sheet(f"{name}: registration", note, [images], [], list(views), {}, tile))


def _large(
    clouds: Discs, framed: Array, azimuth_deg: float, size_px: tuple[int, int] = (840, 600)
) -> tuple[Image, Image]:
    """The same view before and after."""
    camera = orbit_camera(framed, azimuth_deg, 15.0, size_px, margin=0.1)
    first, second = (render(cloud, camera, radii) for cloud, radii in clouds)
    return first, second


def _most_changed(clouds: Discs, framed: Array) -> float:
    """The azimuth, in degrees, from which before and after differ most."""
    azimuths = np.arange(0.0, 360.0, 45.0)
    pairs = (_large(clouds, framed, float(azimuth), (120, 90)) for azimuth in azimuths)
    changes = [float(np.abs(np.subtract(first, second, dtype=np.float32)).mean()) for first, second in pairs]
    return float(azimuths[int(np.argmax(changes))])


def _brightness(cloud: Cloud) -> Array:
    """(N,) brightness 0 to 1 of the points' colours; 1 where there are none."""
    return np.ones(len(cloud)) if cloud.colors is None else luminance(cloud.colors) / 255


def read_surroundings(inputs: FigureInputs) -> Surroundings:
    """Read the clouds and turn them upright; the surroundings are cut to a box around the object.

    Raises:
        StageError: a file is missing or damaged, or the scene has no points around the object.
    """
    fine = read_json(inputs.fine_json)
    up = read_json(inputs.crop_json).get("up_in_scene", {}).get("value")
    level = Sim3(1.0, rotation_between(np.array(up or [0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])), np.zeros(3))
    crop = read_cloud(inputs.crop).transformed(level)
    pose = fine.get("scene_from_object", {}).get("value")
    placed = None
    if pose is not None:
        placed = read_cloud(inputs.object_cloud).transformed(level @ Sim3.from_matrix(np.array(pose)))
    fused = is_placed(fine)
    shown = placed if fused and placed is not None else crop
    low, high = np.percentile(shown.points, [0.5, 99.5], axis=0)
    reach = np.array(REACH) * float(np.linalg.norm(high - low))
    scene, box = open_cloud(inputs.scene), box_around(low - reach, high + reach, level.inverse())
    clouds = scene.near(*box)[1], after_fusion(scene, inputs.checked, inputs.fused, *box)
    level_clouds = (cloud.transformed(level) for cloud in clouds)
    before, after = (cloud[within(cloud.points, low - reach, high + reach, margin=0.0)] for cloud in level_clouds)
    if not len(before):
        raise StageError(
            f"{inputs.scene} has no points around {inputs.name}; look at the crop and at the registration's log"
        )
    unit = unit_of(load(inputs.crop_json), "diagonal") or "scene units"
    missing, reason = _missing_cells(inputs), fine.get("reason", {}).get("value")
    decision = ": ".join(filter(None, [value(fine, "status"), reason]))
    return Surroundings(
        before, after, crop, placed, inner(shown.points), fused, decision, unit,
        None if missing is None else missing.transformed(level), level.apply(read_stations(inputs.next_photos)),
    )  # fmt: skip


def _missing_cells(inputs: FigureInputs) -> Cloud | None:
    """The cells; none where nothing is missing; None where the object has no pose or no photos."""
    content = read_json(inputs.missing_json)
    if "missing" not in content:
        return None
    share = value(content, "missing")
    return read_cloud(inputs.missing) if share else Cloud(np.zeros((0, 3)))


def read_stations(path: Path) -> Array:
    """(S, 3) places of the stations in a table of photos, scene frame: the middle one of the photos of each."""
    with open(path, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["photo"] == "2"]
    return np.array([[float(row[axis]) for axis in "xyz"] for row in rows]).reshape(-1, 3)
