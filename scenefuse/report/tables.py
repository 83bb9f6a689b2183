"""The tables of a run: what every stage measured, side by side.

A run may be partial: a value that does not exist is empty, an object without results carries its last error.
"""

import itertools
from pathlib import Path
from typing import Any

import pandas as pd

from scenefuse.metrics.completion import MEASURES
from scenefuse.metrics.scores import SCORES, THRESHOLDS
from scenefuse.report.run_summary import ObjectSummary, RunSummary, SceneSummary, why_missing
from scenefuse.report.values import Fields, find, number

# Columns of registration.tsv: name, and where its value stands.
REGISTRATION: dict[str, str] = {
    "scale": "fine.scale",
    "f_score": "fine.f_score",
    "margin": "fine.margin",
    **{
        name: f"metrics.registration.{name}"
        for name in (
            *("fitness", "fitness_source", "fitness_f_score", "inlier_rmse", "inlier_rmse_over_diagonal"),
            *("normal_consistency", "normal_consistency_self", "tau"),
        )
    },
    "scale_error_pct": "truth.scale_error_pct",
    "rotation_error_deg": "truth.rotation_error_deg",
    "translation_error_over_diagonal": "truth.translation_error_over_diagonal",
    "placed_f_score_1pct": "truth.placed_f_score_1pct",
}
# The completion metrics of the completed scene that scenes.tsv holds, each with what stands beside it.
BESIDE = ("null", "before", "after")
# Columns of scenes.tsv for surveyed points, in `georeference.json` too.
SURVEYED = tuple(
    f"{kind}_{name}" for kind in ("control", "check") for name in ("points", "rms_horizontal_m", "rms_vertical_m")
)


def registration_table(run: RunSummary) -> pd.DataFrame:
    """One row an object and variant: status, reason, scores, errors against truth; lengths in the scene's unit."""
    rows: list[dict[str, Any]] = []
    for item in run.objects:
        for variant in run.variants:
            fields = item.variants.get(variant, {})
            row = {
                "object": item.name,
                "variant": variant,
                "status": item.status(variant),
                "reason": item.reason(variant),
            }
            rows.append({**row, **{name: number_in(fields, key) for name, key in REGISTRATION.items()}})
    return pd.DataFrame(rows, columns=["object", "variant", "status", "reason", *REGISTRATION])


def completion_table(run: RunSummary) -> pd.DataFrame:
    """One row an object and measure: of what was added, of a random cloud in its place (null), before and after.

    Scores against truth (`scene_*`) are those of the scene around the object, before and after fusion.
    """
    rows: list[dict[str, Any]] = []
    for item in run.objects:
        fields = item.variants[run.variants[0]]
        group = {k.split("completion.", 1)[1]: v for k, v in fields.items() if k.startswith("metrics.completion.")}
        of_measure: dict[str, dict[str, Any]] = {}
        for key, entry in group.items():
            name, column = _measure(key)
            cells = of_measure.setdefault(name, {"unit": entry["unit"]})
            cells[column] = plain(entry["value"])
        for threshold, score in itertools.product(THRESHOLDS, SCORES):
            cells = {w: number_in(item.stages, f"truth.scene_{score}_{w}_{threshold}") for w in ("before", "after")}
            if cells["before"] is not None:
                of_measure[f"scene_{score}_{threshold}"] = {"unit": "1", **cells}
        rows += [{"object": item.name, "measure": name, **cells} for name, cells in of_measure.items()]
    return pd.DataFrame(rows, columns=["object", "measure", "unit", "value", *BESIDE])


def runtime_table(benchmarks: Path) -> pd.DataFrame:
    """One row a rule and a last row `total`: jobs, seconds summed over its jobs, the longest, the largest memory."""
    rows = []
    for path in sorted(benchmarks.rglob("*.tsv")) if benchmarks.is_dir() else []:
        try:
            table = pd.read_csv(path, sep="\t", na_values=["-", "NA"])
            seconds, memory = table["s"].astype(float).sum(), table["max_rss"].astype(float).max()
        except (OSError, ValueError, KeyError, pd.errors.ParserError):
            continue
        rows.append((path.relative_to(benchmarks).parts[0].removesuffix(".tsv"), seconds, memory))
    jobs = pd.DataFrame(rows, columns=["rule", "seconds", "max_rss_mb"])
    table = jobs.groupby("rule", sort=True).agg(
        jobs=("seconds", "size"),
        seconds=("seconds", "sum"),
        longest_seconds=("seconds", "max"),
        max_rss_mb=("max_rss_mb", "max"),
    )
    table = table.sort_values("seconds", ascending=False).reset_index()
    total = [len(jobs), jobs["seconds"].sum(), jobs["seconds"].max(), jobs["max_rss_mb"].max()]
    table.loc[len(table)] = ["total", *total]
    return table


def scenes_table(scenes: list[SceneSummary]) -> pd.DataFrame:
    """One row a scene: photos, cameras, georeference, cloud, metrics of the completed scene, errors against truth."""
    rows = []
    for scene in scenes:
        fields = scene.fields
        added = find(fields, "completed.added_points")
        row: dict[str, Any] = {
            "scene": scene.name,
            "photos": number_in(fields, "sparse.total", "photos.count"),
            "registered": number_in(fields, "sparse.registered"),
            "reprojection_error_px": number_in(fields, "sparse.mean_reprojection_error_px"),
            "length_unit": plain(find(fields, "georeference.length_unit")),
            "gps_residual_median_m": number_in(fields, "georeference.gps_residual_median_m"),
            **{name: number_in(fields, f"georeference.{name}") for name in SURVEYED},
            "points": number_in(fields, "dense.points"),
            "spacing": number_in(fields, "dense.spacing"),
            "backend": plain(find(fields, "dense.backend")),
            "completed_points": number_in(fields, "completed.points"),
            "completed_by": None if added is None else ", ".join(added) or "none",
        }
        for measure in (n for m in MEASURES for n in (m, *(f"{m}_{beside}" for beside in BESIDE))):
            if f"metrics.completion.{measure}" in fields:
                row[measure] = number_in(fields, f"metrics.completion.{measure}")
        row |= {key.removeprefix("truth."): v["value"] for key, v in truth_numbers(fields).items()}
        row["error"] = why_missing(scene.failed) if scene.missing else None
        rows.append(row)
    return pd.DataFrame(rows)


def objects_table(objects: list[ObjectSummary]) -> pd.DataFrame:
    """One row an object: cameras, masks, the four stages, the cloud against truth."""
    rows = []
    for item in objects:
        fields = item.stages
        row: dict[str, Any] = {
            "object": item.name,
            "frames": number_in(fields, "sparse.total", "photos.count"),
            "registered": number_in(fields, "sparse.registered"),
            "reprojection_error_px": number_in(fields, "sparse.mean_reprojection_error_px"),
            "masks": number_in(fields, "masks.masks"),
            "mask_iou": number_in(fields, "truth.mask_iou_mean"),
        }
        for stage in (2, 4):
            row[f"stage{stage}_psnr_db"] = number_in(fields, f"stage{stage}.psnr_held_out")
            row[f"stage{stage}_ssim"] = number_in(fields, f"stage{stage}.ssim")
            row[f"stage{stage}_measured_on"] = find(fields, f"stage{stage}.measured_on")
        for stage in (1, 2, 3, 4):
            row[f"stage{stage}_depth_error_over_diagonal"] = number_in(fields, f"truth.stage{stage}_depth_error")
            row[f"stage{stage}_depth_within_1pct"] = number_in(fields, f"truth.stage{stage}_depth_within_1pct")
        row["points"] = number_in(fields, "object.points")
        row["cloud_accuracy_median_pct_of_diagonal"] = number_in(fields, "truth.cloud_accuracy_median")
        for threshold, score in itertools.product(THRESHOLDS, SCORES):
            row[f"cloud_{score}_{threshold}"] = number_in(fields, f"truth.cloud_{score}_{threshold}")
        row["missing"] = item.missing or None
        row["error"] = why_missing(item.failed) if item.missing else None
        rows.append(row)
    return pd.DataFrame(rows)


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table, column -> cell."""
    return [{str(k): v for k, v in row.items()} for row in table.to_dict("records")]


def truth_numbers(fields: Fields) -> Fields:
    """The numbers among the comparisons with truth; matrices and lists are left out."""
    return {k: v for k, v in fields.items() if k.startswith("truth.") and isinstance(v["value"], (int, float))}


def number_in(fields: Fields, *names: str) -> float | int | None:
    """The first of the named values when it is a number."""
    found = find(fields, *names)
    return found if isinstance(found, (int, float)) else None


def plain(item: Any) -> Any:
    """One table cell: text and numbers as they are, lists and mappings as text."""
    if isinstance(item, dict):
        return ", ".join(f"{k} {number(v)}" for k, v in item.items())
    return ", ".join(number(v) for v in item) if isinstance(item, list) else item


def _measure(key: str) -> tuple[str, str]:
    """A completion key as (measure, column): `nue_null` is the null of `nue`."""
    for column in BESIDE:
        if key.endswith(f"_{column}"):
            return key.removesuffix(f"_{column}"), column
    return key, "value"
