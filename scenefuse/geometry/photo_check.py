"""Points checked in photos: where windows around a point match, it is measured, and how exactly is known.

Sources: Furukawa and Ponce 2010 (patches in the tangent plane, photo-consistency from the best photos); Goesele et al.
2006 (of several views the best count); Yoon and Kweon 2006 (weights that keep a window on one surface); Foerstner
1982 (variance of a match from the gradients and the noise).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.transforms import Array, Sim3
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS, MAX_PHOTOS
from scenefuse.photos.pictures import NOISE
from scenefuse.photos.workspace import View, Workspace

# Least weighted NCC of a photo that confirms a point, and by how much more another offset may score.
MIN_MATCH, MAX_DROP = 0.6, 0.1
# Largest standard deviation of a measured point in steps along the ray, of about a pixel: windows that match as well
# farther on measure nothing, sky and blank walls above all.
MAX_DEVIATION_PX = 1.2
# Share of the way from a point to its best match by which the point is off; the match is by the rest. This and the
# next two by the likelihood of the errors of the demo's house and sculpture, once aligned to the truth.
PEAK_FACTOR = 0.6
# Share of a step that a point's matches are off together, by interpolation above all: it does not average out.
PIXEL_ERROR = 0.07
# The noise of a match is so many times what independent pixels would give: photos share the reference, and samples
# beside each other their pixels.
NOISE_FACTOR = 1.8


@dataclass(frozen=True)
class Photos:
    """V photos in one frame, packed for the kernel.

    Attributes:
        views: their cameras, without pixels.
        pixels: uint8 grey values, one photo behind the other.
        starts: (V,) int64 place of each in `pixels`.
    """

    views: list[View]
    pixels: NDArray[np.uint8]
    starts: NDArray[np.int64]


def pack(views: list[View]) -> Photos:
    """Views with grey pixels (H, W) uint8, made ready for the kernel."""
    lengths = [view.width * view.height for view in views]
    pixels = np.concatenate([view.pixels.reshape(-1) for view in views]) if views else np.zeros(0, np.uint8)
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64) if views else np.zeros(0, np.int64)
    return Photos([replace(view, pixels=None) for view in views], pixels, starts)


def unpacked(photos: Photos) -> list[View]:
    """The views with their pixels (H, W)."""
    parts = np.split(photos.pixels, photos.starts[1:])
    return [replace(v, pixels=part.reshape(v.height, v.width)) for v, part in zip(photos.views, parts)]


def read_photos(workspace: Workspace, points: Array) -> Photos:
    """The photos of a workspace that have points (N, 3; its frame) in their picture, packed for the kernel."""
    rows = showing(workspace.views, points, MAX_PHOTOS)
    return pack([workspace.gray(workspace.views[k]) for k in rows])


def showing(views: list[View], points: Array, most: int) -> NDArray[np.int64]:
    """Rows of views that have points (N, 3) in their picture; of more than `most` those that cover them best."""
    sample = points[:: max(1, len(points) // 2000)]
    fineness = np.zeros((len(views), len(sample)))
    for row, view in zip(fineness, views):
        inside, _, depth = view.visible(sample)
        row[inside] = view.intrinsics[0, 0] / depth
    rows = np.flatnonzero(fineness.any(1))
    if len(rows) > most:
        print(f"{most} of the {len(rows)} photos that show the object are compared", flush=True)
        centres = np.array([views[k].centre for k in rows])
        finest = np.maximum(fineness.max(0), np.finfo(np.float64).tiny)
        rows = rows[covering(fineness[rows] / finest, centres, sample, most)]
    return rows


def covering(shown: Array, centres: Array, points: Array, count: int) -> NDArray[np.int64]:
    """Rows of photos, sorted, that show every point where they can, as finely as they can, from the most different
    directions.

    The next photo is the one of the greatest worth: how finely it shows points, each divided by the square of one more
    than the chosen photos that show it, times two less the cosine to the nearest of their directions.

    Args:
        shown: (V, N), how finely each photo shows each point, over the finest one, 0 where it is not in its picture;
            each shows one.
        centres: (V, 3) of the cameras.
        points: (N, 3).
        count: how many photos to choose.
    """
    directions = centres - (shown @ points) / shown.sum(1, keepdims=True)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    chosen: list[int] = []
    cosine, times = np.full(len(shown), -1.0), np.zeros(len(points))
    while len(chosen) < min(count, len(shown)):
        worth = shown @ (1 + times) ** -2 * (2 - cosine)
        worth[chosen] = -1
        chosen.append(int(worth.argmax()))
        cosine = np.maximum(cosine, directions @ directions[chosen[-1]])
        times += shown[chosen[-1]]
    return np.sort(chosen)


def moved_view(view: View, b_from_a: Sim3) -> View:
    """A camera of frame a in frame b, whose unit its depths have then."""
    pose = np.eye(4)
    pose[:3, :3] = view.cam_from_world[:3, :3] @ b_from_a.rotation.T
    pose[:3, 3] = b_from_a.scale * view.cam_from_world[:3, 3] - pose[:3, :3] @ b_from_a.translation
    return replace(view, cam_from_world=pose)


def moved_photos(photos: Photos, b_from_a: Sim3) -> Photos:
    """Photos of frame a in frame b."""
    return replace(photos, views=[moved_view(view, b_from_a) for view in photos.views])


@dataclass(frozen=True)
class Matches:
    """How well N points match in a set of photos.

    Attributes:
        match: (N,) mean score of the best photos at the point, -1..1; -1 where fewer than three photos see it.
        best: (N,) the same at the offset along the ray where it is largest.
        photos: (N,) photos that confirm the point.
        tested: (N,) photos that it was matched in, its reference not counted.
        deviation: (N,) standard deviation of its place, unit of the points; infinite where no photo confirms it.
        texture: (N,) standard deviation of the reference's window, grey levels.
        step: (N,) how far a point moves along the ray for about a pixel in the other photos, unit of the points.
    """

    match: Array
    best: Array
    photos: NDArray[np.int64]
    tested: NDArray[np.int64]
    deviation: Array
    texture: Array
    step: Array

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(N,) points that enough photos confirm, where a match says where they are: to MAX_DEVIATION_PX."""
        return (self.photos >= CONFIRMING_PHOTOS) & (self.deviation <= MAX_DEVIATION_PX * self.step)

    @property
    def textured(self) -> NDArray[np.bool_]:
        """(N,) points whose window shows more than noise."""
        return np.asarray(self.texture >= 3 * NOISE)


def match_in(points: Array, normals: NDArray[Any] | None, photos: Photos) -> Matches:
    """Match points (N, 3) with unit normals (N, 3), towards the photos, in photos of the same frame.

    Where photos match nowhere along the ray, they are compared again at half their size: faint texture that noise or
    blur hides in single pixels may show there, and less exactly.
    """
    found = _match(points, normals, photos)
    rest = np.flatnonzero(~found.measured & (found.best < MIN_MATCH))
    coarse = _match(points[rest], None if normals is None else normals[rest], halved(photos))
    for kept, tried in zip(vars(found).values(), vars(coarse).values()):
        kept[rest[coarse.measured]] = tried[coarse.measured]
    return found


def halved(photos: Photos) -> Photos:
    """The photos at half their size."""
    return pack([view.resized(view.width // 2, view.height // 2) for view in unpacked(photos)])


def _match(points: Array, normals: NDArray[Any] | None, photos: Photos) -> Matches:
    """`match_in` at one size of the photos."""
    # Numba takes half a second to load, and most jobs that read this module match nothing.
    from scenefuse.geometry.photo_kernel import OFFSETS, match_points

    count = len(points)
    curve, noise = np.full((count, 2 * OFFSETS + 1), -1.0), np.full(count, np.inf)
    tested, confirming = np.zeros(count, np.int64), np.zeros(count, np.int64)
    texture, step = np.zeros(count), np.zeros(count)
    if count and len(photos.views) >= CONFIRMING_PHOTOS:
        views = photos.views
        sizes, projections = np.array([(v.width, v.height) for v in views]), np.array([v.projection for v in views])
        centres, rights = np.array([v.centre for v in views]), np.array([v.cam_from_world[0, :3] for v in views])
        focals = np.array([np.sqrt(v.intrinsics[0, 0] * v.intrinsics[1, 1]) for v in views])
        match_points(
            np.ascontiguousarray(points), np.ascontiguousarray(normals, dtype=np.float64), photos.pixels, photos.starts,
            sizes, projections, centres, rights, focals,
            curve, noise, tested, confirming, texture, step, MIN_MATCH, MAX_DROP,
        )  # fmt: skip
    away = PEAK_FACTOR * _peak(curve) * step
    deviation = np.sqrt(away**2 + (PIXEL_ERROR * step) ** 2 + (NOISE_FACTOR * noise) ** 2)
    deviation = np.where(confirming > 0, deviation, np.inf)
    return Matches(curve[:, OFFSETS], curve.max(1), confirming, tested, deviation, texture, step)


def _peak(curve: Array) -> Array:
    """Where scores (N, STEPS) are largest, in steps from the point: a parabola through the best and its sides."""
    best = np.clip(curve.argmax(1), 1, curve.shape[1] - 2)
    rows = np.arange(len(curve))
    before, middle, after = (curve[rows, best + k] for k in (-1, 0, 1))
    bend = before - 2 * middle + after
    part = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
    return np.asarray(best + np.clip(part, -1, 1) - curve.shape[1] // 2, dtype=np.float64)
