"""The paper's registration (He et al. 2026, section 4.2.3) with its errors mended; a control that has no gate.

RMS-ratio scale, rigid RANSAC on FPFH matches, then point-to-point ICP, all by Open3D (method R1, R2, R5 to R8).

The paper's: the scale, the ratio of the RMS distances to the centroids, held from then on, over all points as in its
formula (variant `paper`) or over matched ones as in its text (recipe `paper`); a voxel of 4 % of the diagonal; RANSAC
within 1.5 voxels, 4,000,000 samples; ICP within 0.4 voxel, 35 iterations.

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
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.stage import quantity, write_json
from scenefuse.core.transforms import Array, Sim3, fit_sim3
from scenefuse.geometry.icp import ScaleRange, triples_of_one_scale
from scenefuse.geometry.surface import SCORE_FRACTION
from scenefuse.register.coarse import coarse_quantities
from scenefuse.register.decision import FineSettings, tilt_deg
from scenefuse.register.fine import draw_alignment, pose_quantities
from scenefuse.register.problem import (
    SURFACE_POINTS,
    Constraints,
    Estimate,
    Inputs,
    Problem,
    estimates,
    rms,
    scale_quantities,
)
from scenefuse.register.score import Hypothesis, score
from scenefuse.register.uncertainty import uncertainty_quantities

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
# How much the sizes of object and crop, which is cut to it, may differ.
MAX_SCALE_FACTOR = 2.0


def register_as_paper(
    *,
    inputs: Inputs,
    scale_report: Path,
    coarse_report: Path,
    report: Path,
    picture: Path | None = None,
    scale: Literal["rms", "ransac_svd", "none"] = "rms",
    seed: int,
) -> None:
    """Register an object by the paper's recipe: scale, coarse and fine registration, nothing rejected.

    Args:
        inputs: the two clouds and their reports.
        scale_report: output JSON of the scale, as of the coarse stage.
        coarse_report: output JSON as of the coarse stage.
        report: output JSON as of the fine stage; its `status` is `ungated`, what has no gate is null.
        picture: output PNG, the object on the scene crop from three sides.
        scale: `rms` over whole clouds, the paper's formula, or `ransac_svd` over matches, its text; `none` takes the
            object as large as it is, the paper's ablation.
        seed: of RANSAC.

    Raises:
        StageError: a cloud's points lie in one place or along one line.
    """
    obj, scene = inputs.clouds()
    ups = inputs.ups()
    ledger = estimates(obj, scene, ups)
    said: list[str] = []
    if scale == "ransac_svd":
        matched, said = matched_scale(obj, scene, seed)
        if matched is None:
            scale = "rms"
        else:
            ledger = [Estimate(scale, matched, True), *ledger]
    held = 1.0 if scale == "none" else ledger[0].scale
    problem = Problem(obj, scene, ScaleRange(held, 0.0), Constraints(ups), seed)
    pose, notes = paper_coarse(problem)
    coarse = _rated(problem, pose, SCORE_FRACTION / 2, SURFACE_POINTS // 2)
    fine = _rated(problem, paper_fine(obj, scene, pose), FineSettings().voxel_fraction, SURFACE_POINTS)
    if picture is not None:
        draw_alignment(picture, obj, scene, fine.pose, seed)
    write_json(scale_report, scale_quantities(ledger, problem.scales, scale))
    write_json(coarse_report, coarse_quantities([coarse], False, [*said, *notes]))
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


def matched_scale(cloud: Cloud, scene: Cloud, seed: int) -> tuple[float | None, list[str]]:
    """Scene units per object unit from matched points, and notes: None where too few agree.

    Mutual FPFH matches of both clouds at a diagonal of 1 (R4), RANSAC with a similarity by SVD, then the ratio of the
    RMS distances of the matches that agree to their centroids. Open3D's RANSAC does not say which matches agree, but
    which points then lie near each other, whatever they match.
    """
    import open3d as o3d

    unit = [Cloud(c.points / c.diagonal) for c in (cloud, scene)]
    (source, of_source), (target, of_target) = (_features(c.points, VOXEL_FRACTION) for c in unit)
    # A ratio of 0: no one-way matches in the place of too few mutual ones.
    pairs = np.asarray(o3d.pipelines.registration.correspondences_from_features(of_source, of_target, True, 0.0))
    matched = np.asarray(source.points)[pairs[:, 0]], np.asarray(target.points)[pairs[:, 1]]
    agree = agreeing(*matched, RANSAC_DISTANCE * VOXEL_FRACTION, seed)
    said = f"{agree.sum()} of {len(pairs)} mutual matches agree"
    print(said, flush=True)
    if agree.sum() < 3:
        return None, [f"{said}, too few: the scale is the RMS ratio of the whole clouds"]
    ratio = rms(matched[1][agree]) / rms(matched[0][agree])
    return ratio * scene.diagonal / cloud.diagonal, [said]


def agreeing(source: Array, target: Array, distance: float, seed: int) -> NDArray[np.bool_]:
    """Which matches (N, 3) and (N, 3) a similarity explains within `distance`: the most that RANSAC finds.

    Triples agree on one scale as Open3D asks it of edges, and it is within a factor of `MAX_SCALE_FACTOR` of 1: a
    similarity that shrinks the object into a spot explains everything.
    """
    best = np.zeros(len(source), dtype=bool)
    rng, drawn, wanted, at_once = np.random.default_rng(seed), 0, float(RANSAC_SAMPLES), 1 << 14
    while len(source) and drawn < wanted:
        triples, drawn = triples_of_one_scale(source, target, at_once, rng, EDGE_LENGTH), drawn + at_once
        for rows in triples.rows[np.abs(np.log(triples.scale)) < np.log(MAX_SCALE_FACTOR)]:
            try:
                pose = fit_sim3(source[rows], target[rows])
            except ValueError:  # along one line
                continue
            found = np.linalg.norm(pose.apply(source) - target, axis=1) <= distance
            if found.sum() > best.sum():
                best = found
                wanted = min(RANSAC_SAMPLES, np.log(1 - CONFIDENCE) / np.log1p(-min(found.mean() ** 3, CONFIDENCE)))
    return best


def paper_coarse(problem: Problem) -> tuple[Sim3, list[str]]:
    """Rigid RANSAC on FPFH matches of the object at its rectified scale, and notes on what Open3D said.

    Args:
        problem: the clouds, and the scale at which the object is taken: the centre of the range.
    """
    import open3d as o3d

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
    import open3d as o3d

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
    import open3d as o3d

    pcd = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
    pcd.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS * voxel, NORMAL_NEIGHBOURS))
    search = o3d.geometry.KDTreeSearchParamHybrid(FEATURE_RADIUS * voxel, FEATURE_NEIGHBOURS)
    return pcd, o3d.pipelines.registration.compute_fpfh_feature(pcd, search)  # type: ignore[call-arg]


def paper_fine(cloud: Cloud, scene: Cloud, start: Sim3) -> Sim3:
    """Point-to-point ICP, scale held, within 0.4 voxel, at most 35 iterations, both clouds at half a voxel."""
    import open3d as o3d

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
