"""The object in the scene from a few clicks in one of the scene's photos, with the depth of the dense cloud."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud
from scenefuse.cloud.tiled_cloud import Rows, TiledCloud
from scenefuse.core.stage import StageError, threads
from scenefuse.core.transforms import FIXING_POINTS, Array
from scenefuse.crop.crop_cloud import (
    MIN_PART_SHARE,
    STRAY_SHARE,
    Crop,
    CropSettings,
    crop_cloud,
    without_strays,
)
from scenefuse.geometry.depth_test import CELL_SPACINGS, SURFACE_SPACINGS
from scenefuse.geometry.surface import NORMAL_NEIGHBOURS, SCORE_FRACTION
from scenefuse.marks.clicks import Clicks
from scenefuse.marks.photo_clicks import PhotoClicks, clicks_per_photo
from scenefuse.photos.workspace import View, read_views

# What a click outside lies on is flat where the points around it have at most this surface variation; then it is what
# lies as near to their plane as points of one part lie to each other.
MAX_VARIATION = 0.02
# Inside clicks with a depth that lay an object down, and points that are no strays.
MIN_INSIDE = FIXING_POINTS
# The object reaches at most so much farther than its clicks, as a ratio of diagonals: clicks are spread over the side
# that the photo shows. What is larger is connected with something else.
MAX_GROWTH = 3.0


@dataclass(frozen=True)
class SceneClicks:
    """Clicks in photos of the scene, with their depth.

    Attributes:
        names: of the inside clicks, for messages.
        inside: (F, 3) where they are, in the scene frame.
        outside: (O, 3) the same of clicks outside.
        boxes: photos with the box that was clicked in them.
        left_out: clicks where the scene has no point, or whose photo has no camera, a sentence each.
    """

    names: list[str]
    inside: Array
    outside: Array
    boxes: list[tuple[View, PhotoClicks]]
    left_out: list[str]

    def other(self, points: Array) -> NDArray[np.bool_]:
        """(N,) points (N, 3) that are something else: nearer to a click outside than to any inside, or off a box.

        Of a click on something flat, as the ground beside a wall, only what lies in that plane: clicks inside are few,
        and most of the wall is nearer to it than to these.
        """
        found = np.zeros(len(points), dtype=bool)
        for view, clicks in self.boxes:
            found |= _off_box(clicks, *view.project(points))
        if not len(self.outside):
            return found
        (to_outside, row), (to_inside, _) = (
            cKDTree(side).query(points, workers=threads()) for side in (self.outside, self.inside)
        )
        extent = float(np.linalg.norm(np.ptp(self.inside, axis=0)))
        for k, click in enumerate(self.outside):
            own = (row == k) & (to_outside < to_inside)
            around = points[np.argsort(np.linalg.norm(points - click, axis=1), kind="stable")[:NORMAL_NEIGHBOURS]]
            spread, axes = np.linalg.eigh(np.cov(around.T))
            if spread[0] < MAX_VARIATION * spread.sum():
                own &= np.abs((points - around.mean(0)) @ axes[:, 0]) < 2 * SCORE_FRACTION * extent
            found |= own
        return found


def locate_clicks(labels: Clicks, sparse: Path, scene: TiledCloud) -> SceneClicks:
    """Where labelled pixels of scene photos are in the scene: on the nearest points of the dense cloud there (C5).

    Args:
        labels: pixels of the scene's photos, inside and outside the object, or a box around it.
        sparse: COLMAP model of these photos.
        scene: dense cloud in the model's frame; what lies along the clicks is read of it.

    Raises:
        StageError: as `clicks_per_photo`; fewer than three inside clicks meet the scene.
    """
    views = read_views(sparse)
    step = scene.spacing()
    names: list[str] = []
    sides: tuple[list[Array], list[Array]] = ([], [])
    boxes = []
    clicked, lost = clicks_per_photo(labels, sparse, views, None)
    left_out = [f"{sentence}: left out of {labels.path}" for sentence in lost]
    for row, clicks in clicked.items():
        view = views[row]
        points = scene.read(_behind(clicks.pixels, scene, step, view))[1].points
        pixels, depth = view.project(points)
        for pixel, inside in zip(clicks.pixels, clicks.inside):
            name = f"{'inside' if inside else 'outside'} ({pixel[0]:.0f}, {pixel[1]:.0f}) in {view.name}"
            found = _on_surface(points, pixels, depth, pixel, step, view)
            if found is None:
                left_out.append(f"the click {name} of {labels.path} meets no point of the scene: left out")
            else:
                sides[int(inside)].append(found)
                names += [name] * bool(inside)
        if clicks.box is not None:
            boxes.append((view, clicks))
    if len(sides[1]) < MIN_INSIDE:
        about = f" ({'; '.join(left_out)})" if left_out else ""
        raise StageError(
            f"{labels.path} has {len(sides[1])} clicks inside the object that meet points of the scene, {MIN_INSIDE}"
            f" are needed{about}: click on the object's ends, in a photo that shows it well"
        )
    return SceneClicks(names, np.array(sides[1]), np.array(sides[0]).reshape(-1, 3), boxes, left_out)


def _behind(pixels: Array, scene: TiledCloud, step: float, view: View) -> Rows:
    """The tiles of a scene that a photo may show about one of (K, 2) pixels; those that reach behind it too."""
    corners = [np.where(end, scene.high, scene.low) for end in np.ndindex(2, 2, 2)]
    at, depth = view.project(np.concatenate(corners))
    at, depth = at.reshape(8, -1, 2), depth.reshape(8, -1)
    reach = np.maximum(1.0, CELL_SPACINGS * step * float(view.intrinsics[0, 0]) / np.maximum(depth.min(0), step))
    low, high = at.min(0) - reach[:, None], at.max(0) + reach[:, None]
    shown = ((pixels[:, None] >= low) & (pixels[:, None] <= high)).all(2).any(0)
    return np.flatnonzero((depth.max(0) > 0) & (shown | (depth.min(0) <= step)))


def _on_surface(points: Array, pixels: Array, depth: Array, pixel: Array, step: float, view: View) -> Array | None:
    """The middle (3,) of the nearest points (N, 3) that a photo shows about a pixel; None where there are none."""
    focal = float(view.intrinsics[0, 0])
    with np.errstate(divide="ignore"):
        reach = np.maximum(1.0, CELL_SPACINGS * step * focal / depth)  # a pixel at least
    rows = np.flatnonzero((depth > 0) & (np.abs(pixels - pixel).max(1) <= reach))
    if not len(rows):
        return None
    # A single point that floats before the surface does not say where it is.
    ahead, thick = np.sort(depth[rows]), SURFACE_SPACINGS * step
    crowd = np.searchsorted(ahead, ahead + thick, side="right") - np.arange(len(ahead)) >= MIN_INSIDE
    nearest = ahead[crowd.argmax()]
    front = rows[(depth[rows] >= nearest) & (depth[rows] <= nearest + thick)]
    return np.median(points[front], axis=0)


def _off_box(clicks: PhotoClicks, pixels: Array, depth: Array) -> NDArray[np.bool_]:
    """(N,) which of the projected points lie outside the box clicked in the photo."""
    if clicks.box is None:
        return np.zeros(len(depth), dtype=bool)
    return (depth <= 0) | (pixels < clicks.box[0]).any(1) | (pixels > clicks.box[1]).any(1)


def crop_grown(scene: Cloud, inside: Array, up: Array, settings: CropSettings, other: NDArray[np.bool_]) -> Crop:
    """`crop_cloud` around clicks on one side of an object, grown along what they lie on, to its other sides (C5).

    Each round takes the points of the last crop as its marks, until one adds no more than the points of a part that
    would be left out. Growth ends at the ground, at gaps and at points that are something else. Where the object is
    connected with something much larger, the box around the clicks remains, and a note says so.

    Args:
        scene: the dense cloud.
        inside: (F, 3) clicks on the object.
        up: (3,) against gravity.
        settings: of the crop.
        other: (N,) points of the scene that are something else.
    """
    first = cut = crop_cloud(scene, inside, up, settings, other)
    most = MAX_GROWTH * float(np.linalg.norm(np.ptp(inside, axis=0)))
    while True:
        own = without_strays(scene.points[cut.keep], STRAY_SHARE / 2)  # in each round again
        if not len(own):
            return cut
        if np.linalg.norm(np.ptp(own, axis=0)) > most:
            break
        marks = np.concatenate([inside, own])
        grown = crop_cloud(scene, marks, up, settings, other)
        if grown.keep.sum() <= (1 + MIN_PART_SHARE) * cut.keep.sum():
            return grown
        cut = grown
    note = (
        f"what the clicks lie on reaches more than {MAX_GROWTH:g} times as far as they do: only the box around them"
        " was cut out; click on the object's ends, and outside, on what it touches"
    )
    return replace(first, notes=[note, *first.notes])
