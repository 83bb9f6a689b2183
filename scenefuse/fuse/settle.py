"""Settle: a registered object is laid on what its photos and the scene's measured of the same surface (method F4)."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud
from scenefuse.cloud.import_cloud import MIN_POINTS
from scenefuse.core.transforms import Sim3, Uncertainty
from scenefuse.fuse.measure import RESOLUTION
from scenefuse.geometry.icp import ScaleRange, change_between, refine_planes
from scenefuse.geometry.surface import SAMPLED_POINTS, SCORE_FRACTION, Surface, with_queries
from scenefuse.register.decision import FineSettings
from scenefuse.register.likelihood import PIECES_ACROSS
from scenefuse.register.score import DISTINCT_SCALE_LOG

# An object that moves by more than this share of its diagonal was put at a wrong place, however certain that seemed. If
# the poses of halves spread by more, the scale stays: a roof alone does not determine how large a house is.
MIN_MISPLACED = FineSettings.max_translation_sd_fraction
# Halves of the surfaces that are settled alike.
HALVES = 6


def settle(obj: Cloud, scene: Cloud, diagonal: float, certain: float | None = None) -> tuple[Sim3, float] | None:
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

    Returns:
        settled_from_placed and the RMS distance that it moves the object's points, over the diagonal; None where a side
        has too few points, or where they would move by more than twice SCORE_FRACTION: then the registration put it
        elsewhere.
    """
    if min(len(obj), len(scene)) < MIN_POINTS:
        return None
    mine, theirs = _surface(obj), _surface(scene)
    pose, scales = _refined(mine, theirs, DISTINCT_SCALE_LOG, diagonal), ScaleRange(1.0, DISTINCT_SCALE_LOG)
    spread = half_sampling(mine, theirs, pose, scales, SCORE_FRACTION * diagonal)
    if spread is None or spread.size(diagonal) > MIN_MISPLACED:
        pose = _refined(mine, theirs, 0.0, diagonal)
    moved = float(np.sqrt(((pose.apply(obj.points) - obj.points) ** 2).sum(1).mean())) / diagonal
    if certain is not None and moved <= MIN_MISPLACED and (spread is None or certain < spread.size(diagonal)):
        return Sim3.identity(), 0.0
    return (pose, moved) if moved <= 2 * SCORE_FRACTION else None


def _refined(mine: Surface, theirs: Surface, scale_width: float, diagonal: float) -> Sim3:
    """The pose after refinement with pairs that come nearer and nearer: an object a few per cent off still settles."""
    pose = Sim3.identity()
    for reach in np.geomspace(2 * SCORE_FRACTION, RESOLUTION, 3):
        pose = refine_planes(mine, theirs, pose, ScaleRange(1.0, scale_width), reach * diagonal, rounds=10)
    return pose


def _surface(cloud: Cloud) -> Surface:
    """A cloud made ready for refinement: drawn evenly, since averages would round corners off; a quarter queries."""
    thin = cloud[np.sort(np.random.default_rng(0).permutation(len(cloud))[:SAMPLED_POINTS])]
    colors = None if thin.colors is None else thin.colors / 255.0
    normals = thin.known_normals.astype(np.float64)
    surface = Surface(thin.points, normals, colors, cKDTree(thin.points), np.arange(len(thin)))
    return with_queries(surface, SAMPLED_POINTS // 4)


def half_sampling(obj: Surface, scene: Surface, pose: Sim3, scales: ScaleRange, tau: float) -> Uncertainty | None:
    """Half-sampling (Politis, Romano 1994): refine again and again with half of the surface's pieces, drawn at random.

    The deviation of a half's pose from the whole's has the spread that the whole's has from the truth. New pairs are
    made each time; a bootstrap of fixed pairs is some five times too sure of itself.

    Args:
        obj: the object in its own frame.
        scene: the scene around it.
        pose: scene_from_object of the whole.
        scales: bounds of the scale.
        tau: see `refine_planes`.

    Returns:
        None with no more pieces to draw from than a pose has parameters.
    """
    centre, rng = obj.points.mean(0), np.random.default_rng(0)
    edge = float(np.linalg.norm(np.ptp(scene.points, axis=0))) / PIECES_ACROSS
    deviations = np.zeros((HALVES, 7))
    for k in range(HALVES):
        half = _half(obj, scene, pose, edge, rng)
        if half is None:
            return None
        # A scale that stays where it is put shows itself.
        factor = 1 + DISTINCT_SCALE_LOG if k % 2 else 1 / (1 + DISTINCT_SCALE_LOG)
        start = Sim3(factor, np.eye(3), (1 - factor) * pose.apply(centre)) @ pose
        other = refine_planes(*half, start, scales, tau, rounds=30)
        deviations[k] = change_between(pose, other, centre)
    return Uncertainty.of(deviations.T @ deviations / HALVES)


def _half(
    obj: Surface, scene: Surface, pose: Sim3, edge: float, rng: np.random.Generator
) -> tuple[Surface, Surface] | None:
    """Both surfaces with the queries in a random half of the scene's pieces, cubes of `edge`; None with too few."""
    places = np.concatenate([scene.points, pose.apply(obj.points)])
    piece = np.unique(np.floor(places / edge).astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    in_scene, in_object = piece[: len(scene)], piece[len(scene) :]
    pieces = np.unique(in_scene)
    if len(pieces) <= 7:
        return None
    chosen = np.zeros(piece.max() + 1, dtype=bool)
    chosen[rng.permutation(pieces)[: len(pieces) // 2]] = True
    return (
        replace(obj, queries=obj.queries[chosen[in_object[obj.queries]]]),
        replace(scene, queries=scene.queries[chosen[in_scene[scene.queries]]]),
    )
