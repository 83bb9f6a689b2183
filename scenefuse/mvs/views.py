"""The posed, masked photos of one object as arrays: what all four training stages work on."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.io.pictures import read_gray
from scenefuse.stage import StageError
from scenefuse.transforms import Array
from scenefuse.workspace import View, read_workspace


@dataclass(frozen=True)
class Views:
    """V photos of one object, undistorted, at one size, with their cameras in the object's SfM frame.

    Attributes:
        names: V file names.
        images: (V, H, W, 3) uint8 RGB.
        mattes: (V, H, W) uint8, the share of each pixel that is object, in 255ths.
        intrinsics: (V, 3, 3) float64, pixels at this size, pixel centres at +0.5.
        object_from_cam: (V, 4, 4) float64 rigid camera poses.
        held_out: (V,) bool, True for photos that no training stage sees; they measure quality.
        sparse: (P, 3) float64 SfM points.
        tracks: V arrays of indices into `sparse`: the points each photo observes.
    """

    names: list[str]
    images: NDArray[np.uint8]
    mattes: NDArray[np.uint8]
    intrinsics: Array
    object_from_cam: Array
    held_out: NDArray[np.bool_]
    sparse: Array
    tracks: list[NDArray[np.int64]]

    @cached_property
    def masks(self) -> NDArray[np.bool_]:
        """(V, H, W), True where a pixel is mostly object."""
        return self.mattes > 127

    def view(self, index: int) -> View:
        """One photo with its camera, (H, W, 3) uint8 RGB pixels; the world is the object's SfM frame."""
        height, width = self.mattes.shape[1:]
        pose = np.linalg.inv(self.object_from_cam[index])
        return View(self.names[index], self.intrinsics[index], pose, width, height, self.images[index])


def load_views(cameras: Path, masks: Path, width_px: int, hold_out_every: int) -> Views:
    """Read an undistorted COLMAP workspace and its masks, scaled to `width_px` columns.

    Args:
        cameras: workspace with images/ and sparse/, PINHOLE cameras.
        masks: folder of {name}.png, above 127 on the object.
        width_px: target width; photos are never enlarged.
        hold_out_every: every n-th photo (in name order) is held out, 0 holds out none; a file held_out.txt in
            `cameras`, one name a line, says it instead.

    Raises:
        StageError: no photo has a mask, a photo or mask cannot be read, or sizes differ between photos.
    """
    workspace = read_workspace(cameras)
    files = [masks / f"{Path(view.name).stem}.png" for view in workspace.views]
    workspace = workspace.subset([k for k, file in enumerate(files) if file.is_file()])
    files = [file for file in files if file.is_file()]
    if not files:
        raise StageError(
            f"no photo in {cameras} has a mask in {masks}; mask files are named like their photo, with .png"
        )
    photos = [_scaled(workspace.rgb(view), width_px) for view in workspace.views]
    mattes = [_scaled(_matte(file, view), width_px).pixels for file, view in zip(files, workspace.views)]
    if len({(view.width, view.height) for view in photos}) > 1:
        raise StageError(f"the photos in {cameras}/images have different sizes; use photos of one camera at one size")
    return Views(
        [view.name for view in photos],
        np.stack([view.pixels for view in photos]),
        np.stack(mattes),
        np.stack([view.intrinsics for view in photos]),
        np.stack([view.world_from_cam for view in photos]),
        _held_out(cameras, [view.name for view in photos], hold_out_every),
        workspace.points,
        [np.unique(rows) for rows in workspace.seen],
    )


def _scaled(view: View, width_px: int) -> View:
    """The view at most `width_px` wide."""
    scale = min(1.0, width_px / view.width)
    return view.resized(round(view.width * scale), round(view.height * scale))


def _matte(path: Path, view: View) -> View:
    """The view with its mask's grey values, (H, W) uint8, as pixels."""
    matte = read_gray(path)
    if matte.shape != (view.height, view.width):
        raise StageError(f"{path} and the photo {view.name} differ in size; rerun the masks stage")
    return replace(view, pixels=matte)


def _held_out(cameras: Path, names: list[str], hold_out_every: int) -> NDArray[np.bool_]:
    """(V,) True for photos that are held out: those listed in held_out.txt, else every n-th."""
    held_out = np.zeros(len(names), dtype=bool)
    listed = cameras / "held_out.txt"
    if listed.is_file():
        held_out = np.isin(names, listed.read_text().splitlines())
    elif hold_out_every > 0:
        held_out[hold_out_every // 2 :: hold_out_every] = True
    return held_out
