"""The benchmarks fit the library: they import, and what they name by strings is there. mypy checks their calls."""

import dataclasses
import importlib
import re
from pathlib import Path
from typing import get_type_hints

import pytest
from benchmarks import frames_scaling, lego, object_ablation, object_mvs

from scenefuse.io.settings import read_settings
from scenefuse.mvs.dense_cloud import DenseCloudSettings
from scenefuse.mvs.plane_sweep import DepthMapSettings
from scenefuse.nerf.train_object_nerf import NerfSettings

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.mark.parametrize("name", sorted(path.stem for path in BENCHMARKS.glob("*.py")))
def test_a_benchmark_can_be_imported_and_holds_the_function_of_its_name(name):
    assert callable(getattr(importlib.import_module(f"benchmarks.{name}"), name))


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


def fields(settings: type) -> set[str]:
    """Names of a settings dataclass's fields and of those of the dataclasses in it."""
    kinds = get_type_hints(settings)
    inner = [kind for kind in kinds.values() if dataclasses.is_dataclass(kind)]
    return set(kinds).union(*(fields(kind) for kind in inner))
