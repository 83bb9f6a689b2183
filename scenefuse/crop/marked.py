"""Which points of a scene are an object's, and which something else's: by its masks, seen through its cameras and a
known similarity, or by a person's clicks in photos of the scene."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.cloud_file import MIN_STRAY_TIMES
from scenefuse.cloud.clouds import NEIGHBOURS, Cloud, occupied_voxels, spacing, within
from scenefuse.cloud.tiled_cloud import Rows, TiledCloud
from scenefuse.core.stage import StageError, threads
from scenefuse.core.transforms import FIXING_POINTS, UP, Array, Sim3
from scenefuse.crop.crop_cloud import (
    LINK_FRACTION,
    MIN_PART_SHARE,
    REACH_FRACTION,
    STRAY_SHARE,
    Crop,
    CropSettings,
    crop_cloud,
    without_strays,
)
from scenefuse.geometry.depth_test import (
    CELL_SPACINGS,
    CONFIRMING_PHOTOS,
    MAX_PHOTOS,
    SURFACE_SPACINGS,
    Where,
    depth_buffer,
    depth_test,
)
from scenefuse.geometry.surface import NORMAL_NEIGHBOURS
from scenefuse.geometry.visual_hull import MAX_BEYOND_POINTS, least_framing
from scenefuse.marks.clicks import Clicks
from scenefuse.marks.photo_clicks import clicks_per_photo
from scenefuse.mvs.sparse_depths import MASK_REACH_PX, MIN_SHARED_POINTS
from scenefuse.photos.workspace import View, Workspace, read_views, read_workspace, with_mask

# What a click outside lies on is flat where the points around it have at most this surface variation; then it is what
# lies as near to their plane as points of one part lie to each other.
MAX_VARIATION = 0.02
# Inside clicks with a depth that lay an object down, and points that are no strays.
MIN_INSIDE = FIXING_POINTS
# The object reaches at most so much farther than its clicks, as a ratio of diagonals: clicks are spread over the side
# that the photo shows. What is larger is connected with something else.
MAX_GROWTH = 3.0
# Where the photos stand farther from the object than so many of its extents, what hides it there is not looked for.
MAX_DISTANCE_EXTENTS = 4.0


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
    boxes: list[tuple[View, Array]]
    left_out: list[str]

    def other(self, points: Array) -> NDArray[np.bool_]:
        """(N,) points (N, 3) that are something else: nearer to a click outside than to any inside, or off a box.

        Of a click on something flat, as the ground beside a wall, only what lies in that plane: clicks inside are few,
        and most of the wall is nearer to it than to these.
        """
        found = np.zeros(len(points), dtype=bool)
        for view, box in self.boxes:
            found |= _off_box(box, *view.project(points), view)
        (to_outside, row), (to_inside, _) = (
            cKDTree(side).query(points, workers=threads()) for side in (self.outside, self.inside)
        )
        extent = float(np.linalg.norm(np.ptp(self.inside, axis=0)))
        for k, click in enumerate(self.outside):
            own = (row == k) & (to_outside < to_inside)
            if (plane := _plane_at(click, points, REACH_FRACTION * extent)) is not None:
                own &= np.abs((points - plane[0]) @ plane[1]) < LINK_FRACTION * extent
            found |= own
        return found


def _plane_at(click: Array, points: Array, reach: float) -> tuple[Array, Array] | None:
    """A point (3,) and the normal (3,) of the plane on which the points (N, 3) about a click lie; None where they are
    not flat. As many of them within reach as are: a few of a dense cloud are as thick as they are wide."""
    away = np.linalg.norm(points - click, axis=1)
    nearest, plane, count = np.argsort(away, kind="stable"), None, NORMAL_NEIGHBOURS
    while count <= max(NORMAL_NEIGHBOURS, int(np.sum(away < reach))):
        middle, normal, flat = _planes(points[nearest[:count]])
        plane, count = (middle, normal) if flat else plane, 2 * count
    return plane


def _planes(around: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Middles (..., 3) and normals (..., 3) of planes through points (..., K, 3), and which of these lie flat on them;
    those along a line do not."""
    middle = around.mean(-2)
    local = around - middle[..., None, :]
    spread, axes = np.linalg.eigh(np.swapaxes(local, -1, -2) @ local)
    return middle, axes[..., 0], spread[..., 0] < 2 * MAX_VARIATION * spread[..., 1]


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
    farthest = MIN_STRAY_TIMES * CELL_SPACINGS * step
    names, boxes = list[str](), list[tuple[View, Array]]()
    sides: tuple[list[Array], list[Array]] = ([], [])
    clicked, lost = clicks_per_photo(labels, sparse, views, None)
    left_out = [f"{sentence}: left out of {labels.path}" for sentence in lost]
    for row, clicks in clicked.items():
        view = views[row]
        points = scene.read(_behind(clicks.pixels, scene, farthest, view))[1].points
        (pixels, depth), tree = view.project(points), cKDTree(points)
        for pixel, inside in zip(clicks.pixels, clicks.inside):
            name = f"{'inside' if inside else 'outside'} ({pixel[0]:.0f}, {pixel[1]:.0f}) in {view.name}"
            # Beside an object outside clicks are of the ground, however far apart the object's points lie.
            reach = farthest if inside else CELL_SPACINGS * step
            found = _on_surface(tree, np.abs(pixels - pixel).max(1), depth, step, reach, view) if tree.n else None
            if found is None:
                left_out.append(f"the click {name} of {labels.path} meets no point of the scene: left out")
            else:
                sides[int(inside)].append(found)
                names += [name] * bool(inside)
        if clicks.box is not None:
            boxes.append((view, clicks.box))
    if len(sides[1]) < MIN_INSIDE:
        about = f" ({'; '.join(left_out)})" if left_out else ""
        raise StageError(
            f"{labels.path} has {len(sides[1])} clicks inside the object that meet points of the scene, {MIN_INSIDE}"
            f" are needed{about}: click on the object's ends, in a photo that shows it well"
        )
    return SceneClicks(names, np.array(sides[1]), np.array(sides[0]).reshape(-1, 3), boxes, left_out)


def _behind(pixels: Array, scene: TiledCloud, reach: float, view: View) -> Rows:
    """The tiles of a scene that a photo may show within reach of one of (K, 2) pixels; those that reach behind it
    too."""
    corners = [np.where(end, scene.high, scene.low) for end in np.ndindex(2, 2, 2)]
    at, depth = view.project(np.concatenate(corners))
    at, depth = at.reshape(8, -1, 2), depth.reshape(8, -1)
    around = _pixels_of(reach, np.maximum(depth.min(0), reach), view)[:, None]
    shown = ((pixels[:, None] >= at.min(0) - around) & (pixels[:, None] <= at.max(0) + around)).all(2).any(0)
    return np.flatnonzero((depth.max(0) > 0) & (shown | (depth.min(0) <= reach)))


def _pixels_of(length: float | Array, depth: Array, view: View) -> Array:
    """Pixels of lengths at positive depths (N,), one at least."""
    return np.maximum(1.0, length * view.intrinsics[0, 0] / depth)


def _on_surface(tree: cKDTree, off: Array, depth: Array, step: float, farthest: float, view: View) -> Array | None:
    """The middle (3,) of the nearest points that a photo shows about a pixel; None where there are none.

    About a pixel are those within two steps. Where the scene shows little, as of what a drone saw obliquely, a pixel
    falls between its points on what is behind: what lies flat, or not much farther apart than usual, is about it within
    the distance of its eighth neighbours, up to `farthest`, and counts where it hides the others.

    Args:
        tree: of points (N, 3) of the scene.
        off: (N,) pixels between them and the pixel, along the axis where these are more.
        depth: (N,) their depths.
        step: usual spacing.
        farthest: as far apart as points of a surface may lie.
        view: of the photo.
    """
    ahead, thick = np.flatnonzero(depth > 0), SURFACE_SPACINGS * step
    rows = ahead[off[ahead] <= _pixels_of(farthest, depth[ahead], view)]
    away, neighbours = tree.query(tree.data[rows], min(NEIGHBOURS + 1, tree.n), workers=threads())
    apart = np.where(_planes(tree.data[neighbours])[2] | (away[:, -1] <= thick), away[:, -1], 0.0)
    near, hiding = (
        _front(rows[off[rows] <= _pixels_of(np.maximum(reach, CELL_SPACINGS * step), depth[rows], view)], depth, thick)
        for reach in (0.0, apart)
    )
    if len(hiding) and (not len(near) or depth[hiding].min() < depth[near].min() - thick):
        near = hiding
    return np.median(tree.data[near], axis=0) if len(near) else None


def _front(rows: Rows, depth: Array, thick: float) -> Rows:
    """The rows in front, within a thickness; a single one that floats before the surface does not say where it is."""
    ahead = np.sort(depth[rows])
    crowd = np.searchsorted(ahead, ahead + thick, side="right") - np.arange(len(ahead)) >= MIN_INSIDE
    nearest = ahead[crowd.argmax()] if len(rows) else 0.0
    return rows[(depth[rows] >= nearest) & (depth[rows] <= nearest + thick)]


def _off_box(box: Array, pixels: Array, depth: Array, view: View) -> NDArray[np.bool_]:
    """(N,) which of the projected points lie outside the box (2, 2) clicked in a photo; where it ends at the photo's
    edge, the object may go on."""
    last = np.array([view.width, view.height]) - 1
    low, high = np.where(box[0] < 1, -np.inf, box[0]), np.where(box[1] > last, np.inf, box[1])
    return (depth <= 0) | (pixels < low).any(1) | (pixels > high).any(1)


def crop_grown(scene: Cloud, inside: Array, settings: CropSettings, other: NDArray[np.bool_]) -> Crop:
    """`crop_cloud` around clicks on one side of an object, grown along what they lie on, to its other sides (C5).

    Each round takes the points of the last crop as its marks, until one adds no more surface than a part that would be
    left out has. Growth ends at the ground, at gaps and at points that are something else. Where the object is
    connected with something much larger, the box around the clicks remains, and a note says so.

    Args:
        scene: the dense cloud, z up.
        inside: (F, 3) clicks on the object.
        settings: of the crop.
        other: (N,) points of the scene that are something else.
    """
    first = cut = crop_cloud(scene, inside, UP, settings, other)
    extent = float(np.linalg.norm(np.ptp(inside, axis=0)))
    while True:
        own = without_strays(scene.points[cut.keep], STRAY_SHARE / 2)  # in each round again
        if not len(own):
            return cut
        if np.linalg.norm(np.ptp(own, axis=0)) > MAX_GROWTH * extent:
            break
        marks = np.concatenate([inside, own])
        grown = crop_cloud(scene, marks, UP, settings, other)
        before, after = (occupied_voxels(scene.points[one.keep], LINK_FRACTION * extent) for one in (cut, grown))
        if after <= (1 + MIN_PART_SHARE) * before:
            return grown
        cut = grown
    note = (
        f"what the clicks lie on reaches more than {MAX_GROWTH:g} times as far as they do: only the box around them"
        " was cut out; click on the object's ends, and outside, on what it touches"
    )
    return replace(first, notes=[note, *first.notes])


@dataclass(frozen=True)
class Masked:
    """An object's photos with their masks.

    Attributes:
        views: with `pixels` True on the mask, grown by MASK_REACH_PX for what they and the similarity err by.
        own: (K, 3) points on the object, in its frame.
        notes: on points that are not from SfM.
    """

    views: list[View]
    own: Array
    notes: tuple[str, ...] = ()

    def sight(self, scene_from_object: Sim3) -> Array:
        """(K + V, 3) the own points and the cameras in the scene, those too far away moved nearer."""
        own = scene_from_object.apply(self.own)
        eyes = scene_from_object.apply(np.array([view.centre for view in self.views]))
        far = MAX_DISTANCE_EXTENTS * float(np.linalg.norm(np.ptp(own, axis=0)))
        return np.concatenate([own, np.clip(eyes, own.min(0) - far, own.max(0) + far)])


def vote(
    points: Array, masked: Masked, scene_from_object: Sim3, min_share: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Project every point of a scene into an object's masks: (N,) which are the object's, and which something else's;
    points that too few photos show are neither.

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
    is_object[rows] = within(in_object[rows], own, reach)
    return is_object, decided & (inside < 0.5 * shown)


def read_masked_views(workspace: Path, masks: Path, min_share: float) -> Masked:
    """At most MAX_PHOTOS of an object's photos, spread evenly, with their masks, and the SfM points on the object.

    A point is on the object when it is inside the mask in `min_share` of the photos that observe it, three or more;
    strays are left out. Where too few SfM points are, those by coarse stereo count too.

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of {name}.png, non-zero on the object.
        min_share: see `vote`.

    Raises:
        StageError: too few photos have a mask, a mask is not of its photo's size, or too few points lie inside.
    """
    read = read_workspace(workspace)
    files = [(path, one) for one in read.views if (path := masks / f"{Path(one.name).stem}.png").is_file()]
    if len(files) < CONFIRMING_PHOTOS:
        raise StageError(
            f"{len(files)} photos of {workspace} have a mask in {masks}, three are needed; rerun the masks"
        )
    chosen = np.unique(np.linspace(0, len(files) - 1, min(MAX_PHOTOS, len(files))).round().astype(int))
    found = {files[k][1].name: _with_grown_mask(files[k][1], files[k][0]) for k in chosen}
    own, notes = _own_points(read, found, min_share), tuple[str, ...]()
    if len(own) < MIN_SHARED_POINTS:
        # Needs PyTorch, which `scenefuse register` does without.
        from scenefuse.mvs.stereo_points import FEW_POINTS, with_stereo_points

        photos = replace(read, views=[read.rgb(view) for view in read.views])
        own, notes = _own_points(with_stereo_points(photos), found, min_share), (FEW_POINTS,)
    if len(own) < MIN_SHARED_POINTS:
        raise StageError(
            f"only {len(own)} points of {workspace} lie inside the masks of {masks}, by features and by stereo,"
            f" {MIN_SHARED_POINTS} are needed; look at the masks, and take sharper photos of the object"
        )
    return Masked(list(found.values()), without_strays(own), notes)


def _own_points(photos: Workspace, masked: dict[str, View], min_share: float) -> Array:
    """(K, 3) points inside the mask of `min_share` of the masked photos that observe them, three or more."""
    observing, inside = (np.zeros(len(photos.points), dtype=np.int32) for _ in range(2))
    for view, seen in zip(photos.views, photos.seen):
        if (one := masked.get(view.name)) is not None:
            observed = np.unique(seen)
            rows, pixels, _ = one.visible(photos.points[observed])
            observing[observed[rows]] += 1
            inside[observed[rows]] += one.pixels[pixels[:, 1], pixels[:, 0]]
    return photos.points[(observing >= CONFIRMING_PHOTOS) & (inside >= min_share * observing)]


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
