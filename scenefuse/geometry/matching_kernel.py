"""CPU kernel in Numba that matches depth hypotheses; its PyTorch twin is `Matcher.keep_best` in matcher.py.

A band of rows is warped, summed over windows and compared row by row, so that everything but the photos stays in the
cache. What a pixel gets does not depend on bands or threads.
"""

import math

import numpy as np
from numba import njit, prange

_BAND = 32
_ZERO, _ONE, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_MATH = {"contract", "reassoc", "nsz"}


@njit(fastmath=_MATH, error_model="numpy")
def _place(inverse, directions, move, y, width, height, place, part_x, part_y, inside):
    """Where one row y of the reference lies in the source photo.

    All float32 but `place`: inverse (w,) inverse depths; directions (3, h, w) and move (3,) give places in -1..1; width
    and height of the source photo. Written: place (w,) int32 index of the upper left pixel of four, part_x and part_y
    (w,) the place between them in 0..1, inside (w,) 1 where it lies in the photo, else 0.
    """
    direction_x, direction_y, direction_z = directions[0, y], directions[1, y], directions[2, y]
    half_x, half_y = np.float32(width) * _HALF, np.float32(height) * _HALF
    last_x, last_y = np.float32(width - 1), np.float32(height - 1)
    end_x, end_y = np.int32(width - 2), np.int32(height - 2)
    for x in range(len(inverse)):
        z = direction_z[x] + move[2] * inverse[x]
        scale = _ONE / max(z, np.float32(1e-6))
        u = (direction_x[x] + move[0] * inverse[x]) * scale
        v = (direction_y[x] + move[1] * inverse[x]) * scale
        inside[x] = _ONE if (z > np.float32(1e-6)) & (abs(u) < _ONE) & (abs(v) < _ONE) else _ZERO
        px = min(max((u + _ONE) * half_x - _HALF, _ZERO), last_x)
        py = min(max((v + _ONE) * half_y - _HALF, _ZERO), last_y)
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
            inner[x] = value[x] * (_ONE if k == 0 else value[x] if k == 1 else reference[x])
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
def _correlate(sums, mean, variance, inside, flat, score):
    """Normalised cross-correlation of a row's windows, into score (w,).

    sums (3 w,): weighted means over whole windows, as `_sums_along` orders them; mean and variance (w,) of the
    reference's windows; inside (w,) as `_place` writes it; flat: variance that is added to all.
    """
    width = len(score)
    first, second, both = sums[:width], sums[width : 2 * width], sums[2 * width :]
    for x in range(width):
        average = first[x]
        spread = max(second[x] - average * average, _ZERO)
        covariance = both[x] - average * mean[x]
        ncc = covariance / math.sqrt((spread + flat) * (variance[x] + flat))
        score[x] = ncc if inside[x] > _ZERO else -_HALF


@njit
def _insert(score, best):
    """Keep the better of two rows of scores (w,) in `best`, the other in `score`."""
    for x in range(len(score)):
        better = max(best[x], score[x])
        score[x] = min(best[x], score[x])
        best[x] = better


@njit(parallel=True, cache=True)
def keep_best(inverse, windows, weights, flat, gray, directions, move, best):  # type: ignore[no-untyped-def]
    """Match D hypotheses per pixel in one source photo, and keep the best scores seen so far.

    All float32: inverse (D, h, w) inverse depths; windows (3, h, w) the reference, and the mean and variance of its
    windows; weights (2, h, window, w) along the rows and across them, as `support_weights` makes them; flat: variance
    that is added to all windows'; gray (H, W) source photo; directions (3, h, w) and move (3,) give its places in
    -1..1; best (K, D, h, w), sorted, the largest first: changed in place.
    """
    reference, mean, variance = windows[0], windows[1], windows[2]
    along, across = weights[0], weights[1]
    count, height, width = inverse.shape
    window = along.shape[1]
    radius = window // 2
    bands = (height + _BAND - 1) // _BAND
    for job in prange(count * bands):
        d, top = job // bands, job % bands * _BAND
        pixels, size_x, size_y = gray.ravel(), gray.shape[1], gray.shape[0]
        place, inside = np.zeros(width, np.int32), np.zeros((window, width), np.float32)
        part_x, part_y = np.zeros(width, np.float32), np.zeros(width, np.float32)
        value, score = np.zeros(width, np.float32), np.zeros(width, np.float32)
        # Sums along the last `window` rows, and over the whole windows.
        sums, total = np.zeros((window, 3 * width), np.float32), np.zeros(3 * width, np.float32)
        for y in range(top - radius, min(top + _BAND, height) + radius):
            slot = (y + window) % window
            if 0 <= y < height:
                _place(inverse[d, y], directions, move, y, size_x, size_y, place, part_x, part_y, inside[slot])
                _warp(pixels, np.uint32(size_x), place, part_x, part_y, value)
                _sums_along(value, reference[y], along[y], sums[slot])
            else:
                sums[slot] = _ZERO
            middle = y - radius
            if middle >= top:
                _sum_across(sums, (slot + 1) % window, across[middle], total)
                _correlate(total, mean[middle], variance[middle], inside[middle % window], flat, score)
                for k in range(best.shape[0]):
                    _insert(score, best[k, d, middle])
