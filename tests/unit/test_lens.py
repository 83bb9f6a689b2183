"""The lens that photos determine, a known calibration, and how far a model may be bent."""

import copy
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from support.surveyed import fly

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Sim3, Uncertainty
from scenefuse.georef.spread import Spread, read_spread, spread_of, write_spread
from scenefuse.register.likelihood import with_bending
from scenefuse.sfm.colmap import adjust
from scenefuse.sfm.features import read_calibration
from scenefuse.sfm.lens import BROWN, CENTRED, HELD, LENSES, RADIAL, choose_lens, enrich

MIDDLE = [700.0, 500.0, 400.0, 0.0]


def photographed(camera: list[float], noise_px: float = 0.3) -> pycolmap.Reconstruction:
    """A model of 16 photos by an OPENCV camera of 1000 x 800 pixels, as a mapper would leave it: SIMPLE_RADIAL, the
    principal point in the middle, adjusted."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=16, num_points3D=400, camera_width=1000, camera_height=800
    )
    options.camera_model_id, options.camera_params = pycolmap.CameraModelId.OPENCV, camera
    model = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=noise_px), model)
    for found in model.cameras.values():
        found.model, found.params = pycolmap.CameraModelId.SIMPLE_RADIAL, MIDDLE
    adjust(model, HELD.freedom)
    return model


def test_a_principal_point_off_the_middle_is_refined_and_found():
    model = photographed([700, 700, 510, 388, 0, 0, 0, 0])
    before = copy.deepcopy(model)
    lens, beyond = choose_lens(model)
    camera = next(iter(lens.fit(model).cameras.values()))
    assert (lens, beyond) == (CENTRED, BROWN)
    assert abs(camera.principal_point_x - 510) < 1 and abs(camera.principal_point_y - 388) < 1
    assert list(model.cameras[1].params) == list(before.cameras[1].params), "the model itself was changed"


def test_brown_distortion_is_refined_and_found():
    true = [700, 700, 510, 388, -0.3, 0.5, 0.02, -0.015]
    model = photographed(true)
    lens, beyond = choose_lens(model)
    camera = next(iter(lens.fit(model).cameras.values()))
    assert lens == BROWN
    rays = np.array([[x, y, 1.0] for x in (-0.2, 0, 0.2) for y in (-0.2, 0, 0.2)])
    expected = pycolmap.Camera(model="OPENCV", width=1000, height=800, params=true).img_from_cam(rays)
    off = camera.img_from_cam(rays) - expected
    assert np.linalg.norm(off - off.mean(0), axis=1).max() < 1  # a turned camera looks like a shifted photo


def test_two_radial_terms_are_found_without_tangential_ones():
    model = photographed([700, 700, 510, 388, -0.5, 30, 0, 0])
    lens, beyond = choose_lens(model)
    assert (lens, beyond) == (RADIAL, BROWN)
    camera = next(iter(lens.fit(model).cameras.values()))
    assert camera.model_name == "RADIAL" and abs(camera.principal_point_x - 510) < 1


def test_a_few_cropped_photos_do_not_hold_the_lens_of_the_others():
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2, num_cameras_per_rig=1, num_frames_per_rig=10, num_points3D=300, camera_width=1000, camera_height=800
    )
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [700.0, 510.0, 388.0, 0.0]
    model = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.3), model)
    model.cameras[1].params, model.cameras[2].params = MIDDLE, [700.0, 400.0, 400.0, 0.0]
    model.cameras[2].width = 800  # without 200 columns on the left
    cropped = [i for i in sorted(model.reg_image_ids()) if model.images[i].camera_id == 2]
    for photo in cropped:
        for point in model.images[photo].points2D:
            point.xy = point.xy - [200.0, 0.0]
        if photo in cropped[2:]:
            model.deregister_frame(model.images[photo].frame_id)
    adjust(model, HELD.freedom)
    lens, _ = choose_lens(model)
    camera = lens.fit(model).cameras[1]
    assert lens == CENTRED and abs(camera.principal_point_x - 510) < 1 and abs(camera.principal_point_y - 388) < 1


def test_principal_points_of_cropped_photos_are_found_wherever_they_are_and_the_rest_is_one_lens():
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=16, num_cameras_per_rig=1, num_frames_per_rig=1, num_points3D=400, camera_width=800, camera_height=800
    )
    options.camera_model_id = pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [700.0, 400.0, 400.0, 0.0]
    model = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.3), model)
    cut = dict(zip(sorted(model.images), np.random.default_rng(0).uniform(-150, 150, 16)))
    for photo, image in model.images.items():
        for point in image.points2D:
            point.xy = point.xy - [0.0, cut[photo]]
    adjust(model, HELD.freedom)
    lens, beyond = choose_lens(model, cropped=[image.name for image in model.images.values()])
    fitted = lens.fit(model)
    for adjusted in (model, fitted):
        adjusted.update_point_3d_errors()
    assert (lens, beyond) == (LENSES["centred, shared"], LENSES["brown, shared"])
    assert fitted.compute_mean_reprojection_error() < 0.4 < 0.6 < model.compute_mean_reprojection_error()
    off = [fitted.images[photo].camera.principal_point_y - (400 - cut[photo]) for photo in cut]
    assert np.abs(off).max() < 4 and {round(camera.params[0] / 7) for camera in fitted.cameras.values()} == {100}
    # One lens cannot be so: it is not refined where principal points run away.
    assert choose_lens(model).lens == HELD


def test_a_lens_in_the_middle_without_distortion_is_held():
    lens, beyond = choose_lens(photographed([700, 700, 500, 400, 0, 0, 0, 0]))
    assert (lens, beyond) == (HELD, CENTRED)


def test_two_focal_lengths_stay_two():
    model = photographed([700, 700, 510, 388, 0, 0, 0, 0])
    for camera in model.cameras.values():
        camera.model, camera.params = pycolmap.CameraModelId.PINHOLE, [700, 700, 500, 400]


def test_a_richer_model_is_the_same_lens():
    poor = pycolmap.Camera(model="RADIAL", width=100, height=80, params=[90, 51, 39, -0.1, 0.02])
    rich = pycolmap.Camera(poor.todict())
    enrich(rich, "FULL_OPENCV")
    rays = np.array([[0.1, 0.2, 1.0], [-0.4, 0.3, 1.0]])
    np.testing.assert_allclose(rich.img_from_cam(rays), poor.img_from_cam(rays), atol=1e-9)
    fisheye = pycolmap.Camera(model="OPENCV_FISHEYE", width=100, height=80, params=[90, 90, 51, 39, 0, 0, 0, 0])
    enrich(fisheye, "OPENCV")
    assert fisheye.model_name == "OPENCV_FISHEYE"


def test_the_spread_covers_a_wrong_lens_and_survives_a_file(tmp_path):
    model = photographed([700, 700, 510, 388, 0, 0, 0, 0])
    held = spread_of(model, HELD, CENTRED)
    refined = spread_of(CENTRED.fit(model), CENTRED, None)
    place = np.median(held.points, axis=0)
    assert np.trace(held.covariance_at(place)) > 10 * np.trace(refined.covariance_at(place))
    write_spread(tmp_path / "spread.npz", held)
    again = read_spread(tmp_path / "spread.npz")
    np.testing.assert_allclose(again.covariance_at(place), held.covariance_at(place), rtol=1e-3, atol=1e-12)
    (tmp_path / "broken.npz").write_bytes(b"PK")
    with pytest.raises(StageError, match="no spread"):
        read_spread(tmp_path / "broken.npz")


def test_three_photos_of_which_none_can_be_left_out_do_not_say_how_far_their_model_may_be_bent():
    model = photographed([700, 700, 500, 400, 0, 0, 0, 0])
    for image in sorted(model.reg_image_ids())[3:]:
        model.deregister_frame(model.images[image].frame_id)
    unknown = spread_of(model, HELD, None)
    assert unknown.covariance_at(np.zeros(3)) is None


def test_photos_in_a_straight_row_leave_no_turn_about_it_open():
    flight = fly(rows=1, columns=16)
    row = [replace(view, cam_from_world=view.cam_from_world.copy()) for view in flight.views]
    for k, view in enumerate(row):
        view.cam_from_world[:3, 3] = -view.cam_from_world[:3, :3] @ [4.0 * (k - 7.5), 0.0, 60.0]
    model = replace(flight, views=row).model()
    spread = spread_of(model, HELD, None)
    bent = Uncertainty.of(spread.covariance_at(np.median(spread.points, axis=0)))
    # By the centres of the cameras alone it is 2.4 degrees.
    assert bent.rotation_sd_deg < 0.5


def test_the_spread_at_a_place_is_the_motion_there():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) * [100, 100, 1]
    bowl = points + 1e-4 * (points[:, :2] ** 2).sum(1)[:, None] * [0, 0, 1]
    spread = Spread(points, np.stack([bowl, points, points]), np.array([True, False, False]))
    assert np.sqrt(spread.covariance_at(np.array([150.0, 0, 0]))[5, 5]) > 1.5
    assert np.sqrt(spread.covariance_at(np.zeros(3))[5, 5]) < 0.5


def test_bending_adds_in_the_frame_of_the_scene():
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    pose = Sim3(2.0, quarter, np.zeros(3))
    of_object = np.diag([0.01, 0, 0, 0.5, 0, 0, 0.02]) ** 2
    total = with_bending(Uncertainty.even(0, 0, 0), pose, of_object, None)
    sd = np.sqrt(np.diag(total.covariance))
    np.testing.assert_allclose(sd, [0, 0.01, 0, 0, 1.0, 0, 0.02], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("# nothing\n", "holds 0 cameras"),
        ("1 OPENCV 100 80 1 2\n", "has 2 parameters, but OPENCV has fx, fy"),
        ("1 NONSENSE 100 80 1 2\n", "no camera of COLMAP"),
        ("1 PINHOLE 100 80 90 90 50 forty\n", "no camera of COLMAP"),
    ],
)
def test_a_broken_calibration_is_named(tmp_path, text, words):
    (tmp_path / "cameras.txt").write_text(text)
    with pytest.raises(StageError, match=words):
        read_calibration(tmp_path / "cameras.txt")
