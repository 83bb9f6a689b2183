"""How well a registered object and the scene crop agree: fitness, RMSE, normals, F-score; and the metrics stage."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scenefuse.io.clouds import Cloud, read_cloud, spacing
from scenefuse.metrics.completion import CompletionSettings, completion_metrics, plane_normals
from scenefuse.stage import quantity, read_json, setting, threads, value, write_json
from scenefuse.transforms import Sim3


@dataclass(frozen=True)
class MetricSettings:
    """Settings of all metrics. Shares are of the full variant's crop diagonal, the same for every variant."""

    tau_fraction: float = setting(0.016, least=0)
    """Distance within which points correspond."""
    normal_neighbours: int = setting(16, least=0)
    """Neighbours that a normal is fitted to."""
    variation_spacings: float = setting(8, least=0)
    """Radius of the surface variation, in spacings of the scene crop."""
    density_neighbours: int = setting(16, least=0)
    """Neighbours k of the local density."""
    primitive_fraction: float = setting(0.005, least=0)
    """Distance to a primitive within which a point lies on it."""
    primitive_support: float = setting(0.01, least=0)
    """Smallest share of the new points that makes a primitive."""
    primitive_most: int = setting(20, least=0)
    """Most primitives taken."""
    primitive_angle_deg: float = setting(25, unit="degree", least=0)
    """Largest angle in degrees between a point's normal and the primitive's."""
    sample: int = setting(4000, least=0)
    """Points that a completion metric looks at, chosen by the seed."""


def compute_metrics(
    *,
    object: Path,
    crop: Path,
    reference: Path,
    fine: Path,
    fused: Path | None = None,
    metrics: Path,
    seed: int,
    settings: MetricSettings,
) -> None:
    """Measure one registration and, where the object was fused, the completion (method G1 to G5, R10, R11).

    Args:
        object: object cloud (PLY) in its own frame.
        crop: scene points on the object (PLY); the full variant's for every variant, so that variants can be compared.
        reference: JSON of the full variant's crop stage: its diagonal sets all thresholds, and the unit of lengths.
        fine: JSON of the fine registration of this variant.
        fused: the object's fused surroundings (PLY, with `source`); without it completion is left out.
        metrics: output JSON with `registration` and `completion`.
        seed: of samples and of the random clouds that give the null values.
        settings: see MetricSettings.
    """
    obj, scene = read_cloud(object), read_cloud(crop)
    registration = read_json(fine)
    pose = Sim3.from_matrix(np.array(value(registration, "scene_from_object")))
    extent = read_json(reference)["diagonal"]
    diagonal, unit = float(extent["value"]), str(extent["unit"])
    found = registration_metrics(obj, scene, pose, settings.tau_fraction * diagonal, diagonal, unit, settings)
    found["status"] = quantity(value(registration, "status"), "")
    content: dict[str, Any] = {"registration": found}
    if fused is not None:
        completed = read_cloud(fused)
        added = completed.fields["source"] == 1
        content["completion"] = completion_metrics(
            completed[~added], scene, completed[added], diagonal, unit, _completion(settings), seed
        )
    for name, item in found.items():
        print(f"{name:28s} {item['value']} {item['unit']}", flush=True)
    write_json(metrics, content)


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


def _completion(settings: MetricSettings) -> CompletionSettings:
    return CompletionSettings(
        settings.variation_spacings,
        settings.density_neighbours,
        settings.primitive_fraction,
        settings.primitive_support,
        settings.primitive_most,
        settings.primitive_angle_deg,
        settings.normal_neighbours,
        settings.sample,
    )
