"""What is still missing of an object, surface that no photo confirms, and why (method F5); and from where to photograph
it (F6).

Sources: Yamauchi 1997 (frontiers between free and unknown space), Isler et al. 2016 (free, occupied and unknown voxels
of an object); Laurentini 1994 (the visual hull bounds what can be unknown); Nemhauser, Wolsey, Fisher 1978 and Minoux
1978 (choosing the best next one, again and again, comes near the best set of them, and most need not be looked at
again); Hepp et al. 2018 and Smith et al. 2018 (views of a proxy surface, planned by what they add to it).
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, concatenate, spacing, voxel_downsample, within
from scenefuse.core.stage import threads
from scenefuse.core.transforms import UP, Array, look_at
from scenefuse.fuse.compare import SAME_PLACE_SPACINGS, THROUGH_SHARE
from scenefuse.fuse.measure import NEAR, RESOLUTION, Evidence
from scenefuse.fuse.modes import around
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS, MIN_AGREEING, see, shown_in
from scenefuse.geometry.photo_check import Photos, match_in
from scenefuse.geometry.photo_kernel import GOOD_ANGLE
from scenefuse.geometry.visual_hull import MAX_WRONG_SHARE, Outline, count_silhouettes
from scenefuse.photos.workspace import View

# Directions that are tried, spread evenly over a sphere around the object, at these distances, in those of its
# close-ups.
DIRECTIONS, DISTANCES = 120, (0.7, 1.0, 1.4)
# Stations at most, and the share of what is missing that one must add.
MAX_STATIONS, MIN_GAIN = 6, 0.05


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
        plain_cells: of these, those where it has only plain points.
        notes: what a user should know.
    """

    cells: Cloud
    side: float
    covered_cells: int
    plain_cells: int
    notes: tuple[str, ...]

    def share(self, kind: int) -> float:
        """Share of the object's surface that is missing for this reason."""
        return self._share(int((self.cells.fields["missing"] == kind).sum()))

    @property
    def plain(self) -> float:
        """Share of the object's surface that is there and plain."""
        return self._share(self.plain_cells)

    def _share(self, cells: int) -> float:
        return cells / max(1, self.covered_cells + len(self.cells))


def find_missing_surface(obj: Cloud, completed: Cloud, photos: tuple[Photos, Photos], masks: list[View]) -> Missing:
    """The surface of an object that no photo confirms, in cells of a hundredth of its diagonal.

    It is where the object's own cloud has points that did not get into the completed scene, and where space that photos
    see through borders, inside the object's visual hull, on space that none of them sees into.

    Args:
        obj: the object's whole cloud in the scene's frame, with normals.
        completed: the completed scene within a diagonal of it, with normals and the field `evidence`.
        photos: the object's and the scene's, in the scene's frame.
        masks: the object's cameras in the scene's frame with masks (H, W) as pixels; none leaves the second out.
    """
    side = margin = RESOLUTION * obj.diagonal
    views = photos[0].views + photos[1].views
    surface = _plain(voxel_downsample(completed, side / 2))
    near = around(surface, obj)
    # What stands beside the object hides, too: past a niche, photos would see into the wall that it is in.
    beside, surface = surface[~near], surface[near]
    hides = beside, spacing(beside.points, quantile=SPARSEST)
    step = spacing(surface.points, quantile=SPARSEST)
    apart = ~within(obj.points, surface.points, SAME_PLACE_SPACINGS * side)
    loose = _plain(obj[apart])
    through = see(loose.points, surface, views, step, margin, hides).through >= MIN_AGREEING
    through |= _off_masks(loose.points, masks)
    loose = loose[~through]
    if len(loose):
        surface = concatenate([surface, voxel_downsample(loose, side / 2)])
    grid = _Cells(obj.points, side)
    supposed, edge = grid.hold(loose.points), grid.none()
    towards = np.zeros((*grid.shape, 3), np.float32)
    if masks:
        edge, towards = _frontier(grid, surface, hides, views, masks, step, margin)
        edge = grid.within(obj.points, MAX_FROM_OBJECT * obj.diagonal, edge)
    found = _in_spots(supposed | edge)
    centres, normals = grid.middle(found), towards[found]
    own = supposed[found]
    if own.any():
        normals[own] = loose.known_normals[cKDTree(loose.points).query(centres[own], workers=threads())[1]]
    cells = Cloud(centres, normals)
    cells.fields["missing"] = _classes(cells, surface, photos, step, margin)
    few = f"{len(masks)} masks: what they do not frame is unknown, only points of the object's own cloud are looked at"
    notes = (few,) if len(masks) < CONFIRMING_PHOTOS else ()
    covered = obj.points[~apart]
    nearest = cKDTree(completed.points).query(covered, workers=threads())[1] if len(covered) else []
    evidence = completed.fields.get("evidence", np.zeros(len(completed)))
    is_plain = evidence[nearest] == Evidence.PLAIN
    plain = grid.hold(covered[is_plain]) & ~grid.hold(covered[~is_plain])
    return Missing(cells, side, int(grid.hold(covered).sum()), int(plain.sum()), notes)


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

    def within(self, points: Array, distance: float, chosen: Grid) -> Grid:
        """The chosen cells no farther than that from one of (N, 3) points."""
        found = self.none()
        found[chosen] = within(self.middle(chosen), points, distance)
        return found

    def middle(self, chosen: Grid) -> Array:
        """(K, 3) centres of the chosen cells."""
        return np.asarray(self.low + (np.argwhere(chosen) + 0.5) * self.side)


def _frontier(
    grid: _Cells,
    surface: Cloud,
    hides: tuple[Cloud, float],
    views: list[View],
    masks: list[View],
    step: float,
    margin: float,
) -> tuple[Grid, NDArray[np.float32]]:
    """Cells of unknown space that border on empty space, and for every cell the direction towards empty space."""
    centres = grid.centres
    shown, off, *_ = count_silhouettes(centres, map(Outline, masks))
    in_hull = (shown >= CONFIRMING_PHOTOS) & (off <= MAX_WRONG_SHARE * shown)
    seen = see(centres, surface, views, step, margin, hides)
    # Off the masks nothing of the object is, where photos see the place at all; below the ground few do, through gaps.
    in_sight = seen.in_view - seen.hidden >= np.maximum(MIN_AGREEING, THROUGH_SHARE * seen.in_view)
    empty = (seen.through >= MIN_AGREEING) | (~in_hull & in_sight)
    beside = ndimage.maximum_filter(grid.hold(surface.points), 2 * int(np.ceil(SAME_PLACE_SPACINGS + 0.5)) + 1)
    bare = ~grid.within(surface.points, SAME_PLACE_SPACINGS * grid.side, beside)
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
    seen, textured = np.zeros(len(cells), dtype=np.int64), np.zeros(len(cells), dtype=bool)
    for side in photos:
        shown = np.zeros(len(cells), dtype=np.int64)
        for view in side.views:
            shown += shown_in(cells.points, cells.known_normals, surface, view, step, margin)
        matches = match_in(cells.points, cells.known_normals, side)
        # Photos from nearly the same place say nothing of a point's place: they are not tested.
        seen = np.maximum(seen, np.minimum(shown, matches.tested + 1))
        textured |= matches.textured
    kinds = np.where(textured, Lack.CONTRADICTED, Lack.UNTEXTURED)
    return np.where(seen < CONFIRMING_PHOTOS, Lack.NEVER_SEEN, kinds).astype(np.uint8)


def _plain(cloud: Cloud) -> Cloud:
    """The cloud with its points and normals only."""
    return Cloud(cloud.points, cloud.normals)


@dataclass(frozen=True)
class Station:
    """A place to take photos from.

    Attributes:
        photos: three cameras beside each other, GOOD_ANGLE apart, in the scene's frame, that look at the object.
        shows: share of the surface worth photographing that all three show, and no station before.
    """

    photos: list[View]
    shows: float


@dataclass(frozen=True)
class Plan:
    """What a few more photos would close.

    Attributes:
        stations: the best first.
        reachable: share of the surface worth photographing that some place shows, chosen or not.
    """

    stations: list[Station]
    reachable: float


def plan_stations(missing: Missing, obj: Cloud, around: Cloud, close_ups: list[View]) -> Plan:
    """The stations that show most of the missing surface.

    Untextured surface is left out, since photos from elsewhere do not measure it either; so is contradicted surface for
    stations from where a close-up shows it already.

    Args:
        missing: in the scene's frame.
        obj: the object in it.
        around: everything that stands in the way, with normals: the completed scene.
        close_ups: the object's cameras in the scene's frame, for lens and distance.
    """
    cells = missing.cells[missing.cells.fields["missing"] != Lack.UNTEXTURED]
    if len(cells) == 0 or not close_ups:
        return Plan([], 0.0)
    middle, distance = _close_ups_from(obj, close_ups)
    apart = np.linalg.norm(around.points - middle, axis=1)
    # What stands beside the object hides by depth buffers, the rest by lines of sight.
    clearance, reach = NEAR * obj.diagonal, (0.5 + 2 * NEAR) * obj.diagonal
    beside = apart < reach
    if not beside.any():
        return Plan([], 0.0)
    obstacles = voxel_downsample(Cloud(around.points[beside], around.known_normals[beside]), missing.side)
    others = voxel_downsample(
        Cloud(around.points[apart < max(reach, reach_of_stations(obj, close_ups))]), clearance / 2
    )
    step = max(missing.side, spacing(obstacles.points, quantile=SPARSEST))
    lens = sorted(close_ups, key=lambda view: view.intrinsics[0, 0] / view.width)[len(close_ups) // 2]
    photos = [_photos_from(place, middle, lens) for place in _around(middle, distance)]
    free = Free(others.points, middle, reach, clearance)
    photos = [three for three in photos if free.ways(np.array([photo.centre for photo in three]))]
    # What the middle photo shows is the most that all three do; these are tested only where it decides (Minoux 1978).
    shown = np.array([_shown_in_all(three[1:2], cells, obstacles, step, missing.side) for three in photos])
    shown = shown.reshape(len(photos), len(cells)).astype(bool)
    shown &= ~_tried(photos, cells, close_ups, obstacles, step, missing.side)
    exact, left, stations = np.zeros(len(photos), dtype=bool), np.ones(len(cells), dtype=bool), list[Station]()
    while len(stations) < MAX_STATIONS and len(photos):
        gains = (shown & left).sum(1)
        best = int(gains.argmax())
        if gains[best] < max(1.0, MIN_GAIN * len(cells)):
            break
        if not exact[best]:
            shown[best] &= _shown_in_all(photos[best], cells, obstacles, step, missing.side)
            shown[best] &= free.sees(np.array([photo.centre for photo in photos[best]]), cells.points)
            exact[best] = True
            continue
        stations.append(Station(photos[best], float(gains[best]) / len(cells)))
        left &= ~shown[best]
    return Plan(stations, float(shown.any(0).mean()) if len(photos) else 0.0)


def _close_ups_from(obj: Cloud, close_ups: list[View]) -> tuple[Array, float]:
    """The object's middle (3,), and how far from it its close-ups were taken."""
    middle = (obj.points.min(0) + obj.points.max(0)) / 2
    return middle, float(np.median([np.linalg.norm(view.centre - middle) for view in close_ups]))


def reach_of_stations(obj: Cloud, close_ups: list[View]) -> float:
    """How far from the object's middle things may stand in the way of a station."""
    return 2 * max(DISTANCES) * _close_ups_from(obj, close_ups)[1]


def _around(middle: Array, distance: float) -> Array:
    """(P, 3) places around an object, nearest first."""
    number = np.arange(DIRECTIONS) + 0.5
    height, turn = 1 - 2 * number / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * number
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    return np.concatenate([middle + factor * distance * directions for factor in sorted(DISTANCES)])


class Free:
    """Where a camera can be: above the ground, and with nothing between it and the object."""

    def __init__(self, obstacles: Array, middle: Array, reach: float, clearance: float):
        self.middle, self.reach, self.clearance = middle, reach, clearance
        self.obstacles, self.near, self.below = obstacles, cKDTree(obstacles), cKDTree(obstacles[:, :2])
        self.beyond = cKDTree(obstacles[np.linalg.norm(obstacles - middle, axis=1) >= reach])

    def ways(self, eyes: Array) -> bool:
        """Whether all of (E, 3) places see the object over free space, up to what stands beside it."""
        if (eyes[:, 2] < self.obstacles[self.below.query(eyes[:, :2])[1], 2] + self.clearance).any():
            return False
        ahead = self.middle - eyes
        length = np.linalg.norm(ahead, axis=1)
        steps = self._steps(length) * np.maximum(0, 1 - self.reach / length)[:, None]
        return bool((self.near.query((eyes + steps * ahead).reshape(-1, 3))[0] > self.clearance).all())

    def sees(self, eyes: Array, points: Array) -> NDArray[np.bool_]:
        """(N,) whether nothing that does not stand beside the object is between any of (E, 3) places and a point."""
        free = np.ones(len(points), dtype=bool)
        for eye in eyes if self.beyond.n else ():
            ahead = points - eye
            places = eye + self._steps(np.linalg.norm(ahead, axis=1)) * ahead
            apart = self.beyond.query(
                places.reshape(-1, 3), distance_upper_bound=self.clearance / 2, workers=threads()
            )[0]
            free &= np.isinf(apart.reshape(-1, len(points))).all(0)
        return free

    def _steps(self, lengths: Array) -> Array:
        """Shares (S, 1, 1) of lines of sight, so near each other, unless these are very long, that what stands in the
        way, thinned to half of the clearance, is not stepped over."""
        return np.linspace(0, 1, int(np.ceil(min(lengths.max() / (0.7 * self.clearance), 240))) + 1)[:, None, None]


def _photos_from(place: Array, middle: Array, lens: View) -> list[View]:
    """Three cameras beside each other, the second at the place, that look at the middle."""
    away = place - middle
    axis = UP - (UP @ away) / (away @ away) * away
    axis /= np.linalg.norm(axis)
    photos = []
    for number, angle in enumerate(GOOD_ANGLE * np.array([-1, 0, 1]), 1):
        eye = middle + np.cos(angle) * away + np.sin(angle) * np.cross(axis, away)
        pose = np.eye(4)
        pose[:3, :3] = look_at(eye, middle, UP)
        pose[:3, 3] = -pose[:3, :3] @ eye
        photos.append(View(str(number), lens.intrinsics, pose, lens.width, lens.height))
    return photos


def _tried(
    photos: list[list[View]], cells: Cloud, close_ups: list[View], obstacles: Cloud, step: float, margin: float
) -> NDArray[np.bool_]:
    """(P, K) contradicted cells that a close-up shows from less than GOOD_ANGLE beside the P stations."""
    tried = np.zeros((len(photos), len(cells)), dtype=bool)
    rows = np.flatnonzero(cells.fields["missing"] == Lack.CONTRADICTED)
    if len(rows) == 0:
        return tried
    part = cells[rows]
    toward = np.array([_directions(part.points, three[1].centre) for three in photos]).reshape(-1, len(rows), 3)
    for view in close_ups:
        known = shown_in(part.points, part.known_normals, obstacles, view, step, margin)
        beside = (toward * _directions(part.points, view.centre)).sum(2) > np.cos(GOOD_ANGLE)
        tried[:, rows] |= beside & known
    return tried


def _directions(points: Array, eye: Array) -> Array:
    """(N, 3) unit vectors from points (N, 3) to a place."""
    away = eye - points
    return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))


def _shown_in_all(photos: list[View], cells: Cloud, obstacles: Cloud, step: float, margin: float) -> NDArray[np.bool_]:
    """(K,) cells that all the photos show."""
    shown = [shown_in(cells.points, cells.known_normals, obstacles, photo, step, margin) for photo in photos]
    return np.asarray(np.logical_and.reduce(shown))
