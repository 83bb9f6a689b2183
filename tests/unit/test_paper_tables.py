"""The paper's tables: each number in its place, what is missing said, no number of a run that does not belong there."""

import re
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from scenefuse.cloud.clouds import Cloud, write_cloud
from scenefuse.core.job_records import JobRecords
from scenefuse.core.stage import quantity, write_json
from scenefuse.paper.compare_with_paper import (
    HERE,
    NULL,
    OBJECTS,
    PAPER,
    PUBLISHED,
    compare_with_paper,
    paper_section,
    published,
)
from scenefuse.report.run_summary import RunInputs
from scenefuse.report.write_report import write_report

ROOT = Path(__file__).resolve().parents[2]
NAMES = ("house", "shed")
OWN = "paper/results"
STAGES = ("matches", "sparse", "undistorted", "masks", "stage2", "stage3", "stage4", "object", "alignment")
COMPLETION = {"surface_variation": 0.1, "nue": 1.5, "nue_density_invariant": 1.2, "primitive_fitting_score": 0.8}


def registration_of(fitness, unit, diagonal=10.0):
    found = {"fitness": (fitness, "1"), "inlier_rmse": (fitness / 4, unit), "normal_consistency": (fitness / 2, "1")}
    found |= {"inlier_rmse_over_diagonal": (fitness / 4 / diagonal, "1"), "tau": (0.016 * diagonal, unit)}
    return {name: quantity(number, u) for name, (number, u) in found.items()}


def write_object(folder, fitness, unit="m"):
    """An object that went through: fitness as given in `full`, a half of it in `no_scale`, a quarter in `no_crop`."""
    write_json(folder / "photos.json", {})
    (folder / "features.db").touch()
    for stage in STAGES:
        write_json(folder / f"{stage}.json", {})
    write_json(folder / "stage1.json", {"pose_source": quantity("sfm", "")})
    drawn = {"rays_per_epoch": 60_000, "rays_per_epoch_paper": 519_951, "prior_confident_share": 0.93}
    drawn |= {"field_is_the_papers": False}
    write_json(folder / "stage2.json", {name: quantity(number, "1") for name, number in drawn.items()})
    rng = np.random.default_rng(0)
    write_cloud(folder / "object.ply", Cloud(rng.uniform(0, 1, (300, 3))))
    status = quantity("ungated", "")
    for share, variant in ((1, "full"), (2, "no_scale"), (4, "no_crop")):
        registered = folder / "registration" / variant
        write_json(registered / "crop.json", {"diagonal": quantity(10.0, unit)})
        for stage in ("scale", "coarse"):
            write_json(registered / f"{stage}.json", {})
        pose = quantity(np.diag([8.0, 8, 8, 1]), "")
        write_json(registered / "fine.json", {"status": status, "reason": quantity("", ""), "scene_from_object": pose})
        measured = {"registration": registration_of(fitness / share, unit)}
        if variant == "full":
            write_cloud(registered / "crop.ply", Cloud(rng.uniform(0, 1, (500, 3)) * [8, 6, 0]))
            completion = {name: quantity(number * fitness, "1") for name, number in COMPLETION.items()}
            completion |= {f"{name}_null": quantity(number / 10, "1") for name, number in COMPLETION.items()}
            write_json(folder / "metrics.json", measured | {"completion": completion})
        else:
            write_json(registered / "metrics.json", measured)
    for name in ("evidence", "fusion", "missing"):
        write_json(folder / f"{name}.json", {})


def write_run(results, fitness):
    """A finished run of the paper's recipe."""
    scene = results / "scenes/yard"
    for name in ("matches", "sparse", "georeference", "undistorted", "dense", "depth/0"):
        write_json(scene / f"{name}.json", {})
    write_json(scene / "photos.json", {})
    (scene / "features.db").touch()
    for name in NAMES:
        write_object(results / "objects" / name, fitness)
    (results / "summary").mkdir(exist_ok=True)
    (results / "summary/summary.txt").write_text("all well\n")


def fail(results, name, words):
    """Let an object end in an error in stage 2; what stands behind it is from before."""
    (results / f"objects/{name}/stage2.json").unlink()
    log = results / f"logs/train_nerf_as_paper/{name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    log.write_text(f"error: {words}\n")


@pytest.fixture
def folder(tmp_path):
    """A run of fitness 0.4."""
    write_run(tmp_path / OWN, 0.4)
    return tmp_path


def compared(folder):
    """Rows of paper.tsv by object, table, variant and measure."""
    results = folder / OWN
    run = RunInputs(
        chunks=1,
        variants=["full", "no_scale", "no_crop"],
        jobs=JobRecords(results / "logs", results / "benchmarks"),
        scenes=(results / "scenes/yard",),
        objects=tuple(results / "objects" / name for name in NAMES),
        scene_of=("yard",) * len(NAMES),
    )
    table = results / "summary/paper.tsv"
    compare_with_paper(run=run, table=table, section=table.with_suffix(".html"), seed=0)
    read = pd.read_csv(table, sep="\t", na_values=["-"], keep_default_na=False)
    return read.set_index(["object", "table", "variant", "measure"])


def test_each_number_stands_in_its_column_and_row(folder):
    table = compared(folder)
    row = table.loc[("house", 2, "full", "fitness")]
    assert row[[PAPER, HERE]].tolist() == [0.9302, 0.4]
    assert table.loc[("house", 4, "no_scale", "fitness"), [PAPER, HERE]].tolist() == [0.3083, 0.2]
    rmse = table.loc[("house", 4, "no_crop", "inlier_rmse")]
    assert rmse[[PAPER, HERE]].tolist() == [0.4424, 0.025] and rmse["unit"] == "m"
    nue = table.loc[("house", 3, "full", "nue"), [PAPER, HERE, NULL]].tolist()
    assert nue == [1.17, pytest.approx(0.6), 0.15]
    assert table["note"].isna().all() and len(table) == 2 * 16
    said = (
        "stages 2 to 4 have the poses of: sfm; rays an epoch in stages 2 and 4: 60000; every pixel of the object once:"
        " 519951; the paper's field: False; share of the masks with a depth in stage 2: 0.93"
    )
    assert table["preset"].eq(said).all()
    assert table.groupby("measure")["definition"].nunique().eq(1).all() and table["definition"].str.len().min() > 20


def test_only_objects_of_the_paper_have_published_numbers(folder):
    table = compared(folder)
    assert table.loc["shed", PAPER].isna().all() and table.loc["shed", HERE].notna().all()
    assert published("shed") == {}


def test_published_numbers_are_those_of_the_paper():
    text = ROOT.parent / "shared/reference/paper.txt"
    if not text.is_file():
        pytest.skip("the paper's text is not here")
    rows = text.read_text().partition("\nTable 2. Registration evaluation")[2].splitlines()
    names = {
        "fitness": "Fitness",
        "inlier_rmse": "Inlier RMSE",
        "normal_consistency": "Normal Consistency",
        "surface_variation": "Geometric Smoothness",
        "nue": "Distribution Uniformity",
        "primitive_fitting_score": "Structural Plausibility",
    }

    def printed(measure, variant, *objects):
        digits = 2 if measure == "nue" else 4
        return "".join(f"{published(name)[measure, variant][0]:.{digits}f}" for name in objects)

    for measure, name in names.items():
        whole = printed(measure, "full", *OBJECTS)
        assert any(row.startswith(name) and row.endswith(whole) for row in rows), (measure, whole)
    assert {row["measure"] for row in PUBLISHED if row["variant"] == "full" and row["house"]} == set(names)
    for measure in ("fitness", "inlier_rmse", "normal_consistency"):
        first = next(k for k, row in enumerate(rows) if row.startswith(names[measure]) and "House" in row)
        for row, name in zip(rows[first : first + 3], OBJECTS, strict=True):
            ablated = printed(measure, "no_scale", name) + printed(measure, "no_crop", name)
            assert row.endswith(name.capitalize() + ablated), (measure, ablated)
    assert published("balloon")["inlier_rmse", "no_crop"][1] == "m" and published("balloon")["nue", "full"][1] == "1"


def test_the_null_is_a_random_cloud_on_the_crop_whatever_the_object_is(folder):
    null = compared(folder)[NULL]
    # 300 points on 8 x 6: how often one of them lies within a tau of 0.16 of a place.
    assert null["house", 2, "full", "fitness"] == pytest.approx(1 - np.exp(-300 / 48 * np.pi * 0.16**2), abs=0.06)
    assert null["house", 2, "full", "fitness"] == null["house", 4, "no_crop", "fitness"]
    assert null["house", 2, "full", "normal_consistency"] == pytest.approx(1)
    write_cloud(folder / OWN / "objects/house/object.ply", Cloud(np.random.default_rng(9).uniform(0, 9, (300, 3))))
    assert compared(folder)[NULL].equals(null)


def test_an_object_that_failed_is_empty_with_the_reason_and_leaves_the_others(folder):
    fail(folder / OWN, "house", "the visual hull of the masks is empty")
    table = compared(folder)
    house = table.loc["house"]
    assert house[HERE].isna().all() and house[NULL].isna().all()
    assert house["note"].str.contains(r"failed, the visual hull of the masks is empty \[train_nerf_as_paper/").all()
    assert house["note"].str.contains("null: the run did not come as far as a pose").all()
    assert table.loc["shed", HERE].notna().all() and table.loc["shed", "note"].isna().all()


def test_a_pose_that_was_refused_is_said_beside_its_numbers(folder):
    why = {"status": quantity("unregistered", ""), "reason": quantity("two poses fit", "")}
    write_json(
        folder / OWN / "objects/house/registration/full/fine.json", why | {"scene_from_object": quantity(None, "")}
    )
    table = compared(folder)
    assert table.loc[("house", 2, "full"), HERE].notna().all()
    assert set(table.loc[("house", 2, "full"), "note"]) == {f"{HERE}: unregistered, two poses fit"}
    assert table.loc[("house", 4), "note"].isna().all()


def test_a_variant_that_did_not_run_and_a_measure_of_nothing_are_said(folder):
    metrics = folder / OWN / "objects/house/metrics.json"
    own = {"registration": registration_of(0.0, "m") | {"inlier_rmse": quantity(None, "m")}}
    write_json(metrics, own | {"completion": {name: quantity(None, "1") for name in COMPLETION}})
    shutil.rmtree(folder / OWN / "objects/house/registration/no_crop")
    table = compared(folder)
    assert table.loc[("house", 2, "full", "inlier_rmse"), "note"] == f"{HERE}: no point of the object within tau"
    assert table.loc[("house", 3, "full", "nue"), "note"].startswith(f"{HERE}: too few points were added")
    assert set(table.loc[("house", 4, "no_crop"), "note"]) == {
        f"{HERE}: missing, no error in its logs; it has not run to its end"
    }
    assert table.loc[("house", 4, "no_scale"), "note"].isna().all()


def test_lengths_in_another_unit_are_left_out_and_said(folder):
    write_object(folder / OWN / "objects/house", 0.8, unit="scene units")
    table = compared(folder)
    row = table.loc[("house", 2, "full", "inlier_rmse")]
    assert np.isnan(row[PAPER]) and row["note"] == f"{PAPER}: 0.0852 m, in another unit" and row[HERE] == 0.2
    assert table.loc[("house", 2, "full", "fitness"), PAPER] == 0.9302


def test_the_truth_changes_nothing(folder):
    before = compared(folder)
    for name in NAMES:
        truth = {"variants": {"full": {"fitness": quantity(0.123, "1")}}, "fitness": quantity(0.123, "1")}
        write_json(folder / OWN / f"objects/{name}/truth.json", truth)
    assert compared(folder).equals(before)


def page_of(folder, paper):
    results = folder / OWN
    page = results / "report.html"
    write_report(summary=results / "summary", paper=paper, title="test", report=page)
    return page.read_text()


def test_the_page_shows_the_tables_with_definitions_reasons_and_figures(folder):
    fail(folder / OWN, "house", "no <volume>")
    compared(folder)
    page = page_of(folder, folder / OWN / "summary/paper.html")
    text = re.sub(r"<[^>]+>", " ", page)
    assert "<summary>The paper</summary>" in page and all(f"Table {number}: " in text for number in (2, 3, 4))
    assert "no &lt;volume&gt;" in page and "<volume>" not in page
    assert "fitness  (Fitness): share of the crop&#x27;s points" in text
    assert all(f"Figure {number}" in text for number in (2, 3, 5)) and "before_after.png" in text
    assert re.search(r"house\s+full\s+1\s+0\.9302\s+-\s+-\s", text)


def test_the_page_of_another_recipe_shows_no_table_of_before(folder):
    compared(folder)
    assert "Table 2" not in page_of(folder, None)


def test_the_page_says_that_the_section_could_not_be_made(folder):
    assert "paper.html is missing" in page_of(folder, folder / OWN / "summary/paper.html")


def test_the_page_says_which_variant_a_note_is_about():
    row = {
        "in_paper": "x",
        "definition": "y",
        "unit": "1",
        PAPER: "-",
        HERE: "1",
        NULL: "-",
    }
    places = [("2", "full", "fitness"), ("3", "full", "nue"), ("4", "no_crop", "fitness"), ("4", "no_crop", "tau")]
    notes = ["a", "a", "b", "-"]
    rows = [
        {"object": "house", "table": t, "variant": v, "measure": m, "note": note, **row}
        for (t, v, m), note in zip(places, notes)
    ]
    page = paper_section(rows)
    assert page.count("<p>house, full: a</p>") == 1 and "<p>house, no_crop: b</p>" in page
    assert f"<p>house, {HERE}: poses are chained</p>" in paper_section(
        [r | {"preset": "poses are chained"} for r in rows]
    )
