"""How certain the most likely pose is, and how far it lies off: the scatter of its pieces, and planted copies."""

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scenefuse.core.transforms import Array, Sim3
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.surface import Surface
from scenefuse.register.mixture import MostLikely, most_likely, moved_about
from scenefuse.register.uncertainty import MIN_PIECES, PIECES_ACROSS, Uncertainty

# Copies of the scene that are drawn from the object, at a pose that is known.
COPIES = 4
# Fewer scene points on the object determine nothing.
LEAST_POINTS = 100
# Of a direction of which nothing is known: this share of the best known.
NOTHING = 1e-9


def certified(
    obj: Surface, scene: Surface, start: Sim3, scales: ScaleRange, spacing: float, diagonal: float, seed: int
) -> tuple[Sim3, Uncertainty] | None:
    """The most likely pose near `start`, corrected by what planted copies of the scene are off, and its uncertainty.

    Arguments as of `most_likely`, and the seed of the copies. None where too little of the scene lies on the object.
    """
    found = most_likely(obj, scene, start, scales, spacing, diagonal)
    of_pieces = _covariance(scene, found, diagonal, scales.width == 0)
    if of_pieces is None or np.count_nonzero(found.on_object > 0.5) < LEAST_POINTS:
        return None
    off = _off_on_copies(obj, scene, found, scales, spacing, diagonal, seed)
    bias, spread = off.mean(0), np.cov(off.T)
    if scales.width == 0:
        bias[6] = 0
    return moved_about(found.pose, -bias, found.centre, scales), Uncertainty.of(of_pieces + spread)


def _covariance(scene: Surface, found: MostLikely, diagonal: float, hold_scale: bool) -> Array | None:
    """(7, 7) by the scatter of the gradients of the scene's pieces (sandwich estimator, Huber 1967, White 1982).

    What errs together stays together: the pieces are cubes. None with too few of them.
    """
    cells = np.floor(scene.points[scene.queries] / (diagonal / PIECES_ACROSS)).astype(np.int64)
    piece = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    count = int(piece.max()) + 1
    if count < MIN_PIECES:
        return None
    sums = np.zeros((count, 7))
    np.add.at(sums, piece, found.gradients)
    unit = np.array([diagonal, diagonal, diagonal, 1, 1, 1, diagonal])
    information, scatter = found.information / np.outer(unit, unit), (sums / unit).T @ (sums / unit)
    if hold_scale:
        information[6], information[:, 6], scatter[6], scatter[:, 6] = 0, 0, 0, 0
        information[6, 6] = 1
    values, vectors = np.linalg.eigh(information)
    inverse = (vectors / np.maximum(values, NOTHING * values[-1])) @ vectors.T
    return (inverse @ scatter @ inverse) * count / (count - 1) / np.outer(unit, unit)


def _off_on_copies(
    obj: Surface, scene: Surface, found: MostLikely, scales: ScaleRange, spacing: float, diagonal: float, seed: int
) -> Array:
    """(COPIES, 7) how far the most likely poses of planted copies lie off: rotation vector, shift, log scale.

    A copy has a point for every scene point on the object, drawn from one half of the object's points about the same
    place, with the noise; the other half is laid on it (parametric bootstrap, Efron 1979). What the object's own noise
    and the rim of what the scene shows do to the pose, they do to the copies'.
    """
    rng, near = np.random.default_rng(seed), np.flatnonzero(found.on_object > 0.5)
    at, noise, off = scene.points[scene.queries[near]], found.noise, []
    for _ in range(COPIES):
        order = rng.permutation(len(obj))
        mine, theirs = (_part(obj, np.sort(half)) for half in np.array_split(order, 2))
        drawn = theirs.tree.query(found.pose.inverse().apply(at + rng.normal(0, noise.place, at.shape)))[1]
        points = found.pose.apply(theirs.points[drawn]) + rng.normal(0, noise.place, at.shape)
        colors = None if theirs.colors is None else noise.gain * theirs.colors[drawn] + noise.bias
        normals = found.pose.rotate(theirs.normals[drawn])
        copy = Surface(points, normals, colors, cKDTree(points), np.arange(len(points)))
        # Half of the points lie farther apart.
        again = most_likely(mine, copy, found.pose, scales, np.sqrt(2) * spacing, diagonal).pose
        turn = Rotation.from_matrix(again.rotation @ found.pose.rotation.T).as_rotvec()
        centre = found.pose.inverse().apply(found.centre)
        off.append([*turn, *(again.apply(centre) - found.centre), np.log(again.scale / found.pose.scale)])
    return np.array(off)


def _part(surface: Surface, rows: Array) -> Surface:
    """Some points of a surface."""
    points = surface.points[rows]
    colors = None if surface.colors is None else surface.colors[rows]
    return Surface(points, surface.normals[rows], colors, cKDTree(points), np.arange(len(rows)))
