"""Maximum likelihood: every scene point is a noisy sample of the object's surface, in place and colour (method R15).

How certain the most likely pose is, and how far it lies off, follows from the scatter of its pieces and from planted
copies of the scene. What makes any pose uncertain besides is what surfaces have wrong in common, and how far models may
be bent.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from scenefuse.cloud.import_cloud import MIN_POINTS
from scenefuse.core.stage import threads
from scenefuse.core.transforms import MAX_DEVIATIONS, Array, Sim3, Uncertainty
from scenefuse.geometry.icp import MAX_SCALE_STEP, ScaleRange, change_between, moved_about, similarity_rows
from scenefuse.geometry.surface import SCORE_FRACTION, Surface, nearest_rows
from scenefuse.register.score import MIN_COLOR_NOISE

# Object points from which a scene point may come: those within two deviations, at the usual spacing and noise.
NEIGHBOURS = 24
# The noise begins at the distance within which points agree, a share of the scene's diagonal.
START_NOISE = SCORE_FRACTION
# It never gets below this share of the object's spacing: samples a spacing apart tell no more.
MIN_NOISE = 0.75
# Pieces to the scene's diagonal: what errs together stays together.
PIECES_ACROSS = 6
# Copies of the scene that are drawn from the object, at a pose that is known.
PLANTED_COPIES = 4
# What a surface has wrong alike all over, as a share of how far two surfaces scatter about each other.
COMMON_ERROR = 0.2


@dataclass(frozen=True)
class Noise:
    """How scene points differ from the object points they come from.

    Attributes:
        place: standard deviation along each axis, scene units.
        color: standard deviation of each channel, 0..1.
        gain: (3,) factors that bring the object's colours to the scene's.
        bias: (3,) added to that.
    """

    place: float
    color: float
    gain: Array
    bias: Array


@dataclass(frozen=True)
class Explanation:
    """From which object points the scene's points may come, at one pose and noise.

    Attributes:
        partner: (N, K) object points.
        weight: (N, K) their probabilities; what is left to 1 is something else.
        residual: (N, K, 3) from the moved object point to the scene point.
        log_likelihood: of all scene points, up to a constant.
    """

    partner: NDArray[np.int64]
    weight: Array
    residual: Array
    log_likelihood: float


@dataclass(frozen=True)
class MostLikely:
    """A maximum of the likelihood.

    Attributes:
        pose: scene_from_object.
        noise: at the maximum.
        on_object: (N,) probability of each scene point to lie on the object.
        gradients: (N, 7) of each point's log-likelihood by rotation vector, shift and log scale about `centre`.
        information: (7, 7) the observed information: minus the second derivative of the log-likelihood.
        centre: (3,) of the object, in the scene.
    """

    pose: Sim3
    noise: Noise
    on_object: Array
    gradients: Array
    information: Array
    centre: Array


def most_likely(
    obj: Surface, scene: Surface, start: Sim3, scales: ScaleRange, spacing: float, diagonal: float
) -> MostLikely:
    """The pose near `start` at which the object best explains the scene's points (Newton's method).

    A scene point is a Gaussian's sample about a point of the object's surface, anywhere on it, in place and colour (a
    mixture as in Myronenko and Song 2010, Chui and Rangarajan 2000). Where noise is as thick as what it lies on, this
    is right where nearest points are not: these always lie near, whatever the pose.

    Args:
        obj: the object in its own frame, evenly thinned.
        scene: the scene crop; its query points count.
        start: scene_from_object, some deviations of the noise off at most.
        scales: bounds of the scale; of width 0 it is held.
        spacing: of the object's points, scene units.
        diagonal: of the scene crop.
    """
    pose, floor = start, MIN_NOISE * spacing
    noise = Noise(START_NOISE * diagonal, 0.15, np.ones(3), np.zeros(3))
    found = explain(obj, scene, pose, noise, spacing)
    for step in range(25):
        noise = _measured_noise(obj, scene, found, floor)
        found = explain(obj, scene, pose, noise, spacing, found.partner)
        at = _derivatives(obj, scene, pose, noise, found)
        change = _newton_step(at, diagonal / 3, scales.width == 0)
        pose, found, moved = _climb(obj, scene, at, found, change, scales, spacing)
        # The noise settles in five rounds; then a step that moves the points by a hundredth of it is the last.
        if step >= 4 and moved * diagonal / 3 < 0.01 * noise.place:
            break
    return _derivatives(obj, scene, pose, noise, found)


def explain(
    obj: Surface,
    scene: Surface,
    pose: Sim3,
    noise: Noise,
    spacing: float,
    partner: NDArray[np.int64] | None = None,
) -> Explanation:
    """From which object points, `spacing` apart (scene units), the scene's query points may come at a pose.

    `partner` (N, K) are the nearest object points at this pose, where they are known already.
    """
    at = scene.points[scene.queries]
    if partner is None:
        partner = nearest_rows(obj.tree, pose.inverse().apply(at), NEIGHBOURS)
    residual = at[:, None] - pose.apply(obj.points[partner])
    off = (residual**2).sum(2) / (2 * noise.place**2)
    if _colored(obj, scene):
        off += (_color_residual(obj, scene, partner, noise) ** 2).sum(2) / (2 * noise.color**2)
    likelihood = np.exp(-off)
    # As many object points lie within reach of a scene point on a plane.
    other = np.exp(-(MAX_DEVIATIONS**2) / 2) * min(partner.shape[1], 2 * np.pi * (noise.place / spacing) ** 2)
    total = likelihood.sum(1) + other
    return Explanation(partner, likelihood / total[:, None], residual, float(np.log(total).sum()))


def _colored(obj: Surface, scene: Surface) -> bool:
    return obj.colors is not None and scene.colors is not None


def _color_residual(obj: Surface, scene: Surface, partner: NDArray[np.int64], noise: Noise) -> Array:
    """(N, K, 3)"""
    assert obj.colors is not None and scene.colors is not None
    return scene.colors[scene.queries][:, None] - (noise.gain * obj.colors[partner] + noise.bias)


def _measured_noise(obj: Surface, scene: Surface, found: Explanation, floor: float) -> Noise:
    """The noise that makes the scene's points most likely, given where they come from."""
    weight, total = found.weight, max(float(found.weight.sum()), 1e-12)
    place = max(floor, float(np.sqrt((weight * (found.residual**2).sum(2)).sum() / (3 * total))))
    if not _colored(obj, scene):
        return Noise(place, 1.0, np.ones(3), np.zeros(3))
    assert obj.colors is not None and scene.colors is not None
    mine, theirs = obj.colors[found.partner], scene.colors[scene.queries]
    mean_mine = np.einsum("nk,nkc->c", weight, mine) / total
    mean_theirs = weight.sum(1) @ theirs / total
    together = (np.einsum("nk,nkc->nc", weight, mine - mean_mine) * (theirs - mean_theirs)).sum(0)
    spread = np.einsum("nk,nkc->c", weight, (mine - mean_mine) ** 2)
    gain = np.clip(together / np.maximum(spread, 1e-9), 0.25, 4.0)
    noise = Noise(place, 1.0, gain, mean_theirs - gain * mean_mine)
    off = (_color_residual(obj, scene, found.partner, noise) ** 2).sum(2)
    return Noise(place, max(MIN_COLOR_NOISE, float(np.sqrt((weight * off).sum() / (3 * total)))), gain, noise.bias)


def _derivatives(obj: Surface, scene: Surface, pose: Sim3, noise: Noise, found: Explanation) -> MostLikely:
    """First and second derivatives at a pose: complete information less what is missing (Louis 1982)."""
    centre = pose.apply(obj.points.mean(0))
    lever = pose.apply(obj.points[found.partner]) - centre
    each = similarity_rows(lever, found.residual) / noise.place**2
    gradients = np.einsum("nk,nkd->nd", found.weight, each)
    weight, flat, arm = found.weight.ravel(), each.reshape(-1, 7), lever.reshape(-1, 3)
    missing = (weight[:, None] * flat).T @ flat - gradients.T @ gradients
    total, mean, square = weight.sum(), weight @ arm, (weight[:, None] * arm).T @ arm
    complete = np.zeros((7, 7))
    complete[:3, :3] = np.trace(square) * np.eye(3) - square
    complete[:3, 3:6] = np.cross(mean, np.eye(3)).T
    complete[3:6, :3] = complete[:3, 3:6].T
    complete[3:6, 3:6] = total * np.eye(3)
    complete[3:6, 6] = complete[6, 3:6] = mean
    complete[6, 6] = np.trace(square)
    information = complete / noise.place**2 - missing
    return MostLikely(pose, noise, found.weight.sum(1), gradients, information, centre)


def _newton_step(at: MostLikely, reach: float, hold_scale: bool) -> Array:
    """(7,) the change that leads to the top of the parabola at a pose; rotation and scale count by `reach`."""
    unit = np.array([reach, reach, reach, 1, 1, 1, reach])
    gradient, information = at.gradients.sum(0) / unit, at.information / np.outer(unit, unit)
    if hold_scale:
        gradient[6], information[6], information[:, 6] = 0, 0, 0
    values, vectors = np.linalg.eigh(information)
    # Directions of which next to nothing is known are not followed far in one step.
    values = np.maximum(values, 1e-3 * values[-1])
    change = (vectors @ ((vectors.T @ gradient) / values)) / unit
    change[6] = np.clip(change[6], -MAX_SCALE_STEP, MAX_SCALE_STEP)
    return change


def _climb(
    obj: Surface,
    scene: Surface,
    at: MostLikely,
    found: Explanation,
    change: Array,
    scales: ScaleRange,
    spacing: float,
) -> tuple[Sim3, Explanation, float]:
    """The pose after a change, or a part of it, that is more likely, and how far it moves a point at the distance 1."""
    for _ in range(5):
        pose = moved_about(at.pose, change, at.centre, scales)
        then = explain(obj, scene, pose, at.noise, spacing)
        if then.log_likelihood > found.log_likelihood:
            reach = float(np.linalg.norm(change[:3]) + abs(change[6]))
            return pose, then, reach + float(np.linalg.norm(change[3:6]))
        change = change / 3
    return at.pose, found, 0.0


def certified(
    obj: Surface, scene: Surface, start: Sim3, scales: ScaleRange, spacing: float, diagonal: float, seed: int
) -> tuple[Sim3, Uncertainty] | None:
    """The most likely pose near `start`, corrected by what planted copies of the scene are off, and its uncertainty.

    Arguments as of `most_likely`, and the seed of the copies. None where too little of the scene lies on the object.
    """
    found = most_likely(obj, scene, start, scales, spacing, diagonal)
    of_pieces = _covariance(scene, found, diagonal, scales.width == 0)
    if of_pieces is None or np.count_nonzero(found.on_object > 0.5) < MIN_POINTS // 2:
        return None
    off = _off_on_copies(obj, scene, found, scales, spacing, diagonal, seed)
    bias, spread = off.mean(0), np.cov(off.T)
    if scales.width == 0:
        bias[6] = 0
    return moved_about(found.pose, -bias, found.centre, scales), Uncertainty.of(of_pieces + spread)


def _covariance(scene: Surface, found: MostLikely, diagonal: float, hold_scale: bool) -> Array | None:
    """(7, 7) by the scatter of the gradients of the scene's pieces (sandwich estimator, Huber 1967, White 1982).

    What errs together stays together: the pieces are cubes. None where there are no more of them than parameters.
    """
    cells = np.floor(scene.points[scene.queries] / (diagonal / PIECES_ACROSS)).astype(np.int64)
    piece = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    count = int(piece.max()) + 1
    if count <= found.gradients.shape[1]:
        return None
    sums = np.zeros((count, 7))
    np.add.at(sums, piece, found.gradients)
    unit = np.array([diagonal, diagonal, diagonal, 1, 1, 1, diagonal])
    information, scatter = found.information / np.outer(unit, unit), (sums / unit).T @ (sums / unit)
    if hold_scale:
        information[6], information[:, 6], scatter[6], scatter[:, 6] = 0, 0, 0, 0
        information[6, 6] = 1
    values, vectors = np.linalg.eigh(information)
    inverse = (vectors / np.maximum(values, 1e-9 * values[-1])) @ vectors.T
    return (inverse @ scatter @ inverse) * count / (count - 1) / np.outer(unit, unit)


def _off_on_copies(
    obj: Surface, scene: Surface, found: MostLikely, scales: ScaleRange, spacing: float, diagonal: float, seed: int
) -> Array:
    """(PLANTED_COPIES, 7) how far the most likely poses of planted copies lie off: rotation vector, shift, log scale.

    A copy has a point for every scene point on the object, drawn from one half of the object's points about the same
    place, with the noise; the other half is laid on it (parametric bootstrap, Efron 1979). What the object's own noise
    and the rim of what the scene shows do to the pose, they do to the copies'.
    """
    rng, near = np.random.default_rng(seed), np.flatnonzero(found.on_object > 0.5)
    at, noise, off = scene.points[scene.queries[near]], found.noise, []
    for _ in range(PLANTED_COPIES):
        order = rng.permutation(len(obj))
        mine, theirs = (_part(obj, np.sort(half)) for half in np.array_split(order, 2))
        drawn = theirs.tree.query(found.pose.inverse().apply(at + rng.normal(0, noise.place, at.shape)))[1]
        points = found.pose.apply(theirs.points[drawn]) + rng.normal(0, noise.place, at.shape)
        colors = None if theirs.colors is None else noise.gain * theirs.colors[drawn] + noise.bias
        normals = found.pose.rotate(theirs.normals[drawn])
        copy = Surface(points, normals, colors, cKDTree(points), np.arange(len(points)))
        # Half of the points lie farther apart.
        again = most_likely(mine, copy, found.pose, scales, np.sqrt(2) * spacing, diagonal).pose
        off.append(change_between(found.pose, again, found.pose.inverse().apply(found.centre)))
    return np.array(off)


def _part(surface: Surface, rows: Array) -> Surface:
    """Some points of a surface."""
    points = surface.points[rows]
    colors = None if surface.colors is None else surface.colors[rows]
    return Surface(points, surface.normals[rows], colors, cKDTree(points), np.arange(len(rows)))


def with_bending(local: Uncertainty, pose: Sim3, of_object: Array | None, of_scene: Array | None) -> Uncertainty:
    """A pose's uncertainty against the world, where both models may be bent (method M10).

    Args:
        local: of the pose between the models as they are, about the object's centre.
        pose: scene_from_object.
        of_object: (7, 7) covariance of the object's model around that centre, in its own frame; None where unknown.
        of_scene: (7, 7) of the scene's model around the same place, in the scene's frame.
    """
    total = local.covariance.copy()
    if of_object is not None:
        into_scene = block_diag(pose.rotation, pose.scale * pose.rotation, 1.0)
        total += into_scene @ of_object @ into_scene.T
    if of_scene is not None:
        total += of_scene
    return Uncertainty.of(total)


def common_error(obj: Surface, scene: Surface, pose: Sim3, scales: ScaleRange, reach: float) -> Array:
    """What a pose by clouds has wrong because their surfaces err alike, about the object's centre (method R12).

    Stereo fattens, smooths and displaces whole surfaces; neither their scatter nor halves of them show it. It is taken
    as a fifth of the scatter: of the RMS distance, along the object's normals, of the scene's points that lie on it.

    Args:
        obj: the object.
        scene: the scene.
        pose: scene_from_object.
        scales: bounds of the scale; one that is held has no error.
        reach: distance within which a point of the scene lies on the object, scene units.

    Returns:
        (7, 7) covariance of rotation vector (radians), translation (scene units) and log scale.
    """
    points = pose.inverse().apply(scene.points)
    distance, nearest = obj.tree.query(points, distance_upper_bound=reach / pose.scale, workers=threads())
    on_it = np.isfinite(distance)
    off = ((points[on_it] - obj.points[nearest[on_it]]) * obj.normals[nearest[on_it]]).sum(1)
    shift = COMMON_ERROR * pose.scale * float(np.sqrt((off**2).mean())) if on_it.any() else 0.0
    radius = pose.scale * float(np.sqrt(((obj.points - obj.points.mean(0)) ** 2).sum(1).mean()))
    of_scale = shift / radius if scales.width > 0 else 0.0
    return np.diag(np.square([shift / radius] * 3 + [shift] * 3 + [of_scale]))
