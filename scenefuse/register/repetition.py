"""Objects that repeat themselves, as stairs, colonnades and facades do: by which shifts, and whether what the object
and a scene both show tells the shifted copies apart (method R8, R12)."""

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import map_coordinates, maximum_filter

from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array, Sim3
from scenefuse.geometry.depth_test import FreeSpace
from scenefuse.geometry.icp import ScaleRange, refine_planes
from scenefuse.geometry.surface import Surface, ends_of
from scenefuse.register.score import MIN_MARGIN, color_agreement, f_beta, worth

# Edge of a voxel in spacings of the points; points agree within two edges.
VOXEL_SPACINGS = 4 / 3
# Shifts below so many voxels are not looked for.
MIN_SHIFT_VOXELS = 3
# A shift is looked at when this share of the object's voxels meet.
MIN_MEETING = 0.3
# The part that both show must be so many periods long: then nothing distinctive in it can leave it unnoticed.
MIN_PERIODS = 2


def shifts_onto_itself(obj: Surface, spacing: float) -> list[Array]:
    """The shortest shifts (3,) that map an object onto itself, one for each direction; often none.

    Peaks of the autocorrelation of its voxels propose them, point-to-plane ICP of the object onto itself refines them.

    Args:
        obj: the object, thinned.
        spacing: of its points, in its own unit.
    """
    found: list[Array] = []
    voxel = VOXEL_SPACINGS * spacing
    for shift in _peaks(obj, voxel):
        if any(_is_multiple(shift, of, 2 * voxel) for of in found):
            continue
        start = Sim3(1.0, np.eye(3), shift)
        refined = refine_planes(obj, obj, start, ScaleRange(1.0, 0.0), 2 * voxel, color_weight=0.0)
        shift = refined.apply(obj.points.mean(0)) - obj.points.mean(0)
        length = float(np.linalg.norm(shift))
        if length < MIN_SHIFT_VOXELS * voxel or any(_is_multiple(shift, of, 2 * voxel) for of in found):
            continue
        if _repeats(obj, shift, 2 * voxel):
            found.append(shift)
        if len(found) == 3:  # directions that are independent
            break
    return found


def _repeats(obj: Surface, shift: Array, tau: float) -> bool:
    """Whether an object meets itself shifted by (3,), and less so on the way there, where it would slide else."""
    distance, nearest = obj.tree.query(obj.points[obj.queries], k=2, workers=threads())
    facing = np.abs((obj.normals[obj.queries] * obj.normals[nearest[:, 1]]).sum(1))
    usual = float((np.clip(1 - (distance[:, 1] / tau) ** 2, 0, 1) * facing).mean())
    if overlap(obj, obj, Sim3(1.0, np.eye(3), shift), shift, tau) < (1 - MIN_MARGIN) * usual:
        return False
    there, half, quarter = (
        overlap(obj, obj, Sim3(1.0, np.eye(3), part * shift), shift, tau / 2) for part in (1.0, 0.5, 0.25)
    )
    # A plane that slides along itself does not repeat.
    return min(half, quarter) < (1 - MIN_MARGIN) * there


def _peaks(obj: Surface, voxel: float) -> list[Array]:
    """Shifts (3,) at which many of an object's voxels meet others, most first; of each and its reverse, one."""
    axes = np.linalg.svd(obj.points - obj.points.mean(0), full_matrices=False)[2]
    points, normals = obj.points @ axes.T, obj.normals @ axes.T
    most = 1_000_000  # cells; of more, the voxels are larger
    voxel = max(voxel, float(np.cbrt(np.prod(2 * np.ptp(points, axis=0) + 4 * voxel) / most)))
    meeting = _autocorrelation(np.floor((points - points.min(0)) / voxel).astype(np.int64), normals)
    size = np.array(meeting.shape)
    high = np.argwhere((meeting == maximum_filter(meeting, 5, mode="wrap")) & (meeting > MIN_MEETING))
    step = np.where(high > size // 2, high - size, high)
    ahead = (step[:, 0] > 0) | (step[:, 0] == 0) & ((step[:, 1] > 0) | (step[:, 1] == 0) & (step[:, 2] > 0))
    step = step[ahead & (np.linalg.norm(step, axis=1) >= MIN_SHIFT_VOXELS)]
    way = step[:, None] * np.linspace(0.1, 0.9, 9)[:, None]
    least = map_coordinates(meeting, np.moveaxis(way, 2, 0), order=1, mode="grid-wrap").min(1)
    step = step[meeting[tuple(step.T)] - least > MIN_MARGIN]
    return [voxel * step[k] @ axes for k in np.argsort(-meeting[tuple(step.T)], kind="stable")]


def _autocorrelation(cells: NDArray[np.int64], normals: Array) -> Array:
    """Shares of a surface in cells (N, 3) with normals (N, 3) that meet its shifted self, for all shifts of a periodic
    grid."""
    shape = tuple(fft.next_fast_len(2 * int(n) + 4, real=True) for n in cells.max(0) + 1)
    flat, size = np.ravel_multi_index(tuple(cells.T), shape), int(np.prod(shape))
    filled = np.bincount(flat, minlength=size)
    spectrum = 0.0
    for axis in range(3):
        facing = np.sqrt(np.bincount(flat, normals[:, axis] ** 2, minlength=size) / np.maximum(filled, 1))
        wave = fft.rfftn(facing.reshape(shape).astype(np.float32), workers=threads())
        spectrum = spectrum + wave.real**2 + wave.imag**2
    meeting = fft.irfftn(_blurred(np.asarray(spectrum), shape), shape, workers=threads())
    return np.asarray(meeting / meeting[0, 0, 0])


def _blurred(power: Array, shape: tuple[int, ...]) -> Array:
    """The spectrum of voxels that meet their neighbours, too: a (1/4, 1/2, 1/4) kernel along each axis."""
    for axis, count in enumerate(shape):
        frequency = np.arange(power.shape[axis]) / count
        kernel = (0.5 + 0.5 * np.cos(2 * np.pi * frequency)).astype(np.float32)
        power = power * kernel.reshape([-1 if k == axis else 1 for k in range(3)])
    return power


def _is_multiple(shift: Array, of: Array, tolerance: float) -> bool:
    """Whether a shift (3,) is another times a whole number."""
    count = np.round(shift @ of / (of @ of))
    return bool(np.linalg.norm(shift - count * of) < max(tolerance, 0.05 * float(np.linalg.norm(shift))))


def overlap(
    obj: Surface, scene: Surface, pose: Sim3, shift: Array, tau: float, free_space: FreeSpace | None = None
) -> float:
    """How well an object and a scene agree where both are, along a direction of the object: 0..1, as in a score.

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
    return agreement


def multiples(obj: Surface, shift: Array) -> list[Array]:
    """A shift (3,) repeated both ways, as far as the object reaches, shortest first."""
    along = obj.points @ (shift / np.linalg.norm(shift))
    most = int(np.ptp(ends_of(along)) / np.linalg.norm(shift))
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
        of_object, of_scene = _places(obj, scene, pose, shift)[2]
        if np.abs(of_object - of_scene).max() <= tau / 2:
            continue
        period, found = pose.scale * float(np.linalg.norm(shift)), overlap(obj, scene, pose, shift, tau, free_space)
        for step in multiples(obj, shift):
            moved = of_object + pose.scale * (step @ shift) / np.linalg.norm(shift)
            left = min(moved[1], of_scene[1]) - max(moved[0], of_scene[0])
            if left < MIN_PERIODS * period:
                continue
            if overlap(obj, scene, shifted(pose, step), shift, tau, free_space) > (1 - margin) * found:
                return period
    return None


def _places(obj: Surface, scene: Surface, pose: Sim3, shift: Array) -> tuple[Array, Array, Array]:
    """Where along a direction of the object its points (N,) and the scene's (M,) lie, and both their ends (2, 2)."""
    along = pose.rotate(shift / np.linalg.norm(shift))
    places = pose.apply(obj.points) @ along, scene.points @ along
    return *places, np.array([ends_of(place) for place in places])
