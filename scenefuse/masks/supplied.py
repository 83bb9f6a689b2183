"""Masks that a person supplies: a folder of pictures named like the photos."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.mvs.visual_hull import Frame, Mask
from scenefuse.stage import StageError


def supplied_masks(folder: Path, sfm: Path, frames: list[Frame]) -> dict[str, Mask]:
    """Masks from a folder by the name of the photo they belong to, undistorted like it.

    Args:
        folder: pictures named like the photos, with or without `_mask`; non-zero on the object.
        sfm: COLMAP model of the original photos, before undistortion.
        frames: the undistorted photos.

    Raises:
        StageError: no such folder, an unreadable mask, or masks that belong to none of the photos.
    """
    if not folder.is_dir():
        raise StageError(
            f"the folder of masks {folder} does not exist; set its path in config/objects.tsv, or in object.masks.keep"
        )
    files = mask_files(folder)
    model = pycolmap.Reconstruction(sfm)
    originals = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    masks = {}
    for frame in frames:
        file = files.get(Path(frame.name).stem)
        if file is None or frame.name not in originals:
            continue
        matte = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if matte is None:
            raise StageError(f"the supplied mask {file} cannot be read; export it again as PNG")
        masks[frame.name] = _undistorted(matte_of(matte), originals[frame.name], frame)
    if not masks:
        example = next(iter(files), "none")
        raise StageError(
            f"masks that match no photo: {len(files)} masks in {folder} (first: {example}), photos are named like "
            f"{frames[0].name}; name a mask like its photo, with or without _mask"
        )
    print(f"{len(masks)} of {len(frames)} photos have a mask in {folder}", flush=True)
    return masks


def mask_files(folder: Path) -> dict[str, Path]:
    """The pictures of a folder by the stem of the photo they belong to: without the photo's ending and `_mask`.

    Those in folders below it have the folders' names in front, joined by `_`.
    """
    files = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() in (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"):
            stem = "_".join((*path.relative_to(folder).parts[:-1], path.stem))
            for ending in (".jpg", ".JPG", ".jpeg", ".JPEG", ".png", ".PNG"):
                stem = stem.removesuffix(ending)
            files[stem.removesuffix("_mask")] = path
    return files


def matte_of(picture: NDArray[Any]) -> Mask:
    """A mask picture as (H, W) bool: alpha where it varies, else brightness, above half of the largest value."""
    if picture.ndim == 3 and picture.shape[2] == 4 and picture[..., 3].min() < picture[..., 3].max():
        channel = picture[..., 3]
    else:
        channel = picture[..., :3].max(2) if picture.ndim == 3 else picture
    return channel > max(1, channel.max()) / 2


def _undistorted(mask: Mask, camera: pycolmap.Camera, frame: Frame) -> Mask:
    """A mask in the pixels of the original photo, moved into those of the undistorted one."""
    height, width = frame.image.shape[:2]
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.linalg.inv(frame.intrinsics).T
    pixels = np.asarray(camera.img_from_cam(rays)).reshape(height, width, 2)
    scale = np.array([mask.shape[1] / camera.width, mask.shape[0] / camera.height])
    x, y = np.moveaxis((pixels * scale - 0.5).astype(np.float32), -1, 0)
    soft = cv2.remap(mask.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return soft > 0.5
