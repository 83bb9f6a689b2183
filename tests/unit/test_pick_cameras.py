"""Where a clicked point is to be expected in other photos, and the workflow's masks in photos with distortion."""

import json

import cv2
import numpy as np
import pycolmap
import pytest

from scenefuse.marks.clicks import Click
from scenefuse.photos.workspace import View, write_model
from scenefuse.pick.expected_place import Cameras
from scenefuse.pick.photo_tiles import MASK_PX, Picture
from scenefuse.pick.session import WorkflowMasks

ROOF = np.array([0.3, -0.2, 0.1])
SIZES = {f"{k}.jpg": (1280, 960) for k in (1, 2, 3)}  # twice the model's photos


@pytest.fixture(scope="module")
def model():
    """Three cameras with strong distortion, 5 away, that look at the origin from 0, 30 and 60 degrees; one point."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="SIMPLE_RADIAL", width=640, height=480, params=[500, 320, 240, 0.1])
    model.add_camera_with_trivial_rig(camera)
    for k, angle in enumerate(np.radians([0.0, 30.0, 60.0]), 1):
        rotation = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0.0, 0.0, 5.0]))
        model.add_image_with_trivial_frame(pycolmap.Image(name=f"{k}.jpg", camera_id=1, image_id=k), pose)
    for k in (1, 2, 3):
        model.images[k].points2D = pycolmap.Point2DList([pycolmap.Point2D(model.images[k].project_point(np.zeros(3)))])
    track = pycolmap.Track([pycolmap.TrackElement(k, 0) for k in (1, 2, 3)])
    model.add_point3D(np.zeros(3), track, np.zeros(3, dtype=np.uint8))
    return model


@pytest.fixture(scope="module")
def cameras(model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sparse")
    model.write(folder)
    return Cameras(folder, SIZES)


def seen(model, k, by=(0.0, 0.0)):
    """The click on the roof in a photo, in pixels of the original."""
    return Click("roof", f"{k}.jpg", *(2 * model.images[k].project_point(ROOF) + by))


def test_one_click_gives_a_line_through_the_true_pixel(model, cameras):
    expected = cameras.expected([seen(model, 1)], "2.jpg")
    true = np.array([seen(model, 2).x_px, seen(model, 2).y_px])
    steps = np.linspace(0, 1, 20)[:, None, None]
    line = (expected[:-1] * (1 - steps) + expected[1:] * steps).reshape(-1, 2)
    assert len(expected) > 20
    assert np.linalg.norm(line - true, axis=1).min() < 0.5


def test_two_clicks_give_the_true_pixel(model, cameras):
    expected = cameras.expected([seen(model, 1), seen(model, 3)], "2.jpg")
    assert np.allclose(expected, [[seen(model, 2).x_px, seen(model, 2).y_px]], atol=1e-3)


def test_the_photo_s_own_click_says_nothing_about_itself(model, cameras):
    assert cameras.expected([seen(model, 2)], "2.jpg") is None
    wrong = seen(model, 2, by=(50, 0))
    expected = cameras.expected([seen(model, 1), wrong, seen(model, 3)], "2.jpg")
    assert np.allclose(expected, [[seen(model, 2).x_px, seen(model, 2).y_px]], atol=1e-3)


def test_residuals_are_in_pixels_of_the_originals(model, cameras):
    assert max(cameras.residuals([seen(model, k) for k in (1, 2, 3)]).values()) < 1e-3
    # An error of 4 px upwards between two level cameras is split into two of each.
    off = cameras.residuals([seen(model, 1), seen(model, 3, by=(0, 4))])
    assert all(abs(px - 2) < 0.2 for px in off.values()) and set(off) == {"1.jpg", "3.jpg"}
    assert cameras.residuals([seen(model, 1)]) == {}


def test_photos_without_a_camera_are_no_error(model, cameras):
    lost = Click("roof", "lost.jpg", 1, 1)
    assert "lost.jpg" not in cameras
    assert cameras.expected([seen(model, 1)], "lost.jpg") is None
    assert cameras.expected([lost], "2.jpg") is None
    assert cameras.residuals([lost, seen(model, 1)]) == {}


@pytest.fixture
def results(model, tmp_path):
    """Results with the mask of a square of the undistorted second photo."""
    for name in ("sparse", "undistorted/sparse", "masks"):
        (tmp_path / name).mkdir(parents=True)
    model.write(tmp_path / "sparse")
    straight = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    write_model(tmp_path / "undistorted/sparse", [View("2.jpg", straight, np.eye(4), 640, 480)])
    mask = np.zeros((480, 640), dtype=np.uint8)
    mask[340:440, 520:600] = 255
    cv2.imwrite(str(tmp_path / "masks/2.png"), mask)
    report = {"dropped": {"1.jpg": "disagrees"}, "per_photo": {"2.jpg": {"area": 0.03, "agreement": 0.9}}}
    (tmp_path / "masks.json").write_text(json.dumps(report))
    return tmp_path


def test_a_mask_is_bent_as_the_lens_bends(model, results):
    mask = WorkflowMasks(results).mask(Picture("2.jpg", None, 1280, 960))
    camera = model.cameras[1]
    corners = camera.img_from_cam(np.column_stack([(np.array([[520, 340], [600, 440]]) - [320, 240]) / 500, [1, 1]]))
    rows, columns = np.nonzero(mask)
    scale = mask.shape[1] / 640
    assert max(mask.shape) <= MASK_PX
    assert corners[0, 0] > 523 and abs(columns.min() / scale - corners[0, 0]) < 2
    assert abs(columns.max() / scale - corners[1, 0]) < 2 and abs(rows.max() / scale - corners[1, 1]) < 2


def test_photos_without_a_mask_have_no_overlay(results):
    assert WorkflowMasks(results).mask(Picture("1.jpg", None, 1280, 960)) is None
    assert WorkflowMasks(results / "nowhere").agreement == {}


def test_masks_that_were_left_out_and_how_the_others_agree_are_known(results):
    masks = WorkflowMasks(results)
    assert masks.dropped == {"1.jpg": "disagrees"} and masks.agreement == {"2.jpg": 0.9}


def test_a_click_beyond_what_the_lens_s_model_reaches_says_nothing(model, tmp_path):
    model = pycolmap.Reconstruction(model)
    model.cameras[1].params = [500, 320, 240, -0.6]
    model.write(tmp_path)
    cameras, corner = Cameras(tmp_path, SIZES), Click("roof", "1.jpg", 4.0, 4.0)
    assert len(cameras.expected([corner], "2.jpg")) == 0
    assert cameras.expected([corner, seen(model, 3)], "2.jpg") is None
    assert cameras.residuals([corner, seen(model, 3)]) == {}
