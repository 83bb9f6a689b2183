"""What a photo shows first, from its sparse points: a place behind it is hidden, whatever the mask says (method K4)."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from scenefuse.mvs.views import Views
from scenefuse.transforms import Array

LONGEST_SIDE = 0.06
"""Of a triangle between sparse points, over the photo's longer side; farther apart they need not be one surface."""
FROM_MASK_PX = 2
"""Sparse points off the mask, but this near to it, may be the object's: they are left out."""


def sparse_depths(views: Views) -> NDArray[np.float32]:
    """Depth (V, H, W) along z, object units, of what each photo shows first; infinite where that is not known, and
    beyond a photo that is smaller than its picture minus infinity: whatever lies there is hidden.

    The sparse points that a photo observes span triangles in it, those on its mask and those off it by themselves, over
    which inverse depth is linear.
    """
    return np.stack([_depths_of(views, index) for index in range(len(views.names))])


def _depths_of(views: Views, index: int) -> NDArray[np.float32]:
    """The map (H, W) of one photo."""
    view = views.view(index)
    mask = views.masks[index, : view.height, : view.width]
    points = views.sparse[views.tracks[index]]
    rows, pixels, depth = view.visible(points)
    size = 2 * FROM_MASK_PX + 1
    at = pixels[:, 1], pixels[:, 0]
    on, off = mask[at], cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8))[at] == 0
    exact = view.project(points[rows])[0]
    of_object, beside = (_interpolated(exact[part], 1 / depth[part], mask.shape) for part in (on, off))
    nearness = np.where(mask, of_object, beside)
    whole = np.full(views.masks.shape[1:], -np.inf, np.float32)
    whole[: view.height, : view.width] = np.where(nearness <= 0, np.inf, 1 / np.maximum(nearness, 1e-12))
    return whole


def _interpolated(at: Array, values: Array, shape: tuple[int, ...]) -> Array:
    """Values (N,) at pixels (N, 2), linear (H, W) over the small ones of the triangles between them; 0 elsewhere."""
    drawn = np.zeros(shape, np.int32)
    try:
        corners = Delaunay(at).simplices
    except (QhullError, ValueError):  # fewer than three points, or all on a line
        return np.zeros(shape)
    sides = np.linalg.norm(at[corners] - at[np.roll(corners, 1, axis=1)], axis=2)
    corners = corners[sides.max(1) <= LONGEST_SIDE * max(shape)]
    for label, triangle in enumerate(np.floor(at[corners]).astype(np.int32), start=1):
        cv2.fillConvexPoly(drawn, triangle, label)
    # Of each triangle the plane (a, b, c): value = a x + b y + c. Slivers have none.
    upright = np.concatenate([at[corners], np.ones((len(corners), 3, 1))], axis=2)
    whole = np.abs(np.linalg.det(upright)) > 1e-6
    planes = np.zeros((len(corners) + 1, 3))
    planes[1:][whole] = np.linalg.solve(upright[whole], values[corners[whole]][..., None])[..., 0]
    rows, columns = np.nonzero(drawn)
    plane = planes[drawn[rows, columns]]
    found = np.zeros(shape)
    found[rows, columns] = plane[:, 0] * (columns + 0.5) + plane[:, 1] * (rows + 0.5) + plane[:, 2]
    return found
