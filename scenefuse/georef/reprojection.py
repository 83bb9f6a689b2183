"""A similarity between two sparse models by reprojection: each model's points in the other one's photos."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.transforms import Array, Sim3, Uncertainty
from scenefuse.geometry.icp import ScaleRange, moved_about, similarity_rows
from scenefuse.georef.landmarks import Landmarks


@dataclass(frozen=True)
class Observations:
    """Matched points of an object and a scene, and every observation of either.

    Attributes:
        x: (M, 3) the object's points.
        y: (M, 3) their partners in the scene.
        match: (K,) which match each observation belongs to.
        forward: the first `forward` observations were made in the scene's photos, the others in the object's.
        pose: (K, 3, 4) cam_from_model of the photo of the observation.
        rays: (K, 2) x / z and y / z observed.
        focal: (K,) pixels.
        photo: (K,) photo of the observation; the object's follow the scene's.
        pixel: (M, 2) what a pixel covers at the point: in the object's unit, in the scene's unit.
    """

    x: Array
    y: Array
    match: NDArray[np.int64]
    forward: int
    pose: Array
    rays: Array
    focal: Array
    photo: NDArray[np.int64]
    pixel: Array

    @property
    def photos(self) -> tuple[int, int]:
        """How many photos of the object and of the scene see these matches."""
        return len(set(self.photo[self.forward :])), len(set(self.photo[: self.forward]))

    def subset(self, chosen: NDArray[np.bool_]) -> "Observations":
        """The matches that an (M,) mask selects, with their observations."""
        rows = chosen[self.match]
        index = np.cumsum(chosen) - 1
        return Observations(
            self.x[chosen],
            self.y[chosen],
            index[self.match[rows]],
            int(rows[: self.forward].sum()),
            self.pose[rows],
            self.rays[rows],
            self.focal[rows],
            self.photo[rows],
            self.pixel[chosen],
        )


def observations(obj: Landmarks, scene: Landmarks, pairs: NDArray[np.int64]) -> Observations:
    """Collect the observations of matched points, (M, 2) rows of `obj` and `scene`."""
    in_scene, scene_match = scene.observations_of(pairs[:, 1])
    in_object, object_match = obj.observations_of(pairs[:, 0])
    scene_view, object_view = scene.seen_in[in_scene], obj.seen_in[in_object]
    return Observations(
        obj.points[pairs[:, 0]],
        scene.points[pairs[:, 1]],
        np.concatenate([scene_match, object_match]),
        len(in_scene),
        np.concatenate([scene.cam_from_model[scene_view], obj.cam_from_model[object_view]]),
        np.concatenate([scene.rays[in_scene], obj.rays[in_object]]),
        np.concatenate([scene.focal[scene_view], obj.focal[object_view]]),
        np.concatenate([scene_view, len(scene.photos) + object_view]),
        np.stack([obj.pixel_size(pairs[:, 0]), scene.pixel_size(pairs[:, 1])], axis=1),
    )


def residuals(seen: Observations, scene_from_object: Sim3) -> tuple[Array, Array]:
    """Reprojection errors (K, 2) in pixels of the coarser photo, and the points (K, 3) in their cameras.

    The object's points are projected into the scene's photos and the scene's points into the object's. A photo from
    near resolves more than the other model's point holds: its errors are counted in pixels of the coarser side.
    """
    n = seen.forward
    moved = np.concatenate(
        [scene_from_object.apply(seen.x)[seen.match[:n]], scene_from_object.inverse().apply(seen.y)[seen.match[n:]]]
    )
    in_cam = np.einsum("kij,kj->ki", seen.pose[:, :, :3], moved) + seen.pose[:, :, 3]
    depth = in_cam[:, 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = (in_cam[:, :2] / depth - seen.rays) * _gain(seen, scene_from_object.scale)[:, None]
    # Behind the camera: farther off than any photo is wide.
    error[depth[:, 0] <= 0] = 1e4
    return error, in_cam


def match_errors(seen: Observations, scene_from_object: Sim3) -> Array:
    """(M,) error of each match in pixels: the larger of the RMS in the scene's and in the object's photos."""
    squared = (residuals(seen, scene_from_object)[0] ** 2).sum(1)
    count = len(seen.x)
    sides = []
    for part in (slice(0, seen.forward), slice(seen.forward, None)):
        total = np.bincount(seen.match[part], squared[part], minlength=count)
        sides.append(total / np.maximum(np.bincount(seen.match[part], minlength=count), 1))
    return np.sqrt(np.maximum(*sides))


def minimise_reprojection(seen: Observations, start: Sim3, width_px: float) -> Sim3:
    """Gauss-Newton over the seven parameters with Cauchy weights of `width_px`, damped where it does not improve."""
    pose, damping = start, 1e-6
    cost = _cost(seen, pose, width_px)
    for _ in range(20):
        jacobian, error, weights = _linearise(seen, pose, width_px)
        normal, gradient = _normal(jacobian, error, weights)
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient).astype(np.float64)
        moved = moved_about(pose, step, _pivot(seen, pose), ScaleRange(1.0, np.inf), np.inf)
        lower = _cost(seen, moved, width_px)
        if lower < cost:
            pose, damping, done = moved, damping / 10, cost - lower < 1e-9 * cost
            cost = lower
            if done:
                break
        else:
            damping *= 100
    return pose


def bootstrap(seen: Observations, pose: Sim3, width_px: float, at: Array, draws: int, seed: int) -> Uncertainty:
    """Standard deviations of a refined pose when photos and matches are drawn again with replacement.

    An observation counts as often as its match was drawn times its photo was drawn, because observations of one point
    or of one photo err together (Owen 2007, the pigeonhole bootstrap). Each draw is one Gauss-Newton step from the
    pose.

    Args:
        seen: the inliers.
        pose: the refined scene_from_object.
        width_px: of the Cauchy weights.
        at: (3,) where the position is taken, in the object's frame.
        draws: number of draws.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    jacobian, error, weights = _linearise(seen, pose, width_px)
    lever = pose.apply(at) - _pivot(seen, pose)

    def redrawn(groups: NDArray[np.int64]) -> NDArray[np.int64]:
        """How often each observation's group is drawn when as many groups are drawn as there are."""
        names, index = np.unique(groups, return_inverse=True)
        return np.bincount(rng.integers(0, len(names), len(names)), minlength=len(names))[index]

    steps = []
    for _ in range(draws):
        photos = np.concatenate([redrawn(seen.photo[: seen.forward]), redrawn(seen.photo[seen.forward :])])
        normal, gradient = _normal(jacobian, error, weights * redrawn(seen.match) * photos)
        step = np.linalg.lstsq(normal, -gradient, rcond=1e-12)[0]
        shift = step[3:6] + np.cross(step[:3], lever) + step[6] * lever
        steps.append([*step[:3], *shift, step[6]])
    turn, shift, scale = (float(np.linalg.norm(part)) for part in np.split(np.std(steps, axis=0), [3, 6]))
    return Uncertainty.even(scale, float(np.degrees(turn)), shift)


def _gain(seen: Observations, scale: float) -> Array:
    """(K,) pixels of the coarser side per unit of x / z."""
    of_object, of_scene = scale * seen.pixel[:, 0], seen.pixel[:, 1]
    finer = np.concatenate(
        [
            np.minimum(1, of_scene / of_object)[seen.match[: seen.forward]],
            np.minimum(1, of_object / of_scene)[seen.match[seen.forward :]],
        ]
    )
    return seen.focal * finer


def _cost(seen: Observations, pose: Sim3, width_px: float) -> float:
    squared = (residuals(seen, pose)[0] ** 2).sum(1)
    return float(np.log1p(squared / width_px**2).sum())


def _linearise(seen: Observations, pose: Sim3, width_px: float) -> tuple[Array, Array, Array]:
    """Jacobian (K, 2, 7) of the errors by rotation about the pivot, shift and log scale; errors; Cauchy weights."""
    n, pivot = seen.forward, _pivot(seen, pose)
    error, in_cam = residuals(seen, pose)
    # Seen from the object, the scene's copy of a point moves the other way.
    lever = np.concatenate([pose.apply(seen.x)[seen.match[:n]], seen.y[seen.match[n:]]]) - pivot
    motion = similarity_rows(*np.broadcast_arrays(lever[:, None], np.eye(3)))
    motion[n:] = -(pose.rotation.T / pose.scale) @ motion[n:]
    in_camera = seen.pose[:, :, :3] @ motion
    depth = np.maximum(in_cam[:, 2], 1e-12)[:, None, None]
    slope = (in_camera[:, :2] - (in_cam[:, :2, None] / depth) * in_camera[:, 2:]) / depth
    jacobian = slope * _gain(seen, pose.scale)[:, None, None]
    weights = 1 / (1 + (error**2).sum(1) / width_px**2)
    weights[in_cam[:, 2] <= 0] = 0
    return jacobian, error, weights


def _normal(jacobian: Array, error: Array, weights: Array) -> tuple[Array, Array]:
    flat = jacobian.reshape(-1, 7)
    weighted = flat * np.repeat(weights, 2)[:, None]
    return weighted.T @ flat, weighted.T @ error.ravel()


def _pivot(seen: Observations, pose: Sim3) -> Array:
    """The middle of the matched points, about which steps turn and scale."""
    return pose.apply(np.median(seen.x, axis=0))
