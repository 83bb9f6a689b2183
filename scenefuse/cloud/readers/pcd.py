"""PCD 0.7, the format of PCL: ASCII, binary and compressed.

Open3D misreads positions that are binary doubles, without a word.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import COLOR, Columns
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
    """

    names: list[str]
    types: list[np.dtype[Any]]
    repeats: list[int]
    count: int
    data: str
    begin: int


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
    if count < header.count:
        raise StageError(f"{path} is cut short: its last {header.count - count} points are missing; copy it again")


def _header(path: Path) -> _Header:
    words: dict[str, list[str]] = {}
    with open(path, "rb") as file:
        while "DATA" not in words:
            line = file.readline()
            cells = line.decode("ascii").split()
            words |= {cells[0]: cells[1:]} if cells else {}
            if not line:
                raise ValueError("it has no PCD header")
        begin = file.tell()
    names = words["FIELDS"]
    repeats = [int(n) for n in words.get("COUNT", ["1"] * len(names))]
    types = [np.dtype(f"<{kind.lower()}{size}") for kind, size in zip(words["TYPE"], words["SIZE"])]
    count = int(words["WIDTH"][0]) * int(words["HEIGHT"][0])
    return _Header(names, types, repeats, count, words["DATA"][0], begin)


def _lines(path: Path, header: _Header, at_once: int) -> Iterator[list[NDArray[Any]]]:
    """The fields (N, n) each of rows of text."""
    cuts = np.cumsum(header.repeats)[:-1]
    with open(path, encoding="ascii") as file:
        file.seek(header.begin)
        left = header.count
        while lines := list(islice(file, min(at_once, left))):
            left -= len(lines)
            rows = np.loadtxt(lines, ndmin=2)
            yield [part.astype(kind) for part, kind in zip(np.split(rows, cuts, axis=1), header.types)]


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
        packed, size = np.fromfile(file, "<u4", 2)
        raw = _lzf(np.fromfile(file, np.uint8, packed), size).tobytes()
    sizes = [kind.itemsize * n * header.count for kind, n in zip(header.types, header.repeats)]
    arrays = [
        np.frombuffer(raw, kind, header.count * n, at).reshape(header.count, n)
        for kind, n, at in zip(header.types, header.repeats, np.cumsum([0, *sizes]))
    ]
    for first in range(0, header.count, at_once):
        yield [array[first : first + at_once] for array in arrays]


def _columns(header: _Header, arrays: list[NDArray[Any]]) -> Columns:
    """Fields of one number by their names, packed colours as three; padding is left out."""
    columns = {
        name: array[:, 0] for name, array, n in zip(header.names, arrays, header.repeats) if n == 1 and name != "_"
    }
    for name in {"rgb", "rgba"} & set(columns):
        kind = header.types[header.names.index(name)]
        bits = np.ascontiguousarray(columns.pop(name).astype(kind)).view(np.uint32)
        columns |= {color: (bits >> shift & 255).astype(np.uint8) for color, shift in zip(COLOR, (16, 8, 0))}
    return columns


def _lzf(packed: NDArray[np.uint8], size: int) -> NDArray[np.uint8]:
    """Undo LZF, the compression of PCD: runs of literal bytes, and copies of bytes that came before."""
    from numba import njit

    @njit
    def unpack(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> int:
        at, end = 0, 0
        while at < len(source):
            control = int(source[at])
            at += 1
            if control < 32:
                length, start = control + 1, -1
            else:
                length = (control >> 5) + 2
                if length == 9:
                    length += int(source[at])
                    at += 1
                start = end - ((control & 31) << 8) - int(source[at]) - 1
                at += 1
                if start < 0:
                    return -1
            if end + length > len(target) or (start < 0 and at + length > len(source)):
                return -1
            for k in range(length):
                target[end + k] = source[at + k] if start < 0 else target[start + k]
            end += length
            at += length if start < 0 else 0
        return end

    target = np.zeros(size, np.uint8)
    if unpack(packed, target) != size:
        raise ValueError("its compressed part is damaged")
    return target
