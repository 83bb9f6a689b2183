"""Upright hypotheses: every yaw, scale and shift of an object whose up direction is known, by correlation."""

import numpy as np
from scipy import fft

from scenefuse.registration.refine import ScaleRange
from scenefuse.registration.surface import Surface
from scenefuse.stage import threads
from scenefuse.transforms import Array, Sim3, rotation_between


def upright_hypotheses(
    obj: Surface,
    scene: Surface,
    up_in_object: Array,
    scales: ScaleRange,
    scale_steps: int,
    yaw_steps: int,
    voxel: float,
    recall_weight: float,
    keep: int,
) -> list[Sim3]:
    """Correlate the occupancy of the turned, scaled object with the scene's, and keep the best shifts.

    At each yaw and scale, one fast Fourier transform gives the number of shared surface voxels for all shifts at
    once; the F-beta of that overlap ranks the poses. Horizontal and vertical surfaces are correlated apart.

    Args:
        obj: the object in its own frame.
        scene: the scene crop, z up.
        up_in_object: (3,) up in the object's frame.
        scales: the scale prior.
        scale_steps: logarithmic steps over the prior.
        yaw_steps: steps of a full turn about the vertical.
        voxel: edge of a voxel, scene units.
        recall_weight: beta of the F-beta measure.
        keep: most hypotheses returned, best first; no two alike.
    """
    upright = rotation_between(up_in_object, np.array([0.0, 0.0, 1.0]))
    centre = obj.points.mean(0)
    points, normals = (obj.points - centre) @ upright.T, obj.normals @ upright.T
    factors = scales.centre * np.exp(np.linspace(-scales.width, scales.width, scale_steps if scales.width else 1))
    low = scene.points.min(0)
    reach = 2 * np.linalg.norm(points[:, :2], axis=1).max() * factors.max()
    span = np.maximum([reach, reach, np.ptp(points[:, 2]) * factors.max()], np.ptp(scene.points, axis=0))
    shape = tuple(fft.next_fast_len(int(n), real=True) for n in np.ceil(span / voxel) + 8 + np.ceil(span / voxel) // 2)
    target, scene_count = _occupancy(scene.points - low, scene.normals, voxel, shape)
    target_f = fft.rfftn(_blur(target), axes=(1, 2, 3), workers=threads())
    b = recall_weight**2
    found: list[tuple[float, float, float, Array]] = []
    for scale in factors:
        for yaw in np.arange(yaw_steps) * 2 * np.pi / yaw_steps:
            turn = _about_z(yaw)
            turned = scale * points @ turn.T
            corner = turned.min(0)
            grid, count = _occupancy(turned - corner, normals @ turn.T, voxel, shape)
            product = (target_f * np.conj(fft.rfftn(grid, axes=(1, 2, 3), workers=threads()))).sum(0)
            shared = fft.irfftn(product, shape, workers=threads())
            best = np.unravel_index(int(shared.argmax()), shape)
            f_beta = (1 + b) * shared[best] / (b * scene_count + count)
            step = np.array([i - n if i > n // 2 else i for i, n in zip(best, shape)])
            # Voxel i of the scene meets voxel i - step of the object.
            found.append((float(f_beta), float(scale), float(yaw), low + step * voxel - corner))
    found.sort(key=lambda h: -h[0])
    chosen: list[tuple[float, float, float, Array]] = []
    for one in found:
        if len(chosen) == keep:
            break
        if not any(_alike(one, other, voxel) for other in chosen):
            chosen.append(one)
    return [_pose(scale, _about_z(yaw) @ upright, shift, centre) for _, scale, yaw, shift in chosen]


def _occupancy(points: Array, normals: Array, voxel: float, shape: tuple[int, ...]) -> tuple[Array, float]:
    """Occupancy (2, X, Y, Z) of horizontal and vertical surfaces, and the number of occupied voxels.

    The squared z of the normals splits a voxel's unit of occupancy between the two channels.
    """
    cells = np.floor(points / voxel).astype(np.int64)
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    total = np.bincount(flat, minlength=int(np.prod(shape)))
    level = np.bincount(flat, normals[:, 2] ** 2, minlength=int(np.prod(shape)))
    share = np.divide(level, total, out=np.zeros_like(level), where=total > 0)
    filled = total > 0
    grid = np.stack([np.sqrt(share), np.sqrt(np.where(filled, 1 - share, 0))]).reshape(2, *shape)
    return grid.astype(np.float32), float(filled.sum())


def _blur(grid: Array) -> Array:
    """A (1/4, 1/2, 1/4) kernel along each axis, so that a pose between two voxels still overlaps; periodic."""
    for axis in (1, 2, 3):
        grid = 0.5 * grid + 0.25 * (np.roll(grid, 1, axis) + np.roll(grid, -1, axis))
    return np.minimum(1.6 * grid, 1.0)


def _about_z(angle: float) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _alike(a: tuple[float, float, float, Array], b: tuple[float, float, float, Array], voxel: float) -> bool:
    """Two grid hypotheses that refinement would bring together."""
    turn = abs((a[2] - b[2] + np.pi) % (2 * np.pi) - np.pi)
    near = np.linalg.norm(a[3] - b[3]) < 3 * voxel
    return bool(turn < np.radians(12) and abs(np.log(a[1] / b[1])) < 0.08 and near)


def _pose(scale: float, rotation: Array, shift: Array, centre: Array) -> Sim3:
    return Sim3(scale, rotation, shift - scale * rotation @ centre)
