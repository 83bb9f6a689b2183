"""The losses of the depth-guided NeRF, each a plain function of per-ray values.

`inside` rays were drawn from the object's pixels, the others beside it.
"""

from dataclasses import asdict, dataclass

import torch
from torch import Tensor
from torch.nn.functional import huber_loss

# Colours in 0..1 that differ by more than this count linearly: reflections and shadows are no noise.
COLOR_DELTA = 0.1
# Below this opacity a ray has no depth to speak of.
SOLID_OPACITY = 0.5
# Absolute depth is quadratic within this distance of the prior, in nerf units (the cube's side is 1).
DEPTH_DELTA = 0.01


@dataclass(frozen=True)
class LossWeights:
    """Weight of each loss; 0 switches one off. The paper names the losses and gives no weights (method N2)."""

    color_weight: float = 1.0
    """Photometric loss inside the mask."""
    depth_weight: float = 2.0
    """Absolute depth against the prior."""
    mask_weight: float = 0.1
    """Opacity against the mask."""
    sparsity_weight: float = 0.05
    """Density on rays that miss the object."""

    def by_name(self) -> dict[str, float]:
        """The weights by the names of their losses."""
        return {name.removesuffix("_weight"): weight for name, weight in asdict(self).items()}


def color_loss(predicted: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Huber loss of (R, 3) colours in 0..1, mean over the rays by weight (R,): 0 outside the mask."""
    error = huber_loss(predicted, target, reduction="none", delta=COLOR_DELTA).mean(1)
    return (error * weight).sum() / weight.sum().clamp(min=1)


def depth_loss(distance: Tensor, opacity: Tensor, prior: Tensor, weight: Tensor) -> Tensor:
    """Huber loss of the expected distance (R,) where the ray is solid and a prior exists (weight > 0) (method N4).

    In units of DEPTH_DELTA; mean over all rays with a prior.
    """
    valid = (weight > 0) & (opacity.detach() > SOLID_OPACITY)
    error = huber_loss(distance[valid], prior[valid], reduction="none", delta=DEPTH_DELTA) / DEPTH_DELTA
    return (error * weight[valid]).sum() / (weight > 0).sum().clamp(min=1)


def mask_loss(opacity: Tensor, matte: Tensor) -> Tensor:
    """Binary cross-entropy of opacity (R,) against the matte (R,) in 0..1 (method N5)."""
    clipped = opacity.clamp(1e-4, 1 - 1e-4)
    return torch.nn.functional.binary_cross_entropy(clipped, matte)


def sparsity_loss(sigma: Tensor, delta: Tensor, inside: Tensor) -> Tensor:
    """Mean opacity of the single samples (R, S) on rays that miss the object (method N5)."""
    empty = ~inside
    opacity = 1 - torch.exp(-sigma[empty] * delta[empty])
    return opacity.mean() if len(opacity) else sigma.sum() * 0
