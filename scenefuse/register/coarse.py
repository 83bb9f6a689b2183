"""Coarse registration: the scale's prior, candidates from features and from gravity, briefly refined, the distinct best
kept."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.spatial.transform import Rotation

from scenefuse.core.stage import quantity, threads
from scenefuse.core.transforms import UP, Array, Sim3, rotation_between
from scenefuse.geometry.icp import (
    MAX_TRIPLES,
    MIN_EDGE_RATIO,
    RANSAC_POSES,
    ScaleRange,
    refine_points,
    triples_of_one_scale,
)
from scenefuse.geometry.surface import SCORE_FRACTION, Surface, prepare, with_grid, with_queries
from scenefuse.register.problem import SURFACE_POINTS, Problem
from scenefuse.register.score import RECALL_WEIGHT, Hypothesis, best_distinct, score

Candidate = tuple[Sim3, str]


@dataclass(frozen=True)
class CoarseSettings:
    """Settings of the coarse registration."""

    max_tilt_deg: float = 10
    """Largest angle between the up directions of object and scene that the search allows, where both are known."""
    voxel_fractions: tuple[float, ...] = (0.04, 0.03)
    """Voxels of the feature pyramid, as shares of the scene crop's diagonal; those of the sweep are the first."""
    ransac_samples: int = 30000
    """Random triples of matches drawn at each level of the pyramid."""
    feature_scale_steps: int = 3
    """Logarithmic scale steps at which the object's features are computed."""
    scale_steps: int = 13
    """Logarithmic scale steps of the upright sweep."""
    yaw_steps: int = 24
    """Steps of a full turn of the upright sweep."""
    candidates: int = 24
    """Candidates that are briefly refined."""
    keep: int = 6
    """Distinct hypotheses handed to the fine registration."""


def coarse_quantities(found: Sequence[Hypothesis], gravity_used: bool, notes: list[str]) -> dict[str, Any]:
    """The stage JSON of hypotheses, best first; each is printed."""
    for h in found:
        print(f"{h.source:8s} scale {h.pose.scale:.4g} score {h.score.total:.3f} F {h.score.f_score:.3f}", flush=True)
    return {
        "scene_from_object": quantity(found[0].pose.matrix, ""),
        "scale": quantity(found[0].pose.scale, "scene units per object unit"),
        "score": quantity(found[0].score.total, "1"),
        "gravity_used": quantity(gravity_used, ""),
        "hypotheses": quantity([h.as_json() for h in found], ""),
        "notes": quantity(notes, ""),
    }


def hypotheses_or_centres(problem: Problem, settings: CoarseSettings) -> tuple[list[Hypothesis], list[str]]:
    """The hypotheses of `find_hypotheses`, or one where it has none, which a note says."""
    found = find_hypotheses(problem, settings)
    if found:
        return found, []
    note = "no feature or heading gave a pose; the clouds' centres were laid on each other instead"
    print(note, flush=True)
    return [_centred(problem)], [note]


def find_hypotheses(problem: Problem, settings: CoarseSettings) -> list[Hypothesis]:
    """Distinct hypotheses, best first: features and gravity propose, brief refinement and the score rank them."""
    scales, diagonal, seed = problem.scales, problem.scene.diagonal, problem.seed
    tau = SCORE_FRACTION * diagonal
    obj, target = problem.surfaces(scales.centre, SCORE_FRACTION / 2, SURFACE_POINTS // 2)
    # The grids of nearest points reach farther around the clouds than the first pairing distance.
    cell, reach = SCORE_FRACTION / 2 * diagonal, 5 * SCORE_FRACTION * diagonal
    both = (
        with_queries(with_grid(obj, cell / scales.centre, reach / scales.centre), SURFACE_POINTS // 10, seed),
        with_queries(with_grid(target, cell, reach), SURFACE_POINTS // 10, seed),
    )
    upright = [(pose, "gravity") for pose in _upright(problem, settings)]
    by_features = [(pose, "features") for pose in _from_features(problem, settings)]
    room = settings.candidates - len(upright)

    def best(candidates: list[Candidate]) -> list[Candidate]:
        return sorted(candidates, key=lambda c: -score(*both, c[0], 2 * tau, scales.centre).total)

    refined = []
    for start, source in best(upright) + best(by_features)[:room]:
        pose = refine_points(*both, start, scales, (3 * tau, tau))
        refined.append(Hypothesis(pose, source, score(*both, pose, tau, scales.centre)))
    return best_distinct(refined, obj.points.mean(0), diagonal, settings.keep)


def _upright(problem: Problem, settings: CoarseSettings) -> list[Sim3]:
    """The sweep of yaw, scale and shift; nothing where gravity is not known."""
    ups, scales, fraction = problem.known.ups, problem.scales, settings.voxel_fractions[0]
    if ups is None:
        return []
    level = Sim3(1.0, rotation_between(ups[1], UP), np.zeros(3))
    obj, scene = problem.surfaces(scales.centre, fraction / 2, SURFACE_POINTS // 2)
    steps, most = (settings.scale_steps, settings.yaw_steps), settings.candidates // 2
    voxel = fraction * problem.scene.diagonal
    found = upright_candidates(obj, scene.transformed(level), ups[0], scales, *steps, voxel, most)
    return [level.inverse() @ pose for pose in found]


def _from_features(problem: Problem, settings: CoarseSettings) -> list[Sim3]:
    """Similarity RANSAC on mutual FPFH matches at every voxel of the pyramid and every feature scale."""
    scales, ups, seed = problem.scales, problem.known.ups, problem.seed
    count = settings.feature_scale_steps if scales.width else 1
    steps = np.linspace(-1, 1, count) if count > 1 else [0.0]
    found: list[Sim3] = []
    for fraction in settings.voxel_fractions:
        voxel = fraction * problem.scene.diagonal
        target = prepare(problem.scene, voxel, seed, SURFACE_POINTS // 2)
        target_features = fpfh(target, 5 * voxel)
        for step in steps:
            scale = scales.centre * np.exp(scales.width * step)
            obj = prepare(problem.object, voxel / scale, seed, SURFACE_POINTS // 2)
            pairs = match(fpfh(obj, 5 * voxel / scale), target_features)
            x, y = obj.points[pairs[:, 0]], target.points[pairs[:, 1]]
            found += ransac_similarities(
                x, y, scales, 1.5 * voxel, settings.ransac_samples, RANSAC_POSES, seed, ups, settings.max_tilt_deg
            )
    return found


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

    A triple is kept when its three edges agree on one scale to 10 % (the edge-length check), which lies as near to the
    bounds, and, where both up directions are known, when it leaves the object upright.

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
    triples, edges, middle = triples_of_one_scale(x, y, samples, rng)
    good = (edges[1].min(1) > 3 * tau) & (
        np.abs(np.log(middle / scales.centre)) <= scales.width - np.log(MIN_EDGE_RATIO)
    )
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
    upright = rotation_between(up_in_object, UP)
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
    found: list[tuple[float, Sim3]] = []
    for scale in factors:
        for yaw in np.arange(yaw_steps) * 2 * np.pi / yaw_steps:
            turn = Rotation.from_euler("z", yaw).as_matrix()
            turned = scale * points @ turn.T
            corner = turned.min(0)
            grid, count = _occupancy(turned - corner, voxel, shape)
            shared = fft.irfftn(target_f * np.conj(fft.rfftn(grid, workers=threads())), shape, workers=threads())
            best = np.unravel_index(int(shared.argmax()), shape)
            f_beta = (1 + b) * shared[best] / (b * scene_count + count)
            step = np.array([i - n if i > n // 2 else i for i, n in zip(best, shape)])
            # Voxel i of the scene meets voxel i - step of the object.
            rotation, shift = turn @ upright, low + step * voxel - corner
            found.append((float(f_beta), Sim3(float(scale), rotation, shift - scale * rotation @ centre)))
    return [pose for _, pose in sorted(found, key=lambda h: -h[0])[:keep]]


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


def _centred(problem: Problem) -> Hypothesis:
    """The clouds' centres on each other, upright where gravity is known: a last resort that the gate has to reject."""
    ups, scale = problem.known.ups, problem.scales.centre
    rotation = np.eye(3) if ups is None else rotation_between(*ups)
    shift = problem.scene.points.mean(0) - scale * (rotation @ problem.object.points.mean(0))
    pose = Sim3(scale, rotation, shift)
    surfaces = problem.surfaces(scale, SCORE_FRACTION / 2, SURFACE_POINTS // 2)
    return Hypothesis(pose, "centres", score(*surfaces, pose, SCORE_FRACTION * problem.scene.diagonal, scale))
