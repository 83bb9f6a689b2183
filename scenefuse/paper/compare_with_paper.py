"""The paper's Tables 2 to 4 of a run, as a table and a section of the report page.

Columns are what the paper published, its preset here, and chance.
"""

import csv
import importlib.resources
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from scenefuse.cloud.clouds import Cloud, read_cloud
from scenefuse.core.stage import atomic_file
from scenefuse.core.transforms import Sim3
from scenefuse.register.score import AgreementSettings, registration_metrics
from scenefuse.report.run_summary import ObjectSummary, RunInputs, summarise
from scenefuse.report.values import Fields, find, number

PAPER, HERE = "paper (published, its own data)", "paper preset (here)"
NULL = "null"
_HEADINGS = (PAPER, HERE, NULL)
VARIANTS = ("full", "no_scale", "no_crop")
"""The registration of the paper's Tables 2 and 3, and those of its ablation, Table 4."""
ASSETS = importlib.resources.files("scenefuse.paper") / "assets"
_TEXTS = yaml.safe_load((ASSETS / "section.yaml").read_text(encoding="utf-8"))


def _rows_of(name: str) -> list[dict[str, str]]:
    """The rows of a table in assets/."""
    with (ASSETS / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file, delimiter="\t"))


_TAU = AgreementSettings().tau_fraction
# What the paper calls each measure, our definition with its labels in docs/method, and its group in metrics.json.
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


def compare_with_paper(*, run: RunInputs, table: Path, section: Path, seed: int) -> None:
    """Write the paper's Tables 2 to 4 (He et al. 2026) for the objects that lie in a scene.

    The definition in a row is that of this run's number and the null; the published numbers are of the paper's own
    captures, at thresholds that it does not give. What does not exist is '-', and `note` says why. No truth is read.

    Args:
        run: this run; see RunInputs.
        table: output, TSV: one row an object, table, variant and measure.
        section: output, HTML: the same as a section of the report page.
        seed: of the random clouds that give the null.
    """
    rows: list[dict[str, Any]] = []
    for folder, item in zip(run.objects, summarise(run).objects):
        if item.alone:
            continue
        nothing = Column(notes=dict.fromkeys(VARIANTS, "the run did not come as far as a pose"))
        columns = {
            PAPER: Column(published(item.name), measured=False),
            HERE: column_of(item),
            NULL: null_of(folder, item, seed) or nothing,
        }
        rows += paper_rows(item.name, columns)
    with atomic_file(table) as temporary:
        pd.DataFrame(rows).to_csv(temporary, sep="\t", index=False, na_rep="-", float_format="%.6g")
    written = pd.read_csv(table, sep="\t", dtype=str, keep_default_na=False)
    with atomic_file(section) as temporary:
        temporary.write_text(paper_section(written.to_dict("records")), encoding="utf-8")
    for note in dict.fromkeys(f"{row['object']}: {row['note']}" for row in rows if row["note"]):
        print(note, flush=True)


def paper_section(rows: list[dict[str, str]]) -> str:
    """Heading, notes and tables from the rows of paper.tsv."""
    parts = ['<h2 id="paper">The paper\'s Tables 2, 3 and 4</h2>']
    parts += [f"<p>{escape(text)}</p>" for text in (*_TEXTS["about"], *_notes(rows))]
    for table, title in _TEXTS["tables"].items():
        parts.append(f"<h3>Table {table}: {title}</h3>{_table([row for row in rows if row['table'] == table])}")
    return "\n".join(parts)


def _notes(rows: list[dict[str, str]]) -> list[str]:
    """How each object of this run was made, and what is said of the cells of each of its variants, once."""
    made = [f"{row['object']}, {HERE}: {row['preset']}" for row in rows if row.get("preset", "-") != "-"]
    said = [f"{row['object']}, {row['variant']}: {row['note']}" for row in rows if row["note"] != "-"]
    return list(dict.fromkeys([*made, *said]))


def _table(rows: list[dict[str, str]]) -> str:
    """A table; the definition of a measure stands above its rows."""
    heads = ["object", "variant", "unit", *_HEADINGS]
    lines = []
    for measure in dict.fromkeys(row["measure"] for row in rows):
        own = [row for row in rows if row["measure"] == measure]
        told = f"<b>{escape(measure)}</b> ({escape(own[0]['in_paper'])}): {escape(own[0]['definition'])}"
        lines.append(f'<tr><td colspan="{len(heads)}" class="text">{told}</td></tr>')
        for row in own:
            cells = [f'<td class="text">{escape(row[head])}</td>' for head in heads[:3]]
            cells += [f"<td>{'-' if row[h] == '-' else number(float(row[h]))}</td>" for h in _HEADINGS]
            lines.append(f"<tr>{''.join(cells)}</tr>")
    titles = "".join(f'<th class="text">{escape(head)}</th>' for head in heads[:3])
    titles += "".join(f"<th>{escape(head)}</th>" for head in _HEADINGS)
    return f'<div class="wide"><table><thead><tr>{titles}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


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
    """What a run of the paper's recipe went on with: whose poses, how many of the paper's rays, which prior."""
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
        units = [columns[h].cells[key][1] for h in (HERE, NULL, PAPER) if key in columns[h].cells]
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
