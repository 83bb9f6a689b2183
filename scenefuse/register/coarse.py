"""Coarse registration: the scale's prior, candidates from features and from gravity, briefly refined, the distinct best
kept."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.core.stage import quantity, write_json
from scenefuse.core.transforms import Sim3, rotation_between
from scenefuse.geometry.icp import refine_points
from scenefuse.geometry.surface import prepare, with_grid, with_queries
from scenefuse.register.candidates import fpfh, match, ransac_similarities, upright_candidates
from scenefuse.register.problem import Constraints, Inputs, Problem
from scenefuse.register.scale import ScaleSettings, estimates, prior, scale_quantities
from scenefuse.register.score import SCORE_FRACTION, Hypothesis, best_distinct, score

Candidate = tuple[Sim3, str]

# Points kept of either cloud, and query points of the score: enough to rank poses, which differ grossly here.
COARSE_POINTS = 6000
QUERY_POINTS = 1200
# Voxel of the upright sweep, as a share of the scene crop's diagonal: a fast Fourier transform of some 50^3 cells.
SWEEP_VOXEL_FRACTION = 0.045
# RANSAC's best poses at each voxel and feature scale.
RANSAC_POSES = 8
# How far the grids of nearest points reach around the clouds, as a share of the diagonal.
GRID_MARGIN = 0.1
BRIEF_ROUNDS = 12


@dataclass(frozen=True)
class CoarseSettings:
    """Settings of the coarse registration."""

    max_tilt_deg: float = 10
    """Largest angle between the up directions of object and scene that the search allows, where both are known."""
    voxel_fractions: tuple[float, ...] = (0.04, 0.03)
    """Voxels of the feature pyramid, as shares of the scene crop's diagonal."""
    ransac_samples: int = 30000
    """Random triples of matches drawn at each level of the pyramid."""
    feature_scale_steps: int = 3
    """Logarithmic scale steps at which the object's features are computed."""
    scale_steps: int = 13
    """Logarithmic scale steps of the upright sweep."""
    yaw_steps: int = 24
    """Steps of a full turn of the upright sweep."""
    candidates: int = 24
    """Candidates that are briefly refined."""
    keep: int = 6
    """Distinct hypotheses handed to the fine registration."""


def register_coarsely(
    *, inputs: Inputs, scale_report: Path, report: Path, seed: int, scale: ScaleSettings, settings: CoarseSettings
) -> None:
    """Estimate the object's scale, and find scene_from_object hypotheses of its pose.

    The scale first, from the clouds' extents, as a prior with a width (method R1 to R3). Then similarity RANSAC on FPFH
    matches over a pyramid of voxels (R3, R4, R6) and, where gravity is known on both sides, a sweep of yaw, scale and
    shift by correlation; each is briefly refined and scored both ways (R9).

    Args:
        inputs: the two clouds and their reports.
        scale_report: output JSON: `scale`, `width_log` and the `ledger` of all estimates.
        report: output JSON with `hypotheses`, best first, and the best `scene_from_object`.
        seed: of all random choices.
        scale: see ScaleSettings.
        settings: see CoarseSettings.

    Raises:
        StageError: a cloud's points lie in one place or along one line.
    """
    start = time.perf_counter()
    (obj, scene), ups = inputs.clouds(), inputs.ups()
    ledger = estimates(obj, scene, ups)
    problem = Problem(obj, scene, prior(ledger, scale), Constraints(ups), seed)
    write_json(scale_report, scale_quantities(ledger, problem.scales, scale.method))
    found, notes = find_hypotheses(problem, settings), []
    if not found:
        notes.append("no feature or heading gave a pose; the clouds' centres were laid on each other instead")
        print(notes[-1], flush=True)
        found = [_centred(problem)]
    write_json(report, coarse_quantities(found, problem.known.ups is not None, notes, time.perf_counter() - start))


def coarse_quantities(
    found: Sequence[Hypothesis], gravity_used: bool, notes: list[str], seconds: float
) -> dict[str, Any]:
    """The stage JSON of hypotheses, best first; each is printed."""
    for h in found:
        print(f"{h.source:8s} scale {h.pose.scale:.4g} score {h.score.total:.3f} F {h.score.f_score:.3f}", flush=True)
    return {
        "scene_from_object": quantity(found[0].pose.matrix, ""),
        "scale": quantity(found[0].pose.scale, "scene units per object unit"),
        "score": quantity(found[0].score.total, "1"),
        "gravity_used": quantity(gravity_used, ""),
        "hypotheses": quantity([h.as_json() for h in found], ""),
        "notes": quantity(notes, ""),
        "seconds": quantity(seconds, "s"),
    }


def find_hypotheses(problem: Problem, settings: CoarseSettings) -> list[Hypothesis]:
    """Distinct hypotheses, best first: features and gravity propose, brief refinement and the score rank them."""
    scales, diagonal, seed = problem.scales, problem.scene.diagonal, problem.seed
    tau = SCORE_FRACTION * diagonal
    obj, target = problem.surfaces(scales.centre, SCORE_FRACTION / 2, COARSE_POINTS)
    cell, reach = SCORE_FRACTION / 2 * diagonal, GRID_MARGIN * diagonal
    both = (
        with_queries(with_grid(obj, cell / scales.centre, reach / scales.centre), QUERY_POINTS, seed),
        with_queries(with_grid(target, cell, reach), QUERY_POINTS, seed),
    )
    upright = [(pose, "gravity") for pose in _upright(problem, settings)]
    by_features = [(pose, "features") for pose in _from_features(problem, settings)]
    room = settings.candidates - len(upright)

    def best(candidates: list[Candidate]) -> list[Candidate]:
        return sorted(candidates, key=lambda c: -score(*both, c[0], 2 * tau, scales.centre).total)

    refined = []
    for start, source in best(upright) + best(by_features)[:room]:
        pose = refine_points(*both, start, scales, (3 * tau, tau), BRIEF_ROUNDS)
        refined.append(Hypothesis(pose, source, score(*both, pose, tau, scales.centre)))
    return best_distinct(refined, obj.points.mean(0), diagonal, settings.keep)


def _upright(problem: Problem, settings: CoarseSettings) -> list[Sim3]:
    """The sweep of yaw, scale and shift; nothing where gravity is not known."""
    ups, scales, voxel = problem.known.ups, problem.scales, SWEEP_VOXEL_FRACTION * problem.scene.diagonal
    if ups is None:
        return []
    level = Sim3(1.0, rotation_between(ups[1], np.array([0.0, 0.0, 1.0])), np.zeros(3))
    obj, scene = problem.surfaces(scales.centre, SWEEP_VOXEL_FRACTION / 2, COARSE_POINTS)
    steps, most = (settings.scale_steps, settings.yaw_steps), settings.candidates // 2
    found = upright_candidates(obj, scene.transformed(level), ups[0], scales, *steps, voxel, most)
    return [level.inverse() @ pose for pose in found]


def _from_features(problem: Problem, settings: CoarseSettings) -> list[Sim3]:
    """Similarity RANSAC on mutual FPFH matches at every voxel of the pyramid and every feature scale."""
    scales, ups, seed = problem.scales, problem.known.ups, problem.seed
    count = settings.feature_scale_steps if scales.width else 1
    steps = np.linspace(-1, 1, count) if count > 1 else [0.0]
    found: list[Sim3] = []
    for fraction in settings.voxel_fractions:
        voxel = fraction * problem.scene.diagonal
        target = prepare(problem.scene, voxel, seed, COARSE_POINTS)
        target_features = fpfh(target, 5 * voxel)
        for step in steps:
            scale = scales.centre * np.exp(scales.width * step)
            obj = prepare(problem.object, voxel / scale, seed, COARSE_POINTS)
            pairs = match(fpfh(obj, 5 * voxel / scale), target_features)
            x, y = obj.points[pairs[:, 0]], target.points[pairs[:, 1]]
            found += ransac_similarities(
                x, y, scales, 1.5 * voxel, settings.ransac_samples, RANSAC_POSES, seed, ups, settings.max_tilt_deg
            )
    return found


def _centred(problem: Problem) -> Hypothesis:
    """The clouds' centres on each other, upright where gravity is known: a last resort that the gate has to reject."""
    ups, scale = problem.known.ups, problem.scales.centre
    rotation = np.eye(3) if ups is None else rotation_between(*ups)
    shift = problem.scene.points.mean(0) - scale * (rotation @ problem.object.points.mean(0))
    pose = Sim3(scale, rotation, shift)
    surfaces = problem.surfaces(scale, SCORE_FRACTION / 2, COARSE_POINTS)
    return Hypothesis(pose, "centres", score(*surfaces, pose, SCORE_FRACTION * problem.scene.diagonal, scale))
