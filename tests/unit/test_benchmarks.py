"""The benchmarks fit the library: they import, and what they name by strings is there. mypy checks their calls."""

import dataclasses
import importlib
import re
from pathlib import Path
from types import SimpleNamespace
from typing import get_args, get_type_hints

import numpy as np
import pandas as pd
import pytest
from benchmarks import completed_scene, frames_scaling, lego, object_ablation, object_mvs, registration
from scipy.spatial.transform import Rotation
from support.planted import AXES, deviations

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.settings import read_settings
from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Sim3, rotation_between
from scenefuse.fuse.fuse_object import FusionSettings
from scenefuse.mvs.dense_cloud import DenseCloudSettings
from scenefuse.mvs.plane_sweep import DepthMapSettings
from scenefuse.nerf.train_object_nerf import NerfSettings

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.parametrize("name", sorted(path.stem for path in BENCHMARKS.glob("*.py")))
def test_a_benchmark_can_be_imported_and_holds_the_function_of_its_name(name):
    commands = {"rules": "run", "faults": "stages"}
    assert callable(getattr(importlib.import_module(f"benchmarks.{name}"), commands.get(name, name)))


@pytest.mark.parametrize("path", sorted(BENCHMARKS.glob("*.yaml")), ids=lambda path: path.stem)
def test_the_settings_of_a_benchmark_are_settings(path):
    read_settings(path)


def test_functions_that_are_timed_by_their_name_exist():
    missing = [part for part in frames_scaling.PARTS if not hasattr(importlib.import_module(part[0]), part[1])]
    assert missing == []


def test_what_benchmarks_vary_are_fields_of_the_settings():
    # `build` leaves out keys that a dataclass does not have: a renamed one would vary nothing.
    nerf = [lego.FLAGS, *(variant.nerf for variant in object_ablation.VARIANTS.values())]
    assert {key for varied in nerf for key in varied} <= fields(NerfSettings)
    assert {key for varied in object_mvs.DEPTH.values() for key in varied} <= fields(DepthMapSettings)
    assert {key for varied in object_mvs.FUSION.values() for key in varied or {}} <= fields(DenseCloudSettings)


def test_the_lego_example_and_its_benchmark_train_alike():
    example = (BENCHMARKS.parents[1] / "config/examples/lego.yaml").read_text()
    words = re.sub(r"[#\\\n]+", " ", example.split("--out lego")[1].split("object:")[0]).split()
    said = {words[i].removeprefix("--").replace("-", "_"): float(words[i + 1]) for i in range(0, len(words), 2)}
    assert said | {"mask_band_px": 0} == lego.FLAGS


def case(points) -> completed_scene.Case:
    """An object of a diagonal of 10 m, 5 in its own unit, turned and moved into the scene."""
    turn = rotation_between(np.array([0, 0, 1.0]), np.array([0.3, -0.5, 0.8]))
    known = SimpleNamespace(diagonal=10.0)
    pose, cloud = Sim3(2.0, turn, np.array([3.0, 1, 2])), Cloud(points)
    return completed_scene.Case(
        "x",
        cloud,
        cloud,
        cloud,
        pose,
        None,
        Sim3.identity(),
        known,
        points,
        Path("results"),  # type: ignore[arg-type]
    )


def test_the_harm_done_to_an_object_is_as_large_as_it_says():
    points = np.random.default_rng(0).uniform(0, 3, (30000, 3))
    right = case(points)
    moved = completed_scene.displaced(right, 1, -1).apply(points) - right.pose.apply(points)
    assert np.allclose(moved, -0.2 * right.pose.rotation[:, 1])
    larger = completed_scene.scaled(right, 1.03)
    assert larger.scale == pytest.approx(2.06)
    assert np.allclose(larger.apply(np.full(3, 1.5)), right.pose.apply(np.full(3, 1.5)), atol=0.01)
    away = completed_scene.bad_object(right).points - points
    third = points[:, 0] > np.quantile(points[:, 0], 2 / 3)
    assert np.allclose(away[third].mean(0), [0, 0.5, 0], atol=0.003) and np.allclose(
        away[~third].mean(0), 0, atol=0.003
    )
    assert np.allclose(away[~third].std(0), 0.05, atol=0.002)


def test_every_mode_of_fusion_is_in_the_table_of_the_completed_scene():
    modes = get_args(get_type_hints(FusionSettings)["mode"])
    found = completed_scene.fusions(())
    assert {settings.mode for settings in found.values()} == set(modes)
    assert FusionSettings() in found.values()
    assert list(completed_scene.fusions(("evidence",))) == ["evidence"]
    with pytest.raises(StageError, match="no rows.*'evidense'"):
        completed_scene.fusions(("evidense",))


def test_the_table_of_the_completed_scene_compares_with_the_better_source_of_each_run():
    def rows(run, before, fused, alone):
        clouds = ((completed_scene.BEFORE, before), ("fill", fused), (completed_scene.ALONE, alone))
        return [
            {"run": run, "object": "x", "shift_over_diagonal": 0, "cloud": c}
            | dict.fromkeys(completed_scene.F_SCORES, f)
            for c, f in clouds
        ]

    lines = completed_scene.summary(pd.DataFrame(rows("a", 0.9, 0.8, 0.5) + rows("b", 0.5, 0.8, 0.8))).splitlines()
    fill = next(line for line in lines if line.startswith("fill"))
    assert fill.endswith("-0.050") and fill.count("0.800 ± 0.000") == 4


def test_the_table_of_planted_registrations_counts_right_and_refused_apart():
    def row(right, accepted, over):
        errors = {"scale_pct": 0.1, "rotation_deg": 0.1, "shift_pct": 0.1, "seconds": 1.0, "cpu_seconds": 1.0}
        stated = {f"over_sd_{axis}": over for axis in AXES} | {"over_sd_turn_z": np.nan}
        known = {"method": "scenefuse", "coverage": 0.3, "shape": "urn"}
        return known | errors | {"right": right, "accepted": accepted} | stated

    trials = [row(True, True, 1.0)] * 5 + [row(True, False, 3.0)] * 3 + [row(False, False, 9.0)] * 2
    text = registration.summary(pd.DataFrame([*trials, row(False, True, 9.0)]))
    counts = next(line for line in text.splitlines() if "scenefuse" in line).split()
    assert counts[2:7] == ["11", "8", "3", "2", "1"]
    right, accepted = text.splitlines()[-2:]
    assert right.split()[1:5] == ["right", "62%", "|", "100%"]
    assert accepted.split()[:4] == ["accepted", "83%", "|", "83%"]


def test_the_turn_about_a_free_axis_is_no_deviation():
    truth, up = Sim3(2.0, Rotation.random(random_state=1).as_matrix(), np.array([1.0, 2, 3])), np.array([0, 0, 1.0])
    lean, spin = (Rotation.from_rotvec(np.radians(turn)).as_matrix() for turn in ([0.5, 0, 0], [0, 0, 170.0]))
    estimate = Sim3(2.02, lean @ spin @ truth.rotation, truth.translation + [0, 0, 0.1])
    found = deviations(estimate, truth, np.zeros(3), up)
    assert np.allclose(found, [np.radians(0.5), 0, 0, 0, 0, 0.1, np.log(1.01)])
    assert np.linalg.norm(deviations(estimate, truth, np.zeros(3))[:3]) > np.radians(169)


def fields(settings: type) -> set[str]:
    """Names of a settings dataclass's fields and of those of the dataclasses in it."""
    kinds = get_type_hints(settings)
    inner = [kind for kind in kinds.values() if dataclasses.is_dataclass(kind)]
    return set(kinds).union(*(fields(kind) for kind in inner))
