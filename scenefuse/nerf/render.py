"""From rays to colours and depths: marching through the occupancy grid, compositing, rendering whole views."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from scenefuse.nerf import kernels
from scenefuse.nerf.field import Field, kernel_module
from scenefuse.nerf.rays import camera_rays

# Interval that rays are cut into, in cells: no cell is stepped over, whatever the direction.
STEP_IN_CELLS = 0.75
# Random cells are evaluated now and then, and an old density decays by this before the larger of it and the new one is
# kept (Mueller et al. 2022, appendix E.2).
DECAY = 0.9


@dataclasses.dataclass
class Occupancy:
    """A grid over the unit cube; its densities change while a field is trained.

    Attributes:
        hull: (G, G, G) bool, cells inside the visual hull; nothing is ever sampled elsewhere.
        density: (G, G, G) float32, cached density.
        alpha: (G, G, G) float32, opacity of one marching step, -1 outside the hull.
        blocks_used: (G / 4, G / 4, G / 4) uint8, 1 where a block of 4 x 4 x 4 cells has one of the hull.
    """

    hull: Tensor
    density: Tensor
    alpha: Tensor = dataclasses.field(init=False)
    blocks_used: Tensor = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        """What marching looks up."""
        opacity = 1 - torch.exp(-self.density * self.step)
        self.alpha = torch.where(self.hull, opacity, torch.full_like(opacity, -1.0))
        side = self.size // 4
        self.blocks_used = self.hull.view(side, 4, side, 4, side, 4).any(5).any(3).any(1).to(torch.uint8)

    @property
    def step(self) -> float:
        """Length of an interval that rays are cut into."""
        return STEP_IN_CELLS / self.size

    @property
    def size(self) -> int:
        """Cells per side."""
        return self.hull.shape[0]

    @classmethod
    def from_hull(cls, hull: Tensor) -> "Occupancy":
        """Nothing is known about densities."""
        return cls(hull, torch.zeros(hull.shape, device=hull.device))


@torch.no_grad()
def updated(occupancy: Occupancy, field: Field, seed: int, step: int) -> Occupancy:
    """The grid with the cached density of random hull cells refreshed; seed and training step determine the cells."""
    density = occupancy.density.clone()
    chosen, x = _drawn_cells(occupancy, seed, step)
    flat = density.view(-1)
    flat[chosen] = torch.maximum(flat[chosen] * DECAY, field.density(x))
    return Occupancy(occupancy.hull, density)


def _drawn_cells(occupancy: Occupancy, seed: int, step: int) -> tuple[Tensor, Tensor]:
    """Flat indices (N,) of random hull cells, and a random position (N, 3) in each."""
    rng = np.random.default_rng((seed, step, 1))
    inside = torch.nonzero(occupancy.hull.flatten())[:, 0]
    # Half of the hull's cells and some more, but never many more than a training step has samples.
    count = min(len(inside) // 2, 1 << 16) + (1 << 12)
    chosen = inside[torch.from_numpy(rng.integers(0, len(inside), min(count, 2 * len(inside))))].unique()
    size = occupancy.size
    index = torch.stack([chosen // (size * size), chosen // size % size, chosen % size], dim=1)
    jitter = torch.from_numpy(rng.random((len(chosen), 3), dtype=np.float32)).to(chosen.device)
    return chosen, (index + jitter) / size


# Share of a ray's samples that is spread evenly over its part in the hull: what the grid does not know yet is seen too.
UNIFORM_SHARE = 0.25


@dataclass(frozen=True)
class RaySamples:
    """S samples on each ray that meets the hull.

    Attributes:
        ray: (H,) int64, which of the R rays they belong to.
        t: (H, S) distance along the ray, increasing.
        delta: (H, S) length of ray in the hull that the sample stands for.
    """

    ray: Tensor
    t: Tensor
    delta: Tensor


@dataclass(frozen=True)
class RayPrior:
    """Where a depth prior expects the surface: distance (R,) along the ray, half-width (R,), share of samples (R,)."""

    distance: Tensor
    width: Tensor
    share: Tensor


def no_prior(rays: int, device: torch.device) -> RayPrior:
    """Nothing is expected anywhere."""
    none = torch.zeros(rays, device=device)
    return RayPrior(none - 1, none, none)


def march(
    origin: Tensor, direction: Tensor, occupancy: Occupancy, jitter: Tensor, uniform: float, prior: RayPrior
) -> RaySamples:
    """Draw samples along rays, more of them where the grid or a depth prior expects the surface.

    Args:
        origin: (R, 3) in the frame of the unit cube.
        direction: (R, 3) unit vectors.
        occupancy: the grid.
        jitter: (R, S) in 0..1, position of each sample in its share of the ray.
        uniform: share of the samples spread evenly over the ray in the hull.
        prior: expected surface; a share of 0 where there is none.
    """
    if kernel_module(origin.device)[0] is not kernels:
        t, delta, hit = march_reference(origin, direction, occupancy, jitter, uniform, prior)
    else:
        t, delta = torch.zeros(jitter.shape), torch.zeros(jitter.shape)
        hit = torch.zeros(len(jitter), dtype=torch.uint8)
        kernels.march(
            (origin.numpy(), direction.numpy()),
            (occupancy.alpha.numpy(), occupancy.blocks_used.numpy(), np.float32(occupancy.step)),
            jitter.numpy(),
            np.float32(uniform),
            (prior.distance.numpy(), prior.width.numpy(), prior.share.numpy()),
            (t.numpy(), delta.numpy(), hit.numpy()),
        )
    ray = torch.nonzero(hit)[:, 0]
    return RaySamples(ray, t[ray], delta[ray])


def march_reference(
    origin: Tensor, direction: Tensor, occupancy: Occupancy, jitter: Tensor, uniform: float, prior: RayPrior
) -> tuple[Tensor, Tensor, Tensor]:
    """`kernels.march` in plain PyTorch: t (R, S), delta (R, S), hit (R,)."""
    step = occupancy.step
    start, alpha, valid = _hull_intervals(origin, direction, occupancy)
    used = valid.sum(1, keepdim=True)
    mass = _mass(start + 0.5 * step, alpha, valid, uniform, prior)
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


def _hull_intervals(origin: Tensor, direction: Tensor, occupancy: Occupancy) -> tuple[Tensor, Tensor, Tensor]:
    """Rays cut into N intervals: where they start (R, N), their opacity, which count; those in the hull come first."""
    step = occupancy.step
    safe = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction)
    a, b = -origin / safe, (1 - origin) / safe
    low = torch.minimum(a, b).amax(1).clamp(min=0)
    high = torch.maximum(a, b).amin(1)
    index = torch.arange(int(math.sqrt(3.0) / step) + 2, device=origin.device)
    middle = low[:, None] + (index + 0.5) * step
    x = origin[:, None] + middle[..., None] * direction[:, None]
    cell = (x * occupancy.size).long().clamp(0, occupancy.size - 1)
    opacity = occupancy.alpha[cell.unbind(-1)]
    valid = (index < torch.ceil((high - low).clamp(min=0) / step)[:, None]) & (opacity >= 0)
    order = torch.argsort((~valid).to(torch.int8), dim=1, stable=True)
    valid, start = valid.gather(1, order), (middle - 0.5 * step).gather(1, order)
    return start, opacity.gather(1, order) * valid, valid


def _mass(middle: Tensor, alpha: Tensor, valid: Tensor, uniform: float, prior: RayPrior) -> Tensor:
    """Share of a ray's samples that each of its intervals (R, N) gets.

    A mixture of three: the same for all, the compositing weights of the grid, blurred by a maximum over neighbours
    (after mip-NeRF, Barron et al. 2021), and the intervals near the prior.
    """
    ahead = torch.cumprod(1 - alpha, 1)
    raw = torch.cat([torch.ones_like(ahead[:, :1]), ahead[:, :-1]], 1) * alpha
    padded = torch.nn.functional.pad(raw, (1, 1))
    peak = torch.maximum(torch.maximum(padded[:, :-2], padded[:, 2:]), raw) * valid
    near = valid & ((middle - prior.distance[:, None]).abs() <= prior.width[:, None])
    near_count = near.sum(1, keepdim=True)
    share_prior = torch.where(near_count > 0, prior.share[:, None], torch.zeros_like(raw[:, :1]))
    known = raw.sum(1, keepdim=True) >= float(kernels.MIN_KNOWN_WEIGHT)
    share_uniform = torch.where(known, uniform * (1 - share_prior), 1 - share_prior)
    return (
        share_uniform / valid.sum(1, keepdim=True).clamp(min=1) * valid
        + (1 - share_prior - share_uniform) * peak / peak.sum(1, keepdim=True).clamp(min=1e-12)
        + share_prior / near_count.clamp(min=1) * near
    )


@dataclass(frozen=True)
class Composited:
    """S samples on each of R rays, seen as one.

    Attributes:
        color: (R, 3) on black.
        opacity: (R,).
        moment: (R,) sum of w t; over the opacity it is the expected distance.
        weights: (R, S) compositing weights w, without gradient.
    """

    color: Tensor
    opacity: Tensor
    moment: Tensor
    weights: Tensor

    @property
    def distance(self) -> Tensor:
        """Expected distance (R,) of the surface along the ray."""
        return self.moment / self.opacity.clamp(min=1e-3)


def composite(sigma: Tensor, rgb: Tensor, t: Tensor, delta: Tensor) -> Composited:
    """Volume rendering by quadrature: equation (3) of NeRF (Mildenhall et al. 2020).

    Args:
        sigma: (R, S) density.
        rgb: (R, S, 3).
        t: (R, S) distance along the ray, increasing.
        delta: (R, S) length each sample stands for.
    """
    tau = sigma * delta
    before = torch.cumsum(tau, 1) - tau
    w = torch.exp(-before) * (1 - torch.exp(-tau))
    return Composited((w[..., None] * rgb).sum(1), w.sum(1), (w * t).sum(1), w.detach())


def median_distance(t: Tensor, delta: Tensor, weights: Tensor) -> Tensor:
    """Distance (R,) at which half of a ray's opacity is reached, linear inside a sample's share of the ray."""
    total = torch.cumsum(weights, 1)
    half = 0.5 * total[:, -1:]
    k = torch.searchsorted(total, half).clamp(max=t.shape[1] - 1)
    w = weights.gather(1, k)
    part = (half - (total.gather(1, k) - w)) / w.clamp(min=1e-9)
    return (t.gather(1, k) + (part.clamp(0, 1) - 0.5) * delta.gather(1, k))[:, 0]


@dataclass(frozen=True)
class RenderedView:
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


Camera = tuple[Tensor, Tensor, Tensor]


@torch.no_grad()
def render_view(
    field: Field, occupancy: Occupancy, camera: Camera, where: Tensor, samples: int, colored: bool
) -> RenderedView:
    """Render the pixels of one view.

    Args:
        field: trained field.
        occupancy: its grid.
        camera: intrinsics (3, 3) in pixels, nerf_from_cam rotation (3, 3), centre (3,), on the CPU.
        where: (H, W) bool, the pixels to trace.
        samples: samples per ray.
        colored: False leaves the colours out, which is faster.
    """
    device = field.table.device
    maps = [torch.zeros(*where.shape, 3), *(torch.zeros(where.shape) for _ in range(3))]
    # At a time so many rays that their samples stay in the processor's caches.
    for pixels in torch.nonzero(where).split(1 << 12):
        uv = pixels.flip(1).float() + 0.5
        intrinsics, rotation, center = (part.expand(len(uv), *part.shape) for part in camera)
        origin, direction, length = camera_rays(intrinsics, rotation, center, uv)
        origin, direction = origin.contiguous().to(device), direction.contiguous().to(device)
        jitter = torch.full((len(uv), samples), 0.5, device=device)
        drawn = march(origin, direction, occupancy, jitter, UNIFORM_SHARE, no_prior(len(uv), device))
        if len(drawn.ray) == 0:
            continue
        hit = drawn.ray.cpu()
        color, distance, opacity, deviation = _render_rays(field, origin, direction, drawn, colored)
        rows, columns = pixels[hit].unbind(1)
        for target, values in zip(maps, (color, distance / length[hit], opacity, deviation)):
            target[rows, columns] = values
    return RenderedView(*maps)


def _render_rays(
    field: Field, origin: Tensor, direction: Tensor, drawn: RaySamples, colored: bool
) -> tuple[Tensor, ...]:
    """Colour (H, 3), median distance, opacity and deviation (H,) of the rays that have samples, on the CPU."""
    x = origin[drawn.ray, None] + drawn.t[..., None] * direction[drawn.ray, None]
    sigma, features = field.geometry(x.view(-1, 3))
    rgb = field.color(features, direction[drawn.ray]) if colored else torch.zeros_like(x)
    ray = composite(sigma.view(drawn.t.shape), rgb, drawn.t, drawn.delta)
    total = ray.opacity.clamp(min=1e-6)
    variance = (ray.weights * (drawn.t - (ray.moment / total)[:, None]) ** 2).sum(1) / total
    distance = median_distance(drawn.t, drawn.delta, ray.weights)
    return tuple(part.cpu() for part in (ray.color, distance, ray.opacity, variance.sqrt()))
