"""Clouds that are read by place: the points near a box, in their rows, whatever the cloud's size."""

from types import SimpleNamespace

import numpy as np
import pytest
from plyfile import PlyData

from scenefuse.cloud import tiled_cloud
from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud, spacing, write_cloud
from scenefuse.cloud.tiled_cloud import open_cloud, write_tiled
from scenefuse.core.stage import StageError

LOW, HIGH = np.array([30.0, 40.0, -1.0]), np.array([36.0, 47.0, 3.0])


@pytest.fixture
def small_tiles(monkeypatch):
    """Clouds of more than 2000 points are large, tiles hold 500, and 3000 are held at once."""
    for name, number in {"WHOLE": 2000, "TILE": 500}.items():
        monkeypatch.setattr(tiled_cloud, name, number)
    monkeypatch.setattr(tiled_cloud, "AT_ONCE", 3000)
    monkeypatch.setattr(tiled_cloud, "POINTS_A_CELL", 20)


@pytest.fixture
def cloud():
    """20,000 points of 100 m x 100 m of rolling ground in no order, with a stray a kilometre away."""
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 100, (20000, 3))
    points[:, 2] = np.sin(points[:, 0] / 9) + 0.01 * points[:, 2]
    points[77] = [1000.0, 0, 50]
    colors = rng.integers(0, 256, (20000, 3)).astype(np.uint8)
    fields = {"views": rng.integers(0, 9, 20000).astype(np.uint16)}
    return Cloud(points, rng.normal(size=(20000, 3)).astype(np.float32), colors, fields)


def write(path, cloud, pieces=3):
    """The cloud as tiles, given in pieces, one of them empty."""
    rows = [*np.array_split(np.arange(len(cloud)), pieces), np.arange(0)]
    write_tiled(path, lambda: (cloud[part] for part in rows), len(cloud), cloud.points)
    return open_cloud(path)


def sorted_rows(cloud):
    """All that is known of each point, in an order of its own."""
    table = np.column_stack([cloud.points, cloud.normals, cloud.colors, *cloud.fields.values()])
    return table[np.lexsort(table.T)]


def inside(points):
    return ((points >= LOW) & (points <= HIGH)).all(1)


def test_a_box_of_a_large_cloud_is_read_from_a_few_tiles(small_tiles, tmp_path, cloud):
    tiles = write(tmp_path / "a.ply", cloud)
    assert len(tiles) == len(cloud) and len(tiles.low) > 20
    rows, near = tiles.near(LOW, HIGH)
    assert np.array_equal(sorted_rows(near[inside(near.points)]), sorted_rows(cloud[inside(cloud.points)]))
    assert len(near) < 0.25 * len(cloud)
    # A row is a point's place in the file, which other programs read as a PLY.
    whole = read_cloud(tmp_path / "a.ply")
    assert np.array_equal(whole.points[rows], near.points) and (np.diff(rows) > 0).all()
    assert np.array_equal(sorted_rows(whole), sorted_rows(cloud))
    assert [element.name for element in PlyData.read(tmp_path / "a.ply").elements] == ["vertex", "tile"]


def test_every_tile_lies_in_its_box_and_a_stray_widens_only_its_own(small_tiles, tmp_path, cloud):
    tiles = write(tmp_path / "a.ply", cloud)
    for number in range(len(tiles.low)):
        points = tiles.read(np.array([number]))[1].points
        assert np.array_equal(points.min(0), tiles.low[number]) and np.array_equal(points.max(0), tiles.high[number])
    assert (tiles.high[:, 0] > 101).sum() == 1


def test_parts_and_single_rows_are_those_of_the_file(small_tiles, tmp_path, cloud):
    tiles, whole = write(tmp_path / "a.ply", cloud), read_cloud(tmp_path / "a.ply")
    parts = list(tiles.parts())
    assert len(parts) == 7 and np.array_equal(concatenate([part for _, part in parts]).points, whole.points)
    few = [(rows, part.points) for rows, part in tiles.parts(every=7)]
    assert np.array_equal(np.concatenate([points for _, points in few]), whole.points[::7])
    assert np.array_equal(np.concatenate([rows for rows, _ in few]), np.arange(0, 20000, 7))
    wanted = np.random.default_rng(1).permutation(20000)[:100]
    assert np.array_equal(tiles.rows(wanted).points, whole.points[wanted])
    assert tiles.spacing() == pytest.approx(spacing(whole.points), rel=0.1)


def test_a_cloud_that_is_not_large_keeps_its_order(tmp_path, cloud):
    tiles = write(tmp_path / "a.ply", cloud)
    rows, near = tiles.near(LOW, HIGH)
    assert np.array_equal(near.points, cloud.points) and np.array_equal(rows, np.arange(len(cloud)))
    assert tiles.spacing() == spacing(cloud.points)


def test_a_cloud_without_tiles_is_read_by_place_too(small_tiles, tmp_path, cloud):
    ordered = cloud[np.argsort(cloud.points[:, 0])]
    write_cloud(tmp_path / "a.ply", ordered)
    rows, near = open_cloud(tmp_path / "a.ply").near(LOW, HIGH)
    assert np.array_equal(ordered.points[rows], near.points) and len(near) < 0.2 * len(cloud)
    assert inside(near.points).sum() == inside(cloud.points).sum()


def test_where_nothing_is_near_the_nearest_tile_is_read(small_tiles, tmp_path, cloud):
    tiles = write(tmp_path / "a.ply", cloud)
    near = tiles.near(np.full(3, 900.0) * [1, 0, 0], np.full(3, 950.0))[1]
    assert 1000 in near.points[:, 0] and len(near) < 1000


def test_an_empty_cloud_is_read(tmp_path, cloud):
    write_cloud(tmp_path / "a.ply", cloud[np.zeros(len(cloud), dtype=bool)])
    rows, near = open_cloud(tmp_path / "a.ply").near(LOW, HIGH)
    assert len(rows) == len(near) == 0 and near.colors is not None and list(near.fields) == ["views"]


def test_bad_files_are_one_sentence(tmp_path, cloud):
    write(tmp_path / "a.ply", cloud)
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "short.ply").write_bytes(whole[:-1000])
    (tmp_path / "text.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
    for name, sentence in {
        "short.ply": "short.ply is cut short: its last .* are missing; delete it",
        "text.ply": "text.ply is no cloud that a stage of this project wrote",
        "none.ply": "none.ply does not exist",
    }.items():
        with pytest.raises(StageError, match=sentence):
            open_cloud(tmp_path / name)


def test_a_full_disk_is_said_before_anything_is_written(tmp_path, cloud, monkeypatch):
    monkeypatch.setattr(tiled_cloud.shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(
        StageError, match=r"the disk is too full for .*a\.ply: it needs 0\.00082 GB and 1e-06 GB are free"
    ):
        write(tmp_path / "a.ply", cloud)
    assert not list(tmp_path.iterdir())
