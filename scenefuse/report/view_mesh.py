"""The mesh of an exported object in its 3D view, beside the points: with photos on it, class and standard deviation."""

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud
from scenefuse.cloud.tiled_cloud import morton
from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array
from scenefuse.photos.sheets import TILE_PX
from scenefuse.report.facts import has_surface
from scenefuse.report.view import Bytes, color_planes, difference_planes, log_levels
from scenefuse.surface.gltf import metres_per_unit, read_painted
from scenefuse.surface.make_surface import read_surface
from scenefuse.surface.mesh import Rows
from scenefuse.surface.texture import simplified


@dataclass(frozen=True)
class ViewMesh:
    """A mesh in the scene's frame.

    Attributes:
        vertices: V of them, with the fields `class` and `deviation`, and colours where there is no picture.
        faces: (F, 3) rows of vertices.
        uv: (V, 2) places in the picture, from its upper left, 0..1; None without a picture.
        picture: of the photos, small enough for a page.
        all_faces: how many the surface has of which this is a simplification.
    """

    vertices: Cloud
    faces: Rows
    uv: Array | None
    picture: Image.Image | None
    all_faces: int


def read_mesh(folder: Path, unit: str) -> ViewMesh | None:
    """The surface in an object's results, simplified; None where there is none.

    Args:
        folder: results of the object.
        unit: of the scene's lengths.
    """
    whole = read_surface(folder / "surface.ply") if has_surface(folder) else None
    if whole is None or not len(whole.faces):
        return None
    painted = read_painted(folder / "surface.glb")
    if painted is None:
        small = simplified(whole)
        return ViewMesh(small.vertices, small.faces, None, None, len(whole.faces))
    points = painted.points / metres_per_unit(unit)
    nearest = cKDTree(whole.vertices.points).query(points, workers=threads())[1]
    fields = {"class": np.zeros(len(points), np.uint8), "deviation": whole.vertices.fields["deviation"][nearest]}
    # A vertex of the GLB has faces of one class only.
    fields["class"][painted.faces] = painted.classes[:, None]
    picture = Image.fromarray(painted.picture)
    # As large as the widest pictures of the page.
    picture.thumbnail((3 * TILE_PX[0], 3 * TILE_PX[0]))
    return ViewMesh(Cloud(points, fields=fields), painted.faces, painted.uv, picture, len(whole.faces))


def encode_mesh(mesh: ViewMesh, middle: Array, deviations: list[float] | None) -> tuple[dict[str, Any], bytes]:
    """A mesh as what the page's script reads, as `encode` does with points.

    Args:
        mesh: to encode.
        middle: (3,) what the page's positions are relative to.
        deviations: ends of the scale of standard deviations; None where they are not shown.

    Returns:
        A description for JSON, and zlib-compressed planes: those of the vertices, then those of the faces.
    """
    points = mesh.vertices.points
    low = points.min(0)
    step = np.maximum(np.ptp(points, axis=0), 1e-12) / 65535
    cells = np.rint((points - low) / step).astype(np.int64)
    order = np.argsort(morton(cells), kind="stable")
    vertices, planes = mesh.vertices[order], dict[str, Bytes]()
    for name, column in zip("xyz", cells[order].T):
        planes |= difference_planes(name, column)
    if mesh.uv is None:
        planes |= color_planes(vertices)
    else:
        for name, column in zip("uv", np.rint(mesh.uv[order] * 65535).astype(np.int64).T):
            planes |= difference_planes(name, column)
    planes["evidence"] = vertices.fields["class"]
    if deviations:
        planes["deviation"] = log_levels(np.nan_to_num(vertices.fields["deviation"], posinf=0.0), *deviations)
    about = {
        "vertices": len(vertices),
        "faces": len(mesh.faces),
        "all_faces": mesh.all_faces,
        "middle": middle.tolist(),
        "step": step.tolist(),
        "corner": (low - middle).tolist(),
        "planes": list(planes),
    }
    packed = [*(plane.tobytes() for plane in planes.values()), _face_bytes(order, mesh.faces)]
    return about, zlib.compress(b"".join(packed), 9)


def _face_bytes(order: Rows, faces: Rows) -> bytes:
    """Nine planes of a byte a face: by how much its first row exceeds that of the face before, and its others the
    first, each in three bytes; rows are those of the vertices in that order."""
    faces = np.argsort(order)[faces]
    turn = (faces.argmin(1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    columns = np.column_stack([np.diff(faces[:, 0], prepend=0), faces[:, 1:] - faces[:, :1]])
    return np.stack([columns.T >> shift & 255 for shift in (0, 8, 16)], axis=1).astype(np.uint8).tobytes()
