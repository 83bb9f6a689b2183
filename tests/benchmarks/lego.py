"""NeRF-synthetic Lego: test PSNR over training time, on white and over whole pictures as in the literature.

python tests/benchmarks/lego.py --data data/lego
"""

import tempfile
import time
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch

from scenefuse.core.machine import use_threads
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import run
from scenefuse.mvs.undistort import UndistortSettings
from scenefuse.nerf.posed_photos import import_photos
from scenefuse.nerf.rays import PhotoTensors
from scenefuse.nerf.render import render_view
from scenefuse.nerf.rendered_maps import psnr, ssim
from scenefuse.nerf.train_object_nerf import NerfSettings, photo_tensors
from scenefuse.nerf.training import Nerf, Training, keep_memory, new_nerf, train
from scenefuse.nerf.volume import find_volume, silhouettes
from scenefuse.photos.views import load_views

GOALS_DB = (25, 28, 30, 32)
ROOT = Path(__file__).resolve().parents[2]
# What the command in config/examples/lego.yaml says by flags; with alpha, masks are exact.
FLAGS = {
    "epochs": 120,
    "images_per_batch": 16,
    "rays_per_image": 128,
    "learning_rate": 1e-2,
    "grid_learning_rate": 4e-2,
    "samples": 24,
    "coarse_until": 0.1,
    "mask_weight": 0.01,
    "render_samples": 48,
    "mask_band_px": 0,
}


def lego(
    *,
    data: Path,
    config: Path = ROOT / "config/examples/lego.yaml",
    every: float = 20.0,
    few: int = 5,
    threads: int = 2,
    device: Literal["cpu", "cuda"] = "cpu",
    seed: int = 0,
    pictures: Path | None = None,
) -> None:
    """Train, and print quality on the test views on the way and at the end; the time that measuring takes is left out.

    Args:
        data: folder with transforms_train.json and transforms_test.json.
        config: settings that differ from the shipped ones.
        every: seconds of training between two measurements.
        few: test views of each measurement on the way; the last one takes all.
        threads: CPU threads.
        device: where to train.
        seed: of all random choices.
        pictures: folder for renders beside photos, or none.
    """
    use_threads(threads)
    torch.backends.cuda.matmul.fp32_precision = "tf32"
    settings = read_settings(config)["object"]
    keep_memory()
    chosen = build(NerfSettings, settings["nerf"] | FLAGS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        places = {"workspace": folder / "undistorted", "mattes": folder / "masks", "report": folder / "photos.json"}
        import_photos(
            data=data, images=None, masks=None, **places, settings=build(UndistortSettings, settings["undistort"])
        )
        views = load_views(places["workspace"], places["mattes"], chosen.width_px, 0)
    start = time.perf_counter()
    trained, tested = np.flatnonzero(~views.held_out), np.flatnonzero(views.held_out)
    outlines = silhouettes(views.masks[trained], None, views.intrinsics[trained], views.object_from_cam[trained])
    volume = find_volume(outlines, chosen.recipe.occupancy_cells, chosen.hull_tolerance)
    photos = photo_tensors(views, volume.nerf_from_object, None, exact=True)
    nerf = new_nerf(chosen.field, torch.from_numpy(volume.hull), len(trained), seed, device)
    training = Training(photos.select(trained), chosen.schedule, chosen.recipe, chosen.losses, warm=False, seed=seed)
    seconds = time.perf_counter() - start
    print(f"hull {volume.hull.mean():.1%} of the cube in {seconds:.1f} s, {training.steps} steps", flush=True)
    samples = chosen.maps.render_samples
    clock = Clock(every, nerf, photos.select(tested[:: max(1, len(tested) // few)]), samples)
    train(nerf, training, checkpoint=None, report=clock.tick)
    seconds, cpu = clock.trained()
    for goal in GOALS_DB:
        first = next((f"after {wall:.0f} s" for wall, quality in clock.history if quality >= goal), "not reached")
        print(f"{goal} dB {first}")
    quality, structure = measure(nerf, photos.select(tested), samples, pictures)
    print(
        f"{len(tested)} test views after {seconds:.0f} s ({cpu:.0f} s CPU): PSNR {quality:.2f} dB, SSIM {structure:.4f}"
    )


class Clock:
    """Measures on the way, at training's own progress lines, and leaves the time out that this takes."""

    def __init__(self, every: float, nerf: Nerf, photos: PhotoTensors, samples: int) -> None:
        self.every, self.nerf, self.photos, self.samples = every, nerf, photos, samples
        self.start, self.last = np.array([time.perf_counter(), time.process_time()]), 0.0
        self.history: list[tuple[float, float]] = []

    def trained(self) -> tuple[float, float]:
        """Seconds of training so far: wall time and CPU time of all threads."""
        wall, cpu = np.array([time.perf_counter(), time.process_time()]) - self.start
        return float(wall), float(cpu)

    def tick(self, line: str) -> None:
        """Print a progress line and the quality, when it is time."""
        wall, cpu = self.trained()
        if wall - self.last < self.every:
            return
        self.last = wall
        quality, _ = measure(self.nerf, self.photos, self.samples, None)
        self.history.append((wall, quality))
        self.start += np.array(self.trained()) - (wall, cpu)
        print(
            f"{wall:5.0f} s ({cpu:5.0f} s CPU)  {quality:.2f} dB on {len(self.photos)} test views | {line}", flush=True
        )


def measure(nerf: Nerf, photos: PhotoTensors, samples: int, pictures: Path | None) -> tuple[float, float]:
    """Mean PSNR and SSIM of whole pictures on white; every pixel is rendered, whatever the mask says."""
    rows = []
    for view in range(len(photos)):
        everything = torch.ones(photos.masks.shape[1:], dtype=torch.bool)
        rendered = render_view(nerf.field, nerf.occupancy, photos.camera(view), everything, samples, colored=True)
        matte = photos.mattes[view, ..., None].float() / 255.0
        photo = photos.images[view].float() / 255.0 * matte + 1 - matte
        picture = (rendered.color + 1 - rendered.opacity[..., None]).clamp(0, 1)
        rows.append((psnr(picture, photo, everything), ssim(picture, photo, everything)))
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            both = (torch.cat([photo, picture], 1).numpy() * 255 + 0.5).astype(np.uint8)
            cv2.imwrite(str(pictures / f"{view:03d}.png"), both[..., ::-1])
    quality, structure = np.mean(rows, axis=0)
    return float(quality), float(structure)


if __name__ == "__main__":
    run(lego)
