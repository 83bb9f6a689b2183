"""The surface of a completed cloud, each face classed by what photos know of the place (method F7).

Screened Poisson (Kazhdan, Hoppe 2013) gives a closed candidate. What lies beside points stays, and what photos confirm
as they do points; of the rest, narrow gaps are bridged where their rim is measured and no photo sees through them, and
all else stays open.
"""

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, concatenate, spacing, voxel_downsample, within
from scenefuse.core.stage import StageError, threads
from scenefuse.core.transforms import Array
from scenefuse.fuse.compare import MARGIN, MIN_AGREEING, SAME_PLACE_SPACINGS
from scenefuse.fuse.measure import NEIGHBOURS, SUPPORT, Evidence, measure, with_evidence, with_normals
from scenefuse.geometry.depth_test import MIN_COSINE
from scenefuse.geometry.photo_check import Photos
from scenefuse.photos.workspace import View

Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Points that a surface is made from at most: memory and time grow with them.
MAX_POINTS = 1_000_000
# Widest gap that is bridged, as a share of the diagonal: where a surface bends by a right angle in the middle of a gap,
# it passes at half the width from what closes it, which is 1 % at most.
MAX_GAP = 2 * MARGIN
# Rays that are cast at once for the pixels of a picture: each takes 200 bytes.
AT_ONCE = 4_000_000
# The candidate reaches so far beyond the points' box, as a share of its longest side.
BEYOND_BOX = 1.1


class FaceClass(IntEnum):
    """Values of `class` on faces and vertices."""

    UNCONFIRMED = 0
    """Beside points that no photo confirms, or that were not checked."""
    MEASURED = 1
    """Beside points that photos confirm."""
    BRIDGED = 2
    """Interpolated over a gap."""
    PLAIN = 3
    """Beside plain points."""


@dataclass(frozen=True)
class Surface:
    """A triangle mesh in the scene's frame.

    Attributes:
        vertices: V of them, with outward normals, colours where the cloud has some, and the fields `evidence`,
            `deviation` (NaN where unknown or interpolated) and `class`.
        faces: (F, 3) rows of vertices, counter-clockwise from outside.
        classes: (F,) uint8 values of `FaceClass`.
        open_area: of the gaps that stay open, by the faces that would close them; those at the cloud's border, where
            nothing says how far the surface goes on, are not counted.
        notes: what a user should know.
    """

    vertices: Cloud
    faces: Rows
    classes: NDArray[np.uint8]
    open_area: float
    notes: tuple[str, ...] = ()

    def areas(self) -> Array:
        """(F,) of the faces."""
        a, b, c = (self.vertices.points[self.faces[:, k]] for k in range(3))
        return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)

    def part(self, chosen: Mask) -> "Surface":
        """Only the chosen faces (F,) and their vertices."""
        used, faces = np.unique(self.faces[chosen], return_inverse=True)
        return replace(
            self, vertices=self.vertices[used], faces=faces.reshape(-1, 3), classes=self.classes[chosen], open_area=0.0
        )


def make_mesh(cloud: Cloud, views: list[View], photos: Photos | None = None) -> Surface:
    """The surface of a completed cloud.

    Args:
        cloud: of an object and its surroundings; the field `evidence` says which points photos confirm.
        views: the photos of both sides in its frame; without any, nothing shows that a gap is empty space.
        photos: of the side that shows it best; they confirm faces between points.

    Raises:
        StageError: the points lie in a line or in one place, or are too few to have a surface.
    """
    notes = []
    # As in a scan that was merged twice.
    cloud = cloud[np.sort(np.unique(cloud.points, axis=0, return_index=True)[1])]
    step, count = spacing(cloud.points), len(cloud)
    if count <= NEIGHBOURS or step == 0 or np.linalg.matrix_rank(cloud.points - cloud.points.mean(0), step) < 2:
        raise StageError(f"{count} points have no surface; at least {NEIGHBOURS + 1} that lie in no line are needed")
    while len(cloud) > MAX_POINTS:
        step *= max(1.1, np.sqrt(len(cloud) / MAX_POINTS))
        cloud = voxel_downsample(cloud, step)
    if len(cloud) < count:
        notes.append(f"{len(cloud):,} of {count:,} points were used, {step:.3g} apart")
    cloud = with_normals(cloud, views)
    points, faces, normals = _poisson(cloud, step)
    tree = cKDTree(cloud.points)
    evidence = cloud.fields.get("evidence", np.zeros(len(cloud), np.uint8))
    known = np.zeros(len(cloud), np.uint8)
    known[evidence == Evidence.MEASURED], known[evidence == Evidence.PLAIN] = FaceClass.MEASURED, FaceClass.PLAIN
    middle = points[faces].mean(1)
    distance, nearest = tree.query(middle, workers=threads())
    near = distance <= _reach(cloud, tree)[nearest]
    low, high, beyond = cloud.points.min(0), cloud.points.max(0), MAX_GAP / 2 * cloud.diagonal
    inside = ((middle >= low - beyond) & (middle <= high + beyond)).all(1)
    classes = np.where(near, known[nearest], np.uint8(FaceClass.UNCONFIRMED))
    if photos is not None:
        tried = np.flatnonzero(inside & ~near)
        of_faces = replace(cloud[nearest[tried]], points=middle[tried], normals=normals_of(points[faces[tried]]))
        matched = measure(of_faces, photos, cloud.diagonal)
        scene = caster(points, faces[classes == FaceClass.MEASURED])
        shown = matched.surface & ~_seen_through(points[faces[tried]], scene, views, MARGIN * cloud.diagonal)
        near[tried[shown]], classes[tried[shown]] = True, FaceClass.MEASURED
        cloud = concatenate([cloud, with_evidence(matched, Evidence.UNCHECKED)[shown]])
    gaps, is_open = _bridges(points, faces, distance, near, inside, classes, cloud, views)
    classes[gaps] = FaceClass.BRIDGED
    kept = near | gaps
    own = cKDTree(cloud.points).query(points, workers=threads())[1]
    vertices = Cloud(points, normals, None if cloud.colors is None else cloud.colors[own])
    fields = cloud.fields
    deviation = fields.get("deviation", np.full(len(cloud), np.nan, np.float32))[own]
    vertices.fields["evidence"] = fields.get("evidence", np.zeros(len(cloud), np.uint8))[own]
    of_vertex = np.full(len(points), FaceClass.BRIDGED, np.uint8)
    # A vertex is measured if any of its faces is, else plain if any is, else unconfirmed.
    for kind in (FaceClass.UNCONFIRMED, FaceClass.PLAIN, FaceClass.MEASURED):
        of_vertex[faces[kept & (classes == kind)]] = kind
    vertices.fields["deviation"] = np.where(of_vertex == FaceClass.BRIDGED, np.nan, deviation).astype(np.float32)
    vertices.fields["class"] = of_vertex
    whole = Surface(vertices, faces, classes.astype(np.uint8), 0.0, tuple(notes))
    return replace(whole.part(kept), open_area=float(whole.areas()[is_open].sum()))


def _poisson(cloud: Cloud, step: float) -> tuple[Array, Rows, NDArray[np.float32]]:
    """Vertices (V, 3), faces (F, 3) and normals (V, 3) of the closed candidate, in cells of the points' spacing."""
    import open3d as o3d

    assert cloud.normals is not None
    middle = cloud.points.mean(0)
    points = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(cloud.points - middle))
    points.normals = o3d.utility.Vector3dVector(cloud.normals.astype(np.float64))
    side = BEYOND_BOX * float(np.ptp(cloud.points, axis=0).max())
    # A surface of MAX_POINTS has no more levels.
    most = np.ceil(np.log2(MAX_POINTS) / 2) + 1
    depth = int(np.clip(np.ceil(np.log2(side / step)), 1, most))
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        points, depth=depth, scale=BEYOND_BOX, n_threads=threads()
    )
    mesh.remove_degenerate_triangles()
    mesh.compute_vertex_normals()
    normals = np.asarray(mesh.vertex_normals).astype(np.float32)
    return np.asarray(mesh.vertices) + middle, np.asarray(mesh.triangles).astype(np.int64), normals


def _reach(cloud: Cloud, tree: cKDTree) -> Array:
    """(N,) how far from each point a face is still beside it: some of the local spacings, or a standard deviation."""
    count = min(NEIGHBOURS + 1, len(cloud))
    distance, near = tree.query(cloud.points, k=count, workers=threads())
    local = np.median(distance[:, 1][near], axis=1)
    deviation = cloud.fields.get("deviation", np.zeros(len(cloud)))
    return np.asarray(np.maximum(SAME_PLACE_SPACINGS * local, np.nan_to_num(deviation)))


def _bridges(
    points: Array,
    faces: Rows,
    distance: Array,
    near: Mask,
    inside: Mask,
    classes: Rows,
    cloud: Cloud,
    views: list[View],
) -> tuple[Mask, Mask]:
    """(F,) faces that bridge a gap, and those of gaps that stay open.

    A gap is a piece of the candidate without points beside it, all of it in their box or half a gap's width beyond, and
    wider than MAX_GAP everywhere or nowhere. In the latter case it is bridged where most of its rim is measured and
    photos do not see through it.
    """
    far = np.flatnonzero(~near)
    pairs, alone = _neighbours(faces)
    place = np.full(len(faces), -1)
    place[far] = np.arange(len(far))
    # What lies in a ball of that width without points is wide.
    half, middle = MAX_GAP / 2 * cloud.diagonal, points[faces[far]].mean(1)
    wide = distance[far] > half
    if wide.any():
        wide |= within(middle, middle[wide], half)
    linked = place[pairs[(place[pairs] >= 0).all(1)]]
    linked = linked[wide[linked[:, 0]] == wide[linked[:, 1]]]
    graph = coo_matrix((np.ones(len(linked)), linked.T), shape=(len(far), len(far)))
    count, gap = connected_components(graph, directed=False)
    at_border = np.zeros(count, dtype=bool)
    at_border[gap[~inside[far] | alone[far]]] = True
    # Faces of gaps, each beside one that is not of it.
    rim = np.concatenate([pairs, pairs[:, ::-1]])
    rim = rim[place[rim[:, 0]] >= 0]
    of = gap[place[rim[:, 0]]]
    beside = np.where(near[rim[:, 1]], -1, gap[place[rim[:, 1]]])
    of, rim = of[of != beside], rim[of != beside]
    measured = classes[rim[:, 1]] == FaceClass.MEASURED
    good = ~at_border & (np.bincount(of, measured, count) >= SUPPORT * np.bincount(of, minlength=count))
    good[gap[wide]] = False
    tried = good[gap]
    if views and tried.any():
        kept = caster(points, faces[classes == FaceClass.MEASURED])
        seen = _seen_through(points[faces[far[tried]]], kept, views, MARGIN * cloud.diagonal)
        through = np.bincount(gap[tried], seen, count)
        good &= through < SUPPORT * np.bincount(gap, minlength=count)
    bridged, is_open = np.zeros(len(faces), dtype=bool), np.zeros(len(faces), dtype=bool)
    bridged[far], is_open[far] = good[gap], ~good[gap] & ~at_border[gap]
    return bridged, is_open


def caster(points: Array, faces: Rows):  # type: ignore[no-untyped-def]
    """Open3D's ray caster with a mesh."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(threads())
    tensor = o3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(points.astype(np.float32)), tensor(faces.astype(np.uint32)))
    return scene


def cast(scene, origins: Array, directions: Array) -> dict[str, NDArray[np.floating]]:  # type: ignore[no-untyped-def]
    """What rays (N, 3) hit: `t_hit` in lengths of their directions, `primitive_ids`, `primitive_normals`, ..."""
    rays = np.concatenate([np.broadcast_to(origins, directions.shape), directions], axis=1).astype(np.float32)
    return {name: values.numpy() for name, values in scene.cast_rays(rays, nthreads=threads()).items()}


def _seen_through(corners: Array, scene, views: list[View], margin: float) -> Mask:  # type: ignore[no-untyped-def]
    """(N,) faces (N, 3, 3) behind which enough photos see the front of a measured face, farther off than a margin.

    Photos that look along a face are not counted: they may see past it.
    """
    places, count = corners.mean(1), np.zeros(len(corners), np.int64)
    normals = normals_of(corners)
    for view in views:
        rows = view.visible(places)[0]
        rays = places[rows] - view.centre
        hit = cast(scene, view.centre, rays)
        length = np.linalg.norm(rays, axis=1)
        front = (hit["primitive_normals"] * rays).sum(1) < 0
        front &= np.abs((normals[rows] * rays).sum(1)) >= MIN_COSINE * length
        count[rows] += front & np.isfinite(hit["t_hit"]) & ((hit["t_hit"] - 1) * length > margin)
    return count >= MIN_AGREEING


def _neighbours(faces: Rows) -> tuple[Rows, Mask]:
    """(E, 2) faces that share an edge, and (F,) those with an edge that no other has."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    key = edges[:, 0] * (int(faces.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    pairs = np.stack([order[:-1][same], order[1:][same]], axis=1) // 3
    shared = np.zeros(len(key), dtype=bool)
    shared[order[1:][same]] = shared[order[:-1][same]] = True
    return pairs, np.asarray(~shared.reshape(-1, 3).all(1))


def normals_of(corners: Array) -> NDArray[np.float32]:
    """(F, 3) unit normals of faces (F, 3, 3)."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)).astype(np.float32)
