"""Training the depth and pose networks on the photos of one object; a killed training resumes where it stopped."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from scenefuse.core.checkpoints import checkpointed, learning_rate_factor, load_checkpoint, require_finite
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError, quantity, threads
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.networks import DepthNetwork, depth_from_disparity
from scenefuse.nerf.prior.pose_network import PoseNetwork, pose_error, small_photos
from scenefuse.nerf.prior.self_supervision import (
    masked_mean,
    minimum_reprojection,
    photometric_error,
    sample,
    smoothness,
    warp,
)

# Highest rate of Adam. Gradients are clipped, since single photos can be off by much.
LEARNING_RATE = 1e-3
MAX_GRADIENT = 1.0
SOURCES_PER_STEP = 3
# Weight of equation (5) as in Monodepth2; the other losses have 1.
SMOOTHNESS_WEIGHT = 1e-3
# Relative depth errors count in full from here, and no more beyond.
SMALL_ERROR, LARGE_ERROR = 0.005, 0.1
# Share of a half-size pixel that is object, for it to count.
SHARE_OF_PIXEL = 0.75
PRINT_EVERY = 10
# Photos that go through the network at once when nothing is trained.
PHOTOS_AT_ONCE = 8


@dataclass(frozen=True)
class Networks:
    """The two networks that are trained together."""

    depth: DepthNetwork
    pose: PoseNetwork

    def state(self) -> dict[str, Any]:
        """Weights of both."""
        return {"depth": self.depth.state_dict(), "pose": self.pose.state_dict()}

    def load(self, state: dict[str, Any]) -> None:
        """Take the weights of `state`."""
        self.depth.load_state_dict(state["depth"])
        self.pose.load_state_dict(state["pose"])


# The losses of (B,) chosen photos at a step, by name; the generator draws what is random.
Objective = Callable[[Tensor, int, torch.Generator], dict[str, Tensor]]


@dataclass(frozen=True)
class Recipe:
    """How long the networks are trained; the stages fill it from their own settings.

    Attributes:
        epochs: each shows every photo once.
        warmup_epochs: epochs of linear rise of the learning rate before the cosine.
        batch_photos: target photos per step.
        coarse_share: share of the steps, the first ones, that compare photos at half size.
        even: whether an epoch's batches are as large as each other, not all but the last one full.
    """

    epochs: int
    warmup_epochs: int
    batch_photos: int
    coarse_share: float
    even: bool = True

    def steps(self, photos: DepthPhotos) -> int:
        """Steps of the whole training."""
        return self.epochs * -(-int(photos.trained.sum()) // self.batch_photos)


@dataclass(frozen=True)
class Supervision:
    """The tensors a training run works on.

    Attributes:
        inputs: (V, C, H, W) network inputs.
        first: (V, 1, H, W) first disparity.
        target: (V, 1, H, W) depth to learn, or None.
        target_weight: (V, 1, H, W) weight of each target pixel, 0 where there is none; None without a target.
        large_error: relative errors against the target count no more beyond: only an outlier can be so far off, where
            the depth is nearly right from the beginning.
    """

    inputs: Tensor
    first: Tensor
    target: Tensor | None = None
    target_weight: Tensor | None = None
    large_error: float = LARGE_ERROR


def prepare_torch(seed: int) -> torch.device:
    """Set this stage's threads and the seed of the weights; the device to train on, CUDA where it is."""
    use_threads(threads())
    torch.manual_seed(seed)
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def new_networks(channels: int, photos: DepthPhotos) -> Networks:
    """Untrained networks on the photos' device; the pose network counts in typical distances to the object."""
    device = photos.images.device
    return Networks(DepthNetwork(channels).to(device), PoseNetwork((photos.near * photos.far) ** 0.5).to(device))


def train_networks(
    networks: Networks, photos: DepthPhotos, supervision: Supervision, recipe: Recipe, checkpoint: Path, seed: int
) -> list[dict[str, float]]:
    """Train both networks in place on photos of known poses and return one row of mean losses per epoch.

    Batches and sources depend on the seed and the step only, so a resumed run equals an uninterrupted one.

    Raises:
        StageError: the training diverged.
    """
    points, weights = _padded(photos)
    scales = [PhotoScale(photos, shrink) for shrink in (2, 1)]
    coarse = recipe.coarse_share * recipe.steps(photos)

    def losses(chosen: Tensor, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        scale = scales[0] if step < coarse else scales[1]
        parts = _losses(networks, photos, supervision, scale, chosen, generator)
        parts["anchor"] = _anchor(parts.pop("depth"), points[chosen], weights[chosen])
        return parts

    return optimise(networks, photos, losses, recipe, checkpoint, seed)


def optimise(
    networks: Networks, photos: DepthPhotos, losses_of: Objective, recipe: Recipe, checkpoint: Path, seed: int
) -> list[dict[str, float]]:
    """Minimise an objective by Adam, with warm-up and cosine; arguments, result and errors as of `train_networks`."""
    batches = _batches(np.flatnonzero(photos.trained), recipe, seed)
    steps, warmup = len(batches), len(batches) * recipe.warmup_epochs / max(recipe.epochs, 1)
    parameters = [*networks.depth.parameters(), *networks.pose.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=LEARNING_RATE)
    losses: list[dict[str, float]] = []

    def state() -> dict[str, Any]:
        return networks.state() | {"optimizer": optimizer.state_dict(), "losses": losses}

    saved = load_checkpoint(checkpoint, like=state())
    if saved is not None:
        networks.load(saved)
        optimizer.load_state_dict(saved["optimizer"])
        losses.extend(saved["losses"])
        print(f"resuming at step {len(losses)} from {checkpoint}", flush=True)
    with checkpointed(checkpoint, state) as step_done:
        for step in range(len(losses), steps):
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * learning_rate_factor(step, steps, warmup)
            generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
            parts = losses_of(torch.as_tensor(batches[step]), step, generator)
            losses.append({name: float(value.detach()) for name, value in parts.items()})
            require_finite(losses[-1])  # the gradient of sampling at a NaN would end the process without a word
            optimizer.zero_grad(set_to_none=True)
            _total(parts).backward()
            for network in (networks.depth, networks.pose):
                torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT)
            optimizer.step()
            if (step + 1) % PRINT_EVERY == 0:
                print(f"step {step + 1}: {' '.join(f'{k} {v:.4f}' for k, v in losses[-1].items())}", flush=True)
            step_done(step + 1)
    return _by_epoch(losses, recipe.epochs)


@torch.no_grad()
def predict(network: DepthNetwork, photos: DepthPhotos, supervision: Supervision) -> Tensor:
    """(V, 1, H, W) depth of all photos, held-out ones too."""
    parts = zip(supervision.inputs.split(PHOTOS_AT_ONCE), supervision.first.split(PHOTOS_AT_ONCE))
    return depth_from_disparity(torch.cat([network(x, d) for x, d in parts]), photos.near, photos.far)


def loss_quantities(losses: list[dict[str, float]]) -> dict[str, Any]:
    """First and last epoch's mean of each loss."""
    return {
        f"{name}_loss_{when}": quantity(row[name], "1")
        for name in (losses[0] if losses else {})
        for when, row in (("first", losses[0]), ("last", losses[-1]))
    }


def save_networks(path: Path, networks: Networks, settings: dict[str, Any]) -> None:
    """What stage 3 continues from."""
    torch.save(networks.state() | {"settings": settings}, path)


def load_networks(path: Path) -> dict[str, Any]:
    """What `save_networks` wrote: `depth` and `pose` for `Networks.load`, and `settings`.

    Raises:
        StageError: the file is missing or holds something else.
    """
    if not path.is_file():
        raise StageError(f"{path} does not exist; run stage 1 first")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a truncated file raises any of half a dozen
        why = " ".join(str(error).split())[:200]
        raise StageError(f"{path} cannot be read ({why}); delete it and run stage 1 again") from None
    if not {"depth", "pose", "settings"} <= set(state):
        raise StageError(f"{path} holds no networks of stage 1; delete it and run stage 1 again")
    return state


class PhotoScale:
    """The photos at one size, and the error of every pair of photos as they are (for the auto-mask)."""

    def __init__(self, photos: DepthPhotos, shrink: int) -> None:
        self.shrink = shrink
        self.images = self.pool(photos.images)
        self.masks = (self.pool(photos.masks) > SHARE_OF_PIXEL).to(photos.masks.dtype)
        self.intrinsics = photos.intrinsics.clone()
        self.intrinsics[:, :2] /= shrink
        self.unmoved = torch.cat([photometric_error(self.images, self.images[of]) for of in photos.sources.T], 1)

    def pool(self, maps: Tensor) -> Tensor:
        """Maps at this size."""
        return functional.avg_pool2d(maps, self.shrink) if self.shrink > 1 else maps


def _losses(
    networks: Networks,
    photos: DepthPhotos,
    supervision: Supervision,
    scale: PhotoScale,
    chosen: Tensor,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    """All losses of (B,) chosen photos but the one at SfM points, and their (B, 1, H, W) depth."""
    disparity = networks.depth(supervision.inputs[chosen], supervision.first[chosen])
    depth = depth_from_disparity(disparity, photos.near, photos.far)
    available = photos.sources.shape[1]
    columns = torch.randperm(available, generator=generator)[: min(SOURCES_PER_STEP, available)].sort().values
    sources = photos.sources[chosen][:, columns]
    moves = photos.source_from_target(chosen[:, None], sources)
    unmoved = scale.unmoved[chosen][:, columns]
    photometric, counts = reprojection_error(scale, chosen, sources, depth, moves, unmoved)
    small, one = small_photos(photos), sources[:, :1]
    found = networks.pose(small[chosen], small[one[:, 0]])[:, None]
    error, seen = reprojection_error(scale, chosen, one, depth.detach(), found, None)
    return {
        "photometric": masked_mean(photometric, counts),
        "smoothness": smoothness(disparity, photos.images[chosen], photos.masks[chosen]),
        "target": error_against_target(depth, supervision, chosen, photos.near),
        "pose": masked_mean(error, seen) + pose_error(found[:, 0], moves[:, 0], networks.pose.unit),
        "depth": depth,
    }


def _total(parts: dict[str, Tensor]) -> Tensor:
    """The loss that is minimised."""
    total = parts["photometric"] + SMOOTHNESS_WEIGHT * parts["smoothness"]
    for name in ("anchor", "target", "pose"):
        total = total + parts[name] if name in parts else total
    return total


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


def error_against_target(depth: Tensor, supervision: Supervision, chosen: Tensor, near: float) -> Tensor:
    """Huber loss on the relative depth error against the target maps; zero without them."""
    if supervision.target is None or supervision.target_weight is None:
        return depth.new_zeros(())
    relative = depth / supervision.target[chosen].clamp_min(near) - 1.0
    weight = supervision.target_weight[chosen]
    return (_huber(relative, supervision.large_error) * weight).sum() / weight.sum().clamp_min(1.0)


def _anchor(depth: Tensor, points: Tensor, weights: Tensor) -> Tensor:
    """Huber loss on the relative depth error at SfM points."""
    relative = sample(depth, points[..., :2])[:, 0] / points[..., 2] - 1.0
    return (_huber(relative) * weights).sum() / weights.sum().clamp_min(1.0)


def _huber(relative: Tensor, large: float = LARGE_ERROR) -> Tensor:
    """Absolute error, rounded below SMALL_ERROR and flat above `large`."""
    size = relative.abs().clamp_max(large)
    return torch.where(size < SMALL_ERROR, size**2 / (2 * SMALL_ERROR), size - SMALL_ERROR / 2)


def _padded(photos: DepthPhotos) -> tuple[Tensor, Tensor]:
    """(V, N, 3) SfM points of all photos and (V, N) weights, zero for padding."""
    count, most = len(photos.points), max(1, *(len(p) for p in photos.points))
    points, weights = np.ones((count, most, 3), np.float32), np.zeros((count, most), np.float32)
    for index, p in enumerate(photos.points):
        points[index, : len(p)], weights[index, : len(p)] = p, 1.0
    device = photos.images.device
    return torch.from_numpy(points).to(device), torch.from_numpy(weights).to(device)


def _batches(photos: NDArray[np.int64], recipe: Recipe, seed: int) -> list[NDArray[np.int64]]:
    """Indices of the photos of each step: every epoch shows all of them in a new order."""
    rng = np.random.default_rng(seed)
    number = -(-len(photos) // recipe.batch_photos)
    parts = number if recipe.even else recipe.batch_photos * np.arange(1, number)
    return [batch for _ in range(recipe.epochs) for batch in np.array_split(rng.permutation(photos), parts)]


def _by_epoch(losses: list[dict[str, float]], epochs: int) -> list[dict[str, float]]:
    groups = [g for g in np.array_split(np.arange(len(losses)), max(epochs, 1)) if len(g)]
    return [{name: float(np.mean([losses[i][name] for i in group])) for name in losses[0]} for group in groups]
