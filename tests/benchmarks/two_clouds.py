"""`scenefuse register --fuse` on a finished demo, against truth: an object's cloud in its scene as a LAZ, no photos.

make demo, then PYTHONPATH=tests python tests/benchmarks/two_clouds.py --results results

The object's cloud is turned, moved and scaled at random first, so that nothing of its frame is known. It is marked as
by a person: by the ends of the true object along the scene's axes, a hundredth of its diagonal off.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from support.marks import frame_of_its_own, marks_of

from demo.evaluate import read_object_truth, scene_scores, surface_to_find
from demo.truth import read_cameras, registration_error
from scenefuse.cloud.clouds import read_cloud, write_cloud
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.stage import read_json, run, value
from scenefuse.core.transforms import Sim3
from scenefuse.two_clouds.find import Known
from scenefuse.two_clouds.register import ExitStatus, register

SAMPLES = 60000


def trial(results: Path, scene: str, name: str, seed: int, folder: Path) -> dict[str, object]:
    """One object's row: the decision, errors of the pose, scores of the scene around it before and after."""
    truth = results / f"demo/{scene}/truth"
    known = read_object_truth(results / f"objects/{name}/undistorted", truth / "scene", truth / name, SAMPLES, seed)
    truth_from_scene = Sim3.from_matrix(
        np.array(value(read_json(results / f"scenes/{scene}/truth.json"), "truth_from_scene"))
    )
    turned = frame_of_its_own(seed)
    dense = read_cloud(results / f"scenes/{scene}/dense.ply")
    write_laz(folder / "scene.laz", dense, np.zeros(3), None)
    write_cloud(folder / "object.ply", read_cloud(results / f"objects/{name}/object.ply").transformed(turned))
    surface = truth_from_scene.inverse().apply(known.surface)
    np.savetxt(folder / "marks.txt", marks_of(surface, known.diagonal / truth_from_scene.scale, seed))
    start = time.perf_counter()
    status = register(
        object=folder / "object.ply",
        scene=folder / "scene.laz",
        out=folder / "out",
        fuse=1,
        known=Known(up_scene=(0.0, 0.0, 1.0), fiducials=folder / "marks.txt"),
        seed=seed,
    )
    row: dict[str, object] = {
        "object": name,
        "status": "registered" if status == ExitStatus.REGISTERED else "unregistered",
    }
    row["seconds"] = time.perf_counter() - start
    pose = Sim3.from_matrix(np.array(value(read_json(folder / "out/transform.json"), "scene_from_object"))) @ turned
    true = truth_from_scene.inverse() @ known.fit.truth_from_model
    middle = known.fit.truth_from_model.inverse().apply(known.middle)
    error = registration_error(pose, true, middle, known.diagonal / truth_from_scene.scale)
    row |= {"scale_pct": error.scale_pct, "rotation_deg": error.rotation_deg}
    row["translation_over_diagonal"] = error.translation_over_diagonal
    found = surface_to_find(known, read_cameras(truth / "scene/cameras.json"))
    for when, path in (("before", folder / "scene.laz"), ("after", folder / "out/completed.laz")):
        if path.is_file():
            scores = scene_scores(truth_from_scene.apply(read_cloud(path).points), known, found)
            row |= {f"f_score_{ending}_{when}": score["f_score"] for ending, score in scores.items()}
    return row


def two_clouds(
    *,
    results: Path,
    scene: str = "demo",
    objects: tuple[str, ...] = ("house", "balloon", "sculpture"),
    seed: int = 0,
    report: Path = Path("two_clouds.tsv"),
) -> None:
    """Write a row for each object and print them.

    Args:
        results: folder of a finished demo; nothing in it is changed.
        scene: name of its scene.
        objects: names of its objects.
        seed: of frames, marks and registrations.
        report: output TSV.
    """
    rows = []
    for name in objects:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(trial(results, scene, name, seed, Path(folder)))
    table = pd.DataFrame(rows)
    table.to_csv(report, sep="\t", index=False, float_format="%.4g")
    print(table.T.to_string(float_format="{:.4g}".format))


if __name__ == "__main__":
    run(two_clouds)
