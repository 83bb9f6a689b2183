"""From relative poses of pairs to poses of all photos: along a spanning tree of the pairs, then averaged over all.

Rotation averaging (Chatterjee and Govindu, ICCV 2013), then averaging of centres, which spreads a loop's error over
all its pairs: both are iteratively reweighted least squares on the graph of pairs. Centres are a linear problem
because the length of every pair's baseline is known.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.transform import Rotation

from scenefuse.poses.correspondences import TwoViewPair

Array = NDArray[np.float64]

# Disagreement at which a pair loses half its weight: of rotations, and of centres as a share of the baseline.
ROTATION_SCALE_DEG = 1.0
CENTRE_SCALE = 0.05
# A pair agrees with the result up to this many times that.
AGREEING = 5.0
ROUNDS = 30


def largest_component(count: int, pairs: list[TwoViewPair]) -> NDArray[np.int64]:
    """Indices of the photos in the largest connected component of the graph of pairs."""
    _, label = connected_components(_graph(count, pairs), directed=False)
    return np.flatnonzero(label == np.bincount(label).argmax())


def spanning_tree_poses(count: int, pairs: list[TwoViewPair], lengths: Array) -> Array:
    """(V, 4, 4) poses graph_from_cam along the spanning tree of the pairs with the most matches.

    The first photo is the origin of the graph's frame.

    Args:
        count: photos, all joined by pairs.
        pairs: relative poses.
        lengths: (P,) baseline of each pair.
    """
    of_pair = {(pair.first, pair.second): index for index, pair in enumerate(pairs)}
    tree = minimum_spanning_tree(_graph(count, pairs))
    order, before = breadth_first_order(tree, 0, directed=False)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for photo in order[1:]:
        parent = before[photo]
        pair = pairs[of_pair[min(photo, parent), max(photo, parent)]]
        second_from_first = np.eye(4)
        second_from_first[:3, :3] = pair.rotation
        second_from_first[:3, 3] = lengths[of_pair[pair.first, pair.second]] * pair.direction
        forwards = pair.second == parent
        poses[photo] = poses[parent] @ (second_from_first if forwards else np.linalg.inv(second_from_first))
    return poses


def average_poses(poses: Array, pairs: list[TwoViewPair], lengths: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Average (V, 4, 4) poses over all pairs; also returns (P,) True for the pairs that agree with the result."""
    first, second = (np.array([getattr(pair, name) for pair in pairs]) for name in ("first", "second"))
    turn = np.array([pair.rotation for pair in pairs])
    moved = lengths[:, None] * np.array([pair.direction for pair in pairs])
    matches = np.sqrt([len(pair.rows) for pair in pairs])
    rotations, centres = poses[:, :3, :3].copy(), poses[:, :3, 3].copy()
    for _ in range(ROUNDS):
        off = Rotation.from_matrix(rotations[second] @ turn @ rotations[first].swapaxes(1, 2)).as_rotvec()
        angle = np.linalg.norm(off, axis=1)
        weights = matches / (1.0 + (angle / np.radians(ROTATION_SCALE_DEG)) ** 2)
        step = _solve(len(poses), first, second, off, weights)
        rotations = Rotation.from_rotvec(step).as_matrix() @ rotations
    wanted = np.einsum("pij,pj->pi", rotations[second], moved)
    weights = matches / (1.0 + (angle / np.radians(ROTATION_SCALE_DEG)) ** 2) / lengths
    share = np.linalg.norm(centres[first] - centres[second] - wanted, axis=1) / lengths
    for _ in range(ROUNDS):
        centres = _solve(len(poses), first, second, wanted, weights / (1.0 + (share / CENTRE_SCALE) ** 2))
        share = np.linalg.norm(centres[first] - centres[second] - wanted, axis=1) / lengths
    averaged = poses.copy()
    averaged[:, :3, :3], averaged[:, :3, 3] = rotations, centres
    return averaged, (np.degrees(angle) < AGREEING * ROTATION_SCALE_DEG) & (share < AGREEING * CENTRE_SCALE)


def _graph(count: int, pairs: list[TwoViewPair]) -> coo_matrix:
    """Cost of each pair: small for many matches."""
    cost = [1.0 / len(pair.rows) for pair in pairs]
    return coo_matrix((cost, ([p.first for p in pairs], [p.second for p in pairs])), shape=(count, count))


def _solve(count: int, first: NDArray, second: NDArray, difference: Array, weights: Array) -> Array:
    """(V, 3) values with value[first] - value[second] = difference, weighted least squares of zero mean."""
    laplacian, right = np.zeros((count, count)), np.zeros((count, 3))
    for a, b, sign in ((first, second, 1.0), (second, first, -1.0)):
        np.add.at(laplacian, (a, a), weights)
        np.add.at(laplacian, (a, b), -weights)
        np.add.at(right, a, sign * weights[:, None] * difference)
    values = np.linalg.lstsq(laplacian, right, rcond=None)[0]
    return values - values.mean(0)
