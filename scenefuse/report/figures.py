"""The figures of an object: what was missing, what was added (paper Figures 2 and 3)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from scenefuse.cloud.clouds import Cloud, read_cloud, spacing
from scenefuse.cloud.tiled_cloud import open_cloud
from scenefuse.core.stage import StageError, atomic_directory, read_json, value
from scenefuse.core.transforms import UP, Array, Sim3, inside_box, rotation_between
from scenefuse.fuse.fuse_object import is_placed
from scenefuse.fuse.missing import Lack
from scenefuse.fuse.write import after_fusion
from scenefuse.photos.geodesy import compass
from scenefuse.photos.pictures import read_depth, read_mask, read_rgb
from scenefuse.photos.sheets import TILE_PX, Cell, Image, depth_colors, draw_scale, draw_sheet, save_png
from scenefuse.photos.workspace import read_views
from scenefuse.report.render import brightened, camera_at, luminance, orbit_camera, point_radii, render
from scenefuse.report.values import WORDS, load, unit_of
from scenefuse.report.view import REACH, view_of, within, write_view
from scenefuse.sfm.gravity import estimate_up

SCENE = "#cdd0d4"
LACKS = {
    Lack.NEVER_SEEN: ("red", "#d6261f"), Lack.UNTEXTURED: ("yellow", "#e0a800"), Lack.CONTRADICTED: ("blue", "#3465c4")
}  # fmt: skip
# Azimuths of the four sides that a row of pictures shows.
SIDES_DEG = (30.0, 120.0, 210.0, 300.0)
# Clouds and the radii of their points' discs.
Discs = list[tuple[Cloud, NDArray[np.float32]]]


@dataclass(frozen=True)
class Surroundings:
    """The clouds of one object in the scene's frame.

    Attributes:
        before: the scene around the object.
        after: the same part of the scene after fusion.
        object_cloud: the object at its estimated pose, or None when there is no pose.
        framed: (N, 3) points every picture has to show.
        fused: whether the object was fused.
        decision: status and reason.
        unit: of the scene's lengths.
        missing: cells of the object's surface that the completed scene lacks; None where they were not looked for.
        stations: (S, 3) places to photograph these from, best first.
        has_north: whether y is north.
    """

    before: Cloud
    after: Cloud
    object_cloud: Cloud | None
    framed: Array
    fused: bool
    decision: str
    unit: str
    missing: Cloud | None
    stations: Array
    has_north: bool


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
    """JSON of the crop, for the unit of lengths."""
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
    """Draw the figures of one object (paper Figures 2 and 3).

    Writes before_after.png (the surroundings before and after fusion from four sides and from below), before.png and
    after.png (one large view of each, the side that changed most), missing.png (what is still missing, and from where
    photos would show it) and object.png (depth of the four stages, renders, the object's cloud, alone where it was
    given); of a fused object view.ply and view.json too, for the 3D view of the report page.

    Args:
        inputs: see FigureInputs.
        figures: output folder of PNG files and the view.

    Raises:
        StageError: a cloud or JSON is missing or damaged.
    """
    join = read_surroundings(inputs)
    clouds = [
        (cloud, point_radii(cloud.points, source=cloud.fields.get("source"))) for cloud in (join.before, join.after)
    ]
    azimuth_deg = most_changed(clouds, join.framed)
    large = _large(clouds, join.framed, azimuth_deg, (2 * TILE_PX[0], 2 * TILE_PX[1]))
    pictures: dict[str, Image | Figure] = dict(zip(("before", "after"), large))
    pictures["before_after"] = _before_after(inputs.name, join, clouds)
    if join.fused and join.missing is not None:
        pictures["missing"] = _missing(inputs.name, join, join.missing, clouds[1][1])
    cloud = join.object_cloud or read_cloud(inputs.object_cloud)
    if inputs.workspace is not None:
        cloud = join.object_cloud or upright(cloud, inputs.workspace)
    pictures["object"] = _object_sheet(inputs.name, cloud, inputs.workspace, inputs.masks, inputs.stages)
    with atomic_directory(figures) as folder:
        for name, picture in pictures.items():
            save_png(folder / f"{name}.png", picture)
            print(f"{name}.png", flush=True)
        if join.fused:
            numbers = np.unique(join.after.fields.get("source", np.zeros(1, np.int64))).tolist()
            sources = {number: f"added from {inputs.name}" if number else "scene" for number in numbers}
            box = join.framed.min(0), join.framed.max(0)
            write_view(folder, view_of(join.before, join.after, *box, sources, join.unit, azimuth_deg))


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
    sheet, framed = _object_sheet(name, cloud, workspace, masks, stages), inner(cloud.points)
    unit = read_json(sparse_json).get("length_unit", {}).get("value", "object units")
    with atomic_directory(figures) as folder:
        save_png(folder / "object.png", sheet)
        box = framed.min(0), framed.max(0)
        radii, none = point_radii(cloud.points), np.zeros(0, np.int64)
        discs = [(cloud[none], radii[none]), (cloud, radii)]
        write_view(folder, view_of(cloud, cloud, *box, {0: name}, unit, most_changed(discs, framed)))


def _before_after(name: str, join: Surroundings, clouds: Discs) -> Figure:
    """Rows before and after; four sides from slightly above, and from below with the surroundings cut away."""
    low, high = join.framed.min(0), join.framed.max(0)
    rows = []
    for cloud, radii in clouds:
        near = within(cloud.points[:, :2], low[:2], high[:2])
        from_below = render(cloud[near], orbit_camera(join.framed, SIDES_DEG[0], -14.0, TILE_PX), radii[near])
        rows.append(
            [*_sides(cloud, join.framed, radii, join.has_north), ("from below, surroundings cut away", from_below)]
        )
    labels = ["before", "after" if join.fused else "after (not fused)"]
    return draw_sheet(f"{name}: before and after", f"{join.decision}; grey: from behind", rows, labels=labels)


def _missing(name: str, join: Surroundings, cells: Cloud, radii: NDArray[np.float32]) -> Figure:
    """What is still missing, coloured by why, from above with the stations, and from the best of these."""
    kinds = cells.fields["missing"] if len(cells) else np.zeros(0, np.uint8)
    colors = join.after.colors
    brightness = np.ones(len(join.after)) if colors is None else luminance(colors) / 255
    shade = _rgb(SCENE) * (0.6 + 0.4 * brightness[:, None])
    colors = np.concatenate([shade, np.array([_rgb(LACKS[kind][1]) for kind in kinds.tolist()]).reshape(-1, 3)])
    side = 1.2 * float(np.median(radii)) if len(cells) < 2 else 0.8 * spacing(cells.points)
    cloud, sizes = Cloud(np.concatenate([join.after.points, cells.points])), np.append(radii, np.full(len(cells), side))
    from_above = orbit_camera(np.concatenate([join.framed, join.stations]), -90.0, 90.0, TILE_PX, orthographic=True)
    cameras = {"from above, with the stations": from_above}
    shown_from, middle = join.stations[: len(SIDES_DEG) - 1], (join.framed.min(0) + join.framed.max(0)) / 2
    for number, place in enumerate(shown_from, 1):
        x, y = (place - middle)[:2]
        # To two digits: nobody stands more exactly.
        away, up = (f"{float(f'{far:.2g}'):g}" for far in (np.hypot(x, y), place[2] - join.framed[:, 2].min()))
        label = f"from station {number}, {away} {join.unit}"
        label += f" {compass(np.degrees(np.arctan2(x, y)))} of it" if join.has_north else " away"
        label += f", {up} {join.unit} up"
        cameras[label] = camera_at(place, join.framed, TILE_PX)
    for azimuth in SIDES_DEG[len(cameras) :]:
        cameras[_from(azimuth, join.has_north)] = orbit_camera(join.framed, azimuth, 20.0, TILE_PX)
    pictures = [(label, render(cloud, camera, sizes, colors)) for label, camera in cameras.items()]
    seen = ", ".join(f"{color}: {WORDS['missing'][kind.name.lower()]}" for kind, (color, _) in LACKS.items())
    shown = f", the best {len(shown_from)} shown" if len(shown_from) < len(join.stations) else ""
    counted = f"{len(join.stations)} station{'' if len(join.stations) == 1 else 's'}"
    note = f"{seen}\n{counted} to photograph it from{shown}; where: next_photos.csv"
    sheet = draw_sheet(f"{name}: what is still missing", note, [pictures[:2], pictures[2:]])
    axes, target = sheet.axes[0], from_above.project(middle[None])[0][0]
    places = from_above.project(join.stations)[0]
    in_the_way = (places < [0.45 * TILE_PX[0], np.inf]) & (places > [-np.inf, 0.6 * TILE_PX[1]])
    draw_scale(axes, from_above.focal_px, join.unit, join.has_north, at_right=bool(in_the_way.all(1).any()))
    # The best one lies on top, where two are close to each other.
    for number, at in reversed([*enumerate(places, 1)]):
        arrow = {"arrowstyle": "->", "color": "0.5", "shrinkB": 40}
        mark = {"boxstyle": "circle,pad=0.15", "facecolor": "black", "edgecolor": "white"}
        axes.annotate(
            str(number), target, at, arrowprops=arrow, bbox=mark, color="white", ha="center", va="center", zorder=6
        )  # fmt: skip
    return sheet


def _large(clouds: Discs, framed: Array, azimuth_deg: float, size_px: tuple[int, int]) -> list[Image]:
    """The same view before and after."""
    camera = orbit_camera(framed, azimuth_deg, 15.0, size_px)
    return [render(cloud, camera, radii) for cloud, radii in clouds]


def most_changed(clouds: Discs, framed: Array) -> float:
    """The azimuth, in degrees, from which the fronts of surfaces differ most before and after."""
    azimuths, changes = np.arange(0.0, 360.0, 45.0).tolist(), []
    for azimuth in azimuths:
        centre = orbit_camera(framed, azimuth, 15.0, TILE_PX).centre
        fronts = [(cloud[seen], radii[seen]) for cloud, radii in clouds for seen in [_facing(cloud, centre)]]
        pair = _large(fronts, framed, azimuth, (120, 90))
        changes.append(float(np.abs(np.subtract(*pair, dtype=np.float32)).mean()))
    return float(azimuths[int(np.argmax(changes))])


def _facing(cloud: Cloud, centre: Array) -> NDArray[np.bool_]:
    """(N,) points that turn their front to a camera, by their normals; all where there are none."""
    if cloud.normals is None:
        return np.ones(len(cloud), bool)
    return np.asarray(np.einsum("ij,ij->i", centre - cloud.points, cloud.normals) > 0)


def _rgb(color: str) -> Array:
    """(3,) of 255."""
    return 255 * np.array(to_rgb(color))


def _object_sheet(
    name: str, cloud: Cloud, workspace: Path | None, masks: Path | None, stages: tuple[Path, ...]
) -> Figure:
    """Depth of each stage on one scale, renders beside photos, the cloud from four sides (Figure 3); the cloud alone of
    an object that was given as one."""
    title, sides = f"{name}: the object by itself", _sides(cloud, inner(cloud.points), point_radii(cloud.points))
    if workspace is None or masks is None or not stages:
        note = (
            f"given as a cloud of {len(cloud):,} points: no stages, {'no' if workspace is None else 'its own'} photos"
        )
        return draw_sheet(title, note, [sides], labels=["cloud"])
    photos = sorted(p for p in (workspace / "images").iterdir() if (masks / f"{p.stem}.png").is_file())
    if not photos:
        raise StageError(f"no photo in {workspace}/images has a mask in {masks}; rerun the masks stage")
    rows: list[Sequence[Cell]] = [_depth_row(photos, masks, stages), _render_row(photos, stages[-1]), sides]
    note = f"{len(photos)} frames with masks; cloud of {len(cloud):,} points; one depth scale, near bright, far dark"
    return draw_sheet(title, note, rows, labels=["depth", "renders", "cloud"])


def _sides(cloud: Cloud, framed: Array, radii: ArrayLike, has_north: bool = False) -> list[Cell]:
    """A cloud from four sides, all of `framed` in each picture."""
    cameras = {azimuth: orbit_camera(framed, azimuth, 20.0, TILE_PX) for azimuth in SIDES_DEG}
    return [(_from(azimuth, has_north), render(cloud, camera, radii)) for azimuth, camera in cameras.items()]


def _from(azimuth_deg: float, has_north: bool) -> str:
    """From where something is seen: in words where x is known to be east."""
    return f"from the {compass(90 - azimuth_deg)}" if has_north else f"azimuth {azimuth_deg:.0f}°"


def _depth_row(photos: list[Path], masks: Path, stages: tuple[Path, ...]) -> list[Cell]:
    """The depth maps of the first photo that most stages have, colour-mapped on one scale over its mask."""
    files = {p: [s / "depth_maps" / f"{p.name}.bin" for s in stages] for p in photos}
    shown = max(photos, key=lambda photo: sum(file.is_file() for file in files[photo]))
    maps = [read_depth(f) if f.is_file() else None for f in files[shown]]
    mask = read_mask(masks / f"{shown.stem}.png")
    inside = [None if d is None else np.where(_fit(mask, d.shape), d, 0.0) for d in maps]
    known = [d[d > 0] for d in inside if d is not None and (d > 0).any()]
    low, high = np.percentile(known[-1], [1, 99]).tolist() if known else (0.0, 1.0)
    return [
        (f"stage {stage}, {shown.name}", None if d is None else depth_colors(d, low, high))
        for stage, d in enumerate(inside, 1)
    ]


def _render_row(photos: list[Path], stage: Path) -> list[Cell]:
    """Two of the photos that stage 4 was measured on, and their renders."""
    renders = [(p, file) for p in photos if (file := stage / "renders" / f"{p.stem}.png").is_file()]
    shown = renders[:: max(1, len(renders) // 2)][:2]
    row: list[Cell] = [("", None)] * (len(SIDES_DEG) - 2 * len(shown))
    pairs = [((f"photo {p.name}", read_rgb(p)), ("its render, stage 4", read_rgb(file))) for p, file in shown]
    return [cell for pair in pairs for cell in pair] + row


def _fit(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """The mask at another size."""
    size = (shape[1], shape[0])
    return np.asarray(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)


def upright(cloud: Cloud, workspace: Path) -> Cloud:
    """The object's cloud turned so that z points up, from the photos' horizontal axes."""
    poses = [view.world_from_cam for view in read_views(workspace / "sparse")]
    up, _ = estimate_up(np.array([pose[:3, :3] for pose in poses]), np.array([pose[:3, 3] for pose in poses]))
    return cloud.transformed(Sim3(1.0, rotation_between(up, UP), np.zeros(3)))


def inner(points: Array, limit: int = 20000) -> Array:
    """At most that many of the points, without the outermost half per cent of each axis: what a picture has to show."""
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return points[inside_box(points, low, high)][:: max(1, len(points) // limit)]


def read_surroundings(inputs: FigureInputs) -> Surroundings:
    """Read the clouds; the surroundings are cut to a box around the object.

    Raises:
        StageError: a file is missing or damaged, or the scene has no points around the object.
    """
    fine = read_json(inputs.fine_json)
    pose, fused, placed = fine.get("scene_from_object", {}).get("value"), is_placed(fine), None
    if pose is not None:
        placed = read_cloud(inputs.object_cloud).transformed(Sim3.from_matrix(np.array(pose)))
    shown = (placed if fused and placed is not None else read_cloud(inputs.crop)).points
    low, high = np.percentile(shown, [0.5, 99.5], axis=0)
    reach = REACH * float(np.linalg.norm(high - low))
    scene, box = open_cloud(inputs.scene), (low - reach, high + reach)
    clouds = scene.near(*box)[1], after_fusion(scene, inputs.checked, inputs.fused, *box)
    before, after = brightened(*(cloud[inside_box(cloud.points, *box)] for cloud in clouds))
    if not len(before):
        raise StageError(
            f"{inputs.scene} has no points around {inputs.name}; look at the crop and at the registration's log"
        )
    unit = unit_of(load(inputs.crop_json), "diagonal") or "scene units"
    decision = ": ".join(filter(None, [value(fine, "status"), fine.get("reason", {}).get("value")]))
    missing = None
    if (share := read_json(inputs.missing_json).get("missing", {}).get("value")) is not None:
        missing = read_cloud(inputs.missing) if share else Cloud(np.zeros((0, 3)))
    photos = pd.read_csv(inputs.next_photos)
    # The middle one of the three photos of a station.
    stations = photos[photos.photo == 2].filter(like="local_").to_numpy(np.float64).reshape(-1, 3)
    has_north = "longitude_deg" in photos
    return Surroundings(before, after, placed, inner(shown), fused, decision, unit, missing, stations, has_north)
