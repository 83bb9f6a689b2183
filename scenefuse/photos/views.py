"""The posed, masked photos of one object as arrays: what all four training stages work on."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.photos.workspace import View, read_workspace, with_mask

Pixel = TypeVar("Pixel", bound=np.generic)


@dataclass(frozen=True)
class Views:
    """V photos of one object, undistorted, on pictures of one size, with their cameras in the object's SfM frame.

    Attributes:
        names: V file names.
        images: (V, H, W, 3) uint8 RGB.
        mattes: (V, H, W) uint8, the share of each pixel that is object, in 255ths.
        beyond: (V, H, W) bool, True where the picture goes on beyond its photo: nothing is known there.
        intrinsics: (V, 3, 3) float64, pixels at this size, pixel centres at +0.5.
        object_from_cam: (V, 4, 4) float64 rigid camera poses.
        held_out: (V,) bool, True for photos that no training stage sees; they measure quality.
        sparse: (P, 3) float64 SfM points.
        tracks: V arrays of indices into `sparse`: the points each photo observes.
    """

    names: list[str]
    images: NDArray[np.uint8]
    mattes: NDArray[np.uint8]
    beyond: NDArray[np.bool_]
    intrinsics: Array
    object_from_cam: Array
    held_out: NDArray[np.bool_]
    sparse: Array
    tracks: list[NDArray[np.int64]]

    @cached_property
    def masks(self) -> NDArray[np.bool_]:
        """(V, H, W), True where a pixel is mostly object."""
        return self.mattes > 127

    @cached_property
    def sizes(self) -> NDArray[np.int64]:
        """(V, 2) rows and columns of each photo, which begins at the upper left of its picture."""
        known = ~self.beyond
        return np.stack([known.any(2).sum(1), known.any(1).sum(1)], axis=1)

    def view(self, index: int) -> View:
        """One photo with its camera, (h, w, 3) uint8 RGB pixels; the world is the object's SfM frame."""
        height, width = (int(side) for side in self.sizes[index])
        pose = np.linalg.inv(self.object_from_cam[index])
        pixels = self.images[index, :height, :width]
        return View(self.names[index], self.intrinsics[index], pose, width, height, pixels)

    def select(self, rows: NDArray[np.int64]) -> "Views":
        """The photos of these rows; all sparse points."""
        of_photos = ("images", "mattes", "beyond", "intrinsics", "object_from_cam", "held_out")
        chosen: dict[str, Any] = {name: getattr(self, name)[rows] for name in of_photos}
        names, tracks = ([listed[i] for i in rows] for listed in (self.names, self.tracks))
        return replace(self, **chosen, names=names, tracks=tracks)


def load_views(workspace: Path, masks: Path, width_px: int, hold_out_every: int) -> Views:
    """Read an undistorted COLMAP workspace and its masks, scaled to `width_px` columns.

    Photos of several sizes, upright ones among others for instance, get about as many pixels each, the widest of them
    `width_px` columns, and lie at the upper left of pictures that hold them all. A photo whose mask holds no pixel of
    that size is left out.

    Args:
        workspace: folder with images/ and sparse/, PINHOLE cameras.
        masks: folder of {name}.png, above 127 on the object.
        width_px: target width; photos are not enlarged, but for some that are smaller than most.
        hold_out_every: every n-th photo (in name order) is held out, 0 holds out none; a file held_out.txt in the
            workspace, one name a line, lists them instead.

    Raises:
        StageError: no photo has a mask, or a photo or mask cannot be read.
    """
    read = read_workspace(workspace)
    files = [masks / f"{Path(view.name).stem}.png" for view in read.views]
    read = read.subset([k for k, file in enumerate(files) if file.is_file()])
    files = [file for file in files if file.is_file()]
    factors = scales(read.views, width_px) if files else []
    mattes = [_scaled(with_mask(view, file), scale) for file, view, scale in zip(files, read.views, factors)]
    shown = [k for k, matte in enumerate(mattes) if (matte.pixels > 127).any()]
    if not shown:
        raise StageError(
            f"no photo in {workspace} has a mask in {masks} that is not black; mask files are named like their photo,"
            " with .png"
        )
    read, mattes = read.subset(shown), [mattes[k] for k in shown]
    photos = [_scaled(read.rgb(view), factors[k]) for view, k in zip(read.views, shown)]
    shape = max(view.height for view in photos), max(view.width for view in photos)
    return Views(
        [view.name for view in photos],
        np.stack([on_picture(view.pixels, shape, "edge") for view in photos]),
        np.stack([on_picture(matte.pixels, shape) for matte in mattes]),
        np.stack([~on_picture(np.ones((view.height, view.width), bool), shape) for view in photos]),
        np.stack([view.intrinsics for view in photos]),
        np.stack([view.world_from_cam for view in photos]),
        _held_out(workspace, [view.name for view in photos], hold_out_every),
        read.points,
        [np.unique(rows) for rows in read.seen],
    )


def on_picture(
    pixels: NDArray[Pixel], shape: tuple[int, int], mode: Literal["constant", "edge"] = "constant"
) -> NDArray[Pixel]:
    """Pixels (h, w, ...) at the upper left of a picture of a shape (H, W), the rest zero or, by `edge`, repeated."""
    spare = [(0, shape[axis] - pixels.shape[axis]) for axis in (0, 1)]
    return np.pad(pixels, spare + [(0, 0)] * (pixels.ndim - 2), mode)


def scales(views: list[View], width_px: int) -> list[float]:
    """By how much each photo is scaled: the widest to `width_px`, so that all get about as many pixels; none becomes
    longer than most, a narrow strip for instance."""
    sides = np.array([(view.width, view.height) for view in views])
    size = np.sqrt(sides.prod(1))
    middle = int(np.argsort(size, kind="stable")[len(size) // 2])
    alike = np.minimum(size[middle] / size, sides[middle].max() / sides.max(1))
    widest = max(round(view.width * factor) for view, factor in zip(views, alike))
    return [float(min(1.0, width_px / widest) * factor) for factor in alike]


def _scaled(view: View, scale: float) -> View:
    """The view, larger or smaller."""
    return view.resized(round(view.width * scale), round(view.height * scale))


def _held_out(workspace: Path, names: list[str], hold_out_every: int) -> NDArray[np.bool_]:
    """(V,) True for photos that are held out: those listed in held_out.txt, else every n-th."""
    held_out = np.zeros(len(names), dtype=bool)
    listed = workspace / "held_out.txt"
    if listed.is_file():
        held_out = np.isin(names, listed.read_text().splitlines())
    elif hold_out_every > 0:
        held_out[hold_out_every // 2 :: hold_out_every] = True
    return held_out
