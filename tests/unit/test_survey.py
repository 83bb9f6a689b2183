"""Control and check points, positions with their accuracy, and the adjustment to both, against a planted truth."""

import contextlib
import csv
from dataclasses import replace

import numpy as np
import pycolmap
import pyproj
import pytest
from PIL import Image
from PIL.ExifTags import IFD, Base
from support.surveyed import FRAME, fly, gcp_lines, write_inputs

from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.georef.control import LocatedPoint, SurveyedPoint, read_control
from scenefuse.georef.georeference import camera_poses, georegister
from scenefuse.georef.placement import GeoreferenceSettings, place_by_control
from scenefuse.marks.triangulation import read_lengths
from scenefuse.photos.frames import VideoSettings, list_photos
from scenefuse.photos.geodesy import frame_notes, scene_frame
from scenefuse.photos.photos import gps_accuracies, read_photos
from scenefuse.photos.positions import Position, positions_of, read_geo
from scenefuse.sfm.mapping import in_metres

FLIGHT = fly()
PLACES = np.array(
    [[-30, -20, 1], [30, -20, 0.5], [28, 20, -1], [-28, 22, 2], [0, 0, 0], [12, -12, 1.5], [-15, 8, 1], [10, 14, 0.0]]
)
NAMES = ["a", "b", "c", "d", "e", "f", "CHK-1", "chk-2"]


@pytest.fixture(scope="module")
def model():
    return FLIGHT.model()


def georeferenced(folder, model, photos, lines=None, lengths=None):
    """Run the stage; its report, the model, and the lines of residuals.tsv by name."""
    folder.mkdir(exist_ok=True)
    write_inputs(folder, model, photos)
    control = None
    if lines is not None:
        control = folder / "gcp_list.txt"
        control.write_text("\n".join(lines) + "\n")
    georegister(
        sparse=folder / "sparse",
        sparse_json=folder / "sparse.json",
        photos=folder / "photos.json",
        control=control,
        lengths=lengths,
        georeferenced=folder / "georeferenced",
        residuals=folder / "residuals.tsv",
        report=folder / "georeference.json",
        settings=GeoreferenceSettings(),
        seed=0,
    )
    with open(folder / "residuals.tsv") as file:
        rows = {row["name"]: row for row in csv.DictReader(file, delimiter="\t")}
    return read_json(folder / "georeference.json"), pycolmap.Reconstruction(folder / "georeferenced"), rows


def without_gps():
    return [replace(p, latitude_deg=None, longitude_deg=None, altitude_m=None) for p in FLIGHT.photos()]


def changed(lines, ending, column, change):
    """Lines of a point with one column changed, a function of the number there."""
    found = []
    for line in lines:
        cells = line.split("\t")
        if cells[-1] == ending:
            cells[column] = f"{change(float(cells[column])):.12g}"
        found.append("\t".join(cells))
    return found


def moved(view, shift):
    """A view from a place beside its own."""
    pose = view.cam_from_world.copy()
    pose[:3, 3] -= pose[:3, :3] @ shift
    return replace(view, cam_from_world=pose)


def off(report, model):
    """(N,) distances of camera centres from the true ones, in metres."""
    names, _, centres = camera_poses(model)
    assert names == FLIGHT.names
    return np.linalg.norm(centres - scene_frame(report).apply(FRAME.inverse(FLIGHT.centres)), axis=1)


def test_control_points_give_metres_and_check_points_are_only_measured(tmp_path, model):
    lines = gcp_lines(FLIGHT, PLACES, NAMES, noise_px=0.3)
    report, found, rows = georeferenced(tmp_path / "a", model, without_gps(), lines)
    assert value(report, "status") == "georeferenced" and value(report, "crs") == "EPSG:32632"
    assert (value(report, "control_points"), value(report, "check_points")) == (6, 2)
    # A pixel is 9 cm on the ground.
    assert value(report, "check_rms_horizontal_m") < 0.05 and value(report, "check_rms_vertical_m") < 0.1
    assert off(report, found).max() < 0.4
    assert (rows["a"]["kind"], rows["a"]["used"]) == ("control point", "yes")
    assert rows["CHK-1"]["kind"] == rows["chk-2"]["kind"] == "check point" and rows["chk-2"]["used"] == "no"
    again, same, _ = georeferenced(tmp_path / "b", model, without_gps(), changed(lines, "CHK-1", 2, lambda z: z + 5))
    apart = scene_frame(again).inverse(camera_poses(same)[2]) - scene_frame(report).inverse(camera_poses(found)[2])
    np.testing.assert_allclose(apart, 0, atol=1e-6)
    assert value(again, "check_rms_vertical_m") == pytest.approx(5 / np.sqrt(2), abs=0.1)


def test_check_points_alone_measure_what_rtk_positions_place(tmp_path, model):
    lines = gcp_lines(FLIGHT, PLACES, [f"CHK-{name}" for name in "abcdefgh"], noise_px=0.3)
    exact = FLIGHT.photos(noise_m=0.02, sd_m=0.02, seed=1)
    report, found, rows = georeferenced(tmp_path / "a", model, exact, lines)
    alone, same, _ = georeferenced(tmp_path / "b", model, exact)
    assert (value(report, "control_points"), value(report, "check_points")) == (0, 8)
    assert value(report, "check_rms_horizontal_m") < 0.05 and value(report, "check_rms_vertical_m") < 0.1
    assert {row["used"] for name, row in rows.items() if name.startswith("CHK")} == {"no"}
    np.testing.assert_allclose(camera_poses(found)[2], camera_poses(same)[2], atol=1e-9)
    assert value(report, "up_cue") == value(alone, "up_cue") == "GPS"
    with pytest.raises(StageError, match="check points .* alone, and nothing else places .*: 0 registered photos have"):
        georeferenced(tmp_path / "c", model, without_gps(), lines)


def test_points_with_larger_stated_deviations_weigh_less(tmp_path, model):
    right = gcp_lines(FLIGHT, PLACES, NAMES)
    high = changed(right, "e", 2, lambda z: z + 0.4)
    up_m = {}
    for name, lines, sd in (("right", right, "0.02"), ("trusted", high, "0.02"), ("rough", high, "1.0")):
        stated = [f"{line}\t{sd}\t{sd}" if line.endswith("\te") else line for line in lines]
        rows = georeferenced(tmp_path / name, model, without_gps(), stated)[2]
        up_m[name] = {point: float(rows[point]["up_m"]) for point in "abcdef"}
    moved = {name: max(abs(up_m[name][p] - up_m["right"][p]) for p in "abcdf") for name in up_m}
    assert up_m["rough"]["e"] == pytest.approx(up_m["right"]["e"] - 0.4, abs=0.02)
    assert moved["rough"] < moved["trusted"] / 2


def test_rtk_positions_straighten_a_model_that_a_wrong_lens_bent(tmp_path):
    bent = FLIGHT.model(off_centre_px=3.0)
    exact = FLIGHT.photos(noise_m=0.02, sd_m=0.02, seed=1)
    silent = [replace(photo, horizontal_sd_m=None, vertical_sd_m=None) for photo in exact]
    rough_report, rough, _ = georeferenced(tmp_path / "rough", bent, silent)
    report, found, rows = georeferenced(tmp_path / "rtk", bent, exact)
    assert off(rough_report, rough).max() > 3 * off(report, found).max()
    assert off(report, found).max() < 0.1
    assert value(report, "adjusted_to_positions") == 24 and rows["00.jpg"]["horizontal_sd_m"] == "0.0200"


def test_a_wild_rtk_position_is_named_and_harmless(tmp_path, model):
    photos = FLIGHT.photos(noise_m=0.02, sd_m=0.02)
    wild = FRAME.inverse(FLIGHT.centres[5:6] + [0, 60, 0])[0].tolist()
    photos[5] = replace(photos[5], latitude_deg=wild[0], longitude_deg=wild[1])
    report, found, rows = georeferenced(tmp_path, model, photos)
    assert value(report, "gps_outliers") == ["05.jpg"] and rows["05.jpg"]["used"] == "no"
    assert off(report, found).max() < 0.2


def test_identical_positions_give_no_metre(tmp_path, model):
    one = FLIGHT.photos(sd_m=0.02)[0]
    photos = [replace(one, name=photo.name) for photo in FLIGHT.photos()]
    report, _, rows = georeferenced(tmp_path, model, photos)
    assert value(report, "status") == "upright" and "spread over 0.0 m" in value(report, "reason")
    assert rows == {} and value(report, "length_unit") == "scene units"


def test_identical_positions_say_nothing_beside_control_points(tmp_path, model):
    photos = [replace(FLIGHT.photos()[0], name=name) for name in FLIGHT.names]
    report, found, rows = georeferenced(tmp_path, model, photos, gcp_lines(FLIGHT, PLACES, NAMES, noise_px=0.3))
    assert value(report, "adjusted_to_positions") == 0 and rows["00.jpg"]["used"] == "no"
    assert off(report, found).max() < 0.4


def test_heights_of_zero_throughout_are_unknown(tmp_path):
    heights = np.where(np.arange(24) % 2, 30.0, 0.0)  # as along a facade, up and down
    flight = replace(FLIGHT, views=[moved(view, [0, 0, h]) for view, h in zip(FLIGHT.views, heights)])
    photos = [replace(photo, altitude_m=0.0) for photo in flight.photos()]
    report, found, _ = georeferenced(tmp_path, flight.model(), photos)
    assert value(report, "heights") == "relative"
    centres = camera_poses(found)[2]
    assert np.ptp(centres[:, 2]) == pytest.approx(np.ptp(flight.centres[:, 2]), rel=0.02)


def test_a_height_of_zero_beside_others_is_unknown(tmp_path, model):
    photos = [replace(photo, altitude_m=0.0) if k % 5 else photo for k, photo in enumerate(FLIGHT.photos(0.5))]
    report, _, _ = georeferenced(tmp_path, model, photos)
    assert (value(report, "heights"), value(report, "gps_outliers")) == ("measured", [])
    assert value(report, "origin_altitude_m") == pytest.approx(490, abs=2) and "19 of them" in value(report, "reason")


def test_positions_along_one_line_do_not_tilt_the_model(tmp_path, model):
    in_line = [p if k // 6 == 1 else replace(p, latitude_deg=None) for k, p in enumerate(FLIGHT.photos(noise_m=0.5))]
    report, _, _ = georeferenced(tmp_path, model, in_line)
    assert "adjusted_to_positions" not in report and "levelled by the cameras" in value(report, "reason")


def test_gps_of_another_datum_beside_control_points_is_shifted_and_helps(tmp_path, model):
    lines = gcp_lines(FLIGHT, PLACES, NAMES)
    photos = [replace(p, altitude_m=p.altitude_m + 47.0) for p in FLIGHT.photos(noise_m=0.02, sd_m=0.02)]
    report, found, rows = georeferenced(tmp_path, model, photos, lines)
    assert value(report, "gps_shift")[2] == pytest.approx(47.0, abs=0.2)
    # The shift is as uncertain as the control points and the focal length make it; beside it the cameras are right.
    apart = camera_poses(found)[2] - scene_frame(report).apply(FRAME.inverse(FLIGHT.centres))
    assert np.linalg.norm(apart - apart.mean(0), axis=1).max() < 0.1
    assert value(report, "check_rms_horizontal_m") < 0.05 and off(report, found).max() < 0.4
    assert rows["00.jpg"]["kind"] == "position" and abs(float(rows["00.jpg"]["up_m"])) < 0.1


def test_a_gross_click_is_named_with_its_photo_and_left_out(tmp_path, model, capsys):
    lines = gcp_lines(FLIGHT, PLACES, NAMES)
    row = next(k for k, line in enumerate(lines) if line.endswith("\tc"))
    cells = lines[row].split("\t")
    lines[row] = "\t".join([*cells[:3], f"{float(cells[3]) - 120:.2f}", *cells[4:]])
    report, found, rows = georeferenced(tmp_path, model, without_gps(), lines)
    (note,) = value(report, "control_notes")
    assert note.startswith(f"c: the click in {cells[5]} is 1") and "px off" in note and note in capsys.readouterr().out
    assert rows["c"]["used"] == "yes" and rows["c"]["photos"] == "4"
    assert off(report, found).max() < 0.4


def test_a_point_with_wrong_coordinates_is_left_out_and_named(tmp_path, model):
    lines = changed(gcp_lines(FLIGHT, PLACES, NAMES), "d", 0, lambda x: x + 30)
    report, found, rows = georeferenced(tmp_path, model, without_gps(), lines)
    (note,) = value(report, "control_notes")
    assert note.startswith("d is left out") and "30" in note and rows["d"]["used"] == "no"
    assert value(report, "control_points") == 5 and off(report, found).max() < 0.4


def test_one_wrong_point_beside_exact_positions_moves_nothing(tmp_path, model):
    lines = changed(gcp_lines(FLIGHT, PLACES, NAMES), "c", 0, lambda x: x + 3)
    photos = [replace(p, altitude_m=p.altitude_m + 47.0) for p in FLIGHT.photos(noise_m=0.02, sd_m=0.02)]
    report, _, _ = georeferenced(tmp_path, model, photos, lines)
    (note,) = value(report, "control_notes")
    assert note.startswith("1 of 6 control points") and "c (" in note
    assert value(report, "check_rms_horizontal_m") < 0.06 and value(report, "check_rms_vertical_m") < 0.06
    assert abs(value(report, "gps_shift")[0]) < 0.1


def test_photos_whose_names_are_written_in_parts_are_found_by_their_points(tmp_path):
    model, apart = FLIGHT.model(), {"00.jpg": "Ho\u0308he.jpg"}
    for image in model.images.values():
        image.name = apart.get(image.name, image.name)
    photos = [replace(p, name=apart.get(p.name, p.name)) for p in without_gps()]
    lines = [line.replace("00.jpg", "H\u00f6he.jpg") for line in gcp_lines(FLIGHT, PLACES, NAMES, most=30)]
    assert any("H\u00f6he.jpg" in line for line in lines)
    report, found, _ = georeferenced(tmp_path, model, photos, lines)
    assert value(report, "control_points") == 6 and value(report, "check_rms_horizontal_m") < 0.05
    places = {"H\u00f6he.jpg": Position(47.0, 8.0, 400.0)}
    assert positions_of(["Ho\u0308he.jpg", "01.jpg"], places, tmp_path)[0]["latitude_deg"] == 47.0


def test_points_that_are_too_far_off_for_what_is_stated_are_named_the_worst_first(tmp_path, model, capsys):
    lines = changed(gcp_lines(FLIGHT, PLACES, NAMES), "e", 2, lambda z: z + 2)
    (note,) = value(georeferenced(tmp_path, model, without_gps(), lines)[0], "control_notes")
    assert "stated standard deviations off, in metres: e (" in note and note in capsys.readouterr().out


def test_heights_may_be_unknown_and_the_crs_may_have_a_vertical_part(tmp_path, model):
    lines = gcp_lines(FLIGHT, PLACES, NAMES, crs="EPSG:25832")
    lines = ["EPSG:25832+7837", *changed(lines[1:], "e", 2, lambda z: np.nan)]
    lines = changed(lines, "e", 0, lambda x: x + 1)
    report, _, rows = georeferenced(tmp_path, model, without_gps(), lines)
    assert rows["e"]["up_m"] == "" and rows["e"]["used"] == "yes"
    assert any(" north);" in note for note in value(report, "control_notes"))
    crs = pyproj.CRS.from_user_input(value(report, "crs"))
    assert crs.is_compound and "DHHN2016" in crs.name
    place = scene_frame(report).in_crs(scene_frame(report).apply(FRAME.inverse(PLACES[:1])))[0]
    np.testing.assert_allclose(place, [float(c) for c in lines[1].split("\t")[:3]], atol=1e-3)


@pytest.mark.parametrize(
    ("known", "notes"),
    [
        ({}, ["x y z: scene units in a local frame"]),
        ({"length_unit": "m"}, ["x y z: metres in a local frame"]),
        (
            {"length_unit": "m", "origin_in_crs": [4e5, 5e6, 0.5], "crs": None},
            ["x y z: metres, less 400000 5000000 0.5 in the coordinates of the given cloud"],
        ),
        (
            {"length_unit": "m", "origin_in_crs": [4e5, 5e6, 0.5], "crs": "EPSG:25832", "origin_latitude_deg": 47.5}
            | {"origin_altitude_m": 470.0},
            [
                "x y z: metres east, north, up of 400000 5000000 0.5 in ETRS89 / UTM zone 32N (EPSG:25832)",
                "heights: as the photos' GPS gives them, which does not say whether above the ellipsoid or the sea",
                "into the CRS: not by adding the origin, for the grid's north is another; completed.copc.laz is in it",
            ],
        ),
    ],
)
def test_a_frame_is_described_in_a_few_lines(tmp_path, known, notes):
    write_json(tmp_path / "known.json", {name: quantity(item, "") for name, item in known.items()})
    assert frame_notes(tmp_path / "known.json") == notes
    for more, heights in (
        ({"control_points": 4}, "heights: those of the control points"),
        ({"met_share": 0.7}, "heights: those of the given cloud"),
        ({"up_cue": "given cameras"}, "heights: those of the given cameras"),
        ({"crs": "EPSG:25832+7837"}, "heights: DHHN2016 height"),
        ({"origin_altitude_m": None}, "heights: relative to the middle camera: no position has a height"),
    ):
        if len(notes) > 1:
            content = {name: quantity(item, "") for name, item in (known | more).items()}
            write_json(tmp_path / "known.json", content)
            assert frame_notes(tmp_path / "known.json")[1] == heights


def test_feet_stay_feet_in_the_results(tmp_path, model):
    foot = 0.3048006096012192
    lines = gcp_lines(FLIGHT, PLACES, NAMES, crs="EPSG:32632")
    in_feet = ["+proj=utm +zone=32 +ellps=WGS84 +units=us-ft +no_defs"]
    for line in lines[1:]:
        cells = line.split("\t")
        in_feet.append("\t".join([*(f"{float(c) / foot:.12g}" for c in cells[:3]), *cells[3:]]))
    report, found, _ = georeferenced(tmp_path, model, without_gps(), in_feet)
    assert value(report, "length_unit") == "m" and report["origin_in_crs"]["unit"] == "US survey foot"
    assert off(report, found).max() < 0.4
    place = scene_frame(report).in_crs(scene_frame(report).apply(FRAME.inverse(PLACES[:1])))[0]
    np.testing.assert_allclose(place, [float(c) for c in in_feet[1].split("\t")[:3]], atol=1e-2)


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda lines: [lines[0]], "holds no points"),
        (lambda lines: lines[1:], "names no coordinate reference system"),
        (lambda lines: [lines[0], "1 2 3 4 5"], "line 2: expected x y z"),
        (lambda lines: [lines[0], lines[1], lines[1]], "clicked more than once in"),
        (lambda lines: [*lines[:3], *changed(lines[3:4], "a", 0, lambda x: x + 1)], "different coordinates"),
        (lambda lines: [line.replace(".jpg", "x.jpg") for line in lines], "none of the 24 photos"),
        (lambda lines: changed(lines, "b", 3, lambda x: x + 900), "lies outside"),
        (lambda lines: [lines[0], lines[1] + "\t0,01"], "has to be a positive number; 0,01 has a decimal comma"),
        (lambda lines: [lines[0], lines[1] + "\t10mm"], "a standard deviation .* has to be a positive number"),
        (lambda lines: ["EPSG:3857", *lines[1:]], "WGS 84 / Pseudo-Mercator is Mercator's projection"),
        (lambda lines: [line for line in lines if line[-1] not in "abcd"], "2 control points with a height"),
        (lambda lines: lines[:1] + [lines[k] for k in range(1, len(lines), 5)], "clicked in"),
        (lambda lines: [swapped(line) for line in lines], "x and y are swapped"),
        (lambda lines: ["EPSG:4326", *(line.replace("\t", "\t", 1) for line in lines[1:])], "does not lie in"),
    ],
)  # fmt: skip
def test_bad_control_points_are_named(tmp_path, model, spoil, words):
    lines = spoil(gcp_lines(FLIGHT, PLACES, NAMES))
    with pytest.raises(StageError, match=words):
        georeferenced(tmp_path, model, without_gps(), lines)


def swapped(line):
    cells = line.split("\t")
    return "\t".join([cells[1], cells[0], *cells[2:]]) if len(cells) > 1 else line


def test_swapped_axes_within_one_country_turn_the_model_upside_down(tmp_path, model):
    grid = "+proj=tmerc +lat_0=47.37 +lon_0=8.55 +ellps=WGS84 +units=m +no_defs"
    lines = [swapped(line) for line in gcp_lines(FLIGHT, PLACES * [1, 1, 0.01], NAMES, crs=grid)]
    with pytest.raises(StageError, match="upside down"):
        georeferenced(tmp_path, model, without_gps(), lines)


@pytest.mark.parametrize("lean_deg, upright", [(0, True), (100, True), (170, False)])
def test_photos_that_do_not_say_for_sure_which_way_is_up_contradict_no_control_points(lean_deg, upright):
    located = [LocatedPoint(SurveyedPoint(n, p, (0.02, 0.03), False, []), p) for n, p in zip(NAMES, PLACES)]
    up = np.array([0.0, np.sin(np.radians(lean_deg)), np.cos(np.radians(lean_deg))])
    with contextlib.nullcontext() if upright else pytest.raises(StageError, match="upside down"):
        placement, _ = place_by_control(located, PLACES, up, "gcp_list.txt", 0)
        np.testing.assert_allclose(placement.local_from_model.matrix, np.eye(4), atol=1e-9)


def test_control_points_along_one_line_are_refused(tmp_path, model):
    along = np.array([[t, 0.5 * t, 0.1] for t in (-30, -10, 0, 15, 30)])
    with pytest.raises(StageError, match="along one line"):
        georeferenced(tmp_path, model, without_gps(), gcp_lines(FLIGHT, along, list("abcde")))


def test_control_points_near_one_line_are_said_to_leave_heights_beside_it_open(tmp_path, model):
    near = np.array([[t, k % 2 - 0.5, 0.1 * k] for k, t in enumerate((-30, -15, 0, 15, 30))])
    lines = gcp_lines(FLIGHT, np.vstack([near, [[0, 20, 1]]]), [*"abcde", "CHK-1"], noise_px=0.5)
    report, _, rows = georeferenced(tmp_path, model, without_gps(), lines)
    (note,) = value(report, "control_notes")
    assert "near one line: 21.2 m beside it heights are known to " in note
    assert abs(float(rows["CHK-1"]["up_m"])) > 1 > 10 * abs(float(rows["a"]["up_m"]))


def test_control_points_of_which_those_that_agree_lie_along_one_line_are_refused(tmp_path, model):
    places = np.array([[-30, -15, 0.1], [0, 0, 0.1], [30, 15, 0.1], [-20, 20, 1.0]])
    lines = changed(gcp_lines(FLIGHT, places, list("abcd"), noise_px=0.3), "d", 1, lambda y: y + 25)
    with pytest.raises(StageError, match="a, b, c lie along one line"):
        georeferenced(tmp_path, model, without_gps(), lines)


def test_control_points_far_from_gps_are_refused(tmp_path, model):
    lines = [
        changed([line], line.split("\t")[-1], 1, lambda y: y + 5000)[0] for line in gcp_lines(FLIGHT, PLACES, NAMES)[1:]
    ]
    with pytest.raises(StageError, match="5 km from where GPS saw"):
        georeferenced(tmp_path, model, FLIGHT.photos(), ["EPSG:32632", *lines])


def test_points_without_names_are_told_by_their_coordinates(tmp_path):
    path = tmp_path / "gcp_list.txt"
    path.write_text("WGS84 UTM 32N\n# a comment\n466000 5246000 NaN 10 20 a.jpg\n466000 5246000 NaN 30 40 b.jpg\n")
    (point,) = read_control(path).points
    assert [click.photo for click in point.clicks] == ["a.jpg", "b.jpg"] and np.isnan(point.position[2])
    assert point.sd_m == (0.02, 0.03) and not point.check


@pytest.mark.parametrize("mark", ["\t", " ", ";", ",", ", ", "; "])
@pytest.mark.parametrize("photo", ["a.jpg", "north side.JPG"])
def test_columns_of_control_points_are_separated_in_any_way(tmp_path, mark, photo):
    cells = [
        ["460000", "5240000", "500", "10.5", "20", photo, "p1"],
        ["460000", "5240000", "500", "1", "2", "b.jpg", "p1"],
    ]
    (tmp_path / "gcp_list.txt").write_text("EPSG:32632\n" + "".join(mark.join(row) + "\n" for row in cells))
    (point,) = read_control(tmp_path / "gcp_list.txt").points
    assert point.name == "p1" and [click.photo for click in point.clicks] == [photo, "b.jpg"]
    np.testing.assert_array_equal(point.clicks[0].pixel, [10.5, 20])


@pytest.mark.parametrize("mark", ["\t", " ", ";", ",", ", ", "; "])
@pytest.mark.parametrize("photo", ["a.jpg", "north side 2.JPG"])
def test_columns_of_positions_are_separated_in_any_way(tmp_path, mark, photo):
    (tmp_path / "geo.txt").write_text(
        "EPSG:4326\n" + "".join(f"{mark.join([n, '8.5', '47.5', '400'])}\n" for n in (photo, "b.jpg"))
    )
    found = read_geo(tmp_path / "geo.txt")
    assert list(found) == [photo, "b.jpg"]
    assert (found[photo].latitude_deg, found[photo].longitude_deg, found[photo].altitude_m) == (47.5, 8.5, 400)


@pytest.mark.parametrize(
    ("first", "mark"), [("EPSG:4326,,,,,,", ","), ("EPSG:4326;;;;", ";"), ('"EPSG:4326"', ","), ("EPSG:4326\t\t", "\t")]
)
def test_what_a_spreadsheet_adds_to_the_first_line_does_no_harm(tmp_path, first, mark):
    gcp, geo = ["8.5", "47.5", "", "10", "20", "a b.jpg", "p", ""], ["a b.jpg", '"8.5"', "47.5", "", ""]
    for name, row in (("gcp_list.txt", gcp), ("geo.txt", geo)):
        (tmp_path / name).write_text(f"{first}\n{mark.join(row)}\n")
    (point,) = read_control(tmp_path / "gcp_list.txt").points
    assert point.clicks[0].photo == "a b.jpg" and point.position[:2].tolist() == [47.5, 8.5]
    assert read_geo(tmp_path / "geo.txt")["a b.jpg"].longitude_deg == 8.5


def a_photo(folder, name, xmp=b"", orientation=1, error_m=0.0):
    folder.mkdir(exist_ok=True)
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    exif[IFD.GPSInfo] = {1: "N", 2: (47.0, 30.0, 0.0), 3: "E", 4: (8.0, 15.0, 0.0), 5: b"\0", 6: 500.0, 31: error_m}
    pixels = np.random.default_rng(len(name) + ord(name[0])).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(folder / name, exif=exif, xmp=xmp)


def listed(folder, tmp_path):
    list_photos(source=folder, upright=tmp_path / "upright", photos=tmp_path / "photos.json", settings=VideoSettings())
    return {photo.name: photo for photo in read_photos(tmp_path / "photos.json")}


def test_accuracies_are_read_from_xmp_and_exif(tmp_path):
    folder = tmp_path / "flight"
    dji = b'<x drone-dji:RtkStdLon="0.012" drone-dji:RtkStdLat="0.016" drone-dji:RtkStdHgt="0.03"/>'
    pix4d = b"<Camera:GPSXYAccuracy>5/100</Camera:GPSXYAccuracy><Camera:GPSZAccuracy>.1</Camera:GPSZAccuracy>"
    a_photo(folder, "a.jpg", dji)
    a_photo(folder, "b.jpg", pix4d, orientation=6)
    a_photo(folder, "c.jpg", b'<x drone-dji:RtkStdLon="0.0" drone-dji:RtkStdLat="0.0" drone-dji:RtkStdHgt="n/a"/>')
    a_photo(folder, "d.jpg", error_m=25.5)
    a_photo(folder, "e.jpg", pix4d, error_m=25.5)
    photos = listed(folder, tmp_path)
    assert photos["a.jpg"].horizontal_sd_m == pytest.approx(np.sqrt((0.012**2 + 0.016**2) / 2))
    assert photos["a.jpg"].vertical_sd_m == 0.03
    assert (photos["b.jpg"].horizontal_sd_m, photos["b.jpg"].vertical_sd_m) == (0.05, 0.1)
    assert (photos["c.jpg"].horizontal_sd_m, photos["c.jpg"].vertical_sd_m) == (None, None)
    assert gps_accuracies(list(photos.values()), 3.0)[2:].tolist() == [[3.0, 3.0], [25.5, 25.5], [0.05, 0.1]]


@pytest.mark.parametrize("name", ["geo.txt", "GEO.TXT"])
def test_a_geo_file_takes_the_place_of_exif(tmp_path, capsys, name):
    folder = tmp_path / "flight"
    for photo in ("a.jpg", "b.jpg", "c.jpg"):
        a_photo(folder, photo)
    x, y = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(8.25, 47.501)
    lines = ["EPSG:32632", f"a.jpg {x} {y} 431.5 10 -90 0 0.02 0.04", f"b.jpg {x + 5} {y}", f"z.jpg {x} {y}"]
    (folder / name).write_text("\n".join(lines))
    photos = listed(folder, tmp_path)
    assert photos["a.jpg"].latitude_deg == pytest.approx(47.501, abs=1e-8)
    assert (photos["a.jpg"].altitude_m, photos["a.jpg"].vertical_sd_m) == (431.5, 0.04)
    assert photos["b.jpg"].altitude_m is None and photos["b.jpg"].has_gps
    assert not photos["c.jpg"].has_gps and "gives 2 of 3 positions" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text, words",
    [
        ("a.jpg 8.5 47.4\n", "names no coordinate reference system"),
        ("EPSG:4326\na.jpg 8.5 north\n", "line 2: expected photo x y"),
        ("EPSG:4326\na.jpg 8,5 47,4 400,1\n", "line 2: expected .*; 8,5 has a decimal comma, write 8.5"),
        ("EPSG:4326\na.jpg;8,5;47,4\n", "line 2: expected .*; 8,5 has a decimal comma, write 8.5"),
        ("EPSG:4326\na.jpg 8.5 47.4\na.jpg 8.5 47.4\n", "given more than once"),
        ("EPSG:4326\nq.jpg 8.5 47.4\n", "names none of the photos"),
        ("EPSG:25832\na.jpg 5246000 466000\n", "x and y are swapped"),
        ("EPSG:25832\na.jpg 32466000 5246000\n", "x begins with the zone: take 32 off, or name a CRS"),
        ("EPSG:25832\na.jpg 3466000 5246000\n", "correct the CRS or the coordinates"),
        ("EPSG:25832\n", "holds no positions"),
    ],
)
def test_a_bad_geo_file_is_named(tmp_path, text, words):
    a_photo(tmp_path / "flight", "a.jpg")
    (tmp_path / "flight/geo.txt").write_text(text)
    with pytest.raises(StageError, match=words):
        listed(tmp_path / "flight", tmp_path)


@pytest.mark.parametrize(
    ("first", "words"),
    [
        ("EPSG:4326", "geo.txt gives latitude before longitude, as the positions in"),
        ("EPSG:32633", r"geo.txt gives positions 452 km from those in the photos' EXIF; correct its CRS or swapped"),
        ("", ""),
    ],
)
def test_a_wrong_zone_or_latitude_before_longitude_shows_beside_exif(tmp_path, capsys, first, words):
    folder = tmp_path / "flight"
    rows = []
    for k in range(3):
        place = [8.5 + 1e-4 * k, 47.4]
        picture, exif = Image.new("RGB", (8, 6)), Image.Exif()
        exif[IFD.GPSInfo] = {1: "N", 2: (47.4, 0.0, 0.0), 3: "E", 4: (8.5002, 0.0, 0.0)}
        folder.mkdir(exist_ok=True)
        picture.putpixel((k, 0), (255, 0, 0))
        picture.save(folder / f"{k}.jpg", exif=exif)
        place = place[::-1] if first == "EPSG:4326" else [462_256 + 8 * k, 5_249_700] if first else place
        rows.append(" ".join(map(str, [f"{k}.jpg", *place])))
    (folder / "geo.txt").write_text("\n".join([first or "EPSG:4326", *rows]))
    if words:
        with pytest.raises(StageError, match=words):
            listed(folder, tmp_path)
    else:
        assert listed(folder, tmp_path)["0.jpg"].longitude_deg == 8.5
        assert "(0.jpg at latitude 47.40000, longitude 8.50000)" in capsys.readouterr().out


BARS = {
    name: (first, second, round(float(np.linalg.norm(first - second)), 4))
    for name, first, second in zip(("door", "kerb", "path"), PLACES[[0, 2, 4]], PLACES[[1, 3, 6]])
}


def length_lines(spoil=lambda cells: cells):
    lines = ["length\tmetres\tend\tphoto\tx_px\ty_px"]
    for name, (*ends, metres) in BARS.items():
        for end, place in zip("ab", ends):
            for photo, pixel in FLIGHT.clicks(place)[:3]:
                lines.append("\t".join(spoil([name, f"{metres}", end, photo, f"{pixel[0]:.3f}", f"{pixel[1]:.3f}"])))
    return lines


def test_known_lengths_give_metres_without_gps(tmp_path, model):
    path = tmp_path / "lengths.tsv"
    path.write_text("\n".join(length_lines()) + "\n")
    report, found, rows = georeferenced(tmp_path, model, without_gps(), lengths=path)
    assert (value(report, "status"), value(report, "length_unit")) == ("scaled", "m") and "crs" not in report
    assert value(report, "length_rms_pct") < 0.5 and 0 < value(report, "lengths_scale_sd_log") < 0.02
    assert rows["door"]["kind"] == "length" and abs(float(rows["door"]["error_m"])) < 0.2
    size = [np.linalg.norm(c - c.mean(0), axis=1).mean() for c in (camera_poses(found)[2], FLIGHT.centres)]
    assert size[0] / size[1] == pytest.approx(1, abs=0.01)
    (tmp_path / "gps").mkdir()
    beside, _, _ = georeferenced(tmp_path / "gps", model, FLIGHT.photos(sd_m=0.02), lengths=path)
    assert value(beside, "status") == "georeferenced"
    assert value(beside, "length_rms_m") < 0.2 and "lengths_scale_sd_log" not in beside


@pytest.mark.parametrize("names", [["door"], ["door", "kerb", "path"]])
def test_how_far_clicks_leave_a_scale_by_known_lengths_open(tmp_path, model, names):
    path, rng, scales = tmp_path / "lengths.tsv", np.random.default_rng(0), []
    sizes = {photo.name: (photo.width, photo.height) for photo in without_gps()}
    header, *lines = (line.split("\t") for line in length_lines())
    for noise_px in (0.0, *[1.0] * 60):
        cells = [line[:4] + [str(float(px) + rng.normal(0, noise_px)) for px in line[4:]] for line in lines]
        path.write_text("\n".join("\t".join(line) for line in [header, *cells] if line is header or line[0] in names))
        known = read_lengths(path, model, sizes)
        scales.append([np.log(known.scale), known.scale_sd_log])
    exact, *noisy = np.array(scales)
    off = np.array([log_scale - exact[0] for log_scale, _ in noisy]) / np.array([sd for _, sd in noisy])
    assert 0.7 < np.sqrt((off**2).mean()) < 1.3


def test_known_lengths_bring_an_object_s_model_into_metres(tmp_path, model):
    path, own = tmp_path / "lengths.tsv", pycolmap.Reconstruction(model)
    path.write_text("\n".join(length_lines()) + "\n")
    sizes = {photo.name: (photo.width, photo.height) for photo in without_gps()}
    before = camera_poses(own)[2]
    content = in_metres(own, path, sizes)
    centres = camera_poses(own)[2]
    size = [np.linalg.norm(c - c.mean(0), axis=1).mean() for c in (centres, FLIGHT.centres, before)]
    assert size[0] / size[1] == pytest.approx(1, abs=0.01) and abs(size[2] / size[1] - 1) > 0.1
    assert value(content, "length_unit") == "m" and abs(value(content, "lengths_off_m")["door"]) < 0.2
    assert in_metres(own, None, sizes) == {} and np.array_equal(camera_poses(own)[2], centres)


@pytest.mark.parametrize(
    "spoil, words",
    [
        (
            lambda cells: [cells[0], "2.0" if cells[0] == "door" else cells[1], *cells[2:]],
            "contradict each other.* apart",
        ),
        (lambda cells: [cells[0], "-1", *cells[2:]], "one positive length"),
        (lambda cells: [*cells[:2], "a", *cells[3:]], "has the ends a"),
        (lambda cells: [*cells[:3], "none.jpg", *cells[4:]], "none.jpg, which is not among"),
        (lambda cells: cells[:4], "line 2: expected"),
        (lambda cells: [*cells[:2], cells[2] + cells[3], *cells[3:]], "has the ends"),
    ],
)
def test_bad_lengths_are_named(tmp_path, model, spoil, words):
    path = tmp_path / "lengths.tsv"
    path.write_text("\n".join(length_lines(spoil)) + "\n")
    with pytest.raises(StageError, match=words):
        georeferenced(tmp_path, model, without_gps(), lengths=path)
