"""The dense cloud of a scene: its depth maps, fused by COLMAP's stereo fusion in a temporary workspace."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.cloud_file import NEIGHBOURS
from scenefuse.cloud.clouds import Cloud, read_cloud, spacing
from scenefuse.cloud.tiled_cloud import WHOLE, write_tiled
from scenefuse.core.stage import StageError, quantity, read_json, scratch_directory, setting, threads, value, write_json
from scenefuse.core.transforms import Array
from scenefuse.geometry.consistency import neighbours, vote
from scenefuse.geometry.photo_check import MAX_PHOTOS
from scenefuse.photos.geodesy import length_unit
from scenefuse.photos.pictures import read_depth, write_depth
from scenefuse.photos.workspace import View, posed_images, read_model, read_views
from scenefuse.sfm.colmap import cancellable

# Share of the measured pixels below which the cameras or the limits are probably wrong.
MIN_FUSED_SHARE = 0.01
# A point is dropped where the mean distance of its neighbours is more than so many times the cloud's median.
OUTLIER_RATIO = 4.0


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
    """Let the depth maps of all chunks vote on each other, and fuse what is left by COLMAP's stereo fusion.

    Args:
        workspace: the undistorted COLMAP workspace that the maps belong to.
        depth: the chunks' folders, each with depth_maps/ and normal_maps/. Maps may be smaller than the photos.
        depth_json: the chunks' reports, in the same order.
        georeference_json: of the scene, for the unit of its lengths, or nothing.
        settings: see DenseCloudSettings.
        cloud: output PLY in the workspace's frame: float64 positions, normals, colours, `views` (photos
            that agree on the point).
        report: output JSON: number of points, spacing, backend, what was dropped, the share of the pixels with a depth
            that are in the cloud, and a note where it is small, and the share that other maps voted out.

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
    fused, measured, left = _fuse(workspace, maps, neighbours(sources), settings, cloud)
    # COLMAP counts pixels, of which one photo may bring several; we count photos.
    agreed = fused[fused.fields["views"] >= settings.min_photos]
    if len(agreed) == 0:
        raise _no_points(settings)
    kept = agreed[near_others(agreed.points)]
    print(f"{len(kept)} points, {len(agreed) - len(kept)} outliers dropped", flush=True)
    content = _report(kept, len(agreed) - len(kept), measured, stages, length_unit(georeference_json))
    write_tiled(cloud, lambda: [kept], len(kept), kept.points)
    content |= {"depth_maps": quantity(len(maps), "1"), "outvoted_share": quantity(1 - left / max(measured, 1), "1")}
    write_json(report, content)


def _all(stages: list[dict[str, Any]], name: str) -> str:
    """A word of all chunks' reports."""
    return ", ".join(sorted({value(stage, name) for stage in stages}))


def _path(folder: Path, part: str, name: str) -> Path:
    return folder / part / f"{name}.bin"


def _report(cloud: Cloud, dropped: int, measured: int, stages: list[dict[str, Any]], unit: str) -> dict[str, Any]:
    """The cloud in numbers, with a note where it holds few of the measured pixels; and how its depth maps were made."""
    share, notes = float(cloud.fields["views"].sum() / max(measured, 1)), []
    if share < MIN_FUSED_SHARE:
        notes.append(
            f"only {share:.2%} of the pixels with a depth are in the cloud: the photos' depths disagree; look at"
            " the cameras, or lower scene.dense_cloud.min_photos"
        )
        print(f"note: {notes[0]}", flush=True)
    return {
        "points": quantity(len(cloud), "1"),
        "dropped_outliers": quantity(dropped, "1"),
        "spacing": quantity(spacing(cloud.points), unit),
        "median_views": quantity(float(np.median(cloud.fields["views"])), "1"),
        "fused_share": quantity(share, "1"),
        "notes": quantity(notes, ""),
        "backend": quantity(_all(stages, "backend"), ""),
        "device": quantity(_all(stages, "device"), ""),
        "reason": quantity(value(stages[0], "reason") if stages else "", ""),
    }


def _fuse(
    workspace: Path,
    maps: Mapping[str, Path],
    near: Mapping[str, list[str]],
    settings: DenseCloudSettings,
    beside: Path,
) -> tuple[Cloud, int, int]:
    """COLMAP's fusion of what is left of the maps after their vote, as a cloud with `views`; pixels before and after.

    Args:
        workspace: that the maps belong to.
        maps: photo -> folder that its maps lie below.
        near: photo -> photos that vote on its map.
        settings: see DenseCloudSettings.
        beside: path that COLMAP works beside.

    Raises:
        StageError: no point at all.
    """
    largest = max(_path(folder, "depth_maps", name).stat().st_size for name, folder in maps.items()) // 4
    photo = max(view.width * view.height for view in read_views(workspace / "sparse"))
    # COLMAP follows a point through 50 photos. Bytes of a pixel: 16 of its depth and normal, 3 of the photo, which it
    # keeps at its own size.
    cached = MAX_PHOTOS * (16 * largest + 3 * photo)
    widths = {name: _map_width(_path(folder, "depth_maps", name)) for name, folder in maps.items()}
    with linked_workspace(workspace, beside, widths) as folder:
        for name, source in maps.items():
            link = folder / "stereo/normal_maps" / f"{name}.geometric.bin"
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(_path(source, "normal_maps", name).resolve())
        measured, left = 0, 0
        for name, before, depth in _voted(workspace, maps, near, settings):
            write_depth(folder / "stereo/depth_maps" / f"{name}.geometric.bin", depth)
            measured, left = measured + before, left + int((depth > 0).sum())
        (folder / "stereo" / "fusion.cfg").write_text("".join(f"{name}\n" for name in sorted(maps)))
        path = folder / "fused.ply"
        fused = cancellable(
            pycolmap.stereo_fusion, path, folder, "COLMAP", "option-all", "geometric", _options(settings, cached), "PLY"
        )
        if not path.is_file() or (fused is not None and fused.num_points3D() == 0 and path.stat().st_size < 1000):
            raise _no_points(settings)
        cloud, views = read_cloud(path), _read_visibility(path.with_suffix(".ply.vis"))
    return Cloud(cloud.points, cloud.normals, cloud.colors, {"views": views}), measured, left


def _options(settings: DenseCloudSettings, cached_bytes: int) -> pycolmap.StereoFusionOptions:
    """COLMAP's own settings; cached_bytes: of the photos and maps that it keeps in memory."""
    options = pycolmap.StereoFusionOptions()
    options.num_threads = 1  # With more, which thread comes first decides the points.
    options.min_num_pixels = settings.min_photos
    options.max_reproj_error = settings.max_reprojection_px
    options.max_depth_error = settings.max_depth_error
    options.max_normal_error = settings.max_normal_error_deg
    options.use_cache, options.cache_size = True, cached_bytes / 1e9
    return options


def _voted(
    workspace: Path, maps: Mapping[str, Path], near: Mapping[str, list[str]], settings: DenseCloudSettings
) -> Iterator[tuple[str, int, NDArray[np.float32]]]:
    """Each photo, its number of depths, and its depths (H, W) that more maps confirm than see through."""
    cameras = {view.name: view for view in read_views(workspace / "sparse")}

    @lru_cache(MAX_PHOTOS)
    def depths(name: str) -> View:
        pixels = read_depth(_path(maps[name], "depth_maps", name))
        return replace(cameras[name].resized(pixels.shape[1], pixels.shape[0]), pixels=pixels)

    for name in sorted(maps):
        view = depths(name)
        others = [depths(other) for other in near.get(name, []) if other in maps]
        votes = vote(view, others, settings.max_depth_error, settings.max_reprojection_px)
        stays = votes.agree > votes.through
        if settings.min_photos < 2:
            stays |= votes.through == 0
        yield name, int((view.pixels > 0).sum()), np.where(stays, view.pixels, np.float32(0))


def _no_points(settings: DenseCloudSettings) -> StageError:
    """The error for maps that do not agree anywhere."""
    return StageError(
        f"no point is seen alike by {settings.min_photos} photos; lower scene.dense_cloud.min_photos, or check the"
        " cameras"
    )


def _map_width(path: Path) -> int:
    """Width of a COLMAP map, from its header `width&height&channels&`."""
    with open(path, "rb") as file:
        return int(file.read(64).split(b"&")[0])


def _read_visibility(path: Path) -> NDArray[np.uint16]:
    """Photos per point, (N,), from COLMAP's .vis file: uint64 N, then per point uint32 n and n uint32 indices."""
    words = np.fromfile(path, dtype=np.uint32)
    count, position = int(words[:2].view(np.uint64)[0]), 2
    views = np.empty(count, dtype=np.uint16)
    for k in range(count):
        views[k] = words[position]
        position += 1 + int(words[position])
    return views


def near_others(points: Array) -> NDArray[np.bool_]:
    """(N,) True where a point's neighbours are about as near as they are for the others."""
    if len(points) <= NEIGHBOURS:
        return np.ones(len(points), dtype=bool)
    tree, distance = cKDTree(points), np.empty(len(points))
    for rows in np.array_split(np.arange(len(points)), -(-len(points) // WHOLE)):
        distance[rows] = tree.query(points[rows], k=NEIGHBOURS + 1, workers=threads())[0][:, 1:].mean(1)
    return distance <= OUTLIER_RATIO * np.median(distance)


@contextmanager
def linked_workspace(workspace: Path, beside: Path, map_widths: Mapping[str, int]) -> Iterator[Path]:
    """A temporary COLMAP workspace, removed afterwards: links to the photos, and shifted cameras.

    COLMAP's dense part takes the first pixel's centre as 0, its sparse part as 0.5, so principal points move by half
    a pixel of the map. With exact depth maps this takes the fused cloud from a quarter of a pixel's error to none.

    Args:
        workspace: with images/ and sparse/, PINHOLE cameras.
        beside: path that it lies beside, on the file system of what comes out, so that maps can be moved there.
        map_widths: width of the depth map of each photo, in pixels; photos of one camera have maps of one width.
    """
    model = read_model(workspace / "sparse")
    widths = {image.camera_id: map_widths[image.name] for image in posed_images(model) if image.name in map_widths}
    for camera in model.cameras.values():
        half = 0.5 * camera.width / widths.get(camera.camera_id, camera.width)
        fx, fy, cx, cy = camera.params
        camera.params = [fx, fy, cx - half, cy - half]
    with scratch_directory(beside) as folder:
        (folder / "sparse").mkdir()
        model.write_binary(folder / "sparse")
        (folder / "images").symlink_to((workspace / "images").resolve())
        yield folder
