"""What stands before an object: photos that look at it there say nothing about where the object ends (method K4)."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from scenefuse.mvs.views import Views
from scenefuse.transforms import Array

LONGEST_SIDE = 0.06
"""Of a triangle between sparse points, over the photo's longer side; farther apart they need not be one surface."""
FROM_MASK_PX = 2
"""Sparse points this near to the mask may be the object's."""


def covered_from(views: Views) -> NDArray[np.float32]:
    """Depth (V, H, W) along z, object units, of what each photo shows beside the object; infinite where not known.

    The sparse points that a photo observes off its mask span triangles in it, over which inverse depth is linear. A
    place farther than that on the pixel's ray is hidden from the photo, which the object's masks alone cannot tell
    from a place where the object is not.
    """
    return np.stack([_behind_mask(views, index) for index in range(len(views.names))])


def _behind_mask(views: Views, index: int) -> NDArray[np.float32]:
    """The map (H, W) of one photo."""
    view, mask = views.view(index), views.masks[index]
    points = views.sparse[views.tracks[index]]
    rows, pixels, depth = view.visible(points)
    size = 2 * FROM_MASK_PX + 1
    off = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8))[pixels[:, 1], pixels[:, 0]] == 0
    nearness = _interpolated(view.project(points[rows[off]])[0], 1 / depth[off], mask.shape)
    return np.where(mask | (nearness <= 0), np.inf, 1 / np.maximum(nearness, 1e-12)).astype(np.float32)


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
