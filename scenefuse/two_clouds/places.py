"""Where in a large scene an object may stand: parts that rise from the ground, the most alike first (method R16)."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.cloud.clouds import Cloud, voxel_downsample
from scenefuse.cloud.import_cloud import MIN_POINTS
from scenefuse.core.transforms import UP, Array, rotation_between
from scenefuse.crop.crop_cloud import CropSettings, crop_cloud
from scenefuse.geometry.surface import SCORE_FRACTION, Surface, prepare

Rows = NDArray[np.int64]

# Sizes of windows, each half of the one before: a scene is up to 30 times as wide as the object.
WINDOW_SIZES = 5
# Cells along a window: the least that separate an object from a bush beside it. The ground is what a window half as
# wide again, which no object of that size fills, can be moved along below the surface (Zhang et al. 2003).
WINDOW_CELLS, OPENING = 8, 1.5
# Places that are searched at most: a landscape has hundreds of trees, and each takes a second.
MAX_PLACES = 24
# A part rises by this share of the window, and by twice that, where it parts from what stands beside it.
MIN_RISE = 0.15


def likely_places(
    obj: Cloud, scene: Cloud, up: Array | None, settings: CropSettings, seed: int, most: int
) -> list[Rows]:
    """Rows of the scene's points on each of the parts that are most like the object, best first.

    Args:
        obj: the object, any frame and unit.
        scene: the scene.
        up: unit vector (3,) in the scene; None where it is not known: then the direction in which the scene extends
            least, or its reverse.
        settings: of the crop around each.
        seed: of the points that are compared.
        most: parts at most.
    """
    directions = [up] if up is not None else _thinnest(scene)
    found = [(up, rows) for up in directions for rows in _raised(scene.points @ rotation_between(up, UP).T)]
    views = [_signature(view, seed) for view in _views(_thin(obj, seed))]
    alike = [max(_alike(_signature(_thin(scene[rows], seed), seed), view) for view in views) for _, rows in found]
    places: list[Rows] = []
    for k in np.argsort([-value for value in alike], kind="stable"):
        direction, rows = found[k]
        rows = _cropped(scene, direction, rows, settings)
        if len(rows) >= MIN_POINTS and not any(_same(rows, other) for other in places):
            places.append(rows)
        if len(places) == most:
            break
    return places


def _thinnest(scene: Cloud) -> list[Array]:
    """The direction (3,) in which a scene extends least, and its reverse."""
    even = voxel_downsample(scene, SCORE_FRACTION * scene.diagonal).points
    axis = np.linalg.svd(even - even.mean(0), full_matrices=False)[2][2]
    return [axis, -axis]


def _raised(points: Array) -> Iterator[Rows]:
    """Rows of the points (N, 3), z up, on each part that rises from the ground, for windows of each size."""
    corner, span = points[:, :2].min(0), float(np.ptp(points[:, :2], axis=0).max())
    for size in span / 2.0 ** np.arange(1, WINDOW_SIZES + 1):
        cell_of = np.floor((points[:, :2] - corner) / (size / WINDOW_CELLS)).astype(np.int64)
        shape = tuple(cell_of.max(0) + 1)
        flat = np.ravel_multi_index(tuple(cell_of.T), shape)
        top, low = np.full(shape, -np.inf), np.full(shape, np.inf)
        np.maximum.at(top.ravel(), flat, points[:, 2])
        np.minimum.at(low.ravel(), flat, points[:, 2])
        ground = _ground(low)
        above = points[:, 2] - ground[tuple(cell_of.T)]
        for rise in (MIN_RISE * size, 2 * MIN_RISE * size):
            part_of = ndimage.label(top - ground > rise, np.ones((3, 3)))[0]
            of_point = np.where(above > rise / 2, part_of[tuple(cell_of.T)], 0)
            order = np.argsort(of_point, kind="stable")
            ends = np.searchsorted(of_point[order], np.arange(part_of.max() + 1), side="right")
            for k, cells in enumerate(ndimage.find_objects(part_of)):
                extent = max(along.stop - along.start for along in cells)
                rows = order[ends[k] : ends[k + 1]]
                if len(rows) >= MIN_POINTS and WINDOW_CELLS < 2 * extent <= 2 * OPENING * WINDOW_CELLS:
                    yield rows


def _ground(low: Array) -> Array:
    """Heights of the ground in cells with these lowest points, infinite where there are none."""
    nearest = ndimage.distance_transform_edt(np.isinf(low), return_distances=False, return_indices=True)
    # Single low points are strays.
    filled = ndimage.percentile_filter(low[tuple(nearest)], 25, size=3)
    return np.asarray(ndimage.uniform_filter(ndimage.grey_opening(filled, size=int(OPENING * WINDOW_CELLS)), 5))


def _cropped(scene: Cloud, up: Array, rows: Rows, settings: CropSettings) -> Rows:
    """Rows of a part's points and of what belongs to it, without the ground."""
    marks = scene.points[rows]
    reach = np.ptp(marks, axis=0).max()
    near = np.flatnonzero(((scene.points > marks.min(0) - reach) & (scene.points < marks.max(0) + reach)).all(1))
    return near[crop_cloud(scene[near], marks, up, settings).keep]


def _same(rows: Rows, other: Rows) -> bool:
    """Whether two parts share most of their points."""
    return 2 * len(np.intersect1d(rows, other)) > max(len(rows), len(other))


def _thin(cloud: Cloud, seed: int) -> Surface:
    """A cloud's surface with one point a voxel, whatever its unit."""
    return prepare(cloud, SCORE_FRACTION * cloud.diagonal, seed, 10 * MIN_POINTS)


def _views(obj: Surface) -> Iterator[Surface]:
    """The object, and the parts of it that are seen along its principal axes: a scene shows only a part."""
    yield obj
    for axis in np.linalg.svd(obj.points - obj.points.mean(0), full_matrices=False)[2]:
        for side in (axis, -axis):
            facing = np.flatnonzero(obj.normals @ side > 0)
            if len(facing) > 1:  # a plane has no other sides
                yield Surface(obj.points, obj.normals, obj.colors, obj.tree, facing)


def _signature(surface: Surface, seed: int) -> tuple[Array, Array | None]:
    """What does not change when a surface is turned, moved and scaled: of its pairs of points the distance, the angle
    of the normals, and of these with the line between (Wahl, Hillenbrand, Hirzinger 2003); and its hues."""
    rows = np.random.default_rng(seed).permutation(surface.queries)[:MIN_POINTS]
    points, normals = surface.points[rows], surface.normals[rows]
    a, b = np.triu_indices(len(rows), 1)
    line = points[b] - points[a]
    length = np.linalg.norm(line, axis=1)
    line /= np.maximum(length, 1e-12)[:, None]
    facing = np.abs((normals[a] * normals[b]).sum(1))
    along = (np.abs((normals[a] * line).sum(1)) + np.abs((normals[b] * line).sum(1))) / 2
    values = np.stack([length / np.sqrt((length**2).mean()), facing, along], axis=1)
    shape = np.histogramdd(values, (8, 4, 4), [(0, 2.4), (0, 1 + 1e-9), (0, 1 + 1e-9)])[0]
    if surface.colors is None:
        return shape / shape.sum(), None
    red, green, blue = np.log(np.maximum(surface.colors[surface.queries], 0.02)).T
    hue = np.histogram2d(red - green, blue - green, 12, [(-1.5, 1.5)] * 2)[0]
    return shape / shape.sum(), ndimage.gaussian_filter(hue / max(hue.sum(), 1), 1.0)


def _alike(a: tuple[Array, Array | None], b: tuple[Array, Array | None]) -> float:
    """How much two signatures share, 0..1."""
    shape = float(np.minimum(a[0], b[0]).sum())
    if a[1] is None or b[1] is None:
        return shape
    return shape * (0.5 + 0.5 * float(np.minimum(a[1], b[1]).sum()))
