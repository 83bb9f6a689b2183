"""The paper's registration (He et al. 2026, section 4.2.3) with its errors mended; a control that has no gate.

RMS-ratio scale, rigid RANSAC on FPFH matches, then point-to-point ICP, all by Open3D (method R1, R2, R5 to R8).

The paper's: the scale, the ratio of the RMS distances to the centroids over all points, as in its formula, held from
then on; a voxel of 4 % of the diagonal; RANSAC within 1.5 voxels, 4,000,000 samples; ICP within 0.4 voxel, 35
iterations.

Mended: the printed ratio is inverted (R1). RANSAC's second limit, 500, belongs to an old Open3D; today's is a
confidence, here 0.999 (R5). The diagonal, of which cloud is not said, is the scene crop's (R6).

Not in the paper, mostly as in Open3D's example of global registration: neighbourhoods of normals and features, triples,
the checks of edge length and distance, mutual matches (Open3D takes one-way matches where fewer than 10 % of the points
have a mutual one), ICP on clouds thinned to half a voxel, and a single thread, so that a seed repeats (R7, R8, R13).
"""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import open3d as o3d

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.stage import quantity, write_json
from scenefuse.core.transforms import Array, Sim3, uncertainty_quantities
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.surface import SCORE_FRACTION
from scenefuse.register.coarse import coarse_quantities
from scenefuse.register.decision import FineSettings, tilt_deg
from scenefuse.register.problem import (
    SURFACE_POINTS,
    Constraints,
    Inputs,
    Problem,
    estimates,
    scale_quantities,
)
from scenefuse.register.register_object import draw_alignment, pose_quantities
from scenefuse.register.score import Hypothesis, score

# The paper's: the voxel as a share of the diagonal.
VOXEL_FRACTION = 0.04
# Neighbourhoods, in voxels, and their most points: normals, features.
NORMAL_RADIUS, NORMAL_NEIGHBOURS = 2, 30
FEATURE_RADIUS, FEATURE_NEIGHBOURS = 5, 100
# RANSAC: the least ratio of matched edges' lengths; the paper's inlier distance in voxels.
EDGE_LENGTH, RANSAC_DISTANCE = 0.9, 1.5
# The paper's samples; the confidence in place of its 500.
RANSAC_SAMPLES, CONFIDENCE = 4_000_000, 0.999
# ICP: the paper's pairing distance in voxels; the spacing in voxels; the paper's iterations.
ICP_DISTANCE, ICP_SPACING, ICP_ITERATIONS = 0.4, 0.5, 35
# Open3D leaves mutual filtering out when fewer than this share of the points have a mutual match.
MIN_MUTUAL_SHARE = 0.1


def register_as_paper(
    *,
    inputs: Inputs,
    scale_report: Path,
    coarse_report: Path,
    report: Path,
    picture: Path | None = None,
    scale: Literal["rms", "none"] = "rms",
    seed: int,
) -> None:
    """Register an object by the paper's recipe: scale, coarse and fine registration, nothing rejected.

    Args:
        inputs: the two clouds and their reports.
        scale_report: output JSON of the scale, as of the coarse stage.
        coarse_report: output JSON as of the coarse stage.
        report: output JSON as of the fine stage; its `status` is `ungated`, what has no gate is null.
        picture: output PNG, the object on the scene crop from three sides.
        scale: `rms` over whole clouds, the paper's formula; `none` takes the object as large as it is, the paper's
            ablation.
        seed: of RANSAC.

    Raises:
        StageError: a cloud's points lie in one place or along one line.
    """
    obj, scene = inputs.clouds()
    ups = inputs.ups()
    ledger = estimates(obj, scene, ups)
    held = 1.0 if scale == "none" else ledger[0].scale
    problem = Problem(obj, scene, ScaleRange(held, 0.0), Constraints(ups), seed)
    pose, notes = paper_coarse(problem)
    coarse = _rated(problem, pose, SCORE_FRACTION / 2, SURFACE_POINTS // 2)
    fine = _rated(problem, paper_fine(obj, scene, pose), FineSettings().voxel_fraction, SURFACE_POINTS)
    if picture is not None:
        draw_alignment(picture, obj, scene, fine.pose, seed)
    write_json(scale_report, scale_quantities(ledger, problem.scales, scale))
    write_json(coarse_report, coarse_quantities([coarse], False, notes))
    write_json(report, _report(fine, problem, inputs.length_unit()))


def _rated(problem: Problem, pose: Sim3, fraction: float, most: int) -> Hypothesis:
    """The pose with its score on both clouds, thinned to `fraction` of the diagonal and `most` points."""
    scale, tau = problem.scales.centre, SCORE_FRACTION * problem.scene.diagonal
    return Hypothesis(pose, "fpfh", score(*problem.surfaces(scale, fraction, most), pose, tau, scale))


def _report(best: Hypothesis, problem: Problem, length: str) -> dict[str, Any]:
    """The stage JSON, with the keys of the fine registration's."""
    reason = "the paper's recipe has no gate"
    print(f"ungated: {reason}", flush=True)
    return {
        "status": quantity("ungated", ""),
        "reason": quantity(reason, ""),
        **pose_quantities(best),
        "decided_by": quantity("geometry", ""),
        "rests_on": quantity(["shape"], ""),
        "margin": quantity(None, "1"),
        "tilt_deg": quantity(tilt_deg(best.pose, problem.known.ups), "deg"),
        **uncertainty_quantities(None, length),
        "hypotheses": quantity([best.as_json()], ""),
    }


def paper_coarse(problem: Problem) -> tuple[Sim3, list[str]]:
    """Rigid RANSAC on FPFH matches of the object at its rectified scale, and notes on what Open3D said.

    Args:
        problem: the clouds, and the scale at which the object is taken: the centre of the range.
    """
    voxel = VOXEL_FRACTION * problem.scene.diagonal
    scaled = Sim3(problem.scales.centre, np.eye(3), np.zeros(3))
    source, source_features = _features(scaled.apply(problem.object.points), voxel)
    target, target_features = _features(problem.scene.points, voxel)
    # A ratio of 0: this call counts the mutual matches and takes no others in their place, as RANSAC does below.
    matches = o3d.pipelines.registration.correspondences_from_features(source_features, target_features, True, 0.0)
    notes = []
    if len(matches) < MIN_MUTUAL_SHARE * len(source.points):
        notes.append(
            f"{len(matches)} mutual matches are too few for {len(source.points)} points:"
            " Open3D falls back to one-way matches"
        )
        print(notes[-1], flush=True)
    features = source_features, target_features
    result = _ransac((source, target), features, RANSAC_DISTANCE * voxel, problem.seed)
    return Sim3.from_matrix(np.asarray(result.transformation)) @ scaled, notes


def _ransac(clouds: tuple[Any, Any], features: tuple[Any, Any], distance: float, seed: int) -> Any:
    """Open3D's RANSAC over mutual matches of two clouds by their features, seeded and on one thread."""
    registration = o3d.pipelines.registration
    checks = [
        registration.CorrespondenceCheckerBasedOnEdgeLength(EDGE_LENGTH),
        registration.CorrespondenceCheckerBasedOnDistance(distance),
    ]
    o3d.utility.random.seed(seed)
    with _one_thread():
        return registration.registration_ransac_based_on_feature_matching(
            *clouds,
            *features,
            True,
            distance,
            registration.TransformationEstimationPointToPoint(False),
            3,
            checks,
            registration.RANSACConvergenceCriteria(RANSAC_SAMPLES, CONFIDENCE),
        )


def _features(points: Array, voxel: float) -> tuple[Any, Any]:
    """(N, 3) points thinned to one per voxel, with normals, as an Open3D cloud; and their FPFH features."""
    pcd = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
    pcd.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS * voxel, NORMAL_NEIGHBOURS))
    search = o3d.geometry.KDTreeSearchParamHybrid(FEATURE_RADIUS * voxel, FEATURE_NEIGHBOURS)
    return pcd, o3d.pipelines.registration.compute_fpfh_feature(pcd, search)  # type: ignore[call-arg]


def paper_fine(cloud: Cloud, scene: Cloud, start: Sim3) -> Sim3:
    """Point-to-point ICP, scale held, within 0.4 voxel, at most 35 iterations, both clouds at half a voxel."""
    registration = o3d.pipelines.registration
    voxel = VOXEL_FRACTION * scene.diagonal
    pcd = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (start.apply(cloud.points), scene.points)]
    source, target = (p.voxel_down_sample(ICP_SPACING * voxel) for p in pcd)
    with _one_thread():
        result = registration.registration_icp(
            source,
            target,
            ICP_DISTANCE * voxel,
            np.eye(4),
            registration.TransformationEstimationPointToPoint(False),
            registration.ICPConvergenceCriteria(max_iteration=ICP_ITERATIONS),
        )
    return Sim3.from_matrix(np.asarray(result.transformation)) @ start


@contextmanager
def _one_thread() -> Iterator[None]:
    """Open3D's RANSAC shares one random generator among its threads; only a single thread repeats itself."""
    try:
        openmp = ctypes.CDLL("libgomp.so.1")
    except OSError:
        yield
        return
    before = openmp.omp_get_max_threads()
    openmp.omp_set_num_threads(1)
    try:
        yield
    finally:
        openmp.omp_set_num_threads(before)
