"""Photos by the names that other programs, lists and people give them."""

import json
import unicodedata
from dataclasses import replace

import cv2
import numpy as np
import pytest

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import in_photos, read_points
from scenefuse.photos.cameras.read_cameras import read_posed_photos
from scenefuse.photos.photo_files import files_by_name, masks_by_name, photos_by_name
from scenefuse.photos.positions import positions_of, read_geo


@pytest.mark.parametrize(
    ("given", "photo"),
    [
        ("a/IMG 1.JPG", "a/IMG 1.JPG"),
        ("IMG 1.JPG", "a/IMG 1.JPG"),
        ("C:\\Users\\me\\a\\IMG 1.JPG", "a/IMG 1.JPG"),
        ("/home/me/photos/IMG 1.JPG", "a/IMG 1.JPG"),
        ("./a/../IMG 1.JPG", "a/IMG 1.JPG"),
        ("\ufeffIMG 1.JPG", "a/IMG 1.JPG"),
        (' "IMG 1.JPG" ', "a/IMG 1.JPG"),
        ("img 1.jpg", "a/IMG 1.JPG"),
        ("IMG 1", "a/IMG 1.JPG"),
        ("IMG 1.JPG.jpg", "a/IMG 1.JPG"),
        ("IMG 1.DNG", "a/IMG 1.JPG"),
        ("a_IMG 1.JPG", "a/IMG 1.JPG"),
        (unicodedata.normalize("NFD", "Gärten.tif"), "Gärten.tif"),
        (unicodedata.normalize("NFD", "GÄRTEN"), "Gärten.tif"),
        ("IMG 2.JPG", None),
        ("MG 1.JPG", None),
        ("", None),
        ("../../etc/passwd", None),
    ],
)
def test_a_photo_is_found_however_its_name_is_written(given, photo):
    found = photos_by_name([given], ["a/IMG 1.JPG", "Gärten.tif", "--help.png"], "list.txt")
    assert found == ({given: photo} if photo else {})


def test_names_that_differ_only_in_case_or_ending_are_told_apart():
    known = ["a.jpg", "A.jpg", "a.png", "b/a.jpg"]
    assert photos_by_name(known, known, "") == {name: name for name in known}
    with pytest.raises(StageError, match="list.txt: a may be any of 4 photos"):
        photos_by_name(["a"], known, "list.txt")


def test_photos_of_one_name_in_two_folders_are_told_apart_by_as_much_of_the_path_as_there_is():
    known = ["100/0.jpg", "101/0.jpg"]
    names = ["D:/flight/100/0.jpg", "D:/flight/101/0.jpg", "D:/flight/102/0.jpg"]
    assert photos_by_name(names, known, "") == {names[0]: known[0], names[1]: known[1]}
    assert photos_by_name(known, ["100_0.jpg", "101_0.jpg"], "") == {"100/0.jpg": "100_0.jpg", "101/0.jpg": "101_0.jpg"}
    with pytest.raises(StageError, match="0.jpg may be any of 2 photos"):
        photos_by_name(["0.jpg"], known, "")
    with pytest.raises(StageError, match="may both be the photo 0.jpg"):
        photos_by_name(known, ["0.jpg"], "")


def test_a_photo_that_is_gone_is_not_taken_from_another_folder():
    known = ["images/1.png", "masks/1.png", "masks/2.png"]
    assert photos_by_name(["images/1.png", "images/2.png"], known, "") == {"images/1.png": "images/1.png"}


@pytest.mark.parametrize(
    "mask",
    [
        "b.JPG.png",
        "b_mask.png",
        "b.JPG_mask.png",
        "b.JPG.mask.png",
        "b.mask.png",
        "b-mask.JPG",
        "Mask_b.png",
        "b_mask.JPG.png",
        "b_mask_mask.png",
        "b mask.png",
        "x/b.jpe",
    ],
)
def test_a_mask_may_be_named_as_any_program_names_it(tmp_path, mask):
    (tmp_path / mask).parent.mkdir(exist_ok=True)
    (tmp_path / mask).touch()
    assert masks_by_name(["a.JPG", "b.JPG"], tmp_path) == {"b.JPG": tmp_path / mask}


def test_photos_whose_names_begin_or_end_as_those_of_masks_have_masks(tmp_path):
    for name in ("mask_1.png", "mask_2_mask.png", "face_mask.png"):
        (tmp_path / name).touch()
    found = masks_by_name(["mask_1.jpg", "mask_2.jpg", "face_mask.jpg"], tmp_path)
    assert {photo: mask.name for photo, mask in found.items()} == {
        "mask_1.jpg": "mask_1.png",
        "mask_2.jpg": "mask_2_mask.png",
        "face_mask.jpg": "face_mask.png",
    }


def test_one_mask_that_is_named_otherwise_hides_no_other(tmp_path):
    for name in ("1.png", "2.png", "2_mask.png", "3.png"):
        (tmp_path / name).touch()
    found = masks_by_name(["1.jpg", "2.jpg", "3.jpg"], tmp_path)
    assert [found[photo].name for photo in ("1.jpg", "2.jpg", "3.jpg")] == ["1.png", "2_mask.png", "3.png"]


def test_masks_are_found_by_their_photos_names(tmp_path):
    for name in ("a.jpg", "a_mask.PNG", "sub/b.JPG", "sub/b.JPG_mask.png", "c.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = masks_by_name(["a.jpg", "sub_b.JPG", "c.jpg"], tmp_path)
    assert found == {"a.jpg": tmp_path / "a_mask.PNG", "sub_b.JPG": tmp_path / "sub/b.JPG_mask.png"}


def test_names_lead_to_no_file_outside_the_folder(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "secret.jpg").touch()
    names = ["../secret.jpg", str(tmp_path / "secret.jpg"), "a\0b.jpg", "x" * 5000, "..", "/"]
    assert files_by_name(names, tmp_path / "photos", "") == {}


TURN, PLACE = "1 0 0 0", "0 0 5"


def model(folder, images, cameras="1 PINHOLE 40 30 50 50 20 15\n"):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(cameras)
    (folder / "images.txt").write_text(images)
    return folder


def photos(folder, *names):
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((30, 40, 3), np.uint8))
    return folder


@pytest.mark.parametrize("observed", ["\n\n", "\n", "\n1.5 2.5 -1 3 4 17\n"], ids=["empty lines", "no lines", "points"])
def test_a_text_model_of_colmap_has_names_with_blanks(tmp_path, observed):
    folder = photos(tmp_path / "photos", "DJI (drone) 1.JPG", "DJI (drone) 2.JPG")
    lines = [f"{k} {TURN} {PLACE} 1 DJI (drone) {k}.JPG" for k in (1, 2)]
    given = model(tmp_path / "sparse", "\ufeff# Image list\n" + observed.join(lines) + observed)
    found, program, notes = read_posed_photos(given, folder)
    assert [photo.file.name for photo in found] == ["DJI (drone) 1.JPG", "DJI (drone) 2.JPG"] and program == "COLMAP"
    np.testing.assert_allclose(found[1].object_from_cam[:3, 3], [0, 0, -5])
    assert notes == []


def test_of_several_models_the_largest_is_taken_and_said(tmp_path):
    folder = photos(tmp_path / "images", "a.jpg", "b.jpg", "c.jpg")
    model(tmp_path / "sparse/0", f"1 {TURN} {PLACE} 1 a.jpg\n\n")
    model(tmp_path / "sparse/1", f"2 {TURN} {PLACE} 1 b.jpg\n\n3 {TURN} {PLACE} 1 c.jpg\n\n")
    found, _, notes = read_posed_photos(tmp_path, folder)
    assert [photo.name for photo in found] == ["b.jpg", "c.jpg"]
    assert notes == ["the model sparse/1 is taken, with 2 photos, and not sparse/0 with 1"]

    lens = {"projection_type": "perspective", "width": 40, "height": 30, "focal": 1.0, "k1": 0.0, "k2": 0.0}
    shot = {"rotation": [0.0, 0.0, 0.0], "translation": [0.0, 0.0, 1.0], "camera": "c"}
    parts = [{"cameras": {"c": lens}, "shots": dict.fromkeys(names, shot)} for names in (["c.jpg"], ["a.jpg", "b.jpg"])]
    (tmp_path / "reconstruction.json").write_text(json.dumps(parts))
    found, _, notes = read_posed_photos(tmp_path / "reconstruction.json", folder)
    assert [photo.name for photo in found] == ["a.jpg", "b.jpg"]
    assert notes == ["the model 1 is taken, with 2 photos, and not 0 with 1"]


def test_a_model_of_colmap_whose_poses_are_no_numbers_is_named(tmp_path):
    folder = photos(tmp_path / "images", "a.jpg")
    with pytest.raises(StageError, match="the pose of a.jpg is no rotation and translation"):
        read_posed_photos(model(tmp_path / "sparse", f"1 {TURN} -inf -inf inf 1 a.jpg\n\n"), folder)
    with pytest.raises(StageError, match="holds no cameras of COLMAP that can be read .*neither an image nor its"):
        read_posed_photos(model(tmp_path / "sparse", f"1 {TURN} 0 0\n"), folder)


def test_photos_of_a_transforms_json_are_found_in_a_folder_of_another_name(tmp_path):
    folder = photos(tmp_path / "photos", "a.JPG", "b.JPG")
    lens = {"w": 40, "h": 30, "fl_x": 50}
    frames = [{"file_path": f"images\\{name}.jpg", "transform_matrix": np.eye(4).tolist()} for name in "abc"]
    (tmp_path / "cameras.json").write_text("\ufeff" + json.dumps(lens | {"frames": frames}))
    for given in (folder, None):
        found, _, notes = read_posed_photos(tmp_path / "cameras.json", given)
        assert [photo.file.name for photo in found] == ["a.JPG", "b.JPG"]
        assert len(notes) == 1 and notes[0].startswith("1 of 3 cameras are of photos that are not in")


def test_clicks_and_positions_are_of_the_photos_that_are_meant(tmp_path):
    (tmp_path / "points.tsv").write_text("point\tphoto\tx_px\ty_px\na\tC:\\me\\img_1.jpg\t3\t4\na\timg_2\t5\t6\n")
    clicks = read_points(tmp_path / "points.tsv")
    assert [c.photo for c in in_photos(clicks.rows, ["b/IMG_1.JPG", "b/IMG_2.JPG"], clicks.path)] == [
        "b/IMG_1.JPG",
        "b/IMG_2.JPG",
    ]
    with pytest.raises(StageError, match=r"img_1\.jpg and IMG_1\.JPG may both be .* write it alike if it is one, or"):
        in_photos([*clicks.rows, replace(clicks.rows[0], photo="IMG_1.JPG")], ["b/IMG_1.JPG"], clicks.path)
    (tmp_path / "geo.txt").write_text("EPSG:4326\nimg_1 8.5 47.5 400\n")
    first, second = positions_of(["b/IMG_1.JPG", "b/IMG_2.JPG"], read_geo(tmp_path / "geo.txt"), tmp_path / "geo.txt")
    assert first["latitude_deg"] == 47.5 and second["latitude_deg"] is None
