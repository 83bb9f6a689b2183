"""Tables 2 to 4 of the paper for one object: its own numbers, runs of this workflow and chance; one definition each."""

import csv
import importlib.resources
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.cloud.clouds import Cloud, read_cloud
from scenefuse.core.stage import read_json, value
from scenefuse.core.transforms import Sim3
from scenefuse.register.agreement import AgreementSettings, registration_metrics
from scenefuse.report.run_summary import ObjectSummary
from scenefuse.report.values import Fields, find

PAPER, HERE, SCENEFUSE = "paper (published, its own data)", "paper preset (here)", "scenefuse"
COMMON = "scenefuse, on the preset's crop"
NULL = "null"
VARIANTS = ("full", "no_scale", "no_crop")
"""The registration of the paper's Tables 2 and 3, and those of its ablation, Table 4."""
ASSETS = importlib.resources.files("scenefuse.paper") / "assets"


def _rows_of(name: str) -> list[dict[str, str]]:
    """The rows of a table in assets/."""
    with (ASSETS / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file, delimiter="\t"))


_TAU = AgreementSettings().tau_fraction
# Of each measure what the paper calls it, our definition with its labels in docs/method, and its group in metrics.json.
MEASURES = {
    row["measure"]: row | {"definition": row["definition"].format(tau=_TAU)} for row in _rows_of("measures.tsv")
}
# Number of the table, variant and measure of each row; and what the paper published there of its own captures, whose
# objects the demo's are named after. RMSE is in metres; no diagonal is given to divide it by.
PUBLISHED = _rows_of("published.tsv")
ROWS = [(int(row["table"]), row["variant"], row["measure"]) for row in PUBLISHED]
OBJECTS = ("house", "balloon", "sculpture")
# Why a number of a run that has come so far may be missing, by group.
_NOTHING = {"registration": "no point of the object within tau", "completion": "too few points were added"}


def published(name: str) -> dict[tuple[str, str], tuple[float, str]]:
    """Value and unit by measure and variant of an object of the paper's; nothing of any other."""
    return {
        (row["measure"], row["variant"]): (float(row[name]), "m" if row["measure"] == "inlier_rmse" else "1")
        for row in PUBLISHED
        if row.get(name) and name in OBJECTS
    }


@dataclass(frozen=True)
class Column:
    """What a column knows of an object.

    Attributes:
        cells: value and unit by measure and variant; what does not exist is not in it.
        notes: by variant, what has to be said of it.
        told: how a run of the paper's recipe was made.
        measured: whether it is measured here, so that a cell that is missing needs a reason.
    """

    cells: dict[tuple[str, str], tuple[float, str]] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)
    told: str = ""
    measured: bool = True


def column_of(item: ObjectSummary) -> Column:
    """A run's numbers, and why a variant has no pose or none that was accepted."""
    notes = {}
    for variant in VARIANTS:
        status = item.status(variant)
        if status not in ("registered", "ungated"):
            notes[variant] = ", ".join(filter(None, (status, item.reason(variant))))
    return Column(_cells({v: _measured(item.variants.get(v, {})) for v in VARIANTS}), notes, _told(item))


def _told(item: ObjectSummary) -> str:
    """Of a run of the paper's recipe: whose poses it went on with, what it drew of the paper's rays, and its prior."""
    said = {
        "stage1.pose_source": "stages 2 to 4 have the poses of: {}",
        "stage2.rays_per_epoch": "rays an epoch in stages 2 and 4: {}",
        "stage2.rays_per_epoch_paper": "every pixel of the object once: {}",
        "stage2.field_is_the_papers": "the paper's field: {}",
        "stage2.prior_confident_share": "share of the masks with a depth in stage 2: {:.2f}",
    }
    if find(item.stages, "stage1.pose_source") is None:
        return ""
    return "; ".join(text.format(find(item.stages, key)) for key, text in said.items() if key in item.stages)


def without(reason: str) -> Column:
    """A column that is empty for a reason."""
    return Column(notes=dict.fromkeys(VARIANTS, reason))


def null_of(folder: Path, item: ObjectSummary, seed: int) -> Column | None:
    """What the measures give for nothing, on a run's crop and by its tau; None where the run did not come so far.

    Of the registration: a random cloud in the place of the object, as many points, uniform in the box of the crop, for
    all variants are measured on the same crop. That of the completion is the run's own (`_null`).

    Args:
        folder: results of the object, with object.ply and registration/full/crop.ply.
        item: what was collected of them.
        seed: of the random cloud.
    """
    fields = item.variants.get("full", {})
    tau, diagonal = find(fields, "metrics.registration.tau"), fields.get("crop.diagonal")
    if tau is None or diagonal is None:
        return None
    crop, count = read_cloud(folder / "registration/full/crop.ply"), len(read_cloud(folder / "object.ply"))
    random = np.random.default_rng(seed).uniform(crop.points.min(0), crop.points.max(0), (count, 3))
    found = registration_metrics(Cloud(random), crop, Sim3.identity(), tau, diagonal["value"], diagonal["unit"])
    return Column(_cells(dict.fromkeys(VARIANTS, found | _measured(fields, "_null"))))


def on_crop_of(folder: Path, item: ObjectSummary, its_folder: Path, here_from_there: Sim3) -> Column:
    """What another run's pose gives on this run's crop, by this run's tau: the same part of the scene for both.

    Args:
        folder: this run's results of the object, with registration/full/crop.ply.
        item: what was collected of them.
        its_folder: the other run's, with object.ply and a pose in registration/full/fine.json.
        here_from_there: from the other run's scene to this run's.
    """
    fields = item.variants.get("full", {})
    tau, diagonal = find(fields, "metrics.registration.tau"), fields.get("crop.diagonal")
    pose = value(read_json(its_folder / "registration/full/fine.json"), "scene_from_object")
    if tau is None or diagonal is None or pose is None:
        return Column(measured=False)
    crop, obj = read_cloud(folder / "registration/full/crop.ply"), read_cloud(its_folder / "object.ply")
    moved = here_from_there @ Sim3.from_matrix(np.array(pose))
    found = registration_metrics(obj, crop, moved, tau, diagonal["value"], diagonal["unit"])
    return Column(_cells({"full": found}), measured=False)


def _measured(fields: Fields, ending: str = "") -> Fields:
    """The paper's measures of a variant, or those of an ending, by their names."""
    keys = {name: f"metrics.{measure['group']}.{name}{ending}" for name, measure in MEASURES.items()}
    return {name: fields[key] for name, key in keys.items() if key in fields}


def _cells(found: Mapping[str, Fields]) -> dict[tuple[str, str], tuple[float, str]]:
    """The cells of a column from the measures of each variant."""
    there = [(name, v, found[v][name]) for _, v, name in ROWS if name in found.get(v, {})]
    return {(name, v): (float(x["value"]), str(x["unit"])) for name, v, x in there if x["value"] is not None}


def paper_rows(name: str, columns: Mapping[str, Column]) -> list[dict[str, Any]]:
    """The rows of an object: a cell for each column, how the preset's run was made (`preset`), and a note on those that
    are empty or no accepted pose's.

    A row has one unit, this run's where it has one; what a column has in another unit is left out and said.

    Args:
        name: of the object.
        columns: by their headings, in order.
    """
    rows = []
    for table, variant, measure in ROWS:
        key, about = (measure, variant), MEASURES[measure]
        units = [columns[h].cells[key][1] for h in (HERE, SCENEFUSE, NULL, PAPER) if key in columns[h].cells]
        unit = units[0] if units else None
        row: dict[str, Any] = {"object": name, "table": table, "variant": variant, "measure": measure}
        row |= {"in_paper": about["in_paper"], "definition": about["definition"], "unit": unit}
        notes = []
        for heading, column in columns.items():
            cell, own = column.cells.get(key, (None, unit))
            row[heading] = cell if own == unit else None
            why = column.notes.get(variant, "")
            if own != unit:
                why = f"{cell:.4g} {own}, in another unit"
            elif cell is None and column.measured:
                why = why or _NOTHING[about["group"]]
            notes += [f"{heading}: {why}"] if why else []
        rows.append(row | {"preset": columns[HERE].told or None, "note": "; ".join(notes) or None})
    return rows
