"""Depths moved to where the photos match best: a map has about the right depth, and matching makes it exact."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scenefuse.mvs.matcher import Matcher
from scenefuse.mvs.plane_sweep import refine_by_matching
from scenefuse.mvs.views import Views
from scenefuse.transforms import Array
from scenefuse.workspace import View

SOURCES, BEST_SOURCES = 8, 3
"""Photos that a photo is matched with, and of these the ones that count: others may not see the place."""
BEST_ANGLE_DEG = 15.0
"""Between two photos: enough baseline to measure, little enough to look alike."""


@dataclass(frozen=True)
class RefinedDepths:
    """Depths after matching.

    Attributes:
        depths: (V, H, W) along z, 0 for none.
        moved: (V, H, W), True for depths that moved.
        inconsistent: (V, H, W), True for depths that are not photo-consistent.
    """

    depths: NDArray[np.float32]
    moved: NDArray[np.bool_]
    inconsistent: NDArray[np.bool_]


@dataclass(frozen=True)
class RefinementSettings:
    """How depths are moved to where photos match."""

    match_reach_px: float = 8
    """How far a depth may move to where the photos match best, in their pixels; 0 leaves depths as they are."""
    match_window_px: int = 5
    """Side of the matching window in pixels, odd."""
    match_min_score: float = 0.6
    """Smallest mean NCC of the best matches, -1..1; below it a depth is not photo-consistent where there is texture."""


def refine_by_photos(
    views: Views, poses: Array, depths: NDArray[np.float32], settings: RefinementSettings
) -> RefinedDepths:
    """Depth maps (V, H, W) with every pixel moved along its ray to the best match.

    Windows of a photo are matched with those of the eight photos that see the object from about 15 degrees aside; the
    best three count (`scenefuse.mvs.plane_sweep`). A pixel whose match is poor, hardly better than where it was, or
    farther off than the reach, keeps its depth. Where there is texture that matches neither there nor nearby in
    photos that have the place in view, the depth is not photo-consistent.

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
    photos = [_gray(views.view(index), poses[index]) for index in range(len(depths))]
    sources = _sources(poses, depths, views.intrinsics)
    for index, depth in enumerate(depths):
        rows, columns = np.nonzero(depth > 0)
        if len(rows) == 0:
            continue
        pad = 2 * window
        top, left = max(rows.min() - pad, 0), max(columns.min() - pad, 0)
        bottom, right = (min(end.max() + pad + 1, side) for end, side in zip((rows, columns), views.sizes[index]))
        part = np.s_[top:bottom, left:right]
        near = [photos[s] for s in sources[index]]
        matcher = Matcher(_cut(photos[index], top, left, bottom, right), near, BEST_SOURCES, window, device)
        found = refine_by_matching(matcher, depth[part], settings.match_reach_px, settings.match_min_score)
        result.depths[index][part], result.moved[index][part], result.inconsistent[index][part] = found
    return result


def _gray(view: View, pose: Array) -> View:
    """A view with grey pixels, (H, W) float32 in 0..1, at a pose (4, 4) world_from_cam."""
    gray = cv2.cvtColor(view.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0
    return replace(view, pixels=gray, cam_from_world=np.asarray(np.linalg.inv(pose)))


def _cut(view: View, top: int, left: int, bottom: int, right: int) -> View:
    """The part of a view from one pixel to another."""
    pixels = np.ascontiguousarray(view.pixels[top:bottom, left:right])
    intrinsics = np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]]) @ view.intrinsics
    return replace(view, pixels=pixels, intrinsics=intrinsics, width=pixels.shape[1], height=pixels.shape[0])


def _sources(poses: Array, depths: NDArray[np.float32], intrinsics: Array) -> NDArray[np.int64]:
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
