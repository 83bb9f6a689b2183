"""The paper's Table 4 on the demo: every registration variant over several seeds, at the full variant's thresholds.

snakemake --configfile config/demo.yaml --cores 2 \\
    --config 'registration={variants: [full, paper, clouds_only, no_scale, no_crop]}'
PYTHONPATH=. python tests/benchmarks/ablation.py --results results --seeds 3
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from demo.truth import fit_cameras, read_cameras, read_posed, registration_error
from scenefuse.cloud.clouds import Cloud, read_cloud
from scenefuse.core.settings import ROOT, build
from scenefuse.core.stage import read_json, run, value
from scenefuse.core.transforms import Sim3
from scenefuse.paper.register_as_paper import register_as_paper
from scenefuse.register.coarse import CoarseSettings
from scenefuse.register.decision import FineSettings
from scenefuse.register.problem import Inputs, ScaleSettings
from scenefuse.register.register_object import ConstraintFiles, register_object
from scenefuse.register.score import AgreementSettings, registration_metrics

OBJECTS = ("house", "balloon", "sculpture")


def one(results: Path, name: str, variant: str, seed: int, options: dict[str, Any], true: Sim3) -> dict[str, Any]:
    """Register one object again with another seed, from the workflow's crop, and measure it."""
    folder, scene = results / "objects" / name, results / "scenes/demo"
    made = folder / "registration" / variant
    inputs = Inputs(folder / "object.ply", made / "crop.ply", made / "crop.json", folder / "undistorted.json")
    with tempfile.TemporaryDirectory() as temporary:
        scale, coarse, fine = (Path(temporary) / f"{step}.json" for step in ("scale", "coarse", "fine"))
        if variant == "paper":
            register_as_paper(inputs=inputs, scale_report=scale, coarse_report=coarse, report=fine, seed=seed)
        else:
            depth = tuple(p for p in sorted((scene / "depth").iterdir()) if p.is_dir())
            evidence = ConstraintFiles(folder / "alignment.json", scene / "undistorted", depth)
            register_object(
                inputs=inputs, known=evidence, scale_report=scale, coarse_report=coarse, report=fine, seed=seed,
                scale=build(ScaleSettings, options.get("scale", {})),
                coarse=build(CoarseSettings, options.get("coarse", {})),
                settings=build(FineSettings, options.get("fine", {})),
            )  # fmt: skip
        found = read_json(fine)
    reference = read_json(folder / "registration/full/crop.json")
    obj, crop = read_cloud(folder / "object.ply"), read_cloud(folder / "registration/full/crop.ply")
    diagonal, measures = value(reference, "diagonal"), AgreementSettings()
    pose = Sim3.from_matrix(np.array(value(found, "scene_from_object")))
    measured = registration_metrics(obj, crop, pose, measures.tau_fraction * diagonal, diagonal, "m")
    error = registration_error(pose, true, *_size(obj, true))
    rmse = value(measured, "inlier_rmse")
    return {
        "object": name,
        "variant": variant,
        "seed": seed,
        "registered": value(found, "status") == "registered",
        "fitness": value(measured, "fitness"),
        "rmse_pct": np.nan if rmse is None else 100 * rmse / diagonal,
        "normals": value(measured, "normal_consistency"),
        "scale_pct": error.scale_pct,
        "rotation_deg": error.rotation_deg,
        "shift_pct": 100 * error.translation_over_diagonal,
    }


def _size(obj: Cloud, true: Sim3) -> tuple[np.ndarray, float]:
    """The object's middle in its own frame, and its diagonal in the scene's unit."""
    low, high = np.percentile(obj.points, [1, 99], axis=0)
    return obj.points.mean(0), true.scale * float(np.linalg.norm(high - low))


def ablation(*, results: Path = Path("results"), seeds: int = 3) -> None:
    """Print mean and spread of every variant over seeds; all trials go to bench/ablation.tsv in the results.

    Args:
        results: folder of a finished demo; the variants that it has are tried.
        seeds: 0 to this.
    """
    rows: list[dict[str, Any]] = []
    variants = yaml.safe_load((ROOT / "workflow/variants.yaml").read_text())
    truth = results / "demo/demo/truth"
    scene_cameras = read_cameras(truth / "scene/cameras.json")
    scene = fit_cameras(read_posed(results / "scenes/demo/georeferenced", scene_cameras), scene_cameras)
    for name in OBJECTS:
        cameras = read_cameras(truth / name / "cameras.json")
        orbit = fit_cameras(read_posed(results / f"objects/{name}/undistorted/sparse", cameras), cameras)
        true = scene.truth_from_model.inverse() @ orbit.truth_from_model
        rows += [
            one(results, name, variant, seed, options, true)
            for variant, options in variants.items()
            if (results / "objects" / name / "registration" / variant).is_dir()
            for seed in range(seeds)
        ]
    table = pd.DataFrame(rows)
    out = results / "bench/ablation.tsv"
    out.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(out, sep="\t", index=False, float_format="%.5g")
    columns = ["registered", "fitness", "rmse_pct", "normals", "scale_pct", "rotation_deg", "shift_pct"]
    groups = table.groupby(["object", "variant"], sort=False)[columns]
    means, spreads = groups.mean(), groups.std()
    print(
        f"{'object':10s} {'variant':11s}" + "".join(f"{c:>18s}" for c in columns) + f"   (mean ± sd over {seeds} seeds)"
    )
    for key in means.index:
        cells = "".join(f"{means.loc[key, c]:10.3g} ± {spreads.loc[key, c]:5.2g}" for c in columns[1:])
        print(f"{key[0]:10s} {key[1]:11s}{means.loc[key, 'registered']:18.2f}{cells}")


if __name__ == "__main__":
    run(ablation)
