"""CPU kernels in Numba for the hash grid, ray marching and compositing.

Each one has a plain PyTorch twin beside its caller, which tests compare against and which runs on other devices or
where Numba is not installed. Loops are arranged so that no two threads write to one place: results do not depend on
the number of threads.
"""

from typing import Any

import numpy as np

nb: Any = None
prange: Any = range
try:
    import numba as nb
    from numba import prange
except ImportError:  # the PyTorch twins do the work
    pass
else:
    # Numba's OpenMP layer would change the thread count of the OpenMP that PyTorch uses.
    nb.config.THREADING_LAYER = "workqueue"

AVAILABLE = nb is not None
PRIMES = (1, 2654435761, 805459861)
BLOCK = 2048
ONE = np.float32(1.0)
HALF = np.float32(0.5)
THIRD = np.float32(1.0 / 3.0)
PY, PZ = np.uint32(PRIMES[1]), np.uint32(PRIMES[2])


def _jit(function):  # type: ignore[no-untyped-def]
    if nb is None:
        return function
    return nb.njit(parallel=True, fastmath=True, cache=True)(function)


def set_threads(count: int) -> None:
    """Use `count` threads for every kernel."""
    if nb is not None:
        nb.set_num_threads(max(1, min(count, nb.config.NUMBA_NUM_THREADS)))


@_jit
def encode(x, table, resolution, stride, offset, mask, level_weight, out):
    """Trilinear hash encoding (Mueller et al. 2022, section 3).

    x (N, 3) in 0..1; table (T, 2); per level: resolution, stride (0: hashed), offset into the table, index mask,
    weight; out (N, 2 L).
    """
    count = x.shape[0]
    blocks = (count + BLOCK - 1) // BLOCK
    for block in prange(blocks):
        first, last = block * BLOCK, min((block + 1) * BLOCK, count)
        for level in range(resolution.shape[0]):
            weight = level_weight[level]
            if weight == np.float32(0.0):
                for n in range(first, last):
                    out[n, 2 * level] = np.float32(0.0)
                    out[n, 2 * level + 1] = np.float32(0.0)
                continue
            size, step, start, bits = resolution[level], stride[level], offset[level], mask[level]
            for n in range(first, last):
                px, py, pz = x[n, 0] * size, x[n, 1] * size, x[n, 2] * size
                ix, iy, iz = np.uint32(px), np.uint32(py), np.uint32(pz)
                fx, fy, fz = px - np.float32(ix), py - np.float32(iy), pz - np.float32(iz)
                a, b = np.float32(0.0), np.float32(0.0)
                for k in range(8):
                    dx, dy, dz = np.uint32(k & 1), np.uint32((k >> 1) & 1), np.uint32(k >> 2)
                    if step > 0:
                        index = (ix + dx) + step * ((iy + dy) + step * (iz + dz))
                    else:
                        index = ((ix + dx) ^ ((iy + dy) * PY) ^ ((iz + dz) * PZ)) & bits
                    row = start + np.int64(index)
                    w = (fx if dx else ONE - fx) * (fy if dy else ONE - fy) * (fz if dz else ONE - fz)
                    a += w * table[row, 0]
                    b += w * table[row, 1]
                out[n, 2 * level] = weight * a
                out[n, 2 * level + 1] = weight * b


@_jit
def encode_backward(x, gradient, resolution, stride, offset, mask, level_weight, boost, fine_from, out):
    """Gradient of `encode` with respect to the table, added to out (T, 2): one thread owns a level.

    gradient (N, 2 L); boost (N,) multiplies a sample's gradient on levels >= fine_from.
    """
    for level in prange(resolution.shape[0]):
        weight = level_weight[level]
        if weight > np.float32(0.0):
            size, step, start, bits = resolution[level], stride[level], offset[level], mask[level]
            for n in range(x.shape[0]):
                scale = weight * boost[n] if level >= fine_from else weight
                ga, gb = scale * gradient[n, 2 * level], scale * gradient[n, 2 * level + 1]
                if ga == np.float32(0.0) and gb == np.float32(0.0):
                    continue
                px, py, pz = x[n, 0] * size, x[n, 1] * size, x[n, 2] * size
                ix, iy, iz = np.uint32(px), np.uint32(py), np.uint32(pz)
                fx, fy, fz = px - np.float32(ix), py - np.float32(iy), pz - np.float32(iz)
                for k in range(8):
                    dx, dy, dz = np.uint32(k & 1), np.uint32((k >> 1) & 1), np.uint32(k >> 2)
                    if step > 0:
                        index = (ix + dx) + step * ((iy + dy) + step * (iz + dz))
                    else:
                        index = ((ix + dx) ^ ((iy + dy) * PY) ^ ((iz + dz) * PZ)) & bits
                    row = start + np.int64(index)
                    w = (fx if dx else ONE - fx) * (fy if dy else ONE - fy) * (fz if dz else ONE - fz)
                    out[row, 0] += w * ga
                    out[row, 1] += w * gb


@_jit
def encode_backward_x(x, gradient, table, resolution, stride, offset, mask, level_weight, out):
    """Gradient of `encode` with respect to the positions, written to out (N, 3)."""
    for n in prange(x.shape[0]):
        sx, sy, sz = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for level in range(resolution.shape[0]):
            weight = level_weight[level]
            if weight == np.float32(0.0):
                continue
            size, step, start, bits = resolution[level], stride[level], offset[level], mask[level]
            ga, gb = weight * gradient[n, 2 * level], weight * gradient[n, 2 * level + 1]
            px, py, pz = x[n, 0] * size, x[n, 1] * size, x[n, 2] * size
            ix, iy, iz = np.uint32(px), np.uint32(py), np.uint32(pz)
            fx, fy, fz = px - np.float32(ix), py - np.float32(iy), pz - np.float32(iz)
            for k in range(8):
                dx, dy, dz = np.uint32(k & 1), np.uint32((k >> 1) & 1), np.uint32(k >> 2)
                if step > 0:
                    index = (ix + dx) + step * ((iy + dy) + step * (iz + dz))
                else:
                    index = ((ix + dx) ^ ((iy + dy) * PY) ^ ((iz + dz) * PZ)) & bits
                row = start + np.int64(index)
                value = (ga * table[row, 0] + gb * table[row, 1]) * size
                wx, wy, wz = fx if dx else ONE - fx, fy if dy else ONE - fy, fz if dz else ONE - fz
                sx += value * wy * wz * (ONE if dx else -ONE)
                sy += value * wx * wz * (ONE if dy else -ONE)
                sz += value * wx * wy * (ONE if dz else -ONE)
        out[n, 0], out[n, 1], out[n, 2] = sx, sy, sz


@_jit
def march(
    origin,
    direction,
    occupied,
    density,
    step,
    jitter,
    uniform_share,
    prior,
    prior_width,
    prior_share,
    out_t,
    out_delta,
    out_hit,
):
    """Importance samples along rays through an occupancy grid.

    A ray is cut into intervals of length `step` inside the unit cube; only those in occupied cells count. Their
    probability mass mixes a uniform part, the compositing weights of the grid's cached density, and the intervals
    near a depth prior; S equal shares of the mass give one sample each. Lengths are lengths of occupied ray.

    origin, direction (R, 3); occupied, density (G, G, G); jitter (R, S) in 0..1; prior, prior_width,
    prior_share (R,); out_t, out_delta (R, S), out_hit (R,) uint8.
    """
    grid = occupied.shape[0]
    scale = np.float32(grid)
    samples = jitter.shape[1]
    blocks = (origin.shape[0] + 63) // 64
    longest = int(np.float32(1.7320508) / step) + 3
    for block in prange(blocks):
        start = np.empty(longest, np.float32)
        raw = np.empty(longest, np.float32)
        near = np.empty(longest, np.uint8)
        for r in range(block * 64, min((block + 1) * 64, origin.shape[0])):
            low, high = np.float32(0.0), np.float32(1e9)
            for k in range(3):
                o, d = origin[r, k], direction[r, k]
                if abs(d) < np.float32(1e-9):
                    if o < np.float32(0.0) or o > ONE:
                        high = np.float32(-1.0)
                else:
                    a, b = (np.float32(0.0) - o) / d, (ONE - o) / d
                    low, high = max(low, min(a, b)), min(high, max(a, b))
            out_hit[r] = 0
            if high <= low:
                continue
            used = 0
            transmittance = ONE
            total = np.float32(0.0)
            near_count = 0
            count = min(int(np.ceil((high - low) / step)), longest - 1)
            for i in range(count):
                t = low + (np.float32(i) + HALF) * step
                ix = min(max(int((origin[r, 0] + t * direction[r, 0]) * scale), 0), grid - 1)
                iy = min(max(int((origin[r, 1] + t * direction[r, 1]) * scale), 0), grid - 1)
                iz = min(max(int((origin[r, 2] + t * direction[r, 2]) * scale), 0), grid - 1)
                if occupied[ix, iy, iz] == 0:
                    continue
                alpha = ONE - np.exp(-density[ix, iy, iz] * step)
                start[used] = t - HALF * step
                raw[used] = transmittance * alpha
                total += raw[used]
                transmittance *= ONE - alpha
                close = abs(t - prior[r]) <= prior_width[r]
                near[used] = 1 if close else 0
                near_count += 1 if close else 0
                used += 1
            if used == 0:
                continue
            out_hit[r] = 1
            share_prior = prior_share[r] if near_count > 0 else np.float32(0.0)
            share_uniform = uniform_share * (ONE - share_prior)
            share_weight = (ONE - share_prior) - share_uniform
            if total < np.float32(1e-4):
                share_uniform += share_weight
                share_weight = np.float32(0.0)
            blurred = np.float32(0.0)
            for i in range(used):
                blurred += max(raw[i], max(raw[max(i - 1, 0)], raw[min(i + 1, used - 1)]))
            blurred = max(blurred, np.float32(1e-12))
            k = -1
            before, after = np.float32(0.0), np.float32(0.0)
            edge = np.float32(0.0)
            for s in range(samples):
                goal = np.float32(s + 1) / np.float32(samples)
                while k < used - 1 and (k < 0 or after < goal):
                    k += 1
                    before = after
                    peak = max(raw[k], max(raw[max(k - 1, 0)], raw[min(k + 1, used - 1)]))
                    mass = share_uniform / np.float32(used) + share_weight * peak / blurred
                    if near[k] == 1:
                        mass += share_prior / np.float32(near_count)
                    after = before + mass
                inside = (goal - before) / max(after - before, np.float32(1e-12))
                end = np.float32(k) + min(max(inside, np.float32(0.0)), ONE)
                if s == samples - 1:
                    end = np.float32(used)
                end = max(end, edge)
                middle = edge + (end - edge) * jitter[r, s]
                cell = min(int(middle), used - 1)
                out_t[r, s] = start[cell] + (middle - np.float32(cell)) * step
                out_delta[r, s] = (end - edge) * step
                edge = end


@_jit
def composite(sigma, rgb, t, delta, weights, color, opacity, depth, distortion):
    """Volume rendering of (R, S) samples: weights, colour (R, 3), opacity, sum of w t, and distortion (R,).

    The distortion is Mip-NeRF 360's (Barron et al. 2022, equation 15) with distances in ray units.
    """
    samples = sigma.shape[1]
    for r in prange(sigma.shape[0]):
        transmittance = ONE
        red, green, blue = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        mass, moment, spread = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for s in range(samples):
            alpha = ONE - np.exp(-sigma[r, s] * delta[r, s])
            w = transmittance * alpha
            transmittance *= ONE - alpha
            weights[r, s] = w
            red += w * rgb[r, s, 0]
            green += w * rgb[r, s, 1]
            blue += w * rgb[r, s, 2]
            spread += np.float32(2.0) * w * (t[r, s] * mass - moment) + THIRD * w * w * delta[r, s]
            mass += w
            moment += w * t[r, s]
        color[r, 0], color[r, 1], color[r, 2] = red, green, blue
        opacity[r], depth[r], distortion[r] = mass, moment, spread


@_jit
def composite_backward(sigma, rgb, t, delta, weights, g_color, g_opacity, g_depth, g_distortion, g_sigma, g_rgb):
    """Gradients of `composite` with respect to sigma (R, S) and rgb (R, S, 3)."""
    samples = sigma.shape[1]
    two = np.float32(2.0)
    for r in prange(sigma.shape[0]):
        mass, moment, tau = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for s in range(samples):
            mass += weights[r, s]
            moment += weights[r, s] * t[r, s]
            tau += sigma[r, s] * delta[r, s]
        behind, mass_behind, moment_behind = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for reverse in range(samples):
            s = samples - 1 - reverse
            w, z = weights[r, s], t[r, s]
            mass_before = mass - mass_behind - w
            moment_before = moment - moment_behind - w * z
            pull = z * (mass_before - mass_behind) - (moment_before - moment_behind)
            g = (
                g_color[r, 0] * rgb[r, s, 0]
                + g_color[r, 1] * rgb[r, s, 1]
                + g_color[r, 2] * rgb[r, s, 2]
                + g_opacity[r]
                + g_depth[r] * z
                + g_distortion[r] * two * (pull + THIRD * w * delta[r, s])
            )
            after = np.exp(-tau)
            g_sigma[r, s] = delta[r, s] * (after * g - behind)
            behind += w * g
            mass_behind += w
            moment_behind += w * z
            tau -= sigma[r, s] * delta[r, s]
            g_rgb[r, s, 0], g_rgb[r, s, 1], g_rgb[r, s, 2] = w * g_color[r, 0], w * g_color[r, 1], w * g_color[r, 2]
