"""Seconds from a click to SAM 2's mask of a photo, as the clicking page makes it, with features computed before.

python tests/benchmarks/click_seconds.py --photo data/bronze_statue/near/DSC_0354.JPG --weights results/weights/sam2
"""

import time
from functools import partial
from pathlib import Path

import numpy as np

from scenefuse.core.stage import run
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.propagation import one_photo
from scenefuse.masks.sam2 import Sam2, query_sam2
from scenefuse.masks.segmentation import MaskSettings
from scenefuse.photos.pictures import read_rgb
from scenefuse.photos.workspace import View

REPEATS = 5


def click_seconds(*, photo: Path, weights: Path, clicks: int = 5, threads: int = 2) -> None:
    """Print the median seconds for one click to several, at random in the photo's middle third.

    Args:
        photo: to click in.
        weights: folder of SAM 2's `encoder.ort` and `decoder.onnx`.
        clicks: at most.
        threads: of the network.
    """
    pixels = read_rgb(photo)
    height, width = pixels.shape[:2]
    network = Sam2(weights / "encoder.ort", weights / "decoder.onnx", threads)
    network.encode(pixels)
    view = View(photo.name, np.eye(3), np.eye(4), width, height, pixels)
    places = np.random.default_rng(0).uniform(1 / 3, 2 / 3, (clicks, 2)) * [width, height]
    for count in range(1, clicks + 1):
        took = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            given = PhotoClicks(places[:count], np.ones(count, dtype=bool))
            one_photo(partial(query_sam2, network), view, given, MaskSettings().max_click_residual_px)
            took.append(time.perf_counter() - start)
        print(f"{width} x {height}, {count} clicks: {np.median(took):.2f} s (worst {max(took):.2f})", flush=True)


if __name__ == "__main__":
    run(click_seconds)
