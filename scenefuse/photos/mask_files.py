"""Masks that a person supplies: pictures named like the photos."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


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


def matte_of(picture: NDArray[Any]) -> NDArray[np.bool_]:
    """A mask picture as (H, W) bool: alpha where it varies, else brightness, above half of the largest value."""
    if picture.ndim == 3 and picture.shape[2] == 4 and picture[..., 3].min() < picture[..., 3].max():
        channel = picture[..., 3]
    else:
        channel = picture[..., :3].max(2) if picture.ndim == 3 else picture
    return channel > max(1, channel.max()) / 2
