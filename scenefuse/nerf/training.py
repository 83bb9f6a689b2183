"""Training of the depth-guided NeRF: one loop, resumable, the same result for the same seed.

Everything lies in the frame of the unit cube ("nerf"): lengths and depths are shares of the cube's side.
"""

import contextlib
import ctypes
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from scenefuse.core.checkpoints import Progress, State, checkpointed, learning_rate_factor, load_checkpoint
from scenefuse.core.stage import setting
from scenefuse.nerf import losses
from scenefuse.nerf.appearance import Appearance, find_appearance, squared_radius
from scenefuse.nerf.field import EdgeRates, Field, FieldSettings, coarse_to_fine
from scenefuse.nerf.losses import LossWeights
from scenefuse.nerf.occupancy import Occupancy, updated
from scenefuse.nerf.pose_refinement import corrected
from scenefuse.nerf.rays import PhotoTensors, PixelPool, RayBatch, camera_rays, draw_batch, pixel_pool
from scenefuse.nerf.render import UNIFORM_SHARE, Composited, RayPrior, RaySamples, composite, march

# Mueller et al. 2022, section 4 and appendix E.2: Adam's moments and epsilon, and steps between updates of the grid.
ADAM_BETAS, ADAM_EPSILON = (0.9, 0.99), 1e-15
OCCUPANCY_EVERY = 16
# Steps between looks at which rows of the grid show edges.
EDGES_EVERY = 4
# The grid drops no cell in the first tenth of a training: the densities there mean nothing yet.
PRUNE_FROM = 0.1
# Samples fall to their last number by the middle of the training, when the grid knows the surface.
SAMPLES_FALL_UNTIL = 0.5
# The cosine ends at this share of the highest rate, not at nothing: the last steps still learn.
LOWEST_RATE = 0.02
# Poses stay as they are at first: the gradients of an untrained field would scatter them.
POSES_FROM = 0.2
# Gains and vignetting are found at these shares of a training: when depths are good enough to compare photos by, and
# again when they are better. A warm training finds them at its start too.
APPEARANCE_AT = (0.15, 0.4)
# Where a prior expects the surface, this share of a ray's samples lies within this distance of it, as shipped.
PRIOR_SHARE, PRIOR_HALF_WIDTH = 0.6, 0.04
# A step's random numbers come from a seed of their own, so that a resumed training draws the same ones.
SEED_STRIDE = 1_000_003


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
    samples_first: int = 32
    """Samples per ray at the start."""
    samples_last: int = 16
    """Samples per ray from the middle of the training on."""
    coarse_until: float = 0.3
    """Share of the steps after which all levels are open (method N9)."""
    edge_boost: float = 1.0
    """Gradients of fine levels are multiplied by 1 + this at edges; Adam divides most of it out again (method N9)."""
    edge_rate: float = 0.0
    """The paper's adaptive grid: steps of fine levels are up to 1 + this times as long at edges (method N9)."""
    order_of_all: bool = False
    """Whether the ranking loss takes all depths of the earlier stage, and not only those of the prior that photos and
    views confirm: where the absolute loss has the same, there is little left to rank (method N3)."""
    prior_of_all: bool = False
    """Whether the absolute loss takes all depths of the earlier stage as well, as the paper does (method N4)."""
    prior_share: float = PRIOR_SHARE
    """Where a prior expects the surface, at most this share of a ray's samples lies near it."""
    turned_share: float = 0.25
    """This share of the rays has its colours asked for from a random direction: they depend on the direction where the
    photos show that they do, and elsewhere are what all photos agree on (method N8)."""
    appearance: bool = True
    """Whether gains and vignetting of the photos are found (method N15), and blurred photos count less."""
    pose_learning_rate: float = 0.0
    """The paper's pose refinement: learning rate of the camera poses, 0 keeps them (method N11)."""
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
    """All that is trained: the field, its occupancy grid, the photos' appearance, and corrections (V, 6) of their poses
    (rotation, centre)."""

    field: Field
    occupancy: Occupancy
    appearance: Appearance
    pose: Tensor

    def state(self) -> State:
        """As plain tensors on the CPU, for a file that any machine can read."""
        return {
            "settings": asdict(self.field.settings),
            "field": {name: tensor.cpu() for name, tensor in self.field.state_dict().items()},
            "hull": self.occupancy.hull.cpu(),
            "density": self.occupancy.density.cpu(),
            "occupied": self.occupancy.occupied.cpu(),
            "log_gain": self.appearance.log_gain.cpu(),
            "falloff": self.appearance.falloff.cpu(),
            "pose": self.pose.detach().cpu(),
        }


def new_nerf(settings: FieldSettings, hull: Tensor, photos: int, seed: int, device: str) -> Nerf:
    """An untrained NeRF in a hull (G, G, G), for a number of training photos."""
    field = Field(settings, torch.Generator().manual_seed(seed)).to(device)
    looks = Appearance.none(photos, device)
    return Nerf(field, Occupancy.from_hull(hull.to(device)), looks, torch.zeros(photos, 6, device=device))


def go_on_from(nerf: Nerf, earlier: State) -> None:
    """Take over the field and the densities of an earlier stage (`Nerf.state`); all of the new hull is occupied."""
    nerf.field.load_state_dict(earlier["field"])
    nerf.field.level_weight.fill_(1.0)
    hull = nerf.occupancy.hull
    nerf.occupancy = Occupancy(hull, earlier["density"].to(hull.device), hull)


@dataclass(frozen=True)
class Training:
    """What a training works on, the same at every step.

    Attributes:
        photos: training photos in the unit cube's frame.
        schedule: its length.
        recipe: batches, rates, samples.
        weights: of the losses.
        warm: the NeRF is already trained: all levels are open and the grid is pruned from the start.
        seed: decides every random draw together with the step's number.
        photo_weight: (V,) weight of each photo's colours, or None for 1.
    """

    photos: PhotoTensors
    schedule: Schedule
    recipe: NerfRecipe
    weights: LossWeights
    warm: bool
    seed: int
    photo_weight: Tensor | None = None

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
    pose = nn.Parameter(nerf.pose.clone())
    optimizer = _optimizer(nerf.field, pose)
    rates = EdgeRates.of(nerf.field, training.recipe.edge_rate)
    done = 0

    def state() -> State:
        own = {"optimizer": optimizer.state_dict(), "pose": pose.detach(), "edges": rates.use, "step": done}
        return {"model": nerf.state(), **own}

    saved = load_checkpoint(checkpoint, like=state())
    if saved is not None:
        done = _resume(saved, nerf, optimizer, pose)
        rates.use = saved["edges"].to(rates.use.device)
        report(f"resumed at step {done} of {training.steps}")
    progress = Progress(training.steps, done, report)
    with checkpointed(checkpoint, state) as step_done:
        for step in range(done, training.steps):
            _prepare(nerf, training, step)
            batch = _draw(training, pool, step, nerf.field.table.device)
            terms, samples = _loss_terms(nerf, training, batch, pose, step, rates)
            _descend(nerf.field, optimizer, training, terms, step, rates)
            progress.add(step, {name: float(term.detach()) for name, term in terms.items()}, len(batch.view), samples)
            done = step + 1
            step_done(done)
    nerf.pose = pose.detach().clone()
    return progress.summary()


def _resume(saved: State, nerf: Nerf, optimizer: torch.optim.Optimizer, pose: Tensor) -> int:
    """Put a checkpoint into NeRF, optimiser and poses; the steps that are done."""
    nerf.field.load_state_dict(saved["model"]["field"])
    device = nerf.field.table.device
    nerf.appearance = Appearance(*(saved["model"][name].to(device) for name in ("log_gain", "falloff")))
    nerf.occupancy = Occupancy(*(saved["model"][name].to(device) for name in ("hull", "density", "occupied")))
    optimizer.load_state_dict(saved["optimizer"])
    with torch.no_grad():
        pose.copy_(saved["pose"])
    return int(saved["step"])


def _optimizer(field: Field, pose: nn.Parameter) -> torch.optim.Optimizer:
    """Adam, with a group each for the hash grid, the networks and the poses: each has its own rate."""
    networks = [parameter for name, parameter in field.named_parameters() if name != "table"]
    groups = [{"params": [field.table]}, {"params": networks}, {"params": [pose]}]
    return torch.optim.Adam(groups, betas=ADAM_BETAS, eps=ADAM_EPSILON, fused=True)


def _prepare(nerf: Nerf, training: Training, step: int) -> None:
    """Open levels of the grid, update the occupancy, find the appearance, as far as the step is due for it."""
    progress = step / training.steps
    if not training.warm:
        coarse_to_fine(nerf.field, progress, training.recipe.coarse_until)
    if step % OCCUPANCY_EVERY == 0 and (step or training.warm):
        prune = training.warm or progress > PRUNE_FROM
        nerf.occupancy = updated(nerf.occupancy, nerf.field, training.seed, step, prune)
    due = step in {round(share * training.steps) for share in APPEARANCE_AT} or (step == 0 and training.warm)
    if due and training.recipe.appearance:
        nerf.appearance = find_appearance(nerf.field, nerf.occupancy, training.photos)


def _draw(training: Training, pool: PixelPool, step: int, device: torch.device) -> RayBatch:
    recipe = training.recipe
    batch = draw_batch(training.photos, pool, training.seed, step, recipe.images_per_batch, recipe.rays_per_image)
    return batch.to(device)


def _descend(
    field: Field,
    optimizer: torch.optim.Optimizer,
    training: Training,
    terms: dict[str, Tensor],
    step: int,
    edges: EdgeRates,
) -> None:
    """One step of Adam on the weighted sum of the losses, at this step's rates; gradients are cleared."""
    training.weights.total({name: term for name, term in terms.items() if name != "psnr"}).backward()
    factor = learning_rate_factor(step, training.steps, training.warmup_steps, LOWEST_RATE)
    recipe = training.recipe
    rates = recipe.grid_learning_rate, recipe.learning_rate, recipe.pose_learning_rate
    for group, rate in zip(optimizer.param_groups, rates):
        group["lr"] = rate * factor
    edges.step(field, optimizer)
    optimizer.zero_grad(set_to_none=True)


@dataclass(frozen=True)
class _Rays:
    """R rays of a batch: origin (R, 3), unit direction (R, 3), the prior on them and its confidence (R,) in 0..1, and
    the depth (R,) along them whose order is learned, with its weight (R,)."""

    origin: Tensor
    direction: Tensor
    prior: RayPrior
    confidence: Tensor
    order: Tensor
    order_weight: Tensor


def _loss_terms(
    nerf: Nerf, training: Training, batch: RayBatch, pose: Tensor, step: int, edges: EdgeRates
) -> tuple[dict[str, Tensor], int]:
    """Loss terms of a batch and `psnr` in dB inside the masks, by name, each a scalar; and the number of samples."""
    progress = step / training.steps
    refine = training.recipe.pose_learning_rate > 0 and progress > POSES_FROM
    rays = _rays(training.photos, batch, pose if refine else None, training.recipe.prior_share)
    device = rays.origin.device
    count = _samples_per_ray(training.recipe, progress)
    rng = torch.Generator().manual_seed(training.seed * SEED_STRIDE + step)
    jitter = torch.rand(len(rays.origin), count, generator=rng).to(device)
    background = torch.rand(len(rays.origin), 3, generator=rng).to(device)
    seen_from = _partly_turned(rays.direction, training.recipe.turned_share, rng)
    origin, direction = rays.origin.detach().contiguous(), rays.direction.detach().contiguous()
    drawn = march(origin, direction, nerf.occupancy, jitter, UNIFORM_SHARE, rays.prior)
    sigma, seen = _render(nerf.field, rays, seen_from, drawn, batch, training.recipe.edge_boost)
    if edges.boost and step % EDGES_EVERY == 0:
        x = (origin[drawn.ray, None] + drawn.t[..., None] * direction[drawn.ray, None]).view(-1, 3)
        opacity = (1 - torch.exp(-sigma.detach() * drawn.delta)).view(-1)
        edges.see(nerf.field, x, opacity, batch.edge[drawn.ray].repeat_interleave(count))
    color, psnr = _photometric(nerf.appearance, training, seen, batch, drawn.ray, background)
    terms = {"color": color, **_geometric(training, rays, batch, drawn, sigma, seen), "psnr": psnr}
    return terms, drawn.t.numel()


def _samples_per_ray(recipe: NerfRecipe, progress: float) -> int:
    fallen = min(1, progress / SAMPLES_FALL_UNTIL)
    return round(recipe.samples_first + (recipe.samples_last - recipe.samples_first) * fallen)


def _rays(photos: PhotoTensors, batch: RayBatch, pose: Tensor | None, prior_share: float) -> _Rays:
    """The batch's rays, through cameras corrected by `pose` (V, 6) if it is given, and where their prior lies."""
    device = batch.view.device
    rotation, center = photos.rotation.to(device)[batch.view], photos.center.to(device)[batch.view]
    if pose is not None:
        rotation, center = corrected(rotation, center, pose[batch.view])
    origin, direction, length = camera_rays(photos.intrinsics.to(device)[batch.view], rotation, center, batch.uv)
    confidence = batch.confidence * ((batch.depth > 0) & batch.inside)
    width = torch.full_like(length, PRIOR_HALF_WIDTH).detach()
    prior = RayPrior(batch.depth * length.detach(), width, prior_share * confidence)
    if batch.order is None:
        return _Rays(origin, direction, prior, confidence, prior.distance, confidence)
    ranked = ((batch.order > 0) & batch.inside).float()
    return _Rays(origin, direction, prior, confidence, batch.order * length.detach(), ranked)


def _partly_turned(direction: Tensor, share: float, rng: torch.Generator) -> Tensor:
    """Unit directions (R, 3), a share of them replaced by random ones."""
    if share == 0:
        return direction
    turned = torch.rand(len(direction), 1, generator=rng) < share
    other = torch.nn.functional.normalize(torch.randn(len(direction), 3, generator=rng), dim=1)
    return torch.where(turned.to(direction.device), other.to(direction.device), direction)


def _render(
    field: Field, rays: _Rays, seen_from: Tensor, drawn: RaySamples, batch: RayBatch, edge_boost: float
) -> tuple[Tensor, Composited]:
    """Densities (H, S) of the samples, and what the H rays that have any look like from directions (R, 3)."""
    x = rays.origin[drawn.ray, None] + drawn.t[..., None] * rays.direction[drawn.ray, None]
    boost = None
    if edge_boost > 0:
        boost = (1 + edge_boost * batch.edge[drawn.ray])[:, None].expand(drawn.t.shape).reshape(-1)
    sigma, features = field.geometry(x.view(-1, 3), boost, fine_from=field.settings.levels // 2)
    sigma = sigma.view(drawn.t.shape)
    return sigma, composite(sigma, field.color(features, seen_from[drawn.ray]), drawn.t, drawn.delta)


def _photometric(
    appearance: Appearance, training: Training, seen: Composited, batch: RayBatch, ray: Tensor, background: Tensor
) -> tuple[Tensor, Tensor]:
    """Photometric loss and PSNR of the rays `ray` (H,), both on random colours (R, 3).

    The field's colours are compared as their photo shows them. On a random background a field cannot pass off emptiness
    as colour, so colours teach opacity as well (instant-ngp's training on images with alpha).
    """
    view, inside, matte, shown = batch.view[ray], batch.inside[ray], batch.matte[ray, None], background[ray]
    height, width = training.photos.images.shape[1:3]
    intrinsics = training.photos.intrinsics.to(view.device)[view]
    factor = appearance.factor(view, squared_radius(batch.uv[ray], intrinsics, width, height))
    composed = factor * seen.color + (1 - seen.opacity)[:, None] * shown
    target = matte * batch.color[ray] + (1 - matte) * shown
    error = ((composed.detach() - target) ** 2)[inside].mean().clamp(min=1e-10)
    weight = inside if training.photo_weight is None else inside * training.photo_weight.to(view.device)[view]
    return losses.color_loss(composed, target, weight), -10 * torch.log10(error)


def _geometric(
    training: Training, rays: _Rays, batch: RayBatch, drawn: RaySamples, sigma: Tensor, seen: Composited
) -> dict[str, Tensor]:
    """The losses of depth, mask and density that have a weight (method N2 to N5)."""
    weights, ray = training.weights, drawn.ray
    distance = seen.moment / seen.opacity.clamp(min=1e-3)
    known, confidence = rays.prior.distance, rays.confidence
    terms = {}
    if weights.depth_weight > 0:
        terms["depth"] = losses.depth_loss(distance, seen.opacity, known[ray], confidence[ray])
    if weights.rank_weight > 0:
        nothing = torch.zeros_like(known)
        far, opaque = (nothing.index_put((ray,), part) for part in (distance, seen.opacity))
        apart_px = losses.RANK_APART * training.photos.images.shape[2]
        images = training.recipe.images_per_batch
        terms["rank"] = losses.rank_loss(far, opaque, rays.order, rays.order_weight, batch.uv, images, apart_px)
    if weights.mask_weight > 0:
        terms["mask"] = losses.mask_loss(seen.opacity, batch.matte[ray])
    if weights.sparsity_weight > 0:
        terms["sparsity"] = losses.sparsity_loss(sigma, drawn.delta, batch.inside[ray])
    if weights.distortion_weight > 0:
        terms["distortion"] = losses.distortion_loss(seen.distortion)
    return terms


def keep_memory() -> None:
    """Let glibc keep freed memory instead of returning it to the kernel: large tensors come and go each step."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            libc: Any = ctypes.CDLL(None)
            libc.mallopt(-3, 1 << 30)  # M_MMAP_THRESHOLD: no mmap of its own below 1 GiB
            libc.mallopt(-1, (1 << 31) - 1)  # M_TRIM_THRESHOLD: never trim
