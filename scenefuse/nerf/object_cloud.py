"""Object cloud from rendered depth: views fused where they agree, carved by the masks, thinned, cleaned."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenefuse.cores import use_threads
from scenefuse.io.clouds import Cloud, concatenate, spacing, voxel_downsample, write_cloud
from scenefuse.io.maps import read_depth, read_normals
from scenefuse.mvs.consistency import compare, extent, surface_points
from scenefuse.mvs.photo_refinement import RefinementSettings, refine_by_photos
from scenefuse.mvs.views import Views, load_views
from scenefuse.stage import StageError, quantity, read_json, setting, threads, write_json


@dataclass(frozen=True)
class CloudSettings:
    """How rendered depth maps become one cloud."""

    min_views: int = setting(2, least=0)
    """views that must agree on a point, its own included"""
    agreement: float = setting(0.006, unit="of the diagonal", least=0)
    """largest difference of depth that agrees, share of the diagonal"""
    min_confidence: float = setting(0.3, least=0)
    """rendered depths below this confidence (0..1) are not used"""
    through_share: float = setting(0.3, least=0)
    """share of the views that may see past a point"""
    mask_share: float = setting(0.1, least=0)
    """share of the views in whose mask a point need not lie"""
    spacing: float = setting(0.004, unit="of the diagonal", least=0)
    """distance between points, share of the diagonal"""
    outlier_deviations: float = setting(3, least=0)
    """points whose neighbours are farther than the mean by so many standard deviations are dropped"""
    min_component: float = setting(0.01, least=0)
    """connected groups with a smaller share of the points are dropped"""


def make_object_cloud(
    *,
    cameras: Path,
    masks: Path,
    stage: Path,
    stage_report: Path,
    cameras_report: Path,
    cloud: Path,
    report: Path,
    refinement: RefinementSettings,
    settings: CloudSettings,
    seed: int,
) -> None:
    """Fuse a NeRF stage's depth maps into the object's cloud (method N13), in the object's camera (SfM) frame.

    Rendered depths are first moved to where the photos match best, where they match, and those that the photos deny
    are left out (`refine_by_photos`).

    Args:
        cameras: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        stage: folder of the last NeRF stage.
        stage_report: its JSON, for `nerf_from_object`.
        cameras_report: JSON of the cameras stage, for `up_in_camera_frame`.
        cloud: output PLY with normals, colours, and the fields `confidence` (0..1) and `views`.
        report: output JSON.
        refinement: of rendered depths by photos.
        settings: gates and spacing.
        seed: of the sample that measures spacing.

    Raises:
        StageError: a map is missing, or no point passes the gates.
    """
    use_threads(threads())
    if not (stage / "model.pt").is_file():
        raise StageError(f"{stage}/model.pt does not exist; run the NeRF stage first")
    saved = torch.load(stage / "model.pt", map_location="cpu", weights_only=True)
    nerf_from_object = read_json(stage_report)["nerf_from_object"]
    up = read_json(cameras_report).get("up_in_camera_frame")
    width = read_depth(stage / "depth_maps" / f"{saved['names'][0]}.bin").shape[1]
    views = load_views(cameras, masks, width, 0)
    if views.names != list(saved["names"]):
        raise StageError(f"{stage} was made from other photos than {cameras} holds now; run the NeRF stage again")
    poses = saved["object_from_cam"].numpy()
    depths, confidence, normals = _maps(stage, views, settings.min_confidence)
    rendered = max(int((depths > 0).sum()), 1)
    refined = refine_by_photos(views, poses, depths, refinement)
    depths = np.where(refined.inconsistent, 0, refined.depths)
    raw, diagonal = fuse_depths(views, poses, depths, confidence, normals, settings)
    if len(raw) < 100:
        raise StageError(
            f"no surface found: {len(raw)} points of {stage} pass the gates; "
            "check masks and held-out renders, or loosen min_views, agreement and min_confidence"
        )
    thinned = voxel_downsample(raw, settings.spacing * diagonal)
    cleaned = clean(thinned, settings.outlier_deviations, settings.min_component, settings.spacing * diagonal)
    cleaned = with_plane_normals(cleaned, neighbours=16)
    write_cloud(cloud, cleaned)
    content = {
        "points": quantity(len(cleaned), "1"),
        "refined_share": quantity(float(refined.moved.sum() / rendered), "1"),
        "inconsistent_share": quantity(float(refined.inconsistent.sum() / rendered), "1"),
        "points_before_thinning": quantity(len(raw), "1"),
        "points_dropped_as_outliers": quantity(len(thinned) - len(cleaned), "1"),
        "spacing": quantity(spacing(cleaned.points, seed=seed), "object units"),
        "diagonal": quantity(cleaned.diagonal, "object units"),
        "views_per_point": quantity(float(np.mean(cleaned.fields["views"])), "1"),
        "confidence_mean": quantity(float(np.mean(cleaned.fields["confidence"])), "1"),
        "nerf_from_object": nerf_from_object,
    }
    write_json(report, content | ({"up_in_camera_frame": up} if up else {}))
    print(f"{len(cleaned)} points on a diagonal of {cleaned.diagonal:.4g}", flush=True)


def fuse_depths(
    views: Views,
    poses: NDArray[np.float64],
    depths: NDArray[np.float32],
    confidence: NDArray[np.float32],
    normals: NDArray[np.float32],
    settings: CloudSettings,
) -> tuple[Cloud, float]:
    """Points of all views that other views confirm, each the mean of those that agree, and the object's diagonal.

    Args:
        views: photos, masks and intrinsics at the maps' size.
        poses: (V, 4, 4) object_from_cam that the maps were rendered with.
        depths: (V, H, W) along z, 0 for none.
        confidence: (V, H, W) in 0..1.
        normals: (V, H, W, 3) in the camera frame.
        settings: the gates.
    """
    known = [surface_points(*view) for view in zip(depths, views.intrinsics, poses)]
    together = np.concatenate([points for points, _, _ in known])
    if len(together) == 0:
        return Cloud(together), 0.0
    diagonal = extent(together)
    grown = np.stack([cv2.dilate(m.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0 for m in views.masks])
    parts = []
    for index, (points, rows, columns) in enumerate(known):
        said = compare(points, index, depths, grown, views.intrinsics, poses, settings.agreement * diagonal)
        seen = said.agree + said.through
        keep = (said.agree + 1 >= settings.min_views) & (said.through <= settings.through_share * seen)
        keep &= said.off_mask <= settings.mask_share * said.compared
        rows, columns = rows[keep], columns[keep]
        turned = normals[index, rows, columns] @ poses[index, :3, :3].T.astype(np.float32)
        towards = poses[index, :3, 3] - said.mean[keep]
        missing = ~turned.any(1)
        turned[missing] = (towards[missing] / np.linalg.norm(towards[missing], axis=1, keepdims=True)).astype(
            np.float32
        )
        parts.append(
            Cloud(
                said.mean[keep],
                turned,
                views.images[index, rows, columns],
                {
                    "confidence": confidence[index, rows, columns].astype(np.float32),
                    "views": (said.agree[keep] + 1).astype(np.int32),
                },
            )
        )
    return concatenate(parts), diagonal


def clean(cloud: Cloud, deviations: float, min_component: float, step: float) -> Cloud:
    """Drop points with far neighbours, then small groups that no chain of steps of 3 x `step` joins to the rest."""
    distance = cKDTree(cloud.points).query(cloud.points, k=min(9, len(cloud)), workers=threads())[0][:, 1:].mean(1)
    cloud = cloud[distance <= distance.mean() + deviations * distance.std()]
    pairs = cKDTree(cloud.points).query_pairs(3 * step, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cloud), len(cloud)))
    group = connected_components(graph, directed=False)[1]
    return cloud[np.bincount(group)[group] >= min_component * len(cloud)]


def with_plane_normals(cloud: Cloud, neighbours: int) -> Cloud:
    """Normals of local planes through the nearest points, on the side of the rendered normals they replace."""
    index = cKDTree(cloud.points).query(cloud.points, k=min(neighbours, len(cloud)), workers=threads())[1]
    local = cloud.points[index] - cloud.points[index].mean(1, keepdims=True)
    normal = np.linalg.eigh(np.einsum("nki,nkj->nij", local, local))[1][:, :, 0]
    if cloud.normals is not None:
        normal *= np.where((normal * cloud.normals).sum(1, keepdims=True) < 0, -1.0, 1.0)
    return Cloud(cloud.points, normal.astype(np.float32), cloud.colors, cloud.fields)


def _maps(
    stage: Path, views: Views, least: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Depth (0 below the least confidence), confidence and normals of all views."""
    folders = "depth_maps", "confidence_maps", "normal_maps"
    depths, confidence, normals = (
        np.stack([(read_normals if k == "normal_maps" else read_depth)(stage / k / f"{n}.bin") for n in views.names])
        for k in folders
    )
    return np.where((confidence >= least) & views.masks, depths, 0).astype(np.float32), confidence, normals
