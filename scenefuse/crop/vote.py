"""Which points of a scene lie inside an object's masks, seen through its cameras and a known similarity."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import spacing
from scenefuse.core.stage import StageError, threads
from scenefuse.core.transforms import Array, Sim3
from scenefuse.crop.crop_cloud import without_strays
from scenefuse.geometry.depth_test import CELL_SPACINGS, SURFACE_SPACINGS, Where, depth_buffer, depth_test
from scenefuse.geometry.photo_check import CONFIRMING_PHOTOS, MAX_PHOTOS
from scenefuse.geometry.visual_hull import MAX_BEYOND_POINTS, least_framing
from scenefuse.mvs.sparse_depths import MASK_REACH_PX, MIN_SHARED_POINTS
from scenefuse.photos.workspace import View, read_workspace, with_mask

# Where the photos stand farther from the object than so many of its extents, what hides it there is not looked for.
MAX_DISTANCE_EXTENTS = 4.0


@dataclass(frozen=True)
class Votes:
    """Votes of an object's masks on points of the scene.

    Attributes:
        object: (N,) bool, True for points of the object.
        other: (N,) bool, True for points of something else; points that too few photos show are neither.
        own: (K, 3) SfM points of the object's photos on the object, in the scene frame.
    """

    object: NDArray[np.bool_]
    other: NDArray[np.bool_]
    own: Array


@dataclass(frozen=True)
class Masked:
    """An object's photos with their masks.

    Attributes:
        views: with `pixels` True on the mask, grown by MASK_REACH_PX for what they and the similarity err by.
        own: (K, 3) SfM points on the object, in its frame.
    """

    views: list[View]
    own: Array

    def sight(self, scene_from_object: Sim3) -> Array:
        """(K + V, 3) the own points and the cameras in the scene, those too far away moved nearer."""
        own = scene_from_object.apply(self.own)
        eyes = scene_from_object.apply(np.array([view.centre for view in self.views]))
        far = MAX_DISTANCE_EXTENTS * float(np.linalg.norm(np.ptp(own, axis=0)))
        return np.concatenate([own, np.clip(eyes, own.min(0) - far, own.max(0) + far)])


def vote(points: Array, masked: Masked, scene_from_object: Sim3, min_share: float) -> Votes:
    """Project every point of a scene into an object's masks.

    A photo votes on a point that falls into its frame and that no nearer scene point hides; three votes make a
    decision. A point is the object's when at least `min_share` of them have it inside their mask, enough photos have it
    in their frame (`least_framing`), and one of the object's own SfM points is near; something else's when most have it
    outside.

    Args:
        points: (N, 3) in the scene frame.
        masked: of `read_masked_views`.
        scene_from_object: the similarity.
        min_share: of the photos that vote on a point, how many must have it inside the mask.
    """
    views, own = masked.views, masked.own
    in_object = scene_from_object.inverse().apply(points)
    least = least_framing(views, own)
    framed, shown, inside = count(in_object, views, least)
    decided = shown >= CONFIRMING_PHOTOS
    is_object = decided & (framed >= least) & (inside >= min_share * shown)
    rows = np.flatnonzero(is_object)
    reach = MAX_BEYOND_POINTS * float(np.linalg.norm(np.ptp(own, axis=0)))
    is_object[rows] = cKDTree(own).query(in_object[rows], workers=threads())[0] <= reach
    return Votes(is_object, decided & (inside < 0.5 * shown), scene_from_object.apply(own))


def read_masked_views(workspace: Path, masks: Path, min_share: float) -> Masked:
    """At most MAX_PHOTOS of an object's photos, spread evenly, with their masks, and the SfM points on the object.

    An SfM point is on the object when it is inside the mask in `min_share` of the photos that observe it, three or
    more; strays are left out.

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of {name}.png, non-zero on the object.
        min_share: see `vote`.

    Raises:
        StageError: too few photos have a mask, a mask is not of its photo's size, or too few SfM points lie inside.
    """
    read = read_workspace(workspace)
    files = [(masks / f"{Path(view.name).stem}.png", view, seen) for view, seen in zip(read.views, read.seen)]
    files = [file for file in files if file[0].is_file()]
    if len(files) < CONFIRMING_PHOTOS:
        raise StageError(
            f"{len(files)} photos of {workspace} have a mask in {masks}, three are needed; rerun the masks"
        )
    observing, inside = (np.zeros(len(read.points), dtype=np.int32) for _ in range(2))
    found = []
    chosen = np.unique(np.linspace(0, len(files) - 1, min(MAX_PHOTOS, len(files))).round().astype(int))
    for path, view, seen in (files[k] for k in chosen):
        one = _with_grown_mask(view, path)
        found.append(one)
        observed = np.unique(seen)
        rows, pixels, _ = one.visible(read.points[observed])
        observing[observed[rows]] += 1
        inside[observed[rows]] += one.pixels[pixels[:, 1], pixels[:, 0]]
    own = read.points[(observing >= CONFIRMING_PHOTOS) & (inside >= min_share * observing)]
    if len(own) < MIN_SHARED_POINTS:
        raise StageError(
            f"only {len(own)} SfM points of {workspace} lie inside the masks of {masks},"
            f" {MIN_SHARED_POINTS} are needed; look at the masks, and take sharper photos of the object"
        )
    return Masked(found, without_strays(own))


def _with_grown_mask(view: View, path: Path) -> View:
    """The view with its mask, grown on all sides."""
    extent = 2 * MASK_REACH_PX + 1
    grown = cv2.dilate(with_mask(view, path).pixels, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (extent, extent)))
    return replace(view, pixels=grown > 0)


def count(
    in_object: Array, views: list[View], least: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """How many photos frame each of (N, 3) points, show it unhidden, and have it inside the mask then.

    What hides is judged by the spacing of those that `least` photos frame.
    """
    framed, shown, inside = (np.zeros(len(in_object), dtype=np.int32) for _ in range(3))
    for one in views:
        framed[one.visible(in_object)[0]] += 1
    around = np.flatnonzero(framed >= least)
    if len(around) < 2:
        return framed, shown, inside
    step = spacing(in_object[around])
    for one in views:
        rows, pixels, _ = one.visible(in_object)
        near = in_object[rows]
        nearest = depth_buffer(near, one, 2 * CELL_SPACINGS * step)  # points of a scene lie unevenly
        unhidden = depth_test(near, nearest, SURFACE_SPACINGS * step) != Where.BEHIND
        rows, pixels = rows[unhidden], pixels[unhidden]
        shown[rows] += 1
        inside[rows] += one.pixels[pixels[:, 1], pixels[:, 0]]
    return framed, shown, inside
