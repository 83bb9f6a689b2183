"""Spoil a quarter of an object's masks, to see what wrong masks do to the completed scene.

cp -a results spoilt/results and work in spoilt/, a copy of the project. Then
PYTHONPATH=. python tests/benchmarks/spoil_masks.py --masks results/objects/house/masks
snakemake --configfile config/demo.yaml --cores 2 --rerun-triggers mtime -R estimate_depth_prior --allowed-rules \\
    estimate_depth_prior train_object_nerf refine_depth retrain_object_nerf make_object_cloud -- \\
    results/objects/house/object.ply
and give that cloud to completed_scene.py: --objects house --object spoilt/results/objects/house/object.ply
"""

from pathlib import Path

import cv2
import numpy as np

from scenefuse.core.stage import StageError, run
from scenefuse.photos.pictures import read_mask

EVERY = 4


def spoil_masks(*, masks: Path) -> None:
    """Replace every fourth mask, in name order and in turn by: its left half, its box grown by half, itself moved.

    Args:
        masks: folder of {photo}.png.

    Raises:
        StageError: fewer than four masks.
    """
    files = sorted(masks.glob("*.png"))
    if len(files) < EVERY:
        raise StageError(f"{masks} holds {len(files)} masks; make the object's masks first")
    for number, path in enumerate(files[::EVERY]):
        mask = read_mask(path)
        rows, columns = np.nonzero(mask)
        if len(rows) == 0:
            continue
        spoilt = [_left_half, _grown_box, _moved][number % 3](mask, columns, rows)
        cv2.imwrite(str(path), spoilt.astype(np.uint8) * 255)
        print(f"{path.name}: {np.count_nonzero(spoilt != mask) / len(rows):.0%} of its area wrong", flush=True)


def _left_half(mask: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    spoilt = mask.copy()
    spoilt[:, int(columns.mean()) :] = False
    return spoilt


def _grown_box(mask: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    spoilt, dx, dy = mask.copy(), np.ptp(columns) // 4, np.ptp(rows) // 4
    spoilt[max(0, rows.min() - dy) : rows.max() + dy, max(0, columns.min() - dx) : columns.max() + dx] = True
    return spoilt


def _moved(mask: np.ndarray, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    return np.roll(mask, int(np.ptp(columns)) // 3, axis=1)


if __name__ == "__main__":
    run(spoil_masks)
