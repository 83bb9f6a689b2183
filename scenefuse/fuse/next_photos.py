"""Where to stand next: camera positions whose photos would close most of what is missing (method F6).

Sources: Nemhauser, Wolsey, Fisher 1978 and Minoux 1978 (choosing the best next one, again and again, comes near the
best set of them, and most need not be looked at again); Hepp et al. 2018 and Smith et al. 2018 (views of a proxy
surface, planned by what they add to it).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, spacing, voxel_downsample
from scenefuse.core.transforms import UP, Array, look_at, rotation_between
from scenefuse.fuse.measure import NEAR
from scenefuse.fuse.missing import SPARSEST, Lack, Missing
from scenefuse.geometry.depth_test import shown_in
from scenefuse.geometry.photo_kernel import GOOD_ANGLE
from scenefuse.photos.workspace import View

# Directions that are tried, spread evenly over a sphere around the object, at these distances, in those of its
# close-ups.
DIRECTIONS, DISTANCES = 120, (0.7, 1.0, 1.4)
# Stations at most, and the share of what is missing that one must add.
MAX_STATIONS, MIN_GAIN = 6, 0.05


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


def plan_stations(missing: Missing, obj: Cloud, around: Cloud, close_ups: list[View], up: Array) -> Plan:
    """The stations that show most of the missing surface.

    Untextured surface is left out, since photos from elsewhere do not measure it either; so is contradicted surface for
    stations from where a close-up shows it already.

    Args:
        missing: in the scene's frame.
        obj: the object in it.
        around: everything that stands in the way, with normals: the completed scene.
        close_ups: the object's cameras in the scene's frame, for lens and distance.
        up: (3,) unit vector opposite to gravity.
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
    assert around.normals is not None
    obstacles = voxel_downsample(Cloud(around.points[beside], around.normals[beside]), missing.side)
    others = voxel_downsample(
        Cloud(around.points[apart < max(reach, reach_of_stations(obj, close_ups))]), clearance / 2
    )
    step = max(missing.side, spacing(obstacles.points, quantile=SPARSEST))
    lens = sorted(close_ups, key=lambda view: view.intrinsics[0, 0] / view.width)[len(close_ups) // 2]
    photos = [_photos_from(place, middle, lens, up) for place in _around(middle, distance, up)]
    free = _Free(others.points, middle, reach, clearance, up)
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


def _around(middle: Array, distance: float, up: Array) -> Array:
    """(P, 3) places around an object, nearest first."""
    number = np.arange(DIRECTIONS) + 0.5
    height, turn = 1 - 2 * number / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * number
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    directions = directions @ rotation_between(UP, up).T
    return np.concatenate([middle + factor * distance * directions for factor in sorted(DISTANCES)])


class _Free:
    """Where a camera can be: above the ground, and with nothing between it and the object."""

    def __init__(self, obstacles: Array, middle: Array, reach: float, clearance: float, up: Array):
        self.middle, self.reach, self.clearance = middle, reach, clearance
        self.level_from_scene = rotation_between(up, UP)
        self.level = obstacles @ self.level_from_scene.T
        self.near, self.below = cKDTree(obstacles), cKDTree(self.level[:, :2])

    def ways(self, eyes: Array) -> bool:
        """Whether all of (E, 3) places see the object over free space, up to what stands beside it."""
        at = eyes @ self.level_from_scene.T
        if (at[:, 2] < self.level[self.below.query(at[:, :2])[1], 2] + self.clearance).any():
            return False
        ahead = self.middle - eyes
        ends = np.maximum(0, 1 - self.reach / np.linalg.norm(ahead, axis=1))
        steps = np.linspace(0, 1, 60)[:, None, None] * ends[:, None]
        return bool((self.near.query((eyes + steps * ahead).reshape(-1, 3))[0] > self.clearance).all())


def _photos_from(place: Array, middle: Array, lens: View, up: Array) -> list[View]:
    """Three cameras beside each other, the second at the place, that look at the middle."""
    away = place - middle
    axis = up - (up @ away) / (away @ away) * away
    axis /= np.linalg.norm(axis)
    photos = []
    for number, angle in enumerate(GOOD_ANGLE * np.array([-1, 0, 1]), 1):
        eye = middle + np.cos(angle) * away + np.sin(angle) * np.cross(axis, away)
        pose = np.eye(4)
        pose[:3, :3] = look_at(eye, middle, up)
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
    assert part.normals is not None
    toward = np.array([_directions(part.points, three[1].centre) for three in photos]).reshape(-1, len(rows), 3)
    for view in close_ups:
        known = shown_in(part.points, part.normals, obstacles, view, step, margin)
        beside = (toward * _directions(part.points, view.centre)).sum(2) > np.cos(GOOD_ANGLE)
        tried[:, rows] |= beside & known
    return tried


def _directions(points: Array, eye: Array) -> Array:
    """(N, 3) unit vectors from points (N, 3) to a place."""
    away = eye - points
    return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))


def _shown_in_all(photos: list[View], cells: Cloud, obstacles: Cloud, step: float, margin: float) -> NDArray[np.bool_]:
    """(K,) cells that all the photos show."""
    assert cells.normals is not None
    shown = np.ones(len(cells), dtype=bool)
    for photo in photos:
        shown &= shown_in(cells.points, cells.normals, obstacles, photo, step, margin)
    return shown
