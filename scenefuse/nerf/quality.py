"""How good a rendered photo is: PSNR, SSIM, silhouette."""

import torch
from torch import Tensor


def psnr(a: Tensor, b: Tensor, where: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of (H, W, 3) pictures in 0..1 over the pixels `where` (H, W)."""
    error = ((a - b) ** 2)[where].mean()
    return float(-10 * torch.log10(error.clamp(min=1e-10)))


def ssim(a: Tensor, b: Tensor, where: Tensor) -> float:
    """Structural similarity (Wang et al. 2004) of (H, W, 3) pictures in 0..1; Gaussian window, sigma 1.5 pixels."""
    x = torch.arange(11.0) - 5
    line = torch.exp(-(x**2) / (2 * 1.5**2))
    line = line / line.sum()

    def blur(picture: Tensor) -> Tensor:
        rows = torch.nn.functional.conv2d(picture, line.view(1, 1, 11, 1), padding=(5, 0))
        return torch.nn.functional.conv2d(rows, line.view(1, 1, 1, 11), padding=(0, 5))

    p, q = (c.permute(2, 0, 1)[:, None].float() for c in (a, b))
    mp, mq = blur(p), blur(q)
    vp, vq, covariance = blur(p * p) - mp * mp, blur(q * q) - mq * mq, blur(p * q) - mp * mq
    c1, c2 = 0.01**2, 0.03**2
    score = (2 * mp * mq + c1) * (2 * covariance + c2) / ((mp * mp + mq * mq + c1) * (vp + vq + c2))
    return float(score[:, 0].mean(0)[where].mean())


def silhouette_iou(opacity: Tensor, mask: Tensor) -> float:
    """Intersection over union of opacity > 0.5 and a mask, both (H, W)."""
    solid = opacity > 0.5
    return float((solid & mask).sum() / (solid | mask).sum().clamp(min=1))
