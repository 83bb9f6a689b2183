"""The kernels of NeRF and matching, and training steps, beside the same in plain PyTorch and nerfstudio's encoding.

make bench-nerf, or: python tests/benchmarks/nerf.py --repeats 3 --device cuda
"""

import statistics
import sys
import time
import types
from collections.abc import Callable
from functools import partial
from typing import Literal
from unittest.mock import patch

import cv2
import numpy as np
import torch
from support.painted_sphere import photos_of, sphere_views, sphere_volume

from scenefuse.core.machine import use_threads
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import run
from scenefuse.geometry.matcher import Matcher
from scenefuse.mvs.plane_sweep import DepthMapSettings
from scenefuse.nerf import field, render
from scenefuse.nerf.field import FieldSettings, encode, encode_reference, hash_grid, kernels_on
from scenefuse.nerf.rays import LossWeights
from scenefuse.nerf.render import UNIFORM_SHARE, Occupancy, march, no_prior
from scenefuse.nerf.training import NerfRecipe, Schedule, Training, keep_memory, new_nerf, train
from scenefuse.photos.workspace import View

LEVELS, LOG2_TABLE, COARSEST, FINEST, SAMPLES = 16, 19, 16, 1024, 32768


def nerf(*, repeats: int = 10, steps: int = 60, threads: int = 2, device: Literal["cpu", "cuda"] = "cpu") -> None:
    """Print times and ratios; what is compared takes turns, so that a busy machine slows all of it.

    Args:
        repeats: runs of each encoding and of marching; the median counts.
        steps: training steps of each model, three times.
        threads: CPU threads.
        device: where everything runs.
    """
    torch.backends.cuda.matmul.fp32_precision = "tf32"
    use_threads(threads)
    keep_memory()
    print(f"hash encoding, {LEVELS} levels, 2^{LOG2_TABLE} rows, {SAMPLES} samples, forward and backward, {device}:")
    compare(medians({name: partial(time_of, step) for name, step in encodings(device).items()}, repeats), "s")
    if kernels_on(device) == "numba":
        print("marching 2304 rays through 128^3 cells, 32 samples:")
        step = marching(2304, 128, 32)
        compare(medians(by_both(lambda: time_of(step)), repeats), "s")
    if device == "cpu":
        print("matching 16 depth hypotheses of 400 x 300 pixels in 8 photos, windows of 7:")
        compare(medians({name: partial(time_of, step) for name, step in matching().items()}, repeats), "s")
    print("training, default field, 2304 rays a step:")
    compare(medians(by_both(lambda: training_seconds(steps, device)), 3), "s a step")


def by_both(measured: Callable[[], float]) -> dict[str, Callable[[], float]]:
    """The same with the kernels and in plain PyTorch."""

    def plain() -> float:
        nothing = None, torch.Tensor.detach
        patches = [patch.object(module, "kernel_module", return_value=nothing) for module in (field, render)]
        with patches[0], patches[1]:
            return measured()

    return {"scenefuse": measured, "scenefuse in plain PyTorch": plain}


def marching(rays: int, cells: int, samples: int) -> Callable[[], object]:
    """Marching as in a training step, through a shell."""
    generator = torch.Generator().manual_seed(0)
    grid = torch.stack(torch.meshgrid(*[torch.linspace(-1, 1, cells)] * 3, indexing="ij"))
    shell = ((grid.norm(dim=0) - 0.6).abs() < 0.1).contiguous()
    occupancy = Occupancy(shell, 50 * shell.float())
    origin = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator)) * 2
    direction = torch.nn.functional.normalize(torch.rand(rays, 3, generator=generator) - 0.5 - origin)
    origin, prior = origin + 0.5, no_prior(rays, origin.device)
    jitter = torch.rand(rays, samples, generator=generator)
    return lambda: march(origin, direction, occupancy, jitter, UNIFORM_SHARE, prior)


def matching() -> dict[str, Callable[[], object]]:
    """A chunk of the plane sweep, by the kernel and in plain PyTorch."""
    rng = np.random.default_rng(0)
    grays = [cv2.GaussianBlur(rng.random((300, 400), np.float32), (0, 0), 2) for _ in range(9)]
    poses = np.repeat(np.eye(4)[None], 9, axis=0)
    poses[:, 0, 3] = 0, -4, -3, -2, -1, 1, 2, 3, 4
    intrinsics = np.array([[350, 0, 200], [0, 350, 150], [0, 0, 1.0]])
    photos = [View("", intrinsics, pose, 400, 300, gray) for gray, pose in zip(grays, poses)]
    settings = build(DepthMapSettings, read_settings(None)["scene"]["depth_maps"])
    matcher = Matcher(photos[0], photos[1:], settings.best_sources, settings.window_px, "cpu")
    inverse = torch.linspace(1 / 60, 1 / 20, 16)[:, None, None].expand(-1, 300, 400).contiguous()

    def plain() -> None:
        best = inverse.new_full((matcher.best, *inverse.shape), -0.5)
        for source in matcher.sources:
            matcher.keep_best(inverse, best, *source)

    return {"scenefuse": lambda: matcher.score(inverse), "scenefuse in plain PyTorch": plain}


def compare(seconds: dict[str, float], unit: str) -> None:
    """Every time, and how many times the first one's it is."""
    first = next(iter(seconds.values()))
    for name, value in seconds.items():
        print(f"  {name:30s} {value:9.4f} {unit}   {value / first:6.1f} x")


def encodings(device: str) -> dict[str, Callable[[], object]]:
    """Encoders of the same size, each as a step that runs forward and backward on the same positions."""
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(SAMPLES, 3, generator=generator).to(device)
    weight = torch.rand(SAMPLES, 2 * LEVELS, generator=generator).to(device)
    grid, every_level = hash_grid(LEVELS, LOG2_TABLE, COARSEST, FINEST), torch.ones(LEVELS, device=device)
    table = torch.nn.Parameter(torch.rand(grid.rows, 2, generator=generator).to(device))
    # Nearly every cache line of the table is read and nearly every one of its gradient written.
    gradient = torch.empty_like(table).detach()

    def step(encoder: Callable[..., torch.Tensor], parameters: torch.nn.Parameter) -> None:
        parameters.grad = None
        (encoder() * weight).sum().backward()

    peers: dict[str, Callable[[], object]] = {
        "scenefuse": lambda: step(lambda: encode(x, table, grid, every_level), table),
        "scenefuse in plain PyTorch": lambda: step(lambda: encode_reference(x, table, grid, every_level), table),
        "floor: copying the table": lambda: gradient.copy_(table.detach()),
    }
    # Its web viewer is imported on the way and not needed.
    for name in ("viser", "viser.transforms"):
        sys.modules.setdefault(name, types.ModuleType(name))
    try:
        from nerfstudio.field_components.encodings import HashEncoding
    except ImportError as error:
        print(f"  (nerfstudio is not there: {error})")
        return peers
    theirs = HashEncoding(LEVELS, COARSEST, FINEST, LOG2_TABLE, 2, implementation="torch").to(device)
    peers["nerfstudio 1.1.5, torch"] = lambda: step(lambda: theirs(x), theirs.hash_table)
    return peers


def medians(measured: dict[str, Callable[[], float]], repeats: int) -> dict[str, float]:
    """Median of what each returns, in turns, after one round that warms up."""
    rounds = [{name: take() for name, take in measured.items()} for _ in range(repeats + 1)]
    return {name: statistics.median(taken[name] for taken in rounds[1:]) for name in measured}


def time_of(step: Callable[[], object]) -> float:
    """Time of one step."""
    wait = torch.cuda.synchronize if torch.cuda.is_available() else lambda: None
    wait()
    start = time.perf_counter()
    step()
    wait()
    return time.perf_counter() - start


def training_seconds(steps: int, device: str) -> float:
    """Seconds of one more training step of the default field on photos of a painted sphere."""
    views, recipe = sphere_views(24, 160), NerfRecipe()
    cube, hull = sphere_volume(views, recipe.occupancy_cells)
    photos = photos_of(views, cube, prior=1.0)
    counts, seconds = (max(4, steps // 6), steps), []
    for count in (2, *counts):  # the first one compiles
        nerf = new_nerf(FieldSettings(), torch.from_numpy(hull), len(photos), 0, device)
        schedule = Schedule(epochs=2, rays_per_epoch=count * recipe.rays_per_step // 2)
        training = Training(photos, schedule, recipe, LossWeights(), warm=False, seed=0)
        start = time.perf_counter()
        train(nerf, training, checkpoint=None, report=print_nothing)
        seconds.append(time.perf_counter() - start)
    return (seconds[2] - seconds[1]) / (counts[1] - counts[0])


def print_nothing(line: str) -> None:
    """Progress is not printed."""


if __name__ == "__main__":
    run(nerf)
