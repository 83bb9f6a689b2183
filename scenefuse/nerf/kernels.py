"""CPU kernels in Numba for the hash grid and ray marching.

Each one has a plain PyTorch twin beside its caller, which tests compare against and which runs on other devices.
Loops are arranged so that no two threads write to one place: results do not depend on the number of threads. Rows of
large levels are fetched ahead of their use, since the processor cannot guess them.
"""

import numba as nb
import numpy as np
from llvmlite import ir
from numba import prange
from numba.extending import intrinsic

# Those of the hash along y and z; along x it takes the vertex itself.
PRIMES = (2654435761, 805459861)
PY, PZ = map(np.uint32, PRIMES)
f32 = np.float32
# Sum of compositing weights below which the grid knows no surface on a ray.
MIN_KNOWN_WEIGHT = f32(1e-4)
_jit = nb.njit(parallel=True, fastmath=True, cache=True)
_inline = nb.njit(fastmath=True, inline="always")


def encode(x, table, levels, out):  # type: ignore[no-untyped-def]
    """Trilinear hash encoding (Mueller et al. 2022, section 3).

    x (N, 3) in 0..1; table (T, 2); levels: resolution, stride (0: hashed), offset into the table, index mask, weight,
    each (L,); out (N, 2 L).
    """
    _encode(nb.get_num_threads(), x, table, levels, out)


def encode_backward(x, gradient, levels, out):  # type: ignore[no-untyped-def]
    """Gradient (N, 2 L) of `encode` with respect to the table, written to out (T, 2)."""
    _encode_backward(nb.get_num_threads(), x, gradient, levels, out)


@_inline
def _cell(position, size):
    """Lower vertex of the cell and place in it, along one axis."""
    scaled = position * size
    low = np.int32(scaled)
    return np.uint32(low), scaled - f32(low)


@_inline
def _rows(ix, iy, iz, stride, start, mask):
    """Table rows of a cell's eight vertices, x fastest: dense with a stride, hashed without (equation 4)."""
    jx = ix + np.uint32(1)
    if stride > 0:
        y0, z0 = iy * stride, start + iz * stride * stride
        y1, z1 = y0 + stride, z0 + stride * stride
        a, b, c, d = y0 + z0, y1 + z0, y0 + z1, y1 + z1
        return ix + a, jx + a, ix + b, jx + b, ix + c, jx + c, ix + d, jx + d
    y0, z0 = iy * PY, iz * PZ
    y1, z1 = y0 + PY, z0 + PZ
    a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    return (
        start + ((ix ^ a) & mask), start + ((jx ^ a) & mask), start + ((ix ^ b) & mask), start + ((jx ^ b) & mask),
        start + ((ix ^ c) & mask), start + ((jx ^ c) & mask), start + ((ix ^ d) & mask), start + ((jx ^ d) & mask),
    )  # fmt: skip


@intrinsic
def _prefetch(typing, array, row):  # type: ignore[no-untyped-def]
    """Ask the processor for a row of an array (T, 2), and do not wait."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        table = context.make_array(signature.args[0])(context, builder, arguments[0])
        place = builder.gep(table.data, [builder.shl(builder.zext(arguments[1], ir.IntType(64)), ir.IntType(64)(1))])
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        # To read, to be kept in all caches, data.
        flags = number(0), number(3), number(1)
        fetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(fetch, [builder.bitcast(place, byte), *flags])
        return context.get_dummy_value()

    return nb.void(array, row), generate


@_inline
def _is_far(stride, mask):
    """Whether a level has too many rows for a core's cache, a MiB and more."""
    return (stride * stride * stride if stride > 0 else mask) >= 1 << 17


@_inline
def _fetch(table, x, n, last, size, stride, start, mask):
    """Ask for the rows that a sample a few after the n-th will need, the last one at most."""
    position = x[min(n + 16, last - 1)]
    ix, _ = _cell(position[0], size)
    iy, _ = _cell(position[1], size)
    iz, _ = _cell(position[2], size)
    r0, r1, r2, r3, r4, r5, r6, r7 = _rows(ix, iy, iz, stride, start, mask)
    _prefetch(table, r0)  # type: ignore[call-arg]
    _prefetch(table, r1)
    _prefetch(table, r2)
    _prefetch(table, r3)
    _prefetch(table, r4)
    _prefetch(table, r5)
    _prefetch(table, r6)
    _prefetch(table, r7)


@_jit
def _encode(threads, x, table, levels, out):
    """A thread goes through all of its samples level by level, so that one level's rows stay in its cache."""
    resolution, stride, offset, mask, level_weight = levels
    count = x.shape[0]
    for thread in prange(threads):
        first, last = count * thread // threads, count * (thread + 1) // threads
        for level in range(resolution.shape[0]):
            weight = level_weight[level]
            if weight == f32(0):
                for n in range(first, last):
                    out[n, 2 * level] = f32(0)
                    out[n, 2 * level + 1] = f32(0)
                continue
            size, step, start, bits = resolution[level], stride[level], offset[level], mask[level]
            far = _is_far(step, bits)
            for n in range(first, last):
                if far:
                    _fetch(table, x, n, last, size, step, start, bits)
                ix, fx = _cell(x[n, 0], size)
                iy, fy = _cell(x[n, 1], size)
                iz, fz = _cell(x[n, 2], size)
                r0, r1, r2, r3, r4, r5, r6, r7 = _rows(ix, iy, iz, step, start, bits)
                gx, gy, gz = f32(1) - fx, f32(1) - fy, f32(1) - fz
                a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
                out[n, 2 * level] = weight * (
                    a * (gx * table[r0, 0] + fx * table[r1, 0]) + b * (gx * table[r2, 0] + fx * table[r3, 0])
                    + c * (gx * table[r4, 0] + fx * table[r5, 0]) + d * (gx * table[r6, 0] + fx * table[r7, 0])
                )  # fmt: skip
                out[n, 2 * level + 1] = weight * (
                    a * (gx * table[r0, 1] + fx * table[r1, 1]) + b * (gx * table[r2, 1] + fx * table[r3, 1])
                    + c * (gx * table[r4, 1] + fx * table[r5, 1]) + d * (gx * table[r6, 1] + fx * table[r7, 1])
                )  # fmt: skip


@_inline
def _add(out, row, weight, a, b):
    out[row, 0] += weight * a
    out[row, 1] += weight * b


@_jit
def _encode_backward(threads, x, gradient, levels, out):
    """One thread owns a level, and sets it to zero just before adding to it: its rows are still in the cache then."""
    resolution, stride, offset, mask, level_weight = levels
    last_level = resolution.shape[0] - 1
    for thread in prange(threads):
        # Fine levels cost more than coarse ones: every thread gets some of both.
        for level in range(thread, last_level + 1, threads):
            weight = level_weight[level]
            out[offset[level] : offset[level + 1] if level < last_level else out.shape[0]] = f32(0)
            if weight == f32(0):
                continue
            size, step, start, bits = resolution[level], stride[level], offset[level], mask[level]
            far = _is_far(step, bits)
            for n in range(x.shape[0]):
                if far:
                    _fetch(out, x, n, x.shape[0], size, step, start, bits)
                ga, gb = weight * gradient[n, 2 * level], weight * gradient[n, 2 * level + 1]
                if ga == f32(0) and gb == f32(0):
                    continue
                ix, fx = _cell(x[n, 0], size)
                iy, fy = _cell(x[n, 1], size)
                iz, fz = _cell(x[n, 2], size)
                r0, r1, r2, r3, r4, r5, r6, r7 = _rows(ix, iy, iz, step, start, bits)
                gx, gy, gz = f32(1) - fx, f32(1) - fy, f32(1) - fz
                a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
                _add(out, r0, gx * a, ga, gb)
                _add(out, r1, fx * a, ga, gb)
                _add(out, r2, gx * b, ga, gb)
                _add(out, r3, fx * b, ga, gb)
                _add(out, r4, gx * c, ga, gb)
                _add(out, r5, fx * c, ga, gb)
                _add(out, r6, gx * d, ga, gb)
                _add(out, r7, fx * d, ga, gb)


@_inline
def _span(origin, direction, r):
    """Where ray r enters the unit cube and leaves it; it misses the cube where it leaves first."""
    low, high = f32(0), f32(1e9)
    for k in range(3):
        o, d = origin[r, k], direction[r, k]
        if abs(d) < f32(1e-9):
            if o < f32(0) or o > f32(1):
                high = -f32(1)
        else:
            a, b = (f32(0) - o) / d, (f32(1) - o) / d
            low, high = max(low, min(a, b)), min(high, max(a, b))
    return low, high


@_inline
def _index(origin, direction, t, scale, grid):
    """The cell of a grid, along one axis, at a distance along a ray."""
    return min(max(int((origin + t * direction) * scale), 0), grid - 1)


@_inline
def _peak(raw, k, used):
    """The largest of an interval's weight and its neighbours': densities are cached, surfaces move a little."""
    return max(raw[k], max(raw[max(k - 1, 0)], raw[min(k + 1, used - 1)]))


@_inline
def _shares(uniform, prior, near_count, total):
    """Shares of the samples: spread evenly, by the grid's weights, near the prior. They add up to one."""
    share_prior = prior if near_count > 0 else f32(0)
    share_uniform = uniform * (f32(1) - share_prior)
    share_weight = (f32(1) - share_prior) - share_uniform
    if total < MIN_KNOWN_WEIGHT:
        share_uniform += share_weight
        share_weight = f32(0)
    return share_uniform, share_weight, share_prior


@_inline
def _walk(ray, span, occupancy, expected, width, buffers):
    """Fill the beginnings, weights and nearness to the prior of the intervals of a ray that lie in cells of the hull.

    ray (6,): origin and direction; span: where it enters and leaves; occupancy as in `march`; expected, width: the
    prior; buffers: what is filled. Returns how many intervals there are, their total weight, how many are near.
    """
    low, high = span
    alpha, blocks_used, step = occupancy
    start, raw, near = buffers
    grid = alpha.shape[0]
    scale = f32(grid)
    ox, oy, oz, dx, dy, dz = ray
    used, near_count = 0, 0
    transmittance, total = f32(1), f32(0)
    for i in range(min(int(np.ceil((high - low) / step)), len(start) - 1)):
        t = low + (f32(i) + f32(0.5)) * step
        ix, iy, iz = _index(ox, dx, t, scale, grid), _index(oy, dy, t, scale, grid), _index(oz, dz, t, scale, grid)
        if blocks_used[ix >> 2, iy >> 2, iz >> 2] == 0:
            continue
        opacity = alpha[ix, iy, iz]
        if opacity < f32(0):
            continue
        start[used] = t - f32(0.5) * step
        raw[used] = transmittance * opacity
        total += raw[used]
        transmittance *= f32(1) - opacity
        close = abs(t - expected) <= width
        near[used] = 1 if close else 0
        near_count += 1 if close else 0
        used += 1
    return used, total, near_count


@_inline
def _place(r, jitter, shares, near_count, used, step, buffers, out):
    """Cut the mass of a ray's intervals into equal shares, and put a sample into each."""
    start, raw, near = buffers
    out_t, out_delta, _ = out
    share_uniform, share_weight, share_prior = shares
    samples = jitter.shape[1]
    blurred = f32(0)
    for i in range(used):
        blurred += _peak(raw, i, used)
    blurred = max(blurred, f32(1e-12))
    k = -1
    before, after, edge = f32(0), f32(0), f32(0)
    for s in range(samples):
        goal = f32(s + 1) / f32(samples)
        while k < used - 1 and (k < 0 or after < goal):
            k += 1
            before = after
            mass = share_uniform / f32(used) + share_weight * _peak(raw, k, used) / blurred
            if near[k] == 1:
                mass += share_prior / f32(near_count)
            after = before + mass
        inside = (goal - before) / max(after - before, f32(1e-12))
        end = f32(k) + min(max(inside, f32(0)), f32(1))
        if s == samples - 1:
            end = f32(used)
        end = max(end, edge)
        middle = edge + (end - edge) * jitter[r, s]
        cell = min(int(middle), used - 1)
        out_t[r, s] = start[cell] + (middle - f32(cell)) * step
        out_delta[r, s] = (end - edge) * step
        edge = end


# Without fast-math, which gave other last bits where it was just compiled than out of the cache.
@nb.njit(parallel=True, cache=True)
def march(rays, occupancy, jitter, uniform, prior, out):
    """Importance samples along rays through an occupancy grid.

    A ray is cut into intervals of length `step` inside the unit cube; only those in cells of the hull count. Their
    probability mass mixes a uniform part, the compositing weights of the grid's cached density, and the intervals
    near a depth prior; S equal shares of the mass give one sample each. Lengths are lengths of ray in the hull.

    rays: origin, direction (R, 3); occupancy: alpha (G, G, G), opacity of one interval, negative outside the hull,
    blocks_used (G / 4, G / 4, G / 4) uint8, whether any cell of the block is in the hull (it stays in the cache,
    most of the cube is empty), step; jitter (R, S) in 0..1; uniform: share of the samples spread evenly; prior:
    distance, width, share (R,); out: t, delta (R, S), hit (R,) uint8.
    """
    origin, direction = rays
    distance, width, share = prior
    step, out_hit = occupancy[2], out[2]
    longest = int(f32(1.7320508) / step) + 3
    rays_a_block = 64  # they share a thread's buffers
    for block in prange((origin.shape[0] + rays_a_block - 1) // rays_a_block):
        buffers = np.empty(longest, np.float32), np.empty(longest, np.float32), np.empty(longest, np.uint8)
        for r in range(block * rays_a_block, min((block + 1) * rays_a_block, origin.shape[0])):
            low, high = _span(origin, direction, r)
            out_hit[r] = 0
            if high <= low:
                continue
            ray = origin[r, 0], origin[r, 1], origin[r, 2], direction[r, 0], direction[r, 1], direction[r, 2]
            used, total, near_count = _walk(ray, (low, high), occupancy, distance[r], width[r], buffers)
            if used == 0:
                continue
            out_hit[r] = 1
            shares = _shares(uniform, share[r], near_count, total)
            _place(r, jitter, shares, near_count, used, step, buffers, out)
