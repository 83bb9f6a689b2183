"""Depth maps of a scene that vote on each other: a depth stays where more photos confirm it than see through it.

Source: Merrell et al. 2007 (a depth map's free-space violations in others count against it).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from scenefuse.core.transforms import Array
from scenefuse.photos.workspace import View


@dataclass(frozen=True)
class Votes:
    """What other depth maps say of one, per pixel (H, W).

    Attributes:
        agree: number of maps that hold the same depth there.
        through: number of maps that measured a surface behind it: it floats in front of theirs.
    """

    agree: NDArray[np.uint16]
    through: NDArray[np.uint16]


def neighbours(sources: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    """Photos that vote on each photo: those it was matched with, and those that were matched with it."""
    found: dict[str, set[str]] = {name: set() for name in sources}
    for name, others in sources.items():
        for other in others:
            if other in found:
                found[name].add(other)
                found[other].add(name)
    return {name: sorted(others) for name, others in found.items()}


def vote(view: View, others: Iterable[View], max_depth_error: float, max_reprojection_px: float) -> Votes:
    """Votes of other depth maps on one.

    A point agrees with another map's when their depths differ by little there, and when the other's point, projected
    back, falls near the pixel. The other map sees through it where all of its pixels around the place lie behind the
    point by more than that distance in pixels.

    Args:
        view: `pixels` are depths along z, (H, W) float32, 0 for none.
        others: likewise, each at its own size.
        max_depth_error: largest relative difference of two depths of a point.
        max_reprojection_px: largest distance between a pixel and the other map's point projected into it.
    """
    agree, through = np.zeros(view.pixels.shape, np.uint16), np.zeros(view.pixels.shape, np.uint16)
    for other in others:
        there, back = _between(view, other), _between(other, view)
        _count(view.pixels, other.pixels, there, back, max_depth_error, max_reprojection_px, agree, through)
    return Votes(agree, through)


def _between(a: View, b: View) -> Array:
    """(3, 4) from a pixel of a times its depth, and one, to a pixel of b times its depth."""
    b_from_a = b.cam_from_world @ a.world_from_cam
    turned = b.intrinsics @ b_from_a[:3, :3] @ np.linalg.inv(a.intrinsics)
    return np.column_stack([turned, b.intrinsics @ b_from_a[:3, 3]])


@njit(parallel=True, cache=True)
def _count(depth, other, there, back, max_error, max_px, agree, through):  # type: ignore[no-untyped-def]
    """Add one map's votes to agree and through (H, W) uint16.

    depth (H, W) and other (h, w) float32, 0 for none; there and back (3, 4) as `_between` makes them.
    """
    height, width = depth.shape
    for row in prange(height):
        for column in range(width):
            d = depth[row, column]
            if d <= 0:
                continue
            x, y = (column + 0.5) * d, (row + 0.5) * d
            z = there[2, 0] * x + there[2, 1] * y + there[2, 2] * d + there[2, 3]
            if z <= 0:
                continue
            u = (there[0, 0] * x + there[0, 1] * y + there[0, 2] * d + there[0, 3]) / z
            v = (there[1, 0] * x + there[1, 1] * y + there[1, 2] * d + there[1, 3]) / z
            left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
            if left < 0 or top < 0 or left + 1 >= other.shape[1] or top + 1 >= other.shape[0]:
                continue
            same, behind = False, True
            for k in range(4):
                e = other[top + k // 2, left + k % 2]
                bx, by = u * e, v * e
                bz = back[2, 0] * bx + back[2, 1] * by + back[2, 2] * e + back[2, 3]
                if e <= 0 or bz <= 0:
                    behind = False
                    continue
                off_x = (back[0, 0] * bx + back[0, 1] * by + back[0, 2] * e + back[0, 3]) / bz - (column + 0.5)
                off_y = (back[1, 0] * bx + back[1, 1] * by + back[1, 2] * e + back[1, 3]) / bz - (row + 0.5)
                near = off_x * off_x + off_y * off_y <= max_px * max_px
                same |= near and abs(e - z) <= max_error * z
                behind &= (not near) and e > z
            if same:
                agree[row, column] += np.uint16(1)
            elif behind:
                through[row, column] += np.uint16(1)
