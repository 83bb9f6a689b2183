"""Clouds as rows of text: XYZ, PTS, TXT, ASC, CSV, as scanners, CloudCompare and spreadsheets write them."""

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import AT_ONCE, COLOR, NORMAL, POSITION, UNIT_TOLERANCE, Columns, common_name
from scenefuse.core.stage import StageError

TEXTS = (".xyz", ".pts", ".txt", ".asc", ".csv")
# What surveyors call the columns, in lower case.
EASTING = ("x", "easting", "east", "e", "rechtswert", "rw", "ostwert")
NORTHING = ("y", "northing", "north", "n", "hochwert", "hw", "nordwert")
ELEVATION = ("z", "elevation", "elev", "height", "h", "altitude", "alt", "hoehe", "höhe")
# By how much the better of two places for the colours among the columns has to be.
MIN_CORRELATION_GAIN = 0.1
# Rows or columns that no scanner's grid has more of; most coordinates in metres do.
MAX_GRID_ROWS = 100_000
# Lines in which the first row is looked for, and rows by which it is told what their columns are.
MAX_HEAD_LINES, MAX_LAYOUT_ROWS = 50, 100_000


@dataclass(frozen=True)
class TextLayout:
    """What stands where in a file of rows.

    Attributes:
        above: lines before the first row.
        separator: of numbers; None for blanks.
        named: whether a name stands before the numbers of every row.
        counted: whether a line of its own may count the points of each scan, as in PTS.
        columns: the names of those that are read -> where they stand in a row.
        notes: what was guessed and what is left out, a sentence each.
    """

    above: int = 0
    separator: str | None = None
    named: bool = False
    counted: bool = False
    columns: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def rows(self, lines: list[str]) -> NDArray[np.float64]:
        """(N, C) numbers of lines that are rows."""
        # A name counts as a number, so that rows of another length are still an error.
        first_cell: Any = {0: lambda name: 0.0} if self.named else None
        if self.counted:
            lines = [line for line in lines if not line.strip().isdecimal()]
        # Some programs end each row with a separator.
        if self.separator and any(line.rstrip().endswith(self.separator) for line in lines[:1]):
            lines = [line.rstrip().removesuffix(self.separator) for line in lines]
        return np.loadtxt(
            lines, delimiter=self.separator, ndmin=2, converters=first_cell, comments=None if self.named else "#"
        )


def text_layout(path: Path) -> TextLayout:
    """What the first lines and rows of a file say of its columns.

    Rows are numbers separated by blanks, commas or semicolons, below any number of other lines. A line above them that
    names the columns (`//X Y Z R G B`, `Point,Northing,Easting,Elevation`) is believed. Without one, the first three
    columns are x, y, z and each three that follow are normals if they have unit length, else colours, if they can be;
    an intensity may stand before or behind these. A first column that names or numbers the points, or two
    with the row and column of a scanner, are left out, and so is what follows.

    Raises:
        StageError: longitude and latitude; commas as decimal points.
        ValueError: no rows of numbers.
    """
    with open(path, encoding=_encoding(path)) as file:
        head = list(islice(file, MAX_HEAD_LINES))
        if not "".join(head).strip():
            return TextLayout(columns=dict(zip(POSITION, range(3))))
        above, named = _first_row(path, head)
        begin = TextLayout(above, _separator(head[above]), named, path.suffix.lower() == ".pts")
        rows = begin.rows(head[above:] + list(islice(file, MAX_LAYOUT_ROWS)))
    names = _names(head[:above], begin.separator, rows.shape[1])
    if len(names) == rows.shape[1]:
        if set(POSITION) <= {common_name(name) for name in names}:
            return replace(begin, columns={name: k for k, name in enumerate(names)})
        axes = [[name for name in names if _plain(name) in known] for known in (EASTING, NORTHING, ELEVATION)]
        if all(len(found) == 1 for found in axes):
            own = {found[0]: axis for axis, found in zip(POSITION, axes)}
            columns = {own.get(name, name): k for k, name in enumerate(names) if k or not named}
            said = f"{path.name}: {', '.join(f'{axis} is {name}' for name, axis in own.items())}"
            return replace(begin, columns=columns, notes=[said])
    degrees = next((name for name in names if name.lower().startswith(("lon", "lat"))), None)
    if degrees is not None:
        raise StageError(f"{path} is in degrees (column {degrees}); project it to metres first, to UTM for instance")
    notes, first = list[str](), 1 if named else _indices(rows)
    if first == 1:
        notes.append(f"{path.name}: its first column names or numbers the points and is left out")
    elif first:
        notes.append(f"{path.name}: its first two columns are rows and columns of a scan and are left out")
    if len(names) - rows.shape[1] + first in (0, 1):
        title = head[above - 1].strip()[:60]
        notes.append(f"{path.name}: '{title}' names no columns x, y, z; the first three are these")
    columns, guessed = _unnamed(path, rows[:, first:])
    return replace(begin, columns={name: first + k for name, k in columns.items()}, notes=[*notes, *guessed])


def _encoding(path: Path) -> str:
    """That of a text whose first lines are UTF-8 or UTF-16, as spreadsheets write it; else of western Europe."""
    with open(path, "rb") as file:
        begin = file.read(1 << 16)
    if begin.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        codecs.getincrementaldecoder("utf-8")().decode(begin)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig"


def text_notes(path: Path) -> list[str]:
    """What a user should know of how a file of text was read, a sentence each; none for any other file."""
    return text_layout(path).notes if path.suffix.lower() in TEXTS else []


def read_text(path: Path, at_once: int = AT_ONCE) -> Iterator[Columns]:
    """The columns of a file of text (`text_layout`), so many rows at a time.

    Raises:
        ValueError: a row that is none, or is of another length.
    """
    layout = text_layout(path)
    with open(path, encoding=_encoding(path)) as file:
        lines = islice(file, layout.above, None)
        first = layout.above + 1
        while some := list(islice(lines, at_once)):
            if "".join(some).strip():
                try:
                    rows = layout.rows(some)
                except ValueError as error:
                    raise ValueError(f"{error}, rows counted from line {first}") from None
                yield {name: rows[:, k] for name, k in layout.columns.items()}
            first += len(some)


def _names(above: list[str], separator: str | None, columns: int) -> list[str]:
    """The names in the nearest line above the rows that has one for each column; else those in the last line."""
    lines = [_titles(line, separator) for line in reversed(above)]
    return next((names for names in lines if len(names) == columns), lines[0] if lines else [])


def _plain(name: str) -> str:
    """A column's name in lower case and without its unit: `N [m]`, `E_m`."""
    return re.sub(r"[\s_]*(\[\w+\]|\(\w+\)|_m)$", "", name.strip()).lower()


def _titles(line: str, separator: str | None) -> list[str]:
    """The names in a line above the rows."""
    return [title.strip().strip("\"'") for title in line.strip(" \t\r\n/#").split(separator)]


def _unnamed(path: Path, rows: NDArray[np.float64]) -> tuple[dict[str, int], list[str]]:
    """The names of (N, C) columns that no line names -> where they stand, and what a user should know of that."""
    columns, start, notes = {name: k for k, name in enumerate(POSITION[: rows.shape[1]])}, 3, list[str]()
    if rows.shape[1] % 3 == 1 and rows.shape[1] >= (4 if path.suffix.lower() == ".pts" else 7):
        start, notes = _colors_at(path, rows)
        columns |= {"intensity": 3} if start == 4 else {}
    for first in range(start, rows.shape[1] - 2, 3):
        three = rows[:, first : first + 3]
        unit = np.abs(np.linalg.norm(three, axis=1) - 1) < UNIT_TOLERANCE
        kind = NORMAL if unit[np.isfinite(three).all(1)].all() else COLOR
        if kind[0] in columns or (kind == COLOR and not _may_be_colors(three)):
            break
        columns |= {name: first + k for k, name in enumerate(kind)}
    if further := rows.shape[1] - len(columns):
        notes.append(f"{path.name}: {further} of its columns have no names and are left out")
    return columns, notes


def _may_be_colors(three: NDArray[np.float64]) -> bool:
    """Whether (N, 3) lie in a range of colours; coordinates, times and directions mostly do not."""
    three = three[np.isfinite(three).all(1)]
    return bool(three.min(initial=0) >= 0 and three.max(initial=0) <= 65535)


def _colors_at(path: Path, rows: NDArray[np.float64]) -> tuple[int, list[str]]:
    """Where the colours begin among (N, C) columns of which one is an intensity: 3, or 4 where it stands before them.

    The file does not say. Colours are alike, red and blue most like green; where both places are possible, and neither
    is clearly the better one, they are at none: C. Where it is a guess, a sentence says so.
    """
    if path.suffix.lower() == ".pts":
        return 4, []
    finite = rows[np.isfinite(rows).all(1)]
    places = [first for first in (3, 4) if _may_be_colors(finite[:, first : first + 3])]
    whole = [first for first in places if (finite[:, first : first + 3] == np.rint(finite[:, first : first + 3])).all()]
    places = whole if len(whole) == 1 else places
    lengths = {first: np.linalg.norm(finite[:, first : first + 3], axis=1) for first in (3, 4)}
    unit = [first for first, length in lengths.items() if (np.abs(length - 1) < UNIT_TOLERANCE).all()]
    if len(unit) == 1 or len(places) == 1:
        return (unit or places)[0], []
    varying = len(places) == 2 and len(finite) > 1 and (np.ptp(finite[:, 3:7], axis=0) > 0).all()
    alike = np.array(np.corrcoef(finite[:, 3:7].T)) if varying else np.zeros((4, 4))
    behind, before = min(alike[0, 1], alike[1, 2]), min(alike[1, 2], alike[2, 3])
    if abs(before - behind) > MIN_CORRELATION_GAIN:
        first = 4 if before > behind else 3
        said = f"columns {first + 1} to {first + 3} are taken for red, green and blue"
    else:
        first, said = rows.shape[1], "which columns are colours cannot be told, and none are read"
    return first, [f"{path.name}: {said}; name the columns in a first line (x y z intensity r g b) if this is wrong"]


def _first_row(path: Path, head: list[str]) -> tuple[int, bool]:
    """Where the rows begin among the first lines, and whether a name stands before the numbers of all of them.

    Raises:
        ValueError: there are none.
        StageError: decimals have commas.
    """
    last = next(line.strip() for line in reversed(head) if line.strip())
    commas = len(re.findall(r"(?<![\d.,])-?\d+,\d+(?![\d.,])", last))
    if commas >= 3 or (commas and (";" in last or "\t" in last)):
        raise StageError(f"{path} has commas as decimal points: '{last[:60]}'; export it with points")
    numbers = next((k for k, line in enumerate(head) if len(_numbers(line)) >= 3), None)
    if numbers is not None:
        return numbers, False
    counts = [len(_numbers(line, True)) for line in head]
    usual = max((count for count in counts if count >= 3), key=counts.count, default=None)
    if usual is None:
        raise ValueError("none of its first lines holds three numbers")
    first = counts.index(usual)
    if any(count != usual for count, line in zip(counts[first:], head[first:]) if line.strip()):
        raise ValueError("its rows have different numbers of columns")
    return first, True


def _indices(rows: NDArray[np.float64]) -> int:
    """How many of the first of (N, C) columns number the points: 1, one after the other, or whole numbers, each once,
    before coordinates that are not whole where x, y, z and colours or normals would be a column fewer or more; or 2, as
    in a scanner's grid, where what follows is x, y, z, and colours or whole numbers."""
    first, columns = rows[:, 0], rows.shape[1]
    if columns <= 3 or len(rows) <= 3:
        return 0
    whole = (rows == np.rint(rows)).all(0)
    if columns > 4 and whole[:2].all() and not whole[2:5].any() and (columns % 3 == 2 or whole[5:].all()):
        return 2 if rows[:, :2].min() >= 0 and rows[:, :2].max() <= MAX_GRID_ROWS else 0
    if (first == first[0] + np.arange(len(first))).all():
        return 1
    once = len(np.unique(first)) == len(first)
    return int(columns % 3 == 1 and whole[0] and not whole[1:4].any() and once)


def _separator(line: str) -> str | None:
    return next((mark for mark in ";," if mark in line), None)


def _numbers(line: str, named: bool = False) -> list[float]:
    """The numbers of a line of numbers, with a name before them or not; none of any other."""
    mark = _separator(line)
    cells = (line.rstrip().removesuffix(mark) if mark else line).split(mark)
    try:
        return [float(cell) for cell in cells[int(named) :]]
    except ValueError:
        return []
