"""The crop keeps the object and nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from planted import plant

from scenefuse.clouds import Cloud, concatenate, read_cloud, write_cloud
from scenefuse.registration.crop import CropSettings, crop_cloud, crop_scene
from scenefuse.registration.ground import fit_ground
from scenefuse.stage import StageError, quantity, read_json, value, write_json

Z = np.array([0.0, 0.0, 1.0])
SETTINGS = CropSettings(
    margin=0.05,
    margin_fraction=0.04,
    remove_ground=True,
    ring_fraction=0.5,
    ground_fraction=0.015,
    link_fraction=0.03,
    reach_fraction=0.05,
    min_part=0.01,
    min_points=200,
    max_residual_px=5.0,
)


@pytest.mark.parametrize("slope", [0.0, 0.15])
def test_ground_goes_and_the_object_stays(slope):
    trial = plant("house", 2, noise=0.002, slope=slope, object_points=4000, density_ratio=1.0)
    own = np.arange(len(trial.scene)) < 3000
    keep = crop_cloud(trial.scene, trial.fiducials, Z, SETTINGS).keep
    above = trial.scene.points[:, 2] > slope * trial.scene.points[:, 0] + 1.0
    assert keep[own & above].mean() > 0.98
    assert (keep & ~own).sum() < 0.05 * keep.sum()


def test_a_tree_inside_the_box_is_left_out():
    trial = plant("house", 2, noise=0.002, object_points=4000, density_ratio=1.0)
    rng = np.random.default_rng(0)
    tree = trial.fiducials.max(0) * [1, 1, 0] + [0.9, 0.9, 3.0] + rng.normal(0, 0.15, (60, 3))
    scene = concatenate([Cloud(trial.scene.points), Cloud(tree)])
    keep = crop_cloud(scene, trial.fiducials, Z, replace(SETTINGS, margin=0.2)).keep
    assert not keep[-60:].any()


def test_without_ground_nothing_is_removed_and_that_is_said():
    trial = plant("sculpture", 1, ground=False, noise=0.002, object_points=4000, density_ratio=1.0)
    cut = crop_cloud(trial.scene, trial.fiducials, Z, SETTINGS)
    assert cut.ground is None and cut.keep.mean() > 0.97
    assert "no ground" in cut.notes[0]


def test_parts_far_from_every_fiducial_are_kept_and_that_is_said():
    trial = plant("sculpture", 1, ground=False, noise=0.002, object_points=4000, density_ratio=1.0)
    low, high = trial.scene.points.min(0), trial.scene.points.max(0)
    far = low + (high - low) * np.array([[-9, -9, -9], [9, -9, -9], [-9, 9, -9], [9, 9, 9]])
    cut = crop_cloud(trial.scene, far, Z, replace(SETTINGS, reach_fraction=1e-6, min_part=1.1))
    assert cut.keep.all() and "no part in the box lies near a fiducial" in cut.notes[1]


def test_ground_is_a_height_field_with_the_planted_slope():
    rng = np.random.default_rng(0)
    points = rng.uniform(-10, 10, (5000, 3))
    points[:, 2] = 0.1 * points[:, 0] - 0.2 * points[:, 1] + 3
    ground = fit_ground(points, np.array([-3.0, -3, 0]), np.array([3.0, 3, 9]), 4.0, 0.1)
    assert ground.height(np.array([[1.0, 2.0]]))[0] == pytest.approx(0.1 - 0.4 + 3, abs=0.05)


def test_stage_writes_the_crop_and_its_box(tmp_path):
    trial = plant("house", 2, noise=0.002, object_points=4000, density_ratio=1.0)
    files = stage_files(tmp_path, trial, trial.fiducials)
    crop_scene(**files, mode="fiducials", settings=SETTINGS)
    report = read_json(files["report"])
    assert value(report, "crop_points") == len(read_cloud(files["crop"])) > 2500
    assert value(report, "up_in_scene") == [0.0, 0.0, 1.0] and report["diagonal"]["unit"] == "scene units"
    write_json(tmp_path / "georeference.json", {"length_unit": quantity("m", "")})
    crop_scene(**files, georeference=tmp_path / "georeference.json", mode="fiducials", settings=SETTINGS)
    assert read_json(files["report"])["diagonal"]["unit"] == "m"
    crop_scene(**files, mode="none", settings=SETTINGS)
    assert len(read_cloud(files["crop"])) == len(trial.scene)


def test_bad_fiducials_end_in_one_sentence(tmp_path):
    trial = plant("house", 2, noise=0.002, object_points=4000, density_ratio=1.0)
    cases = [
        (trial.fiducials[:3], "at least 4"),
        (trial.fiducials + [500, 0, 0], "nearest scene point"),
        (trial.fiducials[:1] + 0.05 * np.eye(4, 3), "a fiducial may lie outside"),
    ]
    for fiducials, sentence in cases:
        files = stage_files(tmp_path, trial, fiducials)
        with pytest.raises(StageError, match=sentence):
            crop_scene(**files, mode="fiducials", settings=SETTINGS)
        assert not files["crop"].exists()


def stage_files(folder, trial, fiducials):
    lines = [f"p{k}\t{x}\t{y}\t{z}" for k, (x, y, z) in enumerate(fiducials)]
    (folder / "fiducials.tsv").write_text("point\tx\ty\tz\n" + "\n".join(lines) + "\n")
    write_cloud(folder / "dense.ply", trial.scene)
    return {
        "scene": folder / "dense.ply",
        "model": folder,
        "fiducials": folder / "fiducials.tsv",
        "crop": folder / "crop.ply",
        "report": folder / "crop.json",
    }
