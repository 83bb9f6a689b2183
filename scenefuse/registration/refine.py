"""Similarity refinement on two-way pairs: Tukey-weighted points first, then planes and colours."""

from dataclasses import dataclass

import numpy as np

from scenefuse.registration.score import Pairs, color_gain, pair
from scenefuse.registration.surface import Surface
from scenefuse.stage import threads
from scenefuse.transforms import Array, Sim3, fit_sim3


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
    """Gauss-Newton over the seven parameters: point-to-plane both ways, and colours along the scene's surface.

    A colour row compares the object's colour (after a gain and bias) with the scene's colour carried to the same
    place along its tangent plane (Park, Zhou, Koltun 2017). Both kinds of rows are divided by their own robust spread.

    Args:
        obj: the object in its own frame.
        scene: the scene crop.
        start: scene_from_object to begin with.
        scales: bounds of the scale.
        tau: pairs within this distance, scene units.
        rounds: iterations.
        color_weight: weight of the colour rows; 0 for geometry alone.
    """
    use_colors = color_weight > 0 and obj.colors is not None and scene.colors is not None
    gradients = _color_gradients(scene) if use_colors else None
    pose, fixed = start, scales.width == 0
    for _ in range(rounds):
        pairs = pair(obj, scene, pose, tau)
        if min(pairs.forward, len(pairs.distance) - pairs.forward) < 10:
            return pose
        p, q = pose.apply(obj.points[pairs.object_index]), scene.points[pairs.scene_index]
        centre = p.mean(0)
        n_scene = scene.normals[pairs.scene_index]
        n_object = pose.rotate(obj.normals[pairs.object_index])
        sign = np.sign((n_scene * n_object).sum(1))
        normals = n_scene + np.where(sign == 0, 1, sign)[:, None] * n_object
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        weights = _two_way_weights(pairs, tau) * np.abs((n_scene * n_object).sum(1))
        residuals = ((p - q) * normals).sum(1)
        system, right = _normal_equations(p - centre, normals, residuals, weights)
        if gradients is not None:
            assert obj.colors is not None and scene.colors is not None
            gain, bias = color_gain(obj, scene, pairs)
            ahead = slice(0, pairs.forward)
            slopes = gradients[pairs.scene_index[ahead]]
            mine = gain * obj.colors[pairs.object_index[ahead]] + bias
            theirs = scene.colors[pairs.scene_index[ahead]] + np.einsum("nck,nk->nc", slopes, (p - q)[ahead])
            for channel in range(3):
                more, less = _normal_equations(
                    (p - centre)[ahead],
                    slopes[:, channel],
                    (theirs - mine)[:, channel],
                    color_weight / 3 * weights[ahead],
                )
                system, right = system + more, right + less
        if fixed:
            system[6], system[:, 6], right[6], system[6, 6] = 0, 0, 0, 1
        step = -np.linalg.solve(system + 1e-9 * np.trace(system) / 7 * np.eye(7), right)
        pose = _apply_step(pose, step, centre, scales)
    return pose


def _two_way_weights(pairs: Pairs, tau: float) -> Array:
    """Tukey's biweight of the distance; each direction sums to a half."""
    weights = (1 - np.minimum(pairs.distance / tau, 1) ** 2) ** 2
    ahead, back = weights[: pairs.forward].sum(), weights[pairs.forward :].sum()
    share = np.where(np.arange(len(weights)) < pairs.forward, 1 / max(ahead, 1e-12), 1 / max(back, 1e-12))
    return 0.5 * weights * share


def _normal_equations(arm: Array, direction: Array, residual: Array, weight: Array) -> tuple[Array, Array]:
    """J^T W J (7, 7) and J^T W r (7,) of rows direction . (rotation x arm + translation + growth arm) + residual.

    Residuals are divided by their robust spread and get Huber weights.
    """
    spread = 1.4826 * np.median(np.abs(residual - np.median(residual))) + 1e-12
    weight = weight * np.minimum(1, 2 * spread / np.maximum(np.abs(residual), 1e-12)) / spread**2
    rows = np.concatenate([np.cross(arm, direction), direction, (arm * direction).sum(1, keepdims=True)], axis=1)
    return rows.T @ (weight[:, None] * rows), rows.T @ (weight * residual)


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


def _color_gradients(surface: Surface, neighbours: int = 20) -> Array:
    """Slope of each colour channel along the tangent plane, (N, 3 channels, 3), by least squares on neighbours."""
    assert surface.colors is not None
    index = surface.tree.query(surface.points, k=min(neighbours, len(surface)), workers=threads())[1]
    offset = surface.points[index] - surface.points[:, None]
    normals = surface.normals[:, None]
    offset = offset - (offset * normals).sum(2, keepdims=True) * normals
    change = surface.colors[index] - surface.colors[:, None]
    normal_matrix = np.einsum("nki,nkj->nij", offset, offset)
    # The normal direction carries no colour; a unit there keeps the system regular.
    scale = np.trace(normal_matrix, axis1=1, axis2=2)[:, None, None] + 1e-12
    normal_matrix = normal_matrix + scale * np.einsum("ni,nj->nij", surface.normals, surface.normals)
    right = np.einsum("nki,nkc->nic", offset, change)
    solved = np.linalg.solve(normal_matrix + 1e-3 * scale * np.eye(3), right)
    return np.swapaxes(solved, 1, 2)
