"""One HTML page of a run that opens anywhere without a network: pictures embedded, tables, notes for reading them."""

import csv
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import yaml

from scenefuse.core.stage import StageError, atomic_file
from scenefuse.report.page import asset, document, embedded, figure, view_section
from scenefuse.report.run_summary import ALONE
from scenefuse.report.values import number
from scenefuse.report.view import View, read_view, thin

# Of all 3D views together: about 8 MB. With more views than fit, each gets fewer points.
PAGE_POINTS = 700_000
# Columns that stand above a table, with the object that they are about.
ABOVE_TABLES = {"reason", "missing", "error"}
EMPTY = ("-", "")
Row = dict[str, str]


def write_report(
    *,
    summary: Path,
    scenes: tuple[Path, ...] = (),
    objects: tuple[Path, ...] = (),
    paper: Path | None = None,
    title: str,
    report: Path,
) -> None:
    """Write the report page of a run: every object and scene in 3D, figures, tables with notes, the text summary.

    Everything is in the one file: no script, font or picture is fetched.

    Args:
        summary: folder with the summary's TSV files and summary.txt; an absent table is left out.
        scenes: result folders of the scenes; scene.png and the 3D view in it are shown.
        objects: result folders of the objects; figures/ in it is shown. One without figures is named as such.
        paper: section that compares the run with the paper, HTML, which only recipe `paper` has; it may be missing.
        title: heading of the page.
        report: output, one HTML file.

    Raises:
        StageError: the summary folder holds no summary.txt.
    """
    text = summary / "summary.txt"
    if not text.is_file():
        raise StageError(f"{text} does not exist; write the summary first")
    texts: dict[str, Any] = yaml.safe_load(asset("report.yaml"))
    views = _views([*(folder / "figures" for folder in objects), *scenes])
    tables = {name: rows for name in texts["tables"] if (rows := _read_table(summary / f"{name}.tsv"))}
    drawn = [folder for folder in scenes if (folder / "scene.png").is_file()]
    links = {folder.name: folder.name for folder in objects}
    links |= {f"scene-{folder.name}": f"scene {folder.name}" for folder in drawn}
    links |= {f"table-{name}": name for name in tables}
    links |= {"paper": "the paper"} if paper is not None else {}
    of_object = {row["object"]: row for row in reversed(tables.get("registration", []))}
    of_scene = {row["scene"]: row for row in tables.get("scenes", [])}
    body = [
        f"<h1>{escape(title)}</h1><p>{texts['intro']}</p>",
        "<nav>" + " ".join(f'<a href="#{escape(to)}">{escape(name)}</a>' for to, name in links.items()) + "</nav>",
        *(_object_section(f, of_object.get(f.name, {}), views.get(f / "figures"), texts) for f in objects),
        *(_scene_section(f, of_scene.get(f.name, {}), views.get(f), texts) for f in drawn),
        *([] if paper is None else [_paper_section(paper)]),
        *(_table_section(name, rows, **texts["tables"][name]) for name, rows in tables.items()),
        f"<h2>Summary</h2><pre>{escape(text.read_text().strip())}</pre>",
    ]
    page = document(title, body, bool(views))
    with atomic_file(report) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(f"{report}: {len(page) / 1e6:.1f} MB", flush=True)


def _paper_section(path: Path) -> str:
    """The section of the paper as it was written, or that it is missing."""
    if path.is_file():
        return path.read_text(encoding="utf-8")
    return f'<h2 id="paper">The paper</h2><p>{path.name} is missing; results/logs/compare_with_paper/ says why.</p>'


def _views(folders: list[Path]) -> dict[Path, View]:
    """The 3D views that there are, by their folders, thinned to what the page holds."""
    found = {folder: view for folder in folders if (view := read_view(folder)) is not None}
    share = PAGE_POINTS / max(PAGE_POINTS, sum(len(view.cloud) for view in found.values()))
    return {
        folder: replace(view, cloud=thin(view.cloud, int(share * len(view.cloud)))) for folder, view in found.items()
    }


def _scene_section(folder: Path, row: Row, view: View | None, texts: dict[str, Any]) -> str:
    """Heading, the completed scene's files, its 3D view, and the figure."""
    parts = [f'<h2 id="scene-{escape(folder.name)}">Scene {escape(folder.name)}</h2>']
    if row.get("completed_points", "-") not in EMPTY:
        parts.append(
            f"<p><code>{escape(str(folder))}/completed.ply</code> and <code>completed.copc.laz</code>: the scene with "
            f"all registered objects in it ({escape(row['completed_by'])}), {escape(row['completed_points'])} points; "
            "<code>source</code> says where each is from, <code>completed.json</code> what its numbers mean.</p>"
        )
    if view is not None:
        parts.append(view_section(f"scene-{folder.name}", f"scene {folder.name}", view))
    return "\n".join([*parts, figure(folder / "scene.png", texts["scene_figure"])])


def _object_section(folder: Path, row: Row, view: View | None, texts: dict[str, Any]) -> str:
    """Heading with the decision, the 3D view, before/after slider, the figures that exist."""
    status, reason = row.get("status", "-"), row.get("reason", "-")
    badge = f'<span class="badge {"ok" if status in ("registered", ALONE) else "no"}">{escape(status)}</span>'
    parts = [f'<h2 id="{escape(folder.name)}">{escape(folder.name)}{badge}</h2>']
    if reason not in EMPTY:
        parts.append(f"<p>{escape(reason)}</p>")
    if status == ALONE:
        parts.append("<p>It lies in no scene: its cloud, <code>object.ply</code>, is the result.</p>")
    # What an unfinished object has of figures is from an earlier run.
    unfinished = status in ("failed", "missing")
    if view is None or unfinished:
        parts.append(f"<p>{texts['no_view'].get(status, texts['no_view']['other'])}</p>")
    else:
        parts.append(view_section(f"object-{folder.name}", folder.name, view))
    if unfinished:
        return "\n".join(parts)
    pictures = folder / "figures"
    if all((pictures / f"{when}.png").is_file() for when in ("before", "after")):
        before, after = (
            f'<figure class="{when}">{embedded(pictures / f"{when}.png", when)}<figcaption>{when}</figcaption></figure>'
            for when in ("before", "after")
        )
        slider = '<input class="range" type="range" min="0" max="100" value="50" aria-label="before and after">'
        parts.append(f'<div class="slider">{before}{after}</div>{slider}')
    figures = {pictures / f"{name}.png": caption for name, caption in texts["object_figures"].items()}
    return "\n".join([*parts, *(figure(path, caption) for path, caption in figures.items() if path.is_file())])


def _table_section(name: str, rows: list[Row], title: str, note: str, turned: bool = False) -> str:
    """A table with its note; columns of text are set left, numbers right and short; empty columns are left out."""
    columns = [c for c in rows[0] if c not in ABOVE_TABLES and any(row[c] not in EMPTY for row in rows)]
    grid = [columns, *([row[c] for c in columns] for row in rows)]
    grid = [list(column) for column in zip(*grid)] if turned else grid
    textual = [any(_number(line[k]) is None for line in grid[1:] if line[k] != "-") for k in range(len(grid[0]))]
    kinds = [' class="text"' if text else "" for text in textual]
    # A break may fall after an underscore.
    heads = [f"<th{kind}>{escape(cell).replace('_', '_<wbr>')}</th>" for cell, kind in zip(grid[0], kinds)]
    lines = [[f"<td{kind}>{escape(_short(cell))}</td>" for cell, kind in zip(line, kinds)] for line in grid[1:]]
    body = "".join(f"<tr>{''.join(cells)}</tr>" for cells in lines)
    return (
        f'<h2 id="table-{name}">{title}</h2><p>{escape(note)}</p><div class="wide"><table><thead><tr>{"".join(heads)}'
        f"</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _short(cell: str) -> str:
    """A number with four significant digits, any other cell as it is."""
    found = _number(cell)
    return cell if found is None else number(int(found) if found == int(found) and abs(found) < 1e15 else found)


def _read_table(path: Path) -> list[Row]:
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return [{k: v or "" for k, v in row.items() if k} for row in csv.DictReader(file, delimiter="\t")]
