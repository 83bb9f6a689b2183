"""The depth that the network starts from: between SfM points, and by a plane sweep over the photos."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from scenefuse.geometry.matcher import NOISE_VARIANCE, Matcher
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.monodepth import depth_from_disparity, disparity_from_depth, points_in_cam, warp
from scenefuse.photos.workspace import View

# Side of the matching windows at full size: small, because the cut photos are small. A median of it leaves out single
# pixels that matched elsewhere, and masks are widened by its radius.
WINDOW_PX = 5
# Photos that a photo is matched with, and of these the ones that count: others may not see the place.
SWEEP_SOURCES, BEST_SOURCES = 4, 2
WHOLE = (slice(None), slice(None))
# Finer hypotheses tried at full size on each side of the one found at half size.
FINE_STEPS = 3
# Matching score at which sweep and SfM points count the same.
EVEN_SCORE = 0.3
# SfM points that a pixel takes its disparity from, and those that a point is held against to find outliers.
NEAREST_POINTS, POINTS_AROUND = 8, 7


@dataclass(frozen=True)
class NetworkInputs:
    """What the depth network is given of V photos.

    Attributes:
        channels: (V, 9, H, W): colour (3), mask, ray (2), disparity between SfM points, sweep disparity, sweep score.
        first: (V, 1, H, W) disparity that the network corrects.
        between_points: (V, 1, H, W) disparity interpolated between SfM points alone.
    """

    channels: Tensor
    first: Tensor
    between_points: Tensor


def network_inputs(photos: DepthPhotos, planes: int) -> NetworkInputs:
    """The network's input channels and the disparity it starts from.

    Args:
        photos: the photos.
        planes: depth hypotheses of the plane sweep; 0 leaves the sweep out.
    """
    count, _, height, width = photos.images.shape
    flat = torch.full((count, 1, height, width), 0.5, device=photos.images.device)
    ray = points_in_cam(torch.ones_like(flat), photos.intrinsics)[:, :2].view(count, 2, height, width)
    between = torch.cat([_between_points(photos, index) for index in range(count)])
    swept, score = flat, torch.zeros_like(flat)
    if planes > 0:
        pairs = [_sweep(photos, index, planes) for index in range(count)]
        swept, score = torch.cat([d for d, _ in pairs]), torch.cat([s for _, s in pairs])
    weight = (score**4) / (score**4 + EVEN_SCORE**4)
    first = between + weight * (swept - between)
    colour = (photos.images * 2.0 - 1.0) * photos.masks
    channels = torch.cat([colour, photos.masks * 2 - 1, ray, between * 2 - 1, swept * 2 - 1, score], 1)
    return NetworkInputs(channels, first, between)


def _between_points(photos: DepthPhotos, index: int) -> Tensor:
    """(1, 1, H, W) disparity: inverse-distance mean of the nearest SfM points, with outliers left out."""
    height, width = photos.images.shape[2:]
    points = photos.points[index]
    if len(points) < 3:
        middle = np.median(np.concatenate([p[:, 2] for p in photos.points]))
        points = np.array([[width / 2, height / 2, middle]], dtype=np.float32)
    disparity = disparity_from_depth(torch.from_numpy(points[:, 2]), photos.near, photos.far).numpy()
    tree = cKDTree(points[:, :2])
    around = disparity[tree.query(points[:, :2], min(POINTS_AROUND, len(points)))[1].reshape(len(points), -1)]
    off = np.abs(disparity - np.median(around, axis=1))
    keep = off <= 4.0 * np.median(off) + 0.02
    rows, columns = np.indices((height, width)).reshape(2, -1) + 0.5
    near_by = min(NEAREST_POINTS, int(keep.sum()))
    distance, neighbour = cKDTree(points[keep, :2]).query(np.column_stack([columns, rows]), near_by)
    distance, neighbour = distance.reshape(-1, near_by), neighbour.reshape(-1, near_by)
    weight = 1.0 / (distance**2 + 1.0)
    value = (disparity[keep][neighbour] * weight).sum(1) / weight.sum(1)
    return torch.from_numpy(value.astype(np.float32)).view(1, 1, height, width).to(photos.images.device)


def _sweep(photos: DepthPhotos, index: int, planes: int) -> tuple[Tensor, Tensor]:
    """(1, 1, H, W) disparity of the plane sweep and its score in 0..1; flat off the object.

    All planes at half size first; then, at full size, a few finer steps around what each pixel found there.
    """
    device = photos.images.device
    height, width = photos.images.shape[2:]
    disparity = torch.full((1, 1, height, width), 0.5, device=device)
    score = torch.zeros_like(disparity)
    rows, columns = torch.nonzero(photos.masks[index, 0], as_tuple=True)
    if len(rows) == 0:
        return disparity, score
    top, bottom = max(int(rows.min()) - WINDOW_PX, 0) // 2 * 2, min(int(rows.max()) + WINDOW_PX + 1, height)
    left, right = max(int(columns.min()) - WINDOW_PX, 0) // 2 * 2, min(int(columns.max()) + WINDOW_PX + 1, width)
    cut = (slice(top, bottom), slice(left, right))
    coarse_size = ((bottom - top + 1) // 2, (right - left + 1) // 2)
    steps = torch.linspace(0.0, 1.0, planes, device=device)[:, None, None]
    coarse, _ = _best_hypothesis(photos, index, cut, steps.expand(-1, *coarse_size), 2)
    around = functional.interpolate(coarse[None, None], size=(bottom - top, right - left), mode="bilinear")[0]
    finer = torch.arange(-FINE_STEPS, FINE_STEPS + 1, device=device)[:, None, None] / (2.0 * (planes - 1))
    fine, certain = _best_hypothesis(photos, index, cut, around + finer, 1)
    disparity[0, 0, top:bottom, left:right] = fine.clamp(0.0, 1.0)
    score[0, 0, top:bottom, left:right] = certain
    return disparity, score


def _best_hypothesis(
    photos: DepthPhotos, index: int, cut: tuple[slice, slice], hypotheses: Tensor, shrink: int
) -> tuple[Tensor, Tensor]:
    """Disparity with the best score among (D, h, w) equidistant hypotheses, to a fraction of a step, and its score."""
    chosen = photos.sources[index][:SWEEP_SOURCES]
    reference = _gray(photos, index, cut, shrink)
    sources = [_gray(photos, int(source), WHOLE, shrink) for source in chosen]
    depths = depth_from_disparity(hypotheses.clamp(0.0, 1.0), photos.near, photos.far)
    window = WINDOW_PX // shrink | 1
    # Windows this small hold little contrast, which what the matcher allows for flat ones must not outweigh.
    matcher = Matcher(reference, sources, BEST_SOURCES, window, hypotheses.device, flat=NOISE_VARIANCE / 16)
    scores = matcher.score((1.0 / depths).contiguous())
    moves = photos.source_from_target(torch.full_like(chosen, index), chosen)
    silhouettes = torch.maximum(photos.masks, photos.beyond)[chosen]
    outside = _outside_silhouettes(silhouettes, depths, moves, reference, sources)
    scores = torch.where(outside, torch.full_like(scores, -1.0), scores)
    best = scores.argmax(0)[None]
    last = len(hypotheses) - 1
    before, here, after = (scores.gather(0, (best + step).clamp(0, last))[0] for step in (-1, 0, 1))
    shift = ((after - before) / (2 * (2 * here - before - after)).clamp_min(1e-6)).clamp(-0.5, 0.5)
    found = hypotheses.gather(0, best)[0] + shift * (hypotheses[1] - hypotheses[0])
    smooth = cv2.medianBlur(found.cpu().numpy().astype(np.float32), WINDOW_PX)
    return torch.from_numpy(smooth).to(found.device), here.clamp(0.0, 1.0)


def _gray(photos: DepthPhotos, index: int, cut: tuple[slice, slice], shrink: int) -> View:
    """A cut of a photo in grey, smaller by a whole number."""
    pixels = _smaller(photos.images[index].mean(0)[cut][None, None], shrink)[0, 0]
    intrinsics = photos.intrinsics[index].double().cpu().numpy().copy()
    intrinsics[:2, 2] -= [cut[1].start or 0, cut[0].start or 0]
    intrinsics[:2] /= shrink
    pose = np.linalg.inv(photos.object_from_cam[index].double().cpu().numpy())
    height, width = pixels.shape
    return View(str(index), intrinsics, pose, width, height, pixels.cpu().numpy())


def _outside_silhouettes(masks: Tensor, depths: Tensor, moves: Tensor, reference: View, sources: list[View]) -> Tensor:
    """(D, h, w), True for the (D, h, w) depths of the reference that lie off the object in two of its sources.

    Such a depth is outside the visual hull; a single mask may be wrong. `masks` (S, 1, H, W) are one beyond the photos.
    """
    count, size = len(sources), (sources[0].height, sources[0].width)
    shrink = round(masks.shape[2] / size[0])
    silhouettes = _smaller(functional.max_pool2d(masks, WINDOW_PX, 1, WINDOW_PX // 2), shrink)
    of_reference, *of_sources = (
        torch.as_tensor(v.intrinsics, dtype=depths.dtype, device=depths.device) for v in (reference, *sources)
    )
    of_all, outside = torch.stack(of_sources), []
    for depth in depths:
        hull, seen = warp(
            silhouettes, depth.expand(count, 1, *depth.shape), moves, of_reference.expand(count, 3, 3), of_all
        )
        outside.append(((hull < 0.5) & seen).sum((0, 1)) >= min(2, count))
    return torch.stack(outside)


def _smaller(maps: Tensor, shrink: int) -> Tensor:
    """(B, C, H, W) maps averaged over squares; a rest at the border counts as one."""
    return functional.avg_pool2d(maps, shrink, ceil_mode=True, count_include_pad=False) if shrink > 1 else maps
