"""How uncertain a pose is: standard deviations, what surfaces have wrong in common, how far models may be bent."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from scenefuse.core.stage import quantity, threads
from scenefuse.core.transforms import UP, Array, Sim3, apart
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.surface import Surface

# What a surface has wrong alike all over, as a share of how far two surfaces scatter about each other.
COMMON_ERROR = 0.2


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


def with_bending(local: Uncertainty, pose: Sim3, of_object: Array | None, of_scene: Array | None) -> Uncertainty:
    """A pose's uncertainty against the world, where both models may be bent (method M10).

    Args:
        local: of the pose between the models as they are, about the object's centre.
        pose: scene_from_object.
        of_object: (7, 7) covariance of the object's model around that centre, in its own frame; None where unknown.
        of_scene: (7, 7) of the scene's model around the same place, in the scene's frame.
    """
    total = local.covariance.copy()
    if of_object is not None:
        into_scene = block_diag(pose.rotation, pose.scale * pose.rotation, 1.0)
        total += into_scene @ of_object @ into_scene.T
    if of_scene is not None:
        total += of_scene
    return Uncertainty.of(total)


def common_error(obj: Surface, scene: Surface, pose: Sim3, scales: ScaleRange, reach: float) -> Array:
    """What a pose by clouds has wrong because their surfaces err alike, about the object's centre (method R12).

    Stereo fattens, smooths and displaces whole surfaces; neither their scatter nor halves of them show it. It is taken
    as a fifth of the scatter: of the RMS distance, along the object's normals, of the scene's points that lie on it.

    Args:
        obj: the object.
        scene: the scene.
        pose: scene_from_object.
        scales: bounds of the scale; one that is held has no error.
        reach: distance within which a point of the scene lies on the object, scene units.

    Returns:
        (7, 7) covariance of rotation vector (radians), translation (scene units) and log scale.
    """
    points = pose.inverse().apply(scene.points)
    distance, nearest = obj.tree.query(points, distance_upper_bound=reach / pose.scale, workers=threads())
    on_it = np.isfinite(distance)
    off = ((points[on_it] - obj.points[nearest[on_it]]) * obj.normals[nearest[on_it]]).sum(1)
    shift = COMMON_ERROR * pose.scale * float(np.sqrt((off**2).mean())) if on_it.any() else 0.0
    radius = pose.scale * float(np.sqrt(((obj.points - obj.points.mean(0)) ** 2).sum(1).mean()))
    of_scale = shift / radius if scales.width > 0 else 0.0
    return np.diag(np.square([shift / radius] * 3 + [shift] * 3 + [of_scale]))


def uncertainty_quantities(uncertainty: Uncertainty | None, length: str) -> dict[str, Any]:
    """A pose's uncertainty as a stage JSON holds it; null where it is not known."""
    u = uncertainty
    return {
        "scale_sd_log": quantity(None if u is None else u.scale_sd_log, "1"),
        "rotation_sd_deg": quantity(None if u is None else u.rotation_sd_deg, "deg"),
        "translation_sd": quantity(None if u is None else u.translation_sd, length),
        "covariance": quantity(None if u is None else u.covariance, f"radians, {length}, log scale"),
    }
