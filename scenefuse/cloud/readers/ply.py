"""PLY: the header, which says where the columns lie, so that parts of them can be read; meshes and lists by plyfile."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from scenefuse.cloud.readers.columns import (
    COLOR,
    NORMAL,
    POSITION,
    Columns,
    bytes_of,
    colors_of,
    common_names,
    next_rows,
    positions,
    typed,
)
from scenefuse.cloud.readers.meshes import Mesh, sampled_columns, triangles
from scenefuse.core.stage import StageError

KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
# What PLY calls NumPy's types.
NAMES = dict(zip(KINDS, ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")))
TYPES = {name: kind for kind, name in NAMES.items()} | dict(
    zip(("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"), KINDS)
)

# What fields are called by in a file: CloudCompare reads these without being told to.
FIELD = "scalar_"
# What the list of a face's corners is called.
CORNERS = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class Element:
    """Rows of one kind in a PLY file.

    Attributes:
        name: vertex, face, ...
        count: of rows.
        row: their NumPy type; None where they hold lists, so that rows differ in length.
        kinds: what the file calls the types of its properties, by their names.
    """

    name: str
    count: int
    row: np.dtype[Any] | None
    kinds: dict[str, str] = field(default_factory=dict)


def read_header(path: Path) -> tuple[list[Element], int] | None:
    """The elements of a binary PLY and the byte where their rows begin; None where the file is text or no PLY.

    Raises:
        StageError: the file does not exist.
    """
    elements, offset, is_text = _header(path)
    return None if is_text or not elements else (elements, offset)


def _header(path: Path) -> tuple[list[Element], int, bool]:
    """Elements, the byte where their rows begin, and whether these are text; no elements where it is no PLY."""
    if not path.is_file():
        raise StageError(f"{path} does not exist; run the stage that writes it first")
    orders = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
    with open(path, "rb") as file:
        lines = _lines(file)
        form = next((line.split()[1] for line in lines if line.startswith("format ")), "")
        if lines[0] != "ply" or lines[-1] != "end_header" or form not in orders:
            return [], 0, False
        return _elements(lines, orders[form]), file.tell(), form == "ascii"


def in_rows(path: Path) -> bool:
    """Whether the points of a PLY come first, without lists, and are no corners of faces."""
    elements = _header(path)[0]
    mesh = any(element.name == "face" and element.count for element in elements)
    return bool(elements) and elements[0].name == "vertex" and elements[0].row is not None and not mesh


def read_ply(path: Path, at_once: int) -> Iterator[Columns]:
    """Points, so many rows at a time; where there are faces, points drawn from them, all at once.

    Raises:
        StageError: the file is cut short, or a row of text is of another length.
        ValueError: it is no PLY, or has no vertices.
    """
    elements, offset, is_text = _header(path)
    if not elements:
        raise ValueError("it does not begin as PLY does")
    if not is_text:
        check_size(path, elements, offset)
    if in_rows(path):
        yield from _rows(path, elements[0], offset, is_text, at_once)
        return
    vertex, faces = _mesh_of_text(path, elements, offset) if is_text else _mesh_of_bytes(path)
    if not len(faces) or not set(POSITION) <= set(vertex):
        yield vertex
        return
    colors = colors_of(dict(zip(common_names(list(vertex)), vertex.values())))
    colors = None if colors is None else bytes_of(colors).astype(np.float64)
    points = positions(vertex)
    rows = np.concatenate(faces).astype(np.int64)
    corners = rows[triangles(np.array([len(face) for face in faces]), rows, points)[0]]
    yield sampled_columns(Mesh(points, corners, colors, None, np.full(len(corners), -1)))


def check_size(path: Path, elements: list[Element], offset: int, advice: str = "copy it again") -> None:
    """StageError where a binary file is too small for what its header counts; a list takes a byte at least."""
    there = path.stat().st_size - offset
    for element in elements:
        size = len(element.kinds) if element.row is None else element.row.itemsize
        there -= size * element.count
        if there < 0:
            raise _cut_short(path, element.name, min(-(there // size), element.count), advice)


def _cut_short(path: Path, element: str, missing: int, advice: str = "copy it again") -> StageError:
    what = "points" if element == "vertex" else f"rows of {element}"
    return StageError(f"{path} is cut short: its last {missing} {what} are missing; {advice}")


def _mesh_of_bytes(path: Path) -> tuple[Columns, list[Any]]:
    """The columns of the vertices, and the corners of each face."""
    from plyfile import PlyData

    content = PlyData.read(path)
    vertex = content["vertex"].data
    names = [name for name in vertex.dtype.names if vertex.dtype[name].kind in "iuf"]
    columns = {name.removeprefix(FIELD): np.array(vertex[name]) for name in names}
    face = content["face"].data if "face" in content else np.empty(0, [("", "u1")])
    name = next((name for name in CORNERS if name in (face.dtype.names or ())), None)
    return columns, [] if name is None else list(face[name])


def _mesh_of_text(path: Path, elements: list[Element], offset: int) -> tuple[Columns, list[Any]]:
    """The same of a file of text."""
    vertex: Columns = {}
    faces: list[list[int]] = []
    with open(path, "rb") as file:
        file.seek(offset)
        for element in elements:
            if element.row is not None:
                columns = _columns_of_text(path, file, element, element.count)[0]
                there = len(next(iter(columns.values()), ()))
                if there < element.count:
                    raise _cut_short(path, element.name, element.count - there)
                vertex = columns if element.name == "vertex" else vertex
                continue
            rows = list(islice((line for line in file if line.strip()), element.count))
            if len(rows) < element.count:
                raise _cut_short(path, element.name, element.count - len(rows))
            if element.name == "face":
                corners = (next((cells for name, cells in _cells(element, row) if name in CORNERS), []) for row in rows)
                faces += [[int(float(cell)) for cell in cells] for cells in corners]
            elif element.name == "vertex":
                vertex = _beside_lists(element, rows)
    return vertex, faces


def _cells(element: Element, row: bytes) -> Iterator[tuple[str, list[bytes]]]:
    """The properties of a row of text that holds lists, and the cells of each."""
    cells, at = row.split(), 0
    for name, kind in element.kinds.items():
        is_list = kind == "list"
        end = at + (1 + int(float(cells[at])) if is_list else 1)
        yield name, cells[at + is_list : end]
        at = end


def _beside_lists(element: Element, rows: list[bytes]) -> Columns:
    """The columns of rows of text that hold lists as well; these are left out."""
    kinds = {name: np.dtype(TYPES[kind]) for name, kind in element.kinds.items() if kind != "list"}
    table = [[float(cells[0]) for name, cells in _cells(element, row) if name in kinds] for row in rows]
    return {name: typed(np.array(values), kinds[name]) for name, values in zip(kinds, zip(*table))}


def _rows(path: Path, element: Element, offset: int, is_text: bool, at_once: int) -> Iterator[Columns]:
    """The columns of a PLY whose points come first, without lists, so many rows at a time."""
    left, row = element.count, element.row
    assert row is not None and row.names is not None
    with open(path, "rb") as file:
        line = 1 + file.read(offset).count(b"\n")
        while left:
            most = min(left, at_once)
            if is_text:
                columns, line = _columns_of_text(path, file, element, most, line)
            else:
                rows = np.fromfile(file, row, most)
                columns = {name: np.ascontiguousarray(rows[name]) for name in row.names}
            count = len(next(iter(columns.values()), ()))
            if not count:
                raise _cut_short(path, element.name, left)
            left -= count
            yield columns


def _columns_of_text(path: Path, file: BinaryIO, element: Element, most: int, line: int = 1) -> tuple[Columns, int]:
    """The next rows of text, so many at most, and the number of the line behind them.

    Single precision has the digits of the text; missing integers are 0, and large ones the largest.
    """
    row = element.row
    assert row is not None and row.names is not None
    rows, line = next_rows(file, most, len(row.names), (str(path), line))
    return {name: typed(rows[:, k], row[name]) for k, name in enumerate(row.names)}, line


def header_of(elements: list[Element]) -> bytes:
    """The header of a little-endian PLY with these elements."""
    lines = ["ply", "format binary_little_endian 1.0"]
    for element in elements:
        lines.append(f"element {element.name} {element.count}")
        assert element.row is not None and element.row.names is not None
        names = map(in_file, element.row.names) if element.name == "vertex" else element.row.names
        lines += [f"property {NAMES[element.row[k].str[1:]]} {name}" for k, name in enumerate(names)]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def in_file(name: str) -> str:
    """What a column of points is called in a PLY."""
    return name if name in {*POSITION, *NORMAL, *COLOR} else FIELD + name


def _lines(file: BinaryIO) -> list[str]:
    """The header's lines; fewer where the file is something else."""
    lines: list[str] = []
    while len(lines) < 1000 and (not lines or lines[-1] != "end_header"):
        line = file.readline(1000)
        lines.append(line.decode("utf-8", "replace").strip(" \r\n\ufeff"))
        if not line or lines[0] != "ply":
            break
    return lines or [""]


def _elements(lines: list[str], order: str) -> list[Element]:
    found: list[tuple[str, int, dict[str, str]]] = []
    for words in (line.split() for line in lines):
        if words[:1] == ["element"]:
            found.append((words[1], int(words[2]), {}))
        elif words[:1] == ["property"]:
            name, columns = words[-1].removeprefix(FIELD), found[-1][2]
            while name in columns:
                name += "_"
            columns[name] = words[1]
    if any(count < 0 for _, count, _ in found):
        raise ValueError("its header counts less than no rows")
    own = {name: kind for element, _, kinds in found if element == "vertex" for name, kind in kinds.items()}
    if unknown := next((name for name, kind in own.items() if kind not in {*TYPES, "list"}), ""):
        raise ValueError(f"its property {unknown} is of type {own[unknown]}, which PLY does not have: leave it out")
    return [
        Element(
            name,
            count,
            np.dtype([(own, order + TYPES[kind]) for own, kind in kinds.items()])
            if {*kinds.values()} <= {*TYPES}
            else None,
            kinds,
        )
        for name, count, kinds in found
    ]
