"""A cloud made ready for matching: thinned to one spacing, normals from its own neighbourhoods, smoothed colours."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.clouds import Cloud, voxel_downsample
from scenefuse.stage import threads
from scenefuse.transforms import Array, Sim3


@dataclass(frozen=True)
class Surface:
    """Points with normals in one frame, and the tree that finds the nearest of them.

    Attributes:
        points: (N, 3) float64.
        normals: (N, 3) float64 unit vectors.
        colors: (N, 3) float64 in 0..1, averaged over a small neighbourhood, or None.
        tree: nearest-neighbour search over `points`.
        probe: (P,) indices of the points that ask for their nearest neighbour on the other surface; all can answer.
    """

    points: Array
    normals: Array
    colors: Array | None
    tree: cKDTree
    probe: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.points)

    def transformed(self, b_from_a: Sim3) -> "Surface":
        """The same surface in frame b."""
        points = b_from_a.apply(self.points)
        return Surface(points, b_from_a.rotate(self.normals), self.colors, cKDTree(points), self.probe)


def prepare(cloud: Cloud, voxel: float, seed: int, most: int) -> Surface:
    """Thin a cloud to one point per voxel (at most `most` points, seeded) and give it normals.

    The direction of a normal is fitted to the neighbours within about two voxels; its side is the measured normal's
    where the cloud has normals, else away from the centroid.

    Args:
        cloud: at least a few dozen points.
        voxel: edge of the voxels, in the cloud's unit.
        seed: of the random choice when more than `most` points are left.
        most: largest number of points kept.
    """
    thin = voxel_downsample(cloud, voxel)
    if len(thin) > most:
        thin = thin[np.sort(np.random.default_rng(seed).choice(len(thin), most, replace=False))]
    tree = cKDTree(thin.points)
    neighbours = tree.query(thin.points, k=min(16, len(thin)), workers=threads())[1]
    normals = _plane_normals(thin.points, neighbours)
    outward = thin.points - thin.points.mean(0) if thin.normals is None else thin.normals
    normals = np.where(((normals * outward).sum(1) < 0)[:, None], -normals, normals)
    colors = None
    if thin.colors is not None:
        colors = (thin.colors[neighbours[:, :6]].astype(np.float64) / 255).mean(1)
    return Surface(thin.points, normals, colors, tree, np.arange(len(thin)))


def probing(surface: Surface, count: int, seed: int = 0) -> Surface:
    """The same surface with at most `count` seeded random points that ask."""
    if len(surface) <= count:
        return surface
    chosen = np.random.default_rng(seed).choice(len(surface), count, replace=False)
    return replace(surface, probe=np.sort(chosen))


def _plane_normals(points: Array, neighbours: NDArray[np.int64]) -> Array:
    """Unit normals (N, 3) of the planes through each point's (N, K) neighbours."""
    local = points[neighbours]
    local = local - local.mean(1, keepdims=True)
    return np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
