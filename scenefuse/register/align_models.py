"""Cross-model alignment from shared features: points and photos that the object's and the scene's sparse models share.

It uses the photos only, not the dense clouds, so what goes wrong in one rarely goes wrong in both.
"""

import contextlib
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import quantity, write_json
from scenefuse.core.transforms import MAX_DEVIATIONS, Array, Sim3, fit_sim3
from scenefuse.geometry.icp import MAX_TRIPLES, RANSAC_POSES, triples_of_one_scale
from scenefuse.register.gps import GpsPose, gps_quantities, pose_by_gps
from scenefuse.register.landmarks import Landmarks, match_landmarks, read_landmarks
from scenefuse.register.reprojection import (
    Observations,
    bootstrap,
    match_errors,
    minimise_reprojection,
    observations,
)
from scenefuse.register.uncertainty import Uncertainty, uncertainty_quantities

# Random triples of matches drawn.
RANSAC_SAMPLES = 100_000
# Largest reprojection error of an inlier, RMS, in pixels of the coarser photos.
MAX_ERROR_PX = 6.0
# The gate: inliers of the best pose among the other matches, over inliers; standard deviation of the log scale, and of
# the rotation in radians: how far either moves what is a unit off the middle.
MAX_RIVAL_SHARE, MAX_SD = 0.5, 0.05
# Draws of photos and points for the standard deviations.
BOOTSTRAP_DRAWS = 200


@dataclass(frozen=True)
class AlignmentSettings:
    """Settings of the alignment from shared features."""

    min_points: int = 15
    """Gate: fewest points shared by both models."""
    min_photos: int = 3
    """Gate: fewest photos on either side that observe shared points."""
    max_ratio: float = 0.85
    """Lowe's ratio test: descriptor distance to the best over that to the second-best point."""
    nearest_points: int = 200
    """Shared points that fix the pose, those nearest to where the object's photos look: far from it both models may be
    bent against each other. As many rank the poses of RANSAC."""
    gps_accuracy_m: float = 3.0
    """Standard error of the GPS positions of either side that state none, when they are compared."""


@dataclass(frozen=True)
class Consensus:
    """The similarity that most matches support.

    Attributes:
        pose: scene_from_object.
        inliers: (M,) bool over the matches.
        rival: inliers of the best pose among the rest.
        other: that pose, or None.
        settled_by_gps: whether GPS chose among several.
    """

    pose: Sim3
    inliers: NDArray[np.bool_]
    rival: int
    other: Sim3 | None = None
    settled_by_gps: bool = False


def align_models(
    *,
    object_sparse: Path,
    object_features: Path,
    scene_sparse: Path,
    scene_features: Path,
    report: Path,
    seed: int,
    settings: AlignmentSettings,
    object_photos: Path | None = None,
    scene_photos: Path | None = None,
    scene_json: Path | None = None,
) -> None:
    """Find scene_from_object from features that the object's photos share with the scene's (method R14).

    Shared points: triangulated points of both models are matched by their SIFT descriptors, RANSAC over triples gives a
    similarity of free scale, and Gauss-Newton minimises the reprojection of each model's points in the other's photos.
    GPS: where both sides have it, it gives one more estimate, which distinguishes an object from its like elsewhere.

    Args:
        object_sparse: COLMAP model of the object's original photos; its frame is the object frame.
        object_features: COLMAP database that holds their features.
        scene_sparse: georeferenced COLMAP model of the scene; its frame is the scene frame.
        scene_features: COLMAP database that holds the scene's features.
        report: output JSON: `found`, `reason`, `scene_from_object`, how certain it is.
        seed: of all random choices.
        settings: see AlignmentSettings.
        object_photos: JSON list of the object's photos with their GPS positions, if any.
        scene_photos: the same of the scene, for their accuracy.
        scene_json: JSON of the georeferencing stage, for the scene's origin.

    Raises:
        StageError: a database does not belong to its model.
    """
    begin = time.perf_counter()
    obj = read_landmarks(object_sparse, object_features)
    scene = read_landmarks(scene_sparse, scene_features)
    gps = pose_by_gps(obj, scene, object_photos, scene_photos, scene_json, settings.gps_accuracy_m, seed)
    content = align_landmarks(obj, scene, settings, seed, gps)
    print(f"{'found' if content['found']['value'] else 'not found'}: {content['reason']['value']}", flush=True)
    write_json(report, {**content, "seconds": quantity(time.perf_counter() - begin, "s")})


def align_landmarks(
    obj: Landmarks, scene: Landmarks, settings: AlignmentSettings, seed: int, gps: GpsPose | None = None
) -> dict[str, Any]:
    """Match, find a consensus, refine, apply the gate: the stage JSON without its time."""
    pairs = match_landmarks(obj, scene, settings.max_ratio)
    print(f"{len(obj.points)} points of the object, {len(scene.points)} of the scene, {len(pairs)} matches", flush=True)
    seen = observations(obj, scene, pairs)
    consensus = find_consensus(seen, seed)
    centre = np.median(obj.points, axis=0)
    if consensus is None or not consensus.inliers.any():
        nothing = f"{len(pairs)} points of the models look alike, and no three of them fit one similarity"
        return _report(len(pairs), nothing) | gps_quantities(gps, None, obj.looked_at())
    if gps is not None:
        consensus = _by_gps(seen, consensus, gps, obj.looked_at(), seed)
    inliers = seen.subset(consensus.inliers)
    near = nearest(inliers, obj.looked_at(), settings.nearest_points)
    pose = minimise_reprojection(near, consensus.pose, MAX_ERROR_PX / 2)
    drawn = bootstrap(near, pose, MAX_ERROR_PX / 2, centre, BOOTSTRAP_DRAWS, seed)
    # The pose that all points give shows how much the models are bent against each other.
    uncertainty = drawn.with_difference(pose, consensus.pose, centre)
    consensus = replace(consensus, pose=pose)
    problem = rejection_reason(consensus, inliers, len(pairs), uncertainty, settings)
    found = _report(len(pairs), problem, consensus, inliers, uncertainty)
    return found | gps_quantities(gps, None if problem else pose, obj.looked_at())


def nearest(seen: Observations, place: Array, count: int) -> Observations:
    """The `count` matches nearest to a place (3,) in the object's frame."""
    distance = np.linalg.norm(seen.x - place, axis=1)
    return seen.subset(distance <= np.sort(distance)[min(count, len(distance)) - 1])


def find_consensus(seen: Observations, seed: int) -> Consensus | None:
    """The similarity that most matches support, refined on its inliers, and its strongest rival among the others."""
    pose = _most_supported(seen, seed)
    if pose is None:
        return None
    error = match_errors(seen, pose)
    others = seen.subset(error > 3 * MAX_ERROR_PX)
    other = _most_supported(others, seed)
    rival = 0 if other is None else int((match_errors(others, other) <= MAX_ERROR_PX).sum())
    return Consensus(pose, error <= MAX_ERROR_PX, rival, other)


def _by_gps(seen: Observations, consensus: Consensus, gps: GpsPose, at: Array, seed: int) -> Consensus:
    """Of a consensus and its strong rivals the one that GPS does not contradict, if there is just one."""
    poses, least = [consensus.pose], MAX_RIVAL_SHARE * consensus.inliers.sum()
    most = 10  # places alike; GPS settles none of more
    other, rival = consensus.other, consensus.rival
    while other is not None and rival > least and len(poses) < most:
        poses.append(other)
        rest = seen.subset(np.min([match_errors(seen, pose) for pose in poses], axis=0) > 3 * MAX_ERROR_PX)
        other = _most_supported(rest, seed)
        rival = 0 if other is None else int((match_errors(rest, other) <= MAX_ERROR_PX).sum())
    allowed = [pose for pose in poses if gps.miss(pose, at) <= MAX_DEVIATIONS]
    if len(poses) == 1 or len(allowed) != 1 or len(poses) == most:
        return consensus
    print(f"GPS settles which of {len(poses)} poses it is", flush=True)
    return Consensus(allowed[0], match_errors(seen, allowed[0]) <= MAX_ERROR_PX, 0, settled_by_gps=True)


def _most_supported(seen: Observations, seed: int) -> Sim3 | None:
    """RANSAC over triples whose edges agree on one scale, ranked by reprojection; the finalists are refined."""
    if len(seen.x) < 4:
        return None
    rng = np.random.default_rng(seed)
    found = triples_of_one_scale(seen.x, seen.y, RANSAC_SAMPLES, rng)
    wide = found.edges[0].min(1) > 0.1 * found.edges[0].max(1)
    proposed = []
    for triple in found.rows[wide][:MAX_TRIPLES]:
        with contextlib.suppress(ValueError):
            proposed.append(fit_sim3(seen.x[triple], seen.y[triple]))
    if not proposed:
        return None
    few = seen.subset(np.isin(np.arange(len(seen.x)), rng.permutation(len(seen.x))[: AlignmentSettings.nearest_points]))
    finalists = sorted(proposed, key=lambda p: _cost(few, p, 2 * MAX_ERROR_PX))[:RANSAC_POSES]
    return min((_polished(seen, p) for p in finalists), key=lambda p: _cost(seen, p, MAX_ERROR_PX))


def _polished(seen: Observations, pose: Sim3) -> Sim3:
    """Refined on the matches within a limit that narrows to that of an inlier."""
    for limit_px in np.array([4.0, 2.0, 1.0, 1.0]) * MAX_ERROR_PX:
        near = match_errors(seen, pose) <= limit_px
        if near.sum() < 4:
            return pose
        pose = minimise_reprojection(seen.subset(near), pose, limit_px / 2)
    return pose


def _cost(seen: Observations, pose: Sim3, limit_px: float) -> float:
    """Truncated squared errors (MSAC, Torr and Zisserman 2000)."""
    return float(np.minimum((match_errors(seen, pose) / limit_px) ** 2, 1).sum())


def rejection_reason(
    consensus: Consensus, inliers: Observations, matches: int, uncertainty: Uncertainty, settings: AlignmentSettings
) -> str | None:
    """Why the pose is rejected, in one sentence, or None."""
    count, photos = len(inliers.x), min(inliers.photos)
    if count < settings.min_points:
        return f"only {count} of {matches} matched points agree on one pose, {settings.min_points} are needed"
    if photos < settings.min_photos:
        return f"the shared points are seen in {photos} photos of one side only, {settings.min_photos} are needed"
    if consensus.rival > MAX_RIVAL_SHARE * count:
        return (
            f"another pose has {consensus.rival} points of its own beside the best one's {count}: something is there"
            " twice"
        )
    scale, turn, most_deg = uncertainty.scale_sd_log, uncertainty.rotation_sd_deg, np.degrees(MAX_SD)
    if scale > MAX_SD:
        return f"the {count} shared points leave the scale open by {100 * scale:.1f} %, more than {100 * MAX_SD:.1f} %"
    if turn > most_deg:
        return f"the {count} shared points leave the rotation open by {turn:.1f} degrees, more than {most_deg:.1f}"
    return None


def _report(
    matches: int,
    problem: str | None,
    consensus: Consensus | None = None,
    inliers: Observations | None = None,
    uncertainty: Uncertainty | None = None,
) -> dict[str, Any]:
    """The stage JSON; what was not found or not looked for is null."""
    count, photos = (0, (0, 0)) if inliers is None else (len(inliers.x), inliers.photos)
    pose, error = None if consensus is None or problem else consensus.pose, None
    if consensus is not None and inliers is not None and count:
        error = float(np.sqrt((match_errors(inliers, consensus.pose) ** 2).mean()))
    settled = consensus is not None and consensus.settled_by_gps
    words = (
        f"{count} of {matches} matched points agree, in {photos[0]} photos of the object and {photos[1]} of the scene"
        + ("; GPS distinguishes it from its like" if settled else "")
    )
    return {
        "found": quantity(problem is None, ""),
        "reason": quantity(problem or words, ""),
        "scene_from_object": quantity(None if pose is None else pose.matrix, ""),
        "scale": quantity(None if pose is None else pose.scale, "scene units per object unit"),
        "shared_points": quantity(count, "1"),
        "matches": quantity(matches, "1"),
        "inlier_share": quantity(count / matches if matches else 0.0, "1"),
        "rival_points": quantity(0 if consensus is None else consensus.rival, "1"),
        "settled_by_gps": quantity(settled, ""),
        "object_photos": quantity(photos[0], "1"),
        "scene_photos": quantity(photos[1], "1"),
        "reprojection_px": quantity(error, "px"),
        **uncertainty_quantities(uncertainty, "scene units"),
    }
