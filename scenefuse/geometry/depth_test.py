"""The depth test: whether a point lies in front of what a depth map shows, on it, behind it, or where nothing is known.

A point in front is seen through: the view sees a surface behind it. A point behind is hidden. The same test serves
measured depth maps and buffers that are drawn from points, of a scene and of an object. Free space is where a scene's
depth maps measured surfaces behind a place: nothing stands there.

Source: Merrell et al. 2007 (visibility constraints between depth maps).
"""

from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import Array
from scenefuse.photos.pictures import read_depth
from scenefuse.photos.workspace import View, posed_images, read_model, view_of

# Side of a cell in spacings of the surface's points, so that a surface has no holes between them; and how many spacings
# behind the nearest points a noisy surface still reaches.
CELL_SPACINGS, SURFACE_SPACINGS = 2.0, 8.0
# Photos that must confirm a point for it to be measured; as many of the others count at each offset of a match, since
# the rest may not see the place (Goesele et al. 2006).
CONFIRMING_PHOTOS = 3
# Photos or depth maps that must agree where one may by chance.
MIN_AGREEING = 2
# Photos of one side that points are checked in at most.
MAX_PHOTOS = 64
# Photos that look along a surface (beyond 75 degrees) show little of it.
MIN_COSINE = 0.25
# Below this share of points with a measurement on their rays, depth maps tell nothing of an object.
MIN_MEASURED = 0.1


class Where(IntEnum):
    """Where a point lies beside what a depth map shows on its ray."""

    OUTSIDE = 0
    """The picture does not show it."""
    UNKNOWN = 1
    IN_FRONT = 2
    AT = 3
    BEHIND = 4


def depth_test(points: Array, view: View, tolerance: float, farthest: Array | None = None) -> NDArray[np.int8]:
    """(N,) where points (N, 3) lie beside a view's depth map, as values of `Where`.

    Args:
        points: in the view's world.
        view: `pixels` are depths along z, (H, W), 0 for none.
        tolerance: difference of depth up to which a point is AT, unit of the world.
        farthest: (H, W) depth behind which points are BEHIND, 0 for none; without it that of `view`.
    """
    rows, pixels, depth = view.visible(points)
    at = pixels[:, 1], pixels[:, 0]
    found = np.full(len(points), Where.OUTSIDE, np.int8)
    nearest = view.pixels[at].astype(np.float64)
    last = nearest if farthest is None else farthest[at]
    in_front, behind = (nearest > 0) & (depth < nearest - tolerance), (last > 0) & (depth > last + tolerance)
    known = (nearest > 0) & (last > 0)
    found[rows] = np.select([in_front, behind, known], [Where.IN_FRONT, Where.BEHIND, Where.AT], Where.UNKNOWN)
    return found


def depth_buffer(points: Array, view: View, side: float) -> View:
    """The view in square cells, `pixels` (H, W) the least depth of the points in each, 0 without one.

    Args:
        points: (N, 3) in the view's world.
        view: its pixels are not used.
        side: of a cell at the points' median depth, unit of the world.
    """
    _, depth = view.project(points)
    ahead = depth[depth > 0]
    cell = side * view.intrinsics[0, 0] / (np.median(ahead) if len(ahead) else 1.0)
    small = replace(view, pixels=None).at_most(max(4, round(max(view.width, view.height) / max(1.0, cell))))
    _, pixels, depth = small.visible(points)
    nearest = np.full((small.height, small.width), np.inf)
    np.minimum.at(nearest, (pixels[:, 1], pixels[:, 0]), depth)
    return replace(small, pixels=np.where(np.isfinite(nearest), nearest, 0.0))


@dataclass(frozen=True)
class Visibility:
    """How V photos see N points.

    Attributes:
        in_view: (N,) photos that have the point in their picture.
        hidden: (N,) of these, photos in which a surface stands before it.
        through: (N,) of these, photos that see a surface behind it: nothing can be where it is.
    """

    in_view: NDArray[np.int64]
    hidden: NDArray[np.int64]
    through: NDArray[np.int64]


def see(
    points: Array,
    surface: Cloud,
    views: list[View],
    spacing: float,
    margin: float,
    beside: tuple[Cloud, float] | None = None,
) -> Visibility:
    """Test points (N, 3) against the measured points of a surface, with normals, in each photo.

    Args:
        points: in the frame of the surface and the cameras.
        surface: measured points.
        views: cameras.
        spacing: of the surface's points.
        margin: how far before or behind the surface a point must lie to count, unit of the frame.
        beside: what else hides points, with normals, and its spacing; nothing is seen through to it.
    """
    in_view, hidden, through = (np.zeros(len(points), dtype=np.int64) for _ in range(3))
    for view in views if len(surface) > 1 else ():
        nearest, farthest = _surface_in(surface, view, spacing)
        found = depth_test(points, nearest, margin, farthest)
        if beside is not None:
            rows = np.flatnonzero((found != Where.OUTSIDE) & (found != Where.BEHIND))
            nearest, farthest = _surface_in(beside[0], view, beside[1])
            found[rows[depth_test(points[rows], nearest, margin, farthest) == Where.BEHIND]] = Where.BEHIND
        in_view += found != Where.OUTSIDE
        hidden += found == Where.BEHIND
        through += found == Where.IN_FRONT
    return Visibility(in_view, hidden, through)


def shown_in(
    points: Array, normals: NDArray[np.float32], surface: Cloud, view: View, spacing: float, margin: float
) -> NDArray[np.bool_]:
    """Which of (N, 3) points with normals (N, 3) a photo shows: from their front, with no surface before them.

    Here both sides of a surface hide: a camera behind a wall sees nothing. The other arguments are those of `see`; a
    photo that looks along a surface, beyond 75 degrees, does not show it.
    """
    nearest, farthest = _surface_in(surface, view, spacing, both_sides=True)
    found = depth_test(points, nearest, margin, farthest)
    return _facing(points, normals, view) & (found != Where.OUTSIDE) & (found != Where.BEHIND)


def _facing(points: Array, normals: NDArray[np.float32], view: View) -> NDArray[np.bool_]:
    """(N,) which of (N, 3) points with normals (N, 3) a photo does not look along or see from behind."""
    towards = view.centre - points
    ahead, squared = (np.einsum("ni,ni->n", one, towards) for one in (normals, towards))
    return np.asarray(ahead >= MIN_COSINE * np.sqrt(squared))


def _surface_in(surface: Cloud, view: View, spacing: float, both_sides: bool = False) -> tuple[View, Array]:
    """The photo in cells: the least depth of the surface in the 3 x 3 cells around each, and the largest (H, W), where
    most of them hold some; 0 elsewhere."""
    shown = surface.points if both_sides else surface.points[_facing(surface.points, surface.known_normals, view)]
    buffer = depth_buffer(shown, view, CELL_SPACINGS * spacing)
    hit, around = buffer.pixels > 0, np.ones((3, 3))
    known = cv2.boxFilter(hit.astype(np.float64), -1, around.shape, borderType=cv2.BORDER_CONSTANT) > 0.5
    least = cv2.erode(np.where(hit, buffer.pixels, np.inf), around)
    most = cv2.dilate(buffer.pixels, around)
    return replace(buffer, pixels=np.where(known, least, 0.0)), np.where(known, most, 0.0)


@dataclass(frozen=True)
class FreeSpace:
    """The scene's depth maps around an object.

    Attributes:
        views: `pixels` are depths along the camera's z axis (H, W; float32, scene units), 0 where nothing was measured,
            without their edges (`without_edges`).
        tolerance: how far beyond a point a measurement must lie for the point to be in free space, scene units.
    """

    views: list[View]
    tolerance: float

    def violation(self, points: Array) -> float | None:
        """Share of the points (N, 3; scene frame) that lie in free space.

        A point counts where any camera has a measurement on its ray. It lies in free space when, of those cameras, at
        least half measured a depth more than `tolerance` beyond it.

        Returns:
            The share, or None when fewer than a tenth of the points have any measurement on their rays.
        """
        measured, beyond = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
        for view in self.views:
            found = depth_test(points, view, self.tolerance)
            measured += found >= Where.IN_FRONT
            beyond += found == Where.IN_FRONT
        seen = measured > 0
        if seen.mean() < MIN_MEASURED:
            return None
        return float((beyond[seen] >= 0.5 * measured[seen]).mean())


def without_edges(view: View) -> View:
    """The nearest depth of the pixels around each, nothing where one of them has none: depths at edges are unsure."""
    return replace(view, pixels=minimum_filter(view.pixels, 3))


def read_free_space(
    workspace: Path, depth: tuple[Path, ...], points: Array, most: int, tolerance: float
) -> FreeSpace | None:
    """The depth maps of the photos that see a place from the most different sides.

    Args:
        workspace: undistorted COLMAP workspace of the scene, with sparse/.
        depth: folders of the depth maps' chunks, each with depth_maps/{photo}.bin.
        points: (N, 3) scene points of the place.
        most: photos used at most.
        tolerance: see FreeSpace.

    Returns:
        None when no photo with a depth map sees half of the points.
    """
    model = read_model(workspace / "sparse")
    sample = points[:: max(1, len(points) // 500)]
    seeing: list[tuple[Path, View]] = []
    for image in posed_images(model):
        path = next((p for d in depth if (p := d / "depth_maps" / f"{image.name}.bin").is_file()), None)
        if path is None:
            continue
        view = view_of(model, image)
        if len(view.visible(sample)[0]) >= 0.5 * len(sample):
            seeing.append((path, view))
    if not seeing:
        return None
    views = []
    for path, view in (seeing[k] for k in most_different([v for _, v in seeing], points.mean(0), most)):
        measured = read_depth(path)
        sized = view.resized(measured.shape[1], measured.shape[0])
        views.append(without_edges(replace(sized, pixels=measured)))
    return FreeSpace(views, tolerance)


def most_different(views: list[View], place: Array, most: int) -> list[int]:
    """Rows of at most `most` views, each next one as far as possible in direction from those before; sorted."""
    directions = np.array([v.centre - place for v in views])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    chosen = [0]
    nearest = directions @ directions[0]
    while len(chosen) < min(most, len(views)):
        chosen.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return sorted(chosen)
