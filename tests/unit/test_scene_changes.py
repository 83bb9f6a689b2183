"""Changes to a scene: laid on any part of it they give what they give on all of it."""

import numpy as np
import pytest
from support.changed_scene import write_changes

from scenefuse.cloud import tiled_cloud
from scenefuse.cloud.clouds import Cloud, concatenate, write_cloud
from scenefuse.cloud.tiled_cloud import open_cloud
from scenefuse.fuse.measure import Evidence
from scenefuse.fuse.write import added_by, after_fusion, merged, read_changes


@pytest.fixture
def scene():
    """1000 points along a line."""
    return Cloud(np.column_stack([np.arange(1000.0), np.zeros((1000, 2))]))


def changes(folder, scene, rows, removed, evidence):
    folder.mkdir()
    write_changes(folder, scene, scene[:1], rows, removed, evidence)
    return read_changes(folder / "checked.ply")


def test_what_is_left_of_parts_is_what_is_left_of_all(tmp_path, scene):
    found = changes(tmp_path / "a", scene, [3, 300, 301, 990], [300, 990], Evidence.MEASURED)
    rows = np.arange(1000)
    whole = found.left_of(rows, scene)
    assert np.array_equal(whole.points[:, 0], np.setdiff1d(rows, [300, 990]))
    assert whole.points[whole.fields["evidence"] == Evidence.MEASURED, 0].tolist() == [3, 301]
    parts = concatenate([found.left_of(part, scene[part]) for part in np.split(rows, [0, 4, 300, 301, 700])])
    assert np.array_equal(parts.points, whole.points)
    assert np.array_equal(parts.fields["evidence"], whole.fields["evidence"])
    assert found.removed_in(np.array([0, 300, 301, 1000])).tolist() == [0, 1, 1]


def test_a_point_goes_if_any_object_takes_it_away_and_what_one_measured_stays_known(tmp_path, scene):
    one = changes(tmp_path / "one", scene, [1, 2, 3, 4], [2], Evidence.MEASURED)
    two = changes(tmp_path / "two", scene, [2, 3, 4, 5], [4], Evidence.STEREO_ONLY)
    for order in ([one, two], [two, one]):
        both = merged(order)
        assert both.rows.tolist() == [1, 2, 3, 4, 5] and both.rows[both.removed].tolist() == [2, 4]
        assert both.fields["evidence"].tolist() == [Evidence.MEASURED] * 4 + [Evidence.STEREO_ONLY]
    assert len(merged([]).left_of(np.arange(1000), scene)) == 1000


def test_near_a_box_the_scene_after_fusion_is_read_from_a_few_tiles(tmp_path, scene, monkeypatch):
    monkeypatch.setattr(tiled_cloud, "WHOLE", 100)
    monkeypatch.setattr(tiled_cloud, "TILE", 10)
    write_cloud(tmp_path / "dense.ply", scene)
    added = Cloud(scene.points[500:503] + [0.5, 0, 0])
    write_changes(tmp_path, scene, added, [500, 501, 999], [501])
    files = tmp_path / "checked.ply", tmp_path / "fused.ply"
    after = after_fusion(open_cloud(tmp_path / "dense.ply"), *files, np.array([498, -1, -1]), np.array([503, 1, 1.0]))
    assert np.array_equal(
        np.sort(after.points[:, 0]), np.sort([*range(490, 501), *range(502, 510), 500.5, 501.5, 502.5])
    )
    assert after.fields["source"].tolist() == [0] * 19 + [1] * 3
    assert np.array_equal(added_by(files[1]).points, added.points)
