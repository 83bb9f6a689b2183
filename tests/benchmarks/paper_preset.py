"""The paper by its letter beside the shipped recipe, on a finished demo: one table an object, and a row a stage.

make demo; then python tests/benchmarks/paper_preset.py --results results --objects sculpture

The paper's stages 1 to 4, cloud, crop, registration and fusion run from the demo's scene, undistorted photos and masks:
once on the poses that the pose network chains, once on SfM's. Where a stage ends in an error, the table says so, and
what follows is empty. A second call goes on where the first was stopped. `null` is what chance gives: cameras that all
stand in their middle, depth that is the same all over a photo, a random cloud in the place of the object's points.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from scenefuse.depth.refine_depth import EarlierStages
from scenefuse.fusion.fuse_object import FusionInputs, FusionOutputs, fuse_object
from scenefuse.fusion.modes import FusionSettings
from scenefuse.io.clouds import Cloud, read_cloud
from scenefuse.io.settings import ROOT, build, read_settings
from scenefuse.metrics.completion import MetricSettings
from scenefuse.metrics.compute_metrics import compute_metrics
from scenefuse.metrics.evaluate_object import ObjectEvaluationSettings
from scenefuse.metrics.object_truth import ObjectTruth, cloud_results, depth_results, read_object_truth
from scenefuse.metrics.truth import registration_error, true_depth
from scenefuse.mvs.photo_refinement import RefinementSettings
from scenefuse.nerf.object_cloud import CloudInputs, CloudSettings, make_object_cloud
from scenefuse.nerf.train_object_nerf import NerfSettings
from scenefuse.paper.estimate_as_paper import PoseSource, StageOutputs, estimate_as_paper
from scenefuse.paper.monocular import MonocularSettings
from scenefuse.paper.refine_as_paper import refine_as_paper
from scenefuse.paper.train_nerf_as_paper import train_nerf_as_paper
from scenefuse.registration.agreement import AgreementSettings, registration_metrics
from scenefuse.registration.crop.crop_cloud import CropSettings
from scenefuse.registration.crop.crop_scene import CropInputs, crop_scene
from scenefuse.registration.paper import register_as_paper
from scenefuse.registration.problem import Inputs
from scenefuse.stage import StageError, read_json, run, value
from scenefuse.transforms import Sim3

# Tables 2 to 4 of the paper, on its own captures: house, balloon, sculpture. It gives RMSE in metres, and no diagonal
# to divide it by.
PUBLISHED = {
    "fitness": (0.9302, 0.9916, 0.9207),
    "inlier_rmse": (0.0852, 0.0096, 0.0348),
    "normal_consistency": (0.6023, 0.6210, 0.7948),
    "surface_variation": (0.1597, 0.1897, 0.1219),
    "nue": (1.17, 1.29, 1.21),
    "primitive_fitting_score": (0.9984, 0.9954, 0.9975),
    "fitness, no_scale": (0.3083, 0.0820, 0.3085),
    "inlier_rmse, no_scale": (0.2614, 0.1810, 0.3724),
    "normal_consistency, no_scale": (0.4448, 0.2196, 0.4834),
    "fitness, no_crop": (0.4129, 0.5876, 0.3621),
    "inlier_rmse, no_crop": (0.4424, 0.1804, 0.0655),
    "normal_consistency, no_crop": (0.3056, 0.5695, 0.7373),
}
# The paper's ablation of the registration: where the run of each arm is, its crop and its scale.
ARMS: dict[str, tuple[bool, Literal["ransac_svd", "none"]]] = {
    "full": (False, "ransac_svd"),
    "no_scale": (False, "none"),
    "no_crop": (True, "ransac_svd"),
}
OBJECTS = ("house", "balloon", "sculpture")
REGISTRATION = ("fitness", "inlier_rmse", "inlier_rmse_over_diagonal", "normal_consistency")
COMPLETION = ("surface_variation", "nue", "primitive_fitting_score")
SCORES = {"0.5": "05pct", "1": "1pct", "2": "2pct"}
TRAJECTORY, TURNED = "trajectory error over extent", "rotation error of the cameras (deg)"
POSES = {
    TRAJECTORY: "trajectory_error_chain_over_extent",
    TURNED: "rotation_error_chain_deg",
    "rotation error of one motion (deg)": "pose_network_rotation_error_deg",
}
COLUMNS = {"chain": "paper preset, chained poses", "sfm": "paper preset, SfM's poses"}
# Of the true depth maps that the null is measured on.
WIDTH_PX = 160


def reconstruct(folder: Path, of: Path, settings: dict[str, Any], source: PoseSource) -> None:
    """Stages 1 to 4 and the cloud of one object into `folder`; a stage whose report is there is left out.

    Raises:
        StageError: of the first stage that cannot go on.
    """
    own, masks = settings["object"], of / "masks"
    common: dict[str, Any] = {"hold_out_every": own["hold_out_every"], "seed": settings["seed"]}

    def done(name: str) -> bool:
        return (folder / f"{name}.json").is_file()

    def outputs(stage: str, posed: str) -> StageOutputs:
        return StageOutputs(folder / stage, folder / f"{stage}.json", folder / posed, folder / f"{posed}.json")

    def nerf(stage: str, prior: str, posed: str) -> None:
        if not done(stage):
            train_nerf_as_paper(
                workspace=folder / posed, masks=masks, prior=folder / prior, stage=folder / stage,
                report=folder / f"{stage}.json", checkpoints=folder / "checkpoints" / stage,
                settings=build(NerfSettings, own["nerf"] | own[stage]), **common,
            )  # fmt: skip

    if not done("stage1"):
        estimate_as_paper(
            workspace=of / "undistorted", masks=masks, outputs=outputs("stage1", "poses"), pose_source=source,
            checkpoints=folder / "checkpoints/stage1", settings=MonocularSettings(own["stage1"]["epochs"]), **common,
        )  # fmt: skip
    nerf("stage2", "stage1", "poses")
    if not done("stage3"):
        refine_as_paper(
            workspace=of / "undistorted", masks=masks, poses=folder / "poses", pose_source=source,
            earlier=EarlierStages(folder / "stage1", folder / "stage2"), outputs=outputs("stage3", "refined_poses"),
            checkpoints=folder / "checkpoints/stage3", settings=MonocularSettings(own["stage3"]["epochs"]), **common,
        )  # fmt: skip
    nerf("stage4", "stage3", "refined_poses")
    if not done("object"):
        posed, last = folder / "refined_poses", folder / "stage4"
        as_rendered = replace(build(CloudSettings, own["cloud"]), refinement=RefinementSettings(match_reach_px=0))
        make_object_cloud(
            inputs=CloudInputs(posed, posed.with_suffix(".json"), masks, last, last.with_suffix(".json")),
            cloud=folder / "object.ply", report=folder / "object.json", settings=as_rendered, seed=settings["seed"],
        )  # fmt: skip


def join(folder: Path, of: Path, scene: Path, fiducials: Path, settings: dict[str, Any]) -> None:
    """Crop, registration, fusion and metrics of the paper, at the thresholds of the demo's own run; its ablation."""
    marked = CropInputs(scene / "dense.ply", scene / "georeferenced", scene / "georeference.json", fiducials)
    box, reference = build(CropSettings, settings["registration"]["crop"]), of / "registration/full"
    measured: dict[str, Any] = {
        "crop": reference / "crop.ply", "crop_json": reference / "crop.json", "seed": settings["seed"],
        "object": folder / "object.ply", "settings": build(MetricSettings, settings["metrics"]),
    }  # fmt: skip
    for arm, (whole, scale) in ARMS.items():
        made = folder / "registration" / arm
        made.mkdir(parents=True, exist_ok=True)
        crop, crop_json = made / "crop.ply", made / "crop.json"
        crop_scene(inputs=marked, crop=crop, report=crop_json, settings=replace(box, whole_scene=whole, minimal=True))
        register_as_paper(
            inputs=Inputs(folder / "object.ply", crop, crop_json, of / "undistorted.json"), scale=scale,
            scale_report=made / "scale.json", coarse_report=made / "coarse.json", report=made / "fine.json",
            picture=made / "fine.png", seed=settings["seed"],
        )  # fmt: skip
        if arm != "full":
            compute_metrics(fine_json=made / "fine.json", report=made / "metrics.json", **measured)
    made = folder / "registration/full"
    ways = {"fused": "fused.ply", "checked": "checked.ply", "evidence": "evidence.json", "report": "fusion.json"}
    fuse_object(
        inputs=FusionInputs(folder / "object.ply", scene / "dense.ply", made / "crop.ply", made / "crop.json",
                            made / "fine.json", georeference_json=scene / "georeference.json"),
        outputs=FusionOutputs(**{name: folder / file for name, file in ways.items()}),
        settings=replace(build(FusionSettings, settings["fusion"]), mode="append"),
    )  # fmt: skip
    report, fused = folder / "metrics.json", folder / "fused.ply"
    compute_metrics(fine_json=made / "fine.json", fused=fused, report=report, **measured)


def of_run(folder: Path, known: ObjectTruth, true: Sim3, settings: dict[str, Any]) -> dict[str, Any]:
    """All measures of a run, as far as it came; lengths in % of the object's diagonal, errors against the truth."""
    limits = build(ObjectEvaluationSettings, settings["evaluation"]["object"])
    rows = of_stages(folder, known, limits.max_photos)
    if (folder / "object.ply").is_file():
        points = known.fit.truth_from_model.apply(read_cloud(folder / "object.ply").points)
        cloud = cloud_results(points, known, limits.samples, settings["seed"])
        rows |= {f"cloud: F {name} %": value(cloud, f"cloud_f_score_{key}") for name, key in SCORES.items()}
    fine = folder / "registration/full/fine.json"
    if fine.is_file() and (folder / "metrics.json").is_file():
        pose = Sim3.from_matrix(np.array(value(read_json(fine), "scene_from_object")))
        middle = known.fit.truth_from_model.inverse().apply(known.middle)
        error = registration_error(pose, true, middle, known.diagonal)
        rows |= {"scale error (%)": error.scale_pct, "rotation error (deg)": error.rotation_deg}
        rows["shift (%)"] = 100 * error.translation_over_diagonal
        measured = read_json(folder / "metrics.json")
        rows |= {name: value(measured["registration"], name) for name in REGISTRATION}
        rows |= {name: value(measured["completion"], name) for name in COMPLETION}
        for arm in ("no_scale", "no_crop"):
            found = read_json(folder / f"registration/{arm}/metrics.json")["registration"]
            rows |= {f"{name}, {arm}": value(found, name) for name in REGISTRATION}
    return rows


def of_stages(folder: Path, known: ObjectTruth, max_photos: int) -> dict[str, Any]:
    """What each of the four stages that are there came to: poses, depth, renders, rays and seconds."""
    rows: dict[str, Any] = {}
    reports = {n: read_json(folder / f"stage{n}.json") for n in (1, 2, 3, 4) if (folder / f"stage{n}.json").is_file()}
    for number in sorted(reports.keys() & {1, 3}):
        rows |= {f"{name}, stage {number}": pose for name, pose in of_poses(reports[number], known).items()}
    depths = depth_results([folder / f"stage{number}" for number in reports], known, max_photos)
    for number, report in reports.items():
        error = value(depths, f"stage{number}_depth_error")
        rows[f"depth error, stage {number} (%)"] = None if error is None else 100 * error
        rows[f"depth within 1 %, stage {number}"] = value(depths, f"stage{number}_depth_within_1pct")
        rows[f"seconds, stage {number}"] = value(report, "seconds")
    for number in sorted(reports.keys() & {2, 4}):
        rows[f"held-out PSNR, stage {number} (dB)"] = value(reports[number], "psnr_held_out")
        rows[f"rays, stage {number} (million)"] = _rays(reports[number]) / 1e6
        if "seconds_estimated_paper" in reports[number]:
            rows[f"seconds of the paper's rays, stage {number}"] = value(reports[number], "seconds_estimated_paper")
    return rows


def of_poses(report: dict[str, Any], known: ObjectTruth) -> dict[str, float]:
    """Errors of the pose network's chain and motions, against SfM; of the shipped recipe, those of SfM itself."""
    if "pose_source" in report:
        return {name: value(report, key) for name, key in POSES.items() if key in report}
    extent = np.linalg.norm(np.ptp([view.centre for view, _ in known.posed], axis=0)) * known.fit.truth_from_model.scale
    position = float(np.sqrt(np.mean(known.fit.position**2)) / extent)
    return {TRAJECTORY: position, TURNED: float(np.median(known.fit.rotation_deg))}


def _rays(report: dict[str, Any]) -> float:
    """Rays that a NeRF stage drew; of the shipped recipe, from its speed."""
    if "rays_per_epoch" in report:
        return float(value(report, "epochs") * value(report, "rays_per_epoch"))
    return float(value(report, "rays_per_second") * value(report, "training_seconds"))


def of_chance(of: Path, paper: Path, known: ObjectTruth, settings: dict[str, Any]) -> dict[str, Any]:
    """The same measures of nothing, see the module's text; `paper` holds a run of stage 1."""
    centres = np.array([view.centre for view, _ in known.posed])
    extent = np.linalg.norm(np.ptp(centres, axis=0))
    still = float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()) / extent)
    reference = of / "registration/full"
    crop, diagonal = read_cloud(reference / "crop.ply"), value(read_json(reference / "crop.json"), "diagonal")
    rng = np.random.default_rng(settings["seed"])
    random = rng.uniform(crop.points.min(0), crop.points.max(0), (len(read_cloud(of / "object.ply")), 3))
    tau = AgreementSettings().tau_fraction * diagonal
    found = registration_metrics(Cloud(random), crop, Sim3.identity(), tau, diagonal, "m")
    completion = read_json(of / "metrics.json")["completion"]
    motion = value(read_json(paper / "stage1.json"), "pose_network_rotation_to_find_deg")
    return {
        **{f"{TRAJECTORY}, stage {number}": still for number in (1, 3)},
        **{f"rotation error of one motion (deg), stage {number}": motion for number in (1, 3)},
        **{f"depth error, stage {number} (%)": flat_depth_error(known) for number in (1, 2, 3, 4)},
        **{name: value(found, name) for name in REGISTRATION},
        **{name: value(completion, f"{name}_null") for name in COMPLETION},
    }


def flat_depth_error(known: ObjectTruth) -> float:
    """Median error of the median depth of the object in each photo, taken everywhere, in % of the diagonal."""
    errors = []
    for view, _ in known.posed[:: max(1, len(known.posed) // 8)]:
        size = WIDTH_PX, round(WIDTH_PX * view.height / view.width)
        true, hit = true_depth(known.everything, view, known.fit.truth_from_model, size)
        own = true[hit == 0]
        errors.append(np.abs(own - np.median(own)))
    return 100 * float(np.median(np.concatenate(errors))) / known.diagonal


def paper_preset(
    *,
    results: Path = Path("results"),
    out: Path | None = None,
    objects: tuple[str, ...] = OBJECTS,
    poses: tuple[PoseSource, ...] = ("chain", "sfm"),
    settings: Path = ROOT / "config/paper.yaml",
) -> None:
    """Run the paper's recipe on a finished demo and print it beside the shipped one; rows go to paper_preset.tsv.

    Args:
        results: folder of a finished demo.
        out: folder of the runs and of the table; bench/paper in the results if not given.
        objects: of the demo.
        poses: whose poses stages 2 to 4 use.
        settings: of the paper.
    """
    chosen, out = read_settings(settings), out or results / "bench/paper"
    scene, truth = results / "scenes/demo", results / "demo/demo/truth"
    truth_from_scene = Sim3.from_matrix(np.array(value(read_json(scene / "truth.json"), "truth_from_scene")))
    samples = chosen["evaluation"]["object"]["samples"]
    rows = []
    for name in objects:
        of = results / "objects" / name
        known = read_object_truth(of / "undistorted", truth / "scene", truth / name, samples, chosen["seed"])
        true = truth_from_scene.inverse() @ known.fit.truth_from_model
        columns: dict[str, dict[str, Any]] = {
            "paper (published, its own data)": {key: cells[OBJECTS.index(name)] for key, cells in PUBLISHED.items()}
        }
        for source in poses:
            folder = out / name / source
            stopped = "nothing stopped it"
            try:
                reconstruct(folder, of, chosen, source)
                if not (folder / "metrics.json").is_file():
                    join(folder, of, scene, results / "demo/demo" / name / "fiducials.tsv", chosen)
            except StageError as error:
                stopped = str(error)
                print(f"{name}, poses by {source}: {error}", flush=True)
            columns[COLUMNS[source]] = {"stopped by": stopped, **of_run(folder, known, true, chosen)}
        columns["scenefuse"] = of_run(of, known, true, chosen)
        columns["null"] = of_chance(of, out / name / poses[0], known, chosen)
        ours_first = [cells for name, cells in columns.items() if name in COLUMNS.values()]
        measures = dict.fromkeys(key for cells in [*ours_first[::-1], *columns.values()] for key in cells)
        for measure in measures:
            row = {column: _five_digits(cells.get(measure)) for column, cells in columns.items()}
            rows.append({"object": name, "measure": measure} | row)
    table = pd.DataFrame(rows)
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / "paper_preset.tsv", sep="\t", index=False)
    print_table(table)


def _five_digits(cell: Any) -> Any:
    return float(f"{cell:.5g}") if isinstance(cell, float) else cell


def print_table(table: pd.DataFrame) -> None:
    """The rows as Markdown."""
    print("\n| " + " | ".join(table.columns) + " |\n|" + "---|" * len(table.columns))
    for row in table.itertuples(index=False):
        cells = [f"{c:.3g}" if isinstance(c, float) else str(c) for c in row]
        print("| " + " | ".join("" if cell in ("nan", "None") else cell for cell in cells) + " |")


if __name__ == "__main__":
    run(paper_preset)
