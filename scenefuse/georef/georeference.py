"""A sparse model brought into metres by control points or GPS, and adjusted to them, or at least turned upright."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.cloud.crs import check_in_area, grid_name, projected_crs
from scenefuse.core.stage import StageError, atomic_directory, quantity, read_json, value, write_json
from scenefuse.core.transforms import UP, box_corners, fit_sim3
from scenefuse.georef.adjust import SurveyedPhotos, SurveyedPoints, adjust_to_survey
from scenefuse.georef.control import Control, read_control_points
from scenefuse.georef.on_cloud import lay_on_cloud
from scenefuse.georef.placement import (
    MAX_GPS_OFF_M,
    PHOTOS_OF_ONE_ERROR,
    GeoreferenceSettings,
    GpsCameras,
    Placement,
    beside_gps,
    middle_of,
    place_by_control,
    place_by_gps,
    scaled,
    upright,
)
from scenefuse.georef.residuals import Georeference, georeference_report, residuals_of, write_residuals
from scenefuse.marks.triangulation import read_lengths
from scenefuse.photos.cameras.given import Place, read_place
from scenefuse.photos.geodesy import LocalFrame, local_frame
from scenefuse.photos.photos import Photo, gps_accuracies, gps_positions, read_photos
from scenefuse.photos.workspace import posed_images, read_model
from scenefuse.sfm.colmap import Freedom, drop_outliers
from scenefuse.sfm.gravity import estimate_up, roll_spread_deg
from scenefuse.sfm.lens import LENSES

Array = NDArray[np.float64]


def georegister(
    *,
    sparse: Path,
    sparse_json: Path,
    photos: Path,
    control: Path | None = None,
    lengths: Path | None = None,
    held: bool = False,
    crs: str | None = None,
    cloud: Path | None = None,
    georeferenced: Path,
    residuals: Path,
    report: Path,
    settings: GeoreferenceSettings,
    seed: int,
) -> None:
    """Move a sparse model into east, north, up in metres by control points or its photos' GPS, and adjust it to them.

    Given cameras that another program placed on the earth stay there, unless there are control points. Without any of
    these the model is turned upright, and in metres only by known lengths.

    Args:
        sparse: COLMAP model.
        sparse_json: JSON of the mapping stage, for the lens, and for where given cameras lie.
        photos: JSON list of the photos with their GPS positions.
        control: control and check points with their clicks, an OpenDroneMap gcp_list.txt.
        lengths: known lengths between clicked points, `lengths.tsv`; beside control points or GPS only measured.
        held: whether the model is only moved: a dense cloud is given that goes with its cameras as they are.
        crs: projected, of the results; without it the UTM zone, or what control points and given cameras are in.
            Beside a cloud, this one's.
        cloud: of the scene, in a CRS, on which the model is laid at last; the results are in its coordinates.
        georeferenced: output, COLMAP model.
        residuals: output, tab-separated: what is left at every surveyed point and every photo with a position.
        report: output, JSON: status, transform, origin, CRS, residuals.
        settings: when GPS is used.
        seed: of RANSAC.

    Raises:
        StageError: as of `read_control_points`, `read_lengths`, `place_by_control`, `beside_gps` and `lay_on_cloud`;
            `crs` is given but the scene has no place on the earth, or one outside it.
    """
    model, listed = read_model(sparse), read_photos(photos)
    names, rotations, centres = camera_poses(model)
    gps = gps_cameras(names, centres, listed, settings.gps_accuracy_m)
    up, cue = estimate_up(rotations, centres)
    surveyed = None if control is None else read_control_points(control, model, listed)
    place = read_place(read_json(sparse_json))
    if place is not None and surveyed is None:
        found = placed_as_given(place, model, gps)
    else:
        found = georeference(gps, surveyed, up, settings, seed, sure_up=cue == "headings")
    if crs is not None and cloud is None:
        found = replace(found, frame=_in_grid(found, crs))
    sizes = {p.name: (p.width, p.height) for p in listed}
    if lengths is not None and not found.metric:
        known = read_lengths(lengths, model, sizes)
        found = replace(found, placement=scaled(found.placement, known.scale, len(known.names)))
    transform = found.placement.local_from_model
    model.transform(pycolmap.Sim3d(transform.scale, pycolmap.Rotation3d(transform.rotation), transform.translation))
    adjustment: dict[str, Any] = {}
    if not held:
        adjustment = adjust_georeferenced(model, found, LENSES[value(read_json(sparse_json), "lens")].freedom)
    if cloud is not None:
        found, laid = lay_on_cloud(model, found, cloud, crs)
        adjustment |= laid
    with atomic_directory(georeferenced) as temporary:
        model.write(temporary)
    left = residuals_of(model, found, None if lengths is None else read_lengths(lengths, model, sizes))
    write_residuals(residuals, found, left)
    _, turned, _ = camera_poses(model)
    write_json(report, georeference_report(found, left, cue, roll_spread_deg(turned, UP)) | adjustment)


def _in_grid(found: Georeference, crs: str) -> LocalFrame:
    """The frame of a scene whose results are to be in a CRS."""
    where = "the column crs"
    grid = projected_crs(crs, where, heights=False)
    if found.frame is None:
        raise StageError(
            f"{where} names {grid.name}, but nothing says where the scene lies: {found.placement.reason}; empty that"
            " cell, or give control points, which name a CRS themselves"
        )
    frame = replace(found.frame, grid=grid_name(grid))
    check_in_area(grid, frame.in_crs(np.zeros((1, 3))), f"{where}: the scene")
    return frame


def georeference(
    gps: GpsCameras,
    control: Control | None,
    up: Array,
    settings: GeoreferenceSettings,
    seed: int,
    sure_up: bool = False,
) -> Georeference:
    """How a model is placed by what was surveyed; nothing is moved yet.

    Args:
        gps: photos with positions.
        control: surveyed points in the model, or None.
        up: (3,) the cameras' up direction in the model.
        settings: when GPS is used.
        seed: of RANSAC.
        sure_up: whether `up` is a measurement (`estimate_up`: "headings"), better than inexact heights.
    """
    by_gps = settings.use_gps and len(gps.names) >= PHOTOS_OF_ONE_ERROR
    if control is not None:
        positions = np.array([s.point.position for s in control.located])
        frame = replace(local_frame(positions), grid=control.grid)
        there, where = frame.apply(positions), str(control.path)
        placement, notes = place_by_control(control.located, there, up, where, seed)
        if by_gps:
            positions = frame.apply(gps.positions)
            placement = beside_gps(placement, control.located, there, gps, positions, where, settings)
        return Georeference(placement, frame, gps, replace(control, notes=[*control.notes, *notes]))
    if by_gps:
        frame = local_frame(gps.positions)
        there, sd_m = frame.apply(gps.positions), float(np.median(gps.sd_m[:, 0]))
        return Georeference(place_by_gps(gps.centres, there, up, settings, seed, sd_m, sure_up), frame, gps)
    reason = f"{len(gps.names)} registered photos have a GPS position, {PHOTOS_OF_ONE_ERROR} are needed"
    return Georeference(upright(up, reason if settings.use_gps else "GPS is switched off"), None, gps)


def placed_as_given(place: Place, model: pycolmap.Reconstruction, gps: GpsCameras) -> Georeference:
    """How a model is placed whose cameras another program placed on the earth: as they are there.

    Args:
        place: of the given cameras.
        model: them and their points.
        gps: photos with positions, to compare; they move nothing.

    Raises:
        StageError: the cameras lie nowhere near the area of the project's CRS, or more than a kilometre from where GPS
            saw them.
    """
    _, _, centres = camera_poses(model)
    inside = np.concatenate([centres, np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)])
    corners = box_corners(inside.min(0), inside.max(0))
    there = place.wgs84(corners, "the given cameras")
    frame = replace(local_frame(there), grid=grid_name(place.crs))
    fitted, reason = fit_sim3(corners, frame.apply(there)), f"where its cameras were given, in {place.crs.name}"
    if len(gps.names):
        off = middle_of(frame.apply(gps.positions) - fitted.apply(gps.centres))
        if np.linalg.norm(off[:2]) > MAX_GPS_OFF_M:
            raise StageError(
                f"the given cameras lie {np.linalg.norm(off[:2]) / 1000:.3g} km from where the photos' GPS saw them;"
                " give the project of these photos, or one whose CRS is theirs"
            )
        reason += f" ({np.linalg.norm(off[:2]):.1f} m from the photos' GPS, {-off[2]:+.1f} m in height)"
    none = np.zeros(0, dtype=bool)
    return Georeference(Placement("georeferenced", reason, fitted, none, "measured", False), frame, gps)


def adjust_georeferenced(model: pycolmap.Reconstruction, found: Georeference, freedom: Freedom) -> dict[str, Any]:
    """Adjust a georeferenced model in place to control points and positions, where these fix it (method M11).

    Positions along one line, or without heights, leave a model free to tilt: it is not adjusted to them.

    Returns:
        Quantities: what it was adjusted to, and reprojection errors; empty where it was not adjusted.
    """
    placement, gps, frame = found.placement, found.gps, found.frame
    if frame is None or placement.status != "georeferenced" or placement.levelled:
        return {}
    chosen = placement.inliers if len(placement.inliers) else np.zeros(len(gps.names), dtype=bool)
    places = frame.apply(gps.positions[chosen]) - placement.gps_shift
    photos = SurveyedPhotos([n for n, c in zip(gps.names, chosen) if c], places, gps.sd_m[chosen])
    used = [s for s, u in zip(found.located, placement.used) if u]
    if not (used or photos.names):
        return {}
    points = SurveyedPoints(
        frame.apply(np.array([s.point.position for s in used]).reshape(-1, 3)),
        np.array([s.point.sd_m for s in used]).reshape(-1, 2),
        placement.local_from_model.apply(np.array([s.x_in_model for s in used]).reshape(-1, 3)),
        [s.point.clicks for s in used],
    )
    before_px = model.compute_mean_reprojection_error()
    adjust_to_survey(model, freedom, photos, points)
    drop_outliers(model)
    after_px = model.compute_mean_reprojection_error()
    print(
        f"adjusted to {len(used)} control points and {len(photos.names)} positions: reprojection error"
        f" {before_px:.3f} px before, {after_px:.3f} px after",
        flush=True,
    )
    return {
        "adjusted_to_control_points": quantity(len(used), "1"),
        "adjusted_to_positions": quantity(len(photos.names), "1"),
        "mean_reprojection_error_before_px": quantity(before_px, "px"),
        "mean_reprojection_error_px": quantity(after_px, "px"),
    }


def gps_cameras(names: list[str], centres: Array, photos: list[Photo], accuracy_m: float) -> GpsCameras:
    """The registered photos that have a position; `accuracy_m` is for those that state none."""
    known, positions = gps_positions(photos)
    row_of = {name: row for row, name in enumerate(known)}
    with_gps = [row for row, name in enumerate(names) if name in row_of]
    rows = [row_of[names[row]] for row in with_gps]
    accuracies = gps_accuracies(photos, accuracy_m)
    return GpsCameras([names[row] for row in with_gps], centres[with_gps], positions[rows], accuracies[rows])


def camera_poses(model: pycolmap.Reconstruction) -> tuple[list[str], Array, Array]:
    """Names (sorted), (N, 3, 3) world_from_cam rotations and (N, 3) centres of the registered photos."""
    images = posed_images(model)
    matrices = np.array([image.cam_from_world().inverse().matrix() for image in images]).reshape(-1, 3, 4)
    return [image.name for image in images], matrices[:, :, :3], matrices[:, :, 3]
