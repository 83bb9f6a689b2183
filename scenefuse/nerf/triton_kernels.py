"""GPU kernels in Triton for the hash grid: the encoding functions of `kernels`, on CUDA tensors instead of arrays.

A program takes a block of samples on one level, a thread one sample with both features of its rows. Gradients are
added to the table atomically, so that two runs may differ in the last bits.
"""

import triton
import triton.language as tl

from scenefuse.nerf import kernels

PY, PZ = map(tl.constexpr, kernels.PRIMES)
# As many as there are threads: then both features are read, and their gradients added, by one instruction each.
BLOCK = 128


def encode(x, table, levels, out):  # type: ignore[no-untyped-def]
    """As `kernels.encode`."""
    count = len(levels[0])
    # Blocks of samples run fastest, so that one level's rows stay in the cache.
    _encode[triton.cdiv(len(x), BLOCK), count](x, table, *levels, out, len(x), count, BLOCK)


def encode_backward(x, gradient, levels, out):  # type: ignore[no-untyped-def]
    """As `kernels.encode_backward`."""
    count = len(levels[0])
    out.zero_()
    _encode_backward[triton.cdiv(len(x), BLOCK), count](x, gradient, *levels, out, len(x), count, BLOCK)


@triton.jit
def _samples(count, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Numbers of this program's samples, and which of them there are."""
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    return n, n < count


@triton.jit
def _level(resolution, stride, offset, mask, level_weight, level):  # type: ignore[no-untyped-def]
    sizes = tl.load(resolution + level), tl.load(stride + level), tl.load(offset + level), tl.load(mask + level)
    return sizes, tl.load(level_weight + level)


@triton.jit
def _cells(x, n, inside, size):  # type: ignore[no-untyped-def]
    """Lower vertices of the cells and places in them, along each axis."""
    sx = tl.load(x + 3 * n, mask=inside, other=0.0) * size
    sy = tl.load(x + 3 * n + 1, mask=inside, other=0.0) * size
    sz = tl.load(x + 3 * n + 2, mask=inside, other=0.0) * size
    ix, iy, iz = sx.to(tl.int32), sy.to(tl.int32), sz.to(tl.int32)
    place = sx - ix.to(tl.float32), sy - iy.to(tl.float32), sz - iz.to(tl.float32)
    return (ix.to(tl.uint32), iy.to(tl.uint32), iz.to(tl.uint32)), place


@triton.jit
def _rows(table, cells, sizes, corner: tl.constexpr):  # type: ignore[no-untyped-def]
    """Addresses (BLOCK, 2) of one vertex of the cells, x fastest: dense with a stride, hashed without (equation 4)."""
    jx, jy, jz = cells[0] + (corner & 1), cells[1] + (corner >> 1 & 1), cells[2] + (corner >> 2)
    stride = sizes[1]
    hashed = (jx ^ (jy * PY) ^ (jz * PZ)) & sizes[3]
    row = sizes[2] + tl.where(stride > 0, jx + stride * (jy + stride * jz), hashed)
    return table + 2 * row.to(tl.int64)[:, None] + tl.arange(0, 2)[None, :]


@triton.jit
def _weights(place, corner: tl.constexpr):  # type: ignore[no-untyped-def]
    """Trilinear weights of one vertex, along each axis."""
    wx = place[0] if corner & 1 else 1.0 - place[0]
    wy = place[1] if corner >> 1 & 1 else 1.0 - place[1]
    wz = place[2] if corner >> 2 else 1.0 - place[2]
    return wx, wy, wz


@triton.jit
def _features(of, n, level, LEVELS: tl.constexpr):  # type: ignore[no-untyped-def]
    """Addresses (BLOCK, 2) of the samples' two features on a level."""
    return of + (n * 2 * LEVELS + 2 * level)[:, None] + tl.arange(0, 2)[None, :]


@triton.jit
def _encode(
    x, table, resolution, stride, offset, mask, level_weight, out, count, LEVELS: tl.constexpr, BLOCK: tl.constexpr
):  # type: ignore[no-untyped-def]
    n, inside = _samples(count, BLOCK)
    level = tl.program_id(1)
    sizes, weight = _level(resolution, stride, offset, mask, level_weight, level)
    cells, place = _cells(x, n, inside, sizes[0])
    used = (n < tl.where(weight != 0.0, count, 0))[:, None]
    features = tl.zeros([BLOCK, 2], tl.float32)
    for corner in tl.static_range(8):
        wx, wy, wz = _weights(place, corner)
        features += (weight * wx * wy * wz)[:, None] * tl.load(_rows(table, cells, sizes, corner), mask=used, other=0.0)
    tl.store(_features(out, n, level, LEVELS), features, mask=inside[:, None])


@triton.jit
def _encode_backward(
    x, gradient, resolution, stride, offset, mask, level_weight, out, count, LEVELS: tl.constexpr, BLOCK: tl.constexpr
):  # type: ignore[no-untyped-def]
    n, inside = _samples(count, BLOCK)
    level = tl.program_id(1)
    sizes, weight = _level(resolution, stride, offset, mask, level_weight, level)
    cells, place = _cells(x, n, inside, sizes[0])
    used = (n < tl.where(weight != 0.0, count, 0))[:, None]
    given = weight * tl.load(_features(gradient, n, level, LEVELS), mask=used, other=0.0)
    for corner in tl.static_range(8):
        wx, wy, wz = _weights(place, corner)
        tl.atomic_add(_rows(out, cells, sizes, corner), (wx * wy * wz)[:, None] * given, mask=used, sem="relaxed")
