"""The report on paper: an overview, then two A4 pages an object, of the records that the page is made of."""

import logging
from pathlib import Path
from textwrap import shorten

import matplotlib
import numpy as np
import rasterio
from fpdf import FPDF
from PIL import Image

from scenefuse.core.stage import atomic_file, read_json, value
from scenefuse.core.version import VERSION
from scenefuse.photos.sheets import round_below
from scenefuse.report.facts import (
    ADDED,
    Row,
    accuracies,
    made_by,
    object_facts,
    rows_of,
    scene_exports,
    scene_facts,
    scene_title,
    surface_facts,
    title_of,
    verdict,
)
from scenefuse.report.values import length
from scenefuse.surface.gltf import metres_per_unit

GAP_MM = 4
SIDES = ("south", "east", "north", "west")


def write_pdf(
    *, summary: Path, scenes: tuple[Path, ...] = (), objects: tuple[Path, ...] = (), title: str = "", report: Path
) -> None:
    """Write what a client keeps: an overview, and an object's facts, pictures and four sides to scale.

    Args:
        summary: folder with the summary's TSV files.
        scenes: result folders of the scenes.
        objects: result folders of the objects; drawings/ and figures/ in them are shown where they are.
        title: of the project; that of `title_of` where it is left out.
        report: output PDF.
    """
    rows = rows_of(summary, "object", objects)
    facts = [
        _with_all(object_facts(row), "Accuracy", row) | surface_facts(folder, row) for folder, row in zip(objects, rows)
    ]
    page = _Page(title or title_of(objects), made_by(summary))
    page.start(page.project, f"{page.made} Files named here lie in the project's folder or the archive you were sent.")
    for folder, row in zip(scenes, rows_of(summary, "scene", scenes)):
        page.text_line(scene_title(row["scene"]), 12)
        page.facts(_with_all(scene_facts(row), "Position", row) | scene_exports(folder))
    page.text_line("Objects", 12)
    # What is missing is told apart on the object's own page.
    surfaces = [each.get("Surface", "").split(":")[0] or shorten(each["Result"], 150) for each in facts]
    found = [[each.get("Size", "-"), surface] for each, surface in zip(facts, surfaces)]
    page.rows([[folder.name, verdict(row), *more] for folder, row, more in zip(objects, rows, found)], (3, 3, 7, 12))
    for folder in scenes:
        page.pictures([folder / "scene.png"], [scene_title(folder.name)])
    for folder, row, each in zip(objects, rows, facts):
        page.start(folder.name, page.made)
        page.facts(each)
        # What others have of pictures is from an earlier run.
        if row["status"] not in ADDED:
            continue
        page.pictures([folder / f"figures/{when}.png" for when in ("before", "after")], ["before", "after"])
        # A person may delete some of them.
        drawn = ("drawings.json", *(f"{side}.tif" for side in SIDES))
        is_drawn = all((folder / "drawings" / name).is_file() for name in drawn)
        # Without photos nothing says what is missing.
        missing = folder / "figures/missing.png"
        shown = ["what is missing"] * missing.is_file() + ["the four sides"] * is_drawn
        if shown:
            page.start(folder.name, ", and ".join(shown))
        if is_drawn:
            page.sides(folder / "drawings")
        page.pictures([missing], ["what is missing, and from where photos would show it"])
    with atomic_file(report) as temporary:
        page.output(str(temporary))


def _with_all(facts: dict[str, str], label: str, row: Row) -> dict[str, str]:
    """Facts, of which one quotes how exact something is, with all that is known of that."""
    return facts | {label: "; ".join([facts[label], *accuracies(row)[1:]])} if label in facts else facts


class _Page(FPDF):
    """A4 pages that begin with the project and end with who made them."""

    def __init__(self, project: str, made: str) -> None:
        super().__init__()
        logging.getLogger("fontTools").setLevel(logging.ERROR)
        fonts = Path(matplotlib.get_data_path()) / "fonts/ttf"
        self.add_font("sans", "", fonts / "DejaVuSans.ttf")
        self.add_font("sans", "B", fonts / "DejaVuSans-Bold.ttf")
        self.project, self.made = project, made
        self.c_margin = 0.0
        self.set_title(project)
        self.set_creator(f"scenefuse {VERSION}")

    def footer(self) -> None:
        """The project, its maker and the number of the page."""
        self.set_y(-self.l_margin)
        self.set_font("sans", size=7)
        self.cell(0, 4, shorten(f"{self.project}. {self.made}", 110), align="L")
        self.cell(0, 4, f"{self.page_no()}", align="R")

    def start(self, name: str, below: str) -> None:
        """A new page of an object, and a line below its name."""
        self.add_page()
        self.text_line(name, 16)
        self.set_font("sans", size=9)
        self.multi_cell(0, 5, below, align="L", new_x="LMARGIN", new_y="NEXT")
        self.ln(GAP_MM)

    def text_line(self, text: str, size: int) -> None:
        """A heading of this size."""
        self.set_font("sans", "B", size)
        self.multi_cell(0, 0.55 * size, text, align="L", new_x="LMARGIN", new_y="NEXT")

    def facts(self, facts: dict[str, str]) -> None:
        """A table of labels and sentences."""
        # A row has to fit on a page: the last line of a log may hold a command with thousands of files.
        self.rows([[label, text[:4000] + " ..." * (len(text) > 4000)] for label, text in facts.items()], (1, 5))

    def rows(self, rows: list[list[str]], widths: tuple[int, ...]) -> None:
        """A table without a heading."""
        self.set_font("sans", size=9)
        self.set_line_width(0.1)
        with self.table(
            first_row_as_headings=False,
            borders_layout="HORIZONTAL_LINES",
            col_widths=widths,
            text_align="LEFT",
            line_height=4.5,
            padding=0.7,
        ) as table:
            for row in rows:
                table.row(row)
        self.ln(GAP_MM)

    def pictures(self, paths: list[Path], captions: list[str]) -> None:
        """The pictures that there are, beside each other, as large as the page allows."""
        shown = [(path, caption) for path, caption in zip(paths, captions) if path.is_file()]
        if not shown:
            return
        sizes = [Image.open(path).size for path, _ in shown]
        width = (self.epw - GAP_MM * (len(shown) - 1)) / len(shown)
        highest = width * max(h / w for w, h in sizes)
        left = self.eph + self.t_margin - self.get_y() - 2 * GAP_MM
        if left < highest / 4:
            self.add_page()
            left = self.eph - 2 * GAP_MM
        width *= min(1.0, left / highest)
        top = self.get_y()
        self.set_font("sans", size=8)
        for k, (path, caption) in enumerate(shown):
            x = self.l_margin + k * (width + GAP_MM)
            self.image(str(path), x, top, width)
            self.text(x, top + min(left, highest) + 3, caption)
        self.set_y(top + min(left, highest) + 2 * GAP_MM)

    def sides(self, drawings: Path) -> None:
        """The four elevations to one scale, which is said below them, beside a bar."""
        known = read_json(drawings / "drawings.json")
        unit, views = known["south_pixel"]["unit"], []
        for side in SIDES:
            with rasterio.open(drawings / f"{side}.tif") as file:
                views.append((np.moveaxis(file.read(), 0, 2), value(known, f"{side}_pixel")))
        width, height = (max(v.shape[axis] * pixel for v, pixel in views) for axis in (1, 0))
        cell, mm = (self.epw - GAP_MM) / 2, 1000 * metres_per_unit(unit)
        needed = mm * max(width / cell, height / (0.2 * self.eph))
        power = 10.0 ** np.floor(np.log10(needed))
        scale = next(k for k in (1, 1.5, 2, 2.5, 3, 4, 5, 7.5, 10) if k * power >= needed) * power
        # Nothing is enlarged that has a size.
        scale = scale if unit == "scene units" else max(1.0, scale)
        per_unit, top = mm / scale, self.get_y()
        self.set_font("sans", size=8)
        for k, (side, (pixels, pixel)) in enumerate(zip(SIDES, views)):
            x = self.l_margin + k % 2 * (cell + GAP_MM)
            y = top + k // 2 * (height * per_unit + 2 * GAP_MM)
            high, wide = (side_px * pixel * per_unit for side_px in pixels.shape[:2])
            with self.local_context(fill_color=217):  # as on the drawings: a wall may be white
                self.rect(x, y, wide, high, "F")
            self.image(Image.fromarray(pixels), x, y, wide)
            looking = (-90 * k - value(known, "wall_turn")) % 360
            self.text(x, y + height * per_unit + 3, f"from the {side}, looking towards {looking:.0f}°")
        bar = round_below(width / 2)
        self.set_y(top + 2 * (height * per_unit + 2 * GAP_MM) + 2)
        with self.local_context(fill_color=0):  # a line would reach half its width beyond its ends
            self.rect(self.l_margin, self.get_y(), bar * per_unit, 1, "F")
        self.ln(2)
        ratio = "" if unit == "scene units" else f"1:{scale:g} on A4; "
        north = "" if value(known, "has_north") else "; y taken for north"
        colors = "purple: interpolated; grey: not measured"
        self.cell(0, 5, f"{ratio}bar: {length(bar, unit)}; {colors}{north}", new_x="LMARGIN", new_y="NEXT")
