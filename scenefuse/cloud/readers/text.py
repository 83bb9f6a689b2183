"""Clouds as rows of text: XYZ, PTS, TXT, ASC, CSV, as scanners, CloudCompare and spreadsheets write them."""

import codecs
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import (
    AT_ONCE,
    COLOR,
    COMMENT,
    NORMAL,
    POSITION,
    TOGETHER,
    UNIT_TOLERANCE,
    Columns,
    cells_of,
    common_names,
    number,
    number_rows,
    separator,
)
from scenefuse.core.stage import StageError

TEXTS = (".xyz", ".pts", ".txt", ".asc", ".csv")
# What surveyors call the columns, in lower case, and what may stand beside that.
EASTING = ("x", "easting", "east", "e", "rechtswert", "rw", "ostwert", "ost", "est", "este")
NORTHING = ("y", "northing", "north", "n", "hochwert", "hw", "nordwert", "nord", "norte")
ELEVATION = ("z", "elevation", "elev", "height", "h", "altitude", "alt", "hoehe", "höhe", "quota", "cota")
# Point, northing, easting, elevation and description, as surveyors' programs call a whole row.
ROW_NAMES = re.compile("P?(NE|EN)ZD?", re.IGNORECASE)
BESIDE = {"m", "utm", "coord", "coords", "coordinate"}
# A unit behind a name.
UNIT = re.compile(r"[\[(]\s*(\w+)\s*[\])]$")
DEGREES = re.compile("lon|lat", re.IGNORECASE)
# X is the easting in programs and the northing in German surveying.
EAST_OR_NORTH = re.compile(r"[xy][\s_.-]*koord|koord\w*[\s_.-]*[xy]$", re.IGNORECASE)
# How the grids of Esri, GRASS and Surfer begin.
RASTER = re.compile(r"(ncols|nrows|north:|DSAA)\s", re.IGNORECASE)
# By how much the better of two places for the colours among the columns has to be.
MIN_CORRELATION_GAIN = 0.1
# Red, green and blue of a picture reach alike far; an intensity, a return and a class do not.
MIN_RANGE_RATIO = 0.25
# Rows or columns that no scanner's grid has more of; most coordinates in metres do.
MAX_GRID_ROWS = 100_000
# What GIS write for cells of a raster that hold nothing, or the largest of single numbers.
NO_DATA = (-9999.0, -32767.0, -32768.0, -99999.0)
# Lines in which the first row is looked for.
MAX_HEAD_LINES = 50


@dataclass(frozen=True)
class TextLayout:
    """What stands where in a file of rows.

    Attributes:
        above: lines before the first row.
        separator: of numbers; None for blanks.
        width: cells of a row.
        named: whether a name stands before the numbers of every row.
        columns: the names of those that are read -> where they stand in a row.
        notes: what was guessed and what is left out, a sentence each.
    """

    above: int = 0
    separator: str | None = None
    width: int = 3
    named: bool = False
    columns: dict[str, int] = field(default_factory=lambda: dict(zip(POSITION, range(3))))
    notes: list[str] = field(default_factory=list)

    def rows(self, path: Path, lines: list[bytes], first: int, wanted: Sequence[int]) -> NDArray[np.float64]:
        """(N, C) numbers of some columns of lines, the first of which has that number in the file (`number_rows`)."""
        if path.suffix.lower() == ".pts":  # a line of its own counts the points of each scan
            lines = [line for line in lines if not line.strip().isdigit()]
        needed = 1 + max((self.columns[axis] for axis in POSITION if axis in self.columns), default=0)
        return number_rows(lines, self.separator, self.width, wanted, needed, (str(path), first), not self.named)


def text_layout(path: Path) -> TextLayout:
    """What the first lines and rows of a file say of its columns.

    Rows are numbers separated by blanks, tabs, commas or semicolons, below any number of other lines. A line above them
    that names the columns (`//X Y Z R G B`, `Point,Northing,Easting,Elevation`) is believed. Without one, the first
    three columns are x, y, z and each three that follow are normals if they have unit length, else colours, if they can
    be nothing else; an intensity may stand before or behind these. A first column that names or numbers the points, or
    two with the row and column of a scanner, are left out, and so is what follows.

    Raises:
        StageError: longitude and latitude; commas as decimal points; a row of another length; a raster or PTX; names in
            another order than x, y, z that are not so many as the columns.
        ValueError: no rows of numbers.
    """
    head = [_decoded(line) for line in islice(_lines(path), MAX_HEAD_LINES)]
    if not "".join(head).strip():
        return TextLayout()
    above, mark, width, named = _first_row(path, head)
    begin = TextLayout(above, mark, width, named)
    rows = begin.rows(path, list(islice(_lines(path), above, TOGETHER)), above + 1, range(width))
    rows = rows[np.isfinite(rows).any(1)]
    known = np.asarray(np.isfinite(rows).any(0))
    while rows.shape[1] > 3 and not known[rows.shape[1] - 1]:  # words behind the numbers, or a separator
        rows = rows[:, :-1]
    notes, first = list[str](), 1 if named else _indices(rows)
    headers = list(_headers(head[:above], mark, width, rows.shape[1] - 1 if first == 1 else 0))
    fitting = [names for names in headers if rows.shape[1] <= len(names) <= width]
    names = next((names for names in fitting if _axes(names)), [])
    if axes := _axes(names):
        usual = common_names(names)
        if axes[1] + 1 == axes[0] < axes[2] and names[axes[0]].lower().startswith("x"):
            raise _unsure(path, names[axes[0]])
        if len(units := {unit[1].lower() for k in axes if (unit := UNIT.search(names[k]))}) > 1:
            raise StageError(f"{path} has x, y and z in {', '.join(sorted(units))}; export all three in one unit")
        if not set(POSITION) <= set(usual):
            notes = [f"{path.name}: {', '.join(f'{axis} is {names[k]}' for axis, k in zip(POSITION, axes))}"]
        words = [name for name, numbers in zip(names, known) if name and not numbers]
        notes += [f"{path.name}: its columns without numbers are left out: {', '.join(words)}"] if words else []
        own = {name: k for k, name in enumerate(usual) if k not in axes and name not in POSITION and name and known[k]}
        columns = dict(zip(POSITION, axes)) | own
    else:
        _check_order(path, headers, rows.shape[1])
        names = next(iter(fitting), headers[0] if headers else [])
        called = [name for line in fitting or [names] for name in line]
        for name in filter(DEGREES.match, called):
            raise StageError(f"{path} is in degrees (column {name}); project it to metres first, to UTM for instance")
        for name in filter(EAST_OR_NORTH.match, called):
            raise _unsure(path, name)
        for line in fitting:
            # A northing that stands first is no x, whatever the others are.
            if any(k != first + axis for axis, found in enumerate(_surveyed(line)) for k in found):
                said = "does not say which three columns are x, y and z; call them so"
                raise StageError(f"{path}: '{' '.join(line)[:60]}' {said}")
        if first == 1 and width > rows.shape[1] == 4:
            raise StageError(
                f"{path}: whether its rows are point, easting, northing or point, northing, easting cannot be told;"
                " write PENZD or PNEZD as its first line"
            )
        if first == 1:
            what = "names or numbers the points and is left out; the next three are x, y and z"
            notes.append(f"{path.name}: its first column {what}")
        elif first:
            notes.append(f"{path.name}: its first two columns are rows and columns of a scan and are left out")
        if len(names) - rows.shape[1] + first in (0, 1):
            title = head[above - 1].strip()[:60]
            notes.append(f"{path.name}: '{title}' names no columns x, y, z; the first three are these")
        columns, guessed = _unnamed(path, rows[:, first:])
        columns, notes = {name: first + k for name, k in columns.items()}, [*notes, *guessed]
    empty = [k for axis, k in columns.items() if axis in POSITION and not known[k]]
    cells = cells_of(head[above], mark)
    if empty and (said := _no_number([cells[k] for k in empty if k < len(cells)])):
        raise ValueError(said)
    return replace(begin, columns=columns, notes=notes)


def _lines(path: Path) -> Iterator[bytes]:
    """The lines of a text in UTF-8, or in one byte a letter; without a byte order mark."""
    with open(path, "rb") as file:
        begin = file.read(1 << 16)
        if begin.startswith((b"PK\3\4", b"\xd0\xcf\x11\xe0")):
            raise ValueError("it is a workbook or an archive, not text")
        halves = {name: begin[k::2] for k, name in enumerate(("utf-16-be", "utf-16-le"))}
        wide = next((name for name, half in halves.items() if 2 * half.count(0) > len(half)), "")
        wide = "utf-16" if begin.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else wide
        if not wide and not re.search(rb"\r[^\r\n]", begin):
            file.seek(len(codecs.BOM_UTF8) if begin.startswith(codecs.BOM_UTF8) else 0)
            yield from file
            return
    # Spreadsheets write UTF-16, and old Macs end lines by a carriage return alone, some lines in a file put together.
    with open(path, encoding=wide or "latin-1", errors="replace") as text:
        yield from (line.encode("utf-8" if wide else "latin-1", "replace") for line in text)


def _decoded(line: bytes) -> str:
    """A line of UTF-8, else of western Europe."""
    try:
        return line.decode()
    except UnicodeDecodeError:
        return line.decode("cp1252", "replace")


def text_notes(path: Path) -> list[str]:
    """What a user should know of how a file of text was read, a sentence each; none for any other file."""
    return text_layout(path).notes if path.suffix.lower() in TEXTS else []


def read_text(path: Path, at_once: int = AT_ONCE) -> Iterator[Columns]:
    """The columns of a file of text (`text_layout`), so many rows at a time.

    Raises:
        StageError: a row is of another length, or the file ends within one.
    """
    layout = text_layout(path)
    lines, first, count = islice(_lines(path), layout.above, None), layout.above + 1, 0
    while some := list(islice(lines, at_once)):
        rows = layout.rows(path, some, first, list(layout.columns.values()))
        columns = dict(zip(layout.columns, rows.T))
        for axis in set(POSITION) & set(columns):
            values = columns[axis]
            values[np.isin(values, NO_DATA) | (np.abs(values) > 1e30)] = np.nan
        yield columns
        first, count = first + len(some), count + len(rows)
    said = (int(line) for line in _lines(path) if line.strip().isdigit()) if path.suffix.lower() == ".pts" else ()
    if (missing := sum(said) - count) > 0:
        raise StageError(f"{path} is cut short: its last {missing} points are missing; copy it again")


def _headers(above: list[str], mark: str | None, width: int, unnumbered: int) -> Iterator[list[str]]:
    """The names that lines above the rows may hold, the nearest first, each split as the rows are, and in its own way.

    Empty ones at its end do not count, nor do those of cells that all rows leave out. Where there are so many as
    `unnumbered`, the first column, which numbers the points, has none.
    """
    for line in reversed(above):
        line = line.strip(" \r\n/#%")
        for own in dict.fromkeys((mark, separator(line))):
            whole = line if own else re.sub(r"\s+[\[(][^\])]*[\])]", "", line)
            names = list(line) if ROW_NAMES.fullmatch(line) else cells_of(whole, own)
            while names and not names[-1]:
                names.pop()
            names = names[:width] if own and own == mark and _axes(names[:width]) else names
            yield ["", *names] if len(names) == unnumbered else names


def _axes(names: list[str]) -> list[int]:
    """Which columns are x, y and z by the names of programs or of surveyors; none if these do not say so."""
    usual = common_names(names)
    if set(POSITION) <= set(usual):
        return [usual.index(axis) for axis in POSITION]
    found = _surveyed(names)
    return [k for (k,) in found] if all(len(some) == 1 for some in found) else []


def _surveyed(names: list[str]) -> list[list[int]]:
    """Which columns may be x, which y, and which z by the names of surveyors."""
    words = [re.split(r"[\s_.-]+", re.sub(r"[\[(].*", "", name.lower())) for name in names]
    plain = ["".join(word for word in some if word not in BESIDE) for some in words]
    return [[k for k, name in enumerate(plain) if name in own] for own in (EASTING, NORTHING, ELEVATION)]


def _unsure(path: Path, name: str) -> StageError:
    """The error of a column of that name: y before x is the easting where surveyors count x to the north."""
    return StageError(
        f"{path}: whether column {name} is the easting or the northing cannot be told; name the columns Easting and"
        " Northing"
    )


def _check_order(path: Path, headers: list[list[str]], columns: int) -> None:
    """StageError where a line names x, y and z in another order, but not so many columns as there are."""
    for names in headers:
        axes = _axes(names)
        if axes and (axes[1] - axes[0], axes[2] - axes[1]) != (1, 1):
            raise StageError(
                f"{path}: '{' '.join(names)[:60]}' names {len(names)} columns, but the rows have {columns}; give each"
                " column one name, without blanks"
            )


def _no_number(cells: list[str]) -> str:
    """What is wrong with the first cell that has digits, but is no number; empty where there is none."""
    cell = next((cell for cell in cells if number(cell) is None and re.search(r"\d", cell)), "")
    return f"{cell[:30]!r} is no number: write it without units, brackets and marks between thousands" if cell else ""


def _unnamed(path: Path, rows: NDArray[np.float64]) -> tuple[dict[str, int], list[str]]:
    """The names of (N, C) columns that no line names -> where they stand, and what a user should know of that."""
    columns, start, notes = {name: k for k, name in enumerate(POSITION[: rows.shape[1]])}, 3, list[str]()
    further_one = rows.shape[1] % 3 == 1 and rows.shape[1] >= (4 if path.suffix.lower() == ".pts" else 7)
    colored = _may_be_colors if further_one else _must_be_colors
    if further_one:
        start, notes = _colors_at(path, rows)
        columns |= {"intensity": 3} if start == 4 else {}
    for first in range(start, rows.shape[1] - 2, 3):
        three = rows[:, first : first + 3]
        lengths = np.linalg.norm(three[np.isfinite(three).all(1)], axis=1)
        unit = (np.abs(lengths - 1) < UNIT_TOLERANCE) | (lengths == 0)  # some programs write 0 0 0 for no normal
        kind = NORMAL if len(lengths) and unit.all() else COLOR
        if kind[0] in columns or (kind == COLOR and not colored(three)):
            break
        columns |= {name: first + k for k, name in enumerate(kind)}
        if kind == COLOR and not notes and path.suffix.lower() != ".pts":
            notes = [_guess(path, first)]
    if further := rows.shape[1] - len(columns):
        notes.append(f"{path.name}: {further} of its columns have no names and are left out")
    return columns, notes


def _must_be_colors(three: NDArray[np.float64]) -> bool:
    """Whether (N, 3) can be nothing but colours: whole numbers that reach alike far."""
    three = three[np.isfinite(three).all(1)]
    tops = three.max(0, initial=0)
    return _may_be_colors(three) and bool(
        (three == np.rint(three)).all() and tops.min() >= MIN_RANGE_RATIO * tops.max()
    )


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
        return first, [_guess(path, first)]
    return rows.shape[1], [
        f"{path.name}: which columns are colours cannot be told, and none are read; name the columns in a first line"
        " (x y z intensity r g b) if this is wrong"
    ]


def _guess(path: Path, first: int) -> str:
    """What a user should know of columns without names that are taken for colours."""
    return (
        f"{path.name}: columns {first + 1} to {first + 3} are taken for red, green and blue; name the columns in a"
        " first line (x y z intensity r g b) if this is wrong"
    )


def _first_row(path: Path, head: list[str]) -> tuple[int, str | None, int, bool]:
    """Where the rows begin among the first lines, what separates their cells, how many these are, and whether a name
    stands before the numbers of all of them.

    Rows begin with the first line of numbers alone, else with the first one of the kind that is the most frequent.

    Raises:
        ValueError: there are none.
        StageError: decimals have commas; the file is a raster, or PTX.
    """
    if RASTER.match("".join(head).lstrip()):
        raise StageError(f"{path} is a raster of heights, not rows of points; export its cells as x y z")
    if [len(line.split()) for line in head[:10]] == [1, 1, 3, 3, 3, 3, 4, 4, 4, 4]:
        raise StageError(f"{path} is PTX, whose scans have poses of their own; convert it to E57 or LAS")
    last = next(line.strip() for line in reversed(head) if line.strip())
    commas = len(re.findall(r"(?<![\d.,])-?\d+,\d+(?![\d.,])", last))
    blanks = [number(cell) for cell in last.replace(",", ".").split()]
    if commas >= 3 or (commas and (";" in last or "\t" in last or (len(blanks) > 2 and None not in blanks[:3]))):
        raise StageError(f"{path} has commas as decimal points: '{last[:60]}'; export it with points")
    kinds: list[tuple[str | None, int, tuple[int, ...]] | None] = []
    for line in head:
        row = COMMENT.split(line)[0]
        mark = separator(row)
        cells = cells_of(row, mark)
        words = tuple(k for k, cell in enumerate(cells) if number(cell) is None)
        some = sum(map(bool, cells)) - len(words) >= 3
        kinds.append((mark, len(cells), words) if some else None)
    found = [kind for kind in kinds if kind is not None]
    if not found:
        said = _no_number(cells_of(last, separator(last)))
        raise ValueError("none of its first lines holds three numbers" + (f", {said}" if said else ""))
    usual = next((kind for kind in found if not kind[2]), max(found, key=found.count))
    # Words in some rows alone may stand in the first ones.
    rows = {usual, *(kind for kind in found if kind[:2] == usual[:2] and found.count(kind) > 1)}
    return next(k for k, kind in enumerate(kinds) if kind in rows), usual[0], usual[1], 0 in usual[2]


def _indices(rows: NDArray[np.float64]) -> int:
    """How many of the first of (N, C) columns number the points: 1, one after the other, or whole numbers, each once,
    before coordinates that are not whole where x, y, z and colours or normals would be a column fewer or more; or 2, as
    in a scanner's grid, where what follows is x, y, z, and colours, whole numbers or an intensity of 0 to 1."""
    first, columns = rows[:, 0], rows.shape[1]
    if columns <= 3 or len(rows) <= 3:
        return 0
    whole = np.asarray((rows == np.rint(rows)).all(0))
    shares = np.asarray(((rows >= 0) & (rows <= 1)).all(0))  # as colours may be, and an intensity
    unit = np.abs(np.linalg.norm(rows[:, 3:6], axis=1) - 1) < UNIT_TOLERANCE
    bright = whole[5:6].all() or (shares[5] and not shares[3:5].all() and not unit.all())
    grid = columns > 4 and whole[:2].all() and not whole[2:5].any()
    if grid and (columns % 3 == 2 or (bright and whole[6:].all())):
        return 2 if rows[:, :2].min() >= 0 and rows[:, :2].max() <= MAX_GRID_ROWS else 0
    if (first == first[0] + np.arange(len(first))).all():
        return 1
    once = len(np.unique(first)) == len(first)
    return int(columns % 3 == 1 and whole[0] and not whole[1:4].any() and once)
