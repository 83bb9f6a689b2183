"""Columns of a cloud's file: names, whatever the file calls them; the range of colours; rows of numbers in text.

Well-formed rows go through pandas' C parser. Others are split one by one: cells may be quoted, empty, or spell a
missing number in any way. A row without numbers becomes a row of NaN, which the caller leaves out and counts.
"""

import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError

Columns = dict[str, NDArray[Any]]

# Rows of a file, or points of a cloud, that are in memory together when all of it is gone through.
AT_ONCE = 1 << 20
# Normals may be this far from unit length; other ones say nothing of the surface.
UNIT_TOLERANCE = 0.05
# A larger share of points or colours is no exception: colours that overshoot their range, strays, points in one place.
MAX_ODD_SHARE = 0.1
POSITION, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
# What other programs call colours, in lower case, in the languages of their users.
COLOR_NAMES = (
    {"r", "red", "rf", "rot", "rouge", "rojo", "rosso", "vermelho", "rood", "czerwony", "rod", "röd", "rød"},
    {"g", "green", "gf", "grün", "grun", "gruen", "vert", "verde", "groen", "zielony", "gron", "grön", "grønn"},
    {"b", "blue", "bf", "blau", "bleu", "azul", "blu", "blauw", "niebieski", "bla", "blå"},
)
# What they call positions and normals; ParaView numbers them, and colours.
OTHER_NAMES = {name: name for name in (*POSITION, *NORMAL)} | {
    f"{word}{k}": name
    for words, names in ((("points",), POSITION), (("normals", "normal"), NORMAL), (("rgb", "rgba"), COLOR))
    for axis, name in enumerate(names)
    for word in words
    for k in (axis, "xyz"[axis])
}
# What may stand before or behind the name of a column: whose colour it is, a unit, a range.
AROUND = re.compile(r"^(diffuse|colou?r|rgba?+|scalar|vertex|farbe|couleur)(?=\D)|[\[(].*$")
# What PCL calls colours whose bytes are those of one number, whatever its type.
PACKED = ("rgb", "rgba")
# Around the number in a cell: quotes, blanks, and a byte order mark, whole or read as three letters.
STRIPPED = " \t\"'\ufeff\u00ef\u00bb\u00bf"
# A comment behind numbers; spreadsheets write #N/A.
COMMENT = re.compile(r"(?:^|\s)\s*#(?!N/A)")
# Rows that are parsed together, and that say what the columns are: one strange row makes all be split one by one.
TOGETHER = 1 << 14


def common_names(names: Sequence[str]) -> list[str]:
    """The names that PLY uses for columns; their own where they are none of position, normal and colour."""
    plain = [AROUND.sub("", re.sub(r"[\s._:-]+", "", name.lower())) for name in names]
    usual = [OTHER_NAMES.get(short, name) for short, name in zip(plain, names)]
    colored = [[k for k, short in enumerate(plain) if short in called] for called in COLOR_NAMES]
    if all(colored):
        for axis, (first, *_) in zip(COLOR, colored):
            usual[first] = axis
    # The first of two is meant: further ones, as of coordinates before they were moved, keep their own names.
    return [own if name in usual[:k] else name for k, (name, own) in enumerate(zip(usual, names))]


def named(columns: Columns) -> Columns:
    """Columns by their common names; packed colours, and those of Gaussian splats (spherical harmonics, degree 0), as
    red, green and blue."""
    found = dict(zip(common_names(list(columns)), columns.values()))
    if set(COLOR) & set(found):
        return found
    if {"f_dc_0", "f_dc_1", "f_dc_2"} <= set(found):
        shares = [0.5 + found[f"f_dc_{k}"] / np.sqrt(4 * np.pi) for k in range(3)]
        return found | {
            name: np.rint(255 * np.nan_to_num(share).clip(0, 1)).astype(np.uint8) for name, share in zip(COLOR, shares)
        }
    name = next((name for name in found if name.lower() in PACKED), "")
    bits = _bits(found[name]) if name else None
    if bits is not None:
        del found[name]
        found |= {color: (bits >> shift & 255).astype(np.uint8) for color, shift in zip(COLOR, (16, 8, 0))}
    return found


def _bits(values: NDArray[Any]) -> NDArray[Any] | None:
    """Packed colours (N,) as integers: the numbers, or the bits of real ones; None where these are shares."""
    if values.dtype.kind != "f":
        return values.astype(np.int64)
    largest = np.abs(np.nan_to_num(values)).max(initial=0)
    if 1 <= largest < 2**32:  # the integer itself, not the real number of its bits
        return np.nan_to_num(values).astype(np.int64)
    # Bits without opacity are the smallest of real numbers.
    return None if 1e-30 < largest < 1 else values.astype(np.float32).view(np.uint32)


def check_count(path: Path, counted: int, there: int, what: str = "points", advice: str = "copy it again") -> None:
    """StageError where a file holds other than the points, or rows of another kind, that its header counts."""
    if there < counted:
        raise StageError(f"{path} is cut short: its last {counted - there} {what} are missing; {advice}")
    if there > counted:
        raise StageError(
            f"{path} holds more {what} than the {counted} that its header counts; export it again, or correct that"
        )


def positions(columns: Columns) -> NDArray[np.float64]:
    """(N, 3) positions."""
    return np.stack([columns[axis].astype(np.float64) for axis in POSITION], axis=1)


def joined(parts: Iterable[Columns]) -> Columns:
    """All parts of a file one after the other."""
    found = list(parts)
    if not found:
        return {name: np.empty(0) for name in POSITION}
    return found[0] if len(found) == 1 else {name: np.concatenate([part[name] for part in found]) for name in found[0]}


def colors_of(columns: Columns) -> NDArray[Any] | None:
    """(N, 3) colours, if there are any."""
    return np.stack([columns[name] for name in COLOR], axis=1) if set(COLOR) <= set(columns) else None


def color_counts(colors: NDArray[Any]) -> NDArray[np.int64]:
    """(3,) how many numbers of colours are above 0, above 1 and above 255."""
    return np.array([np.count_nonzero(colors > least) for least in (0, 1, 255)])


def white_of(kind: np.dtype[Any], counts: NDArray[np.int64]) -> float:
    """The number that stands for white: 1 or 255 in real numbers, 255 in bytes, 255 or 65535 in longer integers.

    Args:
        kind: type of the colours.
        counts: (3,) of the whole file, by `color_counts`. Few numbers above a range overshoot it, and are clipped.
    """
    few = MAX_ODD_SHARE * counts[0]
    if kind == np.uint8:
        return 255.0
    if counts[1] <= few and kind.kind == "f":
        return 1.0
    return 255.0 if counts[2] <= few else 65535.0


def bytes_of(colors: NDArray[Any], white: float | None = None) -> NDArray[np.uint8]:
    """Colours (N, 3) as 0..255, from those whose white is that number; None where these are all of a file."""
    if colors.dtype == np.uint8:
        return colors
    white = white or white_of(colors.dtype, color_counts(colors))
    return np.clip(np.rint(np.nan_to_num(colors.astype(np.float64)) * (255 / white)), 0, 255).astype(np.uint8)


def separator(line: str) -> str | None:
    """What separates the cells of a row; None for blanks. A tab does where no blanks separate numbers as well."""
    mark = next((mark for mark in ";,|" if mark in line), None)
    if mark or "\t" not in line.strip():
        return mark
    numbers = [sum(number(word) is not None for word in cell.split()) for cell in line.split("\t")]
    return None if max(numbers) > 1 else "\t"


def cells_of(line: str, mark: str | None) -> list[str]:
    """The cells of a row, without quotes and the blanks around them."""
    line = line.strip(" \r\n\0" if mark == "\t" else None)
    if '"' in line and line.count('"') % 2 == 0:
        plain = line if mark else line.replace("\t", " ")
        cells = next(csv.reader([plain], delimiter=mark or " ", skipinitialspace=True), [])
    else:
        cells = line.split(mark)
    return [cell.strip(STRIPPED) for cell in cells]


def number(cell: str) -> float | None:
    """The number in a cell, NaN if it is empty or says that there is none; None for a word."""
    for spelled in (cell, cell.lower().replace("d", "e")):  # 1.5D+02 is Fortran's way
        try:
            return float(spelled)
        except ValueError:
            pass
    plain = cell.lower().strip("+-<>()[]#*.")
    missing = plain in ("", "null", "na", "n/a", "none", "nil", "missing") or plain.startswith(("nan", "1.#"))
    return np.nan if missing else None


def number_rows(
    lines: Sequence[bytes], mark: str | None, width: int, wanted: Sequence[int], needed: int, where: tuple[str, int],
    comments: bool = True,
) -> NDArray[np.float64]:  # fmt: skip
    """The numbers (N, C) in some columns of rows; blank lines and comments are skipped.

    Args:
        lines: of the file.
        mark: separates the cells; None for blanks.
        width: cells of a row.
        wanted: (C,) columns; other cells may hold anything.
        needed: cells of a row at least, where a separator says which are missing.
        where: the file, and the number of its first line here, for an error.
        comments: whether # begins a comment, at the begin of a row or behind a blank.

    Raises:
        StageError: a row has numbers, but another count of cells; the file ends within a row.
    """
    found = [np.empty((0, len(wanted)))]
    for first in range(0, len(lines), TOGETHER):
        some = lines[first : first + TOGETHER]
        rows = _together(some, mark, width, wanted, comments)
        if rows is None:
            place = where[0], where[1] + first
            rows = _one_by_one(some, mark, width, wanted, needed, place, comments)
        found.append(rows)
    return np.concatenate(found)


def stored_rows(
    path: Path, begin: int, row: np.dtype[Any], count: int, at_once: int, is_text: bool, last: bool = True
) -> Iterator[Columns]:
    """The fields of so many rows that begin at a byte of a file, so many rows at a time: (N,), or (N, n) of several
    numbers each.

    Args:
        path: of the file.
        begin: the byte.
        row: the fields, in the file's byte order.
        count: of rows, as the header has it.
        at_once: rows.
        is_text: whether they are lines of numbers.
        last: whether nothing stands behind them.

    Raises:
        StageError: there are fewer rows, or more lines.
    """
    with open(path, "rb") as file:
        left, line = count, 1 + file.read(begin).count(b"\n")
        while left:
            most = min(left, at_once)
            if is_text:
                found, line = text_rows(path, file, row, most, line)
            else:
                rows = np.fromfile(file, row, most)
                found = {name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in row.names or ()}
            there = len(next(iter(found.values())))
            if not there:
                check_count(path, count, count - left)
            left -= there
            yield found
        if is_text and last:
            width = len(_numbers_of(row))
            check_count(path, count, count + sum(len(line.split()) == width for line in file))


def text_rows(path: Path, lines: Iterator[bytes], row: np.dtype[Any], most: int, first: int) -> tuple[Columns, int]:
    """The fields of the next rows of a text, so many at most, and the number of the line behind them; of `first`, the
    next one. Single precision has the digits of the text; missing integers are 0, and large ones the largest."""
    numbers, line = _numbers_of(row), first
    found = [np.empty((0, len(numbers)))]
    while (missing := most - sum(map(len, found))) and (some := list(islice(lines, missing))):
        found.append(number_rows(some, None, len(numbers), range(len(numbers)), len(numbers), (str(path), line)))
        line += len(some)
    rows, columns = np.concatenate(found), Columns()
    for name in row.names or ():
        at = [k for k, own in enumerate(numbers) if own == name]
        columns[name] = typed(rows[:, at] if row[name].shape else rows[:, at[0]], row[name].base)
    return columns, line


def typed(values: NDArray[np.float64], kind: np.dtype[Any]) -> NDArray[Any]:
    """Numbers of text as integers of a type, a missing one as 0, a large one as the largest; real ones stay."""
    if kind.kind == "f":
        return values
    ends = np.iinfo(kind)
    return np.clip(np.rint(np.nan_to_num(values)), ends.min, ends.max).astype(kind)


def _numbers_of(row: np.dtype[Any]) -> list[str]:
    """The field of each number of a row."""
    return [name for name in row.names or () for _ in range(int(np.prod(row[name].shape)))]


def _together(
    lines: Sequence[bytes], mark: str | None, width: int, wanted: Sequence[int], comments: bool
) -> NDArray[np.float64] | None:
    """The same of well-formed rows; None where there are others."""
    import pandas as pd

    blob = b"".join(lines).replace(b'"', b"")
    if (comments and b"#" in blob) or (_cell_counts(blob, mark) != width).any():
        lines = [line for line in lines if line.strip() and not (comments and COMMENT.match(line.decode("latin-1")))]
        blob = b"".join(lines).replace(b'"', b"")
        if not lines or b"#" in blob or (_cell_counts(blob, mark) != width).any():
            return None if lines else np.empty((0, len(wanted)))
    try:
        table = pd.read_csv(
            io.BytesIO(blob), sep=mark or r"\s+", header=None, names=range(width), usecols=sorted(set(wanted)),
            index_col=False, dtype=np.float64, quoting=csv.QUOTE_NONE,
            encoding="latin-1", skip_blank_lines=False,
        )  # fmt: skip
    except (ValueError, OverflowError):
        return None
    return table[list(wanted)].to_numpy() if len(table) == len(lines) else None


def _cell_counts(blob: bytes, mark: str | None) -> NDArray[np.int64]:
    """(N,) cells of each line."""
    text = np.frombuffer(blob, np.uint8)
    if mark is None:
        blank = text <= ord(" ")
        begins = np.flatnonzero(~blank & np.concatenate([[True], blank[:-1]]))
    else:
        begins = np.flatnonzero(text == ord(mark))
    ends = np.flatnonzero(text == ord("\n"))
    if not blob.endswith(b"\n"):
        ends = np.append(ends, len(text))
    return np.diff(np.searchsorted(begins, ends), prepend=0) + (mark is not None)


def _one_by_one(
    lines: Sequence[bytes], mark: str | None, width: int, wanted: Sequence[int], needed: int, where: tuple[str, int],
    comments: bool,
) -> NDArray[np.float64]:  # fmt: skip
    """The same, cell by cell."""
    found: list[list[float]] = []
    for at, line in enumerate(lines, where[1]):
        text = line.decode("latin-1").rstrip("\x1a")  # which ends a text of DOS
        text = COMMENT.split(text)[0] if comments else text
        if not text.strip():
            continue
        cells = cells_of(text, mark)
        numbers = [number(cell) for cell in cells]
        if len(cells) != width and not any(cells[width:]) and mark and len(cells) >= needed:
            numbers += [np.nan] * (width - len(cells))  # spreadsheets leave empty cells at the end out, or add some
        elif len(cells) != width:
            known = sum(value is not None and not np.isnan(value) for value in numbers)
            if len(cells) < width and not line.endswith(b"\n"):
                raise StageError(f"{where[0]} is cut short: it ends within a row, line {at}; copy it again")
            if known >= 3 or (known and None not in numbers):
                raise StageError(
                    f"{where[0]}, line {at}, has {len(cells)} columns, the first row {width}: '{text.strip()[:60]}';"
                    " correct that line, or export the cloud again"
                )
            numbers = [np.nan] * width
        found.append([np.nan if (value := numbers[column]) is None else value for column in wanted])
    return np.array(found).reshape(-1, len(wanted))
