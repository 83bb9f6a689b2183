"""Registration on planted trials, beside peers that get the same crops.

make bench-registration, or for a part of it: python tests/benchmarks/registration.py --repeats 1 --shapes house urn
"""

import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pandas as pd
from support.planted import SHAPES, Trial, errors, plant

from scenefuse.io.clouds import Cloud
from scenefuse.registration.coarse import CoarseSettings, find_hypotheses
from scenefuse.registration.crop.crop_cloud import CropSettings, crop_cloud
from scenefuse.registration.decision import FineSettings
from scenefuse.registration.icp import ScaleRange
from scenefuse.registration.paper import paper_coarse, paper_fine
from scenefuse.registration.problem import Evidence, Problem
from scenefuse.registration.refinement import refine_hypotheses
from scenefuse.registration.scale import ScaleSettings, estimates, prior
from scenefuse.stage import run
from scenefuse.transforms import Sim3

UP = np.array([0.0, 0.0, 1.0])
COVERAGES = (0.3, 0.5, 0.7, 0.9)
SCALE_PCT, ROTATION_DEG, SHIFT = 2.0, 2.0, 0.01


@dataclass(frozen=True)
class Found:
    """A method's pose, and whether it would use it."""

    pose: Sim3 | None
    accepted: bool
    reason: str = ""


def scenefuse(trial: Trial, scene: Cloud, *, blind: bool = False) -> Found:
    """Our registration; `blind` hides gravity, colours and depth maps from it."""
    cloud, evidence = trial.object, Evidence((trial.up_in_object, UP), trial.free_space)
    if blind:
        cloud, scene = Cloud(cloud.points, cloud.normals), Cloud(scene.points, scene.normals)
        evidence = Evidence()
    scales = prior(estimates(cloud, scene, evidence.ups), ScaleSettings())
    problem = Problem(cloud, scene, scales, evidence)
    found = find_hypotheses(problem, CoarseSettings())
    if not found:
        return Found(None, False, "no hypothesis")
    outcome = refine_hypotheses(problem, [(h.pose, h.source) for h in found], FineSettings())
    return Found(outcome.ranked[0].pose, outcome.decision.registered, outcome.decision.reason)


def paper(trial: Trial, scene: Cloud) -> Found:
    """The paper's recipe: RMS scale, FPFH RANSAC at 4 %, point-to-point ICP."""
    scales = ScaleRange(estimates(trial.object, scene, None)[0].scale, 0.0)
    start, _ = paper_coarse(Problem(trial.object, scene, scales))
    return Found(paper_fine(trial.object, scene, start), True)


def fgr(trial: Trial, scene: Cloud) -> Found:
    """Open3D's fast global registration at the RMS scale, then the paper's ICP."""
    scaled, source, target, voxel = _at_rms_scale(trial, scene)
    registration = o3d.pipelines.registration
    features = []
    for cloud in (source, target):
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        search = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)
        features.append(registration.compute_fpfh_feature(cloud, search))  # type: ignore[call-arg]
    option = registration.FastGlobalRegistrationOption(maximum_correspondence_distance=1.5 * voxel)
    result = registration.registration_fgr_based_on_feature_matching(source, target, features[0], features[1], option)
    start = Sim3.from_matrix(np.asarray(result.transformation)) @ scaled
    return Found(paper_fine(trial.object, scene, start), True)


def kiss(trial: Trial, scene: Cloud) -> Found:
    """KISS-Matcher at the RMS scale, then the paper's ICP."""
    import kiss_matcher

    scaled, source, target, voxel = _at_rms_scale(trial, scene)
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(voxel))
    found = matcher.estimate(np.asarray(source.points), np.asarray(target.points))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = found.rotation, np.ravel(found.translation)
    start = Sim3.from_matrix(matrix) @ scaled
    return Found(paper_fine(trial.object, scene, start), bool(found.valid))


def _at_rms_scale(trial: Trial, scene: Cloud) -> tuple[Sim3, Any, Any, float]:
    """The scaling, both clouds thinned to voxels of 2 % of the scene crop's diagonal, and that voxel."""
    scaled = Sim3(estimates(trial.object, scene, None)[0].scale, np.eye(3), np.zeros(3))
    voxel = 0.02 * scene.diagonal
    source, target = (
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)).voxel_down_sample(voxel)
        for p in (scaled.apply(trial.object.points), scene.points)
    )
    return scaled, source, target, voxel


METHODS = {
    "scenefuse": scenefuse,
    "geometry only": lambda trial, scene: scenefuse(trial, scene, blind=True),
    "paper": paper,
    "fgr": fgr,
    "kiss": kiss,
}


def planted(name: str, coverage: float, repeat: int) -> tuple[Trial, Cloud, dict[str, Any]]:
    """A trial, its crop, and what was drawn for it."""
    seed = 1000 * repeat + round(100 * coverage)
    rng = np.random.default_rng(seed)
    drawn = {
        "ground": bool(repeat % 2),
        "noise": (0.005, 0.01)[repeat // 2 % 2],
        "density_ratio": float(np.exp(rng.uniform(np.log(0.2), np.log(5)))),
        "clutter": int(rng.integers(0, 5)),
        "slope": float(rng.uniform(-0.1, 0.1)),
    }
    trial = plant(name, seed, coverage=coverage, object_points=12000, **drawn)
    cut = crop_cloud(trial.scene, trial.fiducials, UP, CropSettings())
    return trial, trial.scene[cut.keep], drawn


def one(task: tuple[str, float, int, list[str]]) -> list[dict[str, Any]]:
    """All methods on one trial."""
    name, coverage, repeat, methods = task
    trial, scene, drawn = planted(name, coverage, repeat)
    rows = []
    for method in methods:
        start, start_cpu = time.perf_counter(), time.process_time()
        found = METHODS[method](trial, scene)
        seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - start_cpu
        axis = trial.axis if method == "scenefuse" or not SHAPES[name].round else UP
        scale, angle, shift = (np.nan,) * 3
        if found.pose is not None:
            centre = trial.object.points.mean(0)
            scale, angle, shift = errors(found.pose, trial.scene_from_object, centre, trial.diagonal, axis)
        right = bool(abs(scale) <= SCALE_PCT and angle <= ROTATION_DEG and shift <= SHIFT)
        rows.append(
            {
                "shape": name, "coverage": coverage, "shown": trial.coverage, "repeat": repeat, **drawn,
                "object_points": len(trial.object), "scene_points": len(scene), "method": method,
                "scale_pct": scale, "rotation_deg": angle, "shift_pct": 100 * shift, "right": right,
                "accepted": found.accepted, "seconds": seconds, "cpu_seconds": cpu_seconds, "reason": found.reason,
            }
        )  # fmt: skip
    return rows


def registration(
    *,
    out: Path = Path("results/bench/registration.tsv"),
    repeats: int = 8,
    first: int = 0,
    shapes: list[str] | None = None,
    coverages: list[float] | None = None,
    methods: list[str] | None = None,
    jobs: int = 2,
) -> None:
    """Run the planted trials and print one table: share right, wrong but accepted, refused, median CPU time.

    Right: scale within 2 %, rotation within 2 degrees (about an axis of symmetry: free), shift within 1 % of the
    diagonal. Every method gets the same crop, with the ground removed. Peers other than KISS-Matcher accept all.

    Args:
        out: every trial and method as a row (TSV).
        repeats: trials per shape and coverage; ground and noise alternate with it, the rest is drawn by its seed.
        first: number of the first repeat, for trials that nobody has looked at.
        shapes: which; all without it.
        coverages: which; 0.3, 0.5, 0.7 and 0.9 without it.
        methods: which; all without it.
        jobs: processes, one thread each.
    """
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    chosen = methods or list(METHODS)
    tasks = [
        (name, c, k, chosen)
        for k in range(first, first + repeats)
        for c in coverages or COVERAGES
        for name in shapes or SHAPES
    ]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        table = pd.DataFrame([row for rows in pool.map(one, tasks) for row in rows])
    out.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(out, sep="\t", index=False, float_format="%.5g")
    print(summary(table))


def summary(table: pd.DataFrame) -> str:
    """The printed table."""
    lines = []
    for column, groups in (("coverage", sorted(table.coverage.unique())), ("shape", list(table["shape"].unique()))):
        lines.append(
            f"{column:14s}{'method':15s} trials  right  wrong accepted  refused  median s    CPU s  scale %  rot deg"
        )
        for group in [*groups, "all"]:
            for method, part in table.groupby("method", sort=False):
                part = part if group == "all" else part[part[column] == group]
                good, wrong = part[part.right], (part.accepted & ~part.right).mean()
                lines.append(
                    f"{group!s:14s}{method:15s} {len(part):6d} {part.right.mean():6.1%} {wrong:15.1%}"
                    f" {(~part.accepted).mean():8.1%} {part.seconds.median():9.2f} {part.cpu_seconds.median():8.2f}"
                    f" {good.scale_pct.abs().median():8.2f} {good.rotation_deg.median():8.2f}"
                )
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    run(registration)
