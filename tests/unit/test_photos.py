import hashlib
import os
import resource
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image, TiffImagePlugin

import scenefuse.photos.photo_files
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.photos.frames import VideoSettings, list_photos
from scenefuse.photos.photo_files import distinct_photos, photo_files, stored_size, upright_size
from scenefuse.photos.photos import check_unchanged, inspect_photo, read_photos, save_upright
from scenefuse.photos.pictures import read_gray, read_raw, read_rgb, write_depth, write_picture
from scenefuse.photos.positions import stated_position


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
    list_photos(source=folder, upright=tmp_path / "upright", photos=tmp_path / "photos.json", settings=VideoSettings())
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


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_all_bad_photos_are_named_at_once(tmp_path, kind):
    save(tmp_path / "p" / "a.jpg")
    for name in ("b.jpg", "c.jpg"):
        (tmp_path / "p" / name).write_text(f"<html>{name}")
    Image.fromarray(np.ones((9, 9), kind)).save(tmp_path / "p" / "d.tif")
    with pytest.raises(
        StageError, match=r"b.jpg cannot be decoded \(it is no picture, or of a format .*; nor can c.jpg, d.tif$"
    ):
        listed(tmp_path, tmp_path / "p")
    for name in ("b.jpg", "c.jpg"):
        (tmp_path / "p" / name).unlink()
    with pytest.raises(StageError, match="d.tif cannot be decoded .its pixels are 32-bit measurements"):
        listed(tmp_path, tmp_path / "p")


def test_all_empty_photos_are_named_at_once(tmp_path):
    save(tmp_path / "p" / "a.jpg")
    for name in ("b.jpg", "c.jpg"):
        (tmp_path / "p" / name).touch()
    with pytest.raises(StageError, match=r"b.jpg cannot be decoded .*; nor can c.jpg$"):
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


def test_smaller_and_edited_copies_of_a_shot_are_left_out_and_photos_of_a_rig_stay(tmp_path):
    def shot(name, size, when="2026:05:01 12:00:00", serial=""):
        exif = Image.Exif()
        exif[0x0110], exif[0x8769] = "Camera", {0x9003: when, 0xA431: serial} if when else {}
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size, (0, len(name), size[0])).save(tmp_path / name, exif=exif)

    for name, size in (("p/1.JPG", (40, 30)), ("p/web/1.jpg", (20, 15)), ("p/left/2.jpg", (40, 30))):
        shot(name, size)
    shot("p/right/2.jpg", (40, 30))
    shot("p/later/1.jpg", (20, 15), "2026:05:01 12:00:09")
    shot("p/undated/1.jpg", (20, 15), "")
    for number, when in ((4, "0000:00:00 00:00:00"), (5, "    :  :     :  :  ")):
        for name in (f"p/{number}.jpg", f"p/later/{number}.jpg"):
            shot(name, (40, 30), when, "A7")
    for name, serial in (("left/3.jpg", "A7"), ("left/edited/3.jpg", "A7"), ("right/3.jpg", "B2")):
        shot(f"p/{name}", (40, 30), serial=serial)
    names = [photo.name for photo in listed(tmp_path, tmp_path / "p")]
    there = "1.JPG 4.jpg 5.jpg later/1.jpg later/4.jpg later/5.jpg left/2.jpg left/3.jpg right/2.jpg right/3.jpg"
    assert " ".join(names) == f"{there} undated/1.jpg"
    notes = value(read_json(tmp_path / "photos.json"), "notes")
    assert "2 photos are other copies of the same shots" in notes[0] and "(left/edited/3.jpg of left/3.jpg)" in notes[0]


def test_edited_copies_in_a_photo_s_own_folder_are_left_out_and_photos_of_one_second_stay(tmp_path):
    def shot(name, fraction, size=(40, 30)):
        exif = Image.Exif()
        exif[0x0110], exif[0x8769] = "Phone", {0x9003: "2026:05:01 12:00:00", 0x9291: fraction}
        Image.new("RGB", size, (0, len(name), sum(name.encode()) % 256)).save(tmp_path / name, exif=exif)

    for name in ("IMG_1.JPG", "IMG_E1.JPG", "IMG_1-edited.jpg", "IMG_1-2.jpg"):
        shot(name, "123")
    shot("IMG_E2.JPG", "200", (30, 30))
    shot("IMG_2.JPG", "200")
    for name, fraction in (("12.00.jpg", "000"), ("12.00-1.jpg", "000"), ("12.00-2.jpg", "456"), ("12.01.jpg", "123")):
        shot(name, fraction)
    names, (note,) = distinct_photos(tmp_path)
    assert names == ["12.00-1.jpg", "12.00-2.jpg", "12.00.jpg", "12.01.jpg", "IMG_1.JPG", "IMG_2.JPG"]
    assert note.startswith("4 photos are other copies of the same shots")


@pytest.mark.parametrize("place", ["photos", "project/photos"])
def test_a_project_that_is_moved_finds_its_photos_as_its_table_does(tmp_path, monkeypatch, place):
    save(tmp_path / place / "a.jpg")
    monkeypatch.chdir(tmp_path)
    listed(Path("project"), Path(place) if place.startswith("project") else tmp_path / place)
    (tmp_path / "much/deeper").mkdir(parents=True)
    moved = Path("project").rename("much/deeper/project")
    assert (moved / "upright/a.jpg").is_symlink() and (moved / "upright/a.jpg").is_file()


def test_a_photo_that_was_replaced_or_removed_since_it_was_listed_is_named(tmp_path):
    folder = tmp_path / "p"
    for index in range(3):
        save(folder / f"{index}.png", shade=200 + index)
    photos = listed(tmp_path, folder)
    check_unchanged(tmp_path / "upright", photos)
    before = (folder / "1.png").stat()
    save(folder / "1.png", shade=100)
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


@pytest.mark.slow
def test_a_photo_of_200_megapixels_is_read_and_one_that_no_camera_takes_is_refused(tmp_path, monkeypatch):
    (tmp_path / "p").mkdir()
    Image.new("1", (20_000, 10_000)).save(tmp_path / "p" / "phone.png")
    assert inspect_photo(tmp_path / "p", "phone.png").width == 20_000
    monkeypatch.setattr(scenefuse.photos.photo_files, "MAX_PIXELS", 199_999_999)
    with pytest.raises(StageError, match=r"phone\.png cannot be decoded .*20000 x 10000 pixels are more than any"):
        inspect_photo(tmp_path / "p", "phone.png")


def test_missing_and_empty_folders(tmp_path):
    with pytest.raises(StageError, match="nowhere do not exist"):
        listed(tmp_path, tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "readme.txt").write_text("x")
    with pytest.raises(StageError, match=r"holds no photos.*1 other files were found\)$"):
        listed(tmp_path, tmp_path / "empty")


def test_only_what_is_a_photo_is_listed(tmp_path):
    folder = tmp_path / "p"
    save(folder / "b.JPG")
    save(folder / "sub" / "a.tif")
    save(folder / ".trash" / "old.jpg")
    for name in (".DS_Store", "Thumbs.db", "._b.JPG", "b.xmp", "b.DNG", "notes.txt"):
        (folder / name).write_bytes(b"x")
    for name in ("@eaDir/b.JPG/SYNOPHOTO_THUMB_M.jpg", "$RECYCLE.BIN/$R1.jpg", "sub/#recycle/old.jpg"):
        save(folder / name)
    assert photo_files(folder) == [folder / "b.JPG", folder / "sub" / "a.tif"]


@pytest.mark.parametrize(
    "mask",
    ["{}_mask.png", "{}.tif", "{}.JPG.mask.png", "masks/{}.png", "sub/Mask/{}.jpg", "mask_{}.JPG", "masks/{}_mask.png"],
)
def test_masks_among_photos_are_left_out_and_that_is_said(tmp_path, mask):
    folder = tmp_path / "p"
    for k, name in enumerate(("IMG_1", "IMG_2", "face_mask", "mask_7")):
        save(folder / f"{name}.JPG", (40, 30 + k))
        if k < 2:
            save(folder / mask.format(name), (40, 50 + k))
    names = [photo.name for photo in listed(tmp_path, folder)]
    assert names == ["IMG_1.JPG", "IMG_2.JPG", "face_mask.JPG", "mask_7.JPG"]
    notes = value(read_json(tmp_path / "photos.json"), "notes")
    assert any(note.startswith("2 pictures are masks or other bands of photos by their names, or") for note in notes)


@pytest.mark.parametrize("focal_35mm", [None, 24])
@pytest.mark.parametrize(
    ("name", "mode", "kind", "more"),
    [
        ("a.tif", "RGB", "TIFF", {"compression": "tiff_lzw"}),
        ("a.tif", "L", "TIFF", {"compression": "tiff_adobe_deflate"}),
        ("a.tif", "I;16", "TIFF", {"compression": "tiff_lzw"}),
        ("a.tif", "CMYK", "TIFF", {}),
        ("a.jpg", "CMYK", "JPEG", {}),
        ("a.jpg", "RGBA", "PNG", {}),
        ("a.jpg", "P", "PNG", {}),
        ("a.jpg", "RGB", "WEBP", {}),
        ("a.png", "LA", "PNG", {}),
    ],
)
def test_photos_of_all_modes_are_turned_and_made_smaller(tmp_path, name, mode, kind, more, focal_35mm):
    bright = np.full((30, 80), 200, np.uint8)
    picture = Image.fromarray(bright.astype(np.uint16) * 257) if mode == "I;16" else Image.fromarray(bright)
    exif = Image.Exif()
    exif[0x0112] = 6
    if focal_35mm and not more:  # Pillow writes no such EXIF into a compressed TIFF
        exif[0x8769] = {0xA405: focal_35mm}
    (tmp_path / "p").mkdir()
    picture = picture if mode in ("I;16", "L") else picture.convert("RGB").convert(mode)
    picture.save(tmp_path / "p" / name, kind, exif=exif.tobytes(), **more)
    found = save_upright(tmp_path / "p", inspect_photo(tmp_path / "p", name), tmp_path / name, max_width_px=15)
    assert (found.width, found.height) == (15, 40) and inspect_photo(tmp_path, name).orientation == 1
    assert read_rgb(tmp_path / name).mean() == pytest.approx(200, abs=3)
    assert pycolmap.Bitmap.read(tmp_path / name, True).width == 15


@pytest.mark.parametrize(
    ("photo", "bands"),
    [
        ("DJI_20240501120000_0001_V", ["DJI_20240501120001_0001_T"]),
        ("DJI_0001_W", ["thermal/DJI_0001_T"]),
        ("DJI_20200724102724_0001_ZOOM", ["DJI_20200724102723_0001_THRM"]),
        ("DJI_0001_D", ["DJI_0001_MS_G", "DJI_0001_MS_NIR"]),
        ("IMG_170101_0001_RGB", ["IMG_170101_0001_GRE", "IMG_170101_0001_REG"]),
    ],
)
def test_other_bands_of_a_photo_are_left_out_and_bands_alone_stay(tmp_path, photo, bands):
    folder, alone = tmp_path / "p", bands[0].replace("0001", "0002")
    for k, name in enumerate([photo, *bands, alone]):
        save(folder / f"{name}.JPG", (40, 30 + k))
    assert {found.name for found in listed(tmp_path, folder)} == {f"{photo}.JPG", f"{alone}.JPG"}
    notes = value(read_json(tmp_path / "photos.json"), "notes")
    assert any(f"{len(bands)} pictures are masks or other bands" in note for note in notes)


@pytest.mark.parametrize(
    ("mode", "size", "xmp", "sentence"),
    [
        ("RGB", (80, 40), b'GPano:ProjectionType="equirectangular"', "it is a panorama"),
        ("RGB", (130, 40), b"", "it is a panorama"),
        ("RGB", (118, 40), b'Camera:BandName="RGB"', ""),
        ("L", (60, 40), b'Camera:BandName="Red"', "it is one band of a multispectral camera"),
    ],
)
def test_panoramas_and_bands_are_named(tmp_path, mode, size, xmp, sentence):
    (tmp_path / "p").mkdir()
    Image.new(mode, size).save(tmp_path / "p" / "a.tif", tiffinfo={700: b"<x " + xmp + b"/>"})
    if sentence:
        with pytest.raises(StageError, match=f"a.tif cannot be decoded .{sentence}"):
            listed(tmp_path, tmp_path / "p")
    else:
        assert listed(tmp_path, tmp_path / "p")[0].width == size[0]


def test_a_panorama_of_an_iphone_is_named(tmp_path):
    exif = Image.Exif()
    exif[0x8769] = {0xA401: 6}
    Image.new("RGB", (100, 40)).save(tmp_path / "a.jpg", exif=exif)
    with pytest.raises(StageError, match="it is a panorama"):
        inspect_photo(tmp_path, "a.jpg")


def test_photos_in_symlinked_folders_are_found_once(tmp_path):
    save(tmp_path / "disk" / "card" / "a.jpg")
    (tmp_path / "p").mkdir()
    (tmp_path / "p" / "flight").symlink_to(tmp_path / "disk" / "card")
    (tmp_path / "disk" / "card" / "back").symlink_to(tmp_path / "p")
    assert photo_files(tmp_path / "p") == [tmp_path / "p" / "flight" / "a.jpg"]


@pytest.mark.parametrize("name", ["b.JPG", "flight"])
def test_links_to_photos_that_are_not_there_are_named(tmp_path, name):
    save(tmp_path / "p/a.jpg")
    (tmp_path / "p/notes.txt").symlink_to(tmp_path / "gone.txt")
    assert len(photo_files(tmp_path / "p")) == 1
    (tmp_path / "p" / name).symlink_to(tmp_path / "disk" / name)
    with pytest.raises(StageError, match=f"{name} is a link to what is not there; fetch that, or remove the link"):
        photo_files(tmp_path / "p")


@pytest.mark.parametrize("ending", ["jpe", "JFIF", "ppm"])
def test_photos_in_less_common_formats_are_read_by_all_who_read_photos(tmp_path, ending):
    name = f"a.{ending}"
    write_picture(tmp_path / name, np.full((30, 40, 3), (200, 100, 50), np.uint8))
    photo = inspect_photo(tmp_path, photo_files(tmp_path)[0].name)
    assert save_upright(tmp_path, replace(photo, orientation=6), tmp_path / f"b.{ending}").width == 40
    for path in (tmp_path / name, tmp_path / f"b.{ending}"):
        assert abs(read_rgb(path)[5, 5].astype(int) - [200, 100, 50]).max() <= 2
        assert pycolmap.Bitmap.read(path, True).width == 40


@pytest.mark.parametrize(
    "name", ["IMG_1.HEIC", "DJI_0001.DNG", "sub/shot.NEF", "c.hif", "c.MPO", "c.jp2", "c.gif", "c.insp", "c.tga"]
)
def test_photos_that_cannot_be_read_are_named(tmp_path, name):
    save(tmp_path / "p" / "a.jpg")
    save(tmp_path / "p" / "sub" / "b.jpg")
    (tmp_path / "p" / name).write_bytes(b"x")
    with pytest.raises(StageError, match=f"{name} cannot be read.*convert to JPEG"):
        photo_files(tmp_path / "p")


@pytest.mark.parametrize("form", ["WEBP", "GIF", "AVIF", "MPO"])
def test_photos_that_are_not_what_their_ending_says_are_read_by_colmap(tmp_path, form):
    (tmp_path / "p").mkdir()
    for name, blue in (("a.jpg", 50), ("b.png", 60)):
        Image.new("RGB", (40, 30), (200, 100, blue)).save(tmp_path / "p" / name, form)
    list_photos(
        source=tmp_path / "p", upright=tmp_path / "up", photos=tmp_path / "photos.json", settings=VideoSettings()
    )
    for name, blue in (("a.jpg", 50), ("b.png", 60)):
        pixels = pycolmap.Bitmap.read(tmp_path / "up" / name, True).to_array()
        assert np.abs(pixels[5, 5].astype(int) - [200, 100, blue]).max() <= 12
        assert (tmp_path / "up" / name).is_symlink() == (form == "MPO")


def test_heic_by_another_name_is_named(tmp_path):
    (tmp_path / "a.jpg").write_bytes(b"\0\0\0\x18ftypheic" + bytes(99))
    with pytest.raises(StageError, match=r"a.jpg cannot be decoded \(it is HEIC, whatever its ending: convert it"):
        inspect_photo(tmp_path, "a.jpg")


def test_a_jpeg_of_a_phone_that_holds_a_second_picture_is_read(tmp_path):
    picture = Image.new("RGB", (40, 30))
    picture.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[picture.resize((20, 15))])
    assert inspect_photo(tmp_path, "a.jpg").width == 40


R = TiffImagePlugin.IFDRational
NONE = R(0, 0)


@pytest.mark.parametrize(
    ("gps", "place", "note"),
    [
        ({1: "S", 2: (R(33), R(30), R(0)), 3: "W", 4: (R(70), R(15), R(0))}, (-33.5, -70.25), ""),
        ({1: "S", 2: (R(-33), R(-30), R(0)), 3: "E", 4: (R(70), R(15), R(0))}, (-33.5, 70.25), ""),
        ({2: (R(-33), R(30), R(0)), 3: "E", 4: (R(70), R(15), R(0))}, (-33.5, 70.25), ""),
        ({2: (R(2**32 - 33), R(30), R(0)), 3: "E", 4: (R(70), R(15), R(0))}, (-33.5, 70.25), ""),
        ({2: (R(2**32 - 335 * 10**6, 10**7),), 3: "E", 4: (R(70), R(15), R(0))}, (-33.5, 70.25), ""),
        ({1: "N", 2: (R(33), R(30), R(0)), 3: "E", 4: (R(70), R(14), R(3 * 10**9, 5 * 10**7))}, (33.5, 70.25), ""),
        ({1: "s", 2: (33.5,), 3: "west", 4: 70.25}, (-33.5, -70.25), ""),
        ({1: b"S\0", 2: (R(33), R(30)), 3: b"W\0", 4: (R(70), R(15))}, (-33.5, -70.25), ""),
        ({1: "N", 2: (R(33), R(30), NONE), 3: "E", 4: (R(70), R(15), R(1, 0))}, (33.5, 70.25), ""),
        ({1: "N", 2: "33,30,0", 3: "E", 4: "70 deg 15' 0.0\""}, (33.5, 70.25), ""),
        ({2: "33.5 S", 4: b"70.25W\0"}, (-33.5, -70.25), ""),
        ({1: "N", 2: "67/2", 3: "E", 4: "70/1 15/1 0/0"}, (33.5, 70.25), ""),
        ({1: "N", 2: (33.5, 0, 0), 3: "E", 4: (289.75, 0, 0)}, (33.5, -70.25), ""),
        ({2: (33.0, 30.0, 0.0), 4: (70.0, 15.0, 0.0)}, (33.5, 70.25), "hemisphere is not stated, north and east is"),
        ({1: "N", 2: (NONE, NONE, NONE), 3: "E", 4: (70.0, 15.0, 0.0)}, None, "latitude is missing or no number"),
        ({1: "N", 2: (33.0, 30.0, 0.0)}, None, "longitude is missing or no number"),
        ({1: "N", 2: (99.0, 0.0, 0.0), 3: "E", 4: (8.0, 0.0, 0.0)}, None, "99, 8 degrees lie nowhere on earth"),
        ({1: "N", 2: (0.0, 0.0, 0.0), 3: "E", 4: (0.0, 0.0, 0.0)}, None, "a receiver without a fix"),
        ({1: "N", 2: (float("nan"), 0.0, 0.0), 3: "E", 4: (8.0, 0.0, 0.0)}, None, "latitude is missing"),
        ({1: "N", 3: "E"}, None, ""),
    ],
)
def test_a_position_is_read_however_exif_writes_it(gps, place, note):
    position, said = stated_position(gps, b"")
    found = None if position.latitude_deg is None else (position.latitude_deg, position.longitude_deg)
    assert found == (place and pytest.approx(place)) and note in said and bool(note) == bool(said)


@pytest.mark.parametrize(
    ("altitude", "reference", "metres"),
    [
        (R(400), 0, 400),
        (R(400), b"\0", 400),
        (R(400), b"\1", -400),
        (R(400), 1, -400),
        (R(400), (1,), -400),
        (R(400), "1", -400),
        (R(400), b"1", -400),
        (R(-400), 1, -400),
        (R(-400), 0, -400),
        (R(2**32 - 400), None, -400),
        (R(4 * 10**9, 10**7), 0, 400),
        (R(400), b"\2", 400),
        (R(400), b"\3", -400),
        (R(400), None, 400),
        ("400.5 m", None, 400.5),
        (R(0, 0), 0, None),
        (float("inf"), 0, None),
        (None, 1, None),
    ],
)
def test_an_altitude_lies_below_zero_where_value_or_reference_say_so(altitude, reference, metres):
    gps = {1: "N", 2: (33.5,), 3: "E", 4: (70.25,), 5: reference, 6: altitude}
    assert stated_position(gps, b"")[0].altitude_m == metres


DJI = b'<a drone-dji:GpsLatitude="-33.5" drone-dji:GpsLongtitude="+70.25" drone-dji:AbsoluteAltitude="-12.5"/>'
XMP = b"<exif:GPSLatitude>33,30.0S</exif:GPSLatitude><exif:GPSLongitude>70,15,0E</exif:GPSLongitude>"
XMP += b"<exif:GPSAltitude>125/10</exif:GPSAltitude><exif:GPSAltitudeRef>1</exif:GPSAltitudeRef>"


@pytest.mark.parametrize("xmp", [DJI, XMP])
def test_where_exif_has_no_position_xmp_has(xmp):
    for gps in ({}, {2: (NONE,), 4: (NONE,)}, {2: (0.0,), 4: (0.0,), 6: R(0)}):
        position, note = stated_position(gps, xmp)
        assert (position.latitude_deg, position.longitude_deg, position.altitude_m) == (
            -33.5,
            70.25,
            -12.5,
        ) and not note
    for height in ({}, {6: R(0)}):
        position, _ = stated_position({1: "N", 2: (40.0,), 3: "W", 4: (3.0,)} | height, xmp)
        assert (position.latitude_deg, position.longitude_deg, position.altitude_m) == (40.0, -3.0, -12.5)


def test_unrounded_numbers_that_pillow_writes_into_exif_are_read_as_they_are(tmp_path):
    place, exif = (50.120456, 8.731987, 147.4228664), Image.Exif()
    sexagesimal = [(v // 1, v * 60 // 1 % 60, v * 3600 % 60) for v in place[:2]]
    exif[0x8825] = {1: "N", 2: sexagesimal[0], 3: "E", 4: sexagesimal[1], 5: b"\0", 6: place[2]}
    exif[0x8769] = {0x920A: 8.7654321012}
    Image.new("RGB", (40, 30)).save(tmp_path / "a.jpg", exif=exif)
    photo = inspect_photo(tmp_path, "a.jpg")
    assert (photo.latitude_deg, photo.longitude_deg, photo.altitude_m) == pytest.approx(place, rel=1e-9)
    assert photo.focal_mm == pytest.approx(8.7654321012)


def test_why_a_photo_has_no_position_is_said(tmp_path):
    save(tmp_path / "p" / "a.jpg", gps={1: "N", 2: (99.0, 0.0, 0.0), 3: "E", 4: (8.0, 0.0, 0.0)})
    listed(tmp_path, tmp_path / "p")
    said = "the GPS positions of 1 photos: 99, 8 degrees lie nowhere on earth (of a.jpg, for one)"
    assert value(read_json(tmp_path / "photos.json"), "notes") == [said]


@pytest.mark.parametrize("form", ["grey tif", "colour png", "dark jpg"])
def test_photos_of_12_bits_and_dark_ones_are_stretched_and_that_is_said(tmp_path, form):
    folder, rng = tmp_path / "p", np.random.default_rng(0)
    folder.mkdir()
    for k in range(2):
        if form == "dark jpg":
            pixels = rng.integers(4, 12, (40, 60, 1)).astype(np.uint8).repeat(8, 0).repeat(8, 1).repeat(3, 2)
            Image.fromarray(pixels).save(folder / f"{k}.jpg", quality=98)
            expected = pixels.astype(np.float64) * 16
        else:
            pixels = rng.integers(50, 4096 >> k, (64, 96, 3)[: 2 if "grey" in form else 3]).astype(np.uint16)
            cv2.imwrite(str(folder / f"{k}.{form[-3:]}"), pixels[..., ::-1] if pixels.ndim == 3 else pixels)
            expected = pixels / 16
    photos = listed(tmp_path, folder)
    assert "pixels are 16 times as bright here" in value(read_json(tmp_path / "photos.json"), "notes")[-1]
    with Image.open(tmp_path / "upright" / photos[1].name) as seen:
        assert np.abs(np.asarray(seen) - expected.astype(np.float64)).mean() < 2
    check_unchanged(tmp_path / "upright", photos)


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_a_tiff_of_12_bits_in_16_is_turned_once(tmp_path, orientation):
    pixels = np.random.default_rng(0).integers(50, 4096, (3, 5, 3)).astype("<u2").repeat(8, 0).repeat(8, 1)
    height, width, at = *pixels.shape[:2], 8 + pixels.nbytes
    tags = [(256, 3, 1, width), (257, 3, 1, height), (258, 3, 3, at), (259, 3, 1, 1), (262, 3, 1, 2), (273, 4, 1, 8)]
    tags += [(274, 3, 1, orientation), (277, 3, 1, 3), (278, 3, 1, height), (279, 4, 1, pixels.nbytes)]
    end = struct.pack("<4H", 16, 16, 16, len(tags)) + b"".join(struct.pack("<HHII", *tag) for tag in tags) + bytes(4)
    (tmp_path / "p").mkdir()
    (tmp_path / "p/a.tif").write_bytes(b"II*\0" + struct.pack("<I", at + 6) + pixels.tobytes() + end)
    assert np.array_equal(read_raw(tmp_path / "p/a.tif")[..., ::-1], pixels)  # as stored
    (photo,) = listed(tmp_path, tmp_path / "p")
    seen = np.rot90(pixels, {1: 0, 3: 2, 6: -1}[orientation]) / 16
    assert (photo.height, photo.width) == seen.shape[:2]
    assert np.abs(read_rgb(tmp_path / "upright/a.tif") - seen).max() <= 1


def test_a_photo_whose_exif_is_odd_keeps_its_place_when_it_is_turned(tmp_path):
    exif = Image.Exif()
    exif[0x0112], exif[0x8769] = 6, {0xA405: 24}
    exif[0x8825] = {1: "N", 2: (33.5,), 3: "e", 4: (70.0, 15.0)}
    (tmp_path / "p").mkdir()
    Image.new("RGB", (72, 36), (99, 99, 99)).save(tmp_path / "p" / "--help.jpg", exif=exif)
    (photo,) = listed(tmp_path, tmp_path / "p")
    assert (photo.width, photo.height, photo.latitude_deg, photo.longitude_deg) == (36, 72, 33.5, 70.25)
    assert photo.focal_px == pytest.approx(48.0) and photo.focal_mm is None
    with Image.open(tmp_path / "upright/--help.jpg") as upright:
        assert upright.getexif().get_ifd(0x8769)[0xA405] == 24


def bomb(path):
    """A PNG that claims 10^9 pixels."""
    size = struct.pack(">IIBBBBB", 50_000, 20_000, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", size), (b"IDAT", zlib.compress(b"\0" * 100)), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n")
    with path.open("ab") as file:
        for kind, data in chunks:
            file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))


def test_a_picture_that_claims_a_billion_pixels_is_refused_before_it_is_decoded(tmp_path):
    (tmp_path / "p").mkdir()
    bomb(tmp_path / "p" / "bomb.png")
    for read in (upright_size, stored_size, read_gray, read_raw, lambda path: inspect_photo(path.parent, path.name)):
        with pytest.raises(StageError, match="bomb.png .*pixels"):
            read(tmp_path / "p" / "bomb.png")


@pytest.mark.parametrize(("write", "ending"), [(write_picture, "png"), (write_picture, "jpg"), (write_depth, "bin")])
def test_a_picture_or_map_that_does_not_fit_on_the_disk_is_an_error(tmp_path, write, ending):
    # OpenCV and COLMAP leave a file of which the end is missing, and say nothing.
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (40, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):
            write(tmp_path / f"a.{ending}", np.zeros((8, 8), dtype=np.uint8))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
