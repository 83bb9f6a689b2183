"""Compare: the points of an object and of the scene around it against each other, and what goes and why (F4).

Photos have measured both sides by now (`measure`), and the object has settled (`settle`). What photos see
through goes; where both sides measured a place, one stays.
"""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import NEIGHBOURS, Cloud, concatenate, spacing, within
from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array
from scenefuse.fuse.measure import RESOLUTION, Measured
from scenefuse.geometry.depth_test import CELL_SPACINGS, MIN_AGREEING, see
from scenefuse.photos.workspace import View

Mask = NDArray[np.bool_]


class Reason(IntEnum):
    """What becomes of a point of the scene, field `reason` of those taken away."""

    KEPT = 0
    SEEN_THROUGH = 1
    DISPUTED = 2
    REPLACED = 3


REASONS = {
    Reason.SEEN_THROUGH: "photos see a surface behind it",
    Reason.DISPUTED: "close-ups show the place and do not confirm it",
    Reason.REPLACED: "the object measured the place better",
}
# How far a point must lie before or behind a surface to be seen through or hidden, as a share of the diagonal.
MARGIN = RESOLUTION
# Share of the photos that a point is open to which must see through it, and MIN_AGREEING of them: a surface that is
# wrong itself lies behind good points in some photos; a point that is not there has surfaces behind it in many.
THROUGH_SHARE = 0.2
# Points of both sides show the same place within so many of their common standard deviations, or so many spacings of
# the sparser side where that is more; never farther than twice the RESOLUTION.
SAME_PLACE_DEVIATIONS, SAME_PLACE_SPACINGS = 5.0, 1.5
# The object's points give way where the scene's standard deviation is smaller by more than this factor: the
# object's cloud is usually denser, so it wins ties; where the scene's is denser, the scene wins.
BETTER_FACTOR = 1.5
# Points of the scene for each of the object's, on the surface that both have, from which the scene is the denser.
DENSER_FACTOR = 2.0


def compare(
    obj: Measured, scene: Measured, disputed: Mask, views: list[View], share: float = 1.0
) -> tuple[Mask, Mask, NDArray[np.uint8]]:
    """Decide which points of both sides stay.

    Measured points count as real surface, which hides what is behind it. A measured point of the scene is removed only
    if another point remains beside it.

    Args:
        obj: the object where it settled in the scene.
        scene: the scene's points around it, measured by the photos of both sides.
        disputed: (M,) of these, points that the object's photos dispute; see `measure_again`.
        views: the photos of both sides.
        share: of the scene's points there that are given.

    Returns:
        (N,) of the object's points, those that come into the scene, and those that are not measured and have texture,
        and that photos see through; (M,) of the scene's points, Reason.KEPT, or why each is taken away.
    """
    diagonal = obj.cloud.diagonal
    surface = obj.cloud[obj.surface]
    seen = see(scene.cloud.points, surface, views, spacing(surface.points), MARGIN * diagonal)
    reason = np.zeros(len(scene.cloud), np.uint8)
    # What is measured stays: all photos of a pot before a wall have the wall behind it.
    is_open = seen.in_view - seen.hidden
    through = seen.through >= np.maximum(MIN_AGREEING, THROUGH_SHARE * is_open)
    reason[through & ~scene.surface] = Reason.SEEN_THROUGH

    sides = [surface, scene.cloud[scene.surface]]
    # Where photos show no texture they do not show a surface behind, which they measured by its texture.
    both, contradicted = concatenate(sides), ~obj.surface & obj.matches.textured
    loose = obj.cloud.points[contradicted]
    # In cells as fine as one side's points the other, sparser one has holes.
    behind = [see(loose, both, views, spacing(side.points), MARGIN * diagonal).through for side in sides]
    contradicted[contradicted] = np.maximum(*behind) >= MIN_AGREEING

    worse, better = better_measured(obj, scene, diagonal, share)
    reason[worse & (reason == Reason.KEPT)] = Reason.REPLACED
    if len(surface):
        beside = within(scene.cloud.points, surface.points, 2 * RESOLUTION * diagonal)
        reason[disputed & beside & (reason == Reason.KEPT)] = Reason.DISPUTED
    added = obj.surface & ~better
    removed = np.flatnonzero(scene.surface & (reason >= Reason.DISPUTED))
    stays = concatenate([obj.cloud[added], scene.cloud[reason == Reason.KEPT]])
    reach = SAME_PLACE_SPACINGS * spacing(scene.cloud.points)
    reason[removed[_alone(scene.cloud.points[removed], stays, reach)]] = Reason.KEPT
    return added, contradicted, reason


def better_measured(obj: Measured, scene: Measured, diagonal: float, share: float) -> tuple[Mask, Mask]:
    """Points of the scene (M,) that the object measured better, and points of the object (N,) that the scene did.

    share: of the scene's points that are given.
    """
    worse, better = np.zeros(len(scene.cloud), dtype=bool), np.zeros(len(obj.cloud), dtype=bool)
    if not obj.surface.any() or len(scene.cloud) == 0:
        return worse, better
    points = scene.cloud.points
    first, second = obj.cloud[obj.surface], scene.cloud[scene.surface]
    mine = _smooth(first.points, obj.matches.deviation[obj.surface])
    other = _smooth(second.points, scene.matches.deviation[scene.surface])
    fine = spacing(first.points)
    coarse = max(fine, spacing(points))
    if len(second):
        rough, other_rough = _rougher(first, second, 2 * max(RESOLUTION * diagonal, CELL_SPACINGS * coarse))
        mine, other = np.hypot(mine, rough), np.hypot(other, other_rough)
    is_denser = _times_as_many(second.points, first.points, coarse) > DENSER_FACTOR * share
    factor = 1 / BETTER_FACTOR if is_denser else BETTER_FACTOR
    theirs = np.full(len(points), np.inf)
    theirs[scene.surface] = other
    # What the scene did not measure lies as far off as what it measured, at least.
    typical = float(np.median(other)) if len(second) else 0.0

    def is_same(distance: Array, one: Array, two: Array, least: Array | float) -> Mask:
        common = np.hypot(one, np.where(np.isfinite(two), two, typical))
        return np.asarray(distance <= np.clip(SAME_PLACE_DEVIATIONS * common, least, 2 * RESOLUTION * diagonal))

    distance, partner = _nearest(points, first.points, 2 * RESOLUTION * diagonal)
    # A measured point of the scene is on the object's surface or beside it, on the ground for instance.
    least = SAME_PLACE_SPACINGS * np.where(scene.surface, fine, coarse)
    worse = is_same(distance, mine[partner], theirs, least) & (mine[partner] <= factor * theirs)
    # What it measured in a hole of the object's surface, or beyond its border, is nowhere else.
    worse &= ~scene.surface | (_beside(points, first[partner]) <= coarse)
    if len(second):
        # What it did not measure may well be right where the object measures less exactly than the scene.
        inexact = (mine[partner] > BETTER_FACTOR * typical) & (distance <= SAME_PLACE_DEVIATIONS * mine[partner])
        worse &= scene.surface | ~inexact
        distance, partner = _nearest(first.points, second.points, 2 * RESOLUTION * diagonal)
        # A better point of a sparser side stands for what lies within a spacing of the object's.
        there = is_same(distance, mine, other[partner], SAME_PLACE_SPACINGS * coarse)
        there &= _beside(first.points, second[partner]) <= fine
        if is_denser:
            # Points of the object that are no better stay where a denser scene has holes.
            hole = np.where(mine > BETTER_FACTOR * other[partner], np.inf, SAME_PLACE_SPACINGS * spacing(second.points))
            there &= _beside(first.points, second[partner]) <= hole
        better[obj.surface] = there & (mine > factor * other[partner])
    return worse, better


def _nearest(points: Array, others: Array, reach: float) -> tuple[Array, NDArray[np.intp]]:
    """Distance (N,) to the nearest of the others (M, 3) and its row (N,); infinite, and any row, beyond reach."""
    distance, row = cKDTree(others).query(points, distance_upper_bound=reach, workers=threads())
    return distance, np.minimum(row, len(others) - 1)


def _alone(points: Array, others: Cloud, reach: float) -> Mask:
    """(N,) points beside which, along the surface, none of the others lies within reach."""
    if not len(points) or not len(others):
        return np.full(len(points), not len(others))
    count = min(NEIGHBOURS, len(others))
    near = cKDTree(others.points).query(points, k=count, workers=threads())[1].reshape(-1)
    beside = _beside(np.repeat(points, count, axis=0), others[near])
    return np.asarray(beside.reshape(-1, count).min(1) > reach)


def _times_as_many(points: Array, others: Array, reach: float) -> float:
    """How many of (N, 3) points there are for each of the others (M, 3), where both are within `reach` of each other.

    Counted, not taken from spacings: regular points lie farther apart than as many irregular ones. Doubles are one.
    """
    if not len(points):
        return 0.0
    shared = [a[within(a, b, reach)] for a, b in ((points, others), (others, points))]
    return len(np.unique(shared[0], axis=0)) / max(len(shared[1]), 1)


def _beside(points: Array, partners: Cloud) -> Array:
    """How far (N,) points lie beside their partners, along the surface of these."""
    away = points - partners.points
    along = (away * partners.known_normals).sum(1)
    return np.asarray(np.sqrt(np.maximum((away**2).sum(1) - along**2, 0)))


def _rougher(one: Cloud, two: Cloud, side: float) -> tuple[Array, Array]:
    """How much more each of two clouds scatters about planes than the other does there, for its points (N,), (M,).

    Photos may confirm a point that is off, by chance; that a whole surface is rough shows beside the other side's.
    A standard deviation, per cubic cell, separately for each of six facing directions. What is bent or has an
    edge scatters in both alike.
    """
    keys = [_cells_by_side(cloud, one.points.min(0), side) for cloud in (one, two)]
    group = np.unique(np.concatenate(keys), axis=0, return_inverse=True)[1].reshape(-1)
    count, groups = int(group.max()) + 1, (group[: len(one)], group[len(one) :])
    first, second = (_scatter(cloud.points, of, count) for cloud, of in zip((one, two), groups))
    known = np.isfinite(first + second)
    more = [np.sqrt(np.where(known, np.maximum(a**2 - b**2, 0), 0)) for a, b in ((first, second), (second, first))]
    return more[0][groups[0]], more[1][groups[1]]


def _cells_by_side(cloud: Cloud, low: Array, side: float) -> NDArray[np.int64]:
    """(N, 4) cell of each point, and which of six ways it faces."""
    axis = np.abs(cloud.known_normals).argmax(1)
    backwards = cloud.known_normals[np.arange(len(cloud)), axis] < 0
    cells = np.floor((cloud.points - low) / side).astype(np.int64)
    return np.column_stack([cells, axis + 3 * backwards])


def _scatter(points: Array, group: NDArray[np.int64], count: int) -> Array:
    """RMS distance (count,) of the points in each group from the plane through them; NaN where there are too few."""
    sizes = np.maximum(np.bincount(group, minlength=count), 1)
    means = np.stack([np.bincount(group, points[:, k], count) / sizes for k in range(3)], axis=1)
    away = points - means[group]
    pairs = [np.bincount(group, away[:, i] * away[:, j], count) / sizes for i in range(3) for j in range(3)]
    least = np.linalg.eigvalsh(np.stack(pairs, axis=1).reshape(-1, 3, 3))[:, 0]
    return np.where(sizes >= 6, np.sqrt(np.maximum(least, 0)), np.nan)


def _smooth(points: Array, deviation: Array) -> Array:
    """Median standard deviation (N,) of the points around each: single points would mix both sides."""
    if not len(points):
        return deviation
    near = cKDTree(points).query(points, k=min(NEIGHBOURS, len(points)), workers=threads())[1]
    return np.median(deviation[near.reshape(len(points), -1)], axis=1)


def gaps(obj: Cloud, wanted: Mask, added: Mask, scene: Cloud) -> Mask:
    """(N,) of the wanted points those beside which, along the surface, neither the added ones nor the scene have any:
    before or behind them within RESOLUTION is the same place."""
    there, rows = concatenate([obj[added], scene]), np.flatnonzero(wanted)
    if len(there) == 0 or not len(rows):
        return wanted
    tree, reach = cKDTree(there.points), RESOLUTION * obj.diagonal
    distance, near = tree.query(obj.points[rows], NEIGHBOURS, distance_upper_bound=reach, workers=threads())
    near = np.minimum(near, len(there) - 1).ravel()
    own = np.repeat(rows, NEIGHBOURS)
    alike = (obj.known_normals[own] * there.known_normals[near]).sum(1) > 0
    beside = _beside(obj.points[own], there[near]) <= SAME_PLACE_SPACINGS * spacing(obj.points)
    same = (np.isfinite(distance.ravel()) & alike & beside).reshape(-1, NEIGHBOURS).any(1)
    found = wanted.copy()
    found[rows[same]] = False
    return found
