"""A sparse model brought into metres by control points or GPS, and adjusted to them (method M11), or at least turned
upright."""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from scenefuse.cloud.crs import check_in_area, grid_name, projected_crs
from scenefuse.cloud.import_cloud import near_origin
from scenefuse.core.stage import StageError, atomic_directory, quantity, read_json, value, write_json
from scenefuse.core.transforms import FIXING_POINTS, Array, Sim3, box_corners, fit_sim3
from scenefuse.georef.control import CHECK, Control, SurveyedPoint, read_control_points
from scenefuse.georef.on_cloud import lay_on_cloud
from scenefuse.georef.placement import (
    PHOTOS_OF_ONE_ERROR,
    ROBUST_SD,
    GeoreferenceSettings,
    GpsCameras,
    Placement,
    beside_gps,
    middle_of,
    of_one_zero,
    place_by_control,
    place_by_gps,
    scaled,
    upright,
)
from scenefuse.georef.residuals import Georeference, georeference_report, residuals_of, write_residuals
from scenefuse.marks.triangulation import read_lengths
from scenefuse.photos.cameras.given import Place, read_place
from scenefuse.photos.geodesy import MAX_GPS_OFF_M, LocalFrame, local_frame
from scenefuse.photos.photos import Photo, gps_accuracies, gps_positions, read_photos
from scenefuse.photos.workspace import posed_images, read_model
from scenefuse.sfm.colmap import Freedom, adjustment_options, drop_outliers
from scenefuse.sfm.gravity import estimate_up
from scenefuse.sfm.lens import LENSES

# How far from its point, in metres, a camera stands that measures a coordinate: its aperture takes no depth in. Also
# the standard deviation of an unknown height.
CAMERA_DISTANCE_M = 1000.0
# cam_from_world of cameras that look down (x east, y south) and north (x east, y down).
DOWN = np.diag([1.0, -1.0, -1.0])
NORTH = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


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
    there = np.full(centres.shape, np.nan)
    if settings.use_gps and gps.names:
        there[np.isin(names, gps.names)] = local_frame(gps.positions).apply(gps.positions)
    up, cue = estimate_up(rotations, centres, there)
    surveyed = None if control is None else read_control_points(control, model, listed)
    place = read_place(read_json(sparse_json))
    if place is not None and (surveyed is None or surveyed.only_checks):
        found = replace(placed_as_given(place, model, gps), control=surveyed)
    else:
        found = georeference(gps, surveyed, up, settings, seed, sure_up=cue == "headings")
    if crs is not None and cloud is None:
        found = replace(found, frame=_in_grid(found, crs))
    sizes = {p.name: (p.width, p.height) for p in listed}
    if lengths is not None and not found.metric:
        known = read_lengths(lengths, model, sizes)
        found = replace(found, placement=scaled(found.placement, known.scale, len(known.names)))
    transform = found.placement.local_from_model
    if found.placement.status in ("upright", "scaled"):
        # Cameras in the coordinates of a map, which nothing names, are too far from zero for meshes in float32.
        transform = Sim3(1.0, np.eye(3), -near_origin(transform.apply(centres))) @ transform
        found = replace(found, placement=replace(found.placement, local_from_model=transform))
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
    write_json(report, georeference_report(found, left, cue) | adjustment)


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

    Raises:
        StageError: what `place_by_control` and `beside_gps` say; check points of a scene that nothing else places.
    """
    by_gps = settings.use_gps and len(gps.names) >= PHOTOS_OF_ONE_ERROR
    gps, zeros = of_one_zero(gps, settings.gps_accuracy_m) if by_gps else (gps, "")
    if control is not None and not control.only_checks:
        positions = np.array([s.point.position for s in control.located])
        frame = replace(local_frame(positions), grid=control.grid)
        there, where = frame.apply(positions), str(control.path)
        placement, notes = place_by_control(control.located, there, up, where, seed)
        if by_gps:
            positions = frame.apply(gps.positions)
            placement = beside_gps(placement, control.located, there, gps, positions, where, settings)
            placement = replace(placement, reason=placement.reason + zeros)
        return Georeference(placement, frame, gps, replace(control, notes=[*control.notes, *notes]))
    if by_gps:
        frame = local_frame(gps.positions)
        there, sd_m = frame.apply(gps.positions), float(np.median(gps.sd_m[:, 0]))
        placement = place_by_gps(gps.centres, there, up, settings, seed, sd_m, sure_up)
        frame = frame if control is None else replace(frame, grid=control.grid)
        found = Georeference(replace(placement, reason=placement.reason + zeros), frame, gps, control)
    else:
        reason = f"{len(gps.names)} registered photos have a GPS position, {PHOTOS_OF_ONE_ERROR} are needed"
        found = Georeference(upright(up, reason if settings.use_gps else "GPS is switched off"), None, gps, control)
    if control is not None and found.placement.status != "georeferenced":
        raise StageError(
            f"{control.path} holds check points ({CHECK}...) alone, and nothing else places the scene:"
            f" {found.placement.reason}; name {FIXING_POINTS} of them without {CHECK}, as control points"
        )
    return found


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
    off = middle_of(frame.apply(gps.positions) - fitted.apply(gps.centres))
    if len(gps.names):
        if np.linalg.norm(off[:2]) > MAX_GPS_OFF_M:
            raise StageError(
                f"the given cameras lie {np.linalg.norm(off[:2]) / 1000:.3g} km from where the photos' GPS saw them;"
                " give the project of these photos, or one whose CRS is theirs"
            )
        reason += f" ({np.linalg.norm(off[:2]):.1f} m from the photos' GPS, {-off[2]:+.1f} m in height)"
    none = np.zeros(0, dtype=bool)
    placement = Placement("georeferenced", reason, fitted, none, "measured", False, gps_shift=off)
    return Georeference(placement, frame, gps)


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
    photos = list(zip([n for n, c in zip(gps.names, chosen) if c], places, gps.sd_m[chosen]))
    used = [s for s, u in zip(found.located, placement.used) if u]
    if not (used or photos):
        return {}
    there = frame.apply(np.array([s.point.position for s in used]).reshape(-1, 3))
    seen = placement.local_from_model.apply(np.array([s.x_in_model for s in used]).reshape(-1, 3))
    points = list(zip([s.point for s in used], there, seen))
    before_px = model.compute_mean_reprojection_error()
    adjust_to_survey(model, freedom, photos, points)
    drop_outliers(model)
    after_px = model.compute_mean_reprojection_error()
    print(
        f"adjusted to {len(used)} control points and {len(photos)} positions: reprojection error"
        f" {before_px:.3f} px before, {after_px:.3f} px after",
        flush=True,
    )
    return {
        "adjusted_to_positions": quantity(len(photos), "1"),
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


def adjust_to_survey(
    model: pycolmap.Reconstruction,
    freedom: Freedom,
    photos: list[tuple[str, Array, Array]],
    points: list[tuple[SurveyedPoint, Array, Array]],
) -> None:
    """Adjust a model that lies in the local frame (metres) in place, by reprojection errors and by what was surveyed.

    COLMAP weighs no observation by a standard deviation of its own, but a camera with a long focal length does: each
    surveyed point is also seen by two cameras that stand still, one above it and one south of it, whose pixel is the
    standard deviation of the coordinates that they see. Positions of photos are COLMAP's pose priors. All errors have
    Cauchy weights. An observation counts with a standard deviation of 1 px: those of one model are less far off, but
    they err alike, since a lens that does not quite fit shifts all that lie near each other.

    Args:
        model: registered photos and points, georeferenced.
        freedom: what of the cameras may change.
        photos: names, positions (3,) and their standard deviations (2,), horizontal (of each axis) and vertical.
        points: surveyed points, their coordinates (3,), and where (3,) the model's photos see them. Unknown heights are
            NaN; either list may be empty, not both.
    """
    held = copy.deepcopy(model)
    config = pycolmap.BundleAdjustmentConfig()
    for image in held.reg_image_ids():
        config.add_image(image)
    still = [camera for point in points for camera in _add_point(held, *point)]
    priors = [_position_prior(held, *photo) for photo in photos]
    still += _held(held, len(priors) - len(still))
    for image in still:
        config.add_image(image)
        config.set_constant_rig_from_world_pose(held.images[image].frame_id)
        config.set_constant_cam_intrinsics(held.images[image].camera_id)
    priors += [_prior(held.images[i], held.images[i].projection_center(), np.ones(3)) for i in still]
    options = pycolmap.PosePriorBundleAdjustmentOptions()
    options.alignment_ransac.max_error = 1e-6  # none, see `_held`
    options.alignment_ransac.random_seed = 0
    options.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.prior_position_loss_scale = ROBUST_SD
    adjuster = pycolmap.create_pose_prior_bundle_adjuster(
        adjustment_options(freedom, 1e-9), options, config, priors, held
    )
    adjuster.solve()
    for image in model.reg_image_ids():
        own, frame = model.images[image], model.images[image].frame
        assert frame is not None
        frame.set_cam_from_world(own.camera_id, held.images[image].cam_from_world())
    for camera in model.cameras:
        model.cameras[camera].params = list(held.cameras[camera].params)
    for point in model.point3D_ids():
        model.points3D[point].xyz = held.points3D[point].xyz
    model.update_point_3d_errors()


def _add_point(model: pycolmap.Reconstruction, point: SurveyedPoint, place: Array, start: Array) -> list[int]:
    """Add a surveyed point with its clicks; ids of the cameras that measure its coordinates."""
    horizontal, vertical = CAMERA_DISTANCE_M / np.array(point.sd_m)
    track = pycolmap.Track()
    by_name = {model.images[i].name: i for i in model.reg_image_ids()}
    for click in point.clicks:
        observed = model.images[by_name[click.photo]].points2D
        observed.append(pycolmap.Point2D(click.pixel))
        track.add_element(by_name[click.photo], len(observed) - 1)
    known = np.where(np.isfinite(place), place, start)
    still = [_add_camera(model, DOWN, known, (horizontal, horizontal))]
    if np.isfinite(place[2]):
        # Its focal length counts the horizontal coordinate for nothing.
        still.append(_add_camera(model, NORTH, known, (1e-9, vertical)))
    for image in still:
        track.add_element(image, 0)
    model.add_point3D(start, track)
    return still


def _add_camera(
    model: pycolmap.Reconstruction, cam_from_world: Array, place: Array, focal_px: tuple[float, float]
) -> int:
    """Add a camera that sees a place (3,) in its one pixel from far away, with one observation; its image's id."""
    camera = pycolmap.Camera(model="PINHOLE", width=2, height=2, params=[*focal_px, 1.0, 1.0])
    camera.camera_id = max(model.cameras) + 1
    model.add_camera_with_trivial_rig(camera)
    number = max(model.images) + 1
    observed = [pycolmap.Point2D(np.ones(2))]
    image = pycolmap.Image(name=f"{number}", points2D=observed, camera_id=camera.camera_id, image_id=number)
    centre = place - CAMERA_DISTANCE_M * cam_from_world[2]
    model.add_image_with_trivial_frame(
        image, pycolmap.Rigid3d(pycolmap.Rotation3d(cam_from_world), -cam_from_world @ centre)
    )
    return number


def _held(model: pycolmap.Reconstruction, count: int) -> list[int]:
    """Add cameras that see nothing, half of all priors at least and not in one plane; ids of their images.

    COLMAP first aligns a model with its priors by RANSAC, which would move the cameras of surveyed points away from
    them. These priors fit exactly, and no others do, so that nothing is moved.
    """
    corners = CAMERA_DISTANCE_M * np.array(
        [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64
    )
    return [_add_camera(model, DOWN, corners[k % 8] * (1 + k // 8), (1.0, 1.0)) for k in range(max(8, count))]


def _position_prior(model: pycolmap.Reconstruction, name: str, place: Array, sd_m: Array) -> pycolmap.PosePrior:
    image, (horizontal, vertical) = model.find_image_with_name(name), sd_m
    known = np.where(np.isfinite(place), place, image.projection_center())
    up = vertical if np.isfinite(place[2]) else CAMERA_DISTANCE_M
    return _prior(image, known, np.array([horizontal, horizontal, up]))


def _prior(image: pycolmap.Image, position: Array, sd: Array) -> pycolmap.PosePrior:
    return pycolmap.PosePrior(
        position=position,
        position_covariance=np.diag(sd**2),
        coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
        corr_data_id=image.data_id,
    )
