"""Bundle adjustment: all poses, all points and the focal length together, which removes the drift that is left.

Matches are linked into tracks over many photos, so that the last photos of an orbit share points with the first.
Least squares of the reprojection errors by Levenberg and Marquardt, points eliminated first (Schur complement; Triggs
et al. 1999); errors have a Cauchy weight, and observations that stay far off are dropped.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_matrix, coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from scenefuse.poses.correspondences import PhotoFeatures, TwoViewPair

Array = NDArray[np.float64]

# Reprojection error at which an observation loses half its weight.
ROBUST_PX = 1.0
# After each adjustment, observations with larger errors are dropped, though none below three times the median.
DROP_PX = (8.0, 4.0, 2.5)
STEPS = 15
# Points whose rays spread less have no depth to adjust.
MIN_SPREAD_DEG = 1.5
# Raised damping tried before a step is given up; least relative gain that is worth another step.
MAX_TRIES, MIN_GAIN = 8, 1e-6
# Keeps blocks invertible, and depths off zero.
EPSILON = 1e-9
# Standard deviation of a focal length that was not measured, as its logarithm.
FOCAL_SPREAD = 0.1


@dataclass(frozen=True)
class Tracks:
    """N observations of P points.

    Attributes:
        photo: (N,) index of the photo.
        point: (N,) index of the point, 0 to P - 1, each seen in two photos or more.
        row: (N,) row of the feature in its photo.
        rays: (N, 2) of the feature, at depth 1.
        focal_px: (N,) of its photo.
    """

    photo: NDArray[np.int64]
    point: NDArray[np.int64]
    row: NDArray[np.int64]
    rays: Array
    focal_px: Array

    def keep(self, good: NDArray[np.bool_], points: Array) -> tuple["Tracks", Array]:
        """These observations only, of points that two photos or more still see, and those points."""
        enough = np.bincount(self.point[good], minlength=len(points)) >= 2
        good = good & enough[self.point]
        point = (np.cumsum(enough) - 1)[self.point[good]]
        kept = Tracks(self.photo[good], point, self.row[good], self.rays[good], self.focal_px[good])
        return kept, points[enough]


@dataclass(frozen=True)
class AdjustedBundle:
    """Poses and points after bundle adjustment.

    Attributes:
        graph_from_cam: (V, 4, 4).
        points: (P, 3).
        tracks: the observations that agree.
        focal_scale: the photos' focal length over the one that was given.
        error_px: root mean square reprojection error.
    """

    graph_from_cam: Array
    points: Array
    tracks: Tracks
    focal_scale: float
    error_px: float


def link_tracks(features: list[PhotoFeatures], pairs: list[TwoViewPair]) -> Tracks:
    """Tracks of all matches; a track that has two features of one photo is wrong somewhere and is left out."""
    start = np.cumsum([0, *(len(f.pixels) for f in features)])
    nodes = [(start[p.first] + p.rows[:, 0], start[p.second] + p.rows[:, 1]) for p in pairs]
    a, b = (np.concatenate(side) for side in zip(*nodes))
    graph = coo_matrix((np.ones(len(a)), (a, b)), shape=(start[-1], start[-1]))
    _, label = connected_components(graph, directed=False)
    size = np.bincount(label)
    node = np.flatnonzero(size[label] > 1)
    photo = np.searchsorted(start, node, side="right") - 1
    seen, twice = np.unique(np.column_stack([label[node], photo]), axis=0, return_counts=True)
    wrong = np.zeros(len(size), dtype=bool)
    wrong[seen[twice > 1, 0]] = True
    good = ~wrong[label[node]]
    node, photo = node[good], photo[good]
    row = node - start[photo]
    rays = np.concatenate([f.rays for f in features])[node]
    focal = np.array([f.focal_px for f in features])[photo]
    return Tracks(photo, np.unique(label[node], return_inverse=True)[1], row, rays, focal)


def triangulate(poses: Array, tracks: Tracks) -> Array:
    """(P, 3) points nearest to all their rays."""
    directions = _directions(poses, tracks)
    away = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    count = int(tracks.point.max()) + 1
    normal, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(normal, tracks.point, away)
    np.add.at(right, tracks.point, np.einsum("nij,nj->ni", away, poses[tracks.photo, :3, 3]))
    return np.asarray(np.linalg.solve(normal + EPSILON * np.eye(3), right[:, :, None])[:, :, 0], np.float64)


def adjust_bundle(poses: Array, tracks: Tracks, refine_focal: bool) -> AdjustedBundle:
    """Adjust (V, 4, 4) poses graph_from_cam, the tracks' points and, with `refine_focal`, one focal length for all."""
    points, focal = triangulate(poses, tracks), 0.0
    wide = _widest_angle_deg(poses, tracks, len(points))[tracks.point] > MIN_SPREAD_DEG
    tracks, points = tracks.keep(wide & (_depths(poses, points, tracks) > 0), points)
    for limit in DROP_PX:
        poses, points, focal = _minimise(poses, points, focal, tracks, refine_focal)
        error = np.linalg.norm(_errors(poses, points, focal, tracks), axis=1)
        good = (error < max(limit, 3.0 * float(np.median(error)))) & (_depths(poses, points, tracks) > 0)
        tracks, points = tracks.keep(good, points)
    poses, points, focal = _minimise(poses, points, focal, tracks, refine_focal)
    error = _errors(poses, points, focal, tracks)
    return AdjustedBundle(poses, points, tracks, float(np.exp(focal)), float(np.sqrt((error**2).sum(1).mean())))


def _minimise(
    poses: Array, points: Array, focal: float, tracks: Tracks, refine_focal: bool
) -> tuple[Array, Array, float]:
    damping, cost = 1e-4, _cost(poses, points, focal, tracks)
    for _ in range(STEPS):
        of_poses, of_points, error = _linearise(poses, points, focal, tracks)
        if not refine_focal:
            of_poses = of_poses[:, :-1]
        normal = (of_poses.T @ of_poses).toarray()
        right = of_poses.T @ error
        if refine_focal:
            normal[-1, -1] += FOCAL_SPREAD**-2
            right[-1] += focal * FOCAL_SPREAD**-2
        blocks = np.zeros((len(points), 3, 3))
        flat = of_points.data.reshape(-1, 2, 3)
        np.add.at(blocks, tracks.point, flat.swapaxes(1, 2) @ flat)
        right_points = of_points.T @ error
        mixed = of_poses.T @ of_points
        for _ in range(MAX_TRIES):
            diagonal = np.einsum("pii->pi", blocks)
            inverse = np.linalg.inv(blocks + (damping * diagonal + EPSILON)[:, :, None] * np.eye(3))
            number = np.arange(len(points) + 1)
            inverse = bsr_matrix((inverse, number[:-1], number), shape=(3 * len(points),) * 2)
            reduced = normal + np.diag(damping * normal.diagonal() + EPSILON) - (mixed @ inverse @ mixed.T).toarray()
            step = -np.linalg.lstsq(reduced, right - mixed @ (inverse @ right_points), rcond=None)[0]
            step_points = -(inverse @ (right_points + mixed.T @ step))
            turned = _moved(poses, step)
            placed = points + step_points.reshape(-1, 3)
            zoomed = focal + float(step[-1]) if refine_focal else focal
            new_cost = _cost(turned, placed, zoomed, tracks)
            if new_cost < cost:
                break
            damping *= 10.0
        else:
            break
        gain = 1.0 - new_cost / cost
        poses, points, focal, cost, damping = turned, placed, zoomed, new_cost, max(damping / 10.0, EPSILON)
        if gain < MIN_GAIN:
            break
    return poses, points, focal


def _linearise(poses: Array, points: Array, focal: float, tracks: Tracks) -> tuple[csr_matrix, csr_matrix, Array]:
    """Weighted Jacobians by poses (6 each, and the focal length's logarithm last) and points, and weighted errors."""
    count, in_cam = len(tracks.photo), _in_cam(poses, points, tracks)
    x, y, z = in_cam.T
    z = np.where(np.abs(z) < EPSILON, EPSILON, z)
    zero, scale = np.zeros(count), tracks.focal_px * np.exp(focal)
    rows_of_projection = [np.stack([1 / z, zero, -x / z**2], 1), np.stack([zero, 1 / z, -y / z**2], 1)]
    project = scale[:, None, None] * np.stack(rows_of_projection, 1)
    error = _errors(poses, points, focal, tracks)
    weight = np.sqrt(_weight(error))[:, None]
    cam_from_object = poses[tracks.photo, :3, :3].swapaxes(1, 2)
    by_point = weight[:, :, None] * (project @ cam_from_object)
    # the camera turns by w and moves by m in its own axes: x_in_cam' = x_in_cam - w x x_in_cam - m
    cross = np.stack([np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], 1)
    by_pose = weight[:, :, None] * np.concatenate([project @ cross, -project], 2)
    by_focal = weight * (error + scale[:, None] * tracks.rays)
    rows = np.arange(2 * count).reshape(count, 2)
    columns = 6 * tracks.photo[:, None] + np.arange(6)
    data = np.concatenate([by_pose, by_focal[:, :, None]], 2)
    columns = np.concatenate([columns, np.full((count, 1), 6 * len(poses))], 1)
    of_poses = csr_matrix(
        (data.ravel(), (np.repeat(rows, 7), np.repeat(columns, 2, 0).reshape(count, 2, 7).ravel())),
        shape=(2 * count, 6 * len(poses) + 1),
    )
    of_points = bsr_matrix(
        (by_point, tracks.point, np.arange(count + 1)), shape=(2 * count, 3 * len(points)), blocksize=(2, 3)
    )
    return of_poses, of_points, (weight * error).ravel()


def _moved(poses: Array, step: Array) -> Array:
    """Poses after a step of six numbers each: a turn and a move in the camera's own axes."""
    motion = step[: 6 * len(poses)].reshape(-1, 6)
    moved = poses.copy()
    moved[:, :3, 3] += np.einsum("vij,vj->vi", poses[:, :3, :3], motion[:, 3:])
    moved[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(motion[:, :3]).as_matrix()
    return moved


def _errors(poses: Array, points: Array, focal: float, tracks: Tracks) -> Array:
    """(N, 2) reprojection errors in pixels; a longer focal length sees each feature's ray nearer to the axis."""
    in_cam = _in_cam(poses, points, tracks)
    z = np.where(np.abs(in_cam[:, 2]) < EPSILON, EPSILON, in_cam[:, 2])
    return tracks.focal_px[:, None] * (np.exp(focal) * in_cam[:, :2] / z[:, None] - tracks.rays)


def _weight(error: Array) -> Array:
    return 1.0 / (1.0 + (error**2).sum(1) / ROBUST_PX**2)


def _cost(poses: Array, points: Array, focal: float, tracks: Tracks) -> float:
    error = (_errors(poses, points, focal, tracks) ** 2).sum(1)
    return float((ROBUST_PX**2 * np.log1p(error / ROBUST_PX**2)).sum() + (focal / FOCAL_SPREAD) ** 2)


def _in_cam(poses: Array, points: Array, tracks: Tracks) -> Array:
    offset = points[tracks.point] - poses[tracks.photo, :3, 3]
    return np.einsum("nji,nj->ni", poses[tracks.photo, :3, :3], offset)


def _depths(poses: Array, points: Array, tracks: Tracks) -> Array:
    return _in_cam(poses, points, tracks)[:, 2]


def _directions(poses: Array, tracks: Tracks) -> Array:
    rays = np.column_stack([tracks.rays, np.ones(len(tracks.rays))])
    directions = np.einsum("nij,nj->ni", poses[tracks.photo, :3, :3], rays)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _widest_angle_deg(poses: Array, tracks: Tracks, count: int) -> Array:
    """(P,) spread of each point's rays about their mean, as an angle."""
    directions, total = _directions(poses, tracks), np.zeros((count, 3))
    np.add.at(total, tracks.point, directions)
    cosine = (directions * (total / np.linalg.norm(total, axis=1, keepdims=True))[tracks.point]).sum(1)
    widest = np.zeros(count)
    np.maximum.at(widest, tracks.point, np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return 2.0 * widest
