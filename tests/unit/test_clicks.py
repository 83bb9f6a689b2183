"""Clicks in photos, as a table of labels has them: checked, undistorted, left out by name."""

import unicodedata
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from support.planted_ball import FOCAL, HEIGHT, MIDDLE, WIDTH, photos_of_a_ball

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import read_points
from scenefuse.marks.photo_clicks import clicks_per_photo
from scenefuse.photos.workspace import write_model

HEADER = "label\tphoto\tx_px\ty_px\n"


@pytest.fixture(scope="module")
def photos():
    return photos_of_a_ball()


@pytest.fixture
def model(tmp_path, photos):
    (tmp_path / "sparse").mkdir()
    write_model(tmp_path / "sparse", photos.views)
    return tmp_path / "sparse"


def read(tmp_path, rows):
    path = tmp_path / "prompts.tsv"
    path.write_text(HEADER + "".join("\t".join(map(str, row)) + "\n" for row in rows))
    return read_points(path)


SIZES = {"f00.png": (2 * WIDTH, 2 * HEIGHT), "lost.png": (WIDTH, HEIGHT)}


def test_clicks_come_in_pixels_of_the_original_and_boxes_as_two_corners(tmp_path, model, photos):
    rows = [("inside", "f00.png", 100, 60), ("outside", "f00.png", 20, 10), ("box", "f01.png", 80, 20)]
    labels = read(tmp_path, [*rows, ("box", "f01.png", 30, 70)])
    found, left_out = clicks_per_photo(labels, model, photos.views, SIZES)
    assert left_out == []
    assert list(found) == [0, 1]
    np.testing.assert_allclose(found[0].pixels, [[50, 30], [10, 5]])
    assert found[0].inside.tolist() == [True, False] and found[0].box is None
    np.testing.assert_allclose(found[1].box, [[30, 20], [80, 70]])


def test_umlauts_in_two_spellings_are_one_photo(tmp_path, photos):
    apart, whole = (unicodedata.normalize(form, "Tür 1.png") for form in ("NFD", "NFC"))
    views = [replace(view, name=apart) if view.name == "f00.png" else view for view in photos.views]
    (tmp_path / "sparse").mkdir()
    write_model(tmp_path / "sparse", views)
    labels = read(tmp_path, [("inside", whole, 100, 60)])
    found, _ = clicks_per_photo(labels, tmp_path / "sparse", views, {apart: (2 * WIDTH, 2 * HEIGHT)})
    np.testing.assert_allclose(found[0].pixels, [[50, 30]])


def test_a_click_in_a_photo_without_a_camera_is_left_out_where_others_say_what_the_object_is(tmp_path, model, photos):
    rows = [("inside", "f03.png", *MIDDLE), ("inside", "lost.png", 5, 5), ("inside", "f03.png", 70, 45)]
    labels = read(tmp_path, rows)
    found, left_out = clicks_per_photo(labels, model, photos.views, SIZES)
    sentence = "the click inside at (5, 5) is in lost.png, which has no camera (it could not be registered)"
    assert list(found) == [3] and left_out == [sentence]
    labels = read(tmp_path, [*rows, ("outside", "lost.png", 7, 5)])
    assert clicks_per_photo(labels, model, photos.views, SIZES)[1] == [
        "2 clicks, the click inside at (5, 5) first, are in lost.png, which has no camera (it could not be registered)"
    ]


def test_a_click_in_a_photo_that_is_not_used_is_left_out_where_others_say_what_the_object_is(tmp_path, model, photos):
    labels = read(tmp_path, [("inside", "f03.png", *MIDDLE), ("inside", "unused.png", 5, 5)])
    found, left_out = clicks_per_photo(labels, model, photos.views, SIZES)
    assert list(found) == [3] and "unused.png, which is not among the photos that are used" in left_out[0]


@pytest.mark.parametrize(
    "rows, sentence",
    [
        (
            [("inside", "f00.png", 241, 10)],
            r"the click inside at \(241, 10\) lies outside f00\.png, which has 240 x 180",
        ),
        (
            [("inside", "lost.png", 5, 5), ("outside", "f00.png", 5, 5)],
            r"no other click inside: .* in lost\.png, which has no camera .*; click in one of the 12",
        ),
        (
            [("inside", "none.png", 5, 5)],
            r"in none\.png, which is not among the photos that are used.*; click in one of the 12",
        ),
        ([("outside", "f00.png", 5, 5)], "holds only clicks outside the object"),
        ([("box", "f00.png", 5, 5)], r"a box in f00\.png needs two opposite corners, apart by 2 px; it has 1"),
        (
            [("inside", "f00.png", 5, 5), ("outside", "f00.png", 5, 5)],
            r"\(5, 5\) in f00\.png is given more than once",
        ),
        ([("inside", "f00.png", 5, 5)] * 2, "is given more than once"),
        ([("Inside", "f00.png", 5, 5)], "line 2: the label is inside, outside, box, not 'Inside'"),
        ([("inside", "f00.png", 5, "x")], "line 2: expected label photo x_px y_px"),
        ([], "holds no points below its header"),
    ],
)
def test_bad_clicks_are_named(tmp_path, model, photos, rows, sentence):
    with pytest.raises(StageError, match=sentence):
        clicks_per_photo(read(tmp_path, rows), model, photos.views, SIZES)


def test_clicks_as_shares_of_width_and_height_are_named(tmp_path):
    with pytest.raises(StageError, match="all clicks are within the first pixel; multiply shares"):
        read(tmp_path, [("inside", "f00.png", 0.4, 0.6), ("outside", "f00.png", 0.1, 0.9)])
    assert len(read(tmp_path, [("inside", "f00.png", 0.4, 0.6), ("outside", "f00.png", 90, 1)]).rows) == 2


def bent_model(folder, view, k):
    """A COLMAP model of one photo whose lens bends."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", FOCAL, WIDTH, HEIGHT)
    camera.params = [FOCAL, WIDTH / 2, HEIGHT / 2, k]
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name=view.name, camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
    folder.mkdir()
    model.write(folder)
    return model


def test_a_click_is_undistorted(tmp_path, photos):
    model = bent_model(tmp_path / "bent", photos.views[0], 0.2)
    seen = model.images[1].project_point(np.array([0, 0.5, 0.5]))
    labels = read(tmp_path, [("inside", "f00.png", *seen)])
    found, _ = clicks_per_photo(labels, tmp_path / "bent", photos.views, {})
    straight = photos.views[0].project(np.array([[0, 0.5, 0.5]]))[0]
    assert np.linalg.norm(seen - straight[0]) > 0.05
    np.testing.assert_allclose(found[0].pixels, straight, atol=1e-6)


def test_a_click_where_the_undistorted_photo_has_no_pixels_is_left_out_but_counts_in_the_scene(tmp_path, photos):
    bent_model(tmp_path / "bent", photos.views[0], -0.2)
    labels = read(tmp_path, [("inside", "f00.png", 60, 45), ("outside", "f00.png", 2, 2)])
    found, left_out = clicks_per_photo(labels, tmp_path / "bent", photos.views, {})
    assert len(found[0].pixels) == 1 and "whose edge is cut away there" in left_out[0]
    found, left_out = clicks_per_photo(labels, tmp_path / "bent", photos.views, None)
    assert (found[0].pixels[1] < 0).all() and not left_out


def test_a_click_beyond_what_the_lens_s_model_reaches_is_left_out_and_a_box_s_corner_is_moved(tmp_path, photos):
    bent_model(tmp_path / "bent", photos.views[0], -0.5)
    clicks = [
        ("inside", "f00.png", 60, 45),
        ("outside", "f00.png", 2, 2),
        ("box", "f00.png", 1, 1),
        ("box", "f00.png", 60, 60),
    ]
    found, left_out = clicks_per_photo(read(tmp_path, clicks), tmp_path / "bent", photos.views, {})
    assert len(found[0].pixels) == 1 and len(left_out) == 1 and "(2, 2)" in left_out[0]
    assert (found[0].box[0] >= 0).all() and (found[0].box[0] < 2).all()
