"""The visual hull of an object: a voxel grid carved by the masks of all photos, with a share of them allowed to err.

Source: Laurentini 1994 (visual hull), with voting instead of a strict intersection.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.core.transforms import Array, Sim3
from scenefuse.geometry.depth_test import MIN_AGREEING
from scenefuse.geometry.photo_check import moved_view
from scenefuse.photos.workspace import View

Mask = NDArray[np.bool_]
Counts = NDArray[np.int32]

# Photos that must frame a place: a share of those that frame this percentile of the object's own points, and
# MIN_AGREEING.
MIN_FRAMING_SHARE, FRAMING_PERCENTILE = 0.25, 10
# With fewer own points, the photos that show the object whole count, or this share of all photos.
MIN_WHOLE_SHARE = 1 / 3
# Fewer points on the object do not show its extent.
MIN_OWN_POINTS = 10
# How far an object reaches beyond the points known of it, as a share of their extent: these seldom mark its ends.
# Prompts no farther apart enclose a part: close clicks mark the corners of a small one.
MAX_BEYOND_POINTS = 0.15
# Share of the photos that may have a place of the hull outside their mask: masks err.
MAX_WRONG_SHARE = 0.1
NO_POINTS: Array = np.zeros((0, 3))


@dataclass(frozen=True)
class Box:
    """A box in the object's frame.

    Attributes:
        object_from_box: (3, 4) pose; the box's third axis is up.
        low, high: (3,) extents along the box's axes, in object units.
    """

    object_from_box: Array
    low: Array
    high: Array

    def to_object(self, x_in_box: Array) -> Array:
        """(N, 3) points from the box's axes to the object's frame."""
        return x_in_box @ self.object_from_box[:, :3].T + self.object_from_box[:, 3]

    def to_box(self, x_in_object: Array) -> Array:
        """(N, 3) points from the object's frame to the box's axes."""
        return (x_in_object - self.object_from_box[:, 3]) @ self.object_from_box[:, :3]

    @property
    def diagonal(self) -> float:
        """Length of the diagonal, in object units."""
        return float(np.linalg.norm(self.high - self.low))


@dataclass(frozen=True)
class Hull:
    """The occupied voxels of a box.

    Attributes:
        shell: (N, 3) centres of the occupied voxels that have a free neighbour, in the object's frame.
        voxel: side of a voxel, in object units.
    """

    shell: Array
    voxel: float


class Outline(NamedTuple):
    """A photo of the hull: a view with `pixels` (H, W) bool, True on the object, and the depth (H, W) along z of what
    it shows, infinite where that is unknown; None where it is unknown everywhere."""

    view: View
    depth: NDArray[np.float32] | None = None


class Silhouettes(NamedTuple):
    """How V photos show N points.

    Attributes:
        shown: (N,) photos that have the point in the frame, with nothing of the surroundings before it.
        missed: (N,) of these, photos that have it off the mask.
        hidden: (N,) photos in which something of the surroundings stands before it: they say nothing.
        open: (N,) photos that have it on the mask, and not behind the surface that they are known to show there.
    """

    shown: Counts
    missed: Counts
    hidden: Counts
    open: Counts


def count_silhouettes(points: NDArray[Any], outlines: Iterable[Outline], beyond: float = 0.0) -> Silhouettes:
    """How photos show points; with the counts a caller decides how many photos may err. Source: Laurentini 1994.

    Args:
        points: (N, 3) in the views' world, float32 or float64; projections are computed in their precision.
        outlines: the photos.
        beyond: how far behind the object's surface a point is still open, unit of the world.
    """
    counts = Silhouettes(*(np.zeros(len(points), dtype=np.int32) for _ in range(4)))
    for view, first in outlines:
        projection = view.projection.astype(points.dtype)
        x, y, depth = (points @ projection[:, :3].T + projection[:, 3]).T
        safe = np.maximum(depth, 1e-6)
        u, v = (np.clip(c / safe, -1, 1e6).astype(np.int32) for c in (x, y))
        rows = np.flatnonzero((depth > 0) & (x >= 0) & (u < view.width) & (y >= 0) & (v < view.height))
        inside = view.pixels[v[rows], u[rows]]
        away = np.full(len(rows), -np.inf) if first is None else depth[rows] - first[v[rows], u[rows]]
        counts.hidden[rows] += ~inside & (away > 0)
        counts.missed[rows] += ~inside & (away <= 0)
        counts.open[rows] += inside & np.isfinite(away) & (away <= beyond)
        counts.shown[rows] += inside | (away <= 0)
    return counts


def least_framing(views: Sequence[View], own: Array, share: float = MIN_FRAMING_SHARE) -> int:
    """How many photos must have a place in their frame for it to be the object's, whatever they show there.

    A share of as many as have the places that the fewest have: of a long facade, or of a statue with many photos of its
    head, some have a part only.

    Args:
        views: the photos, with masks as `pixels`.
        own: (N, 3) points on the object, of any number; where they are few, the photos that have it whole count.
        share: of these photos.
    """
    if len(own) >= MIN_OWN_POINTS:
        framed = np.zeros(len(own), dtype=np.int64)
        for view in views:
            framed[view.visible(own)[0]] += 1
        usual = float(np.percentile(framed, FRAMING_PERCENTILE))
    else:
        usual = max(sum(is_whole(view.pixels) for view in views), MIN_WHOLE_SHARE * len(views))
    return max(MIN_AGREEING, int(np.ceil(share * usual)))


def is_whole(mask: Mask) -> bool:
    """Whether a mask (H, W) ends before the photo does."""
    return bool(mask.any() and not (mask[[0, -1]].any() or mask[:, [0, -1]].any()))


def carve(
    box: Box,
    height_of: Callable[[Array], Array],
    silhouettes: list[View],
    voxels: int,
    tolerance: float,
    own: Array = NO_POINTS,
) -> Hull:
    """The voxels of a box, above the ground, that all masks but a share of `tolerance` contain.

    Args:
        box: the space to carve from.
        height_of: heights (N,) over the ground of (N, 3) points along the box's axes; nothing below 0
            belongs to the object.
        silhouettes: cameras with masks as `pixels`; a photo counts for the voxels in its frame.
        voxels: number along each side of a cube; of a pole's box there are as many in all.
        tolerance: share of the photos that show a voxel which may have it outside their mask.
        own: (N, 3) points on the object, for `least_framing`.
    """
    size = np.cbrt((box.high - box.low).prod()) / voxels
    shape = np.maximum(np.ceil((box.high - box.low) / size).astype(int), 1)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    x_in_box = box.low + (index + 0.5) * size
    # About the box's middle: float32 has steps of half a metre in the coordinates of a UTM zone.
    middle = box.to_object((box.low + box.high) / 2)
    centres = (box.to_object(x_in_box) - middle).astype(np.float32)
    silhouettes = [moved_view(view, Sim3(1.0, np.eye(3), -middle)) for view in silhouettes]
    alive = np.flatnonzero(height_of(x_in_box) > 0)
    shown, missed = (np.zeros(len(centres), dtype=np.int32) for _ in range(2))
    together = 4  # photos, after which the voxels that are decided are left out: most are, early
    for start in range(0, len(silhouettes), together):
        counts = count_silhouettes(centres[alive], map(Outline, silhouettes[start : start + together]))
        shown[alive] += counts.shown
        missed[alive] += counts.missed
        # A voxel outside more masks than all photos together could excuse is decided.
        alive = alive[missed[alive] <= tolerance * len(silhouettes)]
    occupied = np.zeros(len(centres), dtype=bool)
    enough = shown[alive] >= least_framing(silhouettes, own - middle)
    occupied[alive] = enough & (missed[alive] <= tolerance * shown[alive])
    grid = occupied.reshape(shape)
    shell = grid & ~ndimage.binary_erosion(grid)
    return Hull(centres[shell.ravel()] + middle, float(size))


def silhouette(hull: Hull, view: View) -> Mask:
    """The hull as the photo sees it, (H, W)."""
    pixels, depth = view.project(hull.shell)
    front = depth > 1e-6
    if not front.any():
        return np.zeros((view.height, view.width), dtype=bool)
    side = hull.voxel * view.intrinsics[0, 0] / depth[front]
    # Closing by a voxel joins the dots; a third of it more stands for the voxel's own extent.
    reach = 2 * int(np.ceil(0.75 * np.median(side))) + 1
    # Nearer voxels, of a wall along which a photo looks, lie too far apart for it: they are drawn as large as they are.
    half = np.where(side > reach / np.sqrt(2), side / 2, 0)[:, None]
    low, high = np.floor(pixels[front] - half), np.floor(pixels[front] + half)
    inside = (high >= 0).all(1) & (low < (view.width, view.height)).all(1)
    drawn = np.zeros((view.height, view.width), dtype=np.uint8)
    u, v = low[inside & (half[:, 0] == 0)].astype(int).T
    drawn[v, u] = 255
    large = np.concatenate([low, high + 1], axis=1)[inside & (half[:, 0] > 0)]
    for left, top, right, bottom in np.clip(large, 0, max(drawn.shape)).astype(int).tolist():
        drawn[top:bottom, left:right] = 255
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    return cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, kernel) > 0


def mask_iou(a: Mask, b: Mask) -> float:
    """Intersection over union of two masks; 1 when both are empty, since they agree."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0
