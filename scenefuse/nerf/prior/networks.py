"""A small depth network after Monodepth2 (Godard et al., ICCV 2019), and its measure of depth, normalised disparity.

It is trained from scratch on the photos of one object, so it is far smaller than the original's ResNet-18, and it
corrects a first disparity (from SfM points and a plane sweep) instead of inventing one from colour alone, much as
ManyDepth (Watson et al., CVPR 2021) gives its network a cost volume.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional


class DepthNetwork(nn.Module):
    """U-Net that predicts normalised disparity: sigmoid(logit(first) + correction).

    The last layer starts at zero, so that training starts from the first disparity.

    Args:
        channels: input channels beside the first disparity.
        width: channels of the finest level; deeper levels have 1, 2, 3 and 4 times as many.
    """

    def __init__(self, channels: int, width: int = 16) -> None:
        super().__init__()
        sizes = [width, width * 2, width * 3, width * 4]
        self.encoder = nn.ModuleList(
            convolutions(before, after, 2) for before, after in zip([channels + 1, *sizes[:-1]], sizes)
        )
        self.decoder = nn.ModuleList(
            convolutions(deep + skip, skip, 1) for deep, skip in zip(sizes[:0:-1], sizes[-2::-1])
        )
        self.head = nn.Conv2d(width + channels + 1, 16, 3, padding=1, padding_mode="replicate")
        self.last = nn.Conv2d(16, 1, 3, padding=1, padding_mode="replicate")
        self.restart()

    def restart(self) -> None:
        """Set the correction to zero; the features learned so far stay."""
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(self, inputs: Tensor, first: Tensor) -> Tensor:
        """(B, C, H, W) inputs and (B, 1, H, W) first disparity in 0..1 -> (B, 1, H, W) disparity in 0..1."""
        first = first.clamp(0.002, 0.998)
        logit = torch.logit(first)
        stacked = torch.cat([inputs, first * 2 - 1], 1)
        levels = []
        x = stacked
        for block in self.encoder:
            x = block(x)
            levels.append(x)
        for block, skip in zip(self.decoder, levels[-2::-1]):
            x = block(torch.cat([_resize_like(x, skip), skip], 1))
        x = functional.elu(self.head(torch.cat([_resize_like(x, stacked), stacked], 1)))
        return torch.sigmoid(logit + self.last(x))


def depth_from_disparity(disparity: Tensor, near: float, far: float) -> Tensor:
    """Normalised disparity 0..1 -> depth: 0 is `far`, 1 is `near` (Monodepth2, section 3.1, in its depth range)."""
    return 1.0 / (1.0 / far + (1.0 / near - 1.0 / far) * disparity)


def disparity_from_depth(depth: Tensor, near: float, far: float) -> Tensor:
    """Depth -> normalised disparity, clamped to 0..1."""
    return ((1.0 / depth.clamp_min(1e-9) - 1.0 / far) / (1.0 / near - 1.0 / far)).clamp(0.0, 1.0)


def parameters(*networks: nn.Module) -> int:
    """Number of trained values in all networks together."""
    return sum(p.numel() for network in networks for p in network.parameters())


def convolutions(before: int, after: int, stride: int) -> nn.Sequential:
    """Two 3x3 convolutions from `before` to `after` channels, the first one strided."""
    return nn.Sequential(
        nn.Conv2d(before, after, 3, stride, 1),
        nn.ELU(),
        nn.Conv2d(after, after, 3, 1, 1),
        nn.GroupNorm(1, after),
        nn.ELU(),
    )


def _resize_like(x: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(x, size=like.shape[2:], mode="bilinear", align_corners=False)
