"""The figures of an object and of a scene: what was missing, what was added, how it fits (paper Figures 2, 3, 5)."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud, spacing
from scenefuse.cloud.tiled_cloud import open_cloud
from scenefuse.core.stage import atomic_directory, read_json
from scenefuse.core.transforms import Array, box_corners
from scenefuse.fuse.measure import Evidence
from scenefuse.fuse.missing import Lack
from scenefuse.photos.sheets import Image, Sheet, add_axes, draw_sheet, new_figure, save_png, to_image
from scenefuse.photos.workspace import read_views
from scenefuse.report.object_sheet import SIDES_DEG, cloud_sheet, inner, object_sheet, sides, upright
from scenefuse.report.render import MAX_DRAWN, luminance, orbit_camera, point_radii, render
from scenefuse.report.surroundings import FigureInputs, Surroundings, read_surroundings
from scenefuse.report.view import REMOVED, View, merge, thin, within, write_view

COLORS = {
    "scene": (205, 208, 212),
    "added": (240, 120, 25),
    "unconfirmed": (150, 60, 170),
    "crop": (40, 95, 185),
    "object": (245, 170, 85),
    Lack.NEVER_SEEN: (214, 38, 31),
    Lack.UNTEXTURED: (52, 101, 196),
    Lack.CONTRADICTED: (150, 60, 170),
}
# Points of an object's 3D view: with three objects and a scene, the page stays well below 15 MB.
VIEW_POINTS = 150_000
# Clouds and the radii of their points' discs.
Discs = list[tuple[Cloud, NDArray[np.float32]]]


def draw_object(*, inputs: FigureInputs, figures: Path) -> None:
    """Draw the figures of one object (paper Figures 2, 3 and 5).

    Writes before_after.png (the surroundings before and after fusion from four sides and from below), before.png and
    after.png (one large view of each, the side that changed most), provenance.png (scene grey, added points coloured),
    missing.png (what is still missing, and from where photos would show it), registration.png (object over crop, with
    the decision) and object.png (frames, masks, depth of the four stages, renders, the object's cloud, alone where it
    was given); of a fused object view.ply and view.json too, for the 3D view of the report page.

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
        "provenance": _provenance(inputs.name, join, clouds[1][1]),
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


def _added(cloud: Cloud) -> NDArray[np.bool_]:
    """(N,) True for the points that came from the object."""
    return cloud.fields["source"] == 1 if "source" in cloud.fields else np.zeros(len(cloud), dtype=bool)


def _view(name: str, join: Surroundings, azimuth_deg: float) -> View:
    """The 3D view of an object: its surroundings before and after, thinned."""
    points, low, high = merge(join.before, join.after), join.framed.min(0), join.framed.max(0)
    points.fields["near"][:] = within(points.points, low, high)
    thinned = thin(points, VIEW_POINTS)
    found = set(thinned.fields["source"].tolist()) - {0, REMOVED}
    sources = {0: "scene"} | {number: f"added from {name}" for number in found}
    counts = len(join.before), len(join.after)
    return View(thinned, sources, join.unit, low, high, azimuth_deg, 18.0, *counts, join.brighter)


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


def _provenance(name: str, join: Surroundings, radii: NDArray[np.float32]) -> Image:
    """Scene points grey, added points coloured, those of them that no photo confirms in another colour."""
    tile, added = (430, 350), _added(join.after)
    kinds = join.after.fields.get("evidence", np.zeros(len(added), np.uint8))
    unconfirmed = added & (kinds == Evidence.NERF_ONLY)
    shade = 0.6 + 0.4 * _brightness(join.after)[:, None]
    colors = np.where(added[:, None], COLORS["added"], COLORS["scene"])
    colors = (np.where(unconfirmed[:, None], COLORS["unconfirmed"], colors) * shade).astype(np.uint8)
    images = sides(join.after, join.framed, radii, tile, 22.0, colors)
    note = (
        f"grey: {(~added).sum():,} points of the scene; orange: {(added & ~unconfirmed).sum():,} points added from the"
        f" object; purple: {unconfirmed.sum():,} of its points that no photo confirms"
    )
    columns = [f"azimuth {a:.0f}°" for a in SIDES_DEG]
    return draw_sheet(Sheet(f"{name}: where the points come from", note, [images], [], columns, {}, tile))


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
    for number, (x, y) in enumerate(camera.project(join.stations)[0], 1):
        axes.annotate("", middle, (x, y), arrowprops={"arrowstyle": "->", "color": "#888888", "shrinkB": 40})
        axes.scatter([x], [y], s=150, c="#d6261f", edgecolors="white", zorder=3)
        axes.text(x, y, str(number), ha="center", va="center", fontsize=9, color="white", zorder=4)
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


def _draw_box(axes: Any, corners_px: Array, label: str) -> None:
    """The twelve edges of a projected box, and its name above it."""
    for a in range(8):
        for bit in (1, 2, 4):
            if not a & bit:
                axes.plot(*corners_px[[a, a | bit]].T, color="#0b4ea2", linewidth=1.2, zorder=4)
    x, y = corners_px[:, 0].mean(), corners_px[:, 1].min() - 6
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5}
    axes.text(x, y, label, ha="center", va="bottom", fontsize=9.5, color="#0b4ea2", zorder=5, bbox=box)
