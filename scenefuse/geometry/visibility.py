"""Which photos see a point: surfaces that photos confirmed hide what is behind them, and nothing stands before them.

Source: Merrell et al. 2007 (visibility constraints between depth maps), here between measured points and photos.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import Array
from scenefuse.geometry.depth_test import BEHIND, IN_FRONT, OUTSIDE, depth_buffer, depth_test
from scenefuse.geometry.photo_kernel import MIN_COSINE
from scenefuse.photos.workspace import View

# Cosine of the angle between a normal and the direction to a camera, from which on a surface stands in the way.
FACING_COSINE = 0.1
# Side of a cell in spacings of the surface's points, so that a surface has no holes between them.
CELL_SPACINGS = 2.0
# Cells of 3 x 3 that must hold a surface to say that a point is hidden behind it, or that a photo sees through it.
MIN_CELLS_HIDING, MIN_CELLS_BEHIND = 5, 7


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
    for view in views:
        nearest, farthest = _surface_in(surface, view, spacing)
        place = depth_test(points, nearest, margin, farthest)
        in_view += place != OUTSIDE
        hidden += place == BEHIND
        through += place == IN_FRONT
    return Visibility(in_view, hidden, through)


def shown_in(
    points: Array, normals: NDArray[np.float32], surface: Cloud, view: View, spacing: float, margin: float
) -> NDArray[np.bool_]:
    """Which of (N, 3) points with normals (N, 3) a photo shows: from their front, with no surface before them.

    Here both sides of a surface hide: a camera behind a wall sees nothing. The other arguments are those of `see`; a
    photo that looks along a surface, beyond 75 degrees, does not show it.
    """
    nearest, farthest = _surface_in(surface, view, spacing, both_sides=True)
    place, towards = depth_test(points, nearest, margin, farthest), view.centre - points
    front = (normals * towards).sum(1) >= MIN_COSINE * np.linalg.norm(towards, axis=1)
    return np.asarray(front & (place != OUTSIDE) & (place != BEHIND))


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
