"""Positions in the subtitles beside a drone's video, in the forms in which drones write them."""

import numpy as np
import pytest

from scenefuse.photos.photo_files import subtitles
from scenefuse.photos.subtitles import positions_in_subtitles

# The place of all samples: latitude, longitude.
PLACE = (50.1102, 8.6101)


def block(start_s, end_s, text):
    return f"1\n00:00:{start_s:06.3f} --> 00:00:{end_s:06.3f}\n{text}\n\n".replace(".", ",", 2)


def read(tmp_path, text, seconds=(0.0,)):
    path = tmp_path / "DJI_0001.SRT"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return positions_in_subtitles(path, seconds)


@pytest.mark.parametrize(
    ("text", "altitude_m", "relative"),
    [
        # Mavic 3, Mini 3 to 5, Air 3: with an absolute and a relative height.
        (
            '<font size="28">FrameCnt: 1, DiffTime: 33ms\n2024-08-07 12:34:24.380\n[iso: 100] [focal_len: 24.00]'
            " [dzoom_ratio: 10000, delta:0],[latitude: 50.1102] [longitude: 8.6101] [rel_alt: 10.200 abs_alt: 120.300]"
            " [ct: 5310] </font>",
            120.3,
            False,
        ),
        ("[latitude: 50.1102] [longitude: 8.6101] [rel_alt: -1.500]", -1.5, True),
        # Mavic 2 and Phantom misspell the longitude; some write no height.
        ("[iso : 100] [latitude : 50.1102] [longtitude : 8.6101] [altitude: 274.239014] </font>", 274.239014, False),
        ("[LATITUDE : 50.1102] [LONGTITUDE : 8.6101]", None, False),
        ("[latitude: 50,1102] [longitude: 8,6101] [rel_alt: 1,3 abs_alt: 132,86]", 132.86, False),
        # A Mavic Air 2 writes radians.
        ("[latitude: 0.87458797] [longitude: 0.15027459] [altitude: 9.0]", 9.0, False),
        # Mavic Pro, Phantom 4: longitude first, then the number of satellites; the height is the barometer's.
        ("HOME(8.7,50.2) 2017.07.29 15:18:50\nGPS(8.6101,50.1102,14) BAROMETER:8.8\nISO:100", 8.8, True),
        ("GPS(8.6101,50.1102,14) Hb:1.9 Hs:2.0", 1.9, True),
        ("F/2.8, SS 60, ISO 100, GPS (8.6101, 50.1102, 10), D 2.80m, H 3.50m, H.S 0.10m/s, V.S 0.00m/s", 3.5, True),
        ("RTK (8.6101, 50.1102, 28), HOME (8.7, 50.2, 103.55m), D 75.36m, H 76.19m, H.S 0.30m/s", 76.19, True),
        ("Af Rect(X:0, Y:0, W:0, H:0) GPS (8.6101, 50.1102, 15), D 0.61m, H 1.00m, H.S 0.00m/s", 1.0, True),
        # Matrice 300: latitude first, and no altitude.
        ("2022.06.21 16:06:24\nGPS(50.1102,8.6101,0.0M) BAROMETER:17.7M", 17.7, True),
        # Autel.
        ("HOME(E: 8.7, N: 50.2) 2022-01-01 10:00:00\nGPS(E: 8.6101, N: 50.1102, 174.21m)", 174.21, False),
    ],
)
def test_a_position_is_read_in_every_form(tmp_path, text, altitude_m, relative):
    (found,), note = read(tmp_path, block(0, 1, text))
    assert (found.latitude_deg, found.longitude_deg) == pytest.approx(PLACE, abs=1e-6)
    assert found.altitude_m == pytest.approx(altitude_m)
    assert ("its heights are above take-off, not the sea" in note) == relative
    assert note.startswith("DJI_0001.SRT gives 1 of 1 positions (the first: latitude 50.11020, longitude 8.61010)")


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("GPS(-58.8517,-34.2379,15)", (-34.2379, -58.8517)),
        ("GPS(W: 97.1095, N: 32.5937, 174.2m)", (32.5937, -97.1095)),
        ("GPS(W: -97.1095, S: -32.5937, 174.2m)", (-32.5937, -97.1095)),
        # No latitude is above 90 degrees.
        ("GPS(39.9062,116.3913,69)", (39.9062, 116.3913)),
        ("GPS(116.3913,39.9062,14)", (39.9062, 116.3913)),
        ("[latitude: -22.72] [longitude: -47.60]", (-22.72, -47.60)),
    ],
)
def test_hemispheres_and_order(tmp_path, text, place):
    (found,), _ = read(tmp_path, block(0, 1, text))
    assert (found.latitude_deg, found.longitude_deg) == pytest.approx(place)


def frames(fix_hz, seconds=4, decimals=7, speed=1e-4):
    """A block for each frame of a flight north, of whose positions a receiver gives so many a second."""
    held = (np.floor(k / 30 * fix_hz) / fix_hz for k in range(30 * seconds))
    lines = (
        f"[latitude: {50 + speed * t:.{decimals}f}] [longitude: 8.0] [rel_alt: 1 abs_alt: {100 + t}]" for t in held
    )
    return "".join(block(k / 30, (k + 1) / 30, line) for k, line in enumerate(lines))


@pytest.mark.parametrize("fix_hz", [1, 10, 30])
def test_between_two_fixes_a_position_is_interpolated(tmp_path, fix_hz):
    """A drone of 11 m/s: a fix that is held for a second would be up to 11 m off."""
    at = np.arange(0, 3.0, 0.21)
    found, _ = read(tmp_path, frames(fix_hz), at)
    assert [p.latitude_deg for p in found] == pytest.approx(50 + 1e-4 * at, abs=1e-6)
    assert [p.altitude_m for p in found] == pytest.approx(100 + at, abs=0.01)


def test_a_block_for_each_second_is_interpolated_too(tmp_path):
    text = "".join(block(k, k + 1, f"GPS(8.0000,{50 + k * 1e-4:.4f},12) BAROMETER:{k}.0") for k in range(1, 60))
    found, note = read(tmp_path, text, [0.5, 1.0, 2.5, 59.9, 61.0])
    assert [p.latitude_deg for p in found[1:-1]] == pytest.approx([50.0001, 50.00025, 50.0059])
    assert not found[0].latitude_deg and not found[-1].latitude_deg
    assert "gives 3 of 5 positions" in note and "ends after 60 s; the last frame is of 61 s" in note


def test_where_there_is_no_fix_there_is_no_position(tmp_path):
    none = "[latitude: 0.000000] [longitude: 0.000000] [rel_alt: 1.0 abs_alt: 20.0]"
    there = "[latitude: 50.000000] [longitude: 8.000000] [rel_alt: 1.0 abs_alt: 20.0]"
    text = "".join(block(k, k + 1, line) for k, line in enumerate([none, there, none, there, "[latitude: 95.5]"]))
    found, _ = read(tmp_path, text, [0.5, 1.5, 2.5, 3.5, 4.5])
    assert [p.latitude_deg for p in found] == [None, 50.0, None, 50.0, None]
    assert [p.altitude_m for p in found] == [None, 20.0, None, 20.0, None]
    assert read(tmp_path, block(0, 1, none))[1] == "DJI_0001.SRT beside the video gives no positions that can be read"


@pytest.mark.parametrize(
    "text",
    [b"", b"\xff\xfe\x00" * 50, "1\n00:00:01,000 --> 00:00:03,000\nHello!\n", "GPS(8.0,50.0,12)", "GPS(.-,--,1)"],
)
def test_what_is_no_flight_s_subtitles_gives_a_note(tmp_path, text):
    found, note = read(tmp_path, text, [0.0, 1.0])
    assert [p.latitude_deg for p in found] == [None, None] and "gives no positions that can be read" in note


def test_subtitles_are_found_beside_a_video_in_any_case(tmp_path):
    for name in ("DJI_0001.MP4", "dji_0001.Srt", "DJI_0002.SRT", "notes.txt", "notes.srt"):
        (tmp_path / name).touch()
    assert subtitles(tmp_path / "DJI_0001.MP4") == tmp_path / "dji_0001.Srt"
    assert subtitles(tmp_path / "notes.txt") is None and subtitles(tmp_path / "DJI_0002.MP4") is None
