"""The metrics of one object's registration and completion.

The quality of what was added needs no truth: surface variation, uniformity of density, primitives; each with its null.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.cloud_file import strays
from scenefuse.cloud.clouds import Cloud, parts, plane_normals, read_cloud, sampled, spacing
from scenefuse.core.stage import quantity, read_json, threads, value, write_json
from scenefuse.core.transforms import Array, Sim3, inside_box
from scenefuse.fuse.compare import MARGIN
from scenefuse.fuse.measure import SUPPORT
from scenefuse.fuse.write import Source
from scenefuse.geometry.surface import NORMAL_NEIGHBOURS
from scenefuse.register.score import AgreementSettings, registration_metrics

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


def compute_metrics(
    *,
    object: Path,
    crop: Path,
    crop_json: Path,
    fine_json: Path,
    fused: Path | None = None,
    report: Path,
    seed: int,
    settings: MetricSettings,
) -> None:
    """Measure one registration and, where the object was fused, the completion (method G1 to G5, R10, R11).

    Args:
        object: object cloud (PLY) in its own frame.
        crop: scene points on the object (PLY); the full variant's for every variant, so that variants can be compared.
        crop_json: JSON of the full variant's crop stage: its diagonal sets all thresholds, and the unit of lengths.
        fine_json: JSON of the fine registration of this variant.
        fused: the object's fused surroundings (PLY, with `source`); without it completion is left out.
        report: output JSON with `registration`, `object` (its size in the scene: length, width and height; median
            and 90 % standard deviations of the added points) and `completion`.
        seed: of samples and of the random clouds that give the null values.
        settings: see MetricSettings.
    """
    obj, scene = read_cloud(object), read_cloud(crop)
    registration = read_json(fine_json)
    pose = Sim3.from_matrix(np.array(value(registration, "scene_from_object")))
    crop_about = read_json(crop_json)
    diagonal, unit = float(value(crop_about, "diagonal")), str(crop_about["diagonal"]["unit"])
    tau = settings.agreement.tau_fraction * diagonal
    found = registration_metrics(obj, scene, pose, tau, diagonal, unit)
    found["status"] = quantity(value(registration, "status"), "")
    size = box_size(pose.apply(obj.points))
    content: dict[str, Any] = {"registration": found, "object": {"size": quantity(size, unit)}}
    if fused is not None:
        after = read_cloud(fused)
        added = after.fields["source"] == Source.OBJECT
        for name in ("deviation", "world_deviation"):
            known = after.fields[name][added] if name in after.fields else np.empty(0)
            if np.isfinite(known).any():
                content["object"][name] = quantity(float(np.nanmedian(known)), unit)
                content["object"][f"{name}_90"] = quantity(float(np.nanpercentile(known, 90)), unit)
        part = completion_of(scene.points, after, Source.OBJECT, diagonal)
        content["completion"] = completion_metrics(part, settings, seed)
    for group in content.values():
        for name, item in group.items():
            print(f"{name:34s} {item['value']} {item['unit']}", flush=True)
    write_json(report, content)


def box_size(points: Array) -> list[float]:
    """Length, width and height of points (N, 3), z up: of the smallest upright box around them without strays. What may
    be ground at the foot, lower than twice MARGIN, counts in the height alone, unless it is most of the object."""
    points = points[~strays(points)]
    low, high = points.min(0), points.max(0)
    above = points[:, 2] > low[2] + 2 * MARGIN * np.linalg.norm(high - low)
    plan = points[above] if above.mean() > SUPPORT else points
    sides = cv2.minAreaRect((plan[:, :2] - low[:2]).astype(np.float32))[1]
    return [*sorted(map(float, sides), reverse=True), float(high[2] - low[2])]


def completion_of(before: Array, after: Cloud, source: int, diagonal: float) -> Completion:
    """An object's completion, from the scene's points on it and a fused cloud.

    Args:
        before: (N, 3) the crop.
        after: the object's surroundings or the whole scene after fusion, with `source`.
        source: the object's number in it.
        diagonal: of the full variant's crop.
    """
    origin = after.fields["source"]
    left = after.points[(origin == 0) & inside_box(after.points, before.min(0), before.max(0))]
    # Fusion never moves what it keeps of the scene.
    still = cKDTree(left).query(before, workers=threads())[0] == 0 if len(left) else np.zeros(len(before), dtype=bool)
    return Completion(before, before[still], after.points[origin == source], diagonal)


def completion_metrics(part: Completion, settings: MetricSettings, seed: int) -> dict[str, dict[str, Any]]:
    """The completion.* numbers of an object (method G2 to G5).

    A name alone is the paper's measure of the added points P_new in the completed cloud. `_null` is the same with a
    random cloud in the place of P_new, as many points, uniform in its bounding box: what the measure gives for nothing.
    `_before` and `_after` are the same measure of all points of the incomplete and of the completed cloud. All are null
    where next to nothing was added.

    Args:
        part: the object that was fused.
        settings: see MetricSettings.
        seed: of samples and of the null cloud.
    """
    added = quantity(len(part.added), "points")
    if len(part.added) < 4 * settings.density_neighbours:
        return {n: quantity(None, "1") for m in MEASURES for n in (m, f"{m}_null")} | {"added_points": added}
    random = np.random.default_rng(seed).uniform(part.added.min(0), part.added.max(0), part.added.shape)
    real, null = _of_added(part, settings, seed), _of_added(replace(part, added=random), settings, seed)
    found: dict[str, dict[str, Any]] = {}
    for name in MEASURES:
        found |= {name: quantity(real[name], "1"), f"{name}_null": quantity(null[name], "1")}
    for when, cloud in (("before", part.before), ("after", part.after)):
        for name, number in _variation_and_primitives(cloud, cloud, part, settings, seed).items():
            found[f"{name}_{when}"] = quantity(number, "1")
    return found | {"added_points": added}


def _of_added(part: Completion, settings: MetricSettings, seed: int) -> dict[str, float | None]:
    """Every number of the added points."""
    densities = [
        local_density(cloud, sampled(cloud, settings.sample, seed), settings.density_neighbours)
        for cloud in (part.after, part.before)
    ]
    (mean, spread), (mean_before, spread_before) = ((float(rho.mean()), float(rho.std())) for rho in densities)
    return _variation_and_primitives(part.after, part.added, part, settings, seed) | {
        "nue": spread / spread_before,
        "nue_density_invariant": (spread / mean) / (spread_before / mean_before),
    }


def _variation_and_primitives(
    cloud: Array, of: Array, part: Completion, settings: MetricSettings, seed: int
) -> dict[str, float | None]:
    """Surface variation and primitives of a cloud, at some of the points `of`."""
    at = sampled(of, settings.sample, seed)
    return {
        "surface_variation": surface_variation(cloud, at, settings.variation_spacings * spacing(part.before)),
        "primitive_fitting_score": _primitives(cloud, at, part.diagonal, settings, seed),
    }


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
