"""Plain: points of an object that photos show but cannot match, for a wall without texture looks alike at every depth.

They are taken where measured surface around them goes on through them, so that they fill gaps and extend nothing (F4).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import voxel_average, voxels
from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array
from scenefuse.fuse.measure import NEAR, RESOLUTION, Measured

# Directions along the surface in which measured surface is looked for; it has to be found in more than half of them.
SECTORS = 6


def plain_points(obj: Measured, contradicted: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) points of an object that are not measured, for photos show no texture there, and continue what is.

    Both are compared in cells of RESOLUTION. A cell continues the measured one beside it where both face alike and the
    line between them is at right angles to their mean normal, as on a plane, a sphere and a cylinder, within a cell's
    side; it is taken where it does so in more than half of the directions around it, within twice NEAR.

    Args:
        obj: the object.
        contradicted: (N,) of its points that photos see through.
    """
    chosen = np.flatnonzero(~obj.surface & ~contradicted & ~obj.matches.textured)
    if not len(chosen) or not obj.surface.any():
        return np.zeros(len(obj.cloud), dtype=bool)
    side = RESOLUTION * obj.cloud.diagonal
    cells, known = voxel_average(obj.cloud[chosen], side), voxel_average(obj.cloud[obj.surface], side)
    lists = cKDTree(known.points).query_ball_point(cells.points, 2 * NEAR * obj.cloud.diagonal, workers=threads())
    assert cells.normals is not None and known.normals is not None
    found = [
        _continued(known.points[near] - point, known.normals[near], normal, side)
        for point, normal, near in zip(cells.points, cells.normals.astype(np.float64), lists)
    ]
    taken = np.zeros(len(obj.cloud), dtype=bool)
    taken[chosen] = np.array(found)[voxels(obj.cloud.points[chosen], side)[0]] > SECTORS / 2
    return taken


def _continued(away: Array, normals: NDArray[np.float32], normal: Array, side: float) -> int:
    """In how many directions a cell with a normal (3,) continues the nearest of cells that lie `away` (K, 3)."""
    alike = normals @ normal > 0
    away, mean = away[alike], normals[alike] + normal
    along = away @ np.linalg.svd(normal[None])[2][1:].T
    sector = np.floor((np.arctan2(along[:, 0], along[:, 1]) / (2 * np.pi) + 0.5) * SECTORS) % SECTORS
    nearest = np.argsort((away**2).sum(1), kind="stable")
    first = nearest[np.unique(sector[nearest], return_index=True)[1]]
    off = np.abs((away[first] * mean[first]).sum(1)) / np.linalg.norm(mean[first], axis=1)
    return int((off <= side).sum())
