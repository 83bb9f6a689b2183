"""Unsupervised quality of what was added: surface variation, uniformity of density, primitives; each with its null."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scenefuse.io.clouds import Cloud, plane_normals, sampled, spacing
from scenefuse.metrics.primitives import primitive_fitting_score
from scenefuse.registration.agreement import NORMAL_NEIGHBOURS, AgreementSettings
from scenefuse.stage import quantity, setting, threads
from scenefuse.transforms import Array

# Points at which the variation is measured over the paper's wide radii: their neighbourhoods are large.
WIDE_SAMPLE = 1500


@dataclass(frozen=True)
class MetricSettings:
    """Settings of all metrics. Shares are of the full variant's crop diagonal, the same for every variant."""

    agreement: AgreementSettings = AgreementSettings()
    """When points correspond."""
    sample: int = setting(4000, least=0)
    """Points at which a completion metric is measured, chosen by the seed."""
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


def completion_metrics(
    around: Cloud, scene: Cloud, added: Cloud, diagonal: float, unit: str, settings: MetricSettings, seed: int
) -> dict[str, dict[str, Any]]:
    """The completion.* numbers of the added points P_new, and the same of a random cloud in their place.

    The null cloud has as many points, uniform in P_new's bounding box: a metric gives that much for nothing.

    Args:
        around: the scene's points that were kept around the object.
        scene: the scene's points on the object before completion: the incomplete cloud of NUE.
        added: P_new.
        diagonal: of the full variant's crop.
        unit: of the scene's lengths.
        settings: see MetricSettings.
        seed: of samples and of the null cloud.
    """
    names = ("surface_variation", "nue", "nue_density_invariant", "primitive_fitting_score")
    if len(added) < 4 * settings.density_neighbours:
        empty = {n: quantity(None, "1") for m in names for n in (m, f"{m}_null")}
        return {**empty, "added_points": quantity(len(added), "points")}
    rng = np.random.default_rng(seed)
    low, high = added.points.min(0), added.points.max(0)
    random = rng.uniform(low, high, (len(added), 3))
    real = _measure(around.points, scene.points, added.points, diagonal, settings, seed)
    null = _measure(around.points, scene.points, random, diagonal, settings, seed)
    found: dict[str, dict[str, Any]] = {}
    for name in real:
        found[name] = quantity(real[name], "1")
        found[f"{name}_null"] = quantity(null[name], "1")
    radius = settings.variation_spacings * spacing(scene.points)
    found["surface_variation_scene"] = quantity(
        surface_variation(scene.points, sampled(scene.points, settings.sample, seed), radius), "1"
    )
    found["surface_variation_radius"] = quantity(radius, unit)
    found["added_points"] = quantity(len(added), "points")
    return found


def _measure(
    around: Array, scene: Array, added: Array, diagonal: float, settings: MetricSettings, seed: int
) -> dict[str, float | None]:
    """Every number for one set of added points."""
    complete = np.concatenate([around, added])
    few = sampled(added, settings.sample, seed)
    fewer = sampled(added, min(settings.sample, WIDE_SAMPLE), seed)
    few_scene = sampled(scene, settings.sample, seed)
    radius = settings.variation_spacings * spacing(scene)
    found: dict[str, float | None] = {"surface_variation": surface_variation(complete, few, radius)}
    for percent in (1, 2, 4):
        found[f"surface_variation_{percent}pct"] = surface_variation(complete, fewer, percent / 100 * diagonal)
    for k in (settings.density_neighbours, 8, 32):
        suffix = "" if k == settings.density_neighbours else f"_k{k}"
        new, old = local_density(complete, few, k), local_density(scene, few_scene, k)
        found[f"nue{suffix}"] = float(new.std() / old.std())
        found[f"nue_density_invariant{suffix}"] = float((new.std() / new.mean()) / (old.std() / old.mean()))
    nearest = cKDTree(complete).query(few, k=min(NORMAL_NEIGHBOURS, len(complete)), workers=threads())[1]
    found["primitive_fitting_score"] = primitive_fitting_score(
        few,
        plane_normals(complete, nearest),
        settings.primitive_fraction * diagonal,
        settings.primitive_support,
        settings.primitive_most,
        settings.primitive_angle_deg,
        seed,
    )
    return found


def surface_variation(cloud: Array, at: Array, radius: float) -> float | None:
    """Mean over `at` of lambda_0 / (lambda_0 + lambda_1 + lambda_2) of the cloud's points within `radius`, 0..1/3.

    Neighbourhoods of fewer than four points have no variation and are left out; None when there is no other.

    Args:
        cloud: (N, 3) points that are neighbours.
        at: (M, 3) points whose neighbourhoods are measured.
        radius: of a neighbourhood, in the clouds' unit.
    """
    found = cKDTree(cloud).query_ball_point(at, radius, workers=threads())
    counts = np.array([len(f) for f in found])
    if (counts < 4).all():
        return None
    index = np.concatenate([np.asarray(f, dtype=np.int64) for f in found])
    owner = np.repeat(np.arange(len(at)), counts)
    local = cloud[index] - at[owner]
    first = np.stack([np.bincount(owner, local[:, i], len(at)) for i in range(3)], axis=1)
    second = np.stack(
        [np.bincount(owner, local[:, i] * local[:, j], len(at)) for i in range(3) for j in range(3)], axis=1
    )
    enough = counts >= 4
    n = counts[enough][:, None]
    mean = first[enough] / n
    covariance = second[enough].reshape(-1, 3, 3) / n[..., None] - mean[:, :, None] * mean[:, None, :]
    values = np.clip(np.linalg.eigvalsh(covariance), 0, None)
    return float((values[:, 0] / np.maximum(values.sum(1), 1e-300)).mean())


def local_density(cloud: Array, at: Array, k: int) -> Array:
    """rho = k / (pi r_k^2) at points `at` of the cloud; r_k is the distance to the k-th other point."""
    distance = cKDTree(cloud).query(at, k=min(k + 1, len(cloud)), workers=threads())[0][:, -1]
    floor = max(float(np.median(distance)) * 1e-3, 1e-300)
    return k / (np.pi * np.maximum(distance, floor) ** 2)
