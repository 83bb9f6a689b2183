"""Fine registration: every hypothesis refined, turned copies tried, the winner polished, audited and gated."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from scenefuse.clouds import Cloud, read_cloud
from scenefuse.registration.audit import Gate, Verdict, judge, tilt_deg, turned_copies
from scenefuse.registration.coarse import Hypothesis, keep_distinct, known_ups, prepare_both
from scenefuse.registration.paper import paper_fine
from scenefuse.registration.picture import draw_alignment
from scenefuse.registration.refine import ScaleRange, refine_planes, refine_points
from scenefuse.registration.score import Score, score
from scenefuse.registration.surface import Surface, probing
from scenefuse.stage import quantity, read_json, value, write_json
from scenefuse.transforms import Array, Sim3

LOOK_POINTS = 1500
REFINE_POINTS = 3000
BEYOND_PRIOR = 0.15


@dataclass(frozen=True)
class FineSettings:
    """Settings of the fine registration and its gate."""

    fine_voxel_fraction: float
    """Spacing of both clouds, as a share of the scene crop's diagonal."""
    start_fraction: float
    """First pairing distance of the refinement, as a share of the diagonal."""
    end_fraction: float
    """Last pairing distance of the refinement, and that of the polish, as a share of the diagonal."""
    color_weight: float
    """Weight of colours against geometry in the polish; 0 ignores colours there."""
    turn_steps: int
    """Turned copies of the leading poses tried about an axis."""
    recall_weight: float
    """Beta of the F-beta score: how much more the scene's explained share weighs than the object's."""
    score_fraction: float
    """Distance within which points agree in the score, as a share of the diagonal."""
    min_f_score: float
    """Gate: smallest two-way F-score."""
    min_recall: float
    """Gate: smallest share of the scene crop that the object explains."""
    min_color: float
    """Gate: smallest agreement of the colours, where both clouds have colours that vary."""
    min_margin: float
    """Gate: smallest relative lead over the best pose that differs."""
    max_final_tilt_deg: float
    """Gate: largest angle in degrees between the up directions."""


@dataclass(frozen=True)
class Outcome:
    """The refined hypotheses, best first, and the verdict on the first."""

    ranked: list[Hypothesis]
    verdict: Verdict


def register_finely(
    *,
    object: Path,
    crop: Path,
    crop_report: Path,
    scale: Path,
    coarse: Path,
    cameras: Path | None = None,
    fine: Path,
    picture: Path | None = None,
    recipe: Literal["default", "paper"],
    voxel_fraction: float,
    seed: int,
    settings: FineSettings,
) -> None:
    """Refine the coarse hypotheses into one pose, or refuse it with a reason (method R8, R9, R12).

    Default: two-way Tukey-weighted similarity ICP of every hypothesis; turned copies of the leaders; point-to-plane
    and colour polish; ranking by the two-way F-score times the agreement of colours; the gate.
    Paper: point-to-point ICP within 0.4 voxel, 35 iterations, scale held; nothing is refused.

    Args:
        object: object cloud (PLY) in its own frame and unit.
        crop: scene crop (PLY).
        crop_report: JSON of the crop stage, for `up_in_scene`.
        scale: JSON of the scale stage.
        coarse: JSON of the coarse stage.
        cameras: JSON with `up_in_camera_frame`, or nothing.
        fine: output JSON: `status`, `reason`, `scene_from_object`, `scale`, scores, every hypothesis.
        picture: output PNG, the object on the scene crop from three sides.
        recipe: default or paper.
        voxel_fraction: the paper's voxel as a share of the diagonal, for its ICP distance.
        seed: of all random choices.
        settings: see FineSettings.
    """
    start = time.perf_counter()
    cloud, scene = read_cloud(object), read_cloud(crop)
    prior = read_json(scale)
    scales = ScaleRange(value(prior, "scale"), value(prior, "width_log"))
    ups = known_ups(cameras, crop_report)
    poses = [
        (Sim3.from_matrix(np.array(h["scene_from_object"])), h["source"])
        for h in value(read_json(coarse), "hypotheses")
    ]
    if recipe == "paper":
        outcome = _paper(cloud, scene, poses[0][0], scales, voxel_fraction, settings, seed)
    else:
        outcome = refine_hypotheses(cloud, scene, poses, scales, ups, settings, seed)
    best, verdict = outcome.ranked[0], outcome.verdict
    seconds = time.perf_counter() - start
    status = "registered" if verdict.registered else "unregistered"
    print(f"{status}: {verdict.reason}", flush=True)
    if picture is not None:
        draw_alignment(picture, cloud, scene, best.pose, seed)
    unit = "scene units per object unit"
    rival = verdict.rival
    write_json(
        fine,
        {
            "status": quantity(status, ""),
            "reason": quantity(verdict.reason, ""),
            "scene_from_object": quantity(best.pose.matrix, ""),
            "scale": quantity(best.pose.scale, unit),
            "scale_over_prior": quantity(best.pose.scale / scales.centre, "1"),
            "f_score": quantity(best.score.f_score, "1"),
            "precision": quantity(best.score.precision, "1"),
            "recall": quantity(best.score.recall, "1"),
            "color_agreement": quantity(best.score.color, "1"),
            "score": quantity(best.score.total, "1"),
            "margin": quantity(verdict.margin, "1"),
            "free_axis": quantity(verdict.free_axis, ""),
            "tilt_deg": quantity(tilt_deg(best.pose, ups), "degrees"),
            "tau": quantity(settings.score_fraction * scene.diagonal, "scene units"),
            "source": quantity(best.source, ""),
            "rival": quantity(None if rival is None else rival.as_json(), ""),
            "hypotheses": quantity([h.as_json() for h in outcome.ranked], ""),
            "recipe": quantity(recipe, ""),
            "seconds": quantity(seconds, "s"),
        },
    )


def refine_hypotheses(
    cloud: Cloud,
    scene: Cloud,
    poses: list[tuple[Sim3, str]],
    scales: ScaleRange,
    ups: tuple[Array, Array] | None,
    settings: FineSettings,
    seed: int,
) -> Outcome:
    """Refine, turn, polish, rank and judge; see `register_finely`."""
    diagonal = scene.diagonal
    tau = settings.score_fraction * diagonal
    wide, narrow = settings.start_fraction * diagonal, settings.end_fraction * diagonal
    obj, target = prepare_both(cloud, scene, poses[0][0].scale, settings.fine_voxel_fraction, seed)
    looking = probing(obj, LOOK_POINTS, seed), probing(target, LOOK_POINTS, seed)
    # The coarse search stays inside the prior; what it found at a bound may go on beyond it.
    scales = scales.widened(BEYOND_PRIOR)
    asking = probing(obj, REFINE_POINTS, seed), probing(target, REFINE_POINTS, seed)

    def rate(pose: Sim3, surfaces: tuple[Surface, Surface]) -> Score:
        return score(*surfaces, pose, tau, settings.recall_weight)

    def settle(pose: Sim3, source: str, first: float) -> Hypothesis:
        pose = refine_points(*looking, pose, scales, (first, narrow), 25)
        return Hypothesis(pose, source, rate(pose, looking))

    def in_order(hypotheses: list[Hypothesis], angle_deg: float = 8) -> list[Hypothesis]:
        ranked = sorted(hypotheses, key=lambda h: -h.score.total)
        return keep_distinct(ranked, obj.points.mean(0), diagonal, len(ranked), angle_deg)

    def polish(h: Hypothesis) -> Hypothesis:
        planes = refine_planes(*asking, h.pose, scales, narrow, 15, settings.color_weight)
        both = [Hypothesis(pose, h.source, rate(pose, asking)) for pose in (planes, h.pose)]
        return max(both, key=lambda x: x.score.total)

    ranked = in_order([settle(pose, source, wide) for pose, source in poses])
    up_in_scene = None if ups is None else ups[1]
    turned = [c for h in ranked[:2] for c in turned_copies(h.pose, obj, up_in_scene, settings.turn_steps)]
    # A copy counts only as the best of its surroundings: those near a leader would only slide back to it.
    leaders = in_order(ranked[:2] + [Hypothesis(c, "turned", rate(c, looking)) for c in turned], angle_deg=25)
    ranked += [settle(h.pose, "turned", 0.7 * wide) for h in leaders if h.source == "turned"][:6]
    ranked = in_order(ranked)[:8]
    ranked = in_order([polish(h) for h in ranked])
    return Outcome(ranked, judge(ranked, looking[0], diagonal, tau, _gate(settings), scales, ups))


def _paper(
    cloud: Cloud,
    scene: Cloud,
    start: Sim3,
    scales: ScaleRange,
    voxel_fraction: float,
    settings: FineSettings,
    seed: int,
) -> Outcome:
    """The paper's ICP; the score is recorded and nothing is refused."""
    pose = paper_fine(cloud, scene, start, voxel_fraction)
    obj, target = prepare_both(cloud, scene, scales.centre, settings.fine_voxel_fraction, seed)
    rated = score(obj, target, pose, settings.score_fraction * scene.diagonal, settings.recall_weight)
    verdict = Verdict(True, "the paper's recipe has no gate", 0.0, None, False)
    return Outcome([Hypothesis(pose, "fpfh", rated)], verdict)


def _gate(settings: FineSettings) -> Gate:
    return Gate(
        settings.min_f_score,
        settings.min_recall,
        settings.min_color,
        settings.min_margin,
        settings.max_final_tilt_deg,
    )
