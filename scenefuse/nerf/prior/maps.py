"""Depth maps of a stage: aligned to SfM points, read, written, and what the reports say of them."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scenefuse.core.stage import quantity
from scenefuse.nerf.prior.consistency import TOLERANCE, ViewConsistency, align_to_points, residuals_at_points
from scenefuse.nerf.prior.crops import Crops
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.self_supervision import sample
from scenefuse.photos.maps import read_depth, write_depth

Content = dict[str, Any]


def align_maps(raw: Tensor, photos: DepthPhotos, seed: int) -> Tensor:
    """Each (1, H, W) depth map aligned to the SfM points of its photo, never to those kept for checking."""
    aligned = []
    for index, points in enumerate(photos.points):
        pixels = torch.from_numpy(points[None, :, :2]).to(raw.device)
        predicted = sample(raw[index : index + 1], pixels)[0, 0].cpu().numpy()
        scale, shift = align_to_points(predicted, points[:, 2], seed)
        aligned.append((scale * raw[index] + shift).clamp_min(1e-3 * photos.near))
    return torch.stack(aligned)


def read_maps(folder: Path, crops: Crops, device: torch.device) -> tuple[Tensor, Tensor]:
    """(V, 1, H, W) depths and confidences of a stage folder, cut like the photos; zeros for a photo without a map."""
    names = crops.views.names
    depths, confidences = np.zeros((2, len(names), 1, *crops.views.masks.shape[1:]), np.float32)
    for index, name in enumerate(names):
        if (folder / "depth_maps" / f"{name}.bin").is_file():
            depths[index, 0] = crops.cut(index, read_depth(folder / "depth_maps" / f"{name}.bin"))
            confidences[index, 0] = crops.cut(index, read_depth(folder / "confidence_maps" / f"{name}.bin"))
    return torch.from_numpy(depths).to(device), torch.from_numpy(confidences).to(device)


def write_maps(folder: Path, crops: Crops, depth: Tensor, confidence: Tensor) -> None:
    """depth_maps/ and confidence_maps/ of a stage folder: one COLMAP map of each whole photo."""
    for index, name in enumerate(crops.views.names):
        write_depth(folder / "depth_maps" / f"{name}.bin", crops.paste(index, depth[index, 0].cpu().numpy()))
        write_depth(folder / "confidence_maps" / f"{name}.bin", crops.paste(index, confidence[index, 0].cpu().numpy()))


def residual_at_checks(depth: Tensor, photos: DepthPhotos) -> float | None:
    """Median relative residual at the SfM points that no training saw; None where there are none."""
    residuals = np.concatenate(residuals_at_points(depth, photos.checks))
    return float(np.median(residuals)) if len(residuals) else None


def map_quantities(depth: Tensor, consistency: ViewConsistency, photos: DepthPhotos) -> Content:
    """Residual at SfM points, share of the object's pixels that other views confirm, and the typical disagreement."""
    on_object = photos.masks > 0
    confirmed = consistency.confidence[on_object] > 0.5
    finite = consistency.variance[on_object & torch.isfinite(consistency.variance)]
    disagreement = float(finite.sqrt().median() / photos.diagonal) if len(finite) else None
    return {
        "residual_after_alignment": quantity(residual_at_checks(depth, photos), "1"),
        "consistent_share": quantity(float(confirmed.float().mean()) if len(confirmed) else 0.0, "1"),
        "disagreement_over_diagonal": quantity(disagreement, "1"),
    }


def tolerance_of(photos: DepthPhotos) -> float:
    """Difference of depth between views that still agrees, object units."""
    return TOLERANCE * photos.diagonal


def print_quality(content: Content) -> None:
    """One line for the log."""
    residual, share = content["residual_after_alignment"]["value"], content["consistent_share"]["value"]
    known = "no SfM points to check" if residual is None else f"median residual at SfM points {100 * residual:.2f} %"
    print(f"depth maps written: {known}, {100 * share:.0f} % of the object confirmed by other views", flush=True)
