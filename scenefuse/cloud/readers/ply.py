"""PLY: the header, which says where the columns lie, so that parts of them can be read; meshes and lists by plyfile."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import (
    COLOR,
    NORMAL,
    POSITION,
    Columns,
    bytes_of,
    check_count,
    colors_of,
    named,
    positions,
    stored_rows,
    text_rows,
    typed,
)
from scenefuse.cloud.readers.meshes import (
    Array,
    Material,
    Mesh,
    beside,
    of_strip,
    picture_of,
    sampled_columns,
    triangles,
)
from scenefuse.core.stage import StageError

KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
# What PLY calls NumPy's types.
NAMES = dict(zip(KINDS, ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")))
TYPES = {name: kind for kind, name in NAMES.items()} | dict(
    zip(("int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"), KINDS)
)

# What fields are called by in a file: CloudCompare reads these without being told to.
FIELD = "scalar_"
# Elements whose rows are polygons, or strips of triangles one after the other with -1 between them.
FACES, STRIPS = "face", "tristrips"
# What the list of a face's corners is called, and that of their places in a texture; those of vertices.
CORNERS, PLACES = ("vertex_indices", "vertex_index"), "texcoord"
PLACE_NAMES = (("texture_u", "texture_v"), ("s", "t"), ("u", "v"))
# A line of the header that names a texture (VCG, MeshLab, Metashape).
TEXTURE = "comment TextureFile "


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


def read_header(path: Path) -> tuple[list[Element], int, bool]:
    """Elements, the byte where their rows begin, and whether these are text; no elements where it is no PLY.

    Raises:
        StageError: the file does not exist.
    """
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
    elements = read_header(path)[0]
    mesh = any(element.name in (FACES, STRIPS) and element.count for element in elements)
    return bool(elements) and elements[0].name == "vertex" and elements[0].row is not None and not mesh


def read_ply(path: Path, at_once: int) -> Iterator[Columns]:
    """Points, so many rows at a time; where there are faces, points drawn from them, all at once, with the colours of
    a texture, else of vertices, else of faces.

    Raises:
        StageError: the file is cut short, or a row of text is of another length.
        ValueError: it is no PLY, or has no vertices.
    """
    elements, offset, is_text = read_header(path)
    if not elements:
        raise ValueError("it does not begin as PLY does")
    if not is_text:
        check_size(path, elements, offset)
    if in_rows(path):
        row, count, last = elements[0].row, elements[0].count, len(elements) == 1
        assert row is not None
        yield from stored_rows(path, offset, row, count, at_once, is_text, last)
        return
    tables = _tables_of_text(path, elements, offset) if is_text else _tables_of_bytes(path)
    vertex, face = named(_numbers(tables.get("vertex", {}))), tables.get(FACES, {})
    faces: Any = next((face[name] for name in CORNERS if name in face), [])
    if strips := [strip for name in CORNERS for strip in tables.get(STRIPS, {}).get(name, [])]:
        face, faces = {}, np.concatenate([of_strip(np.asarray(strip).astype(np.int64)) for strip in strips])
    if not len(faces) or not set(POSITION) <= set(vertex):
        yield vertex
        return
    colors, points = colors_of(vertex), positions(vertex)
    lengths, rows = _flat(faces)
    places, of = triangles(lengths, rows := rows.astype(np.int64), points)
    uvs = next((np.stack([vertex[u], vertex[v]], axis=1)[rows] for u, v in PLACE_NAMES if {u, v} <= set(vertex)), None)
    if PLACES in face and len(own := _flat(face[PLACES])[1]) == 2 * len(rows):
        uvs = own.astype(np.float64).reshape(-1, 2)
    if colors is None and set(COLOR) <= set(face):
        colors = np.repeat(np.array([face[name] for name in COLOR]).T, lengths, axis=0)
        points, rows = points[rows], np.arange(len(rows))
    painted = None if colors is None else bytes_of(colors).astype(np.float64)
    textures = () if uvs is None else tuple(Material(partial(picture_of, file)) for file in named_by_ply(path))
    numbers = np.array(face.get("texnumber", np.zeros(len(faces)))).astype(np.int64)[of]
    yield sampled_columns(Mesh(points, rows[places], painted, None if uvs is None else uvs[places], numbers, textures))


def named_by_ply(path: Path) -> list[Path]:
    """The textures that a header names, by which faces are numbered, whether they are there or not."""
    with open(path, "rb") as file:
        return [beside(path.parent, line.removeprefix(TEXTURE)) for line in _lines(file) if line.startswith(TEXTURE)]


def check_size(path: Path, elements: list[Element], offset: int, advice: str = "copy it again") -> None:
    """StageError where a binary file is too small for what its header counts; a list takes a byte at least."""
    there = path.stat().st_size - offset
    for element in elements:
        size = len(element.kinds) if element.row is None else element.row.itemsize
        there -= size * element.count
        if there < 0:
            check_count(path, element.count, max(element.count + there // size, 0), _rows_of(element), advice)
    if there and all(element.row is not None for element in elements) and there % size == 0:
        check_count(path, element.count, element.count + there // size, _rows_of(element))


def _rows_of(element: Element) -> str:
    """What the rows of an element are called."""
    return "points" if element.name == "vertex" else f"rows of {element.name}"


def _numbers(table: dict[str, Any]) -> Columns:
    """The columns of a table that hold a number a row."""
    return {name: v for name, v in table.items() if isinstance(v, np.ndarray) and v.dtype.kind in "iuf"}


def _flat(lists: Any) -> tuple[NDArray[np.int64], NDArray[Any]]:
    """Lengths (P,) of lists, which a table (P, K) may hold, and all that they hold (N,)."""
    if isinstance(lists, np.ndarray) and lists.ndim == 2:
        return np.full(len(lists), lists.shape[1]), lists.ravel()
    return np.array([len(one) for one in lists]), np.concatenate(lists)


def _tables_of_bytes(path: Path) -> dict[str, dict[str, Any]]:
    """The properties of each element by their names; lists that are all as long as a triangle's in a table."""
    from plyfile import PlyData, PlyParseError

    try:
        content = PlyData.read(path, known_list_len={FACES: dict.fromkeys(CORNERS, 3) | {PLACES: 6}})
    except (PlyParseError, ValueError):  # others are read row by row
        content = PlyData.read(path)
    return {
        e.name: {n.removeprefix(FIELD): e[n].astype(e[n].dtype.newbyteorder("=")) for n in e.data.dtype.names or ()}
        for e in content
    }


def _tables_of_text(path: Path, elements: list[Element], offset: int) -> dict[str, dict[str, Any]]:
    """The same of a file of text."""
    tables: dict[str, dict[str, Any]] = {}
    with open(path, "rb") as file:
        file.seek(offset)
        for element in elements:
            if element.row is not None:
                found: dict[str, Any] = text_rows(path, file, element.row, element.count, 1)[0]
                there = len(next(iter(found.values()), ()))
            else:
                rows = list(islice((line for line in file if line.strip()), element.count))
                there, found = len(rows), _with_lists(element, rows)
            check_count(path, element.count, there, _rows_of(element))
            tables[element.name] = found
    return tables


def _with_lists(element: Element, rows: list[bytes]) -> dict[str, Any]:
    """The columns of rows of text that hold lists: arrays of numbers, and for each list a list of arrays."""
    columns = zip(*(_cells(element, row.split()) for row in rows))
    return {
        name: column if kind == "list" else typed(np.concatenate(column), np.dtype(TYPES.get(kind, "f8")))
        for (name, kind), column in zip(element.kinds.items(), columns)
    }


def _cells(element: Element, cells: list[bytes]) -> Iterator[Array]:
    """The numbers of each property of a row."""
    at = 0
    for kind in element.kinds.values():
        is_list = kind == "list"
        end = at + (1 + int(float(cells[at])) if is_list else 1)
        yield np.array(cells[at + is_list : end], np.float64)
        at = end


def header_of(elements: list[Element], comments: Sequence[str] = ()) -> bytes:
    """The header of a little-endian PLY with these elements, and lines that programs pass over."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
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
    rows = [
        np.dtype([(own, order + TYPES[kind]) for own, kind in kinds.items()]) if {*kinds.values()} <= {*TYPES} else None
        for _, _, kinds in found
    ]
    return [Element(name, count, row, kinds) for (name, count, kinds), row in zip(found, rows)]
