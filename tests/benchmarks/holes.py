"""Why points of objects' clouds are not measured in their own photos, as shares of their surface.

PYTHONPATH=. python tests/benchmarks/holes.py --objects fountain/results/objects/object results/objects/house
"""

from pathlib import Path

import numpy as np
import pandas as pd

from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import read_json, run, threads, value
from scenefuse.fuse.fuse_object import photos_of
from scenefuse.fuse.measure import RESOLUTION, measure
from scenefuse.geometry.photo_check import CONFIRMING_PHOTOS, MIN_MATCH, Matches


def holes(*, objects: tuple[Path, ...], out: Path = Path("results/bench/holes.tsv")) -> None:
    """Print, for each object, the share of its cells (of a hundredth of its diagonal) that no measured point covers, by
    the first cause that holds for most of the cell's points; then what fusion found missing, of either side's photos.

    Args:
        objects: folders `results/objects/NAME` of finished runs.
        out: the same (TSV).
    """
    use_threads(threads())
    rows = []
    for folder in objects:
        cloud = read_cloud(folder / "object.ply")
        known = measure(cloud, photos_of(folder / "undistorted", cloud.points), cloud.diagonal)
        cells = np.floor(cloud.points / (RESOLUTION * cloud.diagonal)).astype(np.int64)
        cell = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
        row: dict[str, object] = {"object": f"{folder.parents[2].name}/{folder.name}"}
        without = np.bincount(cell, known.surface) == 0
        lacking = causes(known.matches)
        counts = np.stack([np.bincount(cell, own) for own in lacking.values()])
        cause = counts.argmax(0)
        for k, name in enumerate(lacking):
            row[name] = f"{100 * (without & (cause == k)).mean():.1f}"
        row["together"] = f"{100 * without.mean():.1f}"
        missing = read_json(folder / "missing.json")
        for name in ("never_seen", "untextured", "contradicted"):
            row[f"missing: {name}"] = f"{100 * value(missing, name):.1f}"
        rows.append(row)
        print(row, flush=True)
    table = pd.DataFrame(rows).set_index("object").T.rename_axis("share of the surface (%)")
    out.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(out, sep="\t")


def causes(matches: Matches) -> dict[str, np.ndarray]:
    """Why points are not measured, (N,) each: the first cause that holds."""
    conditions = {
        "fewer than three photos from useful angles": matches.tested + 1 < CONFIRMING_PHOTOS,
        "texture below 4 grey levels": ~matches.textured,
        "photos match nowhere on the ray": matches.best < MIN_MATCH,
        "too few photos confirm it, or match elsewhere": matches.photos < CONFIRMING_PHOTOS,
        "deviation above 1.2 pixels": ~matches.measured,
        "too few neighbours are measured": np.ones(len(matches.photos), dtype=bool),
    }
    left, found = np.ones(len(matches.photos), dtype=bool), {}
    for name, holds in conditions.items():
        found[name], left = left & holds, left & ~holds
    return found


if __name__ == "__main__":
    run(holes)
