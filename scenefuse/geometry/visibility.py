"""Which photos see a point: surfaces that photos confirmed hide what is behind them, and nothing stands before them.

Source: Merrell et al. 2007 (visibility constraints between depth maps), here between measured points and photos.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import Array
from scenefuse.geometry.photo_kernel import MIN_COSINE
from scenefuse.photos.workspace import View

FACING = 0.1
"""Cosine of the angle between a normal and the direction to a camera, from which on a surface stands in the way."""
CELL_SPACINGS = 2.0
"""Side of a cell in spacings of the surface's points, so that a surface has no holes between them."""
LEAST_KNOWN_HIDDEN, LEAST_KNOWN_THROUGH = 5, 7
"""Cells of 3 x 3 that must hold a surface to say that a point is hidden behind it, or that a photo sees through it."""


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
    """Hold points (N, 3) against the measured points of a surface, with normals, in each photo.

    Args:
        points: in the frame of the surface and the cameras.
        surface: measured points.
        views: cameras.
        spacing: of the surface's points.
        margin: how far before or behind the surface a point must lie to count, unit of the frame.
    """
    in_view, hidden, through = (np.zeros(len(points), dtype=np.int64) for _ in range(3))
    for view in views:
        buffer = _depth_buffer(surface, view, spacing)
        nearest, farthest, known = _around(buffer.pixels)
        rows, pixels, depth = buffer.visible(points)
        at = pixels[:, 1], pixels[:, 0]
        in_view[rows] += 1
        hidden[rows] += (known[at] >= LEAST_KNOWN_HIDDEN) & (depth > farthest[at] + margin)
        through[rows] += (known[at] >= LEAST_KNOWN_THROUGH) & (depth < nearest[at] - margin)
    return Visibility(in_view, hidden, through)


def shown_in(
    points: Array, normals: NDArray[np.float32], surface: Cloud, view: View, spacing: float, margin: float
) -> NDArray[np.bool_]:
    """Which of (N, 3) points with normals (N, 3) a photo shows: from their front, with no surface before them.

    Here both sides of a surface hide: a camera behind a wall sees nothing. The other arguments are those of `see`; a
    photo that looks along a surface, beyond 75 degrees, does not show it.
    """
    buffer = _depth_buffer(surface, view, spacing, both_sides=True)
    _, farthest, known = _around(buffer.pixels)
    rows, pixels, depth = buffer.visible(points)
    at = pixels[:, 1], pixels[:, 0]
    towards = view.centre - points[rows]
    front = (normals[rows] * towards).sum(1) >= MIN_COSINE * np.linalg.norm(towards, axis=1)
    found = np.zeros(len(points), dtype=bool)
    found[rows] = front & ~((known[at] >= LEAST_KNOWN_HIDDEN) & (depth > farthest[at] + margin))
    return found


def _depth_buffer(surface: Cloud, view: View, spacing: float, both_sides: bool = False) -> View:
    """The photo in cells, `pixels` (H, W) the least depth of the surface's points in each; infinite without one."""
    points, normals = surface.points, surface.normals
    assert normals is not None
    towards = view.centre - points
    hiding = both_sides | ((normals * towards).sum(1) > FACING * np.linalg.norm(towards, axis=1))
    _, depth = view.project(points)
    ahead = depth[depth > 0]
    cell = CELL_SPACINGS * spacing * view.intrinsics[0, 0] / (np.median(ahead) if len(ahead) else 1.0)
    small = replace(view, pixels=None).at_most(max(4, round(max(view.width, view.height) / max(1.0, cell))))
    rows, pixels, depth = small.visible(points[hiding])
    nearest = np.full((small.height, small.width), np.inf)
    np.minimum.at(nearest, (pixels[:, 1], pixels[:, 0]), depth)
    return View(small.name, small.intrinsics, small.cam_from_world, small.width, small.height, nearest)


def _around(nearest: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Least and largest depth (H, W) of the 3 x 3 cells around each, of those that have one, and their number."""
    height, width = nearest.shape
    padded = np.pad(nearest, 1, constant_values=np.inf)
    shifted = np.stack([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)])
    known = np.isfinite(shifted)
    return shifted.min(0), np.where(known, shifted, -np.inf).max(0), known.sum(0)
