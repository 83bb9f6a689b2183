"""FPFH features and similarity RANSAC over their matches."""

import numpy as np
from numpy.typing import NDArray

from scenefuse.registration.refine import ScaleRange
from scenefuse.registration.surface import Surface
from scenefuse.transforms import Array, Sim3


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

    A triple is kept when its three edges ask for one scale to 10 % (the edge-length check, with a free but bounded
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
    triples = np.random.default_rng(seed).integers(0, len(x), (samples, 3))
    edges_x = np.stack([np.linalg.norm(x[triples[:, i]] - x[triples[:, i - 1]], axis=1) for i in range(3)])
    edges_y = np.stack([np.linalg.norm(y[triples[:, i]] - y[triples[:, i - 1]], axis=1) for i in range(3)])
    ratio = edges_y / np.maximum(edges_x, 1e-12)
    middle = np.exp(np.log(np.maximum(ratio, 1e-12)).mean(0))
    good = (edges_y.min(0) > 3 * tau) & (ratio.min(0) > 0.9 * ratio.max(0))
    good &= np.abs(np.log(np.maximum(middle, 1e-12) / scales.centre)) <= scales.width + 0.05
    triples, middle = triples[good], middle[good]
    if len(triples) == 0:
        return []
    rotations = _triangle_rotations(x[triples], y[triples])
    if ups is not None:
        upright = (rotations @ ups[0]) @ ups[1] >= np.cos(np.radians(max_tilt_deg))
        triples, middle, rotations = triples[upright], middle[upright], rotations[upright]
    triples, middle, rotations = triples[:2000], middle[:2000], rotations[:2000]
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
