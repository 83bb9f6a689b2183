"""How well a registered object and the scene crop agree: fitness, RMSE, normals, F-score (method R10, R11, G1)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.io.clouds import Cloud, plane_normals, spacing
from scenefuse.stage import quantity, setting, threads
from scenefuse.transforms import Array, Sim3

# Neighbours that a plane is fitted to for a normal.
NORMAL_NEIGHBOURS = 16
# Points of both clouds together at which their common normals are measured.
MOST_TOGETHER = 20000


@dataclass(frozen=True)
class AgreementSettings:
    """When points correspond."""

    tau_fraction: float = setting(0.016, least=0)
    """Distance within which points correspond, as a share of the crop's diagonal."""


def registration_metrics(
    obj: Cloud, scene: Cloud, scene_from_object: Sim3, tau: float, diagonal: float, unit: str
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
    """
    moved = scene_from_object.apply(obj.points)
    ahead, partner = cKDTree(scene.points).query(moved, workers=threads())
    back = cKDTree(moved).query(scene.points, workers=threads())[0]
    inlier = ahead <= tau
    source, target = float(inlier.mean()), float((back <= tau).mean())
    rmse = float(np.sqrt((ahead[inlier] ** 2).mean())) if inlier.any() else None
    normals_object, normals_scene = (_normals(points)[0] for points in (moved, scene.points))
    facing = np.abs((normals_object[inlier] * normals_scene[partner[inlier]]).sum(1))
    together = np.concatenate([moved[inlier], scene.points])
    if len(together) > MOST_TOGETHER:
        together = together[np.random.default_rng(0).permutation(len(together))[:MOST_TOGETHER]]
    union, neighbours = _normals(together)
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


def _normals(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Normals (N, 3) of the planes through each point's nearest neighbours, and these (N, K)."""
    neighbours = cKDTree(points).query(points, k=min(NORMAL_NEIGHBOURS, len(points)), workers=threads())[1]
    return plane_normals(points, neighbours), neighbours
