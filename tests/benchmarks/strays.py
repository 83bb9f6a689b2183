"""Points of a finished demo that photos confirm though they lie far from every true surface, of both sources.

PYTHONPATH=. python tests/benchmarks/strays.py --results results
"""

from pathlib import Path

import pandas as pd

from demo.evaluate import read_object_truth
from demo.truth import distances
from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import read_json, run, value
from scenefuse.core.transforms import Sim3
from scenefuse.fuse.measure import Evidence
from scenefuse.fuse.write import Source

# Shares of the diagonal beyond which a point is counted.
FAR = (0.005, 0.01)


def strays(
    *,
    results: Path = Path("results"),
    objects: tuple[str, ...] = ("house", "balloon", "sculpture"),
    out: Path = Path("results/bench/strays.tsv"),
) -> None:
    """Print of the points of `fused.ply` with `evidence` 1 how many are far off.

    Args:
        results: folder of a finished demo.
        objects: which.
        out: the same (TSV).
    """
    truth, rows = results / "demo/demo/truth", []
    truth_from_scene = Sim3.from_matrix(value(read_json(results / "scenes/demo/truth.json"), "truth_from_scene"))
    for name in objects:
        folder = results / "objects" / name
        known = read_object_truth(folder / "undistorted", truth / "scene", truth / name, 1, seed=0)
        cloud = read_cloud(folder / "fused.ply")
        away = distances(known.everything, truth_from_scene.apply(cloud.points)) / known.diagonal
        for source in Source:
            own = (cloud.fields["source"] == source) & (cloud.fields["evidence"] == Evidence.MEASURED)
            row = {"object": name, "source": source.name.lower(), "measured": int(own.sum())}
            rows.append(row | {f"beyond_{100 * share:g}_pct": int((away[own] > share).sum()) for share in FAR})
    table = pd.DataFrame(rows)
    out.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(out, sep="\t", index=False)
    print(table.to_string(index=False))


if __name__ == "__main__":
    run(strays)
