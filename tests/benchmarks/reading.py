"""Processor seconds to read a million rows of text, PLY and PCD, beside pandas, Open3D and NumPy in the same run.

PYTHONPATH=tests python tests/benchmarks/reading.py
"""

import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import open3d as o3d
import pandas as pd
import tyro

from scenefuse.cloud.clouds import read_cloud


def reading(*, rows: int = 1_000_000, runs: int = 3) -> None:
    """Print the least seconds of each reader, and ours over the peer's.

    Args:
        rows: of each file.
        runs: of each reader, in turns.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = _files(Path(folder), rows)
        print(f"{'file':14}{'ours':>8}{'pandas':>16}{'Open3D':>16}{'NumPy':>16}   (seconds, ours over it)")
        for name, (path, above) in files.items():
            mark = "," if path.suffix == ".csv" else None
            peers: dict[str, Callable[[], object]] = {
                "ours": partial(read_cloud, path),
                "pandas": partial(pd.read_csv, path, sep=mark or r"\s+", skiprows=above, header=None, dtype=np.float64),
                "Open3D": partial(o3d.io.read_point_cloud, path),
                "NumPy": partial(np.loadtxt, path, skiprows=above, delimiter=mark),
            }
            if path.suffix == ".csv":
                del peers["Open3D"]  # which reads no commas
            seconds: dict[str, list[float]] = {peer: [] for peer in peers}
            for _ in range(runs):
                for peer, read in peers.items():
                    start = time.process_time()
                    read()
                    seconds[peer].append(time.process_time() - start)
            least = {peer: min(found) for peer, found in seconds.items()}
            cells = [
                f"{least[peer]:8.2f} ({least['ours'] / least[peer]:.2f})" if peer in least else "-"
                for peer in ("pandas", "Open3D", "NumPy")
            ]
            print(f"{name:14}{least['ours']:8.2f}" + "".join(f"{cell:>16}" for cell in cells))


def _files(folder: Path, rows: int) -> dict[str, tuple[Path, int]]:
    """Files of the same points with colours, and the lines above their rows."""
    rng = np.random.default_rng(0)
    table = np.hstack([rng.uniform(0, 100, (rows, 3)) + [5e5, 5.4e6, 300], rng.integers(0, 256, (rows, 3))])
    names = ("x", "y", "z", "red", "green", "blue")
    kinds = ["double"] * 3 + ["uchar"] * 3
    ply = ["ply", "format ascii 1.0", f"element vertex {rows}"]
    ply += [*(f"property {kind} {name}" for kind, name in zip(kinds, names)), "end_header"]
    pcd = ["VERSION 0.7", f"FIELDS {' '.join(names)}", "SIZE 8 8 8 1 1 1", "TYPE F F F U U U", "COUNT 1 1 1 1 1 1"]
    pcd += [f"WIDTH {rows}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {rows}", "DATA ascii"]
    heads = {"a.xyz": ["//x y z r g b"], "a.csv": [",".join(names)], "a.ply": ply, "a.pcd": pcd}
    for name, head in heads.items():
        mark = "," if name.endswith("csv") else " "
        form = mark.join(["%.4f"] * 3 + ["%d"] * 3)
        np.savetxt(folder / name, table, fmt=form, header="\n".join(head), comments="")
    return {name: (folder / name, len(head)) for name, head in heads.items()}


if __name__ == "__main__":
    tyro.cli(reading)
