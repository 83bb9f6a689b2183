"""summary.txt: a block per scene and object, then time and memory, within WIDTH columns."""

import re
import textwrap
from typing import Any

import pandas as pd

from scenefuse.core.version import VERSION
from scenefuse.fuse.missing import CLASSES
from scenefuse.metrics.completion import MEASURES
from scenefuse.metrics.scores import SCORES, THRESHOLDS
from scenefuse.report.collected import Collected, reason_of, status_of, why_missing
from scenefuse.report.diagnosis import diagnose
from scenefuse.report.disk import disk_line
from scenefuse.report.tables import (
    BESIDE,
    REGISTRATION,
    completion_table,
    number_in,
    plain,
    records,
    truth_numbers,
)
from scenefuse.report.values import Fields, find, number, unit_of

WIDTH = 100
_COLUMNS = ("value", *BESIDE)
_NOTES = re.compile(r"(^|[._])(fallbacks?|warnings?|notes?|reason|not_registered|models_left_out|gps_outliers)$")
_TOLD = ("fine.reason", "fusion.reason", "alignment.reason")
_PLACES = ("workspace", "pose_source", "device", "backend", "kernels")
_CHOICES = (*_PLACES, "method", "pairs_choice", "up_cue", "mode", "kept")


def summary_text(
    scenes: dict[str, Fields], objects: list[Collected], variants: list[str], tables: dict[str, pd.DataFrame]
) -> str:
    """The text, from the quantities of the scenes and objects and from their tables."""
    lines: list[str] = []
    for name, row in zip(scenes, records(tables["scenes"])):
        lines += _heading(f"scene {name}") + _scene_lines(scenes[name], row)
        lines += _line("disk", disk_line(tables["disk"], f"scenes/{name}"))
    statuses = [status_of(item, variants[0]) for item in objects]
    joined = sum(not item.alone for item in objects)
    alone = f"in no scene: {', '.join(item.name for item in objects if item.alone)}"
    done = f"{statuses.count('registered')} of {joined} objects registered and fused" if joined else alone
    done += f"; {alone}" if 0 < joined < len(objects) else ""
    done += f", {statuses.count('ungated')} fused without a check of the pose" if "ungated" in statuses else ""
    for item, row in zip(objects, records(tables["objects"])):
        lines += _heading(f"object {item.name}: {status_of(item, variants[0])}") + _object_lines(item, row, variants)
        lines += _line("disk", disk_line(tables["disk"], f"objects/{item.name}"))
    lines += _heading(done) + _runtime_lines(tables["runtime"]) + _line("scenefuse", VERSION)
    return "\n".join(lines) + "\n"


def _heading(text: str) -> list[str]:
    return ["", text, "-" * min(len(text), WIDTH)]


def _line(label: str, text: str) -> list[str]:
    """`label   text`, wrapped, continuation lines indented."""
    return textwrap.wrap(text, WIDTH, initial_indent=f"{label:<14}", subsequent_indent=" " * 14) if text else []


def _pairs(cells: list[tuple[str, Any, str]]) -> str:
    """`name value unit, ...` of the values that exist."""
    return ", ".join(f"{n} {number(v)}{f' {u}' if u else ''}" for n, v, u in cells if number(v) not in ("-", "nan"))


def _scene_lines(fields: Fields, row: dict[str, Any]) -> list[str]:
    unit = find(fields, "georeference.length_unit") or "scene units"
    if find(fields, "dense.points") is None:
        return _line("missing", f"no dense cloud: {row['error']}")
    given = _given(fields, "dense")
    lines = _line("given", given) + (_line("cameras", _cameras(row, "photos")) if row["registered"] else [])
    frame = [("unit", unit, ""), ("GPS residual (median)", row["gps_residual_median_m"], "m")]
    lines += _line("frame", _pairs(frame)) + _survey_lines(fields)
    lines += _line("cloud", _pairs([("points", row["points"], ""), ("spacing", row["spacing"], str(unit))]))
    measures = [{"measure": name, **{c: row.get(_beside(name, c)) for c in _COLUMNS}} for name in MEASURES]
    lines += _completed_lines(fields) + _completion_lines(measures)
    return lines + _truth_lines(fields) + _remarks(fields)


def _survey_lines(fields: Fields) -> list[str]:
    """Control and check points: how many, and how far the model is from them."""
    lines = []
    for kind in ("control", "check"):
        values = [
            find(fields, f"georeference.{kind}_{name}") for name in ("points", "rms_horizontal_m", "rms_vertical_m")
        ]
        names = (f"{kind} points", "RMS horizontally", "vertically")
        if values[0]:
            lines += _line(kind, _pairs([(n, v, u) for n, v, u in zip(names, values, ("", "m", "m"))]))
    long = [("known lengths", find(fields, "georeference.lengths"), "")]
    long += [("RMS", find(fields, "georeference.length_rms_m"), "m")]
    return lines + _line("lengths", _pairs(long))


def _own_lengths(stages: Fields, fields: Fields) -> str:
    """How well an object's own known lengths agree with each other and, once it is placed, with the scene; or ""."""
    off = find(stages, "sparse.lengths_off_m")
    if not off:
        return ""
    told = "in metres by known lengths; off one scale by " + ", ".join(f"{n} {o:+.2g} m" for n, o in off.items())
    scale = find(fields, "fine.scale")
    if scale is None or find(fields, "fine.status") != "registered":
        return told
    if fields["crop.diagonal"]["unit"] == "m":
        return f"{told}; in the scene's metres its size differs by {100 * (scale - 1):+.2g} %"
    return f"{told}; a metre is {scale:.4g} scene units"


def _beside(measure: str, column: str) -> str:
    """The column of scenes.tsv for a completion metric itself, its null, before or after."""
    return measure if column == "value" else f"{measure}_{column}"


def _given(fields: Fields, stage: str) -> str:
    """The file that a scene or an object was given as, or ""."""
    source = find(fields, f"{stage}.source")
    if not source:
        return ""
    if find(fields, f"{stage}.seen_share") is not None:
        outside = find(fields, f"{stage}.outside_masks")
        cut = f"; {outside} points outside the masks were left out" if outside else ""
        if find(fields, "georeference.laid_on_cloud_by") is not None:
            return f"the cloud {source}, on which the photos were laid"
        return f"the cloud {source}, in the coordinates of the given cameras{cut}"
    crs = find(fields, "georeference.crs")
    return f"as a cloud, {source}, without photos" + (f"; coordinates: {_crs_name(crs)}" if crs else "")


def _crs_name(crs: str) -> str:
    """A CRS in a line: its code, or the name that begins its WKT."""
    return crs.split('"')[1] if '"' in crs else crs


def _cameras(row: dict[str, Any], pictures: str) -> str:
    """How many photos or frames are registered, and how well."""
    error = _pairs([("reprojection error", row["reprojection_error_px"], "px")])
    return f"{number(row['registered'])} of {number(row[pictures])} {pictures} registered" + (error and f", {error}")


def _completed_lines(fields: Fields) -> list[str]:
    """The scene with all its objects: what was added and what is not in it."""
    added = find(fields, "completed.added_points")
    if added is None:
        return _line("completed", "not written with all decisions; look at the log of complete_scene")
    parts = ["completed.ply, completed.copc.laz", _pairs([("points", find(fields, "completed.points"), "")])]
    parts += [f"{name} adds {count}" for name, count in added.items()]
    parts += [f"without {name}" for name in find(fields, "completed.unregistered") or {}]
    parts += [f"without {name}, which failed" for name in find(fields, "completed.failed") or {}]
    return _line("completed", ", ".join(parts))


def _object_lines(item: Collected, row: dict[str, Any], variants: list[str]) -> list[str]:
    lines = _line("missing", item.missing) + _line("because", why_missing(item.failed) if item.missing else "")
    fields = item.variants[variants[0]]
    if find(fields, "fine.status"):
        lines += _line("reason", str(reason_of(item, variants[0]) or ""))
    label = "to improve" if status_of(item, variants[0]) == "registered" else "likely why"
    for sentence in diagnose(item):
        lines += _line(label, sentence)
        label = ""
    lines += _line("given", _given(item.stages, "object"))
    if row["registered"] is not None and row["registered"] == row["registered"]:
        lines += _line("cameras", _cameras(row, "frames"))
    lines += _line("lengths", _own_lengths(item.stages, fields))
    lines += _line("masks", _pairs([("masks", row["masks"], ""), ("IoU with truth", row["mask_iou"], "")]))
    for stage in (1, 2, 3, 4):
        names = {
            "psnr_db": ("PSNR", f"dB on {row.get(f'stage{stage}_measured_on') or 'photos'}"),
            "ssim": ("SSIM", ""),
            "depth_error_over_diagonal": ("median depth error", "of the diagonal"),
            "depth_within_1pct": ("within 1 %", ""),
        }
        cells = [(label, row.get(f"stage{stage}_{key}"), unit) for key, (label, unit) in names.items()]
        lines += _line(f"stage {stage}", _pairs(cells))
    cloud = [
        ("points", row["points"], ""),
        ("median distance", row["cloud_accuracy_median_pct_of_diagonal"], "% of the diagonal"),
    ]
    lines += (
        _line("cloud", _pairs(cloud)) + _line("alignment", _alignment(item.stages)) + _variant_lines(item, variants)
    )
    lines += _line("fusion", _pairs([("mode", find(item.fusion, "fusion.mode"), ""), *_counts(item.fusion)]))
    removed = find(item.fusion, "evidence.scene_removed") or {}
    lines += _line("taken away", _pairs([(f"{why}:", count, "points") for why, count in removed.items() if count]))
    lines += _line("still missing", _still_missing(item.fusion))
    lines += _truth_table(item.stages)
    lines += _completion_lines([r for r in records(completion_table([item], variants[0])) if _is_measure(r)])
    return lines + _remarks(item.stages | fields | item.fusion)


_DECIDED = {
    "geometry": "by the clouds alone: no photos link object and scene",
    "near": "by the clouds, near the alignment from shared features, whose own pose the scene's photos refute",
    "both": "clouds and the alignment from shared features agree",
    "photos": "by the alignment from shared features, against the clouds",
}


def _alignment(fields: Fields) -> str:
    """Where the features that the photos share put the object."""
    found, reason = find(fields, "alignment.found"), find(fields, "alignment.reason")
    if not found:
        return "" if found is None else f"not found: {reason}"
    deviation = 100 * find(fields, "alignment.scale_sd_log")
    scale = number(find(fields, "alignment.scale"))
    miss, photos = find(fields, "alignment.gps_miss"), find(fields, "alignment.gps_photos")
    by_gps = "" if miss is None else f"; GPS of {photos} photos {number(miss)} standard deviations apart"
    return f"scale {scale} (standard deviation {number(deviation)} %, bending apart), {reason}{by_gps}"


def _variant_lines(item: Collected, variants: list[str]) -> list[str]:
    """One line a variant; errors against truth only where it is known."""
    shown = {
        "scale": ("", "scale"),
        "f_score": ("", "F-score"),
        "margin": ("", "margin"),
        "fitness": ("", "fitness"),
        "fitness_source": ("fitness", "source"),
        "inlier_rmse_over_diagonal": ("RMSE", "of diag"),
        "normal_consistency": ("", "normals"),
        "scale_error_pct": ("scale", "error %"),
        "rotation_error_deg": ("angle", "error °"),
        "translation_error_over_diagonal": ("shift", "of diag"),
    }
    rows = {
        variant: {k: number_in(item.variants.get(variant, {}), REGISTRATION[k]) for k in shown} for variant in variants
    }
    used = [k for k in shown if any(row[k] is not None for row in rows.values())]
    if not used:
        return []
    words = {"registered": "ok", "unregistered": "refused"}
    above, below = ("".join(f"{shown[k][row]:>9}" for k in used) for row in (0, 1))
    lines = [f"{'registration':<22}{above}".rstrip(), f"{'':<22}{below}"]
    for variant, row in rows.items():
        status = status_of(item, variant)
        lines.append(
            f"  {variant[:12]:<12}{words.get(status, status):>8}" + "".join(f"{_three(row[k]):>9}" for k in used)
        )
    found = item.variants[variants[0]]
    if number_in(found, REGISTRATION["inlier_rmse"]) is not None:
        cells_of = [(k.replace("_", " "), REGISTRATION[k]) for k in ("inlier_rmse", "tau")]
        units = [(name, number_in(found, key), _short(unit_of(found, key))) for name, key in cells_of]
        lines += _line("", f"{variants[0]}: {_pairs(units)}")
    decided = find(item.variants[variants[0]], "fine.decided_by")
    if decided is not None:
        rests_on = ", ".join(find(item.variants[variants[0]], "fine.rests_on") or [])
        resting = f" ({rests_on})" if rests_on and decided == "geometry" else ""
        lines += _line("pose", _DECIDED.get(decided, decided) + resting + _spread(item.variants[variants[0]]))
    return [line.rstrip() for line in lines]


def _spread(found: Fields) -> str:
    """Standard deviations of the pose, where they are known."""
    scale, turn, shift = (number_in(found, f"fine.{k}") for k in ("scale_sd_log", "rotation_sd_deg", "translation_sd"))
    if scale is None or turn is None or shift is None:
        return ""
    unit = _short(unit_of(found, "fine.translation_sd"))
    unknown = [name for name in ("object", "scene") if name not in (find(found, "fine.bending_known_of") or [])]
    beside = f"; how far the {' and the '.join(unknown)} may be bent is not known" if unknown else ""
    return f"; one sd {_three(100 * scale)} % of scale, {_three(turn)} degrees, {_three(shift)} {unit}{beside}"


def _three(item: float | int | None) -> str:
    """Three significant digits, two of a very small number: at most seven characters; or '-'."""
    return "-" if item is None else f"{item:.1e}" if 0 < abs(item) < 1e-4 else f"{item:.3g}"


def _truth_table(fields: Fields) -> list[str]:
    """Scores of the object's cloud, and of the scene around it before and after fusion, where truth is known."""
    lines = []
    for label, keys in (("cloud", ["cloud_{}"]), ("scene", ["scene_{}_before", "scene_{}_after"])):
        for score in SCORES:
            cells = []
            for threshold in THRESHOLDS:
                found = [number_in(fields, f"truth.{key.format(score)}_{threshold}") for key in keys]
                cells.append(" -> ".join(_three(number) for number in found if number is not None) or "-")
            if set(cells) != {"-"}:
                name = "F-score" if score == "f_score" else score
                lines.append(
                    f"  {label if score == SCORES[0] else '':<12}{name:<14}" + "".join(f"{c:>17}" for c in cells)
                )
    if not lines:
        return []
    shares = "".join(f"{f'{100 * share:g} %':>17}" for share in THRESHOLDS.values())
    return [f"{'truth, at a share of diag':<28}{shares}", *lines]


def _is_measure(row: dict[str, Any]) -> bool:
    """Whether a row of the completion table is a metric without truth."""
    return not row["measure"].startswith("scene_")


def _completion_lines(rows: list[dict[str, Any]]) -> list[str]:
    """The completion metrics: of what was added, of a random cloud in its place, before and after."""
    rows = [row for row in rows if _cell(row["value"]) != "-"]
    if not rows:
        return []
    lines = [f"{'completion':<14}{'':<34}" + "".join(f"{c:>10}" for c in _COLUMNS)]
    for row in rows:
        lines.append(f"{'':<14}{row['measure'][:33]:<34}" + "".join(f"{_cell(row[k]):>10}" for k in _COLUMNS))
    return [line.rstrip() for line in lines]


def _cell(item: Any) -> str:
    return _three(item) if isinstance(item, (int, float)) and item == item else "-"


def _counts(fusion: Fields) -> list[tuple[str, Any, str]]:
    """What fusion added, and the points of the object that no three photos confirm."""
    counts = {"points added": "added", "of the object unconfirmed": "nerf_only"}
    return [(label, find(fusion, f"fusion.{key}_points"), "") for label, key in counts.items()]


def _still_missing(fusion: Fields) -> str:
    """Shares of the object's surface that no photo confirms, and what more photos would show."""
    share = find(fusion, "missing.missing")
    if share is None:
        return ""
    shares = [
        f"{name.replace('_', ' ')} {_three(100 * find(fusion, f'missing.{name}'))} %" for name in CLASSES.values()
    ]
    text = f"{_three(100 * share)} % of {find(fusion, 'missing.of') or 'its surface'} ({', '.join(shares)})"
    stations, shows = find(fusion, "missing.stations"), find(fusion, "missing.stations_show")
    if not stations:
        return text
    shown = f"{_three(100 * shows)} % of it, blank parts apart"
    higher = find(fusion, "missing.stations_above_close_ups")
    where = f"next_photos.csv; {higher} higher than any close-up" if higher else "next_photos.csv"
    return f"{text}; photos from {stations} stations ({where}) would show {shown}"


def _short(unit: str | None) -> str:
    """The unit as printed behind a number: nothing for pure numbers."""
    return "" if unit in (None, "1", "") else str(unit)


def _truth_lines(fields: Fields) -> list[str]:
    cells = [
        (key.removeprefix("truth.").replace("_", " "), item["value"], _short(item["unit"]))
        for key, item in truth_numbers(fields).items()
    ]
    return _line("truth", _pairs(cells))


def _remarks(fields: Fields) -> list[str]:
    """What was chosen, and every fallback, warning and note that a stage recorded."""
    chosen = {k: i["value"] for k, i in fields.items() if k.rsplit(".", 1)[-1] in _CHOICES and k.count(".") == 1}
    lines = _line("chosen", "; ".join(f"{k} {number(plain(v))}" for k, v in chosen.items() if v not in (None, "")))
    for key, item in fields.items():
        if _NOTES.search(key) and key not in _TOLD and item["value"] not in (None, "", [], {}, False):
            lines += _line("note", f"{key}: {plain(item['value'])}")
    return lines


def _memory(megabytes: float) -> str:
    return f"{megabytes:.0f}" if megabytes == megabytes else "-"


def _runtime_lines(runtime: pd.DataFrame) -> list[str]:
    lines = [f"{'rule':<28}{'jobs':>6}{'seconds':>11}{'longest':>11}{'memory MB':>12}"]
    for row in records(runtime):
        lines.append(
            f"{str(row['rule'])[:27]:<28}{row['jobs']:>6.0f}{row['seconds']:>11.1f}"
            f"{row['longest_seconds']:>11.1f}{_memory(row['max_rss_mb']):>12}"
        )
    return lines if len(runtime) > 1 else ["no benchmark files yet"]
