"""An upright box around the prompts, and the ground that the object stands on, by the sparse points beside it."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from scenefuse.core.transforms import Array
from scenefuse.geometry.ground import Ground, quadratic_terms
from scenefuse.geometry.visual_hull import Box

# Ground is looked for so far beside the box, in half widths of it: farther off it may be another level.
GROUND_REACH_HALF_WIDTHS = 1.5
# How far a ground point may lie off the plane, as a share of the box's diagonal: grass, gravel, and errors of SfM.
GROUND_SCATTER_SHARE = 0.02
# Tilt of the ground against the horizontal; steeper planes are walls.
MAX_TILT_DEG = 30.0
# Samples of RANSAC: they find a plane that holds a quarter of the points in 99 of 100 runs.
SAMPLES = 300
# Sparse points beside the box, those of them on the plane, and their share, below which there is no ground to see.
MIN_POINTS_BESIDE, MIN_POINTS_ON_PLANE, MIN_PLANE_SHARE = 20, 12, 0.25


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
    """The ground near the object, and whether it was found; otherwise it is the bottom of the box.

    RANSAC for a plane over the sparse points beside the box (at most one and a half of its width away),
    tilted by at most 30 degrees, then
    a quadratic surface by least squares through the points near it that are not the object's: ground is
    seldom flat. No prompt lies below it by more than it scatters.

    Args:
        points_in_box: (N, 3) sparse points along the box's axes.
        box: the object's box.
        prompts_in_box: (M, 3) prompts along the box's axes.
        seed: seed of the samples.
    """
    centre, half = (box.low + box.high) / 2, (box.high - box.low) / 2
    nowhere = Ground(np.array([box.low[2], 0, 0, 0, 0, 0]), centre[:2])
    sideways = np.abs(points_in_box[:, :2] - centre[:2])
    around = (sideways < half[:2] + GROUND_REACH_HALF_WIDTHS * half[:2].max()).all(1) & (
        points_in_box[:, 2] < box.high[2]
    )
    beside = points_in_box[around & (sideways > half[:2]).any(1)]
    if len(beside) < MIN_POINTS_BESIDE:
        return nowhere, False
    tolerance = GROUND_SCATTER_SHARE * box.diagonal
    generator = np.random.default_rng(seed)
    design = np.column_stack([beside[:, :2], np.ones(len(beside))])
    best = np.zeros(len(beside), dtype=bool)
    for _ in range(SAMPLES):
        pick = generator.choice(len(beside), 3, replace=False)
        if abs(np.linalg.det(design[pick])) < 1e-6 * half[:2].max() ** 2:
            continue
        plane = np.linalg.solve(design[pick], beside[pick, 2])
        inliers = np.abs(beside[:, 2] - design @ plane) < tolerance
        if np.hypot(*plane[:2]) <= np.tan(np.radians(MAX_TILT_DEG)) and inliers.sum() > best.sum():
            best = inliers
    if best.sum() < max(MIN_POINTS_ON_PLANE, MIN_PLANE_SHARE * len(beside)):
        return nowhere, False
    slope = np.linalg.lstsq(design[best], beside[best, 2], rcond=None)[0]
    near = points_in_box[around & ~in_hull(points_in_box, span(prompts_in_box, tolerance))]
    terms = quadratic_terms(near[:, :2] - centre[:2])
    fit = np.array([slope @ [*centre[:2], 1.0], slope[0], slope[1], 0, 0, 0])
    # Bending weighs as much as twenty points that are off by it at the edge of the box: few points cannot bend the
    # surface much.
    ridge = np.diag([0, 0, 0, 1, 1, 1]) * np.sqrt(MIN_POINTS_BESIDE) * half[:2].max() ** 2
    for width in (3, 2, 1.5, 1):
        use = np.abs(near[:, 2] - terms @ fit) < width * tolerance
        fit = np.linalg.lstsq(np.vstack([terms[use], ridge]), np.concatenate([near[use, 2], np.zeros(6)]), rcond=None)[
            0
        ]
    scatter = float(np.std(near[use, 2] - terms[use] @ fit))
    ground = Ground(fit, centre[:2], tolerance)
    fit[0] += min(0.0, float(ground.height_of(prompts_in_box).min()) + 2 * scatter)
    return ground, True


def span(points: Array, margin: float) -> Array:
    """(M, 3) points whose convex hull is that of (N, 3) points, grown by `margin` on all sides."""
    steps = np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)], dtype=np.float64)
    steps /= np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1)
    return (points[:, None] + margin * steps).reshape(-1, 3)


def in_hull(points: Array, corners: Array) -> NDArray[np.bool_]:
    """(N,) True where (N, 3) points lie in the convex hull of (M, 3) corners."""
    hull = ConvexHull(corners)
    near = ((points >= corners.min(0) - 1e-9) & (points <= corners.max(0) + 1e-9)).all(1)
    # Of many points few are near: distances to all faces take far more room than the points.
    near[near] = (points[near] @ hull.equations[:, :3].T + hull.equations[:, 3] <= 1e-9).all(1)
    return np.asarray(near)
