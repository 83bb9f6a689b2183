"""Depth maps tested against each other: what other views confirm and what they see through; normals from depth.

Source: Merrell et al. 2007 (a depth map's free-space violations in others count against it).
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from scenefuse.core.transforms import Array
from scenefuse.geometry.depth_test import MAX_PHOTOS
from scenefuse.photos.workspace import View


@dataclass(frozen=True)
class DepthAgreement:
    """How the depths of other views agree with N points of one view.

    Attributes:
        agree: (N,) views whose depth at the point is the point's own, within the tolerance.
        through: (N,) views that see past the point: it floats in front of their surface.
        off_mask: (N,) views in whose picture the point lies off the mask, with nothing before it.
        mean: (N, 3) mean of the point and the points that agree with it; finer ones count more.
        compared: number of other views.
    """

    agree: NDArray[np.int32]
    through: NDArray[np.int32]
    off_mask: NDArray[np.int32]
    mean: Array
    compared: int


def others(view: int, frame_from_cam: Array) -> NDArray[np.int64]:
    """Indices of the views that `view` is compared with: all others, of many the near ones and ever fewer farther off.

    Near views see the same surface, far ones see it from another side and have it in their outline. With MAX_PHOTOS at
    most, what more photos cost grows with them, not with their square.

    Args:
        view: index of a view.
        frame_from_cam: (V, 4, 4).
    """
    centres = frame_from_cam[:, :3, 3]
    order = np.argsort(np.linalg.norm(centres - centres[view], axis=1), kind="stable")
    order = order[order != view]
    if len(order) <= MAX_PHOTOS:
        return np.sort(order)
    step = np.arange(MAX_PHOTOS)
    spare = len(order) - MAX_PHOTOS
    return np.sort(order[step + np.floor(spare * (step / (MAX_PHOTOS - 1)) ** 2).astype(np.int64)])


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
    compared = others(view, frame_from_cam)
    counts, points = np.zeros((3, len(points)), np.int32), points.astype(np.float64)
    # Errors of depth are as large as pixels.
    away = (points - frame_from_cam[view, :3, 3]) @ frame_from_cam[view, :3, 2]
    weight = (intrinsics[view, 0, 0] / away) ** 2
    total = np.column_stack([points * weight[:, None], weight])
    known = np.zeros((0, 0, 0), np.float32) if covered is None else covered
    # The kernel is compiled again for each layout of arrays.
    cameras = intrinsics.astype(np.float64), frame_from_cam.astype(np.float64, order="C")
    _compare(points, compared, depths, masks, known, *cameras, tolerance, counts, total)
    agree, through, off_mask = counts
    return DepthAgreement(agree, through, off_mask, total[:, :3] / total[:, 3:], len(compared))


@njit(parallel=True, cache=True, error_model="numpy")
def _compare(points, compared, depths, masks, covered, intrinsics, frame_from_cam, tolerance, counts, total):  # type: ignore[no-untyped-def]
    """Add to counts (3, N) of `DepthAgreement`, and to total (N, 4) the points that agree by their weight, and this.

    A thread takes neighbouring points through one map after the other: what they look up stays in its cache.
    """
    height, width = depths.shape[1:]
    together = 4096  # points
    for block in prange((len(points) + together - 1) // together):
        for other in compared:
            pose, k = frame_from_cam[other], intrinsics[other]
            for n in range(block * together, min((block + 1) * together, len(points))):
                dx, dy, dz = points[n, 0] - pose[0, 3], points[n, 1] - pose[1, 3], points[n, 2] - pose[2, 3]
                z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
                if not z > 0:
                    continue
                x = dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]
                y = dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]
                u, v = x / z * k[0, 0] + k[0, 2], y / z * k[1, 1] + k[1, 2]
                if not (u >= 0 and u < width and v >= 0 and v < height):
                    continue
                row, column = int(v), int(u)
                if not masks[other, row, column] and (len(covered) == 0 or z < covered[other, row, column]):
                    counts[2, n] += 1
                measured = depths[other, row, column]
                if not measured > 0:
                    continue
                if z < measured - tolerance:
                    counts[1, n] += 1
                elif z <= measured + tolerance:
                    counts[0, n] += 1
                    # The other view's depth, taken along the ray through the point itself, not the pixel's centre.
                    weight = (k[0, 0] / measured) ** 2
                    for axis in range(3):
                        along = x * pose[axis, 0] + y * pose[axis, 1] + z * pose[axis, 2]
                        total[n, axis] += weight * (along * measured / z + pose[axis, 3])
                    total[n, 3] += weight


@dataclass(frozen=True)
class DepthMap:
    """What stereo says of one photo, at its maps' size.

    Attributes:
        view: its camera; `pixels` are depths along z, (H, W) float32, 0 for none.
        normals: (H, W, 3) float32 unit normals in the world.
        colors: (H, W, 3) uint8.
    """

    view: View
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]


@dataclass(frozen=True)
class Votes:
    """How other depth maps agree with one, per pixel (H, W).

    Attributes:
        agree: number of maps that hold the same surface there.
        through: number of maps that measured a surface behind it: it floats in front of theirs.
        mean: (H, W, 7) mean depth, normal and colour of it and of those that agree; finer ones count more.
    """

    agree: NDArray[np.uint16]
    through: NDArray[np.uint16]
    mean: NDArray[np.float32]


def neighbours(sources: Mapping[str, Iterable[str]]) -> dict[str, list[str]]:
    """Photos that vote on each photo: those it was matched with, and those that were matched with it."""
    found: dict[str, set[str]] = {name: set() for name in sources}
    for name, others in sources.items():
        for other in others:
            if other in found:
                found[name].add(other)
                found[other].add(name)
    return {name: sorted(others) for name, others in found.items()}


def vote(
    own: DepthMap,
    others: Iterable[DepthMap],
    max_depth_error: float,
    max_reprojection_px: float,
    max_normal_error_deg: float,
) -> Votes:
    """Votes of other depth maps on one.

    A point agrees with another map's when their depths and normals differ by little there, and when the other's point,
    projected back, falls near the pixel. The other map sees through it where all of its pixels around the place lie
    behind the point by more than that distance in pixels.

    Args:
        own: the map that is voted on.
        others: the maps that vote, each at its own size.
        max_depth_error: largest relative difference of two depths of a point.
        max_reprojection_px: largest distance between a pixel and the other map's point projected into it.
        max_normal_error_deg: largest angle between two normals of a point.
    """
    depth = own.view.pixels
    agree, through = np.zeros(depth.shape, np.uint16), np.zeros(depth.shape, np.uint16)
    once = np.ones((*depth.shape, 1))
    total = np.concatenate([depth[..., None], own.normals, own.colors, once], axis=2, dtype=np.float32)
    limit = max_depth_error, float(max_reprojection_px), math.cos(math.radians(max_normal_error_deg))
    for other in others:
        between = _between(own.view, other.view), _between(other.view, own.view)
        longer = other.view.intrinsics[0, 0] / own.view.intrinsics[0, 0]
        of_other = other.view.pixels, other.normals, other.colors
        _count(depth, own.normals, *of_other, *between, longer, limit, agree, through, total)
    return Votes(agree, through, total[..., :7] / total[..., 7:])


def _between(a: View, b: View) -> Array:
    """(3, 4) from a pixel of a times its depth, and one, to a pixel of b times its depth."""
    b_from_a = b.cam_from_world @ a.world_from_cam
    turned = b.intrinsics @ b_from_a[:3, :3] @ np.linalg.inv(a.intrinsics)
    return np.column_stack([turned, b.intrinsics @ b_from_a[:3, 3]])


@njit(parallel=True, cache=True, error_model="numpy")
def _count(  # type: ignore[no-untyped-def]
    depth, normals, other, other_normals, colors, there, back, longer, limits, agree, through, total
):
    """Add one map's votes to agree and through (H, W) uint16, and what it holds where it agrees, and its weight, to
    total (H, W, 8): errors of depth are as large as pixels.

    depth (H, W) and other (h, w) float32, 0 for none; normals and colors of them likewise (..., 3); there and back
    (3, 4) as `_between` makes them; longer: the other's focal length over the map's; limits: those of `vote`, of
    normals as a cosine.
    """
    (height, width), (max_error, max_px, min_cosine) = depth.shape, limits
    for row in prange(height):
        held = np.zeros(7, np.float32)
        for column in range(width):
            d = depth[row, column]
            if d <= 0:
                continue
            x, y = (column + 0.5) * d, (row + 0.5) * d
            z = there[2, 0] * x + there[2, 1] * y + there[2, 2] * d + there[2, 3]
            if z <= 0:
                continue
            u = (there[0, 0] * x + there[0, 1] * y + there[0, 2] * d + there[0, 3]) / z
            v = (there[1, 0] * x + there[1, 1] * y + there[1, 2] * d + there[1, 3]) / z
            left, top = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
            if left < 0 or top < 0 or left + 1 >= other.shape[1] or top + 1 >= other.shape[0]:
                continue
            # All of the four pixels around that agree count, the more the nearer.
            weight, behind, held[:] = 0.0, True, np.float32(0)
            for k in range(4):
                j, i = top + k // 2, left + k % 2
                e = other[j, i]
                bx, by = u * e, v * e
                bz = back[2, 0] * bx + back[2, 1] * by + back[2, 2] * e + back[2, 3]
                if e <= 0 or bz <= 0:
                    behind = False
                    continue
                off_x = (back[0, 0] * bx + back[0, 1] * by + back[0, 2] * e + back[0, 3]) / bz - (column + 0.5)
                off_y = (back[1, 0] * bx + back[1, 1] * by + back[1, 2] * e + back[1, 3]) / bz - (row + 0.5)
                near = off_x * off_x + off_y * off_y <= max_px * max_px
                behind &= (not near) and z < e
                if not (near and e - max_error * z <= z <= e + max_error * z):
                    continue
                cosine = 0.0
                for c in range(3):
                    cosine += normals[row, column, c] * other_normals[j, i, c]
                if cosine < min_cosine:
                    continue
                share = (1 - abs(u - 0.5 - i)) * (1 - abs(v - 0.5 - j)) + 1e-6
                weight += share
                held[0] += share * bz
                for c in range(3):
                    held[1 + c] += share * other_normals[j, i, c]
                    held[4 + c] += share * colors[j, i, c]
            if weight > 0:
                agree[row, column] += np.uint16(1)
                finer = (longer * d / z) ** 2
                for c in range(7):
                    total[row, column, c] += finer * held[c] / weight
                total[row, column, 7] += finer
            elif behind:
                through[row, column] += np.uint16(1)


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
