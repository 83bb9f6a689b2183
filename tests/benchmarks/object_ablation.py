"""What each part of the four stages is worth: objects again without it, over seeds, against a truth if there is one.

make demo; then
python tests/benchmarks/object_ablation.py --results results --objects house --seeds 3 --settings config/demo.yaml

The same command goes on after it was stopped: runs that stand in bench/object_ablation.tsv are not made again.
"""

import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch

from demo.evaluate import (
    COMPARED_PHOTOS,
    ObjectTruth,
    around_object,
    cloud_results,
    depth_results,
    read_object_truth,
)
from demo.truth import SAMPLES
from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import StageError, read_json, run, value
from scenefuse.nerf.object_cloud import CloudInputs, CloudSettings, make_object_cloud
from scenefuse.nerf.rendered_maps import psnr, refine_depth
from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, train_object_nerf
from scenefuse.paper.estimate_as_paper import StageOutputs, estimate_as_paper
from scenefuse.paper.monocular import MonocularSettings
from scenefuse.photos.pictures import read_rgb
from scenefuse.photos.views import load_views

# Of stage 1 in config/paper.yaml.
PAPER_EPOCHS = 15


@dataclass(frozen=True)
class Variant:
    """What differs from the full recipe."""

    nerf: dict[str, Any] = field(default_factory=dict)
    masks: bool = True
    prior: bool = True
    feedback: bool = True
    papers_stage1: bool = False
    """the paper's stage 1 from SfM's poses as the prior of both NeRF stages"""
    long: bool = False
    """stage 2 alone, with stage 4's epochs added"""


VARIANTS = {
    "full": Variant(),
    "no_masks": Variant(nerf={"mask_weight": 0, "sparsity_weight": 0}, masks=False),
    "no_depth": Variant(nerf={"depth_weight": 0}, prior=False),
    "no_feedback": Variant(feedback=False),
    "no_samples_at_prior": Variant(nerf={"prior_share": 0.0}),
    "papers_rates": Variant(nerf={"learning_rate": 1e-3, "grid_learning_rate": 1e-3, "warmup_epochs": 2}),
    "stage2_longer": Variant(long=True),
    "papers_stage1": Variant(papers_stage1=True, feedback=False),
}


def one(
    folder: Path, truth: ObjectTruth | None, variant: Variant, seed: int, settings: dict[str, Any], photos: int
) -> dict[str, Any]:
    """Stages 2 to 4 and the cloud of one object again, from the workflow's cameras, masks and stage 1, and measured."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        masks = folder / "masks" if variant.masks else white(folder / "masks", work / "masks")
        common = {"checkpoints": work / "checkpoints", "hold_out_every": settings["hold_out_every"], "seed": seed}

        def nerf(stage: int, prior: Path, previous: Path | None, epochs: int) -> None:
            own = settings["nerf"] | variant.nerf | {"epochs": epochs}
            train_object_nerf(
                inputs=NerfInputs(folder / "undistorted", masks, prior if variant.prior else None, previous),
                stage=work / f"stage{stage}",
                report=work / f"stage{stage}.json",
                settings=build(NerfSettings, own),
                **common,
            )

        early, late = settings["stage2"]["epochs"], settings["stage4"]["epochs"]
        prior = folder / "stage1"
        if variant.papers_stage1:
            prior, posed = work / "stage1", work / "poses"
            estimate_as_paper(
                workspace=folder / "undistorted", masks=masks, pose_source="sfm",
                outputs=StageOutputs(prior, work / "stage1.json", posed, work / "poses.json"),
                settings=MonocularSettings(PAPER_EPOCHS), **common,
            )  # fmt: skip
        nerf(2, prior, None, early + late if variant.long else early)
        if variant.feedback and variant.prior and not variant.long:
            prior = work / "stage3"
            refine_depth(
                workspace=folder / "undistorted", masks=masks, rendered=work / "stage2", stage=prior,
                report=work / "stage3.json", width_px=settings["nerf"]["width_px"],
                hold_out_every=settings["hold_out_every"],
            )  # fmt: skip
        if not variant.long:
            nerf(4, prior, work / "stage2", late)
        last = work / ("stage2" if variant.long else "stage4")
        seconds, fusing = time.monotonic() - start, settings["cloud"]
        measured = {
            "psnr_2": held_out_psnr(folder, work / "stage2", settings),
            "psnr_4": held_out_psnr(folder, last, settings),
            "silhouettes": value(read_json(last.with_suffix(".json")), "silhouette_iou"),
            **cloud(folder, masks, last, truth, fusing, seed),
            "seconds": seconds,
        }
        if truth is None:
            return measured
        depth = depth_results([work / "stage2", last], truth, photos)
        return measured | {
            "depth_2_pct": 100 * value(depth, "stage2_depth_error"),
            "depth_4_pct": 100 * value(depth, f"{last.name}_depth_error"),
            "within_4": value(depth, f"{last.name}_depth_within_1pct"),
            **as_rendered(cloud(folder, masks, last, truth, fusing | {"match_reach_px": 0}, seed)),
        }


def as_rendered(measures: dict[str, Any]) -> dict[str, Any]:
    """The measures of a cloud of depths that photos did not refine, under their own names."""
    return {f"{name}_rendered": measures[name] for name in ("accuracy_pct", "f_05", "f_1")}


def cloud(
    folder: Path, masks: Path, last: Path, truth: ObjectTruth | None, settings: dict[str, Any], seed: int
) -> dict[str, Any]:
    """The cloud of the last NeRF stage, whole, and only what of it is nearer to the object than to its surroundings.

    Without a truth, what its depths say of themselves: how many photos moved to where they match, how many no two views
    agree on.
    """
    path = last.with_name("object.ply")
    workspace = folder / "undistorted"
    inputs = CloudInputs(workspace, workspace.with_suffix(".json"), masks, last, last.with_suffix(".json"))
    wanted = build(CloudSettings, settings)
    try:
        make_object_cloud(inputs=inputs, cloud=path, report=path.with_suffix(".json"), settings=wanted, seed=seed)
    except StageError as error:
        print(f"no cloud: {error}", flush=True)
        return {"accuracy_pct": np.nan, "f_05": 0.0, "f_1": 0.0, "f_1_cut": 0.0}
    own = read_json(path.with_suffix(".json"))
    shares = {name: value(own, f"{name}_share") for name in ("refined", "inconsistent")}
    if truth is None:
        return shares
    points = truth.fit.truth_from_model.apply(read_cloud(path).points)
    near = around_object(points, truth)
    whole = cloud_results(points, truth, len(truth.surface), seed)
    alone = cloud_results(points[near], truth, len(truth.surface), seed) if near.any() else {}
    return shares | {
        "accuracy_pct": value(whole, "cloud_accuracy_median"),
        "f_05": value(whole, "cloud_f_score_05pct"),
        "f_1": value(whole, "cloud_f_score_1pct"),
        "f_1_cut": value(alone, "cloud_f_score_1pct") if alone else 0.0,
    }


def held_out_psnr(folder: Path, stage: Path, settings: dict[str, Any]) -> float:
    """Mean PSNR of the renders of held-out photos inside the workflow's masks, the same pixels for every variant."""
    views = load_views(
        folder / "undistorted", folder / "masks", settings["nerf"]["width_px"], settings["hold_out_every"]
    )
    scores = []
    for index in np.flatnonzero(views.held_out):
        picture = read_rgb(stage / "renders" / f"{Path(views.names[index]).stem}.png")
        render, photo = (torch.from_numpy(p).float() / 255 for p in (picture, views.images[index]))
        scores.append(psnr(render, photo, torch.from_numpy(views.masks[index])))
    return float(np.mean(scores))


def white(masks: Path, folder: Path) -> Path:
    """Masks of the same photos in which everything is the object."""
    folder.mkdir()
    for path in masks.glob("*.png"):
        cv2.imwrite(str(folder / path.name), np.full_like(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), 255))
    return folder


def object_ablation(
    *,
    results: Path = Path("results"),
    objects: tuple[str, ...] = ("house", "balloon", "sculpture"),
    seeds: int = 3,
    only: tuple[str, ...] = (),
    settings: Path | None = None,
) -> None:
    """Print mean and spread of every variant over seeds as Markdown; all runs go to bench/object_ablation.tsv.

    Stage 1 is the workflow's in every variant but `papers_stage1` (to compare with `no_feedback`). `no_masks` calls
    everything the object, for the NeRF and for the cloud; its cloud thus holds the surroundings, which `F 1 %, cut`
    leaves out. `no_depth` has no prior at all, `no_feedback` takes stage 1's depth in stage 4, `stage2_longer` has as
    many epochs without alternation.
    Depth errors are medians over pixels that truly show the object; without a truth, columns that need one are empty.

    Args:
        results: folder of a finished run.
        objects: of it; those of the demo have a truth.
        seeds: 0 to this.
        only: these variants; none for all.
        settings: laid over the shipped ones, or none.
    """
    shipped = read_settings(settings)
    own = shipped["object"]
    out = results / "bench/object_ablation.tsv"
    out.parent.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = pd.read_csv(out, sep="\t").to_dict("records") if out.is_file() else []
    done = {(row["object"], row["variant"], row["seed"]) for row in rows}
    chosen = {name: variant for name, variant in VARIANTS.items() if not only or name in only}
    for name in objects:
        folder, known = results / "objects" / name, results / "demo/demo/truth"
        truth = None
        if (known / name).is_dir():
            truth = read_object_truth(folder / "undistorted", known / "scene", known / name, SAMPLES, shipped["seed"])
        for seed in range(seeds):
            for variant in chosen:
                if (name, variant, seed) in done:
                    continue
                print(f"{name} {variant} {seed}", flush=True)
                measured = one(folder, truth, chosen[variant], seed, own, COMPARED_PHOTOS)
                rows.append({"object": name, "variant": variant, "seed": seed} | measured)
                pd.DataFrame(rows).to_csv(out, sep="\t", index=False, float_format="%.5g")
    print_table(pd.DataFrame(rows), seeds)


HEAD = {
    "depth_2_pct": "depth error after stage 2 (%)",
    "depth_4_pct": "after stage 4 (%)",
    "within_4": "within 1 %",
    "psnr_2": "PSNR, stage 2 (dB)",
    "psnr_4": "stage 4 (dB)",
    "silhouettes": "silhouettes",
    "refined": "depths that photos moved",
    "inconsistent": "inconsistent depths",
    "accuracy_pct": "cloud accuracy (%)",
    "f_05": "F 0.5 %",
    "f_1": "F 1 %",
    "f_1_cut": "F 1 %, cut",
    "accuracy_pct_rendered": "as rendered: accuracy (%)",
    "f_05_rendered": "F 0.5 %",
    "f_1_rendered": "F 1 %",
    "seconds": "seconds",
}


def print_table(table: pd.DataFrame, seeds: int) -> None:
    table = table.reindex(columns=["object", "variant", *HEAD])
    groups = table.groupby(["object", "variant"], sort=False)[list(HEAD)]
    means, spreads = groups.mean(), groups.std().fillna(0)
    print(f"\nMean ± standard deviation over {seeds} seeds; lengths in % of the object's diagonal.\n")
    print("| object | variant | " + " | ".join(HEAD.values()) + " |")
    print("|---|---|" + "---|" * len(HEAD))
    for key in means.index:
        cells = [f"{means.loc[key, c]:.3g} ± {spreads.loc[key, c]:.1g}" for c in HEAD]
        print(f"| {key[0]} | `{key[1]}` | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    run(object_ablation)
