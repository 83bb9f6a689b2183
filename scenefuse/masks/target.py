"""Where an object is, by the sparse model and a few points on it: box, ground, and which sparse points are its own."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay

from scenefuse.cloud.cloud_file import STRAY_PERCENT
from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array, inside_box
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS
from scenefuse.geometry.ground import Ground, fit_ground
from scenefuse.geometry.surface import SCORE_FRACTION
from scenefuse.geometry.visual_hull import MAX_BEYOND_POINTS, MIN_OWN_POINTS, NO_POINTS, Box
from scenefuse.masks.prompts import far_apart
from scenefuse.photos.workspace import View, Workspace

# Sparse points, far apart, that stand for the object where masks voted for thousands.
SPANNING_POINTS = 64
# Ground is looked for so far beside the box, in half widths of it: farther off it may be another level.
GROUND_REACH_HALF_WIDTHS = 1.5


@dataclass(frozen=True)
class Target:
    """Where the object is, by the sparse model and the prompts.

    Attributes:
        box: where it is.
        ground: under which nothing belongs to it.
        ground_found: whether the ground was measured; otherwise it is the box's bottom.
        spanning: (N, 3) points on the object that span it: the prompts.
        margin: how far the object may reach beyond them, in object units.
        parts: (K, 4) rows of them whose tetrahedron is taken for object.
        sparse: (P, 3) sparse points.
        kind: (P,) per sparse point, 1 on the object, -1 not on it, 0 unknown.
        inexact: (K,) rows of the prompts that say how far the object reaches, but may lie beside it in a photo.
    """

    box: Box
    ground: Ground
    ground_found: bool
    spanning: Array
    margin: float
    parts: NDArray[np.intp]
    sparse: Array
    kind: NDArray[np.int8]
    inexact: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))

    def outline(self, view: View) -> Array:
        """Pixels (N, 2) in whose convex hull the object is; all of the photo where that ends behind the camera."""
        pixels, depth = view.project(span(self.spanning, self.margin))
        if (depth > 0).all():
            return pixels
        return np.array([[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]], float)


def target_from_points(points: Array, photos: Workspace, up: Array, seed: int) -> Target:
    """Box, ground and the kind of each sparse point, from (N, 3) points that span the object.

    A sparse point is on the object when it lies above the ground in the convex hull of the points, grown
    by a quarter of the margin; not on it when outside the hull grown by the whole margin, or below the ground; in
    between it is unknown. So is a point of two photos: two rays that are mismatched along their epipolar lines meet
    somewhere all the same.

    Args:
        points: (N, 3) points on the object.
        photos: cameras, sparse points, and who observes them.
        up: (3,) the direction against gravity.
        seed: seed of the ground's RANSAC.

    Raises:
        StageError: all points lie in one place.
    """
    if not np.ptp(points, axis=0).any():
        raise StageError("the points clicked on the object lie in one place; click some that span it")
    sparse, box = photos.points, upright_box(points, up, MAX_BEYOND_POINTS)
    x_in_box = box.to_box(sparse)
    ground, found = find_ground(x_in_box, box, box.to_box(points), seed)
    height = ground.height_of(x_in_box)
    above = SCORE_FRACTION * box.diagonal
    grow = MAX_BEYOND_POINTS * float(np.linalg.norm(np.ptp(points, axis=0)))
    kind = np.zeros(len(sparse), dtype=np.int8)
    kind[~in_hull(sparse, span(points, grow))] = -1
    if found:
        kind[height < 0.5 * above] = -1
    kind[in_hull(sparse, span(points, 0.25 * grow)) & (height > above)] = 1
    kind[np.bincount(np.concatenate(photos.seen), minlength=len(sparse)) < CONFIRMING_PHOTOS] = 0
    return Target(box, ground, found, points, grow, _parts(points, MAX_BEYOND_POINTS * box.diagonal), sparse, kind)


def target_from_votes(
    kind: NDArray[np.int8],
    photos: Workspace,
    up: Array,
    seed: int,
) -> Target:
    """Where the object is, by the sparse points that the photos' masks vote for, those whose kind (P,) is 1.

    Points that the votes leave open are classified as in `target_from_points`, from the points voted for: a vote
    against a point says less, as a part of the object that one mask lacks is missing from the next ones too.

    Raises:
        StageError: fewer than ten points are on the object.
    """
    own = photos.points[kind > 0]
    if len(own) < MIN_OWN_POINTS:
        raise StageError(
            f"only {len(own)} points of the sparse model lie in the masks that the clicks lead to,"
            f" {MIN_OWN_POINTS} are needed; click in a photo that shows more of the object, or in several. If it has"
            " no texture, there are none: light from the side may bring some out"
        )
    target = target_from_points(without_outermost(own), photos, up, seed)
    spanning = far_apart(NO_POINTS, target.spanning, SPANNING_POINTS)
    return replace(
        target,
        spanning=spanning,
        kind=np.where(kind > 0, kind, target.kind).astype(np.int8),
        parts=np.empty((0, 4), dtype=np.intp),
    )


def _parts(points: Array, max_edge: float) -> NDArray[np.intp]:
    """(K, 4) rows of (N, 3) prompts, tetrahedra with short edges: close clicks mark the corners of a small part."""
    if len(points) < 5:
        return np.empty((0, 4), dtype=np.intp)
    corners = Delaunay(points, qhull_options="Qbb Qc QJ").simplices.astype(np.intp)
    edges = np.linalg.norm(points[corners][:, :, None] - points[corners][:, None], axis=-1)
    return corners[edges.max((1, 2)) < max_edge]


def without_outermost(points: Array) -> Array:
    """Of (N, 3) points of the object those that are not the outermost along an axis, where there are many."""
    if not len(points):
        return points
    low = np.percentile(points, STRAY_PERCENT, axis=0, method="lower")
    high = np.percentile(points, 100 - STRAY_PERCENT, axis=0, method="higher")
    return points[inside_box(points, low, high)]


def upright_box(points: Array, up: Array, margin: float) -> Box:
    """The smallest upright box around (N, 3) points, its third axis along `up`, grown on all sides.

    Args:
        points: points on the object, at least three, in the object's frame.
        up: (3,) the direction against gravity.
        margin: growth on each side, as a share of the diagonal of the box of the points.
    """
    z = up / np.linalg.norm(up)
    x = np.cross(z, [1.0, 0, 0] if abs(z[0]) < 0.9 else [0, 1.0, 0])
    x /= np.linalg.norm(x)
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    flat = points @ axes
    angle = np.radians(cv2.minAreaRect((flat - flat.mean(0))[:, :2].astype(np.float32))[2])
    axes = axes @ np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    flat = points @ axes
    low, high = flat.min(0), flat.max(0)
    grow = margin * np.linalg.norm(high - low)
    return Box(np.column_stack([axes, np.zeros(3)]), low - grow, high + grow)


def find_ground(points_in_box: Array, box: Box, prompts_in_box: Array, seed: int) -> tuple[Ground, bool]:
    """The ground beside the object, and whether it was found; otherwise it is the bottom of the box.

    No prompt lies below it: where one would, the ground is lowered.

    Args:
        points_in_box: (N, 3) sparse points along the box's axes.
        box: the object's box.
        prompts_in_box: (M, 3) prompts along the box's axes.
        seed: seed of RANSAC's samples.
    """
    ring = GROUND_REACH_HALF_WIDTHS * float((box.high - box.low)[:2].max()) / 2
    low_enough = points_in_box[points_in_box[:, 2] < box.high[2]]
    ground = fit_ground(low_enough, box.low, box.high, ring, SCORE_FRACTION * box.diagonal, seed)
    if ground is None:
        return Ground(np.array([box.low[2], 0, 0, 0, 0, 0]), (box.low + box.high)[:2] / 2), False
    ground.coefficients[0] += min(0.0, float(ground.height_of(prompts_in_box).min()))
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
