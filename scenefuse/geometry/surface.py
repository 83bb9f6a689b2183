"""A cloud made ready for matching, thinned, with normals and smoothed colours; nearest neighbours of two of them."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from scenefuse.cloud.cloud_file import STRAY_PERCENT
from scenefuse.cloud.clouds import Cloud, plane_normals, voxel_average
from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array, Sim3

# Neighbours that a plane is fitted to for a normal.
NORMAL_NEIGHBOURS = 16
# Distance within which points of two surfaces agree, as a share of a diagonal; points within twice that, of which
# either is off by it at most, belong together.
SCORE_FRACTION = 0.02
# Points that stand for a cloud where all would take long.
SAMPLED_POINTS = 20_000


@dataclass(frozen=True)
class Surface:
    """Points with normals in one frame, and the tree that finds the nearest of them.

    Attributes:
        points: (N, 3) float64.
        normals: (N, 3) float64 unit vectors.
        colors: (N, 3) float64 in 0..1, averaged over a small neighbourhood, or None.
        tree: nearest-neighbour search over `points`.
        queries: (Q,) indices of the points whose nearest neighbours on the other surface are sought.
        grid: a table of the nearest points, used in place of the tree, or None.
        slopes: those of `color_slopes`, once known; copies that differ in `queries` share them.
    """

    points: Array
    normals: Array
    colors: Array | None
    tree: cKDTree
    queries: NDArray[np.int64]
    grid: "NearestGrid | None" = None
    slopes: list[Array] = field(default_factory=list, repr=False)

    def __len__(self) -> int:
        return len(self.points)

    def transformed(self, b_from_a: Sim3) -> "Surface":
        """The same surface in frame b."""
        points = b_from_a.apply(self.points)
        return Surface(points, b_from_a.rotate(self.normals), self.colors, cKDTree(points), self.queries)

    def color_slopes(self) -> Array:
        """Slope of each colour channel along the tangent plane, (N, 3 channels, 3), computed on first use."""
        if not self.slopes:
            self.slopes.append(_color_slopes(self))
        return self.slopes[0]

    def nearest(self, points: Array, within: float) -> tuple[Array, NDArray[np.int64]]:
        """Distances (N,) and indices (N,) of the nearest points; the distance is infinite beyond `within`."""
        if self.grid is not None:
            return self.grid.nearest(self.points, points, within)
        return self.tree.query(points, distance_upper_bound=within, workers=threads())


@dataclass(frozen=True)
class NearestGrid:
    """The nearest point of every cell of a box: some ten times faster than a tree, exact to about one cell.

    Attributes:
        low: (3,) corner of the box.
        cell: edge of a cell.
        index: (X, Y, Z) index of the point nearest to each cell.
    """

    low: Array
    cell: float
    index: NDArray[np.int32]

    def nearest(self, points: Array, queries: Array, within: float) -> tuple[Array, NDArray[np.int64]]:
        """Distances and indices as `Surface.nearest`; what lies outside the box has nothing near."""
        cells = np.floor((queries - self.low) / self.cell).astype(np.int64)
        shape = np.array(self.index.shape)
        inside = ((cells >= 0) & (cells < shape)).all(1)
        cells[~inside] = 0
        found = self.index[cells[:, 0], cells[:, 1], cells[:, 2]].astype(np.int64)
        distance = np.sqrt(((points[found] - queries) ** 2).sum(1))
        return np.where(inside & (distance <= within), distance, np.inf), found


def with_grid(surface: Surface, cell: float, reach: float) -> Surface:
    """The same surface with a table of nearest points: cells of `cell`, out to `reach` around it."""
    low = surface.points.min(0) - reach
    shape = np.ceil((surface.points.max(0) + reach - low) / cell).astype(int) + 1
    cells = np.floor((surface.points - low) / cell).astype(np.int64)
    holder = np.full(shape, -1, dtype=np.int32)
    holder[tuple(cells.T)] = np.arange(len(surface), dtype=np.int32)
    nearest = distance_transform_edt(holder < 0, return_distances=False, return_indices=True)
    return replace(surface, grid=NearestGrid(low, cell, holder[tuple(nearest)]))


def prepare(cloud: Cloud, voxel: float, seed: int, most: int) -> Surface:
    """Average a cloud to one point per voxel (at most `most` points, seeded) and give it normals.

    The direction of a normal is fitted to the neighbours within about two voxels; its side is the measured normal's
    where the cloud has normals, else away from the centroid.

    Args:
        cloud: at least a few dozen points.
        voxel: edge of the voxels, in the cloud's unit.
        seed: of the random choice when more than `most` points are left.
        most: largest number of points kept.
    """
    thin = voxel_average(cloud, voxel)
    if len(thin) > most:
        thin = thin[np.sort(np.random.default_rng(seed).choice(len(thin), most, replace=False))]
    tree = cKDTree(thin.points)
    neighbours = nearest_rows(tree, thin.points, NORMAL_NEIGHBOURS)
    normals = plane_normals(thin.points, neighbours)
    outward = thin.points - thin.points.mean(0) if thin.normals is None else thin.normals
    normals = np.where(((normals * outward).sum(1) < 0)[:, None], -normals, normals)
    colors = None
    if thin.colors is not None:
        colors = (thin.colors[neighbours[:, :6]].astype(np.float64) / 255).mean(1)
    return Surface(thin.points, normals, colors, tree, np.arange(len(thin)))


def normals_at(points: Array, places: Array) -> Array:
    """Normals (M, 3), on either side, of the planes through the points (N, 3) nearest to each of `places` (M, 3)."""
    return plane_normals(points, nearest_rows(cKDTree(points), places, NORMAL_NEIGHBOURS))


def nearest_rows(tree: cKDTree, places: Array, count: int) -> NDArray[np.int64]:
    """(M, K) points nearest to each of `places` (M, 3): so many, or as many as there are."""
    return np.asarray(tree.query(places, k=range(1, min(count, tree.n) + 1), workers=threads())[1])


def with_queries(surface: Surface, count: int, seed: int = 0) -> Surface:
    """The same surface with at most `count` query points, drawn by the seed."""
    if len(surface) <= count:
        return surface
    chosen = np.random.default_rng(seed).choice(len(surface), count, replace=False)
    return replace(surface, queries=np.sort(chosen))


def _color_slopes(surface: Surface, neighbours: int = 20) -> Array:
    """(N, 3 channels, 3) by least squares on each point's neighbours."""
    assert surface.colors is not None
    index = nearest_rows(surface.tree, surface.points, neighbours)
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


def ends_of(places: NDArray[np.floating[Any]]) -> Array:
    """(2, ...) where points end, by their places (N, ...) along directions; strays do not count."""
    return np.percentile(places, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)


@dataclass(frozen=True)
class Pairs:
    """Nearest neighbours both ways at one pose.

    Attributes:
        object_index: (M,) indices into the object's points.
        scene_index: (M,) indices into the scene's points.
        distance: (M,) distances in scene units, all within the threshold.
        forward: the first `forward` pairs go from object points to the scene, the rest from scene points to the object.
    """

    object_index: NDArray[np.int64]
    scene_index: NDArray[np.int64]
    distance: Array
    forward: int


def pair(obj: Surface, scene: Surface, scene_from_object: Sim3, tau: float) -> Pairs:
    """Nearest neighbours within `tau` (scene units), from the object to the scene and back.

    The object's own search serves at every pose: a similarity keeps the order of distances.
    """
    s = scene_from_object.scale
    ahead, there = scene.nearest(scene_from_object.apply(obj.points[obj.queries]), tau)
    back, here = obj.nearest(scene_from_object.inverse().apply(scene.points[scene.queries]), tau / s)
    found, met = np.isfinite(ahead), np.isfinite(back)
    return Pairs(
        np.concatenate([obj.queries[found], here[met]]),
        np.concatenate([there[found], scene.queries[met]]),
        np.concatenate([ahead[found], back[met] * s]),
        int(found.sum()),
    )


def color_gain(obj: Surface, scene: Surface, pairs: Pairs) -> tuple[Array, Array]:
    """Gain and bias (3,) per channel that bring the object's colours to the scene's over the pairs."""
    assert obj.colors is not None and scene.colors is not None
    a, b = obj.colors[pairs.object_index], scene.colors[pairs.scene_index]
    mean_a, mean_b = a.mean(0), b.mean(0)
    gain = ((a - mean_a) * (b - mean_b)).sum(0) / np.maximum(((a - mean_a) ** 2).sum(0), 1e-9)
    gain = np.clip(gain, 0.25, 4.0)
    return gain, mean_b - gain * mean_a
