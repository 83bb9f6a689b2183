"""PLY: the header, which says where the columns lie, so that parts of them can be read; meshes and lists by plyfile."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import COLOR, POSITION, Columns, bytes_of, common_name, positions
from scenefuse.cloud.readers.meshes import Mesh, sampled_columns, triangles
from scenefuse.core.stage import StageError

KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
# What PLY calls NumPy's types.
NAMES = dict(zip(KINDS, ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")))
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


def in_rows(path: Path) -> bool:
    """Whether the points of a PLY come first, without lists, and are no corners of faces."""
    elements = (read_header(path) or read_text_header(path) or ([], 0))[0]
    mesh = any(element.name == "face" and element.count for element in elements)
    return bool(elements) and elements[0].name == "vertex" and elements[0].row is not None and not mesh


def read_ply(path: Path, at_once: int) -> Iterator[Columns]:
    """Points, so many rows at a time; where there are faces, points drawn from them, all at once."""
    if in_rows(path):
        yield from _rows(path, at_once)
        return
    from plyfile import PlyData

    content = PlyData.read(path)
    vertex = content["vertex"].data
    columns = {name: np.array(vertex[name]) for name in vertex.dtype.names if vertex.dtype[name].kind in "iuf"}
    if "face" not in content or not len(content["face"].data):
        yield columns
        return
    face = content["face"].data
    corners = next((name for name in ("vertex_indices", "vertex_index") if name in face.dtype.names), None)
    if corners is None or not set(POSITION) <= set(columns):
        yield columns
        return
    named = {common_name(name): values for name, values in columns.items()}
    vertices = positions(columns)
    colors = None
    if set(COLOR) <= set(named):
        colors = bytes_of(np.stack([named[name] for name in COLOR], axis=1)).astype(np.float64)
    faces = triangles(list(face[corners]))[0]
    yield sampled_columns(Mesh(vertices, faces, colors, None, np.full(len(faces), -1)))


def _rows(path: Path, at_once: int) -> Iterator[Columns]:
    """The columns of a PLY whose points come first, without lists, so many rows at a time."""
    binary = read_header(path)
    elements, offset = binary or read_text_header(path) or ([], 0)
    row, left = elements[0].row, elements[0].count
    assert row is not None and row.names is not None
    kinds = {name: row[name] for name in row.names if row[name].kind in "iuf"}
    with open(path, "rb") as file:
        file.seek(offset)
        while left:
            most = min(left, at_once)
            rows: Any = np.fromfile(file, row, most) if binary else _rows_of_text(file, row, most)
            if not len(rows):
                raise StageError(f"{path} is cut short: its last {left} points are missing; copy it again")
            left -= len(rows)
            yield {name: np.ascontiguousarray(rows[name]) for name in kinds}


def _rows_of_text(file: BinaryIO, row: np.dtype[Any], most: int) -> NDArray[Any]:
    """The next rows of a PLY of text, so many at most; single precision has the digits of the text."""
    assert row.names is not None
    lines = list(islice(file, most))
    wide = np.dtype([(name, "f8" if row[name].kind == "f" else row[name]) for name in row.names])
    return np.loadtxt((line.decode("ascii") for line in lines), wide, ndmin=1) if lines else np.empty(0, wide)


def header_of(elements: list[Element]) -> bytes:
    """The header of a little-endian PLY with these elements."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for element in elements:
        lines.append(f"element {element.name} {element.count}")
        assert element.row is not None and element.row.names is not None
        lines += [f"property {NAMES[element.row[name].str[1:]]} {name}" for name in element.row.names]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _lines(file: BinaryIO) -> list[str]:
    """The header's lines; fewer where the file is something else."""
    lines: list[str] = []
    while len(lines) < 1000 and (not lines or lines[-1] != "end_header"):
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
