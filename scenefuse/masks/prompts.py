"""Pixels that prompt a photo's mask, and how a mask holds them."""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask
from scenefuse.photos.workspace import View

NO_PIXELS: Array = np.zeros((0, 2))
# How far a point's pixel may be off, as a share of the photo's longer side, about two pixels at 640: a disc of this
# radius is certain, and points this near an outline do not vote.
POINT_RADIUS_SHARE = 0.003
# How far from an outline a pixel may lie and say nothing against it, as a share of the photo's longer side.
OUTLINE_BAND_SHARE = 0.015
# Growth of a box around an object, as a share of its longer side: points seldom mark its ends, and a person's corners
# miss them.
BOX_GROWTH_SHARE = 0.05


class Prompts(NamedTuple):
    """Pixels of a photo, (N, 2) each.

    Attributes:
        clicked: clicked on the object in this photo.
        clicked_off: clicked off it.
        known: of points that other photos' masks hold to be the object's.
        known_off: of points that they hold not to be.
    """

    clicked: Array = NO_PIXELS
    clicked_off: Array = NO_PIXELS
    known: Array = NO_PIXELS
    known_off: Array = NO_PIXELS

    @property
    def inside(self) -> Array:
        """(N, 2) all pixels on the object."""
        return np.concatenate([self.clicked, self.known])

    @property
    def outside(self) -> Array:
        """(N, 2) all pixels off it."""
        return np.concatenate([self.clicked_off, self.known_off])


Measure = Callable[[Mask, Prompts, float], float]
"""How well a mask (H, W) agrees with prompts, clicks within a tolerance in pixels; at most 1."""
Segmenter = Callable[[View, Prompts, Array | None], tuple[list[Mask], Array]]
"""Masks (H, W) of a photo with RGB pixels and their qualities, 0..1, from prompts and perhaps a box (2, 2)."""


def agreement(mask: Mask, prompts: Prompts, tolerance_px: float) -> float:
    """Share of the pixels inside that a mask (H, W) holds, less the share of those outside that it holds; 1 where none
    is known. A click is held when it is no farther off than the tolerance."""
    inside, spared = _sides(mask, prompts, tolerance_px)
    return float((inside.mean() if len(inside) else 1.0) - ((~spared).mean() if len(spared) else 0.0))


def overlap(mask: Mask, prompts: Prompts, tolerance_px: float) -> float:
    """As `agreement`, but the IoU of the mask with the pixels inside: what is around a small object is few of a photo's
    pixels outside, and more than its own."""
    inside, spared = _sides(mask, prompts, tolerance_px)
    if not len(inside):
        return float(spared.mean()) if len(spared) else 1.0
    return float(inside.sum() / (len(inside) + (~spared).sum()))


def _sides(mask: Mask, prompts: Prompts, tolerance_px: float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """(N,) which pixels inside a mask holds, and (M,) which outside it does not."""
    inside = np.concatenate([held(mask, prompts.clicked, tolerance_px), held(mask, prompts.known, 0)])
    return inside, np.concatenate([held(~mask, prompts.clicked_off, tolerance_px), held(~mask, prompts.known_off, 0)])


def held(mask: Mask, pixels: Array, tolerance_px: float) -> NDArray[np.bool_]:
    """(N,) whether (N, 2) pixels lie in a mask (H, W), or no farther off it than the tolerance."""
    u, v = pixel_of(pixels, mask)
    if tolerance_px == 0 or not len(pixels):
        return mask[v, u]
    # A few windows: distances of all of a photo's pixels take far longer.
    reach = int(tolerance_px)
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disc, padded = np.hypot(dx, dy) <= tolerance_px, np.pad(mask, reach)
    side = 2 * reach + 1
    return np.array([(padded[y : y + side, x : x + side] & disc).any() for x, y in zip(u, v)])


def pixel_of(pixels: Array, mask: Mask) -> NDArray[np.intp]:
    """(2, N) column and row of (N, 2) pixels, moved into the mask (H, W)."""
    return np.clip(pixels.astype(np.intp), 0, np.array(mask.shape[::-1]) - 1).T


def distance_to(mask: Mask) -> NDArray[np.float32]:
    """(H, W) distance of the pixels off a mask to it, 0 on it; far away where it is empty."""
    if not mask.any():
        return np.full(mask.shape, max(mask.shape), dtype=np.float32)
    away = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(away, dtype=np.float32)


def prompted_parts(mask: Mask, inside: Array, outside: Array) -> Mask:
    """The connected parts of a mask (H, W) that hold more of (N, 2) pixels inside than of (M, 2) outside; all of it
    where no pixel inside is known."""
    if not len(inside):
        return mask
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    on, off = (np.bincount(labels[v, u], minlength=count) for u, v in (pixel_of(p, mask) for p in (inside, outside)))
    wanted = on > off
    wanted[0] = False
    return wanted[labels]


def far_apart(first: Array, others: Array, count: int) -> Array:
    """The first (N, D) points, and of the others those farthest from all before, up to `count` together."""
    chosen = list(first) if len(first) else list(others[:1])
    gaps = np.full(len(others), np.inf)
    for point in chosen:
        gaps = np.minimum(gaps, np.linalg.norm(others - point, axis=1))
    while len(chosen) < count and gaps.max(initial=0) > 0:
        chosen.append(others[gaps.argmax()])
        gaps = np.minimum(gaps, np.linalg.norm(others - chosen[-1], axis=1))
    return np.array(chosen).reshape(-1, others.shape[1])
