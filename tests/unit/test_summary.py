"""Tables, text and page of partial runs."""

import json
import os
import re
import shutil

import numpy as np
import pandas as pd
import pycolmap
import pytest
from PIL import Image

from scenefuse.core.job_records import KILLED, NO_LOG, NOT_ACCEPTED, JobRecords, why_ended, why_unfinished
from scenefuse.core.stage import StageError, quantity, write_json
from scenefuse.report.facts import (
    accuracies,
    closing_lines,
    made_by,
    object_facts,
    photographed,
    scene_facts,
    title_of,
    verdict,
)
from scenefuse.report.run_summary import RunInputs
from scenefuse.report.values import find, flatten, length, load, number, percent, percents, read_table, records
from scenefuse.report.write_report import write_report
from scenefuse.report.write_summary import runtime_table, write_summary

HEADER = "s\th:m:s\tmax_rss\tmax_vms\tmax_uss\tmax_pss\tio_in\tio_out\tmean_load\tcpu_time\n"


@pytest.fixture
def results(tmp_path):
    """A scene, a registered house, a refused balloon, and a sculpture whose masks failed."""
    scene = tmp_path / "scenes/demo"
    for name in ("photos.json", "features.db", "matches.json", "undistorted.json", "depth/0.json", "depth/1.json"):
        write_json(scene / name, {})
    write_json(scene / "sparse.json", {"total": quantity(60, "1"), "registered": quantity(59, "1")})
    write_json(scene / "georeference.json", {"length_unit": quantity("m", "")})
    write_json(scene / "dense.json", {"points": quantity(5000, "1"), "fallback": quantity("CPU used", "")})
    completed = {"added_points": quantity({"house": 30}, "points"), "unregistered": quantity({"balloon": "weak"}, "")}
    write_json(scene / "completed.json", {"points": quantity(5030, "points"), **completed})
    for name, status in (("house", "registered"), ("balloon", "unregistered")):
        folder = tmp_path / "objects" / name
        for stage in ("photos", "matches", "sparse", "undistorted", "masks", "stage1", "stage2", "stage3", "alignment"):
            write_json(folder / f"{stage}.json", {})
        (folder / "features.db").touch()
        quality = {"psnr_held_out": quantity(27.5, "dB"), "measured_on": quantity("training photos", "")}
        write_json(folder / "stage4.json", quality)
        write_json(folder / "object.json", {"points": quantity(1000, "1")})
        for k, variant in enumerate(("full", "paper")):
            fine = {"status": quantity(status, ""), "reason": quantity("" if status == "registered" else "weak", "")}
            write_json(folder / f"registration/{variant}/crop.json", {"diagonal": quantity(15.0, "m")})
            for stage in ("scale", "coarse"):
                write_json(folder / f"registration/{variant}/{stage}.json", {})
            scale = {"scale": quantity(2.0 + k, "scene units per object unit")}
            write_json(folder / f"registration/{variant}/fine.json", fine | scale)
        scores = {
            v: {"fitness": quantity(0.9 - 0.3 * k, "1"), "tau": quantity(0.05, "m")}
            for k, v in enumerate(("full", "paper"))
        }
        write_json(folder / "registration/paper/metrics.json", {"registration": scores["paper"]})
        completion = {"nue": quantity(1.25, "1"), "nue_null": quantity(2.5, "1")}
        completion |= {
            f"surface_variation{e}": quantity(v, "1") for e, v in (("", 0.1), ("_before", 0.3), ("_after", 0.2))
        }
        write_json(folder / "metrics.json", {"registration": scores["full"], "completion": completion})
        removed = {"photos see a surface behind it": 4, "no photo can see it": 0, "the object measured it better": 12}
        notes = {"notes": quantity(["judged by the scene's photos"], "")}
        write_json(folder / "evidence.json", {"scene_removed": quantity(removed, "points")} | notes)
        fused = {"added": 30, "removed": 16, "nerf_only": 7}
        counts = {f"{kind}_points": quantity(count, "points") for kind, count in fused.items()}
        write_json(folder / "fusion.json", counts | notes)
        variants = {variant: {"scale_error_pct": quantity(0.5 + k, "%")} for k, variant in enumerate(("full", "paper"))}
        scene_scores = {
            f"scene_f_score_{when}_{share}pct": quantity(score, "1")
            for share in ("05", "1")
            for when, score in (("before", 0.4), ("after", 0.9))
        }
        scene_scores |= {f"cloud_f_score_{e}pct": quantity(v, "1") for e, v in (("025", 0.71), ("2", 0.98))}
        write_json(
            folder / "truth.json", {"stage1_depth_error": quantity(0.02, ""), "variants": variants, **scene_scores}
        )
        (folder / "fused.ply").write_text("points")
    (tmp_path / "logs/masks").mkdir(parents=True)
    (tmp_path / "logs/masks/sculpture.log").write_text("error: old\nloading\nerror: no <mask> matches a frame\n")
    for rule, job, seconds, memory in (
        ("nerf", "house", 100.0, 900),
        ("nerf", "balloon", 50.0, 1200),
        ("fine", "x", 0.2, "-"),
    ):
        path = tmp_path / f"benchmarks/{rule}/{job}.tsv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{HEADER}{seconds}\t0:01:00\t{memory}\t1\t1\t1\t0\t0\t99\t1\n")
    return tmp_path


def summarise(results, names=("house", "balloon", "sculpture"), lone=(), failed_logs=(), **posed):
    run = RunInputs(
        scenes=(results / "scenes/demo",),
        chunks=2,
        objects=tuple(results / "objects" / name for name in (*names, *lone)),
        scene_of=("demo",) * len(names) + ("",) * len(lone),
        variants=["full", "paper"],
        jobs=JobRecords(results / "logs", results / "benchmarks", failed_logs),
        **posed,
    )
    write_summary(run=run, summary=results / "summary")
    return results / "summary"


def read(summary, name, **options):
    return pd.read_csv(summary / f"{name}.tsv", sep="\t", na_values=["-"], **options)


def test_registration_holds_every_object_and_variant(results):
    table = read(summarise(results), "registration").set_index(["object", "variant"])
    assert table.loc[("house", "full"), "status"] == "registered"
    assert table.loc[("house", "paper"), "fitness"] == pytest.approx(0.6)
    assert table.loc[("house", "paper"), "scale_error_pct"] == 1.5
    assert table.loc[("balloon", "full"), "reason"] == "weak"
    assert table.loc[("sculpture", "full"), "status"] == "failed"
    assert "no <mask> matches a frame" in table.loc[("sculpture", "full"), "reason"]
    assert np.isnan(table.loc[("sculpture", "full"), "scale"])


def test_completion_sets_value_null_before_and_after_side_by_side(results):
    table = read(summarise(results), "completion").set_index(["object", "measure"])
    assert table.loc[("house", "nue"), ["value", "null"]].tolist() == [1.25, 2.5]
    assert table.loc[("house", "nue"), ["before", "after"]].isna().all()
    assert table.loc[("house", "surface_variation"), ["value", "before", "after"]].tolist() == [0.1, 0.3, 0.2]
    assert table.loc[("house", "scene_f_score_05pct"), ["before", "after"]].tolist() == [0.4, 0.9]


def test_scores_against_truth_stand_at_their_thresholds(results):
    summary = summarise(results)
    objects = read(summary, "objects").set_index("object")
    assert objects.loc["house", ["cloud_f_score_025pct", "cloud_f_score_2pct"]].tolist() == [0.71, 0.98]
    text = " ".join((summary / "details.txt").read_text().split())
    assert "scene F-score at 1 % before 0.4, after 0.9, scale off 0.5 %" in text


def test_one_name_has_one_source(results):
    """A score of another definition never fills in for one that is missing."""
    fine = results / "objects/house/registration/full/fine.json"
    content = json.loads(fine.read_text()) | {"f_score": quantity(0.5, "1"), "fitness": quantity(0.7, "1")}
    write_json(fine, content)
    metrics = results / "objects/house/metrics.json"
    write_json(metrics, {"registration": {"f_score": quantity(0.6, "1")}})
    row = read(summarise(results), "registration").set_index(["object", "variant"]).loc[("house", "full")]
    assert row["f_score"] == 0.5 and np.isnan(row["fitness"]) and np.isnan(row["fitness_f_score"])


def test_objects_and_scenes(results):
    summary = summarise(results)
    objects = read(summary, "objects").set_index("object")
    assert objects.loc["house", "stage4_psnr_db"] == 27.5
    assert objects.loc["house", "stage1_depth_error_over_diagonal"] == 0.02
    assert objects.loc["sculpture", "missing"] == "photos.json"
    assert read(summary, "scenes").loc[0, "registered"] == 59


def test_counts_and_places_are_written_whole_beside_a_scene_without_any(results):
    where = {"origin_longitude_deg": quantity(-122.12346, "deg"), "length_unit": quantity("m", "")}
    write_json(results / "scenes/demo/georeference.json", where)
    write_json(results / "scenes/demo/dense.json", {"points": quantity(1_234_567_891, "points")})
    run = RunInputs(
        scenes=(results / "scenes/demo", results / "scenes/none"),
        chunks=2,
        variants=["full"],
        jobs=JobRecords(results / "logs", results / "benchmarks"),
    )
    write_summary(run=run, summary=results / "summary")
    row = (results / "summary/scenes.tsv").read_text().splitlines()[1].split("\t")
    assert "1234567891" in row and "-122.12346" in row
    write_report(summary=results / "summary", title="x", report=results / "report.html")
    page = (results / "report.html").read_text()
    assert "<td>1234567891</td>" in page and "<td>-122.12346</td>" in page


def test_a_refused_pose_says_neither_how_large_an_object_is_nor_how_well_that_is_known(results):
    balloon = results / "objects/balloon"
    metrics = json.loads((balloon / "metrics.json").read_text()) | {"object": {"size": quantity([3.0, 2.0, 1.0], "m")}}
    write_json(balloon / "metrics.json", metrics)
    fine = json.loads((balloon / "registration/full/fine.json").read_text()) | {"scale_sd_log": quantity(0.003, "1")}
    write_json(balloon / "registration/full/fine.json", fine)
    summary = summarise(results)
    row = read(summary, "objects").set_index("object").loc["balloon"]
    assert row[["length", "height", "scale_sd_log"]].isna().all() and row["unit"] == "m"
    said = (summary / "summary.txt").read_text().split("object balloon")[1].split("object sculpture")[0]
    assert "Not added to the scene: weak." in said and not re.search("Size|Scale|Accuracy|File", said)


def test_a_file_s_path_is_not_broken_where_its_object_s_name_has_hyphens(results):
    name = "the-north-wing-of-the-old-mill"
    (results / "objects/house").rename(results / "objects" / name)
    write_json(results / f"objects/{name}/missing.json", {"stations": quantity(3, "")})
    text = (summarise(results, [name]) / "summary.txt").read_text()
    for file in ("fused.ply", "next_photos.csv"):
        assert f"results/objects/{name}/{file}" in text


def test_an_object_that_is_called_by_a_number_keeps_its_name(results):
    write_json(results / "scenes/demo/completed.json", {"added_points": quantity({"007": 30}, "points")})
    rows = records(read_table(summarise(results, ["balloon"]) / "scenes.tsv"))
    assert rows[0]["completed_by"] == "007"


def test_runtime_sums_over_jobs_and_totals(results):
    table = read(summarise(results), "runtime").set_index("rule")
    assert table.loc["nerf", ["jobs", "seconds", "longest_seconds", "max_rss_mb"]].tolist() == [2, 150, 100, 1200]
    assert table.loc["total", "seconds"] == pytest.approx(150.2)
    assert np.isnan(table.loc["fine", "max_rss_mb"])


def test_a_forecast_of_some_jobs_is_not_shown_as_that_of_all(results):
    """A second run forecasts what it makes again; the jobs of the first are counted too."""
    jobs = {str(path): 10.0 for path in (results / "benchmarks").rglob("*.tsv")}
    table = runtime_table(results / "benchmarks", jobs).set_index("rule")
    assert table.loc[["nerf", "total"], "forecast_seconds"].tolist() == [20.0, 30.0]
    del jobs[str(results / "benchmarks/nerf/house.tsv")]
    again = runtime_table(results / "benchmarks", jobs).set_index("rule")["forecast_seconds"]
    assert again["fine"] == 10.0 and np.isnan(again["nerf"]) and np.isnan(again["total"])
    assert again.index.tolist() == table.index.tolist()


def test_runtime_of_no_benchmarks_and_of_damaged_ones(tmp_path):
    assert len(runtime_table(tmp_path / "none", {})) == 1
    (tmp_path / "rule").mkdir()
    (tmp_path / "rule/job.tsv").write_text("garbage\n1\n")
    assert runtime_table(tmp_path, {})["jobs"].tolist() == [0]


def test_the_text_names_failures_fallbacks_and_truth_within_100_columns(results):
    text = (summarise(results) / "details.txt").read_text()
    assert max(len(line) for line in text.splitlines()) <= 100
    assert "object house: registered" in text and "object balloon: unregistered" in text
    assert "Result        Not finished: no <mask> matches a frame [masks/sculpture.log]" in text
    assert "dense fallback: CPU used" in text
    words = " ".join(text.split())
    assert "added 30 points, removed from the scene 16 points, of the object unconfirmed 7" in words
    assert "photos see a surface behind it 4" in words and "the object measured it better 12 points" in words
    assert "fusion notes: judged by the scene's photos" in words and "evidence notes" not in words
    assert "1 of 3 objects registered" in text


def test_an_object_in_no_scene_is_done_with_its_cloud(results):
    head = results / "objects/head"
    shutil.copytree(results / "objects/house", head)
    summary = summarise(results, lone=("head", "arm"))
    text = " ".join((summary / "details.txt").read_text().split())
    assert "object head: by itself" in text and "1 of 3 objects registered and fused; in no scene: head, arm" in text
    assert "object arm: missing" in text
    # What an earlier run with a scene left is not its own.
    own = text[text.index("object head") : text.index("object arm")]
    assert "object.ply (a frame of its own, object units)" in own
    assert "fusion" not in own and "registration" not in own and "cloud" in own
    assert read(summary, "objects").set_index("object").loc["head", "points"] > 0
    write_json(head / "sparse.json", {"length_unit": quantity("m", "")})
    page = report(results, lone=("head",))
    assert "(a frame of its own, metres)" in page
    assert '<span class="badge ok">by itself</span>' in page and "it lies in no scene" in page


def test_the_text_says_that_ground_was_left_in(results):
    note = "990 of the 1000 points in the box would be ground: nothing was removed as ground"
    crop = {"diagonal": quantity(15.0, "m"), "notes": quantity([note], "")}
    write_json(results / "objects/house/registration/full/crop.json", crop)
    text = (summarise(results) / "details.txt").read_text()
    assert f"crop notes: {note}" in " ".join(text.split())


def test_the_text_says_what_psnr_was_measured_on_and_what_the_completed_scene_holds(results):
    text = " ".join((summarise(results, ["house", "balloon"]) / "details.txt").read_text().split())
    assert "PSNR 27.5 dB, measured on training photos" in text and "held-out" not in text
    assert "Completed with house; 5,030 points" in text
    completed = {"points": quantity(5030, "points"), "removed_points": quantity(20, "points")}
    completed |= {"added_points": quantity({"house": 50}, "points")}
    write_json(results / "scenes/demo/completed.json", completed)
    counts = " ".join((summarise(results, ["house", "balloon"]) / "summary.txt").read_text().split())
    assert "5,030 points: 5,000 of the scene before, of which 20 are removed or replaced by better ones" in counts
    assert "results/scenes/demo/completed.copc.laz (for QGIS, CloudCompare), results/scenes/demo/completed.ply" in text
    assert "completed.copc" not in (summarise(results) / "details.txt").read_text()


@pytest.mark.parametrize("gone", ["features.db", "depth/1.json", "dense.json"])
def test_what_stands_behind_a_failed_step_of_the_scene_is_not_shown(results, gone):
    (results / "scenes/demo" / gone).unlink()
    (results / "logs/scene_sparse").mkdir()
    (results / "logs/scene_sparse/demo.log").write_text("error: only 3 photos\n")
    summary = summarise(results)
    text = (summary / "details.txt").read_text()
    assert "No dense cloud: only 3 photos [scene_sparse/demo.log]" in text and "5000" not in text
    assert "completed.copc" not in text
    table = read(summary, "registration").set_index(["object", "variant"])
    assert table.loc[("house", "full"), "status"] == "failed" and np.isnan(table.loc[("house", "full"), "scale"])
    assert f"missing       {gone} of the scene demo" in text and "0 of 3 objects registered" in text


def test_of_clouds_given_with_cameras_neither_depth_maps_nor_stages_are_missed(results):
    for name in ("depth/0.json", "depth/1.json"):
        (results / "scenes/demo" / name).unlink()
    for name in ("masks", "stage1", "stage2", "stage3", "stage4"):
        (results / f"objects/house/{name}.json").unlink()
    given = {"points": quantity(5000, "1"), "source": quantity("own.laz", ""), "seen_share": quantity(1.0, "1")}
    for path in (results / "scenes/demo/dense.json", results / "objects/house/object.json"):
        write_json(path, given)
    text = (
        summarise(results, given_scenes=("both",), given_objects=("both", "photos", "photos")) / "details.txt"
    ).read_text()
    scene, house = (text[text.index(f"{name}\n") :][:400] for name in ("scene demo", "object house: registered"))
    for part in (scene, house):
        assert "given         as a cloud own.laz" in part
    assert "registered 59, of 60" in scene and "points 5000" in house


def test_the_text_says_where_shared_features_put_the_object(results):
    said = {"found": quantity(True, ""), "reason": quantity("9 of 12 points agree", "")}
    said["scale"] = quantity(2.5, "scene units per object unit")
    write_json(results / "objects/house/alignment.json", said | {"scale_sd_log": quantity(0.0123, "1")})
    not_found = {"found": quantity(False, ""), "reason": quantity("3 of 12 points agree", "")}
    write_json(results / "objects/balloon/alignment.json", not_found)
    text = " ".join((summarise(results) / "details.txt").read_text().split())
    assert "alignment found yes, because 9 of 12 points agree, scale 2.5 m per object unit, standard deviation" in text
    assert "alignment found no, because 3 of 12" in text
    assert "alignment.reason" not in text


def test_what_stands_behind_a_failed_step_of_an_object_is_not_shown(results):
    (results / "objects/house/masks.json").unlink()
    summary = summarise(results)
    assert read(summary, "registration").set_index(["object", "variant"]).loc[("house", "full"), "status"] == "missing"
    assert np.isnan(read(summary, "objects").set_index("object").loc["house", "stage4_psnr_db"])
    assert "after 0.9" not in (summary / "details.txt").read_text().split("object balloon")[0]


def test_a_failed_variant_leaves_the_decision_of_the_full_one(results):
    (results / "objects/house/registration/paper/coarse.json").unlink()
    table = read(summarise(results), "registration").set_index(["object", "variant"])
    assert table.loc[("house", "full"), "status"] == "registered"
    assert table.loc[("house", "paper"), "status"] == "missing"


def test_an_empty_run_is_a_summary_too(tmp_path):
    run = RunInputs(
        scenes=(tmp_path / "scenes/demo",),
        chunks=2,
        objects=(tmp_path / "objects/house",),
        scene_of=("demo",),
        variants=["full"],
        jobs=JobRecords(tmp_path / "logs", tmp_path / "benchmarks"),
    )
    write_summary(run=run, summary=tmp_path / "summary")
    text = (tmp_path / "summary/details.txt").read_text()
    assert (
        "Not finished: no error in its logs; it has not run to its end" in " ".join(text.split())
        and "forecast" not in text
    )
    assert len((tmp_path / "summary/completion.tsv").read_text().splitlines()) == 1


def test_a_summary_removes_what_was_exported_of_earlier_results(results):
    made_of = [(f"objects/{name}/drawings/drawings.pdf", f"objects/{name}/fused.ply") for name in ("house", "balloon")]
    of_scene = ("tiles/points/tileset.json", "cameras/cameras.xml")
    made_of += [(f"scenes/demo/{name}", "scenes/demo/completed.ply") for name in of_scene]
    for age_s, (made, source) in zip((60, -60, 60, -60), made_of):
        for path in (results / made, results / source, results / "summary/report.pdf"):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        os.utime(results / made, ((results / source).stat().st_mtime - age_s,) * 2)
    assert not (summarise(results) / "report.pdf").exists()
    assert [(results / made).exists() for made, _ in made_of] == [False, True, False, True]


def test_the_last_error_is_that_of_the_named_object(tmp_path):
    jobs = JobRecords(tmp_path, tmp_path / "benchmarks")
    (tmp_path / "fine").mkdir()
    (tmp_path / "fine/house-full.log").write_text("error: one\nerror: two\ndone\n")
    (tmp_path / "fine/greenhouse-full.log").write_text("ValueError: other\n")
    assert why_unfinished(jobs, "house") == "two [fine/house-full.log]"
    assert why_unfinished(jobs, "greenhouse") == "ValueError: other [fine/greenhouse-full.log]"
    assert why_unfinished(jobs, "hous") == ""


def test_a_killed_job_is_named_with_its_log(results):
    """Its log ends without an error; the jobs before it have finished: their benchmarks are newer than their logs."""
    for rule in ("make_masks", "estimate_depth_prior"):
        (results / f"logs/{rule}").mkdir()
        (results / f"logs/{rule}/barn.log").write_text("epoch 3 of 20\n")
    (results / "benchmarks/make_masks").mkdir()
    (results / "benchmarks/make_masks/barn.tsv").write_text(f"{HEADER}1\t0:01:00\t1\t1\t1\t1\t0\t0\t99\t1\n")
    summary = summarise(results, ["barn"])
    text = " ".join((summary / "details.txt").read_text().split())
    assert "object barn: failed" in text and "has not run" not in text
    assert "or a higher memory limit [estimate_depth_prior/barn.log]" in text
    assert read(summary, "registration").set_index(["object", "variant"]).loc[("barn", "full"), "status"] == "failed"


def test_a_job_without_an_error_was_killed_or_refused_or_ran_elsewhere(tmp_path):
    log, benchmark = tmp_path / "house.log", tmp_path / "house.tsv"
    assert why_ended(log, benchmark, 0.0) == NO_LOG
    for file, date in ((benchmark, 100), (log, 200)):
        file.write_text("epoch 3 of 20\n")
        os.utime(file, (date, date))
    assert why_ended(log, benchmark, 150.0) == KILLED  # the benchmark is of an earlier run
    assert why_ended(log, benchmark, 250.0) == NO_LOG  # so is the log
    os.utime(benchmark, (300, 300))
    assert why_ended(log, benchmark, 150.0) == NOT_ACCEPTED


def test_a_job_that_failed_in_this_run_is_the_cause_whatever_earlier_runs_left(tmp_path):
    logs = [tmp_path / rule / "house.log" for rule in ("fuse_object", "estimate_depth_prior")]
    for log, text in zip(logs, ("error: of before", "Traceback\nMemoryError: Unable to allocate 2 GiB\n")):
        log.parent.mkdir()
        log.write_text(text)
    why = why_unfinished(JobRecords(tmp_path, tmp_path / "none", (logs[1],)), "house")
    assert why.startswith("the memory, or a limit on it") and why.endswith(
        "(MemoryError: Unable to allocate 2 GiB) [estimate_depth_prior/house.log]"
    )
    assert why_unfinished(JobRecords(tmp_path, tmp_path / "none", (logs[1],)), "barn") == ""


def test_a_damaged_decision_is_named_and_said_to_be_so(results):
    path = results / "objects/house/registration/full/fine.json"
    path.write_text(path.read_text()[:40])
    house = read(summarise(results), "registration").set_index(["object", "variant"]).loc[("house", "full")]
    assert house["status"] == "failed" and house["reason"] == f"{path} is damaged; delete it and run again"


def test_jobs_that_failed_are_listed_even_if_all_results_are_there(results):
    log = results / "logs/draw_object/house.log"
    log.parent.mkdir(parents=True)
    log.write_text("error: no font\n")
    summary = summarise(results, failed_logs=(log,))
    text = " ".join((summary / "summary.txt").read_text().split())
    assert "object house: completed" in text and "jobs that failed" in text and "draw_object/house: no font" in text


def test_a_pose_that_nothing_checked_is_shown_as_such(results):
    fine = {"status": quantity("ungated", ""), "reason": quantity("", ""), "scale": quantity(3.0, "")}
    fine |= {"decided_by": quantity("geometry", "")}
    for name, variant in (("house", "paper"), ("balloon", "full")):
        write_json(results / f"objects/{name}/registration/{variant}/fine.json", fine)
    summary = summarise(results, ["house", "balloon"])
    text = (summary / "details.txt").read_text()
    assert re.search(r"paper +ungated", text) and "object balloon: ungated" in text
    assert "for no photos link" not in text
    assert "1 of 2 objects registered and fused, 1 fused without a check of the pose" in text
    table = read(summary, "registration").set_index(["object", "variant"])
    assert table.loc[("house", "paper"), "status"] == table.loc[("balloon", "full"), "status"] == "ungated"


def test_each_failed_variant_has_its_own_reason(results):
    for variant in ("full", "paper"):
        (results / f"objects/house/registration/{variant}/coarse.json").unlink()
        (results / f"logs/{variant}").mkdir()
        (results / f"logs/{variant}/house-{variant}.log").write_text(f"error: {variant} is wrong\n")
    table = read(summarise(results), "registration").set_index(["object", "variant"])
    for variant in ("full", "paper"):
        assert table.loc[("house", variant), "status"] == "failed"
        assert table.loc[("house", variant), "reason"].startswith(f"{variant} is wrong")


def test_a_completed_scene_without_a_failed_object_is_shown_and_one_from_before_it_failed_is_not(results):
    completed = {"points": quantity(5030, "points"), "added_points": quantity({"house": 30}, "points")}
    write_json(results / "scenes/demo/completed.json", completed | {"failed": quantity({"sculpture": "no mask"}, "")})
    text = " ".join((summarise(results) / "details.txt").read_text().split())
    assert "Completed with house; 5,030 points" in text
    assert "completed.copc" not in (summarise(results, ["house"]) / "details.txt").read_text()


def test_values():
    fields = flatten({"a": {"b": quantity(1.5, "m"), "c": {"d": quantity("x", "")}}, "note": "left out"})
    assert fields == {"a.b": {"value": 1.5, "unit": "m"}, "a.c.d": {"value": "x", "unit": ""}}
    assert find(fields, "nothing", "a.b") == 1.5 and find(fields, "b") is None
    assert [number(v) for v in (None, float("nan"), 0.123456, 9999.6, 123456.7, 3, True)] == [
        "-",
        "-",
        "0.1235",
        "10000",
        "123457",
        "3",
        "yes",
    ]


def test_a_damaged_json_counts_as_absent(tmp_path):
    (tmp_path / "x.json").write_text("{")
    assert load(tmp_path / "x.json") == {} and load(tmp_path / "none.json") == {}


def report(results, names=("house", "balloon", "sculpture"), lone=()):
    figures = results / "objects/house/figures"
    figures.mkdir(parents=True)
    for name in ("figures/before.png", "figures/after.png", "registration/full/fine.png"):
        Image.fromarray(np.full((30, 40, 3), 90, dtype=np.uint8)).save(figures.parent / name)
    page = results / "report.html"
    write_report(
        summary=summarise(results, names, lone),
        scenes=[results / "scenes/demo"],
        objects=[results / "objects" / name for name in ("house", "sculpture", *lone)],
        title="Run <1>",
        report=page,
    )
    return page.read_text()


def test_the_page_is_offline_and_escapes_text(results):
    page = report(results)
    assert "Run &lt;1&gt;" in page and "<1>" not in page
    assert "no &lt;mask&gt; matches a frame" in page and "<mask>" not in page
    assert not re.search(r"https?://|<link|src=\"(?!data:)|url\(", page)
    assert page.count("data:image/webp;base64,") == 3
    assert 'class="slider"' in page and "its stages" not in page.split('id="object-house"')[1].split("<section")[0]


def test_the_page_names_the_completed_scene_once_every_object_has_a_decision(results):
    page = report(results, ["house", "balloon"])
    assert "completed.copc.laz" in page and "Completed with house; 5,030 points" in page


@pytest.mark.parametrize("name", ["record", "k3d"])
def test_an_object_may_be_called_as_a_part_of_the_page_is(results, name):
    page = results / "report.html"
    write_report(summary=summarise(results), objects=[results / "objects" / name], report=page)
    text = page.read_text()
    assert f'href="#object-{name}"' in text and text.count(f'id="object-{name}"') == 1
    assert text.count(f'id="{name}"') == (name == "record")


def test_the_page_names_objects_without_figures(results):
    assert "There are neither figures nor a 3D view" in report(results)


def test_a_client_finds_size_accuracy_and_what_is_missing_in_words(results):
    """In summary.txt, on one screen, and in the object's card of the page; everything scientific is folded away."""
    metrics = json.loads((results / "objects/house/metrics.json").read_text())
    size = {"size": quantity([11.42, 9.96, 8.1], "m"), "deviation": quantity(0.0072, "m")}
    metrics["object"] = size | {"world_deviation": quantity(0.0131, "m"), "world_deviation_90": quantity(0.0251, "m")}
    write_json(results / "objects/house/metrics.json", metrics)
    shares = {"missing": 0.018, "never_seen": 0.01, "untextured": 0.0, "contradicted": 0.008, "ground_missing": 0.012}
    shares["plain"] = 0.123
    found = {name: quantity(share, "1") for name, share in shares.items()}
    found |= {"stations": quantity(3, ""), "stations_show": quantity(0.77, "1"), "cell": quantity(0.0521, "m")}
    write_json(results / "objects/house/missing.json", found)
    page = report(results)
    text = (results / "summary/summary.txt").read_text()
    assert len(text.splitlines()) < 45 and max(map(len, text.splitlines())) <= 100
    assert "% measured" not in text + page.split('id="record"')[0]
    card = page.split('id="object-house"')[1].split("<section")[0]
    link = '<a href="../objects/house/next_photos.csv">results/objects/house/next_photos.csv</a>'
    assert link in card.replace("<wbr>", "")
    card = re.sub("<.+?>", "", card).replace("\u00a0", " ")
    for sentence in (
        "11.4 m × 9.96 m, 8.10 m high, overall",
        "98.2 % is there (12 % as plain surface between measured parts; counted in cells of 52.1 mm), 1.8 % is missing:"
        " 1.0 % seen by no photo (estimated), 0.8 % where photos disagree; of the ground at its foot 1.2 % is missing",
        "13.1 mm in the scene, the standard deviation of a point (two points in three are nearer); that of nine points"
        " in ten is at most 25.1 mm",
        "Photograph it from 3 places (results/objects/house/next_photos.csv): this would show 77 % of what no photo",
    ):
        assert sentence in " ".join(text.split()) and sentence in card, sentence
    assert "Not added to the scene: weak. Perhaps it is not in this scene" in text
    above, record = page.split('id="record"')
    assert "<table" not in above and "surface_" in record and "<table" in record
    assert "7.20 mm on the object by itself" not in above
    assert "7.20 mm on the object by itself" in " ".join(record.split())


def test_the_scene_says_where_when_and_how_exactly_it_was_photographed(results):
    scene = results / "scenes/demo"
    (scene / "photos").mkdir()
    exif = Image.Exif()
    exif[0x0132] = "2024:06:01 09:30:00"
    Image.new("RGB", (8, 6)).save(scene / "photos/a.jpg", exif=exif)
    write_json(scene / "photos.json", {"photos": [{"name": "a.jpg"}]})
    here = {"length_unit": quantity("m", ""), "crs": quantity("EPSG:32632", "")}
    here |= {"origin_latitude_deg": quantity(47.49996, "deg"), "origin_longitude_deg": quantity(-8.5, "deg")}
    here |= {"check_points": quantity(4, "1"), "check_rms_horizontal_m": quantity(0.02, "m")}
    write_json(scene / "georeference.json", here | {"check_rms_vertical_m": quantity(0.04, "m")})
    lens, pose = np.array([[1000.0, 0, 4], [0, 1000, 3], [0, 0, 1]]), np.eye(4)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=8, height=6, params=lens[[0, 1, 0, 1], [0, 1, 2, 2]])
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name="a.jpg", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    model.images[1].points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([4.0, 3.0]))])
    model.add_point3D(np.array([0, 0, 40.0]), pycolmap.Track([pycolmap.TrackElement(1, 0)]), np.zeros(3, np.uint8))
    (scene / "georeferenced").mkdir()
    model.write(scene / "georeferenced")
    text = " ".join((summarise(results) / "details.txt").read_text().split())
    assert "47.49996° N, 8.50000° W" in text and "2024-06-01, 59 of 60 photos used" in text
    assert "Metres, WGS 84 / UTM zone 32N (EPSG:32632)" in text and "Ground pixel 40.0 mm" in text
    # Of normal errors, 90 % stay below 1.517 RMS in the plane and 1.645 RMS upwards.
    assert "Absolute, where on Earth the scene lies: check points are 20.0 mm horizontally and 40.0 mm" in text
    assert "nine of ten less than 30.3 mm (CE90) and 65.8 mm (LE90)" in text
    assert "common to all photos" not in text
    gps = {f"gps_residual_{way}_rms_m": quantity(0.5, "m") for way in ("horizontal", "vertical")}
    write_json(scene / "georeference.json", {k: v for k, v in here.items() if "check" not in k} | gps)
    text = " ".join((summarise(results) / "details.txt").read_text().split())
    assert "an error common to all photos, metres without RTK or PPK, does not show in these" in text


def test_a_run_ends_in_three_lines(results):
    """The result, the report page, and what to do next: repair what failed, else photograph what is missing."""
    report(results)
    result, page, following = closing_lines(summarise(results)).splitlines()
    assert result == "Result: 1 of 3 objects completed" and page.startswith("Report: ")
    assert following.startswith("Next:   balloon: Not added to the scene: weak.")
    write_json(results / "objects/house/missing.json", {"stations": quantity(1, "")})
    result, page, following = closing_lines(summarise(results, ["house"])).splitlines()
    assert result.startswith("Result: 1 of 1 objects completed; ") and result.endswith("scenes/demo/completed.ply")
    assert following == "Next:   house: Photograph it from 1 place (results/objects/house/next_photos.csv)"


def test_shares_of_a_whole_sum_to_100_as_they_are_written():
    for missing in ([0.0087, 0.0002, 0.0032], [1 / 3] * 3, [0.00024, 0.00024], [0.3335, 0.3335, 0.333], [0.0]):
        there, together, *each = [float(text.removesuffix(" %") or 0) for text in percents(missing)]
        assert there + together == pytest.approx(100) and sum(each) == pytest.approx(together)
        assert together == pytest.approx(100 * sum(missing), abs=0.15)
    assert percents([0.0087, 0.0002, 0.0032]) == ["98.8 %", "1.2 %", "0.9 %", "", "0.3 %"]
    # All and nothing are neither left out nor said of what is next to them.
    there = [percents([share, 0.0])[0] for share in (0.0, 0.00004, 0.99996, 1.0)]
    assert there == ["100.0 %", "99.996 %", "0.004 %", "0.0 %"] and percents([0.0004] * 3)[0] == "99.9 %"


def test_an_object_says_when_it_was_photographed_and_how_its_lengths_follow_from_the_scene_s(results):
    house, scene = results / "objects/house", results / "scenes/demo"
    (house / "frames").mkdir()
    for name, date in (("a", "2024:06:03"), ("b", "2024:06:02"), ("c", "0000:00:00"), ("d", "    :  :  ")):
        exif = Image.Exif()
        exif[0x0132] = f"{date} 09:30:00"
        Image.new("RGB", (8, 6)).save(house / f"frames/{name}.jpg", exif=exif)
    write_json(house / "photos.json", {"photos": [{"name": f"{name}.jpg"} for name in "abcd"]})
    write_json(house / "sparse.json", {"registered": quantity(39, "1"), "total": quantity(40, "1")})
    fine = json.loads((house / "registration/full/fine.json").read_text()) | {"scale_sd_log": quantity(0.003, "1")}
    write_json(house / "registration/full/fine.json", fine)
    here = {"length_unit": quantity("m", ""), "gps_scale_sd_log": quantity(0.004, "1")}
    write_json(scene / "georeference.json", here)
    text = (summarise(results, made_by=("Hof Müller",)) / "summary.txt").read_text()
    assert re.search(r"Photos +39 of 40 used, taken 2024-06-02 to 2024-06-03\n", text)
    assert re.search(r"Scale +Trust it to 0\.5 %, 50\.0 mm on a 10 m wall \(standard deviation\)\n", text)
    assert re.search(r"Scale +Trust it to 0\.4 %, 40\.0 mm on a 10 m wall .*, by the photos' GPS\n", text)
    assert re.search(r"Made with scenefuse [\d.]+ on 20\d\d-\d\d-\d\d by Hof Müller", text)
    summary = results / "summary/summary.txt"
    text = text.replace("by Hof Müller", "by Hof Müller, Dr.\nBauer").replace(" on 20", " on 19")
    summary.write_text(text)  # exported much later, from a copy with other dates
    assert re.fullmatch(r"Made with scenefuse [\d.]+ on 19\S+ by Hof Müller, Dr. Bauer\.", made_by(summary.parent))
    # Where control points or a cloud hold the scene, its GPS does not say how well its lengths are known.
    for more in ({"control_points": quantity(5, "1")}, {"met_share": quantity(0.7, "1")}):
        write_json(scene / "georeference.json", here | more)
        text = (summarise(results) / "summary.txt").read_text()
        assert re.search(
            r"Scale +Trust it to 0\.3 %, 30\.0 mm on a 10 m wall \(standard deviation\), if the scene's is\s+right\n",
            text,
        )
    assert re.search(r"Scale +It is that of the given cloud; nothing checks it\n", text)
    assert re.search(r"Made with scenefuse [\d.]+ on 20\d\d-\d\d-\d\d\.\n", text)


@pytest.mark.parametrize(
    ("known", "answer"),
    [
        ({}, "Do not trust it: nothing gives it, and lengths are in scene units"),
        ({"length_unit": "m"}, "It is that of the given cloud; nothing checks it"),
        (
            {"lengths": 1, "lengths_scale_sd_log": 0.03},
            "Trust it to 3.0 %, 30.0 cm on a 10 m wall (standard deviation), by one known length; nothing checks it",
        ),
        ({"length_unit": "m", "up_cue": "given cameras"}, "It is that of the given cameras; nothing checks it"),
        (
            {"length_unit": "m", "met_share": 0.7, "lengths": 1, "length_rms_pct": 0.4},
            "It is that of the given cloud; one known length disagrees by 0.4 %",
        ),
        (
            {"lengths": 3, "length_rms_pct": 0.4, "lengths_scale_sd_log": 0.002},
            "Trust it to 0.2 %, 20.0 mm on a 10 m wall (standard deviation), by 3 known lengths; they disagree by",
        ),
        ({"control_points": 5, "gps_scale_sd_log": 0.02}, "Trust it as far as the 5 control points that give it"),
        ({"gps_scale_sd_log": 0.02}, "Trust it to 2.0 %, 20.0 cm on a 10 m wall (standard deviation), by the photos'"),
        # Known lengths beside what gives the scale are its one independent check.
        (
            {"gps_scale_sd_log": 0.003, "lengths": 3, "length_rms_pct": 5.2},
            "Trust it to 0.3 %, 30.0 mm on a 10 m wall (standard deviation), by the photos' GPS;"
            " 3 known lengths disagree by 5.2 %",
        ),
        (
            {"control_points": 5, "lengths": 1, "length_rms_pct": 5.2},
            "Trust it as far as the 5 control points that give it (see Position); one known length disagrees by 5.2 %",
        ),
    ],
)
def test_whether_the_scale_can_be_trusted_has_one_answer(known, answer):
    unit = known.get("length_unit", "m" if known else "scene units")
    assert scene_facts({"scene": "demo", "length_unit": unit} | known)["Scale"].startswith(answer)


def test_a_long_advice_is_cut_in_summary_and_whole_in_details(results):
    lost = [f"photo_{k:04d}_of_a_long_name.jpg" for k in range(30)]
    write_json(results / "objects/house/sparse.json", {"not_registered": quantity(lost, "")})
    summary = summarise(results)
    short, long = ((summary / f"{name}.txt").read_text().split("object balloon")[0] for name in ("summary", "details"))
    lines = short[short.index("Next  ") :].strip().splitlines()
    assert len(lines) == 3 and lines[-1].endswith("... (details.txt)")
    write_json(results / "objects/house/missing.json", {"stations": quantity(2, "")})
    first = "Next:   house: Photograph it from 2 places (results/objects/house/next_photos.csv) (1 more in the report)"
    assert closing_lines(summarise(results, ["house"])).splitlines()[-1] == first
    # Each step is cut by itself.
    blurred = {"blurred_photos": quantity({"blurred.jpg": 0.4}, "")}
    write_json(results / "objects/house/stage2.json", blurred)
    short = (summarise(results) / "summary.txt").read_text().split("object balloon")[0]
    assert re.search(r"\n {14}Blurred photos \(1\): blurred.jpg;", short) and "(details.txt)\n" in short
    assert "photograph the steps between" in " ".join(long.split()) and "details.txt" not in long


def test_shares_and_lengths_are_written_as_people_do():
    assert [percent(share) for share in (0.0, 0.00002, 0.00021, 0.018, 0.5, 0.982, 0.9996, 0.99997, 1.0)] == [
        *("0 %", "0.002 %", "0.02 %", "1.8 %", "50 %", "98.2 %", "99.96 %", "99.997 %", "100 %")
    ]
    lengths = [(0.0072, "m"), (0.256, "m"), (11.42, "m"), (0.5, "scene units"), (1234.5, "m")]
    assert [length(*given) for given in lengths] == ["7.20 mm", "25.6 cm", "11.4 m", "0.500 scene units", "1,234 m"]


def test_the_day_of_the_last_photos_is_not_passed_over(tmp_path):
    (tmp_path / "photos").mkdir()
    for k in range(60):
        exif = Image.Exif()
        exif[0x0132] = f"2024:06:0{1 + (k > 57)} 09:30:00"
        Image.new("RGB", (8, 6)).save(tmp_path / f"photos/{k:02d}.jpg", exif=exif)
    write_json(tmp_path / "photos.json", {"photos": [{"name": f"{k:02d}.jpg"} for k in range(60)]})
    assert photographed(tmp_path, "photos") == "2024-06-01 to 2024-06-02"


def test_photos_without_a_date_are_called_undated():
    row = {"registered": 12, "photos": 12, "frames": 12}
    assert scene_facts({"scene": "yard"} | row)["Photographed"] == "Undated, 12 of 12 photos used"
    assert object_facts({"object": "house", "status": "registered"} | row)["Photos"] == "12 of 12 used, undated"


@pytest.mark.parametrize("unit", ["m", "US survey foot"])
def test_coordinates_have_the_name_and_the_unit_of_their_crs_whatever_the_scene_counts_in(unit):
    feet = "US survey foot, NAD83 / California zone 3 (ftUS) (EPSG:2227)"
    assert scene_facts({"scene": "yard", "length_unit": unit, "crs": "EPSG:2227"})["Coordinates"] == feet
    assert scene_facts({"scene": "yard", "length_unit": unit})["Coordinates"].endswith(
        ", in a local frame, without a CRS"
    )


def test_lengths_of_an_object_in_a_scene_without_a_scale_are_not_trusted_in_metres():
    row = {"object": "head", "status": "registered", "unit": "scene units", "scale_sd_log": 0.011}
    assert object_facts(row)["Scale"] == "Not in metres; beside the scene it is known to 1.1 % (standard deviation)"


def test_a_scene_to_which_nothing_was_added_is_not_called_completed(results):
    nothing = {"points": quantity(5000, "points"), "added_points": quantity({}, "points")}
    write_json(results / "scenes/demo/completed.json", nothing)
    summary = summarise(results, ["balloon"])
    assert "Not completed, for no object was added; 5,000 points, as before" in (summary / "summary.txt").read_text()
    assert closing_lines(summary).startswith("Result: 0 of 1 objects completed\n")


def test_what_is_completed_in_part_alone_is_not_called_completed():
    row = {"object": "house", "status": "registered", "surface_missing": 0.913, "surface_never_seen": 0.913}
    assert object_facts(row)["Result"] == "Found in the scene and completed to 8.7 % (100 % of what photos show)"
    facts = object_facts(row | {"surface_missing": 1.0, "surface_never_seen": 1.0})
    assert facts["Result"].endswith("completed to 0.0 %") and facts["Surface"].startswith("0.0 % is there, 100.0 %")


def test_what_is_there_of_a_cloud_without_masks_is_not_said_of_the_whole_object():
    row = {"object": "house", "status": "registered", "surface_missing": 0.02, "surface_never_seen": 0.02}
    row["surface_of"] = "what its own cloud holds"
    facts = object_facts(row)
    assert facts["Result"] == "Found in the scene and completed" and verdict(row) == "completed"
    assert facts["Surface"].startswith("98.0 % of what its own cloud holds is there, 2.0 % is missing")
    whole = object_facts(row | {"surface_of": "its surface"})
    assert "completed to 98.0 % (100 % of what photos show)" in whole["Result"]


def test_how_much_of_what_is_there_photos_cannot_measure_is_said():
    row = {"object": "house", "status": "registered", "surface_missing": 0.02, "surface_never_seen": 0.02}
    said = "98.0 % is there (12 % as plain surface between measured parts), 2.0 % is missing"
    assert object_facts(row | {"surface_plain": 0.123})["Surface"].startswith(said)


def test_a_position_is_as_exact_as_what_is_known_of_it_says():
    row = {"scene": "yard", "length_unit": "m", "crs": "EPSG:32632"}
    known = {"control_rms_horizontal_m": 0.02, "gps_rms_horizontal_m": 2.0, "gps_rms_vertical_m": 3.0}
    position = scene_facts(row | known)["Position"]
    assert position == "Absolute, where on Earth the scene lies: control points are 20.0 mm horizontally off" + (
        " (root mean square)"
    )
    assert accuracies(row | known)[1] == "nine of ten less than 30.3 mm (CE90)"
    assert scene_facts(row)["Position"] == "That of the given cloud; nothing checks it"
    assert scene_facts(row | {"up_cue": "given cameras"})["Position"].startswith("That of the given cameras;")
    assert "Position" not in scene_facts({"scene": "yard"})


def test_the_result_and_the_surface_of_an_object_name_the_same_share():
    row = {"object": "house", "status": "registered", "surface_missing": 0.01152, "surface_never_seen": 0.00907}
    facts = object_facts(row | {"surface_contradicted": 0.00245})
    assert "completed to 98.8 % (99.8 % of what photos show)" in facts["Result"]
    assert facts["Surface"].startswith("98.8 % is there")


def test_a_project_is_called_by_its_folder_and_its_objects(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert title_of([tmp_path / "house", tmp_path / "shed"]) == f"{tmp_path.name}: house, shed"
    assert title_of([tmp_path / tmp_path.name]) == tmp_path.name


def test_a_page_without_a_summary_is_refused(tmp_path):
    with pytest.raises(StageError, match="write the summary first"):
        write_report(summary=tmp_path, scenes=[], objects=[], title="x", report=tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()
