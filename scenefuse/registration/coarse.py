"""Coarse registration: many hypotheses from features and from gravity, briefly refined, the distinct best kept."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scenefuse.io.clouds import Cloud, read_cloud
from scenefuse.registration.evidence import known_ups
from scenefuse.registration.features import fpfh, match, ransac_similarities
from scenefuse.registration.paper import paper_coarse
from scenefuse.registration.refine import ScaleRange, refine_points
from scenefuse.registration.score import Score, score
from scenefuse.registration.surface import Surface, prepare, probing, with_grid
from scenefuse.registration.upright import upright_hypotheses
from scenefuse.stage import quantity, read_json, setting, value, write_json
from scenefuse.transforms import Array, Sim3, rotation_angle_deg, rotation_between

MOST_POINTS = 6000
SCORE_POINTS = 1200


@dataclass(frozen=True)
class CoarseSettings:
    """Settings of the coarse registration."""

    voxel_fractions: tuple[float, ...] = setting((0.04, 0.03), unit="of the diagonal")
    """Voxels of the feature pyramid, as shares of the scene crop's diagonal."""
    ransac_samples: int = setting(30000, least=0)
    """Random triples of matches drawn at each level of the pyramid."""
    feature_scale_steps: int = setting(3, least=0)
    """Logarithmic scale steps at which the object's features are computed."""
    scale_steps: int = setting(13, least=0)
    """Logarithmic scale steps of the upright sweep."""
    yaw_steps: int = setting(24, least=0)
    """Steps of a full turn of the upright sweep."""
    sweep_voxel_fraction: float = setting(0.045, unit="of the diagonal", least=0)
    """Voxel of the upright sweep, as a share of the scene crop's diagonal."""
    max_tilt_deg: float = setting(10, unit="degree", least=0)
    """Largest angle in degrees between the two up directions, where both are known."""
    recall_weight: float = setting(2, least=0)
    """Beta of the F-beta score: how much more the scene's explained share weighs than the object's."""
    score_fraction: float = setting(0.02, unit="of the diagonal", least=0)
    """Distance within which points agree in the score, as a share of the scene crop's diagonal."""
    candidates: int = setting(24, least=0)
    """Hypotheses that are briefly refined."""
    keep: int = setting(6, least=0)
    """Distinct hypotheses handed to the fine registration."""


@dataclass(frozen=True)
class Hypothesis:
    """One pose and what is known of it."""

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
            "blocked": self.score.blocked,
        }


def register_coarsely(
    *,
    object: Path,
    crop: Path,
    crop_report: Path,
    scale: Path,
    cameras: Path | None = None,
    report: Path,
    recipe: Literal["default", "paper"],
    seed: int,
    settings: CoarseSettings,
) -> None:
    """Find scene_from_object hypotheses of an object of unknown pose and roughly known scale.

    Default: similarity RANSAC on FPFH matches over a pyramid of voxels (method R3, R4, R6) and, where gravity is known
    on both sides, a sweep of yaw, scale and shift by correlation; each is briefly refined and scored both ways (R9).
    Paper: one rigid FPFH RANSAC at the first voxel and the given scale (R5, R7).

    Args:
        object: object cloud (PLY) in the object's own frame and unit.
        crop: scene crop (PLY) in the scene frame.
        crop_report: JSON of the crop stage, for `up_in_scene`.
        scale: JSON of the scale stage.
        cameras: JSON with `up_in_camera_frame`, the up direction in the object's frame; without it, or without
            the key, gravity is not used.
        report: output JSON with `hypotheses`, best first, and the best `scene_from_object`.
        recipe: default or paper.
        seed: of all random choices.
        settings: see CoarseSettings.

    """
    start = time.perf_counter()
    cloud, scene = read_cloud(object), read_cloud(crop)
    prior = read_json(scale)
    scales = ScaleRange(value(prior, "scale"), value(prior, "width_log"))
    ups = known_ups(cameras, crop_report)
    notes: list[str] = []
    if recipe == "paper":
        pose, notes = paper_coarse(
            cloud, scene, scales.centre, settings.voxel_fractions[0], settings.ransac_samples, seed
        )
        obj, target = prepare_both(cloud, scene, scales.centre, settings.score_fraction / 2, seed)
        tau = settings.score_fraction * scene.diagonal
        found = [Hypothesis(pose, "fpfh", score(obj, target, pose, tau, settings.recall_weight, scales.centre))]
    else:
        found = find_hypotheses(cloud, scene, scales, ups, settings, seed)
    if not found:
        notes.append("no feature or heading gave a pose; the clouds' centres were laid on each other instead")
        print(notes[-1], flush=True)
        found = [_centred(cloud, scene, scales, ups, settings, seed)]
    seconds = time.perf_counter() - start
    for h in found:
        print(f"{h.source:8s} scale {h.pose.scale:.4g} score {h.score.total:.3f} F {h.score.f_score:.3f}", flush=True)
    write_json(
        report,
        {
            "scene_from_object": quantity(found[0].pose.matrix, ""),
            "scale": quantity(found[0].pose.scale, "scene units per object unit"),
            "score": quantity(found[0].score.total, "1"),
            "gravity_used": quantity(ups is not None and recipe == "default", ""),
            "recipe": quantity(recipe, ""),
            "hypotheses": quantity([h.as_json() for h in found], ""),
            "notes": quantity(notes, ""),
            "seconds": quantity(seconds, "s"),
        },
    )


def _centred(
    cloud: Cloud,
    scene: Cloud,
    scales: ScaleRange,
    ups: tuple[Array, Array] | None,
    settings: CoarseSettings,
    seed: int,
) -> Hypothesis:
    """The clouds' centres on each other, upright where gravity is known: a last resort that the gate has to judge."""
    rotation = np.eye(3) if ups is None else rotation_between(*ups)
    centre = scene.points.mean(0) - scales.centre * (rotation @ cloud.points.mean(0))
    pose = Sim3(scales.centre, rotation, centre)
    obj, target = prepare_both(cloud, scene, scales.centre, settings.score_fraction / 2, seed)
    tau = settings.score_fraction * scene.diagonal
    return Hypothesis(pose, "centres", score(obj, target, pose, tau, settings.recall_weight, scales.centre))


def prepare_both(
    cloud: Cloud, scene: Cloud, scale: float, fraction: float, seed: int, most: int = MOST_POINTS
) -> tuple[Surface, Surface]:
    """Object and scene thinned alike: `fraction` of the scene's diagonal is one voxel on both sides."""
    voxel = fraction * scene.diagonal
    return prepare(cloud, voxel / scale, seed, most), prepare(scene, voxel, seed, most)


def find_hypotheses(
    cloud: Cloud,
    scene: Cloud,
    scales: ScaleRange,
    ups: tuple[Array, Array] | None,
    settings: CoarseSettings,
    seed: int,
) -> list[Hypothesis]:
    """Distinct hypotheses, best first: features and gravity propose, brief refinement and the score decide."""
    diagonal = scene.diagonal
    tau = settings.score_fraction * diagonal
    obj, target = prepare_both(cloud, scene, scales.centre, settings.score_fraction / 2, seed)
    cell, reach = settings.score_fraction / 2 * diagonal, 0.1 * diagonal
    obj_few = probing(with_grid(obj, cell / scales.centre, reach / scales.centre), SCORE_POINTS, seed)
    target_few = probing(with_grid(target, cell, reach), SCORE_POINTS, seed)

    def rate(pose: Sim3, distance: float) -> Score:
        return score(obj_few, target_few, pose, distance, settings.recall_weight, scales.centre)

    proposed = [(p, "features") for p in _from_features(cloud, scene, scales, ups, settings, seed)]
    if ups is not None:
        level = Sim3(1.0, rotation_between(ups[1], np.array([0.0, 0.0, 1.0])), np.zeros(3))
        sweep_obj, sweep_scene = prepare_both(cloud, scene, scales.centre, settings.sweep_voxel_fraction / 2, seed)
        upright = upright_hypotheses(
            sweep_obj,
            sweep_scene.transformed(level),
            ups[0],
            scales,
            settings.scale_steps,
            settings.yaw_steps,
            settings.sweep_voxel_fraction * diagonal,
            settings.recall_weight,
            settings.candidates // 2,
        )
        proposed += [(level.inverse() @ p, "gravity") for p in upright]
    rated = sorted(((rate(p, 2 * tau).total, k) for k, (p, _) in enumerate(proposed)), key=lambda r: (-r[0], r[1]))
    upright_ones = [k for _, k in rated if proposed[k][1] == "gravity"]
    by_features = [k for _, k in rated if proposed[k][1] == "features"]
    room = settings.candidates - len(upright_ones)
    refined = []
    for k in upright_ones + by_features[:room]:
        pose, source = proposed[k]
        pose = refine_points(obj_few, target_few, pose, scales, (3 * tau, tau), 12)
        refined.append(Hypothesis(pose, source, rate(pose, tau)))
    refined.sort(key=lambda h: -h.score.total)
    return keep_distinct(refined, obj.points.mean(0), diagonal, settings.keep)


def _from_features(
    cloud: Cloud,
    scene: Cloud,
    scales: ScaleRange,
    ups: tuple[Array, Array] | None,
    settings: CoarseSettings,
    seed: int,
) -> list[Sim3]:
    """Similarity RANSAC on mutual FPFH matches at every voxel of the pyramid and every feature scale."""
    found: list[Sim3] = []
    steps = (
        np.linspace(-1, 1, settings.feature_scale_steps) if scales.width and settings.feature_scale_steps > 1 else [0.0]
    )
    for fraction in settings.voxel_fractions:
        voxel = fraction * scene.diagonal
        target = prepare(scene, voxel, seed, MOST_POINTS)
        target_features = fpfh(target, 5 * voxel)
        for step in steps:
            scale = scales.centre * np.exp(scales.width * step)
            obj = prepare(cloud, voxel / scale, seed, MOST_POINTS)
            pairs = match(fpfh(obj, 5 * voxel / scale), target_features)
            found += ransac_similarities(
                obj.points[pairs[:, 0]],
                target.points[pairs[:, 1]],
                scales,
                1.5 * voxel,
                settings.ransac_samples,
                8,
                seed,
                ups,
                settings.max_tilt_deg,
            )
    return found


def keep_distinct(
    ranked: list[Hypothesis], centre: Array, diagonal: float, most: int, angle_deg: float = 8
) -> list[Hypothesis]:
    """Hypotheses in their order, without those that say the same as a better one; see `distinct`."""
    chosen: list[Hypothesis] = []
    for one in ranked:
        if len(chosen) == most:
            break
        if all(distinct(one.pose, other.pose, centre, diagonal, angle_deg) for other in chosen):
            chosen.append(one)
    return chosen


def distinct(a: Sim3, b: Sim3, centre: Array, diagonal: float, angle_deg: float = 8) -> bool:
    """Whether two poses differ by more than an angle, 6 % of scale or 5 % of the diagonal at the object's centre."""
    shift = np.linalg.norm(a.apply(centre) - b.apply(centre))
    turn = rotation_angle_deg(a.rotation @ b.rotation.T)
    return bool(turn > angle_deg or abs(np.log(a.scale / b.scale)) > 0.06 or shift > 0.05 * diagonal)
