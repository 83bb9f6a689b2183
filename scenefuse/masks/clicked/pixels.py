"""Pixels in and around masks."""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.mvs.visual_hull import Mask
from scenefuse.transforms import Array


def held(mask: Mask, pixels: Array, tolerance_px: float) -> NDArray[np.bool_]:
    """(N,) whether (N, 2) pixels lie in a mask, or no farther off it than the tolerance."""
    u, v = pixel_of(pixels, mask)
    return mask[v, u] if tolerance_px == 0 or not len(pixels) else distance_to(mask)[v, u] <= tolerance_px


def share_in(mask: Mask, pixels: Array, of_none: float) -> float:
    """Share of (N, 2) pixels that a mask holds."""
    u, v = pixel_of(pixels, mask)
    return float(mask[v, u].mean()) if len(pixels) else of_none


def pixel_of(pixels: Array, mask: Mask) -> NDArray[np.intp]:
    """(2, N) column and row of (N, 2) pixels, inside the mask."""
    return np.clip(pixels.astype(np.intp), 0, np.array(mask.shape[::-1]) - 1).T


def distance_to(mask: Mask) -> Array:
    """(H, W) distance of the pixels off a mask to it, 0 on it; far away where it is empty."""
    return ndimage.distance_transform_edt(~mask) if mask.any() else np.full(mask.shape, float(max(mask.shape)))
