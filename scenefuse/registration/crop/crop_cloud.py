"""The points of a scene that belong to a marked object: a box or hull, without the ground and without loose parts."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import QhullError, cKDTree

from scenefuse.io.clouds import Cloud, spacing
from scenefuse.registration.crop.shapes import in_wide_hull, least_footprint
from scenefuse.sfm.ground import Ground, fit_ground
from scenefuse.stage import setting, threads
from scenefuse.transforms import Array, rotation_between

# Shares of the diagonal of the fiducials' box.
MARGIN_FRACTION = 0.04  # widening of the box beside `margin`: two pairing distances of the registration
RING_FRACTION = 0.5  # width of the ring around the box in which the ground is looked for
GROUND_FRACTION = 0.015  # points lower than this above the ground are ground
LINK_FRACTION = 0.03  # points closer than this belong to one part
REACH_FRACTION = 0.05  # a part this near to a fiducial belongs to the object
# Parts with a smaller share of the points are left out.
MIN_PART = 0.01


@dataclass(frozen=True)
class CropSettings:
    """Settings of the crop."""

    mode: Literal["fiducials", "masks"] = setting("fiducials")
    """What marks the object in the scene: fiducials, or its masks, seen through the alignment from shared features (in
    any case for objects without fiducials)."""
    shape: Literal["box", "oriented", "hull"] = setting("box")
    """The fiducials' box, the same turned about the vertical to their least footprint, or their convex hull."""
    margin: float = setting(0.05, least=0)
    """Widening of the box on every side, as a share of its own extent."""
    remove_ground: bool = setting(True)
    """Whether the ground is fitted around the box and removed inside."""
    max_residual_px: float = setting(5, unit="px", least=0)
    """Clicks of one fiducial may miss each other by this much, RMS, in pixels of the photos."""
    min_votes: float = setting(0.8, above=0, most=1)
    """Share of the object's photos showing a scene point that must have it inside their mask; mode masks only."""
    whole_scene: bool = False
    """Keep the whole scene, whatever the mode: the ablation without cropping."""


@dataclass(frozen=True)
class Crop:
    """What was cut out and how.

    Attributes:
        keep: (N,) bool over the scene's points, True on the object.
        in_box: (N,) bool, True for all points in the box or hull, ground included.
        shape: box, oriented or hull: what was cut out; None for the whole scene.
        level_from_scene: (3, 3) rotation that turns the scene's up into z, and the box's sides into x and y.
        low: (3,) least corner of the box (around the hull) in the level frame.
        high: (3,) greatest corner.
        ground: the fitted ground, or None.
        notes: what was not done and why.
    """

    keep: NDArray[np.bool_]
    in_box: NDArray[np.bool_]
    shape: str | None
    level_from_scene: Array
    low: Array
    high: Array
    ground: Ground | None
    notes: list[str]


def whole(scene: Cloud) -> Crop:
    """The whole scene as a crop."""
    everything = np.ones(len(scene), dtype=bool)
    return Crop(everything, everything, None, np.eye(3), scene.points.min(0), scene.points.max(0), None, [])


def crop_cloud(
    scene: Cloud, fiducials: Array, up: Array, settings: CropSettings, other: NDArray[np.bool_] | None = None
) -> Crop:
    """The points of a scene that belong to the object marked by fiducials (F, 3), without those known to be `other`."""
    level, shape = rotation_between(up, np.array([0.0, 0.0, 1.0])), settings.shape
    notes: list[str] = []
    if shape == "oriented":
        level = least_footprint(fiducials @ level.T) @ level
    points, marks = scene.points @ level.T, fiducials @ level.T
    extent = np.ptp(marks, axis=0)
    diagonal = float(np.linalg.norm(extent))
    margin = settings.margin * extent + MARGIN_FRACTION * diagonal
    low, high = marks.min(0) - margin, marks.max(0) + margin
    ground = None
    if settings.remove_ground:
        ground = fit_ground(points, low, high, RING_FRACTION * diagonal, GROUND_FRACTION * diagonal)
        if ground is None:
            notes.append("no ground was found around the box: nothing was removed as ground")
        else:
            # Fiducials are clicked where the scene shows the object; what it stands on bounds it below.
            corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
            low[2] = min(low[2], ground.height(corners).min() - GROUND_FRACTION * diagonal)
    in_box = ((points >= low) & (points <= high)).all(1)
    if shape == "hull":
        try:
            in_box[in_box] = in_wide_hull(points[in_box], marks, low[2], margin)
        except QhullError:
            shape = "box"
            notes.append("the fiducials lie in one vertical plane and span no hull: their box was cut out instead")
    above = in_box.copy()
    if ground is not None:
        above &= points[:, 2] > ground.height(points[:, :2]) + ground.tolerance
    if other is not None:
        above &= ~other
    keep = above.copy()
    inside = np.flatnonzero(above)
    if len(inside):
        link = max(LINK_FRACTION * diagonal, 3 * spacing(points[inside]))
        near = _parts_near(points[inside], marks, link, REACH_FRACTION * diagonal)
        if near.any():
            keep[inside] = near
        else:
            notes.append("no part in the box lies near a fiducial: all of them were kept")
    return Crop(keep, in_box, shape, level, low, high, ground, notes)


def parts(points: Array, link: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The connected part of each point, of points closer than about `link`, and how many points each part has."""
    cells, cell_of = np.unique(np.floor(points / link).astype(np.int64), axis=0, return_inverse=True)
    touching = cKDTree(cells).query_pairs(1.8, output_type="ndarray")
    graph = coo_matrix((np.ones(len(touching)), touching.T), shape=(len(cells), len(cells)))
    part_of = connected_components(graph, directed=False)[1][cell_of.ravel()]
    return part_of, np.bincount(part_of)


def _parts_near(points: Array, marks: Array, link: float, reach: float) -> NDArray[np.bool_]:
    """Which points belong to a large enough part that a fiducial touches or that mostly lies between fiducials.

    The second counts for parts no one clicked, a wall under a roof for instance: half their points in the fiducials'
    own box, seen from above.
    """
    part_of, counts = parts(points, link)
    touched = np.bincount(part_of, cKDTree(marks).query(points, workers=threads())[0] <= reach) > 0
    low, high = marks.min(0)[:2], marks.max(0)[:2]
    between = np.bincount(part_of, ((points[:, :2] >= low) & (points[:, :2] <= high)).all(1))
    wanted = (counts >= MIN_PART * len(points)) & (touched | (between >= 0.5 * counts))
    return wanted[part_of]
