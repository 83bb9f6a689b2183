"""PCD 0.5 to 0.7, the format of PCL: ASCII, binary and compressed.

Open3D misreads positions that are binary doubles, without a word.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import Columns, check_count, next_rows, rows_behind, typed


@dataclass(frozen=True)
class _Header:
    """What a file says of its rows.

    Attributes:
        row: its fields by their names and types, each of one number or several.
        count: of rows.
        data: ascii, binary or binary_compressed.
        begin: the byte where the rows begin.
        lines: of the header.
    """

    row: np.dtype[Any]
    count: int
    data: str
    begin: int
    lines: int


def read_pcd(path: Path, at_once: int) -> Iterator[Columns]:
    """The columns of a PCD file that hold one number a row, so many rows at a time; compressed ones are held whole.

    Raises:
        StageError: the file is cut short, or holds more points than its header counts.
        ValueError: it is no PCD, or damaged.
    """
    header = _header(path)
    read = {"ascii": _lines, "binary": _rows, "binary_compressed": _compressed}.get(header.data)
    if read is None:
        raise ValueError(f"its DATA is '{header.data}'")
    count = 0
    for fields in read(path, header, at_once):
        count += len(fields[0])
        yield {
            name: values[:, 0]
            for name, values in zip(header.row.names or (), fields)
            if values.shape[1] == 1 and not name.startswith(" ")
        }
    check_count(path, header.count, count)


def _header(path: Path) -> _Header:
    words: dict[str, list[str]] = {}
    lines = 0
    with open(path, "rb") as file:
        while "DATA" not in words:
            line = file.readline()
            lines += 1
            cells = line.decode("latin-1").split()
            words |= {cells[0].upper(): cells[1:]} if cells else {}
            if not line:
                raise ValueError("it has no PCD header")
        begin = file.tell()
    names = words.get("FIELDS", words.get("COLUMNS", []))  # as version 0.5 calls them
    names = [f" {k}" if name == "_" else name for k, name in enumerate(names)]  # padding, often several times
    repeats = [int(n) for n in words.get("COUNT", ["1"] * len(names))]
    types = [np.dtype(f"<{kind.lower()}{size}") for kind, size in zip(words.get("TYPE", []), words.get("SIZE", []))]
    width, height = words.get("WIDTH", words.get("POINTS", ["0"])), words.get("HEIGHT", ["1"])
    count, data = int(width[0]) * int(height[0]), words["DATA"][0].lower()
    size = sum(kind.itemsize * n for kind, n in zip(types, repeats))
    if len({len(names), len(repeats), len(types)}) > 1 or count < 0 or size <= 0 or min(repeats) < 0:
        raise ValueError("its header does not say what its rows hold")
    there, odd = divmod(path.stat().st_size - begin, size)
    if data == "binary" and (there < count or not odd):
        check_count(path, count, there)
    return _Header(np.dtype([(n, kind, (k,)) for n, kind, k in zip(names, types, repeats)]), count, data, begin, lines)


def _lines(path: Path, header: _Header, at_once: int) -> Iterator[list[NDArray[Any]]]:
    """The fields (N, n) each of rows of text."""
    left, line = header.count, header.lines + 1
    kinds = [kind.subdtype or (kind, (1,)) for kind, *_ in (header.row.fields or {}).values()]
    ends = np.cumsum([0, *(shape[0] for _, shape in kinds)])
    with open(path, "rb") as file:
        file.seek(header.begin)
        while left:
            rows, line = next_rows(file, min(at_once, left), ends[-1], (str(path), line))
            if not len(rows):
                return
            left -= len(rows)
            yield [typed(rows[:, at : at + n], kind) for at, (kind, (n,)) in zip(ends, kinds)]
        check_count(path, header.count, header.count + rows_behind(file, ends[-1]))


def _rows(path: Path, header: _Header, at_once: int) -> Iterator[list[NDArray[Any]]]:
    """The same of binary rows."""
    left = header.count
    with open(path, "rb") as file:
        file.seek(header.begin)
        while left:
            rows = np.fromfile(file, header.row, min(at_once, left))
            if not len(rows):
                return
            left -= len(rows)
            yield [np.ascontiguousarray(rows[name]) for name in header.row.names or ()]


def _compressed(path: Path, header: _Header, at_once: int) -> Iterator[list[NDArray[Any]]]:
    """The same of compressed columns, one after the other."""
    with open(path, "rb") as file:
        file.seek(header.begin)
        packed, size = (int(number) for number in np.fromfile(file, "<u4", 2))
        content = file.read()[:packed]
    check_count(path, packed, len(content), "bytes")
    # A copy of 264 bytes takes three.
    if size > 88 * packed or size != header.count * header.row.itemsize:
        raise ValueError("its compressed part is not as long as its header says")
    raw, fields, at = _lzf(content, size), [], 0
    for kind, *_ in (header.row.fields or {}).values():
        fields.append(np.ndarray(header.count, kind, raw, at))
        at += kind.itemsize * header.count
    for first in range(0, header.count, at_once):
        yield [values[first : first + at_once] for values in fields]


def _lzf(packed: bytes, size: int) -> bytearray:
    """Undo LZF, the compression of PCD: runs of literal bytes, and copies of bytes that came before."""
    found, at = bytearray(), 0
    while at < len(packed) and len(found) <= size:
        control = packed[at]
        at += 1
        if control < 32:
            found += packed[at : at + control + 1]
            at += control + 1
            continue
        length = (control >> 5) + 2
        if length == 9:
            length += packed[at]
            at += 1
        start = len(found) - ((control & 31) << 8) - packed[at] - 1
        at += 1
        before = found[max(start, 0) : start + length]
        found += (before * (length // max(len(before), 1) + 1))[:length]  # a copy may reach into itself
        if start < 0:
            break
    if len(found) != size:
        raise ValueError("its compressed part is damaged")
    return found
