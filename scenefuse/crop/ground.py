"""Which points of a scene are the ground that a marked object stands on: level, below it, and continued around it."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import spacing
from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array
from scenefuse.crop.parts import LINK_FRACTION, MIN_PART_SHARE, parts
from scenefuse.geometry.ground import Ground, fit_ground

# Only what lies in or below the lowest tenth of the fiducials' height may be ground.
FOOT_SHARE = 0.1
# Ground rises by 20 degrees at most.
MAX_RISE = float(np.tan(np.radians(20)))
# The lowest and highest share of the marks does not count: strays among the votes of masks.
STRAY_SHARE = 0.01
# Width of the ring around the box in which the ground is looked for, as a share of the marks' diagonal.
RING_FRACTION = 0.5
# Points lower than this above the ground are ground, as a share of the diagonal.
GROUND_FRACTION = 0.015
# So far beside a mark that is below the surface, nothing is ground, as a share of the diagonal.
BESIDE_FRACTION = 0.05


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
        in_box: (N,) the points in the box or hull, one at least.
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
        level &= cKDTree(buried[:, :2]).query(xy, workers=threads())[0] > BESIDE_FRACTION * diagonal
    rows = rows[level]
    around = ~in_box[rows] & (z >= surface - ground.tolerance)[level]
    found = np.zeros(len(points), dtype=bool)
    if around.any():
        part_of, counts = parts(points[rows], max(LINK_FRACTION * diagonal, 3 * spacing(points[rows])))
        continued = np.bincount(part_of, around, len(counts)) >= MIN_PART_SHARE * around.sum()
        found[rows] = continued[part_of]
    return found & in_box


def _foot(marks: Array) -> tuple[Array, float]:
    """The lowest fiducial (3,), and how high the fiducials are."""
    order = np.argsort(marks[:, 2], kind="stable")
    strays = int(STRAY_SHARE * len(marks))
    foot = marks[order[strays]]
    return foot, float(marks[order[-1 - strays], 2] - foot[2])
