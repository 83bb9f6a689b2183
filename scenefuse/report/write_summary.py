"""The summary stage: tables; summary.txt, one screen of what a client asks; details.txt, a block for each scene and
object with what the stages measured, chose and noted, then time and memory."""

import re
import textwrap
from collections.abc import Collection
from pathlib import Path
from typing import Any

import pandas as pd

from scenefuse.core.stage import atomic_file
from scenefuse.core.version import VERSION
from scenefuse.report.facts import object_facts, scene_facts
from scenefuse.report.forecast import FORECAST, read_forecast
from scenefuse.report.run_summary import ObjectSummary, RunInputs, RunSummary, summarise
from scenefuse.report.tables import (
    QUANTITIES,
    completion_table,
    disk_table,
    objects_table,
    plain,
    records,
    registration_table,
    runtime_table,
    scenes_table,
)
from scenefuse.report.values import Fields, find, number, unit_of

WIDTH = 100
# Facts that the one screen of summary.txt leaves to the page.
ON_PAGE_ONLY = {"Points", "Photos"}
# Quantities of a stage that are worth a line: what it chose where it had a choice, and what it noted.
CHOICES = ("pose_source", "backend", "method", "mode", "up_cue")
NOTES = re.compile(r"(^|[._])(fallbacks?|warnings?|notes?|reason|not_registered|models_left_out|gps_outliers)$")
# Those that have a line of their own, or nothing that a user acts on.
REASONS = ("fine.reason", "fusion.reason", "alignment.reason", "matches.pairs_reason")
Cell = tuple[str, Any, str]


def write_summary(*, run: RunInputs, summary: Path) -> None:
    """Collect every stage JSON and benchmark into tables and a text that reads well in a terminal.

    Writes registration.tsv, completion.tsv, runtime.tsv, scenes.tsv, objects.tsv, disk.tsv, details.txt and, last,
    summary.txt.
    A value that does not exist is '-'. An object without results is named with the last error of its logs. What an
    earlier run left behind a step that failed since is not shown.

    Args:
        run: see RunInputs.
        summary: output folder; other files in it are left alone.

    Raises:
        StageError: no variant is given, or not one scene for each object.
    """
    found = summarise(run)
    tables = {
        "registration": registration_table(found),
        "completion": completion_table(found),
        "runtime": runtime_table(run.jobs.benchmarks, read_forecast(run.jobs.logs / FORECAST)),
        "scenes": scenes_table(found.scenes, run.scenes),
        "objects": objects_table(found),
        "disk": disk_table([*run.scenes, *run.objects]),
    }
    for name, table in tables.items():
        with atomic_file(summary / f"{name}.tsv") as temporary:
            table.to_csv(temporary, sep="\t", index=False, na_rep="-", float_format="%.8g")
    texts = {"details": details_text(found, tables), "summary": summary_text(found, tables)}
    for name, text in texts.items():
        with atomic_file(summary / f"{name}.txt") as temporary:
            temporary.write_text(text)
    print(texts["summary"], flush=True)


def summary_text(run: RunSummary, tables: dict[str, pd.DataFrame]) -> str:
    """What a client asks of each scene and object, in a line or two each."""
    lines: list[str] = []
    for row in records(tables["scenes"]):
        lines += _heading(f"scene {row['scene']}") + _fact_lines(scene_facts(row), ON_PAGE_ONLY)
    for row in records(tables["objects"]):
        lines += _heading(f"object {row['object']}: {row['status']}") + _fact_lines(object_facts(row), ON_PAGE_ONLY)
    if run.failed:
        lines += _heading("jobs that failed") + [line for job in run.failed for line in _line("", job)]
    lines += _heading(_count(run.objects, run.variants[0]))
    return "\n".join([*lines, "details.txt says what the stages measured and chose; report.html shows it all."]) + "\n"


def _fact_lines(facts: dict[str, str], without: Collection[str] = ()) -> list[str]:
    return [line for label, text in facts.items() if label not in without for line in _line(label, text)]


def details_text(run: RunSummary, tables: dict[str, pd.DataFrame]) -> str:
    """The text, from the summary of a run and its tables."""
    details, lines, first = QUANTITIES["details"], list[str](), run.variants[0]
    for scene, row in zip(run.scenes, records(tables["scenes"])):
        lines += _heading(f"scene {scene.name}") + _fact_lines(scene_facts(row))
        lines += [] if scene.missing else _detail_lines(details["scene"], scene.fields)
    for item, row in zip(run.objects, records(tables["objects"])):
        fields = item.stages | item.variants[first] | item.fusion
        lines += _heading(f"object {item.name}: {row['status']}") + _fact_lines(object_facts(row))
        lines += _line("missing", item.missing)
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


def _line(label: str, text: str) -> list[str]:
    """`label   text`, wrapped, continuation lines indented."""
    return textwrap.wrap(text, WIDTH, initial_indent=f"{label:<14}", subsequent_indent=" " * 14) if text else []


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


def _detail_lines(details: dict[str, dict[str, str]], fields: Fields) -> list[str]:
    """The lines of what there is, and every choice, fallback, warning and note that a stage recorded."""
    lines = list[str]()
    for label, names in details.items():
        keys = {name: key.split() for name, key in names.items()}
        cells = [(name, plain(find(fields, *key)), unit_of(fields, *key) or "") for name, key in keys.items()]
        lines += _line(label, _pairs(*cells))
    chosen = {k: i["value"] for k, i in fields.items() if k.rsplit(".", 1)[-1] in CHOICES and k.count(".") == 1}
    lines += _line("chosen", "; ".join(f"{k} {number(plain(v))}" for k, v in chosen.items() if v not in (None, "")))
    for key, item in fields.items():
        if NOTES.search(key) and key not in REASONS and item["value"] not in (None, "", [], {}, False):
            lines += _line("note", f"{key}: {plain(item['value'])}")
    return lines
