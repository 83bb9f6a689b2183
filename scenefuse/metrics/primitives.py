"""Planes, spheres and cylinders in a cloud by RANSAC: the primitive fitting score."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenefuse.core.transforms import Array

# Candidates of each kind in a round.
CANDIDATES = 150
Mask = NDArray[np.bool_]
# Points and normals of candidates' two oriented points: p, q, u, v, each (K, 3).
Pairs = tuple[Array, Array, Array, Array]


def primitive_fitting_score(
    points: Array,
    normals: Array,
    tolerance: float,
    support: float,
    limit: int,
    angle_deg: float,
    seed: int,
) -> float:
    """Share of points on any of the primitives found one after the other (method G5).

    Each round draws planes (one oriented point), spheres and cylinders (two oriented points, Schnabel 2007) from
    neighbouring points that are left, takes the one with the largest connected set of inliers, and removes it.

    Args:
        points: (N, 3) new points.
        normals: (N, 3) unit normals, either side.
        tolerance: distance to the primitive.
        support: smallest share of N that makes a primitive.
        limit: largest number of primitives.
        angle_deg: largest angle between a point's normal and the primitive's.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    left = np.ones(len(points), dtype=bool)
    nearest = cKDTree(points).query(points, k=min(9, len(points)))[0]
    link = max(2 * tolerance, 1.5 * float(np.median(nearest[:, -1])))
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    cosine = np.cos(np.radians(angle_deg))
    for _ in range(limit):
        index = np.flatnonzero(left)
        if len(index) < max(support * len(points), 10):
            break
        taken = _best_primitive(points[index], normals[index], tolerance, cosine, link, size, rng)
        if len(taken) < support * len(points):
            break
        left[index[taken]] = False
    return float(1 - left.mean())


def _best_primitive(
    points: Array, normals: Array, tolerance: float, cosine: float, link: float, size: float, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Indices of the largest connected inlier set among one round of candidates."""
    first = rng.integers(0, len(points), CANDIDATES)
    # A partner from the neighbourhood lies on the same primitive far more often than one from anywhere.
    near = cKDTree(points).query(points[first], k=min(60, len(points)))[1]
    second = near[np.arange(CANDIDATES), rng.integers(min(10, len(points) - 1), near.shape[1], CANDIDATES)]
    pairs = points[first], points[second], normals[first], normals[second]
    masks = [kind(points, normals, pairs, tolerance, cosine, size) for kind in (_on_planes, _on_spheres, _on_cylinders)]
    inliers = np.concatenate(masks)
    counts = inliers.sum(1)
    best = np.array([], dtype=np.int64)
    for k in np.argsort(-counts, kind="stable")[:5]:
        if counts[k] <= len(best):
            break
        found = _largest_part(points, np.flatnonzero(inliers[k]), link)
        best = found if len(found) > len(best) else best
    return best


def _on_planes(points: Array, normals: Array, pairs: Pairs, tolerance: float, cosine: float, size: float) -> Mask:
    """The plane through the first point; its size is not limited."""
    anchor, _, normal, _ = pairs
    distance = np.abs(normal @ points.T - (normal * anchor).sum(1)[:, None])
    return (distance <= tolerance) & (np.abs(normal @ normals.T) >= cosine)


def _on_spheres(points: Array, normals: Array, pairs: Pairs, tolerance: float, cosine: float, size: float) -> Mask:
    """The centre is where the two normals' lines come nearest."""
    p, q, u, v = pairs
    along = (u * v).sum(1)
    w = p - q
    a, b, bottom = (u * w).sum(1), (v * w).sum(1), 1 - along**2
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (along * b - a) / bottom, (b - along * a) / bottom
    centre = (p + s[:, None] * u + q + t[:, None] * v) / 2
    r1, r2 = np.linalg.norm(p - centre, axis=1), np.linalg.norm(q - centre, axis=1)
    radius = (r1 + r2) / 2
    fine = np.isfinite(radius) & (radius < size) & (np.abs(r1 - r2) < 2 * tolerance) & (bottom > 1e-4)
    centre = np.where(fine[:, None], centre, 1e9)
    offset = points[None] - centre[:, None]
    length = np.linalg.norm(offset, axis=2)
    facing = np.abs((offset * normals).sum(2)) >= cosine * length
    return fine[:, None] & (np.abs(length - radius[:, None]) <= tolerance) & facing


def _on_cylinders(points: Array, normals: Array, pairs: Pairs, tolerance: float, cosine: float, size: float) -> Mask:
    """The axis is orthogonal to both normals; across it, the two normals' lines meet at the centre."""
    p, q, u, v = pairs
    axis = np.cross(u, v)
    length = np.linalg.norm(axis, axis=1)
    fine = length > 0.05
    axis = np.where(fine[:, None], axis / np.maximum(length, 1e-12)[:, None], [0.0, 0.0, 1.0])
    w = q - p
    w = w - (w * axis).sum(1, keepdims=True) * axis
    reach = (np.cross(w, v) * axis).sum(1) / np.where(fine, (np.cross(u, v) * axis).sum(1), 1)
    centre = p + reach[:, None] * u
    across = q - centre
    across = across - (across * axis).sum(1, keepdims=True) * axis
    r1, r2 = np.abs(reach), np.linalg.norm(across, axis=1)
    radius = (r1 + r2) / 2
    fine &= (np.abs(r1 - r2) < 2 * tolerance) & (radius < size / 2) & (radius > 2 * tolerance)
    offset = points[None] - centre[:, None]
    offset = offset - (offset @ axis[:, :, None]) * axis[:, None]
    away = np.linalg.norm(offset, axis=2)
    facing = np.abs((offset * normals).sum(2)) >= cosine * away
    return fine[:, None] & (np.abs(away - radius[:, None]) <= tolerance) & facing


def _largest_part(points: Array, index: NDArray[np.int64], link: float) -> NDArray[np.int64]:
    """The largest set of the indexed points whose cells of edge `link` touch."""
    if len(index) == 0:
        return index
    cells, cell_of = np.unique(np.floor(points[index] / link).astype(np.int64), axis=0, return_inverse=True)
    cell_of = cell_of.ravel()
    touching = cKDTree(cells).query_pairs(1.8, output_type="ndarray")
    graph = coo_matrix((np.ones(len(touching)), touching.T), shape=(len(cells), len(cells)))
    part = connected_components(graph, directed=False)[1][cell_of]
    return index[part == np.bincount(part).argmax()]
