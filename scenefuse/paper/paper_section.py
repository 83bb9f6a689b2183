"""The section of the report page that compares a run of the paper's recipe with the paper: its tables and figures."""

from html import escape

from scenefuse.paper.paper_tables import COMMON, HERE, NULL, PAPER, SCENEFUSE
from scenefuse.report.values import number

_HEADINGS = (PAPER, HERE, SCENEFUSE, COMMON, NULL)
_TITLES = {
    "2": "registration",
    "3": "completion",
    "4": "registration without scale rectification (no_scale), without the crop (no_crop)",
}
_ABOUT = (
    f"{PAPER}: what it states for its own captures of such objects; its thresholds are not known. {HERE}: this run."
    f" {SCENEFUSE}: a run of the shipped recipe on the same photos, by the same definitions, on its own crop."
    f" {COMMON}: its pose on this run's crop, which may hold ground, as the fiducials' box has it (Table 2)."
    f" {NULL}: the same for a random cloud in the place of the object (Tables 2, 4) or of the added points (Table 3);"
    " only a clear distance from it says something. Labels like R10 are those of docs/method."
)
_FIGURES = (
    "Its figures have their counterparts on this page and in results/. Figure 2, the scene and its incomplete objects:"
    " (a) scenes/SCENE/scene.png, (b) the row before of objects/OBJECT/figures/before_after.png, large in before.png."
    " Figure 3, the objects reconstructed: figures/object.png. Figure 5, before and after completion:"
    " figures/before_after.png, large in before.png and after.png."
)


def paper_section(rows: list[dict[str, str]]) -> str:
    """Heading, notes and tables from the rows of paper.tsv."""
    parts = ['<h2 id="paper">The paper\'s Tables 2, 3 and 4</h2>']
    parts += [f"<p>{escape(text)}</p>" for text in (_ABOUT, _FIGURES, *_notes(rows))]
    for table, title in _TITLES.items():
        parts.append(f"<h3>Table {table}: {title}</h3>{_table([row for row in rows if row['table'] == table])}")
    return "\n".join(parts)


def _notes(rows: list[dict[str, str]]) -> list[str]:
    """What is said of the cells of each object, once, with the rows that it is said of unless these are all."""
    said: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in rows:
        if row["note"] != "-":
            said.setdefault((row["object"], row["note"]), []).append(row)
    own = {name: [row for row in rows if row["object"] == name] for name, _ in said}
    made = dict.fromkeys(f"{row['object']}, {HERE}: {row['preset']}" for row in rows if row.get("preset", "-") != "-")
    return [*made, *(f"{name}{_where(of, own[name])}: {note}" for (name, note), of in said.items())]


def _where(of: list[dict[str, str]], rows: list[dict[str, str]]) -> str:
    """Which of an object's rows some are: the variants of which they are all, else the measures."""
    if len(of) == len(rows):
        return ""
    places = []
    for variant in dict.fromkeys(row["variant"] for row in of):
        measures = [row["measure"] for row in of if row["variant"] == variant]
        all_of_it = len(measures) == sum(row["variant"] == variant for row in rows)
        places.append(variant if all_of_it else f"{', '.join(measures)} of {variant}")
    return f" ({'; '.join(places)})"


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
