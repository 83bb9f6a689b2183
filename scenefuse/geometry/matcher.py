"""Photo-consistency: how well a depth per pixel of one photo matches the other photos; in Numba on a CPU, else PyTorch.

On a CPU a tile of the reference is compared with all sources at all hypotheses before the next one, so that everything
stays in the cache. What a pixel gets does not depend on tiles or threads.

Source: Goesele et al. 2006 (the best K of several views are averaged, which leaves occluded ones out).
"""

import math
from functools import cached_property

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
# Pixels of a tile along a row, with the halo of its windows.
TILE = 128
_MATH = {"contract", "reassoc", "nsz"}


class Matcher:
    """Scores inverse-depth hypotheses of one reference photo by the mean NCC of its best sources.

    Attributes:
        reference: (h, w) float32 the photo, without its mean.
        mean, variance: (h, w) of its windows.
        weights: (2, h, window, w) of the pixels in a window, see `support_weights`.
        windows: (3, h, w) reference, mean and variance.
        best: sources that count.
        sources: of each the photo (1, 1, H, W) without its mean, and float32 (3, 3) and (3,) that take a pixel of the
            reference and its inverse depth into the source photo, whose sides are -1..1.
    """

    def __init__(
        self, reference: View, sources: list[View], best_sources: int, window_px: int, device: torch.device | str
    ) -> None:
        """`pixels` of all are (H, W) float32 grey values in 0..1."""
        self.best = min(best_sources, len(sources))
        pixels = torch.from_numpy(_centred(reference.pixels)).to(device)
        self.weights = support_weights(pixels, window_px)
        mean = self._mean(pixels)
        self.windows = torch.stack([pixels, mean, (self._mean(pixels**2) - mean**2).clamp(min=0)])
        self.reference, self.mean, self.variance = self.windows
        self.sources: list[tuple[Tensor, Tensor, Tensor]] = []
        for source in sources:
            source_from_reference = source.cam_from_world @ reference.world_from_cam
            # From pixels to grid_sample's -1..1, where 0.5 px is the first pixel's centre.
            to_grid = np.array([[2 / source.width, 0, -1], [0, 2 / source.height, -1], [0, 0, 1]]) @ source.intrinsics
            camera = to_grid @ source_from_reference[:3]
            parts = camera[:, :3] @ np.linalg.inv(reference.intrinsics), camera[:, 3]
            turn, move = (torch.from_numpy(part.astype(np.float32)).to(device) for part in parts)
            self.sources.append((torch.from_numpy(_centred(source.pixels))[None, None].to(device), turn, move))

    def score(self, inverse: Tensor) -> Tensor:
        """Mean NCC of the best sources for D hypotheses per pixel: (D, h, w) inverse depths -> (D, h, w) in -1..1."""
        if inverse.device.type == "cpu":
            result, window = torch.empty(inverse.shape), self.weights.shape[2]
            arrays = (p.numpy() for p in (inverse.contiguous(), self.windows, self.weights, *self._photos))
            score_on_cpu(*arrays, self.best, (0,) * window, result.numpy())  # type: ignore[call-arg]
            return result
        best = inverse.new_full((self.best, *inverse.shape), OUTSIDE_SCORE)
        for source in self.sources:
            self.keep_best(inverse, best, *source)
        return best.mean(0)

    @cached_property
    def _photos(self) -> list[Tensor]:
        """The pixels of all source photos, one photo behind the other; (S, 2) heights and widths; their cameras."""
        photos, *cameras = zip(*self.sources)
        sizes = torch.tensor([photo.shape[2:] for photo in photos])
        return [torch.cat([photo.flatten() for photo in photos]), sizes, *(torch.stack(part) for part in cameras)]

    def keep_best(self, inverse: Tensor, best: Tensor, gray: Tensor, turn: Tensor, move: Tensor) -> None:
        """Put the scores of one of `sources` among the best (K, D, h, w), the largest first."""
        score = self._ncc(inverse, gray, turn, move)
        for k in range(self.best):
            best[k], score = torch.maximum(best[k], score), torch.minimum(best[k], score)

    def seen_by(self, inverse: Tensor) -> Tensor:
        """Number (h, w) of source photos in which a hypothesis per pixel (h, w) lies."""
        return sum(self._place(inverse[None], *source[1:])[1][0].int() for source in self.sources)  # type: ignore[return-value]

    def _directions(self, turn: Tensor, stride: int = 1) -> Tensor:
        """(3, h, w) homogeneous places, in a source photo, of the rays of every stride-th pixel."""
        height, width = self.reference.shape
        v, u = (torch.arange(0, side, stride, device=turn.device) + 0.5 for side in (height, width))
        return turn[:, 0, None, None] * u + turn[:, 1, None, None] * v[:, None] + turn[:, 2, None, None]

    def _place(self, inverse: Tensor, turn: Tensor, move: Tensor) -> tuple[Tensor, Tensor]:
        """Where D hypotheses per pixel lie in a source photo, (D, h, w, 2) in -1..1, and whether they do, (D, h, w)."""
        x, y, z = (direction + step * inverse for direction, step in zip(self._directions(turn), move))
        scale = 1 / z.clamp(min=1e-6)
        grid = torch.stack([x * scale, y * scale], dim=-1)
        return grid, (z > 1e-6) & (grid.abs().amax(-1) < 1)

    def _ncc(self, inverse: Tensor, gray: Tensor, turn: Tensor, move: Tensor) -> Tensor:
        """NCC of one source, (D, h, w); OUTSIDE_SCORE where the hypothesis lies outside the source photo."""
        grid, inside = self._place(inverse, turn, move)
        flat = grid.reshape(1, -1, inverse.shape[-1], 2)
        warped = F.grid_sample(gray, flat, padding_mode="border", align_corners=False).reshape(inverse.shape)
        mean = self._mean(warped)
        variance = (self._mean(warped * warped) - mean * mean).clamp(min=0)
        covariance = self._mean(warped * self.reference) - mean * self.mean
        ncc = covariance / torch.sqrt((variance + NOISE_VARIANCE) * (self.variance + NOISE_VARIANCE))
        return torch.where(inside, ncc, torch.full_like(ncc, OUTSIDE_SCORE))

    def _mean(self, values: Tensor) -> Tensor:
        """Weighted mean of values (..., h, w) over the support of each pixel."""
        return supported_mean(values, self.weights)

    def shifts(self, low: float, high: float) -> list[float]:
        """Shift in each source photo, in its pixels, between two inverse depths, or ever shorter parts of their range
        where none of its pixels has both in the photo; 0 where a 64th still leads out of it."""
        shifts = []
        for gray, turn, move in self.sources:
            half = torch.tensor([gray.shape[-1] / 2, gray.shape[-2] / 2], device=gray.device)
            thinned = self._directions(turn, 8)
            for part in 0.5 ** np.arange(7):
                ends = []
                for inverse in (low, low + part * (high - low)):
                    p = thinned + move[:, None, None] * inverse
                    ends.append(p[:2] / p[2].clamp(min=1e-6))
                inside = (ends[0].abs().amax(0) < 1) & (ends[1].abs().amax(0) < 1)
                if inside.any():
                    break
            length = ((ends[1] - ends[0]) * half[:, None, None]).norm(dim=0)
            shifts.append(float(length[inside].median()) / part if inside.any() else 0.0)
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
    radius, (height, width) = window // 2, gray.shape
    weights = gray.new_zeros(2, height, window, width)
    weights[:, :, radius] = 1
    for axis, part in zip((1, 0), weights.movedim(2, 1)):
        for k in range(1, radius + 1):
            count = gray.shape[axis] - k
            step = (gray.narrow(axis, k, count) - gray.narrow(axis, 0, count)).abs()
            weight = torch.exp(-step / GREY_FALL - k / (DISTANCE_FALL * radius))
            # Beside a dark statue, the smallest weight is texture enough for a blank sky to match at its depth.
            weight *= step < 4 * GREY_FALL
            part[radius + k].narrow(axis, 0, count).copy_(weight)
            part[radius - k].narrow(axis, k, count).copy_(weight)
    return weights.div_(weights.sum(2, keepdim=True))


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


def _centred(gray: NDArray[np.float32]) -> NDArray[np.float32]:
    """The photo (H, W) without its mean, so that sums of squares stay small and exact."""
    return gray - gray.mean()


@njit(fastmath=_MATH, error_model="numpy")
def _place(inverse, turn, move, left, y, width, height, place, part_x, part_y, inside):
    """Where one row y of the reference, from the column `left` on, lies in a source photo.

    All float32 but `place`: inverse (w,) inverse depths; turn (3, 3) and move (3,) give places in -1..1; width and
    height of the source photo. Written: place (w,) int32 index of the upper left pixel of four, part_x and part_y (w,)
    the place between them in 0..1, inside (w,) 1 where it lies in the photo, else 0.
    """
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    row = np.float32(y) + half
    row_x, row_y, row_z = turn[0, 1] * row + turn[0, 2], turn[1, 1] * row + turn[1, 2], turn[2, 1] * row + turn[2, 2]
    step_x, step_y, step_z = turn[0, 0], turn[1, 0], turn[2, 0]
    move_x, move_y, move_z = move[0], move[1], move[2]
    half_x, half_y = np.float32(width) * half, np.float32(height) * half
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    end_x, end_y = np.int32(width - 2), np.int32(height - 2)
    for x in range(len(inverse)):
        column = np.float32(np.int32(left + x)) + half
        z = row_z + step_z * column + move_z * inverse[x]
        scale = one / max(z, np.float32(1e-6))
        u = (row_x + step_x * column + move_x * inverse[x]) * scale
        v = (row_y + step_y * column + move_y * inverse[x]) * scale
        inside[x] = one if (z > np.float32(1e-6)) & (abs(u) < one) & (abs(v) < one) else zero
        px = min(max((u + one) * half_x - half, zero), last_x)
        py = min(max((v + one) * half_y - half, zero), last_y)
        # Whatever a depth that is not a number gives, it is a pixel of the photo.
        x0 = np.int32(max(min(np.int32(px), end_x), np.int32(0)))
        y0 = np.int32(max(min(np.int32(py), end_y), np.int32(0)))
        part_x[x], part_y[x] = px - np.float32(x0), py - np.float32(y0)
        place[x] = y0 * np.int32(width) + x0


@njit(fastmath=_MATH, error_model="numpy")
def _warp(flat, width, place, part_x, part_y, middle, value):
    """Bilinear samples value (w,) of a photo flat (H * width,), less the grey value middle; place and parts as `_place`
    writes them."""
    for x in range(len(place)):
        at = np.uint32(place[x])
        below = np.uint32(at + width)
        a, b = flat[at], flat[np.uint32(at + 1)]
        c, d = flat[below], flat[np.uint32(below + 1)]
        upper = a + part_x[x] * (b - a)
        lower = c + part_x[x] * (d - c)
        value[x] = upper + part_y[x] * (lower - upper) - middle


@njit(fastmath=_MATH)
def _sums_along(value, reference, weight, taps, width, sums):
    """Weighted sums along a row of a value, of its square and of its product with the reference.

    value, reference (w + window - 1,); weight (window * TILE,): of the pixels from left to right in the support of
    each; taps: a tuple as long as the window. Written: sums (3 * TILE,), one behind the other.
    """
    for x in range(min(width, TILE)):  # the compiler then knows that no index runs over
        first = second = both = np.float32(0.0)
        for k in range(len(taps)):
            part = weight[k * TILE + x] * value[x + k]
            first += part
            second += part * value[x + k]
            both += part * reference[x + k]
        sums[x], sums[TILE + x], sums[2 * TILE + x] = first, second, both


@njit(fastmath=_MATH, error_model="numpy")
def _correlate(sums, weight, taps, mean, variance, inside, score):
    """Normalised cross-correlation of a row's windows, into score (w,).

    sums (window * 3 * TILE,): of the rows from top to bottom, as `_sums_along` writes them; weight (window * TILE,): of
    these rows in the support of each pixel; mean and variance (w,) of the reference's windows; inside (w,) as `_place`
    writes it.
    """
    flat = np.float32(NOISE_VARIANCE)
    for x in range(min(len(score), TILE)):
        first = second = both = np.float32(0.0)
        for k in range(len(taps)):
            share = weight[k * TILE + x]
            first += share * sums[3 * k * TILE + x]
            second += share * sums[(3 * k + 1) * TILE + x]
            both += share * sums[(3 * k + 2) * TILE + x]
        spread = max(second - first * first, np.float32(0.0))
        ncc = (both - first * mean[x]) / math.sqrt((spread + flat) * (variance[x] + flat))
        score[x] = ncc if inside[x] > np.float32(0.0) else np.float32(OUTSIDE_SCORE)


@njit
def _insert(score, best):
    """Keep the better of two rows of scores (w,) in `best`, the other in `score`."""
    for x in range(len(score)):
        better = max(best[x], score[x])
        score[x] = min(best[x], score[x])
        best[x] = better


# Loops are written out: expressions of whole arrays take Numba twice as long to compile.
@njit
def _score_tile(inverse, windows, weights, photos, sizes, turns, moves, keep, taps, result, top, bottom, left):
    """`score_on_cpu` of the tile of the rows from `top` to before `bottom` that begins at column `left`."""
    count, height, width = inverse.shape
    window, radius, rows = len(taps), len(taps) // 2, bottom - top
    right = min(left + TILE - window + 1, width)
    # With the halo, as far as the photo goes; columns and rows of buffers begin at the halo's.
    above, below = max(top - radius, 0), min(bottom + radius, height)
    before, behind = max(left - radius, 0), min(right + radius, width)
    lead, reach, halo = before - left + radius, behind - before, rows + 2 * radius
    along, down = np.zeros((halo, window * TILE), np.float32), np.zeros((rows, window * TILE), np.float32)
    reference, inside = np.zeros((halo, TILE), np.float32), np.zeros((halo, TILE), np.float32)
    # Without it, sums of squares are small and exact.
    middle = windows[1, top, left]
    for y in range(above, below):
        for x in range(before, behind):
            reference[y - top + radius, x - left + radius] = windows[0, y, x] - middle
        for k in range(window):
            along[y - top + radius, k * TILE : k * TILE + right - left] = weights[0, y, k, left:right]
            if top <= y < bottom:
                down[y - top, k * TILE : k * TILE + right - left] = weights[1, y, k, left:right]
    place, score = np.zeros(reach, np.int32), np.zeros(right - left, np.float32)
    part_x, part_y, value = np.zeros(reach, np.float32), np.zeros(reach, np.float32), np.zeros(TILE, np.float32)
    mean = np.zeros((rows, right - left), np.float32)
    for k in range(rows):
        for x in range(right - left):
            mean[k, x] = windows[1, top + k, left + x] - middle
    sums = np.zeros(halo * 3 * TILE, np.float32)
    best = np.zeros((keep, rows, right - left), np.float32)
    for d in range(count):
        best[:] = np.float32(OUTSIDE_SCORE)
        start = 0
        for s in range(len(sizes)):
            high, wide = sizes[s, 0], sizes[s, 1]
            photo = photos[start : start + high * wide]
            start += high * wide
            for y in range(above, below):
                k = y - top + radius
                _place(
                    inverse[d, y, before:behind], turns[s], moves[s], before, y, wide, high, place, part_x, part_y,
                    inside[k, lead:],
                )  # fmt: skip
                _warp(photo, np.uint32(wide), place, part_x, part_y, middle, value[lead:])
                _sums_along(value, reference[k], along[k], taps, right - left, sums[k * 3 * TILE :])
            for k in range(rows):
                variance, seen = windows[2, top + k, left:right], inside[k + radius, radius:]
                _correlate(sums[k * 3 * TILE :], down[k], taps, mean[k], variance, seen, score)
                for j in range(keep):
                    _insert(score, best[j, k])
        for k in range(rows):
            for x in range(right - left):
                total = np.float32(0.0)
                for j in range(keep):
                    total += best[j, k, x]
                result[d, top + k, left + x] = total / np.float32(keep)


@njit(parallel=True, cache=True)
def score_on_cpu(inverse, windows, weights, photos, sizes, turns, moves, keep, taps, result):  # type: ignore[no-untyped-def]
    """Mean NCC of the best `keep` sources for D hypotheses per pixel, into result (D, h, w).

    All float32: inverse (D, h, w) inverse depths; windows (3, h, w) the reference, and the mean and variance of its
    windows; weights (2, h, window, w) along the rows and across them, as `support_weights` makes them; photos (sum of
    H * W,) of S sources, one behind the other, of heights and widths sizes (S, 2) int64; turns (S, 3, 3) and moves
    (S, 3) give places in -1..1; taps: a tuple as long as the window, by which the compiler knows its length.
    """
    (height, width), rows, columns = inverse.shape[1:], 32, TILE - len(taps) + 1
    across = (width + columns - 1) // columns
    for tile in prange(across * ((height + rows - 1) // rows)):
        top, left = tile // across * rows, tile % across * columns
        bottom = min(top + rows, height)
        _score_tile(inverse, windows, weights, photos, sizes, turns, moves, keep, taps, result, top, bottom, left)
