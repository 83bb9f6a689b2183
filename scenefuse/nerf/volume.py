"""Where an object is: the unit cube around it that its NeRF is trained in, and its visual hull in that cube."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array, Sim3
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS
from scenefuse.geometry.surface import ends_of
from scenefuse.geometry.visual_hull import (
    MIN_OWN_POINTS,
    MIN_WHOLE_SHARE,
    NO_POINTS,
    Outline,
    count_silhouettes,
    is_whole,
    least_framing,
)
from scenefuse.nerf.rays import SURFACE_DEPTH, dilate
from scenefuse.photos.workspace import View

# Cells per side of the hull that the cube is fitted to: the margin is wider than one of them.
FIRST_CELLS = 64
# Share of the cube's side left free on each side of the hull, for what the masks cut off.
MARGIN = 0.02
# As MIN_FRAMING_SHARE, more than masks need: what few photos bound is large, and costs rays.
MIN_FRAMING_OF_HULL = 0.3
# The first, rough cube is wider by this share on each side than the masks' extents ask for, or the object's own points.
ROUGH_MARGIN = 0.25
EMPTY_HULL = "the visual hull of the masks is empty: masks and cameras contradict each other; check both"


@dataclass(frozen=True)
class Volume:
    """nerf_from_object maps the cube around the object to the unit cube; `hull` (G, G, G) bool are its cells inside."""

    nerf_from_object: Sim3
    hull: NDArray[np.bool_]


def find_volume(
    outlines: list[Outline], cells: int, tolerance: float, cube: Sim3 | None = None, own: Array = NO_POINTS
) -> Volume:
    """The unit cube and the visual hull in it.

    Args:
        outlines: of the training photos.
        cells: per side of the hull, a multiple of 4 times a power of 2.
        tolerance: share of the photos that may have a cell of the hull outside their mask.
        cube: nerf_from_object of an earlier stage, which is kept, or None.
        own: (N, 3) points on the object: they say where it is where few photos have it whole, and how many have a part.

    Raises:
        StageError: fewer than two photos, or no cell is left.
    """
    if cube is None:
        rough = _rough_cube([outline.view for outline in outlines], own)
        cube = tight_cube(visual_hull(outlines, rough, FIRST_CELLS, tolerance, own), rough, MARGIN)
    hull = visual_hull(outlines, cube, cells, tolerance, own)
    if not hull.any():
        raise StageError(EMPTY_HULL)
    return Volume(cube, hull)


def silhouettes(
    masks: NDArray[np.bool_],
    depths: NDArray[np.float32] | None,
    intrinsics: Array,
    object_from_cam: Array,
    sizes: NDArray[np.int64] | None = None,
) -> list[Outline]:
    """V outlines from (V, H, W) masks and `sparse_depths`, (V, 3, 3) intrinsics and (V, 4, 4) poses.

    sizes: (V, 2) rows and columns of each photo, where they differ (`Views.sizes`).
    """
    shapes = [masks.shape[1:]] * len(masks) if sizes is None else sizes.tolist()
    outlines = []
    for row, ((height, width), pose) in enumerate(zip(shapes, np.linalg.inv(object_from_cam))):
        part = np.s_[row, :height, :width]
        view = View("", intrinsics[row], pose, width, height, masks[part])
        outlines.append(Outline(view, None if depths is None else depths[part]))
    return outlines


def hidden_pixels(volume: Volume, outlines: list[Outline]) -> NDArray[np.bool_]:
    """(V, H, W), pixels off the mask where something stands before a part of the hull: it need not be empty there.

    Nor need it beyond a photo that is smaller than the others.
    """
    object_from_unit = volume.nerf_from_object.inverse()
    centres = object_from_unit.apply((np.argwhere(volume.hull) + 0.5) / len(volume.hull))
    reach = _reach(object_from_unit, len(volume.hull))
    height, width = (max(getattr(outline.view, side) for outline in outlines) for side in ("height", "width"))
    hidden = np.ones((len(outlines), height, width), dtype=bool)
    for place, outline in zip(hidden, outlines):
        place[: outline.view.height, : outline.view.width] = _hides(outline, centres, reach)
    return hidden


def _hides(outline: Outline, centres: Array, reach: float) -> NDArray[np.bool_]:
    """`hidden_pixels` (H, W) of one photo for cells with these centres (N, 3), `reach` half their diagonal."""
    view, first = outline
    if first is None:
        return np.zeros((view.height, view.width), dtype=bool)
    rows, pixels, depth = view.visible(centres)
    farthest = np.zeros((view.height, view.width), np.float32)
    np.maximum.at(farthest, (pixels[:, 1], pixels[:, 0]), depth)
    radius = int(np.ceil(reach * view.intrinsics[0, 0] / np.median(depth))) if len(rows) else 0
    grown = cv2.dilate(farthest, np.ones((2 * radius + 1, 2 * radius + 1)))
    return np.asarray(~view.pixels & (first < grown))


def _rough_cube(views: list[View], own: Array) -> Sim3:
    """By the cameras where a quarter of the photos have the object whole; else around its own points, if it has some:
    what masks show of a facade has neither its middle nor its extent."""
    if len(own) < MIN_OWN_POINTS or sum(is_whole(view.pixels) for view in views) >= MIN_WHOLE_SHARE * len(views):
        return cube_from_cameras(views)
    low, high = ends_of(own)
    side = float((high - low).max() + 2 * ROUGH_MARGIN * np.linalg.norm(high - low))
    return Sim3(1 / side, np.eye(3), 0.5 - (low + high) / (2 * side))


def cube_from_cameras(views: list[View]) -> Sim3:
    """A generous cube around the object from masks and cameras alone: unit_from_object.

    Its centre is the point nearest to the viewing rays of the masks' centres; its size follows from their extents.

    Raises:
        StageError: fewer than two photos.
    """
    normal, right, centres, angles = np.zeros((3, 3)), np.zeros(3), [], []
    for view in views:
        rows, columns = np.nonzero(view.pixels)
        # A few stray pixels of a mask do not count.
        box = np.percentile(columns, [0.5, 99.5]), np.percentile(rows, [0.5, 99.5])
        middle = np.array([box[0].mean() + 0.5, box[1].mean() + 0.5, 1.0])
        direction = view.cam_from_world[:3, :3].T @ np.linalg.solve(view.intrinsics, middle)
        direction /= np.linalg.norm(direction)
        project = np.eye(3) - np.outer(direction, direction)
        normal, right = normal + project, right + project @ view.centre
        centres.append(view.centre)
        angles.append(0.5 * np.hypot(np.ptp(box[0]) / view.intrinsics[0, 0], np.ptp(box[1]) / view.intrinsics[1, 1]))
    if len(centres) < 2:
        raise StageError(f"{len(centres)} photos with a mask of the object are trained on, two are needed; add some")
    center = np.linalg.solve(normal, right)
    radius = max(np.percentile(np.linalg.norm(np.array(centres) - center, axis=1) * np.array(angles), 90), 1e-9)
    scale = 0.5 / ((1 + 2 * ROUGH_MARGIN) * radius)
    return Sim3(scale, np.eye(3), 0.5 - scale * center)


def tight_cube(hull: NDArray[np.bool_], unit_from_object: Sim3, margin: float) -> Sim3:
    """The cube around a hull's cells, `margin` (share of its side) wider on each side: nerf_from_object.

    Raises:
        StageError: the hull is empty.
    """
    cells = np.argwhere(hull)
    if len(cells) == 0:
        raise StageError(EMPTY_HULL)
    low, high = cells.min(0) / len(hull), (cells.max(0) + 1) / len(hull)
    object_from_unit = unit_from_object.inverse()
    center = object_from_unit.apply((low + high) / 2)
    scale = 1.0 / (object_from_unit.scale * float((high - low).max()) * (1 + 2 * margin))
    return Sim3(scale, np.eye(3), 0.5 - scale * center)


def visual_hull(
    outlines: list[Outline], unit_from_object: Sim3, size: int, tolerance: float, own: Array = NO_POINTS
) -> NDArray[np.bool_]:
    """Cells (size, size, size) of the unit cube that project into (nearly) every mask of the photos that may see them.

    From coarse to fine: a coarse cell is kept where it touches the masks, and split into eight.

    Args:
        outlines: of the photos.
        unit_from_object: the cube.
        size: cells per side, a multiple of 4 times a power of 2.
        tolerance: share of the photos that may have a cell outside their mask, rounded to a number of photos.
        own: (N, 3) points on the object.
    """
    object_from_unit = unit_from_object.inverse()
    count = size // 4
    quorum = least_framing([outline.view for outline in outlines], own, MIN_FRAMING_OF_HULL)
    cells, children = _corners(count), _corners(2)
    while True:
        points = object_from_unit.apply((cells + 0.5) / count)
        reach = _reach(object_from_unit, count)
        grown = (_grown(outline, points, reach) for outline in outlines)
        # Three photos must have a cell on the mask, not deep behind the surface, where some have it behind the
        # surroundings: what lies behind these and the object is no part of it that one could see.
        found = count_silhouettes(points, grown, object_from_unit.scale * SURFACE_DEPTH)
        # Of a coarse cell that is hidden one part may be in sight.
        shown = found.shown + (found.hidden if count < size else 0)
        kept = (found.missed <= np.round(tolerance * shown)) & (shown >= quorum)
        if count == size:
            kept &= (found.hidden == 0) | (found.open >= CONFIRMING_PHOTOS)
        cells = cells[kept]
        if count == size or len(cells) == 0:
            hull = np.zeros((size, size, size), dtype=bool)
            hull[tuple(cells.T)] = True
            return hull
        cells, count = (2 * cells[:, None] + children).reshape(-1, 3), 2 * count


def _reach(object_from_unit: Sim3, count: int) -> float:
    """Half the diagonal of one of `count` cells per side, sqrt(3) / 2 rounded up: what a mask grows by to hold them."""
    return object_from_unit.scale * 0.87 / count


def _corners(count: int) -> NDArray[np.int64]:
    """(count^3, 3) indices of the cells of a grid."""
    return np.stack(np.meshgrid(*[np.arange(count)] * 3, indexing="ij"), -1).reshape(-1, 3)


def _grown(outline: Outline, points: Array, reach: float) -> Outline:
    """The photo with its mask grown by a length `reach` at the points' median depth, and what it shows likewise."""
    view, first = outline
    depth = np.maximum(points @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3], 1e-9)
    wanted = int(np.ceil(reach * view.intrinsics[0, 0] / max(float(np.median(depth)), 1e-9)))
    radius = min(wanted, max(view.pixels.shape))  # a camera of a wrong pose may stand in the cube, or look away
    if first is not None:
        least = cv2.erode(cv2.erode(first, np.ones((2 * radius + 1, 1))), np.ones((1, 2 * radius + 1)))
        first = (least - reach).astype(np.float32)
    return Outline(replace(view, pixels=dilate(torch.from_numpy(view.pixels)[None], radius)[0].numpy()), first)
