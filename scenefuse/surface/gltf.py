"""GLB files: metres, right-handed, y up; each class of faces with its own feature id and material.

Sources: glTF 2.0 (Khronos), EXT_mesh_features (Cesium), KHR_materials_unlit (photos hold their own light).
"""

import io
import json
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from PIL import Image
from pyproj.database import get_units_map

from scenefuse.cloud.clouds import Cloud
from scenefuse.cloud.crs import has_place
from scenefuse.core.stage import atomic_file, read_json, value
from scenefuse.core.transforms import Array
from scenefuse.core.version import VERSION
from scenefuse.photos.geodesy import length_unit, scene_frame
from scenefuse.surface.mesh import FaceClass, Surface

# (x, y, z) east, north, up to glTF's x east, y up, z south.
Y_UP_FROM_Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
# What nobody measured is drawn in one colour (sRGB), which photos of objects hardly hold.
BRIDGED_TINT = (203, 89, 188)
# What has no colour.
NO_COLOR = (160, 160, 160)
# What `asset.extras` says of feature ids of faces.
CLASSES = {"classes": {kind.name.lower(): int(kind) for kind in FaceClass}}


class _Code(IntEnum):
    """glTF's codes of component types and of buffers."""

    FLOAT = 5126
    UNSIGNED_SHORT = 5123
    UNSIGNED_INT = 5125
    VERTEX_BUFFER = 34962
    INDEX_BUFFER = 34963


class _Buffer:
    """The binary part of a GLB, and what its JSON says of it."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.length = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, data: bytes, target: int | None = None) -> int:
        """A view of some bytes, by its number."""
        self.views.append({"buffer": 0, "byteOffset": self.length, "byteLength": len(data)})
        if target:
            self.views[-1]["target"] = target
        padded = data + b"\0" * (-len(data) % 4)
        self.parts.append(padded)
        self.length += len(padded)
        return len(self.views) - 1

    def accessor(self, values: NDArray[Any], kind: str, component: int, **more: Any) -> int:
        """An accessor of rows of values, by its number."""
        target = _Code.INDEX_BUFFER if component == _Code.UNSIGNED_INT else _Code.VERTEX_BUFFER
        view = self.add(np.ascontiguousarray(values).tobytes(), target)
        entry = {"bufferView": view, "componentType": component, "count": len(values), "type": kind, **more}
        self.accessors.append(entry)
        return len(self.accessors) - 1


def write_glb(
    path: Path,
    surface: Surface,
    extras: dict[str, Any],
    metres: float = 1.0,
    uv: Array | None = None,
    picture: NDArray[np.uint8] | None = None,
) -> None:
    """Write a surface, a primitive for each class of its faces; a file without meshes where it has no faces.

    Args:
        path: output.
        surface: with z up.
        extras: goes into `asset.extras`.
        metres: per unit of the surface.
        uv: (F, 3, 2) places of the faces' corners in the picture, from its upper left, 0..1; None for vertex colours.
        picture: (H, W, 3) uint8, what photos show.
    """
    buffer, primitives = _Buffer(), list[dict[str, Any]]()
    for kind in FaceClass:
        chosen = surface.classes == kind
        if chosen.any():
            corners = uv[chosen] if uv is not None and kind != FaceClass.BRIDGED else None
            primitives.append(_primitive(buffer, surface.part(chosen), kind, metres, corners))
    unlit: dict[str, Any] = {"extensions": {"KHR_materials_unlit": {}}, "doubleSided": True}
    colored: dict[str, Any] = {"name": "photos", "pbrMetallicRoughness": {"metallicFactor": 0.0}, **unlit}
    tinted = {
        "name": "bridged",
        "pbrMetallicRoughness": {"baseColorFactor": [*_linear(np.array(BRIDGED_TINT)), 1.0]},
        **unlit,
    }
    content: dict[str, Any] = {"materials": [colored, tinted]}
    if picture is not None and uv is not None and primitives:
        encoded = io.BytesIO()
        Image.fromarray(picture).save(encoded, "JPEG", quality=90)
        content["images"] = [{"bufferView": buffer.add(encoded.getvalue()), "mimeType": "image/jpeg"}]
        content["textures"] = [{"source": 0}]
        colored["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    _write(path, buffer, primitives, extras | CLASSES, content)


def write_points(path: Path, cloud: Cloud, extras: dict[str, Any]) -> None:
    """Write points, z up and in metres, with their colours and, where they have it, `source` and `evidence` as feature
    ids."""
    buffer = _Buffer()
    attributes = _attributes(buffer, cloud.points, cloud.colors)
    primitive: dict[str, Any] = {"mode": 0, "attributes": attributes, "material": 0}
    ids = list[dict[str, Any]]()
    for name in filter(cloud.fields.__contains__, ("source", "evidence")):
        values = cloud.fields[name].astype(np.float32)
        attributes[f"_FEATURE_ID_{len(ids)}"] = buffer.accessor(values, "SCALAR", _Code.FLOAT)
        ids.append({"featureCount": int(values.max()) + 1, "attribute": len(ids), "label": name})
    if ids:
        primitive["extensions"] = {"EXT_mesh_features": {"featureIds": ids}}
    _write(path, buffer, [primitive], extras, {"materials": [{"extensions": {"KHR_materials_unlit": {}}}]})


def _write(
    path: Path, buffer: _Buffer, primitives: list[dict[str, Any]], extras: dict[str, Any], more: dict[str, Any]
) -> None:
    """Write a GLB of one mesh, or of none where it has no primitives."""
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"scenefuse {VERSION}", "extras": extras},
        "scene": 0,
        "scenes": [{"nodes": [0]} if primitives else {}],
    }
    if primitives:
        used = sorted({name for primitive in primitives for name in primitive.get("extensions", ())})
        content |= {
            "extensionsUsed": [*used, "KHR_materials_unlit"],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": primitives}],
            **more,
            "bufferViews": buffer.views,
            "accessors": buffer.accessors,
            "buffers": [{"byteLength": buffer.length}],
        }
    text = json.dumps(content, allow_nan=False).encode()
    chunks = [(b"JSON", text + b" " * (-len(text) % 4))]
    chunks += [(b"BIN\0", b"".join(buffer.parts))] if primitives else []
    body = b"".join(struct.pack("<I4s", len(data), name) + data for name, data in chunks)
    with atomic_file(path) as temporary:
        temporary.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)


@dataclass(frozen=True)
class Painted:
    """A mesh with its picture, as a GLB holds it, z up again.

    Attributes:
        points: (V, 3) metres; each has faces of one class.
        faces: (F, 3).
        classes: (F,) values of FaceClass.
        uv: (V, 2) places in the picture, from its upper left, 0..1; 0 of bridged faces.
        picture: (H, W, 3) uint8.
    """

    points: Array
    faces: NDArray[np.int64]
    classes: NDArray[np.uint8]
    uv: Array
    picture: NDArray[np.uint8]

    @property
    def shown(self) -> NDArray[np.int64]:
        """(P, 3) faces that photos paint."""
        return self.faces[self.classes != FaceClass.BRIDGED]


def read_painted(path: Path) -> Painted | None:
    """What `write_glb` wrote with a picture; None where there is none."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    content, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    if "images" not in content:
        return None

    def view(number: int) -> bytes:
        entry = content["bufferViews"][number]
        return binary[entry["byteOffset"] : entry["byteOffset"] + entry["byteLength"]]

    def rows(number: int, kind: str, width: int) -> NDArray[Any]:
        return np.frombuffer(view(content["accessors"][number]["bufferView"]), kind).reshape(-1, width)

    parts, count = list[tuple[NDArray[Any], ...]](), 0
    for primitive in content["meshes"][0]["primitives"]:
        names = primitive["attributes"]
        points = rows(names["POSITION"], "<f4", 3) @ Y_UP_FROM_Z_UP
        faces = rows(primitive["indices"], "<u4", 3).astype(np.int64) + count
        classes = np.full(len(faces), FaceClass[primitive["extras"]["class"].upper()], np.uint8)
        uv = rows(names["TEXCOORD_0"], "<f4", 2) if "TEXCOORD_0" in names else np.zeros((len(points), 2))
        parts.append((points, faces, classes, uv))
        count += len(points)
    picture = np.asarray(Image.open(io.BytesIO(view(content["images"][0]["bufferView"]))).convert("RGB"))
    points, faces, classes, uv = (np.concatenate(part) for part in zip(*parts))
    return Painted(points, faces, classes, uv, picture)


def _primitive(buffer: _Buffer, part: Surface, kind: FaceClass, metres: float, uv: Array | None) -> dict[str, Any]:
    """One class of faces; with `uv` (F, 3, 2), vertices that lie in several places of the picture are several."""
    vertices, faces = part.vertices, part.faces
    if uv is not None:
        keys = np.column_stack([faces.ravel(), np.round(uv.reshape(-1, 2) * 2**20)]).astype(np.int64)
        _, first, again = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        vertices, faces, places = vertices[faces.ravel()[first]], again.reshape(-1, 3), uv.reshape(-1, 2)[first]
    assert vertices.normals is not None
    length = np.linalg.norm(vertices.normals, axis=1, keepdims=True)
    normals = np.where(length > 0, vertices.normals / np.maximum(length, 1e-12), [0, 0, 1]) @ Y_UP_FROM_Z_UP.T
    colors = None if uv is not None or kind == FaceClass.BRIDGED else vertices.colors
    attributes = _attributes(buffer, metres * vertices.points, colors) | {
        "NORMAL": buffer.accessor(normals.astype(np.float32), "VEC3", _Code.FLOAT),
        "_FEATURE_ID_0": buffer.accessor(np.full(len(vertices), kind, np.float32), "SCALAR", _Code.FLOAT),
    }
    if uv is not None:
        attributes["TEXCOORD_0"] = buffer.accessor(places.astype(np.float32), "VEC2", _Code.FLOAT)
    return {
        "attributes": attributes,
        "indices": buffer.accessor(faces.astype(np.uint32).ravel(), "SCALAR", _Code.UNSIGNED_INT),
        "material": int(kind == FaceClass.BRIDGED),
        "extensions": {
            "EXT_mesh_features": {
                "featureIds": [{"featureCount": len(FaceClass), "attribute": 0, "label": "face_class"}]
            }
        },
        "extras": {"class": kind.name.lower()},
    }


def _attributes(buffer: _Buffer, points: Array, colors: NDArray[np.uint8] | None) -> dict[str, int]:
    """Positions, z up and in metres, and colours of sRGB where there are some."""
    positions = (points @ Y_UP_FROM_Z_UP.T).astype(np.float32)
    bounds = {"min": positions.min(0).tolist(), "max": positions.max(0).tolist()}
    attributes = {"POSITION": buffer.accessor(positions, "VEC3", _Code.FLOAT, **bounds)}
    if colors is not None:
        linear = _linear(colors)
        rgba = np.column_stack([np.rint(65535 * linear), np.full(len(linear), 65535)]).astype(np.uint16)
        attributes["COLOR_0"] = buffer.accessor(rgba, "VEC4", _Code.UNSIGNED_SHORT, normalized=True)
    return attributes


def _linear(colors: NDArray[Any]) -> Array:
    """Linear colours, 0..1, of those of sRGB, 0..255."""
    return np.where(colors <= 10, colors / 3294.6, ((colors / 255 + 0.055) / 1.055) ** 2.4)


def metres_per_unit(unit: str) -> float:
    """Metres in a unit of lengths by its name; 1 where that is unknown."""
    names = {known.name: known.conv_factor for known in get_units_map("EPSG", "linear").values()}
    return names.get(unit, 1.0)


def place_of_scene(georeference_json: Path | None) -> dict[str, Any]:
    """What `asset.extras` says of the frame of a scene's surfaces and of its place in the world."""
    known = {} if georeference_json is None else read_json(georeference_json)
    frame = scene_frame(known)
    compass = ": x east, z south" if frame is not None and frame.has_north else ""
    content = {
        "axes": f"y up; x, y, z here are x, z, -y in the scene{compass}",
        "scene_unit": length_unit(georeference_json),
    }
    names = ("crs", "origin_in_crs", "crs_from_scene")
    return content | {name: value(known, name) for name in names if name in known}


def earth_from_scene(georeference_json: Path | None, about: Array) -> Array | None:
    """(4, 4) from a scene's frame to Earth-centred coordinates (EPSG:4978, m), right at a place (3,) of the scene; None
    without place.

    Heights are taken as those above the ellipsoid.
    """
    frame = None if georeference_json is None else scene_frame(read_json(georeference_json))
    if frame is None or not has_place(frame.crs):
        return None
    to_earth = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978")
    return map_about(about, lambda points: to_earth.transform(*frame.inverse(points).T))


def map_about(about: Array, to_earth: Callable[[Array], Sequence[Array]]) -> Array:
    """(4, 4) of a map of points (N, 3) to their x, y, z on Earth, right at a place (3,): elsewhere it is bent."""
    step, matrix = 100.0, np.eye(4)
    origin, *ends = np.column_stack(to_earth(about + step * np.vstack([np.zeros(3), np.eye(3)])))
    matrix[:3, :3] = (np.array(ends) - origin).T / step
    matrix[:3, 3] = origin - matrix[:3, :3] @ about
    return matrix
