"""Training the depth and pose networks on the photos of one object, with checkpoints that survive a kill."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from scenefuse.depth.inputs import Frames
from scenefuse.depth.networks import DepthNetwork, PoseNetwork, depth_from_disparity
from scenefuse.depth.self_supervision import (
    masked_mean,
    minimum_reprojection,
    photometric_error,
    sample,
    smoothness,
    warp,
)
from scenefuse.stage import atomic_file

SOURCES_PER_STEP = 3
CHECKPOINT_EVERY = 10


@dataclass(frozen=True)
class Recipe:
    """How the networks are trained; the stages fill it from their own settings.

    Attributes:
        epochs: passes of the schedule.
        passes_per_epoch: how often an epoch shows every photo.
        batch_frames: target photos per step.
        learning_rate: the schedule's maximum.
        warmup_epochs: epochs of linear rise before the cosine.
        ssim_weight: alpha of equation (2).
        smoothness_weight: weight of equation (5).
        anchor_weight: weight of the relative depth error at SfM points.
        target_weight: weight of the relative depth error against a target map.
        coarse_share: share of the steps that compare photos at half size.
    """

    epochs: int
    passes_per_epoch: int
    batch_frames: int
    learning_rate: float
    warmup_epochs: int
    ssim_weight: float
    smoothness_weight: float
    anchor_weight: float
    target_weight: float
    coarse_share: float


@dataclass(frozen=True)
class Supervision:
    """The tensors a training run works on.

    Attributes:
        inputs: (V, C, H, W) network inputs.
        first: (V, 1, H, W) first disparity.
        target: (V, 1, H, W) depth to learn, or None.
        target_weight: (V, 1, H, W) weight of each target pixel, 0 where there is none; None without a target.
    """

    inputs: Tensor
    first: Tensor
    target: Tensor | None = None
    target_weight: Tensor | None = None


def train_networks(
    depth_network: DepthNetwork,
    pose_network: PoseNetwork,
    frames: Frames,
    supervision: Supervision,
    recipe: Recipe,
    checkpoint: Path,
    seed: int,
) -> list[dict[str, float]]:
    """Train both networks in place and return one row of mean losses per epoch.

    Batches and sources depend on the seed and the step only, so a resumed run equals an uninterrupted one.
    """
    batches = _batches(np.flatnonzero(frames.trained), recipe, seed)
    optimizer = torch.optim.Adam([*depth_network.parameters(), *pose_network.parameters()], lr=recipe.learning_rate)
    steps = len(batches)
    warmup = steps * recipe.warmup_epochs / max(recipe.epochs, 1)
    points, weights = _padded(frames)
    scales = [_Scale(frames, recipe.ssim_weight, shrink) for shrink in (2, 1)]
    losses: list[dict[str, float]] = []
    start = _resume(checkpoint, depth_network, pose_network, optimizer, losses)
    with _saved_on_exit(checkpoint, depth_network, pose_network, optimizer, losses) as guard:
        for step in range(start, steps):
            for group in optimizer.param_groups:
                group["lr"] = recipe.learning_rate * warmup_then_cosine(step, steps, warmup)
            scale = scales[0] if step < recipe.coarse_share * steps else scales[1]
            chosen = torch.as_tensor(batches[step])
            generator = torch.Generator().manual_seed(seed * 1_000_003 + step)
            parts = _losses(depth_network, pose_network, frames, supervision, recipe, scale, chosen, generator)
            parts["anchor"] = _anchor(parts.pop("depth"), points[chosen], weights[chosen])
            total = (
                parts["photometric"]
                + recipe.smoothness_weight * parts["smoothness"]
                + recipe.anchor_weight * parts["anchor"]
                + recipe.target_weight * parts["target"]
                + parts["pose"]
            )
            optimizer.zero_grad(set_to_none=True)
            total.backward()
            torch.nn.utils.clip_grad_norm_(depth_network.parameters(), 1.0)
            torch.nn.utils.clip_grad_norm_(pose_network.parameters(), 1.0)
            with guard(step + 1):
                optimizer.step()
                losses.append({name: float(value.detach()) for name, value in parts.items()})
    return _by_epoch(losses, recipe.epochs)


@torch.no_grad()
def predict(network: DepthNetwork, frames: Frames, inputs: Tensor, first: Tensor) -> Tensor:
    """(V, 1, H, W) depth of all photos, held-out ones too."""
    disparity = torch.cat([network(x, d) for x, d in zip(inputs.split(8), first.split(8))])
    return depth_from_disparity(disparity, frames.near, frames.far)


def small_photos(frames: Frames) -> Tensor:
    """What the pose network sees: the photos at half size, unless they are tiny."""
    return functional.avg_pool2d(frames.images, 2) if min(frames.images.shape[2:]) > 64 else frames.images


def warmup_then_cosine(step: int, steps: int, warmup: float) -> float:
    """Share of the maximum learning rate: a linear rise over `warmup` steps, then half a cosine down to zero."""
    if step < warmup:
        return (step + 1) / (warmup + 1)
    return 0.5 * (1.0 + float(np.cos(np.pi * (step - warmup) / max(steps - warmup, 1))))


def key_of(*parts: object) -> str:
    """Sixteen hex digits that change when any part changes: arrays and tensors by content, others by their repr."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Tensor):
            part = part.detach().cpu().numpy()
        digest.update(np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
    return digest.hexdigest()[:16]


class _Scale:
    """The photos at one size, and the error of every pair of photos as they are (for the auto-mask)."""

    def __init__(self, frames: Frames, ssim_weight: float, shrink: int) -> None:
        self.shrink = shrink
        self.images = self.pool(frames.images)
        self.masks = (self.pool(frames.masks) > 0.75).to(frames.masks.dtype)
        self.intrinsics = frames.intrinsics.clone()
        self.intrinsics[:, :2] /= shrink
        self.unmoved = torch.cat(
            [photometric_error(self.images, self.images[of], ssim_weight) for of in frames.sources.T], 1
        )

    def pool(self, maps: Tensor) -> Tensor:
        """Maps at this size."""
        return functional.avg_pool2d(maps, self.shrink) if self.shrink > 1 else maps


def _losses(
    depth_network: DepthNetwork,
    pose_network: PoseNetwork,
    frames: Frames,
    supervision: Supervision,
    recipe: Recipe,
    scale: _Scale,
    chosen: Tensor,
    generator: torch.Generator,
) -> dict[str, Tensor]:
    disparity = depth_network(supervision.inputs[chosen], supervision.first[chosen])
    depth = depth_from_disparity(disparity, frames.near, frames.far)
    available = frames.sources.shape[1]
    columns = torch.randperm(available, generator=generator)[: min(SOURCES_PER_STEP, available)].sort().values
    sources = frames.sources[chosen][:, columns]
    small = small_photos(frames)
    first_pair = frames.sources[chosen, int(columns[0])]
    moves = frames.source_from_target(chosen[:, None], sources)
    photometric, counts = _reprojection(frames, recipe, scale, chosen, sources, columns, depth, moves)
    guess = pose_network(small[chosen], small[first_pair])[:, None]
    error, seen = _reprojection(
        frames, recipe, scale, chosen, first_pair[:, None], columns[:1], depth.detach(), guess, auto_mask=False
    )
    pose_loss = masked_mean(error, seen) + _pose_error(guess[:, 0], moves[:, 0], pose_network.unit)
    mask = frames.masks[chosen]
    parts = {
        "photometric": masked_mean(photometric, counts),
        "smoothness": smoothness(disparity, frames.images[chosen], mask),
        "target": depth.new_zeros(()),
        "pose": pose_loss,
        "depth": depth,
    }
    if supervision.target is not None and supervision.target_weight is not None:
        relative = depth / supervision.target[chosen].clamp_min(frames.near) - 1.0
        weight = supervision.target_weight[chosen]
        parts["target"] = (_huber(relative) * weight).sum() / weight.sum().clamp_min(1.0)
    return parts


def _reprojection(
    frames: Frames,
    recipe: Recipe,
    scale: _Scale,
    chosen: Tensor,
    sources: Tensor,
    columns: Tensor,
    depth: Tensor,
    moves: Tensor,
    auto_mask: bool = True,
) -> tuple[Tensor, Tensor]:
    """Minimum reprojection error of (B,) targets over (B, S) sources, and where it counts."""
    count = sources.shape[1]
    depth = scale.pool(depth).repeat_interleave(count, 0)
    targets, others = chosen.repeat_interleave(count), sources.reshape(-1)
    warped, valid = warp(
        scale.images[others], depth, moves.reshape(-1, 4, 4), scale.intrinsics[targets], scale.intrinsics[others]
    )
    errors = photometric_error(scale.images[targets], warped, recipe.ssim_weight)
    shape = (len(chosen), count, *errors.shape[2:])
    unmoved = scale.unmoved[chosen][:, columns] if auto_mask else None
    smallest, counts = minimum_reprojection(errors.view(shape), valid.view(shape), unmoved)
    return smallest, counts & (scale.masks[chosen] > 0)


def _pose_error(found: Tensor, known: Tensor, unit: float) -> Tensor:
    """How far (B, 4, 4) relative poses are from SfM's.

    Photometric error alone is flat between views as far apart as an orbit's photos, and teaches the network nothing.
    """
    rotation = (found[:, :3, :3] - known[:, :3, :3]).abs().sum((1, 2))
    translation = (found[:, :3, 3] - known[:, :3, 3]).abs().sum(1) / unit
    return (rotation + translation).mean()


def _anchor(depth: Tensor, points: Tensor, weights: Tensor) -> Tensor:
    """Huber loss on the relative depth error at SfM points."""
    relative = sample(depth, points[..., :2])[:, 0] / points[..., 2] - 1.0
    return (_huber(relative) * weights).sum() / weights.sum().clamp_min(1.0)


def _huber(relative: Tensor) -> Tensor:
    """Absolute error, rounded below 0.5 % and flat-tailed above 10 %, where only an outlier can be the reason."""
    size = relative.abs().clamp_max(0.1)
    return torch.where(size < 0.005, size**2 / 0.01, size - 0.0025)


def _padded(frames: Frames) -> tuple[Tensor, Tensor]:
    """(V, N, 3) SfM points of all photos and (V, N) weights, zero for padding."""
    most = max(1, *(len(p) for p in frames.points))
    points, weights = (
        np.ones((len(frames.points), most, 3), np.float32),
        np.zeros((len(frames.points), most), np.float32),
    )
    for index, p in enumerate(frames.points):
        points[index, : len(p)], weights[index, : len(p)] = p, 1.0
    device = frames.images.device
    return torch.from_numpy(points).to(device), torch.from_numpy(weights).to(device)


def _batches(photos: np.ndarray, recipe: Recipe, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    batches = []
    for _ in range(recipe.epochs):
        order = np.concatenate([rng.permutation(photos) for _ in range(recipe.passes_per_epoch)])
        batches += np.array_split(order, -(-len(order) // recipe.batch_frames))
    return batches


def _by_epoch(losses: list[dict[str, float]], epochs: int) -> list[dict[str, float]]:
    groups = [g for g in np.array_split(np.arange(len(losses)), max(epochs, 1)) if len(g)]
    return [{name: float(np.mean([losses[i][name] for i in group])) for name in losses[0]} for group in groups]


def _resume(
    checkpoint: Path, depth: DepthNetwork, pose: PoseNetwork, optimizer: torch.optim.Optimizer, losses: list
) -> int:
    if not checkpoint.is_file():
        return 0
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    depth.load_state_dict(state["depth"])
    pose.load_state_dict(state["pose"])
    optimizer.load_state_dict(state["optimizer"])
    losses.extend(state["losses"])
    print(f"resuming at step {len(losses)} from {checkpoint}", flush=True)
    return len(losses)


@contextmanager
def _saved_on_exit(
    checkpoint: Path, depth: DepthNetwork, pose: PoseNetwork, optimizer: torch.optim.Optimizer, losses: list
) -> Iterator:
    """Save every few steps, and when the process is told to stop; never in the middle of an update."""
    whole = True

    def save() -> None:
        with atomic_file(checkpoint) as temporary:
            state = {"depth": depth.state_dict(), "pose": pose.state_dict(), "optimizer": optimizer.state_dict()}
            torch.save({**state, "losses": losses}, temporary)

    @contextmanager
    def update(step: int) -> Iterator[None]:
        nonlocal whole
        whole = False
        yield
        whole = True
        if step % CHECKPOINT_EVERY == 0:
            save()
            latest = " ".join(f"{name} {value:.4f}" for name, value in losses[-1].items())
            print(f"step {step}: {latest}", flush=True)

    try:
        yield update
    except (SystemExit, KeyboardInterrupt):
        if whole and losses:
            save()
        raise
