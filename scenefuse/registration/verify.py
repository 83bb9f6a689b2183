"""May a pose be used? Turned copies of it, the margin to the best rival, free space, spread, and the gate."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from scenefuse.registration.coarse import Hypothesis, distinct
from scenefuse.registration.refine import ScaleRange, Uncertainty
from scenefuse.registration.score import color_agreement, pair
from scenefuse.registration.surface import Surface
from scenefuse.transforms import Array, Sim3


@dataclass(frozen=True)
class Gate:
    """What a pose must reach to count as registered (method R12)."""

    min_f_score: float
    """Smallest two-way F-score of an accepted pose."""
    min_recall: float
    """Smallest share of the scene crop that an accepted pose explains."""
    min_color: float
    """Smallest agreement of the colours, where both clouds have colours that vary."""
    min_margin: float
    """Smallest relative lead of the score over the best pose that differs."""
    max_final_tilt_deg: float
    """Largest angle in degrees between the two up directions of an accepted pose."""
    max_blocked: float
    """Largest share of the object that stands where the scene's cameras saw through."""
    max_scale_sd_log: float
    """Largest standard deviation of the scale, natural logarithm."""
    max_rotation_sd_deg: float
    """Largest standard deviation of the rotation about any axis, degrees; about a free axis it may be more."""
    max_translation_sd_fraction: float
    """Largest standard deviation of the object's centre, as a share of the diagonal."""


@dataclass(frozen=True)
class Decision:
    """What the audit found.

    Attributes:
        registered: whether the pose may be used.
        reason: one sentence why.
        decided_by: `geometry`, `photos` (they overruled geometry) or `both` (they agree).
        margin: relative lead over the best rival, 0..1.
        rival: the best pose that differs and would leave the object elsewhere, or None.
        free_axis: unit vector (3,) in the scene about which the object can turn and stay the same, or None.
    """

    registered: bool
    reason: str
    decided_by: str
    margin: float
    rival: Hypothesis | None
    free_axis: Array | None


def turned_copies(pose: Sim3, obj: Surface, up_in_scene: Array | None, steps: int) -> list[Sim3]:
    """The pose turned about the object's centre: a full circle about the vertical and half turns about level axes.

    Without gravity, the object's own principal axes take the vertical's place, each in turn.
    """
    centre = pose.apply(obj.points.mean(0))
    principal = np.linalg.svd(pose.rotate(obj.points - obj.points.mean(0)), full_matrices=False)[2]
    axes = principal if up_in_scene is None else up_in_scene[None]
    copies = []
    for axis in axes:
        for angle in np.arange(1, steps) * 2 * np.pi / steps:
            rotation = Rotation.from_rotvec(angle * axis).as_matrix()
            copies.append(Sim3(1.0, rotation, centre - rotation @ centre) @ pose)
    return copies


def decide(
    ranked: list[Hypothesis],
    obj: Surface,
    diagonal: float,
    tau: float,
    gate: Gate,
    scales: ScaleRange,
    ups: tuple[Array, Array] | None,
    spread: Uncertainty | None,
    decided_by: str,
) -> Decision:
    """Weigh the best hypothesis against its rivals, the photos and the gate.

    A rival that maps the object onto itself, in shape and colour, is no rival: fused, both give the same points.
    Photos that link object and scene settle which pose is meant, so that rivals, colours and scores no longer matter:
    the scene may lack nearly all of the object, or show much beside it. Free space and gravity can still deny it.

    Args:
        ranked: refined hypotheses, best first; the photos' own pose first where they overrule geometry.
        obj: the object in its own frame.
        diagonal: of the scene crop.
        tau: scoring distance, scene units.
        gate: thresholds.
        scales: the scale prior; a scale at its edge is refused.
        ups: up in the object's and in the scene's frame, or None.
        spread: of the best pose.
        decided_by: see Decision.
    """
    best, centre = ranked[0], obj.points.mean(0)
    rival, free_axis = None, None
    for other in ranked[1:]:
        if not distinct(best.pose, other.pose, centre, diagonal):
            continue
        if _maps_onto_itself(obj, best.pose.inverse() @ other.pose, tau / best.pose.scale):
            if free_axis is None and other.score.total > (1 - gate.min_margin) * best.score.total:
                free_axis = rotation_axis(other.pose.rotation @ best.pose.rotation.T)
            continue
        if rival is None:
            rival = other
    # The photos' pose may score less than a rival: then there is no lead.
    margin = 1.0 if rival is None else 1 - rival.score.total / max(best.score.total, 1e-12)
    problem = _blocked(best, gate)
    if problem is None and decided_by == "geometry":
        problem = _poor(best, margin, diagonal, gate, scales, spread, free_axis)
    tilt = tilt_deg(best.pose, ups)
    if problem is None and tilt is not None and tilt > gate.max_final_tilt_deg:
        problem = f"the object would lean by {tilt:.1f} degrees, more than {gate.max_final_tilt_deg:.1f}"
    if problem is not None:
        return Decision(False, problem, decided_by, margin, rival, free_axis)
    words = {
        "geometry": f"F-score {best.score.f_score:.2f}, margin {margin:.2f} to the best other pose",
        "both": f"shared photos and geometry agree, F-score {best.score.f_score:.2f}",
        "photos": f"shared photos decide against geometry, F-score {best.score.f_score:.2f}",
    }[decided_by]
    return Decision(True, words, decided_by, margin, rival, free_axis)


def _blocked(best: Hypothesis, gate: Gate) -> str | None:
    if best.score.blocked is None or best.score.blocked <= gate.max_blocked:
        return None
    return (
        f"{best.score.blocked:.0%} of the object would stand where the scene's photos saw through, more than"
        f" {gate.max_blocked:.0%}"
    )


def _poor(
    best: Hypothesis,
    margin: float,
    diagonal: float,
    gate: Gate,
    scales: ScaleRange,
    spread: Uncertainty | None,
    free_axis: Array | None,
) -> str | None:
    """What is wrong with a pose that only geometry and colours speak for."""
    if best.score.f_score < gate.min_f_score:
        return f"the two-way F-score is {best.score.f_score:.2f}, below {gate.min_f_score:.2f}"
    if best.score.recall < gate.min_recall:
        return f"the object explains only {best.score.recall:.2f} of the scene crop, below {gate.min_recall:.2f}"
    if best.score.color is not None and best.score.color < gate.min_color:
        return f"the colours agree by {best.score.color:.2f} only, below {gate.min_color:.2f}"
    if margin < gate.min_margin:
        return f"another pose is nearly as good: the margin is {margin:.3f}, below {gate.min_margin:.3f}"
    if scales.at_edge(best.pose.scale):
        return (
            f"the scale {best.pose.scale:.4g} lies at the edge of its prior, {scales.centre:.4g} times or over"
            f" {np.exp(scales.width):.2f}; widen the prior"
        )
    if spread is None:
        return "too little of the object meets the scene to tell how certain the pose is"
    if spread.scale_sd_log > gate.max_scale_sd_log:
        return f"the scale is uncertain by {spread.scale_sd_log:.1%}, more than {gate.max_scale_sd_log:.1%}"
    turns_freely = free_axis is not None and abs(free_axis @ spread.rotation_axis) > 0.9
    if spread.rotation_sd_deg > gate.max_rotation_sd_deg and not turns_freely:
        return (
            f"the rotation is uncertain by {spread.rotation_sd_deg:.1f} degrees, more than"
            f" {gate.max_rotation_sd_deg:.1f}"
        )
    share = spread.translation_sd / diagonal
    if share > gate.max_translation_sd_fraction:
        return (
            f"the position is uncertain by {share:.1%} of the diagonal, more than"
            f" {gate.max_translation_sd_fraction:.1%}"
        )
    return None


def rotation_axis(rotation: Array) -> Array:
    """Unit axis (3,) of a rotation; its sign is that of a turn of less than half a circle."""
    vector = Rotation.from_matrix(rotation).as_rotvec()
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def tilt_deg(pose: Sim3, up: tuple[Array, Array] | None) -> float | None:
    """Angle in degrees between the object's up, moved into the scene, and the scene's."""
    if up is None:
        return None
    return float(np.degrees(np.arccos(np.clip(pose.rotate(up[0]) @ up[1], -1, 1))))


def _maps_onto_itself(obj: Surface, motion: Sim3, tau: float) -> bool:
    """Whether a motion of the object's frame leaves its shape, and its colours if it has any, as they were.

    Nearly every point must find another within `tau` (object units), both ways.
    """
    pairs = pair(obj, obj, motion, tau)
    ahead, back = pairs.forward / len(obj.probe), (len(pairs.distance) - pairs.forward) / len(obj.probe)
    color = color_agreement(obj, obj, pairs)
    return min(ahead, back) > 0.95 and (color is None or color > 0.9)
