"""The completed scene of two clouds on their own: what comes in, what stays, what the files and the page hold."""

import json
import re
import shlex
import sys
from dataclasses import replace

import laspy
import numpy as np
import pyproj
import pytest
import tyro
from laspy.vlrs.vlrlist import VLRList
from scipy.spatial import cKDTree
from support.browser import chromium, touch
from support.cloud_files import UTM
from support.planted import plant
from support.registered_pair import registered_at_once

from scenefuse.cloud.cloud_file import EVERYWHERE, CloudFile
from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud, spacing, write_cloud
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.stage import StageError, quantity, read_json, value
from scenefuse.core.transforms import Sim3
from scenefuse.core.version import VERSION
from scenefuse.fuse.modes import FusionSettings
from scenefuse.two_clouds import find as register_module
from scenefuse.two_clouds.complete import append_to_las, complete, write_files
from scenefuse.two_clouds.find import Known
from scenefuse.two_clouds.page import write_box_page, write_page
from scenefuse.two_clouds.register import register

FILL = FusionSettings(mode="fill")
POSE = Sim3(2.0, np.eye(3), UTM)


@pytest.fixture(scope="module")
def house():
    return plant("house", 5, ground=False, noise=0.005, object_points=3000, density_ratio=1.0)


def write_survey(path, cloud, crs="EPSG:25832", bright=257):
    """A LAS or LAZ file as a surveyor has it: another point format, classes, intensities, an extra dimension."""
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.001), np.floor(cloud.points.min(0))
    if crs:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    header.add_extra_dim(laspy.ExtraBytesParams("height", "f4", no_data=np.array([-9999.0])))
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = cloud.colors.astype(np.uint16).T * bright
    las.classification = np.arange(len(cloud)) % 7
    las.intensity = np.arange(len(cloud)) % 60_000
    las.height = cloud.points[:, 2]
    las.write(str(path))


def test_an_index_that_more_points_make_untrue_is_left_out_and_other_records_stay(tmp_path):
    scene = in_scene(sheet(0, 4))
    write_survey(tmp_path / "flown.laz", scene)
    las = laspy.read(tmp_path / "flown.laz")
    for user, data in (("copc", bytes(160)), ("surveyor", b"Smith")):
        las.header.vlrs.append(laspy.VLR(user, 1, "", data))
    las = laspy.convert(las, point_format_id=7)
    las.evlrs = VLRList([laspy.VLR("copc", 1000, "", bytes(32)), laspy.VLR("surveyor", 2, "", b"Jones")])
    las.write(str(tmp_path / "yard.laz"))
    scene = CloudFile.of(tmp_path / "yard.laz")
    done = complete(own(sheet(2, 8)), scene, POSE, FILL)
    write_files(tmp_path, done, tmp_path / "shed.ply", scene)
    header = laspy.read(tmp_path / "completed.laz").header
    kept = [(record.user_id, bytes(record.record_data_bytes())) for record in [*header.vlrs, *header.evlrs]]
    assert {("surveyor", b"Smith"), ("surveyor", b"Jones")} <= set(kept)
    assert "copc" not in {user for user, _ in kept} and header.parse_crs().to_epsg() == 25832


def sheet(low, high, color=(200, 100, 50)):
    """A grid at z = 0, x from low to high, 2 wide, 0.1 apart."""
    x, y = np.meshgrid(np.arange(low, high, 0.1), np.arange(0, 2, 0.1))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return Cloud(points, None, np.tile(np.array(color, np.uint8), (len(points), 1)))


def in_scene(cloud):
    return cloud.transformed(Sim3(1.0, np.eye(3), UTM))


def own(cloud):
    """A cloud that POSE puts where `in_scene` puts `cloud`."""
    return cloud.transformed(POSE.inverse() @ Sim3(1.0, np.eye(3), UTM))


def complete_sheet(folder):
    """A sheet in the folder's yard.ply, continued by another."""
    write_cloud(folder / "yard.ply", in_scene(sheet(0, 4)))
    return complete(own(sheet(2, 8)), CloudFile.of(folder / "yard.ply"), POSE, FILL)


@pytest.fixture(scope="module")
def fused(house, tmp_path_factory):
    """The folder with yard.laz, house.ply, and in out/ what came of them."""
    folder = tmp_path_factory.mktemp("fused")
    write_survey(folder / "yard.laz", Cloud(house.scene.points + UTM, None, house.scene.colors))
    write_cloud(folder / "house.ply", house.object)
    with pytest.MonkeyPatch.context() as patch:
        registered_at_once(patch, Sim3(1.0, np.eye(3), UTM) @ house.scene_from_object)
        files = {"object": folder / "house.ply", "scene": folder / "yard.laz"}
        assert register(**files, out=folder / "out", fuse=True) == 0
    return folder


@pytest.mark.slow
def test_a_scene_in_laz_is_completed_by_a_cloud_of_unknown_scale(fused, house):
    out = fused / "out"
    before, after = read_cloud(fused / "yard.laz"), read_cloud(out / "completed.ply")
    added = after.fields["source"] == 1
    assert np.array_equal(after.points[~added], before.points)
    assert set(after.fields) == {"source", "photos", "match", "deviation", "world_deviation", "evidence"}
    assert (after.fields["evidence"] == 0).all() and (after.fields["photos"] == 0).all()
    # What came in is the object's surface, where the scene has none.
    truth = house.scene_from_object.apply(house.object.points) + UTM
    assert cKDTree(truth).query(after.points[added])[0].max() < 0.02 * house.diagonal
    assert cKDTree(before.points).query(after.points[added])[0].min() >= spacing(before.points)
    covered = [(cKDTree(c.points).query(truth)[0] < 0.03 * house.diagonal).mean() for c in (before, after)]
    assert covered[0] < 0.99 < covered[1]
    about = read_json(out / "completed.json")
    assert value(about, "sources") == {"0": "scene", "1": "house"}
    assert value(about, "added_points") == {"house": int(added.sum())} and value(about, "crs") == "EPSG:25832"
    assert value(about, "mode") == "fill" and value(about, "removed_points") == 0
    assert value(about, "version") == value(read_json(out / "transform.json"), "version") == VERSION


def test_the_matrix_is_written_to_the_last_digit(fused):
    matrix = np.loadtxt(fused / "out/transform.txt")
    assert np.array_equal(matrix, value(read_json(fused / "out/transform.json"), "scene_from_object"))


def test_a_laz_keeps_all_that_its_points_have(tmp_path):
    scene, obj = in_scene(sheet(0, 4)), sheet(2, 8, (10, 20, 30))
    write_survey(tmp_path / "yard.laz", scene)
    scene = CloudFile.of(tmp_path / "yard.laz")
    done = complete(own(obj), scene, POSE, FusionSettings(mode="fill", match_colors=False))
    written = write_files(tmp_path, done, tmp_path / "shed.ply", scene)
    assert [path.name for path in written] == ["completed.ply", "completed.laz", "completed.json"]
    before, after = laspy.read(tmp_path / "yard.laz"), laspy.read(tmp_path / "completed.laz")
    count = len(before.points)
    for name in before.point_format.dimension_names:
        assert np.array_equal(before[name], after[name][:count]), name
    extra = [las.header.vlrs.get("ExtraBytesVlr")[0].extra_bytes_structs[0] for las in (before, after)]
    assert extra[0].no_data == extra[1].no_data == [-9999] and extra[0].options & 1 == extra[1].options & 1 == 1
    assert after.header.parse_crs().to_epsg() == 25832
    assert (after.source[:count] == 0).all() and (after.source[count:] == 1).all() and len(done.added) > 0
    new = np.stack([after.x, after.y, after.z], axis=1)[count:]
    assert np.abs(new - done.added.points).max() <= 0.5e-3 + 1e-6
    far = done.added.points[:, 0] - UTM[0] > 5  # beyond the seam, over which colours blend
    assert (np.stack([after.red, after.green, after.blue], axis=1)[count:][far] == np.array([10, 20, 30]) * 257).all()
    assert (after.classification[count:] == 0).all() and (after.return_number[count:] == 1).all()


@pytest.mark.parametrize(("offset", "step"), [(0.0, 0.001), (1e8, 0.1)])
def test_a_laz_has_finer_steps_where_the_object_asks_for_them_or_says_that_it_cannot(tmp_path, offset, step):
    scene = in_scene(sheet(0, 4))
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales, header.offsets = np.full(3, 0.1), np.floor(UTM) - offset
    las = laspy.LasData(header)
    las.xyz = scene.points
    las.write(tmp_path / "yard.laz")
    file = CloudFile.of(tmp_path / "yard.laz")
    dense = Cloud(np.random.default_rng(0).random((3000, 3)) * [1, 1, 0] + [5, 0, 0])
    done = complete(own(dense), file, POSE, FusionSettings(mode="append"))
    write_files(tmp_path, done, tmp_path / "shed.ply", file)
    after, count = laspy.read(tmp_path / "completed.laz"), len(scene)
    assert after.header.scales == pytest.approx([step] * 3)
    assert np.array_equal(after.X[:count], laspy.read(tmp_path / "yard.laz").X * round(0.1 / step))
    assert np.abs(after.xyz[:count] - scene.points).max() < 1e-6
    assert np.abs(after.xyz[count:] - done.added.points).max() <= step / 2 + 1e-6
    notes = " ".join(value(read_json(tmp_path / "completed.json"), "notes"))
    assert ("counts in steps of 0.001, not 0.1" if step < 0.1 else "use completed.ply") in notes


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_colours_of_8_bits_stay_8_bits(tmp_path, ending):
    scene, obj = in_scene(sheet(0, 4)), sheet(2, 8)
    write_survey(tmp_path / f"yard.{ending}", scene, bright=1)
    survey = laspy.read(tmp_path / f"yard.{ending}")
    survey.red[0] = 40_000  # a stray
    survey.write(tmp_path / f"yard.{ending}")
    scene = CloudFile.of(tmp_path / f"yard.{ending}")
    done = complete(own(obj), scene, POSE, FILL)
    write_files(tmp_path, done, tmp_path / "shed.ply", scene)
    after = laspy.read(tmp_path / "completed.laz")
    assert after.red[1:].max() <= 255 and after.red[-1] > 100


def test_a_completed_scene_takes_further_objects_and_keeps_what_is_known(tmp_path):
    write_survey(tmp_path / "yard.laz", in_scene(sheet(0, 4)))
    scene = tmp_path / "yard.laz"
    for number, (low, high) in enumerate([(2, 8), (6, 12), (10, 16)], 1):
        out = tmp_path / str(number)
        scene = CloudFile.of(scene)
        done = complete(own(sheet(low, high)), scene, POSE, FILL)
        write_files(out, done, tmp_path / "shed.ply", scene)
        scene = out / "completed.laz"
        if number == 1:
            first = laspy.read(scene)
            first.deviation[:100] = 0.5
            first.write(scene)
    last, cloud = laspy.read(scene), read_cloud(tmp_path / "3/completed.ply")
    assert set(last.source.tolist()) == set(cloud.fields["source"].tolist()) == {0, 1, 2, 3}
    assert (last.deviation[:100] == 0.5).all() and np.isnan(last.deviation[100:]).all()
    assert not any("after" in name for name in last.point_format.dimension_names)
    named = value(read_json(tmp_path / "3/completed.json"), "sources")
    assert named == {"0": "scene", "1": "1 in completed.laz", "2": "2 in completed.laz", "3": "shed"}


def test_the_page_names_the_number_of_an_object_in_a_scene_that_was_completed_before(tmp_path):
    done = complete_sheet(tmp_path)
    again = replace(done, source=2)
    content = {
        "inputs": quantity({"object": "shed.ply", "scene": "yard.ply", "scene_points": 800}, ""),
        "status": quantity("registered", ""),
        "reason": quantity("", ""),
        "notes": quantity([], ""),
    }
    for one, said in ((done, "0 scene, 1 object"), (again, "0 scene, 2 object")):
        write_page(tmp_path / "report.html", content, "m", tmp_path / "none.png", one, None)
        assert said in (tmp_path / "report.html").read_text()


def test_a_scene_with_some_field_of_the_same_name_keeps_it(tmp_path):
    write_survey(tmp_path / "yard.laz", in_scene(sheet(0, 4)))
    survey = laspy.read(tmp_path / "yard.laz")
    survey.add_extra_dim(laspy.ExtraBytesParams("source", "u1"))
    survey.source[:] = 7
    survey.write(tmp_path / "yard.laz")
    scene = CloudFile.of(tmp_path / "yard.laz")
    done = complete(own(sheet(2, 8)), scene, POSE, FILL)
    write_files(tmp_path, done, tmp_path / "shed.ply", scene)
    after = laspy.read(tmp_path / "completed.laz")
    assert set(after.source[: len(survey.points)].tolist()) == {7}
    assert set(after.source_after.tolist()) == {0, 1}
    assert any("'source' is 'source_after'" in n for n in value(read_json(tmp_path / "completed.json"), "notes"))


def test_a_scan_that_was_merged_twice_is_completed_as_once_and_is_said_to_be(tmp_path):
    scene = in_scene(sheet(0, 4))
    write_survey(tmp_path / "once.laz", scene)
    write_survey(tmp_path / "twice.laz", scene[np.tile(np.arange(len(scene)), 2)])
    once, twice = (CloudFile.of(tmp_path / f"{name}.laz") for name in ("once", "twice"))
    settings = FusionSettings(mode="fill", match_colors=False)
    done, again = (complete(own(sheet(2, 8)), file, POSE, settings) for file in (once, twice))
    assert again.fill_distance == done.fill_distance > 0.1 and np.array_equal(again.added.points, done.added.points)
    assert 0 < len(done.added) < 0.7 * len(sheet(2, 8)) and not once.notes
    assert any("100% of the points of twice.laz lie exactly where others do" in note for note in twice.notes)


def test_columns_that_the_object_lacks_are_named_and_a_grey_object_is_said_to_be(tmp_path, capsys):
    scene, obj = in_scene(sheet(0, 4)), Cloud(sheet(2, 8).points)
    scene.fields["height"] = scene.fields["intensity"] = scene.points[:, 0]
    write_cloud(tmp_path / "yard.ply", scene)
    scene = CloudFile.of(tmp_path / "yard.ply")
    done = complete(own(obj), scene, POSE, FusionSettings())
    written = write_files(tmp_path, done, tmp_path / "shed.ply", scene)
    assert [path.name for path in written] == ["completed.ply", "completed.json"]
    notes, printed = value(read_json(written[-1]), "notes"), capsys.readouterr().out
    for words in ("leaves out the scene's columns height", "grey in the scene", "neither side has photos"):
        assert any(words in note for note in notes) and words in printed
    added = read_cloud(written[0])
    assert (added.colors[added.fields["source"] == 1] == 128).all()
    # What LAS has a place for stays.
    assert not any("intensity" in note for note in notes) and added.fields["intensity"].max() > UTM[0]


def test_what_a_las_says_of_the_object_beside_its_colours_is_named_where_it_is_left_out(tmp_path, house, monkeypatch):
    write_survey(tmp_path / "house.laz", house.object)
    write_cloud(tmp_path / "yard.ply", house.scene)
    registered_at_once(monkeypatch, house.scene_from_object)
    out = tmp_path / "out"
    assert register(object=tmp_path / "house.laz", scene=tmp_path / "yard.ply", out=out, format="laz") == 0
    assert "height" in laspy.read(out / "object_in_scene.laz").point_format.dimension_names
    notes = value(read_json(out / "transform.json"), "notes")
    assert any(note.endswith("house.laz the dimensions intensity, classification") for note in notes), notes


def test_an_object_beyond_the_coordinates_of_a_las_file_is_one_sentence(tmp_path):
    scene, far = in_scene(sheet(0, 4)), sheet(2, 8)
    far.points[-1, 0] = 4e6
    write_survey(tmp_path / "yard.laz", scene)
    scene = CloudFile.of(tmp_path / "yard.laz")
    done = complete(own(far), scene, POSE, FILL)
    with pytest.raises(StageError, match="coordinates of .*yard.laz end before the object"):
        write_files(tmp_path, done, tmp_path / "shed.ply", scene)
    assert [path.name for path in tmp_path.iterdir()] == ["yard.laz"]


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size")
@pytest.mark.parametrize("limit", [3_000, 20_000])
def test_a_completed_scene_that_does_not_fit_is_an_error_and_leaves_nothing(tmp_path, limit):
    import resource

    noise = np.random.default_rng(0).random((20_000, 3))
    write_survey(tmp_path / "yard.laz", in_scene(Cloud(noise, None, (noise * 255).astype(np.uint8))))
    scene = CloudFile.of(tmp_path / "yard.laz")
    done = complete(own(sheet(2, 8)), scene, POSE, FILL)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
    try:
        with pytest.raises(StageError, match=r"completed\.laz could not be written .* GB of its disk are free: free"):
            write_files(tmp_path / "out", done, tmp_path / "shed.ply", scene)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list((tmp_path / "out").iterdir())


def test_completed_files_appear_together_or_not_at_all(tmp_path, monkeypatch):
    write_survey(tmp_path / "yard.laz", in_scene(sheet(0, 4)))
    scene = CloudFile.of(tmp_path / "yard.laz")
    done = complete(own(sheet(2, 8)), scene, POSE, FILL)
    monkeypatch.setattr("scenefuse.two_clouds.complete.VERSION", float("nan"))  # which no JSON holds
    with pytest.raises(ValueError):
        write_files(tmp_path / "out", done, tmp_path / "shed.ply", scene)
    assert not list((tmp_path / "out").iterdir())


def test_the_page_shows_the_decision_the_scene_in_3d_and_the_matrix_and_fetches_nothing(fused):
    page = (fused / "out/report.html").read_text()
    assert 'class="badge ok">registered' in page and "added from house.ply" in page
    assert (fused / "out/transform.txt").read_text().splitlines()[0] in page
    assert 'aria-label="3D view of house.ply in yard.laz"' in page and "data:image/webp" in page
    assert not re.search(r'(src|href)="https?:', page)
    view = json.loads(re.search(r'class="about">(.*?)</script>', page)[1])
    assert view["points"]["after"] > 0 and view["total"]["after"] > view["total"]["before"]


@pytest.mark.slow
def test_a_refused_pose_leaves_no_completed_scene_and_nothing_of_an_earlier_run(tmp_path, house, monkeypatch):
    registered_at_once(monkeypatch, house.scene_from_object, registered=False)
    out = tmp_path / "out"
    out.mkdir()
    for name in ("completed.ply", "completed.laz", "completed.json", "transform.txt", "report.html"):
        (out / name).write_text("of an earlier run")
    write_cloud(tmp_path / "house.ply", house.object)
    write_cloud(tmp_path / "yard.ply", house.scene)
    assert register(object=tmp_path / "house.ply", scene=tmp_path / "yard.ply", out=out, fuse=True) == 3
    assert sorted(p.name for p in out.iterdir()) == ["crop_box.html", "picture.png", "report.html", "transform.json"]
    page = (out / "report.html").read_text()
    assert "unregistered" in page and "The pose was refused" in page


@pytest.mark.slow
def test_a_refusal_ends_in_places_whose_boxes_can_be_pasted(tmp_path, house, monkeypatch, capsys):
    searched = registered_at_once(monkeypatch, house.scene_from_object, registered=False)
    rows = np.flatnonzero(house.scene.points[:, 0] > np.median(house.scene.points[:, 0]))
    monkeypatch.setattr(register_module, "likely_places", lambda *known: [rows])
    for name, cloud in (("house", house.object), ("yard", house.scene)):
        write_cloud(tmp_path / f"{name}.ply", cloud)
    known = {"object": tmp_path / "house.ply", "scene": tmp_path / "yard.ply", "out": tmp_path / "out"}
    assert register(**known, format="laz", seed=7) == 3
    said = capsys.readouterr().out
    box = tuple(map(float, re.search(r"^place +score 0\.00  --crop-box (.*)$", said, re.MULTILINE)[1].split()))
    points = house.scene.points[rows]
    np.testing.assert_allclose(box, [*points.min(0), *points.max(0)], atol=1e-3 * np.ptp(points, axis=0).max())
    assert f"draw a box around the object in {tmp_path / 'out/crop_box.html'}" in said
    assert "--format laz --seed 7" in (tmp_path / "out/crop_box.html").read_text()
    written = value(read_json(tmp_path / "out/transform.json"), "places")
    assert len(written) == 1 and len(written[0]["crop_box"]) == 6
    # A box holds more than the object: what looks like it there is tried, too.
    searched.clear()
    monkeypatch.setattr(register_module, "likely_places", lambda *known: [np.arange(300)])
    assert register(**known, known=Known(crop_box=box)) == 3
    assert len(searched) == 2 and len(searched[1][1]) == 300


def test_a_stray_far_away_does_not_make_the_scene_a_dot_in_the_page_to_draw_in(tmp_path, house, monkeypatch):
    registered_at_once(monkeypatch, house.scene_from_object, registered=False)
    stray = Cloud(house.scene.points[:1] + [9000, 0, 0], None, house.scene.colors[:1])
    write_cloud(tmp_path / "yard.ply", concatenate([house.scene, stray]))
    write_cloud(tmp_path / "house.ply", house.object)
    box = Known(crop_box=(*house.scene.points.min(0), *house.scene.points.max(0)))
    known = {"object": tmp_path / "house.ply", "scene": tmp_path / "yard.ply", "out": tmp_path / "out"}
    assert register(**known, known=box) == 3
    page = (tmp_path / "out/crop_box.html").read_text()
    step = json.loads(re.search(r'id="about">(.*?)</script>', page)[1])["step"][0]
    assert abs(step) < 0.01 * house.scene.diagonal


@pytest.mark.process
@pytest.mark.parametrize("phone", [False, True])
def test_the_box_drawn_in_the_page_of_a_refusal_holds_the_object_and_its_command_finds_it(tmp_path, house, phone):
    others = plant("sculpture", 7, ground=False, noise=0.005, density_ratio=1.0).scene
    low, high = house.scene.points.min(0), house.scene.points.max(0)
    shift = UTM + [3 * (high - low)[0], -2 * (high - low)[1], 0]
    write_survey(
        tmp_path / "yard.laz",
        concatenate(
            [
                Cloud(house.scene.points + UTM, None, house.scene.colors),
                Cloud(others.points + shift, None, others.colors),
            ]
        ),
    )
    write_cloud(tmp_path / "house.ply", house.object)
    known = {"object": tmp_path / "house.ply", "scene": tmp_path / "yard.laz", "out": tmp_path / "out"}
    with pytest.MonkeyPatch.context() as patch:
        registered_at_once(patch, house.scene_from_object, registered=False)
        patch.setattr(register_module, "likely_places", lambda *known: [np.arange(len(house.scene))])
        assert register(**known, known=Known(up_scene=(0, 0, 1))) == 3
    with chromium("--window-size=1400,900", phone=phone) as window:
        window.open(tmp_path / "out/crop_box.html")
        window.find(".places button").click()
        place = np.array(window.find("#command").text.split("--crop-box ")[1].split(), np.float64)
        picture = window.find(".map svg")
        middle, reach, size = (low + high) / 2 + UTM, 0.55 * (high - low), picture.size
        pixel = window.value(
            "return about.axes.map((axis, k) => (given[0][axis] - about.corner[k]) / about.step[k]);", middle.tolist()
        )
        shown = size["width"] / window.value("return map.viewBox.baseVal.width;")
        across = shown * np.array(reach[:2]) / window.value("return Math.abs(about.step[0]);")
        path = [shown * np.array(pixel) + side * across for side in (-1, -0.5, 0, 0.5, 1)]
        touch(window, picture, [tuple(place) for place in path], "touch" if phone else "mouse")
        said = window.find("#command").text
        assert window.value("return document.documentElement.scrollWidth <= innerWidth;")
        assert window.complaints() == []
    np.testing.assert_allclose(place, [*(low + UTM), *(high + UTM)], atol=0.05)
    words = shlex.split(said)
    box = np.array(words[words.index("--crop-box") + 1 :], np.float64)
    np.testing.assert_allclose(box[[0, 1, 3, 4]], [*(middle - reach)[:2], *(middle + reach)[:2]], atol=0.3)
    assert words[:2] == ["scenefuse", "register"] and words[words.index("--up-scene") + 1] == "0"
    if not phone:
        with pytest.MonkeyPatch.context() as patch:
            searched = registered_at_once(patch, Sim3(1.0, np.eye(3), UTM) @ house.scene_from_object)
            options = (tyro.conf.FlagConversionOff, tyro.conf.OmitArgPrefixes)
            assert tyro.cli(register, args=words[2:], config=options) == 0
        assert len(searched[0][1]) == len(house.scene)


@pytest.mark.parametrize(
    ("points", "up", "axis"),
    [
        ([[0.0, 0, 0], [5, 1, 9], [3, 0.5, 2]], None, "y"),
        ([[0.0, 0, 0], [5, 1, 9], [3, 0.5, 2]], (0, 0, -1), "z"),
        ([[7.0, 7, 7]], None, "x"),
    ],
)
def test_any_scene_has_a_page_to_draw_in(tmp_path, points, up, axis):
    scene = Cloud(np.array(points))
    write_box_page(tmp_path / "page.html", scene, None if up is None else np.array(up, np.float64), [], "do")
    text = (tmp_path / "page.html").read_text()
    about = json.loads(re.search(r'id="about">(.*?)</script>', text)[1])
    assert f"along its {axis} axis" in text and "xyz".index(axis) not in about["axes"]
    # Seen from below, the picture is mirrored: x grows to the left.
    assert (about["step"][0] < 0) == (up is not None) or axis == "y"
    for k, side in enumerate(about["axes"]):
        pixels = (scene.points[:, side] - about["corner"][k]) / about["step"][k]
        assert (pixels >= 0).all() and (pixels <= 1300).all()


def test_noise_of_a_laz_is_not_searched_and_stays_in_the_completed_laz_alone(tmp_path, house, monkeypatch, capsys):
    registered_at_once(monkeypatch, house.scene_from_object)
    write_cloud(tmp_path / "house.ply", house.object)
    write_laz(tmp_path / "clean.laz", house.scene, np.zeros(3), None)
    las = laspy.read(tmp_path / "clean.laz")
    noisy = laspy.LasData(las.header)
    noisy.points = laspy.ScaleAwarePointRecord.zeros(len(las.points) + 40, header=las.header)
    for name in las.points.array.dtype.names:
        noisy.points.array[name][40:] = las.points.array[name]
    noisy.x[:40] = las.header.maxs[0] + 5 * np.arange(40)
    noisy.classification[:30], noisy.withheld[30:40] = 7, 1
    noisy.write(tmp_path / "noisy.laz")
    files = {"object": tmp_path / "house.ply", "scene": tmp_path / "noisy.laz"}
    assert register(**files, out=tmp_path / "out", fuse=True) == 0
    printed = capsys.readouterr().out
    assert "30 points of the classes 7 and 18 (noise) of" in printed and "10 withheld points of" in printed
    written = laspy.read(tmp_path / "out/completed.laz")
    assert (np.asarray(written.classification) == 7).sum() == 30 and (np.asarray(written["source"]) == 1).any()
    about, surface = read_json(tmp_path / "out/completed.json"), read_cloud(tmp_path / "out/completed.ply")
    assert np.array_equal(surface.points[surface.fields["source"] == 0], read_cloud(tmp_path / "clean.laz").points)
    assert value(about, "points") == len(surface) == len(written.points) - 40
    assert any("completed.ply leaves out the 40 points that are not used" in note for note in value(about, "notes"))


def test_bad_input_leaves_nothing_of_an_earlier_run(tmp_path, house):
    out = tmp_path / "out"
    out.mkdir()
    (out / "completed.ply").write_text("of an earlier run")
    (out / "mine.txt").write_text("a file of the user")
    write_cloud(tmp_path / "house.ply", house.object)
    with pytest.raises(StageError, match="does not exist"):
        register(object=tmp_path / "house.ply", scene=tmp_path / "none.laz", out=out, fuse=True)
    assert [path.name for path in out.iterdir()] == ["mine.txt"]


def test_an_input_in_the_folder_of_the_results_is_kept(tmp_path, house):
    out = tmp_path / "out"
    write_cloud(out / "completed.ply", house.scene)
    with pytest.raises(StageError, match="is an input, and a run removes what lies in --out"):
        register(object=tmp_path / "house.ply", scene=out / "completed.ply", out=out)
    assert (out / "completed.ply").is_file()


def in_parts(monkeypatch, rows, most):
    """Files are read so many rows at a time, and so many points of a part are held."""
    monkeypatch.setattr("scenefuse.cloud.formats.AT_ONCE", rows)
    monkeypatch.setattr("scenefuse.cloud.cloud_file.AT_ONCE", rows)
    monkeypatch.setattr("scenefuse.two_clouds.register.MAX_SEARCHED_POINTS", most)


@pytest.mark.parametrize("ending", ["laz", "ply", "xyz"])
def test_a_scene_in_parts_is_completed_as_one_in_one_piece(tmp_path, monkeypatch, ending):
    scene, path = in_scene(sheet(0, 4)), tmp_path / f"yard.{ending}"
    if ending == "laz":
        write_survey(path, scene)
    elif ending == "ply":
        write_cloud(path, scene)
    else:
        np.savetxt(path, np.hstack([scene.points, scene.colors]), fmt="%.3f")
    settings = FusionSettings(mode="replace")  # which takes points away, too
    whole = CloudFile.of(path)
    done = complete(own(sheet(2, 8)), whole, POSE, settings)
    write_files(tmp_path / "whole", done, tmp_path / "shed.ply", whole)
    in_parts(monkeypatch, 70, 1 << 22)
    parts = CloudFile.of(path)
    assert len(list(parts.parts())) > 5 and parts.every == 1
    again = complete(own(sheet(2, 8)), parts, POSE, settings)
    write_files(tmp_path / "parts", again, tmp_path / "shed.ply", parts)
    for one in (tmp_path / "whole").glob("completed.[pl]*"):
        assert one.read_bytes() == (tmp_path / "parts" / one.name).read_bytes(), one.name
    assert 0 < len(again.removed) < len(scene) and len(again.added) > 0
    assert len(read_cloud(tmp_path / "parts/completed.ply")) == len(scene) - len(again.removed) + len(again.added)


def test_of_a_large_part_every_so_manyth_point_is_searched_and_all_stay(tmp_path, house, monkeypatch):
    searched = registered_at_once(monkeypatch, Sim3(1.0, np.eye(3), UTM) @ house.scene_from_object)
    in_parts(monkeypatch, 500, 500)
    write_cloud(tmp_path / "house.ply", house.object)
    write_survey(tmp_path / "yard.laz", Cloud(house.scene.points + UTM, None, house.scene.colors))
    files = {"object": tmp_path / "house.ply", "scene": tmp_path / "yard.laz"}
    assert register(**files, out=tmp_path / "out", fuse=True) == 0
    content = read_json(tmp_path / "out/transform.json")
    assert any("one in 4 of its points is searched" in note for note in value(content, "notes"))
    assert f"the whole scene, {len(house.scene)} points" in value(content, "searched")
    assert len(searched[0][1]) == len(house.scene.points[::4])
    after = read_cloud(tmp_path / "out/completed.ply")
    assert (after.fields["source"] == 0).sum() == len(house.scene)
    # New is what is farther from all of the scene's points than these are apart, not than those that were searched.
    assert value(read_json(tmp_path / "out/completed.json"), "fill_distance") < 2.5 * spacing(house.scene.points)


def test_a_crop_box_is_all_that_is_held_of_a_scene(tmp_path):
    write_survey(tmp_path / "yard.laz", in_scene(sheet(0, 40)))
    low, high = UTM + [2.95, -1, -1], UTM + [4.95, 3, 1]
    held = CloudFile.of(tmp_path / "yard.laz", (low, high))
    assert (len(held.part), held.summary.count) == (20 * 20, 400 * 20)
    rows, near = held.near(low - 1, high + 1)
    assert len(near) == 40 * 20 and np.array_equal(near.points, read_cloud(tmp_path / "yard.laz").points[rows])


@pytest.mark.parametrize("fields", [{"classification": 7}, {"withheld": 1}])
def test_a_cloud_without_a_point_of_a_surface_is_one_sentence(tmp_path, fields):
    write_survey(tmp_path / "yard.laz", in_scene(sheet(0, 4)))
    las = laspy.read(tmp_path / "yard.laz")
    for name, number in fields.items():
        las[name] = np.full(len(las.points), number)
    las.write(tmp_path / "yard.laz")
    with pytest.raises(StageError, match="holds no point of a surface .800 .*withheld|noise"):
        CloudFile.of(tmp_path / "yard.laz")


def test_points_at_zero_that_fill_a_whole_part_are_none_either(tmp_path, monkeypatch):
    in_parts(monkeypatch, 500, 1 << 22)
    scene = in_scene(sheet(0, 4))
    write_cloud(tmp_path / "yard.ply", Cloud(np.concatenate([scene.points, np.zeros((1200, 3))])))
    held = CloudFile.of(tmp_path / "yard.ply")
    assert held.summary.count == len(held.part) == len(scene)
    assert any("1200 points at exactly 0 0 0 of" in note for note in held.notes)
    assert sum(len(cloud) for _, cloud in held.parts()) == len(held.near(*EVERYWHERE)[0]) == len(scene)
    # A site whose own zero lies in it has a point there.
    write_cloud(tmp_path / "site.ply", Cloud(np.concatenate([sheet(0, 4).points, np.zeros((1, 3))])))
    assert CloudFile.of(tmp_path / "site.ply").summary.count == len(scene) + 1


def test_an_object_may_be_anywhere_whatever_crs_its_file_names(tmp_path, house, monkeypatch):
    registered_at_once(monkeypatch, house.scene_from_object)
    write_laz(tmp_path / "house.laz", house.object, np.zeros(3), "EPSG:25832")
    write_cloud(tmp_path / "yard.ply", house.scene)
    assert register(object=tmp_path / "house.laz", scene=tmp_path / "yard.ply", out=tmp_path / "out") == 0


def test_strays_and_normals_that_say_nothing_do_not_count(tmp_path, house, monkeypatch):
    searched = registered_at_once(monkeypatch, house.scene_from_object)
    points = np.concatenate([house.object.points, [[1e4, 0, 0], [0, -1e4, 5]]])
    write_cloud(tmp_path / "house.ply", Cloud(points, np.zeros((len(points), 3), np.float32)))
    write_cloud(tmp_path / "yard.ply", Cloud(np.concatenate([house.scene.points, [[0, 0, 9e5]]])))
    files = {"object": tmp_path / "house.ply", "scene": tmp_path / "yard.ply"}
    register(**files, out=tmp_path / "out")
    content = read_json(tmp_path / "out/transform.json")
    ((obj, scene),) = searched
    assert np.array_equal(obj.points, house.object.points) and obj.normals is None
    assert np.array_equal(scene.points, house.scene.points)
    notes = " ".join(value(content, "notes"))
    assert "2 points of" in notes and "1 points of what is searched" in notes and "not all of unit length" in notes
    assert value(content, "inputs")["object_points"] == len(house.object)


def test_normals_that_face_either_side_do_not_count_and_that_is_said(tmp_path, house, monkeypatch):
    searched = registered_at_once(monkeypatch, house.scene_from_object)
    for name, cloud in (("house", house.object), ("yard", house.scene)):
        signs = np.random.default_rng(0).choice([-1, 1], (len(cloud), 1)).astype(np.float32)
        write_cloud(tmp_path / f"{name}.ply", replace(cloud, normals=signs * cloud.normals))
    files = {"object": tmp_path / "house.ply", "scene": tmp_path / "yard.ply"}
    register(**files, out=tmp_path / "out")
    notes = value(read_json(tmp_path / "out/transform.json"), "notes")
    for name, note in zip(("house", "yard"), notes, strict=True):
        assert f"{name}.ply face either side" in note
    assert searched[0][0].normals is None


def test_a_las_of_an_old_version_is_completed(tmp_path):
    write_survey(tmp_path / "yard.las", in_scene(sheet(0, 4)))
    las = laspy.convert(laspy.read(tmp_path / "yard.las"), point_format_id=1, file_version="1.1")
    las.write(tmp_path / "old.las")
    content = bytearray((tmp_path / "old.las").read_bytes())
    content[24:26] = bytes([1, 0])
    (tmp_path / "old.las").write_bytes(content)
    scene = CloudFile.of(tmp_path / "old.las")
    done = complete(own(sheet(2, 8)), scene, POSE, FusionSettings(mode="append"))
    append_to_las(tmp_path / "completed.las", scene, done)
    after = laspy.read(tmp_path / "completed.las")
    assert len(after.points) == scene.summary.rows + len(done.added)


def test_colours_that_the_scene_has_no_place_for_are_named(tmp_path):
    scene = in_scene(sheet(0, 4))
    write_cloud(tmp_path / "yard.ply", Cloud(scene.points))
    done = complete(own(sheet(2, 8)), CloudFile.of(tmp_path / "yard.ply"), POSE, FusionSettings(mode="append"))
    assert any("the scene has no colours" in note for note in done.notes)


def test_an_object_s_colours_do_not_make_a_scene_black_that_has_none(tmp_path):
    write_survey(tmp_path / "yard.laz", in_scene(sheet(0, 4, (0, 0, 0))))
    scene = CloudFile.of(tmp_path / "yard.laz")
    done = complete(own(sheet(2, 8)), scene, POSE, FILL)
    write_files(tmp_path, done, tmp_path / "shed.ply", scene)
    assert len(done.added) and CloudFile.of(tmp_path / "completed.laz").part.colors is None


def test_a_folder_that_may_not_be_written_to_stops_at_once(tmp_path, house, monkeypatch):
    write_cloud(tmp_path / "house.ply", house.object)
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(StageError, match="nothing may be written in --out"):
        register(object=tmp_path / "house.ply", scene=tmp_path / "house.ply", out=tmp_path / "out")
