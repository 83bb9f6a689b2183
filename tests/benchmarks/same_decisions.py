"""Decisions and errors of registration by clouds on planted trials: to compare two versions of the code.

PYTHONPATH=tests OMP_NUM_THREADS=1 python tests/benchmarks/same_decisions.py OUT.tsv, in the folder of either version
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from benchmarks.registration import mirrored, planted, scenefuse
from support.planted import SHAPES, errors

NAMES = list(SHAPES)
# Kind, share shown, repeat: with all evidence, by shape alone, an object in another's scene, a mirrored object.
KINDS = [
    ("all", 0.3, 2), ("all", 0.3, 1), ("all", 0.5, 3), ("all", 0.7, 0),
    ("shape", 0.7, 1), ("shape", 0.5, 2), ("absent", 0.7, 3), ("mirrored", 0.7, 0),
]  # fmt: skip
TRIALS = [(name, *kind) for kind in KINDS for name in NAMES]


def one(name: str, kind: str, coverage: float, repeat: int) -> dict[str, object]:
    """The decision on a trial, its errors, and processor seconds."""
    trial, scene, _ = planted(name, coverage, repeat)
    if kind == "absent":
        other, scene, _ = planted(NAMES[(NAMES.index(name) + 3) % len(NAMES)], coverage, repeat)
        trial = replace(trial, free_space=other.free_space)
    if kind == "mirrored":
        trial = mirrored(trial)
    start = time.process_time()
    found = scenefuse(trial, scene, blind=kind == "shape")
    seconds = time.process_time() - start
    off = (np.nan,) * 3
    if found.pose is not None:
        off = errors(found.pose, trial.scene_from_object, trial.object.points.mean(0), trial.diagonal, trial.axis)
    errs = ("scale_pct", "rotation_deg", "shift"), (float(x) for x in off)
    decision = "registered" if found.accepted else "refused"
    return {
        "trial": f"{name}, {kind}, {coverage}, {repeat}",
        "decision": decision, **dict(zip(*errs)), "cpu_s": seconds, "reason": found.reason,
    }  # fmt: skip


def same_decisions(out: Path) -> None:
    """Run all trials; rows are written as they come, and those that are there already are not run again."""
    known = len(pd.read_csv(out, sep="\t")) if out.is_file() else 0
    for trial in TRIALS[known:]:
        pd.DataFrame([one(*trial)]).to_csv(out, sep="\t", index=False, mode="a", header=not out.is_file())


if __name__ == "__main__":
    same_decisions(Path(sys.argv[1]))
