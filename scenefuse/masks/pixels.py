"""Pixels in and around masks."""

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask


def held(mask: Mask, pixels: Array, tolerance_px: float) -> NDArray[np.bool_]:
    """(N,) whether (N, 2) pixels lie in a mask, or no farther off it than the tolerance."""
    u, v = pixel_of(pixels, mask)
    if tolerance_px == 0 or not len(pixels):
        return mask[v, u]
    # A few windows: distances of all of a photo's pixels take far longer.
    reach = int(tolerance_px)
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc, padded = np.hypot(dx, dy) <= tolerance_px, np.pad(mask, reach)
    side = 2 * reach + 1
    return np.array([(padded[y : y + side, x : x + side] & disc).any() for x, y in zip(u, v)])


def share_in(mask: Mask, pixels: Array, of_none: float) -> float:
    """Share of (N, 2) pixels that a mask holds."""
    u, v = pixel_of(pixels, mask)
    return float(mask[v, u].mean()) if len(pixels) else of_none


def pixel_of(pixels: Array, mask: Mask) -> NDArray[np.intp]:
    """(2, N) column and row of (N, 2) pixels, inside the mask."""
    return np.clip(pixels.astype(np.intp), 0, np.array(mask.shape[::-1]) - 1).T


def distance_to(mask: Mask) -> NDArray[np.float32]:
    """(H, W) distance of the pixels off a mask to it, 0 on it; far away where it is empty."""
    if not mask.any():
        return np.full(mask.shape, max(mask.shape), dtype=np.float32)
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away, dtype=np.float32)
