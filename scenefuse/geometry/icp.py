"""Similarities by ICP and RANSAC: two surfaces by Tukey-weighted points, then by planes and colours; sparse points on a
cloud; triples of matches."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scenefuse.cloud.clouds import NEIGHBOURS, plane_normals
from scenefuse.core.stage import threads
from scenefuse.core.transforms import SD_OVER_MEDIAN, Array, Sim3, fit_sim3
from scenefuse.geometry.surface import SAMPLED_POINTS, Pairs, Surface, color_gain, pair

# Weight of point-to-point rows beside point-to-plane rows: enough to stop sliding, too little to hold planes back.
POINT_WEIGHT = 0.1
# Weight of colour rows against geometry in the polish; both are in units of their own spread.
COLOR_WEIGHT = 0.3
# A linearised step changes the scale by this at most (natural logarithm).
MAX_SCALE_STEP = 0.05
# This share of a model's points that are laid on a cloud counts, those nearest: others are off its surface, or
# mismatched.
NEAREST_SHARE = 0.7
# How much the scales of a triple's three edges may differ, least over largest; triples that are tried on all matches;
# their best poses, which are refined.
MIN_EDGE_RATIO, MAX_TRIPLES, RANSAC_POSES = 0.9, 2000, 8


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


def refine_points(obj: Surface, scene: Surface, start: Sim3, scales: ScaleRange, tau: tuple[float, float]) -> Sim3:
    """Two-way ICP with Tukey weights and Horn's symmetric scale (Horn 1987), threshold shrinking from tau[0] to tau[1].

    Pairs from both directions count alike: a one-way fit with free scale shrinks the object.
    """
    pose = start
    for threshold in np.geomspace(*tau, 25):
        pairs = pair(obj, scene, pose, threshold)
        backward = len(pairs.distance) - pairs.forward
        if min(pairs.forward, backward) < 7:  # as many as a similarity has parameters
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
    color_weight: float = COLOR_WEIGHT,
    rounds: int = 60,
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
        color_weight: weight of the colour rows; 0 for geometry alone.
        rounds: iterations at most; a step that moves the points by less than 0.5 % of `tau` is the last.
    """
    pose = start
    for _ in range(rounds):
        rows = _rows(obj, scene, pose, tau, color_weight)
        if rows is None:
            return pose
        system, right, centre, reach = rows
        if scales.width == 0:
            system[6], system[:, 6], right[6], system[6, 6] = 0, 0, 0, 1
        step = np.asarray(-np.linalg.solve(system * (1 + 1e-9 * np.eye(7)), right), np.float64)
        pose = moved_about(pose, step, centre, scales)
        # How far the step moves the paired points.
        if np.linalg.norm(step[3:6]) + reach * (np.linalg.norm(step[:3]) + abs(step[6])) < 0.005 * tau:
            break
    return pose


def refine_on_cloud(own: Array, points: Array) -> Sim3:
    """The similarity that lays a model's own points (M, 3) on a cloud (N, 3), both nearly in the same place.

    Point to plane (Chen and Medioni 1992), of the nearest 70 % at each step (trimmed ICP, Chetverikov et al. 2005); a
    plane is fitted to the neighbours in the cloud. What a flat cloud leaves open stays, by weak point-to-point rows.
    """
    own, tree, found = own[:: max(1, len(own) // SAMPLED_POINTS)], cKDTree(points), Sim3.identity()
    for _ in range(20):
        moved = found.apply(own)
        distance, near = tree.query(moved, NEIGHBOURS, workers=threads())
        rows = np.argsort(distance[:, 0])[: max(NEIGHBOURS, int(NEAREST_SHARE * len(own)))]
        normals, middle = plane_normals(points, near[rows]), points[near[rows]].mean(1)
        moved = moved[rows]
        off = ((moved - middle) * normals).sum(1)
        # Levers end on the planes: noise of the model beside a flat cloud is no relief, which a smaller scale fits.
        places = [moved - off[:, None] * normals, *[moved] * 3]
        # Half the weight: beside a cloud's border the nearest points lie inwards.
        axes = POINT_WEIGHT / 2 * np.eye(3)
        along = np.concatenate([normals, *(np.broadcast_to(axis, moved.shape) for axis in axes)])
        apart = np.concatenate([off, *((moved - points[near[rows, 0]]) @ axes).T])
        found = step_to_planes(found, np.concatenate(places), along, apart)
    return found


def step_to_planes(pose: Sim3, moved: Array, normals: Array, off: Array) -> Sim3:
    """A pose after one step of Gauss-Newton that brings points to planes (Chen and Medioni 1992).

    Args:
        pose: of the points.
        moved: (N, 3) the points at that pose.
        normals: (N, 3) unit normals of their planes.
        off: (N,) distances from these, along the normals.
    """
    centre = moved.mean(0)
    step = np.asarray(-np.linalg.lstsq(similarity_rows(moved - centre, normals), off, rcond=None)[0], np.float64)
    return moved_about(pose, step, centre, ScaleRange(1.0, np.inf), 2 * MAX_SCALE_STEP)


def similarity_rows(lever: Array, direction: Array) -> Array:
    """(..., 7) how far points move along a direction (..., 3) by a small rotation, shift and log scale about a centre.

    `lever` (..., 3) is from the centre to the points.
    """
    (x, y, z), (u, v, w) = np.moveaxis(lever, -1, 0), np.moveaxis(direction, -1, 0)
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u, u, v, w, x * u + y * v + z * w], axis=-1)


def moved_about(
    pose: Sim3, step: Array, centre: Array, scales: ScaleRange, max_scale_step: float = MAX_SCALE_STEP
) -> Sim3:
    """A pose after a step (7,) of rotation vector, shift and log scale about a centre (3,) in the scene."""
    rotation = Rotation.from_rotvec(step[:3]).as_matrix()
    factor = float(np.exp(np.clip(step[6], -max_scale_step, max_scale_step)))
    growth = scales.clamp(pose.scale * factor) / pose.scale
    return Sim3(growth, rotation, centre + step[3:6] - growth * (rotation @ centre)) @ pose


def change_between(pose: Sim3, other: Sim3, at: Array) -> Array:
    """(7,) what `moved_about` undoes: rotation vector, shift and log scale from a pose to another, about where both
    have (3,) of the object."""
    turn = Rotation.from_matrix(other.rotation @ pose.rotation.T).as_rotvec()
    return np.array([*turn, *(other.apply(at) - pose.apply(at)), np.log(other.scale / pose.scale)])


def _rows(
    obj: Surface, scene: Surface, pose: Sim3, tau: float, color_weight: float
) -> tuple[Array, Array, Array, float] | None:
    """Rows of the pairs both ways, None with too few: point-to-plane, a little point-to-point against the sliding that
    planes leave free, and colours where both sides have them.

    Returns:
        The fit at the pose, linear in rotation, translation and log scale: normal equations (7, 7) and (7,), of which
        the first times the step, plus the second, is 0; the centre (3,) that the step turns and grows about; the RMS
        distance of the paired points from it.
    """
    pairs = _without_overhang(obj, scene, pose, tau, pair(obj, scene, pose, tau))
    if min(pairs.forward, len(pairs.distance) - pairs.forward) < 7:
        return None
    p, q = pose.apply(obj.points[pairs.object_index]), scene.points[pairs.scene_index]
    centre = p.mean(0)
    # The object's normals: its cloud is the denser and the cleaner one.
    normals = pose.rotate(obj.normals[pairs.object_index])
    facing = np.abs((normals * scene.normals[pairs.scene_index]).sum(1))
    weights = _two_way_weights(pairs, tau) * np.sqrt(facing)
    lever, off = p - centre, p - q
    parts = [_weighted(lever, normals, (off * normals).sum(1), weights)]
    for axis in np.eye(3):
        parts.append(_weighted(lever, np.broadcast_to(axis, p.shape), off @ axis, POINT_WEIGHT * weights))
    if color_weight > 0 and obj.colors is not None and scene.colors is not None:
        gain, bias = color_gain(obj, scene, pairs)
        ahead = slice(0, pairs.forward)
        slopes = scene.color_slopes()[pairs.scene_index[ahead]]
        mine = gain * obj.colors[pairs.object_index[ahead]] + bias
        theirs = scene.colors[pairs.scene_index[ahead]] + np.einsum("nck,nk->nc", slopes, off[ahead])
        for channel in range(3):
            change = (theirs - mine)[:, channel]
            parts.append(_weighted(lever[ahead], slopes[:, channel], change, color_weight / 3 * weights[ahead]))
    systems, rights = zip(*parts)
    return sum(systems), sum(rights), centre, float(np.sqrt((lever**2).sum(1).mean()))


def _without_overhang(obj: Surface, scene: Surface, pose: Sim3, tau: float, pairs: Pairs) -> Pairs:
    """The pairs without object points beyond the rim of what the scene shows.

    They all meet the rim and would pull inwards: the less the scene shows, the more the object would shrink (Turk and
    Levoy 1994 leave out pairs at rims for that). They are known by their partner's own nearest object point, which is
    more than half of `tau` away.
    """
    ahead = slice(0, pairs.forward)
    partners, of_pair = np.unique(pairs.scene_index[ahead], return_inverse=True)
    own = obj.nearest(pose.inverse().apply(scene.points[partners]), np.inf)[1][of_pair]
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


def _weighted(lever: Array, direction: Array, residual: Array, weight: Array) -> tuple[Array, Array]:
    """Normal equations of direction . (rotation x lever + translation + growth lever) + residual, by Huber weights.

    Residuals are divided by their robust spread, so that kinds of rows can be added.
    """
    spread = SD_OVER_MEDIAN * np.median(np.abs(residual - np.median(residual))) + 1e-12
    weight = weight * np.minimum(1, 2 * spread / np.maximum(np.abs(residual), 1e-12)) / spread**2
    jacobian = similarity_rows(lever, direction)
    weighted = weight[:, None] * jacobian
    return weighted.T @ jacobian, weighted.T @ residual


def triples_of_one_scale(
    x: Array, y: Array, count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], tuple[Array, Array], Array]:
    """Random triples of matches whose three edges are longer on one side by nearly the same factor (Fischler 1981).

    Args:
        x: (M, 3) points of one side.
        y: (M, 3) their partners.
        count: triples drawn.
        rng: draws them.

    Returns:
        (N, 3) rows of the matches, lengths (N, 3) of their edges on either side, and (N,) geometric means of the ratios
        of these.
    """
    rows = rng.integers(0, len(x), (count, 3))
    a, b = (np.linalg.norm(side[rows] - side[np.roll(rows, 1, axis=1)], axis=2) for side in (x, y))
    ratio = b / np.maximum(a, 1e-12)
    good = ratio.min(1) > MIN_EDGE_RATIO * ratio.max(1)
    scale = np.exp(np.log(np.maximum(ratio[good], 1e-12)).mean(1))
    return rows[good], (a[good], b[good]), scale
