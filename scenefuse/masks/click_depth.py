"""The depth of a click: where along its ray the other photos show the same, so that one click prompts them all."""

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.pixels import held
from scenefuse.photos.workspace import View, Workspace

PATCH = 0.01
"""Half width of the patch that is looked for, as a share of the photo's longer side: six pixels at 640."""
NEAREST_DEG, FARTHEST_DEG, MOST_PHOTOS = 5.0, 45.0, 6
"""Photos that are compared: so far apart as the point sees them, the nearest of these."""
STEPS, FINE_STEPS = 160, 20
"""Inverse depths that are tried, over the range of the sparse points' that the photo sees, and again between two."""
RANGE_PERCENT, NEARER = (1, 95), 0.7
"""Which of their depths bound the range; the object may be so much nearer."""
LEAST_NCC, LEAST_PHOTOS = 0.7, 3
"""Correlation with the patch, mean of the best so many photos, from which a depth counts."""
PEAK_STEPS, CLEARLY = 8, 0.1
"""No depth farther than so many steps from the best may match nearly as well."""
LEAST_SHARE = 0.25
"""Of the patch that lies in the photo's mask: the rest shows what is behind a thin part, at its depth."""


def with_depth(
    photos: Workspace, clicked: Mapping[int, PhotoClicks], masks: Mapping[int, Mask]
) -> dict[int, PhotoClicks]:
    """The clicks with the points (N, 3) in the object's frame that they are on, NaN where none is found (method K1).

    Args:
        photos: views with RGB pixels, sparse points and who observes them.
        clicked: clicks by row of the photo.
        masks: (H, W) of the clicked photos by their own clicks, where these are enough for one: of the patch around a
            click inside, what lies in it is looked for.
    """
    grey = [cv2.cvtColor(view.pixels, cv2.COLOR_RGB2GRAY) for view in photos.views]
    found = {}
    for k, clicks in clicked.items():
        mask = masks.get(k)
        points = [
            _point_at(photos, grey, k, pixel, mask if inside else None)
            for pixel, inside in zip(clicks.pixels, clicks.inside)
        ]
        known = [np.full(3, np.nan) if point is None else point for point in points]
        found[k] = replace(clicks, points=np.array(known).reshape(-1, 3))
    print(f"{sum(len(c.placed) for c in found.values())} clicks on the object have a depth", flush=True)
    return found


def _point_at(
    photos: Workspace, grey: list[NDArray[np.uint8]], k: int, pixel: Array, mask: Mask | None
) -> Array | None:
    """The point (3,) on the ray of a pixel (2,) that other photos show alike; None where too few do, or too little of
    its patch lies in a mask."""
    view = photos.views[k]
    depths = view.project(photos.points[photos.seen[k]])[1]
    if not len(depths):
        return None
    near, far = np.percentile(depths, RANGE_PERCENT)
    half = max(3, round(PATCH * max(view.width, view.height)))
    offsets = np.arange(-half, half + 1)
    grid = pixel + np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
    if (grid < 0).any() or (grid > [view.width - 1, view.height - 1]).any():
        return None
    if mask is not None:
        whole, grid = len(grid), grid[held(mask, grid, 0)]
        if len(grid) < LEAST_SHARE * whole:
            return None
    grid = np.concatenate([pixel[None], grid])
    rays = np.column_stack([grid, np.ones(len(grid))]) @ np.linalg.inv(view.intrinsics).T
    rays = rays @ view.cam_from_world[:3, :3]
    ray, rays, grid = rays[0], rays[1:], grid[1:]
    patch, others = _sampled(grey[k], grid), _beside(photos.views, k, view.centre + ray * near)
    tried = np.linspace(1 / far, 1 / (NEARER * near), STEPS)
    for fine in (False, True):
        scores = [_alike(photos.views, grey, others, view.centre + rays / inverse, patch) for inverse in tried]
        best, step = tried[int(np.argmax(scores))], tried[1] - tried[0]
        if not fine:
            elsewhere = np.array(scores)[np.abs(np.arange(STEPS) - np.argmax(scores)) > PEAK_STEPS]
            if elsewhere.max() > max(scores) - CLEARLY:
                return None
            tried = np.linspace(best - step, best + step, FINE_STEPS)
    return view.centre + ray / best if max(scores) >= LEAST_NCC else None


def _beside(views: list[View], k: int, point: Array) -> list[int]:
    """The photos nearest to one, as a point sees them, but for those from almost the same place."""
    towards = np.array([view.centre for view in views]) - point
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(np.clip(towards @ towards[k], -1, 1)))
    rows = np.flatnonzero((angles >= NEAREST_DEG) & (angles <= FARTHEST_DEG))
    return [int(row) for row in rows[np.argsort(angles[rows], kind="stable")][:MOST_PHOTOS]]


def _alike(views: list[View], grey: list[NDArray[np.uint8]], others: list[int], points: Array, patch: Array) -> float:
    """How like a patch the photos show its points (N, 3): the mean of the best three correlations."""
    found = []
    for row in others:
        pixels, depth = views[row].project(points)
        size = [views[row].width - 1, views[row].height - 1]
        if (depth > 0).all() and (pixels >= 0).all() and (pixels <= size).all():
            found.append(float(np.mean(_sampled(grey[row], pixels) * patch)))
    return float(np.mean(sorted(found)[-LEAST_PHOTOS:])) if len(found) >= LEAST_PHOTOS else -1.0


def _sampled(grey: NDArray[np.uint8], pixels: Array) -> Array:
    """(N,) grey values at pixels (N, 2), centres at +0.5, of mean 0 and deviation 1; nearly even ones stay small."""
    x, y = (pixels - 0.5).astype(np.float32).T
    values = cv2.remap(grey, x[:, None], y[:, None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]
    values = values.astype(np.float64) - values.mean()
    return np.asarray(values / np.sqrt(np.mean(values**2) + 1.0))
