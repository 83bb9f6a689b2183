"""The whole workflow on a tiny capture: what it writes, what a second run does, what an edit reruns."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from support.user_project import planned

from scenefuse.cloud.clouds import read_cloud
from scenefuse.fuse.measure import Evidence

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def finished(tmp_path_factory, snakemake):
    """A working directory in which the whole tiny workflow has run."""
    directory = tmp_path_factory.mktemp("tiny")
    result = snakemake(directory)
    assert result.returncode == 0, result.stdout[-6000:]
    ends = (
        "Result: 1 of 1 objects completed; results/scenes/demo/completed.ply",
        "Report: results/summary/report.html",
    )
    assert "\n".join([*ends, "Next: "]) in result.stdout, result.stdout[-3000:]
    return directory


def test_everything_a_user_reads_is_there(finished):
    results = finished / "results"
    for name in ("registration", "completion", "runtime", "scenes", "objects"):
        assert len(pd.read_csv(results / f"summary/{name}.tsv", sep="\t")) > 0
    assert "house" in (results / "summary/summary.txt").read_text()
    page = (results / "summary/report.html").read_text()
    assert "<img" in page and all(f'aria-label="3D view of {name}"' in page for name in ("house", "scene demo"))
    assert {"before_after.png", "object.png"} <= {p.name for p in (results / "objects/house/figures").iterdir()}


def decision(directory, variant="full") -> dict:
    """A variant's registration of the house."""
    return json.loads((directory / f"results/objects/house/registration/{variant}/fine.json").read_text())


def test_the_house_is_registered_where_it_is(finished):
    # The tiny capture is coarse; docs/results.md has the accuracy of the demo.
    fine, truth = decision(finished), json.loads((finished / "results/objects/house/truth.json").read_text())
    assert fine["status"]["value"] == "registered", fine["reason"]["value"]
    assert abs(truth["scale_error_pct"]["value"]) <= 2.0
    assert truth["rotation_error_deg"]["value"] <= 2.0
    assert truth["translation_error_over_diagonal"]["value"] <= 0.02


def test_masks_find_the_house_in_the_scene_where_fiducials_do(finished):
    full, by_fiducials = (
        np.array(decision(finished, variant)["scene_from_object"]["value"]) for variant in ("full", "by_fiducials")
    )
    crops = [
        json.loads((finished / f"results/objects/house/registration/{variant}/crop.json").read_text())["mode"]["value"]
        for variant in ("full", "by_fiducials")
    ]
    assert crops == ["masks", "fiducials"]
    assert decision(finished, "by_fiducials")["status"]["value"] == "registered"
    assert np.linalg.norm(full[:3, 3] - by_fiducials[:3, 3]) < 0.1  # metres


def test_fusion_completes_the_scene_and_keeps_the_provenance_of_every_point(finished):
    house = finished / "results/objects/house"
    truth = json.loads((house / "truth.json").read_text())
    fused, checked = read_cloud(house / "fused.ply"), read_cloud(house / "checked.ply")
    scene = read_cloud(finished / "results/scenes/demo/dense.ply")
    added = fused.fields["source"] == 1
    removed = sum(json.loads((house / "evidence.json").read_text())["scene_removed"]["value"].values())
    assert (checked.fields["reason"] > 0).sum() == removed
    assert np.array_equal(scene.points[checked.fields["row"].astype(int)], checked.points)
    assert not (house / "fused_scene.ply").exists()  # only where it is asked for
    confirmed, plain = fused.fields["photos"] >= 3, fused.fields["evidence"] == Evidence.PLAIN
    assert confirmed[added].mean() > 0.9 and (confirmed | plain)[added].all()
    for threshold in ("1pct", "2pct"):
        assert truth[f"scene_f_score_after_{threshold}"]["value"] > truth[f"scene_f_score_before_{threshold}"]["value"]


def test_the_completed_scene_holds_what_the_object_adds(finished):
    scene = finished / "results/scenes/demo"
    house = finished / "results/objects/house"
    completed, fused, checked = (
        read_cloud(path) for path in (scene / "completed.ply", house / "fused.ply", house / "checked.ply")
    )
    dense, added = read_cloud(scene / "dense.ply"), fused[fused.fields["source"] == 1]
    kept = np.delete(dense.points, checked.fields["row"][checked.fields["reason"] > 0].astype(int), axis=0)
    assert np.array_equal(completed.points, np.concatenate([kept, added.points]))
    assert np.array_equal(completed.fields["source"], np.repeat([0, 1], [len(kept), len(added)]))
    assert json.loads((scene / "completed.json").read_text())["sources"]["value"] == {"0": "scene", "1": "house"}
    assert (scene / "completed.copc.laz").stat().st_size > 0


def test_the_ledger_holds_the_pose_of_the_added_points(finished):
    house = finished / "results/objects/house"
    ledger = json.loads((house / "frames.json").read_text())
    fusion = json.loads((house / "fusion.json").read_text())
    assert np.allclose(ledger["scene_from_object"]["value"], fusion["scene_from_object"]["value"], atol=1e-12)


def test_a_second_run_does_nothing(finished, snakemake):
    assert "Nothing to be done" in snakemake(finished).stdout


SUMMARY = {"draw_object", "write_summary", "write_report", "all"}


def test_an_edited_setting_reruns_only_what_depends_on_it(finished, snakemake, tmp_path):
    rules = {
        *("fuse_object", "find_missing", "complete_scene", "view_scene"),
        *("compute_metrics", "evaluate_object"),
    }
    tiny = yaml.safe_load((ROOT / "tests/data/tiny.yaml").read_text())
    (tmp_path / "edited.yaml").write_text(yaml.safe_dump(tiny | {"fusion": {"match_colors": False}}))
    assert planned(snakemake(finished, "--dry-run", config=tmp_path / "edited.yaml").stdout) == rules | SUMMARY


def test_maps_go_when_no_job_needs_them_only_where_that_is_wanted(finished, snakemake, tmp_path):
    tiny = yaml.safe_load((ROOT / "tests/data/tiny.yaml").read_text())
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(tiny | {"keep_maps": False}))
    gone = {
        line.split("Would remove temporary output ")[1]
        for line in snakemake(finished, "--dry-run", "--forceall", config=tmp_path / "small.yaml").stdout.splitlines()
        if "Would remove temporary output " in line
    }
    assert gone == {
        *(f"results/scenes/demo/depth/{chunk}" for chunk in range(2)),
        *(f"results/objects/house/stage{stage}" for stage in range(1, 5)),
    }
    assert "temporary output" not in snakemake(finished, "--dry-run", "--forceall").stdout


def test_the_scene_with_one_object_is_a_target(finished, snakemake):
    result = snakemake(finished, "results/objects/house/fused_scene.copc.laz", "--dry-run")
    assert planned(result.stdout) == {"complete_scene_with_object"}


def test_one_object_is_a_target(finished, snakemake):
    result = snakemake(finished, "results/objects/house/fused.ply", "--dry-run", "--forcerun", "fuse_object")
    assert planned(result.stdout) == {"fuse_object"}
