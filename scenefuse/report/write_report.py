"""One HTML page of a run that opens anywhere without a network: a card for each object and scene, in a client's words;
everything scientific is folded away below, for the record."""

import re
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from scenefuse.core.stage import StageError, atomic_file
from scenefuse.report.facts import (
    ADDED,
    made_by,
    object_facts,
    rows_of,
    scale_sd,
    scene_exports,
    scene_facts,
    scene_title,
    surface_facts,
    title_of,
    verdict,
)
from scenefuse.report.page import document, embedded, figure, view_section
from scenefuse.report.run_summary import ALONE
from scenefuse.report.values import asset, number, read_table
from scenefuse.report.view import View, read_view, thin
from scenefuse.report.view_mesh import read_mesh

# Points of all 3D views together, about 8 MB. With more views than fit, each gets fewer.
PAGE_POINTS = 700_000
# What such objects have of figures is from an earlier run.
UNFINISHED = ("failed", "missing")
Row = dict[str, Any]
Texts = dict[str, Any]


def write_report(
    *,
    summary: Path,
    scenes: tuple[Path, ...] = (),
    objects: tuple[Path, ...] = (),
    paper: Path | None = None,
    title: str = "",
    report: Path,
) -> None:
    """Write the report page of a run: a card for each object and scene, and all figures, tables and texts below.

    Everything is in the one file: no script, font or picture is fetched.

    Args:
        summary: folder with the summary's TSV files, summary.txt and details.txt; an absent table is left out.
        scenes: result folders of the scenes; scene.png and the 3D view in it are shown.
        objects: result folders of the objects; masks.png and figures/ in it are shown.
        paper: section that compares the run with the paper, HTML, which only recipe `paper` has; it may be missing.
        title: heading of the page; that of `title_of` where it is left out.
        report: output, one HTML file.

    Raises:
        StageError: the summary folder holds no summary.txt.
    """
    if not (summary / "summary.txt").is_file():
        raise StageError(f"{summary / 'summary.txt'} does not exist; write the summary first")
    texts: Texts = yaml.safe_load(asset("report.yaml"))
    title, papers = title or title_of(objects), [] if paper is None else [paper]
    views = _views([*(folder / "figures" for folder in objects), *scenes])
    tables = {name: table for name in texts["tables"] if len(table := read_table(summary / f"{name}.tsv"))}
    shown = list(zip(objects, rows_of(summary, "object", objects)))
    flown = list(zip(scenes, rows_of(summary, "scene", scenes)))
    links = "".join(
        f'<span><a href="#object-{escape(folder.name)}">{escape(folder.name)}</a>{_badge(row)}</span>'
        for folder, row in shown
    )
    body = [
        f"<header><h1>{escape(title)}</h1><p>{escape(made_by(summary))} {texts['intro']}</p>",
        f"<nav>{links}</nav></header>",
        *(
            f'<section class="scene"><h2>{escape(scene_title(row["scene"]))}</h2>'
            f"{_facts(scene_facts(row) | scene_exports(folder))}</section>"
            for folder, row in flown
        ),
        *(_object_card(folder, row, views.get(folder / "figures"), texts) for folder, row in shown),
        *(_scene_card(f, row, views.get(f), texts) for f, row in flown if (f / "scene.png").is_file()),
        '<section id="record"><h2>For the record</h2>',
        *(_object_record(folder, texts) for folder, row in shown if row["status"] not in UNFINISHED),
        *(_folded("The paper", p.read_text("utf-8") if p.is_file() else texts["no_paper"]) for p in papers),
        *(_table_section(table, **texts["tables"][name]) for name, table in tables.items()),
    ]
    if (details := summary / "details.txt").is_file():
        body.append(_folded("Details", f"<pre>{escape(details.read_text().strip())}</pre>"))
    body.append("</section>")
    page = document(title, body, bool(views))
    with atomic_file(report) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(f"{report}: {len(page) / 1e6:.1f} MB", flush=True)


def _views(folders: list[Path]) -> dict[Path, View]:
    """The 3D views that there are, by their folders, thinned to what the page holds."""
    found = {folder: view for folder in folders if (view := read_view(folder)) is not None}
    share = PAGE_POINTS / max(PAGE_POINTS, sum(len(view.cloud) for view in found.values()))
    return {
        folder: replace(view, cloud=thin(view.cloud, int(share * len(view.cloud)))) for folder, view in found.items()
    }


def _facts(facts: dict[str, str]) -> str:
    """Labels and sentences; files of the results are links from results/summary/, where the page is."""

    def link(file: re.Match[str]) -> str:
        return f'<a href="../{file[1]}">{file[0].replace("/", "/<wbr>")}</a>'

    def said(text: str) -> str:
        kept = re.sub(r"(?<=\d) (?=(mm|cm|m|m²|scene units|%|°)(?!\w))", "\u00a0", escape(text))
        lines = re.sub(r"results/([\w./-]*\w)", link, kept).splitlines()
        return lines[0] if len(lines) == 1 else f"<ul>{''.join(f'<li>{line}</li>' for line in lines)}</ul>"

    return f"<dl>{''.join(f'<div><dt>{label}</dt><dd>{said(text)}</dd></div>' for label, text in facts.items())}</dl>"


def _folded(title: str, content: str) -> str:
    """What is shown when its title is pressed."""
    return f"<details><summary>{escape(title)}</summary>{content}</details>"


def _object_card(folder: Path, row: Row, view: View | None, texts: Texts) -> str:
    """One object: result, picture before and after, facts, 3D view, what is missing, masks."""
    status = row["status"]
    parts = [f'<section class="card" id="object-{escape(folder.name)}"><h2>{escape(folder.name)}{_badge(row)}</h2>']
    is_finished, figures = status not in UNFINISHED, folder / "figures"
    pictures = [_slider(figures)] if status in ADDED and (figures / "before.png").is_file() else []
    facts = object_facts(row) | (surface_facts(folder, row) if is_finished else {})
    parts.append(f'<div class="pair">{"".join(pictures)}{_facts(facts)}</div>')
    if view is not None and is_finished:
        mesh = read_mesh(folder, view.unit)
        parts.append(view_section(f"object-{folder.name}", folder.name, view, mesh, scale_sd(row)))
    elif status in texts["no_view"]:
        parts.append(f"<p>{texts['no_view'][status]}</p>")
    if is_finished and (figures / "missing.png").is_file():
        where = figure(figures / "missing.png", texts["missing"])
        parts.append(_folded("What is missing, and where to photograph it from", where))
    if (masks := folder / "masks.png").is_file():
        parts.append(_folded("What was taken for the object in its photos", figure(masks, texts["masks"])))
    return "\n".join([*parts, "</section>"])


def _badge(row: Row) -> str:
    kind = "ok" if row["status"] in ("registered", ALONE) else "no"
    return f'<span class="badge {kind}">{verdict(row)}</span>'


def _slider(figures: Path) -> str:
    """The picture before, with that after over it up to a line that is moved."""
    before, after = (
        f'<figure class="{when}">{embedded(figures / f"{when}.png", when)}<figcaption>{when}</figcaption></figure>'
        for when in ("before", "after")
    )
    slider = '<input class="range" type="range" min="0" max="100" value="50" aria-label="before and after">'
    return f'<div><div class="slider">{before}{after}</div>{slider}</div>'


def _scene_card(folder: Path, row: Row, view: View | None, texts: Texts) -> str:
    """A scene with its objects in 3D, and its figure."""
    title = escape(scene_title(folder.name))
    parts = [f'<section class="card" id="scene-{escape(folder.name)}"><h2>{title} in pictures</h2>']
    if view is not None:
        parts.append(view_section(f"scene-{folder.name}", f"scene {folder.name}", view, scale_sd=scale_sd(row)))
    # A given cloud has no cameras to show.
    caption = texts["scene_figure" if pd.notna(row.get("registered")) else "cloud_figure"]
    return "\n".join([*parts, figure(folder / "scene.png", caption), "</section>"])


def _object_record(folder: Path, texts: Texts) -> str:
    """The figures of an object that say how its result came about."""
    figures = {folder / name: caption for name, caption in texts["object_figures"].items()}
    shown = "".join(figure(path, caption) for path, caption in figures.items() if path.is_file())
    return _folded(f"Pictures of {folder.name}", shown) if shown else ""


def _table_section(table: pd.DataFrame, title: str, note: str, turned: bool = False) -> str:
    """A table with its note; empty columns are left out; `turned` has a row for each column."""
    table = table.dropna(axis=1, how="all")
    # A place is said whole: of a latitude four digits leave half a kilometre.
    places = {n: table[n].map("{:.10g}".format, na_action="ignore") for n in table if n.endswith("itude_deg")}
    if turned:
        table = table.assign(**places).set_index(table.columns[0]).T.rename_axis(columns=None).reset_index(names="")
    cells = table.map(lambda cell: number(cell) if cell == cell else "-")
    content = cells.to_html(index=False, border=0).replace("_", "_<wbr>")
    return _folded(title, f'<p>{escape(note)}</p><div class="wide">{content}</div>')
