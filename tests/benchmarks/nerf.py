"""The NeRF's kernels and training steps on the CPU, beside the same in plain PyTorch and nerfstudio's encoding.

make bench-nerf, or: python tests/benchmarks/nerf.py --repeats 3
"""

import statistics
import sys
import time
import types
from collections.abc import Callable

import torch
from painted_sphere import photos_of, sphere_views, sphere_volume

from scenefuse.nerf import kernels
from scenefuse.nerf.encoding import encode, encode_reference, hash_grid
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.losses import LossWeights
from scenefuse.nerf.occupancy import Occupancy
from scenefuse.nerf.render import Prior, march
from scenefuse.nerf.train import Schedule, keep_memory, new_model, train
from scenefuse.settings import build, shipped_with
from scenefuse.stage import run

LEVELS, LOG2_TABLE, COARSEST, FINEST, SAMPLES = 16, 19, 16, 1024, 32768


def nerf(*, repeats: int = 10, steps: int = 60, threads: int = 2) -> None:
    """Print times and ratios.

    Args:
        repeats: runs of each encoding; the median counts.
        steps: training steps of each model.
        threads: CPU threads.
    """
    torch.set_num_threads(threads)
    kernels.set_threads(threads)
    keep_memory()
    print(f"hash encoding, {LEVELS} levels, 2^{LOG2_TABLE} rows, {SAMPLES} samples, forward and backward:")
    compare({name: median_seconds(step, repeats) for name, step in encodings().items()}, "s")
    for title, step in kernel_steps().items():
        print(f"{title}:")
        compare(by_both(lambda: median_seconds(step, repeats)), "s")  # noqa: B023
    print("training, default field, 2304 rays a step:")
    compare(by_both(lambda: training_seconds(steps if kernels.AVAILABLE else max(4, steps // 10), threads)), "s a step")


def by_both(measured: Callable[[], float]) -> dict[str, float]:
    """The same with the kernels and in plain PyTorch."""
    seconds = {"scenefuse": measured()}
    kernels.AVAILABLE = False
    seconds["scenefuse in plain PyTorch"] = measured()
    kernels.AVAILABLE = True
    return seconds


def kernel_steps() -> dict[str, Callable[[], None]]:
    """What the other kernel does in a training step, at its size."""
    generator = torch.Generator().manual_seed(0)
    rays, samples, cells = 2304, 32, 128
    grid = torch.stack(torch.meshgrid(*[torch.linspace(-1, 1, cells)] * 3, indexing="ij"))
    shell = ((grid.norm(dim=0) - 0.6).abs() < 0.1).contiguous()
    occupancy = Occupancy(shell, 50 * shell.float(), shell)
    origin = torch.nn.functional.normalize(torch.randn(rays, 3, generator=generator)) * 2
    direction = torch.nn.functional.normalize(torch.rand(rays, 3, generator=generator) - 0.5 - origin)
    origin, none = origin + 0.5, torch.zeros(rays)
    jitter, prior = torch.rand(rays, samples, generator=generator), Prior(none - 1, none, none)

    def marching() -> None:
        march(origin, direction, occupancy, jitter, 0.25, prior)

    return {f"marching {rays} rays through {cells}^3 cells, {samples} samples": marching}


def compare(seconds: dict[str, float], unit: str) -> None:
    """Every time, and how many times the first one's it is."""
    first = next(iter(seconds.values()))
    for name, value in seconds.items():
        print(f"  {name:30s} {value:9.4f} {unit}   {value / first:6.1f} x")


def encodings() -> dict[str, Callable[[], None]]:
    """Encoders of the same size, each as a step that runs forward and backward on the same positions."""
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(SAMPLES, 3, generator=generator)
    weight = torch.rand(SAMPLES, 2 * LEVELS, generator=generator)
    grid, every_level = hash_grid(LEVELS, LOG2_TABLE, COARSEST, FINEST), torch.ones(LEVELS)
    table = torch.nn.Parameter(torch.rand(grid.rows, 2, generator=generator))
    # Nearly every cache line of the table is read and nearly every one of its gradient written.
    gradient = torch.empty_like(table).detach()

    def step(encoder: Callable[..., torch.Tensor], parameters: torch.nn.Parameter) -> None:
        parameters.grad = None
        (encoder() * weight).sum().backward()

    peers = {
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
    theirs = HashEncoding(LEVELS, COARSEST, FINEST, LOG2_TABLE, 2, implementation="torch")
    peers["nerfstudio 1.1.5, torch"] = lambda: step(lambda: theirs(x), theirs.hash_table)
    return peers


def median_seconds(step: Callable[[], None], repeats: int) -> float:
    """Median time of a step, after one that warms up."""
    step()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        step()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def training_seconds(steps: int, threads: int) -> float:
    """Seconds of one training step of the default field on photos of a painted sphere, compilation left out."""
    config = shipped_with(None)["object"]
    settings = config["nerf"]
    views = sphere_views(24, 160)
    cube, hull = sphere_volume(views, settings["occupancy_cells"])
    photos = photos_of(views, cube, prior=1.0)
    rays = settings["images_per_batch"] * settings["rays_per_image"]
    weights = build(LossWeights, settings)
    seconds = 0.0
    for count in (2, steps):
        fitted = settings | {"epochs": 2, "rays_per_epoch": count * rays // 2}
        model = new_model(build(FieldSettings, settings), torch.from_numpy(hull), len(photos), 0, "cpu")
        schedule = build(Schedule, fitted)
        result = train(
            model,
            photos,
            schedule,
            weights,
            warm=False,
            seed=0,
            threads=threads,
            checkpoint=None,
            report=print_nothing,
            band_px=settings["mask_band_px"],
        )
        seconds = result["seconds"] / result["steps"]
    return seconds


def print_nothing(line: str) -> None:
    """Progress is not printed."""


if __name__ == "__main__":
    run(nerf)
