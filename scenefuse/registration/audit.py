"""Is the best pose the only one? Turned copies of it, the margin to the best rival, and the gate."""

from dataclasses import dataclass

import numpy as np

from scenefuse.registration.coarse import Hypothesis, distinct
from scenefuse.registration.refine import ScaleRange
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


@dataclass(frozen=True)
class Verdict:
    """What the audit found.

    Attributes:
        registered: whether the pose may be used.
        reason: one sentence why.
        margin: relative lead over the best rival, 0..1.
        rival: the best pose that differs and would leave the object elsewhere, or None.
        free_axis: a pose as good that only maps the object onto itself exists.
    """

    registered: bool
    reason: str
    margin: float
    rival: Hypothesis | None
    free_axis: bool


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
            rotation = _about(axis, angle)
            copies.append(Sim3(1.0, rotation, centre - rotation @ centre) @ pose)
    return copies


def judge(
    ranked: list[Hypothesis],
    obj: Surface,
    diagonal: float,
    tau: float,
    gate: Gate,
    scales: ScaleRange,
    up: tuple[Array, Array] | None,
) -> Verdict:
    """Weigh the best hypothesis against its rivals and the gate.

    A rival that maps the object onto itself, in shape and colour, is no rival: fused, both give the same points.

    Args:
        ranked: refined hypotheses, best first.
        obj: the object in its own frame.
        diagonal: of the scene crop.
        tau: scoring distance, scene units.
        gate: thresholds.
        scales: the scale prior; a scale at its edge is refused.
        up: up in the object's and in the scene's frame, or None.
    """
    best, centre = ranked[0], obj.points.mean(0)
    rival, free_axis = None, False
    for other in ranked[1:]:
        if not distinct(best.pose, other.pose, centre, diagonal):
            continue
        if _maps_onto_itself(obj, best.pose.inverse() @ other.pose, tau / best.pose.scale):
            free_axis |= other.score.total > (1 - gate.min_margin) * best.score.total
            continue
        if rival is None:
            rival = other
    margin = 1.0 if rival is None else 1 - rival.score.total / max(best.score.total, 1e-12)
    tilt = tilt_deg(best.pose, up)
    if best.score.f_score < gate.min_f_score:
        problem = f"the two-way F-score is {best.score.f_score:.2f}, below {gate.min_f_score:.2f}"
    elif best.score.recall < gate.min_recall:
        problem = f"the object explains only {best.score.recall:.2f} of the scene crop, below {gate.min_recall:.2f}"
    elif best.score.color is not None and best.score.color < gate.min_color:
        problem = f"the colours agree by {best.score.color:.2f} only, below {gate.min_color:.2f}"
    elif margin < gate.min_margin:
        problem = f"another pose is nearly as good: the margin is {margin:.3f}, below {gate.min_margin:.3f}"
    elif scales.at_edge(best.pose.scale):
        problem = (
            f"the scale {best.pose.scale:.4g} lies at the edge of its prior, {scales.centre:.4g} times or over"
            f" {np.exp(scales.width):.2f}; widen the prior"
        )
    elif tilt is not None and tilt > gate.max_final_tilt_deg:
        problem = f"the object would lean by {tilt:.1f} degrees, more than {gate.max_final_tilt_deg:.1f}"
    else:
        words = f"F-score {best.score.f_score:.2f}, margin {margin:.2f} to the best other pose"
        return Verdict(True, words, margin, rival, free_axis)
    return Verdict(False, problem, margin, rival, free_axis)


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


def _about(axis: Array, angle: float) -> Array:
    x, y, z = axis / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
