"""What a person marked: clicks on points, triangulated through the cameras, points in the scene frame, or labels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.tables import comma_advice, composed, read_cells

if TYPE_CHECKING:
    import pycolmap

Array = NDArray[np.float64]
CLICK_COLUMNS = ["point", "photo", "x_px", "y_px"]
POINT_COLUMNS = ["point", "x", "y", "z"]
LABEL_COLUMNS = ["label", "photo", "x_px", "y_px"]
LABELS = ("inside", "outside", "box")


@dataclass(frozen=True)
class Clicks:
    """Pixels clicked in photos.

    Attributes:
        path: the file they come from, for messages.
        points: N point names; a point appears once for each photo it was clicked in.
        photos: N photo names.
        pixels: (N, 2) x and y in pixels of the original photo as people see it, pixel centres at +0.5.
    """

    path: Path
    points: list[str]
    photos: list[str]
    pixels: Array


@dataclass(frozen=True)
class ScenePoints:
    """Points given by their coordinates in the scene frame.

    Attributes:
        path: the file they come from, for messages.
        points: N point names.
        positions: (N, 3) coordinates.
    """

    path: Path
    points: list[str]
    positions: Array


@dataclass(frozen=True)
class Labels:
    """Pixels of photos labelled as on or off an object.

    Attributes:
        path: the file they come from, for messages.
        labels: N of inside, outside and box; a box has two lines, opposite corners.
        photos: N photo names.
        pixels: (N, 2) as in Clicks.
    """

    path: Path
    labels: list[str]
    photos: list[str]
    pixels: Array


def read_points(path: Path) -> Clicks | ScenePoints | Labels:
    """Read a tab-separated file of clicks (point, photo, x_px, y_px), scene points (point, x, y, z) or labelled
    pixels (label, photo, x_px, y_px).

    Scene points may be separated by semicolons, commas or spaces too; without a header, or with `x y z`, a
    line is x y z, perhaps behind a name, and points without one are called 1, 2, ... in their order.

    Raises:
        StageError: the file is missing or empty, its header is none of these, or a line is not well formed.
    """
    rows = read_cells(path)
    loose = [(number, _words(cells)) for number, cells in rows]
    if loose and (_is_point(loose[0][1]) or loose[0][1] == POINT_COLUMNS[1:]):
        return _bare_points(path, loose[loose[0][1] == POINT_COLUMNS[1:] :])
    if loose and loose[0][1] == POINT_COLUMNS:
        rows = loose if len(rows[0][1]) == 1 else rows
    header = rows[0][1] if rows else []
    if header not in (CLICK_COLUMNS, POINT_COLUMNS, LABEL_COLUMNS):
        spaced = loose and loose[0][1] in (CLICK_COLUMNS, LABEL_COLUMNS)
        raise StageError(
            f"{path}: separate its columns by tabs (one between two columns); names of photos may hold spaces"
            if spaced
            else f"{path} has to begin with the tab-separated header 'point photo x_px y_px' or 'point x y z' or "
            f"'label photo x_px y_px', not with '{' '.join(header)}'{comma_advice(loose[0][1] if loose else [])}"
        )
    if len(rows) == 1:
        wanted = "click on the object" if header == LABEL_COLUMNS else "mark at least four points on the object"
        raise StageError(f"{path} holds no points below its header; {wanted}")
    names, numbers = _split(path, header, rows[1:])
    if header == LABEL_COLUMNS:
        return _labels(path, names, numbers)
    keys = [tuple(entry) for entry in names]
    for key in keys:
        if keys.count(key) > 1:
            raise StageError(f"{path}: {' in '.join(key)} is given more than once; keep one line of it")
    if header == POINT_COLUMNS:
        return ScenePoints(path, [n[0] for n in names], np.array(numbers))
    return Clicks(path, [n[0] for n in names], [n[1] for n in names], np.array(numbers))


def _words(cells: list[str]) -> list[str]:
    """The cells of a line that tabs do not separate, by semicolons, commas or blanks."""
    if len(cells) > 1:
        return cells
    mark = next((mark for mark in ";," if mark in cells[0]), None)
    return [word.strip() for word in cells[0].split(mark)]


def _is_point(words: list[str]) -> bool:
    """Whether a line is x y z, perhaps behind a name."""
    try:
        return len(words) in (3, 4) and bool(np.isfinite([float(word) for word in words[-3:]]).all())
    except ValueError:
        return False


def _bare_points(path: Path, rows: list[tuple[int, list[str]]]) -> ScenePoints:
    """Points of lines below which header there was; those without a name are numbered."""
    if not rows:
        raise StageError(f"{path} holds no points below its header; mark at least four points on the object")
    for number, words in rows:
        if not _is_point(words):
            raise StageError(
                f"{path}, line {number}: expected x y z, perhaps behind a name, got '{' '.join(words)}'"
                f"{comma_advice(words)}"
            )
    names = [words[0] if len(words) == 4 else str(index) for index, (_, words) in enumerate(rows, 1)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise StageError(f"{path}: {twice} is given more than once; keep one line of it")
    return ScenePoints(path, names, np.array([[float(word) for word in words[-3:]] for _, words in rows]))


def _split(
    path: Path, header: list[str], rows: list[tuple[int, list[str]]]
) -> tuple[list[list[str]], list[list[float]]]:
    """The names and the numbers of each line below the header."""
    texts = 1 if header == POINT_COLUMNS else 2
    names: list[list[str]] = []
    numbers: list[list[float]] = []
    for number, cells in rows:
        try:
            if len(cells) != 4:
                raise ValueError
            values = [float(cell) for cell in cells[texts:]]
            if not np.isfinite(values).all():
                raise ValueError
        except ValueError:
            raise StageError(
                f"{path}, line {number}: expected {' '.join(header)} separated by tabs, got '{' '.join(cells)}'"
                f"{comma_advice(cells[texts:])}"
            ) from None
        names.append(cells[:texts])
        numbers.append(values)
        if header == LABEL_COLUMNS and cells[0] not in LABELS:
            raise StageError(f"{path}, line {number}: the label is {', '.join(LABELS)}, not '{cells[0]}'")
    return names, numbers


def _labels(path: Path, names: list[list[str]], numbers: list[list[float]]) -> Labels:
    """Labelled pixels, each given once."""
    places = [(photo, *pixel) for (_, photo), pixel in zip(names, numbers)]
    for (photo, x, y), (label, _) in zip(places, names):
        if places.count((photo, x, y)) > 1:
            raise StageError(
                f"{path}: ({x:g}, {y:g}) in {photo} is clicked more than once ({label}); keep one line of it"
            )
    return Labels(path, [n[0] for n in names], [n[1] for n in names], np.array(numbers))


def triangulate(
    clicks: Clicks,
    model: pycolmap.Reconstruction,
    max_residual_px: float,
    sizes: Mapping[str, tuple[int, int]] | None = None,
) -> tuple[list[str], Array, Array]:
    """Positions of clicked points in the frame of a COLMAP model, through its cameras and their distortion.

    Linear triangulation (Hartley and Zisserman, 12.2), then Gauss-Newton on the reprojection error.

    Args:
        clicks: two or more photos per point.
        model: of the photos that were clicked in (not of undistorted ones).
        max_residual_px: a point with a larger RMS reprojection error is an error, in pixels of the model's photos.
        sizes: photo name -> (width, height) of the photos clicked in, where the model was made from smaller copies; of
            all photos, also those that could not be registered.

    Returns:
        Point names in order of appearance, (P, 3) positions, (P,) RMS reprojection errors in pixels.

    Raises:
        StageError: as `triangulate_consistent`, and rays that are parallel or miss each other: all points at once.
    """
    names, positions, residuals, left_out = triangulate_consistent(clicks, model, max_residual_px, sizes)
    if len(names) < len(set(clicks.points)):
        raise StageError(f"{clicks.path}: {'; '.join(left_out)}; correct these clicks, or delete them")
    for sentence in left_out:
        print(f"left out of {clicks.path}: {sentence}", flush=True)
    return names, positions, residuals


def triangulate_consistent(
    clicks: Clicks,
    model: pycolmap.Reconstruction,
    max_residual_px: float,
    sizes: Mapping[str, tuple[int, int]] | None = None,
) -> tuple[list[str], Array, Array, list[str]]:
    """As `triangulate`, but what cannot be used is left out and named in the fourth result: points whose clicks
    contradict each other, clicks in photos without a camera, and points that have fewer than two others.

    Raises:
        StageError: a photo that is none of `sizes`, a click outside its photo, a point that is clicked once only. Each
            message names the point.
    """
    images = {composed(model.images[i].name): model.images[i] for i in model.reg_image_ids()}
    sizes = None if sizes is None else {composed(name): size for name, size in sizes.items()}
    positions, residuals, names = [], [], []
    sightings, left_out = _sightings(clicks, images, sizes)
    for point, observed in sightings.items():
        seen, pixels = [images[name] for name, _ in observed], np.array([p for _, p in observed])
        position, residual = intersect(seen, pixels)
        if position is None:
            where = ", ".join(name for name, _ in observed)
            left_out.append(
                f"the rays to point {point} from {where} are parallel, meet behind a camera, or lie beyond what the"
                " lens shows"
            )
        elif residual > max_residual_px:
            off = np.linalg.norm(np.array([image.project_point(position) for image in seen]) - pixels, axis=1)
            where = ", ".join(f"{name} {px:.1f} px" for (name, _), px in zip(observed, off))
            left_out.append(
                f"the clicks on point {point} miss each other by {residual:.1f} px"
                f" (limit {max_residual_px:.3g} px): {where}"
            )
        else:
            names.append(point)
            positions.append(position)
            residuals.append(residual)
    return names, np.array(positions).reshape(-1, 3), np.array(residuals), left_out


def marked_size(
    clicks: Clicks, model: pycolmap.Reconstruction, sizes: Mapping[str, tuple[int, int]] | None = None
) -> float:
    """How large what is clicked is in the photos: median diagonal of the box of a photo's clicks, in pixels of the
    model's photos; 0 where no photo with a camera has two. Arguments as of `triangulate`."""
    images = {composed(model.images[i].name): model.images[i] for i in model.reg_image_ids()}
    sizes = {} if sizes is None else {composed(name): size for name, size in sizes.items()}
    photos, spans = np.array([composed(photo) for photo in clicks.photos]), []
    for name in sorted(set(photos) & set(images)):
        camera = images[name].camera
        assert camera is not None
        scale = camera.width / sizes.get(name, (camera.width, camera.height))[0]
        if (photos == name).sum() > 1:
            spans.append(scale * float(np.linalg.norm(np.ptp(clicks.pixels[photos == name], axis=0))))
    return float(np.median(spans)) if spans else 0.0


def _sightings(
    clicks: Clicks, images: Mapping[str, pycolmap.Image], sizes: Mapping[str, tuple[int, int]] | None
) -> tuple[dict[str, list[tuple[str, Array]]], list[str]]:
    """The registered photos and their pixels where each point was clicked, two or more; and what is left out since a
    photo has no camera."""
    seen: dict[str, list[tuple[str, Array]]] = {}
    lost: dict[str, list[str]] = {}
    for point, photo, pixel in zip(clicks.points, map(composed, clicks.photos), clicks.pixels):
        seen.setdefault(point, [])
        if photo in images:
            seen[point].append((photo, model_pixel(clicks.path, point, photo, pixel, images[photo], sizes)))
        elif sizes is None or photo in sizes:
            lost.setdefault(point, []).append(photo)
        else:
            raise StageError(
                f"{clicks.path}: point {point} is clicked in {photo}, which is not among the {len(images)} "
                f"registered photos; click in one of them ({', '.join(sorted(images)[:3])}, ...)"
            )
    left_out, unsure = [], "" if sizes else ", or is none of the photos"
    for point, observed in seen.items():
        count = f"the number of registered photos in which point {point} is clicked is {len(observed)}"
        unregistered = f"{', '.join(lost.get(point, []))} could not be registered{unsure}"
        if len(observed) < 2 and point not in lost:
            raise StageError(f"{clicks.path}: {count}; two or more are needed, click it in another one")
        if len(observed) < 2:
            left_out.append(f"{count} ({unregistered}), two or more are needed")
        elif point in lost:
            left_out.append(f"{unregistered}: its click on point {point}")
    return {point: observed for point, observed in seen.items() if len(observed) > 1}, left_out


def locate(
    path: Path, model: Path, max_residual_px: float, sizes: Mapping[str, tuple[int, int]] | None = None
) -> tuple[list[str], Array, Array]:
    """Marked points of either kind in the frame of a COLMAP model (scene points are taken to be in it already).

    Returns:
        Names, (P, 3) positions, (P,) residuals in pixels, which are 0 for points given by coordinates.
    """
    # Not above: the workflow reads clicks whenever it plans, and this takes long to import.
    from scenefuse.photos.workspace import read_model

    marked = read_points(path)
    if isinstance(marked, ScenePoints):
        return marked.points, marked.positions, np.zeros(len(marked.points))
    if isinstance(marked, Labels):
        raise StageError(f"{path} holds labels; mark points here ('point photo x_px y_px')")
    return triangulate(marked, read_model(model), max_residual_px, sizes)


def model_pixel(
    path: Path,
    point: str,
    photo: str,
    pixel: Array,
    image: pycolmap.Image,
    sizes: Mapping[str, tuple[int, int]] | None,
) -> Array:
    """A click (2,) in pixels of the model's photo; StageError when it lies outside."""
    assert image.camera is not None
    own = (image.camera.width, image.camera.height)
    clicked = own if sizes is None else sizes.get(photo, own)
    if not (0 <= pixel[0] <= clicked[0] and 0 <= pixel[1] <= clicked[1]):
        raise StageError(
            f"{path}: the click on point {point} at ({pixel[0]:g}, {pixel[1]:g}) lies outside {photo}, which has "
            f"{clicked[0]} x {clicked[1]} pixels; correct the click"
        )
    return pixel * np.array(own) / np.array(clicked)


def intersect(images: list[pycolmap.Image], pixels: Array) -> tuple[Array | None, float]:
    """Point that images see at (N, 2) pixels and its RMS reprojection error; None where the rays do not meet, or one
    lies beyond what the lens shows."""
    from scenefuse.photos.workspace import ray_through

    poses = np.array([image.cam_from_world().matrix() for image in images])
    cameras = [image.camera for image in images if image.camera is not None]
    normalised = np.array([ray_through(camera, pixel) for camera, pixel in zip(cameras, pixels)])
    if not np.isfinite(normalised).all():
        return None, np.inf
    rows = normalised[:, :, None] * poses[:, 2:3, :] - poses[:, :2, :]
    system = rows.reshape(-1, 4)
    homogeneous = np.linalg.svd(system)[2][3]
    if abs(homogeneous[3]) < 1e-9 * np.linalg.norm(homogeneous[:3]):
        return None, np.inf
    position = homogeneous[:3] / homogeneous[3]
    for _ in range(10):
        in_cam = poses[:, :, :3] @ position + poses[:, :, 3]
        if (in_cam[:, 2] <= 0).any():
            return None, np.inf
        error = in_cam[:, :2] / in_cam[:, 2:] - normalised
        # d(x/z, y/z) = (row_xy - (xy / z) row_z) / z
        slope = (poses[:, :2, :3] - (in_cam[:, :2] / in_cam[:, 2:])[:, :, None] * poses[:, 2:3, :3]) / in_cam[
            :, 2:, None
        ]
        step, _, rank, _ = np.linalg.lstsq(slope.reshape(-1, 3), -error.reshape(-1), rcond=1e-6)
        if rank < 3:
            return None, np.inf
        position = position + step
    reprojected = [image.project_point(position) for image in images]
    if any(p is None for p in reprojected):
        return None, np.inf
    return position, float(np.sqrt(((np.array(reprojected) - pixels) ** 2).sum(1).mean()))
