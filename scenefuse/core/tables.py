"""Tables of a user: tab-separated text from an editor or a spreadsheet. Standard library only."""

import codecs
import csv
import io
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from scenefuse.core.stage import StageError

Row = dict[str, str]
# What a spreadsheet writes where a comma separates decimals.
DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+")


def read_table(path: Path, key: str) -> dict[str, Row]:
    """Rows of a tab-separated table by the column `key`; every cell is text, an empty one is ''.

    Lines that begin with #, empty rows and columns, and a spreadsheet's quotes and blanks are left out. A cell that
    begins with ~/ is a path in the user's home folder.

    Raises:
        StageError: the file is missing or not text, has no such column or a column twice, a row has too few or too many
            cells, or two rows have the same key.
    """
    lines = [line for line in io.StringIO(read_text(path), newline=None) if not is_comment(line)]
    written = [[cell.strip() for cell in row] for row in _split(lines, path)]
    header, *cells = [row for row in written if any(row)] or [[]]
    header = _cells(header)
    if key not in header:
        tabs = "; separate columns by tabs" if len(header) == 1 and re.search("[;, ]", header[0]) else ""
        raise StageError(f"{path} has no column '{key}'; its first line names: {', '.join(header) or 'nothing'}{tabs}")
    twice = next((name for name in header if header.count(name) > 1), None)
    if twice is not None:
        raise StageError(f"{path} has two columns '{twice}'; remove one")
    rows: dict[str, Row] = {}
    for number, row in enumerate(cells, 1):
        # Cells at the end may be empty, or cut off; a row of one cell is one that spaces separate.
        row = row[: len(header)] if not any(row[len(header) :]) else row
        row += [""] * (len(header) - len(row) if len(row) > 1 else 0)
        if len(row) != len(header):
            raise StageError(
                f"{path}, row {number}: {len(row)} columns, and the header has {len(header)}; separate them by tabs"
            )
        content = {n: str(Path(c).expanduser()) if c.startswith("~/") else c for n, c in zip(header, row)}
        if content[key] in rows:
            raise StageError(f"{path}: '{content[key]}' stands in two rows; names must differ")
        rows[content[key]] = content
    return rows


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Lines of a text file with their numbers from 1, without those that are empty or begin with #.

    Raises:
        StageError: the file is missing, or is not text.
    """
    lines = enumerate(read_text(path).splitlines(), 1)
    return [(number, line) for number, line in lines if line.strip() and not is_comment(line)]


def read_cells(path: Path) -> list[tuple[int, list[str]]]:
    """The cells of each line of a tab-separated file, with its number from 1, as `read_lines` has them: without blanks
    around them, a spreadsheet's quotes, and empty cells at the end.

    Raises:
        StageError: the file is missing, or is not text.
    """
    rows = ((number, _cells(next(_split([line], path)))) for number, line in read_lines(path))
    return [(number, cells) for number, cells in rows if cells]


def _split(lines: Iterable[str], path: Path) -> Iterator[list[str]]:
    """The rows of tab-separated lines; StageError where a cell begins with a quote that takes others into it."""
    for row in csv.reader(lines, delimiter="\t"):
        broken = next((cell for cell in row if re.search("[\t\n]", cell)), None)
        if broken is not None:
            raise StageError(
                f"{path}: the quote before {' '.join(broken.split())[:30]} takes several cells into one; remove it"
            )
        yield row


def is_comment(line: str) -> bool:
    """Whether a line begins with #, perhaps in a spreadsheet's quotes."""
    return line.lstrip('"').startswith("#")


def _cells(row: list[str]) -> list[str]:
    """The cells of a row without blanks around them, and without empty ones at the end."""
    cells = [cell.strip() for cell in row]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def comma_advice(cells: list[str]) -> str:
    """Advice for an error about cells that should be numbers, where one has a decimal comma; else ""."""
    odd = next((cell for cell in cells if DECIMAL_COMMA.fullmatch(cell)), None)
    return f"; {odd} has a decimal comma, write {odd.replace(',', '.')}" if odd else ""


def read_text(path: Path) -> str:
    """A text file in UTF-8, or in UTF-16 with a byte order mark, as spreadsheets write it.

    Raises:
        StageError: the file is missing, or has another encoding.
    """
    try:
        content = Path(path).read_bytes()
    except OSError:
        raise StageError(f"{path} does not exist or cannot be read; write it, or correct its path") from None
    marked = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    # DOS ends text with ^Z.
    content = content if marked else content.rstrip(b"\x1a")
    if content.startswith((b"PK\3\4", b"\xd0\xcf\x11\xe0")):
        raise StageError(f"{path} is a spreadsheet or an archive, whatever its name; save it as tab-separated text")
    if b"\0" in content and not marked:
        # Every second byte of ASCII in UTF-16 is zero.
        if (b"\0" in content[::2]) == (b"\0" in content[1::2]):
            raise StageError(f"{path} is no text, it holds binary data; give a text file")
        raise StageError(f"{path} is not UTF-8 text (it looks like UTF-16); save the file as UTF-8")
    try:
        return content.decode("utf-16" if marked else "utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise StageError(f"{path}, line {line}: not {'UTF-16' if marked else 'UTF-8'} text; save it as UTF-8") from None
