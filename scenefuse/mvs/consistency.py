"""Depth maps held against each other: which pixels other views confirm, and normals from depth."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.transforms import Array

MOST_VIEWS = 64
"""Views that a view is compared with at most: what more photos cost then grows with them, not with their square."""


@dataclass(frozen=True)
class DepthAgreement:
    """How the depths of other views agree with N points of one view.

    Attributes:
        agree: (N,) views whose depth at the point is the point's own, within the tolerance.
        through: (N,) views that see past the point: it floats in front of their surface.
        hidden: (N,) views for which the point is behind their surface.
        off_mask: (N,) views in whose picture the point lies off the mask, with nothing before it.
        mean: (N, 3) mean of the point and the points that agree with it.
        compared: number of other views.
    """

    agree: NDArray[np.int32]
    through: NDArray[np.int32]
    hidden: NDArray[np.int32]
    off_mask: NDArray[np.int32]
    mean: Array
    compared: int


def others(view: int, frame_from_cam: Array) -> NDArray[np.int64]:
    """Indices of the views that `view` is compared with: all others, of many the near ones and ever fewer farther off.

    Near views see the same surface, far ones see it from another side and have it in their outline.

    Args:
        view: index of a view.
        frame_from_cam: (V, 4, 4).
    """
    centres = frame_from_cam[:, :3, 3]
    order = np.argsort(np.linalg.norm(centres - centres[view], axis=1), kind="stable")
    order = order[order != view]
    if len(order) <= MOST_VIEWS:
        return np.sort(order)
    step = np.arange(MOST_VIEWS)
    spare = len(order) - MOST_VIEWS
    return np.sort(order[step + np.floor(spare * (step / (MOST_VIEWS - 1)) ** 2).astype(np.int64)])


def back_project(
    depth: Array, intrinsics: Array, frame_from_cam: Array, rows: NDArray[Any], columns: NDArray[Any]
) -> Array:
    """Points (N, 3) of pixels (integer rows and columns) with depths (N,) along z."""
    x = (columns + 0.5 - intrinsics[0, 2]) / intrinsics[0, 0]
    y = (rows + 0.5 - intrinsics[1, 2]) / intrinsics[1, 1]
    in_camera = np.stack([x, y, np.ones_like(x)], axis=1) * depth[:, None]
    return in_camera @ frame_from_cam[:3, :3].T + frame_from_cam[:3, 3]


def surface_points(
    depth: NDArray[np.float32], intrinsics: Array, frame_from_cam: Array
) -> tuple[Array, NDArray[Any], NDArray[Any]]:
    """Points (N, 3) of all pixels of a map (H, W) that have a depth, and their rows and columns."""
    rows, columns = np.nonzero(depth > 0)
    known = depth[rows, columns].astype(np.float64)
    return back_project(known, intrinsics, frame_from_cam, rows, columns), rows, columns


def extent(points: Array) -> float:
    """Diagonal of the box of points (N, 3), half a per cent at each side left out; 0 without points."""
    if len(points) == 0:
        return 0.0
    low, high = np.percentile(points, [0.5, 99.5], axis=0)
    return float(np.linalg.norm(high - low))


def compare(
    points: Array,
    view: int,
    depths: NDArray[np.float32],
    masks: NDArray[np.bool_],
    intrinsics: Array,
    frame_from_cam: Array,
    tolerance: float,
    covered: NDArray[np.float32] | None = None,
) -> DepthAgreement:
    """Project points of one view into the others (of many, `others`) and compare depths.

    Args:
        points: (N, 3) in the cameras' common frame.
        view: index of the view they come from.
        depths: (V, H, W) along z, 0 for none.
        masks: (V, H, W), True on the object and a little around it.
        intrinsics: (V, 3, 3) in pixels.
        frame_from_cam: (V, 4, 4).
        tolerance: largest difference of depth that agrees, unit of the frame.
        covered: (V, H, W) depth along z from which on a view sees nothing off its mask, where it is known.
    """
    count = len(points)
    agree, through, hidden, off_mask = (np.zeros(count, np.int32) for _ in range(4))
    total = points.copy()
    height, width = depths.shape[1:]
    compared = others(view, frame_from_cam)
    for other in compared:
        pose, k = frame_from_cam[other], intrinsics[other]
        in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
        z = in_camera[:, 2]
        safe = np.maximum(z, 1e-9)
        x, y = in_camera[:, 0] / safe * k[0, 0] + k[0, 2], in_camera[:, 1] / safe * k[1, 1] + k[1, 2]
        index = np.flatnonzero((z > 0) & (x >= 0) & (x < width) & (y >= 0) & (y < height))
        column, row = x[index].astype(np.int64), y[index].astype(np.int64)
        beside = ~masks[other, row, column]
        off_mask[index] += beside if covered is None else beside & (z[index] < covered[other, row, column])
        measured = depths[other, row, column].astype(np.float64)
        index, column, row = (a[measured > 0] for a in (index, column, row))
        measured = measured[measured > 0]
        difference = z[index] - measured
        through[index] += difference < -tolerance
        hidden[index] += difference > tolerance
        same = np.abs(difference) <= tolerance
        agree[index] += same
        # The other view's depth, taken along the ray through the point itself, not through the pixel's centre.
        confirmed = index[same]
        total[confirmed] += (
            in_camera[confirmed] * (measured[same] / z[confirmed])[:, None] @ pose[:3, :3].T + pose[:3, 3]
        )
    return DepthAgreement(agree, through, hidden, off_mask, total / (agree + 1)[:, None], len(compared))


def normals_from_depth(
    depth: NDArray[np.float32], intrinsics: Array, radius_px: int, jump: float
) -> NDArray[np.float32]:
    """Unit normals (H, W, 3) in the camera frame, towards the camera, zero where there is no depth.

    Differences are taken over `radius_px` on the side where the depth changes less, so that edges stay sharp.

    Args:
        depth: (H, W) along z, 0 for none.
        intrinsics: (3, 3) in pixels.
        radius_px: distance of the differences.
        jump: relative change of depth beyond which two pixels are not one surface.
    """
    rows, columns = np.indices(depth.shape)
    points = back_project(
        depth.reshape(-1).astype(np.float64), intrinsics, np.eye(4), rows.reshape(-1), columns.reshape(-1)
    )
    points = points.reshape(*depth.shape, 3)
    tangents = []
    for axis in (1, 0):
        sides = []
        for sign in (1, -1):
            shifted = np.roll(points, -sign * radius_px, axis=axis)
            step = (shifted - points) * sign
            bad = (depth <= 0) | (shifted[..., 2] <= 0) | (np.abs(step[..., 2]) > jump * np.maximum(depth, 1e-9))
            edge = [slice(None), slice(None)]
            edge[axis] = slice(-radius_px, None) if sign > 0 else slice(0, radius_px)
            bad[tuple(edge)] = True
            sides.append(np.where(bad[..., None], np.nan, step))
        both = np.nansum(np.stack(sides), axis=0)
        both[np.isnan(sides[0][..., 0]) & np.isnan(sides[1][..., 0])] = np.nan
        tangents.append(both)
    normal = -np.cross(tangents[0], tangents[1])
    with np.errstate(invalid="ignore"):
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-30)
    return np.nan_to_num(normal).astype(np.float32)
