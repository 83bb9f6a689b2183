import hashlib
import os

import numpy as np
import pytest
from PIL import Image

from scenefuse.core.stage import StageError, read_json, value
from scenefuse.photos.photo_files import photo_files
from scenefuse.photos.photos import check_unchanged, gps_positions, inspect_photo, list_photos, read_photos


def save(path, size=(40, 30), gps=None, shade=100, focal_35mm=None, orientation=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if gps is not None:
        exif[0x8825] = gps
    if focal_35mm is not None:
        exif[0x8769] = {0xA405: focal_35mm}
    if orientation is not None:
        exif[0x0112] = orientation
    Image.new("RGB", size, (shade, shade, shade)).save(path, exif=exif)


def listed(tmp_path, folder):
    list_photos(folder=folder, upright=tmp_path / "upright", photos=tmp_path / "photos.json")
    return read_photos(tmp_path / "photos.json")


def test_sizes_hashes_positions_and_subfolders(tmp_path):
    folder = tmp_path / "photos"
    south_west = {1: "S", 2: (33.0, 30.0, 36.0), 3: "W", 4: (70.0, 15.0, 0.0), 5: b"\x00", 6: 520.25}
    save(folder / "a.jpg", gps=south_west, focal_35mm=18)
    save(folder / "sub" / "b.png", size=(20, 50), shade=7)
    (folder / "notes.txt").write_text("no photo")
    listed(tmp_path, folder)
    first, second = read_photos(tmp_path / "photos.json")
    assert (first.name, first.width, first.height) == ("a.jpg", 40, 30)
    assert first.sha256 == hashlib.sha256((folder / "a.jpg").read_bytes()).hexdigest()
    assert first.latitude_deg == pytest.approx(-33.51) and first.longitude_deg == pytest.approx(-70.25)
    assert first.altitude_m == pytest.approx(520.25)
    assert first.focal_px == pytest.approx(20.0)  # 18 mm of a 36 mm wide frame is half of 40 columns
    assert (second.name, second.width, second.height, second.has_gps) == ("sub/b.png", 20, 50, False)
    assert value(read_json(tmp_path / "photos.json"), "with_gps") == 1


@pytest.mark.parametrize(
    "gps",
    [
        {1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)},
        {1: "N", 3: "E"},
        {1: "N", 2: (99.0, 0.0, 0.0), 3: "E", 4: (8.0, 0.0, 0.0)},
    ],
)
def test_a_useless_position_is_no_position(tmp_path, gps):
    save(tmp_path / "p" / "a.jpg", gps=gps)
    listed(tmp_path, tmp_path / "p")
    assert not read_photos(tmp_path / "photos.json")[0].has_gps


def test_depth_below_sea_level_and_missing_altitude(tmp_path):
    north_east = {1: "N", 2: (31.0, 0.0, 0.0), 3: "E", 4: (35.0, 0.0, 0.0)}
    save(tmp_path / "p" / "a.jpg", gps=north_east | {5: b"\x01", 6: 400.0}, shade=1)
    save(tmp_path / "p" / "b.jpg", gps=north_east, shade=2)
    listed(tmp_path, tmp_path / "p")
    names, positions = gps_positions(read_photos(tmp_path / "photos.json"))
    assert names == ["a.jpg", "b.jpg"]
    np.testing.assert_allclose(positions, [[31, 35, -400], [31, 35, np.nan]])


def test_all_bad_photos_are_named_at_once(tmp_path):
    save(tmp_path / "p" / "a.jpg")
    for name in ("b.jpg", "c.jpg"):
        (tmp_path / "p" / name).write_text(f"<html>{name}")
    Image.fromarray(np.ones((9, 9), np.float32)).save(tmp_path / "p" / "d.tif")
    with pytest.raises(StageError, match=r"b.jpg cannot be decoded \(it is no picture\).*; nor can c.jpg, d.tif$"):
        listed(tmp_path, tmp_path / "p")
    for name in ("b.jpg", "c.jpg"):
        (tmp_path / "p" / name).unlink()
    with pytest.raises(StageError, match="d.tif cannot be decoded .its pixels are 32-bit measurements"):
        listed(tmp_path, tmp_path / "p")


def test_copies_and_rotations_are_noted(tmp_path):
    save(tmp_path / "p" / "a.jpg")
    save(tmp_path / "p" / "b.jpg")
    save(tmp_path / "p" / "c.jpg", orientation=6)
    listed(tmp_path, tmp_path / "p")
    notes = value(read_json(tmp_path / "photos.json"), "notes")
    assert notes[0] == "1 photos are copies of others, byte for byte, and are left out (b.jpg of a.jpg)"
    assert [photo.name for photo in read_photos(tmp_path / "photos.json")] == ["a.jpg", "c.jpg"]
    assert "1 photos (c.jpg, ...) carry an EXIF rotation; upright copies" in notes[-1]


def test_rotated_photos_are_stood_upright_and_the_others_linked(tmp_path):
    folder, north_east = tmp_path / "p", {1: "N", 2: (31.0, 0.0, 0.0), 3: "E", 4: (35.0, 0.0, 0.0), 5: b"\x00", 6: 77.0}
    save(folder / "sub" / "a.jpg", gps=north_east)
    exif = Image.Exif()
    exif[0x0112], exif[0x010F], exif[0x8825], exif[0x8769] = 6, "Maker", north_east, {0xA405: 18}
    picture = Image.new("RGB", (64, 32), (0, 0, 0))
    picture.paste((250, 0, 0), (0, 0, 16, 16))  # top left as stored, top right as seen
    picture.save(folder / "sub" / "b.jpg", exif=exif, quality=95)
    level, turned = listed(tmp_path, folder)
    assert (tmp_path / "upright/sub/a.jpg").is_symlink() and level.name == "sub/a.jpg"
    assert (tmp_path / "upright/sub/a.jpg").read_bytes() == (folder / "sub/a.jpg").read_bytes()
    assert (turned.width, turned.height, turned.orientation, turned.camera) == (32, 64, 1, "Maker")
    assert turned.has_gps and turned.altitude_m == 77.0 and turned.focal_px == pytest.approx(32.0)
    with Image.open(tmp_path / "upright/sub/b.jpg") as seen:
        assert seen.getpixel((24, 8))[0] > 200 and seen.getpixel((8, 8))[0] < 50
    assert value(read_json(tmp_path / "photos.json"), "turned") == {"sub/b.jpg": 6}


def test_a_photo_that_was_replaced_or_removed_since_it_was_listed_is_named(tmp_path):
    folder = tmp_path / "p"
    for index in range(3):
        save(folder / f"{index}.png", shade=index)
    photos = listed(tmp_path, folder)
    check_unchanged(tmp_path / "upright", photos)
    before = (folder / "1.png").stat()
    save(folder / "1.png", shade=200)
    os.utime(folder / "1.png", (before.st_atime, before.st_mtime - 1000))
    with pytest.raises(StageError, match=r"1\.png is not the photo that was listed any more"):
        check_unchanged(tmp_path / "upright", photos)
    (folder / "2.png").unlink()
    with pytest.raises(StageError, match=r"1 photos are missing .*2\.png"):
        check_unchanged(tmp_path / "upright", photos)


@pytest.mark.parametrize("content", [b"", b"not a photo", None])
def test_an_unreadable_photo_is_named_and_nothing_is_written(tmp_path, content):
    folder = tmp_path / "p"
    save(folder / "good.jpg")
    save(folder / "bad.jpg", size=(400, 300))
    whole = (folder / "bad.jpg").read_bytes()
    (folder / "bad.jpg").write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(StageError, match=r"bad\.jpg cannot be decoded .* remove it"):
        listed(tmp_path, folder)
    assert not (tmp_path / "photos.json").exists()


def test_a_photo_of_200_megapixels_is_read_and_one_that_no_camera_takes_is_refused(tmp_path, monkeypatch):
    (tmp_path / "p").mkdir()
    Image.new("1", (20_000, 10_000)).save(tmp_path / "p" / "phone.png")
    assert inspect_photo(tmp_path / "p", "phone.png").width == 20_000
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", Image.MAX_IMAGE_PIXELS // 3)
    with pytest.raises(StageError, match=r"phone\.png cannot be decoded .*exceeds limit"):
        inspect_photo(tmp_path / "p", "phone.png")


def test_missing_and_empty_folders(tmp_path):
    with pytest.raises(StageError, match="nowhere does not exist"):
        listed(tmp_path, tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "readme.txt").write_text("x")
    with pytest.raises(StageError, match=r"holds no photos.*1 other files"):
        listed(tmp_path, tmp_path / "empty")


def test_only_what_is_a_photo_is_listed(tmp_path):
    folder = tmp_path / "p"
    save(folder / "b.JPG")
    save(folder / "sub" / "a.tif")
    save(folder / ".trash" / "old.jpg")
    for name in (".DS_Store", "Thumbs.db", "._b.JPG", "b.xmp", "b.DNG", "notes.txt"):
        (folder / name).write_bytes(b"x")
    assert photo_files(folder) == [folder / "b.JPG", folder / "sub" / "a.tif"]


def test_photos_in_symlinked_folders_are_found_once(tmp_path):
    save(tmp_path / "disk" / "card" / "a.jpg")
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "flight").symlink_to(tmp_path / "disk" / "card")
    (tmp_path / "disk" / "card" / "back").symlink_to(tmp_path / "p")
    assert photo_files(tmp_path / "p") == [tmp_path / "p" / "flight" / "a.jpg"]


@pytest.mark.parametrize("name", ["IMG_1.HEIC", "DJI_0001.DNG", "sub/shot.NEF"])
def test_photos_that_cannot_be_read_are_named(tmp_path, name):
    save(tmp_path / "p" / "a.jpg")
    save(tmp_path / "p" / "sub" / "b.jpg")
    (tmp_path / "p" / name).write_bytes(b"x")
    with pytest.raises(StageError, match=f"{name} cannot be read.*convert to JPEG"):
        photo_files(tmp_path / "p")
