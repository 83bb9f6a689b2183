"""Settle: a registered object is laid on what its photos and the scene's measured of the same surface (method F4)."""

import numpy as np
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import Sim3
from scenefuse.geometry.icp import COLOR_WEIGHT, ScaleRange, refine_planes
from scenefuse.geometry.surface import Surface, with_queries
from scenefuse.register.uncertainty import half_sampling

# Pairs within these shares of the diagonal, one after the other: an object a few per cent off still settles. One that
# would move by more than the first (RMS) is not where the registration put it.
REACHES = (0.04, 0.02, 0.01)
# The scale stays within five per cent of what the registration found.
SCALE_WIDTH = 0.05
# Measured points that each side needs; of each side at most so many, drawn evenly, and of these those that look for a
# partner. They are not averaged, which would round corners off.
MIN_POINTS, MAX_POINTS, MAX_QUERIES = 200, 20000, 5000
# An object that moves by more than this share of its diagonal was put at a wrong place, however certain that seemed: a
# registration's position may be as uncertain as that.
MIN_MISPLACED = 0.005
# Halves of the surfaces that are settled alike, and how far their poses may spread, over the diagonal, for the scale to
# be settled too: a roof alone does not determine how large a house is.
HALVES, MAX_SPREAD = 6, 0.003


def settle(
    obj: Cloud, scene: Cloud, diagonal: float, certain: float | None = None, seed: int = 0
) -> tuple[Sim3, float] | None:
    """The similarity that lays measured points of an object on those of the scene, and how far it moves them.

    The registration worked on whole clouds, with what stereo made up at edges and the NeRF where nothing was seen; here
    both sides are what their photos confirmed, so the same refinement (method R8: planes, points and colours both ways)
    is more exact. The scale stays what it is where the surfaces do not determine it. Where the registration was more
    certain than that, by the photos that both sides share for instance, the object stays as it is, unless it would move
    by more than MIN_MISPLACED: the surfaces of a scene's stereo have errors of their own.

    Args:
        obj: measured points in the scene's frame, with normals, and colours if both have them.
        scene: the scene's around them, likewise.
        diagonal: of the object.
        certain: `size` of the registration's uncertainty on the scene, over the diagonal; None where it is not known.
        seed: of the drawing.

    Returns:
        settled_from_placed and the RMS distance that it moves the object's points, over the diagonal; None where a side
        has too few points, or where they would move by more than the first of REACHES.
    """
    if min(len(obj), len(scene)) < MIN_POINTS:
        return None
    mine, theirs = _surface(obj, seed), _surface(scene, seed)
    pose, scales = _refined(mine, theirs, SCALE_WIDTH, diagonal), ScaleRange(1.0, SCALE_WIDTH)
    spread = half_sampling([(mine, theirs)], pose, scales, REACHES[1] * diagonal, HALVES, seed)
    if spread is None or spread.size(diagonal) > MAX_SPREAD:
        pose = _refined(mine, theirs, 0.0, diagonal)
    moved = float(np.sqrt(((pose.apply(obj.points) - obj.points) ** 2).sum(1).mean())) / diagonal
    if certain is not None and moved <= MIN_MISPLACED and (spread is None or certain < spread.size(diagonal)):
        return Sim3.identity(), 0.0
    return (pose, moved) if moved <= REACHES[0] else None


def _refined(mine: Surface, theirs: Surface, scale_width: float, diagonal: float) -> Sim3:
    """The pose after refinement with pairs that come nearer and nearer."""
    pose = Sim3.identity()
    for reach in REACHES:
        pose = refine_planes(mine, theirs, pose, ScaleRange(1.0, scale_width), reach * diagonal, 10, COLOR_WEIGHT)
    return pose


def _surface(cloud: Cloud, seed: int) -> Surface:
    """A cloud made ready for refinement."""
    rng = np.random.default_rng(seed)
    thin = cloud[np.sort(rng.permutation(len(cloud))[:MAX_POINTS])]
    colors = None if thin.colors is None else thin.colors / 255.0
    assert thin.normals is not None
    normals = thin.normals.astype(np.float64)
    surface = Surface(thin.points, normals, colors, cKDTree(thin.points), np.arange(len(thin)))
    return with_queries(surface, MAX_QUERIES, seed)
