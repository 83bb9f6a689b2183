"""Fine registration: every hypothesis refined, turned copies tried, the winner polished, audited and gated."""

import time
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scenefuse.io.clouds import Cloud, read_cloud
from scenefuse.registration.coarse import Hypothesis, keep_distinct, prepare_both
from scenefuse.registration.evidence import Alignment, Evidence, known_ups, read_alignment
from scenefuse.registration.free_space import read_free_space
from scenefuse.registration.paper import paper_fine
from scenefuse.registration.picture import draw_alignment
from scenefuse.registration.refine import ScaleRange, Uncertainty, refine_planes, refine_points, uncertainty
from scenefuse.registration.score import Score, score
from scenefuse.registration.surface import Surface, probing, with_grid
from scenefuse.registration.verify import Decision, Gate, decide, tilt_deg, turned_copies
from scenefuse.stage import quantity, read_json, setting, value, write_json
from scenefuse.transforms import Array, Sim3

MOST_POINTS = 12000
LOOK_POINTS = 1200
REFINE_POINTS = 3000
POLISHED = 4
ROUNDS = 60
OFF_SCALE = 1.06
BEYOND_PRIOR = 0.15
ASTRAY = 0.9


@dataclass(frozen=True)
class FineSettings:
    """Settings of the fine registration and its gate."""

    fine_voxel_fraction: float = setting(0.0075, unit="of the diagonal", least=0)
    """Spacing of both clouds, as a share of the scene crop's diagonal."""
    start_fraction: float = setting(0.05, unit="of the diagonal", least=0)
    """First pairing distance of the refinement, as a share of the diagonal."""
    end_fraction: float = setting(0.02, unit="of the diagonal", least=0)
    """Last pairing distance of the refinement, and that of the polish, as a share of the diagonal."""
    color_weight: float = setting(0.3, least=0)
    """Weight of colours against geometry in the polish; 0 ignores colours there."""
    turn_steps: int = setting(24, least=0)
    """Turned copies of the leading poses tried about an axis."""
    recall_weight: float = setting(2, least=0)
    """Beta of the F-beta score: how much more the scene's explained share weighs than the object's."""
    score_fraction: float = setting(0.02, unit="of the diagonal", least=0)
    """Distance within which points agree in the score, as a share of the diagonal."""
    min_f_score: float = setting(0.35, least=0)
    """Gate: smallest two-way F-score."""
    min_recall: float = setting(0.4, least=0)
    """Gate: smallest share of the scene crop that the object explains."""
    min_color: float = setting(0.5, least=0)
    """Gate: smallest agreement of the colours, where both clouds have colours that vary."""
    min_margin: float = setting(0.04, least=0)
    """Gate: smallest relative lead over the best pose that differs."""
    max_final_tilt_deg: float = setting(8, unit="degree", least=0)
    """Gate: largest angle in degrees between the up directions."""
    use_alignment: bool = setting(True)
    """Whether the photos' similarity (the alignment) is compared with the clouds' and overrules it."""
    free_space_photos: int = setting(12, least=0)
    """Photos of the scene whose depth maps are asked what they saw through; 0 leaves the test out."""
    free_space_fraction: float = setting(0.03, unit="of the diagonal", least=0)
    """A measurement this far beyond a point of the object, as a share of the diagonal, proves it is not there."""
    max_blocked: float = setting(0.25, least=0)
    """Gate: largest share of the object that stands where the scene's photos saw through."""
    resamplings: int = setting(8, least=2)
    """Halves of the surface that are registered again for the spread of the pose."""
    max_translation_sd_fraction: float = setting(0.005, unit="of the diagonal", least=0)
    """Gate: largest standard deviation of the object's centre, as a share of the diagonal."""
    max_scale_sd_log: float = setting(0.01, least=0)
    """Gate: largest standard deviation of the scale, natural logarithm."""
    max_rotation_sd_deg: float = setting(1, unit="degree", least=0)
    """Gate: largest standard deviation of the rotation, degrees, but about a free axis."""


@dataclass(frozen=True)
class Outcome:
    """The refined hypotheses, best first, the decision on the first, and its spread."""

    ranked: list[Hypothesis]
    decision: Decision
    spread: Uncertainty | None


def register_finely(
    *,
    object: Path,
    crop: Path,
    crop_report: Path,
    scale: Path,
    coarse: Path,
    cameras: Path | None = None,
    alignment: Path | None = None,
    workspace: Path | None = None,
    depth: list[Path] | None = None,
    fine: Path,
    picture: Path | None = None,
    recipe: Literal["default", "paper"],
    voxel_fraction: float,
    seed: int,
    settings: FineSettings,
) -> None:
    """Refine the coarse hypotheses into one pose, or refuse it with a reason (method R8, R9, R12).

    Default: two-way Tukey-weighted similarity ICP of every hypothesis; turned copies of the leaders; point-to-plane
    and colour polish; ranking by the two-way F-score, the agreement of colours and the free space; comparison with
    the photos' similarity, which overrules geometry where they differ; the spread over halves of the surface; the gate.
    Paper: point-to-point ICP within 0.4 voxel, 35 iterations, scale held; nothing is refused.

    Args:
        object: object cloud (PLY) in its own frame and unit.
        crop: scene crop (PLY).
        crop_report: JSON of the crop stage, for `up_in_scene` and the unit of lengths.
        scale: JSON of the scale stage.
        coarse: JSON of the coarse stage.
        cameras: JSON with `up_in_camera_frame`, or nothing.
        alignment: JSON of the alignment stage, or nothing.
        workspace: undistorted COLMAP workspace of the scene, or nothing; with `depth` it gives the free space.
        depth: folders of the scene's depth maps.
        fine: output JSON: `status`, `reason`, `scene_from_object`, `scale`, scores, `scale_ledger`, every hypothesis.
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
    free_space = None
    if recipe == "default" and workspace is not None and settings.free_space_photos > 0:
        tolerance = settings.free_space_fraction * scene.diagonal
        free_space = read_free_space(workspace, depth or [], scene.points, settings.free_space_photos, tolerance)
    photos = read_alignment(alignment) if settings.use_alignment else None
    evidence = Evidence(known_ups(cameras, crop_report), free_space, photos)
    poses = [
        (Sim3.from_matrix(np.array(h["scene_from_object"])), h["source"])
        for h in value(read_json(coarse), "hypotheses")
    ]
    if recipe == "paper":
        outcome = _paper(cloud, scene, poses[0][0], scales, voxel_fraction, settings, seed)
    else:
        outcome = refine_hypotheses(cloud, scene, poses, scales, evidence, settings, seed)
    best, decision = outcome.ranked[0], outcome.decision
    seconds = time.perf_counter() - start
    status = "registered" if decision.registered else "unregistered"
    print(f"{status}: {decision.reason}", flush=True)
    if picture is not None:
        draw_alignment(picture, cloud, scene, best.pose, seed)
    length = read_json(crop_report)["diagonal"]["unit"]
    unit = "scene units per object unit"
    rival = decision.rival
    write_json(
        fine,
        {
            "status": quantity(status, ""),
            "reason": quantity(decision.reason, ""),
            "scene_from_object": quantity(best.pose.matrix, ""),
            "scale": quantity(best.pose.scale, unit),
            "scale_over_prior": quantity(best.pose.scale / scales.centre, "1"),
            "f_score": quantity(best.score.f_score, "1"),
            "precision": quantity(best.score.precision, "1"),
            "recall": quantity(best.score.recall, "1"),
            "color_agreement": quantity(best.score.color, "1"),
            "score": quantity(best.score.total, "1"),
            "decided_by": quantity(decision.decided_by, ""),
            "margin": quantity(decision.margin, "1"),
            "free_axis": quantity(decision.free_axis, ""),
            "blocked": quantity(best.score.blocked, "1"),
            "tilt_deg": quantity(tilt_deg(best.pose, evidence.ups), "degrees"),
            **spread_quantities(outcome.spread, length),
            "scale_ledger": quantity(scale_ledger(prior, evidence.alignment, best, outcome.spread, decision), ""),
            "tau": quantity(settings.score_fraction * scene.diagonal, length),
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
    evidence: Evidence,
    settings: FineSettings,
    seed: int,
) -> Outcome:
    """Refine, turn, polish, rank, compare with the photos and judge; see `register_finely`."""
    pair = _Pair.prepare(cloud, scene, poses[0][0].scale, scales, evidence, settings, seed)
    ranked = pair.in_order([pair.settle(pose, source, pair.wide) for pose, source in poses])
    ranked = pair.in_order([*ranked, *pair.turned(ranked[:2])])
    ranked = pair.in_order([pair.polish(h) for h in ranked[:POLISHED]])
    # A valley that is flat in scale has several ends; start from both sides.
    sides = (pair.polish(pair.resized(ranked[0], factor)) for factor in (1 / OFF_SCALE, OFF_SCALE))
    ranked = pair.in_order([*ranked, *sides])
    ranked, spread, decided_by = pair.with_photos(ranked)
    gate = Gate(**{field.name: getattr(settings, field.name) for field in fields(Gate)})
    looks = probing(pair.obj, LOOK_POINTS, seed)
    decision = decide(ranked, looks, pair.diagonal, pair.tau, gate, pair.scales, evidence.ups, spread, decided_by)
    return Outcome(ranked, decision, spread)


@dataclass(frozen=True)
class _Pair:
    """Both clouds, prepared once, and what is done with a pose on them.

    Attributes:
        obj: the object's surface, thinned.
        searched: object and scene with few probing points and distance grids, for the first refinement and ranking.
        scored: the same with more points, for the polish and the final score.
        coarser: both at twice the spacing, for the spread.
        diagonal: of the scene crop.
        scales: what the scale may be: the coarse search stays inside the prior, what it found at a bound may go on.
        evidence: gravity, free space and photos.
        settings: of the fine registration.
        seed: of the spread's halves.
    """

    obj: Surface
    searched: tuple[Surface, Surface]
    scored: tuple[Surface, Surface]
    coarser: tuple[Surface, Surface]
    diagonal: float
    scales: ScaleRange
    evidence: Evidence
    settings: FineSettings
    seed: int

    @staticmethod
    def prepare(
        cloud: Cloud,
        scene: Cloud,
        scale: float,
        scales: ScaleRange,
        evidence: Evidence,
        settings: FineSettings,
        seed: int,
    ) -> "_Pair":
        """Thin and index both clouds for poses of about this scale."""
        diagonal, fraction = scene.diagonal, settings.fine_voxel_fraction
        obj, target = prepare_both(cloud, scene, scale, fraction, seed, MOST_POINTS)
        cell, reach = 2 * fraction * diagonal, 2 * settings.start_fraction * diagonal
        searched = (
            probing(with_grid(obj, cell / scale, reach / scale), LOOK_POINTS, seed),
            probing(with_grid(target, cell, reach), LOOK_POINTS, seed),
        )
        scored = probing(obj, REFINE_POINTS, seed), probing(target, REFINE_POINTS, seed)
        coarser = prepare_both(cloud, scene, scale, 2 * fraction, seed, MOST_POINTS)
        scales = scales.widened(BEYOND_PRIOR)
        return _Pair(obj, searched, scored, coarser, diagonal, scales, evidence, settings, seed)

    @property
    def centre(self) -> Array:
        """(3,) centre of the object, in its own frame."""
        return self.obj.points.mean(0)

    @property
    def tau(self) -> float:
        """Distance within which points agree, scene units."""
        return self.settings.score_fraction * self.diagonal

    @property
    def wide(self) -> float:
        """First pairing distance, scene units."""
        return self.settings.start_fraction * self.diagonal

    @property
    def narrow(self) -> float:
        """Last pairing distance, scene units."""
        return self.settings.end_fraction * self.diagonal

    def rate(self, pose: Sim3, surfaces: tuple[Surface, Surface]) -> Score:
        """How well a pose explains both clouds."""
        recall_weight = self.settings.recall_weight
        return score(*surfaces, pose, self.tau, recall_weight, self.scales.centre, self.evidence.free_space)

    def in_order(self, hypotheses: list[Hypothesis], angle_deg: float = 8) -> list[Hypothesis]:
        """Best first, one of each valley."""
        ranked = sorted(hypotheses, key=lambda h: -h.score.total)
        return keep_distinct(ranked, self.centre, self.diagonal, len(ranked), angle_deg)

    def settle(self, pose: Sim3, source: str, first: float) -> Hypothesis:
        """The bottom of the valley that a pose lies in, by point pairs within `first`, scene units, and ever less."""
        pose = refine_points(*self.searched, pose, self.scales, (first, self.narrow), 25)
        return Hypothesis(pose, source, self.rate(pose, self.searched))

    def turned(self, leaders: list[Hypothesis]) -> list[Hypothesis]:
        """The best of the leaders' turned copies, settled."""
        up = None if self.evidence.ups is None else self.evidence.ups[1]
        copies = [c for h in leaders for c in turned_copies(h.pose, self.obj, up, self.settings.turn_steps)]
        rated = [Hypothesis(c, "turned", self.rate(c, self.searched)) for c in copies]
        # A copy counts only as the best of its surroundings: those near a leader would only slide back to it.
        best = [h for h in self.in_order(leaders + rated, angle_deg=25) if h.source == "turned"]
        return [self.settle(h.pose, "turned", 0.7 * self.wide) for h in best[:6]]

    def polish(self, h: Hypothesis) -> Hypothesis:
        """The hypothesis after the last refinement, by planes and colours."""
        color_weight = self.settings.color_weight
        planes = refine_planes(*self.scored, h.pose, self.scales, self.narrow, ROUNDS, color_weight)
        polished, before = (Hypothesis(p, h.source, self.rate(p, self.scored)) for p in (planes, h.pose))
        # The score is too coarse to choose between two poses in one valley; it only tells that a polish went astray.
        return polished if polished.score.total > ASTRAY * before.score.total else before

    def resized(self, h: Hypothesis, factor: float) -> Hypothesis:
        """The hypothesis with the object grown about its centre."""
        fixed = h.pose.apply(self.centre)
        grown = Sim3(factor, np.eye(3), (1 - factor) * fixed) @ h.pose
        return Hypothesis(grown, h.source, self.rate(grown, self.scored))

    def spread(self, h: Hypothesis) -> Uncertainty | None:
        """How far the pose moves when halves of the surface are left out."""
        both, settings = [self.scored, self.coarser], self.settings
        color_weight, resamplings = settings.color_weight, settings.resamplings
        return uncertainty(both, h.pose, self.scales, self.narrow, color_weight, resamplings, self.seed)

    def with_photos(
        self, ranked: list[Hypothesis]
    ) -> tuple[list[Hypothesis], Uncertainty | None, Literal["geometry", "photos", "both"]]:
        """The ranking after the photos' word, the spread of its first, and who decided.

        Where clouds and photos are in one valley, the surer of them has the last word, and clouds cannot leave it. The
        worse the clouds lie on each other at the photos' pose, the surer the photos must be.
        """
        alignment = self.evidence.alignment
        if alignment is None:
            return ranked, self.spread(ranked[0]), "geometry"
        agree = alignment.agrees(ranked[0].pose, self.centre, self.diagonal)
        if not agree:
            ranked = [self.polish(self.settle(alignment.pose, "photos", self.narrow)), *ranked]
        spread = self.spread(ranked[0])
        strays = not alignment.agrees(ranked[0].pose, self.centre, self.diagonal)
        by_photos = Hypothesis(alignment.pose, "photos", self.rate(alignment.pose, self.scored))
        worth = min(1.0, by_photos.score.total / max(ranked[0].score.total, 1e-12))
        if strays or spread is None or alignment.spread.size(self.diagonal) < worth * spread.size(self.diagonal):
            ranked, spread = [by_photos, *ranked], alignment.spread
        return ranked, spread, "both" if agree else "photos"


def spread_quantities(spread: Uncertainty | None, unit: str) -> dict[str, Any]:
    """A pose's spread as a stage JSON holds it; null where it is not known."""
    return {
        "scale_sd_log": quantity(None if spread is None else spread.scale_sd_log, "1"),
        "rotation_sd_deg": quantity(None if spread is None else spread.rotation_sd_deg, "degrees"),
        "translation_sd": quantity(None if spread is None else spread.translation_sd, unit),
        "covariance": quantity(None if spread is None else spread.covariance, f"radians, {unit}, log scale"),
    }


def scale_ledger(
    prior: dict[str, Any], alignment: Alignment | None, best: Hypothesis, spread: Uncertainty | None, decision: Decision
) -> list[dict[str, Any]]:
    """Every estimate of the scale with its spread (log), what it was used for, which one won and why.

    The estimates of extent have no spread of their own: what one side lacks biases them, so they only centre a prior.
    """
    rows = [
        {"name": e["name"], "scale": e["scale"], "sd_log": None, "use": "centres the prior" if e["used"] else "none"}
        for e in value(prior, "ledger")
    ]
    agree = {"both": ", and the clouds agree", "photos": "; the clouds' best fit is another pose"}
    why = "the clouds' best fit inside the prior" + {"both": ", and the photos agree"}.get(decision.decided_by, "")
    by_photos = alignment is not None and best.pose is alignment.pose
    if alignment is not None:
        use = f"won: surer than the clouds{agree[decision.decided_by]}" if by_photos else "confirms"
        sd = alignment.spread.scale_sd_log
        rows.append({"name": "shared points", "scale": alignment.pose.scale, "sd_log": sd, "use": use})
        if alignment.scale_from_centres is not None:
            rows.append(
                {"name": "camera centres", "scale": alignment.scale_from_centres, "sd_log": None, "use": "none"}
            )
    if not by_photos:
        own = None if spread is None else spread.scale_sd_log
        rows.append({"name": "clouds", "scale": best.pose.scale, "sd_log": own, "use": f"won: {why}"})
    return rows


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
    obj, target = prepare_both(cloud, scene, scales.centre, settings.fine_voxel_fraction, seed, MOST_POINTS)
    rated = score(obj, target, pose, settings.score_fraction * scene.diagonal, settings.recall_weight, scales.centre)
    decision = Decision(True, "the paper's recipe has no gate", "geometry", 0.0, None, None)
    return Outcome([Hypothesis(pose, "fpfh", rated)], decision, None)
