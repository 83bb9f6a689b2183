"""The paper's Tables 2 to 4 of a run, as a table and a section of the report page.

Columns are what the paper published, its preset here, the shipped recipe, and chance.
"""

import math
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from scenefuse.core.job_records import JobRecords
from scenefuse.core.stage import StageError, atomic_file, read_json, setting
from scenefuse.core.transforms import Sim3, fit_sim3
from scenefuse.paper.paper_tables import (
    ASSETS,
    COMMON,
    HERE,
    NULL,
    PAPER,
    SCENEFUSE,
    VARIANTS,
    Column,
    column_of,
    null_of,
    on_crop_of,
    paper_rows,
    published,
    without,
)
from scenefuse.photos.workspace import posed_images, read_model
from scenefuse.report.run_summary import ObjectSummary, RunInputs, summarise
from scenefuse.report.values import find, load, number

_HEADINGS = (PAPER, HERE, SCENEFUSE, COMMON, NULL)
_TEXTS = yaml.safe_load((ASSETS / "section.yaml").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class ComparisonSettings:
    """What the paper's preset is compared with."""

    compared_with: str = setting("../results")
    """Results of a finished run of the shipped recipe on the same photos, for the column scenefuse of paper.tsv (recipe
    `paper` only). Without such a run there the column is empty, and paper.tsv says why."""


def compare_with_paper(*, run: RunInputs, settings: ComparisonSettings, table: Path, section: Path, seed: int) -> None:
    """Write the paper's Tables 2 to 4 (He et al. 2026) for the objects that lie in a scene.

    The definition in a row is that of this run's number, the shipped recipe's and the null; the published numbers are
    of the paper's own captures, at thresholds that it does not give. What does not exist is '-', and `note` says why.
    The null is on this run's crop or, where this run did not come so far, on the other's, as `note` says. No truth is
    read.

    Args:
        run: this run; see RunInputs.
        settings: see ComparisonSettings.
        table: output, TSV: one row an object, table, variant and measure.
        section: output, HTML: the same as a section of the report page.
        seed: of the random clouds that give the null.

    Raises:
        StageError: no variant is given, or not one scene for each object.
    """
    results = Path(settings.compared_with)
    beside = _of_other_results(run, results)
    unfinished = "" if (results / "summary/summary.txt").is_file() else f"{results} holds no finished run"
    rows: list[dict[str, Any]] = []
    for place, (item, other) in enumerate(zip(summarise(run).objects, summarise(beside).objects)):
        if item.alone:
            continue
        folder, its_folder = run.objects[place], beside.objects[place]
        scene = next(k for k, path in enumerate(run.scenes) if path.name == run.scene_of[place])
        pairs = [(folder, its_folder), (run.scenes[scene], beside.scenes[scene])]
        why = unfinished or why_not_comparable(pairs, item, other)
        columns = {
            PAPER: Column(published(item.name), measured=False),
            HERE: column_of(item),
            SCENEFUSE: without(why) if why else column_of(other),
            COMMON: Column(measured=False),
        }
        if not why and (between := between_scenes(run.scenes[scene], beside.scenes[scene])) is not None:
            columns[COMMON] = on_crop_of(folder, item, its_folder, between)
        null = null_of(folder, item, seed)
        if null is None and not why and (null := null_of(its_folder, other, seed)) is not None:
            null = replace(null, notes=dict.fromkeys(VARIANTS, "on the crop of the run scenefuse"))
        columns[NULL] = null or without("no run came as far as a pose")
        rows += paper_rows(item.name, columns)
    with atomic_file(table) as temporary:
        pd.DataFrame(rows).to_csv(temporary, sep="\t", index=False, na_rep="-", float_format="%.6g")
    written = pd.read_csv(table, sep="\t", dtype=str, keep_default_na=False)
    with atomic_file(section) as temporary:
        temporary.write_text(paper_section(written.to_dict("records")), encoding="utf-8")
    for note in dict.fromkeys(f"{row['object']}: {row['note']}" for row in rows if row["note"]):
        print(note, flush=True)


def _of_other_results(run: RunInputs, results: Path) -> RunInputs:
    """The same scenes and objects in other results, whose depth maps may be split into other jobs."""
    return replace(
        run,
        chunks=0,
        jobs=JobRecords(results / "logs", results / "benchmarks"),
        scenes=tuple(results / "scenes" / folder.name for folder in run.scenes),
        objects=tuple(results / "objects" / folder.name for folder in run.objects),
    )


def why_not_comparable(pairs: list[tuple[Path, Path]], item: ObjectSummary, other: ObjectSummary) -> str:
    """Why what another run made of an object cannot stand beside this run's, or "".

    Args:
        pairs: this run's folder and the other's, of the object and of its scene.
        item: what this run made of the object.
        other: what the other one did.
    """
    # Only the paper's stage 1 says whose poses it gives, and only the paper's registration has no gate.
    if find(other.stages, "stage1.pose_source") is not None or other.status("full") == "ungated":
        return f"{pairs[0][1]} is of recipe paper itself"
    try:
        for own, its in pairs:
            if _taken_from(own) != _taken_from(its):
                return f"{its} is of other photos than {own}"
    except StageError as error:
        return str(error)
    here, there = _tau_share(item), _tau_share(other)
    if here is not None and there is not None and not math.isclose(here, there, rel_tol=1e-6):
        return f"{pairs[0][1]} is measured at another tau ({there:.4g} of the crop's diagonal, here {here:.4g})"
    return ""


def between_scenes(own: Path, other: Path) -> Sim3 | None:
    """From another run's scene to this run's, of the same photos, by their cameras; of the same cloud, nothing moves.
    None where there are too few cameras.

    Args:
        own: this run's folder of the scene.
        other: the other run's.
    """
    models = [folder / "georeferenced" for folder in (own, other)]
    if not all(model.is_dir() for model in models):
        return None if any(model.is_dir() for model in models) else Sim3.identity()
    here, there = ({image.name: image.projection_center() for image in posed_images(read_model(m))} for m in models)
    names = sorted(here.keys() & there.keys())
    try:
        return fit_sim3(np.array([there[name] for name in names]), np.array([here[name] for name in names]))
    except ValueError:
        return None


def _taken_from(folder: Path) -> Any:
    """What tells the photos of an object or a scene from others; of one without photos, the size of its cloud."""
    if (folder / "photos.json").is_file():
        return sorted(photo["sha256"] for photo in read_json(folder / "photos.json").get("photos", []))
    return [find(load(folder / name), "points") for name in ("object.json", "dense.json")]


def _tau_share(item: ObjectSummary) -> float | None:
    """Tau as a share of the crop's diagonal; None without a pose."""
    fields = item.variants.get("full", {})
    tau, diagonal = find(fields, "metrics.registration.tau"), find(fields, "crop.diagonal")
    return None if tau is None else tau / diagonal


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
