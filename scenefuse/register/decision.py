"""May a pose be used? The margin to the best rival, and the gate (method R12)."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from scenefuse.core.stage import setting
from scenefuse.core.transforms import Array, Sim3, Uncertainty, rotation_angle_deg
from scenefuse.geometry.surface import SCORE_FRACTION, Surface, ends_of
from scenefuse.georef.placement import MAX_BENT
from scenefuse.register.problem import Problem
from scenefuse.register.score import (
    DISTINCT_ANGLE_DEG,
    DISTINCT_SHIFT,
    MIN_MARGIN,
    Hypothesis,
    color_agreement,
    distinct,
    lead,
    pair,
)

DecidedBy = Literal["geometry", "near", "photos", "both"]

# Fixed thresholds of the gate, which right poses of the planted trials pass with room to spare; FineSettings has those
# that can be set. Least share of the scene crop that the object explains.
MIN_RECALL = 0.4
# The agreement of the colours, where both clouds have colours that vary.
MIN_COLOR = 0.5
# The angle between the up directions: beyond that the pose is another one.
MAX_TILT_DEG = DISTINCT_ANGLE_DEG
# The share of the object in the scene's free space, and of the places that both clouds show at different depths.
MAX_CONTRADICTED = 0.25
# A motion maps an object onto itself when its colours agree as much, beside the share of its points that meet others.
MIN_SELF_COLOR = 0.9


@dataclass(frozen=True)
class FineSettings:
    """Settings of the fine registration: its gate, and how thoroughly it searches."""

    min_f_score: float = 0.35
    """Gate: smallest two-way F-score."""
    min_margin: float = MIN_MARGIN
    """Gate: smallest relative lead of the score over the best pose that differs."""
    max_scale_sd_log: float = setting(0.01, least=0)
    """Gate: largest standard deviation of the scale, natural logarithm."""
    max_rotation_sd_deg: float = setting(1, unit="deg", least=0)
    """Gate: largest standard deviation of the rotation about any axis; about a free axis it may be more."""
    max_translation_sd_fraction: float = setting(0.005, least=0)
    """Gate: largest standard deviation of the object's centre, as a share of the scene crop's diagonal."""
    use_alignment: bool = True
    """Whether the alignment from shared features is compared with the clouds' pose and can replace it."""
    voxel_fraction: float = 0.0075
    """Spacing of both clouds, as a share of the scene crop's diagonal."""
    score_fraction: float = SCORE_FRACTION
    """Distance within which points agree in the score, as a share of the diagonal."""
    turn_steps: int = 24
    """Turned copies of the leading poses tried about an axis."""


@dataclass(frozen=True)
class Repetition:
    """What an object's repetition leaves open; as it is for one that does not repeat itself.

    Attributes:
        same_shift: poses whose shift differs by less are one, as a share of the diagonal.
        undecided: period, scene units, by which the object can be shifted and fits what both show as well; or None.
    """

    same_shift: float = DISTINCT_SHIFT
    undecided: float | None = None


@dataclass(frozen=True)
class Decision:
    """Whether a pose may be used, and why.

    Attributes:
        registered: whether the pose may be used.
        reason: one sentence why.
        decided_by: `geometry`, `near` (the clouds' pose, close to an alignment that the scene's photos rule out),
            `photos` (the alignment from shared features replaced the clouds' pose) or `both` (they agree).
        margin: `lead` over the best rival; 1 without one.
        rival: the best pose that differs and would leave the object elsewhere, or None.
        free_axis: unit vector (3,) in the scene about which the object can turn and stay the same, or None.
    """

    registered: bool
    reason: str
    decided_by: DecidedBy
    margin: float
    rival: Hypothesis | None
    free_axis: Array | None


def decide(
    ranked: list[Hypothesis],
    uncertainty: Uncertainty | None,
    decided_by: DecidedBy,
    obj: Surface,
    problem: Problem,
    settings: FineSettings,
    repetition: Repetition = Repetition(),
) -> Decision:
    """Compare the best hypothesis with its rivals and with the gate.

    A pose that only turns the object onto itself, in shape and colour, is no rival: fused, both give the same points.
    Shared photos settle which pose is meant, so that rivals, colours and scores no longer matter: the scene may lack
    nearly all of the object, or show much beside it. Free space, gravity and the pose's own uncertainty still count:
    `registered` means the same tolerances whatever decided.

    Args:
        ranked: refined hypotheses, best first; the alignment's own pose first where it replaced the clouds'.
        uncertainty: of the best pose.
        decided_by: see Decision.
        obj: the object in its own frame.
        problem: the clouds, the scale prior (a scale at its edge is rejected) and what else is known.
        settings: the gate.
        repetition: of the object.
    """
    best, rest = ranked[0], ranked[1:]
    rivals, free_axis = _rivals(best, rest, obj, problem.scene.diagonal, settings, repetition.same_shift)
    if uncertainty is not None and uncertainty.rotation_sd_deg > settings.max_rotation_sd_deg:
        # A column that can be turned over as well: which of its poses are found is chance, what leaves it open is not.
        turn = _turned_about(best.pose, uncertainty.rotation_axis, obj.points.mean(0))
        if _turns_onto_itself(obj, turn, settings.score_fraction * problem.scene.diagonal / best.pose.scale):
            free_axis = uncertainty.rotation_axis
    rival = rivals[0] if rivals else None
    # The alignment's pose may score less than a rival: then there is no lead.
    margin = 1.0 if rival is None else lead(best.score.total, rival.score.total)
    by_clouds = decided_by in ("geometry", "near")
    of_clouds = _reasons_of_clouds(best, margin, repetition, problem, settings) if by_clouds else ()
    of_spread = _reasons_of_spread(free_axis, uncertainty, problem.scene.diagonal, settings)
    reason = next(_reasons(best, (*of_clouds, *of_spread), problem), None)
    fit = f"F-score {best.score.f_score:.2f}, margin {margin:.2f} to the best other pose{_freely(free_axis)}"
    words = {
        "geometry": fit,
        "near": f"by the clouds, near the alignment, whose own pose the scene's photos refute: {fit}",
        "both": f"alignment and clouds agree, F-score {best.score.f_score:.2f}",
        "photos": f"by the alignment, against the clouds' best fit, F-score {best.score.f_score:.2f}",
    }[decided_by]
    return Decision(reason is None, reason or words, decided_by, margin, rival, free_axis)


def unless_bent(decision: Decision, with_bending: Uncertainty | None, diagonal: float) -> Decision:
    """The decision, or a refusal where the object's own model may be bent too far.

    Args:
        decision: by the gate, which counts the uncertainty on the scene as it is.
        with_bending: the uncertainty with how far the object's model may be bent (method M10); None if unknown.
        diagonal: of the scene crop.
    """
    if with_bending is None or not decision.registered or with_bending.size(diagonal) <= MAX_BENT:
        return decision
    reason = (
        f"the object's model may be bent so far that it lies off by {with_bending.size(diagonal):.0%} of the diagonal, "
        f"more than {MAX_BENT:.0%}; take more photos between those of the object"
    )
    return replace(decision, registered=False, reason=reason)


def unless_mirrored(decision: Decision, best: Hypothesis, mirrored: Hypothesis, settings: FineSettings) -> Decision:
    """The decision, or a refusal where the object's mirror image fits better by more than the margin.

    Args:
        decision: by the gate, on a pose by the clouds.
        best: that pose and its scores.
        mirrored: the best pose of the mirror image.
        settings: the gate.
    """
    fit, other = best.score.total, mirrored.score.total
    if not decision.registered or fit >= (1 - settings.min_margin) * other:
        return decision
    reason = (
        f"the mirror image of the object fits better, with a score of {other:.2f} instead of {fit:.2f}: its axes are"
        " left-handed; negate the x of all its points, or any other axis, and register it again"
    )
    return replace(decision, registered=False, reason=reason)


def _rivals(
    best: Hypothesis,
    others: list[Hypothesis],
    obj: Surface,
    diagonal: float,
    settings: FineSettings,
    same_shift: float,
) -> tuple[list[Hypothesis], Array | None]:
    """The poses that differ from the best and leave the object elsewhere, and the axis about which it turns freely."""
    tau, centre = settings.score_fraction * diagonal, obj.points.mean(0)
    rivals, free_axis = [], None
    for other in others:
        if not distinct(best.pose, other.pose, centre, diagonal, shift=same_shift):
            continue
        if not _turns_onto_itself(obj, best.pose.inverse() @ other.pose, tau / best.pose.scale):
            rivals.append(other)
        elif free_axis is None and other.score.total > (1 - settings.min_margin) * best.score.total:
            free_axis = rotation_axis(other.pose.rotation @ best.pose.rotation.T)
    return rivals, free_axis


def _freely(axis: Array | None) -> str:
    """What is reported of an object that fits as well when it is turned."""
    if axis is None:
        return ""
    about = ", ".join(f"{x:.2f}" for x in axis)
    return f"; turned about ({about}) the object fits as well; its shape does not decide which turn is right"


def _reasons(best: Hypothesis, of_clouds: Iterable[str], problem: Problem) -> Iterator[str]:
    """Why a pose may not be used; free space and gravity count whatever decided on it."""
    violation, tilt = best.score.free_space_violation, tilt_deg(best.pose, problem.known.ups)
    if violation is not None and violation > MAX_CONTRADICTED:
        yield (
            f"{violation:.0%} of the object would lie in free space, where the scene's photos measured surfaces behind"
            f" it; {MAX_CONTRADICTED:.0%} are allowed"
        )
    yield from of_clouds
    if tilt is not None and tilt > MAX_TILT_DEG:
        yield f"the object would lean by {tilt:.1f} degrees, more than {MAX_TILT_DEG:.1f}"


def _reasons_of_clouds(
    best: Hypothesis, margin: float, repetition: Repetition, problem: Problem, settings: FineSettings
) -> Iterator[str]:
    """Why a pose that no photos support may not be used."""
    found, scales = best.score, problem.scales
    if found.f_score < settings.min_f_score:
        yield f"the two-way F-score is {found.f_score:.2f}, below {settings.min_f_score:.2f}"
    if found.recall < MIN_RECALL:
        yield f"the object explains only {found.recall:.2f} of the scene crop, below {MIN_RECALL:.2f}"
    if found.color is not None and found.color < MIN_COLOR:
        yield f"the colours agree by {found.color:.2f} only, below {MIN_COLOR:.2f}"
    if found.displaced is not None and found.displaced > MAX_CONTRADICTED:
        yield (
            f"in {found.displaced:.0%} of the places that both clouds show, one's surface lies in front of the other's;"
            f" {MAX_CONTRADICTED:.0%} are allowed: the scene may show something else there"
        )
    if repetition.undecided is not None:
        yield (
            f"the object repeats itself every {repetition.undecided:.3g} units of the scene, and shifted by that"
            " much it fits equally well; cut the scene to where the object ends, or register it by photos"
        )
    if margin < settings.min_margin:
        yield f"another pose is nearly as good: the margin is {margin:.3f}, below {settings.min_margin:.3f}"
    if scales.at_edge(best.pose.scale):
        low, high = scales.centre * np.exp([-scales.width, scales.width])
        yield f"the scale {best.pose.scale:.4g} lies at the edge of what was searched, {low:.4g} to {high:.4g}"


def _reasons_of_spread(
    free_axis: Array | None, uncertainty: Uncertainty | None, diagonal: float, settings: FineSettings
) -> Iterator[str]:
    """Why a pose is too uncertain to be used; `diagonal` of the scene crop, in its unit."""
    if uncertainty is None:
        yield "too little of the object meets the scene for an estimate of how certain the pose is"
        return
    scale, most = uncertainty.scale_sd_log, settings.max_scale_sd_log
    if scale > most:
        yield f"the scale is uncertain by {scale:.1%}, more than {most:.1%}"
    turns_freely = free_axis is not None and abs(free_axis @ uncertainty.rotation_axis) > 0.9
    angle, most = uncertainty.rotation_sd_deg, settings.max_rotation_sd_deg
    if angle > most and not turns_freely:
        yield f"the rotation is uncertain by {angle:.1f} degrees, more than {most:.1f}"
    shift, most = uncertainty.translation_sd / diagonal, settings.max_translation_sd_fraction
    if shift > most:
        yield f"the position is uncertain by {shift:.1%} of the diagonal, more than {most:.1%}"


def _turned_about(pose: Sim3, axis: Array, centre: Array) -> Sim3:
    """The turn of the object's frame about its centre (3,) and an axis (3,) in the scene, as far as turned poses are
    apart."""
    rotation = Rotation.from_rotvec(np.radians(3 * DISTINCT_ANGLE_DEG) * (pose.rotation.T @ axis)).as_matrix()
    return Sim3(1.0, rotation, centre - rotation @ centre)


def rotation_axis(rotation: Array) -> Array:
    """Unit axis (3,) of a rotation; its sign is that of a turn of less than half a circle."""
    vector = Rotation.from_matrix(rotation).as_rotvec()
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def tilt_deg(pose: Sim3, up: tuple[Array, Array] | None) -> float | None:
    """Angle in degrees between the object's up, moved into the scene, and the scene's."""
    if up is None:
        return None
    return float(np.degrees(np.arccos(np.clip(pose.rotate(up[0]) @ up[1], -1, 1))))


def _turns_onto_itself(obj: Surface, motion: Sim3, tau: float) -> bool:
    """Whether a motion of the object's frame turns it, and leaves its shape, and any colours, as they were.

    Nearly every point must find another within `tau` (object units), both ways, and the object's middle must stay: a
    long row of equal parts that is shifted by one of them is elsewhere.
    """
    if rotation_angle_deg(motion.rotation) <= DISTINCT_ANGLE_DEG:
        return False
    axes = np.linalg.svd(obj.points - obj.points.mean(0), full_matrices=False)[2]
    middle = ends_of(obj.points @ axes.T).mean(0) @ axes
    if np.linalg.norm(motion.apply(middle) - middle) > tau:
        return False
    pairs = pair(obj, obj, motion, tau)
    ahead, back = pairs.forward / len(obj.queries), (len(pairs.distance) - pairs.forward) / len(obj.queries)
    color = color_agreement(obj, obj, pairs)
    return min(ahead, back) > 1 - MIN_MARGIN and (color is None or color > MIN_SELF_COLOR)
