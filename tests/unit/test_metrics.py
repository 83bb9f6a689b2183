"""Metrics against hand-computed values."""

from dataclasses import replace

import numpy as np
import pytest

from scenefuse.io.clouds import Cloud, write_cloud
from scenefuse.metrics.completion import MetricSettings, completion_metrics, local_density, surface_variation
from scenefuse.metrics.compute_metrics import compute_metrics
from scenefuse.metrics.primitives import primitive_fitting_score
from scenefuse.registration.agreement import registration_metrics
from scenefuse.stage import quantity, read_json, write_json
from scenefuse.transforms import Sim3

SETTINGS = MetricSettings(
    variation_spacings=8.0,
    density_neighbours=16,
    primitive_fraction=0.005,
    primitive_support=0.01,
    primitive_most=20,
    primitive_angle_deg=25.0,
    sample=2000,
)


def grid(n, step=1.0):
    x, y = np.meshgrid(np.arange(n) * step, np.arange(n) * step)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def ball(n, seed=0):
    """Uniform points in a unit ball."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(n, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(size=(n, 1)) ** (1 / 3)


def test_fitness_counts_both_ways_and_rmse_is_the_shift():
    scene = Cloud(grid(20))
    obj = Cloud(np.concatenate([grid(20)[:100] + [0, 0, 0.3], grid(20)[:100] + [0, 0, 50.0]]))
    found = registration_metrics(obj, scene, Sim3.identity(), 0.5, 10.0, "m")
    assert found["fitness_source"]["value"] == pytest.approx(0.5)
    assert found["fitness_target"]["value"] == pytest.approx(0.25)
    assert found["f_score"]["value"] == pytest.approx(2 * 0.5 * 0.25 / 0.75)
    assert found["inlier_rmse"]["value"] == pytest.approx(0.3)
    assert found["inlier_rmse_over_diagonal"]["value"] == pytest.approx(0.03)
    assert found["normal_consistency_cross"]["value"] == pytest.approx(1.0)


def test_normals_of_unrelated_surfaces_agree_by_chance_only():
    rng = np.random.default_rng(0)
    found = registration_metrics(
        Cloud(rng.uniform(size=(3000, 3))), Cloud(rng.uniform(size=(3000, 3))), Sim3.identity(), 0.2, 1.0, "m"
    )
    assert found["normal_consistency_cross"]["value"] == pytest.approx(0.5, abs=0.1)


def test_no_inlier_gives_no_rmse():
    found = registration_metrics(Cloud(grid(5)), Cloud(grid(5) + 100), Sim3.identity(), 0.1, 1.0, "m")
    assert found["inlier_rmse"]["value"] is None and found["fitness_source"]["value"] == 0


def test_surface_variation_is_nothing_on_a_plane_and_a_third_in_a_ball():
    assert surface_variation(grid(20), grid(20), 3.0) == pytest.approx(0.0, abs=1e-12)
    points = ball(20000)
    assert surface_variation(points, np.zeros((1, 3)), 0.9) == pytest.approx(1 / 3, abs=0.01)


def test_density_of_a_square_grid():
    points = grid(41)
    centre = points[[20 * 41 + 20]]
    assert local_density(points, centre, 4)[0] == pytest.approx(4 / np.pi)


def sphere(n=1500, seed=0):
    direction = np.random.default_rng(seed).normal(size=(n, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def cylinder(n=1500, seed=0):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, n)
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    return normals + np.stack([np.zeros(n), np.zeros(n), rng.uniform(0, 4, n)], axis=1), normals


def test_each_kind_of_primitive_is_found():
    points, normals = cylinder()
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    flat = np.random.default_rng(0).uniform(0, 3, (1000, 3)) * [1, 1, 0]
    cases = [
        (sphere(), sphere()),
        (points @ turn.T, normals @ turn.T),
        (flat, np.tile([0.0, 0.0, 1.0], (1000, 1))),
    ]
    for where, facing in cases:
        assert primitive_fitting_score(where, facing, 0.02, 0.05, 1, 20.0, 0) > 0.95


def test_a_random_ball_is_no_primitive():
    points = ball(2000)
    normals = np.random.default_rng(1).normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert primitive_fitting_score(points, normals, 0.01, 0.01, 20, 20.0, 0) < 0.3


def test_stage_writes_completion_with_its_nulls(tmp_path):
    rng = np.random.default_rng(0)
    scene, added = (rng.uniform(0, 4, (3000, 3)) * [1, 1, 0] + [x, 0, 0] for x in (0, 4))
    both = Cloud(np.concatenate([scene, added]), fields={"source": np.repeat([0, 1], 3000).astype(np.uint8)})
    write_cloud(tmp_path / "crop.ply", Cloud(scene))
    write_cloud(tmp_path / "object.ply", Cloud(np.concatenate([scene, added])))
    write_cloud(tmp_path / "fused.ply", both)
    write_json(tmp_path / "crop.json", {"diagonal": quantity(6.0, "m")})
    write_json(
        tmp_path / "fine.json", {"scene_from_object": quantity(np.eye(4), ""), "status": quantity("registered", "")}
    )
    compute_metrics(
        object=tmp_path / "object.ply",
        crop=tmp_path / "crop.ply",
        crop_json=tmp_path / "crop.json",
        fine_json=tmp_path / "fine.json",
        fused=tmp_path / "fused.ply",
        report=tmp_path / "metrics.json",
        seed=0,
        settings=SETTINGS,
    )
    content = read_json(tmp_path / "metrics.json")
    completion = {name: item["value"] for name, item in content["completion"].items()}
    assert content["registration"]["fitness_target"]["value"] == 1.0
    assert content["registration"]["tau"]["unit"] == content["completion"]["surface_variation_radius"]["unit"] == "m"
    assert completion["surface_variation"] < 1e-6
    assert completion["nue"] == pytest.approx(1.0, abs=0.15)
    assert completion["primitive_fitting_score"] > 0.95
    for name in ("surface_variation", "nue", "nue_density_invariant", "primitive_fitting_score"):
        assert f"{name}_null" in completion


def test_a_five_times_denser_completion_shows_in_nue_but_not_in_its_invariant_form(tmp_path):
    rng = np.random.default_rng(0)
    scene = rng.uniform(0, 4, (2000, 3)) * [1, 1, 0]
    dense = rng.uniform(0, 4, (10000, 3)) * [1, 1, 0] + [4.2, 0, 0]
    settings = replace(SETTINGS, primitive_most=2)
    found = completion_metrics(Cloud(scene), Cloud(scene), Cloud(dense), 6.0, "m", settings, 0)
    assert found["nue"]["value"] == pytest.approx(5, rel=0.25)
    assert found["nue_density_invariant"]["value"] == pytest.approx(1, rel=0.2)


def test_every_part_of_what_was_added_counts_in_the_variation_over_wide_radii():
    """A smooth part that comes first in the file does not hide a rough part behind it."""
    rng = np.random.default_rng(0)
    scene = rng.uniform(0, 4, (2000, 3)) * [1, 1, 0]
    smooth = rng.uniform(0, 4, (1500, 3)) * [1, 1, 0] + [4.2, 0, 0]
    rough = rng.uniform(0, 4, (1500, 3)) * [1, 1, 0.1] + [8.4, 0, 0]
    settings = replace(SETTINGS, primitive_most=2, sample=4000)
    found = [
        completion_metrics(Cloud(scene), Cloud(scene), Cloud(np.concatenate(parts)), 10.0, "m", settings, 0)
        for parts in ([smooth, rough], [rough, smooth])
    ]
    for name in ("surface_variation_2pct", "surface_variation_4pct"):
        first, second = (f[name]["value"] for f in found)
        assert first == pytest.approx(second, rel=0.15) and first > 0.005
