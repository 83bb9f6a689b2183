"""Triangle meshes of simple shapes: what the demo's world is built of."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scenefuse.demo.textures import noise_at


@dataclass(frozen=True)
class Part:
    """A piece of a mesh with one material.

    Attributes:
        vertices: (V, 3) float64, metres.
        triangles: (T, 3) int64 indices, counter-clockwise from outside.
        material: number of the material, see `scenefuse.demo.textures`.
    """

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    material: int

    def moved(self, offset: tuple[float, float, float]) -> "Part":
        """The same piece shifted by `offset`."""
        return Part(self.vertices + np.asarray(offset), self.triangles, self.material)

    def turned(self, rotation: NDArray[np.float64]) -> "Part":
        """The same piece rotated about the origin by a (3, 3) matrix."""
        return Part(self.vertices @ rotation.T, self.triangles, self.material)


def rotation(axis: int, angle_deg: float) -> NDArray[np.float64]:
    """(3, 3) rotation about axis 0, 1 or 2."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def grid(points: NDArray[np.float64], material: int) -> Part:
    """A (n, m, 3) grid of points as two triangles a cell; the normal is d/dn x d/dm."""
    n, m = points.shape[:2]
    index = np.arange(n * m).reshape(n, m)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    cells = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
    return Part(points.reshape(-1, 3), cells.reshape(-1, 3), material)


def join(parts: list[Part]) -> Part:
    """Pieces of one material as one piece."""
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts])
    triangles = np.concatenate([p.triangles + o for p, o in zip(parts, offsets)])
    return Part(np.concatenate([p.vertices for p in parts]), triangles, parts[0].material)


def sheet(a: ArrayLike, b: ArrayLike, c: ArrayLike, d: ArrayLike, material: int, edge: float = 0.5) -> Part:
    """The flat or twisted quadrilateral a b c d, counter-clockwise from outside, in cells of about `edge`."""
    a, b, c, d = (np.asarray(p, dtype=np.float64) for p in (a, b, c, d))
    n = max(1, int(np.ceil(max(np.linalg.norm(b - a), np.linalg.norm(c - d)) / edge)))
    m = max(1, int(np.ceil(max(np.linalg.norm(d - a), np.linalg.norm(c - b)) / edge)))
    u, v = np.linspace(0, 1, n + 1)[:, None, None], np.linspace(0, 1, m + 1)[None, :, None]
    return grid((1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d, material)


def hexahedron(bottom: NDArray[np.float64], top: NDArray[np.float64], material: int) -> Part:
    """A body between two quadrilaterals (4, 3), both counter-clockwise seen from above."""
    sides = [sheet(bottom[i], bottom[(i + 1) % 4], top[(i + 1) % 4], top[i], material) for i in range(4)]
    return join([*sides, _lid(top, material), _lid(bottom[::-1], material)])


def _lid(corners: NDArray[np.float64], material: int) -> Part:
    return sheet(corners[0], corners[1], corners[2], corners[3], material)


def box(low: tuple[float, float, float], high: tuple[float, float, float], material: int) -> Part:
    """The axis-aligned box between two corners."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    foot = np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]], dtype=np.float64)
    return hexahedron(foot, foot + [0, 0, z1 - z0], material)


def tube(start: ArrayLike, end: ArrayLike, radius: float, material: int, sides: int = 10) -> Part:
    """A closed cylinder from `start` to `end`."""
    start, end = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis = (end - start) / np.linalg.norm(end - start)
    x = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    x /= np.linalg.norm(x)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    ring = np.cos(angle) * x + np.sin(angle) * np.cross(axis, x)
    along = np.linspace(0, 1, max(2, int(np.linalg.norm(end - start) / 0.5) + 1))
    rows = [start + 0 * ring, *[start + t * (end - start) + radius * ring for t in along], end + 0 * ring]
    return grid(np.stack(rows, axis=1), material)


def lathe(profile: NDArray[np.float64], sides: int, material: int) -> Part:
    """A surface of revolution about z of an (n, 2) profile of (radius, height), from the bottom up."""
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    r, z = profile[None, :, 0], profile[None, :, 1]
    return grid(np.stack([r * np.cos(angle), r * np.sin(angle), z + 0 * angle], axis=-1), material)


def blob(radius: tuple[float, float, float], rough: float, detail: int, seed: int, material: int) -> Part:
    """An ellipsoid with a noisy surface: `rough` is the depth of the bumps as a share of the radius."""
    t = (1 + 5**0.5) / 2
    v: list[tuple[float, float, float]] = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0), (0, -1, t), (0, 1, t)]
    v += [(0, -1, -t), (0, 1, -t), (t, 0, -1), (t, 0, 1), (-t, 0, -1), (-t, 0, 1)]
    f = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6)]
    f += [(7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10)]
    f += [(8, 6, 7), (9, 8, 1)]
    triangles = np.array(f)
    vertices = np.array(v, dtype=np.float64)
    for _ in range(detail):
        pairs = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
        unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
        ab, bc, ca = inverse.reshape(3, -1) + len(vertices)
        a, b, c = triangles.T
        vertices = np.concatenate([vertices, vertices[unique].mean(1)])
        corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        triangles = np.concatenate([np.stack(k, axis=1) for k in corners])
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    bumps = noise_at(vertices * 1.6 + 10.0 * seed, 4, 0.7, seed)
    return Part(vertices * (1 + rough * bumps[:, None]) * np.asarray(radius), triangles, material)
