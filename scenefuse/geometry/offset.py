"""How far a cloud lies beside the points that its cameras' photos give: clouds of another datum are metres off."""

import numpy as np
from scipy.spatial import cKDTree

from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array, Sim3, step_to_planes

# Points of the model that are laid on the cloud, and neighbours in it that say how its surface lies.
MOST_POINTS, NEIGHBOURS = 20_000, 8
STEPS = 20
# Of the points, so many that are nearest count: the others are off the cloud's surface, or mismatched.
NEAREST = 0.7


def cloud_from_own(points: Array, own: Array) -> Sim3:
    """The similarity that lays a model's own points (M, 3) on a cloud (N, 3), both nearly in the same place.

    Point to plane (Chen and Medioni 1992), of the nearest 70 % at each step (trimmed ICP, Chetverikov et al. 2005).
    """
    own, tree, found = own[:: max(1, len(own) // MOST_POINTS)], cKDTree(points), Sim3.identity()
    for _ in range(STEPS):
        moved = found.apply(own)
        distance, near = tree.query(moved, NEIGHBOURS, workers=threads())
        rows = np.argsort(distance[:, 0])[: max(NEIGHBOURS, int(NEAREST * len(own)))]
        around = points[near[rows]]
        middle = around.mean(1)
        normals = np.linalg.eigh(np.einsum("nki,nkj->nij", *[around - middle[:, None]] * 2))[1][:, :, 0]
        found = step_to_planes(moved[rows], normals, ((moved[rows] - middle) * normals).sum(1)) @ found
    return found
