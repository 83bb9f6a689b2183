"""A sparse model brought into metres by GPS, or at least turned upright."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.sfm.geodesy import local_frame
from scenefuse.sfm.gravity import estimate_up, roll_spread_deg
from scenefuse.sfm.photos import gps_positions, read_photos
from scenefuse.stage import atomic_directory, quantity, setting, write_json
from scenefuse.transforms import Sim3, fit_sim3_robust, rotation_between

Array = NDArray[np.float64]


@dataclass(frozen=True)
class GeoreferenceSettings:
    """When GPS is used, and how strictly."""

    use_gps: bool = setting(True, unit="m")
    """Whether GPS positions in EXIF bring the model into metres."""
    gps_accuracy_m: float = setting(3, unit="m", least=0)
    """Standard error of a GPS position in metres; positions farther than four times this are outliers."""
    min_gps_photos: int = setting(5, least=0)
    """Fewest registered photos with GPS for the model to count as metric."""


@dataclass(frozen=True)
class Placement:
    """How a model was placed.

    Attributes:
        status: "georeferenced" (metres), "upright" (scene units).
        reason: why, in words.
        local_from_model: similarity into the new frame.
        inliers: (N,) bool over the GPS positions used, or empty.
    """

    status: str
    reason: str
    local_from_model: Sim3
    inliers: NDArray[np.bool_]


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
    model = pycolmap.Reconstruction(sparse)
    names, rotations, centres = camera_poses(model)
    known, positions = gps_positions(read_photos(photos))
    row_of = {name: row for row, name in enumerate(known)}
    used = [name for name in names if name in row_of]
    positions = positions[[row_of[name] for name in used]]
    up, cue = estimate_up(rotations, centres)
    content: dict[str, Any] = {}
    placement, target = None, np.zeros((0, 3))
    if settings.use_gps and len(used) >= settings.min_gps_photos:
        frame = local_frame(positions)
        target = frame.apply(positions)
        source = centres[[names.index(name) for name in used]]
        placement = place_by_gps(source, target, up, settings, seed)
        if placement.status == "georeferenced":
            crs_from_local = frame.crs_from_local()
            content = {
                "origin_latitude_deg": quantity(frame.latitude_deg, "deg"),
                "origin_longitude_deg": quantity(frame.longitude_deg, "deg"),
                "origin_altitude_m": quantity(frame.altitude_m, "m"),
                "crs": quantity(frame.crs, ""),
                "origin_in_crs": quantity(crs_from_local.translation, "m"),
                "crs_from_scene": quantity(crs_from_local.matrix, "m"),
                **_residuals(used, placement.local_from_model.apply(source) - target, placement.inliers),
            }
    elif settings.use_gps:
        reason = f"{len(used)} registered photos have a GPS position, {settings.min_gps_photos} are needed"
        placement = upright(up, reason)
    if placement is None:
        placement = upright(up, "GPS is switched off")
    metric = placement.status == "georeferenced"
    unit = "m" if metric else "scene units"
    print(f"{placement.status}: {placement.reason}; unit: {unit}", flush=True)
    transform = placement.local_from_model
    model.transform(pycolmap.Sim3d(transform.scale, pycolmap.Rotation3d(transform.rotation), transform.translation))
    with atomic_directory(georeferenced) as temporary:
        model.write(temporary)
    summary = {
        "status": quantity(placement.status, ""),
        "reason": quantity(placement.reason, ""),
        "length_unit": quantity(unit, ""),
        "metric": quantity(metric, ""),
        "scene_from_sparse": quantity(transform.matrix, unit),
        "scale": quantity(transform.scale, f"{unit} per unit of the sparse model"),
        "photos_with_gps": quantity(len(used), "1"),
        "up_cue": quantity("GPS" if metric else cue, ""),
        "camera_roll_median_deg": quantity(
            roll_spread_deg(transform.rotation @ rotations, np.array([0.0, 0.0, 1.0])), "deg"
        ),
    }
    write_json(report, summary | content)


def camera_poses(model: pycolmap.Reconstruction) -> tuple[list[str], Array, Array]:
    """Names (sorted), (N, 3, 3) world_from_cam rotations and (N, 3) centres of the registered photos."""
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    matrices = np.array([image.cam_from_world().inverse().matrix() for image in images]).reshape(-1, 3, 4)
    return [image.name for image in images], matrices[:, :, :3], matrices[:, :, 3]


def place_by_gps(centres: Array, target: Array, up: Array, settings: GeoreferenceSettings, seed: int) -> Placement:
    """Fit local_from_model to camera centres (N, 3) in model units and their GPS positions (N, 3) in metres.

    Positions along one line leave the roll about it open: then the cameras' up direction (3,) closes it. Positions
    within five times the GPS accuracy of each other say nothing about scale: then the model is only turned upright.
    """
    centred = target - np.median(target, axis=0)
    extent = np.linalg.svd(centred[:, :2], compute_uv=False) / np.sqrt(len(target))
    limit = 4.0 * settings.gps_accuracy_m
    if extent[0] < 5.0 * settings.gps_accuracy_m:
        reason = f"GPS positions spread over {extent[0]:.1f} m only, with an accuracy of {settings.gps_accuracy_m:g} m"
        return upright(up, reason)
    try:
        if extent[1] < 3.0 * settings.gps_accuracy_m:
            fitted, inliers = fit_level(centres, target, up, limit)
            how = "along one line, levelled by the cameras"
        else:
            fitted, inliers = fit_sim3_robust(centres, target, limit, seed=seed)
            how = "by GPS"
    except ValueError as error:
        return upright(up, f"GPS positions do not fit the cameras ({error})")
    if inliers.sum() < max(settings.min_gps_photos, 0.5 * len(target)):
        reason = f"only {inliers.sum()} of {len(target)} GPS positions agree with the cameras within {limit:g} m"
        return upright(up, reason)
    return Placement("georeferenced", f"{inliers.sum()} of {len(target)} photos {how}", fitted, inliers)


def upright(up: Array, reason: str) -> Placement:
    """Only turn the model so that `up` (3,) becomes z; scale and origin stay."""
    rotation = rotation_between(up, np.array([0.0, 0.0, 1.0]))
    return Placement("upright", reason, Sim3(1.0, rotation, np.zeros(3)), np.zeros(0, dtype=bool))


def fit_level(centres: Array, target: Array, up: Array, limit: float) -> tuple[Sim3, NDArray[np.bool_]]:
    """Similarity with its vertical given: heading, scale and shift from the horizontal positions, height from the mean.

    Weighted least squares, reweighted with Cauchy weights of width `limit` / 2 (metres).
    """
    levelled = centres @ rotation_between(up, np.array([0.0, 0.0, 1.0])).T
    # A heading alone is a rotation in the plane: one complex factor, scale and angle together.
    a, b = levelled[:, 0] + 1j * levelled[:, 1], target[:, 0] + 1j * target[:, 1]
    weights = np.ones(len(centres))
    for _ in range(30):
        w = weights / weights.sum()
        centred = a - w @ a
        factor = (w @ (centred.conj() * (b - w @ b))) / (w @ np.abs(centred) ** 2)
        scale, angle = abs(factor), np.angle(factor)
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
        rotation = turn @ rotation_between(up, np.array([0.0, 0.0, 1.0]))
        fitted = Sim3(scale, rotation, w @ (target - scale * centres @ rotation.T))
        distance = np.linalg.norm(fitted.apply(centres) - target, axis=1)
        weights = 1.0 / (1.0 + (2.0 * distance / limit) ** 2)
    return fitted, distance <= limit


def _residuals(names: list[str], difference: Array, inliers: NDArray[np.bool_]) -> dict[str, Any]:
    distance = np.linalg.norm(difference, axis=1)
    print(
        f"GPS residuals: median {np.median(distance):.2f} m, RMS of inliers {_rms(distance[inliers]):.2f} m",
        flush=True,
    )
    return {
        "gps_inliers": quantity(int(inliers.sum()), "1"),
        "gps_residual_median_m": quantity(float(np.median(distance)), "m"),
        "gps_residual_rms_m": quantity(_rms(distance[inliers]), "m"),
        "gps_residual_horizontal_rms_m": quantity(_rms(np.linalg.norm(difference[inliers, :2], axis=1)), "m"),
        "gps_residual_vertical_rms_m": quantity(_rms(difference[inliers, 2]), "m"),
        "gps_residuals_m": quantity(dict(zip(names, distance.round(4).tolist())), "m"),
        "gps_outliers": quantity([name for name, ok in zip(names, inliers) if not ok], ""),
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
