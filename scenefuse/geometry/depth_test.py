"""The depth test: whether a point lies in front of what a depth map shows, on it, behind it, or where nothing is known.

A point in front is seen through: the view sees a surface behind it. A point behind is hidden. The same test serves
measured depth maps and buffers that are drawn from points, of a scene and of an object.
"""

from dataclasses import replace

import numpy as np
from numba import vectorize
from numpy.typing import NDArray

from scenefuse.core.transforms import Array
from scenefuse.photos.workspace import View

OUTSIDE, UNKNOWN, IN_FRONT, AT, BEHIND = range(5)


@vectorize(cache=True)
def place(depth, nearest, farthest, tolerance):  # type: ignore[no-untyped-def]
    """UNKNOWN, IN_FRONT, AT or BEHIND: a depth beside the nearest and the farthest that a map holds there, 0 for none.

    A NumPy ufunc that Numba's kernels also call.
    """
    if nearest > 0 and depth < nearest - tolerance:
        return np.int8(IN_FRONT)
    if farthest > 0 and depth > farthest + tolerance:
        return np.int8(BEHIND)
    return np.int8(AT) if nearest > 0 and farthest > 0 else np.int8(UNKNOWN)


def depth_test(points: Array, view: View, tolerance: float, farthest: Array | None = None) -> NDArray[np.int8]:
    """(N,) where points (N, 3) lie beside a view's depth map: OUTSIDE of the picture, UNKNOWN, IN_FRONT, AT or BEHIND.

    Args:
        points: in the view's world.
        view: `pixels` are depths along z, (H, W), 0 for none.
        tolerance: difference of depth up to which a point is AT, unit of the world.
        farthest: (H, W) depth behind which points are BEHIND, 0 for none; without it that of `view`.
    """
    rows, pixels, depth = view.visible(points)
    at = pixels[:, 1], pixels[:, 0]
    found = np.full(len(points), OUTSIDE, np.int8)
    found[rows] = place(depth, view.pixels[at], (view.pixels if farthest is None else farthest)[at], tolerance)
    return found


def depth_buffer(points: Array, view: View, side: float) -> View:
    """The view in square cells, `pixels` (H, W) the least depth of the points in each, 0 without one.

    Args:
        points: (N, 3) in the view's world.
        view: its pixels are not used.
        side: of a cell at the points' median depth, unit of the world.
    """
    _, depth = view.project(points)
    ahead = depth[depth > 0]
    cell = side * view.intrinsics[0, 0] / (np.median(ahead) if len(ahead) else 1.0)
    small = replace(view, pixels=None).at_most(max(4, round(max(view.width, view.height) / max(1.0, cell))))
    _, pixels, depth = small.visible(points)
    nearest = np.full((small.height, small.width), np.inf)
    np.minimum.at(nearest, (pixels[:, 1], pixels[:, 0]), depth)
    return replace(small, pixels=np.where(np.isfinite(nearest), nearest, 0.0))
