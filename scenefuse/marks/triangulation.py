"""Clicked points in the frame of a COLMAP model, through its cameras and their distortion; and known lengths between
them, scale bars, which bring a model into metres where there is neither GPS nor control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.marks.clicks import Click, Clicks, check_inside, in_photos, read_length_clicks
from scenefuse.photos.workspace import images_by_name, ray_through

if TYPE_CHECKING:
    import pycolmap

Sizes = Mapping[str, tuple[int, int]]
# Clicks that miss each other by more are not on one point; as a share of the photo's longer side.
MAX_CLICK_MISS = 0.005
# Lengths that differ by more from one scale say that one of them is wrong; as a share of the length.
MAX_LENGTH_ERROR = 0.05


def triangulate(
    clicks: Clicks, model: pycolmap.Reconstruction, max_residual_px: float, sizes: Sizes | None = None
) -> tuple[list[str], Array, Array]:
    """Positions of clicked points: linear triangulation (Hartley and Zisserman, 12.2), then Gauss-Newton on the
    reprojection error.

    Args:
        clicks: two or more photos per point.
        model: of the photos that were clicked in (not of undistorted ones).
        max_residual_px: a point with a larger RMS reprojection error is an error, in pixels of the model's photos.
        sizes: photo name -> (width, height) of the photos clicked in, where the model was made from smaller copies; of
            all photos, also those that could not be registered.

    Returns:
        Labels of the points in order of appearance, (P, 3) positions, (P,) RMS reprojection errors in pixels.

    Raises:
        StageError: as `triangulate_consistent`, and rays that are parallel or miss each other: all points at once.
    """
    labels, positions, residuals, left_out = triangulate_consistent(clicks, model, max_residual_px, sizes)
    if len(labels) < len(set(clicks.labels)):
        raise StageError(f"{clicks.path}: {'; '.join(left_out)}; correct these clicks, or delete them")
    for sentence in left_out:
        print(f"left out of {clicks.path}: {sentence}", flush=True)
    return labels, positions, residuals


def triangulate_consistent(
    clicks: Clicks, model: pycolmap.Reconstruction, max_residual_px: float, sizes: Sizes | None = None
) -> tuple[list[str], Array, Array, list[str]]:
    """As `triangulate`, but what cannot be used is left out and named in the fourth result: points whose clicks
    contradict each other, clicks in photos without a camera, and points that have fewer than two others.

    Raises:
        StageError: a photo that is none of `sizes`, a click outside its photo, a point that is clicked once only. Each
            message names the point.
    """
    images = images_by_name(model)
    positions, residuals, labels = [], [], []
    registered, left_out = _registered(clicks, images, sizes)
    for label, own in registered.items():
        seen, photos = [images[click.photo] for click in own], [click.photo for click in own]
        pixels = np.array([model_pixel(clicks.path, click, image, sizes) for click, image in zip(own, seen)])
        position, residual = intersect(seen, pixels)
        if position is None:
            left_out.append(
                f"the rays to point {own[0].name} from {', '.join(photos)} are parallel, meet behind a camera, or lie"
                " beyond what the lens shows"
            )
        elif residual > max_residual_px:
            off = np.linalg.norm(np.array([image.project_point(position) for image in seen]) - pixels, axis=1)
            where = ", ".join(f"{photo} {px:.1f} px" for photo, px in zip(photos, off))
            left_out.append(
                f"the clicks on point {own[0].name} miss each other by {residual:.1f} px"
                f" (limit {max_residual_px:.3g} px): {where}"
            )
        else:
            labels.append(label)
            positions.append(position)
            residuals.append(residual)
    return labels, np.array(positions).reshape(-1, 3), np.array(residuals), left_out


def marked_size(clicks: Clicks, model: pycolmap.Reconstruction, sizes: Sizes | None = None) -> float:
    """How large what is clicked is in the photos: median diagonal of the box of a photo's clicks, in pixels of the
    model's photos; 0 where no photo with a camera has two. Arguments as of `triangulate`."""
    images = images_by_name(model)
    sizes, own = sizes or {}, in_photos(clicks.rows, images, clicks.path)
    photos, spans = np.array([click.photo for click in own]), []
    for name in sorted(set(photos) & set(images)):
        camera = images[name].camera
        assert camera is not None
        scale = camera.width / sizes.get(name, (camera.width, camera.height))[0]
        if (photos == name).sum() > 1:
            spans.append(scale * float(np.linalg.norm(np.ptp(clicks.pixels[photos == name], axis=0))))
    return float(np.median(spans)) if spans else 0.0


def _registered(
    clicks: Clicks, images: Mapping[str, pycolmap.Image], sizes: Sizes | None
) -> tuple[dict[str, list[Click]], list[str]]:
    """The clicks in registered photos by label, two or more of each; and what is left out since a photo has no
    camera."""
    found: dict[str, list[Click]] = {}
    lost: dict[str, list[Click]] = {}
    clicks.check_twice()
    for click in in_photos(clicks.rows, [*images, *(sizes or ())], clicks.path):
        own = found.setdefault(click.label, [])
        if click.photo in images:
            own.append(click)
        elif sizes is None or click.photo in sizes:
            lost.setdefault(click.label, []).append(click)
        else:
            raise StageError(
                f"{clicks.path}: point {click.name} is clicked in {click.photo}, which is not among the {len(images)}"
                f" registered photos; click in one of them ({', '.join(sorted(images)[:3])}, ...)"
            )
    left_out, unsure = [], "" if sizes else ", or is none of the photos"
    for label, there in lost.items():
        unregistered = f"{', '.join(click.photo for click in there)} could not be registered{unsure}"
        count = f"the number of registered photos in which point {there[0].name} is clicked is {len(found[label])}"
        few = f"{count} ({unregistered}), two or more are needed"
        left_out.append(few if len(found[label]) < 2 else f"{unregistered}: its click on point {there[0].name}")
    return {label: own for label, own in found.items() if len(own) > 1}, left_out


def model_pixel(path: Path, click: Click, image: pycolmap.Image, sizes: Sizes | None) -> Array:
    """A click (2,) in pixels of the model's photo; StageError when it lies outside."""
    assert image.camera is not None
    own = (image.camera.width, image.camera.height)
    clicked = own if sizes is None else sizes.get(click.photo, own)
    check_inside(path, click, clicked)
    return click.pixel * np.array(own) / np.array(clicked)


def intersect(images: list[pycolmap.Image], pixels: Array) -> tuple[Array | None, float]:
    """Point that images see at (N, 2) pixels and its RMS reprojection error; None where the rays do not meet, or one
    lies beyond what the lens shows."""
    poses = np.array([image.cam_from_world().matrix() for image in images])
    cameras = [image.camera for image in images if image.camera is not None]
    focal_px = np.array([camera.mean_focal_length() for camera in cameras])[:, None]
    normalised = np.array([ray_through(camera, pixel) for camera, pixel in zip(cameras, pixels)])
    if not np.isfinite(normalised).all():
        return None, np.inf
    rows = focal_px[:, None] * (normalised[:, :, None] * poses[:, 2:3, :] - poses[:, :2, :])
    homogeneous = np.linalg.svd(rows.reshape(-1, 4))[2][3]
    if abs(homogeneous[3]) < 1e-9 * np.linalg.norm(homogeneous[:3]):
        return None, np.inf
    position = homogeneous[:3] / homogeneous[3]
    for _ in range(10):
        in_cam = poses[:, :, :3] @ position + poses[:, :, 3]
        if (in_cam[:, 2] <= 0).any():
            return None, np.inf
        seen, per_unit = in_cam[:, :2] / in_cam[:, 2:], focal_px / in_cam[:, 2:]
        error = focal_px * (seen - normalised)
        # d(x/z, y/z) = (row_xy - (xy / z) row_z) / z
        slope = per_unit[:, :, None] * (poses[:, :2, :3] - seen[:, :, None] * poses[:, 2:3, :3])
        step, _, rank, _ = np.linalg.lstsq(slope.reshape(-1, 3), -error.reshape(-1), rcond=1e-6)
        if rank < 3:
            return None, np.inf
        position = position + step
    reprojected = [image.project_point(position) for image in images]
    if any(p is None for p in reprojected):
        return None, np.inf
    return position, float(np.sqrt(((np.array(reprojected) - pixels) ** 2).sum(1).mean()))


def _covariance(images: list[pycolmap.Image], position: Array) -> Array:
    """(3, 3) of a point (3,) that is clicked in images, each click one pixel off along each axis."""
    step = 1e-4 * float(np.linalg.norm(images[0].projection_center() - position))
    around = position + step * np.concatenate([np.eye(3), -np.eye(3)])
    pixels = np.array([[image.project_point(place) for place in around] for image in images])
    slope = ((pixels[:, :3] - pixels[:, 3:]) / (2 * step)).transpose(0, 2, 1).reshape(-1, 3)
    return np.linalg.inv(slope.T @ slope)


@dataclass(frozen=True)
class Lengths:
    """Known lengths in a model.

    Attributes:
        names: of L lengths.
        metres: (L,) how long they are.
        in_model: (L,) how long they are in the model.
        sd: (L,) standard deviations of these, by the clicks on their ends.
    """

    names: list[str]
    metres: Array
    in_model: Array
    sd: Array

    @property
    def scale(self) -> float:
        """Metres in a unit of the model, by least squares."""
        return float(self.metres @ self.in_model / (self.in_model @ self.in_model))

    @property
    def scale_sd_log(self) -> float:
        """Standard deviation of the scale's logarithm, by the clicks."""
        return float(np.linalg.norm(self.in_model * self.sd) / (self.in_model @ self.in_model))

    @property
    def off_m(self) -> Array:
        """(L,) metres that they are too long in the model once it is scaled."""
        return self.scale * self.in_model - self.metres


def read_lengths(path: Path, model: pycolmap.Reconstruction, sizes: Mapping[str, tuple[int, int]]) -> Lengths:
    """Read lengths.tsv and measure its lengths in a model.

    Args:
        path: of the file, a line a click: name of the length, metres, end (any two words), photo, pixel.
        model: cameras of the photos.
        sizes: photo name -> (width, height) of the photos clicked in.

    Raises:
        StageError: what `read_ends` and `triangulate` say; lengths that contradict each other.
    """
    clicks = read_ends(path)
    limit_px = MAX_CLICK_MISS * max(max(camera.width, camera.height) for camera in model.cameras.values())
    metres: dict[str, float] = {}
    ends: dict[str, list[Array]] = {}
    spread: dict[str, Array] = {}
    labels, places, residuals = triangulate(clicks, model, limit_px, sizes)
    images = images_by_name(model)
    seen = [[images[click.photo] for click in own] for own in _registered(clicks, images, sizes)[0].values()]
    counts = np.array([len(own) for own in seen])
    # As far as the clicks on an end miss each other, and at least a pixel.
    click_px = max(1.0, float(np.sqrt((counts * residuals**2).sum() / (2 * counts - 3).sum())))
    for label, place, own in zip(labels, places, seen):
        name, long, _ = label.split("\t")
        metres[name] = float(long)
        ends.setdefault(name, []).append(place)
        spread[name] = spread.get(name, 0.0) + click_px**2 * _covariance(own, place)
    apart = np.array([np.subtract(*two) for two in ends.values()])
    in_model = np.linalg.norm(apart, axis=1)
    if not (in_model > 0).all():
        raise StageError(
            f"{path}: both ends of {list(metres)[int(in_model.argmin())]} lie at one place; click them again"
        )
    sd = np.sqrt(np.einsum("ni,nij,nj->n", apart, np.array(list(spread.values())), apart)) / in_model
    found = Lengths(list(metres), np.array(list(metres.values())), in_model, sd)
    off = found.scale * in_model / found.metres - 1
    if np.abs(off).max() > MAX_LENGTH_ERROR:
        each = ", ".join(f"{name} {100 * o:+.1f} %" for name, o in zip(metres, off))
        advice = "correct the wrong one, or click its ends in photos from farther apart"
        raise StageError(f"{path}: the lengths contradict each other: off one scale by {each}; {advice}")
    return found


def read_ends(path: Path) -> Clicks:
    """Read lengths.tsv, where each length has two ends.

    Raises:
        StageError: what `read_length_clicks` says; an end that is missing, or a third one; one in a single photo.
    """
    clicks = read_length_clicks(path)
    ends: dict[str, list[str]] = {}
    for label in dict.fromkeys(clicks.labels):
        name, _, end = label.split("\t")
        ends.setdefault(name, []).append(end)
    odd = next((name for name, two in ends.items() if len(two) != 2), None)
    if odd is not None:
        raise StageError(f"{path}: {odd} has the ends {', '.join(ends[odd])}; click two, each in two photos or more")
    clicks.check_twice()
    return clicks
