"""How well a pose explains two surfaces: two-way F-score, colours, free space; hypotheses ranked by it; and the
registration.* numbers of a pose (method G1)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, sampled, within
from scenefuse.core.stage import quantity, threads
from scenefuse.core.transforms import Array, Sim3, apart
from scenefuse.geometry.depth_test import FreeSpace
from scenefuse.geometry.surface import NORMAL_NEIGHBOURS, SAMPLED_POINTS, Pairs, Surface, nearest_rows, normals_at, pair

# Beta of the F-beta score: recall weighs more, since the scene shows only a part of the object.
RECALL_WEIGHT = 2.0
# Noise of colours (standard deviation, 0..1) at least; those that vary less say nothing about the pose.
MIN_COLOR_NOISE = 0.03
# Relative lead of a score by which one pose is better than another.
MIN_MARGIN = 0.04
# Poses that differ by less than these are one: an angle, the scale, the centre as a share of the diagonal.
DISTINCT_ANGLE_DEG, DISTINCT_SCALE_LOG, DISTINCT_SHIFT = 8.0, 0.06, 0.05

# Surfaces face the same way if the cosine of the angle between their normals is larger; and are sought within so many
# times the distance of points that agree.
MIN_FACING, LAYERS = 0.5, 6


@dataclass(frozen=True)
class Score:
    """The quality of one pose, every number in 0..1.

    Attributes:
        f_score: two-way F of `precision` and `recall`, both soft (an inlier counts less the farther and the more
            tilted its partner is). Recall weighs more, since the scene shows only a part of the object.
        precision: share of the object that the scene confirms.
        recall: share of the scene crop that the object explains.
        color: correlation of the colours over the pairs after one gain and bias per channel; None without colours.
        free_space_violation: share of the object in the scene's free space, where photos measured surfaces behind it;
            None where the free space is not known.
        total: the number hypotheses are ranked by: F, with the object's area at the usual scale, times the agreement
            of colours, times the share outside free space.
        displaced: see `displaced_share`; None where it was not measured.
    """

    f_score: float
    precision: float
    recall: float
    color: float | None
    free_space_violation: float | None
    total: float
    displaced: float | None = None


def worth(obj: Surface, scene: Surface, scene_from_object: Sim3, tau: float) -> tuple[Pairs, Array]:
    """The pairs of a pose and how much each counts (M,), 0..1: less the farther and the more tilted its partner is."""
    pairs = pair(obj, scene, scene_from_object, tau)
    turned = scene_from_object.rotate(obj.normals)
    facing = (turned[pairs.object_index] * scene.normals[pairs.scene_index]).sum(1)
    return pairs, (1 - (pairs.distance / tau) ** 2) * np.clip(np.abs(facing), 0, 1)


def lead(best: float, rival: float) -> float:
    """Relative lead of a score over a rival's, -1..1; negative where the rival's is better."""
    return (best - rival) / max(best, rival, 1e-12)


def f_beta(precision: float, recall: float) -> float:
    """The F-score in which recall weighs more."""
    b = RECALL_WEIGHT**2
    return (1 + b) * precision * recall / (b * precision + recall) if precision + recall > 0 else 0.0


def score(
    obj: Surface,
    scene: Surface,
    scene_from_object: Sim3,
    tau: float,
    usual_scale: float,
    free_space: FreeSpace | None = None,
) -> Score:
    """Score a pose.

    Args:
        obj: the object in its own frame.
        scene: the scene crop.
        scene_from_object: the pose.
        tau: distance within which points agree, scene units.
        usual_scale: centre of the scale prior; in the total, an object's area counts as it would be at that scale.
        free_space: space known to be empty, or None.
    """
    pairs, value = worth(obj, scene, scene_from_object, tau)
    precision = float(value[: pairs.forward].sum() / len(obj.queries))
    recall = float(value[pairs.forward :].sum() / len(scene.queries))
    f_score = f_beta(precision, recall)
    color = color_agreement(obj, scene, pairs)
    # A smaller object sticks out less: as a share of its own area, precision would always reward shrinking.
    level = min(1.0, precision * (scene_from_object.scale / usual_scale) ** 2)
    total = f_beta(level, recall)
    total *= 1.0 if color is None else 0.5 + 0.5 * color
    violation = None
    if free_space is not None:
        violation = free_space.violation(scene_from_object.apply(obj.points[obj.queries]))
        total *= 1 - (violation or 0.0)
    return Score(f_score, precision, recall, color, violation, total)


def displaced_share(obj: Surface, scene: Surface, scene_from_object: Sim3, tau: float) -> float | None:
    """Share of the places shown by both clouds where one's surface lies in front of the other's, or behind it.

    From each point the other cloud is looked up along the normal, both ways, for a surface that it meets or that faces
    the same way: where the object is, the two are one. None where no place is shown by both.

    Args:
        obj: the object in its own frame.
        scene: the scene crop.
        scene_from_object: the pose.
        tau: distance within which surfaces are one, scene units; others are sought within LAYERS times that.
    """
    moved = obj.transformed(scene_from_object)
    shown = apart = 0
    for one, other in ((moved, scene), (scene, moved)):
        places, normals = one.points[one.queries], one.normals[one.queries]
        nearest = np.full(len(places), np.inf)
        for step in range(-LAYERS, LAYERS + 1):
            distance, index = other.tree.query(places + step * tau * normals, distance_upper_bound=tau)
            hit = np.flatnonzero(np.isfinite(distance))
            normal, found = normals[hit], index[hit]
            facing = (other.normals[found] * normal).sum(1)
            off = np.abs(((other.points[found] - places[hit]) * normal).sum(1))
            # Where two surfaces meet, the sides of their normals do not count: they may be estimated, or wrong.
            facing = np.where(off <= tau, np.abs(facing), facing)
            nearest[hit] = np.minimum(nearest[hit], np.where(facing > MIN_FACING, off, np.inf))
        shown += int(np.isfinite(nearest).sum())
        apart += int((nearest[np.isfinite(nearest)] > tau).sum())
    return apart / shown if shown else None


def color_agreement(obj: Surface, scene: Surface, pairs: Pairs) -> float | None:
    """Correlation 0..1 of paired colours, pooled over channels, after a gain and a bias per channel.

    None without colours, or where either side is all but one colour: then colours say nothing about the pose.
    """
    if obj.colors is None or scene.colors is None:
        return None
    if min(float(c.std(0).max()) for c in (obj.colors, scene.colors)) < MIN_COLOR_NOISE:
        return None
    if len(pairs.distance) < 30:
        return 0.0
    a, b = obj.colors[pairs.object_index], scene.colors[pairs.scene_index]
    a, b = a - a.mean(0), b - b.mean(0)
    spread = (b**2).sum(0)
    together = (a * b).sum(0)
    explained = np.where(together > 0, together**2 / np.maximum((a**2).sum(0), 1e-9), 0.0)
    return float(np.sqrt(explained.sum() / max(spread.sum(), 1e-9)))


@dataclass(frozen=True)
class Hypothesis:
    """A pose (scene_from_object), where it comes from, and how well it explains both clouds."""

    pose: Sim3
    source: str
    score: Score

    def as_json(self) -> dict[str, Any]:
        """The pose and its numbers as a stage JSON holds them."""
        return {
            "scene_from_object": self.pose.matrix.tolist(),
            "scale": self.pose.scale,
            "source": self.source,
            "score": self.score.total,
            "f_score": self.score.f_score,
            "precision": self.score.precision,
            "recall": self.score.recall,
            "color_agreement": self.score.color,
            "free_space_violation": self.score.free_space_violation,
            "displaced_share": self.score.displaced,
        }


def best_distinct(
    hypotheses: list[Hypothesis],
    centre: Array,
    diagonal: float,
    most: int,
    angle_deg: float = DISTINCT_ANGLE_DEG,
    shift: float = DISTINCT_SHIFT,
) -> list[Hypothesis]:
    """At most `most` hypotheses, best first, without those that equal a better one; see `distinct`."""
    chosen: list[Hypothesis] = []
    for one in sorted(hypotheses, key=lambda h: -h.score.total):
        if len(chosen) == most:
            break
        if all(distinct(one.pose, other.pose, centre, diagonal, angle_deg, shift) for other in chosen):
            chosen.append(one)
    return chosen


def distinct(
    a: Sim3,
    b: Sim3,
    centre: Array,
    diagonal: float,
    angle_deg: float = DISTINCT_ANGLE_DEG,
    shift: float = DISTINCT_SHIFT,
) -> bool:
    """Whether two poses differ by more than an angle, 6 % of scale or, at the object's centre, `shift` diagonals."""
    return bool((apart(a, b, centre) > [DISTINCT_SCALE_LOG, angle_deg, shift * diagonal]).any())


@dataclass(frozen=True)
class AgreementSettings:
    """When points correspond."""

    tau_fraction: float = 0.016
    """Distance within which points correspond, as a share of the crop's diagonal."""


def registration_metrics(
    obj: Cloud, scene: Cloud, scene_from_object: Sim3, tau: float, diagonal: float, unit: str
) -> dict[str, dict[str, Any]]:
    """The registration.* numbers of one pose.

    The object's inliers are its points with a scene point within tau. The names without a suffix are the paper's:
    fitness = share of scene points with an object point within tau (the paper divides by the target); inlier_rmse = RMS
    distance of the object's inliers to their nearest scene points; normal_consistency = mean |n . n_nearest| over these
    pairs (chance 0.5). Beside them: fitness_source = share of the object's points that are inliers (Open3D's fitness);
    fitness_f_score = harmonic mean of both fitnesses; normal_consistency_self = mean |n . n'| between points and their
    neighbours in both whole clouds together.

    Args:
        obj: the object in its own frame.
        scene: the scene's points on the object.
        scene_from_object: the pose.
        tau: inlier distance.
        diagonal: of the full variant's crop.
        unit: of the scene's lengths.
    """
    moved, reach = scene_from_object.apply(obj.points), np.nextafter(tau, np.inf)
    ahead, partner = cKDTree(scene.points).query(moved, distance_upper_bound=reach, workers=threads())
    inlier = np.isfinite(ahead)
    source, target = float(inlier.mean()), float(within(scene.points, moved, tau).mean())
    rmse = float(np.sqrt((ahead[inlier] ** 2).mean())) if inlier.any() else None
    normals_object, normals_scene = (normals_at(points, points) for points in (moved, scene.points))
    facing = np.abs((normals_object[inlier] * normals_scene[partner[inlier]]).sum(1))
    return {
        "fitness": quantity(target, "1"),
        "fitness_source": quantity(source, "1"),
        "fitness_f_score": quantity(2 * source * target / max(source + target, 1e-12), "1"),
        "inlier_rmse": quantity(rmse, unit),
        "inlier_rmse_over_diagonal": quantity(None if rmse is None else rmse / diagonal, "1"),
        "normal_consistency": quantity(float(facing.mean()) if inlier.any() else None, "1"),
        "normal_consistency_self": quantity(self_consistency(np.concatenate([moved, scene.points])), "1"),
        "tau": quantity(tau, unit),
    }


def self_consistency(points: Array) -> float:
    """Mean |n . n'| between points (N, 3) and their neighbours: how smooth a surface is, whatever it is of (method G1).

    Measured at SAMPLED_POINTS points at most; neighbours and normals are those of the whole cloud.
    """
    tree, at = cKDTree(points), sampled(points, SAMPLED_POINTS, seed=0)
    neighbours = nearest_rows(tree, at, NORMAL_NEIGHBOURS)
    used, place = np.unique(neighbours, return_inverse=True)
    normals = normals_at(points, points[used])[place.reshape(neighbours.shape)]
    return float(np.abs(np.einsum("nk,njk->nj", normals[:, 0], normals[:, 1:])).mean())
