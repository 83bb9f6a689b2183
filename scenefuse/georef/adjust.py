"""Bundle adjustment that also counts surveyed points and the positions of photos (method M11)."""

import copy
from dataclasses import dataclass

import numpy as np
import pycolmap

from scenefuse.core.transforms import Array
from scenefuse.georef.placement import ROBUST_SD
from scenefuse.marks.clicks import Click
from scenefuse.sfm.colmap import Freedom, adjustment_options

# How far from its point, in metres, a camera stands that measures a coordinate: its aperture takes no depth in. Also
# the standard deviation of an unknown height.
CAMERA_DISTANCE_M = 1000.0
# cam_from_world of cameras that look down (x east, y south) and north (x east, y down).
DOWN = np.diag([1.0, -1.0, -1.0])
NORTH = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@dataclass(frozen=True)
class SurveyedPhotos:
    """N photos whose positions are known.

    Attributes:
        names: of the photos, all registered.
        x_in_local: (N, 3) metres; NaN where a height is unknown.
        sd_m: (N, 2) standard deviations, horizontal (of each axis) and vertical.
    """

    names: list[str]
    x_in_local: Array
    sd_m: Array


@dataclass(frozen=True)
class SurveyedPoints:
    """P points whose coordinates are known.

    Attributes:
        x_in_local: (P, 3) metres; NaN where a height is unknown.
        sd_m: (P, 2) standard deviations, horizontal (of each axis) and vertical.
        start: (P, 3) where the model's photos see them.
        clicks: P lists of clicks, in pixels of the model's photos.
    """

    x_in_local: Array
    sd_m: Array
    start: Array
    clicks: list[list[Click]]


def adjust_to_survey(
    model: pycolmap.Reconstruction,
    freedom: Freedom,
    photos: SurveyedPhotos,
    points: SurveyedPoints,
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
        photos, points: what was surveyed; either may be empty, not both.
    """
    held = copy.deepcopy(model)
    config = pycolmap.BundleAdjustmentConfig()
    for image in held.reg_image_ids():
        config.add_image(image)
    still = [camera for k in range(len(points.clicks)) for camera in _add_point(held, points, k)]
    priors = [_position_prior(held, photos, row) for row in range(len(photos.names))]
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


def _add_point(model: pycolmap.Reconstruction, points: SurveyedPoints, row: int) -> list[int]:
    """Add a surveyed point with its clicks; ids of the cameras that measure its coordinates."""
    place, (horizontal, vertical) = points.x_in_local[row], CAMERA_DISTANCE_M / points.sd_m[row]
    track = pycolmap.Track()
    by_name = {model.images[i].name: i for i in model.reg_image_ids()}
    for click in points.clicks[row]:
        observed = model.images[by_name[click.photo]].points2D
        observed.append(pycolmap.Point2D(click.pixel))
        track.add_element(by_name[click.photo], len(observed) - 1)
    known = np.where(np.isfinite(place), place, points.start[row])
    still = [_add_camera(model, DOWN, known, (horizontal, horizontal))]
    if np.isfinite(place[2]):
        # Its focal length counts the horizontal coordinate for nothing.
        still.append(_add_camera(model, NORTH, known, (1e-9, vertical)))
    for image in still:
        track.add_element(image, 0)
    model.add_point3D(points.start[row], track)
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


def _position_prior(model: pycolmap.Reconstruction, photos: SurveyedPhotos, row: int) -> pycolmap.PosePrior:
    image = model.find_image_with_name(photos.names[row])
    place, (horizontal, vertical) = photos.x_in_local[row], photos.sd_m[row]
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
