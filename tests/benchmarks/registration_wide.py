"""Registration in landscapes up to thirty times as wide as the object, by shape and colours alone.

PYTHONPATH=.:tests python tests/benchmarks/registration_wide.py --table docs/results/planted_wide.tsv

Every fifth trial has another object where this one would stand; every pose is wrong there.
"""

import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import open3d as o3d
import pandas as pd
from benchmarks.registration import FIRST_REPEAT, METHODS, ROTATION_DEG, SCALE_PCT, SHIFT, Found
from support.planted import SHAPES, Trial, errors, plant_wide

from scenefuse.core.stage import run
from scenefuse.two_clouds.find import RegistrationSettings, find_in_scene

TIMES, NAMES = (3, 10, 30), list(SHAPES)
UP = np.array([0.0, 0.0, 1.0])


def planted(times: int, number: int) -> tuple[Trial, bool]:
    """A trial, and whether its scene lacks the object."""
    rng = np.random.default_rng([times, number])
    absent = number % 5 == 4
    drawn = {
        "coverage": float(rng.choice([0.5, 0.7])),
        "noise": (0.005, 0.01)[number // 2 % 2],
        "density_ratio": float(np.exp(rng.uniform(np.log(0.2), np.log(2)))),
        "clutter": int(rng.integers(0, 5)),
        "slope": float(rng.uniform(-0.1, 0.1)),
    }
    return plant_wide(NAMES[number % len(NAMES)], number, times, absent=absent, object_points=12000, **drawn), absent


def places(trial: Trial) -> Found:
    """`scenefuse register` without a box."""
    found = find_in_scene(trial.object, trial.scene, RegistrationSettings(), 0)[0]
    return Found(found.scene_from_object, found.registered, found.reason)


def one(task: tuple[int, int, list[str]]) -> list[dict[str, object]]:
    """All methods on one trial."""
    times, number, methods = task
    trial, absent = planted(times, number)
    rows = []
    for method in methods:
        start = time.process_time()
        found = places(trial) if method == "scenefuse" else METHODS[method](trial, trial.scene)
        seconds, off = time.process_time() - start, (np.nan,) * 3
        if found.pose is not None and not absent:
            axis = UP if SHAPES[NAMES[number % len(NAMES)]].round else trial.axis
            off = errors(found.pose, trial.scene_from_object, trial.object.points.mean(0), trial.diagonal, axis)
        right = bool(abs(off[0]) <= SCALE_PCT and off[1] <= ROTATION_DEG and off[2] <= SHIFT)
        rows.append({
            "times": times, "trial": number, "shape": NAMES[number % len(NAMES)], "absent": absent, "method": method,
            "points": len(trial.scene), "right": right, "accepted": found.accepted, "scale_pct": off[0],
            "rotation_deg": off[1], "shift_pct": 100 * off[2], "cpu_s": seconds, "reason": found.reason,
        })  # fmt: skip
        print("\t".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in rows[-1].values()), flush=True)
    return rows


def summary(rows: pd.DataFrame) -> pd.DataFrame:
    """Counts by width and method."""
    lines = []
    for (times, method), part in rows.groupby(["times", "method"], sort=False):
        there, absent = part[~part.absent], part[part.absent]
        lines.append({
            "landscape, times as wide as the object": times, "method": method, "trials": len(there),
            "right and accepted": (there.right & there.accepted).sum(),
            "right, refused": (there.right & ~there.accepted).sum(),
            "wrong, accepted": (~there.right & there.accepted).sum(),
            "object absent": len(absent), "absent, accepted": absent.accepted.sum(),
            "seconds of one core": round(part.cpu_s.median()),
        })  # fmt: skip
    return pd.DataFrame(lines)


def registration_wide(
    *,
    out: Path = Path("results/bench/registration_wide.tsv"),
    table: Path | None = None,
    times: tuple[int, ...] = TIMES,
    trials: int = 20,
    first: int = 0,
    published: bool = False,
    methods: tuple[str, ...] = ("scenefuse", "fgr", "kiss"),
    jobs: int = 1,
) -> None:
    """Run the trials and count what is right, refused, and wrong but accepted.

    Args:
        out: every trial and method as a row (TSV), written as it comes; what it holds already is not run again.
        table: the counts (TSV).
        times: widths of the landscape over the object's.
        trials: how many for each width.
        first: number of the first trial.
        published: seeds that nothing was tuned on.
        methods: see `registration.py`; they register in the whole scene.
        jobs: processes, one thread each.
    """
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    known = set() if not out.is_file() else {(r.times, r.trial) for r in pd.read_csv(out, sep="\t").itertuples()}
    start = first + (FIRST_REPEAT["published"] if published else 0)
    numbers = [(t, k) for k in range(start, start + trials) for t in times]
    tasks = [(*one, list(methods)) for one in numbers if one not in known]
    out.parent.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for rows in pool.map(one, tasks):
            pd.DataFrame(rows).to_csv(out, sep="\t", index=False, mode="a", header=not out.is_file())
    counts = summary(pd.read_csv(out, sep="\t"))
    print(counts.to_string())
    if table is not None:
        counts.to_csv(table, sep="\t", index=False)


if __name__ == "__main__":
    run(registration_wide)
