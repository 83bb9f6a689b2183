"""What sparse points say of depths: which photos are matched with which, and between which depths (method M3); and what
a photo shows first, since a place behind it is hidden, whatever the mask says (method K4)."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import Delaunay, QhullError

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import DEPTH_JUMP, Array
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS
from scenefuse.photos.views import Views
from scenefuse.photos.workspace import View, Workspace

# Sparse points that a photo has to have, and to share with a source: fewer do not determine depths and angles.
MIN_SHARED_POINTS = 8
# Between two rays to a point: below there is little baseline to measure with, above surfaces look different.
GOOD_ANGLES_DEG = (8, 25)
# Standard deviations with which a point's weight falls off below and above them.
FALLOFF_DEG = (4.0, 10.0)
# Longest side of a triangle between sparse points, over the photo's; farther apart they need not be one surface.
MAX_TRIANGLE_SIDE = 0.06
# Sparse points off the mask, but this near to it, may be the object's: they are left out.
MASK_REACH_PX = 2
# Share of the masks that must agree on a sparse point, of those in whose photos it is observed.
MIN_AGREEMENT = 0.8


@dataclass(frozen=True)
class Reference:
    """A photo to estimate depths of.

    Attributes:
        view: its camera.
        sources: views to match it with, the best first.
        near, far: depths to search between, in the model's unit.
    """

    view: View
    sources: list[View]
    near: float
    far: float


def select_views(workspace: Workspace, sources: int, min_angle_deg: float) -> dict[str, Reference]:
    """Sources and depth range of every photo that has any, by name, from the sparse points.

    Sources are ranked by `pair_worth`.

    Args:
        workspace: posed photos and sparse points.
        sources: at most so many for each photo.
        min_angle_deg: smallest median angle between the rays of a photo and a source.

    Raises:
        StageError: fewer than two photos or no sparse points, or no photo with a source.
    """
    if len(workspace.views) < 2 or len(workspace.points) == 0:
        raise StageError(
            f"{workspace.folder} has {len(workspace.views)} photos and {len(workspace.points)} sparse points; "
            "stereo needs two photos and points they share"
        )
    seen = [np.unique(rows) for rows in workspace.seen]
    rows, ends = np.concatenate(seen), np.cumsum([0, *map(len, seen)])
    sees = csr_array((np.ones(len(rows), np.int32), rows, ends), shape=(len(seen), len(workspace.points)))
    shares = csr_array(sees @ sees.T)
    found = {}
    for k, view in enumerate(workspace.views):
        worth = []
        row = shares[[k]]
        for j in np.sort(row.indices[(row.data >= MIN_SHARED_POINTS) & (row.indices != k)]).tolist():
            shared = np.intersect1d(seen[k], seen[j], assume_unique=True)
            value, angle_deg = pair_worth(workspace.points[shared], view.centre, workspace.views[j].centre)
            if angle_deg >= min_angle_deg:
                worth.append((-value, j))
        if worth:
            chosen = [workspace.views[j] for _, j in sorted(worth)[:sources]]
            found[view.name] = Reference(view, chosen, *_depth_range(view, workspace.points[seen[k]]))
    if not found:
        raise StageError(
            f"no photo in {workspace.folder} shares points with another at {min_angle_deg} degrees or more; "
            "check the sparse model, or lower min_angle_deg"
        )
    return found


def _depth_range(view: View, points: Array) -> tuple[float, float]:
    """Depths between which the surface is, from (N, 3) sparse points that the photo sees."""
    z = points @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3]
    z = np.sort(z[z > 0])
    # Sparse points miss tops and distant ground, and a tall thing may hold few of them: the third nearest counts.
    near = min(0.75 * np.percentile(z, 1), 0.85 * z[min(2, len(z) - 1)])
    return float(near), float(1.25 * np.percentile(z, 99))


def pair_worth(points: Array, a: Array, b: Array) -> tuple[float, float]:
    """What matching a photo at a (3,) with a source at b is worth, and the median angle between their rays to shared
    points.

    The sum over the points (N, 3) of a weight that falls off below 8 and above 25 degrees, in the manner of MVSNet's
    and COLMAP's view selection, and where the source is more than twice as far (Goesele et al. 2007): it is as coarse.
    """
    if len(points) == 0:
        return 0.0, 0.0
    u, v = points - a, points - b
    near, far = np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1)
    cosine = (u * v).sum(1) / (near * far)
    angles = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    (low, high), (below, above) = GOOD_ANGLES_DEG, FALLOFF_DEG
    width = np.where(angles < low, below, np.where(angles > high, above, 1.0))
    weight = np.exp(-0.5 * ((angles - np.clip(angles, low, high)) / width) ** 2) * np.minimum(1, 2 * near / far)
    return float(weight.sum()), float(np.median(angles))


def sparse_depths(views: Views) -> NDArray[np.float32]:
    """Depth (V, H, W) along z, object units, of what each photo shows first; infinite where that is not known, and
    beyond a photo that is smaller than its picture minus infinity: whatever lies there is hidden.

    The sparse points that a photo observes span triangles in it, those on its mask and those off it by themselves, over
    which inverse depth is linear. A point of the object that a photo has off its mask, and does not observe, is hidden
    by something just before it.
    """
    own = own_points(views)
    return np.stack([_depths_of(views, index, own) for index in range(len(views.names))])


def own_points(views: Views) -> NDArray[np.bool_]:
    """(P,) which sparse points are the object's: on the masks of three photos, and of nearly all that observe them."""
    on, seen = np.zeros(len(views.sparse), np.int64), np.zeros(len(views.sparse), np.int64)
    for index in range(len(views.names)):
        rows, on_mask, _ = beside_mask(views, index, views.tracks[index])[:3]
        seen[rows] += 1
        on[rows[on_mask]] += 1
    return (on >= CONFIRMING_PHOTOS) & (on >= MIN_AGREEMENT * seen)


def beside_mask(
    views: Views, index: int, rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_], Array, Array]:
    """Of sparse points, the rows of those in a photo's frame, which are on its mask, which clearly off it, their pixels
    (N, 2) and depths along z."""
    view = views.view(index)
    mask = views.masks[index, : view.height, : view.width]
    shown, pixels, depth = view.visible(views.sparse[rows])
    size, at = 2 * MASK_REACH_PX + 1, (pixels[:, 1], pixels[:, 0])
    off = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8))[at] == 0
    return rows[shown], mask[at], off, view.project(views.sparse[rows[shown]])[0], depth


def _depths_of(views: Views, index: int, own: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The map (H, W) of one photo."""
    view = views.view(index)
    mask = views.masks[index, : view.height, : view.width]
    _, on, off, exact, depth = beside_mask(views, index, views.tracks[index])
    unseen = np.setdiff1d(np.flatnonzero(own), views.tracks[index])
    _, _, hidden, there, behind = beside_mask(views, index, unseen)
    of_object = _interpolated(exact[on], 1 / depth[on], mask.shape)
    beside = _interpolated(
        np.concatenate([exact[off], there[hidden]]),
        1 / np.concatenate([depth[off], (1 - DEPTH_JUMP) * behind[hidden]]),
        mask.shape,
    )
    nearness = np.where(mask, of_object, beside)
    whole = np.full(views.masks.shape[1:], -np.inf, np.float32)
    whole[: view.height, : view.width] = np.where(nearness <= 0, np.inf, 1 / np.maximum(nearness, 1e-12))
    return whole


def _interpolated(at: Array, values: Array, shape: tuple[int, ...]) -> Array:
    """Values (N,) at pixels (N, 2), linear (H, W) over the small ones of the triangles between them; 0 elsewhere."""
    drawn = np.zeros(shape, np.int32)
    try:
        corners = Delaunay(at).simplices
    except (QhullError, ValueError):  # fewer than three points, or all on a line
        return np.zeros(shape)
    sides = np.linalg.norm(at[corners] - at[np.roll(corners, 1, axis=1)], axis=2)
    corners = corners[sides.max(1) <= MAX_TRIANGLE_SIDE * max(shape)]
    for label, triangle in enumerate(np.floor(at[corners]).astype(np.int32), start=1):
        cv2.fillConvexPoly(drawn, triangle, label)
    # Of each triangle the plane (a, b, c): value = a x + b y + c. Slivers have none.
    upright = np.concatenate([at[corners], np.ones((len(corners), 3, 1))], axis=2)
    whole = np.abs(np.linalg.det(upright)) > 1e-6
    planes = np.zeros((len(corners) + 1, 3))
    planes[1:][whole] = np.linalg.solve(upright[whole], values[corners[whole]][..., None])[..., 0]
    rows, columns = np.nonzero(drawn)
    plane = planes[drawn[rows, columns]]
    found = np.zeros(shape)
    found[rows, columns] = plane[:, 0] * (columns + 0.5) + plane[:, 1] * (rows + 0.5) + plane[:, 2]
    return found
