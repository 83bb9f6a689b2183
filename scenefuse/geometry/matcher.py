"""Photo-consistency: how well a depth per pixel of one photo matches the other photos; in Numba on a CPU, else PyTorch.

On a CPU a band of rows is warped, summed over windows and compared row by row, so that everything but the photos stays
in the cache. What a pixel gets does not depend on bands or threads.

Source: Goesele et al. 2006 (the best K of several views are averaged, which leaves occluded ones out).
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
from numba import njit, prange
from numpy.typing import NDArray
from torch import Tensor

from scenefuse.photos.workspace import View

# One grey level of 255, squared, the noise of a photo: keeps windows without texture from matching anything.
NOISE_VARIANCE = 1.5e-5
# Difference of grey values, 0..1, at which a pixel's weight in a support falls to 1 / e.
GREY_FALL = 0.07
# Distance, in radii of the window, at which it falls to 1 / e.
DISTANCE_FALL = 0.6
# Score of a hypothesis outside a source photo: worse than a window that does not match.
OUTSIDE_SCORE = -0.5
_MATH = {"contract", "reassoc", "nsz"}


class Matcher:
    """Scores inverse-depth hypotheses of one reference photo by the mean NCC of its best sources.

    Attributes:
        reference: (h, w) float32 the photo, without its mean.
        mean, variance: (h, w) of its windows.
        weights: (2, h, window, w) of the pixels in a window, see `support_weights`.
        windows: (3, h, w) reference, mean and variance.
        best: sources that count.
    """

    def __init__(
        self,
        reference: View,
        sources: list[View],
        best_sources: int,
        window_px: int,
        device: torch.device | str,
    ) -> None:
        """Place each pixel's ray in each source photo; `pixels` of all are (H, W) float32 grey values in 0..1."""
        height, width = reference.height, reference.width
        self.best = min(best_sources, len(sources))
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.linalg.inv(reference.intrinsics) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
        rotation, shift = reference.cam_from_world[:3, :3], reference.cam_from_world[:3, 3]
        pixels = torch.from_numpy(_centred(reference.pixels)).to(device)
        self.weights = support_weights(pixels, window_px)
        mean = self._mean(pixels)
        self.windows = torch.stack([pixels, mean, (self._mean(pixels**2) - mean**2).clamp(min=0)])
        self.reference, self.mean, self.variance = self.windows
        self.sources: list[tuple[Tensor, Tensor, Tensor]] = []
        for source in sources:
            turn = source.cam_from_world[:3, :3] @ rotation.T
            move = source.cam_from_world[:3, 3] - turn @ shift
            # From pixels to grid_sample's -1..1, where 0.5 px is the first pixel's centre.
            to_grid = np.array([[2 / source.width, 0, -1], [0, 2 / source.height, -1], [0, 0, 1]]) @ source.intrinsics
            directions = (to_grid @ turn @ rays).reshape(3, height, width)
            self.sources.append(
                (
                    torch.from_numpy(_centred(source.pixels))[None, None].to(device),
                    torch.from_numpy(directions.astype(np.float32)).to(device),
                    torch.from_numpy((to_grid @ move).astype(np.float32)).to(device),
                )
            )

    def score(self, inverse: Tensor) -> Tensor:
        """Mean NCC of the best sources for D hypotheses per pixel: (D, h, w) inverse depths -> (D, h, w) in -1..1."""
        best = inverse.new_full((self.best, *inverse.shape), OUTSIDE_SCORE)
        keep = self._keep_best_on_cpu if inverse.device.type == "cpu" else self.keep_best
        for source in self.sources:
            keep(inverse, best, *source)
        return best.mean(0)

    def _keep_best_on_cpu(self, inverse: Tensor, best: Tensor, gray: Tensor, directions: Tensor, move: Tensor) -> None:
        """The same as `keep_best`, by the CPU's kernel."""
        first, last = (inverse.contiguous(), self.windows, self.weights), (gray[0, 0], directions, move, best)
        keep_best_on_cpu(*(p.numpy() for p in (*first, *last)))  # type: ignore[call-arg]

    def keep_best(self, inverse: Tensor, best: Tensor, gray: Tensor, directions: Tensor, move: Tensor) -> None:
        """Put the scores of one of `sources` among the best (K, D, h, w), the largest first."""
        score = self._ncc(inverse, gray, directions, move)
        for k in range(self.best):
            best[k], score = torch.maximum(best[k], score), torch.minimum(best[k], score)

    def seen_by(self, inverse: Tensor) -> Tensor:
        """Number (h, w) of source photos in which a hypothesis per pixel (h, w) lies."""
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
        """NCC of one source, (D, h, w); OUTSIDE_SCORE where the hypothesis lies outside the source photo."""
        grid, inside = self._place(inverse, directions, move)
        count, height, width = inverse.shape
        grid = grid.reshape(1, count * height, width, 2)
        warped = F.grid_sample(gray, grid, padding_mode="border", align_corners=False)
        warped = warped.reshape(count, height, width)
        mean = self._mean(warped)
        variance = (self._mean(warped * warped) - mean * mean).clamp(min=0)
        covariance = self._mean(warped * self.reference) - mean * self.mean
        ncc = covariance / torch.sqrt((variance + NOISE_VARIANCE) * (self.variance + NOISE_VARIANCE))
        return torch.where(inside, ncc, torch.full_like(ncc, OUTSIDE_SCORE))

    def _mean(self, values: Tensor) -> Tensor:
        """Weighted mean of values (..., h, w) over the support of each pixel."""
        return supported_mean(values, self.weights)

    def shift_per_inverse_depth(self, low: float, high: float) -> float:
        """Largest shift in any source photo, in its pixels, between the two ends of the inverse depth range."""
        return max(self._shifts(low, high))

    def middle_shift_per_inverse_depth(self, low: float, high: float) -> float:
        """The same in the middle one of the source photos: half of them move by at least as much."""
        return float(np.median(self._shifts(low, high)))

    def _shifts(self, low: float, high: float) -> list[float]:
        """Shift in each source photo, in its pixels; 0 where both ends of the range never lie in it."""
        shifts = []
        for gray, directions, move in self.sources:
            half = torch.tensor([gray.shape[-1] / 2, gray.shape[-2] / 2], device=gray.device)
            thinned = directions[:, ::8, ::8]
            ends = []
            for inverse in (low, high):
                p = thinned + move[:, None, None] * inverse
                ends.append(p[:2] / p[2].clamp(min=1e-6))
            inside = (ends[0].abs().amax(0) < 1) & (ends[1].abs().amax(0) < 1)
            length = ((ends[1] - ends[0]) * half[:, None, None]).norm(dim=0)
            shifts.append(float(length[inside].median()) if inside.any() else 0.0)
        return shifts


def support_weights(gray: Tensor, window: int) -> Tensor:
    """Weights of pixels along a row, and of rows across it, in each pixel's support, (2, h, window, w).

    A pixel counts as far as it is near and of the same grey (Yoon, Kweon 2006), along the rows first and then across
    them (Pham, van Vliet 2005), so that a window of n x n pixels costs 2 n products. A pixel's weights sum to one, and
    are zero outside the photo.

    Args:
        gray: (h, w) in 0..1.
        window: its side, odd.
    """
    radius = window // 2
    parts = []
    for axis in (0, 1):
        values = gray.movedim(axis, 0)  # the axis that the support runs along, first
        padded = F.pad(values, (0, 0, radius, radius), value=float("inf"))
        weights = []
        for k in range(window):
            step = (padded[k : k + len(values)] - values).abs()
            weight = torch.exp(-step / GREY_FALL - abs(k - radius) / (DISTANCE_FALL * radius))
            # Beside a dark statue, the smallest weight is texture enough for a blank sky to match at its depth.
            weights.append(weight * (step < 4 * GREY_FALL))
        stacked = torch.stack(weights, dim=1)
        stacked = (stacked / stacked.sum(1, keepdim=True)).transpose(0, 2 * axis)
        parts.append(stacked)
    return torch.stack([parts[1], parts[0]])


def supported_mean(values: Tensor, weights: Tensor) -> Tensor:
    """Mean of values (..., h, w) over each pixel's support, weighted as `support_weights` says."""
    along, across = weights
    window, radius = along.shape[1], along.shape[1] // 2
    height, width = values.shape[-2:]
    row = F.pad(values, (radius, radius))
    sums, total = torch.zeros_like(values), torch.zeros_like(values)
    for k in range(window):
        sums.addcmul_(along[:, k], row[..., k : k + width])
    rows = F.pad(sums, (0, 0, radius, radius))
    for k in range(window):
        total.addcmul_(across[:, k], rows[..., k : k + height, :])
    return total


def box(values: Tensor, window: int) -> Tensor:
    """Mean over a window of the last two axes; at the border, over what the padding by zero leaves."""
    radius = window // 2
    padded = F.pad(values, (radius + 1, radius, radius + 1, radius))
    sums = padded.cumsum(-1)
    sums = (sums[..., window:] - sums[..., :-window]).cumsum(-2)
    return (sums[..., window:, :] - sums[..., :-window, :]) / window**2


def _centred(gray: NDArray[np.float32]) -> NDArray[np.float32]:
    """The photo (H, W) without its mean, so that sums of squares stay small and exact."""
    return gray - gray.mean()


@njit(fastmath=_MATH, error_model="numpy")
def _place(inverse, directions, move, y, width, height, place, part_x, part_y, inside):
    """Where one row y of the reference lies in the source photo.

    All float32 but `place`: inverse (w,) inverse depths; directions (3, h, w) and move (3,) give places in -1..1; width
    and height of the source photo. Written: place (w,) int32 index of the upper left pixel of four, part_x and part_y
    (w,) the place between them in 0..1, inside (w,) 1 where it lies in the photo, else 0.
    """
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    direction_x, direction_y, direction_z = directions[0, y], directions[1, y], directions[2, y]
    half_x, half_y = np.float32(width) * half, np.float32(height) * half
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    end_x, end_y = np.int32(width - 2), np.int32(height - 2)
    for x in range(len(inverse)):
        z = direction_z[x] + move[2] * inverse[x]
        scale = one / max(z, np.float32(1e-6))
        u = (direction_x[x] + move[0] * inverse[x]) * scale
        v = (direction_y[x] + move[1] * inverse[x]) * scale
        inside[x] = one if (z > np.float32(1e-6)) & (abs(u) < one) & (abs(v) < one) else zero
        px = min(max((u + one) * half_x - half, zero), last_x)
        py = min(max((v + one) * half_y - half, zero), last_y)
        # Whatever a depth that is not a number gives, it is a pixel of the photo.
        x0 = np.int32(max(min(np.int32(px), end_x), np.int32(0)))
        y0 = np.int32(max(min(np.int32(py), end_y), np.int32(0)))
        part_x[x], part_y[x] = px - np.float32(x0), py - np.float32(y0)
        place[x] = y0 * np.int32(width) + x0


@njit(fastmath=_MATH, error_model="numpy")
def _warp(flat, width, place, part_x, part_y, value):
    """Bilinear samples value (w,) of a photo flat (H * width,); place, part_x and part_y as `_place` writes them."""
    for x in range(len(place)):
        at = np.uint32(place[x])
        below = np.uint32(at + width)
        a, b = flat[at], flat[np.uint32(at + 1)]
        c, d = flat[below], flat[np.uint32(below + 1)]
        upper = a + part_x[x] * (b - a)
        lower = c + part_x[x] * (d - c)
        value[x] = upper + part_y[x] * (lower - upper)


@njit(fastmath=_MATH)
def _sums_along(value, reference, weight, sums):
    """Weighted sums along a row of a value (w,), of its square and of its product with the reference (w,).

    weight (window, w): of the pixels from left to right in the support of each. Written: sums (3 w,), one behind the
    other; outside the row is zero.
    """
    width, radius = len(value), len(weight) // 2
    row = np.zeros(width + 2 * radius, np.float32)
    inner = row[radius : radius + width]
    for k in range(3):
        for x in range(width):
            inner[x] = value[x] * (np.float32(1.0) if k == 0 else value[x] if k == 1 else reference[x])
        out, share = sums[k * width : (k + 1) * width], weight[0]
        for x in range(width):
            out[x] = share[x] * row[x]
        for w in range(1, len(weight)):
            shifted, share = row[w : w + width], weight[w]
            for x in range(width):
                out[x] += share[x] * shifted[x]


@njit(fastmath=_MATH)
def _sum_across(rows, first, weight, total):
    """Weighted sums across rows (window, 3 w), a ring of which `first` is the uppermost, into total (3 w,).

    weight (window, w): of the rows from top to bottom in the support of each pixel.
    """
    window, width = weight.shape
    for k in range(3):
        out = total[k * width : (k + 1) * width]
        for w in range(window):
            part, share = rows[(first + w) % window, k * width : (k + 1) * width], weight[w]
            if w == 0:
                for x in range(width):
                    out[x] = share[x] * part[x]
            else:
                for x in range(width):
                    out[x] += share[x] * part[x]


@njit(fastmath=_MATH, error_model="numpy")
def _correlate(sums, mean, variance, inside, score):
    """Normalised cross-correlation of a row's windows, into score (w,).

    sums (3 w,): weighted means over whole windows, as `_sums_along` orders them; mean and variance (w,) of the
    reference's windows; inside (w,) as `_place` writes it.
    """
    width, flat = len(score), np.float32(NOISE_VARIANCE)
    first, second, both = sums[:width], sums[width : 2 * width], sums[2 * width :]
    for x in range(width):
        average = first[x]
        spread = max(second[x] - average * average, np.float32(0.0))
        covariance = both[x] - average * mean[x]
        ncc = covariance / math.sqrt((spread + flat) * (variance[x] + flat))
        score[x] = ncc if inside[x] > np.float32(0.0) else np.float32(OUTSIDE_SCORE)


@njit
def _insert(score, best):
    """Keep the better of two rows of scores (w,) in `best`, the other in `score`."""
    for x in range(len(score)):
        better = max(best[x], score[x])
        score[x] = min(best[x], score[x])
        best[x] = better


@njit(parallel=True, cache=True)
def keep_best_on_cpu(inverse, windows, weights, gray, directions, move, best):  # type: ignore[no-untyped-def]
    """Match D hypotheses per pixel in one source photo, and keep the best scores seen so far.

    All float32: inverse (D, h, w) inverse depths; windows (3, h, w) the reference, and the mean and variance of its
    windows; weights (2, h, window, w) along the rows and across them, as `support_weights` makes them; gray (H, W)
    source photo; directions (3, h, w) and move (3,) give its places in -1..1; best (K, D, h, w), sorted, the largest
    first: changed in place.
    """
    reference, mean, variance = windows[0], windows[1], windows[2]
    along, across = weights[0], weights[1]
    count, height, width = inverse.shape
    window = along.shape[1]
    radius = window // 2
    band = 32  # rows
    bands = (height + band - 1) // band
    for job in prange(count * bands):
        d, top = job // bands, job % bands * band
        pixels, size_x, size_y = gray.ravel(), gray.shape[1], gray.shape[0]
        place, inside = np.zeros(width, np.int32), np.zeros((window, width), np.float32)
        part_x, part_y = np.zeros(width, np.float32), np.zeros(width, np.float32)
        value, score = np.zeros(width, np.float32), np.zeros(width, np.float32)
        # Sums along the last `window` rows, and over the whole windows.
        sums, total = np.zeros((window, 3 * width), np.float32), np.zeros(3 * width, np.float32)
        for y in range(top - radius, min(top + band, height) + radius):
            slot = (y + window) % window
            if 0 <= y < height:
                _place(inverse[d, y], directions, move, y, size_x, size_y, place, part_x, part_y, inside[slot])
                _warp(pixels, np.uint32(size_x), place, part_x, part_y, value)
                _sums_along(value, reference[y], along[y], sums[slot])
            else:
                sums[slot] = np.float32(0.0)
            middle = y - radius
            if middle >= top:
                _sum_across(sums, (slot + 1) % window, across[middle], total)
                _correlate(total, mean[middle], variance[middle], inside[middle % window], score)
                for k in range(best.shape[0]):
                    _insert(score, best[k, d, middle])
