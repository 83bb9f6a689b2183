"""The paper by its letter beside the shipped recipe, from three finished runs: a table an object, a row a measure.

make demo
snakemake --configfile config/paper.yaml --directory paper --cores 2
snakemake --configfile config/paper.yaml --config "object={stage1: {pose_source: sfm}}" --directory paper_from_sfm \
    --cores 2
python tests/benchmarks/paper_preset.py --shipped results --chained paper/results --from-sfm paper_from_sfm/results

Its rows of the paper's Tables 2 to 4 are those of results/summary/paper.tsv (scenefuse/paper/compare_with_paper.py);
here are two runs of the preset side by side, and errors against the truth. Where a stage ended in an error, the table
says so, and what follows is empty; without a truth, so are errors. `null` is what chance gives: one motion, a random
one, from each frame to the next, depth that is the same all over a photo, a random cloud in the place of the object's
points, in the shipped run's crop or, for a run of the preset, in its own.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from demo.evaluate import ObjectTruth, cloud_results, depth_results, read_object_truth
from demo.truth import SAMPLES, registration_error, true_depth
from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.job_records import JobRecords, why_unfinished
from scenefuse.core.settings import read_settings
from scenefuse.core.stage import read_json, run, value
from scenefuse.core.transforms import Array, Sim3, rotation_angle_deg
from scenefuse.paper.compare_with_paper import (
    NULL,
    OBJECTS,
    PAPER,
    VARIANTS,
    column_of,
    null_of,
    published,
)
from scenefuse.paper.estimate_as_paper import trajectory_error
from scenefuse.photos.workspace import read_workspace
from scenefuse.report.run_summary import ObjectSummary, summarise_object

SCENE = "demo"
SCORES = {"0.5": "05pct", "1": "1pct", "2": "2pct"}
TRAJECTORY, TURNED = "trajectory error over extent", "rotation error of the cameras (deg)"
POSES = {
    TRAJECTORY: "trajectory_error_chain_over_extent",
    TURNED: "rotation_error_chain_deg",
    "rotation error of one motion (deg)": "pose_network_rotation_error_deg",
    "shift error of one motion over its length": "pose_network_translation_error",
}
CHAINED, FROM_SFM, SHIPPED = "paper preset, chained poses", "paper preset, SfM's poses", "scenefuse"
NULLS = {CHAINED: f"{NULL} of the preset, chained poses", FROM_SFM: f"{NULL} of the preset, SfM's poses"}
# Of the true depth maps that the null is measured on.
WIDTH_PX = 160
# Random motions that the null of a trajectory is the median of.
MOTIONS = 200


class Run:
    """What a run of the workflow made of an object, and the truth of it, where there is one."""

    def __init__(self, results: Path, name: str, seed: int) -> None:
        """Read the truth, and the poses of the object's model in it."""
        self.results, self.folder, self.seed = results, results / "objects" / name, seed
        self.jobs = JobRecords(results / "logs", results / "benchmarks")
        truth, self.known = results / "demo" / SCENE / "truth", None
        if (truth / name).is_dir():
            workspace = self.folder / "undistorted"
            self.known = read_object_truth(workspace, truth / "scene", truth / name, SAMPLES, seed)

    def collected(self) -> ObjectSummary:
        """What the summary would know of the object."""
        return summarise_object(self.folder, list(VARIANTS), self.jobs, SCENE)

    def measures(self) -> dict[str, Any]:
        """All measures, as far as the run came; lengths in % of the object's diagonal, errors against the truth."""
        rows: dict[str, Any] = {"stopped by": why_unfinished(self.jobs, self.folder.name) or "nothing stopped it"}
        rows |= of_stages(self.folder, self.known)
        if self.known is not None and (self.folder / "object.ply").is_file():
            points = self.known.fit.truth_from_model.apply(read_cloud(self.folder / "object.ply").points)
            cloud = cloud_results(points, self.known, SAMPLES, self.seed)
            rows |= {f"cloud: F {name} %": value(cloud, f"cloud_f_score_{key}") for name, key in SCORES.items()}
        registered = self.folder / "registration/full"
        if (registered / "coarse.json").is_file():
            rows["said of its matches"] = "; ".join(value(read_json(registered / "coarse.json"), "notes"))
        if (registered / "fine.json").is_file() and self.known is not None:
            rows |= self._pose_errors(read_json(registered / "fine.json"), self.known)
        if (self.folder / "truth.json").is_file():
            truth = read_json(self.folder / "truth.json")
            for when in ("before", "after"):
                rows[f"scene around the object, {when}: F 1 %"] = value(truth, f"scene_f_score_{when}_1pct")
        return rows | of_tables(column_of(self.collected()).cells)

    def _pose_errors(self, fine: dict[str, Any], known: ObjectTruth) -> dict[str, float]:
        matrix = value(fine, "scene_from_object")
        if matrix is None:
            return {}
        scene = read_json(self.results / "scenes" / SCENE / "truth.json")
        truth_from_scene = Sim3.from_matrix(np.array(value(scene, "truth_from_scene")))
        true = truth_from_scene.inverse() @ known.fit.truth_from_model
        middle, diagonal = known.fit.truth_from_model.inverse().apply(known.middle), known.diagonal
        error = registration_error(Sim3.from_matrix(np.array(matrix)), true, middle, diagonal / truth_from_scene.scale)
        rows = {"scale error (%)": error.scale_pct, "rotation error (deg)": error.rotation_deg}
        return rows | {"shift (%)": 100 * error.translation_over_diagonal}


def of_stages(folder: Path, known: ObjectTruth | None) -> dict[str, Any]:
    """What each of the four stages that are there came to: poses, depth, renders, rays and seconds."""
    rows: dict[str, Any] = {}
    reports = {n: read_json(folder / f"stage{n}.json") for n in (1, 2, 3, 4) if (folder / f"stage{n}.json").is_file()}
    for number in sorted(reports.keys() & {1, 3}):
        rows |= {f"{name}, stage {number}": pose for name, pose in of_poses(reports[number], known).items()}
    stages = [folder / f"stage{number}" for number in reports]
    depths = {} if known is None else depth_results(stages, known)
    for number, report in reports.items():
        if depths:
            error = value(depths, f"stage{number}_depth_error")
            rows[f"depth error, stage {number} (%)"] = None if error is None else 100 * error
            rows[f"depth within 1 %, stage {number}"] = value(depths, f"stage{number}_depth_within_1pct")
        rows[f"seconds, stage {number}"] = value(report, "seconds")
    for number in sorted(reports.keys() & {2, 4}):
        rows[f"held-out PSNR, stage {number} (dB)"] = value(reports[number], "psnr_held_out")
        rows[f"rays, stage {number} (million)"] = _rays(reports[number]) / 1e6
    return rows


def of_poses(report: dict[str, Any], known: ObjectTruth | None) -> dict[str, float]:
    """Errors of the pose network's chain and motions, against SfM; of the shipped recipe, those of SfM itself."""
    if "pose_source" in report:
        return {name: value(report, key) for name, key in POSES.items() if key in report}
    if known is None:
        return {}
    extent = np.linalg.norm(np.ptp([view.centre for view, _ in known.posed], axis=0)) * known.fit.truth_from_model.scale
    position = float(np.sqrt(np.mean(known.fit.position**2)) / extent)
    return {TRAJECTORY: position, TURNED: float(np.median(known.fit.rotation_deg))}


def _rays(report: dict[str, Any]) -> float:
    """Rays that a NeRF stage drew; of the shipped recipe, from its speed."""
    if "rays_per_epoch" in report:
        return float(value(report, "epochs") * value(report, "rays_per_epoch"))
    return float(value(report, "rays_per_second") * value(report, "training_seconds"))


def of_tables(cells: dict[tuple[str, str], tuple[float, str]]) -> dict[str, Any]:
    """The rows of the paper's tables, without their units."""
    return {
        measure if variant == "full" else f"{measure}, {variant}": number
        for (measure, variant), (number, _) in cells.items()
    }


def of_chance(run: Run) -> dict[str, Any]:
    """The paper's tables' measures of nothing, on the crop of a run."""
    crop = run.folder / "registration/full/crop.ply"
    if not (crop.is_file() and (run.folder / "object.ply").is_file()):
        return {}
    null = null_of(run.folder, run.collected(), run.seed)
    return {} if null is None else of_tables(null.cells)


def of_chance_in_stages(shipped: Run, chained: Run) -> dict[str, Any]:
    """Measures of the four stages, of nothing: see the module's text."""
    rows: dict[str, Any] = {}
    if (chained.folder / "stage1.json").is_file():
        report = read_json(chained.folder / "stage1.json")
        for number in (1, 3):
            still = value(report, "pose_network_rotation_to_find_deg")
            rows[f"rotation error of one motion (deg), stage {number}"] = still
    known = np.stack([view.world_from_cam for view in read_workspace(shipped.folder / "undistorted").views])
    repeated = one_motion_repeated(known, shipped.seed)
    rows |= {f"{name}, stage {number}": error for name, error in repeated.items() for number in (1, 3)}
    if shipped.known is not None:
        rows |= {f"depth error, stage {number} (%)": flat_depth_error(shipped.known) for number in (1, 2, 3, 4)}
    return rows


def one_motion_repeated(known: Array, seed: int) -> dict[str, float]:
    """Median errors of chains of one random motion each, as far turned as a frame is against the next, of poses
    (V, 4, 4)."""
    turn = np.median([rotation_angle_deg(a[:3, :3] @ b[:3, :3].T) for a, b in pairwise(known)])
    rng, errors = np.random.default_rng(seed), []
    for _ in range(MOTIONS):
        axis, step = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(np.radians(turn) * axis)[0], step
        chain = np.stack([np.linalg.matrix_power(motion, k) for k in range(len(known))])
        errors.append({key: value({key: item}, key) for key, item in trajectory_error("chain", chain, known).items()})
    medians = pd.DataFrame(errors).median()
    return {name: float(medians[POSES[name]]) for name in (TRAJECTORY, TURNED)}


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
    shipped: Path = Path("results"),
    chained: Path = Path("paper/results"),
    from_sfm: Path = Path("paper_from_sfm/results"),
    objects: tuple[str, ...] = OBJECTS,
    table: Path | None = None,
) -> None:
    """Print runs of the paper's recipe beside one of the shipped recipe.

    Args:
        shipped: results of the shipped recipe.
        chained: results of config/paper.yaml.
        from_sfm: results of config/paper.yaml with object.stage1.pose_source sfm.
        objects: of all three.
        table: TSV to write, too.
    """
    settings = read_settings(None)
    rows = []
    for name in objects:
        folders = {CHAINED: chained, FROM_SFM: from_sfm, SHIPPED: shipped}
        runs = {column: Run(results, name, settings["seed"]) for column, results in folders.items()}
        columns: dict[str, dict[str, Any]] = {PAPER: of_tables(published(name))}
        columns |= {column: found.measures() for column, found in runs.items()}
        columns[NULL] = of_chance(runs[SHIPPED]) | of_chance_in_stages(runs[SHIPPED], runs[CHAINED])
        columns |= {null: of_chance(runs[column]) for column, null in NULLS.items()}
        measures = dict.fromkeys(key for column in (FROM_SFM, *columns) for key in columns[column])
        for measure in measures:
            row = {column: _five_digits(cells.get(measure)) for column, cells in columns.items()}
            rows.append({"object": name, "measure": measure} | row)
    found = pd.DataFrame(rows)
    if table is not None:
        found.to_csv(table, sep="\t", index=False)
    print_table(found)


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
