"""The sheet of one object by itself: frames, masks, depth of the four stages, renders, cloud (Figure 3)."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array, Sim3, rotation_between
from scenefuse.photos.pictures import read_depth, read_mask, read_rgb
from scenefuse.photos.sheets import Image, Sheet, depth_colors, draw_sheet
from scenefuse.photos.workspace import read_views
from scenefuse.report.render import orbit_camera, point_radii, render
from scenefuse.sfm.gravity import estimate_up

# Azimuths of the four sides that a row of pictures shows.
SIDES_DEG = (30.0, 120.0, 210.0, 300.0)


def object_sheet(name: str, cloud: Cloud, workspace: Path, masks: Path, stages: list[Path]) -> Image:
    """Frames, masks, depth of each stage on one scale, renders, the cloud from four sides (Figure 3)."""
    tile = (320, 240)
    photos = sorted(p for p in (workspace / "images").iterdir() if (masks / f"{p.stem}.png").is_file())
    if not photos:
        raise StageError(f"no photo in {workspace}/images has a mask in {masks}; rerun the masks stage")
    chosen = [photos[i] for i in np.linspace(0, len(photos) - 1, 4).round().astype(int)]
    frames = [read_rgb(p) for p in chosen]
    cut_out = [_dim_outside(f, read_mask(masks / f"{p.stem}.png")) for f, p in zip(frames, chosen)]
    depths, shown = _depth_row(photos, masks, stages)
    renders, labels = _render_row(workspace, stages[-1])
    captions = {(2, i): f"stage {i + 1}, {shown}" for i in range(4)} | {(3, i): t for i, t in enumerate(labels)}
    captions |= {(0, i): p.name for i, p in enumerate(chosen)}
    row_labels = ["frames", "masks", "depth", "renders", "cloud"]
    rows: list[list[Image | None]] = [[*frames], [*cut_out], depths, renders, _cloud_row(cloud, tile)]
    note = f"{len(photos)} frames with masks; cloud of {len(cloud):,} points; one depth scale, near bright, far dark"
    return draw_sheet(Sheet(f"{name}: the object by itself", note, rows, row_labels, [], captions, tile))


def cloud_sheet(name: str, cloud: Cloud, has_photos: bool) -> Image:
    """The same of an object whose cloud was given: the cloud from four sides."""
    tile = (320, 240)
    note = f"given as a cloud of {len(cloud):,} points: no stages, {'its own' if has_photos else 'no'} photos"
    return draw_sheet(Sheet(f"{name}: the object by itself", note, [_cloud_row(cloud, tile)], ["cloud"], [], {}, tile))


def sides(
    cloud: Cloud,
    framed: Array,
    radii: ArrayLike,
    tile: tuple[int, int],
    elevation_deg: float,
    colors: ArrayLike | None = None,
) -> list[Image | None]:
    """A cloud from four sides, all of `framed` in each picture."""
    return [render(cloud, orbit_camera(framed, a, elevation_deg, tile), radii, colors) for a in SIDES_DEG]


def _cloud_row(cloud: Cloud, tile: tuple[int, int]) -> list[Image | None]:
    return sides(cloud, inner(cloud.points), point_radii(cloud.points), tile, 18.0)


def _depth_row(photos: list[Path], masks: Path, stages: list[Path]) -> tuple[list[Image | None], str]:
    """The depth maps of the first photo that most stages have, colour-mapped on one scale over its mask."""
    files = {p.name: [s / "depth_maps" / f"{p.name}.bin" for s in stages] for p in photos}
    most = max(sum(f.is_file() for f in of_photo) for of_photo in files.values())
    shown = next(n for n, of_photo in files.items() if sum(f.is_file() for f in of_photo) == most)
    maps = [read_depth(f) if f.is_file() else None for f in files[shown]]
    mask = read_mask(masks / f"{Path(shown).stem}.png")
    inside = [None if d is None else np.where(_fit(mask, d.shape), d, 0.0) for d in maps]
    known = [d[d > 0] for d in inside if d is not None and (d > 0).any()]
    if not known:
        return [None] * len(stages), shown
    low, high = np.percentile(known[-1], [1, 99])
    return [None if d is None else depth_colors(d, float(low), float(high)) for d in inside], shown


def _render_row(workspace: Path, stage: Path) -> tuple[list[Image | None], list[str]]:
    """Two of the photos that stage 4 was measured on and their renders, and the captions."""
    row: list[Image | None] = []
    labels = []
    by_stem = {name: path for path in (workspace / "images").iterdir() for name in (path.stem, path.name)}
    files = sorted(p for p in (stage / "renders").glob("*.png") if p.stem in by_stem)
    for path in files[:: max(1, len(files) // 2)][:2]:
        photo = by_stem[path.stem]
        row += [read_rgb(photo), read_rgb(path)]
        labels += [f"photo {photo.name}", "its render, stage 4"]
    return row + [None] * (4 - len(row)), labels


def upright(cloud: Cloud, workspace: Path) -> Cloud:
    """The object's cloud turned so that z points up, from the photos' horizontal axes."""
    poses = [view.world_from_cam for view in read_views(workspace / "sparse")]
    up, _ = estimate_up(np.array([pose[:3, :3] for pose in poses]), np.array([pose[:3, 3] for pose in poses]))
    return cloud.transformed(Sim3(1.0, rotation_between(up, np.array([0.0, 0.0, 1.0])), np.zeros(3)))


def inner(points: Array, limit: int = 20000) -> Array:
    """At most that many of the points, without the outermost half per cent of each axis: what a picture has to show."""
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return points[((points >= low) & (points <= high)).all(1)][:: max(1, len(points) // limit)]


def _fit(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """The mask at another size."""
    size = (shape[1], shape[0])
    return np.asarray(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0)


def _dim_outside(picture: Image, mask: NDArray[np.bool_]) -> Image:
    """The picture with everything outside the mask faded to a pale grey."""
    pale = 235 - (235 - picture.astype(np.float32)) * 0.12
    return np.where(_fit(mask, picture.shape)[..., None], picture, pale).astype(np.uint8)
