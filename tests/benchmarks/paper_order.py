"""What the paper's relative depth does in its preset, beside the absolute depth of the same maps: stage 2 without it.

A finished run of config/paper.yaml with object.stage1.pose_source sfm; then
python tests/benchmarks/paper_order.py --results results --objects fountain --seeds 3
"""

import tempfile
from functools import partial
from pathlib import Path

from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import read_json, run, value
from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, train_object_nerf
from scenefuse.paper.train_nerf_as_paper import NERF, RANK_WEIGHT, OrderAndEdges, as_paper, rays_of_an_epoch

# So small a weight teaches nothing, and the loss is still measured.
NOTHING = 1e-9
PRESET = Path(__file__).parents[2] / "config/paper.yaml"
MEASURES = ("loss_rank", "loss_depth", "psnr_held_out", "silhouette_iou")


def paper_order(
    *,
    results: Path = Path("results"),
    objects: tuple[str, ...] = ("fountain",),
    seeds: int = 3,
    weights: tuple[float, ...] = (NOTHING, RANK_WEIGHT),
) -> None:
    """Print stage 2 of the preset with weights of the ranking loss, a line a run.

    Args:
        results: of a finished run of the preset.
        objects: of it.
        seeds: 0 to this.
        weights: of the ranking loss.
    """
    own = read_settings(PRESET)["object"]
    wanted = build(NerfSettings, own["nerf"] | {"epochs": own["stage2"]["epochs"]})
    print("| object | weight | seed | " + " | ".join(MEASURES) + " |\n|" + "---|" * (3 + len(MEASURES)))
    for name in objects:
        folder = results / "objects" / name
        workspace, masks = folder / "poses", folder / "masks"
        letter = rays_of_an_epoch(workspace, masks, wanted.width_px, own["hold_out_every"])
        preset = as_paper(wanted, letter, "cpu")
        for seed in range(seeds):
            for weight in weights:
                with tempfile.TemporaryDirectory() as temporary:
                    report = Path(temporary) / "stage2.json"
                    train_object_nerf(
                        inputs=NerfInputs(workspace, masks, folder / "stage1"), stage=report.with_suffix(""),
                        report=report, checkpoints=Path(temporary) / "checkpoints", settings=preset,
                        hold_out_every=own["hold_out_every"], seed=seed,
                        add=partial(OrderAndEdges, images=NERF.images_per_batch, rank_weight=weight),
                    )  # fmt: skip
                    cells = [f"{value(read_json(report), measure):.4g}" for measure in MEASURES]
                print(f"| {name} | {weight:g} | {seed} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    run(paper_order)
