"""The posed, masked photos of one object as arrays: what all four training stages work on."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.stage import StageError


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
    intrinsics: NDArray[np.float64]
    object_from_cam: NDArray[np.float64]
    held_out: NDArray[np.bool_]
    sparse: NDArray[np.float64]
    tracks: list[NDArray[np.int64]]

    @cached_property
    def masks(self) -> NDArray[np.bool_]:
        """(V, H, W), True where a pixel is mostly object."""
        return self.mattes > 127


def load_views(cameras: Path, masks: Path, width_px: int, hold_out_every: int) -> Views:
    """Read an undistorted COLMAP workspace and its masks, scaled to `width_px` columns.

    Args:
        cameras: workspace with images/ and sparse/, PINHOLE cameras.
        masks: folder of {name}.png, above 127 on the object.
        width_px: target width; photos are never enlarged.
        hold_out_every: every n-th photo (in name order) is held out, 0 holds out none; a file held_out.txt in
            `cameras`, one name a line, says it instead.

    Raises:
        StageError: no photo has a mask, or sizes differ between photos.
    """
    model = pycolmap.Reconstruction(cameras / "sparse")
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    images = [i for i in images if (masks / f"{Path(i.name).stem}.png").is_file()]
    if not images:
        raise StageError(
            f"no photo in {cameras} has a mask in {masks}; mask files are named like their photo, with .png"
        )
    point_ids = {point_id: index for index, point_id in enumerate(sorted(model.points3D))}
    sparse = np.array([model.points3D[p].xyz for p in point_ids], dtype=np.float64).reshape(-1, 3)
    pictures, mattes, intrinsics, poses, tracks = [], [], [], [], []
    for image in images:
        camera = model.cameras[image.camera_id]
        scale = min(1.0, width_px / camera.width)
        size = (round(camera.width * scale), round(camera.height * scale))
        # COLMAP's cameras belong to the pixels as they are stored, whatever the EXIF orientation says.
        stored = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
        picture = cv2.imread(str(cameras / "images" / image.name), stored)
        matte = cv2.imread(str(masks / f"{Path(image.name).stem}.png"), cv2.IMREAD_GRAYSCALE)
        if picture is None or matte is None or matte.shape != picture.shape[:2]:
            raise StageError(f"{image.name}: photo and mask cannot be read or differ in size; rerun the masks stage")
        pictures.append(cv2.cvtColor(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), cv2.COLOR_BGR2RGB))
        mattes.append(cv2.resize(matte, size, interpolation=cv2.INTER_AREA))
        shrink = np.diag([size[0] / camera.width, size[1] / camera.height, 1.0])
        intrinsics.append(shrink @ camera.calibration_matrix())
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        poses.append(pose)
        tracks.append(
            np.array(sorted({point_ids[p.point3D_id] for p in image.get_observation_points2D()}), dtype=np.int64)
        )
    if len({p.shape for p in pictures}) > 1:
        raise StageError(f"the photos in {cameras}/images have different sizes; use photos of one camera at one size")
    held_out = np.zeros(len(images), dtype=bool)
    listed = cameras / "held_out.txt"
    if listed.is_file():
        held_out = np.isin([i.name for i in images], listed.read_text().splitlines())
    elif hold_out_every > 0:
        held_out[hold_out_every // 2 :: hold_out_every] = True
    return Views(
        [i.name for i in images],
        np.stack(pictures),
        np.stack(mattes),
        np.stack(intrinsics),
        np.stack(poses),
        held_out,
        sparse,
        tracks,
    )
