"""Depth maps of an undistorted COLMAP workspace, in chunks."""

import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch

from scenefuse.core.machine import use_threads
from scenefuse.core.stage import (
    StageError,
    atomic_directory,
    quantity,
    scratch_directory,
    threads,
    write_json,
)
from scenefuse.geometry.depth_test import MAX_PHOTOS
from scenefuse.mvs.plane_sweep import DepthMapSettings, estimate_depth
from scenefuse.mvs.sparse_depths import Reference, select_views
from scenefuse.photos.pictures import read_depth, write_depth, write_normals
from scenefuse.photos.workspace import View, Workspace, posed_images, read_model, read_workspace
from scenefuse.sfm.colmap import cancellable

MAPS = ("depth_maps", "normal_maps")


def estimate_depth_maps(
    *, workspace: Path, chunk: int, chunks: int, settings: DepthMapSettings, seed: int, depth: Path, report: Path
) -> None:
    """Write depth and normal maps for one chunk of the photos of an undistorted workspace.

    COLMAP's patch-match runs where CUDA is present (the paper's method; method M3: the sources are
    `__auto__`); otherwise a plane sweep in PyTorch, on CUDA or the CPU, takes its place. Which one ran, and why, is in
    the report.

    Args:
        workspace: COLMAP workspace with images/ and sparse/ (PINHOLE cameras, sparse points with tracks).
        chunk: which share of the photos, 0 .. chunks - 1: every chunks-th photo in name order.
        chunks: number of shares.
        settings: see DepthMapSettings.
        seed: seed of everything random (COLMAP's patch-match keeps its own).
        depth: output folder with depth_maps/{photo}.bin (H, W; along z; the model's unit; 0 = none) and
            normal_maps/{photo}.bin (H, W, 3; camera frame), in COLMAP's format.
        report: output JSON: backend and why, device, sources, depth range and coverage per photo, hashes of the maps.

    Raises:
        StageError: no CUDA for `colmap`; no photos or points in the workspace; an unreadable photo; a
            chunk out of range.
    """
    if not 0 <= chunk < chunks:
        raise StageError(f"chunk {chunk} of {chunks} does not exist; chunks count from 0 to {chunks - 1}")
    backend, reason = _choose_backend(settings.backend)
    device = "cuda" if backend == "colmap" or torch.cuda.is_available() else "cpu"
    print(f"depth maps by {backend} on {device}: {reason}", flush=True)
    torch.manual_seed(seed)
    use_threads(threads())
    photos = read_workspace(workspace)
    selected = select_views(photos, settings.sources, settings.min_angle_deg)
    references = [selected[name] for name in sorted(selected)[chunk::chunks]]
    with atomic_directory(depth) as folder:
        for part in MAPS:
            (folder / part).mkdir()
        if references and backend == "colmap":
            run_patch_match(photos, references, settings, folder)
        elif references:
            _run_plane_sweep(photos, references, settings, device, folder)
        names = [reference.view.name for reference in references]
        coverage = [float((read_depth(folder / "depth_maps" / f"{name}.bin") > 0).mean()) for name in names]
    how = {"backend": backend, "reason": reason, "device": device, "chunk": f"{chunk} of {chunks}"}
    write_json(report, _report(how, references, coverage))


def _choose_backend(backend: str) -> tuple[str, str]:
    """The backend that runs, and why."""
    if backend == "torch":
        return "torch", "as set"
    if pycolmap.has_cuda:
        return "colmap", "as set" if backend == "colmap" else "pycolmap has CUDA"
    if backend == "colmap":
        raise StageError(
            "COLMAP's patch-match needs CUDA, and this pycolmap has none; install pycolmap-cuda12, "
            "or set the depth backend to auto or torch"
        )
    return "torch", "fallback: this pycolmap has no CUDA, so its patch-match cannot run"


def _report(how: dict[str, str], references: list[Reference], coverage: list[float]) -> dict[str, Any]:
    """How depths were made, and what came out for each photo."""
    photos = {
        reference.view.name: {
            "sources": [view.name for view in reference.sources],
            "near": round(reference.near, 4),
            "far": round(reference.far, 4),
            "coverage": round(share, 4),
        }
        for reference, share in zip(references, coverage)
    }
    return {key: quantity(text, "") for key, text in how.items()} | {"photos": photos}


def _run_plane_sweep(
    workspace: Workspace, references: list[Reference], settings: DepthMapSettings, device: str, folder: Path
) -> None:
    """Depth and normal maps by our plane sweep, into folder/depth_maps and folder/normal_maps."""
    views = {view.name: view for view in workspace.views}

    @lru_cache(MAX_PHOTOS)
    def gray(name: str) -> View:
        return _gray(workspace, views[name], settings.max_image_size_px)

    for k, reference in enumerate(references):
        first, *others = (gray(view.name) for view in (reference.view, *reference.sources))
        estimate = estimate_depth(first, others, reference.near, reference.far, settings, device)
        write_depth(folder / "depth_maps" / f"{first.name}.bin", estimate.depth)
        write_normals(folder / "normal_maps" / f"{first.name}.bin", estimate.normals)
        print(
            f"{k + 1}/{len(references)} {first.name}: {len(others)} sources, "
            f"{(estimate.depth > 0).mean():.0%} of the pixels have a depth",
            flush=True,
        )


def _gray(workspace: Workspace, view: View, size_px: int) -> View:
    """A view with grey pixels, (H, W) float32 in 0..1, its longer side at most size_px."""
    full = workspace.gray(view)
    return replace(full, pixels=full.pixels.astype(np.float32) / np.float32(255)).at_most(size_px)


def run_patch_match(
    workspace: Workspace, references: list[Reference], settings: DepthMapSettings, folder: Path
) -> None:
    """Depth and normal maps by COLMAP's patch-match (CUDA), into folder/depth_maps and folder/normal_maps."""
    options = pycolmap.PatchMatchOptions()
    options.max_image_size = settings.max_image_size_px
    options.window_radius = settings.window_px // 2
    options.geom_consistency = settings.geometric
    options.min_triangulation_angle = settings.min_angle_deg
    options.num_threads = threads()
    options.allow_missing_files = True
    names = {r.view.name for r in references}
    if settings.geometric:
        # This pass reads the sources' photometric maps, so these need one too: every photo is a reference there.
        names |= {view.name for r in references for view in r.sources}
    widths = {view.name: view.at_most(settings.max_image_size_px).width for view in workspace.views}
    with linked_workspace(workspace.folder, folder / "patch_match", widths) as temporary:
        stereo = temporary / "stereo"
        for part in (*MAPS, "consistency_graphs"):
            for name in names:
                (stereo / part / name).parent.mkdir(parents=True, exist_ok=True)
        config = "".join(f"{name}\n__auto__, {settings.sources}\n" for name in sorted(names))
        (stereo / "patch-match.cfg").write_text(config)
        cancellable(pycolmap.patch_match_stereo, temporary, "COLMAP", "option-all", options)
        kind = "geometric" if settings.geometric else "photometric"
        collect_maps(stereo, [r.view.name for r in references], kind, folder)


def collect_maps(stereo: Path, names: Iterable[str], kind: str, output: Path) -> None:
    """Move the depth and normal maps of photos from a workspace's stereo/ to output/{depth,normal}_maps/{photo}.bin.

    Args:
        stereo: folder that COLMAP wrote its maps to, on the file system of `output`.
        names: of photos, perhaps in subfolders.
        kind: of the maps, "photometric" or "geometric".
        output: folder of the maps.

    Raises:
        StageError: COLMAP made no map of a photo.
    """
    for name in names:
        for part in MAPS:
            source, target = stereo / part / f"{name}.{kind}.bin", output / part / f"{name}.bin"
            if not source.is_file():
                raise StageError(f"COLMAP's patch-match left no {name}.{kind}.bin in {part}; look at the log")
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, target)


@contextmanager
def linked_workspace(workspace: Path, beside: Path, map_widths: Mapping[str, int]) -> Iterator[Path]:
    """A temporary COLMAP workspace, removed afterwards: links to the photos, and shifted cameras.

    COLMAP's dense part takes the first pixel's centre as 0, its sparse part as 0.5, so principal points move by half
    a pixel of the map.

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
