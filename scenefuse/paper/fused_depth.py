"""Two sets of depth maps fused by inverse variance where views agree (after AltNeRF; method N12)."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from scenefuse.core.stage import quantity
from scenefuse.nerf.monodepth import inside, points_in_cam, project, sample
from scenefuse.nerf.prior_inputs import DepthPhotos
from scenefuse.nerf.refine_depth import MAP_AGREEMENT
from scenefuse.nerf.train_depth import residual_at_checks

Content = dict[str, Any]

# Depths that differ by more standard deviations are of different surfaces.
MAX_DEVIATIONS = 3.0


@torch.no_grad()
def variance_between_views(depth: Tensor, photos: DepthPhotos) -> Tensor:
    """(V, 1, H, W) mean squared difference from the depths of source views, object units squared.

    Infinite where no source view agrees within MAX_DEVIATIONS times the difference that other depth maps may have, and
    off the object. The square of this difference is added: no depth is better known.

    Args:
        depth: (V, 1, H, W), 0 where there is none.
        photos: the photos; their sources are the views compared with.
    """
    depth, tolerance = depth * photos.masks, MAP_AGREEMENT * photos.diagonal
    variance = torch.full_like(depth, torch.inf)
    for view, sources in enumerate(photos.sources):
        moves = photos.source_from_target(torch.full_like(sources, view), sources)
        cameras = photos.intrinsics[view : view + 1], photos.intrinsics[sources]
        difference, seen = reprojection_differences(depth[view : view + 1], depth[sources], moves, *cameras)
        close = seen & (difference.abs() < MAX_DEVIATIONS * tolerance)
        mean_square = (difference**2 * close).sum(0) / close.sum(0)
        variance[view, 0] = torch.where(close.any(0), mean_square + tolerance**2, torch.inf)
    return variance


@dataclass(frozen=True)
class Blend:
    """Stage 1's and rendered depth blended.

    Attributes:
        depth: (V, 1, H, W), 0 where neither was accepted.
        weight: (V, 1, H, W) weight of each pixel as a target, 0..1.
        shares: of the object's pixels that were rendered, accepted, blended.
    """

    depth: Tensor
    weight: Tensor
    shares: dict[str, float]


def blend_depths(predicted: Tensor, rendered: Tensor, photos: DepthPhotos) -> Blend:
    """Blend two sets of (V, 1, H, W) depth maps, each weighted by its agreement between views."""
    variances = [variance_between_views(depth, photos) for depth in (predicted, rendered)]
    depth, variance = fuse_by_inverse_variance(predicted, rendered, *variances)
    weight = ((MAP_AGREEMENT * photos.diagonal) ** 2 / variance).clamp(0.0, 1.0)
    both = (depth > 0) & torch.isfinite(variances[0]) & torch.isfinite(variances[1])
    counted = {"accepted_share": depth > 0, "blended_share": both, "rendered_share": rendered > 0}
    area = photos.masks.sum().clamp_min(1)
    return Blend(depth, weight, {name: float(where.sum() / area) for name, where in counted.items()})


def fuse_by_inverse_variance(first: Tensor, second: Tensor, *variances: Tensor) -> tuple[Tensor, Tensor]:
    """Blend two depth maps of the same view by inverse variance (after AltNeRF; method N12).

    A map without a variance has no weight. Where both have one and differ by more than three standard deviations of
    their difference, neither is accepted.

    Args:
        first: (V, 1, H, W) depth, 0 where there is none.
        second: the other.
        variances: of either, squared units, infinite where no other view agrees.

    Returns:
        (V, 1, H, W) fused depth, 0 where rejected, and its variance, infinite where rejected.
    """
    a, b = variances
    rejected = (first - second) ** 2 >= MAX_DEVIATIONS**2 * (a + b)
    weight = torch.where(rejected, 0.0, 1 / a + 1 / b)
    mean = (first / a + second / b) / weight
    return torch.where(weight > 0, mean, 0.0), 1 / weight


def reprojection_differences(
    depth: Tensor, others: Tensor, other_from_view: Tensor, of_view: Tensor, of_others: Tensor
) -> tuple[Tensor, Tensor]:
    """Forward-backward check of one view's depth map against those of other views.

    Each pixel goes into another view with its depth, takes the depth found there, and comes back.

    Args:
        depth: (1, 1, H, W) depth, 0 where there is none.
        others: (S, 1, H, W) depths of the other views, 0 where there is none.
        other_from_view: (S, 4, 4) rigid transforms.
        of_view: (1, 3, 3) intrinsics.
        of_others: (S, 3, 3) intrinsics.

    Returns:
        (S, H, W) depth that came back minus depth; (S, H, W) bool, True where both views have a depth.
    """
    count, (height, width) = len(others), depth.shape[2:]
    points = points_in_cam(depth, of_view).expand(count, -1, -1)
    pixels, z = project(points, other_from_view, of_others)
    have = (others > 0).to(depth.dtype)
    found = sample(torch.cat([others, have], 1), pixels)
    seen = inside(pixels, z, height, width) & (found[:, 1] > 0.999) & (depth > 0).view(1, -1)
    rays = torch.linalg.inv(of_others) @ torch.cat([pixels, torch.ones_like(pixels[..., :1])], 2).transpose(1, 2)
    _, returned = project(rays * found[:, :1], torch.linalg.inv(other_from_view), of_view.expand(count, -1, -1))
    return (returned - depth.view(1, -1)).view(count, height, width), seen.view(count, height, width)


def map_quantities(depth: Tensor, photos: DepthPhotos) -> Content:
    """Residual at SfM points, and the share of the object's pixels with which another view agrees."""
    agrees = torch.isfinite(variance_between_views(depth, photos))
    return {
        "residual_after_alignment": quantity(residual_at_checks(depth, photos), "1"),
        "consistent_share": quantity(float(agrees.sum() / photos.masks.sum().clamp_min(1)), "1"),
    }
