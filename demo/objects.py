"""The three objects of the demo, each in its own frame: z up, the ground at z = 0, metres."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from demo.textures import Material, noise_at


@dataclass(frozen=True)
class Part:
    """A piece of a mesh with one material.

    Attributes:
        vertices: (V, 3) float64, metres.
        triangles: (T, 3) int64 indices, counter-clockwise from outside.
        material: number of the material, see `demo.textures`.
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


@dataclass(frozen=True)
class Model:
    """One object of the demo.

    Attributes:
        parts: its surface.
        place: x, y in the world, and yaw in degrees.
        landmarks: points of the surface that a person would click, name -> position in the object's frame.
        radius: of the ground that stays clear of clutter around it.
    """

    parts: list[Part]
    place: tuple[float, float, float]
    landmarks: dict[str, tuple[float, float, float]]
    radius: float


def house() -> Model:
    """A house of 10 x 7 m: gable roof with overhang, chimney, dormer, porch, a stack of logs."""
    ridge, rise = 6.6, 0.93
    parts = [
        box((-5.08, -3.58, -0.6), (5.08, 3.58, 0.55), Material.STONE),
        box((-5, -3.5, 0.5), (5, 3.5, 1.95), Material.BRICK),
        box((-5, -3.5, 1.95), (5, 3.5, 3.4), Material.PLASTER),
        hexahedron(
            np.array([[-5, -3.5, 3.3], [5, -3.5, 3.3], [5, 3.5, 3.3], [-5, 3.5, 3.3]]),
            np.array([[-5, -0.02, 6.5], [5, -0.02, 6.5], [5, 0.02, 6.5], [-5, 0.02, 6.5]]),
            Material.PLASTER,
        ),
    ]
    for side in (-1, 1):
        y0 = side * 4.15
        low = np.array(
            [[-5.6, y0, ridge - rise * 4.15], [5.6, y0, ridge - rise * 4.15], [5.6, 0, ridge], [-5.6, 0, ridge]]
        )
        low = low if side < 0 else low[[1, 0, 3, 2]]
        parts.append(hexahedron(low, low + [0, 0, 0.2], Material.TILES))
    parts += [
        box((1.9, 0.8, 4.5), (2.9, 1.7, 7.7), Material.BRICK),
        box((1.8, 0.7, 7.7), (3.0, 1.8, 7.88), Material.STONE),
        box((-3.3, -3.0, 4.0), (-1.3, -0.6, 5.55), Material.PLASTER),
        _dormer_roof(),
        *_window(-2.3, -3.02, 4.35, 1.1, 0.95, 0),
        *_porch(),
        *_window(-3.7, -3.52, 1.1, 1.2, 1.4, 0),
        *_window(-1.6, -3.52, 1.1, 1.2, 1.4, 0),
        *_window(-3.2, 3.52, 1.1, 1.8, 1.4, 0),
        *_window(1.2, 3.52, 1.1, 1.2, 1.4, 0),
        *_window(1.6, 5.02, 1.2, 1.0, 1.3, 1),
        *_window(0.0, 5.02, 4.1, 1.2, 1.2, 1),
        *_window(0.0, -5.02, 4.1, 1.0, 1.0, 1),
        box((-5.06, -1.9, 0.4), (-4.96, -0.9, 2.5), Material.WOOD),
        box((-5.75, 0.5, -0.3), (-5.0, 3.1, 1.55), Material.LOGS),
        tube((4.4, 3.95, -0.3), (4.4, 3.95, 1.15), 0.42, Material.WOOD, 18),
    ]
    return Model(parts, (-21.0, 9.0, 21.0), _house_landmarks(ridge, ridge - rise * 4.15 + 0.2), 8.0)


def _house_landmarks(ridge: float, z: float) -> dict[str, tuple[float, float, float]]:
    """Corners that a person would click; the eaves' tops lie at height `z`."""
    return {
        "eave_south_west": (-5.6, -4.15, z),
        "eave_south_east": (5.6, -4.15, z),
        "eave_north_east": (5.6, 4.15, z),
        "eave_north_west": (-5.6, 4.15, z),
        "ridge_west": (-5.6, 0.0, ridge + 0.2),
        "ridge_east": (5.6, 0.0, ridge + 0.2),
        "chimney_a": (1.8, 0.7, 7.88),
        "chimney_b": (3.0, 1.8, 7.88),
        "base_south_west": (-5.08, -3.58, 0.02),
        "base_south_east": (5.08, -3.58, 0.02),
        "base_north_east": (5.08, 3.58, 0.02),
        "base_north_west": (-5.08, 3.58, 0.02),
        "porch_west": (0.9, -5.35, 0.02),
        "porch_east": (4.3, -5.35, 0.02),
        "logs": (-5.75, 3.1, 0.02),
    }


def balloon() -> Model:
    """A hot-air balloon, its basket on the ground: 16 gores alike in shape, coloured so that no turn repeats."""
    radius, centre, tangent = 3.95, 8.1, np.radians(124.0)
    polar = np.linspace(0, tangent, 44)
    top = np.stack([radius * np.sin(polar), centre + radius * np.cos(polar)], axis=1)
    down = np.array([np.cos(tangent), -np.sin(tangent)])
    length = (top[-1, 0] - 0.95) / -down[0]
    cone = top[-1] + np.linspace(0, length, 22)[1:, None] * down
    envelope = lathe(np.concatenate([top, cone])[::-1], 160, Material.FABRIC)
    x, y, z = envelope.vertices.T
    bulge = 1.0 + 0.022 * (np.abs(np.sin(8 * np.arctan2(y, x))) - 1.0)
    envelope = Part(np.stack([x * bulge, y * bulge, z], axis=1), envelope.triangles, Material.FABRIC)
    mouth = cone[-1]
    parts = [envelope]
    for sx, sy in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
        parts.append(tube((0.7 * sx, 0.7 * sy, 1.1), (0.66 * sx, 0.66 * sy, mouth[1] + 0.03), 0.05, Material.ROPE))
        parts.append(blob((0.2, 0.2, 0.28), 0.15, 2, 5, Material.ROPE).moved((0.55 * sx, 0.97 * sy, 0.55)))
    parts += [
        box((-0.8, -0.8, -0.3), (0.8, 0.8, 0.2), Material.WICKER),
        box((-0.8, -0.8, 0.2), (0.8, -0.7, 1.15), Material.WICKER),
        box((-0.8, 0.7, 0.2), (0.8, 0.8, 1.15), Material.WICKER),
        box((-0.8, -0.7, 0.2), (-0.7, 0.7, 1.15), Material.WICKER),
        box((0.7, -0.7, 0.2), (0.8, 0.7, 1.15), Material.WICKER),
        box((-0.45, -0.12, mouth[1] - 0.35), (0.45, 0.12, mouth[1] - 0.15), Material.TRIM),
        tube((-0.66, -0.66, mouth[1] - 0.25), (0.66, 0.66, mouth[1] - 0.25), 0.05, Material.ROPE),
    ]
    landmarks = {"crown": (0.0, 0.0, centre + radius)}
    for k in range(8):
        angle = 2 * np.pi * (2 * k) / 16
        r = radius * 0.978
        landmarks[f"seam_{k}"] = (r * np.cos(angle), r * np.sin(angle), centre)
    for k, (sx, sy) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        landmarks[f"basket_foot_{k}"] = (0.8 * sx, 0.8 * sy, 0.03)
        landmarks[f"basket_rim_{k}"] = (0.8 * sx, 0.8 * sy, 1.15)
    return Model(parts, (19.0, 13.0, 8.0), landmarks, 5.0)


def sculpture() -> Model:
    """A twisted ring, a ball and a leaning slab on a plinth, about 6 m high."""
    angle = np.linspace(0, 2 * np.pi, 321)[:, None]
    section = np.linspace(0, 2 * np.pi, 97)[None, :]
    twist = 2 * angle
    a, b = 0.62 * np.cos(section), 0.3 * np.sin(section)
    across, up = a * np.cos(twist) - b * np.sin(twist), a * np.sin(twist) + b * np.cos(twist)
    big = 1.65 + 0.12 * np.cos(3 * angle)
    ring_points = np.stack([(big + across) * np.cos(angle), up, (big + across) * np.sin(angle)], axis=-1)
    tilt = rotation(2, 25.0) @ rotation(1, 12.0) @ rotation(0, 8.0)
    ring = grid(ring_points, Material.BRONZE).turned(tilt).moved((0.1, 0.0, 3.95))
    slab_turn = rotation(2, -30.0) @ rotation(0, -17.0)
    slab_at = (-0.75, 1.05, 1.45)
    slab = box((-0.85, -0.16, 0.0), (0.85, 0.16, 3.6), Material.RUST).turned(slab_turn).moved(slab_at)
    parts = [
        box((-1.9, -1.9, -0.5), (1.9, 1.9, 0.45), Material.STONE),
        box((-1.4, -1.4, 0.45), (1.4, 1.4, 1.75), Material.STONE),
        ring,
        blob((0.62, 0.62, 0.62), 0.0, 4, 1, Material.TERRAZZO).moved((0.95, -0.95, 2.33)),
        slab,
        tube((1.9, 0.2, -0.2), (1.25, 0.35, 3.2), 0.14, Material.RUST, 16),
        blob((0.5, 0.45, 0.35), 0.25, 4, 3, Material.ROCK).moved((-1.55, -1.5, 0.6)),
    ]
    ring_top = ring.vertices[ring.vertices[:, 2].argmax()]
    corner = slab_turn @ np.array([-0.85, 0.16, 3.6]) + slab_at
    other = slab_turn @ np.array([0.85, 0.16, 3.6]) + slab_at
    landmarks = {
        "ring_top": tuple(ring_top),
        "slab_left": tuple(corner),
        "slab_right": tuple(other),
        "ball_top": (0.95, -0.95, 2.95),
        "rod_top": (1.25, 0.35, 3.2),
    }
    for k, (sx, sy) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        landmarks[f"step_{k}"] = (1.9 * sx, 1.9 * sy, 0.45)
        landmarks[f"foot_{k}"] = (1.9 * sx, 1.9 * sy, 0.03)
        landmarks[f"plinth_{k}"] = (1.4 * sx, 1.4 * sy, 1.75)
    return Model(parts, (3.0, -19.0, -14.0), landmarks, 4.0)


OBJECTS = {"house": house, "balloon": balloon, "sculpture": sculpture}


def _window(centre: float, plane: float, sill: float, width: float, height: float, axis: int) -> list[Part]:
    """Frame and glass on a wall y = plane (axis 0) or x = plane (axis 1), a few centimetres proud."""
    sign = np.sign(plane)
    parts = []
    for material, grow, depth in ((Material.TRIM, 0.1, 0.05), (Material.GLASS, 0.0, 0.07)):
        near, far = sorted((plane - 0.1 * sign, plane + depth * sign))
        a, b = centre - width / 2 - grow, centre + width / 2 + grow
        z0, z1 = sill - grow, sill + height + grow
        low, high = ((a, near, z0), (b, far, z1)) if axis == 0 else ((near, a, z0), (far, b, z1))
        parts.append(box(low, high, material))
    return parts


def _dormer_roof() -> Part:
    """A lean-to roof over the dormer."""
    low = np.array([[-3.6, -3.35, 5.4], [-1.0, -3.35, 5.4], [-1.0, -0.3, 6.15], [-3.6, -0.3, 6.15]])
    return hexahedron(low, low + [0, 0, 0.16], Material.TILES)


def _porch() -> list[Part]:
    """Steps, two posts, a small roof and the door."""
    low = np.array([[0.6, -5.5, 2.5], [4.6, -5.5, 2.5], [4.6, -3.4, 3.0], [0.6, -3.4, 3.0]])
    return [
        box((0.9, -5.35, -0.5), (4.3, -3.5, 0.45), Material.WOOD),
        box((1.7, -5.75, -0.5), (3.4, -5.35, 0.22), Material.STONE),
        box((1.0, -5.25, 0.45), (1.18, -5.07, 2.65), Material.TRIM),
        box((4.02, -5.25, 0.45), (4.2, -5.07, 2.65), Material.TRIM),
        box((1.0, -5.2, 1.15), (1.9, -5.1, 1.25), Material.TRIM),
        box((3.3, -5.2, 1.15), (4.2, -5.1, 1.25), Material.TRIM),
        hexahedron(low, low + [0, 0, 0.14], Material.TILES),
        box((2.05, -3.56, 0.45), (3.05, -3.4, 2.5), Material.WOOD),
        sheet((1.9, -3.53, 0.45), (3.2, -3.53, 0.45), (3.2, -3.53, 2.65), (1.9, -3.53, 2.65), Material.TRIM),
        join([box((3.75, -3.9, 0.45), (4.25, -3.55, 0.95), Material.HAY)]),
    ]
