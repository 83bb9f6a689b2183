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
from scenefuse.report.disk import disk_table
from scenefuse.report.facts import object_facts, scene_facts
from scenefuse.report.forecast import FORECAST, read_forecast
from scenefuse.report.run_summary import (
    ObjectSummary,
    RunInputs,
    RunSummary,
    SceneSummary,
    summarise,
)
from scenefuse.report.tables import (
    completion_table,
    number_in,
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
ON_PAGE_ONLY = {"Points", "Photos", "Residuals"}
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
    lines: list[str] = []
    for scene, row in zip(run.scenes, records(tables["scenes"])):
        lines += _heading(f"scene {scene.name}") + _fact_lines(scene_facts(row)) + _scene_lines(scene, row)
    for item, row in zip(run.objects, records(tables["objects"])):
        lines += _heading(f"object {item.name}: {row['status']}") + _fact_lines(object_facts(row))
        lines += _line("missing", item.missing) + _object_lines(item, row, run.variants)
    total = records(tables["runtime"])[-1]
    lines += _heading(_count(run.objects, run.variants[0]))
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


def _scene_lines(scene: SceneSummary, row: dict[str, Any]) -> list[str]:
    if scene.missing:
        return []
    fields = scene.fields
    lines = _line("given", _given(fields, "dense")) + _line("cameras", _cameras(row, "photos"))
    known = ("known lengths", find(fields, "georeference.lengths"), "")
    lines += _line("lengths", _pairs(known, ("RMS", find(fields, "georeference.length_rms_m"), "m")))
    lines += _line("cloud", _pairs(("points", row["points"], ""), ("spacing", row["spacing"], str(row["length_unit"]))))
    errors = {
        "cameras off (median)": "camera_position_median",
        "georeference off (median)": "georeference_error_median",
        "cloud off (median)": "cloud_distance_median",
        "terrain covered": "terrain_covered",
    }
    return lines + _line("truth", _truth(fields, errors)) + _remarks(fields)


def _given(fields: Fields, stage: str) -> str:
    """The file that a scene or an object was given as, or ""."""
    source = find(fields, f"{stage}.source")
    if not source:
        return ""
    if find(fields, f"{stage}.seen_share") is None:
        return f"as a cloud, {source}, without photos"
    if find(fields, "georeference.laid_on_cloud_by") is not None:
        return f"the cloud {source}, on which the photos were laid"
    outside = find(fields, f"{stage}.outside_masks")
    cut = f"; {outside} points outside the masks were left out" if outside else ""
    return f"the cloud {source}, in the coordinates of the given cameras{cut}"


def _cameras(row: dict[str, Any], pictures: str) -> str:
    """How many photos or frames are registered, and how well; "" where there are no photos."""
    if row["registered"] is None or row["registered"] != row["registered"]:
        return ""
    registered = f"{number(row['registered'])} of {number(row[pictures])} {pictures} registered"
    return ", ".join(filter(None, [registered, _pairs(("reprojection error", row["reprojection_error_px"], "px"))]))


def _object_lines(item: ObjectSummary, row: dict[str, Any], variants: list[str]) -> list[str]:
    fields = item.variants[variants[0]]
    lines = _line("given", _given(item.stages, "object")) + _line("cameras", _cameras(row, "frames"))
    lines += _line("lengths", _own_lengths(item.stages, fields))
    psnr = ("PSNR", row["stage4_psnr_db"], f"dB on {row['stage4_measured_on'] or 'photos'}")
    lines += _line("NeRF", _pairs(psnr, ("SSIM", row["stage4_ssim"], "")))
    lines += _line("cloud", _pairs(("points", row["points"], ""), ("masks", row["masks"], "")))
    lines += _line("alignment", _alignment(item.stages)) + _line("pose", _pose(fields))
    others = (f"{variant} {item.status(variant)}" for variant in variants[1:])
    lines += _line("variants", ", ".join(others) if find(fields, "fine.status") else "")
    unconfirmed = ("of the object unconfirmed", find(item.fusion, "fusion.nerf_only_points"), "")
    lines += _line("fusion", _pairs(("mode", find(item.fusion, "fusion.mode"), ""), unconfirmed))
    removed = find(item.fusion, "evidence.scene_removed") or {}
    lines += _line("taken away", _pairs(*((f"{why}:", count, "points") for why, count in removed.items() if count)))
    lines += _line("truth", _object_truth(item, fields))
    return lines + _remarks(item.stages | fields | item.fusion)


def _own_lengths(stages: Fields, fields: Fields) -> str:
    """How well an object's own known lengths agree with each other and, once it is placed, with the scene; or ""."""
    off = find(stages, "sparse.lengths_off_m")
    if not off:
        return ""
    known = "in metres by known lengths; off one scale by " + ", ".join(f"{n} {o:+.2g} m" for n, o in off.items())
    scale = find(fields, "fine.scale")
    if scale is None or find(fields, "fine.status") != "registered":
        return known
    if fields["crop.diagonal"]["unit"] == "m":
        return f"{known}; in the scene's metres its size differs by {100 * (scale - 1):+.2g} %"
    return f"{known}; a metre is {scale:.4g} scene units"


def _alignment(fields: Fields) -> str:
    """Where the features that the photos share put the object."""
    found, reason = find(fields, "alignment.found"), find(fields, "alignment.reason")
    if not found:
        return "" if found is None else f"not found: {reason}"
    deviation = 100 * find(fields, "alignment.scale_sd_log")
    miss, photos = find(fields, "alignment.gps_miss"), find(fields, "alignment.gps_photos")
    by_gps = "" if miss is None else f"; GPS of {photos} photos {number(miss)} standard deviations apart"
    scale = f"scale {number(find(fields, 'alignment.scale'))} (standard deviation {number(deviation)} %, bending apart)"
    return f"{scale}, {reason}{by_gps}"


def _pose(found: Fields) -> str:
    """The pose's scale and scores, what it rests on, and its standard deviations."""
    scores = [("F-score", "fine.f_score"), ("margin", "fine.margin"), ("fitness", "metrics.registration.fitness")]
    cells: list[Cell] = [("scale", number_in(found, "fine.scale"), unit_of(found, "fine.scale") or "")]
    parts = [_pairs(*cells, *((name, number_in(found, key), "") for name, key in scores))]
    evidence = find(found, "fine.rests_on") or []
    parts.append(f"rests on {', '.join(evidence)}" if evidence else "")
    scale, turn, shift = (number_in(found, f"fine.{k}") for k in ("scale_sd_log", "rotation_sd_deg", "translation_sd"))
    if scale is not None and turn is not None and shift is not None:
        unit = unit_of(found, "fine.translation_sd")
        spread = f"{number(100 * scale)} % of scale, {number(turn)} degrees, {number(shift)} {unit}"
        parts.append(f"standard deviations {spread}")
        unknown = [name for name in ("object", "scene") if name not in (find(found, "fine.bending_known_of") or [])]
        parts.append(f"how far the {' and the '.join(unknown)} may be bent is not known" if unknown else "")
    return "; ".join(filter(None, parts))


def _object_truth(item: ObjectSummary, fields: Fields) -> str:
    """Errors against truth, where it is known; shares are of the object's diagonal."""
    pose = {
        "scale off": "scale_error_pct",
        "rotation off": "rotation_error_deg",
        "position off over the diagonal": "translation_error_over_diagonal",
    }
    own = {"mask IoU": "mask_iou_mean", "cloud F-score at 1 %": "cloud_f_score_1pct"}
    scene = [number_in(item.stages, f"truth.scene_f_score_{when}_1pct") for when in ("before", "after")]
    found = " -> ".join(number(score) for score in scene if score is not None)
    return ", ".join(
        filter(None, [_truth(item.stages, own), found and f"scene F-score at 1 % {found}", _truth(fields, pose)])
    )


def _truth(fields: Fields, names: dict[str, str]) -> str:
    """Some of the comparisons with truth."""
    return _pairs(
        *((label, number_in(fields, f"truth.{k}"), unit_of(fields, f"truth.{k}") or "") for label, k in names.items())
    )


def _remarks(fields: Fields) -> list[str]:
    """What was chosen, and every fallback, warning and note that a stage recorded."""
    chosen = {k: i["value"] for k, i in fields.items() if k.rsplit(".", 1)[-1] in CHOICES and k.count(".") == 1}
    lines = _line("chosen", "; ".join(f"{k} {number(plain(v))}" for k, v in chosen.items() if v not in (None, "")))
    for key, item in fields.items():
        if NOTES.search(key) and key not in REASONS and item["value"] not in (None, "", [], {}, False):
            lines += _line("note", f"{key}: {plain(item['value'])}")
    return lines
