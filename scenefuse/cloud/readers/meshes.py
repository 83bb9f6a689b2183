"""Triangle meshes (PLY, OBJ, glTF) as points: drawn evenly from their faces, with normals and colours.

Read here and not by Open3D, whose readers take positions as float32: at UTM coordinates that loses decimetres.
"""

import codecs
import io
import json
import re
from array import array
from base64 import b64decode
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import AT_ONCE, COLOR, Columns, bytes_of
from scenefuse.core.stage import StageError

Array = NDArray[np.float64]

# Points drawn from a mesh; one with more vertices gives as many as it has.
MESH_POINTS = 500_000
# Extensions of glTF that are read, or change neither shapes nor the colours of surfaces.
READ_EXTENSIONS = re.compile(
    "EXT_texture_webp|EXT_mesh_gpu_instancing|KHR_(texture_transform|mesh_quantization|materials_(?!variants)"
    "|lights|xmp|node_visibility)|(MSFT|ADOBE|FB|AGI)_"
)
# What may stand before the file of a texture in a line of a material.
OPTIONS = re.compile(r"(?:-[A-Za-z]+(?:\s+(?:[-+]?[\d.]+(?:[eE][-+]?\d+)?|on|off)(?=\s))*\s+)*")
DIFFUSE = "KHR_materials_pbrSpecularGlossiness"
INSTANCE_PARTS = ("TRANSLATION", "ROTATION", "SCALE")


@dataclass(frozen=True)
class Material:
    """The colour of faces: a picture (H, W, 3) RGB where there is one that can be read, else one colour, 0..255.

    A matrix (2, 3) leads from places (u, v, 1) of a mesh to those in the picture.
    """

    picture: Callable[[], NDArray[np.uint8] | None] | None = None
    color: tuple[float, ...] = (255.0, 255.0, 255.0)
    place: Array = field(default_factory=lambda: np.eye(2, 3))


@dataclass(frozen=True)
class Mesh:
    """Triangles.

    Attributes:
        vertices: (V, 3) positions.
        faces: (F, 3) rows of `vertices`.
        colors: (V, 3) 0..255, NaN where there are none; or None.
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
    first = mesh.vertices[mesh.faces[:, 0]]
    cross = np.cross(mesh.vertices[mesh.faces[:, 1]] - first, mesh.vertices[mesh.faces[:, 2]] - first)
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
    a, b, c = (mesh.vertices[mesh.faces[face, k]] for k in range(3))
    points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    columns: Columns = dict(zip("xyz", points.T)) | dict(
        zip(("nx", "ny", "nz"), (cross[face] / double[face, None]).T.astype(np.float32))
    )
    colors = _colors(mesh, face, weights)
    if colors is not None:
        columns |= dict(zip(("red", "green", "blue"), np.clip(np.rint(colors), 0, 255).astype(np.uint8).T))
    return columns


def _colors(mesh: Mesh, face: NDArray[np.int64], weights: Array) -> Array | None:
    """(N, 3) colours at points of faces (N,) with barycentric weights (N, 3): of a picture, else the vertices, else the
    material. Beside materials, programs write white for vertices that have none. Of the pictures one is held."""
    of = np.where(mesh.material < len(mesh.materials), mesh.material, -1)[face]
    painted = np.full((len(face), 3), np.nan)
    for number, material in enumerate(mesh.materials):
        rows = np.flatnonzero(of == number)
        if material.picture is not None and mesh.uvs is not None and len(rows):
            painted[rows] = _texels(material, np.einsum("nk,nkc->nc", weights[rows], mesh.uvs[face[rows]]))
    pictured = np.isfinite(painted)
    plain = not pictured.any() and all(material.color == Material.color for material in mesh.materials)
    own = None if mesh.colors is None or not ((mesh.colors < 255).any() or plain) else mesh.colors
    if own is None and plain:
        if mesh.materials:
            print("note: the mesh's materials have neither pictures nor colours: it has none", flush=True)
        return None
    colors = np.array([*(material.color for material in mesh.materials), Material.color])[of]
    if own is not None:
        at = np.einsum("nk,nkc->nc", weights, own[mesh.faces[face]])
        colors = np.where(np.isfinite(at), at, colors)
    return np.where(pictured, painted, colors)


def _texels(material: Material, uv: Array) -> Array:
    """(N, 3) colours of a material's picture at places (N, 2), NaN where these are, or where it cannot be read."""
    found, known = np.full((len(uv), 3), np.nan), np.isfinite(uv).all(1)
    picture = material.picture and material.picture()
    if picture is not None:
        uv = uv[known] @ material.place[:, :2].T + material.place[:, 2]
        uv = np.where((uv < 0) | (uv > 1), uv % 1, uv)
        height, width = picture.shape[:2]
        column = np.minimum((uv[:, 0] * width).astype(int), width - 1)
        row = np.minimum(((1 - uv[:, 1]) * height).astype(int), height - 1)
        found[known] = picture[row, column]
    return found


def triangles(
    lengths: NDArray[np.int64], rows: NDArray[np.int64], vertices: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Polygons as triangles: fans where these do not fold over.

    Args:
        lengths: (P,) corners of each.
        rows: (N,) of all corners, polygon by polygon, in `vertices` (V, 3).

    Returns:
        (F, 3) places of the triangles' corners in `rows`; (F,) the polygon of each.
    """
    starts = np.cumsum(lengths) - lengths
    corners, of = [], []
    for length in np.unique(lengths[lengths >= 3]):
        same = np.flatnonzero(lengths == length)
        fan = np.stack([np.zeros(length - 2, np.int64), np.arange(1, length - 1), np.arange(2, length)], axis=1)
        found = starts[same, None, None] + fan
        if length > 3:
            at = vertices.take(rows[starts[same, None] + np.arange(length)], axis=0, mode="clip")
            arms = at[:, 1:] - at[:, :1]
            normals = np.cross(arms[:, :-1], arms[:, 1:])
            folded = (np.einsum("ntk,nk->nt", normals, normals.sum(1)) < 0).any(1)
            for k in np.flatnonzero(folded):
                found[k] = starts[same[k]] + _ears(at[k], normals[k].sum(0))
        corners.append(found.reshape(-1, 3))
        of.append(np.repeat(same, length - 2))
    if not corners:
        return np.zeros((0, 3), np.int64), np.zeros(0, np.int64)
    order = np.argsort(np.concatenate(of), kind="stable")
    return np.concatenate(corners)[order], np.concatenate(of)[order]


def of_strip(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """(F, 3) triangles of strips (N,) with -1 between them; every second one has its corners turned."""
    each = np.arange(len(index) - 2)
    begins = np.maximum.accumulate(np.where(index == -1, np.arange(len(index)) + 1, 0))[: len(each)]
    turned = (each - begins) % 2
    found = index[np.stack([each, each + 1 + turned, each + 2 - turned], axis=1)]
    return found[(found >= 0).all(1)]


def _ears(points: Array, normal: Array) -> NDArray[np.int64]:
    """(N - 2, 3) triangles of a polygon (N, 3) with a normal, by clipping its ears (Meisters 1975)."""
    seen = np.argmax(abs(normal))  # from along this axis
    flat = np.roll(points, -1 - seen, axis=1)[:, :2] * [np.sign(normal[seen]), 1]

    def side(a: int, b: int, corners: Any) -> Any:
        """Positive for corners that lie left of the line from a to b."""
        (x, y), far = flat[b] - flat[a], flat[corners] - flat[a]
        return x * far[..., 1] - y * far[..., 0]

    left, found, k, tried = list(range(len(points))), [], 0, 0
    while len(left) > 3:
        before, corner, after = left[k - 1], left[k], left[(k + 1) % len(left)]
        ear = side(before, corner, after) > 0
        if ear:
            sides = [side(before, corner, left), side(corner, after, left), side(after, before, left)]
            ear = not (np.min(sides, axis=0) > 0).any()
        if ear or tried == len(left):  # a knot has no ears
            found.append((before, corner, after))
            del left[k]
            k, tried = max(k - 1, 0), 0
        else:
            k, tried = (k + 1) % len(left), tried + 1
    return np.array([*found, tuple(left)])


def read_obj(path: Path) -> Columns:
    """Wavefront OBJ: positions, colours behind them, polygons, pictures of the materials (`map_Kd`).

    Without faces its vertices are the points.
    """
    # Six numbers of each vertex, two of each place in a picture; rows of these of all corners, -1 for none.
    vertices, uvs, rows, places = array("d"), array("d"), array("q"), array("q")
    # Corners and material of each polygon.
    lengths, used, names = array("q"), array("q"), {"": 0}
    libraries, material = list[str](), 0
    for line in _obj_lines(path):
        word, rest = (*line.split(None, 1), "", "")[:2]
        numbers = rest.split("#")[0].split()
        if word == "v":
            vertices.extend(map(float, numbers[:6] if len(numbers) > 5 else [*numbers[:3], *["nan"] * 3]))
        elif word == "vt":
            uvs.extend(map(float, [*numbers, "0"][:2]))
        elif word == "f":
            cells = [(cell + "//").split("/", 2) for cell in numbers]
            rows.extend(_rows([cell[0] for cell in cells], len(vertices) // 6))
            places.extend(_rows([cell[1] for cell in cells], len(uvs) // 2))
            lengths.append(len(cells))
            used.append(material)
        elif word == "usemtl":
            material = names.setdefault(rest.strip(), len(names))
        elif word == "mtllib":
            libraries.append(rest.strip())
    # A file of several objects may have colours of some.
    table = np.array(vertices).reshape(-1, 6)
    painted = np.isfinite(table[:, 3:]).all(1)
    if not lengths:
        return _points(table[:, :3], bytes_of(table[:, 3:]) if painted.all() else None)
    corners, of = triangles(np.array(lengths), np.array(rows), table[:, :3])
    files = [file for name in libraries for file in _libraries(path.parent, name)]
    known = dict(pair for file in files for pair in _materials(file).items())
    return sampled_columns(
        Mesh(
            table[:, :3],
            np.array(rows)[corners],
            np.where(painted[:, None], bytes_of(table[:, 3:]), np.nan) if painted.any() else None,
            np.array([*uvs, np.nan, np.nan]).reshape(-1, 2)[np.array(places)[corners]],
            np.array(used)[of],
            tuple(known.get(name, Material()) for name in names) if known else (),
        )
    )


def _points(vertices: Array, colors: NDArray[Any] | None) -> Columns:
    """Vertices (V, 3) of a file without faces; colours 0..255 where all have one."""
    columns: Columns = dict(zip("xyz", vertices.T))
    if colors is None or not np.isfinite(colors).all():
        return columns
    return columns | dict(zip(COLOR, np.rint(colors).astype(np.uint8).T))


def _obj_lines(path: Path) -> Iterator[str]:
    """The lines of an OBJ, those that a backslash continues in one."""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for line in file:
            while "\\" in line and line.rstrip().endswith("\\") and (more := file.readline()):
                line = line.rstrip()[:-1] + " " + more
            yield line


def _rows(cells: list[str], count: int) -> list[int]:
    """References of OBJ, from 1, or from the end if negative, as rows from 0; -1 for an empty one."""
    numbers = [int(cell or 0) for cell in cells]
    return [number - 1 if number >= 0 else count + number for number in numbers]


def _libraries(folder: Path, names: str) -> list[Path]:
    """The files of materials that a line names: one, perhaps with blanks, or several."""
    whole = beside(folder, names)
    return [whole] if whole.is_file() else [beside(folder, name) for name in names.split() or [names]]


def beside(folder: Path, name: str) -> Path:
    """A file that another one names, there or, where the name is of another machine, by that beside it in any case."""
    parts = name.strip().strip('"').replace("\\", "/")
    path = folder / parts
    if path.is_file() or not folder.is_dir():
        return path
    last = Path(parts).name.lower()
    return next((other for other in sorted(folder.iterdir()) if other.name.lower() == last), path)


def named_by_obj(path: Path) -> Iterator[Path]:
    """The materials that an OBJ names before its first vertex, and their textures, whether they are there or not."""
    for line in takewhile(lambda line: not line.startswith("v "), _obj_lines(path)):
        for file in _libraries(path.parent, line[7:].strip()) if line.startswith("mtllib ") else []:
            yield file
            text = file.read_text(encoding="utf-8-sig", errors="replace") if file.is_file() else ""
            for name in re.findall(r"(?im)^\s*map_kd\s+(.*)", text):
                yield beside(file.parent, OPTIONS.sub("", name, count=1))


def named_by_gltf(path: Path) -> Iterator[Path]:
    """The buffers and pictures that a glTF of JSON names, whether they are there or not."""
    document = json.loads(path.read_bytes())
    uris = [part.get("uri", "data:") for kind in ("buffers", "images") for part in document.get(kind, [])]
    yield from (beside(path.parent, unquote(uri)) for uri in uris if not uri.startswith("data:"))


def _materials(path: Path) -> dict[str, Material]:
    """The materials of an MTL file by name; what cannot be read is named, and counts as white."""
    found: dict[str, Material] = {}
    name = ""
    if not path.is_file():
        print(f"note: {path} is not there: the mesh has no colours of its materials", flush=True)
        return found
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        word, rest = (*line.split(None, 1), "", "")[:2]
        if word == "newmtl":
            name = rest.strip()
            found[name] = Material()
        elif word.lower() == "kd" and name:
            color = tuple(255 * float(cell) for cell in rest.split("#")[0].split()[:3])
            found[name] = replace(found[name], color=color if len(color) == 3 else Material.color)
        elif word.lower() == "map_kd" and name:
            options = OPTIONS.match(rest)
            picture = partial(picture_of, beside(path.parent, rest[options.end() if options else 0 :]))
            found[name] = replace(found[name], picture=picture, place=_placed(options[0] if options else ""))
    return found


def _placed(options: str) -> Array:
    """Where a texture lies, by its options -s (scale) and -o (offset)."""
    place = np.eye(2, 3)
    for letter, numbers in re.findall(r"-([so])((?:\s+[-+]?[\d.]\S*)+)", options):
        first = np.array([float(cell) for cell in numbers.split()[:2]])
        place[np.arange(len(first)), np.arange(len(first)) if letter == "s" else 2] = first
    return place


def picture_of(file: Path) -> NDArray[np.uint8] | None:
    """The picture in a file; None, and a note, where it cannot be read."""
    return _picture(file.read_bytes() if file.is_file() else b"", str(file))


def _picture(content: bytes, name: str) -> NDArray[np.uint8] | None:
    """An encoded picture as (H, W, 3) RGB; None, and a note, where it cannot be read."""
    import cv2
    from PIL import Image

    found = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if content else None
    if found is not None:
        return np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2RGB), np.uint8)
    try:
        with Image.open(io.BytesIO(content)) as picture:  # TGA, DDS and others
            return np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, Image.DecompressionBombError):
        print(f"note: the texture {name} cannot be read: its faces have their material's colour", flush=True)
        return None


def read_gltf(path: Path) -> Columns:
    """glTF 2.0, in one file (GLB) or JSON with files beside it: all meshes of its scene at their places, turned so that
    z is up (glTF says that y is); where it has points alone, these.

    Raises:
        ValueError: it is no glTF, holds neither triangles nor points, or its meshes are compressed.
    """
    content = _Gltf.of(path)
    document = content.document
    unread = sorted(name for name in document.get("extensionsUsed", []) if not READ_EXTENSIONS.match(name))
    if packed := [name for name in unread if name.endswith("_compression")]:
        raise ValueError(f"its meshes are compressed by {packed[0]}: export them without")
    if unread:
        print(f"note: {path.name} uses {', '.join(unread)}, which is not read", flush=True)
    upright = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    scenes, nodes = document.get("scenes"), document.get("nodes", [])
    tops = {*range(len(nodes))}.difference(*(node.get("children", []) for node in nodes))
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else sorted(tops)
    parts = [part for root in roots for part in content.parts(root, upright)]
    if not parts:
        raise ValueError("it holds no triangles and no points")
    starts = np.cumsum([0] + [len(part.vertices) for part in parts])
    colors = [np.full(part.vertices.shape, np.nan) if part.colors is None else part.colors for part in parts]
    mesh = Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts)]),
        None if all(part.colors is None for part in parts) else np.concatenate(colors),
        np.concatenate([np.full((len(p.faces), 3, 2), np.nan) if p.uvs is None else p.uvs for p in parts]),
        np.concatenate([part.material for part in parts]),
        tuple(content.material(number) for number in range(len(document.get("materials", [])))),
    )
    if not len(mesh.faces):
        return _points(mesh.vertices, mesh.colors)
    if not all(len(part.faces) for part in parts):
        print("note: points of the glTF are left out; triangles are read", flush=True)
    return sampled_columns(mesh)


@dataclass(frozen=True)
class _Gltf:
    """The JSON of a glTF, its buffers, and the folder of the files that it names."""

    document: dict[str, Any]
    buffers: list[bytes]
    folder: Path

    @classmethod
    def of(cls, path: Path) -> "_Gltf":
        """A file with what lies beside it; StageError where a part is missing or cut short."""
        content, blob = path.read_bytes(), b""
        if content[:4] == b"glTF" and len(content) >= 20:
            if missing := max(int.from_bytes(content[8:12], "little") - len(content), 0):
                raise StageError(f"{path} is cut short: its last {missing} bytes are missing; copy it again")
            length = int.from_bytes(content[12:16], "little")
            content, blob = content[20 : 20 + length], content[28 + length :]
        elif not content.lstrip(codecs.BOM_UTF8 + b" \t\r\n").startswith(b"{"):
            raise ValueError("it does not begin as glTF does")
        found = cls(json.loads(content), [], path.parent)
        for about in found.document.get("buffers", [{}]):
            buffer = found.content(about["uri"]) if "uri" in about else blob
            if len(buffer) < about.get("byteLength", 0):
                name = about.get("uri", "data")[:60]
                raise StageError(f"{path}: its {name} is missing or cut short; put it beside it, or copy it again")
            found.buffers.append(buffer)
        return found

    def content(self, uri: str) -> bytes:
        """What an address in the document says, or names in its folder; nothing where that is not there."""
        if uri.startswith("data:"):
            return b64decode(uri.partition(",")[2])
        file = beside(self.folder, unquote(uri))
        return file.read_bytes() if file.is_file() else b""

    def parts(self, node: int, outer: Array) -> list[Mesh]:
        """The triangles below a node, in the frame that `outer` (4, 4) leads to."""
        about = self.document["nodes"][node]
        own = _poses({part: np.array([about[part.lower()]], float) for part in INSTANCE_PARTS if part.lower() in about})
        own = np.array(about["matrix"], float).reshape(4, 4).T[None] if "matrix" in about else own
        pose, found = outer @ own[0], list[Mesh]()
        for primitive in self.document["meshes"][about["mesh"]]["primitives"] if "mesh" in about else []:
            faces = self.faces(primitive)
            if faces is None:
                print("note: lines of the glTF are left out", flush=True)
                continue
            names, number = primitive["attributes"], primitive.get("material", -1)
            vertices = self.values(names["POSITION"])
            colors = self.colors(names["COLOR_0"]) if "COLOR_0" in names else None
            uvs = None
            if number >= 0 and (place := f"TEXCOORD_{self.texture(number).get('texCoord', 0)}") in names:
                uvs = self.values(names[place])[faces]
            for instance in self.instances(about):
                turn = pose @ instance
                corners = faces if np.linalg.det(turn[:3, :3]) > 0 else faces[:, ::-1]
                own_uvs = uvs if uvs is None or corners is faces else uvs[:, ::-1]
                moved = vertices @ turn[:3, :3].T + turn[:3, 3]
                found.append(Mesh(moved, corners, colors, own_uvs, np.full(len(faces), number)))
        return found + [part for child in about.get("children", []) for part in self.parts(child, pose)]

    def faces(self, primitive: dict[str, Any]) -> NDArray[np.int64] | None:
        """The triangles (F, 3) of triangles, a strip or a fan (glTF 2.0, 3.7.2.1), none of points; None of lines."""
        count = self.document["accessors"][primitive["attributes"]["POSITION"]]["count"]
        index = np.arange(count)
        if "indices" in primitive:
            index = self.values(primitive["indices"]).astype(np.int64).ravel()
            if index.size and index.max() >= count:
                raise ValueError("its faces name vertices that it does not have")
        mode, each = primitive.get("mode", 4), np.arange(len(index) - 2)
        if mode in (0, 4):
            return index[: len(index) // 3 * 3 if mode else 0].reshape(-1, 3)
        if mode == 5:
            return of_strip(index)
        return index[np.stack([each + 1, each + 2, np.zeros_like(each)], axis=1)] if mode == 6 else None

    def instances(self, node: dict[str, Any]) -> Array:
        """(N, 4, 4) where copies of a node's mesh stand in it, by EXT_mesh_gpu_instancing."""
        names = node.get("extensions", {}).get("EXT_mesh_gpu_instancing", {}).get("attributes", {})
        return _poses({name: self.values(names[name]) for name in INSTANCE_PARTS if name in names})

    def values(self, accessor: int) -> Array:
        """(N, K) values of an accessor; normalised integers as fractions."""
        about = self.document["accessors"][accessor]
        width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[about["type"]]
        kind, count = _kind(about), about["count"]
        if "bufferView" in about:
            table = self.stored(about, kind, count, width).astype(np.float64)
        elif count > 256 * AT_ONCE:
            raise ValueError("it counts more values than a file holds")
        else:
            table = np.zeros((count, width))
        if "sparse" in about:
            sparse = about["sparse"]
            rows = self.stored(sparse["indices"], _kind(sparse["indices"]), sparse["count"], 1)[:, 0]
            table[rows] = self.stored(sparse["values"], kind, sparse["count"], width)
        return np.maximum(table / np.iinfo(kind).max, -1) if about.get("normalized") else table

    def colors(self, accessor: int) -> Array:
        """(N, 3) colours of vertices, 0..255. glTF's are linear (2.0, 3.9.2), as Blender writes them in 16 bits; what
        trimesh and Open3D write as bytes and real numbers is as in pictures."""
        shares = self.values(accessor)[:, :3]
        return _as_in_pictures(shares) if _kind(self.document["accessors"][accessor]) == np.uint16 else 255 * shares

    def stored(self, about: dict[str, Any], kind: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        """(N, K) numbers that lie in a buffer."""
        view = self.document["bufferViews"][about["bufferView"]]
        start = view.get("byteOffset", 0) + about.get("byteOffset", 0)
        step = view.get("byteStride", kind.itemsize * width)
        return np.ndarray((count, width), kind, self.buffers[view["buffer"]], start, (step, kind.itemsize))

    def painted(self, material: int) -> tuple[dict[str, Any], list[float]]:
        """What a material says of its texture, and its colour: by its base colour, as a diffuse one (older exports),
        or, of one that shines and has no texture else, by its light."""
        about = self.document["materials"][material]
        base, old = about.get("pbrMetallicRoughness", {}), about.get("extensions", {}).get(DIFFUSE)
        if old is not None:
            return old.get("diffuseTexture", {}), old.get("diffuseFactor", [1, 1, 1])
        if "emissiveTexture" in about and "baseColorTexture" not in base:
            return about["emissiveTexture"], about.get("emissiveFactor", [1, 1, 1])
        return base.get("baseColorTexture", {}), base.get("baseColorFactor", [1, 1, 1])

    def texture(self, material: int) -> dict[str, Any]:
        """What a material says of its texture: `index`, and `texCoord`, `offset`, `scale`, `rotation` of its places."""
        about = self.painted(material)[0]
        return about | about.get("extensions", {}).get("KHR_texture_transform", {})

    def material(self, number: int) -> Material:
        """A material's colour and picture."""
        color = tuple(np.rint(_as_in_pictures(np.array(self.painted(number)[1][:3], float))))
        texture = self.texture(number)
        if "index" not in texture:
            return Material(None, color)
        sources = self.document["textures"][texture["index"]]
        source = sources.get("extensions", {}).get("EXT_texture_webp", sources).get("source")
        image = {} if source is None else self.document["images"][source]
        if "bufferView" in image:
            view = self.document["bufferViews"][image["bufferView"]]
            start = view.get("byteOffset", 0)
            encoded = self.buffers[view["buffer"]][start : start + view["byteLength"]]
        else:
            encoded = self.content(image["uri"]) if "uri" in image else b""
        picture = partial(_picture, encoded, image.get("name", f"number {source}"))
        cos, sin = np.cos(texture.get("rotation", 0.0)), np.sin(texture.get("rotation", 0.0))
        place = np.eye(3)
        place[:2, :2] = np.array([[cos, -sin], [sin, cos]]) * texture.get("scale", [1, 1])
        place[:2, 2] = texture.get("offset", [0, 0])
        down = np.array([[1.0, 0, 0], [0, -1.0, 1], [0, 0, 1]])  # glTF counts from the upper edge
        return Material(picture, color, (down @ place)[:2])


def _as_in_pictures(shares: Array) -> Array:
    """Linear colours, 0..1, as pictures have them, 0..255 (IEC 61966-2-1)."""
    return 255 * np.where(shares <= 0.0031308, 12.92 * shares, 1.055 * shares ** (1 / 2.4) - 0.055)


def _poses(parts: dict[str, Array]) -> Array:
    """(N, 4, 4) of translations, rotations and scales (N, K); one that changes nothing where there are none."""
    from scipy.spatial.transform import Rotation

    poses = np.tile(np.eye(4), (len(next(iter(parts.values()), [0])), 1, 1))
    if "ROTATION" in parts:
        poses[:, :3, :3] = Rotation.from_quat(parts["ROTATION"]).as_matrix()
    poses[:, :3, :3] *= parts.get("SCALE", np.ones((1, 3)))[:, None]
    poses[:, :3, 3] = parts.get("TRANSLATION", 0.0)
    return poses


def _kind(about: dict[str, Any]) -> np.dtype[Any]:
    """The type of an accessor's numbers (glTF 2.0, 3.6.2.2)."""
    kinds = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
    return np.dtype(kinds[about["componentType"]])
