"""Depth maps laid on the SfM points of their photos by a robust scale and shift (method N1)."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scenefuse.core.transforms import Array
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.self_supervision import sample

# RANSAC of the alignment: draws, the smallest distance of two points as a share of their range, and the largest factor
# between a draw's scale and the median ratio.
DRAWS, MIN_DISTANCE_SHARE, MAX_SCALE_FACTOR = 200, 0.1, 5.0
MIN_POINTS = 5


def align_maps(raw: Tensor, photos: DepthPhotos, seed: int) -> Tensor:
    """Each (1, H, W) depth map aligned to the SfM points of its photo, never to those kept for checking."""
    aligned = []
    for index, points in enumerate(photos.points):
        pixels = torch.from_numpy(points[None, :, :2]).to(raw.device)
        predicted = sample(raw[index : index + 1], pixels)[0, 0].double().cpu().numpy()
        scale, shift = align_to_points(predicted, points[:, 2].astype(np.float64), seed)
        aligned.append((scale * raw[index] + shift).clamp_min(1e-3 * photos.near))
    return torch.stack(aligned)


def align_to_points(predicted: Array, measured: Array, seed: int = 0) -> tuple[float, float]:
    """Robust (scale, shift) with measured = scale * predicted + shift; 30 % and more outliers do no harm.

    RANSAC over pairs scored by the median residual, then Tukey-weighted least squares. The shift is used, and the
    scale differs from one, only where each lowers the median residual by more than its sampling error, 1 / sqrt(N):
    with few points the depth map itself is the better evidence (method N1).

    Args:
        predicted: (N,) depths of the map at SfM points.
        measured: (N,) depths of those points.
        seed: of the RANSAC pairs.
    """
    predicted, measured = np.asarray(predicted, float), np.asarray(measured, float)
    if len(predicted) < MIN_POINTS:
        return 1.0, 0.0
    rng = np.random.default_rng(seed)

    def cost(scale: float, shift: float, free: int) -> float:
        residual = np.median(np.abs(scale * predicted + shift - measured))
        return float(residual) * (1.0 + free / np.sqrt(len(predicted)))

    scale = float(np.median(measured / predicted))
    best = (scale, 0.0)
    for _ in range(DRAWS):
        i, j = rng.choice(len(predicted), 2, replace=False)
        if abs(predicted[i] - predicted[j]) < MIN_DISTANCE_SHARE * np.ptp(predicted):
            continue
        slope = (measured[i] - measured[j]) / (predicted[i] - predicted[j])
        candidate = (slope, measured[i] - slope * predicted[i])
        if scale / MAX_SCALE_FACTOR < slope < MAX_SCALE_FACTOR * scale and cost(*candidate, 0) < cost(*best, 0):
            best = candidate
    best = _tukey_line(predicted, measured, *best)
    options = [(cost(1.0, 0.0, 0), (1.0, 0.0)), (cost(scale, 0.0, 1), (scale, 0.0)), (cost(*best, 2), best)]
    return min(options)[1]


def residuals_at_points(depth: Tensor, points: list[NDArray[np.float32]]) -> list[Array]:
    """|depth - SfM depth| / SfM depth at each photo's points: V arrays."""
    result = []
    for index, p in enumerate(points):
        found = sample(depth[index : index + 1], torch.from_numpy(p[None, :, :2]).to(depth.device))[0, 0].cpu().numpy()
        result.append(np.abs(found / p[:, 2] - 1.0))
    return result


def residual_at_checks(depth: Tensor, photos: DepthPhotos) -> float | None:
    """Median relative residual at the SfM points that no training saw; None where there are none."""
    residuals = np.concatenate(residuals_at_points(depth, photos.checks))
    return float(np.median(residuals)) if len(residuals) else None


def _tukey_line(x: Array, y: Array, scale: float, shift: float) -> tuple[float, float]:
    for _ in range(10):
        residual = y - scale * x - shift
        spread = 4.685 * max(1.4826 * float(np.median(np.abs(residual))), 1e-9 * float(np.median(np.abs(y))))
        w = np.clip(1.0 - (residual / spread) ** 2, 0.0, None) ** 2
        mean_x, mean_y = w @ x / w.sum(), w @ y / w.sum()
        variance = w @ (x - mean_x) ** 2
        if variance <= 1e-12 * max(mean_x**2, 1e-30):
            break
        scale = float(w @ ((x - mean_x) * (y - mean_y)) / variance)
        shift = float(mean_y - scale * mean_x)
    return scale, shift
