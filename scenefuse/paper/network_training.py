"""Training depth and pose networks on the photos of one object; a killed training resumes where it stopped."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from scenefuse.core.checkpoints import (
    checkpointed,
    learning_rate_factor,
    load_checkpoint,
    require_finite,
    step_generator,
)
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import quantity, threads
from scenefuse.paper.depth_photos import DepthPhotos
from scenefuse.paper.monodepth import (
    DepthNetwork,
    depth_from_disparity,
    minimum_reprojection,
    photometric_error,
    warp,
)

# Highest rate of Adam. Gradients are clipped, since single photos can be off by much.
LEARNING_RATE = 1e-3
MAX_GRADIENT = 1.0
# Weight of equation (5) as in Monodepth2; the other losses have 1.
SMOOTHNESS_WEIGHT = 1e-3
# Relative depth errors are squared below this.
SQUARED_ERROR = 0.005

# The losses of (B,) chosen photos at a step, by name; the generator draws what is random.
Objective = Callable[[Tensor, int, torch.Generator], dict[str, Tensor]]


@dataclass(frozen=True)
class Recipe:
    """How long networks are trained.

    Attributes:
        epochs: each shows every photo once.
        warmup_epochs: epochs of linear rise of the learning rate before the cosine.
        batch_photos: target photos per step; an epoch's last batch holds the rest.
    """

    epochs: int
    warmup_epochs: int = 2
    batch_photos: int = 24

    def steps(self, photos: DepthPhotos) -> int:
        """Steps of the whole training."""
        return self.epochs * -(-int(photos.trained.sum()) // self.batch_photos)


def prepare_torch(seed: int) -> torch.device:
    """Set this stage's threads and the seed of the weights; the device to train on, CUDA where it is."""
    use_threads(threads())
    torch.manual_seed(seed)
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def optimise(
    networks: dict[str, nn.Module],
    photos: DepthPhotos,
    losses_of: Objective,
    recipe: Recipe,
    checkpoint: Path,
    seed: int,
) -> list[dict[str, float]]:
    """Train networks in place by Adam, with warm-up and cosine, and return one row of mean losses per epoch.

    Batches depend on the seed and the step only, so a resumed run equals an uninterrupted one.

    Raises:
        StageError: the training diverged.
    """
    batches = _batches(np.flatnonzero(photos.trained), recipe, seed)
    steps, warmup = len(batches), len(batches) * recipe.warmup_epochs / max(recipe.epochs, 1)
    parameters = [weight for network in networks.values() for weight in network.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=LEARNING_RATE)
    losses: list[dict[str, float]] = []

    def state() -> dict[str, Any]:
        weights = {name: network.state_dict() for name, network in networks.items()}
        return weights | {"optimizer": optimizer.state_dict(), "losses": losses}

    saved = load_checkpoint(checkpoint, like=state())
    if saved is not None:
        for name, network in networks.items():
            network.load_state_dict(saved[name])
        optimizer.load_state_dict(saved["optimizer"])
        losses.extend(saved["losses"])
        print(f"resuming at step {len(losses)} from {checkpoint}", flush=True)
    with checkpointed(checkpoint, state) as step_done:
        for step in range(len(losses), steps):
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * learning_rate_factor(step, steps, warmup)
            parts = losses_of(torch.as_tensor(batches[step]), step, step_generator(seed, step))
            losses.append({name: float(value.detach()) for name, value in parts.items()})
            require_finite(losses[-1])  # the gradient of sampling at a NaN would end the process without a word
            optimizer.zero_grad(set_to_none=True)
            weight = {"smoothness": SMOOTHNESS_WEIGHT}
            torch.stack([weight.get(name, 1.0) * loss for name, loss in parts.items()]).sum().backward()
            for network in networks.values():
                torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT)
            optimizer.step()
            if (step + 1) % 10 == 0:
                print(f"step {step + 1}: {' '.join(f'{k} {v:.4f}' for k, v in losses[-1].items())}", flush=True)
            step_done(step + 1)
    return _by_epoch(losses, recipe.epochs)


@torch.no_grad()
def predict(network: DepthNetwork, photos: DepthPhotos) -> Tensor:
    """(V, 1, H, W) depth of all photos, held-out ones too."""
    return depth_from_disparity(torch.cat([network(part) for part in photos.images.split(8)]))


def loss_quantities(losses: list[dict[str, float]]) -> dict[str, Any]:
    """First and last epoch's mean of each loss."""
    return {
        f"{name}_loss_{when}": quantity(row[name], "1")
        for name in (losses[0] if losses else {})
        for when, row in (("first", losses[0]), ("last", losses[-1]))
    }


class PhotoScale:
    """The photos at one size, and the error of every pair of photos as they are (for the auto-mask)."""

    def __init__(self, photos: DepthPhotos, shrink: int) -> None:
        self.shrink = shrink
        self.images = self.pool(photos.images)
        self.masks = (self.pool(photos.masks) > 0.5).to(photos.masks.dtype)
        self.intrinsics = photos.intrinsics.clone()
        self.intrinsics[:, :2] /= shrink
        self.unmoved = torch.cat([photometric_error(self.images, self.images[of]) for of in photos.sources.T], 1)

    def pool(self, maps: Tensor) -> Tensor:
        """Maps at this size."""
        return functional.avg_pool2d(maps, self.shrink) if self.shrink > 1 else maps


def reprojection_error(
    scale: PhotoScale, chosen: Tensor, sources: Tensor, depth: Tensor, moves: Tensor, unmoved: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Minimum reprojection error of (B,) targets over (B, S) sources, and where it counts.

    `unmoved` is the (B, S, H, W) error of the sources as they are, for the auto-mask; None for no auto-mask.
    """
    count = sources.shape[1]
    depth = scale.pool(depth).repeat_interleave(count, 0)
    targets, others = chosen.repeat_interleave(count), sources.reshape(-1)
    warped, valid = warp(
        scale.images[others], depth, moves.reshape(-1, 4, 4), scale.intrinsics[targets], scale.intrinsics[others]
    )
    errors = photometric_error(scale.images[targets], warped)
    shape = (len(chosen), count, *errors.shape[2:])
    smallest, counts = minimum_reprojection(errors.view(shape), valid.view(shape), unmoved)
    return smallest, counts & (scale.masks[chosen] > 0)


def huber(relative: Tensor) -> Tensor:
    """Absolute error, squared below SQUARED_ERROR."""
    nothing = torch.zeros_like(relative)
    return functional.huber_loss(relative, nothing, reduction="none", delta=SQUARED_ERROR) / SQUARED_ERROR


def _batches(photos: NDArray[np.int64], recipe: Recipe, seed: int) -> list[NDArray[np.int64]]:
    """Indices of the photos of each step: every epoch shows all of them in a new order."""
    rng = np.random.default_rng(seed)
    ends = np.arange(recipe.batch_photos, len(photos), recipe.batch_photos)
    return [batch for _ in range(recipe.epochs) for batch in np.split(rng.permutation(photos), ends)]


def _by_epoch(losses: list[dict[str, float]], epochs: int) -> list[dict[str, float]]:
    groups = [g for g in np.array_split(np.arange(len(losses)), max(epochs, 1)) if len(g)]
    return [{name: float(np.mean([losses[i][name] for i in group])) for name in losses[0]} for group in groups]
