"""Where the object is: an upright box around the prompts, and the ground it stands on."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from scenefuse.mvs.visual_hull import Box
from scenefuse.sfm.ground import Ground, fit_ground
from scenefuse.transforms import Array

REACH = 1.5
"""Ground is looked for so far beside the box, in half widths of it: farther off it may be another level."""
SCATTER = 0.02
"""How far a ground point may lie off the plane, as a share of the box's diagonal: grass, gravel, and errors of SfM."""
LEAST = (20, 12)
"""Sparse points beside the box, and cells that hold one, below which there is no ground to see."""


def upright_box(points: Array, up: Array, margin: float) -> Box:
    """The smallest upright box around (N, 3) points, its third axis along `up`, grown on all sides.

    Args:
        points: points on the object, at least two, in the object's frame.
        up: (3,) the direction against gravity.
        margin: growth on each side, as a share of the diagonal of the box of the points.
    """
    z = up / np.linalg.norm(up)
    x = np.cross(z, [1.0, 0, 0] if abs(z[0]) < 0.9 else [0, 1.0, 0])
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    flat = points @ axes
    if len(points) >= 3:
        angle = np.radians(cv2.minAreaRect(flat[:, :2].astype(np.float32))[2])
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        axes = axes @ turn
        flat = points @ axes
    low, high = flat.min(0), flat.max(0)
    grow = margin * np.linalg.norm(high - low)
    return Box(np.column_stack([axes, np.zeros(3)]), low - grow, high + grow)


def find_ground(points_in_box: Array, box: Box, prompts_in_box: Array, seed: int) -> tuple[Ground, bool]:
    """The ground near the object along the box's axes, and whether it was found; otherwise the bottom of the box.

    Fitted to the sparse points beside the box, at most one and a half of its width away. No prompt lies below it by
    more than it scatters.

    Args:
        points_in_box: (N, 3) sparse points along the box's axes.
        box: the object's box.
        prompts_in_box: (M, 3) prompts along the box's axes.
        seed: seed of the samples.
    """
    middle, ring = (box.low + box.high)[:2] / 2, REACH * float((box.high - box.low)[:2].max()) / 2
    tolerance = SCATTER * box.diagonal
    below = points_in_box[points_in_box[:, 2] < box.high[2]]
    ground = fit_ground(below, box.low, box.high, ring, tolerance, seed, LEAST)
    if ground is None:
        return Ground(np.array([box.low[2], 0, 0, 0, 0, 0]), middle, tolerance), False
    around = (np.abs(below[:, :2] - middle) < (box.high - box.low)[:2] / 2 + ring).all(1)
    off = ground.height_of(below[around])
    scatter = float(np.std(off[np.abs(off) < tolerance]))
    ground.coefficients[0] += min(0.0, float(ground.height_of(prompts_in_box).min()) + 2 * scatter)
    return ground, True


def span(points: Array, margin: float) -> Array:
    """(M, 3) points whose convex hull is that of (N, 3) points, grown by `margin` on all sides."""
    steps = np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], dtype=np.float64)
    steps /= np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1)
    return (points[:, None] + margin * steps).reshape(-1, 3)


def in_hull(points: Array, corners: Array) -> NDArray[np.bool_]:
    """(N,) True where (N, 3) points lie in the convex hull of (M, 3) corners."""
    hull = ConvexHull(corners)
    return (points @ hull.equations[:, :3].T + hull.equations[:, 3] <= 1e-9).all(1)
