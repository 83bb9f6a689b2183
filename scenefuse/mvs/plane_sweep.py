"""Multi-view stereo in PyTorch: a plane sweep with semi-global smoothing, then slanted refinement at full size.

The CPU and GPU counterpart of COLMAP's patch-match stereo. Every hypothesis is an inverse depth per pixel, so that one
warp serves the fronto-parallel sweep and the refinement around a surface that is already known, where the matching
window follows the slant of that surface. Sources: Collins 1996 (plane sweep); Hirschmueller 2008 (semi-global
matching).
"""

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numba import njit, prange
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from scenefuse.core.stage import setting
from scenefuse.core.transforms import Array
from scenefuse.geometry.matcher import NOISE_VARIANCE, Matcher, support_weights, supported_mean
from scenefuse.photos.workspace import View

# Side of the windows that planes are fitted in, for depths and for normals: windows of 5 let the depths of single
# pixels, off by half a step, turn normals by 12 degrees; larger ones lose small things.
PLANE_PX, NORMAL_PX = 9, 11
# The same where depths are already nearly right: smaller, since objects are curved.
KNOWN_PLANE_PX = 7
# Less than this, in NCC, is no better match: smooth surfaces match nearly everywhere. A match must be better than those
# beside it by this and by so much more for noise as strong as the texture: in that ratio noise changes NCC.
MIN_GAIN, MIN_GAIN_PER_NOISE = 0.02, 0.25
# Windows whose grey values deviate by this much (two of 255 levels) have a texture that must match somewhere.
MIN_TEXTURE = 2 / 255
# A match must be worse this far beside it, in pixels of the middle one of the source photos: a high correlation alone
# says little, as a shaded wall matches at all depths.
PEAK_DISTANCE_PX = 1.5
# Largest share of blank pixels among those around that look alike, in windows of NORMAL_PX, twice over: the glow beside
# an edge lies at the rim of a blank sky.
MAX_BLANK_SHARE = 0.25


@dataclass(frozen=True)
class DepthMapSettings:
    """How a scene's depth maps are made."""

    backend: Literal["auto", "colmap", "torch"] = setting("auto")
    """`colmap` needs CUDA; `torch` is our plane sweep; `auto` takes the first that can run."""
    max_image_size_px: int = setting(800, unit="px", above=0)
    """Longer side of the photo that stereo works on; the depth map has this size."""
    sources: int = setting(8, least=1)
    """Source photos per reference photo."""
    min_score: float = 0.5
    """Smallest mean NCC of the best sources that a pixel needs to keep its depth (torch only)."""
    min_angle_deg: float = setting(2, unit="deg", least=0)
    """Smallest median angle between the rays of a reference and a source photo."""
    best_sources: int = 3
    """The best so many sources of a hypothesis count; the others are taken as occluded (torch only)."""
    planes: int = 96
    """At most so many inverse-depth hypotheses in the sweep, unless more than two pixels apart (torch only)."""
    window_px: int = 7
    """Side of the matching window in pixels, odd."""
    smoothness: float = 0.1
    """Semi-global cost of a step to the next plane, in units of 1 - NCC; a larger jump costs four times that (torch
    only)."""
    geometric: bool = True
    """Second, geometrically consistent pass of COLMAP's patch-match (colmap only)."""


@dataclass(frozen=True)
class DepthEstimate:
    """Depths of one photo by stereo.

    Attributes:
        depth: (H, W) float32 along z, in world units; 0 where there is none.
        normals: (H, W, 3) float32 unit normals in the camera frame, towards the camera; zeros where there is no depth.
        score: (H, W) float32, mean NCC of the best sources, -1..1.
        best: (H, W) float32, the depth that matches best, where it is no measurement too.
    """

    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    score: NDArray[np.float32]
    best: NDArray[np.float32]


def estimate_depth(
    reference: View, sources: list[View], near: float, far: float, settings: DepthMapSettings, device: str
) -> DepthEstimate:
    """Depth, normals and matching score of one photo.

    Args:
        reference: the photo to estimate, at the size of the result; pixels (H, W) float32 grey in 0..1.
        sources: photos that overlap it, at their own size and about the same scale, likewise.
        near: smallest depth to try.
        far: largest depth to try.
        settings: see DepthMapSettings.
        device: a PyTorch device, "cpu" or "cuda".
    """
    inverse = torch.zeros(0)
    for level, reduction in enumerate((2, 1)):  # the sweep runs at half size
        sizes = [(round(v.width / reduction), round(v.height / reduction)) for v in (reference, *sources)]
        first, *others = (v.resized(*size) for v, size in zip((reference, *sources), sizes))
        matcher = Matcher(first, others, settings.best_sources, settings.window_px, device)
        if level == 0:
            inverse, step = _sweep(matcher, 1 / far, 1 / near, settings)
        else:
            size = first.height, first.width
            inverse = F.interpolate(inverse[None, None], size, mode="bilinear", align_corners=False)[0, 0]
            step /= 2
        inverse, score = _refine(matcher, inverse, step, 1 / far, 1 / near)
    inverse, _ = _local_planes(inverse, score, PLANE_PX)
    inverse, score = _refine_once(matcher, inverse[None], step / 2)
    _, slopes = _local_planes(inverse, score, NORMAL_PX)
    normals = _normals(inverse, slopes, reference.intrinsics)
    pixel = (1 / near - 1 / far) / max(float(np.median(matcher.shifts(1 / far, 1 / near))), 1e-6)
    good = is_measured(matcher, inverse, score, settings.min_score, pixel) & (inverse > 0.5 / far)
    best = 1 / inverse.clamp(min=1e-12)
    maps = torch.where(good, best, torch.zeros_like(best)), normals * good[..., None], score, best
    return DepthEstimate(*(values.cpu().numpy() for values in maps))


def refine_by_matching(
    matcher: Matcher, depth: NDArray[np.float32], reach_px: float, min_score: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """A depth map that is nearly right, moved to where the photos match best.

    Returns the depths (H, W), which of them moved, and which are not photo-consistent: the window has texture, and it
    matches neither there nor nearby.

    Args:
        matcher: of the map's photo, at its size, with photos that overlap it.
        depth: (H, W) along z, 0 for none.
        reach_px: how far a pixel may move in the source photos, pixels.
        min_score: smallest mean NCC of a match, -1..1.
    """
    device = matcher.reference.device
    known = depth > 0
    rows, columns = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    first = torch.from_numpy(1 / depth[rows, columns]).to(device)
    low, high = float(first.min()), float(first.max()) * 1.001
    step = reach_px * (high - low) / max(*matcher.shifts(low, high), 1e-6)
    inverse, _ = _refine_once(matcher, first[None], step / 2)
    inverse, score = _refine(matcher, _median3(inverse), step / 4, low, high)
    inverse, _ = _local_planes(inverse, score, KNOWN_PLANE_PX)
    inverse, score = _refine_once(matcher, inverse[None], step / 8)
    before = matcher.score(first[None])[0]
    moved = (score >= min_score) & (score - before >= MIN_GAIN) & ((inverse - first).abs() <= step)
    moved &= torch.from_numpy(known).to(device)
    testable = (matcher.variance >= MIN_TEXTURE**2) & (matcher.seen_by(first) >= matcher.best)
    inconsistent = ~moved & (before < min_score) & testable
    refined = torch.where(moved, 1 / inverse.clamp(min=1e-12), torch.from_numpy(depth).to(device))
    return refined.cpu().numpy(), moved.cpu().numpy(), inconsistent.cpu().numpy() & known


def _sweep(matcher: Matcher, low: float, high: float, settings: DepthMapSettings) -> tuple[Tensor, float]:
    """Inverse depth per pixel, (h, w), by a fronto-parallel sweep with semi-global smoothing, and the plane step."""
    shift = max(matcher.shifts(low, high))
    # Between planes more than two pixels apart no window matches; but a wrong range may be as long as it likes.
    count = int(np.clip(math.ceil(shift / 0.75), 16, max(settings.planes, min(shift / 2, 4 * settings.planes))))
    planes = torch.linspace(low, high, count, device=matcher.reference.device)
    height, width = matcher.reference.shape
    cost = torch.empty(height, width, count)
    for start in range(0, count, 16):
        chunk = planes[start : start + 16, None, None].expand(-1, height, width)
        cost[..., start : start + 16] = 1 - matcher.score(chunk).permute(1, 2, 0)
    total = torch.zeros_like(cost)
    small = np.float32(settings.smoothness)
    _semi_global(cost.numpy(), small, 4 * small, total.numpy())
    total = total.to(planes.device)
    chosen = total.argmin(-1)
    inner = chosen.clamp(1, count - 2)
    before, middle, after = (total.gather(-1, (inner + k)[..., None])[..., 0] for k in (-1, 0, 1))
    step = (high - low) / (count - 1)
    inverse = planes[chosen] + step * _parabola(before, middle, after) * (inner == chosen)
    return inverse, step


@njit(cache=True, parallel=True)
def _semi_global(cost, small, large, total):  # type: ignore[no-untyped-def]
    """Add to total (h, w, D) the path costs along four directions, for a matching cost (h, w, D) float32."""
    height, width, count = cost.shape
    for axis in range(2):
        lines, length = (height, width) if axis == 0 else (width, height)
        for line in prange(lines):
            for way in range(2):
                previous = np.full(count + 2, np.inf, np.float32)
                current, floor = np.empty(count, np.float32), np.float32(0)
                previous[1:-1] = 0
                for step in range(length):
                    at = step if way == 0 else length - 1 - step
                    y, x = (np.int64(line), at) if axis == 0 else (at, np.int64(line))
                    own, out = cost[y, x], total[y, x]
                    for d in range(count):
                        beside = min(previous[d], previous[d + 2]) + small
                        current[d] = own[d] + min(min(previous[d + 1], beside), floor + large) - floor
                        out[d] += current[d]
                    floor = np.float32(np.inf)
                    for d in range(count):
                        previous[d + 1] = current[d]
                        floor = min(floor, current[d])


def _refine(matcher: Matcher, inverse: Tensor, step: float, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Inverse depth (h, w) and score after trying the neighbours' depths, then a finer step around the winner."""
    lowest, highest = -F.max_pool2d(-inverse[None], 5, 1, 2)[0], F.max_pool2d(inverse[None], 5, 1, 2)[0]
    inverse, _ = _refine_once(matcher, torch.stack([inverse, lowest, highest]), step)
    inverse = _median3(inverse.clamp(0.8 * low, 1.2 * high))
    return _refine_once(matcher, inverse[None], step / 2)


def _refine_once(matcher: Matcher, bases: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """The best of B base surfaces (B, h, w), each shifted by up to a step to a fraction of it; and its score."""
    best_score = torch.full_like(bases[0], -1.0)
    best = bases[0]
    for base in bases:
        before, middle, after = matcher.score(torch.stack([base - step, base, base + step]))
        offset = _parabola(-before, -middle, -after)
        score = torch.maximum(torch.maximum(before, middle), after)
        better = score > best_score
        best = torch.where(better, base + step * offset, best)
        best_score = torch.where(better, score, best_score)
    return best, best_score


def _parabola(before: Tensor, middle: Tensor, after: Tensor) -> Tensor:
    """Where a parabola through three costs at -1, 0, 1 is least; the better end where it opens downwards."""
    curvature = before - 2 * middle + after
    offset = 0.5 * (before - after) / curvature.clamp(min=1e-6)
    ends = torch.where(before < after, -1.0, 1.0)
    inside = (middle <= before) & (middle <= after) & (curvature > 1e-6)
    return torch.where(inside, offset.clamp(-1, 1), torch.where((before < middle) | (after < middle), ends, 0.0))


def _local_planes(inverse: Tensor, score: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Smoothed inverse depth (h, w) and its slopes per pixel (2, h, w), from plane fits that keep edges.

    A plane's inverse depth is linear in the pixel, so a weighted linear fit in a window is a plane fit.
    Each pixel takes the fit, out of nine windows that contain it, whose residual is smallest (Kuwahara 1976): no fit
    crosses a depth edge.
    """
    fits, found = np.empty((4, *inverse.shape)), np.empty((3, *inverse.shape), np.float32)
    _fit_planes(inverse.cpu().numpy(), (score.clamp(min=0.02) ** 2).cpu().numpy(), window, fits)
    _take_planes(fits, window // 2, found)
    smooth, *slopes = torch.from_numpy(found).to(inverse.device)
    return smooth, torch.stack(slopes)


@njit(cache=True, parallel=True, error_model="numpy")
def _fit_planes(inverse, weight, window, fits):  # type: ignore[no-untyped-def]
    """Slopes, value at the middle and mean squared residual, fits (4, h, w), of a plane in the window of each pixel.

    inverse, weight: (h, w) float32.
    """
    height, width = inverse.shape
    radius = window // 2
    for line in prange(height):
        y = np.int64(line)
        # Sums over the rows: of w, w v, w v v, w q, w q v, w q q, where v counts from the middle.
        rows = np.zeros((6, width + 2 * radius))
        for v in range(max(-radius, -y), min(radius, height - 1 - y) + 1):
            for x in range(width):
                w, q = np.float64(weight[y + v, x]), np.float64(inverse[y + v, x])
                rows[0, x + radius] += w
                rows[1, x + radius] += w * v
                rows[2, x + radius] += w * v * v
                rows[3, x + radius] += w * q
                rows[4, x + radius] += w * q * v
                rows[5, x + radius] += w * q * q
        # And over all: of w, w u, w v, w u u, w u v, w v v, w q, w q u, w q v, w q q.
        sums = np.zeros((10, width))
        for k, (row, power) in enumerate(zip((0, 0, 1, 0, 1, 2, 3, 3, 4, 5), (0, 1, 0, 2, 1, 0, 0, 1, 0, 0))):
            for u in range(-radius, radius + 1):
                share = np.float64(u) ** power
                for x in range(width):
                    sums[k, x] += share * rows[row, x + u + radius]
        for x in range(width):
            w = sums[0, x]
            mu, mv, mq = sums[1, x] / w, sums[2, x] / w, sums[6, x] / w
            uu, uv, vv = sums[3, x] / w - mu * mu, sums[4, x] / w - mu * mv, sums[5, x] / w - mv * mv
            uq, vq, qq = sums[7, x] / w - mu * mq, sums[8, x] / w - mv * mq, sums[9, x] / w - mq * mq
            determinant = max(uu * vv - uv * uv, 1e-6)
            a, b = (uq * vv - vq * uv) / determinant, (vq * uu - uq * uv) / determinant
            fits[0, y, x], fits[1, y, x], fits[2, y, x] = a, b, mq - a * mu - b * mv
            fits[3, y, x] = max(qq - a * uq - b * vq, 0.0)


@njit(cache=True, parallel=True)
def _take_planes(fits, radius, found):  # type: ignore[no-untyped-def]
    """Value and slopes, found (3, h, w), of the plane with the least residual, of nine windows around each pixel."""
    height, width = fits.shape[1:]
    for line in prange(height):
        y = np.int64(line)
        for x in range(width):
            row, column, least = y, x, 0.8 * fits[3, y, x]  # the centred window wins ties
            for v in range(-radius, radius + 1, radius):
                for u in range(-radius, radius + 1, radius):
                    j, i = min(max(y + v, 0), height - 1), min(max(x + u, 0), width - 1)
                    if fits[3, j, i] < least:
                        row, column, least = j, i, fits[3, j, i]
            a, b = fits[0, row, column], fits[1, row, column]
            found[0, y, x] = fits[2, row, column] + a * (x - column) + b * (y - row)
            found[1, y, x], found[2, y, x] = a, b


def _normals(inverse: Tensor, slopes: Tensor, intrinsics: Array) -> Tensor:
    """Unit normals (h, w, 3) in the camera frame, towards the camera, from inverse depth and its slopes per pixel."""
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    height, width = inverse.shape
    v, u = torch.meshgrid(
        torch.arange(height, device=inverse.device) + 0.5,
        torch.arange(width, device=inverse.device) + 0.5,
        indexing="ij",
    )
    # n . X = d and X = z K^-1 x give 1/z = n . K^-1 x / d: linear in the pixel.
    n = torch.stack([slopes[0] * fx, slopes[1] * fy, inverse - slopes[0] * (u - cx) - slopes[1] * (v - cy)], dim=-1)
    return -F.normalize(n, dim=-1)


def _median3(values: Tensor) -> Tensor:
    """Median over 3x3 pixels of an (h, w) map."""
    return torch.from_numpy(cv2.medianBlur(values.cpu().numpy(), 3)).to(values.device)


def is_measured(matcher: Matcher, inverse: Tensor, score: Tensor, min_score: float, pixel: float) -> Tensor:
    """Where an inverse depth (h, w) is a measurement, (h, w) bool.

    Args:
        matcher: that found it.
        inverse: (h, w) inverse depths.
        score: (h, w) their mean NCC.
        min_score: smallest score of a match, -1..1.
        pixel: difference of inverse depth that moves a pixel by one in the middle one of the source photos.
    """
    away = PEAK_DISTANCE_PX * pixel
    beside = matcher.score(torch.stack([inverse - away, inverse + away])).amax(0)
    noise = NOISE_VARIANCE / matcher.variance.clamp(min=1e-12)
    measured = (score >= min_score) & (score - beside >= MIN_GAIN + MIN_GAIN_PER_NOISE * noise)
    return measured & ~_among_blank(matcher, measured)


def _among_blank(matcher: Matcher, measured: Tensor) -> Tensor:
    """True (h, w) where of the pixels around that look alike too many have neither texture nor a measurement."""
    weights = support_weights(matcher.reference, NORMAL_PX)
    known, blank = measured.float(), (~measured & (matcher.variance < NOISE_VARIANCE)).float()
    for _ in range(2):
        known, blank = (supported_mean(values, weights) for values in (known, blank))
    return blank > MAX_BLANK_SHARE * (known + blank)
