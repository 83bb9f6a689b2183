"""The summary stage: tables, and summary.txt, a block for each scene and object, then time and memory.

A line says what a user acts on: the status, what was completed, with units, what is missing, and what to do next; the
tables beside it hold every number.
"""

import re
import textwrap
from pathlib import Path
from typing import Any

import pandas as pd

from scenefuse.core.stage import atomic_file
from scenefuse.core.version import VERSION
from scenefuse.fuse.missing import Lack
from scenefuse.report.diagnosis import diagnose
from scenefuse.report.disk import disk_line, disk_table
from scenefuse.report.forecast import FORECAST, read_forecast
from scenefuse.report.run_summary import (
    ALONE,
    ObjectSummary,
    RunInputs,
    RunSummary,
    SceneSummary,
    summarise,
    why_missing,
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
# Rules that the text lists, those that took longest; runtime.tsv has them all.
MAX_LISTED_RULES = 6
# Quantities of a stage that are worth a line: what it chose where it had a choice, and what it noted.
CHOICES = ("pose_source", "backend", "method", "mode", "up_cue")
NOTES = re.compile(r"(^|[._])(fallbacks?|warnings?|notes?|reason|not_registered|models_left_out|gps_outliers)$")
# Those that have a line of their own, or nothing that a user acts on.
REASONS = ("fine.reason", "fusion.reason", "alignment.reason", "matches.pairs_reason")
Cell = tuple[str, Any, str]


def write_summary(*, run: RunInputs, summary: Path) -> None:
    """Collect every stage JSON and benchmark into tables and a text that reads well in a terminal.

    Writes registration.tsv, completion.tsv, runtime.tsv, scenes.tsv, objects.tsv, disk.tsv and, last, summary.txt.
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
        "runtime": runtime_table(run.jobs.benchmarks, read_forecast(summary / FORECAST)),
        "scenes": scenes_table(found.scenes),
        "objects": objects_table(found.objects),
        "disk": disk_table([*run.scenes, *run.objects]),
    }
    for name, table in tables.items():
        with atomic_file(summary / f"{name}.tsv") as temporary:
            table.to_csv(temporary, sep="\t", index=False, na_rep="-", float_format="%.6g")
    text = summary_text(found, tables)
    with atomic_file(summary / "summary.txt") as temporary:
        temporary.write_text(text)
    print(text, flush=True)


def summary_text(run: RunSummary, tables: dict[str, pd.DataFrame]) -> str:
    """The text, from the summary of a run and its tables."""
    lines: list[str] = []
    for scene, row in zip(run.scenes, records(tables["scenes"])):
        lines += _heading(f"scene {scene.name}") + _scene_lines(scene, row)
        lines += _line("disk", disk_line(tables["disk"], f"scenes/{scene.name}"))
    for item, row in zip(run.objects, records(tables["objects"])):
        lines += _heading(f"object {item.name}: {item.status(run.variants[0])}") + _object_lines(
            item, row, run.variants
        )
        lines += _line("disk", disk_line(tables["disk"], f"objects/{item.name}"))
    lines += (
        _heading(_count(run.objects, run.variants[0])) + _runtime_lines(tables["runtime"]) + _line("scenefuse", VERSION)
    )
    return "\n".join(lines) + "\n"


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


def _three(item: float) -> str:
    """Three significant digits, two of a very small number."""
    return f"{item:.1e}" if 0 < abs(item) < 1e-4 else f"{item:.3g}"


def _count(objects: list[ObjectSummary], variant: str) -> str:
    """How many objects are done."""
    statuses = [item.status(variant) for item in objects]
    joined, alone = sum(not item.alone for item in objects), [item.name for item in objects if item.alone]
    parts = [f"{statuses.count('registered')} of {joined} objects registered and fused"] if joined else []
    parts += [f"in no scene: {', '.join(alone)}"] if alone or not joined else []
    unchecked = f", {statuses.count('ungated')} fused without a check of the pose" if "ungated" in statuses else ""
    return "; ".join(parts) + unchecked


def _scene_lines(scene: SceneSummary, row: dict[str, Any]) -> list[str]:
    fields = scene.fields
    unit = find(fields, "georeference.length_unit") or "scene units"
    if scene.missing:
        return _line("missing", f"no dense cloud: {row['error']}")
    lines = _line("given", _given(fields, "dense")) + _line("cameras", _cameras(row, "photos"))
    lines += _line("frame", _pairs(("unit", unit, ""), ("GPS residual (median)", row["gps_residual_median_m"], "m")))
    lines += _survey_lines(fields)
    lines += _line("cloud", _pairs(("points", row["points"], ""), ("spacing", row["spacing"], str(unit))))
    lines += _line("completed", _completed(fields))
    errors = {
        "cameras off (median)": "camera_position_median",
        "georeference off (median)": "georeference_error_median",
        "cloud off (median)": "cloud_distance_median",
        "terrain covered": "terrain_covered",
    }
    lines += _line("truth", _truth(fields, errors))
    return lines + _remarks(fields)


def _survey_lines(fields: Fields) -> list[str]:
    """Control and check points, and known lengths: how many, and how far the model is from them."""
    lines = []
    for kind in ("control", "check"):
        count, horizontal, vertical = (
            find(fields, f"georeference.{kind}_{name}") for name in ("points", "rms_horizontal_m", "rms_vertical_m")
        )
        if count:
            errors = ("RMS horizontally", horizontal, "m"), ("vertically", vertical, "m")
            lines += _line(kind, _pairs((f"{kind} points", count, ""), *errors))
    known = ("known lengths", find(fields, "georeference.lengths"), "")
    return lines + _line("lengths", _pairs(known, ("RMS", find(fields, "georeference.length_rms_m"), "m")))


def _given(fields: Fields, stage: str) -> str:
    """The file that a scene or an object was given as, or ""."""
    source = find(fields, f"{stage}.source")
    if not source:
        return ""
    if find(fields, f"{stage}.seen_share") is None:
        crs = find(fields, "georeference.crs")
        # A CRS is its code, or the name that begins its WKT.
        name = "" if not crs else f"; coordinates: {crs.split(chr(34))[1] if chr(34) in crs else crs}"
        return f"as a cloud, {source}, without photos{name}"
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


def _completed(fields: Fields) -> str:
    """The scene with all its objects: what was added and what is not in it."""
    added = find(fields, "completed.added_points")
    if added is None:
        return "not written with all decisions; look at the log of complete_scene"
    parts = ["completed.ply, completed.copc.laz", _pairs(("points", find(fields, "completed.points"), ""))]
    parts += [f"{name} adds {count}" for name, count in added.items()]
    parts += [f"without {name}" for name in find(fields, "completed.unregistered") or {}]
    parts += [f"without {name}, which failed" for name in find(fields, "completed.failed") or {}]
    return ", ".join(parts)


def _object_lines(item: ObjectSummary, row: dict[str, Any], variants: list[str]) -> list[str]:
    fields, status = item.variants[variants[0]], item.status(variants[0])
    lines = _line("missing", item.missing) + _line("because", why_missing(item.failed) if item.missing else "")
    if find(fields, "fine.status"):
        lines += _line("reason", str(item.reason(variants[0]) or ""))
    for k, sentence in enumerate(diagnose(item)):
        lines += _line("" if k else "to improve" if status in ("registered", ALONE) else "likely why", sentence)
    lines += _line("given", _given(item.stages, "object")) + _line("cameras", _cameras(row, "frames"))
    lines += _line("lengths", _own_lengths(item.stages, fields))
    lines += _line("masks", _pairs(("masks", row["masks"], "")))
    psnr = ("PSNR", row["stage4_psnr_db"], f"dB on {row['stage4_measured_on'] or 'photos'}")
    lines += _line("NeRF", _pairs(psnr, ("SSIM", row["stage4_ssim"], "")))
    lines += _line("cloud", _pairs(("points", row["points"], "")))
    lines += _line("alignment", _alignment(item.stages)) + _line("pose", _pose(fields))
    others = (f"{variant} {item.status(variant)}" for variant in variants[1:])
    lines += _line("variants", ", ".join(others) if find(fields, "fine.status") else "")
    added = ("points added", find(item.fusion, "fusion.added_points"), "")
    unconfirmed = ("of the object unconfirmed", find(item.fusion, "fusion.nerf_only_points"), "")
    lines += _line("fusion", _pairs(("mode", find(item.fusion, "fusion.mode"), ""), added, unconfirmed))
    removed = find(item.fusion, "evidence.scene_removed") or {}
    lines += _line("taken away", _pairs(*((f"{why}:", count, "points") for why, count in removed.items() if count)))
    lines += _line("still missing", _still_missing(item.fusion))
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
    """The pose's scale and scores, what decided it, and its standard deviations."""
    scores = [("F-score", "fine.f_score"), ("margin", "fine.margin"), ("fitness", "metrics.registration.fitness")]
    cells: list[Cell] = [("scale", number_in(found, "fine.scale"), unit_of(found, "fine.scale") or "")]
    parts = [_pairs(*cells, *((name, number_in(found, key), "") for name, key in scores))]
    decided = {
        "geometry": "decided by the clouds alone: no photos link object and scene",
        "near": "decided by the clouds, near the alignment, whose own pose the scene's photos refute",
        "both": "clouds and alignment agree",
        "photos": "decided by the alignment, against the clouds",
    }.get(find(found, "fine.decided_by"), "")
    evidence = find(found, "fine.rests_on") or []
    with_evidence = f" ({', '.join(evidence)})" if evidence and find(found, "fine.decided_by") == "geometry" else ""
    parts.append(decided + with_evidence)
    scale, turn, shift = (number_in(found, f"fine.{k}") for k in ("scale_sd_log", "rotation_sd_deg", "translation_sd"))
    if scale is not None and turn is not None and shift is not None:
        unit = unit_of(found, "fine.translation_sd")
        spread = f"{_three(100 * scale)} % of scale, {_three(turn)} degrees, {_three(shift)} {unit}"
        parts.append(f"standard deviations {spread}")
        unknown = [name for name in ("object", "scene") if name not in (find(found, "fine.bending_known_of") or [])]
        parts.append(f"how far the {' and the '.join(unknown)} may be bent is not known" if unknown else "")
    return "; ".join(filter(None, parts))


def _still_missing(fusion: Fields) -> str:
    """Shares of the object's surface that no photo confirms, and what more photos would show."""
    share = find(fusion, "missing.missing")
    if share is None:
        return ""
    shares = (
        f"{name.replace('_', ' ')} {_three(100 * find(fusion, f'missing.{name}'))} %"
        for name in (k.name.lower() for k in Lack)
    )
    text = f"{_three(100 * share)} % of {find(fusion, 'missing.of') or 'its surface'} ({', '.join(shares)})"
    stations, shows = find(fusion, "missing.stations"), find(fusion, "missing.stations_show")
    if not stations:
        return text
    higher = find(fusion, "missing.stations_above_close_ups")
    where = f"next_photos.csv; {higher} higher than any close-up" if higher else "next_photos.csv"
    shown = f"{_three(100 * shows)} % of it, blank parts apart"
    return f"{text}; photos from {stations} stations ({where}) would show {shown}"


def _object_truth(item: ObjectSummary, fields: Fields) -> str:
    """Errors against truth, where it is known; shares are of the object's diagonal."""
    pose = {
        "scale off": "scale_error_pct",
        "rotation off": "rotation_error_deg",
        "position off over the diagonal": "translation_error_over_diagonal",
    }
    own = {"mask IoU": "mask_iou_mean", "cloud F-score at 1 %": "cloud_f_score_1pct"}
    scene = [number_in(item.stages, f"truth.scene_f_score_{when}_1pct") for when in ("before", "after")]
    found = " -> ".join(_three(score) for score in scene if score is not None)
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


def _runtime_lines(runtime: pd.DataFrame) -> list[str]:
    """The rules that took longest, and all of them together."""
    if len(runtime) < 2:
        return ["no benchmark files yet"]
    rows = records(runtime)
    shown = [*rows[:-1][:MAX_LISTED_RULES], rows[-1]]
    return [
        f"{'longest rules':<28}{'jobs':>6}{'seconds':>11}{'longest':>11}{'memory MB':>12}",
        *(
            f"{str(row['rule'])[:27]:<28}{row['jobs']:>6.0f}{row['seconds']:>11.1f}{row['longest_seconds']:>11.1f}"
            f"{number(row['max_rss_mb']):>12}"
            for row in shown
        ),
    ]
