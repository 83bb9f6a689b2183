"""Shapes that a crop can have besides the box: turned to the least footprint, and the convex hull."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from scenefuse.core.transforms import Array


def least_footprint(points: Array) -> Array:
    """(3, 3) turn about z after which the box of (N, 3) points has the least footprint; at most 45 degrees.

    A rectangle of least area has a side along an edge of the convex hull (Freeman and Shapira 1975). Points along one
    line are turned along x or y, whichever is nearer.
    """
    try:
        hull = points[ConvexHull(points[:, :2]).vertices, :2]
    except QhullError:
        hull = np.linalg.svd(points[:, :2] - points[:, :2].mean(0), full_matrices=False)[2][:1] * [[1.0], [-1.0]]
    edges = np.roll(hull, -1, axis=0) - hull
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    angles = (angles + np.pi / 4) % (np.pi / 2) - np.pi / 4
    turns = [np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1.0]]) for a in angles]
    return min(turns, key=lambda turn: float(np.prod(np.ptp(points[:, :2] @ turn[:2, :2].T, axis=0))))


def in_wide_hull(points: Array, marks: Array, floor: float, margin: Array) -> NDArray[np.bool_]:
    """(N,) points in the convex hull of marks (F, 3) and of their copies at the height `floor`, grown on all sides.

    A face is moved outwards by as much of the `margin` (3,) along x, y and z as its normal has.

    Raises:
        QhullError: the marks lie in one vertical plane.
    """
    dropped = np.column_stack([marks[:, :2], np.full(len(marks), floor)])
    planes = ConvexHull(np.concatenate([marks, dropped])).equations
    inside = np.ones(len(points), dtype=bool)
    for plane in planes:
        inside &= points @ plane[:3] + plane[3] <= np.abs(plane[:3]) @ margin
    return inside
