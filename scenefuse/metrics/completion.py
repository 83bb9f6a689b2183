"""Unsupervised quality of what was added: surface variation, uniformity of density, primitives; each with its null."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, parts, plane_normals, sampled, spacing
from scenefuse.core.stage import quantity, threads
from scenefuse.core.transforms import Array
from scenefuse.geometry.surface import NORMAL_NEIGHBOURS
from scenefuse.register.score import AgreementSettings

MEASURES = ("surface_variation", "nue", "nue_density_invariant", "primitive_fitting_score")
# Candidates for a primitive, of each kind, in a round.
CANDIDATES = 150
Mask = NDArray[np.bool_]
# Points and normals of candidates' two oriented points: p, q, u, v, each (K, 3).
Pairs = tuple[Array, Array, Array, Array]


@dataclass(frozen=True)
class MetricSettings:
    """Settings of all metrics. Shares are of the full variant's crop diagonal, the same for every variant."""

    agreement: AgreementSettings = AgreementSettings()
    """When points correspond."""
    sample: int = 4000
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


@dataclass(frozen=True)
class Completion:
    """An object in its scene before and after fusion; clouds in the scene's frame, without the ground around it.

    Attributes:
        before: (N, 3) the incomplete cloud: the scene's points on the object, the crop.
        kept: (K, 3) those of them that fusion left.
        added: (M, 3) P_new, what fusion added.
        diagonal: of the full variant's crop.
    """

    before: Array
    kept: Array
    added: Array
    diagonal: float

    @property
    def after(self) -> Array:
        """(K + M, 3) the completed cloud."""
        return np.concatenate([self.kept, self.added])


def completion_of(before: Array, after: Cloud, source: int, diagonal: float) -> Completion:
    """An object's completion, from the scene's points on it and a fused cloud.

    Args:
        before: (N, 3) the crop.
        after: the object's surroundings or the whole scene after fusion, with `source`.
        source: the object's number in it.
        diagonal: of the full variant's crop.
    """
    low, high = before.min(0), before.max(0)
    origin = after.fields["source"]
    left = after.points[(origin == 0) & ((after.points >= low) & (after.points <= high)).all(1)]
    # Fusion never moves what it keeps of the scene.
    still = cKDTree(left).query(before, workers=threads())[0] == 0 if len(left) else np.zeros(len(before), dtype=bool)
    return Completion(before, before[still], after.points[origin == source], diagonal)


def completion_metrics(parts: Sequence[Completion], settings: MetricSettings, seed: int) -> dict[str, dict[str, Any]]:
    """The completion.* numbers of one object, or of a scene's objects together (method G2 to G5).

    A name alone is the paper's measure of the added points P_new in the completed cloud. `_null` is the same with a
    random cloud in the place of P_new, as many points, uniform in its bounding box: what the measure gives for nothing.
    `_before` and `_after` are the same measure of all points of the incomplete and of the completed cloud. Objects that
    added next to nothing are left out; several count by their points.

    Args:
        parts: the objects that were fused.
        settings: see MetricSettings.
        seed: of samples and of the null cloud.
    """
    added = quantity(sum(len(part.added) for part in parts), "points")
    parts = [part for part in parts if len(part.added) >= 4 * settings.density_neighbours]
    if not parts:
        return {n: quantity(None, "1") for m in MEASURES for n in (m, f"{m}_null")} | {"added_points": added}
    random = [replace(part, added=_random_cloud(part.added, seed)) for part in parts]
    real, null = _of_added(parts, settings, seed), _of_added(random, settings, seed)
    found: dict[str, dict[str, Any]] = {}
    for name in real:
        found |= {name: quantity(real[name], "1"), f"{name}_null": quantity(null[name], "1")}
    for when, clouds in (("before", [part.before for part in parts]), ("after", [part.after for part in parts])):
        for name, number in _variation_and_primitives(clouds, clouds, parts, settings, seed).items():
            found[f"{name}_{when}"] = quantity(number, "1")
    return found | {"added_points": added}


def _random_cloud(like: Array, seed: int) -> Array:
    return np.random.default_rng(seed).uniform(like.min(0), like.max(0), like.shape)


def _of_added(parts: Sequence[Completion], settings: MetricSettings, seed: int) -> dict[str, float | None]:
    """Every number of the added points, the objects weighted by their number."""
    after, k = [part.after for part in parts], settings.density_neighbours
    new = _spread(after, k, settings.sample, seed)
    old = _spread([part.before for part in parts], k, settings.sample, seed)
    found = _variation_and_primitives(after, [part.added for part in parts], parts, settings, seed)
    nue = {"nue": new[1] / old[1], "nue_density_invariant": (new[1] / new[0]) / (old[1] / old[0])}
    return {name: (found | nue)[name] for name in MEASURES}


def _variation_and_primitives(
    clouds: Sequence[Array], of: Sequence[Array], parts: Sequence[Completion], settings: MetricSettings, seed: int
) -> dict[str, float | None]:
    """Surface variation and primitives of clouds, one for each object, at some of the points `of` each.

    The objects are weighted by the number of these points.
    """
    at, weights = [sampled(points, settings.sample, seed) for points in of], [len(points) for points in of]
    radii = [settings.variation_spacings * spacing(part.before) for part in parts]
    smooth = [surface_variation(*given) for given in zip(clouds, at, radii)]
    plain = [_primitives(c, a, p.diagonal, settings, seed) for c, a, p in zip(clouds, at, parts)]
    return {"surface_variation": _mean(smooth, weights), "primitive_fitting_score": _mean(plain, weights)}


def _mean(values: Sequence[float | None], weights: Sequence[int]) -> float | None:
    """The weighted mean of the values that exist."""
    there = [(value, weight) for value, weight in zip(values, weights) if value is not None]
    return float(np.average([v for v, _ in there], weights=[w for _, w in there])) if there else None


def _spread(clouds: Sequence[Array], k: int, sample: int, seed: int) -> tuple[float, float]:
    """Mean and standard deviation of the local densities of several clouds, each counted by its points."""
    found = [local_density(cloud, sampled(cloud, sample, seed), k) for cloud in clouds]
    weights = np.concatenate([np.full(len(rho), len(cloud) / len(rho)) for rho, cloud in zip(found, clouds)])
    rho = np.concatenate(found)
    mean = float(np.average(rho, weights=weights))
    return mean, float(np.sqrt(np.average((rho - mean) ** 2, weights=weights)))


def _primitives(cloud: Array, at: Array, diagonal: float, settings: MetricSettings, seed: int) -> float:
    """The primitive fitting score of points `at` of a cloud, with the cloud's normals."""
    nearest = cKDTree(cloud).query(at, k=min(NORMAL_NEIGHBOURS, len(cloud)), workers=threads())[1]
    return primitive_fitting_score(
        at,
        plane_normals(cloud, nearest),
        settings.primitive_fraction * diagonal,
        settings.primitive_support,
        settings.primitive_most,
        settings.primitive_angle_deg,
        seed,
    )


def surface_variation(cloud: Array, at: Array, radius: float) -> float | None:
    """Mean over `at` of lambda_0 / (lambda_0 + lambda_1 + lambda_2) of the cloud's points within `radius`, 0..1/3.

    Neighbourhoods of fewer than four points have no variation and are left out; None when there is no other.

    Args:
        cloud: (N, 3) points that are neighbours.
        at: (M, 3) points whose neighbourhoods are measured.
        radius: of a neighbourhood, in the clouds' unit.
    """
    tree = cKDTree(cloud)
    # At a time few: a fine object's neighbourhoods hold thousands of points each.
    parts = [_variations(tree, at[start : start + 200], radius) for start in range(0, len(at), 200)]
    found = np.concatenate(parts) if parts else np.empty(0)
    return float(found.mean()) if len(found) else None


def _variations(tree: cKDTree, at: Array, radius: float) -> Array:
    """(V,) surface variations at those of `at` whose neighbourhood holds four points or more."""
    near = tree.query_ball_point(at, radius, workers=threads())
    counts = np.array([len(f) for f in near])
    index = np.concatenate([np.asarray(f, dtype=np.int64) for f in near])
    owner = np.repeat(np.arange(len(at)), counts)
    local = tree.data[index] - at[owner]
    first = np.stack([np.bincount(owner, local[:, i], len(at)) for i in range(3)], axis=1)
    second = np.stack(
        [np.bincount(owner, local[:, i] * local[:, j], len(at)) for i in range(3) for j in range(3)], axis=1
    )
    enough = counts >= 4
    n = counts[enough][:, None]
    mean = first[enough] / n
    covariance = second[enough].reshape(-1, 3, 3) / n[..., None] - mean[:, :, None] * mean[:, None, :]
    values = np.clip(np.linalg.eigvalsh(covariance), 0, None)
    return values[:, 0] / np.maximum(values.sum(1), 1e-300)


def local_density(cloud: Array, at: Array, k: int) -> Array:
    """rho = k / (pi r_k^2) at points `at` of the cloud; r_k is the distance to the k-th other point."""
    distance = cKDTree(cloud).query(at, k=min(k + 1, len(cloud)), workers=threads())[0][:, -1]
    floor = max(float(np.median(distance)) * 1e-3, 1e-300)
    return k / (np.pi * np.maximum(distance, floor) ** 2)


def primitive_fitting_score(
    points: Array,
    normals: Array,
    tolerance: float,
    support: float,
    limit: int,
    angle_deg: float,
    seed: int,
) -> float:
    """Share of points on any of the primitives found one after the other (method G5).

    Each round draws planes (one oriented point), spheres and cylinders (two oriented points, Schnabel 2007) from
    neighbouring points that are left, takes the one with the largest connected set of inliers, and removes it.

    Args:
        points: (N, 3) new points.
        normals: (N, 3) unit normals, either side.
        tolerance: distance to the primitive.
        support: smallest share of N that makes a primitive.
        limit: largest number of primitives.
        angle_deg: largest angle between a point's normal and the primitive's.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    left = np.ones(len(points), dtype=bool)
    nearest = cKDTree(points).query(points, k=min(9, len(points)))[0]
    link = max(2 * tolerance, 1.5 * float(np.median(nearest[:, -1])))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    cosine = np.cos(np.radians(angle_deg))
    for _ in range(limit):
        index = np.flatnonzero(left)
        if len(index) < max(support * len(points), 10):
            break
        taken = _best_primitive(points[index], normals[index], tolerance, cosine, link, size, rng)
        if len(taken) < support * len(points):
            break
        left[index[taken]] = False
    return float(1 - left.mean())


def _best_primitive(
    points: Array, normals: Array, tolerance: float, cosine: float, link: float, size: float, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Indices of the largest connected inlier set among one round of candidates."""
    first = rng.integers(0, len(points), CANDIDATES)
    # A partner from the neighbourhood lies on the same primitive far more often than one from anywhere.
    near = cKDTree(points).query(points[first], k=min(60, len(points)))[1]
    second = near[np.arange(CANDIDATES), rng.integers(min(10, len(points) - 1), near.shape[1], CANDIDATES)]
    pairs = points[first], points[second], normals[first], normals[second]
    masks = [kind(points, normals, pairs, tolerance, cosine, size) for kind in (_on_planes, _on_spheres, _on_cylinders)]
    inliers = np.concatenate(masks)
    counts = inliers.sum(1)
    best = np.array([], dtype=np.int64)
    for k in np.argsort(-counts, kind="stable")[:5]:
        if counts[k] <= len(best):
            break
        on_it = np.flatnonzero(inliers[k])
        part_of, sizes = parts(points[on_it], link)
        best = on_it[part_of == sizes.argmax()] if sizes.max() > len(best) else best
    return best


def _on_planes(points: Array, normals: Array, pairs: Pairs, tolerance: float, cosine: float, size: float) -> Mask:
    """The plane through the first point; its size is not limited."""
    anchor, _, normal, _ = pairs
    distance = np.abs(normal @ points.T - (normal * anchor).sum(1)[:, None])
    return (distance <= tolerance) & (np.abs(normal @ normals.T) >= cosine)


def _on_spheres(points: Array, normals: Array, pairs: Pairs, tolerance: float, cosine: float, size: float) -> Mask:
    """The centre is where the two normals' lines come nearest."""
    p, q, u, v = pairs
    along = (u * v).sum(1)
    w = p - q
    a, b, bottom = (u * w).sum(1), (v * w).sum(1), 1 - along**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (along * b - a) / bottom, (b - along * a) / bottom
    centre = (p + s[:, None] * u + q + t[:, None] * v) / 2
    r1, r2 = np.linalg.norm(p - centre, axis=1), np.linalg.norm(q - centre, axis=1)
    radius = (r1 + r2) / 2
    fine = np.isfinite(radius) & (radius < size) & (np.abs(r1 - r2) < 2 * tolerance) & (bottom > 1e-4)
    centre = np.where(fine[:, None], centre, 1e9)
    offset = points[None] - centre[:, None]
    length = np.linalg.norm(offset, axis=2)
    facing = np.abs((offset * normals).sum(2)) >= cosine * length
    return fine[:, None] & (np.abs(length - radius[:, None]) <= tolerance) & facing


def _on_cylinders(points: Array, normals: Array, pairs: Pairs, tolerance: float, cosine: float, size: float) -> Mask:
    """The axis is orthogonal to both normals; across it, the two normals' lines meet at the centre."""
    p, q, u, v = pairs
    axis = np.cross(u, v)
    length = np.linalg.norm(axis, axis=1)
    fine = length > 0.05
    axis = np.where(fine[:, None], axis / np.maximum(length, 1e-12)[:, None], [0.0, 0.0, 1.0])
    w = q - p
    w = w - (w * axis).sum(1, keepdims=True) * axis
    reach = (np.cross(w, v) * axis).sum(1) / np.where(fine, (np.cross(u, v) * axis).sum(1), 1)
    centre = p + reach[:, None] * u
    across = q - centre
    across = across - (across * axis).sum(1, keepdims=True) * axis
    r1, r2 = np.abs(reach), np.linalg.norm(across, axis=1)
    radius = (r1 + r2) / 2
    fine &= (np.abs(r1 - r2) < 2 * tolerance) & (radius < size / 2) & (radius > 2 * tolerance)
    offset = points[None] - centre[:, None]
    offset = offset - (offset @ axis[:, :, None]) * axis[:, None]
    away = np.linalg.norm(offset, axis=2)
    facing = np.abs((offset * normals).sum(2)) >= cosine * away
    return fine[:, None] & (np.abs(away - radius[:, None]) <= tolerance) & facing
