"""Depth maps of an undistorted COLMAP workspace, in chunks, and their fusion into the scene's dense cloud."""

import copy
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cores import use_threads
from scenefuse.io.clouds import Cloud, read_cloud, spacing, write_cloud
from scenefuse.io.maps import read_depth, write_depth, write_normals
from scenefuse.io.units import length_unit
from scenefuse.mvs.plane_sweep import DepthSettings, Photo, estimate_depth
from scenefuse.sfm.features import cancellable
from scenefuse.stage import (
    StageError,
    atomic_directory,
    manifest,
    quantity,
    read_json,
    setting,
    threads,
    value,
    write_json,
)

FEW_FUSED = 0.01


@dataclass(frozen=True)
class FusionSettings:
    """How depth maps become one cloud."""

    min_photos: int = setting(3, least=0)
    """Photos that must agree on a point."""
    max_reprojection_px: float = setting(2, unit="px", least=0)
    """Largest distance between a pixel and the point of another photo projected into it."""
    max_depth_error: float = setting(0.01, least=0)
    """Largest relative difference of two photos' depths of a point."""
    max_normal_error_deg: float = setting(90, unit="degree", least=0)
    """Largest angle between two photos' normals of a point."""
    max_traversal_depth: int = setting(100, least=0)
    """Largest number of steps from photo to photo in one point's search for agreement."""
    outlier_neighbours: int = setting(8, least=0)
    """Neighbours whose mean distance tells a lonely point."""
    outlier_ratio: float = setting(4, least=0)
    """A point is dropped when that distance is more than so many times the cloud's median; 0 keeps all."""


@dataclass(frozen=True)
class _Task:
    """One reference photo of a workspace, its sources and its depth range."""

    name: str
    sources: list[str]
    near: float
    far: float


def estimate_depth_maps(
    *,
    workspace: Path,
    chunk: int,
    chunks: int,
    backend: Literal["auto", "colmap", "torch"],
    settings: DepthSettings,
    seed: int,
    depth: Path,
    report: Path,
) -> None:
    """Write depth and normal maps for one chunk of the photos of an undistorted workspace.

    COLMAP's patch-match runs where CUDA is present (the paper's method; method M3: the sources are
    `__auto__`); otherwise a plane sweep
    in PyTorch, on CUDA or the CPU, takes its place. Which one ran, and why, is in the report.

    Args:
        workspace: COLMAP workspace with images/ and sparse/ (PINHOLE cameras, sparse points with tracks).
        chunk: which share of the photos, 0 .. chunks - 1: every chunks-th photo in name order.
        chunks: number of shares.
        backend: `colmap` needs CUDA; `torch` is our plane sweep; `auto` takes the first that can run.
        settings: see DepthSettings.
        seed: seed of everything random (COLMAP's patch-match keeps its own).
        depth: output folder with depth_maps/{photo}.bin (H, W; along z; the model's unit; 0 = none) and
            normal_maps/{photo}.bin
            (H, W, 3; camera frame), in COLMAP's format.
        report: output JSON: backend and why, device, sources, depth range and coverage per photo, hashes of the maps.

    Raises:
        StageError: no CUDA for `colmap`; no photos or points in the workspace; an unreadable photo; a
            chunk out of range.
    """
    if not 0 <= chunk < chunks:
        raise StageError(f"chunk {chunk} of {chunks} does not exist; chunks count from 0 to {chunks - 1}")
    chosen, why = _choose_backend(backend)
    device = "cuda" if chosen == "colmap" or torch.cuda.is_available() else "cpu"
    print(f"depth maps by {chosen} on {device}: {why}", flush=True)
    torch.manual_seed(seed)
    use_threads(threads())
    model = _read_model(workspace)
    tasks = _tasks(model, settings)
    if not tasks:
        raise StageError(
            f"no photo in {workspace} shares points with another at {settings.min_angle_deg} degrees or more; "
            "check the sparse model, or lower min_angle_deg"
        )
    names = sorted(tasks)[chunk::chunks]
    with atomic_directory(depth) as folder:
        (folder / "depth_maps").mkdir()
        (folder / "normal_maps").mkdir()
        if names and chosen == "colmap":
            _run_colmap(workspace, model, [tasks[n] for n in names], settings, folder)
        elif names:
            _run_torch(workspace, model, [tasks[n] for n in names], settings, device, folder)
        coverage = {n: float((read_depth(folder / "depth_maps" / f"{n}.bin") > 0).mean()) for n in names}
        files = manifest(folder)
    photos = {
        n: {
            "sources": tasks[n].sources,
            "near": round(tasks[n].near, 4),
            "far": round(tasks[n].far, 4),
            "coverage": round(coverage[n], 4),
        }
        for n in names
    }
    write_json(
        report,
        {
            "backend": quantity(chosen, ""),
            "reason": quantity(why, ""),
            "device": quantity(device, ""),
            "chunk": quantity(f"{chunk} of {chunks}", ""),
            "median_coverage": quantity(float(np.median(list(coverage.values()))) if coverage else 0.0, "1"),
            "photos": photos,
            "files": files,
        },
    )


def fuse_depth_maps(
    *,
    workspace: Path,
    depth: list[Path],
    depth_reports: list[Path],
    georeference: Path | None = None,
    settings: FusionSettings,
    cloud: Path,
    report: Path,
) -> None:
    """Fuse the depth maps of all chunks into one cloud by COLMAP's stereo fusion.

    Args:
        workspace: the undistorted COLMAP workspace that the maps belong to.
        depth: the chunks' folders, each with depth_maps/ and normal_maps/. Maps may be smaller than the photos.
        depth_reports: the chunks' JSON reports, in the same order.
        georeference: JSON of the scene, for the unit of its lengths, or nothing.
        settings: see FusionSettings.
        cloud: output PLY in the workspace's frame: float64 positions, normals, colours, `views` (photos
            that agree on the point).
        report: output JSON: number of points, spacing, backend, what was dropped, the share of the pixels with a depth
            that are in the cloud, and a note where it is small.

    Raises:
        StageError: no depth maps, or no point on which enough photos agree.
    """
    model = _read_model(workspace)
    maps = {
        p.relative_to(folder / "depth_maps").as_posix()[: -len(".bin")]: (folder, p)
        for folder in depth
        for p in sorted((folder / "depth_maps").rglob("*.bin"))
    }
    if not maps:
        raise StageError(f"no depth maps in {', '.join(map(str, depth))}; run the depth stage first")
    stages = [read_json(r) for r in depth_reports]
    backends = sorted({value(s, "backend") for s in stages})
    print(f"fusing {len(maps)} depth maps by {', '.join(backends)}", flush=True)
    widths = {image.camera_id: _map_width(maps[image.name][1]) for image in model.images.values() if image.name in maps}
    with _workspace_of_links(workspace, model, lambda c: widths.get(c.camera_id, c.width)) as folder:
        for name, (folder_of_map, path) in maps.items():
            for kind in ("depth_maps", "normal_maps"):
                link = folder / "stereo" / kind / f"{name}.geometric.bin"
                link.parent.mkdir(parents=True, exist_ok=True)
                link.symlink_to((folder_of_map / kind / path.relative_to(folder_of_map / "depth_maps")).resolve())
        (folder / "stereo" / "fusion.cfg").write_text("".join(f"{n}\n" for n in sorted(maps)))
        fused = _stereo_fusion(folder, settings)
    # COLMAP counts pixels, of which one photo may bring several; we count photos.
    agreed = fused[fused.fields["views"] >= settings.min_photos]
    if len(agreed) == 0:
        raise _no_points(settings)
    kept = agreed[_near_others(agreed.points, settings)]
    print(f"{len(kept)} points, {len(agreed) - len(kept)} lonely ones dropped", flush=True)
    measured = sum(int((read_depth(path) > 0).sum()) for _, path in maps.values())
    fused_share = float(kept.fields["views"].sum() / max(measured, 1))
    notes = []
    if fused_share < FEW_FUSED:
        notes.append(
            f"only {fused_share:.2%} of the pixels with a depth are in the cloud: the photos' depths disagree; look at"
            " the cameras, or raise max_depth_error, max_reprojection_px or max_normal_error_deg"
        )
        print(f"note: {notes[0]}", flush=True)
    write_cloud(cloud, kept)
    write_json(
        report,
        {
            "points": quantity(len(kept), "1"),
            "dropped_outliers": quantity(len(agreed) - len(kept), "1"),
            "spacing": quantity(spacing(kept.points), length_unit(georeference)),
            "median_views": quantity(float(np.median(kept.fields["views"])), "1"),
            "depth_maps": quantity(len(maps), "1"),
            "fused_share": quantity(fused_share, "1"),
            "notes": quantity(notes, ""),
            "backend": quantity(", ".join(backends), ""),
            "device": quantity(", ".join(sorted({value(s, "device") for s in stages})), ""),
            "reason": quantity(value(stages[0], "reason") if stages else "", ""),
        },
    )


def _choose_backend(backend: str) -> tuple[str, str]:
    """The backend that runs, and why."""
    if backend == "torch":
        return "torch", "asked for"
    if pycolmap.has_cuda:
        return "colmap", "asked for" if backend == "colmap" else "pycolmap has CUDA"
    if backend == "colmap":
        raise StageError(
            "COLMAP's patch-match needs CUDA, and this pycolmap has none; install pycolmap-cuda12, "
            "or set the depth backend to auto or torch"
        )
    return "torch", "fallback: this pycolmap has no CUDA, so its patch-match cannot run"


def _read_model(workspace: Path) -> pycolmap.Reconstruction:
    """The workspace's sparse model."""
    try:
        model = pycolmap.Reconstruction(workspace / "sparse")
    except Exception as error:
        raise StageError(
            f"{workspace}/sparse is not a readable COLMAP model ({error}); rerun the undistortion stage"
        ) from None
    if model.num_reg_images() < 2 or model.num_points3D() == 0:
        raise StageError(
            f"{workspace} has {model.num_reg_images()} photos and {model.num_points3D()} sparse points; "
            "stereo needs two photos and points they share"
        )
    return model


def _tasks(model: pycolmap.Reconstruction, settings: DepthSettings) -> dict[str, _Task]:
    """Sources and depth range of every photo that has any, by name, from the sparse points.

    A source's worth is the sum over shared points of a weight that falls off below 8 and above 25 degrees
    between the two rays: enough
    baseline to measure, little enough to look alike (in the manner of MVSNet's and COLMAP's view selection).
    """
    ids = sorted(i for i, image in model.images.items() if image.has_pose)
    xyz = {p: point.xyz for p, point in model.points3D.items()}
    seen = {
        i: np.array(sorted({o.point3D_id for o in model.images[i].get_observation_points2D()}), dtype=np.int64)
        for i in ids
    }
    centres = {i: model.images[i].projection_center() for i in ids}
    tasks = {}
    for i in ids:
        if len(seen[i]) < 8:
            continue
        worth = []
        for j in ids:
            shared = np.intersect1d(seen[i], seen[j], assume_unique=True) if j != i else np.empty(0)
            if len(shared) < 8:
                continue
            points = np.array([xyz[p] for p in shared])
            angles = _angles_deg(points, centres[i], centres[j])
            if np.median(angles) >= settings.min_angle_deg:
                worth.append((-float(_angle_weight(angles).sum()), j))
        chosen = [model.images[j].name for _, j in sorted(worth)[: settings.sources]]
        if not chosen:
            continue
        points = np.array([xyz[p] for p in seen[i]])
        pose = model.images[i].cam_from_world().matrix()
        z = points @ pose[2, :3] + pose[2, 3]
        z = np.sort(z[z > 0])
        # Sparse points miss tops and distant ground, and a tall thing may hold few of them: the third nearest counts.
        near, far = min(0.75 * np.percentile(z, 1), 0.85 * z[min(2, len(z) - 1)]), 1.25 * np.percentile(z, 99)
        name = model.images[i].name
        tasks[name] = _Task(name, chosen, float(near), float(far))
    return tasks


def _angles_deg(points: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles (N,) between the rays from (N, 3) points to two camera centres."""
    u, v = points - a, points - b
    cosine = (u * v).sum(1) / (np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1))
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _angle_weight(angles_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Worth of a point seen at these angles, (N,) in 0..1."""
    width = np.where(angles_deg < 8, 4.0, np.where(angles_deg > 25, 10.0, 1.0))
    return np.exp(-0.5 * ((angles_deg - np.clip(angles_deg, 8, 25)) / width) ** 2)


def _run_torch(
    workspace: Path,
    model: pycolmap.Reconstruction,
    tasks: list[_Task],
    settings: DepthSettings,
    device: str,
    folder: Path,
) -> None:
    """Depth and normal maps of the tasks by our plane sweep, into folder/depth_maps and folder/normal_maps."""
    photos: dict[str, Photo] = {}
    by_name = {image.name: image for image in model.images.values()}
    for k, task in enumerate(tasks):
        for name in [task.name, *task.sources]:
            if name not in photos:
                photos[name] = _read_photo(workspace, model, by_name[name], settings.max_image_size_px)
        estimate = estimate_depth(
            photos[task.name], [photos[n] for n in task.sources], task.near, task.far, settings, device
        )
        write_depth(folder / "depth_maps" / f"{task.name}.bin", estimate.depth)
        write_normals(folder / "normal_maps" / f"{task.name}.bin", estimate.normals)
        print(
            f"{k + 1}/{len(tasks)} {task.name}: {len(task.sources)} sources, "
            f"{(estimate.depth > 0).mean():.0%} of the pixels have a depth",
            flush=True,
        )


def _read_photo(workspace: Path, model: pycolmap.Reconstruction, image: Any, size_px: int) -> Photo:
    """A photo in grey with its camera, its longer side at most size_px."""
    gray = cv2.imread(str(workspace / "images" / image.name), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if gray is None:
        raise StageError(f"{workspace}/images/{image.name} cannot be read; rerun the undistortion stage")
    photo = Photo(
        np.asarray(gray, dtype=np.float32) / np.float32(255),
        model.cameras[image.camera_id].calibration_matrix(),
        image.cam_from_world().matrix(),
    )
    scale = min(1.0, size_px / max(gray.shape))
    return photo.resized((round(gray.shape[1] * scale), round(gray.shape[0] * scale)))


def _run_colmap(
    workspace: Path, model: pycolmap.Reconstruction, tasks: list[_Task], settings: DepthSettings, folder: Path
) -> None:
    """Depth and normal maps of the tasks by COLMAP's patch-match, into folder/depth_maps and folder/normal_maps."""
    options = pycolmap.PatchMatchOptions()
    options.max_image_size = settings.max_image_size_px
    options.window_radius = settings.window_px // 2
    options.geom_consistency = settings.geometric
    options.min_triangulation_angle = settings.min_angle_deg
    options.num_threads = threads()
    kind = "geometric" if settings.geometric else "photometric"

    def width_px(camera: pycolmap.Camera) -> int:
        return round(camera.width * min(1.0, settings.max_image_size_px / max(camera.width, camera.height)))

    with _workspace_of_links(workspace, model, width_px) as temporary:
        stereo = temporary / "stereo"
        for name in ("depth_maps", "normal_maps", "consistency_graphs"):
            (stereo / name).mkdir(parents=True)
        # A geometric pass reads the sources' photometric maps, so these need one too: every photo is a reference there.
        references = {t.name for t in tasks} | ({s for t in tasks for s in t.sources} if settings.geometric else set())
        config = "".join(f"{name}\n__auto__, {settings.sources}\n" for name in sorted(references))
        (stereo / "patch-match.cfg").write_text(config)
        options.allow_missing_files = True
        cancellable(pycolmap.patch_match_stereo, temporary, "COLMAP", "option-all", options)
        for task in tasks:
            for name in ("depth_maps", "normal_maps"):
                os.replace(stereo / name / f"{task.name}.{kind}.bin", folder / name / f"{task.name}.bin")


@contextmanager
def _workspace_of_links(
    workspace: Path, model: pycolmap.Reconstruction, width_px: Callable[[pycolmap.Camera], int]
) -> Iterator[Path]:
    """A temporary COLMAP workspace: links to the photos, and cameras in the convention of COLMAP's dense part.

    That part takes the first pixel's centre as 0, the sparse part as 0.5, so principal points move by half
    a pixel of the map, which
    is `width_px` wide. With exact depth maps this takes the fused cloud from a quarter of a pixel's error to none.
    """
    with tempfile.TemporaryDirectory(prefix="scenefuse-") as name:
        folder = Path(name)
        (folder / "sparse").mkdir()
        shifted = copy.deepcopy(model)
        for camera in shifted.cameras.values():
            half = 0.5 * camera.width / width_px(camera)
            fx, fy, cx, cy = camera.params
            camera.params = [fx, fy, cx - half, cy - half]
        shifted.write_binary(folder / "sparse")
        (folder / "images").symlink_to((workspace / "images").resolve())
        yield folder


def _stereo_fusion(folder: Path, settings: FusionSettings) -> Cloud:
    """COLMAP's fusion of a temporary workspace, as a cloud."""
    options = pycolmap.StereoFusionOptions()
    options.num_threads = 1  # With more, which thread comes first decides the points.
    options.min_num_pixels = settings.min_photos
    options.max_reproj_error = settings.max_reprojection_px
    options.max_depth_error = settings.max_depth_error
    options.max_normal_error = settings.max_normal_error_deg
    options.max_traversal_depth = settings.max_traversal_depth
    path = folder / "fused.ply"
    fused = cancellable(pycolmap.stereo_fusion, path, folder, "COLMAP", "option-all", "geometric", options, "PLY")
    if not path.is_file() or (fused is not None and fused.num_points3D() == 0 and path.stat().st_size < 1000):
        raise _no_points(settings)
    cloud = read_cloud(path)
    return Cloud(cloud.points, cloud.normals, cloud.colors, {"views": _read_visibility(path.with_suffix(".ply.vis"))})


def _no_points(settings: FusionSettings) -> StageError:
    """The error for maps that do not agree anywhere."""
    return StageError(
        f"no point is seen alike by {settings.min_photos} photos; lower min_photos or min_score, or check the cameras"
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


def _near_others(points: NDArray[np.float64], settings: FusionSettings) -> NDArray[np.bool_]:
    """(N,) True where a point's neighbours are about as near as they are for the others."""
    if settings.outlier_ratio <= 0 or len(points) <= settings.outlier_neighbours:
        return np.ones(len(points), dtype=bool)
    k = settings.outlier_neighbours + 1
    distance = cKDTree(points).query(points, k=k, workers=threads())[0][:, 1:].mean(1)
    return distance <= settings.outlier_ratio * np.median(distance)
