"""Multi-view stereo in PyTorch: a plane sweep with semi-global smoothing, then slanted refinement at full size.

The CPU and GPU counterpart of COLMAP's patch-match stereo. Every hypothesis is an inverse depth per pixel, so that one
warp serves the fronto-parallel sweep and the refinement around a surface that is already known, where the matching
window follows the slant of that surface. Sources: Collins 1996 (plane sweep); Hirschmueller 2008
(semi-global matching);
Goesele et al. 2006 (the best K of several views are averaged, which leaves occluded ones out).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

from scenefuse.mvs.matching_kernel import keep_best
from scenefuse.stage import setting

# Less than this is no better match: smooth surfaces match nearly everywhere.
MIN_GAIN = 0.02
# Windows whose grey values deviate by this much (three of 255 levels) have a texture that must match somewhere.
TEXTURE = 3 / 255


@dataclass(frozen=True)
class DepthSettings:
    """How depth maps are made."""

    max_image_size_px: int = setting(800, unit="px", least=0)
    """Longer side of the photo that stereo works on; the depth map has this size."""
    sources: int = setting(8, least=0)
    """Source photos per reference photo."""
    best_sources: int = setting(3, least=0)
    """The best so many sources of a hypothesis count; the others are taken as occluded (torch only)."""
    planes: int = setting(96, least=0)
    """At most so many inverse-depth hypotheses in the sweep (torch only)."""
    sweep_reduction: int = setting(2, least=0)
    """The sweep runs on photos this much smaller; the refinement doubles the size step by step (torch only)."""
    window_px: int = setting(7, unit="px", least=0)
    """Side of the matching window, odd."""
    smoothness: float = setting(0.1, least=0)
    """Semi-global cost of a step to the next plane, in units of 1 - NCC; a larger jump costs four times that."""
    min_score: float = setting(0.5, least=0)
    """Smallest mean NCC of the best sources that a pixel needs to keep its depth."""
    min_angle_deg: float = setting(2, unit="degree", least=0)
    """Smallest median angle between the rays of a reference and a source photo."""
    geometric: bool = setting(True)
    """Second, geometrically consistent pass of COLMAP's patch-match (colmap only)."""


@dataclass(frozen=True)
class Photo:
    """One photo with its camera.

    Attributes:
        gray: (H, W) float32 in 0..1.
        intrinsics: (3, 3) float64, pixel centres at +0.5.
        cam_from_world: (3, 4) float64.
    """

    gray: NDArray[np.float32]
    intrinsics: NDArray[np.float64]
    cam_from_world: NDArray[np.float64]

    def resized(self, size: tuple[int, int]) -> "Photo":
        """The same photo at (width, height), never sharper than it was."""
        height, width = self.gray.shape
        if size == (width, height):
            return self
        shrink = np.diag([size[0] / width, size[1] / height, 1.0])
        gray = np.asarray(cv2.resize(self.gray, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        return Photo(gray, shrink @ self.intrinsics, self.cam_from_world)


@dataclass(frozen=True)
class DepthEstimate:
    """What stereo knows of one photo.

    Attributes:
        depth: (H, W) float32 along z, in world units; 0 where there is none.
        normals: (H, W, 3) float32 unit normals in the camera frame, towards the camera; zeros where there is no depth.
        score: (H, W) float32, mean NCC of the best sources, -1..1.
    """

    depth: NDArray[np.float32]
    normals: NDArray[np.float32]
    score: NDArray[np.float32]


def estimate_depth(
    reference: Photo, sources: list[Photo], near: float, far: float, settings: DepthSettings, device: str
) -> DepthEstimate:
    """Depth, normals and matching score of one photo.

    Args:
        reference: the photo to estimate, at the size of the result.
        sources: photos that overlap it, at their own size and about the same scale.
        near: smallest depth to try.
        far: largest depth to try.
        settings: see DepthSettings.
        device: a PyTorch device, "cpu" or "cuda".
    """
    reductions = [2**k for k in range(round(math.log2(settings.sweep_reduction)), -1, -1)]
    height, width = reference.gray.shape
    inverse = torch.zeros(0)
    for level, reduction in enumerate(reductions):
        size = (round(width / reduction), round(height / reduction))
        matcher = _Matcher(
            reference.resized(size),
            [s.resized((round(s.gray.shape[1] / reduction), round(s.gray.shape[0] / reduction))) for s in sources],
            settings,
            device,
        )
        if level == 0:
            inverse, step = _sweep(matcher, 1 / far, 1 / near, settings)
        else:
            inverse, step = _upsampled(inverse, size), step / 2
        inverse, score = _refine(matcher, inverse, step, 1 / far, 1 / near)
    inverse, slopes = _local_planes(inverse, score)
    inverse, score = _refine_once(matcher, inverse[None], step / 2)
    normals = _normals(inverse, slopes, reference.intrinsics)
    good = (score >= settings.min_score) & (inverse > 0.5 / far)
    depth = torch.where(good, 1 / inverse.clamp(min=1e-12), torch.zeros_like(inverse))
    return DepthEstimate(depth.cpu().numpy(), (normals * good[..., None]).cpu().numpy(), score.cpu().numpy())


def refine_depth(
    reference: Photo, sources: list[Photo], depth: NDArray[np.float32], reach_px: float, settings: DepthSettings,
    device: str,
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:  # fmt: skip
    """A depth map that is nearly right, moved to where the photos match best.

    Returns the depths (H, W), which of them moved, and which the photos deny: the window has texture, and it matches
    neither there nor nearby.

    Args:
        reference: the photo of the depth map, at its size.
        sources: photos that overlap it, at about the same scale.
        depth: (H, W) along z, 0 for none.
        reach_px: how far a pixel may move in the source photos, pixels.
        settings: see DepthSettings; of these best_sources, window_px and min_score.
        device: a PyTorch device, "cpu" or "cuda".
    """
    known = depth > 0
    rows, columns = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    first = torch.from_numpy(1 / depth[rows, columns]).to(device)
    low, high = float(first.min()), float(first.max()) * 1.001
    matcher = _Matcher(reference, sources, settings, device)
    step = reach_px * (high - low) / max(matcher.shift_per_inverse_depth(low, high), 1e-6)
    inverse, _ = _refine_once(matcher, first[None], step / 2)
    inverse, score = _refine(matcher, _median3(inverse), step / 4, low, high)
    inverse, _ = _local_planes(inverse, score)
    inverse, score = _refine_once(matcher, inverse[None], step / 8)
    before = matcher.score(first[None])[0]
    moved = (score >= settings.min_score) & (score - before >= MIN_GAIN) & ((inverse - first).abs() <= step)
    moved &= torch.from_numpy(known).to(device)
    asked = (matcher.variance >= TEXTURE**2) & (matcher.seen_by(first) >= matcher.best)
    denied = ~moved & (before < settings.min_score) & asked
    refined = torch.where(moved, 1 / inverse.clamp(min=1e-12), torch.from_numpy(depth).to(device))
    return refined.cpu().numpy(), moved.cpu().numpy(), denied.cpu().numpy() & known


class _Matcher:
    """Scores inverse-depth hypotheses of one reference photo by the mean NCC of its best sources."""

    def __init__(self, reference: Photo, sources: list[Photo], settings: DepthSettings, device: str) -> None:
        height, width = reference.gray.shape
        self.window, self.best = settings.window_px, min(settings.best_sources, len(sources))
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.linalg.inv(reference.intrinsics) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
        rotation, shift = reference.cam_from_world[:, :3], reference.cam_from_world[:, 3]
        self.reference = torch.from_numpy(_high_pass(reference.gray)).to(device)
        self.mean = _box(self.reference, self.window)
        self.variance = (_box(self.reference**2, self.window) - self.mean**2).clamp(min=0)
        self.sources: list[tuple[Tensor, Tensor, Tensor]] = []
        for source in sources:
            turn = source.cam_from_world[:, :3] @ rotation.T
            move = source.cam_from_world[:, 3] - turn @ shift
            # From pixels to grid_sample's -1..1, where 0.5 px is the first pixel's centre.
            to_grid = (
                np.array([[2 / source.gray.shape[1], 0, -1], [0, 2 / source.gray.shape[0], -1], [0, 0, 1]])
                @ source.intrinsics
            )
            directions = (to_grid @ turn @ rays).reshape(3, height, width)
            self.sources.append(
                (
                    torch.from_numpy(_high_pass(source.gray))[None, None].to(device),
                    torch.from_numpy(directions.astype(np.float32)).to(device),
                    torch.from_numpy((to_grid @ move).astype(np.float32)).to(device),
                )
            )

    def score(self, inverse: Tensor) -> Tensor:
        """Mean NCC of the best sources for D hypotheses per pixel: (D, h, w) inverse depths -> (D, h, w) in -1..1."""
        best = inverse.new_full((self.best, *inverse.shape), -0.5)
        keep = self._keep_best_on_cpu if inverse.device.type == "cpu" else self._keep_best
        for source in self.sources:
            keep(inverse, best, *source)
        return best.mean(0)

    def _keep_best_on_cpu(self, inverse: Tensor, best: Tensor, gray: Tensor, directions: Tensor, move: Tensor) -> None:
        """The same as `_keep_best`, by the CPU's kernel."""
        photos = inverse.contiguous(), self.reference, self.mean, self.variance, gray[0, 0], directions, move
        keep_best(*(p.numpy() for p in photos), self.window, best.numpy())  # type: ignore[call-arg]

    def _keep_best(self, inverse: Tensor, best: Tensor, gray: Tensor, directions: Tensor, move: Tensor) -> None:
        """Put the scores of one source among the best (K, D, h, w), the largest first."""
        score = self._ncc(inverse, gray, directions, move)
        for k in range(self.best):
            best[k], score = torch.maximum(best[k], score), torch.minimum(best[k], score)

    def seen_by(self, inverse: Tensor) -> Tensor:
        """Source photos (h, w) in which a hypothesis per pixel (h, w) lies."""
        return sum(self._place(inverse[None], *source[1:])[1][0].int() for source in self.sources)  # type: ignore[return-value]

    @staticmethod
    def _place(inverse: Tensor, directions: Tensor, move: Tensor) -> tuple[Tensor, Tensor]:
        """Where D hypotheses per pixel lie in a source photo, (D, h, w, 2) in -1..1, and whether they do, (D, h, w)."""
        z = directions[2] + move[2] * inverse
        scale = 1 / z.clamp(min=1e-6)
        grid = torch.stack(
            [(directions[0] + move[0] * inverse) * scale, (directions[1] + move[1] * inverse) * scale], dim=-1
        )
        return grid, (z > 1e-6) & (grid.abs().amax(-1) < 1)

    def _ncc(self, inverse: Tensor, gray: Tensor, directions: Tensor, move: Tensor) -> Tensor:
        """NCC of one source, (D, h, w); -0.5 where the hypothesis lies outside the source photo."""
        grid, inside = self._place(inverse, directions, move)
        count, height, width = inverse.shape
        grid = grid.reshape(1, count * height, width, 2)
        warped = F.grid_sample(gray, grid, padding_mode="border", align_corners=False)
        warped = warped.reshape(count, height, width)
        mean = _box(warped, self.window)
        variance = (_box(warped * warped, self.window) - mean * mean).clamp(min=0)
        covariance = _box(warped * self.reference, self.window) - mean * self.mean
        # The constant keeps windows without texture from matching anything: one grey level of 255, squared.
        ncc = covariance / torch.sqrt((variance + 1.5e-5) * (self.variance + 1.5e-5))
        return torch.where(inside, ncc, torch.full_like(ncc, -0.5))

    def shift_per_inverse_depth(self, low: float, high: float) -> float:
        """Largest shift in any source photo, in its pixels, between the two ends of the inverse depth range."""
        shifts = [0.0]
        for gray, directions, move in self.sources:
            half = torch.tensor([gray.shape[-1] / 2, gray.shape[-2] / 2], device=gray.device)
            thinned = directions[:, ::8, ::8]
            ends = []
            for inverse in (low, high):
                p = thinned + move[:, None, None] * inverse
                ends.append(p[:2] / p[2].clamp(min=1e-6))
            inside = (ends[0].abs().amax(0) < 1) & (ends[1].abs().amax(0) < 1)
            if inside.any():
                length = ((ends[1] - ends[0]) * half[:, None, None]).norm(dim=0)
                shifts.append(float(length[inside].median()))
        return max(shifts)


def _sweep(matcher: _Matcher, low: float, high: float, settings: DepthSettings) -> tuple[Tensor, float]:
    """Inverse depth per pixel, (h, w), by a fronto-parallel sweep with semi-global smoothing, and the plane step."""
    shift = matcher.shift_per_inverse_depth(low, high)
    count = int(np.clip(math.ceil(shift / 0.75), 16, settings.planes))
    planes = torch.linspace(low, high, count, device=matcher.reference.device)
    height, width = matcher.reference.shape
    cost = torch.empty(count, height, width, device=planes.device)
    for start in range(0, count, 16):
        chunk = planes[start : start + 16, None, None].expand(-1, height, width)
        cost[start : start + 16] = 1 - matcher.score(chunk)
    total = _semi_global(cost, settings.smoothness, 4 * settings.smoothness)
    chosen = total.argmin(0)
    inner = chosen.clamp(1, count - 2)
    before, middle, after = (total.gather(0, (inner + k)[None])[0] for k in (-1, 0, 1))
    step = (high - low) / (count - 1)
    inverse = planes[chosen] + step * _parabola(before, middle, after) * (inner == chosen)
    return inverse, step


def _semi_global(cost: Tensor, small: float, large: float) -> Tensor:
    """Sum of the path costs along four directions, (D, h, w), for a (D, h, w) matching cost."""
    total = torch.zeros_like(cost)
    for axis in (1, 2):
        lines = cost.movedim(axis, 0).contiguous()
        for backward in (False, True):
            path = torch.empty_like(lines)
            order = range(len(lines) - 1, -1, -1) if backward else range(len(lines))
            previous: Tensor | None = None
            for k in order:
                if previous is None:
                    path[k] = lines[k]
                else:
                    floor = previous.amin(0, keepdim=True)
                    best = torch.minimum(previous, floor + large)
                    best[1:] = torch.minimum(best[1:], previous[:-1] + small)
                    best[:-1] = torch.minimum(best[:-1], previous[1:] + small)
                    path[k] = lines[k] + best - floor
                previous = path[k]
            total += path.movedim(0, axis)
    return total


def _refine(matcher: _Matcher, inverse: Tensor, step: float, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Inverse depth (h, w) and score after trying the neighbours' depths, then a finer step around the winner."""
    lowest, highest = -F.max_pool2d(-inverse[None], 5, 1, 2)[0], F.max_pool2d(inverse[None], 5, 1, 2)[0]
    inverse, _ = _refine_once(matcher, torch.stack([inverse, lowest, highest]), step)
    inverse = _median3(inverse.clamp(0.8 * low, 1.2 * high))
    return _refine_once(matcher, inverse[None], step / 2)


def _refine_once(matcher: _Matcher, bases: Tensor, step: float) -> tuple[Tensor, Tensor]:
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


def _local_planes(inverse: Tensor, score: Tensor, window: int = 5) -> tuple[Tensor, Tensor]:
    """Smoothed inverse depth (h, w) and its slopes per pixel (2, h, w), from plane fits that keep edges.

    A plane's inverse depth is linear in the pixel, so a weighted linear fit in a window is a plane fit.
    Each pixel takes the fit, out
    of nine windows that contain it, whose residual is smallest (Kuwahara 1976): no fit crosses a depth edge.
    """
    height, width = inverse.shape
    weight = score.clamp(min=0.02) ** 2
    radius = window // 2
    v, u = torch.meshgrid(
        torch.arange(height, device=inverse.device, dtype=torch.float64),
        torch.arange(width, device=inverse.device, dtype=torch.float64),
        indexing="ij",
    )
    w, q = weight.double(), inverse.double()
    s = {
        name: _box(values, window)
        for name, values in {
            "1": w, "u": w * u, "v": w * v, "uu": w * u * u, "uv": w * u * v, "vv": w * v * v,
            "q": w * q, "uq": w * u * q, "vq": w * v * q, "qq": w * q * q,
        }.items()
    }  # fmt: skip
    mu, mv, mq = s["u"] / s["1"], s["v"] / s["1"], s["q"] / s["1"]
    uu, uv, vv = s["uu"] / s["1"] - mu * mu, s["uv"] / s["1"] - mu * mv, s["vv"] / s["1"] - mv * mv
    uq, vq, qq = s["uq"] / s["1"] - mu * mq, s["vq"] / s["1"] - mv * mq, s["qq"] / s["1"] - mq * mq
    determinant = (uu * vv - uv * uv).clamp(min=1e-6)
    a, b = (uq * vv - vq * uv) / determinant, (vq * uu - uq * uv) / determinant
    residual = (qq - a * uq - b * vq).clamp(min=0)
    fits = torch.stack([a, b, mq - a * mu - b * mv, residual])
    padded = F.pad(fits[None], (radius,) * 4, mode="replicate")[0]
    best = fits.clone()
    best[3] *= 0.8  # the centred window wins ties
    for dv in range(0, window, radius):
        for du in range(0, window, radius):
            other = padded[:, dv : dv + height, du : du + width]
            best = torch.where(other[3:] < best[3:], other, best)
    smooth = best[0] * u + best[1] * v + best[2]
    return smooth.float(), best[:2].float()


def _normals(inverse: Tensor, slopes: Tensor, intrinsics: NDArray[np.float64]) -> Tensor:
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


def _upsampled(inverse: Tensor, size: tuple[int, int]) -> Tensor:
    """(h, w) to (size[1], size[0]), bilinear."""
    return F.interpolate(inverse[None, None], size=(size[1], size[0]), mode="bilinear", align_corners=False)[0, 0]


def _median3(values: Tensor) -> Tensor:
    """Median over 3x3 pixels of an (h, w) map."""
    height, width = values.shape
    padded = F.pad(values[None, None], (1, 1, 1, 1), mode="replicate")[0, 0]
    return torch.stack([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)]).median(0).values


def _box(values: Tensor, window: int) -> Tensor:
    """Mean over a window of the last two axes; at the border, over what the padding by zero leaves."""
    radius = window // 2
    padded = F.pad(values, (radius + 1, radius, radius + 1, radius))
    sums = padded.cumsum(-1)
    sums = (sums[..., window:] - sums[..., :-window]).cumsum(-2)
    return (sums[..., window:, :] - sums[..., :-window, :]) / window**2


def _high_pass(gray: NDArray[np.float32]) -> NDArray[np.float32]:
    """The photo without its slow changes of brightness, so that sums over a window stay small and exact."""
    return gray - cv2.GaussianBlur(gray, (0, 0), 12.0)
