"""Cross-model alignment from shared features: points and photos that the object's and the scene's sparse models share.

It uses the photos only, not the dense clouds, so what goes wrong in one rarely goes wrong in both. GPS of both sides
gives one more estimate, which no feature enters.
"""

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import quantity, read_json, value, write_json
from scenefuse.core.transforms import MAX_DEVIATIONS, Array, Sim3, Uncertainty, fit_sim3, uncertainty_quantities
from scenefuse.geometry.icp import MAX_TRIPLES, RANSAC_POSES, triples_of_one_scale
from scenefuse.georef.landmarks import Landmarks, match_landmarks, read_landmarks
from scenefuse.georef.placement import PHOTOS_OF_ONE_ERROR, GeoreferenceSettings, place_by_gps
from scenefuse.georef.reprojection import Observations, bootstrap, match_errors, minimise_reprojection, observations
from scenefuse.photos.geodesy import LocalFrame, scene_frame
from scenefuse.photos.photos import gps_accuracies, gps_positions, read_photos
from scenefuse.sfm.gravity import estimate_up

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


@dataclass(frozen=True)
class GpsPose:
    """The pose that GPS gives, and how well.

    Heights take no part in what follows: those of two flights often have other zeros.

    Attributes:
        pose: scene_from_object.
        photos: that it rests on.
        turn_sd: standard deviation of log scale, and of the heading in radians.
        shift_sd: of the place in the plane, metres (the scene's unit).
    """

    pose: Sim3
    photos: int
    turn_sd: float
    shift_sd: float

    def differences(self, other: Sim3, at: Array) -> tuple[float, float, float]:
        """Another pose's ratio of scales (log), heading in radians, and shift in the plane, at (3,) of the object."""
        turn = other.rotation @ self.pose.rotation.T
        heading = float(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1]))
        shift = float(np.linalg.norm((other.apply(at) - self.pose.apply(at))[:2]))
        return float(np.log(other.scale / self.pose.scale)), heading, shift

    def miss(self, other: Sim3, at: Array) -> float:
        """How far another pose is off, in standard deviations, by the worst of scale, heading and place."""
        scale, heading, shift = self.differences(other, at)
        return max(abs(scale) / self.turn_sd, abs(heading) / self.turn_sd, shift / self.shift_sd)


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
    obj = read_landmarks(object_sparse, object_features)
    scene = read_landmarks(scene_sparse, scene_features)
    gps = pose_by_gps(obj, scene, object_photos, scene_photos, scene_json, settings.gps_accuracy_m, seed)
    content = align_landmarks(obj, scene, settings, seed, gps)
    print(f"{'found' if content['found']['value'] else 'not found'}: {content['reason']['value']}", flush=True)
    write_json(report, content)


def align_landmarks(
    obj: Landmarks, scene: Landmarks, settings: AlignmentSettings, seed: int, gps: GpsPose | None = None
) -> dict[str, Any]:
    """Match, find a consensus, refine, apply the gate: the stage JSON."""
    pairs = match_landmarks(obj, scene, settings.max_ratio)
    print(f"{len(obj.points)} points of the object, {len(scene.points)} of the scene, {len(pairs)} matches", flush=True)
    seen = observations(obj, scene, pairs)
    consensus = find_consensus(seen, seed)
    # Most points of the model may lie far behind the object.
    centre = obj.looked_at()
    if consensus is None or not consensus.inliers.any():
        nothing = f"{len(pairs)} points of the models look alike, and no three of them fit one similarity"
        return _report(len(pairs), nothing) | gps_quantities(gps, None, centre)
    if gps is not None:
        consensus = _by_gps(seen, consensus, gps, centre, seed)
    inliers = seen.subset(consensus.inliers)
    near = nearest(inliers, centre, settings.nearest_points)
    pose = minimise_reprojection(near, consensus.pose, MAX_ERROR_PX / 2)
    drawn = bootstrap(near, pose, MAX_ERROR_PX / 2, centre, BOOTSTRAP_DRAWS, seed)
    # The pose that all points give shows how much the models are bent against each other.
    uncertainty = drawn.with_difference(pose, consensus.pose, centre)
    consensus = replace(consensus, pose=pose)
    problem = rejection_reason(consensus, inliers, len(pairs), uncertainty, settings)
    found = _report(len(pairs), problem, consensus, inliers, uncertainty)
    return found | gps_quantities(gps, None if problem else pose, centre)


def nearest(seen: Observations, place: Array, count: int) -> Observations:
    """The `count` matches nearest to a place (3,) in the object's frame."""
    distance = np.linalg.norm(seen.x - place, axis=1)
    return seen.subset(distance <= np.sort(distance)[min(count, len(distance)) - 1])


def find_consensus(seen: Observations, seed: int) -> Consensus | None:
    """The similarity that most matches support, refined on its inliers, and its strongest rival among the others."""
    pose = _most_supported(seen, seed)
    if pose is None:
        return None
    other, rival = _another(seen, [pose], seed)
    return Consensus(pose, match_errors(seen, pose) <= MAX_ERROR_PX, rival, other)


def _another(seen: Observations, poses: list[Sim3], seed: int) -> tuple[Sim3 | None, int]:
    """The similarity that most matches support of those which no pose explains, and how many do."""
    rest = seen.subset(np.min([match_errors(seen, pose) for pose in poses], axis=0) > 3 * MAX_ERROR_PX)
    other = _most_supported(rest, seed)
    return other, 0 if other is None else int((match_errors(rest, other) <= MAX_ERROR_PX).sum())


def _by_gps(seen: Observations, consensus: Consensus, gps: GpsPose, at: Array, seed: int) -> Consensus:
    """The one of a consensus and its strong rivals that GPS does not contradict, if there is just one."""
    poses, least = [consensus.pose], MAX_RIVAL_SHARE * consensus.inliers.sum()
    most = 10  # places alike; GPS settles none of more
    other, rival = consensus.other, consensus.rival
    while other is not None and rival > least and len(poses) < most:
        poses.append(other)
        other, rival = _another(seen, poses, seed)
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
    triples, (edges, _), _ = triples_of_one_scale(seen.x, seen.y, RANSAC_SAMPLES, rng)
    wide = edges.min(1) > 0.1 * edges.max(1)
    proposed = []
    for triple in triples[wide][:MAX_TRIPLES]:
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
        "settled_by_gps": quantity(settled, ""),
        "object_photos": quantity(photos[0], "1"),
        "scene_photos": quantity(photos[1], "1"),
        "reprojection_px": quantity(error, "px"),
        **uncertainty_quantities(uncertainty, "scene units"),
    }


def pose_by_gps(
    obj: Landmarks,
    scene: Landmarks,
    photos: Path | None,
    scene_photos: Path | None,
    scene_json: Path | None,
    accuracy_m: float,
    seed: int,
) -> GpsPose | None:
    """The similarity of the camera centres to their GPS positions; None where either side has too few, or they spread
    too little beside their accuracy.

    Args:
        obj: the object's cameras.
        scene: the scene's, in metres.
        photos: photos.json of the object.
        scene_photos: photos.json of the scene.
        scene_json: georeference.json of the scene.
        accuracy_m: standard error of positions that state none.
        seed: of RANSAC.
    """
    frame = None if scene_json is None else scene_frame(read_json(scene_json))
    listed = [] if photos is None else read_photos(photos)
    names, positions = gps_positions(listed)
    row_of = {name: row for row, name in enumerate(obj.photos)}
    known = [k for k, name in enumerate(names) if name in row_of]
    if not isinstance(frame, LocalFrame) or len(known) < PHOTOS_OF_ONE_ERROR:
        return None
    rotations, centres = (part[[row_of[names[k]] for k in known]] for part in _cameras(obj))
    target, sd_m = frame.apply(positions[known]), float(np.median(gps_accuracies(listed, accuracy_m)[known, 0]))
    up = estimate_up(rotations, centres, target)[0]
    placed = place_by_gps(centres, target, up, GeoreferenceSettings(True, accuracy_m), seed, sd_m)
    if placed.status != "georeferenced":
        return None
    there = target[placed.inliers, :2]
    off = placed.local_from_model.apply(centres[placed.inliers])[:, :2] - there
    each = max(sd_m, float(np.sqrt((off**2).mean())))
    of_scene = float(np.hypot(_accuracy_of(scene_photos, accuracy_m), _off_in_plane(scene_json)))
    turn = np.hypot(each / _extent(there), of_scene / _extent(_cameras(scene)[1][:, :2])) * np.sqrt(PHOTOS_OF_ONE_ERROR)
    # What all positions of a flight have in common is not averaged out by more photos.
    return GpsPose(placed.local_from_model, len(there), float(turn), float(np.hypot(each, of_scene)))


def _cameras(landmarks: Landmarks) -> tuple[Array, Array]:
    """World-from-camera rotations (V, 3, 3) and centres (V, 3) of a model's photos."""
    rotations = landmarks.cam_from_model[:, :, :3].transpose(0, 2, 1)
    return rotations, -np.einsum("nij,nj->ni", rotations, landmarks.cam_from_model[:, :, 3])


def _extent(points: Array) -> float:
    """Root of the summed squared distances of points (N, 2) from their mean."""
    return max(float(np.sqrt(((points - points.mean(0)) ** 2).sum())), 1e-12)


def _off_in_plane(scene_json: Path | None) -> float:
    """How far the GPS of a scene's flight lies off its control points or scan in the plane, metres: as much may the
    object's lie off the scene, or not, by another receiver."""
    content = {} if scene_json is None else read_json(scene_json)
    return float(np.linalg.norm(value(content, "gps_shift")[:2])) if "gps_shift" in content else 0.0


def _accuracy_of(photos: Path | None, otherwise_m: float) -> float:
    """Standard error of a side's positions, in metres; also where control points placed it: GPS need not share its
    datum."""
    stated = gps_accuracies([] if photos is None else read_photos(photos), otherwise_m)
    return float(np.median(stated[:, 0])) if len(stated) else otherwise_m


def gps_quantities(gps: GpsPose | None, pose: Sim3 | None, at: Array | None) -> dict[str, Any]:
    """What GPS says of the pose that was found, or of the place where none was; null where it is not known."""
    scale = heading = shift = miss = place = None
    notes = []
    if gps is not None and at is not None:
        place = gps.pose.apply(at)
        about = f"the GPS of {gps.photos} of its photos"
        if pose is None:
            notes.append(
                f"{about} says that it stands {place[0]:.1f} m east and {place[1]:.1f} m north of the scene's"
                f" origin, give or take {gps.shift_sd:.1f} m: click on it there (column fiducials)"
            )
        else:
            scale, heading, shift = gps.differences(pose, at)
            miss, heading = gps.miss(pose, at), float(np.degrees(heading))
            if miss > MAX_DEVIATIONS:
                notes.append(
                    f"{about} contradicts the pose: {np.expm1(abs(scale)):.1%} of scale, {abs(heading):.1f} degrees and"
                    f" {shift:.1f} m in the plane apart, and GPS is known to {gps.turn_sd:.1%},"
                    f" {np.degrees(gps.turn_sd):.1f} degrees and {gps.shift_sd:.1f} m; see in before_after.png if it"
                    " is the object, or its like"
                )
    return {
        "gps_photos": quantity(0 if gps is None else gps.photos, "1"),
        "gps_place": quantity(place, "m"),
        "gps_scale_apart": quantity(scale, "log"),
        "gps_heading_apart_deg": quantity(heading, "deg"),
        "gps_shift_apart": quantity(shift, "m"),
        "gps_miss": quantity(miss, "standard deviations"),
        "notes": quantity(notes, ""),
    }
