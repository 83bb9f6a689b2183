"""A small depth network and the signal that trains it without depth, after Monodepth2 (Godard et al., ICCV 2019).

The network is trained from scratch on the photos of one object, so it is far smaller than the original's ResNet-18, and
it corrects a first disparity (from SfM points and stereo) instead of inventing one from colour alone, much as
ManyDepth (Watson et al., CVPR 2021) gives its network a cost volume. Its measure of depth is normalised disparity.

One photo, warped by the right depth and pose, must look like another. For target photo I_t, source photos I_s, depth D
and the pose T of the source camera, a target pixel p (homogeneous) is seen in the source at

    p_s ~ K_s T (D(p) K_t^-1 p)                                                            (1) warping
    I_{s->t}(p) = I_s(p_s), bilinear
    pe(a, b) = alpha / 2 (1 - SSIM(a, b)) + (1 - alpha) |a - b|,  alpha = 0.85              (2) photometric error
    L_p = min over s of pe(I_t, I_{s->t})                                                  (3) minimum reprojection
    mu = [ min_s pe(I_t, I_{s->t}) < min_s pe(I_t, I_s) ]                                   (4) auto-mask
    L_s = |dx d*| exp(-|dx I_t|) + |dy d*| exp(-|dy I_t|),  d* = d / mean(d)                (5) edge-aware smoothness

Images are (B, 3, H, W) in 0..1, depths (B, 1, H, W) along z, pixel centres at +0.5.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

# alpha of equation (2), as in Monodepth2.
SSIM_WEIGHT = 0.85
# What the depth network can say: an object that fits into its photos, about 1 away, is neither nearer nor farther.
NEAR = 0.5


def points_in_cam(depth: Tensor, intrinsics: Tensor) -> Tensor:
    """(B, 1, H, W) depth and (B, 3, 3) intrinsics -> (B, 3, H*W) points in the camera's frame."""
    batch, _, height, width = depth.shape
    v, u = torch.meshgrid(
        torch.arange(height, device=depth.device) + 0.5, torch.arange(width, device=depth.device) + 0.5, indexing="ij"
    )
    pixels = torch.stack([u, v, torch.ones_like(u)]).view(1, 3, -1).to(depth.dtype)
    return torch.linalg.inv(intrinsics) @ pixels * depth.reshape(batch, 1, -1)


def project(points: Tensor, source_from_target: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Equation (1): (B, 3, N) points -> (B, N, 2) pixels in the source, (B, N) depths there."""
    moved = source_from_target[:, :3, :3] @ points + source_from_target[:, :3, 3:]
    z = moved[:, 2]
    pixels = intrinsics @ moved
    return (pixels[:, :2] / z[:, None].clamp_min(1e-6)).transpose(1, 2), z


def sample(image: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear values of (B, C, H, W) maps at (B, ..., 2) pixels -> (B, C, ...); the border is repeated."""
    size = pixels.new_tensor([image.shape[3], image.shape[2]])
    grid = (pixels * 2.0 / size - 1.0).view(len(image), -1, 1, 2)
    values = functional.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return values.view(*values.shape[:2], *pixels.shape[1:-1])


def inside(pixels: Tensor, z: Tensor, height: int, width: int) -> Tensor:
    """True for (B, N, 2) pixels that lie in the image and in front of the camera, at least half a pixel inside."""
    u, v = pixels.unbind(-1)
    return (u > 0.5) & (u < width - 0.5) & (v > 0.5) & (v < height - 0.5) & (z > 1e-6)


def warp(
    source: Tensor, depth: Tensor, source_from_target: Tensor, of_target: Tensor, of_source: Tensor
) -> tuple[Tensor, Tensor]:
    """Draw the source as the target camera would see it.

    Args:
        source: (B, C, h, w) photo or map of the source.
        depth: (B, 1, H, W) depth of the target.
        source_from_target: (B, 4, 4) rigid transforms.
        of_target: (B, 3, 3) intrinsics of the target.
        of_source: (B, 3, 3) intrinsics of the source.

    Returns:
        (B, C, H, W) warped values and (B, 1, H, W) bool, True where the source has the pixel.
    """
    height, width = depth.shape[2:]
    pixels, z = project(points_in_cam(depth, of_target), source_from_target, of_source)
    valid = inside(pixels, z, *source.shape[2:])
    return sample(source, pixels.view(len(depth), height, width, 2)), valid.view(-1, 1, height, width)


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity in 3x3 windows, per pixel and channel (Wang et al. 2004)."""
    a, b = (functional.pad(x, (1, 1, 1, 1), mode="reflect") for x in (a, b))
    mean_a, mean_b, aa, bb, ab = functional.avg_pool2d(torch.cat([a, b, a * a, b * b, a * b], 1), 3, 1).chunk(5, 1)
    c1, c2 = 0.01**2, 0.03**2
    covariance, spread = ab - mean_a * mean_b, (aa - mean_a**2) + (bb - mean_b**2)
    return (2 * mean_a * mean_b + c1) * (2 * covariance + c2) / ((mean_a**2 + mean_b**2 + c1) * (spread + c2))


def photometric_error(a: Tensor, b: Tensor) -> Tensor:
    """Equation (2), averaged over colours: (B, 1, H, W)."""
    absolute = (a - b).abs()
    structure = (1.0 - ssim(a, b)).div(2.0).clamp(0.0, 1.0)
    return (SSIM_WEIGHT * structure + (1.0 - SSIM_WEIGHT) * absolute).mean(1, keepdim=True)


def minimum_reprojection(errors: Tensor, valid: Tensor, unmoved: Tensor | None) -> tuple[Tensor, Tensor]:
    """Equations (3) and (4).

    Args:
        errors: (B, S, H, W) photometric error against each warped source.
        valid: (B, S, H, W) bool, True where that source has the pixel.
        unmoved: (B, S, H, W) error against the sources as they are, or None for no auto-mask.

    Returns:
        (B, 1, H, W) smallest error and (B, 1, H, W) bool, True where it counts.
    """
    infinite = errors.new_tensor(torch.inf)
    smallest = torch.where(valid, errors, infinite).amin(1, keepdim=True)
    counts = torch.isfinite(smallest)
    if unmoved is not None:
        counts = counts & (smallest < unmoved.amin(1, keepdim=True))
    return torch.where(counts, smallest, torch.zeros_like(smallest)), counts


def smoothness(disparity: Tensor, image: Tensor, mask: Tensor) -> Tensor:
    """Equation (5) inside a (B, 1, H, W) mask of zeros and ones: a scalar."""
    mean = (disparity * mask).sum((2, 3), keepdim=True) / mask.sum((2, 3), keepdim=True).clamp_min(1.0)
    disparity = disparity / mean.clamp_min(1e-6)
    total = disparity.new_zeros(())
    for axis in (2, 3):
        step = torch.diff(disparity, dim=axis).abs()
        edge = torch.exp(-torch.diff(image, dim=axis).abs().mean(1, keepdim=True))
        size = mask.shape[axis] - 1
        both = mask.narrow(axis, 1, size) * mask.narrow(axis, 0, size)
        total = total + (step * edge * both).sum() / both.sum().clamp_min(1.0)
    return total


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of values where the mask is non-zero; zero where it is nowhere."""
    weights = mask.to(values.dtype)
    return (values * weights).sum() / weights.sum().clamp_min(1.0)


class DepthNetwork(nn.Module):
    """U-Net that predicts normalised disparity from colours: sigmoid(logit(first) + correction).

    The first disparity is that of a depth of 1. The last layer starts at zero, so that training starts from it.
    """

    def __init__(self) -> None:
        super().__init__()
        sizes = [16, 32, 48, 64]
        self.encoder = nn.ModuleList(convolutions(before, after, 2) for before, after in zip([4, *sizes[:-1]], sizes))
        self.decoder = nn.ModuleList(
            convolutions(deep + skip, skip, 1) for deep, skip in zip(sizes[:0:-1], sizes[-2::-1])
        )
        self.head = nn.Conv2d(sizes[0] + 4, 16, 3, padding=1, padding_mode="replicate")
        self.last = nn.Conv2d(16, 1, 3, padding=1, padding_mode="replicate")
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(self, photos: Tensor) -> Tensor:
        """(B, 3, H, W) photos in 0..1 -> (B, 1, H, W) disparity in 0..1."""
        first = torch.full_like(photos[:, :1], (1 - NEAR) / (1 / NEAR - NEAR))
        stacked = torch.cat([photos, first], 1) * 2 - 1
        levels = []
        x = stacked
        for block in self.encoder:
            x = block(x)
            levels.append(x)
        for block, skip in zip(self.decoder, levels[-2::-1]):
            x = block(torch.cat([_resize_like(x, skip), skip], 1))
        x = functional.elu(self.head(torch.cat([_resize_like(x, stacked), stacked], 1)))
        return torch.sigmoid(torch.logit(first) + self.last(x))


def depth_from_disparity(disparity: Tensor) -> Tensor:
    """Normalised disparity 0..1 -> depth from 1 / NEAR to NEAR (Monodepth2, section 3.1, in this depth range)."""
    return 1.0 / (NEAR + (1.0 / NEAR - NEAR) * disparity)


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
