import signal
import struct
import sys

import cv2
import numpy as np
import pytest
from PIL import Image
from support.user_project import film

from scenefuse.core.stage import StageError, read_json, run, value
from scenefuse.photos.frames import (
    FrameSettings,
    VideoSettings,
    extract_frames,
    list_photos,
    original_sizes,
    sharpness,
    video_size,
)
from scenefuse.photos.photo_files import thin_out
from scenefuse.photos.photos import read_photos

SETTINGS = FrameSettings(frame_step=1, max_frames=0, max_width_px=64)
SHIPPED = VideoSettings()


def picture(width=64, height=48, seed=0):
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), dtype=np.uint8)


def folder_of(tmp_path, sizes, suffix=".png"):
    folder = tmp_path / "photos"
    folder.mkdir()
    for index, (width, height) in enumerate(sizes):
        Image.fromarray(picture(width, height, index)).save(folder / f"{index:02d}{suffix}")
    return folder


def extract(tmp_path, source, settings=SETTINGS):
    extract_frames(source=source, frames=tmp_path / "frames", photos=tmp_path / "photos.json", settings=settings)
    return read_photos(tmp_path / "photos.json"), read_json(tmp_path / "photos.json")


def test_narrow_photos_are_copied_and_wide_ones_scaled(tmp_path):
    folder = folder_of(tmp_path, [(64, 48), (128, 96), (32, 24)])
    photos, content = extract(tmp_path, folder)
    assert [(p.name, p.width, p.height) for p in photos] == [
        ("00.png", 64, 48),
        ("01.png", 64, 48),
        ("02.png", 32, 24),
    ]
    assert (tmp_path / "frames" / "00.png").read_bytes() == (folder / "00.png").read_bytes()
    assert original_sizes(content) == {"00.png": (64, 48), "01.png": (128, 96), "02.png": (32, 24)}
    assert value(content, "kind") == "photos"


def test_rotated_photos_are_stood_upright_and_keep_their_focal_length(tmp_path):
    folder = folder_of(tmp_path, [(60, 40)] * 3, ".jpg")
    exif = Image.Exif()
    exif[0x0112] = 6
    exif[0x8769] = {0xA405: 36}
    Image.fromarray(picture(60, 40)).save(folder / "00.jpg", exif=exif)
    photos, content = extract(tmp_path, folder)
    assert (photos[0].width, photos[0].height, photos[0].orientation) == (40, 60, 1)
    assert photos[0].focal_px == pytest.approx(60.0)
    assert original_sizes(content)["00.jpg"] == (40, 60)


@pytest.mark.parametrize("kind", ["RGB", "L", "I;16", "RGBA"])
def test_a_tiff_that_is_too_wide_is_scaled_and_keeps_its_place_and_focal_length(tmp_path, kind):
    folder = folder_of(tmp_path, [(64, 48)] * 2)
    exif = Image.Exif()
    exif[0x0112] = 8
    exif[0x8769] = {0xA405: 36}
    exif[0x8825] = {1: "N", 2: (47.0, 30.0, 0.0), 3: "E", 4: (8.0, 15.0, 0.0), 5: b"\x00", 6: 431.5}
    colours = picture(96, 200)
    pixels = colours[..., 0].astype(np.uint16) * 257 if kind == "I;16" else colours
    image = Image.fromarray(pixels) if kind == "I;16" else Image.fromarray(colours).convert(kind)
    image.save(folder / "wide.tif", exif=exif.tobytes())
    photos, content = extract(tmp_path, folder)
    wide = photos[-1]
    assert (wide.name, wide.width, wide.height, wide.orientation) == ("wide.tif", 64, 31, 1)
    assert (wide.latitude_deg, wide.longitude_deg, wide.altitude_m) == pytest.approx((47.5, 8.25, 431.5))
    assert wide.focal_px == pytest.approx(64.0) and original_sizes(content)["wide.tif"] == (200, 96)


def test_any_name_of_a_photo_serves(tmp_path):
    folder = folder_of(tmp_path, [(64, 48)] * 2)
    names = ["#1.png", "a {1} (2).png", "Übersicht Süd.png"]
    for index, name in enumerate(names):
        Image.fromarray(picture(seed=9 + index)).save(folder / name)
    assert {p.name for p in extract(tmp_path, folder)[0]} == {"00.png", "01.png", *names}


def test_a_photo_whose_folders_make_its_name_too_long_is_named(tmp_path, monkeypatch, capsys):
    names = ["a church in summer " * 5, "its western portal " * 5, "the figures above it " * 5]
    folder = tmp_path.joinpath("photos", *names)
    folder.mkdir(parents=True)
    Image.fromarray(picture()).save(folder / "1.png")
    monkeypatch.setattr(sys, "argv", ["extract_frames"])
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit):
        run(lambda: extract(tmp_path, tmp_path / "photos"))
    said = capsys.readouterr().err
    assert said.startswith("error: the name a church in") and "_1.png is too long; shorten it, or" in said


def test_step_and_limit(tmp_path):
    assert thin_out(10, 3, 0) == [0, 3, 6, 9]
    assert thin_out(101, 1, 3) == [0, 50, 100]
    assert thin_out(4, 1, 9) == [0, 1, 2, 3]
    folder = folder_of(tmp_path, [(64, 48)] * 9)
    photos, content = extract(tmp_path, folder, FrameSettings(frame_step=2, max_frames=3, max_width_px=64))
    assert [p.name for p in photos] == ["00.png", "04.png", "08.png"]
    assert value(content, "notes")[0].startswith("3 of 9 photos are used, spread evenly (object.frames.max_frames")


def test_the_sharpest_frame_of_each_window_of_a_video_is_kept(tmp_path):
    path = tmp_path / "walk.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (128, 96))
    sharp = {2, 5, 11, 12}
    for index in range(16):
        frame = cv2.resize(picture(32, 24, index), (128, 96), interpolation=cv2.INTER_NEAREST)
        video.write(frame if index in sharp else cv2.GaussianBlur(frame, (0, 0), 6.0))
    video.release()
    photos, content = extract(tmp_path, path, FrameSettings(frame_step=4, max_frames=0, max_width_px=64))
    assert value(content, "kind") == "video"
    origin = value(content, "origin")
    chosen = [origin[p.name]["frame"] for p in photos]
    # Windows 0 to 3, 4 to 7, 8 to 11, 12 to 15.
    assert chosen == [2, 5, 11, 12]
    assert (photos[0].width, photos[0].height) == (64, 48)
    assert original_sizes(content)[photos[0].name] == (128, 96)


def listed(tmp_path, source, settings=SHIPPED):
    list_photos(source=source, upright=tmp_path / "up", photos=tmp_path / "photos.json", settings=settings)
    return read_photos(tmp_path / "photos.json"), read_json(tmp_path / "photos.json")


def test_a_scene_s_video_gives_frames_of_its_size_with_the_positions_in_its_subtitles(tmp_path):
    photos, content = listed(tmp_path, film(tmp_path / "DJI_0001.MP4"), VideoSettings(max_frames=6))
    assert value(content, "kind") == "video" and len(photos) == 6 == value(content, "with_gps")
    frames = [value(content, "origin")[photo.name]["frame"] for photo in photos]
    assert frames == sorted(frames) and frames[-1] >= 10
    for frame, photo in zip(frames, photos):
        assert (photo.name, photo.width, photo.height) == (f"frame_{frame:06d}.jpg", 128, 96)
        place = (photo.latitude_deg, photo.longitude_deg, photo.altitude_m)
        assert place == pytest.approx((47.5, 8 + frame / 1e4, 400 + frame), abs=1e-6)
        assert (tmp_path / "up" / photo.name).is_file()
    (note,) = value(content, "notes")
    assert note.startswith("DJI_0001.SRT gives 6 of 6 positions (the first: latitude 47.50000, longitude 8.00000)")


def test_an_object_s_video_has_positions_too_and_without_subtitles_there_are_none(tmp_path):
    path = film(tmp_path / "orbit.mp4")
    photos, _ = extract(tmp_path, path)
    assert all(photo.has_gps for photo in photos) and photos[0].width == 64
    path.with_suffix(".SRT").write_bytes(b"\x00\xff")
    photos, content = listed(tmp_path, path)
    assert len(photos) == 12 and not any(photo.has_gps for photo in photos)
    assert value(content, "notes") == ["orbit.SRT beside the video gives no positions that can be read"]
    path.with_suffix(".SRT").unlink()
    assert value(listed(tmp_path, path)[1], "notes") == []


def test_a_video_that_was_filmed_upright_is_stood_upright(tmp_path):
    path = film(tmp_path / "phone.mp4")
    content = bytearray(path.read_bytes())
    # The matrix in the header of its track: a quarter turn, as phones write it.
    matrix = content.find(b"tkhd") + 44
    content[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, 96 << 16, 0, 1 << 30)
    path.write_bytes(content)
    assert video_size(path) == (12, 96, 128)
    assert {(photo.width, photo.height) for photo in listed(tmp_path, path)[0]} == {(96, 128)}


@pytest.mark.parametrize(("wide", "high", "size"), [(4, 3, (128, 72)), (8, 9, (114, 96)), (0, 1, (128, 96))])
def test_a_video_whose_pixels_are_not_square_gives_frames_whose_are(tmp_path, wide, high, size):
    path = film(tmp_path / "camcorder.mp4")
    content, box = bytearray(path.read_bytes()), struct.pack(">I4sII", 16, b"pasp", wide, high)
    entry = content.index(b"mp4v", content.index(b"stsd")) - 4
    end = entry + int.from_bytes(content[entry : entry + 4], "big")
    content[end:end] = box
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"mp4v"):
        at = content.index(name, content.index(b"moov")) - 4
        content[at : at + 4] = (int.from_bytes(content[at : at + 4], "big") + len(box)).to_bytes(4, "big")
    path.write_bytes(content)
    assert {(photo.width, photo.height) for photo in listed(tmp_path, path)[0]} == {size}


def test_a_video_that_is_cut_short_is_said_to_be(tmp_path):
    path = film(tmp_path / "orbit.avi")
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    photos, said = listed(tmp_path, path)
    assert 3 <= len(photos) < 12
    assert f"has 12 frames, {len(photos)} can be decoded: it may be cut" in " ".join(value(said, "notes"))


@pytest.mark.parametrize("version", [1, 2])
def test_a_video_that_is_a_panorama_is_refused(tmp_path, version):
    content = film(tmp_path / "insta.mp4").read_bytes()
    # As cameras of 360 degrees write it: in the track, or in the description of its pictures.
    said = bytes.fromhex("ffcc8263f8554a938814587a02521fdd") + b"<GSpherical:Spherical>true</GSpherical:Spherical>"
    box = b"uuid" + said if version == 1 else b"sv3d" + struct.pack(">I4s", 16, b"svhd") + bytes(8)
    box = struct.pack(">I", 4 + len(box)) + box
    moov = content.index(b"moov") - 4
    assert moov > content.index(b"mdat")
    size = int.from_bytes(content[moov : moov + 4], "big")
    path = tmp_path / "pano.mp4"
    path.write_bytes(
        content[:moov]
        + struct.pack(">I", size + len(box))
        + content[moov + 4 : moov + size]
        + box
        + content[moov + size :]
    )
    assert video_size(path) == video_size(tmp_path / "insta.mp4")
    with pytest.raises(StageError, match=r"the video .*pano\.mp4 is a panorama, to which no lens is fitted"):
        listed(tmp_path, path)


@pytest.mark.parametrize(
    ("name", "frames", "sentence"),
    [
        ("short.mp4", 2, r"the video .*short\.mp4 has 2 frames, at least 3 are needed"),
        ("broken.mp4", 0, r"the video .*broken\.mp4 cannot be decoded; convert it to H\.264"),
        ("notes.txt", 0, r"notes\.txt is neither a folder of photos nor a video"),
    ],
)
def test_a_scene_s_bad_video_is_one_sentence(tmp_path, name, frames, sentence):
    path = tmp_path / name
    film(path, frames) if frames else path.write_bytes(b"x" * 100)
    with pytest.raises(StageError, match=sentence):
        listed(tmp_path, path)
    assert not (tmp_path / "up").exists() and not (tmp_path / "photos.json").exists()


def test_blur_lowers_sharpness():
    frame = picture()
    assert sharpness(cv2.GaussianBlur(frame, (0, 0), 2.0)) < 0.2 * sharpness(frame)


def test_bad_sources(tmp_path):
    with pytest.raises(StageError, match="nowhere do not exist"):
        extract(tmp_path, tmp_path / "nowhere")
    (tmp_path / "list.txt").write_text("x")
    with pytest.raises(StageError, match="neither a folder of photos nor a video"):
        extract(tmp_path, tmp_path / "list.txt")
    (tmp_path / "broken.mp4").write_bytes(b"x" * 100)
    with pytest.raises(StageError, match=r"broken\.mp4 cannot be decoded"):
        extract(tmp_path, tmp_path / "broken.mp4")
    assert not (tmp_path / "frames").exists()


def test_too_few_frames_leave_nothing_behind(tmp_path):
    with pytest.raises(StageError, match="yields 2 frames, at least 3"):
        extract(tmp_path, folder_of(tmp_path, [(64, 48)] * 2))
    assert not (tmp_path / "frames").exists() and not (tmp_path / "photos.json").exists()


def test_frames_that_would_share_a_mask(tmp_path):
    folder = folder_of(tmp_path, [(64, 48)] * 3)
    Image.fromarray(picture()).save(folder / "00.bmp")
    with pytest.raises(StageError, match=r"00\.bmp and 00\.png in .* would share the mask 00\.png"):
        extract(tmp_path, folder)
