"""The points of a scene that belong to a marked object: a box, without the ground and without loose parts."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, parts, spacing, voxels, within
from scenefuse.core.stage import setting
from scenefuse.core.transforms import UP, Array, inside_box, rotation_between
from scenefuse.geometry.ground import Ground, fit_ground
from scenefuse.geometry.surface import SCORE_FRACTION

# A part this near to a fiducial belongs to the object, and this near beside one that is below the surface nothing is
# ground; as a share of the diagonal.
REACH_FRACTION = 0.05
# Points closer than this belong to one part, as a share of the diagonal of the fiducials' box.
LINK_FRACTION = 0.03
# A step is left out if less than this share of the surface in the box would be left: the object is there.
MIN_LEFT = 0.05
# Parts with a smaller share of the surface are left out.
MIN_PART_SHARE = 0.01
# The outermost share of points on each side marks nothing: strays, among the votes of masks for instance.
STRAY_SHARE = MIN_PART_SHARE
# Only what lies in or below the lowest tenth of the fiducials' height may be ground.
FOOT_SHARE = 0.1
# Ground rises by 20 degrees at most.
MAX_RISE = float(np.tan(np.radians(20)))
# Width of the ring around the box in which the ground is looked for, as a share of the marks' diagonal.
RING_FRACTION = 0.5
# Points lower than this above the ground are ground, as a share of the diagonal.
GROUND_FRACTION = 0.015


@dataclass(frozen=True)
class CropSettings:
    """Settings of the crop."""

    mode: Literal["masks", "fiducials"] = setting("masks")
    """What marks the object in the scene: its masks (or, where a cloud of it is given with cameras and without masks,
    this cloud), seen through the alignment from shared features, and only where photos share too few the file in the
    column `fiducials`; or this file in any case. An object without it, and without photos on both sides, is searched in
    the whole scene."""
    margin: float = setting(0.05, least=0)
    """Widening of the box on every side, as a share of its own extent."""
    remove_ground: bool = setting(True)
    """Whether the ground is fitted around the box and removed inside."""
    max_residual_px: float = setting(5, unit="px", least=0)
    """Clicks of one fiducial may miss each other by this much, RMS, in pixels of the photos."""
    min_votes: float = 0.8
    """Share of the object's photos showing a scene point that must have it inside their mask."""
    whole_scene: bool = False
    """Keep the whole scene, whatever the mode: the ablation without cropping, and what is left without any mark."""
    minimal: bool = False
    """Keep all that lies in the least upright box around the marks, whatever the rest says: the paper's crop."""


@dataclass(frozen=True)
class Crop:
    """What was cut out and how.

    Attributes:
        keep: (N,) bool over the scene's points, True on the object.
        on_ground: (N,) bool, True for points in it that were removed as ground.
        level_from_scene: (3, 3) rotation that turns the scene's up into z.
        low: (3,) least corner of the box in the level frame.
        high: (3,) greatest corner.
        ground: the fitted ground on which the object stands, or None.
        notes: what was not done and why.
    """

    keep: NDArray[np.bool_]
    on_ground: NDArray[np.bool_]
    level_from_scene: Array
    low: Array
    high: Array
    ground: Ground | None
    notes: list[str]


def whole(scene: Cloud) -> Crop:
    """The whole scene as a crop."""
    everything = np.ones(len(scene), dtype=bool)
    note = "nothing was cut out: the object is looked for in the whole scene, as if that showed little else"
    return Crop(everything, ~everything, np.eye(3), scene.points.min(0), scene.points.max(0), None, [note])


def crop_cloud(
    scene: Cloud, fiducials: Array, up: Array, settings: CropSettings, other: NDArray[np.bool_] | None = None
) -> Crop:
    """The points of a scene that belong to the object marked by fiducials (F, 3), without those known to be `other`."""
    level = rotation_between(up, UP)
    points, marks = scene.points @ level.T, fiducials @ level.T
    extent = np.ptp(marks, axis=0)
    if settings.minimal:
        low, high = marks.min(0), marks.max(0)
        inside = inside_box(points, low, high)
        return Crop(inside, np.zeros_like(inside), level, low, high, None, [])
    diagonal = float(np.linalg.norm(extent))
    margin = settings.margin * extent + 2 * SCORE_FRACTION * diagonal
    low, high = marks.min(0) - margin, marks.max(0) + margin
    ground, notes = ground_under(points, marks, low, high) if settings.remove_ground else (None, [])
    if ground is not None:
        # Fiducials are clicked where the scene shows the object; what it stands on bounds it below.
        corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
        low[2] = min(low[2], ground.height(corners).min() - GROUND_FRACTION * diagonal)
    in_box = inside_box(points, low, high)
    away = np.zeros(len(points), dtype=bool)
    if ground is not None and in_box.any():
        away = on_ground(points, marks, ground, in_box)
        area = _areas(points[in_box], LINK_FRACTION * diagonal)
        if area[away[in_box]].sum() > (1 - MIN_LEFT) * area.sum():
            cut = crop_cloud(scene, fiducials, up, replace(settings, remove_ground=False), other)
            share = f"{away.sum()} of the {in_box.sum()} points in the box"
            return replace(cut, notes=[f"{share} would be ground: nothing was removed as ground", *cut.notes])
        if not away.any():
            notes.append("the ground around the box does not continue into it: nothing was removed as ground")
    keep = in_box & ~away if other is None else in_box & ~away & ~other
    keep, said = _without_loose_parts(points, keep, marks, diagonal)
    return Crop(keep, away, level, low, high, ground, notes + said)


def _without_loose_parts(
    points: Array, inside: NDArray[np.bool_], marks: Array, diagonal: float
) -> tuple[NDArray[np.bool_], list[str]]:
    """Those of the points `inside` in large enough parts that a fiducial touches, and what was not done and why."""
    own = points[inside]
    if not len(own):
        return inside, []
    cell, reach = LINK_FRACTION * diagonal, REACH_FRACTION * diagonal
    area, (part_of, counts) = _areas(own, cell), parts(own, max(cell, 3 * spacing(own, cell=cell)))
    # Of millions of marks and points one in each cell says as much, to an eighth of the reach.
    one, mark = (np.unique(voxels(side, reach / 8)[0], return_index=True)[1] for side in (own, marks))
    touched = np.bincount(part_of[one], within(own[one], marks[mark], reach), len(counts)) > 0
    near = (touched & (np.bincount(part_of, area) >= MIN_PART_SHARE * area.sum()))[part_of]
    if not near.any():
        return inside, ["no part in the box lies near a fiducial: all of them were kept"]
    if area[near].sum() < MIN_LEFT * area.sum():
        return inside, [f"parts near a fiducial have only {near.sum()} of {len(own)} points in the box: all were kept"]
    keep = inside.copy()
    keep[inside] = near
    return keep, []


def _areas(points: Array, cell: float) -> Array:
    """(N,) what share of its cell each point is: their sum grows with a surface, and not with how densely it was
    measured."""
    group, counts = voxels(points, cell)
    return 1 / counts[group]


def ground_under(points: Array, marks: Array, low: Array, high: Array) -> tuple[Ground | None, list[str]]:
    """The ground under an object, and why there is none (method C4).

    It is fitted around the box to points that ground can reach which rises by 20 degrees at most from the lowest tenth
    of the fiducials' height. It may neither be steeper, nor pass over that tenth, nor be farther below the fiducials
    than these are high: fiducials bound the object, so it does not stand on what is farther down.

    Args:
        points: (N, 3) the scene's, z up.
        marks: (F, 3) the fiducials.
        low: (3,) corner of the box.
        high: (3,) opposite corner.
    """
    foot, height = _foot(marks)
    limit, diagonal = foot[2] + FOOT_SHARE * height, float(np.linalg.norm(np.ptp(marks, axis=0)))
    reached = points[points[:, 2] <= limit + MAX_RISE * np.hypot(*(points - foot).T[:2])]
    ground = fit_ground(reached, low, high, RING_FRACTION * diagonal, GROUND_FRACTION * diagonal)
    if ground is None:
        return None, ["no ground was found around the box: nothing was removed as ground"]
    middle = (low[:2] + high[:2])[None] / 2
    angle, most = (float(np.degrees(np.arctan(rise))) for rise in (ground.rise(middle)[0], MAX_RISE))
    if angle > most:
        steep = f"the lowest surface around the box rises by {angle:.0f} degrees, ground by {most:.0f} at most"
        return None, [f"{steep}: nothing was removed as ground"]
    over = float(ground.height(foot[None, :2])[0]) - limit
    if over > ground.tolerance:
        high_up = f"the level surface around the box is {over:.3g} over the lowest tenth of the fiducials' height"
        return None, [f"{high_up}: nothing was removed as ground"]
    gap = float((marks[:, 2] - ground.height(marks[:, :2]))[marks[:, 2] >= foot[2]].min())
    if gap > height + ground.tolerance:
        far = f"the ground around the box is {gap:.3g} below the fiducials, which are {height:.3g} high"
        return None, [f"{far}: the box was not extended down to it; if the object stands on it, mark its foot too"]
    return ground, []


def on_ground(points: Array, marks: Array, ground: Ground, in_box: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) which of the points in the box are ground: not higher than it, and connected with it outside the box.

    Never a point over the lowest tenth of the fiducials' height (from the fiducials' downhill end on, this level
    rises with the ground), nor where the surface is steep, nor beside or over a fiducial that is below the surface.

    Args:
        points: (N, 3) the scene's, z up.
        marks: (F, 3) the fiducials.
        ground: of `ground_under`.
        in_box: (N,) the points in the box, one at least.
    """
    foot, height = _foot(marks)
    diagonal = float(np.linalg.norm(np.ptp(marks, axis=0)))
    inside, ring = points[in_box, :2], RING_FRACTION * diagonal
    near = (points[:, :2] >= inside.min(0) - ring) & (points[:, :2] <= inside.max(0) + ring)
    rows = np.flatnonzero(near.all(1))
    xy, z = points[rows, :2], points[rows, 2]
    surface = ground.height(xy)
    under = ground.height(marks[:, :2])
    uphill = np.maximum(surface - under.min(), 0)
    level = (z <= surface + ground.tolerance) & (ground.rise(xy) <= MAX_RISE)
    level &= z <= foot[2] + FOOT_SHARE * height + uphill
    buried = marks[(under - marks[:, 2] > ground.tolerance) & (marks[:, 2] >= foot[2])]
    if len(buried):
        level &= ~within(xy, buried[:, :2], REACH_FRACTION * diagonal)
    rows = rows[level]
    around = ~in_box[rows] & (z >= surface - ground.tolerance)[level]
    found = np.zeros(len(points), dtype=bool)
    if around.any():
        part_of, counts = parts(points[rows], max(LINK_FRACTION * diagonal, 3 * spacing(points[rows])))
        continued = np.bincount(part_of, around, len(counts)) >= MIN_PART_SHARE * around.sum()
        found[rows] = continued[part_of]
    return found & in_box


def without_strays(points: Array, share: float = STRAY_SHARE) -> Array:
    """Points (N, 3) without the outermost share along each axis."""
    if not len(points):
        return points
    low, high = np.percentile(points, [100 * share, 100 * (1 - share)], axis=0)
    return points[inside_box(points, low, high)]


def _foot(marks: Array) -> tuple[Array, float]:
    """The lowest fiducial (3,), and how high the fiducials are."""
    order = np.argsort(marks[:, 2], kind="stable")
    strays = int(STRAY_SHARE * len(marks))
    foot = marks[order[strays]]
    return foot, float(marks[order[-1 - strays], 2] - foot[2])
