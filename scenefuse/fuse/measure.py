"""Measure: which points of a cloud photos confirm, how exactly, and the fields in which a fused cloud says so (F4).

Plain points are those that photos show but cannot match, for a wall without texture looks alike at every depth. They
are taken where measured surface around them goes on through them, so that they fill gaps and extend nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import NEIGHBOURS, Cloud, sampled_rows, spacing, voxel_average, voxels
from scenefuse.cloud.readers.columns import AT_ONCE
from scenefuse.core.stage import threads
from scenefuse.core.transforms import UP, Array, Sim3
from scenefuse.geometry.icp import similarity_rows
from scenefuse.geometry.photo_check import CONFIRMING_PHOTOS, Matches, Photos, match_in
from scenefuse.geometry.surface import normals_at
from scenefuse.photos.workspace import View


class Evidence(IntEnum):
    """Values of the field `evidence`."""

    UNCHECKED = 0
    MEASURED = 1
    NERF_ONLY = 2
    STEREO_ONLY = 3
    PLAIN = 4


FIELDS = ("photos", "match", "deviation", "world_deviation", "evidence")
"""What is known of a point: photos that confirm it, mean NCC of the best, standard deviations on the object and in the
world, and an Evidence value."""
# Share of the object's diagonal that fusion resolves: how far a point lies before or behind a surface to be seen
# through or hidden, what its neighbours are, and the side of the cells in which missing surface is counted.
RESOLUTION = 0.01
# What is nearer to an object than this share of its diagonal is beside it: there the scene is compared with it, and no
# camera can stand.
NEAR = 0.05
# A point is measured where photos confirm this share of it and its neighbours: here and there one matches by chance.
# Neighbours are as many as a plane has within RESOLUTION, from NEIGHBOURS to MAX_NEIGHBOURS.
SUPPORT, MAX_NEIGHBOURS = 0.5, 64
# Directions along the surface in which measured surface is looked for; it has to be found in more than half of them.
SECTORS = 6


@dataclass(frozen=True)
class Measured:
    """A cloud after its points were matched in photos.

    Attributes:
        cloud: with normals.
        matches: of its points.
        surface: (N,) points that photos confirm together with most of their neighbours.
    """

    cloud: Cloud
    matches: Matches
    surface: NDArray[np.bool_]

    def moved(self, pose: Sim3) -> "Measured":
        """The same, the cloud in another place."""
        return replace(self, cloud=self.cloud.transformed(pose))


def measure(cloud: Cloud, photos: Photos, diagonal: float) -> Measured:
    """Match a cloud's points in photos of the same frame; diagonal: of the object."""
    cloud = with_normals(cloud, photos.views)
    matches = match_in(cloud.points, cloud.normals, photos)
    return Measured(cloud, matches, supported(cloud.points, matches.measured, diagonal))


def measure_again(known: Measured, photos: Photos, diagonal: float) -> tuple[Measured, NDArray[np.bool_]]:
    """The same cloud by further photos, and (N,) points that these dispute.

    Each point has the matches of the photos that confirm it more often, and the smaller standard deviation. Photos
    dispute a point where they resolve more than those before, enough of them were compared there and show texture, and
    they do not confirm it, or less than half of them: beside an edge three of ten match by chance.
    """
    one, two = known.matches, match_in(known.cloud.points, known.cloud.normals, photos)
    more = two.photos > one.photos
    best = Matches(**{
        name: np.where(more, getattr(two, name), values) for name, values in vars(one).items()
    } | {"match": np.maximum(one.match, two.match), "deviation": np.minimum(one.deviation, two.deviation)})  # fmt: skip
    surface = supported(known.cloud.points, one.measured | two.measured, diagonal)
    compared = (two.tested >= CONFIRMING_PHOTOS) & two.textured & (two.step < one.step)
    agree = two.photos >= SUPPORT * (two.tested + 1)
    return Measured(known.cloud, best, surface), compared & ~(two.measured & agree)


def supported(points: Array, measured: NDArray[np.bool_], diagonal: float) -> NDArray[np.bool_]:
    """(N,) measured points of which most neighbours are measured too."""
    if not measured.any():
        return measured
    step = spacing(points)
    on_plane = np.pi * (RESOLUTION * diagonal / step) ** 2 if step > 0 else MAX_NEIGHBOURS
    count = min(int(np.clip(on_plane, NEIGHBOURS, MAX_NEIGHBOURS)) + 1, len(points))
    tree, found = cKDTree(points), measured.copy()
    # At a time some: the neighbours of tens of millions of points fill a computer's memory.
    for rows in np.array_split(np.flatnonzero(measured), 1 + len(points) * count // AT_ONCE):
        near = tree.query(points[rows], k=count, workers=threads())[1]
        found[rows] = measured[near.reshape(-1, count)].mean(1) >= SUPPORT
    return found


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
    found = [
        _continued(known.points[near] - point, known.known_normals[near], normal, side)
        for point, normal, near in zip(cells.points, cells.known_normals.astype(np.float64), lists)
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


def with_normals(cloud: Cloud, views: Sequence[View] = ()) -> Cloud:
    """The cloud, with normals of local planes where it has none, which face outwards."""
    if cloud.normals is not None:
        return cloud
    if len(cloud) <= NEIGHBOURS:
        return replace(cloud, normals=np.tile(UP.astype(np.float32), (len(cloud), 1)))
    normals, some = normals_at(cloud.points, cloud.points), sampled_rows(len(cloud), AT_ONCE // 4, seed=0)
    outward = _outward(cloud.points[some], normals[some], views)
    near = cKDTree(cloud.points[some]).query(cloud.points, workers=threads())[1]
    normals *= np.where((normals * outward[near]).sum(1, keepdims=True) < 0, -1.0, 1.0)
    return replace(cloud, normals=normals.astype(np.float32))


def _outward(points: Array, normals: Array, views: Sequence[View]) -> Array:
    """Normals (N, 3) of points (N, 3), consistent with their neighbours', and most of them towards the nearest camera,
    which may lie below a roof that others see; without cameras, those of what is highest in a place upwards."""
    import open3d as o3d

    local = points - points.mean(0)
    size = float(np.ptp(local, axis=0).max())
    # Of points on a lattice or in one plane, the triangulation takes the square of their number in time, or fails.
    shaken = local + np.random.default_rng(0).normal(0, 1e-6 * size, local.shape)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(shaken))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    cloud.orient_normals_consistent_tangent_plane(NEIGHBOURS)
    turned = np.asarray(cloud.normals)
    if views:
        centres = np.array([view.centre for view in views])
        facing = ((centres[cKDTree(centres).query(points, workers=threads())[1]] - points) * turned).sum(1)
    else:
        falling = np.argsort(-points[:, 2])
        place = voxels(local[falling] * [1, 1, 0], RESOLUTION * size)[0]
        facing = turned[falling[np.unique(place, return_index=True)[1]], 2]
    return -turned if np.sign(facing).sum() < 0 else turned


def with_evidence(known: Measured, otherwise: Evidence, of_pose: Array | float = 0.0) -> Cloud:
    """The cloud with only these fields: what photos know of its points, and `evidence`: MEASURED or `otherwise`.

    `of_pose` (N,) is what the uncertainty of its pose adds to `world_deviation`, see `deviations_of_pose`.
    """
    matches = known.matches
    deviation = np.where(np.isfinite(matches.deviation), matches.deviation, np.nan).astype(np.float32)
    fields: dict[str, NDArray[Any]] = {
        "photos": matches.photos.astype(np.uint16),
        "match": np.where(matches.tested > 0, matches.match, np.nan).astype(np.float32),
        "deviation": deviation,
        "world_deviation": np.hypot(deviation.astype(np.float64), of_pose).astype(np.float32),
        "evidence": np.where(known.surface, Evidence.MEASURED, otherwise).astype(np.uint8),
    }
    return replace(known.cloud, fields=fields)


def unchecked(cloud: Cloud) -> Cloud:
    """The cloud with the same fields, empty: it was matched in no photo."""
    nothing, none = np.full(len(cloud), np.nan), np.zeros(len(cloud), np.int64)
    return with_evidence(
        Measured(cloud, Matches(nothing, nothing, none, none, *[nothing] * 3), none > 0), Evidence.UNCHECKED
    )


def deviations_of_pose(cloud: Cloud, covariance: Array, centre: Array) -> Array:
    """Standard deviations (N,) of points with normals, along these, by the uncertainty of their pose (method M10).

    Args:
        cloud: in the scene.
        covariance: (7, 7) of the pose about `centre`: rotation vector (radians), shift, log scale.
        centre: (3,) in the scene.
    """
    along = similarity_rows(cloud.points - centre, cloud.known_normals.astype(np.float64))
    return np.asarray(np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", along, covariance, along), 0)))
