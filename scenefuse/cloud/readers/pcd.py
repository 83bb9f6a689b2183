"""PCD 0.5 to 0.7, the format of PCL: ASCII, binary and compressed.

Open3D misreads positions that are binary doubles, without a word.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.cloud.readers.columns import Columns, check_count, stored_rows


def read_pcd(path: Path, at_once: int) -> Iterator[Columns]:
    """The columns of a PCD file that hold one number a row, so many rows at a time; compressed ones are held whole.

    Raises:
        StageError: the file is cut short, or holds more points than its header counts.
        ValueError: it is no PCD, or damaged.
    """
    data, begin, row, count = _header(path)
    if data == "binary_compressed":
        parts = _compressed(path, begin, row, count, at_once)
    elif data in ("ascii", "binary"):
        parts = stored_rows(path, begin, row, count, at_once, data == "ascii")
    else:
        raise ValueError(f"its DATA is '{data}'")
    for fields in parts:
        yield {name: values for name, values in fields.items() if values.ndim == 1 and not name.startswith(" ")}


def _header(path: Path) -> tuple[str, int, np.dtype[Any], int]:
    """How rows are stored (ascii, binary or binary_compressed), the byte where they begin, their fields by names and
    types, each of one number or several, and how many they are."""
    words: dict[str, list[str]] = {}
    with open(path, "rb") as file:
        while "DATA" not in words:
            line = file.readline()
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
    row = np.dtype([(name, kind, (k,) if k != 1 else ()) for name, kind, k in zip(names, types, repeats)])
    return data, begin, row, count


def _compressed(path: Path, begin: int, row: np.dtype[Any], count: int, at_once: int) -> Iterator[Columns]:
    """The fields of compressed columns, one after the other."""
    with open(path, "rb") as file:
        file.seek(begin)
        packed, size = (int(number) for number in np.fromfile(file, "<u4", 2))
        content = file.read()[:packed]
    check_count(path, packed, len(content), "bytes")
    # A copy of 264 bytes takes three.
    if size > 88 * packed or size != count * row.itemsize:
        raise ValueError("its compressed part is not as long as its header says")
    raw, fields, at = _lzf(content, size), Columns(), 0
    for name in row.names or ():
        fields[name] = np.ndarray(count, row[name], raw, at)
        at += row[name].itemsize * count
    for first in range(0, count, at_once):
        yield {name: values[first : first + at_once] for name, values in fields.items()}


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
