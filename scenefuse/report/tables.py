"""The tables of a run: what every stage measured, side by side.

A run may be partial: a value that does not exist is empty, an object without results carries its last error.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from scenefuse.metrics.completion import MEASURES
from scenefuse.report.facts import diagnose, ground_pixel, photographed
from scenefuse.report.run_summary import RunSummary, SceneSummary, why_missing
from scenefuse.report.values import Fields, asset, find, number, parts_of, unit_of

# Of the jobs of a rule: by the clock, of the processor, and as they were forecast.
SECONDS = ("seconds", "processor_seconds", "forecast_seconds")
# What stands beside the value of a completion metric.
BESIDE = ("null", "before", "after")
# Columns of the tables and lines of details.txt, and where each value stands.
QUANTITIES: dict[str, dict[str, Any]] = yaml.safe_load(asset("quantities.yaml"))


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
        **{name: (name, "sum") for name in SECONDS},
        longest_seconds=("seconds", "max"),
        max_rss_mb=("max_rss_mb", "max"),
    )
    table = table.sort_values("seconds", ascending=False).reset_index()
    sums = [jobs[name].sum() for name in SECONDS]
    table.loc[len(table)] = ["total", len(jobs), *sums, jobs["seconds"].max(), jobs["max_rss_mb"].max()]
    return table


def disk_table(folders: Sequence[Path]) -> pd.DataFrame:
    """Disk space of the parts of result folders: name (such as `scenes/{scene}`), part, megabytes; largest first."""
    rows = [
        {"name": f"{folder.parent.name}/{folder.name}", "part": part, "megabytes": size / 1e6}
        for folder in folders
        for part, size in sorted(parts_of(folder).items(), key=lambda item: (-item[1], item[0]))
    ]
    return pd.DataFrame(rows, columns=["name", "part", "megabytes"])


def scenes_table(scenes: list[SceneSummary], folders: Sequence[Path]) -> pd.DataFrame:
    """One row a scene: photos, cameras, georeference, cloud, metrics of the completed scene, errors against truth.

    Args:
        scenes: what the run has left of them.
        folders: their results.
    """
    rows = []
    for scene, folder in zip(scenes, folders):
        fields, added = scene.fields, find(scene.fields, "completed.added_points")
        row: dict[str, Any] = {"scene": scene.name} | _columns(fields, "scenes")
        if "georeference.length_unit" in fields:
            row |= {"photographed": photographed(folder), "ground_pixel": ground_pixel(folder / "georeferenced")}
        row["completed_by"] = None if added is None else ", ".join(added) or "none"
        for measure in (name for m in MEASURES for name in (m, *(f"{m}_{beside}" for beside in BESIDE))):
            if f"metrics.completion.{measure}" in fields:
                row[measure] = number_in(fields, f"metrics.completion.{measure}")
        for key, entry in fields.items():
            if key.startswith("truth.") and isinstance(entry["value"], (int, float)):
                row[key.removeprefix("truth.")] = entry["value"]
        rows.append(row | {"error": why_missing(scene.failed) if scene.missing else None})
    return pd.DataFrame(rows)


def objects_table(run: RunSummary) -> pd.DataFrame:
    """One row an object: the result, its size (in `unit`), what is missing, what to do; cameras, stages, truth."""
    rows = []
    for item in run.objects:
        variant = run.variants[0]
        fields = item.variants[variant] | item.fusion | item.stages
        unit, size = unit_of(fields, "metrics.object.size"), find(fields, "metrics.object.size") or [None] * 3
        rows.append(
            {"object": item.name, "status": item.status(variant), "reason": item.reason(variant)}
            | dict(zip(("length", "width", "height"), size))
            | _columns(fields, "objects")
            | {"unit": unit or unit_of(fields, "crop.diagonal")}
            | {"missing": item.missing or None, "error": why_missing(item.failed) if item.missing else None}
            | {"advice": "; ".join(diagnose(item)) or None}
        )
    return pd.DataFrame(rows)


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table, column -> cell."""
    return [{str(k): v for k, v in row.items()} for row in table.to_dict("records")]


def number_in(fields: Fields, name: str) -> float | int | None:
    """The named value when it is a number."""
    found = find(fields, name)
    return found if isinstance(found, (int, float)) else None


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
