"""The header of a PLY file: where its columns lie, so that parts of them can be read."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from scenefuse.core.stage import StageError

KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
NAMES = dict(zip(KINDS, ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")))
"""What PLY calls NumPy's types."""
TYPES = {name: kind for kind, name in NAMES.items()} | dict(
    zip(("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"), KINDS)
)


@dataclass(frozen=True)
class Element:
    """Rows of one kind in a PLY file.

    Attributes:
        name: vertex, face, ...
        count: of rows.
        row: their NumPy type; None where they hold lists, so that rows differ in length.
    """

    name: str
    count: int
    row: np.dtype[Any] | None


def read_header(path: Path) -> tuple[list[Element], int] | None:
    """The elements of a binary PLY and the byte where their rows begin; None where the file is text or no PLY.

    Raises:
        StageError: the file does not exist.
    """
    return _header(path, {"binary_little_endian": "<", "binary_big_endian": ">"})


def read_text_header(path: Path) -> tuple[list[Element], int] | None:
    """The same of a PLY of text; None where it is binary or no PLY."""
    return _header(path, {"ascii": "="})


def _header(path: Path, orders: dict[str, str]) -> tuple[list[Element], int] | None:
    """The same of the formats that are keys of `orders`, whose values are NumPy's byte orders."""
    if not path.is_file():
        raise StageError(f"{path} does not exist; run the stage that writes it first")
    with open(path, "rb") as file:
        lines = _lines(file)
        if lines[:1] != ["ply"] or lines[-1] != "end_header":
            return None
        order = orders.get((lines[1].split() + ["", ""])[1])
        return None if order is None else (_elements(lines[2:], order), file.tell())


def header_of(elements: list[Element]) -> bytes:
    """The header of a little-endian PLY with these elements."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for element in elements:
        lines.append(f"element {element.name} {element.count}")
        assert element.row is not None and element.row.names is not None
        lines += [f"property {NAMES[element.row[name].str[1:]]} {name}" for name in element.row.names]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _lines(file: BinaryIO, most: int = 1000) -> list[str]:
    """The header's lines; fewer where the file is something else."""
    lines: list[str] = []
    while len(lines) < most and (not lines or lines[-1] != "end_header"):
        line = file.readline(1000)
        lines.append(line.decode("ascii", "replace").strip())
        if not line or lines[0] != "ply":
            break
    return lines


def _elements(lines: list[str], order: str) -> list[Element]:
    found: list[tuple[str, int, list[tuple[str, str]] | None]] = []
    for words in (line.split() for line in lines):
        if words[:1] == ["element"]:
            found.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            name, count, columns = found[-1]
            if columns is None or words[1] not in TYPES:
                found[-1] = name, count, None
            else:
                columns.append((words[2], order + TYPES[words[1]]))
    return [Element(name, count, None if columns is None else np.dtype(columns)) for name, count, columns in found]
