"""The NeRF's rules by short trainings: depth errors against the truth, held-out PSNR, and the hull's volume.

Trials are the demo's objects in the folder that RESULTS names: stage 2 alone, on the run's masks and its stage 1, with
a quarter of the shipped rays at 320 px. Lengths are in % of the object's diagonal.
"""

import os
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import replace
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

from rules import Rule

from demo.evaluate import ObjectTruth, depth_results, read_object_truth
from scenefuse.core.stage import read_json, value
from scenefuse.nerf.rays import LossWeights
from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, train_object_nerf
from scenefuse.nerf.training import NerfRecipe, Schedule

RESULTS = Path(os.environ.get("RESULTS", "results"))
OBJECTS = ("balloon", "sculpture", "house")
TRIALS = len(OBJECTS)
RECIPE, LOSSES = NerfRecipe(), LossWeights()
SCHEDULE, WIDTH_PX, HOLD_OUT_EVERY, SAMPLES, PHOTOS = Schedule(5, 120_000), 320, 8, 2000, 4


@cache
def _truth(name: str) -> ObjectTruth:
    truth = RESULTS / "demo/demo/truth"
    return read_object_truth(RESULTS / "objects" / name / "undistorted", truth / "scene", truth / name, SAMPLES, seed=0)


def evaluate(trial: int, rule: Rule | None) -> dict[str, Any]:
    """One training."""
    name = OBJECTS[trial]
    folder = RESULTS / "objects" / name
    settings = NerfSettings(width_px=WIDTH_PX, schedule=SCHEDULE, recipe=RECIPE, losses=LOSSES)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        with redirect_stdout(StringIO()):
            train_object_nerf(
                inputs=NerfInputs(folder / "undistorted", folder / "masks", folder / "stage1"),
                stage=work / "stage2",
                report=work / "stage2.json",
                checkpoints=work / "checkpoints",
                settings=settings,
                hold_out_every=HOLD_OUT_EVERY,
                seed=0,
            )
        report, depth = read_json(work / "stage2.json"), depth_results([work / "stage2"], _truth(name), PHOTOS)
    return {
        "kind": name,
        "depth error": 100 * value(depth, "stage2_depth_error"),
        "within 1 %": value(depth, "stage2_depth_within_1pct"),
        "psnr": value(report, "psnr_held_out"),
        "silhouettes": value(report, "silhouette_iou"),
        "hull": value(report, "hull_share"),
        "confident": value(report, "confident_share"),
    }


def constant(value: Any) -> Callable[[Any], Any]:
    """In the place of a number, whatever that is."""
    return lambda _: value


def without_field(**fields: Any) -> Callable[[Any], Any]:
    """The recipe or the losses with other numbers."""
    return lambda settings: replace(settings, **fields)


N, HERE = "scenefuse.nerf", "rules_of.nerf"
RULES = [
    Rule("samples near the prior", f"{HERE}.RECIPE", without_field(prior_share=0.0)),
    Rule("colours from random directions", f"{HERE}.RECIPE", without_field(turned_share=0.0)),
    Rule("gains of photos", f"{HERE}.RECIPE", without_field(appearance=False)),
    Rule("levels from coarse to fine", f"{HERE}.RECIPE", without_field(coarse_until=0.0)),
    Rule("band around masks", f"{HERE}.RECIPE", without_field(mask_band_px=1)),
    Rule("sparsity", f"{HERE}.LOSSES", without_field(sparsity_weight=0.0)),
    Rule("samples spread evenly", f"{N}.training.UNIFORM_SHARE", constant(0.05)),
    Rule("the ring beside masks doubled", f"{N}.rays.RING_PX", constant(24)),
    Rule("rays beside the object halved", f"{N}.rays.OUTSIDE_SHARE", constant(0.05)),
    Rule("width of the prior halved", f"{N}.training.SURFACE_DEPTH", lambda width: width / 2),
    Rule("what is open to few photos goes", f"{N}.volume.CONFIRMING_PHOTOS", constant(0)),
    Rule("photos that frame a cell", f"{N}.volume.MIN_FRAMING_OF_HULL", constant(0.0)),
    Rule("sparse points hide", f"{N}.train_object_nerf.sparse_depths", lambda _: lambda views: None),
]
