"""Solid textures and light of the demo's world, in Numba: a colour for every sample of a photo.

A texture is a function of the point in its object's own frame, so that every photo of a point agrees. It is made of
value noise in octaves; an octave fades out where its wavelength nears the pixel's footprint, which is what a lens and
a pixel do as well, and leaves detail at every distance.
"""

from enum import IntEnum

import numba
import numpy as np
from numba import njit, prange
from numpy.typing import NDArray


class Material(IntEnum):
    """What a triangle is made of; its number seeds its noise."""

    TERRAIN, BRICK, PLASTER, TILES, WOOD, GLASS, TRIM, FABRIC, WICKER, ROPE = range(10)
    BRONZE, TERRAZZO, RUST, STONE, LEAVES, BARK, ROCK, BUSH, HAY, LOGS = range(10, 20)


# Colours of the balloon's fabrics, and which of them its gores have, in a sequence that no rotation maps onto itself.
_FABRICS = np.array([
    [0.6, 0.55, 0.44], [0.62, 0.06, 0.05], [0.85, 0.45, 0.04],
    [0.05, 0.18, 0.5], [0.06, 0.33, 0.18], [0.35, 0.08, 0.32],
])  # fmt: skip
_GORES = np.array([0, 1, 2, 0, 3, 4, 0, 1, 5, 2, 0, 4, 3, 5, 0, 2])
# Corners of the path's middle, x and y.
_PATH = np.array([[-60.0, -30], [-40, -12], [-24, -3], [-8, -4], [3, -9], [14, -4], [24, 2], [40, 2], [70, 18]])


@njit(cache=True, fastmath=True, inline="always")
def _hash(i, j, k, seed):
    h = (i * 374761393 + j * 668265263 + k * 2147483647 + seed * 144665) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 1274126177) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFF) * (1.0 / 65535.0)


@njit(cache=True, fastmath=True)
def _noise(x, y, z, seed):
    """Value noise in -1 .. 1 with wavelength about 1."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = int(fx), int(fy), int(fz)
    x, y, z = x - fx, y - fy, z - fz
    x, y, z = x * x * (3 - 2 * x), y * y * (3 - 2 * y), z * z * (3 - 2 * z)
    a = _hash(i, j, k, seed) * (1 - x) + _hash(i + 1, j, k, seed) * x
    b = _hash(i, j + 1, k, seed) * (1 - x) + _hash(i + 1, j + 1, k, seed) * x
    c = _hash(i, j, k + 1, seed) * (1 - x) + _hash(i + 1, j, k + 1, seed) * x
    d = _hash(i, j + 1, k + 1, seed) * (1 - x) + _hash(i + 1, j + 1, k + 1, seed) * x
    return 2 * ((a * (1 - y) + b * y) * (1 - z) + (c * (1 - y) + d * y) * z) - 1


# One signature, or Numba would compile it again for each of the constants that it is called with.
@njit("f8(f8, f8, f8, f8, i8, f8, f8, i8)", cache=True, fastmath=True)
def fractal_noise(x, y, z, wavelength, octaves, gain, footprint, seed):
    """Octaves of noise from `wavelength` metres down, each half as long; about -1 .. 1."""
    total, norm, weight = 0.0, 0.0, 1.0
    for octave in range(octaves):
        norm += weight * weight
        fade = 1.5 * wavelength / footprint - 1.2
        if fade > 0:
            f = 1.0 / wavelength
            total += weight * min(fade, 1.0) * _noise(x * f, y * f, z * f, seed + octave)
            # Turning each octave hides the noise's own grid.
            x, y, z = 0.8 * x - 0.6 * y, 0.36 * x + 0.48 * y - 0.8 * z, 0.48 * x + 0.64 * y + 0.6 * z
        wavelength *= 0.5
        weight *= gain
    return 1.4 * total / np.sqrt(norm)


@njit(cache=True)
def noise_at(points: NDArray[np.float64], octaves: int, gain: float, seed: int) -> NDArray[np.float64]:
    """Noise about -1 .. 1 at (N, 3) points, longest wavelength 1."""
    out = np.empty(len(points))
    for n in range(len(points)):
        out[n] = fractal_noise(points[n, 0], points[n, 1], points[n, 2], 1.0, octaves, gain, 1e-6, seed)
    return out


@njit(cache=True, fastmath=True, inline="always")
def _step(low, high, value):
    t = min(max((value - low) / (high - low), 0.0), 1.0)
    return t * t * (3 - 2 * t)


@njit(cache=True, fastmath=True, inline="always")
def _mix(a, b, t):
    return (a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t)


@njit(cache=True, fastmath=True, inline="always")
def _times(a, s):
    return (a[0] * s, a[1] * s, a[2] * s)


@njit(cache=True, fastmath=True)
def _joint(u, v, width, height, joint, footprint, seed):
    """Running bond: (how much mortar 0..1, a random number for this brick)."""
    row = np.floor(v / height)
    u += 0.5 * width * (row % 2)
    column = np.floor(u / width)
    du, dv = u - column * width, v - row * height
    edge = min(min(du, width - du), min(dv, height - dv))
    soft = 0.5 * footprint
    mortar = 1 - _step(joint - soft, joint + soft + 1e-4, edge)
    # Far away a joint covers only a part of the pixel.
    mortar *= min(1.0, 2 * height / (height + footprint * 2))
    return mortar, _hash(int(column), int(row), 7, seed)


@njit(cache=True, fastmath=True)
def path_distance(x, y):
    """Metres from a point to the middle of the path."""
    best = 1e9
    for s in range(len(_PATH) - 1):
        ax, ay = _PATH[s, 0], _PATH[s, 1]
        bx, by = _PATH[s + 1, 0] - ax, _PATH[s + 1, 1] - ay
        t = min(max(((x - ax) * bx + (y - ay) * by) / (bx * bx + by * by), 0.0), 1.0)
        best = min(best, (x - ax - t * bx) ** 2 + (y - ay - t * by) ** 2)
    return np.sqrt(best)


@njit(cache=True, fastmath=True)
def _terrain(x, y, z, fp):
    fine = fractal_noise(x, y, z, 0.9, 7, 1.12, fp, 11)
    broad = fractal_noise(x, y, 0.0, 14.0, 4, 0.6, fp, 31)
    colour = _mix((0.068, 0.115, 0.03), (0.19, 0.18, 0.07), _step(-0.5, 0.8, broad + 0.3 * fine))
    soil = fractal_noise(x + 50, y, 0.0, 9.0, 4, 0.7, fp, 47) + 0.25 * fine
    colour = _mix(colour, (0.19, 0.125, 0.07), 0.9 * _step(0.35, 0.75, soil))
    if x > 22 and y < -8 and x < 44 and y > -36:
        furrow = 0.5 + 0.5 * np.sin((0.94 * x + 0.34 * y) * 7.0 + 1.2 * soil)
        inside = min(min(x - 22, 44 - x), min(-8 - y, y + 36)) + 0.6 * fine
        earth = _mix((0.17, 0.10, 0.05), (0.12, 0.17, 0.035), _step(0.45, 0.9, furrow + 0.35 * fine))
        colour = _mix(colour, earth, _step(0.0, 0.8, inside))
    flower = _hash(int(np.floor(x * 5.5)), int(np.floor(y * 5.5)), 3, 5)
    if flower > 0.965 and fp < 0.2 and soil < 0.2:
        dx, dy = x * 5.5 - np.floor(x * 5.5) - 0.5, y * 5.5 - np.floor(y * 5.5) - 0.5
        petal = 1 - _step(0.25, 0.42, np.sqrt(dx * dx + dy * dy))
        tint = (0.8, 0.75, 0.6) if flower > 0.985 else (0.75, 0.5, 0.05)
        colour = _mix(colour, tint, petal * min(1.0, 0.08 / fp))
    d = path_distance(x, y)
    if d < 2.6:
        d += 0.5 * fractal_noise(x, y, 0.0, 2.5, 4, 0.7, fp, 71)
        gravel = _mix((0.17, 0.13, 0.095), (0.34, 0.3, 0.245), 0.5 + 0.7 * fractal_noise(x, y, z, 0.4, 5, 1.0, fp, 83))
        colour = _mix(gravel, colour, _step(1.1, 1.6, d))
    return _times(colour, max(0.2, 1.0 + 0.85 * fine))


@njit(cache=True, fastmath=True)
def _fabric(x, y, z, fp):
    turn = (np.arctan2(y, x) / (2 * np.pi) + 1.0) * 16.0
    gore = int(np.floor(turn)) % 16
    seam = abs(turn - np.floor(turn + 0.5)) * (2 * np.pi / 16) * np.sqrt(x * x + y * y)
    colour_index = _GORES[gore]
    row = int(np.floor(z / 0.75))
    if 6.75 <= z < 9.0:
        colour_index = _GORES[(gore * 3 + row * 5) % 16]
    c = (_FABRICS[colour_index, 0], _FABRICS[colour_index, 1], _FABRICS[colour_index, 2])
    # The emblem: a ring and a disc on one side only.
    a, b = np.sin(np.arctan2(y, x) - 0.7) * 4.0, z - 7.9
    if x * 0.765 + y * 0.644 > 0:
        r = np.sqrt(a * a + b * b)
        c = _mix((0.8, 0.62, 0.08), c, _step(0.9 - fp, 0.9 + fp, r))
        c = _mix((0.05, 0.07, 0.16), c, _step(0.18, 0.18 + fp, abs(r - 1.3)))
    band = abs(z / 0.75 - np.floor(z / 0.75 + 0.5)) * 0.75
    stitch = 1 - 0.45 * (1 - _step(0.02, 0.03 + fp, min(seam, band))) * min(1.0, 0.06 / fp)
    cell = _hash(gore, row, 1, 9)
    weave = fractal_noise(x, y, z, 0.7, 6, 1.1, fp, 101)
    return _times(c, stitch * (0.85 + 0.3 * cell) * max(0.3, 1.0 + 0.5 * weave))


@njit(cache=True, fastmath=True)
def _albedo(material, x, y, z, u, v, fp):
    """Linear RGB. x, y, z: the object's frame; u, v: metres on the surface's dominant plane (v upwards on walls)."""
    fine = fractal_noise(x, y, z, 0.6, 6, 1.15, fp, 200 + 10 * material)
    broad = fractal_noise(x, y, z, 3.0, 3, 0.6, fp, 205 + 10 * material)
    c = (0.5, 0.5, 0.5)
    if material in (Material.BRICK, Material.STONE):
        w, h = (0.46, 0.16) if material == Material.BRICK else (0.85, 0.42)
        mortar, r = _joint(u, v, w, h, 0.014 if material == Material.BRICK else 0.02, fp, material)
        a = (0.38, 0.13, 0.075) if material == Material.BRICK else (0.33, 0.31, 0.27)
        b = (0.22, 0.085, 0.06) if material == Material.BRICK else (0.5, 0.46, 0.38)
        c = _times(_mix(a, b, r), 1.0 + 0.5 * fine)
        c = _mix(c, (0.42, 0.39, 0.34), mortar * 0.85)
    elif material == Material.PLASTER:
        c = _mix((0.6, 0.49, 0.31), (0.48, 0.4, 0.29), 0.5 + 0.6 * broad)
        streak = fractal_noise(u * 3.0, v * 0.4, 0.0, 1.0, 5, 0.8, 3 * fp, 301)
        c = _times(c, 1.0 + 0.5 * fine + 0.16 * streak)
        beam = min(abs(v - 1.95), abs(u - 1.25 * np.floor(u / 1.25 + 0.5)))
        if v < 1.95 or v > 3.2:
            beam = min(abs(v - 1.95), abs(v - 3.2))
        timber = _times((0.13, 0.07, 0.04), 1.0 + 0.5 * fine)
        c = _mix(timber, c, _step(0.075, 0.075 + fp, beam))
    elif material == Material.TILES:
        row = np.floor(v / 0.34)
        col = np.floor(u / 0.3 + 0.5 * (row % 2))
        r = _hash(int(col), int(row), 3, 21)
        shade = 0.55 + 0.45 * _step(0.0, 0.3, v / 0.34 - row)
        curve = u / 0.3 + 0.5 * (row % 2) - col
        shade *= 0.75 + 0.5 * curve * (1 - curve) * 2
        shade = 0.8 + (shade - 0.8) * min(1.0, 0.14 / fp)
        c = _mix((0.42, 0.12, 0.06), (0.24, 0.085, 0.06), r)
        c = _mix(c, (0.17, 0.17, 0.09), 0.7 * _step(0.3, 0.8, broad + 0.3 * fine))
        c = _times(c, shade * (1.0 + 0.45 * fine))
    elif material in (Material.WOOD, Material.TRIM):
        plank = np.floor(u / 0.22)
        r = _hash(int(plank), 3, 5, 41)
        grain = fractal_noise(u * 5.0, v * 0.5, r * 30.0, 0.7, 6, 0.85, 3 * fp, 43)
        gap = min(u - plank * 0.22, 0.22 - u + plank * 0.22)
        c = _mix((0.27, 0.15, 0.07), (0.4, 0.26, 0.14), r)
        if material == Material.TRIM:
            c = (0.62, 0.6, 0.55)
        c = _times(
            c, (1.0 + 0.4 * grain + 0.25 * fine) * (1 - 0.6 * (1 - _step(0.006, 0.012 + fp, gap)) * min(1.0, 0.05 / fp))
        )
    elif material == Material.GLASS:
        c = _mix((0.03, 0.045, 0.07), (0.16, 0.19, 0.22), _step(-0.2, 0.6, broad + 0.6 * fine))
        bar = min(abs(u - 0.6 * np.floor(u / 0.6 + 0.5)), abs(v - 0.55 * np.floor(v / 0.55 + 0.5)))
        c = _mix((0.6, 0.58, 0.53), c, _step(0.03, 0.03 + fp, bar))
    elif material == Material.FABRIC:
        c = _fabric(x, y, z, fp)
    elif material == Material.WICKER:
        weave = np.sin(u * 30.0) * np.sin(v * 30.0 + 3.14 * np.floor(u * 9.55)) * min(1.0, 0.05 / fp)
        c = _times((0.33, 0.2, 0.09), 1.0 + 0.35 * weave + 0.45 * fine)
    elif material == Material.ROPE:
        c = _times((0.4, 0.34, 0.24), 1.0 + 0.4 * fine)
    elif material == Material.BRONZE:
        patina = _step(-0.15, 0.35, broad + 0.5 * fine)
        c = _mix((0.26, 0.13, 0.05), (0.14, 0.33, 0.26), patina)
        c = _times(c, 1.0 + 0.55 * fractal_noise(x, y, z, 0.35, 5, 1.1, fp, 401))
    elif material == Material.TERRAZZO:
        c = _times((0.58, 0.52, 0.44), 1.0 + 0.3 * fine)
        chip = fractal_noise(x, y, z, 0.22, 3, 0.9, fp, 411)
        c = _mix(c, (0.1, 0.13, 0.3), _step(0.3, 0.42, chip))
        c = _mix(c, (0.5, 0.1, 0.05), _step(0.3, 0.42, -chip))
    elif material == Material.RUST:
        c = _mix((0.16, 0.075, 0.045), (0.45, 0.18, 0.05), _step(-0.6, 0.6, fine + 0.5 * broad))
        plate = min(abs(u - 0.9 * np.floor(u / 0.9 + 0.5)), abs(v - 0.9 * np.floor(v / 0.9 + 0.5)))
        c = _times(c, 0.55 + 0.45 * _step(0.012, 0.012 + fp, plate))
        c = _times(c, 1.0 + 0.4 * fractal_noise(x, y, z, 0.3, 5, 0.95, fp, 421))
    elif material in (Material.LEAVES, Material.BUSH):
        leaf = fractal_noise(x, y, z, 0.55, 5, 0.95, fp, 431)
        c = _mix((0.035, 0.085, 0.02), (0.16, 0.24, 0.05), _step(-0.9, 0.9, leaf + 0.3 * broad))
        if material == Material.BUSH:
            c = _mix(c, (0.3, 0.21, 0.06), 0.45 * _step(-0.2, 0.7, broad))
        c = _times(c, 1.0 + 0.35 * fine)
    elif material == Material.BARK:
        c = _times(
            (0.17, 0.115, 0.075), 1.0 + 0.55 * fractal_noise(x * 2.5, y * 2.5, z * 0.6, 0.5, 5, 0.85, 2 * fp, 441)
        )
    elif material == Material.ROCK:
        c = _mix((0.24, 0.23, 0.21), (0.42, 0.4, 0.36), 0.5 + 0.6 * fine)
        c = _mix(c, (0.2, 0.22, 0.09), 0.7 * _step(0.25, 0.6, broad))
    elif material == Material.HAY:
        straw = fractal_noise(x * 1.5, y * 3.0, z * 3.0, 0.5, 6, 0.9, 2 * fp, 451)
        c = _times((0.5, 0.37, 0.13), 1.0 + 0.5 * straw)
    elif material == Material.LOGS:
        row = np.floor(v / 0.2)
        col = np.floor(u / 0.22 + 0.5 * (row % 2))
        du, dv = (u / 0.22 + 0.5 * (row % 2) - col - 0.5) * 0.22, v - (row + 0.5) * 0.2
        r = np.sqrt(du * du + dv * dv)
        c = _mix((0.5, 0.34, 0.17), (0.32, 0.2, 0.1), 0.5 + 0.5 * np.sin(r * 150.0) * min(1.0, 0.02 / fp))
        c = _mix(c, (0.05, 0.035, 0.02), _step(0.085, 0.085 + fp, r))
        c = _times(c, 0.75 + 0.5 * _hash(int(col), int(row), 1, 61) + 0.3 * fine)
    return c


@njit(parallel=True, cache=True, fastmath=True)
def world_rays(rays, centre, world_from_cam, in_cam):
    """Fill (N, 6) float32 rays of the world with unit directions, from their (N, 2) x and y at z = 1 in the camera."""
    for n in prange(len(rays)):
        x, y = in_cam[n, 0], in_cam[n, 1]
        norm = 1.0 / np.sqrt(x * x + y * y + 1.0)
        for k in range(3):
            rays[n, k] = centre[k]
            d = world_from_cam[k, 0] * x + world_from_cam[k, 1] * y + world_from_cam[k, 2]
            rays[n, 3 + k] = d * norm


@njit(parallel=True, cache=True, fastmath=True)
def sun_rays(out, facing, rays, distance, normals, triangle, suns):
    """Rays from every hit to the sun; `facing` is False where the surface looks away or nothing was hit.

    `suns`: (S, 3) points of the sun's disc, taken in turn by a pixel's samples: half-shadows come out soft.
    """
    for n in prange(len(rays)):
        sun = suns[n % len(suns)]
        side, along = 0.0, 0.0
        for k in range(3):
            side += normals[n, k] * rays[n, 3 + k]
            along += normals[n, k] * sun[k]
        if side > 0:
            along = -along
        facing[n] = triangle[n] >= 0 and along > 0
        if facing[n]:
            for k in range(3):
                offset = -2e-3 * normals[n, k] if side > 0 else 2e-3 * normals[n, k]
                out[n, k] = rays[n, k] + distance[n] * rays[n, 3 + k] + offset
                out[n, 3 + k] = sun[k]


@njit(parallel=True, cache=True, fastmath=True)
def shade(
    light, rays, distance, normals, triangle, uv, lit, materials, owners, triangles, openness, frames, sun,
    pixel_angle, haze,
):  # fmt: skip
    """Fill (H, W, 3) with the linear light of a photo's pixels.

    Args:
        light: output, float64.
        rays: (H * W * S, 6), the S samples of a pixel next to each other.
        distance: (N,) metres to the hit.
        normals: (N, 3) of the triangle hit.
        triangle: (N,) its number, negative for the sky.
        uv: (N, 2) barycentric coordinates in it.
        lit: (N,) whether the sun reaches the hit.
        materials: (T,) per triangle.
        owners: (T,) per triangle, index into `frames`.
        triangles: (T, 3).
        openness: (V,) share of the sky that a vertex sees, 0 .. 1.
        frames: (F, 5) x, y, z, cosine and sine of the yaw: object frames in the world.
        sun: (3,) direction to the sun.
        pixel_angle: radians a pixel covers.
        haze: share of white in the sky, 0 .. 1.
    """
    height, width = light.shape[:2]
    samples = len(rays) // (height * width)
    for row in prange(height):
        for column in range(width):
            red, green, blue = 0.0, 0.0, 0.0
            for s in range(samples):
                n = (row * width + column) * samples + s
                dz = rays[n, 5]
                if triangle[n] < 0:
                    t = _step(-0.05, 0.6, dz)
                    white = haze * (0.98 + 0.07 * _noise(2.5 * rays[n, 3], 2.5 * rays[n, 4], 2.5 * dz, 71))
                    red += (1 - haze) * (0.72 - 0.48 * t) + white
                    green += (1 - haze) * (0.8 - 0.34 * t) + white
                    blue += (1 - haze) * (0.86 - 0.08 * t) + white
                    continue
                d = distance[n]
                px, py, pz = rays[n, 0] + d * rays[n, 3], rays[n, 1] + d * rays[n, 4], rays[n, 2] + d * dz
                nx, ny, nz = normals[n, 0], normals[n, 1], normals[n, 2]
                towards = -(nx * rays[n, 3] + ny * rays[n, 4] + nz * dz)
                if towards < 0:
                    nx, ny, nz, towards = -nx, -ny, -nz, -towards
                fp = d * pixel_angle / np.sqrt(max(towards, 0.15))
                tri = triangle[n]
                material = materials[tri]
                if material == Material.TERRAIN:
                    c = _terrain(px, py, pz, fp)
                else:
                    f = frames[owners[tri]]
                    x = f[3] * (px - f[0]) + f[4] * (py - f[1])
                    y = f[3] * (py - f[1]) - f[4] * (px - f[0])
                    z = pz - f[2]
                    lx, ly = abs(f[3] * nx + f[4] * ny), abs(f[3] * ny - f[4] * nx)
                    if material == Material.TILES:
                        u, v = (x, z * 1.45) if lx < 0.3 else (y, z * 1.45)
                    elif abs(nz) > 0.8:
                        u, v = x, y
                    elif lx > ly:
                        u, v = y, z
                    else:
                        u, v = x, z
                    c = _albedo(material, x, y, z, u, v, fp)
                a, b = uv[n, 0], uv[n, 1]
                open_sky = (
                    (1 - a - b) * openness[triangles[tri, 0]]
                    + a * openness[triangles[tri, 1]]
                    + b * openness[triangles[tri, 2]]
                )
                sky = open_sky * (0.30 + 0.14 * nz)
                direct = 0.0
                if lit[n]:
                    direct = 1.55 * max(0.0, nx * sun[0] + ny * sun[1] + nz * sun[2])
                bounce = 0.07 * (1 - nz) * (0.4 + 0.6 * open_sky)
                red += max(c[0], 0.0) * (sky * 0.92 + direct * 1.04 + bounce * 1.1)
                green += max(c[1], 0.0) * (sky * 1.0 + direct * 0.99 + bounce * 1.05)
                blue += max(c[2], 0.0) * (sky * 1.18 + direct * 0.88 + bounce * 0.8)
            scale = 1.4 / samples
            light[row, column, 0] = red * scale
            light[row, column, 1] = green * scale
            light[row, column, 2] = blue * scale


@njit(parallel=True, cache=True, fastmath=True)
def encode(picture, light):
    """Fill (H, W, 3) uint8 from linear light that is not negative: a soft shoulder, then gamma."""
    for row in prange(light.shape[0]):
        for column in range(light.shape[1]):
            for k in range(3):
                linear = light[row, column, k]
                value = linear * (1 + 0.12 * linear) / (1 + 0.55 * linear)
                picture[row, column, k] = min(255.0, 255.0 * value ** (1 / 2.2) + 0.5)


def set_threads(count: int) -> None:
    """Threads of the kernels above; never more than Numba was started with."""
    # TBB comes last: Numba warns about the versions that it finds too old.
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "workqueue", "tbb"]  # type: ignore[attr-defined]
    numba.set_num_threads(max(1, min(count, numba.config.NUMBA_NUM_THREADS)))  # type: ignore[attr-defined]
