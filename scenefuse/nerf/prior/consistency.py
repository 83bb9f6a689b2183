"""Quality of depth maps without truth: consistency between views and with SfM points; fusing two sets of maps."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.self_supervision import reprojection_differences, sample

Array = NDArray[np.floating]

# Difference between views at which agreement falls to 60 %, share of the object's diagonal.
TOLERANCE = 0.01
# Beyond so many tolerances, or standard deviations of two maps' difference, depths are of different surfaces.
FAR_OFF = 3.0
# Where two maps differ, one is kept if its variance is smaller by this factor.
VARIANCE_RATIO = 4.0
# RANSAC of the alignment: draws, the least distance of two points as a share of their range, and the largest factor
# between a draw's scale and the median ratio.
DRAWS, LEAST_DISTANCE, LARGEST_FACTOR = 200, 0.1, 5.0
MIN_POINTS = 5


@dataclass(frozen=True)
class ViewConsistency:
    """How well a set of depth maps agrees with itself across views.

    Attributes:
        confidence: (V, 1, H, W) 0..1, 0 off the object.
        variance: (V, 1, H, W) mean squared disagreement in depth, object units squared; infinite where no view agrees.
    """

    confidence: Tensor
    variance: Tensor


@torch.no_grad()
def consistency_between_views(depth: Tensor, photos: DepthPhotos, tolerance: float) -> ViewConsistency:
    """Forward-backward consistency of each depth map with those of its source views.

    A source view agrees by exp(-(e / tolerance)^2 / 2), where e is the depth that came back minus the depth. A view
    that sees something nearer does not count, because the point is occluded there; one that sees past the point counts
    with 0. The confidence is the mean over the views that count, at least two.

    Args:
        depth: (V, 1, H, W), 0 where there is none.
        photos: the photos; their sources are the views compared with.
        tolerance: object units; see TOLERANCE.
    """
    depth = depth * photos.masks
    confidence, variance = torch.zeros_like(depth), torch.full_like(depth, torch.inf)
    for view in range(len(depth)):
        sources = photos.sources[view]
        moves = photos.source_from_target(torch.full_like(sources, view), sources)
        difference, _, seen = reprojection_differences(
            depth[view : view + 1],
            depth[sources],
            moves,
            photos.intrinsics[view : view + 1],
            photos.intrinsics[sources],
        )
        counted = seen & (difference > -FAR_OFF * tolerance)
        votes = torch.exp(-0.5 * (difference / tolerance) ** 2) * counted
        confidence[view, 0] = votes.sum(0) / counted.sum(0).clamp_min(2)
        close = counted & (difference.abs() < FAR_OFF * tolerance)
        number = close.sum(0)
        mean_square = (difference**2 * close).sum(0) / number.clamp_min(1)
        variance[view, 0] = torch.where(number > 0, mean_square, torch.full_like(mean_square, torch.inf))
    return ViewConsistency(confidence * (depth > 0), variance)


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
        if abs(predicted[i] - predicted[j]) < LEAST_DISTANCE * np.ptp(predicted):
            continue
        slope = (measured[i] - measured[j]) / (predicted[i] - predicted[j])
        candidate = (slope, measured[i] - slope * predicted[i])
        if scale / LARGEST_FACTOR < slope < LARGEST_FACTOR * scale and cost(*candidate, 0) < cost(*best, 0):
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


def fuse_by_inverse_variance(
    first: Tensor, second: Tensor, first_variance: Tensor, second_variance: Tensor, floor: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend two depth maps of the same view by inverse variance (after AltNeRF; method N12).

    Where both have a finite variance and differ by less than three standard deviations of their difference, the
    result is their mean weighted by 1 / variance. Where they differ by more, or only one has a variance, the pixel
    keeps the map with the smaller variance if that is at least four times smaller; otherwise it keeps none.

    Args:
        first: (V, 1, H, W) depth, 0 where there is none.
        second: the other.
        first_variance: (V, 1, H, W) squared units, infinite where no other view agrees.
        second_variance: the other's.
        floor: standard deviation that no map is better than, object units.

    Returns:
        (V, 1, H, W) fused depth, 0 where rejected; its variance, infinite where rejected; bool, True where blended.
    """
    a = torch.where(first > 0, first_variance + floor**2, torch.inf)
    b = torch.where(second > 0, second_variance + floor**2, torch.inf)
    both = torch.isfinite(a) & torch.isfinite(b)
    blended = both & ((first - second) ** 2 < FAR_OFF**2 * (a + b))
    weight_a, weight_b = 1.0 / a, 1.0 / b
    total = (weight_a + weight_b).clamp_min(1e-30)
    mean = (first * weight_a + second * weight_b) / total
    only_a, only_b = (
        ~blended & (VARIANCE_RATIO * a <= b) & torch.isfinite(a),
        ~blended & (VARIANCE_RATIO * b <= a) & torch.isfinite(b),
    )
    nothing = torch.zeros_like(first)
    depth = torch.where(blended, mean, torch.where(only_a, first, torch.where(only_b, second, nothing)))
    infinite = torch.full_like(first, torch.inf)
    variance = torch.where(blended, 1.0 / total, torch.where(only_a, a, torch.where(only_b, b, infinite)))
    return depth, variance, blended


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
