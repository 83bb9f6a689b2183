"""Tables 2 to 4 of the paper for one object: its own numbers, runs of this workflow and chance; one definition each."""

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
# What the paper published in these tables, of its own captures, whose objects the demo's are named after.
OBJECTS = ("house", "balloon", "sculpture")
# By measure and registration variant, in the order of OBJECTS. RMSE is in metres; no diagonal is given to divide it by.
PUBLISHED = {
    ("fitness", "full"): (0.9302, 0.9916, 0.9207),
    ("inlier_rmse", "full"): (0.0852, 0.0096, 0.0348),
    ("normal_consistency", "full"): (0.6023, 0.6210, 0.7948),
    ("surface_variation", "full"): (0.1597, 0.1897, 0.1219),
    ("nue", "full"): (1.17, 1.29, 1.21),
    ("primitive_fitting_score", "full"): (0.9984, 0.9954, 0.9975),
    ("fitness", "no_scale"): (0.3083, 0.0820, 0.3085),
    ("inlier_rmse", "no_scale"): (0.2614, 0.1810, 0.3724),
    ("normal_consistency", "no_scale"): (0.4448, 0.2196, 0.4834),
    ("fitness", "no_crop"): (0.4129, 0.5876, 0.3621),
    ("inlier_rmse", "no_crop"): (0.4424, 0.1804, 0.0655),
    ("normal_consistency", "no_crop"): (0.3056, 0.5695, 0.7373),
}


def published(name: str) -> dict[tuple[str, str], tuple[float, str]]:
    """Value and unit by measure and variant of an object of the paper's; nothing of any other."""
    if name not in OBJECTS:
        return {}
    place = OBJECTS.index(name)
    return {key: (values[place], "m" if key[0] == "inlier_rmse" else "1") for key, values in PUBLISHED.items()}


@dataclass(frozen=True)
class Measure:
    """A measure of the paper.

    Attributes:
        name: as in metrics.json.
        paper: what the paper calls it.
        definition: of the numbers of all our columns, with its labels in docs/method.
        group: of metrics.json that holds it.
    """

    name: str
    paper: str
    definition: str
    group: str


_FITNESS = (
    f"share of the crop's points with a point of the object within tau, {AgreementSettings().tau_fraction:.1%} of the"
    " crop's diagonal; higher is better (R10, R11)"
)
_RMSE = (
    "RMS distance to the crop of the object's points (not the crop's, as in fitness) that lie within tau of it; lower"
    " is better (R10, R11)"
)
_RMSE_SHARE = "inlier_rmse over the diagonal of the crop, so that objects of any size compare; lower is better (R11)"
_NORMALS = (
    "mean |n . n_nearest| between the object's points that lie within tau of the crop and the crop's nearest to them;"
    " higher is better, 0.5 is of unrelated normals (G1)"
)
_VARIATION = (
    "mean over the added points of the smallest eigenvalue of the covariance of their neighbours (within"
    " metrics.variation_spacings of the crop's spacings) over the sum of all three; 0 to 1/3, lower is better (G2)"
)
_DENSITY = "density (k over the area of the circle to the k-th neighbour, k = metrics.density_neighbours)"
_NUE = f"standard deviation of the {_DENSITY} of the completed cloud over that of the crop; near 1 is better (G3, G4)"
_NUE_INVARIANT = "as nue, each standard deviation over its mean: what is denser everywhere has the same (G4)"
_PRIMITIVES = (
    "share of the added points that lie within metrics.primitive_fraction of the crop's diagonal on planes, spheres or"
    " cylinders, at most metrics.primitive_most, of metrics.primitive_support of the points at least; higher is better"
    " (G5)"
)
REGISTRATION = (
    Measure("fitness", "Fitness", _FITNESS, "registration"),
    Measure("inlier_rmse", "Inlier RMSE", _RMSE, "registration"),
    Measure("inlier_rmse_over_diagonal", "not in the paper", _RMSE_SHARE, "registration"),
    Measure("normal_consistency", "Normal Consistency", _NORMALS, "registration"),
)
COMPLETION = (
    Measure("surface_variation", "Geometric Smoothness", _VARIATION, "completion"),
    Measure("nue", "Distribution Uniformity", _NUE, "completion"),
    Measure("nue_density_invariant", "not in the paper", _NUE_INVARIANT, "completion"),
    Measure("primitive_fitting_score", "Structural Plausibility", _PRIMITIVES, "completion"),
)
_TABLES = {2: (REGISTRATION, VARIANTS[:1]), 3: (COMPLETION, VARIANTS[:1]), 4: (REGISTRATION, VARIANTS[1:])}
ROWS = [(n, variant, m) for n, (measures, variants) in _TABLES.items() for variant in variants for m in measures]
"""Number of the table, variant and measure of each row."""
# Why a number of a run that has come so far may be missing, by group.
_NOTHING = {"registration": "no point of the object within tau", "completion": "too few points were added"}


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
    keys = {m.name: f"metrics.{m.group}.{m.name}{ending}" for m in (*REGISTRATION, *COMPLETION)}
    return {name: fields[key] for name, key in keys.items() if key in fields}


def _cells(found: Mapping[str, Fields]) -> dict[tuple[str, str], tuple[float, str]]:
    """The cells of a column from the measures of each variant."""
    there = [(m.name, v, found[v][m.name]) for _, v, m in ROWS if m.name in found.get(v, {})]
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
        key = measure.name, variant
        units = [columns[h].cells[key][1] for h in (HERE, SCENEFUSE, NULL, PAPER) if key in columns[h].cells]
        unit = units[0] if units else None
        row: dict[str, Any] = {"object": name, "table": table, "variant": variant, "measure": measure.name}
        row |= {"in_paper": measure.paper, "definition": measure.definition, "unit": unit}
        notes = []
        for heading, column in columns.items():
            cell, own = column.cells.get(key, (None, unit))
            row[heading] = cell if own == unit else None
            why = column.notes.get(variant, "")
            if own != unit:
                why = f"{cell:.4g} {own}, in another unit"
            elif cell is None and column.measured:
                why = why or _NOTHING[measure.group]
            notes += [f"{heading}: {why}"] if why else []
        rows.append(row | {"preset": columns[HERE].told or None, "note": "; ".join(notes) or None})
    return rows
