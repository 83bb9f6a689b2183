"""Cross-model alignment from shared features: points and photos that the object's and the scene's sparse models share.

It looks at photographs only and knows nothing of the dense clouds, so what goes wrong in one rarely goes wrong in both.
"""

import contextlib
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.registration.shared_features.landmarks import Landmarks, match_landmarks, read_landmarks
from scenefuse.registration.shared_features.localise import Centres, localise
from scenefuse.registration.shared_features.reprojection import (
    Deviation,
    Observations,
    bootstrap,
    match_errors,
    observations,
    refine,
)
from scenefuse.stage import quantity, setting, write_json
from scenefuse.transforms import Array, Sim3, fit_sim3, rotation_angle_deg

PROPOSALS = 2000
FEW = 300
FINALISTS = 10
SAME_SCALE = 0.8


@dataclass(frozen=True)
class AlignmentSettings:
    """Settings of the alignment from shared features, and its gate."""

    most_points: int = setting(100000, least=100)
    """Most points of either model that are matched, those with the longest tracks; bounds time and memory."""
    descriptors_per_point: int = setting(3, least=1)
    """Views of a point whose descriptors are compared."""
    max_ratio: float = setting(0.85, above=0, most=1)
    """Lowe's ratio test: descriptor distance to the best over that to the second-best point."""
    ransac_samples: int = setting(100000, least=100)
    """Random triples of matches drawn."""
    max_error_px: float = setting(6, unit="px", above=0)
    """Largest reprojection error of an inlier, RMS, in pixels of the coarser photos."""
    min_points: int = setting(15, least=4)
    """Gate: fewest points shared by both models."""
    min_photos: int = setting(3, least=2)
    """Gate: fewest photos on either side that see shared points."""
    nearest_points: int = setting(200, least=10)
    """Shared points that fix the pose, those nearest to where the object's photos look: far from it both models may be
    bent against each other."""
    max_rival_share: float = setting(0.5, least=0, most=1)
    """Gate: inliers of the best pose among the other matches, over inliers."""
    max_scale_sd_log: float = setting(0.05, above=0)
    """Gate: largest standard deviation of the scale, natural logarithm."""
    max_rotation_sd_deg: float = setting(3, unit="degree", above=0)
    """Gate: largest standard deviation of the rotation, degrees."""
    bootstrap_draws: int = setting(200, least=10)
    """Draws of photos and points for the standard deviations."""


@dataclass(frozen=True)
class Agreement:
    """What the shared points say.

    Attributes:
        pose: scene_from_object.
        inliers: (M,) bool over the matches.
        rival: inliers of the best pose among the rest.
    """

    pose: Sim3
    inliers: NDArray[np.bool_]
    rival: int


def align_models(
    *,
    object_model: Path,
    object_features: Path,
    scene_model: Path,
    scene_features: Path,
    alignment: Path,
    seed: int,
    settings: AlignmentSettings,
) -> None:
    """Find scene_from_object from features that the object's photos share with the scene's (method R14).

    Shared points: triangulated points of both models are matched by their SIFT descriptors, RANSAC over triples gives a
    similarity of free scale, and Gauss-Newton minimises the reprojection of each model's points in the other's photos.
    Camera centres: each photo of the object is localised in the scene by itself, and a similarity is fitted to the
    centres; it shares the matches but neither the object's points nor the minimiser, and is reported beside the first.

    Args:
        object_model: COLMAP model of the object's original photos; its frame is the object frame.
        object_features: COLMAP database that holds their features.
        scene_model: georeferenced COLMAP model of the scene; its frame is the scene frame.
        scene_features: COLMAP database that holds the scene's features.
        alignment: output JSON: `found`, `reason`, `scene_from_object`, how sure it is.
        seed: of all random choices.
        settings: see AlignmentSettings.

    Raises:
        StageError: a database does not belong to its model.
    """
    begin = time.perf_counter()
    obj = read_landmarks(object_model, object_features, settings.most_points, settings.descriptors_per_point)
    scene = read_landmarks(scene_model, scene_features, settings.most_points, settings.descriptors_per_point)
    content = align_landmarks(obj, scene, settings, seed)
    print(f"{'found' if content['found']['value'] else 'not found'}: {content['reason']['value']}", flush=True)
    write_json(alignment, {**content, "seconds": quantity(time.perf_counter() - begin, "s")})


def align_landmarks(obj: Landmarks, scene: Landmarks, settings: AlignmentSettings, seed: int) -> dict[str, Any]:
    """Match, agree, judge: the stage JSON without its time."""
    pairs = match_landmarks(obj, scene, settings.max_ratio)
    print(f"{len(obj.points)} points of the object, {len(scene.points)} of the scene, {len(pairs)} matches", flush=True)
    seen = observations(obj, scene, pairs)
    agreed = agree(seen, settings, seed)
    if agreed is None:
        reason = f"{len(pairs)} points of the models look alike, and no three of them fit one similarity"
        return _report(reason, len(pairs), None, None, None, None, np.zeros(3))
    centre = np.median(obj.points, axis=0)
    inliers = seen.subset(agreed.inliers)
    near = nearest(inliers, obj.looked_at(), settings.nearest_points)
    pose = refine(near, agreed.pose, settings.max_error_px / 2, 20)
    drawn = bootstrap(near, pose, settings.max_error_px / 2, centre, settings.bootstrap_draws, seed)
    # What all points would make of the pose shows how much the models are bent against each other.
    deviation = drawn.beside(pose, agreed.pose, centre)
    agreed = replace(agreed, pose=pose)
    problem = rejection_reason(agreed, inliers, len(pairs), deviation, settings)
    centres = None if problem else localise(obj, scene, pairs, pose, settings.max_error_px, seed)
    return _report(problem, len(pairs), agreed, inliers, deviation, centres, centre)


def nearest(seen: Observations, place: Array, count: int) -> Observations:
    """The `count` matches nearest to a place (3,) in the object's frame."""
    distance = np.linalg.norm(seen.x - place, axis=1)
    return seen.subset(distance <= np.sort(distance)[min(count, len(distance)) - 1])


def agree(seen: Observations, settings: AlignmentSettings, seed: int) -> Agreement | None:
    """The similarity that most matches agree on, refined on its inliers, and its strongest rival among the others."""
    pose = _most_agreed(seen, settings, seed)
    if pose is None:
        return None
    error = match_errors(seen, pose)
    others = seen.subset(error > 3 * settings.max_error_px)
    other = _most_agreed(others, settings, seed)
    rival = 0 if other is None else int((match_errors(others, other) <= settings.max_error_px).sum())
    return Agreement(pose, error <= settings.max_error_px, rival)


def _most_agreed(seen: Observations, settings: AlignmentSettings, seed: int) -> Sim3 | None:
    """RANSAC over triples whose edges ask for one scale, judged by reprojection; the finalists are refined."""
    if len(seen.x) < 4:
        return None
    rng = np.random.default_rng(seed)
    triples = rng.integers(0, len(seen.x), (settings.ransac_samples, 3))
    edges = [np.linalg.norm(p[triples] - p[np.roll(triples, 1, axis=1)], axis=2) for p in (seen.x, seen.y)]
    ratio = edges[1] / np.maximum(edges[0], 1e-300)
    fair = (edges[0].min(1) > 0.1 * edges[0].max(1)) & (ratio.min(1) > SAME_SCALE * ratio.max(1))
    proposed = []
    for triple in triples[fair][:PROPOSALS]:
        with contextlib.suppress(ValueError):
            proposed.append(fit_sim3(seen.x[triple], seen.y[triple]))
    if not proposed:
        return None
    few = seen.subset(np.isin(np.arange(len(seen.x)), rng.permutation(len(seen.x))[:FEW]))
    finalists = sorted(proposed, key=lambda p: _cost(few, p, 2 * settings.max_error_px))[:FINALISTS]
    polished = [_polished(seen, p, settings.max_error_px) for p in finalists]
    return min(polished, key=lambda p: _cost(seen, p, settings.max_error_px))


def _polished(seen: Observations, pose: Sim3, limit_px: float) -> Sim3:
    """Refined on the matches within a limit that narrows to `limit_px`."""
    for factor in (4.0, 2.0, 1.0, 1.0):
        near = match_errors(seen, pose) <= factor * limit_px
        if near.sum() < 4:
            return pose
        pose = refine(seen.subset(near), pose, factor * limit_px / 2, 20)
    return pose


def _cost(seen: Observations, pose: Sim3, limit_px: float) -> float:
    """Truncated squared errors (MSAC, Torr and Zisserman 2000)."""
    return float(np.minimum((match_errors(seen, pose) / limit_px) ** 2, 1).sum())


def rejection_reason(
    agreed: Agreement, inliers: Observations, matches: int, deviation: Deviation, settings: AlignmentSettings
) -> str | None:
    """Why the pose must not be believed, in one sentence, or None."""
    count, photos = len(inliers.x), min(inliers.photos)
    if count < settings.min_points:
        return f"only {count} of {matches} matched points agree on one pose, {settings.min_points} are needed"
    if photos < settings.min_photos:
        return f"the shared points are seen in {photos} photos of one side only, {settings.min_photos} are needed"
    if agreed.rival > settings.max_rival_share * count:
        return (
            f"another pose has {agreed.rival} points of its own beside the best one's {count}: something is there twice"
        )
    if deviation.scale_log > settings.max_scale_sd_log:
        return (
            f"the {count} shared points leave the scale open by {100 * deviation.scale_log:.1f} %, more than"
            f" {100 * settings.max_scale_sd_log:.1f} %"
        )
    if deviation.rotation_deg > settings.max_rotation_sd_deg:
        return (
            f"the {count} shared points leave the rotation open by {deviation.rotation_deg:.1f} degrees, more than"
            f" {settings.max_rotation_sd_deg:.1f}"
        )
    return None


def _report(
    problem: str | None,
    matches: int,
    agreed: Agreement | None,
    inliers: Observations | None,
    deviation: Deviation | None,
    centres: Centres | None,
    centre: Array,
) -> dict[str, Any]:
    """The stage JSON; what was not found or not looked for is null."""
    found = problem is None and agreed is not None and inliers is not None
    count = 0 if inliers is None else len(inliers.x)
    photos = (0, 0) if inliers is None else inliers.photos
    error = None
    if agreed is not None and inliers is not None and count:
        error = float(np.sqrt((match_errors(inliers, agreed.pose) ** 2).mean()))
    pose = agreed.pose if agreed is not None and found else None
    by_centres = None if centres is None else centres.pose
    per_unit = "scene units per object unit"
    turn = shift = None
    if pose is not None and by_centres is not None:
        turn = rotation_angle_deg(by_centres.rotation @ pose.rotation.T)
        shift = float(np.linalg.norm(by_centres.apply(centre) - pose.apply(centre)))
    words = (
        f"{count} of {matches} matched points agree, in {photos[0]} photos of the object and {photos[1]} of the scene"
    )
    return {
        "found": quantity(found, ""),
        "reason": quantity(problem or words, ""),
        "scene_from_object": quantity(None if pose is None else pose.matrix, ""),
        "scale": quantity(None if pose is None else pose.scale, per_unit),
        "shared_points": quantity(count, "points"),
        "matches": quantity(matches, "points"),
        "inlier_share": quantity(count / matches if matches else 0.0, "1"),
        "rival_points": quantity(0 if agreed is None else agreed.rival, "points"),
        "object_photos": quantity(photos[0], "photos"),
        "scene_photos": quantity(photos[1], "photos"),
        "reprojection_px": quantity(error, "px"),
        "scale_sd_log": quantity(None if deviation is None else deviation.scale_log, "1"),
        "rotation_sd_deg": quantity(None if deviation is None else deviation.rotation_deg, "degrees"),
        "translation_sd": quantity(None if deviation is None else deviation.shift, "scene units"),
        "scale_from_centres": quantity(None if by_centres is None else by_centres.scale, per_unit),
        "centres_photos": quantity(0 if centres is None else len(centres.photos), "photos"),
        "centres_rotation_deg": quantity(turn, "degrees"),
        "centres_shift": quantity(shift, "scene units"),
    }
