"""Training of the depth-guided NeRF: one loop, resumable, the same result for the same seed."""

import contextlib
import ctypes
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from scenefuse.cores import use_threads
from scenefuse.nerf import losses
from scenefuse.nerf.field import Field, FieldSettings, coarse_to_fine
from scenefuse.nerf.losses import LossWeights
from scenefuse.nerf.occupancy import Occupancy, updated
from scenefuse.nerf.rays import Batch, Photos, camera_rays, draw_batch, pixel_pool
from scenefuse.nerf.render import Prior, composite, march
from scenefuse.stage import setting

DEPTH_DELTA = 0.01
OCCUPANCY_EVERY = 16


@dataclass(frozen=True)
class Schedule:
    """How long and how fast a NeRF stage trains."""

    epochs: int = setting(20, least=0)
    """epochs of this stage"""
    rays_per_epoch: int = setting(60000, least=0)
    """rays drawn per epoch"""
    images_per_batch: int = setting(24, least=0)
    """photos per batch"""
    rays_per_image: int = setting(96, least=0)
    """rays per photo of a batch"""
    warmup_epochs: float = setting(1, least=0)
    """epochs of linear warm-up, before the cosine"""
    learning_rate: float = setting(0.005, least=0)
    """highest learning rate of the networks"""
    grid_learning_rate: float = setting(0.01, least=0)
    """highest learning rate of the hash grid"""
    samples_first: int = setting(32, least=0)
    """samples per ray at the start"""
    samples_last: int = setting(16, least=0)
    """samples per ray at the end"""
    coarse_until: float = setting(0.3, least=0)
    """share of the steps after which all levels are open"""
    edge_boost: float = setting(1, least=0)
    """adaptive grid: gradients of fine levels are multiplied by 1 + this at edges"""
    pose_learning_rate: float = setting(0, least=0)
    """learning rate of the camera poses, 0 keeps them"""

    @property
    def steps(self) -> int:
        """Optimiser steps of the stage."""
        return max(1, round(self.epochs * self.rays_per_epoch / (self.images_per_batch * self.rays_per_image)))


@dataclass
class Model:
    """All that is trained: the field, its occupancy grid, and corrections (V, 6) of the poses (rotation, centre)."""

    field: Field
    occupancy: Occupancy
    pose: Tensor

    def state(self) -> dict[str, Any]:
        """As plain tensors, for a file."""
        return {
            "settings": asdict(self.field.settings),
            "field": self.field.state_dict(),
            "hull": self.occupancy.hull.cpu(),
            "density": self.occupancy.density.cpu(),
            "occupied": self.occupancy.occupied.cpu(),
            "pose": self.pose.detach().cpu(),
        }

    @classmethod
    def from_state(cls, state: dict[str, Any], device: str = "cpu") -> "Model":
        """Back from `state`."""
        field = Field(FieldSettings(**state["settings"]), torch.Generator().manual_seed(0))
        field.load_state_dict(state["field"])
        occupancy = Occupancy(*(state[k].to(device) for k in ("hull", "density", "occupied")))
        return cls(field.to(device), occupancy, state["pose"].to(device))


def new_model(settings: FieldSettings, hull: Tensor, photos: int, seed: int, device: str) -> Model:
    """An untrained model."""
    field = Field(settings, torch.Generator().manual_seed(seed)).to(device)
    return Model(field, Occupancy.from_hull(hull.to(device)), torch.zeros(photos, 6, device=device))


def train(
    model: Model,
    photos: Photos,
    schedule: Schedule,
    weights: LossWeights,
    *,
    warm: bool,
    seed: int,
    threads: int,
    checkpoint: Path | None,
    report: Callable[[str], None],
    band_px: int,
) -> dict[str, float]:
    """Train `model` in place on `photos`.

    Args:
        model: new, or of an earlier stage.
        photos: training photos in the unit cube's frame.
        schedule: lengths and rates.
        weights: of the losses.
        warm: the model is already trained: all levels open and the grid pruned from the start.
        seed: decides every random draw together with the step's number.
        threads: CPU threads.
        checkpoint: file to resume from and save to (every 30 s, and when the process is asked to end), or None.
        report: called with progress lines.
        band_px: half-width of the band around the masks' edges that no loss touches; 0: mattes are exact.

    Returns:
        final loss terms and `psnr` (means over the last tenth), `steps`, `seconds`, `rays_per_second`,
        `samples_per_second`.
    """
    use_threads(threads)
    keep_memory()
    pool = pixel_pool(photos, band_px=band_px, ring_px=12, edge_px=3)
    pose = nn.Parameter(model.pose.clone())
    networks = [p for name, p in model.field.named_parameters() if name != "table"]
    optimizer = Optimizer(model.field.table, networks, pose)
    first = _resume(checkpoint, model, optimizer, pose)
    if first:
        report(f"resumed at step {first} of {schedule.steps}")
    meter = _Meter(schedule, first, report)
    saved = time.monotonic()
    with _between_steps() as asked:
        for step in range(first, schedule.steps):
            terms, counts = _step(model, photos, pool, schedule, weights, pose, optimizer, warm, seed, step)
            meter.add(step, terms, counts)
            if checkpoint and (asked or time.monotonic() - saved > 30):
                _save(checkpoint, model, optimizer, pose, step + 1)
                saved = time.monotonic()
            if asked:
                report(f"stopped after step {step + 1} of {schedule.steps}")
                sys.exit(128 + asked[0])
    model.pose = pose.detach().clone()
    return meter.summary()


@contextlib.contextmanager
def _between_steps() -> Iterator[list[int]]:
    """Hold SIGTERM and SIGINT back until a step is whole: yields the list of signals that came."""
    asked: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield asked
        return
    numbers = (signal.SIGTERM, signal.SIGINT)
    before = [signal.signal(number, lambda n, _: asked.append(n)) for number in numbers]
    try:
        yield asked
    finally:
        for number, handler in zip(numbers, before):
            signal.signal(number, handler)


def _step(model, photos, pool, schedule, weights, pose, optimizer, warm, seed, step):  # type: ignore[no-untyped-def]
    """One optimiser step: loss terms (detached tensors) and (rays, samples)."""
    progress = step / schedule.steps
    field, occupancy = model.field, model.occupancy
    device = field.table.device
    if not warm:
        coarse_to_fine(field, progress, schedule.coarse_until, max(4, field.settings.levels // 2))
    if step % OCCUPANCY_EVERY == 0 and (step or warm):
        hull_cells = int(occupancy.hull.sum())
        prune = warm or progress > 0.1
        occupancy = updated(occupancy, field, seed, step, min(hull_cells // 2, 65536) + 4096, 0.9, prune, 0.005)
        model.occupancy = occupancy
    batch = draw_batch(photos, pool, seed, step, schedule.images_per_batch, schedule.rays_per_image, 0.1)
    batch = Batch(*(getattr(batch, name).to(device) for name in batch.__dataclass_fields__))
    count = round(schedule.samples_first + (schedule.samples_last - schedule.samples_first) * min(1, 2 * progress))
    rng = torch.Generator().manual_seed(seed * 1_000_003 + step)
    refine = schedule.pose_learning_rate > 0 and progress > 0.2
    terms, samples = _loss_terms(field, occupancy, photos, batch, schedule, weights, pose if refine else None,
                                 count, rng)  # fmt: skip
    loss = sum(getattr(weights, f"{name}_weight") * value for name, value in terms.items() if name != "psnr")
    loss.backward()
    optimizer.step(schedule, step)
    return {name: float(value.detach()) for name, value in terms.items()}, (len(batch.view), samples)


def _loss_terms(field, occupancy, photos, batch, schedule, weights, pose, count, rng):  # type: ignore[no-untyped-def]
    device = field.table.device
    rotation, center = photos.rotation.to(device)[batch.view], photos.center.to(device)[batch.view]
    if pose is not None:
        rotation, center = refined(rotation, center, pose[batch.view])
    origin, direction, length = camera_rays(photos.intrinsics.to(device)[batch.view], rotation, center, batch.uv)
    has_prior = (batch.depth > 0) & batch.inside
    confidence = batch.confidence * has_prior
    prior_distance = batch.depth * length.detach()
    prior = Prior(prior_distance, torch.full_like(length, 0.04).detach(), 0.6 * confidence)
    jitter = torch.rand(len(origin), count, generator=rng).to(device)
    background = torch.rand(len(origin), 3, generator=rng).to(device)
    drawn = march(origin.detach().contiguous(), direction.detach().contiguous(), occupancy, jitter, 0.25, prior)
    ray = drawn.ray
    x = origin[ray, None] + drawn.t[..., None] * direction[ray, None]
    boost = (1 + schedule.edge_boost * batch.edge[ray])[:, None].expand(drawn.t.shape).reshape(-1)
    fine_from = field.settings.levels // 2
    sigma, features = field.geometry(x.view(-1, 3), boost if schedule.edge_boost > 0 else None, fine_from)
    sigma = sigma.view(drawn.t.shape)
    rgb = field.color(features, direction[ray])
    color, opacity, moment, spread, _ = composite(sigma, rgb, drawn.t, drawn.delta)
    inside, matte, shown = batch.inside[ray], batch.matte[ray, None], background[ray]
    composed = color + (1 - opacity)[:, None] * shown
    target = matte * batch.color[ray] + (1 - matte) * shown
    distance = moment / opacity.clamp(min=1e-3)
    terms = {"color": losses.color_loss(composed, target, inside)}
    if weights.depth_weight > 0:
        terms["depth"] = losses.depth_loss(distance, opacity, prior_distance[ray], confidence[ray], DEPTH_DELTA)
    if weights.rank_weight > 0:
        spread_out = (torch.zeros_like(length).index_put((ray,), a) for a in (distance, opacity))
        every_distance, every_opacity = spread_out
        terms["rank"] = losses.rank_loss(
            every_distance, every_opacity, prior_distance, confidence, batch.uv, schedule.images_per_batch,
            0.02 * photos.images.shape[2], 0.02,
        )  # fmt: skip
    if weights.mask_weight > 0:
        terms["mask"] = losses.mask_loss(opacity, matte[:, 0])
    if weights.sparsity_weight > 0:
        terms["sparsity"] = losses.sparsity_loss(sigma, drawn.delta, inside)
    if weights.distortion_weight > 0:
        terms["distortion"] = losses.distortion_loss(spread)
    error = ((composed.detach() - target) ** 2)[inside].mean().clamp(min=1e-10)
    terms["psnr"] = -10 * torch.log10(error)
    return terms, drawn.t.numel()


def refined(rotation: Tensor, center: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """Apply corrections (R, 6) in SO(3) x R3 to rotations (R, 3, 3) and centres (R, 3), first order in the angle."""
    x, y, z = pose[:, :3].unbind(1)
    o = torch.zeros_like(x)
    skew = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=1).view(-1, 3, 3)
    return torch.linalg.matrix_exp(skew) @ rotation, center + pose[:, 3:]


def keep_memory() -> None:
    """Let glibc keep freed memory instead of returning it to the kernel: large tensors come and go each step."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            libc = ctypes.CDLL(None)
            libc.mallopt(-3, 1 << 30)
            libc.mallopt(-1, (1 << 31) - 1)


class Optimizer:
    """Adam for table, networks and poses, with linear warm-up and a cosine to 2 % of the highest rates."""

    def __init__(self, table: nn.Parameter, networks: list[nn.Parameter], pose: nn.Parameter) -> None:
        groups = [{"params": p} for p in ([table], networks, [pose])]
        self.adam = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)

    def step(self, schedule: Schedule, step: int) -> None:
        """Apply all gradients at the rates of this step, and clear them."""
        warmup = max(1.0, schedule.warmup_epochs / schedule.epochs * schedule.steps)
        rise = min(1.0, (step + 1) / warmup)
        done = max(0.0, (step - warmup) / max(1.0, schedule.steps - warmup))
        factor = rise * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * done)))
        rates = schedule.grid_learning_rate, schedule.learning_rate, schedule.pose_learning_rate
        for group, rate in zip(self.adam.param_groups, rates):
            group["lr"] = rate * factor
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)


class _Meter:
    """Running means of the loss terms, and progress lines."""

    def __init__(self, schedule: Schedule, first: int, report: Callable[[str], None]) -> None:
        self.schedule, self.first, self.report = schedule, first, report
        self.start = self.spoken = time.monotonic()
        self.history: list[dict[str, float]] = []
        self.rays = self.samples = 0

    def add(self, step: int, terms: dict[str, float], counts: tuple[int, int]) -> None:
        self.history.append(terms)
        self.rays, self.samples = self.rays + counts[0], self.samples + counts[1]
        now = time.monotonic()
        if now - self.spoken > 5 or step + 1 == self.schedule.steps:
            self.spoken = now
            elapsed = now - self.start
            left = elapsed / (step + 1 - self.first) * (self.schedule.steps - step - 1)
            means = self.means(20)
            text = " ".join(f"{k} {v:.4g}" for k, v in means.items())
            self.report(
                f"step {step + 1}/{self.schedule.steps} {text} | {self.rays / elapsed:.0f} rays/s "
                f"{self.samples / elapsed:.0f} samples/s, {left:.0f} s left"
            )

    def means(self, last: int) -> dict[str, float]:
        recent = self.history[-last:]
        names = dict.fromkeys(name for terms in recent for name in terms)
        return {name: float(np.mean([t[name] for t in recent if name in t])) for name in names}

    def summary(self) -> dict[str, float]:
        elapsed = max(time.monotonic() - self.start, 1e-9)
        return self.means(max(1, self.schedule.steps // 10)) | {
            "steps": float(self.schedule.steps),
            "seconds": elapsed,
            "rays_per_second": self.rays / elapsed,
            "samples_per_second": self.samples / elapsed,
        }


def _save(path: Path, model: Model, optimizer: Optimizer, pose: Tensor, step: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    state = {"model": model.state(), "optimizer": optimizer.adam.state_dict(), "pose": pose.detach(), "step": step}
    torch.save(state, temporary)
    os.replace(temporary, path)


def _resume(path: Path | None, model: Model, optimizer: Optimizer, pose: Tensor) -> int:
    """Load a checkpoint into model, optimizer and pose; the step to go on with, 0 without one."""
    if path is None or not path.is_file():
        return 0
    state = torch.load(path, map_location="cpu", weights_only=True)
    model.field.load_state_dict(state["model"]["field"])
    device = model.field.table.device
    model.occupancy = Occupancy(*(state["model"][name].to(device) for name in ("hull", "density", "occupied")))
    optimizer.adam.load_state_dict(state["optimizer"])
    with torch.no_grad():
        pose.copy_(state["pose"])
    return int(state["step"])
