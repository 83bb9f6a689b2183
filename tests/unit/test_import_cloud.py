"""Clouds in the place of photos: their frame, their coordinates, and what does without photos."""

from dataclasses import replace

import laspy
import numpy as np
import pyproj
import pytest
from plyfile import PlyData
from support.cloud_files import UTM, write_e57, write_pcd
from support.copc_file import write_copc

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.cloud.import_cloud import import_object_cloud, import_scene_cloud, near_origin, unit_and_name
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.core.transforms import Sim3
from scenefuse.crop.crop_scene import points_in
from scenefuse.fuse.fuse_object import possible
from scenefuse.fuse.modes import FusionSettings
from scenefuse.fuse.write import frame_ledger
from scenefuse.photos.geodesy import scene_frame
from scenefuse.surface.gltf import metres_per_unit


@pytest.fixture
def cloud():
    """A patch of 40 m with colours, at UTM coordinates."""
    rng = np.random.default_rng(0)
    points = UTM + rng.uniform(0, 40, (500, 3)) * [1, 1, 0.2]
    return Cloud(points, None, rng.integers(0, 256, (500, 3)).astype(np.uint8))


def imported_scene(path, source, crs=None):
    """The scene's cloud, report and georeference."""
    files = {
        "cloud": path / "dense.ply",
        "report": path / "dense.json",
        "georeference_json": path / "georeference.json",
    }
    import_scene_cloud(source=source, crs=crs, **files)
    return read_cloud(files["cloud"]), read_json(files["report"]), read_json(files["georeference_json"])


def write_as(path, cloud):
    """The cloud as a file of the path's kind."""
    if path.name.endswith(".copc.laz"):
        write_copc(path, cloud.points, cloud.colors)
    elif path.suffix in (".laz", ".las"):
        write_laz(path, Cloud(cloud.points - UTM, None, cloud.colors), UTM, "EPSG:32632")
    elif path.suffix == ".e57":
        write_e57(path, [(cloud.points, cloud.colors, np.array([1.0, 0, 0, 0]), np.zeros(3))])
    elif path.suffix == ".pcd":
        write_pcd(path, cloud, "ascii" if "text" in path.name else "binary")
    elif path.suffix == ".ply":
        write_cloud(path, cloud)
        if "text" in path.name:
            PlyData(PlyData.read(path, mmap=False).elements, text=True).write(path)
    else:
        np.savetxt(path, np.c_[cloud.points, cloud.colors], fmt=["%.6f"] * 3 + ["%d"] * 3)
    return path


@pytest.mark.parametrize("name", ["a.laz", "a.e57", "a.ply", "a.xyz"])
def test_a_scene_in_utm_lies_near_its_origin_and_goes_back_to_its_place(tmp_path, cloud, name):
    found, report, georeference = imported_scene(tmp_path, write_as(tmp_path / name, cloud))
    assert np.abs(found.points).max() < 100 and np.array_equal(found.colors, cloud.colors)
    assert np.allclose(scene_frame(georeference).in_crs(found.points), cloud.points, atol=6e-4)
    in_float32 = found.points.astype(np.float32) + value(georeference, "origin_in_crs")
    assert np.allclose(in_float32, cloud.points, atol=6e-4)
    assert value(report, "points") == 500 and value(report, "source") == name


@pytest.mark.parametrize(
    "name", ["a.laz", "a.las", "a.e57", "a.ply", "text.ply", "a.pcd", "text.pcd", "a.xyz", "a.copc.laz"]
)
def test_a_file_read_in_parts_gives_the_same_scene(tmp_path, cloud, name, monkeypatch):
    turned = np.random.default_rng(1).normal(size=(500, 3)) + [0, 0, 4]
    source = write_as(tmp_path / name, replace(cloud, normals=turned / np.linalg.norm(turned, axis=1, keepdims=True)))
    whole, *jsons = imported_scene(tmp_path, source)
    monkeypatch.setattr("scenefuse.cloud.formats.AT_ONCE", 64)
    monkeypatch.setattr("scenefuse.cloud.cloud_file.SAMPLE", 220)  # of which the origin is found
    found, *others = imported_scene(tmp_path, source)
    assert jsons == others and np.array_equal(found.points, whole.points)
    assert np.array_equal(found.colors, cloud.colors)
    assert (found.normals is None) == (not name.endswith((".ply", ".pcd"))) and np.array_equal(
        found.normals, whole.normals
    )


def test_a_copc_of_many_nodes_is_read_whole(tmp_path, monkeypatch):
    monkeypatch.setattr("support.copc_file.NODE_POINTS", 500)
    rng = np.random.default_rng(2)
    points, colors = UTM + rng.uniform(0, 40, (9000, 3)) * [1, 1, 0.1], rng.integers(0, 256, (9000, 3)).astype(np.uint8)
    write_copc(tmp_path / "a.copc.laz", points, colors)
    found, _, georeference = imported_scene(tmp_path, tmp_path / "a.copc.laz")
    back = scene_frame(georeference).in_crs(found.points)
    order, other = np.lexsort(np.round(back, 3).T), np.lexsort(np.round(points, 3).T)
    assert np.allclose(back[order], points[other], atol=1e-3)
    assert np.array_equal(found.colors[order], colors[other])


def test_colors_of_16_bits_are_told_from_bytes_by_the_whole_file(tmp_path, cloud, monkeypatch):
    colors = np.zeros((500, 3), np.uint16)
    colors[-1] = [65535, 257, 0]
    columns = dict(zip(("red", "green", "blue"), colors.T))
    write_cloud(tmp_path / "a.ply", Cloud(cloud.points, None, None, columns))
    monkeypatch.setattr("scenefuse.cloud.formats.AT_ONCE", 64)
    assert imported_scene(tmp_path, tmp_path / "a.ply")[0].colors[-1].tolist() == [255, 1, 0]


@pytest.mark.parametrize("name", ["a.laz", "a.las", "a.e57", "a.ply", "text.ply", "a.pcd", "text.pcd", "a.copc.laz"])
def test_a_file_that_is_cut_short_is_one_sentence(tmp_path, cloud, name, monkeypatch):
    monkeypatch.setattr("scenefuse.cloud.formats.AT_ONCE", 64)
    source = write_as(tmp_path / name, cloud)
    source.write_bytes(source.read_bytes()[:-3000])
    with pytest.raises(StageError, match=f"{name} is (cut short: it|not a readable)"):
        imported_scene(tmp_path, source)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_crs_is_kept_and_gives_the_unit_and_latitudes(tmp_path, cloud):
    georeference = imported_scene(tmp_path, write_as(tmp_path / "a.laz", cloud))[2]
    assert (value(georeference, "crs"), value(georeference, "length_unit")) == ("EPSG:32632", "m")
    latitude, longitude, height = scene_frame(georeference).inverse(np.zeros((1, 3)))[0]
    assert latitude == pytest.approx(50.3, abs=0.01) and longitude == pytest.approx(9.0, abs=0.01)
    assert height == value(georeference, "origin_in_crs")[2]


def test_without_a_crs_nothing_is_called_metres(tmp_path, cloud):
    georeference = imported_scene(tmp_path, write_as(tmp_path / "a.ply", cloud))[2]
    assert (value(georeference, "crs"), value(georeference, "length_unit")) == (None, "scene units")


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:25832+7837", "WGS84 UTM 32N"])
def test_a_cloud_whose_file_does_not_say_its_crs_has_the_tables(tmp_path, cloud, crs):
    georeference = imported_scene(tmp_path, write_as(tmp_path / "a.ply", cloud), crs)[2]
    wanted = crs.replace("WGS84 UTM 32N", "EPSG:32632")
    assert (value(georeference, "crs"), value(georeference, "length_unit")) == (wanted, "m")
    assert scene_frame(georeference).inverse(np.zeros((1, 3)))[0][0] == pytest.approx(50.3, abs=0.01)


@pytest.mark.parametrize(
    ("name", "crs", "sentence"),
    [
        ("a.ply", "EPSG:32633+1", "names no coordinate reference system; write EPSG:25832"),
        ("a.ply", "EPSG:4326", "is in degrees; name a projected one"),
        ("a.ply", "EPSG:2056", r"does not lie in CH1903\+"),
        ("a.laz", "EPSG:25832", "is in WGS 84 / UTM zone 32N, but the column crs says ETRS89 / UTM zone 32N"),
    ],
)
def test_a_crs_of_the_table_that_is_not_the_clouds_is_one_sentence(tmp_path, cloud, name, crs, sentence):
    with pytest.raises(StageError, match=sentence):
        imported_scene(tmp_path, write_as(tmp_path / name, cloud), crs)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_feet_are_called_by_their_name(tmp_path, cloud):
    write_laz(tmp_path / "a.laz", Cloud(cloud.points - UTM), np.array([985_000.0, 195_000.0, 0.0]), "EPSG:2263")
    assert value(imported_scene(tmp_path, tmp_path / "a.laz")[2], "length_unit") == "US survey foot"
    # Whose metres depend on its name, and programs have names of their own.
    for word, metres, name in (("U.S. Foot", 0.3048006096, "US survey foot"), ("Foot", 0.3048, "foot"), ("m", 1, "m")):
        wkt = pyproj.CRS.from_epsg(25832).to_wkt("WKT1_GDAL").replace('UNIT["metre",1', f'UNIT["{word}",{metres}')
        assert unit_and_name(pyproj.CRS.from_wkt(wkt))[0] == name
        assert metres_per_unit(name) == pytest.approx(metres, rel=1e-9)


def test_a_plane_in_feet_with_heights_in_metres_is_refused(tmp_path, cloud):
    source = write_as(tmp_path / "a.xyz", replace(cloud, points=cloud.points - cloud.points.mean(0) + [1e6, 2e5, 50]))
    with pytest.raises(StageError, match="counts US survey foot and metre; give heights in the unit of the plane"):
        imported_scene(tmp_path, source, "EPSG:2263+5703")
    write_laz(tmp_path / "b.laz", Cloud(cloud.points - UTM), np.array([1e6, 2e5, 50.0]), "EPSG:2263+5703")
    with pytest.raises(StageError, match=r"b\.laz: .* counts US survey foot and metre; give heights"):
        import_object_cloud(source=tmp_path / "b.laz", cloud=tmp_path / "b.ply", report=tmp_path / "b.json")


def test_clouds_near_zero_keep_their_coordinates_at_any_size():
    points = np.random.default_rng(0).normal(size=(1000, 3)) + [2, 0, -1]
    assert np.array_equal(near_origin(points), np.zeros(3)) and np.array_equal(near_origin(1e-4 * points), np.zeros(3))


def test_rows_without_a_position_and_unused_columns_are_recorded(tmp_path, cloud):
    points = cloud.points.copy()
    points[:3, 1] = np.nan
    write_cloud(tmp_path / "a.ply", Cloud(points, None, None, {"intensity": np.zeros(500, np.float32)}))
    found, report, _ = imported_scene(tmp_path, tmp_path / "a.ply")
    assert len(found) == 497 and found.fields == {} and value(report, "columns_not_used") == ["intensity"]
    left_out, unused = value(report, "notes")
    assert left_out == "3 rows without a finite position of a.ply were left out"
    assert unused.endswith("results: intensity")


def test_normals_that_are_none_are_left_out_and_that_is_said(tmp_path, cloud):
    up, either = np.tile([0, 0, 1], (500, 1)), np.random.default_rng(0).choice([-1, 1], (500, 1))
    for normals, fault in ((0 * up, "not all of unit length"), (either * up, "face either side")):
        write_cloud(tmp_path / "a.ply", Cloud(cloud.points, normals.astype(np.float32)))
        found, report, _ = imported_scene(tmp_path, tmp_path / "a.ply")
        assert found.normals is None and fault in value(report, "notes")[0]


def test_classes_and_intensities_of_a_laz_are_kept_for_a_scene_and_named_for_an_object(tmp_path, cloud):
    las = laspy.read(write_as(tmp_path / "a.laz", cloud))
    las.classification[:100], las.intensity[:], las.user_data[:7] = 6, np.arange(500), 1
    las.write(tmp_path / "classed.laz")
    found, report, _ = imported_scene(tmp_path, tmp_path / "classed.laz")
    assert found.fields["classification"].dtype == np.uint8 and (found.fields["classification"] == 6).sum() == 100
    assert found.fields["intensity"].tolist() == list(range(500))
    assert value(report, "columns_not_used") == ["user_data"]
    import_object_cloud(source=tmp_path / "classed.laz", cloud=tmp_path / "object.ply", report=tmp_path / "object.json")
    assert not read_cloud(tmp_path / "object.ply").fields
    unused = value(read_json(tmp_path / "object.json"), "columns_not_used")
    assert unused == ["classification", "intensity", "user_data"]


def test_noise_of_a_laz_and_points_at_nothing_are_left_out_and_counted(tmp_path, cloud):
    las = laspy.read(write_as(tmp_path / "a.laz", cloud))
    las.classification[:30], las.classification[30:50] = 7, 18
    las.withheld[50:60] = 1
    las.z[:60] = 4000.0
    las.write(tmp_path / "noisy.laz")
    found, report, _ = imported_scene(tmp_path, tmp_path / "noisy.laz")
    assert len(found) == 440 and value(report, "diagonal") < 100
    assert value(report, "notes")[:2] == [
        "50 points of the classes 7 and 18 (noise) of noisy.laz were left out",
        "10 withheld points of noisy.laz were left out",
    ]
    points = cloud.points.copy()
    points[:4] = 0
    write_cloud(tmp_path / "zero.ply", Cloud(points))
    found, report, _ = imported_scene(tmp_path, tmp_path / "zero.ply")
    assert len(found) == 496 and value(report, "diagonal") < 100
    assert value(report, "notes") == ["4 points at exactly 0 0 0 of zero.ply were left out"]
    near = cloud.points - UTM
    near[0] = 0
    write_cloud(tmp_path / "near.ply", Cloud(near))
    assert len(imported_scene(tmp_path, tmp_path / "near.ply")[0]) == 500


def test_coordinates_in_single_precision_that_are_too_coarse_are_named(tmp_path, cloud):
    write_cloud(tmp_path / "a.ply", Cloud(cloud.points.astype(np.float32).astype(float)))
    notes = value(imported_scene(tmp_path, tmp_path / "a.ply")[1], "notes")
    assert len(notes) == 1 and "in steps of 0.5, and its points are" in notes[0]
    write_cloud(tmp_path / "b.ply", Cloud((cloud.points - UTM).astype(np.float32).astype(float)))
    assert not value(imported_scene(tmp_path, tmp_path / "b.ply")[1], "notes")


def test_dimensions_of_a_laz_that_say_nothing_are_no_columns(tmp_path, cloud):
    assert not imported_scene(tmp_path, write_as(tmp_path / "a.laz", cloud))[0].fields


@pytest.mark.parametrize("version", ["WKT2_2019", "WKT1_GDAL"])
def test_a_cloud_that_is_not_where_its_crs_says_is_one_sentence(tmp_path, cloud, version):
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(pyproj.CRS("EPSG:32632").to_wkt(version)))
    las = laspy.LasData(header)
    las.x, las.y, las.z = (cloud.points - UTM).T
    las.write(tmp_path / "a.laz")
    with pytest.raises(StageError, match=r"a\.laz, the middle of its points: .* does not lie in WGS 84 / UTM zone 32N"):
        imported_scene(tmp_path, tmp_path / "a.laz")


def test_what_is_narrow_and_tall_is_not_in_degrees(tmp_path):
    rng = np.random.default_rng(0)
    borehole = rng.uniform(-0.05, 0.05, (400, 3)) * [1, 1, 4000]
    room = rng.uniform(2, 12, (400, 3))
    room[:8, 2] = -32000
    for name, points in (("borehole.xyz", borehole), ("room.xyz", room)):
        np.savetxt(tmp_path / name, points)
        assert len(imported_scene(tmp_path, tmp_path / name)[0]) == 400


def test_longitude_and_latitude_without_a_word_are_refused(tmp_path, cloud):
    points = (cloud.points - UTM) * [1e-5, 1e-5, 1] + [8.1, 47.2, 400]
    np.savetxt(tmp_path / "a.xyz", points)
    with pytest.raises(StageError, match="seems to be in degrees: x and y vary by"):
        imported_scene(tmp_path, tmp_path / "a.xyz")


@pytest.mark.parametrize(
    "name, content, sentence",
    [
        ("a.xyz", "", r"is empty \(0 bytes\)"),
        ("a.xyz", "1 2 3\n" * 300, "only 1 different positions among its 300 points; 200 or more are needed"),
        ("a.xyz", "nan nan nan\n" * 300, "300 rows without a finite position"),
        ("a.dwg", "", r"'\.dwg' is no cloud's ending"),
        ("a.laz", "LASF", "not a readable LAZ cloud"),
    ],
    ids=["empty", "one point", "NaN", "unknown ending", "cut short"],
)
def test_a_bad_cloud_is_one_sentence_and_leaves_nothing(tmp_path, name, content, sentence):
    (tmp_path / name).write_text(content)
    with pytest.raises(StageError, match=sentence):
        imported_scene(tmp_path, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_points_of_an_objects_own_file_reach_the_world_by_the_ledger(tmp_path, cloud):
    imported_scene(tmp_path, write_as(tmp_path / "a.laz", cloud))
    moved = Cloud(cloud.points / 3 + [7000.0, 0, 0])
    write_cloud(tmp_path / "b.ply", moved)
    import_object_cloud(source=tmp_path / "b.ply", cloud=tmp_path / "object.ply", report=tmp_path / "object.json")
    obj, scene = read_cloud(tmp_path / "object.ply").points, read_cloud(tmp_path / "dense.ply").points
    pose = Sim3(3.0, np.eye(3), scene[0] - 3 * obj[0])
    ledger = frame_ledger(pose, tmp_path / "object.json", tmp_path / "georeference.json")
    matrix = np.array(value(ledger, "world_from_file"))
    assert np.allclose(moved.points @ matrix[:3, :3].T + matrix[:3, 3], cloud.points, atol=1e-3)


def test_fiducials_of_a_cloud_are_in_its_own_coordinates_and_clicks_are_refused(tmp_path, cloud):
    found = imported_scene(tmp_path, write_as(tmp_path / "a.laz", cloud))[0]
    rows = "".join(f"p{k}\t{x}\t{y}\t{z}\n" for k, (x, y, z) in enumerate(cloud.points[:5].tolist()))
    (tmp_path / "marks.tsv").write_text("point\tx\ty\tz\n" + rows)
    names, points = points_in(tmp_path / "marks.tsv", tmp_path / "georeference.json")
    assert names == ["p0", "p1", "p2", "p3", "p4"] and np.allclose(points, found.points[:5], atol=1e-3)
    (tmp_path / "clicks.tsv").write_text("point\tphoto\tx_px\ty_px\nroof\t1.jpg\t3\t4\n")
    with pytest.raises(StageError, match="clicks.tsv holds clicks in photos, and the scene is a cloud without photos"):
        points_in(tmp_path / "clicks.tsv", tmp_path / "georeference.json")


def test_fusion_does_what_the_photos_that_there_are_allow():
    wanted = FusionSettings()
    assert possible(wanted, True, False) == possible(wanted, True, True) == (wanted, [])
    settings, notes = possible(wanted, False, True)
    assert (settings.mode, settings.unconfirmed) == ("evidence", "all") and "the object has no photos" in notes[0]
    settings, notes = possible(wanted, False, False)
    assert settings.mode == "fill" and "neither side has photos" in notes[0]
    assert possible(FusionSettings(mode="replace"), False, False)[0].mode == "replace"


def test_what_was_guessed_of_a_text_s_columns_is_in_the_report(tmp_path):
    points = np.random.default_rng(0).uniform(0, 9, (300, 3)).round(3)
    np.savetxt(tmp_path / "a.txt", np.column_stack([np.arange(300), points]), fmt="%.3f")
    _, report, _ = imported_scene(tmp_path, tmp_path / "a.txt")
    assert value(report, "notes") == [
        "a.txt: its first column names or numbers the points and is left out; the next three are x, y and z"
    ]
