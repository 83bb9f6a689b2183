"""Object cloud from rendered depth: views fused where they agree, carved by the masks, thinned, cleaned."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import NEIGHBOURS, Cloud, concatenate, near_others, spacing, voxel_downsample, write_cloud
from scenefuse.cloud.import_cloud import MIN_POINTS
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError, quantity, read_json, setting, threads, write_json
from scenefuse.geometry.consistency import compare, extent, surface_points
from scenefuse.geometry.surface import normals_at
from scenefuse.mvs.photo_refinement import RefinementSettings, refine_by_photos
from scenefuse.mvs.sparse_depths import MASK_REACH_PX, sparse_depths
from scenefuse.mvs.stereo_points import with_stereo
from scenefuse.nerf.appearance import without_appearance
from scenefuse.nerf.rendered_maps import read_nerf
from scenefuse.photos.pictures import read_depth, read_normals
from scenefuse.photos.views import Views, load_views

Maps = NDArray[np.float32]

# Points belong to one group where steps of this many spacings lead from one to the other.
MAX_STEP = 3


@dataclass(frozen=True)
class CloudGates:
    """Which points of rendered depth maps are kept."""

    point_agreement: float = 0.006
    """Largest difference of depth that agrees, share of the object's diagonal."""
    min_confidence: float = 0.3
    """Rendered depths below this confidence (0..1) are not used."""
    through_share: float = 0.3
    """Share of the views that may see past a point."""
    mask_share: float = 0.1
    """Share of the views in whose mask a point need not lie."""
    min_component: float = 0.01
    """Connected groups with a smaller share of the points are dropped."""


@dataclass(frozen=True)
class CloudSettings:
    """How rendered depth maps become one cloud."""

    min_views: int = setting(2, least=1)
    """Views that must agree on a point, its own included; more keep fewer and better points."""
    spacing: float = setting(0.004, above=0, most=1)
    """Voxels that keep one point each, share of the object's diagonal; smaller where the maps' pixels are smaller."""
    gates: CloudGates = CloudGates()
    """Which points are kept."""
    refinement: RefinementSettings = RefinementSettings()
    """Of rendered depths by photos."""


@dataclass(frozen=True)
class CloudInputs:
    """What an object's cloud is made from."""

    workspace: Path
    """Undistorted COLMAP workspace of the object."""
    workspace_json: Path
    """Its JSON, for `up_in_camera_frame`."""
    masks: Path
    """Folder of masks named like the photos, .png."""
    stage: Path
    """Folder of the last NeRF stage."""
    stage_json: Path
    """Its JSON, for `nerf_from_object`."""


def make_object_cloud(*, inputs: CloudInputs, cloud: Path, report: Path, settings: CloudSettings, seed: int) -> None:
    """Fuse a NeRF stage's depth maps into the object's cloud (method N13), in the object's camera (SfM) frame.

    Rendered depths are first moved to where the photos match best, where they match, and those that no photo confirms
    although there is texture are left out (`refine_by_photos`). Colours are those of one exposure: what the NeRF found
    of each photo's gains and of the vignetting is taken out.

    Args:
        inputs: photos, masks and the NeRF stage.
        cloud: output PLY with normals, colours, and the fields `confidence` (0..1) and `views`.
        report: output JSON.
        settings: gates and spacing.
        seed: of the sample that measures spacing.

    Raises:
        StageError: a map is missing, or no point passes the gates.
    """
    use_threads(threads())
    saved = read_nerf(inputs.stage)
    of = {"nerf_from_object": inputs.stage_json, "up_in_camera_frame": inputs.workspace_json}
    known = {name: read_json(path)[name] for name, path in of.items()}
    views = _views(inputs, saved["names"])
    maps = read_maps(inputs.stage, views, settings.gates.min_confidence)
    rendered = max(int((maps.depths > 0).sum()), 1)
    refined = refine_by_photos(views, maps.depths, settings.refinement)
    maps = replace(maps, depths=np.where(refined.inconsistent, 0, refined.depths))
    raw, diagonal = fuse_depths(_neutral(views, saved), maps, settings)
    if len(raw) < MIN_POINTS:
        raise StageError(
            f"no surface found: {len(raw)} points of {inputs.stage} pass the gates; check masks and held-out renders, "
            "or lower min_views"
        )
    # Voxels are no larger than half a window that depths were matched by, which tells no more.
    pixels = settings.refinement.match_window_px // 2
    voxel = min(settings.spacing * diagonal, pixels * footprint(maps.depths, views.intrinsics))
    cleaned = with_plane_normals(clean(voxel_downsample(raw, voxel), settings.gates.min_component, voxel))
    shares = float(refined.moved.sum() / rendered), float(refined.inconsistent.sum() / rendered)
    write_cloud(cloud, cleaned)
    write_json(report, _report(cleaned, shares, seed) | known)
    print(f"{len(cleaned)} points on a diagonal of {cleaned.diagonal:.4g}", flush=True)


@dataclass(frozen=True)
class SurfaceMaps:
    """Rendered maps of V views: depths (V, H, W) along z, 0 for none; confidence (V, H, W) in 0..1; normals
    (V, H, W, 3) in the camera's axes, 0 for none."""

    depths: Maps
    confidence: Maps
    normals: NDArray[np.float16]


def fuse_depths(views: Views, maps: SurfaceMaps, settings: CloudSettings) -> tuple[Cloud, float]:
    """Points of all views that other views confirm, each the mean of those that agree, and the object's diagonal.

    Args:
        views: photos, masks and cameras at the maps' size.
        maps: of the views.
        settings: the gates.
    """
    points = [surface_points(*view)[0] for view in zip(maps.depths, views.intrinsics, views.object_from_cam)]
    together = np.concatenate(points)
    if len(together) == 0:
        return Cloud(together), 0.0
    diagonal = extent(together)
    size = 2 * MASK_REACH_PX + 1
    grown = np.stack([cv2.dilate(m.astype(np.uint8), np.ones((size, size), np.uint8)) > 0 for m in views.masks])
    tolerance = settings.gates.point_agreement * diagonal
    seen = grown, sparse_depths(with_stereo(views))
    parts = [_confirmed(views, maps, seen, tolerance, index, settings) for index in range(len(points))]
    return concatenate(parts), diagonal


def _confirmed(
    views: Views, maps: SurfaceMaps, seen: tuple[NDArray[np.bool_], Maps],
    tolerance: float, index: int, settings: CloudSettings,
) -> Cloud:  # fmt: skip
    """The points of one view that pass the gates; `seen` (V, H, W) are the masks that points may lie in, and from
    which depth on they may lie beside them."""
    poses, intrinsics = views.object_from_cam, views.intrinsics
    points, rows, columns = surface_points(maps.depths[index], intrinsics[index], poses[index])
    found = compare(points, index, maps.depths, seen[0], intrinsics, poses, tolerance, seen[1])
    gates = settings.gates
    keep = found.agree + 1 >= settings.min_views
    keep &= found.through <= gates.through_share * (found.agree + found.through)
    keep &= found.off_mask <= gates.mask_share * found.compared
    rows, columns = rows[keep], columns[keep]
    normals = maps.normals[index, rows, columns].astype(np.float32) @ poses[index, :3, :3].T.astype(np.float32)
    towards = poses[index, :3, 3] - found.mean[keep]
    missing = ~normals.any(1)
    normals[missing] = towards[missing] / np.linalg.norm(towards[missing], axis=1, keepdims=True)
    fields = {
        "confidence": maps.confidence[index, rows, columns].astype(np.float32),
        "views": (found.agree[keep] + 1).astype(np.int32),
        "pixel": maps.depths[index, rows, columns] / intrinsics[index, 0, 0],
    }
    return Cloud(found.mean[keep], normals, views.images[index, rows, columns], fields)


def footprint(depths: Maps, intrinsics: NDArray[np.float64]) -> float:
    """How large a pixel of the maps (V, H, W) is on the surface that it faces, the median; unit of the depths."""
    rows, *pixels = np.nonzero(depths > 0)
    return float(np.median(depths[rows, *pixels] / intrinsics[rows, 0, 0]))


def clean(cloud: Cloud, min_component: float, step: float) -> Cloud:
    """Drop points far from all others, then small groups that no chain of steps of 3 x `step` joins to the rest; where
    the field `pixel`, which goes, is larger than the step, points lie so far apart."""
    size = np.maximum(cloud.fields.get("pixel", np.zeros(len(cloud))), step)
    near = near_others(cloud.points, size)
    cloud, size = cloud[near], size[near]
    cloud.fields.pop("pixel", None)
    tree, coarse = cKDTree(cloud.points), np.flatnonzero(size > step)
    pairs = tree.query_pairs(MAX_STEP * step, output_type="ndarray")
    distance, other = tree.query(cloud.points[coarse], k=min(NEIGHBOURS + 1, len(cloud)), workers=threads())
    row, column = np.nonzero(distance <= MAX_STEP * size[coarse, None])
    together = np.concatenate([pairs, np.column_stack([coarse[row], other[row, column]])])
    graph = coo_matrix((np.ones(len(together)), together.T), shape=(len(cloud), len(cloud)))
    group = connected_components(graph, directed=False)[1]
    return cloud[np.bincount(group)[group] >= min_component * len(cloud)]


def with_plane_normals(cloud: Cloud) -> Cloud:
    """Normals of local planes through the nearest points, on the side of the rendered normals they replace."""
    normal = normals_at(cloud.points, cloud.points)
    if cloud.normals is not None:
        normal *= np.where((normal * cloud.normals).sum(1, keepdims=True) < 0, -1.0, 1.0)
    return Cloud(cloud.points, normal.astype(np.float32), cloud.colors, cloud.fields)


def _views(inputs: CloudInputs, names: list[str]) -> Views:
    """The photos at the size of the stage's maps."""
    width = max(read_depth(inputs.stage / "depth_maps" / f"{name}.bin").shape[1] for name in names)
    views = load_views(inputs.workspace, inputs.masks, width, 0)
    if views.names != list(names):
        raise StageError(
            f"{inputs.stage} was made from other photos than {inputs.workspace} holds now; run the NeRF stage again"
        )
    return views


def _neutral(views: Views, saved: dict[str, Any]) -> Views:
    """The photos with the gains and the vignetting that the NeRF found taken out."""
    images, intrinsics = torch.from_numpy(views.images), torch.from_numpy(views.intrinsics.astype(np.float32))
    return replace(views, images=without_appearance(images, intrinsics, saved["log_gain"], saved["falloff"]).numpy())


def read_maps(stage: Path, views: Views, least_confidence: float) -> SurfaceMaps:
    """The maps of all views, without depths outside the masks or below the least confidence.

    They are most of the stage's memory: each is read into its place.
    """
    depths = np.zeros(views.masks.shape, np.float32)
    confidence = np.zeros_like(depths)
    normals = np.zeros((*depths.shape, 3), np.float16)
    kinds: list[tuple[str, Any, Any]] = [
        ("depth_maps", depths, read_depth),
        ("confidence_maps", confidence, read_depth),
        ("normal_maps", normals, read_normals),
    ]
    for folder, maps, read in kinds:
        for index, name in enumerate(views.names):
            found = read(stage / folder / f"{name}.bin")
            maps[index, : found.shape[0], : found.shape[1]] = found
    depths[(confidence < least_confidence) | ~views.masks] = 0
    return SurfaceMaps(depths, confidence, normals)


def _report(cleaned: Cloud, shares: tuple[float, float], seed: int) -> dict[str, Any]:
    """The cloud, and the shares of rendered depths that photos moved and contradicted."""
    return {
        "points": quantity(len(cleaned), "1"),
        "refined_share": quantity(shares[0], "1"),
        "inconsistent_share": quantity(shares[1], "1"),
        "spacing": quantity(spacing(cleaned.points, seed=seed), "object units"),
        "diagonal": quantity(cleaned.diagonal, "object units"),
    }
