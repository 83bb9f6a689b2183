"""Depth maps of an undistorted COLMAP workspace, in chunks."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError, atomic_directory, quantity, threads, write_json
from scenefuse.geometry.photo_check import MAX_PHOTOS
from scenefuse.mvs.plane_sweep import DepthMapSettings, estimate_depth
from scenefuse.mvs.sparse_depths import Reference, select_views
from scenefuse.photos.pictures import read_depth, write_depth, write_normals
from scenefuse.photos.workspace import View, Workspace, read_workspace


def estimate_depth_maps(
    *, workspace: Path, chunk: int, chunks: int, settings: DepthMapSettings, seed: int, depth: Path, report: Path
) -> None:
    """Write depth and normal maps for one chunk of the photos of an undistorted workspace: by a plane sweep in PyTorch,
    on CUDA where it is, else on the CPU.

    Args:
        workspace: COLMAP workspace with images/ and sparse/ (PINHOLE cameras, sparse points with tracks).
        chunk: which share of the photos, 0 .. chunks - 1: every chunks-th photo in name order.
        chunks: number of shares.
        settings: see DepthMapSettings.
        seed: seed of everything random.
        depth: output folder with depth_maps/{photo}.bin (H, W; along z; the model's unit; 0 = none) and
            normal_maps/{photo}.bin (H, W, 3; camera frame), in COLMAP's format.
        report: output JSON: device, sources, depth range and coverage per photo.

    Raises:
        StageError: no photos or points in the workspace; an unreadable photo; a chunk out of range.
    """
    if not 0 <= chunk < chunks:
        raise StageError(f"chunk {chunk} of {chunks} does not exist; chunks count from 0 to {chunks - 1}")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    print(f"depth maps on {device}", flush=True)
    torch.manual_seed(seed)
    use_threads(threads())
    photos = read_workspace(workspace)
    selected = select_views(photos, settings.sources, settings.min_angle_deg)
    references = [selected[name] for name in sorted(selected)[chunk::chunks]]
    with atomic_directory(depth) as folder:
        for part in ("depth_maps", "normal_maps"):
            (folder / part).mkdir()
        _sweep_photos(photos, references, settings, device, folder)
        names = [reference.view.name for reference in references]
        coverage = [float((read_depth(folder / "depth_maps" / f"{name}.bin") > 0).mean()) for name in names]
    how = {"device": device, "chunk": f"{chunk} of {chunks}"}
    write_json(report, _report(how, references, coverage))


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


def _sweep_photos(
    workspace: Workspace, references: list[Reference], settings: DepthMapSettings, device: str, folder: Path
) -> None:
    """Depth and normal maps by the plane sweep, into folder/depth_maps and folder/normal_maps."""
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
