"""Candidate poses: from matched features, and from every heading of an upright object by correlation."""

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array, Sim3, rotation_between
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.ransac import triples_of_one_scale
from scenefuse.geometry.surface import Surface
from scenefuse.register.score import RECALL_WEIGHT

# Triples that pass the checks and are tried on all matches: as many as fit into memory at once.
MAX_TRIPLES = 2000
# How much the scales of a triple's three edges may differ, least over largest.
MIN_EDGE_RATIO = 0.9


def fpfh(surface: Surface, radius: float) -> Array:
    """Fast point feature histograms (Rusu 2009), (N, 33), from at most 100 neighbours within `radius`."""
    import open3d as o3d

    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(surface.points))
    cloud.normals = o3d.utility.Vector3dVector(surface.normals)
    search = o3d.geometry.KDTreeSearchParamHybrid(radius, 100)
    return np.asarray(o3d.pipelines.registration.compute_fpfh_feature(cloud, search).data).T.copy()  # type: ignore[call-arg]


def match(a: Array, b: Array) -> NDArray[np.int64]:
    """Pairs (M, 2) of features that are each other's nearest, from (N, 33) and (K, 33)."""
    a32, b32 = a.astype(np.float32), b.astype(np.float32)
    cost = (a32**2).sum(1)[:, None] - 2 * a32 @ b32.T + (b32**2).sum(1)
    there, back = cost.argmin(1), cost.argmin(0)
    mine = np.flatnonzero(back[there] == np.arange(len(a)))
    return np.stack([mine, there[mine]], axis=1)


def ransac_similarities(
    x: Array,
    y: Array,
    scales: ScaleRange,
    tau: float,
    samples: int,
    keep: int,
    seed: int,
    ups: tuple[Array, Array] | None,
    max_tilt_deg: float,
) -> list[Sim3]:
    """The `keep` similarities with most inliers among random triples of matches, most first.

    A triple is kept when its three edges agree on one scale to 10 % (the edge-length check, with a free but bounded
    scale) and, where both up directions are known, when it leaves the object upright.

    Args:
        x: (M, 3) matched points of the object.
        y: (M, 3) their partners in the scene.
        scales: the scale prior.
        tau: inlier distance, scene units.
        samples: random triples drawn.
        keep: most similarities returned.
        seed: of the triples.
        ups: up in the object's and in the scene's frame, or None.
        max_tilt_deg: largest angle between the two ups.
    """
    if len(x) < 3:
        return []
    rng = np.random.default_rng(seed)
    triples, edges, middle = triples_of_one_scale(x, y, samples, MIN_EDGE_RATIO, rng)
    good = (edges[1].min(1) > 3 * tau) & (np.abs(np.log(middle / scales.centre)) <= scales.width + 0.05)
    triples, middle = triples[good], middle[good]
    if len(triples) == 0:
        return []
    rotations = _triangle_rotations(x[triples], y[triples])
    if ups is not None:
        upright = (rotations @ ups[0]) @ ups[1] >= np.cos(np.radians(max_tilt_deg))
        triples, middle, rotations = triples[upright], middle[upright], rotations[upright]
    triples, middle, rotations = triples[:MAX_TRIPLES], middle[:MAX_TRIPLES], rotations[:MAX_TRIPLES]
    if len(triples) == 0:
        return []
    middle = np.array([scales.clamp(s) for s in middle])
    linear = middle[:, None, None] * rotations
    shifts = y[triples].mean(1) - np.einsum("nij,nj->ni", linear, x[triples].mean(1))
    moved = np.einsum("nij,mj->nmi", linear, x) + shifts[:, None]
    counts = (((moved - y) ** 2).sum(2) <= tau**2).sum(1)
    order = np.argsort(-counts, kind="stable")[:keep]
    return [Sim3(float(middle[k]), rotations[k], shifts[k]) for k in order]


def _triangle_rotations(a: Array, b: Array) -> Array:
    """Rotations (N, 3, 3) that turn triangles a (N, 3, 3) into triangles b: edge direction and plane."""

    def frames(t: Array) -> Array:
        first = t[:, 1] - t[:, 0]
        first = first / np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
        normal = np.cross(first, t[:, 2] - t[:, 0])
        normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        return np.stack([first, normal, np.cross(first, normal)], axis=2)

    return frames(b) @ np.swapaxes(frames(a), 1, 2)


def upright_candidates(
    obj: Surface,
    scene: Surface,
    up_in_object: Array,
    scales: ScaleRange,
    scale_steps: int,
    yaw_steps: int,
    voxel: float,
    keep: int,
) -> list[Sim3]:
    """Correlate the occupancy of the turned, scaled object with the scene's, and keep the best shifts.

    At each yaw and scale, one fast Fourier transform gives the number of shared surface voxels for all shifts at
    once; the F-beta of that overlap ranks the poses.

    Args:
        obj: the object in its own frame.
        scene: the scene crop, z up.
        up_in_object: (3,) up in the object's frame.
        scales: the scale prior.
        scale_steps: logarithmic steps over the prior.
        yaw_steps: steps of a full turn about the vertical.
        voxel: edge of a voxel, scene units.
        keep: most candidates returned, best first.
    """
    upright = rotation_between(up_in_object, np.array([0.0, 0.0, 1.0]))
    centre = obj.points.mean(0)
    points = (obj.points - centre) @ upright.T
    factors = scales.centre * np.exp(np.linspace(-scales.width, scales.width, scale_steps if scales.width else 1))
    low = scene.points.min(0)
    reach = 2 * np.linalg.norm(points[:, :2], axis=1).max() * factors.max()
    span = np.maximum([reach, reach, np.ptp(points[:, 2]) * factors.max()], np.ptp(scene.points, axis=0))
    shape = tuple(fft.next_fast_len(int(n), real=True) for n in np.ceil(span / voxel) + 8 + np.ceil(span / voxel) // 2)
    target, scene_count = _occupancy(scene.points - low, voxel, shape)
    target_f = fft.rfftn(_blur(target), workers=threads())
    b = RECALL_WEIGHT**2
    found: list[tuple[float, float, float, Array]] = []
    for scale in factors:
        for yaw in np.arange(yaw_steps) * 2 * np.pi / yaw_steps:
            turn = _about_z(yaw)
            turned = scale * points @ turn.T
            corner = turned.min(0)
            grid, count = _occupancy(turned - corner, voxel, shape)
            shared = fft.irfftn(target_f * np.conj(fft.rfftn(grid, workers=threads())), shape, workers=threads())
            best = np.unravel_index(int(shared.argmax()), shape)
            f_beta = (1 + b) * shared[best] / (b * scene_count + count)
            step = np.array([i - n if i > n // 2 else i for i, n in zip(best, shape)])
            # Voxel i of the scene meets voxel i - step of the object.
            found.append((float(f_beta), float(scale), float(yaw), low + step * voxel - corner))
    found.sort(key=lambda h: -h[0])
    return [_pose(scale, _about_z(yaw) @ upright, shift, centre) for _, scale, yaw, shift in found[:keep]]


def _occupancy(points: Array, voxel: float, shape: tuple[int, ...]) -> tuple[NDArray[np.float32], float]:
    """Which voxels (X, Y, Z) hold points, and how many do."""
    grid = np.zeros(shape, np.float32)
    grid[tuple(np.floor(points / voxel).astype(np.int64).T)] = 1
    return grid, float(grid.sum())


def _blur(grid: NDArray[np.float32]) -> NDArray[np.float32]:
    """A (1/4, 1/2, 1/4) kernel along each axis, so that a pose between two voxels still overlaps; periodic."""
    for axis in range(3):
        grid = 0.5 * grid + 0.25 * (np.roll(grid, 1, axis) + np.roll(grid, -1, axis))
    return np.minimum(1.6 * grid, 1.0)


def _about_z(angle: float) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _pose(scale: float, rotation: Array, shift: Array, centre: Array) -> Sim3:
    return Sim3(scale, rotation, shift - scale * rotation @ centre)
