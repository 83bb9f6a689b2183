"""Texture of a surface from photos: each texel from the photos that show its face best (method F8).

Sources: Waechter et al. 2014 (photos by footprint, angle and visibility; exposures levelled), UVAtlas (Sander et al.
2003) by Open3D.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.stage import StageError, threads
from scenefuse.core.transforms import Array
from scenefuse.fuse.compare import MARGIN
from scenefuse.fuse.write import GAINS
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS, MIN_COSINE
from scenefuse.photos.frames import sharpness
from scenefuse.photos.workspace import View
from scenefuse.surface.gltf import NO_COLOR
from scenefuse.surface.mesh import AT_ONCE, FaceClass, Rows, Surface, cast, caster, normals_of

# Faces that a textured surface is simplified to: what is finer is in its picture, and to unfold more takes minutes.
TEXTURED_FACES = 40_000
# Parts that are unfolded by themselves: eight take a fifth of the time of one, and fill as much of the picture.
PARTS = 8
# Longest side of the picture, that all graphics cards take.
MAX_SIDE_PX = 8192


@dataclass(frozen=True)
class Textured:
    """A simplified surface and its picture.

    Attributes:
        surface: F faces.
        uv: (F, 3, 2) places of their corners in the picture, from its upper left, 0..1.
        picture: (H, W, 3) uint8.
        shown_share: of the area that is to be painted, what photos show; the rest has those of the points, or grey.
    """

    surface: Surface
    uv: Array
    picture: NDArray[np.uint8]
    shown_share: float


def textured(surface: Surface, photos: list[View], read: Callable[[int], NDArray[np.uint8]]) -> Textured | None:
    """Paint a surface, except where it is bridged. One photo at a time is in memory.

    Args:
        surface: as made.
        photos: V cameras in its frame.
        read: the (H, W, 3) uint8 pixels of one of them.

    Returns:
        None where no photo shows any of its faces.
    """
    small = simplified(surface)
    worth, gains = _worth(small, surface, photos, read)
    painted = np.flatnonzero((small.classes != FaceClass.BRIDGED) & (small.areas() > 0))
    if not len(painted) or not (worth[:, painted] > 0).any():
        return None
    points, faces = small.vertices.points, small.faces[painted]
    pixels = _footprints(small, photos).max(0)[painted]
    # Unfolded pieces cover about half of a picture.
    wanted = 2 * small.areas()[painted].sum() * np.median(pixels[pixels > 0])
    side = int(np.clip(np.sqrt(wanted), 64, MAX_SIDE_PX))
    uv = unfolded(points, faces, side)
    face, weights, places = texels_of_faces(points, faces, uv, side)
    of_face, of_vertex = best_worth(worth[:, painted]), vertex_worth(worth[:, painted], faces, len(points))
    color, weight = np.zeros((len(face), 3)), np.zeros(len(face))
    for number, view in enumerate(photos):
        # From corner to corner, so that no step is seen between faces; a face by itself where corners see nothing.
        corners, alone = of_vertex[number][faces], 1e-6 * of_face[number]
        rows = np.flatnonzero((corners.any(1) | (alone > 0))[face[:, 2]])
        if not len(rows):
            continue
        share = (corners[face[rows, 2]] * weights[rows]).sum(1) + alone[face[rows, 2]]
        pixels = read(number)
        at = view.project(places[rows])[0][:, ::-1].T - 0.5
        found = np.stack([map_coordinates(pixels[..., k], at, np.float64, 1, mode="nearest") for k in range(3)], 1)
        color[rows] += share[:, None] * gains[number] * found
        weight[rows] += share
    shown = weight > 0
    color[shown] /= weight[shown, None]
    if small.vertices.colors is None:
        color[~shown] = NO_COLOR
    elif not shown.all():
        own = cKDTree(points).query(places[~shown], workers=threads())[1]
        color[~shown] = small.vertices.colors[own]
    picture = np.zeros((side, side, 3), np.uint8)
    filled = np.zeros((side, side), dtype=bool)
    picture[face[:, 1], face[:, 0]] = np.clip(np.rint(color), 0, 255)
    filled[face[:, 1], face[:, 0]] = True
    # Beyond the borders of the pieces colours go on, so that none bleeds in.
    near = distance_transform_edt(~filled, return_distances=False, return_indices=True)
    corners = np.zeros((len(small.faces), 3, 2))
    corners[painted] = uv
    return Textured(small, corners, picture[tuple(near)], float(shown.mean()))


def simplified(surface: Surface, faces: int = TEXTURED_FACES) -> Surface:
    """The surface with fewer faces, whose classes and fields are those of the nearest before."""
    import open3d as o3d

    if len(surface.faces) <= faces:
        return surface
    middle = surface.vertices.points.mean(0)
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(surface.vertices.points - middle),
        o3d.utility.Vector3iVector(surface.faces.astype(np.int32)),
    )
    mesh = mesh.simplify_quadric_decimation(faces, boundary_weight=10.0)
    mesh.remove_degenerate_triangles()
    mesh.remove_unreferenced_vertices()
    mesh.compute_vertex_normals()
    points, triangles = np.asarray(mesh.vertices) + middle, np.asarray(mesh.triangles).astype(np.int64)
    before = surface.vertices.points[surface.faces].mean(1)
    near = cKDTree(before).query(points[triangles].mean(1), workers=threads())[1]
    own = cKDTree(surface.vertices.points).query(points, workers=threads())[1]
    vertices = surface.vertices[own]
    vertices = Cloud(points, np.asarray(mesh.vertex_normals).astype(np.float32), vertices.colors, vertices.fields)
    return replace(surface, vertices=vertices, faces=triangles, classes=surface.classes[near])


def _footprints(surface: Surface, photos: list[View]) -> Array:
    """(V, F) pixels that a unit of a face's area has in each photo that it is in, seen from its front; else 0."""
    corners = surface.vertices.points[surface.faces]
    middle, normals = corners.mean(1), normals_of(corners)
    found = np.zeros((len(photos), len(middle)))
    for row, view in zip(found, photos):
        rows, _, depth = view.visible(middle)
        towards = view.centre - middle[rows]
        cosine = (towards * normals[rows]).sum(1) / np.linalg.norm(towards, axis=1)
        pixels = cosine * view.intrinsics[0, 0] * view.intrinsics[1, 1] / depth**2
        row[rows] = np.where(cosine >= MIN_COSINE, pixels, 0)
    return found


def _worth(
    small: Surface, whole: Surface, photos: list[View], read: Callable[[int], NDArray[np.uint8]]
) -> tuple[Array, Array]:
    """How well each photo shows each face (V, F), and the factors of its channels (V, 3).

    The worth is the footprint times the photo's sharpness; 0 where the face is hidden, out of the picture or seen from
    behind. The factors bring a photo to the colours of the points, which are of one exposure.
    """
    worth, gains = _footprints(small, photos), np.ones((len(photos), 3))
    middle, scene = small.vertices.points[small.faces].mean(1), caster(whole.vertices.points, whole.faces)
    own = None if small.vertices.colors is None else small.vertices.colors[small.faces].mean(1)
    tolerance = MARGIN * whole.vertices.diagonal
    for number, view in enumerate(photos):
        rows = np.flatnonzero(worth[number])
        rays = middle[rows] - view.centre
        before = (1 - cast(scene, view.centre, rays)["t_hit"]) * np.linalg.norm(rays, axis=1)
        worth[number, rows] *= before <= tolerance
        rows = np.flatnonzero(worth[number])
        if not len(rows):
            continue
        pixels = read(number)
        worth[number] *= sharpness(pixels)
        if own is not None:
            at = view.visible(middle[rows])[1]
            ratio = own[rows] / np.maximum(pixels[at[:, 1], at[:, 0]], 1.0)
            gains[number] = np.clip(np.median(ratio, axis=0), *GAINS)
    return worth, gains


def unfolded(points: Array, faces: Rows, side: int) -> Array:
    """(F, 3, 2) places of the faces' corners in a picture of a side, from its upper left, 0..1."""
    import open3d as o3d

    tensor = o3d.core.Tensor.from_numpy
    loose = beyond_manifold(faces)
    corners = np.append(points, points[faces[loose]].reshape(-1, 3), axis=0) - points.mean(0)
    faces = faces.copy()
    faces[loose] = np.arange(len(points), len(corners)).reshape(-1, 3)
    mesh = o3d.t.geometry.TriangleMesh(tensor(corners.astype(np.float32)), tensor(faces))
    try:
        mesh.compute_uvatlas(size=side, parallel_partitions=PARTS, nthreads=threads())
    except RuntimeError as error:
        raise StageError(f"UVAtlas cannot unfold the surface ({str(error).rsplit(':', 1)[-1].strip()})") from None
    uv = mesh.triangle.texture_uvs.numpy().astype(np.float64)
    return np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1)


def beyond_manifold(faces: Rows) -> NDArray[np.bool_]:
    """(F,) faces with an edge in the direction in which another has it already, or with two edges of another: UVAtlas
    takes a manifold only, in which neighbours share one edge."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    first = np.unique(edges, axis=0, return_index=True)[1]
    again = np.ones(len(edges), dtype=bool)
    again[first] = False
    loose: NDArray[np.bool_] = np.asarray(again.reshape(-1, 3).any(1))
    edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(np.diff(edge[order]) == 0)
    pairs, count = np.unique(np.stack([order[same], order[same + 1]], axis=1) // 3, axis=0, return_counts=True)
    loose[pairs[count > 1, 1]] = True
    return loose


def best_worth(worth: Array) -> Array:
    """(V, N) the worth of the photos that show each face or corner best; 0 of the others."""
    best = np.argsort(-worth, axis=0)[:CONFIRMING_PHOTOS]
    kept = np.zeros_like(worth)
    np.put_along_axis(kept, best, np.take_along_axis(worth, best, axis=0), axis=0)
    return kept


def vertex_worth(worth: Array, faces: Rows, count: int) -> Array:
    """(V, N) the same of corners: the least of their faces, so that a photo fades out towards what it does not show."""
    least = np.full((len(worth), count), np.inf)
    for corner in faces.T:
        for own, row in zip(least, worth):
            np.minimum.at(own, corner, row)
    return best_worth(np.where(np.isfinite(least), least, 0.0))


def texels_of_faces(points: Array, faces: Rows, uv: Array, side: int) -> tuple[Rows, Array, Array]:
    """(T, 3) column and row of the texels on faces, and which face; (T, 3) weights of its corners, and the places
    (T, 3) that they show."""
    flat = np.column_stack([uv.reshape(-1, 2) * side, np.zeros(3 * len(faces))])
    scene = caster(flat, np.arange(len(flat)).reshape(-1, 3))
    texels, weights, places = list[Rows](), list[Array](), list[Array]()
    for rows in np.array_split(np.arange(side), -(-(side**2) // AT_ONCE)):
        column, row = (a.ravel() for a in np.meshgrid(np.arange(side), rows))
        origins = np.column_stack([column + 0.5, row + 0.5, np.full(len(row), -1.0)])
        hit = cast(scene, origins, np.tile([0.0, 0, 1], (len(row), 1)))
        on = np.isfinite(hit["t_hit"])
        face = hit["primitive_ids"][on].astype(np.int64)
        b, c = hit["primitive_uvs"][on].T
        weights.append(np.column_stack([1 - b - c, b, c]))
        places.append((points[faces[face]] * weights[-1][..., None]).sum(1))
        texels.append(np.column_stack([column[on], row[on], face]))
    return np.concatenate(texels), np.concatenate(weights), np.concatenate(places)
