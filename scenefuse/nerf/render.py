"""From rays to colours and depths: marching through the occupancy grid, compositing, rendering whole views."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from scenefuse.nerf import kernels
from scenefuse.nerf.field import Field
from scenefuse.nerf.occupancy import Occupancy
from scenefuse.nerf.rays import camera_rays


@dataclass(frozen=True)
class Samples:
    """S samples on each ray that meets an occupied cell.

    Attributes:
        ray: (H,) int64, which of the R rays they belong to.
        t: (H, S) distance along the ray, increasing.
        delta: (H, S) length of occupied ray that the sample stands for.
    """

    ray: Tensor
    t: Tensor
    delta: Tensor


@dataclass(frozen=True)
class Prior:
    """Where a depth prior expects the surface: distance (R,) along the ray, half-width (R,), share of samples (R,)."""

    distance: Tensor
    width: Tensor
    share: Tensor


def march(
    origin: Tensor, direction: Tensor, occupancy: Occupancy, jitter: Tensor, uniform: float, prior: Prior
) -> Samples:
    """Draw samples along rays, more of them where the grid or a depth prior expects the surface.

    Args:
        origin: (R, 3) in the frame of the unit cube.
        direction: (R, 3) unit vectors.
        occupancy: the grid.
        jitter: (R, S) in 0..1, position of each sample in its share of the ray.
        uniform: share of the samples spread evenly over the occupied ray.
        prior: expected surface; a share of 0 where there is none.
    """
    if not (kernels.AVAILABLE and origin.device.type == "cpu"):
        t, delta, hit = march_reference(origin, direction, occupancy, jitter, uniform, prior)
    else:
        t, delta = torch.zeros(jitter.shape), torch.zeros(jitter.shape)
        hit = torch.zeros(len(jitter), dtype=torch.uint8)
        kernels.march(
            origin.numpy(), direction.numpy(), occupancy.alpha.numpy(), occupancy.blocks_used.numpy(),
            _f32(occupancy.step), jitter.numpy(), _f32(uniform), prior.distance.numpy(), prior.width.numpy(),
            prior.share.numpy(), t.numpy(), delta.numpy(), hit.numpy(),
        )  # fmt: skip
    ray = torch.nonzero(hit)[:, 0]
    return Samples(ray, t[ray], delta[ray])


def march_reference(
    origin: Tensor, direction: Tensor, occupancy: Occupancy, jitter: Tensor, uniform: float, prior: Prior
) -> tuple[Tensor, Tensor, Tensor]:
    """`kernels.march` in plain PyTorch: t (R, S), delta (R, S), hit (R,)."""
    step = occupancy.step
    safe = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction)
    a, b = -origin / safe, (1 - origin) / safe
    low = torch.minimum(a, b).amax(1).clamp(min=0)
    high = torch.maximum(a, b).amin(1)
    intervals = int(math.sqrt(3.0) / step) + 2
    index = torch.arange(intervals, device=origin.device)
    middle = low[:, None] + (index + 0.5) * step
    x = origin[:, None] + middle[..., None] * direction[:, None]
    cell = (x * occupancy.size).long().clamp(0, occupancy.size - 1)
    opacity = occupancy.alpha[cell.unbind(-1)]
    valid = (index < torch.ceil((high - low).clamp(min=0) / step)[:, None]) & (opacity >= 0)
    # Occupied intervals first, in their order along the ray.
    order = torch.argsort((~valid).to(torch.int8), dim=1, stable=True)
    valid, start = valid.gather(1, order), (middle - 0.5 * step).gather(1, order)
    alpha = opacity.gather(1, order) * valid
    ahead = torch.cumprod(1 - alpha, 1)
    raw = torch.cat([torch.ones_like(ahead[:, :1]), ahead[:, :-1]], 1) * alpha
    padded = torch.nn.functional.pad(raw, (1, 1))
    peak = torch.maximum(torch.maximum(padded[:, :-2], padded[:, 2:]), raw) * valid
    used = valid.sum(1, keepdim=True)
    near = valid & ((start + 0.5 * step - prior.distance[:, None]).abs() <= prior.width[:, None])
    near_count = near.sum(1, keepdim=True)
    share_prior = torch.where(near_count > 0, prior.share[:, None], torch.zeros_like(raw[:, :1]))
    known = raw.sum(1, keepdim=True) >= 1e-4
    share_uniform = torch.where(known, uniform * (1 - share_prior), 1 - share_prior)
    share_weight = 1 - share_prior - share_uniform
    mass = (
        share_uniform / used.clamp(min=1) * valid
        + share_weight * peak / peak.sum(1, keepdim=True).clamp(min=1e-12)
        + share_prior / near_count.clamp(min=1) * near
    )
    cdf = torch.cumsum(mass, 1)
    samples = jitter.shape[1]
    goal = ((torch.arange(samples, device=origin.device) + 1) / samples).expand(len(origin), samples).contiguous()
    k = torch.searchsorted(cdf, goal).minimum(used - 1).clamp(min=0)
    before = (cdf - mass).gather(1, k)
    end = k + ((goal - before) / mass.gather(1, k).clamp(min=1e-12)).clamp(0, 1)
    end[:, -1:] = used.to(end.dtype)
    edge = torch.cat([torch.zeros_like(end[:, :1]), end[:, :-1]], 1)
    position = edge + (end - edge) * jitter
    chosen = position.long().minimum(used - 1).clamp(min=0)
    t = start.gather(1, chosen) + (position - chosen) * step
    return t, (end - edge) * step, used[:, 0] > 0


def composite(sigma: Tensor, rgb: Tensor, t: Tensor, delta: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Volume rendering of S samples on each of R rays.

    Args:
        sigma: (R, S) density.
        rgb: (R, S, 3).
        t: (R, S) distance along the ray, increasing.
        delta: (R, S) length each sample stands for.

    Returns:
        colour (R, 3) on black, opacity (R,), sum of w t (R,), distortion (R,), and the weights w (R, S), which carry
        no gradient.
    """
    tau = sigma * delta
    before = torch.cumsum(tau, 1) - tau
    w = torch.exp(-before) * (1 - torch.exp(-tau))
    mass, moment = torch.cumsum(w, 1) - w, torch.cumsum(w * t, 1) - w * t
    distortion = (2 * w * (t * mass - moment) + w * w * delta / 3).sum(1)
    return (w[..., None] * rgb).sum(1), w.sum(1), (w * t).sum(1), distortion, w.detach()


def median_distance(t: Tensor, delta: Tensor, weights: Tensor) -> Tensor:
    """Distance (R,) at which half of a ray's opacity is reached, linear inside a sample's share of the ray."""
    total = torch.cumsum(weights, 1)
    half = 0.5 * total[:, -1:]
    k = torch.searchsorted(total, half).clamp(max=t.shape[1] - 1)
    w = weights.gather(1, k)
    part = (half - (total.gather(1, k) - w)) / w.clamp(min=1e-9)
    return (t.gather(1, k) + (part.clamp(0, 1) - 0.5) * delta.gather(1, k))[:, 0]


@dataclass(frozen=True)
class Rendered:
    """A view as rendered: maps (H, W), zero where the ray was not traced or met nothing.

    Attributes:
        color: (H, W, 3) float32 on black; all zero unless asked for.
        depth: median depth along z, nerf units.
        opacity: 0..1.
        deviation: standard deviation of the compositing weights along the ray, nerf units.
    """

    color: Tensor
    depth: Tensor
    opacity: Tensor
    deviation: Tensor


@torch.no_grad()
def render_view(
    field: Field, occupancy: Occupancy, intrinsics: Tensor, rotation: Tensor, center: Tensor, where: Tensor,
    samples: int, uniform: float, colored: bool, chunk: int = 4096,
) -> Rendered:  # fmt: skip
    """Render the pixels of one view.

    Args:
        field: trained field.
        occupancy: its grid.
        intrinsics: (3, 3) in pixels.
        rotation: (3, 3) nerf_from_cam.
        center: (3,) camera centre.
        where: (H, W) bool, the pixels to trace.
        samples: samples per ray.
        uniform: share of the samples spread evenly over the occupied ray.
        colored: False leaves the colours out, which is faster.
        chunk: rays at once.
    """
    maps = [torch.zeros(*where.shape, 3), *(torch.zeros(where.shape) for _ in range(3))]
    for pixels in torch.nonzero(where).split(chunk):
        uv = pixels.flip(1).float() + 0.5
        count = len(uv)
        origin, direction, length = camera_rays(
            intrinsics.expand(count, 3, 3), rotation.expand(count, 3, 3), center.expand(count, 3), uv
        )
        device = field.table.device
        origin, direction = origin.contiguous().to(device), direction.contiguous().to(device)
        none = torch.zeros(count, device=device)
        jitter = torch.full((count, samples), 0.5, device=device)
        drawn = march(origin, direction, occupancy, jitter, uniform, Prior(none - 1, none, none))
        if len(drawn.ray) == 0:
            continue
        x = origin[drawn.ray, None] + drawn.t[..., None] * direction[drawn.ray, None]
        sigma, features = field.geometry(x.view(-1, 3))
        rgb = field.color(features, direction[drawn.ray]) if colored else torch.zeros(*drawn.t.shape, 3, device=device)
        color, opacity, moment, _, w = composite(sigma.view(drawn.t.shape), rgb, drawn.t, drawn.delta)
        mean = moment / opacity.clamp(min=1e-6)
        variance = (w * (drawn.t - mean[:, None]) ** 2).sum(1) / opacity.clamp(min=1e-6)
        hit = drawn.ray.cpu()
        rows, columns = pixels[hit].unbind(1)
        depth = median_distance(drawn.t, drawn.delta, w).cpu() / length[hit]
        for target, values in zip(maps, (color, depth, opacity, variance.sqrt())):
            target[rows, columns] = values.cpu()
    return Rendered(*maps)


def _f32(value: float) -> np.float32:
    return np.float32(value)
