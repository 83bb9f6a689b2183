"""The losses of the depth-guided NeRF, each a plain function of per-ray values.

`inside` rays were drawn from the object's pixels, the others beside it.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from scenefuse.stage import setting


@dataclass(frozen=True)
class LossWeights:
    """Weight of each loss; 0 switches one off."""

    color_weight: float = setting(1, least=0)
    """photometric loss inside the mask"""
    depth_weight: float = setting(2, least=0)
    """absolute depth against the prior (Huber)"""
    rank_weight: float = setting(0.02, least=0)
    """relative depth ranking between pixel pairs of one photo"""
    mask_weight: float = setting(0.1, least=0)
    """opacity against the mask (binary cross-entropy)"""
    sparsity_weight: float = setting(0.05, least=0)
    """density on rays that miss the object"""
    distortion_weight: float = setting(0.01, least=0)
    """spread of the weights along a ray"""


def color_loss(predicted: Tensor, target: Tensor, inside: Tensor) -> Tensor:
    """Huber loss (0.1) of (R, 3) colours in 0..1, mean over the rays inside the mask."""
    error = huber_loss(predicted, target, reduction="none", delta=0.1).mean(1)
    return (error * inside).sum() / inside.sum().clamp(min=1)


def depth_loss(distance: Tensor, opacity: Tensor, prior: Tensor, weight: Tensor, delta: float) -> Tensor:
    """Huber loss of the expected distance (R,) where opacity > 0.5 and a prior exists (weight > 0).

    Divided by `delta`, so that an error of a few `delta` costs about as many units; mean over all rays with a prior.
    """
    valid = (weight > 0) & (opacity.detach() > 0.5)
    error = huber_loss(distance[valid], prior[valid], reduction="none", delta=delta) / delta
    return (error * weight[valid]).sum() / (weight > 0).sum().clamp(min=1)


def rank_loss(distance: Tensor, opacity: Tensor, prior: Tensor, weight: Tensor, uv: Tensor, images: int,
              apart_px: float, margin: float) -> Tensor:  # fmt: skip
    """Relative depth (SparseNeRF, Wang et al. 2023): order of two pixels' depths as the prior has it.

    Args:
        distance: (R,) expected depth along the ray, `images` equal groups of rays one after the other.
        opacity: (R,); pairs need more than 0.5 on both.
        prior: (R,) prior depth along the ray.
        weight: (R,) confidence of the prior, 0 where there is none (also outside the mask).
        uv: (R, 2) pixels.
        images: number of groups; pairs never cross them.
        apart_px: least distance between two pixels of a pair.
        margin: least difference of prior depths that is trusted, and hinge margin.
    """
    groups = [a.view(images, -1) for a in (distance, opacity.detach(), prior, weight)]
    half = groups[0].shape[1] // 2
    (d, d2), (o, o2), (p, p2), (w, w2) = ((a[:, -2 * half : -half], a[:, -half:]) for a in groups)
    grouped = uv.view(images, -1, 2)
    apart = (grouped[:, -2 * half : -half] - grouped[:, -half:]).norm(dim=-1) >= apart_px
    sign = torch.sign(p2 - p)
    valid = apart & (w > 0) & (w2 > 0) & (o > 0.5) & (o2 > 0.5) & ((p2 - p).abs() > margin)
    hinge = torch.relu(margin - sign * (d2 - d)) / margin
    return (hinge * torch.minimum(w, w2) * valid).sum() / valid.sum().clamp(min=1)


def mask_loss(opacity: Tensor, matte: Tensor) -> Tensor:
    """Binary cross-entropy of opacity (R,) against the matte (R,) in 0..1."""
    clipped = opacity.clamp(1e-4, 1 - 1e-4)
    return torch.nn.functional.binary_cross_entropy(clipped, matte)


def sparsity_loss(sigma: Tensor, delta: Tensor, inside: Tensor) -> Tensor:
    """Mean opacity of the single samples (R, S) on rays that miss the object."""
    empty = ~inside
    opacity = 1 - torch.exp(-sigma[empty] * delta[empty])
    return opacity.mean() if len(opacity) else sigma.sum() * 0


def distortion_loss(distortion: Tensor) -> Tensor:
    """Mean distortion (R,) (Mip-NeRF 360)."""
    return distortion.mean()
