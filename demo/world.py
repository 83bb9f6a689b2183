"""The demo's world: terrain, clutter and three objects as one labelled triangle mesh, the same for the same seed.

Frame: metres, x east, y north, z up, about the origin `ORIGIN`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from demo.objects import OBJECTS, Part, blob, box, grid, rotation, tube
from demo.textures import Material, noise_at, path_distance
from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array

# Height of the ground at east, north.
Height = Callable[[Array, Array], Array]

# Latitude, longitude in degrees and ellipsoidal height in metres of the world's origin: open country, no landmark.
ORIGIN = (47.5, 8.5, 430.0)
# Half the size of the mapped area, east and north.
MAPPED = (45.0, 40.0)
# Direction to the sun, the same for every photo.
SUN = np.array([-0.46, -0.52, 0.72]) / np.linalg.norm([-0.46, -0.52, 0.72])


@dataclass(frozen=True)
class World:
    """The world as one mesh with labels, ready for rays.

    Attributes:
        vertices: (V, 3) float32.
        triangles: (T, 3) int32.
        materials: (T,) int32, see `demo.textures`.
        owners: (T,) int32: 0 terrain and clutter, 1 + k the k-th of `names`.
        names: the objects.
        frames: (1 + objects, 5) x, y, z, cos yaw, sin yaw of each owner's frame in the world.
        scene: Open3D ray caster; one geometry, so a primitive id is a triangle's number.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    materials: NDArray[np.int32]
    owners: NDArray[np.int32]
    names: list[str]
    frames: Array
    scene: o3d.t.geometry.RaycastingScene

    def owner(self, name: str) -> int:
        """Number of an object among `owners`; StageError for a name the demo does not have."""
        if name not in self.names:
            raise StageError(f"the demo has no object {name!r}; use one of {', '.join(self.names)}")
        return 1 + self.names.index(name)

    def landmarks(self, name: str) -> dict[str, Array]:
        """Points of an object that a person would click, in the world."""
        x, y, z, c, s = self.frames[self.owner(name)]
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return {k: turn @ np.asarray(p) + [x, y, z] for k, p in OBJECTS[name]().landmarks.items()}

    def bounds(self, name: str) -> Array:
        """(2, 3) lowest and highest corner of what stands above the ground of an object, in the world."""
        used = np.unique(self.triangles[self.owners == self.owner(name)])
        corners = np.stack([self.vertices[used].min(0), self.vertices[used].max(0)]).astype(np.float64)
        corners[0, 2] = max(corners[0, 2], self.frames[self.owner(name), 2])
        return corners

    def mesh(self, owner: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Vertices and triangles of one owner, renumbered; an object's without what is buried or walled in."""
        chosen = self.triangles[self.owners == owner]
        if owner > 0:
            chosen = chosen[_exposed(self, chosen)]
        used, renumbered = np.unique(chosen, return_inverse=True)
        return self.vertices[used], renumbered.reshape(-1, 3).astype(np.int32)


def build_world(seed: int) -> World:
    """Terrain, clutter and the three objects."""
    models = {name: make() for name, make in OBJECTS.items()}
    centres = np.array([m.place[:2] for m in models.values()])
    radii = np.array([m.radius for m in models.values()])

    def height(x: Array, y: Array) -> Array:
        return _height(x, y, centres, radii, seed)

    rng = np.random.default_rng(seed)
    parts = [(part, 0) for part in [_terrain(height), *_clutter(height, centres, radii, rng)]]
    frames = [(0.0, 0.0, 0.0, 1.0, 0.0)]
    for k, model in enumerate(models.values()):
        x, y, yaw = model.place
        z = float(height(np.array([x]), np.array([y]))[0])
        frames.append((x, y, z, np.cos(np.radians(yaw)), np.sin(np.radians(yaw))))
        parts += [(p.turned(rotation(2, yaw)).moved((x, y, z)), k + 1) for p in model.parts]
    return _assemble(parts, list(models), np.array(frames))


def openness(world: World, directions: int, seed: int) -> NDArray[np.float32]:
    """(V,) share of the sky that each vertex sees, cosine-weighted: soft shade in corners and under trees.

    Vertices far outside the mapped area count as open.
    """
    normals = _vertex_normals(world)
    near = np.flatnonzero(np.abs(world.vertices[:, :2]).max(1) < 75.0)
    rng = np.random.default_rng(seed)
    total = np.zeros(len(near))
    for _ in range(directions):
        d = rng.normal(size=(len(near), 3))
        d = d / np.linalg.norm(d, axis=1, keepdims=True) + 1.02 * normals[near]
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        origin = world.vertices[near] + 0.03 * normals[near]
        rays = np.concatenate([origin, d], axis=1).astype(np.float32)
        total += ~world.scene.test_occlusions(o3d.core.Tensor.from_numpy(rays), 0.0, 8.0).numpy()
    result = np.ones(len(world.vertices), dtype=np.float32)
    result[near] = 0.15 + 0.85 * total / directions
    return result


def _height(x: Array, y: Array, centres: Array, radii: Array, seed: int) -> Array:
    """Gentle relief, level where an object stands, hills at the horizon."""
    points = np.stack([x, y, np.zeros_like(x)], axis=1)
    z = 1.9 * noise_at(points / 34.0, 3, 0.5, seed + 5)
    z += 0.07 * noise_at(points / 2.2, 3, 0.6, seed + 6)
    far = np.clip((np.hypot(x, y) - 75.0) / 200.0, 0, 1)
    z += 26.0 * far**1.5 * (0.75 + 0.6 * noise_at(points / 120.0, 2, 0.5, seed + 7))
    for centre, radius in zip(centres, radii):
        level = 1.9 * noise_at(np.array([[*centre, 0.0]]) / 34.0, 3, 0.5, seed + 5)[0]
        blend = np.clip((np.hypot(x - centre[0], y - centre[1]) - 0.85 * radius) / radius, 0, 1)
        blend = blend * blend * (3 - 2 * blend)
        rough = 0.025 * noise_at(points / 0.9, 2, 0.6, seed + 8)
        z = (level + rough) * (1 - blend) + z * blend
    return z


def _terrain(height: Height) -> Part:
    """A grid of 0.4 m cells over the mapped area, growing coarser towards the horizon."""
    outer = 56.0 + np.cumsum(0.5 * 1.12 ** np.arange(1, 39))
    axis = np.concatenate([-outer[::-1], np.arange(-56.0, 56.01, 0.4), outer])
    x, y = np.meshgrid(axis, axis, indexing="ij")
    z = height(x.ravel(), y.ravel()).reshape(x.shape)
    return grid(np.stack([x, y, z], axis=-1), Material.TERRAIN)


def _clutter(height: Height, centres: Array, radii: Array, rng: np.random.Generator) -> list[Part]:
    """Trees, bushes, rocks, fences and bales, clear of the objects and of the cameras around them."""
    clear = np.array([22.0, 26.0, 15.0])

    def ground(x: float, y: float) -> float:
        return float(height(np.array([x]), np.array([y]))[0])

    def free(count: int, reach: float, margins: Array, inner: float = 0.0) -> list[tuple[float, float]]:
        spots: list[tuple[float, float]] = []
        while len(spots) < count:
            x, y = rng.uniform(-reach, reach, 2)
            away = np.hypot(x - centres[:, 0], y - centres[:, 1])
            if (away > margins).all() and np.hypot(x, y) > inner and path_distance(x, y) > 2.3:
                spots.append((float(x), float(y)))
        return spots

    parts: list[Part] = []
    for x, y in [*free(26, 52.0, clear), *free(95, 130.0, clear + 8, 58.0)]:
        parts += _tree(x, y, ground(x, y), rng, 3 if np.hypot(x, y) < 60 else 2)
    for x, y in free(55, 52.0, radii + 2.5):
        size = rng.uniform(0.35, 1.0)
        shape = (size * rng.uniform(0.9, 1.5), size * rng.uniform(0.9, 1.5), size)
        bush = blob(shape, 0.3, 3, int(rng.integers(999)), Material.BUSH)
        parts.append(bush.turned(rotation(2, rng.uniform(0, 360))).moved((x, y, ground(x, y) + 0.35 * size)))
    for x, y in free(60, 50.0, radii + 1.0):
        size = rng.uniform(0.15, 0.6)
        rock = blob((size * 1.3, size, 0.8 * size), 0.3, 3, int(rng.integers(999)), Material.ROCK)
        parts.append(rock.turned(rotation(2, rng.uniform(0, 360))).moved((x, y, ground(x, y) + 0.1 * size)))
    for x, y in free(9, 44.0, radii + 6.0):
        turn = rotation(2, rng.uniform(0, 360))
        bale = tube((-0.6, 0, 0), (0.6, 0, 0), 0.62, Material.HAY, 24).turned(turn)
        parts.append(bale.moved((x, y, ground(x, y) + 0.55)))
    lines: list[list[tuple[float, float]]] = [
        [(-34, -24), (-25, -18.5), (-15, -19), (-7, -26)],
        [(-3, 21), (4, 30), (14, 34), (26, 31)],
        [(22, -8), (22, -36), (44, -36)],
    ]
    for line in lines:
        for start, end in zip(line[:-1], line[1:]):
            parts += _fence(np.array(start), np.array(end), ground)
    parts += _bench(-8.0, 3.0, ground(-8.0, 3.0), 35.0) + _bench(9.5, -12.5, ground(9.5, -12.5), -50.0)
    return parts


def _tree(x: float, y: float, z: float, rng: np.random.Generator, detail: int) -> list[Part]:
    """A trunk and a crown of a few rough ellipsoids."""
    tall = rng.uniform(3.5, 8.0)
    parts = [tube((x, y, z - 0.3), (x, y, z + 0.6 * tall), 0.045 * tall, Material.BARK, 9)]
    if rng.random() < 0.3:
        for k in range(4):
            r = 0.24 * tall * (1 - 0.21 * k)
            layer = blob((r, r, 0.2 * tall), 0.25, detail, int(rng.integers(999)), Material.LEAVES)
            parts.append(layer.moved((x, y, z + tall * (0.35 + 0.2 * k))))
        return parts
    for k in range(5):
        r = tall * rng.uniform(0.15, 0.24)
        angle, away = rng.uniform(0, 2 * np.pi), 0.0 if k == 0 else tall * rng.uniform(0.1, 0.2)
        crown = blob((r * 1.1, r, r * 0.9), 0.34, detail, int(rng.integers(999)), Material.LEAVES)
        spot = (x + away * np.cos(angle), y + away * np.sin(angle), z + tall * rng.uniform(0.6, 0.88))
        parts.append(crown.moved(spot))
    return parts


def _fence(start: Array, end: Array, ground: Callable[[float, float], float]) -> list[Part]:
    """Posts every 2.2 m with two rails."""
    count = max(2, int(np.linalg.norm(end - start) / 2.2) + 1)
    spots = np.linspace(start, end, count)
    tops = [np.array([*p, ground(*p)]) for p in spots]
    parts = [tube(p - [0, 0, 0.3], p + [0, 0, 1.15], 0.08, Material.WOOD, 8) for p in tops]
    for a, b in zip(tops[:-1], tops[1:]):
        parts += [tube(a + [0, 0, h], b + [0, 0, h], 0.05, Material.WOOD, 6) for h in (0.5, 0.98)]
    return parts


def _bench(x: float, y: float, z: float, yaw: float) -> list[Part]:
    """A bench of planks on two blocks."""
    pieces = [
        box((-1.0, -0.25, 0.4), (1.0, 0.25, 0.48), Material.WOOD),
        box((-1.0, 0.22, 0.48), (1.0, 0.3, 0.95), Material.WOOD),
        box((-0.9, -0.2, -0.3), (-0.65, 0.2, 0.4), Material.STONE),
        box((0.65, -0.2, -0.3), (0.9, 0.2, 0.4), Material.STONE),
    ]
    return [p.turned(rotation(2, yaw)).moved((x, y, z)) for p in pieces]


def _assemble(parts: list[tuple[Part, int]], names: list[str], frames: Array) -> World:
    offsets = np.cumsum([0] + [len(p.vertices) for p, _ in parts])
    vertices = np.concatenate([p.vertices for p, _ in parts]).astype(np.float32)
    triangles = np.concatenate([p.triangles + o for (p, _), o in zip(parts, offsets)]).astype(np.int32)
    counts = [len(p.triangles) for p, _ in parts]
    materials = np.repeat([p.material for p, _ in parts], counts).astype(np.int32)
    owners = np.repeat([owner for _, owner in parts], counts).astype(np.int32)
    scene = o3d.t.geometry.RaycastingScene()
    tensors = (o3d.core.Tensor.from_numpy(a) for a in (vertices, triangles.astype(np.uint32)))
    scene.add_triangles(*tensors)
    return World(vertices, triangles, materials, owners, names, frames, scene)


def _exposed(world: World, triangles: NDArray[np.int32]) -> NDArray[np.bool_]:
    """(T,) triangles from which some ray, to either side, gets away to the sky."""
    rng = np.random.default_rng(0)
    corners = world.vertices[triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    result = np.zeros(len(triangles), dtype=bool)
    for _ in range(240):
        inner = np.flatnonzero(~result)
        weights = rng.dirichlet(np.ones(3), len(inner))
        direction = rng.normal(size=(len(inner), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        side = np.sign((direction * normals[inner]).sum(1, keepdims=True))
        origin = (weights[:, :, None] * corners[inner]).sum(1) + 2e-3 * side * normals[inner]
        rays = np.concatenate([origin, direction], axis=1).astype(np.float32)
        result[inner] = ~world.scene.test_occlusions(o3d.core.Tensor.from_numpy(rays)).numpy()
    return result


def _vertex_normals(world: World) -> Array:
    a, b, c = (world.vertices[world.triangles[:, k]].astype(np.float64) for k in range(3))
    face = np.cross(b - a, c - a)
    normals = np.zeros((len(world.vertices), 3))
    for k in range(3):
        np.add.at(normals, world.triangles[:, k], face)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
