"""Similarities between frames: composing, inverting, fitting, writing, and how uncertain one is.

`b_from_a` names a transform, `x_in_b` points. All arithmetic is float64.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scenefuse.core.stage import quantity

Array = NDArray[np.float64]
# Opposite to gravity in a levelled frame.
UP: Array = np.array([0.0, 0.0, 1.0])
# Standard deviation of a normal error over the median of its size.
SD_OVER_MEDIAN = 1.4826
# Points that fix a similarity.
FIXING_POINTS = 3
# Points lie along a line where they extend across it by less than this share of their extent along it (RMS).
MIN_BREADTH = 0.01
# Depths that differ by this share are of two surfaces: no slanted one has such a step.
DEPTH_JUMP = 0.03
# What is off by this many standard deviations is an outlier: another place, another pose, or a wrong measurement.
MAX_DEVIATIONS = 4.0


@dataclass(frozen=True)
class Sim3:
    """x_in_b = scale * rotation @ x_in_a + translation.

    Attributes:
        scale: positive factor, units of b per unit of a.
        rotation: (3, 3) rotation matrix.
        translation: (3,) in units of b.
    """

    scale: float
    rotation: Array
    translation: Array

    @classmethod
    def identity(cls) -> "Sim3":
        """The transform that changes nothing."""
        return cls(1.0, np.eye(3), np.zeros(3))

    @classmethod
    def from_matrix(cls, matrix: Array) -> "Sim3":
        """From a 4x4 similarity matrix; ValueError when its linear part is no scaled rotation."""
        matrix = np.asarray(matrix, dtype=np.float64)
        determinant = np.linalg.det(matrix[:3, :3])
        if determinant <= 0:
            raise ValueError(f"not a similarity: the determinant of the linear part is {determinant:.3g}")
        scale = float(np.cbrt(determinant))
        rotation = matrix[:3, :3] / scale
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
            raise ValueError("not a similarity: the linear part is not a scaled rotation")
        return cls(scale, rotation, matrix[:3, 3].copy())

    @property
    def matrix(self) -> Array:
        """The transform as a (4, 4) matrix."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def apply(self, points: ArrayLike) -> Array:
        """Transform (..., 3) points from a to b."""
        return self.scale * (np.asarray(points, dtype=np.float64) @ self.rotation.T) + self.translation

    def rotate(self, directions: ArrayLike) -> Array:
        """Rotate (..., 3) directions, normals for instance, from a to b."""
        return np.asarray(directions, dtype=np.float64) @ self.rotation.T

    def inverse(self) -> "Sim3":
        """a_from_b."""
        rotation = self.rotation.T
        return Sim3(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def __matmul__(self, other: "Sim3") -> "Sim3":
        """c_from_b @ b_from_a = c_from_a."""
        return Sim3(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.scale * (self.rotation @ other.translation) + self.translation,
        )


def box_corners(low: Array, high: Array) -> Array:
    """The eight corners (8, 3) of the axis-aligned box from `low` (3,) to `high` (3,), x slowest."""
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def inside_box(points: Array, low: Array, high: Array, margin: float = 0.0) -> NDArray[np.bool_]:
    """(N,) which of the points (N, D) lie in the box from `low` (D,) to `high` (D,), its sides moved by `margin`."""
    return np.asarray(((points >= low - margin) & (points <= high + margin)).all(1))


def box_around(low: Array, high: Array, b_from_a: Sim3) -> tuple[Array, Array]:
    """Corners (3,) of the axis-aligned box in frame b around a box of frame a from `low` (3,) to `high` (3,)."""
    moved = b_from_a.apply(box_corners(low, high))
    return moved.min(0), moved.max(0)


def fit_sim3(x_in_a: Array, x_in_b: Array, weights: Array | None = None, scale: float | None = None) -> Sim3:
    """Weighted least-squares b_from_a for (N, 3) pairs (Umeyama 1991); with `scale` given it is not estimated.

    Raises:
        ValueError: fewer than three pairs, or points on one line.
    """
    if len(x_in_a) < 3:
        raise ValueError(f"a similarity needs three pairs of points, not {len(x_in_a)}")
    w = np.ones(len(x_in_a)) if weights is None else np.asarray(weights, dtype=np.float64)
    w = w / w.sum()
    mean_a, mean_b = w @ x_in_a, w @ x_in_b
    centred_a, centred_b = x_in_a - mean_a, x_in_b - mean_b
    u, singular, vt = np.linalg.svd((w[:, None] * centred_b).T @ centred_a)
    if singular[1] < 1e-12 * max(singular[0], 1e-300):
        raise ValueError("a similarity cannot be fitted to points on one line")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    if scale is None:
        scale = float((singular * sign).sum() / (w @ (centred_a**2).sum(1)))
    return Sim3(scale, rotation, mean_b - scale * (rotation @ mean_a))


def fit_sim3_robust(x_in_a: Array, x_in_b: Array, threshold: float, seed: int = 0) -> tuple[Sim3, NDArray[np.bool_]]:
    """RANSAC over 1000 triples, then least squares on the inliers within `threshold` (units of b).

    Returns:
        b_from_a and the (N,) inlier mask.

    Raises:
        ValueError: fewer than three pairs, or no triple that spans a plane.
    """
    rng = np.random.default_rng(seed)
    best = np.zeros(len(x_in_a), dtype=bool)
    for _ in range(1000):
        triple = rng.choice(len(x_in_a), 3, replace=False) if len(x_in_a) >= 3 else np.arange(len(x_in_a))
        try:
            candidate = fit_sim3(x_in_a[triple], x_in_b[triple])
        except ValueError:
            continue
        inliers = np.linalg.norm(candidate.apply(x_in_a) - x_in_b, axis=1) <= threshold
        if inliers.sum() > best.sum():
            best = inliers
    for _ in range(5):
        fitted = fit_sim3(x_in_a[best], x_in_b[best])
        best = np.linalg.norm(fitted.apply(x_in_a) - x_in_b, axis=1) <= threshold
    return fitted, best


def rotation_angle_deg(rotation: Array) -> float:
    """Angle of a rotation matrix in degrees, 0 to 180."""
    sine = np.linalg.norm(rotation - rotation.T) / np.sqrt(8.0)
    return float(np.degrees(np.arctan2(sine, (np.trace(rotation) - 1.0) / 2.0)))


def rotation_between(a: Array, b: Array) -> Array:
    """The smallest (3, 3) rotation that turns direction a (3,) into direction b (3,)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1.0 + 1e-12:
        helper = np.eye(3)[np.argmin(np.abs(a))]
        axis = np.cross(a, helper)
        axis /= np.linalg.norm(axis)
        return 2.0 * np.outer(axis, axis) - np.eye(3)
    k = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + k + k @ k / (1.0 + cosine)


def apart(pose: "Sim3", other: "Sim3", at: Array) -> Array:
    """(3,) how two poses differ: by log scale, by rotation in degrees, and where (3,) of the object lies."""
    return np.array([
        abs(np.log(other.scale / pose.scale)),
        rotation_angle_deg(other.rotation @ pose.rotation.T),
        np.linalg.norm(other.apply(at) - pose.apply(at)),
    ])  # fmt: skip


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of a pose.

    Attributes:
        scale_sd_log: standard deviation of the scale, natural logarithm.
        rotation_sd_deg: standard deviation of the rotation about its least certain axis, degrees.
        rotation_axis: (3,) that axis, in the scene.
        translation_sd: standard deviation of the object's centre along its least certain direction, scene units.
        covariance: (7, 7) of rotation vector (radians), translation (scene units) and log scale, about that centre.
    """

    scale_sd_log: float
    rotation_sd_deg: float
    rotation_axis: Array
    translation_sd: float
    covariance: Array

    @classmethod
    def of(cls, covariance: Array) -> "Uncertainty":
        """What a (7, 7) covariance says."""
        turn, axes = np.linalg.eigh(covariance[:3, :3])
        return cls(
            float(np.sqrt(max(covariance[6, 6], 0))),
            float(np.degrees(np.sqrt(max(turn[-1], 0)))),
            axes[:, -1],
            float(np.sqrt(max(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1], 0))),
            covariance,
        )

    @classmethod
    def even(cls, scale_sd_log: float, rotation_sd_deg: float, translation_sd: float) -> "Uncertainty":
        """The same in all directions."""
        variances = np.array([np.radians(rotation_sd_deg)] * 3 + [translation_sd] * 3 + [scale_sd_log]) ** 2
        return cls(scale_sd_log, rotation_sd_deg, UP, translation_sd, np.diag(variances))

    def size(self, diagonal: float) -> float:
        """One number to compare by: how far it moves a point half a diagonal off the centre, over the diagonal."""
        turn, shift = np.radians(self.rotation_sd_deg) / 2, self.translation_sd / diagonal
        return float(np.sqrt((self.scale_sd_log / 2) ** 2 + turn**2 + shift**2))

    @property
    def deviations(self) -> Array:
        """(3,) standard deviations of log scale, of the rotation (degrees) and of the shift (scene units)."""
        return np.array([self.scale_sd_log, self.rotation_sd_deg, self.translation_sd])

    def with_difference(self, pose: Sim3, other: Sim3, at: Array) -> "Uncertainty":
        """With the difference of two estimates of the pose, taken at (3,) in the object's frame, added in squares."""
        return Uncertainty.even(*np.hypot(self.deviations, apart(pose, other, at)))

    def unless_apart(self, pose: Sim3, other: Sim3, at: Array, of_other: "Uncertainty") -> "Uncertainty":
        """At least what two estimates differ by beyond the other's own uncertainty; see `with_difference`."""
        beyond = np.sqrt(np.maximum(apart(pose, other, at) ** 2 - of_other.deviations**2, 0))
        if (beyond <= self.deviations).all():
            return self
        return Uncertainty.even(*np.maximum(self.deviations, beyond))


def uncertainty_quantities(uncertainty: Uncertainty | None, length: str) -> dict[str, Any]:
    """A pose's uncertainty as a stage JSON holds it; null where it is not known."""
    u = uncertainty
    return {
        "scale_sd_log": quantity(None if u is None else u.scale_sd_log, "1"),
        "rotation_sd_deg": quantity(None if u is None else u.rotation_sd_deg, "deg"),
        "translation_sd": quantity(None if u is None else u.translation_sd, length),
        "covariance": quantity(None if u is None else u.covariance, f"radians, {length}, log scale"),
    }


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike) -> Array:
    """(3, 3) cam_from_world rotation of a camera at `eye` that looks at `target` with `up` upwards in the image."""
    forward = np.asarray(target, dtype=np.float64) - np.asarray(eye, dtype=np.float64)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, dtype=np.float64))
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def along_a_line(points: Array) -> bool:
    """Whether (N, 3) points lie in one place or along a line, which leaves the turn about it open."""
    centred = points - points.mean(0)
    least, most = np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred)[1:], 0))
    return bool(least <= MIN_BREADTH * most)
