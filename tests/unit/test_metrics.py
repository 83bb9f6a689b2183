"""Metrics against hand-computed values."""

from dataclasses import replace

import numpy as np
import pytest

from scenefuse.cloud.clouds import Cloud, write_cloud
from scenefuse.core.stage import quantity, read_json, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.geometry.surface import SAMPLED_POINTS
from scenefuse.metrics.compute_metrics import (
    Completion,
    MetricSettings,
    box_size,
    completion_metrics,
    completion_of,
    compute_metrics,
    local_density,
    primitive_fitting_score,
    surface_variation,
)
from scenefuse.register.score import registration_metrics, self_consistency

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
    assert found["fitness"]["value"] == pytest.approx(0.25)  # of the scene's points, as the paper
    assert found["fitness_source"]["value"] == pytest.approx(0.5)  # of the object's, as Open3D
    assert found["fitness_f_score"]["value"] == pytest.approx(2 * 0.5 * 0.25 / 0.75)
    assert found["inlier_rmse"]["value"] == pytest.approx(0.3)
    assert found["inlier_rmse_over_diagonal"]["value"] == pytest.approx(0.03)
    assert found["normal_consistency"]["value"] == pytest.approx(1.0)


def test_normals_of_unrelated_surfaces_agree_by_chance_only():
    rng = np.random.default_rng(0)
    found = registration_metrics(
        Cloud(rng.uniform(size=(3000, 3))), Cloud(rng.uniform(size=(3000, 3))), Sim3.identity(), 0.2, 1.0, "m"
    )
    assert found["normal_consistency"]["value"] == pytest.approx(0.5, abs=0.1)


def test_an_object_that_is_too_small_has_a_low_fitness_though_all_of_it_lies_on_the_scene():
    scene = Cloud(grid(40))
    found = registration_metrics(scene, scene, Sim3(0.2, np.eye(3), np.zeros(3)), 0.9, 50.0, "m")
    assert found["fitness_source"]["value"] == 1.0
    assert found["fitness"]["value"] == pytest.approx(9**2 / 40**2)


@pytest.mark.slow
def test_self_consistency_is_of_both_whole_clouds_at_their_own_density():
    """A ripple whose normals turn by 90 degrees every half unit: a thinned cloud has more of its neighbours there."""
    x, y = np.meshgrid(np.arange(0, 60, 0.05), np.arange(0, 6, 0.05))
    ripple = np.stack([x.ravel(), y.ravel(), np.abs(x.ravel() % 1 - 0.5)], axis=1)
    assert len(ripple) > 7 * SAMPLED_POINTS
    assert self_consistency(ripple) > 0.93 > 0.9 > self_consistency(ripple[::7])
    flat, far = grid(30), ball(900) * 30 + [500, 0, 0]
    alone, both = (
        registration_metrics(Cloud(obj), Cloud(flat), Sim3.identity(), 0.5, 50.0, "m")["normal_consistency_self"]
        for obj in (flat + [0, 0, 0.1], far)
    )
    # What is of the object and far from the scene counts too.
    assert alone["value"] > 0.99 and both["value"] < 0.9


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
    fields = {"source": np.repeat([0, 1], 3000).astype(np.uint8), "deviation": np.linspace(-1, 1, 6000, dtype="f4")}
    both = Cloud(np.concatenate([scene, added]), fields=fields)
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
    assert content["object"]["size"]["unit"] == "m"
    # Of the points added alone.
    assert content["object"]["deviation"] == {"value": pytest.approx(0.5, abs=0.01), "unit": "m"}
    assert content["object"]["deviation_90"] == {"value": pytest.approx(0.9, abs=0.01), "unit": "m"}
    completion = {name: item["value"] for name, item in content["completion"].items()}
    assert content["registration"]["fitness"]["value"] == 1.0
    assert content["registration"]["tau"]["unit"] == "m"
    assert completion["surface_variation"] < 1e-6
    assert completion["nue"] == pytest.approx(1.0, abs=0.15)
    assert completion["primitive_fitting_score"] > 0.95
    for name in ("surface_variation", "nue", "nue_density_invariant", "primitive_fitting_score"):
        assert f"{name}_null" in completion


def test_a_five_times_denser_completion_shows_in_nue_but_not_in_its_invariant_form():
    rng = np.random.default_rng(0)
    scene, dense = (rng.uniform(0, 4, (n, 3)) * [1, 1, 0] for n in (2000, 10000))
    settings = replace(SETTINGS, primitive_most=2)
    found = completion_metrics(Completion(scene, scene[:0], dense, 6.0), settings, 0)
    assert found["nue"]["value"] == pytest.approx(5, rel=0.25)
    assert found["nue_density_invariant"]["value"] == pytest.approx(1, rel=0.2)


def test_nue_is_of_the_completed_cloud_not_only_of_what_was_added():
    """Half of it five times as dense: even within each half, uneven as a whole."""
    rng = np.random.default_rng(0)
    scene, dense = (rng.uniform(0, 4, (n, 3)) * [1, 1, 0] for n in (4000, 10000))
    half = scene[scene[:, 0] < 2]
    settings = replace(SETTINGS, primitive_most=2)
    found = completion_metrics(Completion(scene, half, dense * [0.5, 1, 1] + [2, 0, 0], 6.0), settings, 0)
    # By hand: densities 1 and 5 at 1 and 5 shares of the points; 16 neighbours add a quarter of each as noise.
    mean, noise = (1 * 1 + 5 * 5) / 6, 0.25
    spread = np.sqrt(((1 - mean) ** 2 + 5 * (5 - mean) ** 2) / 6 + noise**2 * (1 + 5 * 25) / 6)
    assert found["nue_density_invariant"]["value"] == pytest.approx(spread / mean / noise, rel=0.15)


def test_what_fusion_took_away_counts_no_longer():
    rng = np.random.default_rng(0)
    good = rng.uniform(0, 4, (1500, 3)) * [1, 1, 0]
    bad = rng.uniform(0, 4, (1500, 3)) * [1, 1, 0.2] + [4, 0, 0]
    new = rng.uniform(0, 4, (1500, 3)) * [1, 1, 0] + [4, 0, 0]
    ground = rng.uniform(-2, 8, (500, 3)) * [1, 1, 0] - [0, 0, 0.5]
    other = ball(300) + [4, 2, 1]
    fused = Cloud(
        np.concatenate([ground, good, other, new]),
        fields={"source": np.repeat([0, 1, 3], [2000, 300, 1500]).astype(np.uint16)},
    )
    part = completion_of(np.concatenate([bad, good]), fused, 3, 9.0)
    assert np.array_equal(np.sort(part.kept, axis=0), np.sort(good, axis=0)) and np.array_equal(part.added, new)
    found = completion_metrics(part, replace(SETTINGS, primitive_most=3), 0)
    before, after = (found[f"surface_variation_{when}"]["value"] for when in ("before", "after"))
    assert after < 1e-9 < 0.01 < before
    before, after = (found[f"primitive_fitting_score_{when}"]["value"] for when in ("before", "after"))
    assert after > 0.95 > 0.8 > before


def test_next_to_nothing_that_was_added_has_no_measures():
    scene = np.random.default_rng(0).uniform(0, 4, (2000, 3)) * [1, 1, 0]
    found = completion_metrics(Completion(scene, scene, scene[:3], 6.0), SETTINGS, 0)
    assert found["nue"]["value"] is None and found["added_points"]["value"] == 3


def test_every_part_of_what_was_added_counts_in_the_surface_variation():
    """A smooth part that comes first in the file does not hide a rough part behind it."""
    rng = np.random.default_rng(0)
    scene = rng.uniform(0, 4, (2000, 3)) * [1, 1, 0]
    smooth = rng.uniform(0, 4, (1500, 3)) * [1, 1, 0] + [4.2, 0, 0]
    rough = rng.uniform(0, 4, (1500, 3)) * [1, 1, 0.1] + [8.4, 0, 0]
    settings = replace(SETTINGS, primitive_most=2, sample=1500)
    found = [
        completion_metrics(Completion(scene, scene, np.concatenate(parts), 10.0), settings, 0)
        for parts in ([smooth, rough], [rough, smooth])
    ]
    first, second = (f["surface_variation"]["value"] for f in found)
    assert first == pytest.approx(second, rel=0.15) and first > 0.005


def test_the_size_is_that_of_the_upright_box_however_the_object_stands_in_the_scene():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (20_000, 3)) * [4, 2, 2]
    points[:5] *= 9  # stray points do not make it larger
    points[5:35] = np.linspace([0, 0, 1], [0, 0, 2], 30)  # a spire does
    points[35:95] = [0, 0, -1] + np.linspace([0, 0, 0], [0, 3, 0.05], 60)  # ground at its foot does not
    turned = np.radians(30)
    turn = np.array([[np.cos(turned), -np.sin(turned), 0], [np.sin(turned), np.cos(turned), 0], [0, 0, 1]])
    np.testing.assert_allclose(box_size(points @ turn.T + 100.0), [4, 2, 3], rtol=0.05)
