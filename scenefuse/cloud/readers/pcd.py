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
from scenefuse.core.stage import StageError


@dataclass(frozen=True)
class _Header:
    """What a file says of its rows.

    Attributes:
        names: of the fields.
        types: of each field's numbers.
        repeats: how many numbers each field has.
        count: of rows.
        data: ascii, binary or binary_compressed.
        begin: the byte where the rows begin.
        lines: of the header.
    """

    names: list[str]
    types: list[np.dtype[Any]]
    repeats: list[int]
    count: int
    data: str
    begin: int
    lines: int


def read_pcd(path: Path, at_once: int) -> Iterator[Columns]:
    """The columns of a PCD file, so many rows at a time; compressed ones are held whole.

    Raises:
        StageError: the file is cut short.
        ValueError: it is no PCD, or damaged.
    """
    header = _header(path)
    read = {"ascii": _lines, "binary": _rows, "binary_compressed": _compressed}.get(header.data)
    if read is None:
        raise ValueError(f"its DATA is '{header.data}'")
    count = 0
    for arrays in read(path, header, at_once):
        count += len(arrays[0])
        yield _columns(header, arrays)
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
    return _Header(names, types, repeats, count, data, begin, lines)


def _lines(path: Path, header: _Header, at_once: int) -> Iterator[list[NDArray[Any]]]:
    """The fields (N, n) each of rows of text."""
    left, line, ends = header.count, header.lines + 1, np.cumsum([0, *header.repeats])
    with open(path, "rb") as file:
        file.seek(header.begin)
        while left:
            rows, line = next_rows(file, min(at_once, left), ends[-1], (str(path), line))
            if not len(rows):
                return
            left -= len(rows)
            yield [typed(rows[:, at : at + n], kind) for at, n, kind in zip(ends, header.repeats, header.types)]
        check_count(path, header.count, header.count + rows_behind(file, ends[-1]))


def _rows(path: Path, header: _Header, at_once: int) -> Iterator[list[NDArray[Any]]]:
    """The same of binary rows."""
    fields = [(str(k), kind, (n,)) for k, (kind, n) in enumerate(zip(header.types, header.repeats))]
    row, left = np.dtype(fields), header.count
    with open(path, "rb") as file:
        file.seek(header.begin)
        while left:
            rows = np.fromfile(file, row, min(at_once, left))
            if not len(rows):
                return
            left -= len(rows)
            yield [np.ascontiguousarray(rows[name]) for name, *_ in fields]


def _compressed(path: Path, header: _Header, at_once: int) -> Iterator[list[NDArray[Any]]]:
    """The same of compressed columns, one after the other."""
    with open(path, "rb") as file:
        file.seek(header.begin)
        packed, size = (int(number) for number in np.fromfile(file, "<u4", 2))
        content = file.read()[:packed]
    if len(content) < packed:
        raise StageError(f"{path} is cut short: {packed - len(content)} bytes are missing; copy it again")
    # A copy of 264 bytes takes three.
    if size > 88 * packed or size != header.count * sum(k.itemsize * n for k, n in zip(header.types, header.repeats)):
        raise ValueError("its compressed part is not as long as its header says")
    raw = _lzf(content, size)
    sizes = [kind.itemsize * n * header.count for kind, n in zip(header.types, header.repeats)]
    arrays = [
        np.frombuffer(raw, kind, header.count * n, at).reshape(header.count, n)
        for kind, n, at in zip(header.types, header.repeats, np.cumsum([0, *sizes]))
    ]
    for first in range(0, header.count, at_once):
        yield [array[first : first + at_once] for array in arrays]


def _columns(header: _Header, arrays: list[NDArray[Any]]) -> Columns:
    """Fields of one number by their names; padding is left out."""
    return {name: array[:, 0] for name, array, n in zip(header.names, arrays, header.repeats) if n == 1 and name != "_"}


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
