"""What is left between a georeferenced model and what was surveyed: at every point, and at every photo's position."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from scenefuse.core.stage import atomic_file, quantity
from scenefuse.core.transforms import MAX_DEVIATIONS, SD_OVER_MEDIAN, Array
from scenefuse.georef.control import Control, LocatedPoint, seen_at
from scenefuse.georef.placement import GpsCameras, Placement
from scenefuse.marks.triangulation import Lengths
from scenefuse.photos.geodesy import LocalFrame

COLUMNS = ["kind", "name", "used", "error_m", "east_m", "north_m", "up_m", "horizontal_sd_m", "vertical_sd_m"]
COLUMNS += ["photos", "reprojection_px"]


@dataclass(frozen=True)
class Georeference:
    """Where a model lies, and by what.

    Attributes:
        placement: the similarity and what agrees with it.
        frame: the local frame; None where there is no metric one.
        gps: the photos with positions.
        control: surveyed points, or None.
    """

    placement: Placement
    frame: LocalFrame | None
    gps: GpsCameras
    control: Control | None = None

    @property
    def located(self) -> list[LocatedPoint]:
        """The surveyed points."""
        return [] if self.control is None else self.control.located

    @property
    def used(self) -> NDArray[np.bool_]:
        """(P,) the control points that place it, of the surveyed points."""
        return self.placement.used if len(self.placement.used) else np.zeros(len(self.located), dtype=bool)

    @property
    def metric(self) -> bool:
        """Whether the model is in metres."""
        return self.placement.status != "upright"


@dataclass(frozen=True)
class Residuals:
    """Model minus survey, in metres, east, north and up; not a number where either is unknown.

    Attributes:
        cameras: (N, 3) at the photos with positions, which are first moved by their common shift.
        points: (P, 3) at the surveyed points.
        points_px: (P,) RMS distances of clicks from the points that they show together.
        lengths: known lengths as the model has them, or None.
    """

    cameras: Array
    points: Array
    points_px: Array
    lengths: Lengths | None = None


def residuals_of(model: pycolmap.Reconstruction, found: Georeference, lengths: Lengths | None = None) -> Residuals:
    """Compare a georeferenced model with what was surveyed. Points lie where their clicks' rays meet."""
    if found.placement.status != "georeferenced" or found.frame is None:
        return Residuals(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), lengths)
    names, positions = found.gps.names, found.frame.apply(found.gps.positions) - found.placement.gps_shift
    centres = np.array([model.find_image_with_name(name).projection_center() for name in names]).reshape(-1, 3)
    target = found.frame.apply(np.array([s.point.position for s in found.located]).reshape(-1, 3))
    if found.placement.heights == "relative":
        target[:, 2] = np.nan
    places, rms_px = seen_at(found.located, model)
    return Residuals(centres - positions, places - target, rms_px, lengths)


def write_residuals(path: Path, found: Georeference, left: Residuals) -> None:
    """Write a line for every surveyed point and every photo with a position; cells without a value are empty."""
    rows: list[list[Any]] = []
    yes_no = {True: "yes", False: "no"}
    if left.lengths is not None:
        used = yes_no[found.placement.status == "scaled"]
        for name, error in zip(left.lengths.names, left.lengths.in_model - left.lengths.metres):
            rows.append(["length", name, used, error])
    if found.placement.status == "georeferenced":
        for row, (point, error) in enumerate(zip((s.point for s in found.located), left.points)):
            kind, used = "check point" if point.check else "control point", yes_no[bool(found.used[row])]
            counts = [len(point.clicks), left.points_px[row]]
            rows.append([kind, point.name, used, _length(error), *error, *point.sd_m, *counts])
        chosen = found.placement.inliers if len(found.placement.inliers) else np.zeros(len(found.gps.names), bool)
        for name, is_used, error, sd_m in zip(found.gps.names, chosen, left.cameras, found.gps.sd_m):
            rows.append(["position", name, yes_no[bool(is_used)], _length(error), *error, *sd_m])
    table = pd.DataFrame([dict(zip(COLUMNS, row)) for row in rows], columns=COLUMNS)
    with atomic_file(path) as temporary:
        table.astype({"photos": "Int64"}).to_csv(temporary, sep="\t", index=False, float_format="%.4f")


def _length(error: Array) -> float:
    """Length of an error (3,) over its known coordinates; NaN where none is."""
    return float(np.sqrt(np.nansum(error**2))) if np.isfinite(error).any() else np.nan


def georeference_report(found: Georeference, left: Residuals, cue: str) -> dict[str, Any]:
    """Content of georeference.json; what matters of it is printed."""
    placement, unit = found.placement, "m" if found.metric else "scene units"
    measured_by = "control points" if found.used.any() else "GPS" if len(placement.inliers) else "given cameras"
    print(f"{placement.status}: {placement.reason}; unit: {unit}", flush=True)
    transform = placement.local_from_model
    content = {
        "status": quantity(placement.status, ""),
        "reason": quantity(placement.reason, ""),
        "length_unit": quantity(unit, ""),
        "metric": quantity(found.metric, ""),
        "scene_from_sparse": quantity(transform.matrix, unit),
        "scale": quantity(transform.scale, f"{unit} per unit of the sparse model"),
        "up_cue": quantity(cue if placement.levelled else measured_by, ""),
    }
    content |= {} if left.lengths is None else _of_lengths(left.lengths, placement.status == "scaled")
    if found.placement.status != "georeferenced" or found.frame is None:
        return content
    frame, crs_from_local = found.frame, found.frame.crs_from_local()
    measured = placement.heights == "measured"
    content |= {
        "heights": quantity(placement.heights, ""),
        "origin_latitude_deg": quantity(frame.latitude_deg, "deg"),
        "origin_longitude_deg": quantity(frame.longitude_deg, "deg"),
        "origin_altitude_m": quantity(frame.altitude_m if measured else None, "m"),
        "crs": quantity(frame.crs, ""),
        "origin_in_crs": quantity(crs_from_local.translation, frame.crs_unit),
        "crs_from_scene": quantity(crs_from_local.matrix, frame.crs_unit),
    }
    if placement.gps_shift.any():
        content["gps_shift"] = quantity(placement.gps_shift, "m")
    if found.control is not None:
        content |= _of_points(found, found.control, left)
    return content | (_of_cameras(found, left) if len(placement.inliers) else {})


def _of_lengths(lengths: Lengths, used: bool) -> dict[str, Any]:
    """Errors of known lengths, as quantities, and what they leave open of the scale where they give it."""
    error = lengths.in_model - lengths.metres
    content = {
        "lengths": quantity(len(error), "1"),
        "length_rms_m": quantity(rms(error[:, None]), "m"),
        "length_rms_pct": quantity(100 * (rms(error[:, None] / lengths.metres[:, None]) or 0.0), "%"),
    }
    if used:
        content["lengths_scale_sd_log"] = quantity(lengths.scale_sd_log, "1")
    print(f"{len(error)} known lengths: RMS {content['length_rms_m']['value']:.4f} m", flush=True)
    return content


def _of_points(found: Georeference, control: Control, left: Residuals) -> dict[str, Any]:
    """Errors at control and at check points, as quantities."""
    notes = [*control.notes, *_misfits(found, control, left), *_near_a_line(found, control, left)]
    for note in notes:
        print(f"note: {note}", flush=True)
    check = np.array([s.point.check and not s.problem for s in control.located])
    content: dict[str, Any] = {"control_notes": quantity(notes, "")}
    for kind, rows in (("control", found.used), ("check", check)):
        horizontal, vertical = rms(left.points[rows, :2]), rms(left.points[rows, 2:])
        content |= {
            f"{kind}_points": quantity(int(rows.sum()), "1"),
            f"{kind}_rms_horizontal_m": quantity(horizontal, "m"),
            f"{kind}_rms_vertical_m": quantity(vertical, "m"),
        }
        if rows.any():
            height = "heights unknown" if vertical is None else f"vertically {vertical:.3f} m"
            print(f"{rows.sum()} {kind} points: RMS horizontally {horizontal:.3f} m, {height}", flush=True)
    return content


def _misfits(found: Georeference, control: Control, left: Residuals) -> list[str]:
    """A note that names the control points, the worst first, whose errors are too large for what is stated of them."""
    used = found.used
    sd_m = np.array([s.point.sd_m for s in control.located]).reshape(-1, 2)
    horizontal = np.linalg.norm(left.points[:, :2], axis=1) / sd_m[:, 0]
    ratio = np.where(used, np.fmax(horizontal, np.abs(left.points[:, 2]) / sd_m[:, 1]), 0.0)
    worst = [k for k in np.argsort(-ratio) if ratio[k] > MAX_DEVIATIONS]
    if not worst:
        return []
    named = [f"{control.located[k].point.name} ({_in_words(left.points[k])})" for k in worst[:3]]
    return [
        f"{len(worst)} of {used.sum()} control points are more than {MAX_DEVIATIONS:g} stated standard deviations off,"
        f" in metres: {', '.join(named)}; correct coordinates and clicks, or state larger deviations in columns 8 and 9"
    ]


def _near_a_line(found: Georeference, control: Control, left: Residuals) -> list[str]:
    """A note where control points without GPS lie so near to one line that heights as far beside it as they reach along
    it (RMS) are known much worse than is stated of theirs."""
    rows = found.used & np.isfinite(left.points).all(1)
    if found.frame is None or found.placement.inliers.any() or not rows.any():
        return []
    at = found.frame.apply(np.array([s.point.position for s in control.located])[rows])
    along, across, _ = np.linalg.svd(at - at.mean(0), compute_uv=False) / [np.sqrt(len(at)), 1.0, 1.0]
    stated_m = float(np.median([s.point.sd_m[1] for s, row in zip(control.located, rows) if row]))
    open_m = along / across * max(stated_m, SD_OVER_MEDIAN * float(np.median(np.abs(left.points[rows, 2]))))
    if open_m <= MAX_DEVIATIONS * stated_m:
        return []
    return [
        f"the control points lie near one line: {along:.3g} m beside it heights are known to {open_m:.2g} m only; add a"
        " point there"
    ]


def _in_words(error: Array) -> str:
    """The known coordinates of an error (3,)."""
    named = zip(error, ("east", "north", "up"))
    return ", ".join(f"{off:+.2f} {axis}" for off, axis in named if np.isfinite(off))


def _of_cameras(found: Georeference, left: Residuals) -> dict[str, Any]:
    """Distances of cameras from their positions, as quantities."""
    gps, inliers = found.gps, found.placement.inliers
    distance = np.sqrt(np.nansum(left.cameras**2, axis=1))
    whole = rms(left.cameras[inliers])
    print(f"GPS residuals: median {np.median(distance):.2f} m, RMS of inliers {whole or 0:.2f} m", flush=True)
    horizontal = rms(left.cameras[inliers, :2])
    content = {
        "gps_residual_median_m": quantity(float(np.median(distance)), "m"),
        "gps_residual_rms_m": quantity(whole, "m"),
        "gps_residual_horizontal_rms_m": quantity(horizontal, "m"),
        "gps_residual_vertical_rms_m": quantity(rms(left.cameras[inliers, 2:]), "m"),
        "gps_outliers": quantity([name for name, ok in zip(gps.names, inliers) if not ok], ""),
        "gps_accuracy_m": quantity(np.median(gps.sd_m, axis=0), "m"),
    }
    if found.frame is not None and horizontal:
        # Of a similarity fitted to N positions, each coordinate off by its share of the residual.
        at = found.frame.apply(gps.positions[inliers])[:, :2]
        content["gps_scale_sd_log"] = quantity(horizontal / np.sqrt(2 * ((at - at.mean(0)) ** 2).sum()), "1")
    return content


def rms(values: NDArray[np.float64]) -> float | None:
    """Root mean square length of (N, D) differences over those that are known; None where none is."""
    known = values[np.isfinite(values).any(1)]
    return float(np.sqrt(np.nansum(known**2) / len(known))) if len(known) else None
