"""Training of the depth-guided NeRF: one loop, resumable, the same result for the same seed.

Everything lies in the frame of the unit cube ("nerf"): lengths and depths are shares of the cube's side.
"""

import contextlib
import ctypes
import sys
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from scenefuse.core.checkpoints import (
    Progress,
    State,
    checkpointed,
    learning_rate_factor,
    load_checkpoint,
    step_generator,
)
from scenefuse.core.stage import setting
from scenefuse.nerf.appearance import Appearance, find_appearance, squared_radius
from scenefuse.nerf.field import Field, FieldSettings, coarse_to_fine
from scenefuse.nerf.rays import (
    SURFACE_DEPTH,
    LossWeights,
    PhotoTensors,
    PixelBatch,
    PixelPool,
    camera_rays,
    color_loss,
    depth_loss,
    draw_batch,
    mask_loss,
    pixel_pool,
    sparsity_loss,
)
from scenefuse.nerf.render import UNIFORM_SHARE, Composited, Occupancy, RayPrior, RaySamples, composite, march, updated

# Steps between updates of the grid (Mueller et al. 2022, appendix E.2).
OCCUPANCY_EVERY = 16


@dataclass(frozen=True)
class Schedule:
    """How long a NeRF stage trains."""

    epochs: int = setting(20, least=1)
    """Epochs of this stage; an epoch is a number of rays."""
    rays_per_epoch: int = setting(120_000, least=1)
    """Rays drawn per epoch."""


@dataclass(frozen=True)
class NerfRecipe:
    """How a NeRF stage trains.

    Adam, warm-up, cosine and batches of 24 photos are the paper's (section 4.2.2); its highest rate, 0.001, is too low
    for a hash grid (method N7).
    """

    images_per_batch: int = 24
    """Photos per batch."""
    rays_per_image: int = 96
    """Rays per photo of a batch."""
    warmup_epochs: float = 1.0
    """Epochs of linear warm-up, before the cosine."""
    learning_rate: float = 5e-3
    """Highest learning rate of the networks."""
    grid_learning_rate: float = 1e-2
    """Highest learning rate of the hash grid."""
    samples: int = 16
    """Samples per ray."""
    coarse_until: float = 0.3
    """Share of the steps after which all levels are open (method N9)."""
    prior_share: float = 0.6
    """Where a prior expects the surface, at most this share of a ray's samples lies near it."""
    turned_share: float = 0.25
    """This share of the rays has its colours asked for from a random direction: they depend on the direction where the
    photos show that they do, and elsewhere are what all photos agree on (method N8)."""
    appearance: bool = True
    """Whether gains and vignetting of the photos are found (method N15), and blurred photos count less."""
    mask_band_px: int = 2
    """Half-width of the band around a mask's edge that no loss touches; 0: masks are exact, grey values included."""

    occupancy_cells: int = 128
    """Cells per side of the occupancy grid, a multiple of 4 times a power of 2."""

    @property
    def rays_per_step(self) -> int:
        """Rays of a batch."""
        return self.images_per_batch * self.rays_per_image


@dataclass
class Nerf:
    """All that is trained: the field, its occupancy grid, and the photos' appearance."""

    field: Field
    occupancy: Occupancy
    appearance: Appearance

    def state(self) -> State:
        """As plain tensors on the CPU, for a file that any machine can read."""
        return {
            "settings": asdict(self.field.settings),
            "field": {name: tensor.cpu() for name, tensor in self.field.state_dict().items()},
            "hull": self.occupancy.hull.cpu(),
            "density": self.occupancy.density.cpu(),
            "log_gain": self.appearance.log_gain.cpu(),
            "falloff": self.appearance.falloff.cpu(),
        }


def new_nerf(settings: FieldSettings, hull: Tensor, photos: int, seed: int, device: str) -> Nerf:
    """An untrained NeRF in a hull (G, G, G), for a number of training photos."""
    field = Field(settings, torch.Generator().manual_seed(seed)).to(device)
    return Nerf(field, Occupancy.from_hull(hull.to(device)), Appearance.none(photos, device))


def go_on_from(nerf: Nerf, earlier: State) -> None:
    """Take over the field and the densities of an earlier stage (`Nerf.state`)."""
    nerf.field.load_state_dict(earlier["field"])
    nerf.field.level_weight.fill_(1.0)
    hull = nerf.occupancy.hull
    nerf.occupancy = Occupancy(hull, earlier["density"].to(hull.device))


@dataclass(frozen=True)
class Rays:
    """R rays of a batch: origin (R, 3), unit direction (R, 3), length (R,) per unit of depth along z, where the prior
    expects the surface on them, and its confidence (R,) in 0..1."""

    origin: Tensor
    direction: Tensor
    length: Tensor
    prior: RayPrior
    confidence: Tensor


@dataclass(frozen=True)
class Rendered:
    """What a step has rendered.

    Attributes:
        step: its number.
        batch: the pixels of its R rays.
        rays: the rays.
        drawn: samples on the H rays that meet the hull.
        sigma: (H, S) densities of the samples.
        seen: what the H rays look like.
    """

    step: int
    batch: PixelBatch
    rays: Rays
    drawn: RaySamples
    sigma: Tensor
    seen: Composited


class Additions(Protocol):
    """What another recipe adds to a training."""

    weights: Mapping[str, float]
    """Weight of each loss that it adds."""
    state: Tensor
    """What a checkpoint keeps of it."""

    def losses(self, rendered: Rendered, nerf: Nerf) -> dict[str, Tensor]:
        """Further losses of a step, by name."""

    def descend(self, nerf: Nerf, optimizer: torch.optim.Optimizer) -> None:
        """Take the optimiser's step."""


@dataclass(frozen=True)
class Training:
    """What a training works on, the same at every step.

    Attributes:
        photos: training photos in the unit cube's frame.
        schedule: its length.
        recipe: batches, rates, samples.
        weights: of the losses.
        warm: the NeRF is already trained: all levels are open, and densities and appearance are found at the start.
        seed: decides every random draw together with the step's number.
        photo_weight: (V,) weight of each photo's colours, or None for 1.
        additions: of another recipe, or None.
    """

    photos: PhotoTensors
    schedule: Schedule
    recipe: NerfRecipe
    weights: LossWeights
    warm: bool
    seed: int
    photo_weight: Tensor | None = None
    additions: Additions | None = None

    @property
    def steps(self) -> int:
        """Optimiser steps."""
        return max(1, round(self.schedule.epochs * self.schedule.rays_per_epoch / self.recipe.rays_per_step))

    @property
    def warmup_steps(self) -> float:
        """Steps of linear warm-up."""
        return self.recipe.warmup_epochs / self.schedule.epochs * self.steps


def train(
    nerf: Nerf, training: Training, *, checkpoint: Path | None, report: Callable[[str], None]
) -> dict[str, float]:
    """Train `nerf` in place.

    Args:
        nerf: new, or of an earlier stage.
        training: photos, lengths, rates and weights.
        checkpoint: file to resume from and save to (every 30 s, and when the process is asked to end), or None.
        report: called with progress lines.

    Returns:
        final loss terms and `psnr` (means over the last tenth), `steps`, `seconds`, `rays_per_second`,
        `samples_per_second`.

    Raises:
        StageError: the training diverged.
    """
    pool = pixel_pool(training.photos, training.recipe.mask_band_px)
    optimizer, added = _optimizer(nerf.field), training.additions
    done = 0

    def state() -> State:
        own = {} if added is None else {"additions": added.state}
        return {"model": nerf.state(), "optimizer": optimizer.state_dict(), "step": done, **own}

    saved = load_checkpoint(checkpoint, like=state())
    if saved is not None:
        done = _resume(saved, nerf, optimizer)
        if added is not None:
            added.state = saved["additions"].to(added.state.device)
        report(f"resumed at step {done} of {training.steps}")
    progress = Progress(training.steps, done, report)
    with checkpointed(checkpoint, state) as step_done:
        for step in range(done, training.steps):
            _prepare(nerf, training, step)
            batch = _draw(training, pool, step, nerf.field.table.device)
            terms, samples = _loss_terms(nerf, training, batch, step)
            _descend(nerf, optimizer, training, terms, step)
            progress.add(step, {name: float(term.detach()) for name, term in terms.items()}, len(batch.view), samples)
            done = step + 1
            step_done(done)
    return progress.summary()


def _resume(saved: State, nerf: Nerf, optimizer: torch.optim.Optimizer) -> int:
    """Put a checkpoint into NeRF and optimiser; the steps that are done."""
    nerf.field.load_state_dict(saved["model"]["field"])
    device = nerf.field.table.device
    nerf.appearance = Appearance(*(saved["model"][name].to(device) for name in ("log_gain", "falloff")))
    nerf.occupancy = Occupancy(*(saved["model"][name].to(device) for name in ("hull", "density")))
    optimizer.load_state_dict(saved["optimizer"])
    return int(saved["step"])


def _optimizer(field: Field) -> torch.optim.Optimizer:
    """Adam with the moments of Mueller et al. 2022, section 4; hash grid and networks each have a rate of their own."""
    networks = [parameter for name, parameter in field.named_parameters() if name != "table"]
    groups = [{"params": [field.table]}, {"params": networks}]
    return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)


def _prepare(nerf: Nerf, training: Training, step: int) -> None:
    """Open levels of the grid, update the occupancy, find the appearance, as far as the step is due for it."""
    progress = step / training.steps
    if not training.warm:
        coarse_to_fine(nerf.field, progress, training.recipe.coarse_until)
    if step % OCCUPANCY_EVERY == 0 and (step or training.warm):
        nerf.occupancy = updated(nerf.occupancy, nerf.field, training.seed, step)
    # Photos are compared by depths, which are good once all levels are open.
    due = 0 if training.warm else round(training.recipe.coarse_until * training.steps)
    if step == due and training.recipe.appearance:
        nerf.appearance = find_appearance(nerf.field, nerf.occupancy, training.photos, training.recipe.samples)


def _draw(training: Training, pool: PixelPool, step: int, device: torch.device) -> PixelBatch:
    recipe = training.recipe
    batch = draw_batch(training.photos, pool, training.seed, step, recipe.images_per_batch, recipe.rays_per_image)
    return batch.to(device)


def _descend(
    nerf: Nerf, optimizer: torch.optim.Optimizer, training: Training, terms: dict[str, Tensor], step: int
) -> None:
    """One step of Adam on the weighted sum of the losses, at this step's rates; gradients are cleared."""
    added = training.additions
    weights = {**training.weights.by_name(), **({} if added is None else added.weights)}
    torch.stack([weights[name] * term for name, term in terms.items() if name != "psnr"]).sum().backward()
    factor = learning_rate_factor(step, training.steps, training.warmup_steps)
    rates = training.recipe.grid_learning_rate, training.recipe.learning_rate
    for group, rate in zip(optimizer.param_groups, rates):
        group["lr"] = rate * factor
    if added is None:
        optimizer.step()
    else:
        added.descend(nerf, optimizer)
    optimizer.zero_grad(set_to_none=True)


def _loss_terms(nerf: Nerf, training: Training, batch: PixelBatch, step: int) -> tuple[dict[str, Tensor], int]:
    """Loss terms of a batch and `psnr` in dB inside the masks, by name, each a scalar; and the number of samples."""
    rays = _rays(training.photos, batch, training.recipe.prior_share)
    device = rays.origin.device
    rng = step_generator(training.seed, step)
    jitter = torch.rand(len(rays.origin), training.recipe.samples, generator=rng).to(device)
    background = torch.rand(len(rays.origin), 3, generator=rng).to(device)
    seen_from = _partly_turned(rays.direction, training.recipe.turned_share, rng)
    drawn = march(
        rays.origin.contiguous(), rays.direction.contiguous(), nerf.occupancy, jitter, UNIFORM_SHARE, rays.prior
    )
    rendered = Rendered(step, batch, rays, drawn, *_render(nerf.field, rays, seen_from, drawn))
    color, psnr = _photometric(nerf.appearance, training, rendered, background)
    terms = {"color": color, **_geometric(training.weights, rendered)}
    if training.additions is not None:
        terms |= training.additions.losses(rendered, nerf)
    return terms | {"psnr": psnr}, drawn.t.numel()


def _rays(photos: PhotoTensors, batch: PixelBatch, prior_share: float) -> Rays:
    """The batch's rays, and where their prior lies."""
    device = batch.view.device
    intrinsics, rotation, center = (
        part.to(device)[batch.view] for part in (photos.intrinsics, photos.rotation, photos.center)
    )
    origin, direction, length = camera_rays(intrinsics, rotation, center, batch.uv)
    confidence = batch.confidence * ((batch.depth > 0) & batch.inside)
    prior = RayPrior(batch.depth * length, torch.full_like(length, SURFACE_DEPTH), prior_share * confidence)
    return Rays(origin, direction, length, prior, confidence)


def _partly_turned(direction: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Unit directions (R, 3), a share of them replaced by random ones."""
    if share == 0:
        return direction
    turned = torch.rand(len(direction), 1, generator=rng) < share
    other = torch.nn.functional.normalize(torch.randn(len(direction), 3, generator=rng), dim=1)
    return torch.where(turned.to(direction.device), other.to(direction.device), direction)


def _render(field: Field, rays: Rays, seen_from: Tensor, drawn: RaySamples) -> tuple[Tensor, Composited]:
    """Densities (H, S) of the samples, and what the H rays that have any look like from directions (R, 3)."""
    x = rays.origin[drawn.ray, None] + drawn.t[..., None] * rays.direction[drawn.ray, None]
    sigma, features = field.geometry(x.view(-1, 3))
    sigma = sigma.view(drawn.t.shape)
    return sigma, composite(sigma, field.color(features, seen_from[drawn.ray]), drawn.t, drawn.delta)


def _photometric(
    appearance: Appearance, training: Training, rendered: Rendered, background: Tensor
) -> tuple[Tensor, Tensor]:
    """Photometric loss and PSNR of the rays that have samples, on random colours (R, 3).

    The field's colours are compared as their photo shows them. On a random background a field cannot pass off emptiness
    as colour, so colours teach opacity as well (instant-ngp's training on images with alpha).
    """
    batch, seen, ray = rendered.batch, rendered.seen, rendered.drawn.ray
    view, inside, matte, shown = batch.view[ray], batch.inside[ray], batch.matte[ray, None], background[ray]
    height, width = training.photos.images.shape[1:3]
    intrinsics = training.photos.intrinsics.to(view.device)[view]
    factor = appearance.factor(view, squared_radius(batch.uv[ray], intrinsics, width, height))
    composed = factor * seen.color + (1 - seen.opacity)[:, None] * shown
    target = matte * batch.color[ray] + (1 - matte) * shown
    error = ((composed.detach() - target) ** 2)[inside].mean().clamp(min=1e-10)
    weight = inside if training.photo_weight is None else inside * training.photo_weight.to(view.device)[view]
    return color_loss(composed, target, weight), -10 * torch.log10(error)


def _geometric(weights: LossWeights, rendered: Rendered) -> dict[str, Tensor]:
    """The losses of depth, mask and density that have a weight (method N2, N4, N5)."""
    seen, ray, rays, batch = rendered.seen, rendered.drawn.ray, rendered.rays, rendered.batch
    terms = {}
    if weights.depth_weight > 0:
        known = rays.prior.distance[ray], rays.confidence[ray]
        terms["depth"] = depth_loss(seen.distance, seen.opacity, *known)
    if weights.mask_weight > 0:
        terms["mask"] = mask_loss(seen.opacity, batch.matte[ray])
    if weights.sparsity_weight > 0:
        terms["sparsity"] = sparsity_loss(rendered.sigma, rendered.drawn.delta, batch.inside[ray])
    return terms


def keep_memory() -> None:
    """Let glibc keep freed memory instead of returning it to the kernel: large tensors come and go each step."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            libc: Any = ctypes.CDLL(None)
            libc.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD: no mmap of its own below 1 GiB
            libc.mallopt(-1, (1 << 31) - 1)  # M_TRIM_THRESHOLD: never trim
