"""Similarity refinement on two-way pairs: Tukey-weighted points first, then planes and colours."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from scenefuse.registration.score import Pairs, color_gain, pair
from scenefuse.registration.surface import Surface
from scenefuse.transforms import Array, Sim3, fit_sim3

POINT_WEIGHT = 0.1
SETTLED = 0.005
OFF_SCALE = 1.03
HALF_ROUNDS = 30


@dataclass(frozen=True)
class ScaleRange:
    """The scale prior: a centre and a width, as natural logarithm; width 0 holds the scale fixed."""

    centre: float
    width: float

    def clamp(self, scale: float) -> float:
        """The nearest scale inside the prior."""
        return float(np.clip(scale, self.centre * np.exp(-self.width), self.centre * np.exp(self.width)))

    def widened(self, more: float) -> "ScaleRange":
        """A wider prior; one of no width stays fixed."""
        return ScaleRange(self.centre, self.width + more if self.width > 0 else 0.0)

    def at_edge(self, scale: float) -> bool:
        """Whether a scale presses against a bound of the prior: then the truth may lie outside."""
        return self.width > 0 and abs(np.log(scale / self.centre)) > self.width - 0.01


def refine_points(
    obj: Surface, scene: Surface, start: Sim3, scales: ScaleRange, tau: tuple[float, float], rounds: int
) -> Sim3:
    """Two-way ICP with Tukey weights and Horn's symmetric scale (Horn 1987), threshold shrinking from tau[0] to tau[1].

    Pairs from both directions count alike: a one-way fit with free scale shrinks the object.
    """
    pose = start
    for step in range(rounds):
        threshold = tau[0] * (tau[1] / tau[0]) ** (step / max(rounds - 1, 1))
        pairs = pair(obj, scene, pose, threshold)
        backward = len(pairs.distance) - pairs.forward
        if pairs.forward < 10 or backward < 10:
            return pose
        weights = _two_way_weights(pairs, threshold)
        x, y = obj.points[pairs.object_index], scene.points[pairs.scene_index]
        mean_x, mean_y = weights @ x / weights.sum(), weights @ y / weights.sum()
        spread_x, spread_y = weights @ ((x - mean_x) ** 2).sum(1), weights @ ((y - mean_y) ** 2).sum(1)
        pose = fit_sim3(x, y, weights, scale=scales.clamp(float(np.sqrt(spread_y / spread_x))))
    return pose


def refine_planes(
    obj: Surface,
    scene: Surface,
    start: Sim3,
    scales: ScaleRange,
    tau: float,
    rounds: int,
    color_weight: float,
) -> Sim3:
    """Gauss-Newton over the seven parameters: planes and points both ways, and colours along the scene's surface.

    A colour row compares the object's colour (after a gain and bias) with the scene's colour carried to the same
    place along its tangent plane (Park, Zhou, Koltun 2017). Both kinds of rows are divided by their own robust spread.

    Args:
        obj: the object in its own frame.
        scene: the scene crop.
        start: scene_from_object to begin with.
        scales: bounds of the scale.
        tau: pairs within this distance, scene units.
        rounds: iterations at most; a step that moves the points by less than 0.5 % of `tau` is the last.
        color_weight: weight of the colour rows; 0 for geometry alone.
    """
    pose = start
    for _ in range(rounds):
        rows = _rows(obj, scene, pose, tau, color_weight)
        if rows is None:
            return pose
        system, right = rows.normal_equations()
        if scales.width == 0:
            system[6], system[:, 6], right[6], system[6, 6] = 0, 0, 0, 1
        step = -np.linalg.solve(system + 1e-9 * np.trace(system) / 7 * np.eye(7), right)
        pose = _apply_step(pose, step, rows.centre, scales)
        if _motion(step, rows) < SETTLED * tau:
            break
    return pose


def _motion(step: Array, rows: "_Rows") -> float:
    """How far a step moves the paired points, scene units."""
    return float(np.linalg.norm(step[3:6]) + rows.reach * (np.linalg.norm(step[:3]) + abs(step[6])))


@dataclass(frozen=True)
class Uncertainty:
    """Spread of a pose over resampled surfaces.

    Attributes:
        scale_sd_log: standard deviation of the scale, natural logarithm.
        rotation_sd_deg: standard deviation of the rotation about its least certain axis, degrees.
        rotation_axis: (3,) that axis, in the scene.
        translation_sd: standard deviation of the object's centre along its least certain direction, scene units.
        covariance: (7, 7) of rotation vector (radians), translation (scene units) and log scale, about that centre.
    """

    scale_sd_log: float
    rotation_sd_deg: float
    rotation_axis: Array
    translation_sd: float
    covariance: Array

    @classmethod
    def even(cls, scale_sd_log: float, rotation_sd_deg: float, translation_sd: float) -> "Uncertainty":
        """The same spread in all directions."""
        variances = np.array([np.radians(rotation_sd_deg)] * 3 + [translation_sd] * 3 + [scale_sd_log]) ** 2
        return cls(scale_sd_log, rotation_sd_deg, np.array([0.0, 0.0, 1.0]), translation_sd, np.diag(variances))

    def size(self, diagonal: float) -> float:
        """One number to compare spreads by: how far it moves a point half a diagonal off the centre, over it."""
        turn, shift = np.radians(self.rotation_sd_deg) / 2, self.translation_sd / diagonal
        return float(np.sqrt((self.scale_sd_log / 2) ** 2 + turn**2 + shift**2))


def uncertainty(
    surfaces: list[tuple[Surface, Surface]],
    pose: Sim3,
    scales: ScaleRange,
    tau: float,
    color_weight: float,
    resamplings: int,
    seed: int,
) -> Uncertainty | None:
    """Half-sampling (Politis, Romano 1994): refine again and again with half of the surface's pieces, drawn at random.

    Pieces are a sixth of the scene crop's diagonal wide, so that what is correlated stays together. The deviation of a
    half's pose from the whole's has the spread that the whole's has from the truth. New pairs are made each time; a
    bootstrap of fixed pairs is some five times too sure of itself. Taking turns with differently thinned clouds lets
    a pose that hangs on the thinning show it, and beginning 3 % too small or too large lets one show that stays where
    it is put.

    Args:
        surfaces: object and scene at one or more spacings, in turn.
        pose: scene_from_object of the whole.
        scales: bounds of the scale.
        tau: see `refine_planes`.
        color_weight: see `refine_planes`.
        resamplings: halves drawn.
        seed: of the halves.

    Returns:
        The spread, or None with fewer than eight pieces to draw from.
    """
    centre = surfaces[0][0].points.mean(0)
    edge = float(np.linalg.norm(np.ptp(surfaces[0][1].points, axis=0))) / 6
    rng = np.random.default_rng(seed)
    deviations = np.zeros((resamplings, 7))
    for k in range(resamplings):
        obj, scene = surfaces[k % len(surfaces)]
        places = np.concatenate([scene.points, pose.apply(obj.points)])
        piece = np.unique(np.floor(places / edge).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
        in_scene, in_object = piece[: len(scene)], piece[len(scene) :]
        pieces = np.unique(in_scene)
        if len(pieces) < 8:
            return None
        chosen = np.zeros(piece.max() + 1, dtype=bool)
        chosen[rng.permutation(pieces)[: len(pieces) // 2]] = True
        half_object = replace(obj, probe=obj.probe[chosen[in_object[obj.probe]]])
        half_scene = replace(scene, probe=scene.probe[chosen[in_scene[scene.probe]]])
        factor = OFF_SCALE if k // len(surfaces) % 2 else 1 / OFF_SCALE
        start = Sim3(factor, np.eye(3), (1 - factor) * pose.apply(centre)) @ pose
        other = refine_planes(half_object, half_scene, start, scales, tau, HALF_ROUNDS, color_weight)
        deviations[k, :3] = Rotation.from_matrix(other.rotation @ pose.rotation.T).as_rotvec()
        deviations[k, 3:6] = other.apply(centre) - pose.apply(centre)
        deviations[k, 6] = np.log(other.scale / pose.scale)
    covariance = deviations.T @ deviations / resamplings
    turn, axes = np.linalg.eigh(covariance[:3, :3])
    return Uncertainty(
        float(np.sqrt(covariance[6, 6])),
        float(np.degrees(np.sqrt(max(turn[-1], 0)))),
        axes[:, -1],
        float(np.sqrt(max(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1], 0))),
        covariance,
    )


@dataclass(frozen=True)
class _Rows:
    """The linearised fit at one pose: `jacobian` step + `residual` = 0, over rotation, translation and log scale.

    Attributes:
        jacobian: (M, 7).
        residual: (M,).
        weight: (M,).
        centre: (3,) that the step turns and grows about.
        reach: RMS distance of the paired points from it.
    """

    jacobian: Array
    residual: Array
    weight: Array
    centre: Array
    reach: float

    def normal_equations(self) -> tuple[Array, Array]:
        return self.jacobian.T @ (self.weight[:, None] * self.jacobian), self.jacobian.T @ (self.weight * self.residual)


def _rows(obj: Surface, scene: Surface, pose: Sim3, tau: float, color_weight: float) -> _Rows | None:
    """Rows of the pairs both ways, None with too few: point-to-plane, a little point-to-point against the sliding that
    planes leave free, and colours where both sides have them."""
    pairs = _without_overhang(obj, scene, pose, tau, pair(obj, scene, pose, tau))
    if min(pairs.forward, len(pairs.distance) - pairs.forward) < 10:
        return None
    p, q = pose.apply(obj.points[pairs.object_index]), scene.points[pairs.scene_index]
    centre = p.mean(0)
    # The object's normals: its cloud is the denser and the cleaner one.
    normals = pose.rotate(obj.normals[pairs.object_index])
    facing = np.abs((normals * scene.normals[pairs.scene_index]).sum(1))
    weights = _two_way_weights(pairs, tau) * np.sqrt(facing)
    parts = [_weighted(p - centre, normals, ((p - q) * normals).sum(1), weights)]
    for axis in np.eye(3):
        along = np.broadcast_to(axis, p.shape)
        parts.append(_weighted(p - centre, along, (p - q) @ axis, POINT_WEIGHT * weights))
    if color_weight > 0 and obj.colors is not None and scene.colors is not None:
        gain, bias = color_gain(obj, scene, pairs)
        ahead = slice(0, pairs.forward)
        slopes = scene.color_slopes()[pairs.scene_index[ahead]]
        mine = gain * obj.colors[pairs.object_index[ahead]] + bias
        theirs = scene.colors[pairs.scene_index[ahead]] + np.einsum("nck,nk->nc", slopes, (p - q)[ahead])
        for channel in range(3):
            off = (theirs - mine)[:, channel]
            parts.append(_weighted((p - centre)[ahead], slopes[:, channel], off, color_weight / 3 * weights[ahead]))
    jacobian, residual, weight = (np.concatenate(kind) for kind in zip(*parts))
    return _Rows(jacobian, residual, weight, centre, float(np.sqrt(((p - centre) ** 2).sum(1).mean())))


def _without_overhang(obj: Surface, scene: Surface, pose: Sim3, tau: float, pairs: Pairs) -> Pairs:
    """The pairs without object points beyond the rim of what the scene shows.

    They all meet the rim and would pull inwards: the less the scene shows, the more the object would shrink (Turk and
    Levoy 1994 leave out pairs at rims for that). They are known by their partner's own nearest object point, which is
    more than half of `tau` away.
    """
    ahead = slice(0, pairs.forward)
    own = obj.nearest(pose.inverse().apply(scene.points[pairs.scene_index[ahead]]), np.inf)[1]
    aside = np.linalg.norm(obj.points[own] - obj.points[pairs.object_index[ahead]], axis=1) * pose.scale
    keep = np.concatenate([aside < tau / 2, np.ones(len(pairs.distance) - pairs.forward, dtype=bool)])
    kept = int(keep[ahead].sum())
    return Pairs(pairs.object_index[keep], pairs.scene_index[keep], pairs.distance[keep], kept)


def _two_way_weights(pairs: Pairs, tau: float) -> Array:
    """Tukey's biweight of the distance; each direction sums to a half."""
    weights = (1 - np.minimum(pairs.distance / tau, 1) ** 2) ** 2
    ahead, back = weights[: pairs.forward].sum(), weights[pairs.forward :].sum()
    share = np.where(np.arange(len(weights)) < pairs.forward, 1 / max(ahead, 1e-12), 1 / max(back, 1e-12))
    return 0.5 * weights * share


def _weighted(lever: Array, direction: Array, residual: Array, weight: Array) -> tuple[Array, Array, Array]:
    """Rows direction . (rotation x lever + translation + growth lever) + residual, and their Huber weights.

    Residuals are divided by their robust spread, so that kinds of rows can be added.
    """
    spread = 1.4826 * np.median(np.abs(residual - np.median(residual))) + 1e-12
    weight = weight * np.minimum(1, 2 * spread / np.maximum(np.abs(residual), 1e-12)) / spread**2
    jacobian = np.concatenate(
        [np.cross(lever, direction), direction, (lever * direction).sum(1, keepdims=True)], axis=1
    )
    return jacobian, residual, weight


def _apply_step(pose: Sim3, step: Array, centre: Array, scales: ScaleRange) -> Sim3:
    """Rotate and grow about `centre`, shift, and keep the scale in its prior."""
    angle = np.linalg.norm(step[:3])
    rotation = np.eye(3)
    if angle > 0:
        x, y, z = step[:3] / angle
        k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    scale = scales.clamp(pose.scale * float(np.exp(np.clip(step[6], -0.05, 0.05))))
    growth = scale / pose.scale
    about = Sim3(growth, rotation, centre + step[3:6] - growth * (rotation @ centre))
    moved = about @ pose
    return Sim3(scale, moved.rotation, moved.translation)
