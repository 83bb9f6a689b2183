"""What makes a pose uncertain: what surfaces have wrong in common, how far models may be bent."""

import numpy as np
from scipy.linalg import block_diag

from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array, Sim3, Uncertainty
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.surface import Surface

# What a surface has wrong alike all over, as a share of how far two surfaces scatter about each other.
COMMON_ERROR = 0.2


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
