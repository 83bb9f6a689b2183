"""The tables of a run: what every stage measured, side by side.

A run may be partial: a value that does not exist is empty, an object without results carries its last error.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from scenefuse.fuse.missing import Lack
from scenefuse.metrics.completion import MEASURES
from scenefuse.metrics.scores import SCORES, THRESHOLDS
from scenefuse.report.diagnosis import diagnose
from scenefuse.report.facts import ground_pixel, photographed
from scenefuse.report.run_summary import RunSummary, SceneSummary, why_missing
from scenefuse.report.values import Fields, find, number, unit_of

# Of the jobs of a rule: by the clock, of the processor, and as they were forecast.
SECONDS = ("seconds", "processor_seconds", "forecast_seconds")
# What stands beside the value of a completion metric.
BESIDE = ("null", "before", "after")
# Columns of the tables, and where each value stands: the first that is there.
REGISTRATION = {
    **{name: f"fine.{name}" for name in ("scale", "f_score", "margin")},
    **{
        name: f"metrics.registration.{name}"
        for name in (
            *("fitness", "fitness_source", "fitness_f_score", "inlier_rmse", "inlier_rmse_over_diagonal"),
            *("normal_consistency", "normal_consistency_self", "tau"),
        )
    },
    **{
        name: f"truth.{name}"
        for name in (
            *("scale_error_pct", "rotation_error_deg", "translation_error_over_diagonal"),
            "placed_f_score_1pct",
        )
    },
}
CAMERAS = {"registered": "sparse.registered", "reprojection_error_px": "sparse.mean_reprojection_error_px"}
SURVEYED = tuple(
    f"{kind}_{name}" for kind in ("control", "check") for name in ("points", "rms_horizontal_m", "rms_vertical_m")
)
SCENE = {
    "photos": "sparse.total photos.count",
    **CAMERAS,
    "latitude_deg": "georeference.origin_latitude_deg",
    "longitude_deg": "georeference.origin_longitude_deg",
    **{name: f"georeference.{name}" for name in ("crs", "length_unit", "gps_residual_median_m", *SURVEYED)},
    **{f"gps_rms_{way}_m": f"georeference.gps_residual_{way}_rms_m" for way in ("horizontal", "vertical")},
    **{name: f"dense.{name}" for name in ("points", "spacing", "backend")},
    "completed_points": "completed.points",
}
OBJECT = {
    **{name: f"fine.{name}" for name in ("decided_by", "scale_sd_log")},
    **{f"surface_{name}": f"missing.{name}" for name in ("missing", *(lack.name.lower() for lack in Lack))},
    **{name: f"fusion.{name}" for name in ("added_points", "removed_points")},
    "measured_share": "evidence.object_measured_share",
    **{name: f"metrics.object.{name}" for name in ("deviation", "world_deviation")},
    **{name: f"missing.{name}" for name in ("stations", "stations_show")},
    "frames": "sparse.total photos.count",
    **CAMERAS,
    "masks": "masks.masks",
    "mask_iou": "truth.mask_iou_mean",
    **{
        f"stage{stage}_{column}": f"stage{stage}.{name}"
        for stage in (2, 4)
        for column, name in {"psnr_db": "psnr_held_out", "ssim": "ssim", "measured_on": "measured_on"}.items()
    },
    **{
        f"stage{stage}_{column}": f"truth.stage{stage}_{name}"
        for stage in (1, 2, 3, 4)
        for column, name in {
            "depth_error_over_diagonal": "depth_error",
            "depth_within_1pct": "depth_within_1pct",
        }.items()
    },
    "points": "object.points",
    "cloud_accuracy_median_pct_of_diagonal": "truth.cloud_accuracy_median",
    **{f"cloud_{s}_{t}": f"truth.cloud_{s}_{t}" for t, s in itertools.product(THRESHOLDS, SCORES)},
}


def registration_table(run: RunSummary) -> pd.DataFrame:
    """One row an object and variant: status, reason, scores, errors against truth; lengths in the scene's unit."""
    rows = [
        {"object": item.name, "variant": variant, "status": item.status(variant), "reason": item.reason(variant)}
        | _columns(item.variants[variant], REGISTRATION)
        for item in run.objects
        for variant in run.variants
    ]
    return pd.DataFrame(rows, columns=["object", "variant", "status", "reason", *REGISTRATION])


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
        for threshold, score in itertools.product(THRESHOLDS, SCORES):
            cells = {w: number_in(item.stages, f"truth.scene_{score}_{w}_{threshold}") for w in ("before", "after")}
            if cells["before"] is not None:
                measures[f"scene_{score}_{threshold}"] = {"unit": "1", **cells}
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


def scenes_table(scenes: list[SceneSummary], folders: Sequence[Path]) -> pd.DataFrame:
    """One row a scene: photos, cameras, georeference, cloud, metrics of the completed scene, errors against truth.

    Args:
        scenes: what the run has left of them.
        folders: their results.
    """
    rows = []
    for scene, folder in zip(scenes, folders):
        fields, added = scene.fields, find(scene.fields, "completed.added_points")
        row: dict[str, Any] = {"scene": scene.name} | _columns(fields, SCENE)
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
            | _columns(fields, OBJECT)
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


def _columns(fields: Fields, columns: dict[str, str]) -> dict[str, Any]:
    """The cells of a row."""
    return {name: plain(find(fields, *keys.split())) for name, keys in columns.items()}


def _measure(key: str) -> tuple[str, str]:
    """A completion key as (measure, column): `nue_null` is the null of `nue`."""
    name, _, column = key.rpartition("_")
    return (name, column) if column in BESIDE else (key, "value")
