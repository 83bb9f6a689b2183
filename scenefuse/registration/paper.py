"""The paper's registration to the letter, as method R5 to R8 read it: rigid FPFH RANSAC, then point-to-point ICP."""

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from scenefuse.io.clouds import Cloud
from scenefuse.transforms import Sim3


def paper_coarse(
    cloud: Cloud, scene: Cloud, scale: float, voxel_fraction: float, samples: int, seed: int
) -> tuple[Sim3, list[str]]:
    """Rigid RANSAC on FPFH matches of the object at its rectified scale, and notes on what Open3D said.

    Normals from 2 voxels / 30 neighbours, FPFH from 5 voxels / 100, triples, edge-length check 0.9, distance 1.5
    voxels, mutual filter on, `samples` and a confidence of 0.999.

    Args:
        cloud: object in its own frame.
        scene: the scene crop.
        scale: scene units per object unit.
        voxel_fraction: share of the scene crop's diagonal.
        samples: RANSAC's largest number of iterations.
        seed: of RANSAC.
    """
    import open3d as o3d

    registration = o3d.pipelines.registration
    voxel = voxel_fraction * scene.diagonal
    scaled = Sim3(scale, np.eye(3), np.zeros(3))

    def features(points: np.ndarray):  # type: ignore[no-untyped-def]
        pcd = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel)
        pcd.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel, 30))
        search = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel, 100)
        return pcd, registration.compute_fpfh_feature(pcd, search)  # type: ignore[call-arg]

    source, source_features = features(scaled.apply(cloud.points))
    target, target_features = features(scene.points)
    matches = np.asarray(
        registration.correspondences_from_features(source_features, target_features, mutual_filter=True)
    )
    notes = []
    if len(matches) < 0.1 * len(source.points):
        notes.append(
            f"{len(matches)} mutual matches are too few for {len(source.points)} points:"
            " Open3D falls back to one-way matches"
        )
        print(notes[-1], flush=True)
    o3d.utility.random.seed(seed)
    with _one_thread():
        result = registration.registration_ransac_based_on_feature_matching(
            source,
            target,
            source_features,
            target_features,
            True,
            1.5 * voxel,
            registration.TransformationEstimationPointToPoint(False),
            3,
            [
                registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                registration.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
            ],
            registration.RANSACConvergenceCriteria(samples, 0.999),
        )
    return Sim3.from_matrix(np.asarray(result.transformation)) @ scaled, notes


def paper_fine(cloud: Cloud, scene: Cloud, start: Sim3, voxel_fraction: float) -> Sim3:
    """Point-to-point ICP, scale held, within 0.4 voxel, at most 35 iterations, both clouds at half a voxel."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    voxel = voxel_fraction * scene.diagonal
    pcd = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (start.apply(cloud.points), scene.points)]
    source, target = (p.voxel_down_sample(0.5 * voxel) for p in pcd)
    with _one_thread():
        result = registration.registration_icp(
            source,
            target,
            0.4 * voxel,
            np.eye(4),
            registration.TransformationEstimationPointToPoint(False),
            registration.ICPConvergenceCriteria(max_iteration=35),
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
