"""Photos on one side only, through the whole workflow, on a finished demo, against truth.

make demo, then
PYTHONPATH=tests python tests/benchmarks/one_side.py --results results --work results/bench/one_side

Once the scene is a LAZ, and the object's photos are reconstructed and trained on anew; its place is marked by points
as `two_clouds.py` marks it. Once the scene has its photos, cameras and cloud, and the object is a PLY that was
turned, moved and scaled at random; its place is marked by the demo's clicks in the scene's photos. A second call goes
on where the first was stopped.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import yaml
from support.marks import frame_of_its_own, marks_of

from demo.evaluate import ObjectTruth, read_object_truth, scene_scores, surface_to_find
from demo.truth import read_cameras
from scenefuse.cloud.clouds import read_cloud, write_cloud
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.settings import ROOT
from scenefuse.core.stage import read_json, run, value
from scenefuse.core.transforms import Sim3

SCENE, SAMPLES = "demo", 60000


def one_side(
    *, results: Path, work: Path, objects: tuple[str, ...] = ("house",), cores: int = 2, seed: int = 0
) -> None:
    """Print what either way came to: the decision, F of the scene around the object before and after.

    Args:
        results: folder of a finished demo; nothing in it is changed.
        work: folder of the two runs.
        objects: names of the demo's objects.
        cores: of the runs.
        seed: of marks and frames.
    """
    results, rows = results.resolve(), []
    truth, flight = results / f"demo/{SCENE}/truth", results / f"scenes/{SCENE}"
    truth_from_scene = Sim3.from_matrix(np.array(value(read_json(flight / "truth.json"), "truth_from_scene")))
    dense, cameras = read_cloud(flight / "dense.ply"), read_cameras(truth / "scene/cameras.json")
    for name in objects:
        of = results / "objects" / name
        known = read_object_truth(of / "undistorted", truth / "scene", truth / name, SAMPLES, seed)
        for way in ("scene's cloud, object's photos", "scene's photos, object's cloud"):
            folder = work / name / way.split("'")[0] / way.split()[1].rstrip(",")
            folder.mkdir(parents=True, exist_ok=True)
            if not (folder / "mine.yaml").exists():
                if way.startswith("scene's cloud"):
                    write_laz(folder / "scene.laz", dense, np.zeros(3), None)
                    _marks(folder / "marks.tsv", known, truth_from_scene, seed)
                    given = results / f"demo/{SCENE}/{name}"
                    scene: dict[str, object] = {"cloud": "scene.laz"}
                    row: dict[str, object] = {
                        "photos": given / "photos",
                        "prompts": given / "prompts.tsv",
                        "fiducials": "marks.tsv",
                    }
                else:
                    write_cloud(
                        folder / "object.ply", read_cloud(of / "object.ply").transformed(frame_of_its_own(seed))
                    )
                    scene = {"photos": results / f"demo/{SCENE}/scene/photos", "cameras": flight / "georeferenced"}
                    scene["cloud"] = flight / "dense.ply"
                    row = {"cloud": "object.ply", "fiducials": results / f"demo/{SCENE}/{name}/fiducials.tsv"}
                _project(folder, name, scene, row)
            command = [sys.executable, "-m", "snakemake", "--snakefile", ROOT / "Snakefile", "--directory", folder]
            command += ["--configfile", folder / "mine.yaml", "--cores", cores]
            done = subprocess.run(list(map(str, command)), cwd=ROOT, capture_output=True, text=True)
            (folder / "run.log").write_text(done.stdout + done.stderr)
            made = folder / "results/objects" / name
            fine = read_json(made / "registration/full/fine.json")
            found = {"object": name, "way": way, "decision": f"{value(fine, 'status')}: {value(fine, 'reason')}"}
            after = read_cloud(folder / "results/scenes" / SCENE / "completed.copc.laz").points
            surface = surface_to_find(known, cameras)
            scores = [scene_scores(truth_from_scene.apply(cloud), known, surface) for cloud in (dense.points, after)]
            for ending in scores[0]:
                found[f"F {ending}"] = " -> ".join(f"{score[ending]['f_score']:.3f}" for score in scores)
            rows.append(found)
    print(pd.DataFrame(rows).T.to_string())


def _marks(path: Path, known: ObjectTruth, truth_from_scene: Sim3, seed: int) -> None:
    surface = truth_from_scene.inverse().apply(known.surface)
    marks = marks_of(surface, known.diagonal / truth_from_scene.scale, seed)
    path.write_text("point\tx\ty\tz\n" + "".join(f"p{k}\t{x}\t{y}\t{z}\n" for k, (x, y, z) in enumerate(marks)))


def _project(folder: Path, name: str, scene: dict[str, object], row: dict[str, object]) -> None:
    """Tables and settings of a scene and an object."""
    tables = {"scenes": {"scene": SCENE} | scene, "objects": {"object": name, "scene": SCENE} | row}
    for kind, cells in tables.items():
        (folder / f"{kind}.tsv").write_text("\t".join(cells) + "\n" + "\t".join(map(str, cells.values())) + "\n")
    demo = yaml.safe_load((ROOT / "config/demo.yaml").read_text())
    own = {"scenes": "scenes.tsv", "objects": "objects.tsv"} | {part: demo[part] for part in ("scene", "object")}
    (folder / "mine.yaml").write_text(yaml.safe_dump(own))


if __name__ == "__main__":
    run(one_side)
