"""One HTML page of a run that opens anywhere without a network: pictures embedded, tables, notes for reading them."""

import csv
from dataclasses import replace
from html import escape
from pathlib import Path

from scenefuse.core.stage import StageError, atomic_file
from scenefuse.paper.paper_section import paper_section
from scenefuse.report.collected import ALONE
from scenefuse.report.page import document, embedded, figure, view_section
from scenefuse.report.values import number
from scenefuse.report.view import View, read_view, thin

PAGE_POINTS = 700_000
"""Of all 3D views together: about 8 MB. With more views than fit, each gets fewer points."""

_TABLES = {
    "scenes": "Scenes",
    "objects": "Objects by themselves",
    "registration": "Registration",
    "completion": "Completion",
    "ablation": "Ablation",
    "runtime": "Time and memory",
}
_NOTES = {
    "scenes": "How many photos the scene model holds, how well it fits them, and the cloud that came out. Lengths are "
    "in the unit named in the row: metres where GPS, control points or known lengths gave them.",
    "objects": "PSNR (dB) and SSIM compare renders with photos: higher is better; `measured_on` says whether training "
    "saw those photos. Depth error, "
    "accuracy, precision, recall and F-score exist only where the true surface is known.",
    "registration": "f_score: how well both surfaces explain each other, 1 is perfect; the decision is made on it. "
    "Margin: lead over the second-best pose; near zero, two poses explain the data equally well. Below its limits an "
    "object is unregistered and left out of the scene. The paper's are fitness (the share of the crop's points with an "
    "object point within tau), inlier_rmse (the distance of the object's points that lie within tau of the "
    "crop, in the scene's unit and as a share of the crop's diagonal) and normal_consistency (how parallel the two "
    "surfaces are there; 0.5 is chance). fitness_source: the share of the object's points within tau of the crop, high "
    "for an object that is too small. fitness_f_score: both at once. `ungated`: nothing checked the pose. `failed`: a "
    "step ended with an error; `missing`: it has not run.",
    "completion": "value: of the added points. null: of a random cloud in their place; only a clear distance from it "
    "says something. before, after: of all points of the object in the scene, without and with them. Surface "
    "variation: 0 smooth to 1/3. NUE: evenness of the density after against before; at or below 1 as even as the "
    "scene, to 1.3 seamless; the density-invariant form ignores that one cloud is denser. Primitive fitting: share of "
    "points on planes, spheres or cylinders. scene_*: against truth, the scene around the object at a share of its "
    "diagonal (025pct: 0.25 %).",
    "ablation": "All variants at the same thresholds, except f_score and margin, which are each decision's own. `full` "
    "is fused, `paper` follows the published recipe, which checks no pose, `clouds_only` uses the clouds alone, "
    "`no_scale` leaves out scale rectification, `no_crop` the crop.",
    "runtime": "Sum over a rule's jobs; jobs run side by side, so the wall time is less than the total. Memory is the "
    "largest resident size of one job.",
}
# Few rows and many columns read better with one column a scene or object.
_TURNED = {"scenes", "objects"}
_TOLD_ABOVE = {"reason", "missing", "error"}
_OBJECT_FIGURES = {
    "before_after": "The scene around the object before and after fusion, same cameras.",
    "provenance": "Grey: measured in the scene. Orange: added from the object.",
    "missing": "Still missing: red never seen, blue seen but without texture, purple contradicted; numbers are the "
    "stations of next_photos.csv.",
    "registration": "The object (orange) over the scene's crop (blue dots).",
    "object": "Frames, masks, depth of the four stages on one scale, renders beside their photos, the object's cloud.",
}


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
        paper: table that compares the run with the paper, which only recipe `paper` has; it may be missing.
        title: heading of the page.
        report: output, one HTML file.

    Raises:
        StageError: the summary folder holds no summary.txt.
    """
    text = summary / "summary.txt"
    if not text.is_file():
        raise StageError(f"{text} does not exist; write the summary first")
    views = _views([*(f / "figures" for f in objects), *scenes])
    tables = {name: _read_table(summary / f"{name}.tsv") for name in _TABLES}
    drawn = [f for f in scenes if (f / "scene.png").is_file()]
    links = {f.name: f.name for f in objects} | {f"scene-{f.name}": f"scene {f.name}" for f in drawn}
    links |= {f"table-{name}": name for name in _TABLES if tables[name]}
    links |= {"paper": "the paper"} if paper is not None else {}
    body = [
        f"<h1>{escape(title)}</h1>",
        "<p>Objects that the scene's photos left incomplete, completed by their own close-up reconstruction.</p>",
        "<nav>" + " ".join(f'<a href="#{escape(to)}">{escape(name)}</a>' for to, name in links.items()) + "</nav>",
        *(_object_section(folder, tables["registration"], views.get(folder / "figures")) for folder in objects),
        *(_scene_section(folder, tables["scenes"], views.get(folder)) for folder in scenes),
        *([] if paper is None else [paper_section(_read_table(paper))]),
        *(_table_section(name, rows) for name, rows in tables.items() if rows),
        f"<h2>Summary</h2><pre>{escape(text.read_text().strip())}</pre>",
    ]
    page = document(title, body, bool(views))
    with atomic_file(report) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(f"{report}: {len(page) / 1e6:.1f} MB", flush=True)


def _views(folders: list[Path]) -> dict[Path, View]:
    """The 3D views that there are, by their folders, thinned to what the page holds."""
    found = {folder: view for folder in folders if (view := read_view(folder)) is not None}
    most = PAGE_POINTS / max(PAGE_POINTS, sum(len(view.cloud) for view in found.values()))
    return {
        folder: replace(view, cloud=thin(view.cloud, int(most * len(view.cloud)))) for folder, view in found.items()
    }


def _scene_section(folder: Path, scenes: list[dict[str, str]], view: View | None) -> str:
    """Heading, the completed scene's files, its 3D view, and the figure; nothing without a figure."""
    path = folder / "scene.png"
    if not path.is_file():
        return ""
    row = next((r for r in scenes if r.get("scene") == folder.name), {})
    parts = [f'<h2 id="scene-{escape(folder.name)}">Scene {escape(folder.name)}</h2>']
    if row.get("completed_points", "-") not in ("-", ""):
        parts.append(
            f"<p><code>{escape(str(folder))}/completed.ply</code> and <code>completed.copc.laz</code>: the scene with "
            f"all registered objects in it ({escape(row['completed_by'])}), {escape(row['completed_points'])} points; "
            "<code>source</code> says where each is from, <code>completed.json</code> what its numbers mean.</p>"
        )
    if view is not None:
        parts.append(view_section(f"scene-{folder.name}", f"scene {folder.name}", view))
    return "\n".join([*parts, figure(path, "From above and obliquely: cameras red, objects boxed.")])


def _object_section(folder: Path, registration: list[dict[str, str]], view: View | None) -> str:
    """Heading with the decision, the 3D view, before/after slider, the figures that exist."""
    row = next((r for r in registration if r.get("object") == folder.name), {})
    status, reason = row.get("status", "-"), row.get("reason", "-")
    badge = f'<span class="badge {"ok" if status in ("registered", ALONE) else "no"}">{escape(status)}</span>'
    parts = [f'<h2 id="{escape(folder.name)}">{escape(folder.name)}{badge}</h2>']
    if reason not in ("-", ""):
        parts.append(f"<p>{escape(reason)}</p>")
    if status == ALONE:
        parts.append("<p>It lies in no scene: its cloud, <code>object.ply</code>, is the result.</p>")
    if status in ("failed", "missing"):
        return "\n".join([*parts, "<p>No 3D view and no figures: the object's stages did not finish.</p>"])
    if view is not None:
        parts.append(view_section(f"object-{folder.name}", folder.name, view))
    elif status == "unregistered":
        parts.append("<p>No 3D view: the object has no accepted pose and was not added to the scene.</p>")
    else:
        parts.append("<p>No 3D view: figures/view.json is missing; draw the figures again.</p>")
    figure_folder = folder / "figures"
    before, after = figure_folder / "before.png", figure_folder / "after.png"
    if before.is_file() and after.is_file():
        parts.append(
            f'<div class="slider"><figure class="before">{embedded(before, "before")}<figcaption>before</figcaption>'
            f'</figure><figure class="after">{embedded(after, "after")}<figcaption>after</figcaption></figure></div>'
            '<input class="range" type="range" min="0" max="100" value="50" aria-label="before and after">'
        )
    figures = [(figure_folder / f"{name}.png", caption) for name, caption in _OBJECT_FIGURES.items()]
    parts += [figure(path, caption) for path, caption in figures if path.is_file()]
    return "\n".join(parts)


def _table_section(name: str, rows: list[dict[str, str]]) -> str:
    """A table with its note; columns of text are set left, numbers right and short; empty columns are left out."""
    columns = [c for c in rows[0] if c not in _TOLD_ABOVE and any(row[c] not in ("-", "") for row in rows)]
    grid = [columns, *([row[c] for c in columns] for row in rows)]
    if name in _TURNED:
        grid = [list(column) for column in zip(*grid)]
    textual = [any(_number(line[k]) is None for line in grid[1:] if line[k] != "-") for k in range(len(grid[0]))]
    # A break may fall after an underscore.
    heads = [f"<th{_left(t)}>{escape(c).replace('_', '_<wbr>')}</th>" for c, t in zip(grid[0], textual)]
    cells = [
        "<tr>" + "".join(f"<td{_left(t)}>{escape(_short(c))}</td>" for c, t in zip(line, textual)) + "</tr>"
        for line in grid[1:]
    ]
    return (
        f'<h2 id="table-{name}">{_TABLES[name]}</h2><p>{escape(_NOTES[name])}</p>'
        f'<div class="wide"><table><thead><tr>{"".join(heads)}</tr></thead>'
        f"<tbody>{''.join(cells)}</tbody></table></div>"
    )


def _left(text: bool) -> str:
    return ' class="text"' if text else ""


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _short(cell: str) -> str:
    """A number with four significant digits, any other cell as it is."""
    found = _number(cell)
    return cell if found is None else number(int(found) if found == int(found) and abs(found) < 1e15 else found)


def _read_table(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return [{k: v or "" for k, v in row.items() if k} for row in csv.DictReader(file, delimiter="\t")]
