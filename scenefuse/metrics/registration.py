"""How well a registered object and the scene crop agree: fitness, RMSE, normals, F-score."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scenefuse.io.clouds import Cloud, spacing
from scenefuse.stage import quantity, setting, threads
from scenefuse.transforms import Array, Sim3


@dataclass(frozen=True)
class MetricSettings:
    """Settings of all metrics. Shares are of the full variant's crop diagonal, the same for every variant."""

    tau_fraction: float = setting(0.016, least=0)
    """Distance within which points correspond, as a share of the crop's diagonal."""
    sample: int = setting(4000, least=0)
    """Points at which a completion metric is measured, chosen by the seed."""
    normal_neighbours: int = 16
    """Neighbours that a normal is fitted to."""
    variation_spacings: float = 8
    """Radius of the surface variation, in spacings of the scene crop."""
    density_neighbours: int = 16
    """Neighbours k of the local density."""
    primitive_fraction: float = 0.005
    """Distance to a primitive within which a point lies on it, as a share of the crop's diagonal."""
    primitive_support: float = 0.01
    """Smallest share of the new points that makes a primitive."""
    primitive_most: int = 20
    """Most primitives taken."""
    primitive_angle_deg: float = 25
    """Largest angle in degrees between a point's normal and the primitive's."""


def registration_metrics(
    obj: Cloud,
    scene: Cloud,
    scene_from_object: Sim3,
    tau: float,
    diagonal: float,
    unit: str,
    settings: MetricSettings,
) -> dict[str, dict[str, Any]]:
    """The registration.* numbers of one pose.

    fitness_source = share of object points with a scene point within tau (Open3D's); fitness_target = share of scene
    points with an object point within tau (the paper divides by the target); inlier_rmse over the object's inliers;
    normal_consistency_cross = mean |n . n_nearest| over them (chance 0.5); normal_consistency_self = the same between
    each point of both clouds together and its neighbours; f_score = harmonic mean of both fitnesses.

    Args:
        obj: the object in its own frame.
        scene: the scene's points on the object.
        scene_from_object: the pose.
        tau: inlier distance.
        diagonal: of the full variant's crop.
        unit: of the scene's lengths.
        settings: for the normals.
    """
    moved = scene_from_object.apply(obj.points)
    ahead, partner = cKDTree(scene.points).query(moved, workers=threads())
    back = cKDTree(moved).query(scene.points, workers=threads())[0]
    inlier = ahead <= tau
    source, target = float(inlier.mean()), float((back <= tau).mean())
    rmse = float(np.sqrt((ahead[inlier] ** 2).mean())) if inlier.any() else None
    normals_object = plane_normals(moved, moved, settings.normal_neighbours)
    normals_scene = plane_normals(scene.points, scene.points, settings.normal_neighbours)
    facing = np.abs((normals_object[inlier] * normals_scene[partner[inlier]]).sum(1))
    together = np.concatenate([moved[inlier], scene.points])
    if len(together) > 20000:
        together = together[np.random.default_rng(0).permutation(len(together))[:20000]]
    union = plane_normals(together, together, settings.normal_neighbours)
    neighbours = cKDTree(together).query(together, k=min(settings.normal_neighbours, len(together)), workers=threads())[
        1
    ]
    smooth = np.abs(np.einsum("nk,njk->nj", union, union[neighbours[:, 1:]])).mean()
    return {
        "fitness_source": quantity(source, "1"),
        "fitness_target": quantity(target, "1"),
        "inlier_rmse": quantity(rmse, unit),
        "inlier_rmse_over_diagonal": quantity(None if rmse is None else rmse / diagonal, "1"),
        "normal_consistency_cross": quantity(float(facing.mean()) if inlier.any() else None, "1"),
        "normal_consistency_self": quantity(float(smooth), "1"),
        "f_score": quantity(2 * source * target / max(source + target, 1e-12), "1"),
        "tau": quantity(tau, unit),
        "object_spacing": quantity(spacing(moved), unit),
        "scene_spacing": quantity(spacing(scene.points), unit),
    }


def plane_normals(cloud: Array, at: Array, neighbours: int) -> Array:
    """Unit normals (M, 3) at points `at` from the planes through their nearest neighbours in the cloud."""
    index = cKDTree(cloud).query(at, k=min(neighbours, len(cloud)), workers=threads())[1]
    local = cloud[index]
    local = local - local.mean(1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]


def sampled(points: Array, most: int, seed: int) -> Array:
    """At most that many of (N, 3) points, drawn evenly."""
    if len(points) <= most:
        return points
    return points[np.random.default_rng(seed).choice(len(points), most, replace=False)]
