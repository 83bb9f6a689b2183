"""What crops cost: cameras of square crops of photos beside those of the whole ones, by one lens and as shipped.

PYTHONPATH=. python tests/benchmarks/cropped_photos.py --photos data/bronze_statue/near --work results/bench/cropped
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base

from scenefuse.core.stage import run
from scenefuse.core.transforms import fit_sim3

SIDE_PX = 1024
MODES = {"whole": "auto", "one lens": "single", "as shipped": "auto"}
"""Settings of `camera_mode`, of the whole photos and of crops."""


def cropped_photos(*, photos: Path, work: Path) -> None:
    """Map a folder of photos with EXIF, and crops of them, and print how far crops' cameras are off.

    Args:
        photos: folder of photos whose EXIF has their size.
        work: output, a folder: crops, projects, cropped.tsv. What is there is not made again.
    """
    work = work.absolute()
    crops = work / "crops"
    if not crops.is_dir():
        crop(photos, crops)
    centres, rows = {}, []
    for name, mode in MODES.items():
        project = work / name.replace(" ", "_")
        if not project.is_dir():
            scene = photos.absolute() if name == "whole" else crops
            command = [sys.executable, "-m", "scenefuse"]
            subprocess.run([*command, "init", project, "--scene", scene], check=True)
            (project / "config/config.yaml").write_text(f"scene: {{ features: {{ camera_mode: {mode} }} }}\n")
            target = f"results/scenes/{scene.name}/sparse.json"
            subprocess.run([*command, "run", target, "--cores", "2"], check=True, cwd=project)
        model = pycolmap.Reconstruction(next(project.glob("results/scenes/*/sparse")))
        centres[name] = {i.name: i.projection_center() for i in map(model.image, model.reg_image_ids())}
        focal = [camera.mean_focal_length() for camera in model.cameras.values()]
        shared = sorted(centres[name].keys() & centres["whole"].keys())
        here, there = (np.array([centres[one][photo] for photo in shared]) for one in (name, "whole"))
        off = np.linalg.norm(fit_sim3(here, there).apply(here) - there, axis=1)
        radius = np.sqrt(there.var(0).sum())
        row = {"photos": len(shared), "rms_pct": 100 * np.sqrt((off**2).mean()) / radius}
        row |= {"largest_pct": 100 * off.max() / radius, "error_px": model.compute_mean_reprojection_error()}
        rows.append({"cameras": name} | row | {"focal_spread_pct": 100 * np.std(focal) / np.mean(focal)})
    table = pd.DataFrame(rows).round(3)
    table.to_csv(work / "cropped.tsv", sep="\t", index=False)
    print(table.to_string(index=False))


def crop(photos: Path, crops: Path) -> None:
    """Write a square of each photo, as wide as its shorter side, from anywhere in its middle three fifths."""
    rng = np.random.default_rng(0)
    crops.mkdir(parents=True)
    for path in sorted(photos.iterdir()):
        with Image.open(path) as image:
            exif, taken = Image.Exif(), image.getexif().get_ifd(IFD.Exif)
            kept = (Base.ExifImageWidth, Base.ExifImageHeight, Base.FocalLength, Base.FocalLengthIn35mmFilm)
            exif[IFD.Exif] = {tag: taken[tag] for tag in kept if tag in taken}
            whole = ImageOps.exif_transpose(image)
        side = min(whole.size)
        left, top = (int(rng.uniform(0.2, 0.8) * (size - side)) for size in whole.size)
        square = whole.crop((left, top, left + side, top + side)).resize((SIDE_PX, SIDE_PX), Image.Resampling.LANCZOS)
        square.save(crops / path.name, quality=95, exif=exif.tobytes())


if __name__ == "__main__":
    run(cropped_photos)
