"""CPU kernel in Numba: small patches around points, compared between the photos that see them."""

import math

import numpy as np
from numba import njit, prange

from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS, MIN_COSINE
from scenefuse.photos.pictures import NOISE

# Steps before and behind the point that are matched too; a step moves a patch by about a pixel in the other photos.
OFFSETS = 4
# Samples on each side of a patch's middle: 7 x 7 of them, a pixel of the sharpest photo apart.
RADIUS = 3
# Photos at most that one point is compared in, beside its reference.
OTHERS = 10
# Grey levels over which a sample's weight falls: across an edge a patch does not mix two surfaces (Yoon, Kweon 2006).
GREY_FALL = 25.0
# Between two rays to a point: below the first a match does not locate it, beyond the last patches look different; the
# second is as good as any up to half way to the last.
MIN_ANGLE, GOOD_ANGLE, MAX_ANGLE = math.radians(3), math.radians(12), math.radians(60)
# Photos that a point is seen from as reference, one after the other, and the least angle between them; no other one is
# tried where it and as many as count confirm the point.
REFERENCES = CONFIRMING_PHOTOS
REFERENCE_ANGLE = math.radians(20)

_REFERENCE_COSINE = math.cos(REFERENCE_ANGLE)
_SIDE = 2 * RADIUS + 1
_SAMPLES = _SIDE * _SIDE


@njit(error_model="numpy")
def _suitability(angle):
    """How well a photo at an angle (radians) to the reference locates a point, 0..1."""
    if angle < MIN_ANGLE or angle > MAX_ANGLE:
        return 0.0
    half = 0.5 * MAX_ANGLE
    falling = 1.0 if angle < half else 1.0 - 0.8 * (angle - half) / half
    return min(angle / GOOD_ANGLE, 1.0) * falling


@njit(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _bilinear(pixels, start, width, px, py):
    """Grey value between the pixel (px, py) is in and the next ones; px, py inside, pixel centres whole numbers."""
    x0, y0 = int(px), int(py)
    fx, fy = np.float32(px - x0), np.float32(py - y0)
    at = start + y0 * width + x0
    upper = np.float32(pixels[at]) * (np.float32(1.0) - fx) + np.float32(pixels[at + 1]) * fx
    at += width
    lower = np.float32(pixels[at]) * (np.float32(1.0) - fx) + np.float32(pixels[at + 1]) * fx
    return upper * (np.float32(1.0) - fy) + lower * fy


@njit(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _sample(pixels, start, width, height, x, y):
    """Bilinear grey value at (x, y), pixel centres at +0.5; negative outside the photo."""
    px, py = x - 0.5, y - 0.5
    if not (px >= 0.0 and py >= 0.0 and px < width - 1.0 and py < height - 1.0):
        return np.float32(-1.0)
    return _bilinear(pixels, start, width, px, py)


@njit(error_model="numpy")
def _cosine(point, first, second):
    """Cosine of the angle at a point between two centres; written out, since arrays here would be allocated."""
    ax, ay, az = point[0] - first[0], point[1] - first[1], point[2] - first[2]
    bx, by, bz = point[0] - second[0], point[1] - second[1], point[2] - second[2]
    return (ax * bx + ay * by + az * bz) / math.sqrt((ax * ax + ay * ay + az * az) * (bx * bx + by * by + bz * bz))


@njit(error_model="numpy")
def _photos_of(point, normal, projections, centres, focals, sizes, quality, cosine):
    """Quality (V,) of the photos for one point, cosine over footprint, 0 where it is not seen; and that cosine (V,)."""
    for v in range(len(focals)):
        quality[v] = 0.0
        p = projections[v]
        z = p[2, 0] * point[0] + p[2, 1] * point[1] + p[2, 2] * point[2] + p[2, 3]
        if z <= 0.0:
            continue
        x = (p[0, 0] * point[0] + p[0, 1] * point[1] + p[0, 2] * point[2] + p[0, 3]) / z
        y = (p[1, 0] * point[0] + p[1, 1] * point[1] + p[1, 2] * point[2] + p[1, 3]) / z
        if x < RADIUS + 1 or y < RADIUS + 1 or x > sizes[v, 0] - RADIUS - 1 or y > sizes[v, 1] - RADIUS - 1:
            continue
        tx, ty, tz = centres[v, 0] - point[0], centres[v, 1] - point[1], centres[v, 2] - point[2]
        along = normal[0] * tx + normal[1] * ty + normal[2] * tz
        cosine[v] = along / math.sqrt(tx * tx + ty * ty + tz * tz)
        if cosine[v] < MIN_COSINE:
            continue
        quality[v] = cosine[v] * focals[v] / z


@njit(error_model="numpy")
def _choose(point, reference, centres, quality, chosen, angles, worth):
    """Put the photos that locate the point best beside the reference into chosen (OTHERS,); returns their number."""
    count = 0
    for v in range(len(quality)):
        if quality[v] <= 0.0 or v == reference:
            continue
        angle = math.acos(min(max(_cosine(point, centres[reference], centres[v]), -1.0), 1.0))
        value = quality[v] * _suitability(angle)
        if value <= 0.0 or (count == OTHERS and value <= worth[OTHERS - 1]):
            continue
        k = min(count, OTHERS - 1)
        while k > 0 and worth[k - 1] < value:
            worth[k], chosen[k], angles[k] = worth[k - 1], chosen[k - 1], angles[k - 1]
            k -= 1
        worth[k], chosen[k], angles[k] = value, v, angle
        count = min(count + 1, OTHERS)
    return count


@njit(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _reference_patch(pixels, start, width, height, p, point, across, down, patch, weight):
    """The reference's samples and weights (SAMPLES,); their weighted mean and variance, -1 outside the photo."""
    k = 0
    for b in range(-RADIUS, RADIUS + 1):
        for a in range(-RADIUS, RADIUS + 1):
            qx = point[0] + a * across[0] + b * down[0]
            qy = point[1] + a * across[1] + b * down[1]
            qz = point[2] + a * across[2] + b * down[2]
            z = p[2, 0] * qx + p[2, 1] * qy + p[2, 2] * qz + p[2, 3]
            x = (p[0, 0] * qx + p[0, 1] * qy + p[0, 2] * qz + p[0, 3]) / z
            y = (p[1, 0] * qx + p[1, 1] * qy + p[1, 2] * qz + p[1, 3]) / z
            patch[k] = _sample(pixels, start, width, height, x, y)
            if patch[k] < 0:
                return 0.0, -1.0
            k += 1
    middle = patch[_SAMPLES // 2]
    total = mean = 0.0
    for k in range(_SAMPLES):
        a, b = k % _SIDE - RADIUS, k // _SIDE - RADIUS
        grey = (patch[k] - middle) / GREY_FALL
        weight[k] = math.exp(-0.5 * (a * a + b * b) / (RADIUS * RADIUS) - 0.5 * grey * grey)
        total += weight[k]
        mean += weight[k] * patch[k]
    mean /= total
    variance = 0.0
    for k in range(_SAMPLES):
        weight[k] /= total
        variance += weight[k] * (patch[k] - mean) ** 2
    return mean, variance


@njit(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _correlate(patch, weight, mean, variance, other):
    """Weighted normalised cross-correlation of a patch with another photo's samples, and the variance of these."""
    theirs = both = square = 0.0
    for k in range(_SAMPLES):
        theirs += weight[k] * other[k]
    for k in range(_SAMPLES):
        difference = other[k] - theirs
        both += weight[k] * (patch[k] - mean) * difference
        square += weight[k] * difference * difference
    # The noise of both photos keeps patches without texture from matching.
    return both / math.sqrt((variance + NOISE * NOISE) * (square + NOISE * NOISE)), square


@njit(error_model="numpy")
def _turned(p, x, y, z):
    """A vector in the homogeneous pixels of a camera p (3, 4)."""
    return (
        p[0, 0] * x + p[0, 1] * y + p[0, 2] * z,
        p[1, 0] * x + p[1, 1] * y + p[1, 2] * z,
        p[2, 0] * x + p[2, 1] * y + p[2, 2] * z,
    )


@njit(error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
def _match(
    pixels, start, width, height, p, centre, point, across, down, step, patch, weight, mean, variance, samples, ncc
):
    """Scores ncc (STEPS,) of one photo for the patch at all offsets along the reference's ray; -1 outside it.

    Returns how much the photo's samples change with the offset, as information on it: 1 / variance, the square of a
    step being the unit.
    """
    # A patch moved along the ray is scaled about the reference's centre, which leaves it as it is in the reference.
    cx, cy, cz = centre
    rx, ry, rz = point[0] - cx, point[1] - cy, point[2] - cz
    base_x = p[0, 0] * cx + p[0, 1] * cy + p[0, 2] * cz + p[0, 3]
    base_y = p[1, 0] * cx + p[1, 1] * cy + p[1, 2] * cz + p[1, 3]
    base_z = p[2, 0] * cx + p[2, 1] * cy + p[2, 2] * cz + p[2, 3]
    ray_x, ray_y, ray_z = _turned(p, rx, ry, rz)
    across_x, across_y, across_z = _turned(p, across[0], across[1], across[2])
    down_x, down_y, down_z = _turned(p, down[0], down[1], down[2])
    # Middle of the outermost pixel, and a little more: the corners are compared before the division, rounded otherwise.
    spread, least = 0.0, 0.5001
    for j in range(len(ncc)):
        scale = 1.0 + (j - OFFSETS) * step
        mx, my, mz = base_x + scale * ray_x, base_y + scale * ray_y, base_z + scale * ray_z
        ax, ay, az = scale * across_x, scale * across_y, scale * across_z
        bx, by, bz = scale * down_x, scale * down_y, scale * down_z
        # A plane patch is a convex quadrilateral in a photo: where its corners are inside, all of it is.
        inside = True
        for corner in range(4):
            a, b = RADIUS * (2 * (corner & 1) - 1), RADIUS * ((corner & 2) - 1)
            z = mz + a * az + b * bz
            x, y = mx + a * ax + b * bx, my + a * ay + b * by
            inside &= z > 0.0 and min(x, y) > least * z and x < (width - least) * z and y < (height - least) * z
        ncc[j] = -1.0
        if inside:
            for k in range(_SAMPLES):
                a, b = k % _SIDE - RADIUS, k // _SIDE - RADIUS
                nearness = 1.0 / (mz + a * az + b * bz)
                px = (mx + a * ax + b * bx) * nearness - 0.5
                py = (my + a * ay + b * by) * nearness - 0.5
                samples[j, k] = _bilinear(pixels, start, width, px, py)
            ncc[j], square = _correlate(patch, weight, mean, variance, samples[j])
            if j == OFFSETS:
                spread = square
    if ncc[OFFSETS] <= 0.0 or ncc[OFFSETS - 1] == -1.0 or ncc[OFFSETS + 1] == -1.0:
        return 0.0
    slope = squares = middle = 0.0
    for k in range(_SAMPLES):
        middle += weight[k] * 0.5 * (samples[OFFSETS + 1, k] - samples[OFFSETS - 1, k])
    for k in range(_SAMPLES):
        change = 0.5 * (samples[OFFSETS + 1, k] - samples[OFFSETS - 1, k]) - middle
        slope += weight[k] * change * change
        squares += weight[k] * weight[k]
    residual = spread * (1.0 - ncc[OFFSETS] ** 2) + NOISE * NOISE
    return slope / (squares * residual)


@njit(error_model="numpy")
def _next_reference(point, centres, quality, tried, count):
    """The best photo that looks from more than REFERENCE_ANGLE from all that were tried, or -1."""
    best = -1
    for v in range(len(quality)):
        if quality[v] <= 0.0 or (best >= 0 and quality[v] <= quality[best]):
            continue
        apart = True
        for k in range(count):
            apart &= _cosine(point, centres[v], centres[tried[k]]) < _REFERENCE_COSINE
        if apart:
            best = v
    return best


@njit(error_model="numpy")
def _axes(normal, right, length):
    """Vectors (3,) of this length in a patch: along the photo's rows as far as the normal lets them be, and down."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    along = right[0] * nx + right[1] * ny + right[2] * nz
    ax, ay, az = right[0] - along * nx, right[1] - along * ny, right[2] - along * nz
    scale = length / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * scale, ay * scale, az * scale
    return (ax, ay, az), (ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax)


@njit(error_model="numpy")
def _sort(values, count):
    """Sort the first few values, the largest first."""
    for k in range(1, count):
        value = values[k]
        while k > 0 and values[k - 1] < value:
            values[k] = values[k - 1]
            k -= 1
        values[k] = value


# Sums and sorting of a few numbers are written out: what NumPy has for arrays takes Numba twice as long to compile.
@njit(error_model="numpy")
def _match_block(
    first, last, points, normals, pixels, starts, sizes, projections, centres, rights, focals,
    curve, spread, tested, confirming, texture, step_length, min_match, slack,
):  # fmt: skip
    """`match_points` of the points from `first` to before `last`."""
    views = len(focals)
    quality, cosine = np.zeros(views), np.zeros(views)
    chosen, angles, tried = np.zeros(OTHERS, np.int64), np.zeros(OTHERS), np.zeros(REFERENCES, np.int64)
    patch, weight = np.zeros(_SAMPLES, np.float32), np.zeros(_SAMPLES, np.float32)
    samples, ncc = np.zeros((curve.shape[1], _SAMPLES), np.float32), np.zeros((OTHERS, curve.shape[1]))
    information, few, worth = np.zeros(OTHERS), np.zeros(OTHERS), np.zeros(OTHERS)
    for i in range(first, last):
        curve[i], spread[i], tested[i], confirming[i], texture[i], step_length[i] = -1.0, np.inf, 0, 0, 0.0, 0.0
        point, normal = points[i], normals[i]
        _photos_of(point, normal, projections, centres, focals, sizes, quality, cosine)
        for attempt in range(REFERENCES):
            ref = _next_reference(point, centres, quality, tried, attempt)
            if ref < 0 or confirming[i] > CONFIRMING_PHOTOS:
                break
            tried[attempt] = ref
            others = _choose(point, ref, centres, quality, chosen, angles, worth)
            if others < 2:
                continue
            footprint = cosine[ref] / quality[ref]
            across, down = _axes(normal, rights[ref], footprint)
            mean, variance = _reference_patch(
                pixels, starts[ref], sizes[ref, 0], sizes[ref, 1], projections[ref], point, across, down, patch,
                weight,
            )  # fmt: skip
            if variance < 0:
                continue
            ray_x, ray_y, ray_z = point[0] - centres[ref, 0], point[1] - centres[ref, 1], point[2] - centres[ref, 2]
            distance = math.sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z)
            for k in range(others):
                few[k] = angles[k]
            _sort(few, others)
            step = footprint / math.sin(0.5 * (few[(others - 1) // 2] + few[others // 2]))
            seen, agreeing, known = 0, 0, 0.0
            for k in range(others):
                v = chosen[k]
                information[k] = _match(
                    pixels, starts[v], sizes[v, 0], sizes[v, 1], projections[v], centres[ref], point, across, down,
                    step / distance, patch, weight, mean, variance, samples, ncc[k],
                )  # fmt: skip
                seen += ncc[k, OFFSETS] > -1.0
                if ncc[k, OFFSETS] >= min_match and ncc[k, OFFSETS] >= ncc[k].max() - slack:
                    agreeing += 1
                    known += information[k]
            if seen < 2 or (tested[i] > 0 and agreeing + 1 <= confirming[i]):
                continue
            tested[i], texture[i], step_length[i] = seen, math.sqrt(variance), step
            for j in range(curve.shape[1]):
                for k in range(others):
                    few[k] = ncc[k, j]
                _sort(few, others)
                best = min(CONFIRMING_PHOTOS, seen)
                total = 0.0
                for k in range(best):
                    total += few[k]
                curve[i, j] = total / best
            if agreeing > 0:
                confirming[i] = agreeing + 1
                spread[i] = step / math.sqrt(known) if known > 0 else np.inf


@njit(parallel=True, cache=True, error_model="numpy")
def match_points(  # type: ignore[no-untyped-def]
    points, normals, pixels, starts, sizes, projections, centres, rights, focals,
    curve, spread, tested, confirming, texture, step_length, min_match, slack,
):  # fmt: skip
    """Match a patch around each point between the photos that see it, there and at offsets along the ray.

    The sharpest photo is the reference; where fewer than three photos confirm a point, others from elsewhere are tried,
    since a point may be hidden in one. The reference with the most photos that confirm counts, of equal ones the first.

    points, normals (N, 3) float64; pixels (sum of W x H,) uint8 of V photos, one behind the other from starts (V,);
    sizes (V, 2) width and height; projections (V, 3, 4), centres (V, 3), rights (V, 3) x axes of cameras, focals (V,);
    min_match, slack: a photo confirms a point where its score is at
    least the first, and no more than the second below its best one. Written: curve (N, STEPS) mean score of the best
    photos at each offset, -1 where there are none; spread (N,) standard deviation along the ray in the points' unit,
    infinite where nothing confirms; tested (N,) photos compared with the reference; confirming (N,) photos that
    confirm, with the reference; texture (N,) standard deviation of the reference's patch in grey levels; step_length
    (N,) of an offset.
    """
    count = len(points)
    together = 64  # points
    for block in prange((count + together - 1) // together):
        _match_block(
            block * together, min((block + 1) * together, count), points, normals, pixels, starts, sizes, projections,
            centres, rights, focals, curve, spread, tested, confirming, texture, step_length, min_match, slack,
        )  # fmt: skip
