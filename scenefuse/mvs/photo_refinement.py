"""Depths moved to where the photos match best: a map has about the right depth, and matching makes it exact."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scenefuse.core.transforms import DEPTH_JUMP
from scenefuse.geometry.consistency import back_project
from scenefuse.geometry.matcher import Matcher
from scenefuse.mvs.plane_sweep import DepthMapSettings, refine_by_matching
from scenefuse.mvs.sparse_depths import pair_worth
from scenefuse.photos.views import Views
from scenefuse.photos.workspace import View

# Places of a photo's depth map that other photos are chosen by.
PLACES = 200


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


def refine_by_photos(views: Views, depths: NDArray[np.float32], settings: RefinementSettings) -> RefinedDepths:
    """Depth maps (V, H, W) with every pixel moved along its ray to the best match.

    Windows of a photo are matched with those of the eight photos that are worth most (`choose_sources`); the best three
    count (`scenefuse.mvs.plane_sweep`). A pixel whose match is poor, hardly better than where it
    was, or farther off than the reach, keeps its depth. Where there is texture that matches neither there nor nearby
    in photos that have the place in view, the depth is not photo-consistent.

    Args:
        views: photos and cameras at the maps' size.
        depths: (V, H, W) along z, 0 for none.
        settings: reach, window and least score.
    """
    result = RefinedDepths(depths.copy(), np.zeros(depths.shape, bool), np.zeros(depths.shape, bool))
    if settings.match_reach_px == 0:
        return result
    device = "cuda" if torch.cuda.is_available() else "cpu"
    window = settings.match_window_px
    photos = [_gray(views.view(index)) for index in range(len(depths))]
    sources = choose_sources(views, depths)
    for index, depth in enumerate(depths):
        rows, columns = np.nonzero(depth > 0)
        if len(rows) == 0:
            continue
        pad = 2 * window
        top, left = max(rows.min() - pad, 0), max(columns.min() - pad, 0)
        bottom, right = (min(end.max() + pad + 1, side) for end, side in zip((rows, columns), views.sizes[index]))
        part = np.s_[top:bottom, left:right]
        near = [photos[s] for s in sources[index]]
        matcher = Matcher(
            _cut(photos[index], top, left, bottom, right), near, DepthMapSettings.best_sources, window, device
        )
        found = refine_by_matching(matcher, depth[part], settings.match_reach_px, settings.match_min_score)
        result.depths[index][part], result.moved[index][part], result.inconsistent[index][part] = found
    return result


def _gray(view: View) -> View:
    """A view with grey pixels, (H, W) float32 in 0..1."""
    return replace(view, pixels=cv2.cvtColor(view.pixels, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0)


def _cut(view: View, top: int, left: int, bottom: int, right: int) -> View:
    """The part of a view from one pixel to another."""
    pixels = np.ascontiguousarray(view.pixels[top:bottom, left:right])
    intrinsics = np.array([[1, 0, -left], [0, 1, -top], [0, 0, 1.0]]) @ view.intrinsics
    return replace(view, pixels=pixels, intrinsics=intrinsics, width=pixels.shape[1], height=pixels.shape[0])


def choose_sources(views: Views, depths: NDArray[np.float32]) -> NDArray[np.int64]:
    """(V, S) for each photo those that are worth most by what both show (`pair_worth`), the best first."""
    poses, places = views.object_from_cam, np.full((len(depths), PLACES, 3), np.nan)
    for index, depth in enumerate(depths):
        rows, columns = np.nonzero(depth > 0)
        if len(rows):
            chosen = np.linspace(0, len(rows) - 1, PLACES).round().astype(int)
            rows, columns = rows[chosen], columns[chosen]
            places[index] = back_project(depth[rows, columns], views.intrinsics[index], poses[index], rows, columns)
    centres, worth = poses[:, :3, 3], np.full((len(depths), len(depths)), -np.inf)
    for index, depth in enumerate(depths):
        shown, pixels, away = views.view(index).visible(places.reshape(-1, 3))
        there = depth[pixels[:, 1], pixels[:, 0]]
        shown = shown[(there == 0) | (away <= (1 + DEPTH_JUMP) * there)]
        for other in np.flatnonzero(np.arange(len(depths)) != index):
            both = places[other, shown[shown // PLACES == other] % PLACES]
            worth[other, index] = pair_worth(both, centres[other], centres[index])[0]
    return np.argsort(-worth, axis=1, kind="stable")[:, : min(DepthMapSettings.sources, len(poses) - 1)]
