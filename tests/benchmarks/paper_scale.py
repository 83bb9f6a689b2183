"""The paper's scale from FPFH matches beside the ratio of diagonals, by how alike matched edges have to be.

PYTHONPATH=tests python tests/benchmarks/paper_scale.py
"""

from unittest.mock import patch

import pandas as pd
from support.planted import plant

from scenefuse.core.stage import run
from scenefuse.paper import register_as_paper as paper
from scenefuse.register.problem import rms

EDGES = (0.9, 0.7, 0.5)
SHOWN = ((1.0, False), (0.6, False), (0.4, False), (0.6, True))


def paper_scale(*, shapes: tuple[str, ...] = ("house", "sculpture", "balloon"), seeds: int = 2) -> None:
    """Print how far off the scale is, in percent, for planted objects of which a scene shows a part.

    Args:
        shapes: planted objects.
        seeds: trials of each.
    """
    rows = []
    for shape, (coverage, ground), seed in ((s, c, k) for s in shapes for c in SHOWN for k in range(seeds)):
        trial = plant(shape, seed, coverage=coverage, ground=ground, object_points=8000, depth_maps=False)
        cloud, scene, true = trial.object, trial.scene, trial.scene_from_object.scale
        found = {"diagonals": scene.diagonal / cloud.diagonal, "rms": rms(scene.points) / rms(cloud.points)}
        for edge in EDGES:
            with patch.object(paper, "EDGE_LENGTH", edge):
                found[f"edges {edge}"] = paper.matched_scale(cloud, scene, 0)[0] or float("nan")
        off = {name: 100 * (scale / true - 1) for name, scale in found.items()}
        rows.append({"object": shape, "shown": coverage, "ground": ground, "seed": seed} | off)
    print(pd.DataFrame(rows).to_string(index=False, float_format="{:+.1f}".format))


if __name__ == "__main__":
    run(paper_scale)
