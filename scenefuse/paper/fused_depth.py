"""Two sets of depth maps fused by inverse variance where views agree (after AltNeRF; method N12)."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from scenefuse.core.stage import quantity
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.monodepth import inside, points_in_cam, project, sample
from scenefuse.nerf.prior.train_depth import residual_at_checks

Content = dict[str, Any]

# Difference between views at which agreement falls to 60 %, share of the object's diagonal.
TOLERANCE = 0.01
# Beyond so many tolerances, or standard deviations of two maps' difference, depths are of different surfaces.
MAX_DEVIATIONS = 3.0
# Where two maps differ, one is kept if its variance is smaller by this factor.
VARIANCE_RATIO = 4.0
# Standard deviation that no map is better than, in tolerances of consistency.
MIN_DEVIATION = 0.3


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
def consistency_between_views(depth: Tensor, photos: DepthPhotos) -> ViewConsistency:
    """Forward-backward consistency of each depth map with those of its source views.

    A source view agrees by exp(-(e / tolerance)^2 / 2), where e is the depth that came back minus the depth. A view
    that sees something nearer does not count, because the point is occluded there; one that sees past the point counts
    with 0. The confidence is the mean over the views that count, at least two.

    Args:
        depth: (V, 1, H, W), 0 where there is none.
        photos: the photos; their sources are the views compared with.
    """
    depth, tolerance = depth * photos.masks, TOLERANCE * photos.diagonal
    confidence, variance = torch.zeros_like(depth), torch.full_like(depth, torch.inf)
    for view in range(len(depth)):
        sources = photos.sources[view]
        moves = photos.source_from_target(torch.full_like(sources, view), sources)
        difference, seen = reprojection_differences(
            depth[view : view + 1],
            depth[sources],
            moves,
            photos.intrinsics[view : view + 1],
            photos.intrinsics[sources],
        )
        counted = seen & (difference > -MAX_DEVIATIONS * tolerance)
        votes = torch.exp(-0.5 * (difference / tolerance) ** 2) * counted
        confidence[view, 0] = votes.sum(0) / counted.sum(0).clamp_min(2)
        close = counted & (difference.abs() < MAX_DEVIATIONS * tolerance)
        number = close.sum(0)
        mean_square = (difference**2 * close).sum(0) / number.clamp_min(1)
        variance[view, 0] = torch.where(number > 0, mean_square, torch.full_like(mean_square, torch.inf))
    return ViewConsistency(confidence * (depth > 0), variance)


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
    """Blend two sets of (V, 1, H, W) depth maps, each weighted by its consistency between views."""
    floor = MIN_DEVIATION * TOLERANCE * photos.diagonal
    own, other = (consistency_between_views(depth, photos).variance for depth in (predicted, rendered))
    depth, variance, blended = fuse_by_inverse_variance(predicted, rendered, own, other, floor)
    depth = depth * photos.masks
    weight = torch.where(depth > 0, floor**2 / variance, torch.zeros_like(depth)).clamp(0.0, 1.0)
    area, on_object = photos.masks.sum().clamp_min(1), photos.masks > 0
    shares = {
        "accepted_share": float((depth > 0).sum() / area),
        "blended_share": float((blended & on_object).sum() / area),
        "rendered_share": float((rendered > 0).sum() / area),
    }
    return Blend(depth, weight, shares)


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
    blended = both & ((first - second) ** 2 < MAX_DEVIATIONS**2 * (a + b))
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


def print_quality(content: Content) -> None:
    """One line for the log."""
    residual, share = content["residual_after_alignment"]["value"], content["consistent_share"]["value"]
    known = "no SfM points to check" if residual is None else f"median residual at SfM points {100 * residual:.2f} %"
    print(f"depth maps written: {known}, {100 * share:.0f} % of the object confirmed by other views", flush=True)
