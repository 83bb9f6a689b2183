"""Evidence: points of the object and of the scene around it, kept where photos confirm them, dropped where photos
contradict them (method F4)."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, concatenate, plane_normals, spacing
from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array, Sim3
from scenefuse.fuse.settle import settle
from scenefuse.geometry.photo_check import LEAST_PHOTOS, MIN_MATCH, SLACK, Matches, Photos, match_in, moved_photos
from scenefuse.geometry.visibility import Visibility, see

UNCHECKED, MEASURED, NERF_ONLY, STEREO_ONLY = 0, 1, 2, 3
"""Values of the field `evidence`."""
FIELDS = ("photos", "match", "deviation", "world_deviation", "evidence")
"""What is known of a point: photos that confirm it, mean NCC of the best, one standard deviation, and one of these."""
KEPT, SEEN_THROUGH, ENCLOSED, REPLACED, ELSEWHERE = 0, 1, 2, 3, 4
"""What becomes of a point of the scene, field `reason` of those taken away."""
REASONS = {
    SEEN_THROUGH: "photos see a surface behind it",
    ENCLOSED: "no photo can see it: a measured surface stands before it in all",
    REPLACED: "the object measured the place better",
    ELSEWHERE: "the object's photos match clearly better before or behind it",
}
NEAR = 0.05
"""The scene is checked in the object's box, widened by this share of its diagonal."""
MARGIN = 0.01
"""Share of the diagonal that a point must lie before or behind a surface to be seen through or hidden."""
LEAST_THROUGH = 2
"""Photos that must see through a point."""
SHARE_THROUGH = 0.3
"""And this share of those that it is open to, where it is not measured: a surface that is wrong itself lies behind
good points in some photos; a point that is not there has surfaces behind it in many."""
MOST_CONFIRM = 0.5
"""A measured point of the scene that more than this share of the photos asked confirm is not seen through."""
CERTAIN_STEPS = 0.5
"""Of a step along the ray (about a pixel), the most that the object's pose may be off for its photos to say that they
match a single point of the scene elsewhere."""
MOST_ELSEWHERE = 0.1
"""Share of what the scene measured of which they may say so: where it is more, the pose is off after all."""
LEAST_VIEWS = 3
"""Photos that must have a point in their picture for it to count as enclosed."""
SAME_DEVIATIONS, SAME_SPACINGS, SAME_MOST = 5.0, 1.5, 0.02
"""Points of both sides show the same place within so many of their common standard deviations, or so many spacings of
the sparser side where that is more; never farther than this share of the diagonal."""
CLEARLY = 1.5
"""The object's points give way where the scene's standard deviation is smaller by more than this factor: they are the
denser ones, and equals would alternate. Where they are outnumbered, the scene's give way likewise."""
CONSISTENT = 3.5
"""Standard deviations of the object within which a point that the scene did not measure may be right."""
OUTNUMBERED = 2.0
"""Points of the scene for each of the object's, on the surface that both have, from which the scene is the denser."""
SMOOTH_POINTS = 8
"""Neighbours whose median standard deviation says which side is the better one: single points would mix both."""
ROUGH_SIDE, ROUGH_SPACINGS, ROUGH_POINTS = 0.02, 4.0, 6
"""Side of the cells in which both sides' scatter is compared, over the diagonal, and in spacings of the sparser side
where that is more; points that a plane needs. Photos may confirm a point that is off, by chance; that a whole surface
is rough shows beside the other side's."""
SUPPORT, SUPPORT_RADIUS, SUPPORT_MOST = 0.5, 0.01, 64
"""Share of a point and its neighbours that photos must confirm for it to be measured: here and there a point matches by
chance. These are as many as a plane has within this share of the diagonal, at least SMOOTH_POINTS and at most so many.
"""
NORMAL_POINTS = 16
"""Neighbours that a missing normal is fitted to."""
MOST_CHECKED = 1_000_000
"""Points of the scene around an object that are checked; of a denser scene a random choice, which the others follow."""


@dataclass(frozen=True)
class Side:
    """A cloud with the photos it was made from, in the same frame; without photos where there are none."""

    cloud: Cloud
    photos: Photos


@dataclass(frozen=True)
class Weighed:
    """What becomes of both sides.

    Attributes:
        settled: settled_from_placed, by which the object was moved before its points were compared.
        moved: RMS distance of that, over the object's diagonal; None where it could not be settled.
        obj: the object's points, moved, with `photos`, `match`, `deviation`, `evidence`.
        added: (N,) of the object's points that come into the scene.
        contradicted: (N,) of the object's points that photos see through.
        scene: the scene's points around it with the same fields.
        reason: (M,) uint8 of the scene's points: KEPT, or why it is taken away.
        notes: what a user should know.
    """

    settled: Sim3
    moved: float | None
    obj: Cloud
    added: NDArray[np.bool_]
    contradicted: NDArray[np.bool_]
    scene: Cloud
    reason: NDArray[np.uint8]
    notes: tuple[str, ...]


def weigh(obj: Side, scene: Side, nerf_only: bool, certain: float | None = None, share: float = 1.0) -> Weighed:
    """Check the points of an object and of the scene around it in the photos of both.

    A point is measured where three photos of its own side confirm it, and most of its neighbours; a scene's point also
    where three of the object's do. A side without photos is judged by the other's. Measured points are the surface
    that hides and is seen. What photos see through is not there (a measured point where a larger share of the photos
    that it is open to see through it than of those asked confirm it), nor what no photo can see, nor what
    the object's photos match clearly better elsewhere. Where both sides measured a place, the object's points stay
    unless the scene's standard deviation is clearly smaller; a clearly denser scene stays unless the object's is. What
    the scene measured goes only where something is left beside it.

    Args:
        obj: the object in the scene's frame, registered.
        scene: the scene's points around it.
        nerf_only: whether points of the object that no photo confirms are added where the scene has none.
        certain: how certain the registration was; see `settle`.
        share: of the scene's points there that are given.
    """
    if len(scene.cloud) > MOST_CHECKED:
        return _weigh_some(obj, scene, nerf_only, certain)
    obj, scene = replace(obj, cloud=with_normals(obj.cloud)), replace(scene, cloud=with_normals(scene.cloud))
    diagonal = obj.cloud.diagonal
    of_obj, of_scene = _own(obj, scene), _own(scene, obj)
    on_obj = _supported(obj.cloud.points, of_obj.measured, diagonal)
    on_scene = _supported(scene.cloud.points, of_scene.measured, diagonal)
    found = settle(obj.cloud[on_obj], scene.cloud[on_scene], diagonal, certain)
    settled, moved = found or (Sim3.identity(), None)
    obj = Side(obj.cloud.transformed(settled), moved_photos(obj.photos, settled))
    across = match_in(scene.cloud.points, scene.cloud.normals, obj.photos)
    on_scene = _supported(scene.cloud.points, of_scene.measured | across.measured, diagonal)
    sure = _surer(of_scene, across)
    surface = obj.cloud[on_obj]
    seen = _seen(scene.cloud.points, surface, obj, scene, diagonal)
    reason = np.zeros(len(scene.cloud), np.uint8)
    reason[(seen.hidden == seen.in_view) & (seen.in_view >= LEAST_VIEWS)] = ENCLOSED
    elsewhere = matched_elsewhere(across, of_scene.measured, np.inf if certain is None else certain * diagonal)
    reason[elsewhere & (reason == KEPT)] = ELSEWHERE
    reason[is_seen_through(seen, sure, on_scene)] = SEEN_THROUGH
    left = on_scene & (reason == KEPT)
    behind = _seen(obj.cloud.points, concatenate([surface, scene.cloud[left]]), obj, scene, diagonal)
    contradicted = np.where(on_obj, is_seen_through(behind, of_obj, on_obj), behind.through >= LEAST_THROUGH)
    added = on_obj & ~contradicted
    worse, better = compare(obj.cloud, of_obj.deviation, added, scene.cloud, sure.deviation, left, diagonal, share)
    reason[(reason == KEPT) & worse] = REPLACED
    added &= ~better
    replaced = np.flatnonzero(left & (reason == REPLACED))
    there = concatenate([obj.cloud[added], scene.cloud[reason == KEPT]])
    reason[replaced[_alone(scene.cloud.points[replaced], there, SAME_SPACINGS * spacing(scene.cloud.points))]] = KEPT
    if nerf_only:
        added |= _gaps(obj.cloud.points, ~on_obj & ~contradicted, added, scene.cloud.points[reason == KEPT])
    return Weighed(
        settled, moved, with_evidence(obj.cloud, of_obj, on_obj, NERF_ONLY), added, contradicted,
        with_evidence(scene.cloud, sure, on_scene, STEREO_ONLY), reason, _notes(obj, scene, on_obj, moved),
    )  # fmt: skip


def _weigh_some(obj: Side, scene: Side, nerf_only: bool, certain: float | None) -> Weighed:
    """`weigh` with MOST_CHECKED points of the scene; each of the others shares the fate of the nearest of these."""
    count = len(scene.cloud)
    chosen = np.sort(np.random.default_rng(0).choice(count, MOST_CHECKED, replace=False))
    some = weigh(obj, replace(scene, cloud=scene.cloud[chosen]), nerf_only, certain, MOST_CHECKED / count)
    nearest = cKDTree(scene.cloud.points[chosen]).query(scene.cloud.points, workers=threads())[1]
    fields = {name: values[nearest] for name, values in some.scene.fields.items()}
    note = f"of {count} points of the scene near the object {MOST_CHECKED} were checked; the others follow the nearest"
    return replace(
        some, scene=replace(scene.cloud, fields=fields), reason=some.reason[nearest], notes=(*some.notes, note)
    )


def _notes(obj: Side, scene: Side, on_obj: NDArray[np.bool_], moved: float | None) -> tuple[str, ...]:
    """What a user should know of the check."""
    notes = []
    for side, name, other in ((obj, "object", "scene"), (scene, "scene", "object")):
        if len(side.photos.views) < LEAST_PHOTOS:
            notes.append(f"fewer than {LEAST_PHOTOS} photos of the {name} see it: it is judged by those of the {other}")
    if not on_obj.any():
        notes.append("no photo confirms any point of the object, so nothing is added")
    if moved is None:
        notes.append(
            "the object stays where the registration put it: too little is measured on both sides, or it would move far"
        )
    elif moved == 0:
        notes.append("the object stays where the registration put it: that is more certain than what the surfaces say")
    return tuple(notes)


def around(scene: Cloud, obj: Cloud) -> NDArray[np.bool_]:
    """(N,) points of the scene that are checked: in the object's box, widened by NEAR."""
    low, high, margin = obj.points.min(0), obj.points.max(0), NEAR * obj.diagonal
    return ((scene.points >= low - margin) & (scene.points <= high + margin)).all(1)


def with_evidence(cloud: Cloud, matches: Matches, measured: NDArray[np.bool_], otherwise: int) -> Cloud:
    """The cloud with only these fields: what photos know of its points, and `evidence`: MEASURED or `otherwise`."""
    deviation = np.where(np.isfinite(matches.deviation), matches.deviation, np.nan).astype(np.float32)
    fields: dict[str, NDArray[Any]] = {
        "photos": matches.photos.astype(np.uint16),
        "match": np.where(matches.tested > 0, matches.match, np.nan).astype(np.float32),
        "deviation": deviation,
        "world_deviation": deviation.copy(),
        "evidence": np.where(measured, MEASURED, otherwise).astype(np.uint8),
    }
    return replace(cloud, fields=fields)


def with_pose_uncertainty(cloud: Cloud, covariance: Array, centre: Array) -> Cloud:
    """Points of an object, `world_deviation` with what its pose adds along their normals (method M10).

    Args:
        cloud: in the scene, with normals and fields of evidence.
        covariance: (7, 7) of the pose about `centre`: rotation vector (radians), shift, log scale.
        centre: (3,) in the scene.
    """
    if cloud.normals is None:
        return cloud
    lever, normals = cloud.points - centre, cloud.normals.astype(np.float64)
    along = np.column_stack([np.cross(lever, normals), normals, (lever * normals).sum(1)])
    of_pose = np.einsum("ni,ij,nj->n", along, covariance, along)
    whole = np.sqrt(cloud.fields["deviation"].astype(np.float64) ** 2 + np.maximum(of_pose, 0))
    return replace(cloud, fields=cloud.fields | {"world_deviation": whole.astype(np.float32)})


def unchecked(cloud: Cloud) -> Cloud:
    """The cloud with the same fields, empty: no photo was asked."""
    nothing, none = np.full(len(cloud), np.nan), np.zeros(len(cloud), np.int64)
    return with_evidence(cloud, Matches(nothing, nothing, none, none, *[nothing] * 3), none > 0, UNCHECKED)


def with_normals(cloud: Cloud) -> Cloud:
    """The cloud, with normals of local planes where it has none; their side is unknown then."""
    if cloud.normals is not None:
        return cloud
    if len(cloud) < 3:
        return replace(cloud, normals=np.tile(np.array([0, 0, 1], np.float32), (len(cloud), 1)))
    index = cKDTree(cloud.points).query(cloud.points, k=min(NORMAL_POINTS, len(cloud)), workers=threads())[1]
    return replace(cloud, normals=plane_normals(cloud.points, index).astype(np.float32))


def _own(side: Side, other: Side) -> Matches:
    """A side's points in its own photos, or in the other's where it has none."""
    photos = side.photos if len(side.photos.views) >= LEAST_PHOTOS else other.photos
    return match_in(side.cloud.points, side.cloud.normals, photos)


def _surer(one: Matches, two: Matches) -> Matches:
    """What the photos of that side say which confirms a point more often, and the least deviation of both."""
    more = two.photos > one.photos
    return Matches(**{
        name: np.where(more, getattr(two, name), values) for name, values in vars(one).items()
    } | {"match": np.maximum(one.match, two.match), "deviation": np.minimum(one.deviation, two.deviation)})  # fmt: skip


def is_seen_through(seen: Visibility, matches: Matches, measured: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) points where photos see a surface behind them: enough of those they are open to; of measured ones, a larger
    share than confirms them.

    All photos are held against a surface, only the best are matched: their numbers cannot be compared. A measured point
    that most of the photos asked confirm stays: all photos of a pot before a wall have the wall behind it.
    """
    confirming = matches.photos / (matches.tested + 1.0)  # the reference is among both
    least = np.where(measured, confirming, SHARE_THROUGH) * (seen.in_view - seen.hidden)
    least = np.where(measured & (confirming > MOST_CONFIRM), np.inf, least)
    return np.asarray(seen.through >= np.maximum(LEAST_THROUGH, least))


def matched_elsewhere(across: Matches, measured: NDArray[np.bool_], off: float) -> NDArray[np.bool_]:
    """(N,) points that the scene's photos measured, but the object's match clearly better elsewhere along the ray and
    confirm less than three times; none where the pose is uncertain, or off: it may be `off` (unit of the points)."""
    better = (across.best >= MIN_MATCH) & (across.best - across.match > SLACK)
    found = measured & better & (across.photos < LEAST_PHOTOS)
    both = found | (measured & across.measured)
    sure = both.any() and off <= CERTAIN_STEPS * np.median(across.step[both])
    return found if sure and found.sum() <= MOST_ELSEWHERE * both.sum() else np.zeros_like(found)


def _alone(points: Array, others: Cloud, reach: float) -> NDArray[np.bool_]:
    """(N,) points beside which, along the surface, none of the others lies within reach."""
    if not len(points) or not len(others):
        return np.full(len(points), not len(others))
    count = min(SMOOTH_POINTS, len(others))
    near = cKDTree(others.points).query(points, k=count, workers=threads())[1].reshape(-1)
    beside = _beside(np.repeat(points, count, axis=0), others[near])
    return np.asarray(beside.reshape(-1, count).min(1) > reach)


def _seen(points: Array, surface: Cloud, obj: Side, scene: Side, diagonal: float) -> Visibility:
    """How the photos of both sides see points beside a measured surface."""
    if len(surface) < 2:
        none = np.zeros(len(points), np.int64)
        return Visibility(none, none, none)
    views = obj.photos.views + scene.photos.views
    return see(points, surface, views, spacing(surface.points), MARGIN * diagonal)


def compare(
    obj: Cloud, of_obj: Array, on_obj: NDArray[np.bool_], scene: Cloud, of_scene: Array, on_scene: NDArray[np.bool_],
    diagonal: float, share: float,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:  # fmt: skip
    """Points of the scene (M,) that the object measured better, and points of the object (N,) that the scene did.

    of_obj (N,), of_scene (M,): standard deviations; on_obj (N,), on_scene (M,): points that are measured and stay;
    share: of the scene's points that are given.
    """
    worse, better = np.zeros(len(scene), dtype=bool), np.zeros(len(obj), dtype=bool)
    if not on_obj.any() or len(scene) == 0:
        return worse, better
    first, second = obj[on_obj], scene[on_scene]
    mine, other = _smooth(first.points, of_obj[on_obj]), _smooth(second.points, of_scene[on_scene])
    fine = spacing(first.points)
    coarse = max(fine, spacing(scene.points))
    if len(second):
        rough, other_rough = _rougher(first, second, max(ROUGH_SIDE * diagonal, ROUGH_SPACINGS * coarse))
        mine, other = np.hypot(mine, rough), np.hypot(other, other_rough)
    outnumbered = _times_as_many(second.points, first.points, coarse) > OUTNUMBERED * share
    factor = 1 / CLEARLY if outnumbered else CLEARLY
    theirs = np.full(len(scene), np.inf)
    theirs[on_scene] = other
    # What the scene did not measure lies as far off as what it measured, at least.
    typical = float(np.median(other)) if len(second) else 0.0

    def same(distance: Array, one: Array, two: Array, least: Array | float) -> NDArray[np.bool_]:
        common = np.hypot(one, np.where(np.isfinite(two), two, typical))
        return np.asarray(distance <= np.clip(SAME_DEVIATIONS * common, least, SAME_MOST * diagonal))

    distance, partner = cKDTree(first.points).query(scene.points, workers=threads())
    # A measured point of the scene is on the object's surface or beside it, on the ground for instance.
    least = SAME_SPACINGS * np.where(on_scene, fine, coarse)
    worse = same(distance, mine[partner], theirs, least) & (mine[partner] <= factor * theirs)
    # What it measured in a hole of the object's surface, or beyond its border, is nowhere else.
    worse &= ~on_scene | (_beside(scene.points, first[partner]) <= coarse)
    if len(second):
        # What it did not measure may well be right where the object measures less exactly than the scene.
        inexact = (mine[partner] > CLEARLY * typical) & (distance <= CONSISTENT * mine[partner])
        worse &= on_scene | ~inexact
        distance, partner = cKDTree(second.points).query(first.points, workers=threads())
        # A better point of a sparser side stands for what lies within a spacing of the object's.
        there = same(distance, mine, other[partner], SAME_SPACINGS * coarse)
        there &= _beside(first.points, second[partner]) <= fine
        if outnumbered:
            # Of equals the object's points stay in the holes of a denser scene.
            hole = np.where(mine > CLEARLY * other[partner], np.inf, SAME_SPACINGS * spacing(second.points))
            there &= _beside(first.points, second[partner]) <= hole
        better[on_obj] = there & (mine > factor * other[partner])
    return worse, better


def _times_as_many(points: Array, others: Array, reach: float) -> float:
    """How many of (N, 3) points there are for each of the others (M, 3), where both are within `reach` of each other.

    Counted, since regular points lie farther from their nearest ones than as many irregular ones; doubles are one.
    """
    if not len(points):
        return 0.0
    shared = [a[cKDTree(b).query(a, workers=threads())[0] < reach] for a, b in ((points, others), (others, points))]
    return len(np.unique(shared[0], axis=0)) / max(len(shared[1]), 1)


def _beside(points: Array, partners: Cloud) -> Array:
    """How far (N,) points lie beside their partners, along the surface of these."""
    assert partners.normals is not None
    away = points - partners.points
    along = (away * partners.normals).sum(1)
    return np.asarray(np.sqrt(np.maximum((away**2).sum(1) - along**2, 0)))


def _rougher(one: Cloud, two: Cloud, side: float) -> tuple[Array, Array]:
    """How much more each of two clouds scatters about planes than the other does there, for its points (N,), (M,).

    A standard deviation, by cells of a side, those of points that face the same way apart from the others. What is bent
    or has an edge scatters in both alike.
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
    assert cloud.normals is not None
    axis = np.abs(cloud.normals).argmax(1)
    backwards = cloud.normals[np.arange(len(cloud)), axis] < 0
    cells = np.floor((cloud.points - low) / side).astype(np.int64)
    return np.column_stack([cells, axis + 3 * backwards])


def _scatter(points: Array, group: NDArray[np.int64], count: int) -> Array:
    """RMS distance (count,) of the points in each group from the plane through them; NaN where there are too few."""
    sizes = np.maximum(np.bincount(group, minlength=count), 1)
    means = np.stack([np.bincount(group, points[:, k], count) / sizes for k in range(3)], axis=1)
    away = points - means[group]
    pairs = [np.bincount(group, away[:, i] * away[:, j], count) / sizes for i in range(3) for j in range(3)]
    least = np.linalg.eigvalsh(np.stack(pairs, axis=1).reshape(-1, 3, 3))[:, 0]
    return np.where(sizes >= ROUGH_POINTS, np.sqrt(np.maximum(least, 0)), np.nan)


def _supported(points: Array, measured: NDArray[np.bool_], diagonal: float) -> NDArray[np.bool_]:
    """(N,) points that photos confirm with most of their neighbours."""
    if not measured.any():
        return measured
    reach, step = SUPPORT_RADIUS * diagonal, spacing(points)
    count = int(np.clip(np.pi * (reach / step) ** 2, SMOOTH_POINTS, SUPPORT_MOST)) + 1 if step > 0 else SUPPORT_MOST
    near = cKDTree(points).query(points[measured], k=min(count, len(points)), workers=threads())[1]
    found = measured.copy()
    found[measured] = measured[near.reshape(int(measured.sum()), -1)].mean(1) >= SUPPORT
    return found


def _smooth(points: Array, deviation: Array) -> Array:
    """Median standard deviation (N,) of the points around each."""
    if not len(points):
        return deviation
    near = cKDTree(points).query(points, k=min(SMOOTH_POINTS, len(points)), workers=threads())[1]
    return np.median(deviation[near.reshape(len(points), -1)], axis=1)


def _gaps(points: Array, wanted: NDArray[np.bool_], added: NDArray[np.bool_], scene: Array) -> NDArray[np.bool_]:
    """(N,) of the wanted points those where neither the added ones nor the scene have any."""
    there = np.concatenate([points[added], scene])
    if len(there) == 0 or not wanted.any():
        return wanted
    free = cKDTree(there).query(points, workers=threads())[0] > SAME_SPACINGS * spacing(points)
    return wanted & free
