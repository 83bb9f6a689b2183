"""Whether what an object and a scene both show tells the object's shifted copies apart (method R12)."""

from dataclasses import dataclass

import numpy as np

from scenefuse.core.transforms import Array, Sim3
from scenefuse.geometry.free_space import FreeSpace
from scenefuse.geometry.surface import Surface
from scenefuse.register.score import color_agreement, f_beta, worth

# Where two clouds end along a direction, as percentiles: strays do not count.
ENDS = 1, 99
# The part that both show must be so many periods long, and at least this share of what it is at the pose found: then
# nothing distinctive in that can leave it unnoticed.
LEAST_PERIODS, LEAST_LEFT = 2, 0.5


@dataclass(frozen=True)
class Overlap:
    """How well two surfaces agree where both are, along a direction.

    Attributes:
        agreement: two-way F, colours and free space, 0..1, as in a score.
        length: of the part that both show, scene units.
        same_ends: whether both end in the same places, to half the distance within which points agree.
    """

    agreement: float
    length: float
    same_ends: bool


def overlap(
    obj: Surface, scene: Surface, pose: Sim3, shift: Array, tau: float, free_space: FreeSpace | None = None
) -> Overlap:
    """Compare an object and a scene where both are, along a direction of the object.

    Args:
        obj: the object in its own frame.
        scene: the scene crop.
        pose: scene_from_object.
        shift: (3,) the direction, in the object's frame.
        tau: distance within which points agree, scene units.
        free_space: space known to be empty, or None.
    """
    of_object, of_scene, ends = _places(obj, scene, pose, shift)
    low, high = ends[:, 0].max(), ends[:, 1].min()
    pairs, value = worth(obj, scene, pose, tau)
    shares = []
    for place, queries, met, worths in (
        (of_object, obj.queries, pairs.object_index[: pairs.forward], value[: pairs.forward]),
        (of_scene, scene.queries, pairs.scene_index[pairs.forward :], value[pairs.forward :]),
    ):
        inside = (place >= low) & (place <= high)
        shares.append(float(worths[inside[met]].sum() / max(inside[queries].sum(), 1)))
    agreement, color = f_beta(*shares), color_agreement(obj, scene, pairs)
    agreement *= 1.0 if color is None else 0.5 + 0.5 * color
    if free_space is not None:
        agreement *= 1 - (free_space.violation(pose.apply(obj.points[obj.queries])) or 0.0)
    return Overlap(agreement, float(high - low), bool((np.abs(ends[0] - ends[1]) <= tau / 2).all()))


def multiples(obj: Surface, shift: Array) -> list[Array]:
    """A shift (3,) repeated both ways, as far as the object reaches, shortest first."""
    along = obj.points @ (shift / np.linalg.norm(shift))
    most = int(np.ptp(np.percentile(along, ENDS)) / np.linalg.norm(shift))
    return [sign * k * shift for k in range(1, most + 1) for sign in (1, -1)]


def shifted(pose: Sim3, shift: Array) -> Sim3:
    """A pose with the object shifted by (3,) in its own frame."""
    return pose @ Sim3(1.0, np.eye(3), shift)


def undecided_shift(
    obj: Surface,
    scene: Surface,
    pose: Sim3,
    shifts: list[Array],
    tau: float,
    margin: float,
    free_space: FreeSpace | None,
) -> float | None:
    """The period of the object, scene units, along which it fits what both show as well when it is shifted; or None.

    How much both show does not count: of a row of equal bays, the scene and the object may show parts that overlap
    little. It does count where both end in the same places.

    Args:
        obj: the object in its own frame.
        scene: the scene crop.
        pose: scene_from_object.
        shifts: by which the object repeats itself; see `shifts_onto_itself`.
        tau: distance within which points agree, scene units.
        margin: relative lead that tells two poses apart.
        free_space: space known to be empty, or None.
    """
    for shift in shifts:
        period, found = pose.scale * float(np.linalg.norm(shift)), overlap(obj, scene, pose, shift, tau, free_space)
        if found.same_ends:
            continue
        of_object, of_scene = _places(obj, scene, pose, shift)[2]
        for step in multiples(obj, shift):
            moved = of_object + pose.scale * (step @ shift) / np.linalg.norm(shift)
            left = min(moved[1], of_scene[1]) - max(moved[0], of_scene[0])
            if left < max(LEAST_PERIODS * period, LEAST_LEFT * found.length):
                continue
            other = overlap(obj, scene, shifted(pose, step), shift, tau, free_space)
            if other.agreement > (1 - margin) * found.agreement:
                return period
    return None


def _places(obj: Surface, scene: Surface, pose: Sim3, shift: Array) -> tuple[Array, Array, Array]:
    """Where along a direction of the object its points (N,) and the scene's (M,) lie, and both their ends (2, 2)."""
    along = pose.rotate(shift / np.linalg.norm(shift))
    places = pose.apply(obj.points) @ along, scene.points @ along
    return *places, np.array([np.percentile(place, ENDS) for place in places])
