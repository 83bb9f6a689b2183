"""Masks that a person supplies for the original photos, moved into the undistorted ones."""

from pathlib import Path

import numpy as np
import pycolmap

from scenefuse.core.stage import StageError
from scenefuse.geometry.visual_hull import Mask
from scenefuse.photos.photo_files import masks_by_name, pictures_below
from scenefuse.photos.photos import SHAPE_TOLERANCE
from scenefuse.photos.pictures import matte_of, read_raw
from scenefuse.photos.workspace import View, read_cameras
from scenefuse.sfm.undistort import undistort_picture


def supplied_masks(folder: Path, sparse: Path, views: list[View]) -> tuple[dict[str, Mask], dict[str, str]]:
    """Masks from a folder by the name of the photo they belong to, undistorted like it; and why others are unusable.

    Args:
        folder: pictures named like the photos, with or without `_mask`; non-zero on the object. A mask may be larger
            or smaller than its photo.
        sparse: COLMAP model of the original photos, before undistortion.
        views: the undistorted photos.

    Raises:
        StageError: no such folder, masks that belong to none of the photos, or none that is usable.
    """
    if not folder.is_dir():
        raise StageError(
            f"the folder of masks {folder} does not exist; set its path in config/objects.tsv, or in object.masks.keep"
        )
    files, originals = masks_by_name([view.name for view in views], folder), read_cameras(sparse)
    masks: dict[str, Mask] = {}
    unusable: dict[str, str] = {}
    for view in views:
        file = files.get(view.name)
        if file is None or view.name not in originals:
            continue
        try:
            mask = _read(file, originals[view.name]).astype(np.float32)
            masks[view.name] = undistort_picture(mask, originals[view.name], view) > 0.5
        except StageError as error:
            unusable[view.name] = str(error)
    if not masks and unusable:
        raise StageError(f"none of {len(unusable)} masks in {folder} can be used; {next(iter(unusable.values()))}")
    if not masks:
        pictures = pictures_below(folder)
        example = next(iter(pictures), "none")
        raise StageError(
            f"masks that match no photo: {len(pictures)} masks in {folder} (first: {example}), photos are named like "
            f"{views[0].name}; name a mask like its photo, with or without _mask"
        )
    print(f"{len(masks)} of {len(views)} photos have a mask in {folder}", flush=True)
    return masks, unusable


def _read(file: Path, camera: pycolmap.Camera) -> Mask:
    """The mask (H, W) of a photo that a camera took; StageError when it cannot be read or is of another picture."""
    try:
        mask = matte_of(read_raw(file))
    except StageError:
        raise StageError(f"the supplied mask {file} cannot be read; export it again as PNG") from None
    height, width = mask.shape
    if abs(width * camera.height / (height * camera.width) - 1) > SHAPE_TOLERANCE:
        raise StageError(
            f"the supplied mask {file} is {width} x {height} pixels, its photo {camera.width} x {camera.height}; export"
            " it at the photo's size"
        )
    return mask
