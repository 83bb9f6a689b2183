"""What is still missing of an object: surface that no photo confirms, and why (method F5).

Sources: Yamauchi 1997 (frontiers between free and unknown space), Isler et al. 2016 (free, occupied and unknown voxels
of an object); Laurentini 1994 (the visual hull bounds what can be unknown).
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, concatenate, spacing, voxel_downsample
from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array
from scenefuse.fuse.compare import SAME_PLACE_SPACINGS, THROUGH_SHARE
from scenefuse.fuse.measure import RESOLUTION
from scenefuse.geometry.depth_test import see, shown_in
from scenefuse.geometry.photo_check import CONFIRMING_PHOTOS, Photos, match_in
from scenefuse.geometry.photo_kernel import MIN_AGREEING, NOISE
from scenefuse.geometry.visual_hull import MAX_WRONG_SHARE, Outline, count_silhouettes
from scenefuse.photos.workspace import View


class Lack(IntEnum):
    """Why a cell is missing, field `missing` of its centre."""

    NEVER_SEEN = 1
    UNTEXTURED = 2
    CONTRADICTED = 3


# So many cells around the object's points are looked at too.
BORDER_CELLS = 3
# Cells beside each other that count: smaller spots are between points, not missing.
MIN_SPOT_CELLS = 12
# Quantile of the distances between a surface's points that depth buffers go by: sparse parts have no holes then.
SPARSEST = 0.9
# Share of the diagonal within which a missing cell has a point of the object: what is seen past a wall without points
# is not its back.
MAX_FROM_OBJECT = 0.2

Grid = NDArray[np.bool_]


@dataclass(frozen=True)
class Missing:
    """Surface of an object that the completed scene lacks.

    Attributes:
        cells: centres of its cells, with normals towards empty space and the field `missing`, a value of `Lack`.
        side: of a cell, unit of the frame.
        covered_cells: cells of the object's surface that the completed scene has.
        seen_through: points of the object that photos see through: nothing is there, so nothing is missing.
        notes: what a user should know.
    """

    cells: Cloud
    side: float
    covered_cells: int
    seen_through: int
    notes: tuple[str, ...]

    def share(self, kind: int) -> float:
        """Of the object's surface, the share that is missing for this reason."""
        total = self.covered_cells + len(self.cells)
        return float((self.cells.fields["missing"] == kind).sum()) / max(1, total)


def find_missing_surface(obj: Cloud, completed: Cloud, photos: tuple[Photos, Photos], masks: list[View]) -> Missing:
    """The surface of an object that no photo confirms, in cells of a hundredth of its diagonal.

    It is where the object's own cloud has points that did not get into the completed scene, and where space that photos
    see through borders, inside the object's visual hull, on space that none of them sees into.

    Args:
        obj: the object's whole cloud in the scene's frame, with normals.
        completed: the completed scene around it, with normals.
        photos: the object's and the scene's, in the scene's frame.
        masks: the object's cameras in the scene's frame with masks (H, W) as pixels; none leaves the second out.
    """
    side = margin = RESOLUTION * obj.diagonal
    views = photos[0].views + photos[1].views
    surface = _plain(voxel_downsample(completed, side / 2))
    step = spacing(surface.points, quantile=SPARSEST)
    apart = cKDTree(surface.points).query(obj.points, workers=threads())[0] > SAME_PLACE_SPACINGS * side
    loose = _plain(obj[apart])
    through = see(loose.points, surface, views, step, margin).through >= MIN_AGREEING
    through |= _off_masks(loose.points, masks)
    loose = loose[~through]
    if len(loose):
        surface = concatenate([surface, voxel_downsample(loose, side / 2)])
    grid = _Cells(obj.points, side)
    supposed, edge = grid.hold(loose.points), grid.none()
    towards = np.zeros((*grid.shape, 3), np.float32)
    if masks:
        edge, towards = _frontier(grid, surface, views, masks, step, margin)
        edge &= grid.within(obj.points, MAX_FROM_OBJECT * obj.diagonal)
    found = _in_spots(supposed | edge)
    centres, normals = grid.middle(found), towards[found]
    own = supposed[found]
    if own.any():
        assert loose.normals is not None
        normals[own] = loose.normals[cKDTree(loose.points).query(centres[own], workers=threads())[1]]
    cells = Cloud(centres, normals)
    cells.fields["missing"] = _classes(cells, surface, photos, step, margin)
    few = f"{len(masks)} masks: what they do not frame is unknown, only points of the object's own cloud are looked at"
    notes = (few,) if len(masks) < CONFIRMING_PHOTOS else ()
    return Missing(cells, side, int(grid.hold(obj.points[~apart]).sum()), int(through.sum()), notes)


class _Cells:
    """The cells of a box around points (N, 3)."""

    def __init__(self, points: Array, side: float):
        self.side = side
        self.low = points.min(0) - BORDER_CELLS * side
        self.shape = tuple(np.ceil((np.ptp(points, axis=0)) / side).astype(int) + 2 * BORDER_CELLS)

    @property
    def centres(self) -> Array:
        """(N, 3) of all cells."""
        index = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(self.low + (index + 0.5) * self.side)

    def none(self) -> Grid:
        return np.zeros(self.shape, dtype=bool)

    def place(self, points: Array) -> tuple[NDArray[np.int64], ...]:
        """The cells that points (N, 3) within the box lie in."""
        index = np.floor((points - self.low) / self.side).astype(np.int64)
        return tuple(np.clip(index, 0, np.array(self.shape) - 1).T)

    def hold(self, points: Array) -> Grid:
        """The cells that hold one of (N, 3) points."""
        grid = self.none()
        grid[self.place(points)] = True
        return grid

    def within(self, points: Array, distance: float) -> Grid:
        """The cells no farther than that from one of (N, 3) points."""
        away = cKDTree(points).query(self.centres, distance_upper_bound=distance, workers=threads())[0]
        return np.isfinite(away).reshape(self.shape)

    def middle(self, chosen: Grid) -> Array:
        """(K, 3) centres of the chosen cells."""
        return np.asarray(self.low + (np.argwhere(chosen) + 0.5) * self.side)


def _frontier(
    grid: _Cells, surface: Cloud, views: list[View], masks: list[View], step: float, margin: float
) -> tuple[Grid, NDArray[np.float32]]:
    """Cells of unknown space that border on empty space, and for every cell the direction towards empty space."""
    centres = grid.centres
    shown, off, *_ = count_silhouettes(centres, map(Outline, masks))
    in_hull = (shown >= CONFIRMING_PHOTOS) & (off <= MAX_WRONG_SHARE * shown)
    seen = see(centres, surface, views, step, margin)
    # Off the masks nothing of the object is, where photos see the place at all; below the ground few do, through gaps.
    in_sight = seen.in_view - seen.hidden >= np.maximum(MIN_AGREEING, THROUGH_SHARE * seen.in_view)
    empty = (seen.through >= MIN_AGREEING) | (~in_hull & in_sight)
    bare = ~grid.within(surface.points, SAME_PLACE_SPACINGS * grid.side)
    free = empty.reshape(grid.shape) & bare
    unknown = (in_hull & ~empty).reshape(grid.shape) & bare
    edge = unknown & ndimage.binary_dilation(free)
    towards = np.stack(np.gradient(ndimage.gaussian_filter(free.astype(np.float32), 1.5)), axis=-1)
    return edge, towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), np.float32(1e-12))


def _off_masks(points: Array, masks: list[View]) -> NDArray[np.bool_]:
    """(N,) points that three photos have in their frame, and too many of these outside the mask."""
    shown, off, *_ = count_silhouettes(points, map(Outline, masks))
    return np.asarray((shown >= CONFIRMING_PHOTOS) & (off > MAX_WRONG_SHARE * shown))


def _in_spots(missing: Grid) -> Grid:
    """The cells that lie with enough others beside each other."""
    labels, count = ndimage.label(missing, structure=np.ones((3, 3, 3)))
    if count == 0:
        return missing
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return np.asarray(sizes[labels] >= MIN_SPOT_CELLS)


def _classes(
    cells: Cloud, surface: Cloud, photos: tuple[Photos, Photos], step: float, margin: float
) -> NDArray[np.uint8]:
    """Why each cell is missing, (K,): too few photos of either side see it, it has no texture, or they do not agree."""
    assert cells.normals is not None
    seen, texture = np.zeros(len(cells), dtype=np.int64), np.zeros(len(cells))
    for side in photos:
        shown = np.zeros(len(cells), dtype=np.int64)
        for view in side.views:
            shown += shown_in(cells.points, cells.normals, surface, view, step, margin)
        matches = match_in(cells.points, cells.normals, side)
        # Photos from nearly the same place say nothing of a point's place: they are not tested.
        seen = np.maximum(seen, np.minimum(shown, matches.tested + 1))
        texture = np.maximum(texture, matches.texture)
    kinds = np.where(texture < 3 * NOISE, Lack.UNTEXTURED, Lack.CONTRADICTED)
    return np.where(seen < CONFIRMING_PHOTOS, Lack.NEVER_SEEN, kinds).astype(np.uint8)


def _plain(cloud: Cloud) -> Cloud:
    """The cloud with its points and normals only."""
    return Cloud(cloud.points, cloud.normals)
