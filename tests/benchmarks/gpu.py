"""Every path that a GPU takes, beside its twin on the CPU: whether they agree, seconds, ratio.

make check-gpu, or, on a machine with PyTorch, Triton and a GPU where nothing is installed:
PYTHONPATH=.:tests python3 tests/benchmarks/gpu.py --table gpu.tsv --object results/objects/house --lego data/lego

Beside PyTorch and Triton it needs NumPy, SciPy, Numba, OpenCV, PyYAML, jsonschema and tyro; pycolmap (pycolmap-cuda12
for patch-match, with X11's libraries) and pyproj for photos. Without a GPU both sides run on the CPU, which checks the
checks, and the end is an error.
"""

import dataclasses
import statistics
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from benchmarks.nerf import by_both, training_seconds
from support.painted_sphere import photos_of, sphere_views, sphere_volume
from support.sideways_video import sideways_video
from support.textured_plane import plane_views, speckled, wrong_depths

from scenefuse.core.machine import use_threads
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import StageError, run
from scenefuse.mvs.photo_refinement import RefinementSettings, refine_by_photos
from scenefuse.mvs.plane_sweep import DepthMapSettings, estimate_depth
from scenefuse.nerf.field import FieldSettings, encode, hash_grid
from scenefuse.nerf.rays import LossWeights
from scenefuse.nerf.render import UNIFORM_SHARE, march, no_prior, render_view
from scenefuse.nerf.training import NerfRecipe, Schedule, Training, keep_memory, new_nerf, train
from scenefuse.paper.network_training import Recipe, optimise, predict

HAVE_GPU = torch.cuda.is_available()
GPU: Literal["cpu", "cuda"] = "cuda" if HAVE_GPU else "cpu"
ROOT = Path(__file__).resolve().parents[2]


@dataclasses.dataclass(frozen=True)
class Row:
    """A check: what was compared, how far both are apart and may be, seconds on CPU and GPU, a note."""

    check: str
    agree: str
    difference: float
    tolerance: float
    cpu_s: float
    gpu_s: float
    note: str

    def cells(self) -> tuple[object, ...]:
        """What the table's row holds; the ratio is how many times as fast the GPU is."""
        *first, note = dataclasses.astuple(self)
        return *first, self.cpu_s / self.gpu_s, note


def gpu(
    *,
    table: Path | None = None,
    object: Path | None = None,
    lego: Path | None = None,
    only: tuple[str, ...] = (),
    threads: int = 4,
) -> None:
    """Check one path after the other; what fails is told with its traceback, and the next one follows.

    Args:
        table: TSV to write, a row a check.
        object: folder of a finished object, whose four stages are run again.
        lego: folder of NeRF-synthetic Lego, trained to 30 dB.
        only: names of checks; all without.
        threads: CPU threads.
    """
    torch.backends.cuda.matmul.fp32_precision = "tf32"
    use_threads(threads)
    keep_memory()
    if HAVE_GPU:
        print(f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}", flush=True)
    checks: dict[str, Callable[[], Row]] = {
        "copy": copy,
        "encoding": lambda: encoding(backward=False),
        "encoding_backward": lambda: encoding(backward=True),
        "marching": marching,
        "training": training,
        "rendering": rendering,
        "stereo": stereo,
        "photo_refinement": photo_refinement,
        "paper_networks": paper_networks,
    }
    if object is not None:
        checks |= {"patch_match": lambda: patch_match(object), "object": lambda: whole_object(object)}
    if lego is not None:
        checks["lego"] = lambda: lego_to_30_db(lego)
    rows = [checked(name, check) for name, check in checks.items() if not only or name in only]
    header = "check\tagrees\tdifference\ttolerance\tcpu_s\tgpu_s\tratio\tnote"
    lines = [header, *("\t".join(map(shown, row.cells())) for row in rows)]
    print("\n".join(lines), flush=True)
    if table is not None:
        table.parent.mkdir(parents=True, exist_ok=True)
        table.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if not HAVE_GPU:
        raise StageError("PyTorch sees no GPU: the CPU was compared with itself")
    failed = [row.check for row in rows if row.agree != "yes" and not row.note.startswith("left out")]
    if failed:
        raise StageError(f"CPU and GPU do not agree, or the GPU fails, in: {', '.join(failed)}")


def checked(name: str, check: Callable[[], Row]) -> Row:
    """A check's row, also where it fails."""
    start = time.perf_counter()
    try:
        row = check()
        row = dataclasses.replace(row, check=name, agree="yes" if row.difference <= row.tolerance else "no")
    except ImportError as error:
        row = Row(name, "", np.nan, np.nan, np.nan, np.nan, f"left out: {error}")
    except Exception as error:
        traceback.print_exc()
        row = Row(name, "no", np.nan, np.nan, np.nan, np.nan, f"{type(error).__name__}: {str(error).splitlines()[:1]}")
    print(f"{name}: {row}, {time.perf_counter() - start:.1f} s", flush=True)
    return row


def shown(value: object) -> str:
    """A cell of the table."""
    return ("" if np.isnan(value) else f"{value:.3g}") if isinstance(value, float) else str(value)


def seconds_of(step: Callable[[], Any], repeats: int = 5) -> float:
    """Median seconds of a step after one that warms up."""
    taken = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        step()
        if HAVE_GPU:
            torch.cuda.synchronize()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken[1:])


@contextmanager
def without_gpu() -> Iterator[None]:
    """What asks for a GPU sees none."""
    available = torch.cuda.is_available
    torch.cuda.is_available = lambda: False
    try:
        yield
    finally:
        torch.cuda.is_available = available


def both(step: Callable[[], Any]) -> tuple[Any, float, Any, float]:
    """Result and seconds on the CPU, then on the GPU, of what chooses its device itself; the GPU's second run."""
    with without_gpu():
        start = time.perf_counter()
        here = step()
        cpu = time.perf_counter() - start
    step()
    start = time.perf_counter()
    there = step()
    return here, cpu, there, time.perf_counter() - start


def copy() -> Row:
    """What the memory can do."""
    a, b = (torch.rand(1 << 28, device=GPU) if HAVE_GPU else torch.rand(1 << 22) for _ in range(2))
    taken = seconds_of(lambda: b.copy_(a), 20)
    return Row("", "", 0, 0, np.nan, taken, f"{8 * a.numel() / taken / 1e9:.0f} GB/s read and written")


def encoding(*, backward: bool) -> Row:
    """The hash grid of 16 levels and 2^19 rows, 2^18 samples: features, or the table's gradient."""
    levels, count = 16, 1 << 18
    grid, rng = hash_grid(levels, 19, 16, 1024), torch.Generator().manual_seed(0)
    x, table = torch.rand(count, 3, generator=rng), torch.rand(grid.rows, 2, generator=rng)
    weight = torch.rand(count, 2 * levels, generator=rng)
    results, taken = [], []
    for device in ("cpu", GPU):
        there, where = torch.nn.Parameter(table.to(device)), x.to(device)
        given, every = weight.to(device), torch.ones(levels, device=device)
        out = encode(where, there, grid, every)

        def step(out=out, there=there, given=given, where=where, every=every) -> torch.Tensor:
            if backward:
                return torch.autograd.grad(out, there, given, retain_graph=True)[0]
            with torch.no_grad():
                return encode(where, there, grid, every)

        results.append(step().cpu())
        taken.append(seconds_of(step, 20))
    off = float((results[0] - results[1]).abs().max() / results[0].abs().max())
    moved = count * levels * 8 * 8 * (2 if backward else 1) + 4 * weight.numel()
    return Row("", "", off, 1e-4, taken[0], taken[1], f"{moved / taken[1] / 1e9:.0f} GB/s gathered")


def trained_sphere(device: str, steps: int) -> tuple[Any, Any, dict[str, float]]:
    """A NeRF of the painted sphere after some steps, its photos, and what the training says."""
    views, recipe = sphere_views(24, 160), NerfRecipe()
    cube, hull = sphere_volume(views, recipe.occupancy_cells)
    photos = photos_of(views, cube, prior=1.0)
    nerf = new_nerf(FieldSettings(), torch.from_numpy(hull), len(photos), 0, device)
    schedule = Schedule(epochs=10, rays_per_epoch=steps * recipe.rays_per_step // 10)
    told = train(
        nerf,
        Training(photos, schedule, recipe, LossWeights(), warm=False, seed=0),
        checkpoint=None,
        report=lambda line: None,
    )
    return nerf, photos, told


def training() -> Row:
    """The same training on both: the PSNR of its last tenth, and seconds a step of 2304 rays."""
    trained_sphere(GPU, 20)
    (_, _, here), (_, _, there) = trained_sphere("cpu", 1000), trained_sphere(GPU, 1000)
    steps = [told["seconds"] / told["steps"] for told in (here, there)]
    marginal = {name: take() for name, take in by_both(lambda: training_seconds(240, GPU)).items()}
    note = f"{here['psnr']:.2f} dB, {there['psnr']:.2f} dB; one more step on the GPU: "
    note += ", ".join(f"{name} {1000 * taken:.2f} ms" for name, taken in marginal.items())
    # Three standard deviations of what other seeds give (45.9, 45.1, 45.8 dB).
    return Row("", "", abs(here["psnr"] - there["psnr"]), 1.2, steps[0], steps[1], note)


def marching() -> Row:
    """Samples along rays: the kernel and plain PyTorch on the GPU."""
    nerf, _, _ = trained_sphere("cpu", 100)
    rng = torch.Generator().manual_seed(0)
    origin = torch.nn.functional.normalize(torch.randn(2304, 3, generator=rng)) * 1.5
    direction = torch.nn.functional.normalize(torch.rand(2304, 3, generator=rng) * 0.6 - 0.3 - origin)
    jitter, results, taken = torch.rand(2304, 16, generator=rng), [], []
    for device in ("cpu", GPU):
        occupancy = type(nerf.occupancy)(nerf.occupancy.hull.to(device), nerf.occupancy.density.to(device))
        given = [a.to(device).contiguous() for a in (origin + 0.5, direction)]
        there, prior = jitter.to(device), no_prior(2304, torch.device(device))

        def step(given=given, occupancy=occupancy, there=there, prior=prior) -> Any:
            return march(given[0], given[1], occupancy, there, UNIFORM_SHARE, prior)

        results.append(step())
        taken.append(seconds_of(step, 20))
    same = set(results[0].ray.tolist()) == set(results[1].ray.tolist())
    off = (results[0].t - results[1].t.cpu()).abs() if same else torch.ones(1)
    return Row("", "", float(off.quantile(0.999)), 1e-3, taken[0], taken[1], "" if same else "other rays hit the hull")


def rendering() -> Row:
    """A view of one field on both: colours."""
    nerf, photos, _ = trained_sphere("cpu", 100)
    results, taken, everything = [], [], torch.ones(photos.masks.shape[1:], dtype=torch.bool)
    for device in ("cpu", GPU):
        nerf.field.to(device)
        occupancy = type(nerf.occupancy)(nerf.occupancy.hull.to(device), nerf.occupancy.density.to(device))

        def step(occupancy=occupancy) -> Any:
            return render_view(nerf.field, occupancy, photos.camera(0), everything, 48, True)

        results.append(step())
        taken.append(seconds_of(step, 3))
    off = (results[0].color - results[1].color).abs().flatten().quantile(0.999)
    return Row(
        "", "", float(off), 5e-3, taken[0], taken[1], f"{everything.numel() / taken[1] / 1e6:.2f} million rays a second"
    )


def stereo() -> Row:
    """The plane sweep: share of the pixels whose depths differ by more than a thousandth."""
    views, truth = plane_views(9, 640, 480)
    views = speckled(views, truth)
    seen = [
        dataclasses.replace(views.view(i), pixels=views.images[i][..., 0].astype(np.float32) / 255) for i in range(9)
    ]
    settings = build(DepthMapSettings, read_settings(None)["scene"]["depth_maps"])
    results, taken = [], []
    for device in ("cpu", GPU):

        def step(device=device) -> Any:
            return estimate_depth(seen[4], seen[:4] + seen[5:], 1.5, 6.0, settings, device)

        results.append(step())
        taken.append(seconds_of(step, 2))
    here, there = (r.depth for r in results)
    off = float((np.abs(here - there) > 1e-3 * truth[4]).mean())
    right = [float((np.abs(r.depth - truth[4]) < 1e-3 * truth[4])[truth[4] > 0].mean()) for r in results]
    return Row(
        "", "", off, 0.01, taken[0], taken[1], f"within 0.1 % of the truth {right[0]:.3f}, {right[1]:.3f}; 0.307 MP"
    )


def photo_refinement() -> Row:
    """Depths moved to where photos match."""
    views, truth = plane_views(9, 640, 480)
    views = speckled(views, truth)
    here, cpu, there, gpu_s = both(lambda: refine_by_photos(views, wrong_depths(truth, 0.005), RefinementSettings()))
    off = float((np.abs(here.depths - there.depths) > 1e-3 * here.depths.max()).mean())
    return Row("", "", off, 0.01, cpu, gpu_s, "9 photos of 0.307 MP")


def paper_networks() -> Row:
    """The paper's networks of stage 1 on a small video: the first loss; seconds of twenty steps."""
    from scenefuse.paper.monocular import frames_of, monocular_losses, new_monocular_networks

    def losses() -> tuple[float, float]:
        device, length = torch.device("cuda" if torch.cuda.is_available() else "cpu"), Recipe(20, 1)
        torch.manual_seed(0)
        frames = frames_of(sideways_video(6), device)
        networks = new_monocular_networks(device)
        objective = monocular_losses(networks, frames, length)
        with tempfile.TemporaryDirectory() as name:
            told = optimise(networks.parts(), frames, objective, length, Path(name) / "state.pt", 0)
        predict(networks.depth, frames)
        return told[0]["photometric"], told[-1]["photometric"]

    here, cpu, there, gpu_s = both(losses)
    note = f"photometric loss {here[0]:.4f}, {there[0]:.4f}; after twenty steps {here[1]:.4f}, {there[1]:.4f}"
    return Row("", "", abs(here[0] - there[0]) / here[0], 0.01, cpu, gpu_s, note)


def patch_match(folder: Path) -> Row:
    """COLMAP's patch-match on an object's photos, beside the plane sweep on the GPU: where both have a depth."""
    import pycolmap

    from scenefuse.mvs.depth_maps import estimate_depth_maps
    from scenefuse.photos.pictures import read_depth

    if not pycolmap.has_cuda:
        raise ImportError("this pycolmap has no CUDA")
    taken, maps = [], []
    with tempfile.TemporaryDirectory() as name:
        for backend in ("torch", "colmap"):
            settings = DepthMapSettings(backend=backend, max_image_size_px=480)
            out = Path(name) / backend
            start = time.perf_counter()
            estimate_depth_maps(
                workspace=folder / "undistorted",
                chunk=0,
                chunks=8,
                settings=settings,
                seed=0,
                depth=out,
                report=Path(name) / f"{backend}.json",
            )
            taken.append(time.perf_counter() - start)
            maps.append([read_depth(path) for path in sorted((out / "depth_maps").glob("*"))])
    sweep, matched = (np.concatenate([m.ravel() for m in part]) for part in maps)
    common = (sweep > 0) & (matched > 0)
    off = np.abs(sweep - matched)[common] / sweep[common]
    note = f"{len(maps[0])} photos; plane sweep on the GPU {taken[0]:.1f} s; depth in {(sweep > 0).mean():.3f}, "
    note += f"{(matched > 0).mean():.3f} of the pixels; median difference"
    return Row("", "", float(np.median(off)), 2e-3, np.nan, taken[1], note)


def whole_object(folder: Path) -> Row:
    """The four stages of a finished object again, on the GPU: held-out PSNR beside the CPU's."""
    from scenefuse.core.stage import read_json, value
    from scenefuse.nerf.depth_prior import estimate_depth_prior
    from scenefuse.nerf.rendered_maps import refine_depth
    from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, train_object_nerf

    settings = read_settings(ROOT / "config/demo.yaml")["object"]
    held, width = settings["hold_out_every"], settings["nerf"]["width_px"]
    taken = {}
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        photos = {"workspace": folder / "undistorted", "masks": folder / "masks"}
        places = [{"stage": out / f"stage{k}", "report": out / f"stage{k}.json"} for k in range(5)]

        def nerf(k: int, previous: Path | None) -> None:
            train_object_nerf(
                inputs=NerfInputs(**photos, prior=out / f"stage{k - 1}", previous=previous),
                stage=places[k]["stage"],
                report=places[k]["report"],
                checkpoints=out / "checkpoints",
                settings=build(NerfSettings, settings["nerf"] | settings[f"stage{k}"]),
                hold_out_every=held,
                seed=0,
            )

        steps: dict[int, Callable[[], None]] = {
            1: lambda: estimate_depth_prior(
                workspace=photos["workspace"],
                masks=photos["masks"],
                stage=places[1]["stage"],
                report=places[1]["report"],
                width_px=width,
                hold_out_every=held,
            ),
            2: lambda: nerf(2, None),
            3: lambda: refine_depth(
                **photos, rendered=out / "stage2", **places[3], width_px=width, hold_out_every=held
            ),
            4: lambda: nerf(4, out / "stage2"),
        }
        for k, step in steps.items():
            start = time.perf_counter()
            step()
            taken[k] = time.perf_counter() - start
        there, here = (read_json(at / "stage4.json") for at in (out, folder))
        before = [value(read_json(folder / f"stage{k}.json"), "seconds") for k in range(1, 5)]
    quality = [value(report, "psnr_held_out") for report in (here, there)]
    note = f"held-out {quality[0]:.2f} dB, {quality[1]:.2f} dB; stages " + ", ".join(f"{s:.1f}" for s in taken.values())
    note += " s; CPU " + ", ".join(f"{s:.0f}" for s in before)
    return Row("", "", quality[0] - quality[1], 0.4, sum(before), sum(taken.values()), note)


def lego_to_30_db(data: Path) -> Row:
    """Lego at 400 px, test views of whole pictures on white: seconds of training to 30 dB."""
    import contextlib
    import io
    import re

    from benchmarks.lego import lego

    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        lego(data=data, every=3.0, device=GPU, threads=4)
    text = said.getvalue()
    print(text, flush=True)
    found = re.search(r"30 dB after (\d+) s", text)
    last = re.search(r"PSNR ([\d.]+) dB", text)
    seconds = float(found[1]) if found else np.nan
    return Row("", "", 30 - float(last[1]) if last else np.nan, 0, np.nan, seconds, text.strip().splitlines()[-1])


if __name__ == "__main__":
    run(gpu)
