"""The rules of registration by clouds, on planted trials: the pose is right, refused, or wrong and accepted.

Trials are of four kinds in turn: with all evidence, by shape alone (no gravity, colours or depth maps), with all
evidence where the scene shows more, and another object's scene, in which every pose is wrong. After these come mirrored
objects, of which every pose is wrong, too; at the end, without colours, buildings whose scene has another one of the
same footprint.
"""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from registration import ROTATION_DEG, SCALE_PCT, SHIFT, mirrored, planted
from rules import Rule, without
from support.planted import SHAPES, errors, plant

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import Sim3, Uncertainty
from scenefuse.geometry.surface import Pairs
from scenefuse.register import decision, refinement
from scenefuse.register.coarse import CoarseSettings, find_hypotheses
from scenefuse.register.decision import FineSettings
from scenefuse.register.problem import Constraints, Problem, ScaleSettings, estimates, prior
from scenefuse.register.score import Hypothesis

UP = np.array([0.0, 0.0, 1.0])
NAMES = list(SHAPES)
KINDS = ("all evidence, 30 % shown", "shape alone, 70 % shown", "all evidence, 50 % shown", "absent")
MIRRORED = "mirrored"
DECOY = "another building of the same footprint, no colours"
DECOYS = (
    ("gable", "flat"), ("gable", "flat, lower"), ("gable", "flat, higher"),
    ("gable, porch, chimney", "flat"), ("gable, porch, chimney", "flat, porch"),
    ("gable, porch, chimney", "gable, porch, chimney, higher"),
    ("gable, porch, chimney", "gable, annex, other chimney"), ("gable, annex, chimney", "flat, annex"),
)  # fmt: skip
FIRST_DECOY = (len(KINDS) + 1) * len(NAMES)
TRIALS = FIRST_DECOY + 6 * len(DECOYS)
# Less work than by default, so that many rules can be tried.
COARSE = CoarseSettings(ransac_samples=10000, scale_steps=9, yaw_steps=16, candidates=12, keep=4)
LITTLE: dict[str, Any] = {"voxel_fraction": 0.012, "turn_steps": 12}
R, G = "scenefuse.register", "scenefuse.geometry"
# Rules of these modules leave the candidates as they are.
AFTER_CANDIDATES = (
    *(f"{R}.{name}." for name in ("refinement", "likelihood", "uncertainty", "repetition", "decision")),
    f"{G}.icp._without_overhang", f"{G}.icp.POINT_WEIGHT",
)  # fmt: skip


@cache
def trial_of(number: int) -> tuple[Any, Cloud, str]:
    """A planted trial, its crop, and its kind."""
    if number >= FIRST_DECOY:
        names, seed = DECOYS[(number - FIRST_DECOY) % len(DECOYS)], 1 + (number - FIRST_DECOY) // len(DECOYS)
        plain = {"ground": False, "depth_maps": False, "object_points": 9000, "density_ratio": 1.0}
        trial, other = (plant(name, seed + 50 * k, **plain) for k, name in enumerate(names))
        return replace(trial, object=replace(trial.object, colors=None)), replace(other.scene, colors=None), DECOY
    kind, repeat = KINDS[number % len(KINDS)], number // len(KINDS)
    if repeat >= len(NAMES):
        kind, repeat = MIRRORED, number % len(NAMES)
    coverage = {KINDS[0]: 0.3, KINDS[1]: 0.7, KINDS[2]: 0.5, KINDS[3]: 0.7, MIRRORED: 0.7}[kind]
    trial, scene, _ = planted(_name(number), coverage, repeat)
    if kind == MIRRORED:
        trial = mirrored(trial)
    if kind == KINDS[3]:
        other, scene, _ = planted(NAMES[(repeat + 3) % len(NAMES)], coverage, repeat)
        trial = replace(trial, free_space=other.free_space)
    return trial, scene, kind


def _name(number: int) -> str:
    """The shape of a trial."""
    if number >= FIRST_DECOY:
        return DECOYS[(number - FIRST_DECOY) % len(DECOYS)][0]
    return NAMES[number // len(KINDS)] if number < len(KINDS) * len(NAMES) else NAMES[number % len(NAMES)]


def evaluate(number: int, rule: Rule | None) -> dict[str, Any]:
    """Register one trial. The gate alone is decided again on the pose found with all rules."""
    if rule is not None and rule.name.startswith("gate"):
        row, (ranked, uncertainty, decided_by, shape, problem, _, repetition) = _registered(number)
        found = decision.decide(ranked, uncertainty, decided_by, shape, problem, FineSettings(**LITTLE), repetition)
        return row | _counts(bool(row["found"]), found.registered) | {"reason": found.reason}
    later = rule is not None and rule.where.startswith(AFTER_CANDIDATES)
    return _outcome(number, _candidates(number) if later else _searched(number))[0]


def _searched(number: int) -> list[Hypothesis]:
    return find_hypotheses(_problem(number), COARSE)


def _problem(number: int) -> Problem:
    trial, scene, kind = trial_of(number)
    cloud, evidence = trial.object, Constraints((trial.up_in_object, UP), trial.free_space)
    if kind == KINDS[1]:
        cloud, scene, evidence = Cloud(cloud.points, cloud.normals), Cloud(scene.points, scene.normals), Constraints()
    scales = prior(estimates(cloud, scene, evidence.ups), ScaleSettings())
    return Problem(cloud, scene, scales, evidence)


@cache
def _candidates(number: int) -> list[Hypothesis]:
    """With all rules; only rules of what follows are switched off around this."""
    return _searched(number)


@cache
def _registered(number: int) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """With all rules, and what the gate was given."""
    return _outcome(number, _candidates(number))


def _outcome(number: int, found: list[Hypothesis]) -> tuple[dict[str, Any], tuple[Any, ...]]:
    """What the fine registration of candidates gives, and what its gate was given."""
    given: list[tuple[Any, ...]] = []

    def gate(*args: Any) -> decision.Decision:
        given.append(args)
        return decision.decide(*args)

    starts = [(h.pose, h.source) for h in found]
    with without(Rule("", f"{R}.refinement.decide", lambda _: gate)):
        outcome = refinement.refine_hypotheses(_problem(number), starts, FineSettings(**LITTLE)) if starts else None
    if outcome is None:
        return _measured(number, False, False, "no hypothesis"), ()
    return _rated(number, outcome.ranked[0].pose, outcome.stated, outcome.decision), given[0]


def _rated(number: int, pose: Sim3, stated: Uncertainty | None, found: decision.Decision) -> dict[str, Any]:
    """A pose and its decision beside the truth."""
    trial, _, kind = trial_of(number)
    axis = UP if _name(number) in SHAPES and SHAPES[_name(number)].round else trial.axis
    scale, angle, shift = errors(pose, trial.scene_from_object, trial.object.points.mean(0), trial.diagonal, axis)
    if kind in (KINDS[3], MIRRORED, DECOY) or abs(scale) > SCALE_PCT or angle > ROTATION_DEG or shift > SHIFT:
        return _measured(number, False, found.registered, found.reason)
    over = np.nan if stated is None else abs(np.log(1 + scale / 100)) / max(stated.scale_sd_log, 1e-9)
    return _measured(number, True, found.registered, found.reason, abs(scale), angle, 100 * shift, over)


def _measured(number: int, right: bool, accepted: bool, reason: str, *numbers: float) -> dict[str, Any]:
    names = ("scale_pct", "rotation_deg", "shift_pct", "scale_over_sd")
    return {
        "kind": trial_of(number)[2],
        **_counts(right, accepted),
        **dict(zip(names, numbers or (np.nan,) * 4)),
        "reason": reason,
    }


def _counts(right: bool, accepted: bool) -> dict[str, int]:
    counts = {"right": right and accepted, "refused": not accepted, "wrong": accepted and not right, "found": right}
    return {name: int(count) for name, count in counts.items()}


def nothing(_: Any) -> Any:
    """In the place of a function that proposes something."""
    return lambda *args, **kwargs: []


def constant(value: Any) -> Any:
    """In the place of a number."""
    return lambda _: value


def same(_: Any) -> Any:
    """In the place of a function that changes its only argument."""
    return lambda x: x


def _even(_: Any) -> Any:
    """No Tukey weights: each direction sums to a half."""

    def weights(pairs: Pairs, tau: float) -> Any:
        ahead, count = pairs.forward, len(pairs.distance)
        return np.where(np.arange(count) < ahead, 0.5 / max(ahead, 1), 0.5 / max(count - ahead, 1))

    return weights


def _own_area(score: Any) -> Any:
    """Precision as a share of the object's own area."""
    return lambda obj, scene, pose, tau, usual, free_space=None: score(obj, scene, pose, tau, pose.scale, free_space)


def _blind(score: Any) -> Any:
    """A score that knows no free space."""

    def blind(obj: Any, scene: Any, pose: Sim3, tau: float, usual: float, free_space: Any = None) -> Any:
        found = score(obj, scene, pose, tau, usual)
        if free_space is None:
            return found
        return replace(found, free_space_violation=free_space.violation(pose.apply(obj.points[obj.queries])))

    return blind


def _median(prior_of: Any) -> Any:
    """The prior about the median of the estimates."""

    def about(ledger: Any, settings: ScaleSettings) -> Any:
        found = prior_of(ledger, settings)
        return replace(found, centre=float(np.exp(np.median([np.log(e.scale) for e in ledger if e.used]))))

    return about


def _extent_only(estimates_of: Any) -> Any:
    """Only the RMS of the evened clouds."""
    return lambda *args: estimates_of(*args)[:2]


def _setting(**changed: float) -> Any:
    """Another value of a setting of the gate."""
    return lambda settings: lambda **own: replace(settings(**own), **changed)


HERE = __name__
RULES = [
    # The scale.
    Rule("prior: upper quartile of the estimates", f"{HERE}.prior", _median),
    Rule("prior: footprint, height and hull beside the RMS", f"{HERE}.estimates", _extent_only),
    Rule("refinement may leave the prior by 0.15", f"{R}.refinement.PRIOR_SLACK_LOG", constant(0.0)),
    # Candidates.
    Rule("coarse: sweep of headings", f"{R}.coarse._upright", nothing),
    Rule("coarse: features", f"{R}.coarse._from_features", nothing),
    Rule("RANSAC: edges agree on one scale", f"{R}.coarse.triples_of_one_scale",
         lambda f: lambda *known: f(*known, 0.0)),
    Rule("sweep: blurred target", f"{R}.coarse._blur", same),
    # Refinement.
    Rule("refine: turned copies", f"{R}.refinement._Work.turned", nothing),
    Rule("refine: repetition", f"{R}.refinement.shifts_onto_itself", nothing),
    # ICP.
    Rule("ICP: no pairs beyond the rim", f"{G}.icp._without_overhang", lambda _: lambda *args: args[-1]),
    Rule("ICP: point rows beside planes", f"{G}.icp.POINT_WEIGHT", constant(0.0)),
    Rule("ICP: colour rows", f"{R}.refinement.refine_planes", lambda f: partial(f, color_weight=0.0)),
    Rule("ICP: Tukey weights", f"{G}.icp._two_way_weights", _even),
    # The most likely pose.
    Rule("most likely pose", f"{R}.refinement.certified", lambda _: lambda *args: None),
    Rule("most likely pose: corrected by planted copies", f"{R}.likelihood._off_on_copies",
         lambda f: lambda *args: 0 * f(*args)),
    # The uncertainty.
    Rule("uncertainty: what surfaces have wrong alike", f"{R}.uncertainty.COMMON_ERROR", constant(0.0)),
    # The score.
    Rule("score: recall weighs more", f"{R}.score.RECALL_WEIGHT", constant(1.0)),
    Rule("score: area at the usual scale", f"{R}.refinement.score", _own_area),
    Rule("score: colours", f"{R}.score.color_agreement", lambda _: lambda *args: None),
    Rule("score: free space", f"{R}.refinement.score", _blind),
    Rule("score: displaced surfaces", f"{R}.refinement.displaced_share", lambda _: lambda *args: None),
    # The gate.
    Rule("gate: F-score", f"{HERE}.FineSettings", _setting(min_f_score=0.0)),
    Rule("gate: recall", f"{R}.decision.MIN_RECALL", constant(0.0)),
    Rule("gate: colours", f"{R}.decision.MIN_COLOR", constant(0.0)),
    Rule("gate: tilt", f"{R}.decision.MAX_TILT_DEG", constant(180.0)),
    Rule("gate: free space", f"{R}.decision.MAX_CONTRADICTED", constant(1.0)),
    Rule("gate: margin", f"{HERE}.FineSettings", _setting(min_margin=0.0)),
    Rule("gate: uncertain scale", f"{HERE}.FineSettings", _setting(max_scale_sd_log=9.0)),
    Rule("gate: uncertain rotation", f"{HERE}.FineSettings", _setting(max_rotation_sd_deg=360.0)),
    Rule("gate: uncertain position", f"{HERE}.FineSettings", _setting(max_translation_sd_fraction=9.0)),
    Rule("gate: scale at the prior's edge", f"{G}.icp.ScaleRange.at_edge", lambda _: lambda *args: False),
    Rule("gate: rivals that turn onto itself", f"{R}.decision._turns_onto_itself", lambda _: lambda *args: False),
]  # fmt: skip
