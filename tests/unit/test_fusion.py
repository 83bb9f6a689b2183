"""Fusion on hand-made clouds: what is added, what is taken away, and where it says it comes from."""

from dataclasses import replace

import numpy as np
import pytest

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.core.stage import quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.fuse.fuse_object import FusionInputs, FusionOutputs, fuse_object
from scenefuse.fuse.modes import FusionSettings, fuse_by_distance
from scenefuse.fuse.write import feathered, match_colors, read_changes

SETTINGS = FusionSettings(mode="fill")


def sheet(low, high, step, color, z=0.0):
    """A flat grid, x from low to high, y from 0 to 4."""
    x, y = np.meshgrid(np.arange(low, high, step), np.arange(0, 4, step))
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)
    shade = 0.6 + 0.4 * np.sin(points[:, 1:2])
    return Cloud(
        points,
        np.tile(np.array([0, 0, 1], np.float32), (len(points), 1)),
        (np.array(color) * shade).astype(np.uint8),
    )


@pytest.fixture
def scene():
    return sheet(0, 4, 0.1, [200, 100, 50])


@pytest.fixture
def obj():
    return sheet(0, 8, 0.05, [100, 100, 100])


def test_fill_adds_only_what_the_scene_lacks(scene, obj):
    fusion = fuse_by_distance(obj, scene, scene, Sim3.identity(), SETTINGS)
    assert len(fusion.removed) == 0
    assert fusion.added.points[:, 0].min() > 4.0
    assert (fusion.added.points[:, 0] > 4.2).sum() == (obj.points[:, 0] > 4.2).sum()


def test_append_adds_everything(scene, obj):
    fusion = fuse_by_distance(obj, scene, scene, Sim3.identity(), replace(SETTINGS, mode="append"))
    assert len(fusion.added) == len(obj) and len(fusion.removed) == 0


def test_replace_takes_the_scene_away_under_the_object(scene, obj):
    half = obj[obj.points[:, 0] > 2]
    fusion = fuse_by_distance(half, scene, scene, Sim3.identity(), replace(SETTINGS, mode="replace"))
    left = fusion.kept.points[:, 0]
    assert (left < 1.8).sum() == (scene.points[:, 0] < 1.8).sum() and not (left > 2.2).any()


def test_the_seam_blends_colors_and_moves_no_point(scene):
    raised = sheet(2, 8, 0.05, [100, 100, 250], z=0.1)
    blended = feathered(raised, scene[scene.points[:, 0] < 2], width=1.0, fill=0.1)
    change = np.abs(blended.colors.astype(int) - raised.colors).max(1)
    assert np.array_equal(blended.points, raised.points)
    assert change[raised.points[:, 0] < 2.1].min() > 20 and change[raised.points[:, 0] > 4].max() == 0


def test_colors_of_what_is_added_follow_the_scene(scene, obj):
    added = fuse_by_distance(obj, scene, scene, Sim3.identity(), SETTINGS).added
    expected = np.array([200, 100, 50]) * (0.6 + 0.4 * np.sin(added.points[:, 1:2]))
    assert np.abs(added.colors - expected).mean() < 5


def test_gain_and_bias_are_recovered():
    a = np.random.default_rng(0).integers(20, 120, (500, 3)).astype(np.uint8)
    gain, bias = match_colors(a, (1.5 * a + 10).astype(np.uint8))
    assert np.allclose(gain, 1.5, atol=0.03) and np.allclose(bias, 10, atol=3)


@pytest.mark.parametrize("status", ["registered", "unregistered", "ungated"])
def test_stage_keeps_provenance_and_survives_an_unregistered_object(tmp_path, scene, obj, status):
    pose = Sim3(2.0, np.eye(3), np.array([1.0, 2.0, 3.0]))
    for name, cloud in (("scene", scene), ("crop", scene), ("object", obj.transformed(pose.inverse()))):
        write_cloud(tmp_path / f"{name}.ply", cloud)
    write_json(
        tmp_path / "crop.json",
        {
            "level_from_scene": quantity(np.eye(3), ""),
            "box_low": quantity([-1, -1, -1], ""),
            "box_high": quantity([3, 9, 1], ""),
        },
    )
    write_json(
        tmp_path / "fine.json",
        {
            "status": quantity(status, ""),
            "reason": quantity("because", ""),
            "scene_from_object": quantity(pose.matrix, ""),
        },
    )
    write_json(
        tmp_path / "georeference.json",
        {
            "length_unit": quantity("m", ""),
            "origin_latitude_deg": quantity(47.4, "deg"),
            "origin_longitude_deg": quantity(8.55, "deg"),
            "origin_altitude_m": quantity(430.0, "m"),
        },
    )
    fuse_object(
        inputs=FusionInputs(
            object=tmp_path / "object.ply",
            scene=tmp_path / "scene.ply",
            crop=tmp_path / "crop.ply",
            crop_json=tmp_path / "crop.json",
            fine_json=tmp_path / "fine.json",
            georeference_json=tmp_path / "georeference.json",
        ),
        outputs=FusionOutputs(
            fused=tmp_path / "fused.ply",
            checked=tmp_path / "checked.ply",
            evidence=tmp_path / "evidence.json",
            report=tmp_path / "fusion.json",
        ),
        settings=SETTINGS,
    )
    around, report = read_cloud(tmp_path / "fused.ply"), read_json(tmp_path / "fusion.json")
    assert report["fill_distance"]["unit"] == "m"
    added = value(report, "added_points")
    assert (added > 0) == (status != "unregistered") and value(report, "registration") == status
    assert (around.fields["source"] == 1).sum() == added
    assert around.fields["source"].dtype == np.uint16 and not around.fields["evidence"].any()
    assert value(read_json(tmp_path / "evidence.json"), "notes") == ["no photo was compared"]
    assert len(around) == (scene.points[:, 0] <= 3).sum() + added
    assert len(read_changes(tmp_path / "checked.ply").rows) == 0
