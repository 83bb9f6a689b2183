"""Triangle meshes (PLY, OBJ, GLB) as points: drawn evenly from their faces, with normals and colours.

Read here and not by Open3D, whose readers take positions as float32: at UTM coordinates that loses decimetres.
"""

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import Columns

Array = NDArray[np.float64]

# Points drawn from a mesh; one with more vertices gives as many as it has.
MESH_POINTS = 500_000


@dataclass(frozen=True)
class Material:
    """The colour of faces: a picture (H, W, 3) RGB where there is one, else one colour, 0..255."""

    picture: NDArray[np.uint8] | None = None
    color: tuple[float, ...] = (255.0, 255.0, 255.0)


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Attributes:
        vertices: (V, 3) positions.
        faces: (F, 3) rows of `vertices`.
        colors: (V, 3) 0..255, or None.
        uvs: (F, 3, 2) places in the material's picture, from its lower left corner; NaN where there are none; or None.
        material: (F,) rows of `materials`, -1 for none.
        materials: of the faces.
    """

    vertices: Array
    faces: NDArray[np.int64]
    colors: Array | None
    uvs: Array | None
    material: NDArray[np.int64]
    materials: tuple[Material, ...] = ()


def sampled_columns(mesh: Mesh) -> Columns:
    """Points on the faces of a mesh, as many on each as its area asks for, with the faces' normals.

    Every n-th part of the area gets one point; no chance is involved.

    Args:
        mesh: at least one face with an area; faces without one, or with a vertex that is not finite, are left out.

    Raises:
        ValueError: a face names a vertex that is not there, or no face has an area.
    """
    if mesh.faces.size and (mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices)):
        raise ValueError("its faces name vertices that it does not have")
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    double = np.nan_to_num(np.linalg.norm(cross, axis=1), posinf=0.0)
    ends = np.cumsum(double)
    if not len(ends) or ends[-1] == 0:
        raise ValueError("none of its faces has an area")
    count = max(MESH_POINTS, len(mesh.vertices))
    face = np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1], side="right")
    # A plane-filling sequence (Roberts 2018, R2): any stretch of it is even.
    u, v = ((np.arange(1, count + 1) * step) % 1 for step in (0.7548776662466927, 0.5698402909980532))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    weights = np.stack([1 - u - v, u, v], axis=1)
    points = a[face] + u[:, None] * (b - a)[face] + v[:, None] * (c - a)[face]
    columns: Columns = dict(zip("xyz", points.T)) | dict(
        zip(("nx", "ny", "nz"), (cross[face] / double[face, None]).T.astype(np.float32))
    )
    colors = _colors(mesh, face, weights)
    if colors is not None:
        columns |= dict(zip(("red", "green", "blue"), np.clip(np.rint(colors), 0, 255).astype(np.uint8).T))
    return columns


def _colors(mesh: Mesh, face: NDArray[np.int64], weights: Array) -> Array | None:
    """(N, 3) colours at points of faces (N,) with barycentric weights (N, 3): of the vertices, else the materials."""
    if mesh.colors is not None:
        return np.asarray(np.einsum("nk,nkc->nc", weights, mesh.colors[mesh.faces[face]]))
    if all(material.picture is None and material.color == Material.color for material in mesh.materials):
        if mesh.materials:
            print("note: the mesh's materials have neither pictures nor colours: it has none", flush=True)
        return None
    colors, of = np.full((len(face), 3), 255.0), mesh.material[face]
    for number, material in enumerate(mesh.materials):
        rows = np.flatnonzero(of == number)
        colors[rows] = material.color
        if material.picture is None or mesh.uvs is None:
            continue
        uv = np.einsum("nk,nkc->nc", weights[rows], mesh.uvs[face[rows]])
        known = np.isfinite(uv).all(1)
        uv = uv[known]
        uv = np.where((uv < 0) | (uv > 1), uv % 1, uv)
        height, width = material.picture.shape[:2]
        column = np.minimum((uv[:, 0] * width).astype(int), width - 1)
        row = np.minimum(((1 - uv[:, 1]) * height).astype(int), height - 1)
        colors[rows[known]] = material.picture[row, column]
    return colors


def triangles(polygons: list[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Polygons as fans of triangles: corners (F, 3), and the polygon of each (F,)."""
    lengths = np.array([len(polygon) for polygon in polygons], np.int64)
    corners, of = [], []
    for length in np.unique(lengths[lengths >= 3]):
        rows = np.flatnonzero(lengths == length)
        same = np.array([polygons[row] for row in rows], np.int64)
        for k in range(1, length - 1):
            corners.append(same[:, [0, k, k + 1]])
            of.append(rows)
    if not corners:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    order = np.argsort(np.concatenate(of), kind="stable")
    return np.concatenate(corners)[order], np.concatenate(of)[order]


@dataclass
class _Obj:
    """The lines of an OBJ file, rows from 0; `place` is -1 where a corner has no `vt`."""

    vertices: list[list[float]] = field(default_factory=list)
    uvs: list[list[float]] = field(default_factory=list)
    polygons: list[list[int]] = field(default_factory=list)
    places: list[list[int]] = field(default_factory=list)
    used: list[str] = field(default_factory=list)
    libraries: list[str] = field(default_factory=list)
    material: str = ""

    def take(self, line: str) -> None:
        word, rest = (*line.split(None, 1), "", "")[:2]
        if word == "v":
            self.vertices.append([float(cell) for cell in rest.split()])
        elif word == "vt":
            self.uvs.append([float(cell) for cell in rest.split()[:2]])
        elif word == "f":
            cells = [cell.split("/") for cell in rest.split()]
            self.polygons.append([_row(cell[0], len(self.vertices)) for cell in cells])
            self.places.append([_row(c[1], len(self.uvs)) if len(c) > 1 and c[1] else -1 for c in cells])
            self.used.append(self.material)
        elif word == "usemtl":
            self.material = rest.strip()
        elif word == "mtllib":
            self.libraries.append(rest.strip())


def read_obj(path: Path) -> Columns:
    """Wavefront OBJ: positions, colours behind them, polygons, pictures of the materials (`map_Kd`).

    Without faces its vertices are the points.
    """
    content = _Obj()
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for line in file:
            content.take(line)
    if not content.vertices:
        return {axis: np.empty(0) for axis in "xyz"}
    width = 6 if min(map(len, content.vertices)) >= 6 else 3
    table = np.array([vertex[:width] for vertex in content.vertices], np.float64)
    colors = table[:, 3:] * (255.0 if table[:, 3:].max() <= 1 else 1.0) if width == 6 else None
    if not content.polygons:
        columns: Columns = dict(zip("xyz", table[:, :3].T))
        return columns if colors is None else columns | dict(zip(("red", "green", "blue"), np.rint(colors).T))
    faces, of = triangles(content.polygons)
    uvs = np.array([*content.uvs, [np.nan, np.nan]], np.float64)[triangles(content.places)[0]]
    known = dict(pair for name in content.libraries for pair in _materials(path.parent / name).items())
    names = sorted(set(content.used))
    material = np.array([names.index(name) for name in content.used])[of]
    materials = tuple(known.get(name, Material()) for name in names) if known else ()
    return sampled_columns(Mesh(table[:, :3], faces, colors, uvs, material, materials))


def _row(cell: str, count: int) -> int:
    """A reference of OBJ, from 1, or from the end if negative, as a row from 0."""
    number = int(cell)
    return number - 1 if number > 0 else count + number


def _materials(path: Path) -> dict[str, Material]:
    """The materials of an MTL file by name; what cannot be read is named, and counts as white."""
    found: dict[str, Material] = {}
    name = ""
    if not path.is_file():
        print(f"note: {path} is not there: the mesh has no colours of its materials", flush=True)
        return found
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "newmtl":
            name = rest.strip()
            found[name] = Material()
        elif word == "Kd" and name:
            found[name] = Material(found[name].picture, tuple(255 * float(cell) for cell in rest.split()[:3]))
        elif word == "map_Kd" and name:
            file = path.parent / _named_file(rest).replace("\\", "/")
            found[name] = Material(_picture(file.read_bytes() if file.is_file() else b"", str(file)), found[name].color)
    return found


def _named_file(rest: str) -> str:
    """The file that a line of a material names: behind its options, perhaps in quotes."""
    options = re.match(r"(?:-[A-Za-z]+(?:\s+(?:-?[\d.]+|on|off)(?=\s))*\s+)*", rest)
    return rest[options.end() if options else 0 :].strip().strip('"')


def _picture(content: bytes, name: str) -> NDArray[np.uint8] | None:
    """An encoded picture as (H, W, 3) RGB; None, and a note, where it cannot be read."""
    import cv2

    found = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    if found is None:
        print(f"note: the texture {name} cannot be read: its faces have their material's colour", flush=True)
        return None
    return np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2RGB), np.uint8)


def read_glb(path: Path) -> Columns:
    """Binary glTF 2.0: all meshes of its scene at their places, turned so that z is up (glTF says that y is).

    Raises:
        ValueError: it is no GLB, holds no triangles, or its meshes are compressed.
    """
    content = path.read_bytes()
    if content[:4] != b"glTF" or len(content) < 20:
        raise ValueError("it does not begin as GLB does")
    length = int.from_bytes(content[12:16], "little")
    document, blob = json.loads(content[20 : 20 + length]), content[28 + length :]
    if unread := {"KHR_draco_mesh_compression", "EXT_meshopt_compression"} & set(document.get("extensionsUsed", [])):
        raise ValueError(f"its meshes are compressed by {min(unread)}: export them without")
    upright = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    scenes, nodes = document.get("scenes"), document.get("nodes", [])
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
    parts = [part for root in roots for part in _parts(document, blob, root, upright)]
    if not parts:
        raise ValueError("it holds no triangles")
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    colored = [part.colors for part in parts if part.colors is not None]
    return sampled_columns(
        Mesh(
            np.concatenate([part.vertices for part in parts]),
            np.concatenate([part.faces + start for part, start in zip(parts, starts)]),
            np.concatenate(colored) if len(colored) == len(parts) else None,
            np.concatenate([np.full((len(p.faces), 3, 2), np.nan) if p.uvs is None else p.uvs for p in parts]),
            np.concatenate([part.material for part in parts]),
            tuple(_gltf_material(document, blob, entry) for entry in document.get("materials", [])),
        )
    )


def _parts(document: dict[str, Any], blob: bytes, node: int, outer: Array) -> list[Mesh]:
    """The triangles below a node of glTF, in the frame that `outer` (4, 4) leads to."""
    from scipy.spatial.transform import Rotation

    about = document["nodes"][node]
    if "matrix" in about:
        own = np.array(about["matrix"], np.float64).reshape(4, 4).T
    else:
        own = np.eye(4)
        turn = Rotation.from_quat(about.get("rotation", [0, 0, 0, 1])).as_matrix()
        own[:3, :3], own[:3, 3] = turn * np.array(about.get("scale", [1, 1, 1])), about.get("translation", [0, 0, 0])
    pose = outer @ own
    found = []
    for primitive in document["meshes"][about["mesh"]]["primitives"] if "mesh" in about else []:
        if primitive.get("mode", 4) != 4:
            print("note: lines, points and strips of the GLB are left out; triangles are read", flush=True)
            continue
        names = primitive["attributes"]
        vertices = _values(document, blob, names["POSITION"]) @ pose[:3, :3].T + pose[:3, 3]
        index = np.arange(len(vertices))
        if "indices" in primitive:
            index = _values(document, blob, primitive["indices"]).astype(np.int64).ravel()
        faces = index[: len(index) // 3 * 3].reshape(-1, 3)
        colors = 255 * _values(document, blob, names["COLOR_0"])[:, :3] if "COLOR_0" in names else None
        uvs = _values(document, blob, names["TEXCOORD_0"]) if "TEXCOORD_0" in names else None
        uvs = None if uvs is None else (uvs * [1, -1] + [0, 1])[faces]
        found.append(Mesh(vertices, faces, colors, uvs, np.full(len(faces), primitive.get("material", -1))))
    return found + [part for child in about.get("children", []) for part in _parts(document, blob, child, pose)]


def _values(document: dict[str, Any], blob: bytes, accessor: int) -> Array:
    """(N, K) values of an accessor of glTF; normalised integers as fractions."""
    about = document["accessors"][accessor]
    if "bufferView" not in about or "sparse" in about:
        raise ValueError("its meshes are stored in a form that is not read (sparse); export it again")
    view = document["bufferViews"][about["bufferView"]]
    # glTF 2.0, 3.6.2.2: component types, and components of an accessor's type.
    kinds = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
    widths = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
    kind, width = np.dtype(kinds[about["componentType"]]), widths[about["type"]]
    start, step = view.get("byteOffset", 0) + about.get("byteOffset", 0), view.get("byteStride", kind.itemsize * width)
    table = np.ndarray((about["count"], width), kind, blob, start, (step, kind.itemsize)).astype(np.float64)
    return table / np.iinfo(kind).max if about.get("normalized") else table


def _gltf_material(document: dict[str, Any], blob: bytes, entry: dict[str, Any]) -> Material:
    about = entry.get("pbrMetallicRoughness", {})
    color = tuple(255 * part for part in about.get("baseColorFactor", [1, 1, 1])[:3])
    if "baseColorTexture" not in about:
        return Material(None, color)
    number = document["textures"][about["baseColorTexture"]["index"]].get("source", 0)
    image = document["images"][number]
    view = document["bufferViews"][image["bufferView"]] if "bufferView" in image else {"byteLength": 0}
    start = view.get("byteOffset", 0)
    return Material(_picture(blob[start : start + view["byteLength"]], image.get("name", f"number {number}")), color)
