"""The depth test: whether a point lies in front of what a depth map shows, on it, behind it, or where nothing is known.

A point in front is seen through: the view sees a surface behind it. A point behind is hidden. The same test serves
measured depth maps and buffers that are drawn from points, of a scene and of an object.

Source: Merrell et al. 2007 (visibility constraints between depth maps).
"""

from dataclasses import dataclass, replace

import numpy as np
from numba import vectorize
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import Array
from scenefuse.geometry.photo_kernel import MIN_COSINE
from scenefuse.photos.workspace import View

OUTSIDE, UNKNOWN, IN_FRONT, AT, BEHIND = range(5)
# Cosine of the angle between a normal and the direction to a camera, from which on a surface stands in the way.
FACING_COSINE = 0.1
# Side of a cell in spacings of the surface's points, so that a surface has no holes between them.
CELL_SPACINGS = 2.0
# Cells of 3 x 3 that must hold a surface to say that a point is hidden behind it, or that a photo sees through it.
MIN_CELLS_HIDING, MIN_CELLS_BEHIND = 5, 7


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


@dataclass(frozen=True)
class Visibility:
    """How V photos see N points.

    Attributes:
        in_view: (N,) photos that have the point in their picture.
        hidden: (N,) of these, photos in which a surface stands before it.
        through: (N,) of these, photos that see a surface behind it: nothing can be where it is.
    """

    in_view: NDArray[np.int64]
    hidden: NDArray[np.int64]
    through: NDArray[np.int64]


def see(points: Array, surface: Cloud, views: list[View], spacing: float, margin: float) -> Visibility:
    """Test points (N, 3) against the measured points of a surface, with normals, in each photo.

    Args:
        points: in the frame of the surface and the cameras.
        surface: measured points.
        views: cameras.
        spacing: of the surface's points.
        margin: how far before or behind the surface a point must lie to count, unit of the frame.
    """
    in_view, hidden, through = (np.zeros(len(points), dtype=np.int64) for _ in range(3))
    for view in views if len(surface) > 1 else ():
        nearest, farthest = _surface_in(surface, view, spacing)
        found = depth_test(points, nearest, margin, farthest)
        in_view += found != OUTSIDE
        hidden += found == BEHIND
        through += found == IN_FRONT
    return Visibility(in_view, hidden, through)


def shown_in(
    points: Array, normals: NDArray[np.float32], surface: Cloud, view: View, spacing: float, margin: float
) -> NDArray[np.bool_]:
    """Which of (N, 3) points with normals (N, 3) a photo shows: from their front, with no surface before them.

    Here both sides of a surface hide: a camera behind a wall sees nothing. The other arguments are those of `see`; a
    photo that looks along a surface, beyond 75 degrees, does not show it.
    """
    nearest, farthest = _surface_in(surface, view, spacing, both_sides=True)
    found, towards = depth_test(points, nearest, margin, farthest), view.centre - points
    front = (normals * towards).sum(1) >= MIN_COSINE * np.linalg.norm(towards, axis=1)
    return np.asarray(front & (found != OUTSIDE) & (found != BEHIND))


def _surface_in(surface: Cloud, view: View, spacing: float, both_sides: bool = False) -> tuple[View, Array]:
    """The photo in cells: the least depth of the surface in the 3 x 3 cells around each, where MIN_CELLS_BEHIND of
    them hold some, and the largest (H, W), where MIN_CELLS_HIDING do; 0 elsewhere."""
    assert surface.normals is not None
    towards = view.centre - surface.points
    facing = (surface.normals * towards).sum(1) > FACING_COSINE * np.linalg.norm(towards, axis=1)
    buffer = depth_buffer(surface.points[both_sides | facing], view, CELL_SPACINGS * spacing)
    height, width = buffer.pixels.shape
    padded = np.pad(buffer.pixels, 1)
    shifted = np.stack([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)])
    known = (shifted > 0).sum(0)
    least = np.where(shifted > 0, shifted, np.inf).min(0)
    nearest = np.where(known >= MIN_CELLS_BEHIND, least, 0.0)
    return replace(buffer, pixels=nearest), np.where(known >= MIN_CELLS_HIDING, shifted.max(0), 0.0)
