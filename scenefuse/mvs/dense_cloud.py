"""The dense cloud of a scene: what its depth maps confirm of each other, a point for each pixel of the finest one.

Source: Merrell et al. 2007.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, concatenate, near_others, spacing, voxel_downsample
from scenefuse.cloud.tiled_cloud import write_tiled
from scenefuse.core.stage import StageError, quantity, read_json, setting, value, write_json
from scenefuse.geometry.consistency import DepthMap, Votes, back_project, neighbours, surface_points, vote
from scenefuse.geometry.depth_test import MAX_PHOTOS
from scenefuse.photos.geodesy import length_unit
from scenefuse.photos.pictures import read_depth, read_normals, read_rgb
from scenefuse.photos.workspace import View, read_views

# Share of the measured pixels below which the cameras or the limits are probably wrong.
MIN_FUSED_SHARE = 0.01


@dataclass(frozen=True)
class DenseCloudSettings:
    """How depth maps become one cloud."""

    min_photos: int = setting(3, least=0)
    """Photos that must agree on a point."""
    max_reprojection_px: float = 2
    """Largest distance between a pixel and the point of another photo projected into it."""
    max_depth_error: float = 0.01
    """Largest relative difference of two photos' depths of a point."""
    max_normal_error_deg: float = 30
    """Largest angle between two photos' normals of a point."""


def fuse_depth_maps(
    *,
    workspace: Path,
    depth: list[Path],
    depth_json: list[Path],
    georeference_json: Path | None = None,
    settings: DenseCloudSettings,
    cloud: Path,
    report: Path,
) -> None:
    """Let the depth maps of all chunks vote on each other, and make a cloud of what enough of them confirm.

    Args:
        workspace: the undistorted COLMAP workspace that the maps belong to.
        depth: the chunks' folders, each with depth_maps/ and normal_maps/. Maps may be smaller than the photos.
        depth_json: the chunks' reports, in the same order.
        georeference_json: of the scene, for the unit of its lengths, or nothing.
        settings: see DenseCloudSettings.
        cloud: output PLY in the workspace's frame: float64 positions, normals, colours, `views` (photos
            that agree on the point).
        report: output JSON: number of points, spacing, backend, the share of the pixels with a depth that enough photos
            confirm, and a note where it is small.

    Raises:
        StageError: no depth maps, or no point on which enough photos agree.
    """
    maps = {
        path.relative_to(folder / "depth_maps").as_posix()[: -len(".bin")]: folder
        for folder in depth
        for path in sorted((folder / "depth_maps").rglob("*.bin"))
    }
    if not maps:
        raise StageError(f"no depth maps in {', '.join(map(str, depth))}; run the depth stage first")
    stages = [read_json(path) for path in depth_json]
    print(f"fusing {len(maps)} depth maps by {_all(stages, 'backend')}", flush=True)
    sources = {name: photo["sources"] for stage in stages for name, photo in stage["photos"].items()}
    fused, pixel, share = _fuse(workspace, maps, neighbours(sources), settings)
    if len(fused) == 0:
        raise StageError(
            f"no point is seen alike by {settings.min_photos} photos; lower scene.dense_cloud.min_photos, or check the"
            " cameras"
        )
    near = near_others(fused.points, fused.fields.pop("pixel"))
    kept = voxel_downsample(fused[near], pixel)
    print(f"{len(kept)} points, {(~near).sum()} of {len(fused)} dropped as outliers before thinning", flush=True)
    content = _report(kept, share, stages, length_unit(georeference_json))
    write_tiled(cloud, lambda: [kept], len(kept), kept.points)
    write_json(report, content | {"depth_maps": quantity(len(maps), "1")})


def _all(stages: list[dict[str, Any]], name: str) -> str:
    """A word of all chunks' reports."""
    return ", ".join(sorted({value(stage, name) for stage in stages}))


def _report(cloud: Cloud, share: float, stages: list[dict[str, Any]], unit: str) -> dict[str, Any]:
    """The cloud in numbers, with a note where it holds few of the measured pixels; and how its depth maps were made."""
    notes = []
    if share < MIN_FUSED_SHARE:
        notes.append(
            f"only {share:.2%} of the pixels with a depth are in the cloud: the photos' depths disagree; look at"
            " the cameras, or lower scene.dense_cloud.min_photos"
        )
        print(f"note: {notes[0]}", flush=True)
    return {
        "points": quantity(len(cloud), "1"),
        "spacing": quantity(spacing(cloud.points), unit),
        "fused_share": quantity(share, "1"),
        "notes": quantity(notes, ""),
        "backend": quantity(_all(stages, "backend"), ""),
        "device": quantity(_all(stages, "device"), ""),
        "reason": quantity(value(stages[0], "reason") if stages else "", ""),
    }


def _fuse(
    workspace: Path, maps: Mapping[str, Path], near: Mapping[str, list[str]], settings: DenseCloudSettings
) -> tuple[Cloud, float, float]:
    """A cloud of the pixels that enough maps confirm, with `views` and the size of each, `pixel`; that of the finest
    map's pixels on the surface; and which share of the pixels with a depth they are.

    Where several maps show a place, the finest one on the whole gives its points, and each that is finer there.

    Args:
        workspace: that the maps belong to.
        maps: photo -> folder that its maps lie below.
        near: photo -> photos that vote on its map.
        settings: see DenseCloudSettings.
    """
    cameras = {view.name: view for view in read_views(workspace / "sparse")}
    near = {name: [other for other in near.get(name, []) if other in maps] for name in maps}
    limits = settings.max_depth_error, settings.max_reprojection_px, settings.max_normal_error_deg
    measured = lru_cache(MAX_PHOTOS)(lambda name: _read_map(cameras[name], workspace / "images", maps[name]))
    confirmed: dict[str, NDArray[np.uint8]] = {}  # eight pixels in one number
    pixel: dict[str, float] = {}
    count = stay = 0
    for name in sorted(maps):
        own = measured(name)
        votes = vote(own, map(measured, near[name]), *limits)
        stays = votes.agree > votes.through
        if settings.min_photos < 2:
            stays |= votes.through == 0
        stays &= (own.view.pixels > 0) & (votes.agree + 1 >= settings.min_photos)
        count, stay = count + int((own.view.pixels > 0).sum()), stay + int(stays.sum())
        confirmed[name] = np.packbits(stays)
        pixel[name] = float(np.median(own.view.pixels[stays])) / own.view.intrinsics[0, 0] if stays.any() else math.inf

    def surface(name: str) -> DepthMap:
        bits = np.unpackbits(confirmed[name], count=measured(name).view.pixels.size)
        return _only(measured(name), bits > 0)

    parts, place = [], {name: (pixel[name], name) for name in maps}
    for name in sorted(maps, key=lambda name: place[name]):
        own = surface(name)
        points, *pixels = surface_points(own.view.pixels, own.view.intrinsics, own.view.world_from_cam)
        size = own.view.pixels[*pixels] / own.view.intrinsics[0, 0]
        for other in (surface(other) for other in near[name] if place[other] < place[name]):
            # The far part of an oblique photo is coarser than one from above, as fine as its near part may be.
            fine = np.zeros(own.view.pixels.shape, bool)
            fine[*pixels] = other.view.project(points)[1] / other.view.intrinsics[0, 0] <= 1.2 * size
            own = _only(own, vote(_only(own, fine), [other], *limits).agree == 0)
        parts.append(_points(own, vote(own, map(measured, near[name]), *limits)))
    return concatenate(parts), min(pixel.values()), stay / max(count, 1)


def _read_map(camera: View, photos: Path, folder: Path) -> DepthMap:
    """The maps of one photo in a folder of depth_maps/ and normal_maps/, with its colours."""
    depth, normals = (
        read_depth(folder / f"depth_maps/{camera.name}.bin"),
        read_normals(folder / f"normal_maps/{camera.name}.bin"),
    )
    photo = replace(camera, pixels=read_rgb(photos / camera.name)).resized(*depth.shape[::-1])
    turned = normals @ camera.cam_from_world[:3, :3].astype(np.float32)
    return DepthMap(replace(photo, pixels=depth), turned, photo.pixels)


def _only(whole: DepthMap, where: NDArray[Any]) -> DepthMap:
    """A map without the depths elsewhere."""
    depth = whole.view.pixels
    return replace(whole, view=replace(whole.view, pixels=np.where(where.reshape(depth.shape), depth, np.float32(0))))


def _points(own: DepthMap, votes: Votes) -> Cloud:
    """A point for each depth of a map, the mean of those that agree."""
    rows, columns = np.nonzero(own.view.pixels > 0)
    depth, normals, colors = np.split(votes.mean[rows, columns], [1, 4], axis=1)
    points = back_project(depth[:, 0].astype(np.float64), own.view.intrinsics, own.view.world_from_cam, rows, columns)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    fields = {"views": votes.agree[rows, columns] + np.uint16(1), "pixel": depth[:, 0] / own.view.intrinsics[0, 0]}
    return Cloud(points, normals, np.rint(colors).astype(np.uint8), fields)
