"""A sparse model brought into metres by GPS, or at least turned upright."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.sfm.geodesy import FAR, LocalFrame, local_frame
from scenefuse.sfm.gravity import estimate_up, roll_spread_deg
from scenefuse.sfm.photos import gps_positions, read_photos
from scenefuse.stage import atomic_directory, quantity, setting, write_json
from scenefuse.transforms import Sim3, fit_sim3, fit_sim3_robust, rotation_between
from scenefuse.workspace import posed_images, read_model

Array = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])

# Fewer registered photos with GPS are too few to tell a wild position from the others.
MIN_GPS_PHOTOS = 5
# In standard errors of a position: what is farther from its camera is an outlier; a flight that spreads less says
# nothing about scale; one that is narrower lies along one line and says nothing about roll.
OUTLIER, SPREAD, WIDTH = 4.0, 5.0, 3.0
# Each round halves what filling in half of the heights leaves to be found.
FILL_ROUNDS = 30


@dataclass(frozen=True)
class GeoreferenceSettings:
    """When GPS is used, and how strictly."""

    use_gps: bool = setting(True)
    """Whether GPS positions in EXIF bring the model into metres."""
    gps_accuracy_m: float = setting(3, unit="m", above=0)
    """Standard error of a GPS position; positions farther than four times this from their cameras are outliers."""


@dataclass(frozen=True)
class Placement:
    """How a model was placed.

    Attributes:
        status: "georeferenced" (metres), "upright" (scene units).
        reason: why, in words.
        local_from_model: similarity into the new frame.
        inliers: (N,) bool over the GPS positions used, or empty.
        heights: "measured" by GPS, "relative" to the middle camera, or "" where there is no metric frame.
        levelled: whether the cameras say which way is up, not GPS.
    """

    status: str
    reason: str
    local_from_model: Sim3
    inliers: NDArray[np.bool_]
    heights: str = ""
    levelled: bool = True


@dataclass(frozen=True)
class GpsCameras:
    """The registered photos that have a GPS position.

    Attributes:
        names: N of them.
        centres: (N, 3) camera centres in the model's frame.
        positions: (N, 3) latitude (deg), longitude (deg), altitude (m; NaN where unknown).
    """

    names: list[str]
    centres: Array
    positions: Array


def georegister(
    *, sparse: Path, photos: Path, georeferenced: Path, report: Path, settings: GeoreferenceSettings, seed: int
) -> None:
    """Move a sparse model into east, north, up in metres by its photos' GPS, or turn it upright without a unit.

    Args:
        sparse: COLMAP model.
        photos: JSON list of the photos with their GPS positions.
        georeferenced: output, COLMAP model.
        report: output, JSON: status, transform, origin, CRS, residuals.
        settings: when GPS is used.
        seed: of RANSAC.
    """
    model = read_model(sparse)
    names, rotations, centres = camera_poses(model)
    known, positions = gps_positions(read_photos(photos))
    row_of = {name: row for row, name in enumerate(known)}
    with_gps = [row for row, name in enumerate(names) if name in row_of]
    used = [names[row] for row in with_gps]
    gps = GpsCameras(used, centres[with_gps], positions[[row_of[name] for name in used]])
    up, cue = estimate_up(rotations, centres)
    frame = local_frame(gps.positions) if settings.use_gps and len(used) >= MIN_GPS_PHOTOS else None
    if frame is not None:
        placement = place_by_gps(gps.centres, frame.apply(gps.positions), up, settings, seed)
    elif settings.use_gps:
        reason = f"{len(used)} registered photos have a GPS position, {MIN_GPS_PHOTOS} are needed"
        placement = upright(up, reason)
    else:
        placement = upright(up, "GPS is switched off")
    transform = placement.local_from_model
    model.transform(pycolmap.Sim3d(transform.scale, pycolmap.Rotation3d(transform.rotation), transform.translation))
    with atomic_directory(georeferenced) as temporary:
        model.write(temporary)
    roll_deg = roll_spread_deg(transform.rotation @ rotations, UP)
    write_json(report, _report(placement, gps, frame, cue, roll_deg))


def camera_poses(model: pycolmap.Reconstruction) -> tuple[list[str], Array, Array]:
    """Names (sorted), (N, 3, 3) world_from_cam rotations and (N, 3) centres of the registered photos."""
    images = posed_images(model)
    matrices = np.array([image.cam_from_world().inverse().matrix() for image in images]).reshape(-1, 3, 4)
    return [image.name for image in images], matrices[:, :, :3], matrices[:, :, 3]


def place_by_gps(centres: Array, target: Array, up: Array, settings: GeoreferenceSettings, seed: int) -> Placement:
    """Fit local_from_model to camera centres (N, 3) in model units and their GPS positions (N, 3) in metres.

    Unknown heights are NaN and take no part. Positions along one line leave the roll about it open, and horizontal ones
    the tilt: then the cameras' up direction (3,) closes it. Positions within five times the GPS accuracy of each other
    say nothing about scale: then the model is only turned upright.
    """
    accuracy_m, extent = settings.gps_accuracy_m, _extent(target)
    if extent[0] < SPREAD * accuracy_m:
        reason = f"GPS positions spread over {extent[0]:.1f} m only, with an accuracy of {accuracy_m:g} m"
        return upright(up, reason)
    fitted, inliers, levelled = _fit(centres, target, up, accuracy_m, seed)
    if inliers.sum() < max(MIN_GPS_PHOTOS, 0.5 * len(target)):
        reason = (
            f"only {inliers.sum()} of {len(target)} GPS positions agree with the cameras within"
            f" {OUTLIER * accuracy_m:g} m"
        )
        return upright(up, reason)
    reason = f"{inliers.sum()} of {len(target)} photos by GPS"
    if levelled:
        line = "along one line, " if _extent(target[inliers])[1] < WIDTH * accuracy_m else ""
        reason += f", {line}levelled by the cameras"
    unknown = np.isnan(target[:, 2])
    if unknown.all():
        reason += "; no photo has a GPS height, so heights are relative to the middle camera"
    elif unknown.any():
        reason += f"; {unknown.sum()} of them have no GPS height and do not constrain heights"
    return Placement("georeferenced", reason, fitted, inliers, "relative" if unknown.all() else "measured", levelled)


def _fit(
    centres: Array, target: Array, up: Array, accuracy_m: float, seed: int
) -> tuple[Sim3, NDArray[np.bool_], bool]:
    """Similarity, inliers, and whether the cameras had to level it, because the positions that agree do not."""
    limit, has_height = OUTLIER * accuracy_m, np.isfinite(target[:, 2])

    def fixes_tilt(rows: NDArray[np.bool_]) -> bool:
        return bool(rows.sum() >= MIN_GPS_PHOTOS and _extent(target[rows])[1] >= WIDTH * accuracy_m)

    if fixes_tilt(has_height):
        with contextlib.suppress(ValueError):  # no three positions agree
            fitted, inliers = fit_measured(centres, target, limit, seed)
            if inliers.sum() >= 0.5 * len(target) and fixes_tilt(inliers & has_height):
                return fitted, inliers, False
    return *fit_level(centres, target, up, limit, seed), True


def upright(up: Array, reason: str) -> Placement:
    """Only turn the model so that `up` (3,) becomes z; scale and origin stay."""
    rotation = rotation_between(up, UP)
    return Placement("upright", reason, Sim3(1.0, rotation, np.zeros(3)), np.zeros(0, dtype=bool))


def fit_measured(centres: Array, target: Array, limit: float, seed: int) -> tuple[Sim3, NDArray[np.bool_]]:
    """Similarity by RANSAC over positions whose height is known, then least squares over all measured coordinates.

    Unknown heights (NaN in `target`) are set to what the fit says, again and again, which is least squares without them
    (expectation maximisation).

    Returns:
        local_from_model and the (N,) inliers within `limit` metres.
    """
    known = np.isfinite(target)
    whole = known.all(1)
    fitted, inliers = fit_sim3_robust(centres[whole], target[whole], limit, seed=seed)
    if whole.all():
        return fitted, inliers
    for _ in range(FILL_ROUNDS):
        here = fitted.apply(centres)
        filled = np.where(known, target, here)
        inliers = np.linalg.norm(filled - here, axis=1) <= limit
        fitted = fit_sim3(centres[inliers], filled[inliers])
    return fitted, inliers


def fit_level(centres: Array, target: Array, up: Array, limit: float, seed: int = 0) -> tuple[Sim3, NDArray[np.bool_]]:
    """Similarity with its vertical given: heading, scale and shift from horizontal positions, height from the mean.

    RANSAC over pairs, then least squares, reweighted with Cauchy weights of width `limit` / 2 (metres). Unknown heights
    (NaN) take no part; where none is known, the median camera gets height 0.
    """
    levelling = rotation_between(up, UP)
    levelled = centres @ levelling.T
    # A heading alone is a rotation in the plane: one complex factor, scale and angle together.
    a, b = levelled[:, 0] + 1j * levelled[:, 1], target[:, 0] + 1j * target[:, 1]
    known = np.isfinite(target[:, 2])
    weights = _agreeing_pair(a, b, limit, seed).astype(np.float64)
    for _ in range(30):
        w = weights / weights.sum()
        centred = a - w @ a
        factor = (w @ (centred.conj() * (b - w @ b))) / (w @ np.abs(centred) ** 2)
        scale, angle = abs(factor), np.angle(factor)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        rotation = turn @ levelling
        offset = target - scale * centres @ rotation.T
        height = w[known] @ offset[known, 2] / w[known].sum() if known.any() else -np.median(scale * levelled[:, 2])
        fitted = Sim3(scale, rotation, np.array([*(w @ offset[:, :2]), height]))
        distance = _distance(fitted.apply(centres) - target)
        weights = 1.0 / (1.0 + (2.0 * distance / limit) ** 2)
    return fitted, distance <= limit


def _agreeing_pair(a: NDArray[np.complex128], b: NDArray[np.complex128], limit: float, seed: int) -> NDArray[np.bool_]:
    """Which of N positions in the plane the similarity b ~ factor a + shift through some two of them explains: most."""
    rng, best = np.random.default_rng(seed), np.zeros(len(a), dtype=bool)
    for _ in range(300):
        i, j = rng.choice(len(a), 2, replace=False)
        if a[i] != a[j]:
            inliers = np.abs((b[j] - b[i]) / (a[j] - a[i]) * (a - a[i]) + b[i] - b) <= limit
            best = inliers if inliers.sum() > best.sum() else best
    return best if best.any() else ~best


def _extent(target: Array) -> Array:
    """RMS extent in metres of positions (N, 3) along the two axes of their horizontal spread, far ones left out."""
    centred = target[:, :2] - np.median(target[:, :2], axis=0)
    distance = np.linalg.norm(centred, axis=1)
    centred = centred[distance <= FAR * np.median(distance)]
    return np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(centred))


def _report(
    placement: Placement, gps: GpsCameras, frame: LocalFrame | None, cue: str, roll_deg: float
) -> dict[str, Any]:
    """Content of georeference.json."""
    metric = placement.status == "georeferenced"
    unit = "m" if metric else "scene units"
    print(f"{placement.status}: {placement.reason}; unit: {unit}", flush=True)
    transform = placement.local_from_model
    content = {
        "status": quantity(placement.status, ""),
        "reason": quantity(placement.reason, ""),
        "length_unit": quantity(unit, ""),
        "metric": quantity(metric, ""),
        "scene_from_sparse": quantity(transform.matrix, unit),
        "scale": quantity(transform.scale, f"{unit} per unit of the sparse model"),
        "photos_with_gps": quantity(len(gps.names), "1"),
        "photos_with_gps_height": quantity(int(np.isfinite(gps.positions[:, 2]).sum()), "1"),
        "up_cue": quantity(cue if placement.levelled else "GPS", ""),
        "camera_roll_median_deg": quantity(roll_deg, "deg"),
    }
    if not metric or frame is None:
        return content
    crs_from_local = frame.crs_from_local()
    measured = placement.heights == "measured"
    return content | {
        "heights": quantity(placement.heights, ""),
        "origin_latitude_deg": quantity(frame.latitude_deg, "deg"),
        "origin_longitude_deg": quantity(frame.longitude_deg, "deg"),
        "origin_altitude_m": quantity(frame.altitude_m if measured else None, "m"),
        "crs": quantity(frame.crs, ""),
        "origin_in_crs": quantity(crs_from_local.translation, "m"),
        "crs_from_scene": quantity(crs_from_local.matrix, "m"),
        **_residuals(gps.names, transform.apply(gps.centres) - frame.apply(gps.positions), placement.inliers),
    }


def _residuals(names: list[str], difference: Array, inliers: NDArray[np.bool_]) -> dict[str, Any]:
    """Distances of cameras (N, 3) from their GPS positions, as quantities; NaN where a height is unknown."""
    distance, vertical = _distance(difference), difference[inliers, 2]
    vertical = vertical[np.isfinite(vertical)]
    print(
        f"GPS residuals: median {np.median(distance):.2f} m, RMS of inliers {_rms(distance[inliers]):.2f} m",
        flush=True,
    )
    return {
        "gps_inliers": quantity(int(inliers.sum()), "1"),
        "gps_residual_median_m": quantity(float(np.median(distance)), "m"),
        "gps_residual_rms_m": quantity(_rms(distance[inliers]), "m"),
        "gps_residual_horizontal_rms_m": quantity(_rms(np.linalg.norm(difference[inliers, :2], axis=1)), "m"),
        "gps_residual_vertical_rms_m": quantity(_rms(vertical) if len(vertical) else None, "m"),
        "gps_residuals_m": quantity(dict(zip(names, distance.round(4).tolist())), "m"),
        "gps_outliers": quantity([name for name, ok in zip(names, inliers) if not ok], ""),
    }


def _distance(difference: Array) -> Array:
    """Length of differences (N, 3) over their known coordinates."""
    return np.sqrt(np.nansum(difference**2, axis=1))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
