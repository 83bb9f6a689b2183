"""Depths moved to where the photos match best: a map says where the surface is, the photos say how exactly."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scenefuse.mvs.plane_sweep import DepthSettings, Photo, refine_depth
from scenefuse.mvs.views import Views
from scenefuse.stage import setting

SOURCES, BEST_SOURCES, BEST_ANGLE_DEG = 8, 3, 15.0


@dataclass(frozen=True)
class RefinedDepths:
    """Depths (V, H, W) after the photos were asked, 0 for none; which of them moved; which the photos deny."""

    depths: NDArray[np.float32]
    moved: NDArray[np.bool_]
    denied: NDArray[np.bool_]


@dataclass(frozen=True)
class RefinementSettings:
    """How depths are moved to where photos match."""

    match_reach_px: float = setting(8, unit="px", least=0)
    """how far a depth may move, in the other photos, to where they match best; 0 leaves depths as they are"""
    match_window_px: int = setting(5, unit="px", least=3)
    """side of the matching window, odd"""
    match_min_score: float = setting(0.6, least=-1, most=1)
    """least mean correlation of the best matches; below it photos deny a depth where there is texture"""


def refine_by_photos(
    views: Views, poses: NDArray[np.float64], depths: NDArray[np.float32], settings: RefinementSettings
) -> RefinedDepths:
    """Depth maps (V, H, W) with every pixel moved along its ray to the best match.

    Windows of a photo are matched with those of the eight photos that see the object from about 15 degrees aside; the
    best three count (`scenefuse.mvs.plane_sweep`). A pixel whose match is poor, hardly better than where it was, or
    farther off than the reach, keeps its depth. Where there is texture that matches neither there nor nearby in
    photos that have the place in view, the photos deny the depth.

    Args:
        views: photos and intrinsics at the maps' size.
        poses: (V, 4, 4) object_from_cam of the maps.
        depths: (V, H, W) along z, 0 for none.
        settings: reach, window and least score.
    """
    result = RefinedDepths(depths.copy(), np.zeros(depths.shape, bool), np.zeros(depths.shape, bool))
    if settings.match_reach_px == 0:
        return result
    device = "cuda" if torch.cuda.is_available() else "cpu"
    window = settings.match_window_px
    limits = DepthSettings(0, SOURCES, BEST_SOURCES, 0, 1, window, 0.0, settings.match_min_score, 0.0, False)
    photos = [_photo(views, poses, index) for index in range(len(depths))]
    sources = _sources(poses, depths, views.intrinsics)
    for index, depth in enumerate(depths):
        rows, columns = np.nonzero(depth > 0)
        if len(rows) == 0:
            continue
        pad = 2 * window
        top, left = max(rows.min() - pad, 0), max(columns.min() - pad, 0)
        part = np.s_[top : rows.max() + pad + 1, left : columns.max() + pad + 1]
        whole = photos[index]
        cut = np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]]) @ whole.intrinsics
        reference = Photo(np.ascontiguousarray(whole.gray[part]), cut, whole.cam_from_world)
        near = [photos[s] for s in sources[index]]
        found = refine_depth(reference, near, depth[part], settings.match_reach_px, limits, device)
        result.depths[index][part], result.moved[index][part], result.denied[index][part] = found
    return result


def _photo(views: Views, poses: NDArray[np.float64], index: int) -> Photo:
    gray = cv2.cvtColor(views.images[index], cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
    return Photo(gray, views.intrinsics[index], np.linalg.inv(poses[index])[:3])


def _sources(
    poses: NDArray[np.float64], depths: NDArray[np.float32], intrinsics: NDArray[np.float64]
) -> NDArray[np.int64]:
    """(V, S) the photos that look at the middle of what all see from about 15 degrees beside each photo."""
    centres, middles = poses[:, :3, 3], []
    for depth, k, pose in zip(depths, intrinsics, poses):
        rows, columns = np.nonzero(depth > 0)
        if len(rows):
            pixel = np.array([np.median(columns) + 0.5, np.median(rows) + 0.5, 1.0])
            middles.append(pose[:3, :3] @ (np.linalg.inv(k) @ pixel * np.median(depth[rows, columns])) + pose[:3, 3])
    rays = centres - np.median(middles, axis=0)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(rays @ rays.T, -1.0, 1.0)))
    score = -np.abs(angle - BEST_ANGLE_DEG)
    np.fill_diagonal(score, -np.inf)
    return np.argsort(-score, axis=1, kind="stable")[:, : min(SOURCES, len(poses) - 1)]
