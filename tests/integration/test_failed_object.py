"""One object fails: the others are completed and shown without it, and the next run takes it in once it is mended.

Only the last stages run; what comes before them is written by hand.
"""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
import yaml
from support.changed_scene import write_changes
from support.user_project import CLICKS

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.core.stage import quantity, write_json

GATHERED = ("completed.", "view.", "summary/")
STATUS = {
    "status": quantity("registered", ""),
    "reason": quantity("", ""),
    "scene_from_object": quantity(np.eye(4), ""),
}


def sheet(low, high):
    """A flat grid of 0.1, x from low to high, y from 0 to 2."""
    x, y = np.meshgrid(np.arange(low, high, 0.1), np.arange(0, 2, 0.1))
    return Cloud(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))


def added_of(name):
    """What an object adds, each beside the scene."""
    low = {"shed": 5, "barn": 8}.get(name, 5)
    return sheet(low, low + 2)


def write_stages(folder: Path, files: list[str], date: float) -> None:
    """Outputs of the stages before the last ones: real where these read them, else empty."""
    content = {"fine.json": STATUS, "dense.json": {"points": quantity(1000, "points")}}
    content["georeference.json"] = {"length_unit": quantity("m", "")}
    content["crop.json"] = {"diagonal": quantity(5.0, "m")}
    content["fusion.json"] = {"status": quantity("fused", ""), "checked_points": quantity(0, "points")}
    for path in (folder / file for file in files):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.name in ("fused.ply", "checked.ply"):
            write_changes(path.parent, sheet(0, 5), added_of(path.parent.name))
        elif path.suffix == ".ply":
            write_cloud(path, sheet(5, 7) if path.name == "object.ply" else sheet(0, 5))
        elif path.suffix == ".png":
            cv2.imwrite(str(path), np.zeros((4, 4), dtype=np.uint8))
        elif path.suffix:
            write_json(path, content.get(path.name, {}))
        else:
            path.mkdir(exist_ok=True)
    for file in files:
        os.utime(folder / file, (date, date))


@pytest.fixture
def project(tmp_path, snakemake, request):
    """A scene with a shed that is done up to its fusion, and a barn with a broken photo; call it to run Snakemake.

    The objects' recipe may be given as the fixture's parameter.
    """
    for name in ("flight", "shed", "barn"):
        (tmp_path / name).mkdir()
        for index in range(5):
            noise = np.random.default_rng(index).integers(0, 255, (48, 64, 3), dtype=np.uint8)
            cv2.imwrite(str(tmp_path / name / f"{index}.jpg"), noise)
            os.utime(tmp_path / name / f"{index}.jpg", (1e9, 1e9))
    shutil.copy(tmp_path / "barn/2.jpg", tmp_path / "spare.jpg")
    (tmp_path / "barn/2.jpg").write_bytes(b"\xff\xd8\xff\xe0 broken")
    (tmp_path / "scenes.tsv").write_text("scene\tphotos\tmade_by\nyard\tflight\tA {B} $C\n")
    rows = [f"{name}\tyard\t{name}\tclicks.tsv\tprompts.tsv" for name in ("shed", "barn")]
    (tmp_path / "objects.tsv").write_text("\n".join(["object\tscene\tphotos\tfiducials\tprompts", *rows]) + "\n")
    for name in ("clicks.tsv", "prompts.tsv"):
        (tmp_path / name).write_text(CLICKS)
        os.utime(tmp_path / name, (1e9, 1e9))
    registration = {"variants": ["full"], "crop": {"mode": "fiducials"}}
    config = {"scenes": "scenes.tsv", "objects": "objects.tsv", "registration": registration}
    config["object"] = {"recipe": getattr(request, "param", "scenefuse")}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(config))

    def run(*words):
        return snakemake(tmp_path, *words, config=tmp_path / "mine.yaml")

    listed = [line.split("\t")[0] for line in run("--summary").stdout.splitlines()]
    run.files = [f for f in listed if f.startswith("results/") and not any(part in f for part in GATHERED)]
    done = [f for f in run.files if "/barn/" not in f or "/crop." in f]
    write_stages(tmp_path, done, 1.1e9)
    return run


def test_a_failed_object_keeps_nobody_back_and_is_taken_in_once_it_is_mended(project, tmp_path):
    failed = project()
    assert failed.returncode != 0
    scene, summary = tmp_path / "results/scenes/yard", tmp_path / "results/summary"
    assert (scene / "completed.json").is_file(), failed.stdout[-6000:]
    report = json.loads((scene / "completed.json").read_text())
    assert list(report["added_points"]["value"]) == ["shed"] and "2.jpg" in report["failed"]["value"]["barn"]
    assert set(read_cloud(scene / "completed.ply").fields["source"]) == {0, 1}
    assert (scene / "completed.copc.laz").stat().st_size > 0
    table = pd.read_csv(summary / "registration.tsv", sep="\t").set_index("object")
    assert table["status"].to_dict() == {"shed": "registered", "barn": "failed"} and "2.jpg" in table["reason"]["barn"]
    text = " ".join((summary / "summary.txt").read_text().split())
    assert "Completed with shed;" in text and "object barn: failed" in text
    page = (summary / "report.html").read_text()
    assert '>barn<span class="badge no">failed<' in page and "2.jpg" in page and "A {B} $C" in page
    assert 'aria-label="3D view of scene yard"' in page

    # What is there can be handed over, as `scenefuse export` does.
    exported = ("results/summary/report.pdf", "results/summary/report.html")
    handed = project("-n", *exported, "--allowed-rules", "make_surface", "draw_surface", "write_pdf", "write_report")
    assert handed.returncode == 0, handed.stdout[-3000:]

    # As if the barn's stages had run after its photo was mended.
    shutil.copy(tmp_path / "spare.jpg", tmp_path / "barn/2.jpg")
    os.utime(tmp_path / "barn/2.jpg", (1e9, 1e9))
    write_stages(tmp_path, [f for f in project.files if "/barn/" in f and "/crop." not in f], 1.2e9)
    frames = [f"results/objects/barn/{name}" for name in ("frames", "photos.json")]
    assert project("--cleanup-metadata", *frames).returncode == 0  # of the run with the broken photo
    mended = project()
    assert mended.returncode == 0, mended.stdout[-3000:]
    report = json.loads((scene / "completed.json").read_text())
    assert list(report["added_points"]["value"]) == ["shed", "barn"] and report["failed"]["value"] == {}
    assert "2 of 2 objects registered" in (summary / "summary.txt").read_text()
    assert "Nothing to be done" in project("-n").stdout

    # An export that fails is named until another run, which makes no summary, ends well.
    assert project("results/objects/shed/surface.glb").returncode != 0
    assert "jobs that failed" in (text := (summary / "summary.txt").read_text()) and "make_surface/shed" in text
    assert project("--forcerun", "view_scene", "--", "results/scenes/yard/view.json").returncode == 0
    assert "jobs that failed" not in (text := (summary / "summary.txt").read_text()) and "2 of 2 objects" in text

    # It fails again: what it left from before is out of date, and not in the completed scene.
    (tmp_path / "barn/2.jpg").write_bytes(b"broken once more")
    assert project().returncode != 0
    report = json.loads((scene / "completed.json").read_text())
    assert (tmp_path / "results/objects/barn/object.ply").exists()
    assert list(report["added_points"]["value"]) == ["shed"] and list(report["failed"]["value"]) == ["barn"]
    assert set(read_cloud(scene / "completed.ply").fields["source"]) == {0, 1}
    assert "object barn: failed" in (summary / "summary.txt").read_text()


@pytest.mark.parametrize("project", ["paper"], indirect=True)
def test_the_paper_s_tables_are_made_without_an_object_that_failed(project, tmp_path):
    summary = tmp_path / "results/summary"
    summary.mkdir()
    (summary / "paper.tsv").write_text("of before\n")
    assert project().returncode != 0
    notes = pd.read_csv(summary / "paper.tsv", sep="\t").set_index("object")["note"]
    assert notes["barn"].str.contains("paper preset (here): failed, ", regex=False).all()
    assert notes["barn"].str.contains("2.jpg").all() and not notes["shed"].str.contains("failed").any()
    page = (summary / "report.html").read_text()
    assert "Table 4: " in page and "<p>barn, full: paper preset (here): failed, " in page
