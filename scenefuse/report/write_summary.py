"""The summary stage: tables; summary.txt, one screen of what a client asks; details.txt, a block for each scene and
object with what the stages measured, chose and noted, then time and memory."""

import math
import re
import shutil
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from scenefuse.core.stage import atomic_file
from scenefuse.core.version import VERSION
from scenefuse.report.facts import (
    BETWEEN,
    accuracies,
    diagnose,
    is_current,
    made_today,
    object_facts,
    of_cameras,
    photographed,
    scene_facts,
    verdict,
)
from scenefuse.report.forecast import FORECAST, read_forecast
from scenefuse.report.run_summary import ObjectSummary, RunInputs, RunSummary, SceneSummary, summarise, why_missing
from scenefuse.report.values import Fields, asset, find, number, records, unit_of

# Seconds of a rule's jobs: by the clock, of the processor, and as they were forecast.
SECONDS = ("seconds", "processor_seconds", "forecast_seconds")
# What stands beside the value of a completion metric.
BESIDE = ("null", "before", "after")
# Columns of the tables and lines of details.txt, and where each value stands.
QUANTITIES: dict[str, dict[str, Any]] = yaml.safe_load(asset("quantities.yaml"))
WIDTH = 100
# Quantities of a stage that are worth a line: what it chose where it had a choice, and what it noted.
CHOICES = ("pose_source", "backend", "method", "mode", "up_cue")
NOTES = re.compile(r"(^|[._])(fallbacks?|warnings?|notes?|reason|not_registered|models_left_out|gps_outliers)$")
# Those that have a line of their own, or nothing that a user acts on.
REASONS = ("fine.reason", "fusion.reason", "alignment.reason", "matches.pairs_reason")
Cell = tuple[str, Any, str]


def write_summary(*, run: RunInputs, summary: Path) -> None:
    """Collect every stage JSON and benchmark into tables and a text that reads well in a terminal.

    Writes registration.tsv, completion.tsv, runtime.tsv, scenes.tsv, objects.tsv, details.txt and, last,
    summary.txt.
    A value that does not exist is '-'. An object without results is named with the last error of its logs. What an
    earlier run left behind a step that failed since is not shown.

    Args:
        run: see RunInputs.
        summary: output folder; of other files in it, report.pdf goes, and other exports of earlier results with it.
    """
    found = summarise(run)
    tables = {
        "registration": registration_table(found),
        "completion": completion_table(found),
        "runtime": runtime_table(run.jobs.benchmarks, read_forecast(run.jobs.logs / FORECAST)),
        "scenes": scenes_table(found.scenes, run),
        "objects": objects_table(found, run),
    }
    for name, table in tables.items():
        with atomic_file(summary / f"{name}.tsv") as temporary:
            table.to_csv(temporary, sep="\t", index=False, na_rep="-", float_format="%.10g")
    texts = {"details": details_text(found, tables), "summary": summary_text(found, tables, made_today(summary))}
    for name, text in texts.items():
        with atomic_file(summary / f"{name}.txt") as temporary:
            temporary.write_text(text)
    print(texts["summary"], flush=True)
    # What was exported of earlier results may not be handed over as of these.
    (summary / "report.pdf").unlink(missing_ok=True)
    made_of = [(folder / "drawings", "drawings.pdf", "fused.ply") for folder in run.objects]
    for folder in run.scenes:
        made_of += [(folder / "tiles", "points/tileset.json", "completed.ply")]
        made_of += [(folder / "cameras", "cameras.xml", "completed.ply")]
    for folder, file, source in made_of:
        if not is_current(folder / file, folder.parent / source):
            shutil.rmtree(folder, ignore_errors=True)


def registration_table(run: RunSummary) -> pd.DataFrame:
    """One row an object and variant: status, reason, scores, errors against truth; lengths in the scene's unit."""
    rows = [
        {"object": item.name, "variant": variant, "status": item.status(variant), "reason": item.reason(variant)}
        | _columns(item.variants[variant], "registration")
        for item in run.objects
        for variant in run.variants
    ]
    return pd.DataFrame(rows, columns=["object", "variant", "status", "reason", *QUANTITIES["columns"]["registration"]])


def completion_table(run: RunSummary) -> pd.DataFrame:
    """One row an object and measure: of what was added, of a random cloud in its place (null), before and after.

    Scores against truth (`scene_*`) are those of the scene around the object, before and after fusion.
    """
    rows: list[dict[str, Any]] = []
    for item in run.objects:
        measures: dict[str, dict[str, Any]] = {}
        for key, entry in item.variants[run.variants[0]].items():
            if key.startswith("metrics.completion."):
                name, column = _measure(key.removeprefix("metrics.completion."))
                measures.setdefault(name, {"unit": entry["unit"]})[column] = plain(entry["value"])
        for score, before, threshold in (key.partition("_before_") for key in item.stages):
            if before and score.startswith("truth.scene_"):
                cells = {w: find(item.stages, f"{score}_{w}_{threshold}") for w in ("before", "after")}
                measures[f"{score.removeprefix('truth.')}_{threshold}"] = {"unit": "1", **cells}
        rows += [{"object": item.name, "measure": name, **cells} for name, cells in measures.items()]
    return pd.DataFrame(rows, columns=["object", "measure", "unit", "value", *BESIDE])


def runtime_table(benchmarks: Path, forecast: Mapping[str, float]) -> pd.DataFrame:
    """One row a rule and a last row `total`: jobs, seconds by the clock, of the processor and forecast, largest memory.

    Args:
        benchmarks: folder of Snakemake's benchmarks.
        forecast: processor seconds by a benchmark's file.
    """
    rows = []
    for path in sorted(benchmarks.rglob("*.tsv")) if benchmarks.is_dir() else []:
        try:
            table = pd.read_csv(path, sep="\t", na_values=["-", "NA"])
            clock, processor = table["s"].astype(float).sum(), table["cpu_time"].astype(float).sum()
            memory = table["max_rss"].astype(float).max()
        except (OSError, ValueError, KeyError, pd.errors.ParserError):
            continue
        rule = path.relative_to(benchmarks).parts[0].removesuffix(".tsv")
        rows.append((rule, clock, processor, forecast.get(str(path), math.nan), memory))
    jobs = pd.DataFrame(rows, columns=["rule", *SECONDS, "max_rss_mb"])
    table = jobs.groupby("rule", sort=True).agg(
        jobs=("seconds", "size"),
        # What is not known of one job is not known of them all.
        **{name: (name, lambda column: column.sum(skipna=False)) for name in SECONDS},
        longest_seconds=("seconds", "max"),
        max_rss_mb=("max_rss_mb", "max"),
    )
    table = table.sort_values("seconds", ascending=False).reset_index()
    sums = jobs[[*SECONDS]].sum(skipna=False)
    table.loc[len(table)] = ["total", len(jobs), *sums, jobs["seconds"].max(), jobs["max_rss_mb"].max()]
    return table


def scenes_table(scenes: list[SceneSummary], inputs: RunInputs) -> pd.DataFrame:
    """One row a scene: photos, cameras, georeference, cloud, errors against truth.

    Args:
        scenes: what the run has left of them.
        inputs: of the run.
    """
    rows = []
    for scene, folder, maker in zip(scenes, inputs.scenes, inputs.made_by or [""] * len(scenes), strict=True):
        fields, by = scene.fields, find(scene.fields, "completed.added_points")
        row: dict[str, Any] = {"scene": scene.name, "made_by": maker or None} | _columns(fields, "scenes")
        if "georeference.length_unit" in fields:
            row |= {"photographed": photographed(folder, "photos")} | of_cameras(folder / "georeferenced")
        row |= _scale_sd(fields) | {"completed_by": None if by is None else ", ".join(by) or "none"}
        for key, entry in fields.items():
            if key.startswith("truth.") and isinstance(entry["value"], (int, float)):
                row[key.removeprefix("truth.")] = entry["value"]
        rows.append(row | {"error": why_missing(scene.failed) if scene.missing else None})
    return pd.DataFrame(rows)


def _scale_sd(scene: Fields) -> dict[str, float | None]:
    """How well the photos' GPS or known lengths give a scene's scale; None where others or nothing give it."""
    others = {"georeference.control_points", "georeference.met_share"} & set(scene)
    names = ("gps_scale_sd_log", "lengths_scale_sd_log")
    return {name: None if others else find(scene, f"georeference.{name}") for name in names}


def objects_table(run: RunSummary, inputs: RunInputs) -> pd.DataFrame:
    """One row an object: the result, its size (in `unit`), what is missing, what to do; cameras, stages, truth."""
    rows, scenes = [], {scene.name: scene.fields for scene in run.scenes}
    for item, folder, scene in zip(run.objects, inputs.objects, inputs.scene_of):
        variant = run.variants[0]
        fields = item.variants[variant] | item.fusion | item.stages
        # A pose that was refused says neither how large an object is nor how well that is known.
        for name in ("metrics.object.size", "fine.scale_sd_log") if item.status(variant) == "unregistered" else ():
            fields.pop(name, None)
        unit, size = unit_of(fields, "metrics.object.size"), find(fields, "metrics.object.size") or [None] * 3
        rows.append(
            {"object": item.name, "status": item.status(variant), "reason": item.reason(variant)}
            | dict(zip(("length", "width", "height"), size))
            | _columns(fields, "objects")
            | {"unit": unit or unit_of(fields, "crop.diagonal") or find(fields, "sparse.length_unit")}
            | {"scene": scene or None, "crs": find(scenes.get(scene, {}), "georeference.crs")}
            | {"scene_scale_sd_log": next(filter(None, _scale_sd(scenes.get(scene, {})).values()), None)}
            | {"photographed": photographed(folder, "frames")}
            | {"missing": item.missing or None, "error": why_missing(item.failed) if item.missing else None}
            | {"advice": BETWEEN.join(diagnose(item)) or None}
        )
    return pd.DataFrame(rows)


def plain(item: Any) -> Any:
    """One table cell: text and numbers as they are, lists and mappings as text."""
    if isinstance(item, dict):
        return ", ".join(f"{k} {number(v)}" for k, v in item.items())
    return ", ".join(number(v) for v in item) if isinstance(item, list) else item


def _columns(fields: Fields, table: str) -> dict[str, Any]:
    """The cells of a row."""
    return {name: plain(find(fields, *keys.split())) for name, keys in QUANTITIES["columns"][table].items()}


def _measure(key: str) -> tuple[str, str]:
    """A completion key as (measure, column): `nue_null` is the null of `nue`."""
    name, _, column = key.rpartition("_")
    return (name, column) if column in BESIDE else (key, "value")


def summary_text(run: RunSummary, tables: dict[str, pd.DataFrame], made: str) -> str:
    """What a client asks of each scene and object, in three lines at most."""
    lines: list[str] = []
    for row in records(tables["scenes"]):
        lines += ["", f"scene {row['scene']}", *_fact_lines(scene_facts(row), most=3)]
    for row in records(tables["objects"]):
        lines += ["", f"object {row['object']}: {verdict(row)}", *_fact_lines(object_facts(row), most=3)]
    if run.failed:
        lines += ["", "jobs that failed", *(line for job in run.failed for line in _line("", job))]
    more = "details.txt says what the stages measured and chose; report.html shows it all."
    return "\n".join([*lines, "", f"{_count(run.objects, run.variants[0])}.", *textwrap.wrap(made, WIDTH), more]) + "\n"


def _fact_lines(facts: dict[str, str], most: int | None = None) -> list[str]:
    return [line for label, text in facts.items() for line in _line(label, text, most)]


def details_text(run: RunSummary, tables: dict[str, pd.DataFrame]) -> str:
    """The text, from the summary of a run and its tables."""
    details, lines, first = QUANTITIES["details"], list[str](), run.variants[0]
    for scene, row in zip(run.scenes, records(tables["scenes"])):
        lines += _heading(f"scene {scene.name}") + _fact_lines(scene_facts(row))
        lines += _line("accuracies", "; ".join(accuracies(row)))
        lines += [] if scene.missing else _detail_lines(details["scene"], scene.fields)
    for item, row in zip(run.objects, records(tables["objects"])):
        fields = item.stages | item.variants[first] | item.fusion
        lines += _heading(f"object {item.name}: {row['status']}") + _fact_lines(object_facts(row))
        lines += _line("accuracies", "; ".join(accuracies(row))) + _line("missing", item.missing)
        others = (f"{variant} {item.status(variant)}" for variant in run.variants[1:])
        lines += _line("variants", ", ".join(others) if find(fields, "fine.status") else "")
        lines += _detail_lines(details["object"], fields)
    total = records(tables["runtime"])[-1]
    lines += _heading(_count(run.objects, first))
    time = {"by the clock": "seconds", "of the processor": "processor_seconds", "forecast": "forecast_seconds"}
    cells: list[Cell] = [(label, total[name] or None, "s") for label, name in time.items()]
    lines += _line("jobs", _pairs(("", total["jobs"], ""), *cells, ("largest", total["max_rss_mb"], "MB")))
    return "\n".join([*lines, *_line("scenefuse", VERSION)]) + "\n"


def _heading(text: str) -> list[str]:
    return ["", text, "-" * min(len(text), WIDTH)]


def _line(label: str, text: str, most: int | None = None) -> list[str]:
    """`label   text`, wrapped with paths whole, continuation lines indented; `most` is how many a line may take."""
    lines, wrapper = list[str](), textwrap.TextWrapper(WIDTH, break_long_words=False, break_on_hyphens=False)
    wrapper.subsequent_indent, wrapper.max_lines, wrapper.placeholder = " " * 14, most, " ... (details.txt)"
    for part in text.splitlines():
        wrapper.initial_indent = f"{'' if lines else label:<13} "
        lines += wrapper.wrap(part)
    return lines


def _pairs(*cells: Cell) -> str:
    """`name value unit, ...` of the values that exist."""
    return ", ".join(
        f"{name} {number(item)}{f' {unit}' if unit not in ('', '1') else ''}".strip()
        for name, item, unit in cells
        if number(item) not in ("-", "nan")
    )


def _count(objects: list[ObjectSummary], variant: str) -> str:
    """How many objects are done."""
    statuses = [item.status(variant) for item in objects]
    joined, alone = sum(not item.alone for item in objects), [item.name for item in objects if item.alone]
    parts = [f"{statuses.count('registered')} of {joined} objects registered and fused"] if joined else []
    parts += [f"in no scene: {', '.join(alone)}"] if alone or not joined else []
    unchecked = f", {statuses.count('ungated')} fused without a check of the pose" if "ungated" in statuses else ""
    return "; ".join(parts) + unchecked


def _in_words(key: str) -> str:
    return key.replace(".", " ").replace("_", " ")


def _detail_lines(details: dict[str, dict[str, str]], fields: Fields) -> list[str]:
    """The lines of what there is, and every choice, fallback, warning and note that a stage recorded."""
    lines = list[str]()
    for label, names in details.items():
        keys = {name: key.split() for name, key in names.items()}
        cells = [(name, plain(find(fields, *key)), unit_of(fields, *key) or "") for name, key in keys.items()]
        lines += _line(label, _pairs(*cells))
    chosen = {k: i["value"] for k, i in fields.items() if k.rsplit(".", 1)[-1] in CHOICES and k.count(".") == 1}
    said = (f"{_in_words(k)} {number(plain(v))}" for k, v in chosen.items() if v not in (None, ""))
    lines += _line("chosen", "; ".join(said))
    for key, item in fields.items():
        if NOTES.search(key) and key not in REASONS and item["value"] not in (None, "", [], {}, False):
            lines += _line("note", f"{_in_words(key)}: {plain(item['value'])}")
    return lines
