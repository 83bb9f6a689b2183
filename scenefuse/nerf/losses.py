"""The losses of the depth-guided NeRF, each a plain function of per-ray values.

`inside` rays were drawn from the object's pixels, the others beside it.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import huber_loss

# Colours in 0..1 that differ by more than this count linearly: reflections and shadows are no noise.
COLOR_DELTA = 0.1
# Below this opacity a ray has no depth to speak of.
SOLID = 0.5
# Absolute depth is quadratic within this distance of the prior, in nerf units (the cube's side is 1).
DEPTH_DELTA = 0.01
# Pairs of the ranking loss lie apart by so much of the photo's width (method N3), and differ by so much in nerf units.
RANK_APART, RANK_MARGIN = 0.02, 0.02


@dataclass(frozen=True)
class LossWeights:
    """Weight of each loss; 0 switches one off. The paper names the losses and gives no weights (method N2)."""

    color_weight: float = 1.0
    """Photometric loss inside the mask."""
    depth_weight: float = 2.0
    """Absolute depth against the prior."""
    rank_weight: float = 0.02
    """Relative depth: order of pairs of pixels as the prior has it."""
    mask_weight: float = 0.1
    """Opacity against the mask."""
    sparsity_weight: float = 0.05
    """Density on rays that miss the object."""
    distortion_weight: float = 0.01
    """Spread of the weights along a ray."""

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """Weighted sum of loss terms by their name."""
        return torch.stack([getattr(self, f"{name}_weight") * term for name, term in terms.items()]).sum()


def color_loss(predicted: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Huber loss of (R, 3) colours in 0..1, mean over the rays by weight (R,): 0 outside the mask."""
    error = huber_loss(predicted, target, reduction="none", delta=COLOR_DELTA).mean(1)
    return (error * weight).sum() / weight.sum().clamp(min=1)


def depth_loss(distance: Tensor, opacity: Tensor, prior: Tensor, weight: Tensor) -> Tensor:
    """Huber loss of the expected distance (R,) where the ray is solid and a prior exists (weight > 0) (method N4).

    In units of DEPTH_DELTA; mean over all rays with a prior.
    """
    valid = (weight > 0) & (opacity.detach() > SOLID)
    error = huber_loss(distance[valid], prior[valid], reduction="none", delta=DEPTH_DELTA) / DEPTH_DELTA
    return (error * weight[valid]).sum() / (weight > 0).sum().clamp(min=1)


def rank_loss(
    distance: Tensor, opacity: Tensor, prior: Tensor, weight: Tensor, uv: Tensor, images: int, apart_px: float
) -> Tensor:
    """The paper's relative depth: order of two pixels' depths as the prior has it (method N3).

    The ranking hinge of SparseNeRF (Wang et al. 2023), in units of its margin.

    Args:
        distance: (R,) expected depth along the ray, `images` equal groups of rays one after the other.
        opacity: (R,); both pixels of a pair have to be solid.
        prior: (R,) prior depth along the ray.
        weight: (R,) confidence of the prior, 0 where there is none (also outside the mask).
        uv: (R, 2) pixels.
        images: number of groups; pairs never cross them.
        apart_px: least distance between two pixels of a pair.
    """
    groups = [a.view(images, -1) for a in (distance, opacity.detach(), prior, weight)]
    half = groups[0].shape[1] // 2
    (d, d2), (o, o2), (p, p2), (w, w2) = ((a[:, -2 * half : -half], a[:, -half:]) for a in groups)
    grouped = uv.view(images, -1, 2)
    apart = (grouped[:, -2 * half : -half] - grouped[:, -half:]).norm(dim=-1) >= apart_px
    sign = torch.sign(p2 - p)
    valid = apart & (w > 0) & (w2 > 0) & (o > SOLID) & (o2 > SOLID) & ((p2 - p).abs() > RANK_MARGIN)
    hinge = torch.relu(RANK_MARGIN - sign * (d2 - d)) / RANK_MARGIN
    return (hinge * torch.minimum(w, w2) * valid).sum() / valid.sum().clamp(min=1)


def mask_loss(opacity: Tensor, matte: Tensor) -> Tensor:
    """Binary cross-entropy of opacity (R,) against the matte (R,) in 0..1 (method N5)."""
    clipped = opacity.clamp(1e-4, 1 - 1e-4)
    return torch.nn.functional.binary_cross_entropy(clipped, matte)


def sparsity_loss(sigma: Tensor, delta: Tensor, inside: Tensor) -> Tensor:
    """Mean opacity of the single samples (R, S) on rays that miss the object (method N5)."""
    empty = ~inside
    opacity = 1 - torch.exp(-sigma[empty] * delta[empty])
    return opacity.mean() if len(opacity) else sigma.sum() * 0


def distortion_loss(distortion: Tensor) -> Tensor:
    """Mean distortion (R,): equation (15) of Mip-NeRF 360 (Barron et al. 2022), see `render.composite`."""
    return distortion.mean()
