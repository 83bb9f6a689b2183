"""Clouds written as COPC: every reader of LAZ has all points, and a reader of COPC what is near or coarse."""

import sys
import tracemalloc
from dataclasses import replace

import laspy
import numpy as np
import pytest
from laspy.copc import load_octree_for_query
from scipy.spatial import cKDTree

from scenefuse.cloud import copc, tiled_cloud
from scenefuse.cloud.clouds import Cloud, write_cloud
from scenefuse.cloud.copc import write_copc
from scenefuse.cloud.tiled_cloud import TiledCloud, open_cloud, write_tiled
from scenefuse.core.stage import StageError
from scenefuse.photos.geodesy import LocalFrame

UTM = np.array([462_000.0, 5_260_000.0, 400.0])


@pytest.fixture
def small_nodes(monkeypatch):
    """Tiles of 500 points, cubes of 3000 in memory, nodes of 200 points and 8 cells along an axis."""
    for name, number in {"WHOLE": 2000, "TILE": 500, "POINTS_A_CELL": 20}.items():
        monkeypatch.setattr(tiled_cloud, name, number)
    for name, number in {"AT_ONCE": 3000, "NODE_POINTS": 200, "GRID_BITS": 3, "TILES_HELD": 2}.items():
        monkeypatch.setattr(copc, name, number)


def ground(count=20_000, seed=0):
    """Rolling ground of 100 m x 100 m, half of its points on a plot of 10 m x 10 m."""
    rng = np.random.default_rng(seed)
    x, y = np.concatenate([rng.uniform(0, 100, (count // 2, 2)), rng.uniform(40, 50, (count // 2, 2))]).T
    points = np.stack([x, y, 2 * np.sin(x / 9)], axis=1)
    fields = {"source": np.arange(count, dtype=np.uint16), "deviation": rng.random(count).astype(np.float32)}
    return Cloud(points, colors=rng.integers(0, 256, (count, 3)).astype(np.uint8), fields=fields)


def turned(points):
    """A CRS whose axes are turned against the cloud's."""
    return np.stack([-points[:, 1], points[:, 0], points[:, 2]], axis=1) + UTM


def written(folder, cloud, in_crs=turned, crs="EPSG:32632"):
    """The cloud as tiles, and those as COPC."""
    write_tiled(folder / "a.ply", lambda: [cloud], len(cloud), cloud.points)
    write_copc(folder / "a.copc.laz", open_cloud(folder / "a.ply"), in_crs, crs)
    return folder / "a.copc.laz"


def places(found):
    return np.stack([found.x, found.y, found.z], axis=1)


@pytest.mark.slow
def test_every_point_is_there_once_with_all_it_had(tmp_path, small_nodes):
    cloud = ground()
    las = laspy.read(written(tmp_path, cloud))
    order = np.argsort(las["source"])
    assert np.array_equal(las["source"][order], cloud.fields["source"])
    assert np.abs(las.xyz[order] - turned(cloud.points)).max() < 6e-4
    assert np.array_equal(las["deviation"][order], cloud.fields["deviation"])
    colors = np.stack([las.red, las.green, las.blue], axis=1)[order]
    assert np.array_equal(colors // 257, cloud.colors)
    assert las.header.parse_crs().to_epsg() == 32632
    # LAS 1.4 asks for WKT 1; few programs but PROJ's read WKT 2.
    assert las.header.vlrs.get("WktCoordinateSystemVlr")[0].string.startswith("PROJCS[")
    assert np.allclose([las.header.mins, las.header.maxs], [las.xyz.min(0), las.xyz.max(0)], atol=1e-6)
    assert las.header.number_of_points_by_return[0] == len(cloud)


@pytest.mark.slow
def test_a_box_is_read_whole_without_the_rest(tmp_path, small_nodes):
    cloud = ground()
    low, high = UTM + [-30, 20, -3], UTM + [-20, 30, 3]
    inside = ((turned(cloud.points) >= low) & (turned(cloud.points) <= high)).all(1)
    path = written(tmp_path, cloud)
    with laspy.CopcReader.open(path) as file:
        found = file.query(laspy.Bounds(mins=low, maxs=high))
        nodes = load_octree_for_query(
            file.source, file.copc_info, file.root_page, query_bounds=laspy.Bounds(mins=low, maxs=high)
        )
    assert inside.sum() > 50 and set(found["source"]) == set(cloud.fields["source"][inside])
    assert sum(node.point_count for node in nodes) < len(cloud) / 5


@pytest.mark.slow
def test_every_node_lies_in_its_cube(tmp_path, small_nodes):
    path = written(tmp_path, ground())
    with laspy.CopcReader.open(path) as file:
        nodes = load_octree_for_query(file.source, file.copc_info, file.root_page)
        nodes = [node for node in nodes if node.point_count]
        assert len(nodes) > 50 and max(node.key.level for node in nodes) >= 5
        seen = 0
        for node in nodes:
            found = file.query(node.bounds, level=node.key.level)
            assert len(found) >= node.point_count
            seen += node.point_count
    assert seen == 20_000


def test_a_coarse_level_is_even_where_the_cloud_is_not(tmp_path, small_nodes):
    cloud = ground()
    with laspy.CopcReader.open(written(tmp_path, cloud)) as file:
        coarse = places(file.query(level=range(3)))
        cell = file.copc_info.spacing / 4
    in_plot = (np.abs(coarse[:, :2] - turned(np.array([[45.0, 45, 0]]))[0, :2]) < 5).all(1)
    assert in_plot.mean() < 0.03  # a hundredth of the area, with half of the points
    # Every place of the ground has a point of it within two cells.
    assert cKDTree(coarse).query(turned(cloud.points))[0].max() < 2 * np.sqrt(3) * cell


def test_without_a_crs_and_for_few_or_equal_points(tmp_path):
    for points in (np.zeros((1, 3)), np.full((300, 3), 7.25), 5.3 + np.array([[0, 0, 0], [1e-3, 0, 0]])):
        path = written(tmp_path, Cloud(points), lambda x: x, None)
        with laspy.CopcReader.open(path) as file:
            assert file.header.global_encoding.wkt
            assert np.allclose(np.sort(places(file.query()), axis=0), np.sort(points, axis=0), atol=1e-9)


def test_a_cloud_without_colours_has_no_black_ones(tmp_path, small_nodes):
    cloud = replace(ground(3000), colors=None)
    las = laspy.read(written(tmp_path, cloud))
    assert "red" not in las.point_format.dimension_names and len(las.points) == 3000
    assert np.array_equal(np.sort(las["source"]), cloud.fields["source"])


def test_lengths_of_points_are_in_the_unit_of_the_crs(tmp_path, small_nodes):
    cloud, frame = ground(3000), LocalFrame(40.71, -74.0, 10.0, grid="EPSG:2263")
    las = laspy.read(written(tmp_path, cloud, frame.in_crs, frame.crs))
    feet = cloud.fields["deviation"][las["source"]] / 0.3048006
    assert np.allclose(las["deviation"], feet, rtol=1e-5)


def test_a_stray_far_away_costs_digits_and_is_named(tmp_path, capsys):
    points = np.random.default_rng(0).random((1000, 3))
    points[0] = [5e6, 0, 0]
    write_cloud(tmp_path / "a.ply", Cloud(points))
    write_copc(tmp_path / "a.copc.laz", open_cloud(tmp_path / "a.ply"), turned, "EPSG:32632")
    assert "points lie up to 5e+06 from the origin, so a.copc.laz counts in 0.01 of its" in capsys.readouterr().out
    found = laspy.read(tmp_path / "a.copc.laz").xyz
    assert len(found) == 1000 and abs(np.sort(found[:, 1])[-1] - UTM[1] - 5e6) < 0.006


def test_a_stray_without_a_place_in_the_crs_is_named_and_leaves_no_file(tmp_path):
    points = np.random.default_rng(0).random((1000, 3))
    points[7] = [5e7, 0, 0]
    write_cloud(tmp_path / "a.ply", Cloud(points))
    frame = LocalFrame(47.5, 8.5, 400.0)
    with pytest.raises(StageError, match=r"a\.ply: points such as \(5e\+07, 0, 0\) .*no coordinates there: remove"):
        write_copc(tmp_path / "a.copc.laz", open_cloud(tmp_path / "a.ply"), frame.in_crs, frame.crs)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.slow
def test_memory_is_bounded_where_tiles_are_heaps_with_strays(tmp_path, small_nodes, monkeypatch):
    """Boxes that strays stretch over all of the scene say nothing of where the points are."""
    points = np.random.default_rng(0).random((12_000, 3)) * [5, 5, 1]
    points[::50] *= 200
    cloud = Cloud(points)
    parts = np.split(points, 24)
    low, high = (np.array([end(part, 0) for part in parts]) for end in (np.min, np.max))
    heap = TiledCloud(tmp_path / "a.ply", None, 0, np.arange(0, 12_001, 500), low, high)
    monkeypatch.setattr(TiledCloud, "like", property(lambda _: cloud[:0]))
    monkeypatch.setattr(TiledCloud, "read", lambda _, tiles: (None, Cloud(np.concatenate([parts[k] for k in tiles]))))
    peaks = []
    for at_once in (1200, len(cloud)):
        monkeypatch.setattr(copc, "AT_ONCE", at_once)
        tracemalloc.start()
        write_copc(tmp_path / "a.copc.laz", heap, lambda x: x, None)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        found = laspy.read(tmp_path / "a.copc.laz").xyz
        assert np.allclose(np.sort(found, axis=0), np.sort(points, axis=0), atol=1e-4)
    assert peaks[0] < peaks[1] / 2


@pytest.mark.slow
@pytest.mark.parametrize("case", ["stray", "clusters", "equal", "line"])
def test_a_reader_of_the_octree_finds_every_point_through_empty_cubes(tmp_path, small_nodes, case):
    points = np.random.default_rng(0).random((8000, 3)) * [50, 50, 5]
    if case == "stray":
        points[0] = [30_000, 0, 0]
    elif case == "clusters":
        points[4000:] += [3000, 0, 0]
    elif case == "equal":
        points[:] = 7.25
    else:
        points[:, 1:] = 0
    with laspy.CopcReader.open(written(tmp_path, Cloud(points))) as file:
        found = places(file.query())
    assert len(found) == len(points)
    assert np.allclose(np.sort(found, axis=0), np.sort(turned(points), axis=0), atol=6e-4)


@pytest.mark.slow
def test_the_same_cloud_gives_the_same_file(tmp_path, small_nodes):
    one, other = (written(tmp_path, ground()).read_bytes() for _ in range(2))
    assert one == other


@pytest.mark.skipif(sys.platform == "win32", reason="no limit of a file's size")
def test_a_file_that_does_not_fit_leaves_nothing(tmp_path):
    import resource

    write_cloud(tmp_path / "a.ply", Cloud(np.random.default_rng(0).random((200_000, 3))))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(OSError, match="too large"):  # a full disk is put in words for all stages, in stage.py
            write_copc(tmp_path / "a.copc.laz", open_cloud(tmp_path / "a.ply"), lambda x: x, None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
