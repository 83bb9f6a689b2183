"""Planted registration trials: an object in an unknown frame and scale against a partial, noisy scene."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from demo import objects
from demo.objects import Part, blob, box, grid, join, lathe, tube
from scenefuse.cloud.clouds import Cloud, concatenate
from scenefuse.core.transforms import Sim3, rotation_angle_deg, rotation_between
from scenefuse.geometry.depth_test import FreeSpace, without_edges
from scenefuse.photos.workspace import View

OUTER_POINTS = 60000
# The seven parts of an error, in the order of a stated covariance.
AXES = ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z", "scale")


@dataclass(frozen=True)
class Trial:
    """One trial: the object (own frame), the scene (z up), and what is true about them."""

    object: Cloud
    scene: Cloud
    scene_from_object: Sim3
    up_in_object: np.ndarray
    fiducials: np.ndarray
    free_space: FreeSpace | None
    coverage: float
    diagonal: float
    axis: np.ndarray | None
    """Axis in the scene about which shape and colours repeat at every angle, or None."""


@dataclass(frozen=True)
class Shape:
    """A kind of object: its surface, and whether it is a surface of revolution, in shape and in colours."""

    parts: Callable[[], list[Part]]
    round: bool = False
    plain: bool = False


def _urn():
    """A turned urn: nothing tells one heading from another, neither shape nor colours."""
    heights = np.linspace(0, 5, 60)
    radii = 0.9 + 0.55 * np.sin(1.1 * heights + 0.4) + 0.12 * np.sin(5 * heights)
    profile = np.stack([radii, heights], axis=1)
    return [lathe(np.concatenate([[[0.0, 0.0]], profile, [[0.0, 5.0]]]), 160, 0)]


def _gate():
    """A thin gate: posts, two beams, laths and a lamp."""
    posts = [tube((x, 0, 0), (0.96 * x, 0, 4.2), 0.13, 0, 16) for x in (-2.2, 2.2)]
    beams = [box((-2.9, -0.12, 4.2), (2.9, 0.12, 4.45), 0), box((-2.4, -0.07, 3.5), (2.4, 0.07, 3.68), 0)]
    laths = [tube((x, 0, 3.6), (x, 0, 4.2), 0.05, 0) for x in (-1.1, 0.3)]
    lamp = blob((0.22, 0.22, 0.3), 0.0, 3, 1, 0).moved((1.2, 0.0, 3.2))
    rail = tube((-2.2, 0, 1.0), (-0.6, 0.9, 1.0), 0.06, 0)
    return [*posts, *beams, *laths, lamp, rail, tube((-0.6, 0.9, 0), (-0.6, 0.9, 1.1), 0.08, 0)]


def _wall():
    """Mostly one plane: a wall with pilasters, a niche's frame, a ledge and a buttress."""
    pilasters = [box((x, -0.32, 0), (x + 0.5, -0.2, 3.6), 0) for x in (-3.8, -0.4, 3.2)]
    frame = [box((0.8, -0.3, 0.5), (2.4, -0.2, 0.65), 0), box((0.8, -0.3, 2.4), (2.4, -0.2, 2.55), 0)]
    return [
        box((-4, -0.2, 0), (4, 0.2, 4), 0),
        box((-4.1, -0.35, 3.7), (4.1, 0.3, 4.1), 0),
        *pilasters,
        *frame,
        box((-2.6, -0.7, 0), (-1.4, -0.2, 0.6), 0),
        tube((-3.0, 0.9, 0.0), (-3.0, 0.25, 2.6), 0.25, 0, 16),
    ]


def _beast():
    """An organic shape: a body, a head, legs and a tail, all bumpy."""
    legs = [
        blob((0.26, 0.28, 0.75), 0.15, 4, k, 0).moved((x, y, 0.6))
        for k, (x, y) in enumerate([(-0.8, 0.4), (-0.9, -0.4), (0.8, 0.45), (0.7, -0.4)])
    ]
    body = blob((1.5, 0.75, 0.7), 0.2, 5, 11, 0).moved((0.0, 0.0, 1.5))
    head = blob((0.55, 0.42, 0.45), 0.25, 4, 12, 0).moved((1.65, 0.15, 2.3))
    neck = tube((1.1, 0.05, 1.8), (1.6, 0.12, 2.25), 0.3, 0, 24)
    return [*legs, body, head, neck, tube((-1.4, 0, 1.7), (-2.1, 0.5, 2.4), 0.12, 0, 16)]


SHAPES = {
    "house": Shape(lambda: objects.house().parts),
    "balloon": Shape(lambda: objects.balloon().parts, round=True),
    "sculpture": Shape(lambda: objects.sculpture().parts),
    "urn": Shape(_urn, round=True, plain=True),
    "gate": Shape(_gate),
    "wall": Shape(_wall),
    "beast": Shape(_beast),
}


def _gabled(half_width, half_depth, eaves, ridge):
    """A house with a saddle roof along x."""
    w, d = half_width, half_depth
    foot, wall = [[[x, y, z] for x, y in ((-w, -d), (w, -d), (w, d), (-w, d))] for z in (0, eaves)]
    vertices = np.array([*foot, *wall, [-w, 0, ridge], [w, 0, ridge]], dtype=float)
    sides = [(0, 1, 5), (0, 5, 4), (2, 3, 7), (2, 7, 6), (0, 4, 7), (0, 7, 3), (1, 2, 6), (1, 6, 5)]
    roof = [(4, 5, 9), (4, 9, 8), (6, 7, 8), (6, 8, 9), (4, 8, 7), (5, 6, 9)]
    return Part(vertices, np.array(sides + roof), 0)


_PORCH, _ANNEX = box((-1, -3.8, 0), (1.2, -2.6, 2.2), 0), box((4, -1.5, 0), (6, 0.8, 2.2), 0)
_CHIMNEY, _FLAT = box((1.8, 0.6, 2), (2.4, 1.2, 5.2), 0), box((-4, -2.6, 0), (4, 2.6, 3.6), 0)
# Buildings of one footprint, 8 x 5.2, that hold each other's poses.
BUILDINGS = {
    "gable": Shape(lambda: [_gabled(4, 2.6, 2.6, 4.6)]),
    "gable, porch, chimney": Shape(lambda: [_gabled(4, 2.6, 2.6, 4.6), _CHIMNEY, _PORCH]),
    "gable, porch, chimney, higher": Shape(lambda: [_gabled(4, 2.6, 4.0, 5.2), _CHIMNEY, _PORCH]),
    "gable, annex, chimney": Shape(lambda: [_gabled(4, 2.6, 2.6, 4.6), _CHIMNEY, _ANNEX]),
    "gable, annex, other chimney": Shape(
        lambda: [_gabled(4, 2.6, 2.6, 4.6), box((-2.4, 0.6, 2), (-1.8, 1.2, 5.2), 0), _ANNEX]
    ),
    "flat": Shape(lambda: [_FLAT]),
    "flat, lower": Shape(lambda: [box((-4, -2.6, 0), (4, 2.6, 2.6), 0)]),
    "flat, higher": Shape(lambda: [box((-4, -2.6, 0), (4, 2.6, 4.6), 0)]),
    "flat, porch": Shape(lambda: [_FLAT, _PORCH]),
    "flat, annex": Shape(lambda: [_FLAT, _ANNEX]),
}


def _noise(points, seed, cells):
    """Smooth noise 0..1 in space: a few seeded plane waves."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, cells, (8, 3))
    return 0.5 + 0.5 * np.sin(points @ waves.T + rng.uniform(0, 6.28, 8)).mean(1) * 1.8


def _paint(name, points, normals):
    """Colours 0..1 that depend on the place on the object only; the balloon has eight panels, the urn rings."""
    if name == "urn":
        return np.clip((0.5 + 0.2 * np.sin(3 * points[:, 2]))[:, None] * [1.0, 0.8, 0.6], 0, 1)
    if name == "balloon":
        panel = np.floor((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * 8).astype(int) % 8
        red, yellow, blue, white = [0.8, 0.15, 0.1], [0.95, 0.8, 0.1], [0.1, 0.3, 0.75], [0.9, 0.9, 0.88]
        green, violet = [0.15, 0.55, 0.25], [0.45, 0.15, 0.5]
        palette = np.array([red, yellow, blue, white, red, green, yellow, violet])
        base = np.where((points[:, 2] > 4)[:, None], palette[panel], [0.45, 0.3, 0.15])
    else:
        base = np.where((normals[:, 2] > 0.3)[:, None], [0.6, 0.28, 0.2], [0.78, 0.72, 0.6])
    shade = 0.55 + 0.6 * _noise(points, 3, 1.2)[:, None] * (0.7 + 0.5 * _noise(points, 4, 4.0)[:, None])
    return np.clip(base * shade, 0, 1)


def _mesh(part):
    mesh = o3d.t.geometry.TriangleMesh()
    mesh.vertex.positions = o3d.core.Tensor.from_numpy(part.vertices.astype(np.float32))
    mesh.triangle.indices = o3d.core.Tensor.from_numpy(part.triangles.astype(np.int32))
    return mesh


def sampled(parts, count, seed, noise):
    """A noisy cloud on the surfaces of parts, without colours."""
    o3d.utility.random.seed(seed)
    found = _mesh(join(parts)).to_legacy().sample_points_uniformly(count, use_triangle_normal=True)
    points = np.asarray(found.points) + np.random.default_rng(seed).normal(0, noise, (count, 3))
    return Cloud(points, np.asarray(found.normals).astype(np.float32))


def _seen_by(rays, points, camera):
    """(N,) bool: no surface between the points and the camera."""
    direction = camera - points
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ray = np.concatenate([points + 2e-2 * direction, direction], 1).astype(np.float32)
    return ~np.isfinite(rays.cast_rays(o3d.core.Tensor.from_numpy(ray))["t_hit"].numpy())


@cache
def _outer(name):
    """The part of a shape (z up) that photos from around it see: mesh, points, normals, colours, centre, diagonal."""
    part = join((SHAPES | BUILDINGS)[name].parts())
    mesh = _mesh(part).to_legacy()
    rays = o3d.t.geometry.RaycastingScene()
    rays.add_triangles(_mesh(part))
    o3d.utility.random.seed(1)
    sampled = mesh.sample_points_uniformly(2 * OUTER_POINTS, use_triangle_normal=True)
    points, normals = np.asarray(sampled.points), np.asarray(sampled.normals)
    above = points[:, 2] > 0
    points, normals = points[above], normals[above]
    low, high = points.min(0), points.max(0)
    centre, diagonal = (low + high) / 2, float(np.linalg.norm(high - low))
    votes, outward = np.zeros(len(points), int), np.zeros(len(points))
    for azimuth in np.linspace(0, 2 * np.pi, 12, endpoint=False):
        for elevation in (0.1, 0.6):
            direction = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
            camera = centre + 1.3 * diagonal * np.array(direction)
            seen = _seen_by(rays, points, camera)
            votes += seen
            outward += seen * np.sign(((camera - points) * normals).sum(1))
    keep = np.flatnonzero(votes >= 2)[:OUTER_POINTS]
    normals = np.where((outward < 0)[:, None], -normals, normals)
    return part, points[keep], normals[keep], _paint(name, points[keep], normals[keep]), centre, diagonal


def plant(
    name,
    seed,
    *,
    coverage=0.7,
    ground=True,
    noise=0.005,
    object_points=20000,
    density_ratio=0.5,
    clutter=0,
    slope=0.0,
    up_error_deg=1.5,
    scale_log=2.3,
    depth_maps=True,
):
    """Make one trial.

    Args:
        name: of a shape.
        seed: of everything random.
        coverage: share of the object's outer surface that the scene shows: seen from above and from one side.
        ground: whether the scene has ground around the object, sloping by `slope`.
        noise: standard deviation of the scene's points, as a share of the object's diagonal.
        object_points: points of the object's cloud.
        density_ratio: points per area of the scene over those of the object.
        clutter: bushes beside the object, in and around its box.
        slope: of the ground.
        up_error_deg: error of the object's up direction.
        scale_log: the object's unit is exp(-scale_log) to exp(scale_log) scene units.
        depth_maps: whether the scene's depth maps are made.
    """
    rng = np.random.default_rng([seed, *name.encode()])
    part, points, normals, colors, centre, diagonal = _outer(name)
    rays = o3d.t.geometry.RaycastingScene()
    own = rays.add_triangles(_mesh(part))
    azimuth = rng.uniform(0, 2 * np.pi)
    soil = _soil(rng, centre, diagonal, slope) if ground else None
    bushes = [_bush(rng, centre, diagonal) for _ in range(clutter)]
    for b in bushes:
        rays.add_triangles(_mesh(b))

    cameras = [centre + [x, y, 4 * diagonal] for x in (-diagonal, diagonal) for y in (-diagonal, diagonal)]
    seen = np.zeros(len(points), bool)
    for camera in cameras:
        seen |= _seen_by(rays, points, camera)
    for turn in (0.0, 0.5, -0.5, 1.0, -1.0, 1.7, -1.7, 2.4, -2.4, 3.1):
        if seen.mean() >= coverage and len(cameras) > 4:
            break
        direction = [0.75 * np.cos(azimuth + turn), 0.75 * np.sin(azimuth + turn), 0.66]
        cameras.append(centre + 3 * diagonal * np.array(direction))
        seen |= _seen_by(rays, points, cameras[-1])
    shown = np.flatnonzero(seen)
    if len(shown) > coverage * len(points):
        side = np.array([np.cos(azimuth), np.sin(azimuth), 0.6])
        shown = shown[np.argsort(-(points[shown] @ side))[: int(coverage * len(points))]]
    share = len(shown) / len(points)
    count = int(np.clip(object_points * density_ratio * share, 300, len(shown)))
    shown = rng.permutation(shown)

    in_scene = [(points[shown[:count]], normals[shown[:count]], colors[shown[:count]])]
    per_area = count / share / (diagonal**2)
    for extra, hue in [(soil, (0.35, 0.42, 0.2)), *((b, (0.2, 0.35, 0.12)) for b in bushes)]:
        if extra is not None:
            in_scene.append(_sampled(extra, int(max(200, 0.7 * per_area * _area(extra))), hue, rng))
    fiducials = _fiducials(in_scene[0][0])
    scene_points, scene_normals, scene_colors = (np.concatenate(kind) for kind in zip(*in_scene))
    scene_points = scene_points + rng.normal(0, noise * diagonal, scene_points.shape)

    gain = rng.uniform(0.7, 1.2, 3)
    chosen = rng.permutation(len(points))[:object_points]
    object_cloud = points[chosen] + rng.normal(0, 0.004 * diagonal, (len(chosen), 3))
    object_from_scene = Sim3(
        float(np.exp(rng.uniform(-scale_log, scale_log))),
        Rotation.random(random_state=rng).as_matrix(),
        rng.normal(0, 20, 3),
    )
    tilt = Rotation.from_rotvec(np.radians(rng.normal(0, up_error_deg / 1.4, 3))).as_matrix()
    if soil is not None:
        rays.add_triangles(_mesh(soil))
    free_space = None
    if depth_maps:
        views = _depth_maps(rays, own, cameras, points[shown], centre, diagonal, noise, rng)
        free_space = FreeSpace([without_edges(v) for v in views], 0.03 * diagonal)
    shape = (SHAPES | BUILDINGS)[name]
    return Trial(
        Cloud(object_cloud, normals[chosen].astype(np.float32), _bytes(colors[chosen] * gain)).transformed(
            object_from_scene
        ),
        Cloud(scene_points, scene_normals.astype(np.float32), _bytes(scene_colors)),
        object_from_scene.inverse(),
        object_from_scene.rotation @ tilt @ np.array([0.0, 0.0, 1.0]),
        fiducials,
        free_space,
        share,
        diagonal,
        np.array([0.0, 0.0, 1.0]) if shape.round and shape.plain else None,
    )


def plant_wide(name, seed, times, *, absent=False, ground_points=300_000, slope=0.0, noise=0.005, **given):
    """A trial in a landscape `times` as wide as the object: hills, two other objects, bushes, boulders.

    Args:
        name, seed, slope, noise, given: as of `plant`.
        times: width of the landscape over the object's.
        absent: whether another object stands where this one would.
        ground_points: of the landscape at most.
    """
    rng, names = np.random.default_rng([seed, times, *name.encode()]), list(SHAPES)
    others = [names[(names.index(name) + k) % len(names)] for k in rng.permutation(np.arange(1, len(names)))[:3]]
    trial = plant(name, seed, ground=False, noise=noise, depth_maps=False, **given)
    shown = plant(others[2], seed, ground=False, noise=noise, depth_maps=False, **given) if absent else trial
    diagonal, per_area = trial.diagonal, len(shown.scene) / shown.diagonal**2
    width = times * float(np.ptp(trial.scene_from_object.apply(trial.object.points)[:, :2], axis=0).max())
    centre, hills = rng.uniform(-0.3, 0.3, 2) * width, int(rng.integers(1000))

    def height(xy):
        flat = np.c_[xy, 0 * xy[:, 0]]
        rolling = 0.02 * diagonal * _noise(flat / diagonal, hills, 4.0) + 0.02 * width * _noise(
            flat / width, hills, 4.0
        )
        return slope * xy[:, 0] + rolling

    def placed(cloud, at, scale=1.0):
        foot = np.array([*at, float(height(at[None])[0] - height(np.zeros((1, 2)))[0])])
        turn = Rotation.from_rotvec([0, 0, 0 if scale == 1.0 else rng.uniform(0, 6)]).as_matrix()
        return cloud.transformed(Sim3(scale, turn, foot))

    clouds = [shown.scene]
    for other, angle in zip(others[:2], rng.uniform(0, np.pi) + np.array([0, np.pi * 0.8])):
        cloud = plant(other, seed + 1, ground=False, noise=noise, depth_maps=False, **given)
        scale = diagonal / cloud.diagonal * float(np.exp(rng.uniform(-0.5, 0.3)))
        reach = max(1.3 * diagonal, rng.uniform(0.1, 0.3) * width)
        clouds.append(placed(cloud.scene, reach * np.array([np.cos(angle), np.sin(angle)]), scale))
    for k in range(6 * times):
        size = rng.uniform(0.05, 0.2) * diagonal
        at = rng.uniform(-0.5, 0.5, 2) * width - centre
        if np.linalg.norm(at) < 0.7 * diagonal + size:
            continue
        thing = blob((size, size, rng.uniform(0.6, 1.4) * size), 0.3, 3, int(rng.integers(1000)), 0)
        hue = (0.2, 0.35, 0.12) if k % 3 else (0.45, 0.43, 0.4)
        points, normals, colors = _sampled(thing, int(max(100, 0.7 * per_area * _area(thing))), hue, rng)
        up = points[:, 2] > -0.3 * size
        points += rng.normal(0, noise * diagonal, points.shape)
        clouds.append(placed(Cloud(points[up], normals[up].astype(np.float32), _bytes(colors[up])), at))
    count = min(ground_points, int(0.7 * per_area * width**2))
    xy = rng.uniform(-0.5, 0.5, (count, 2)) * width - centre
    step = 1e-3 * width
    slopes = [(height(xy + d) - height(xy - d)) / (2 * step) for d in (np.array([step, 0]), np.array([0, step]))]
    normals = np.stack([-slopes[0], -slopes[1], np.ones(count)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.c_[xy, height(xy) - height(np.zeros((1, 2)))] + rng.normal(0, noise * diagonal, (count, 3))
    shade = 0.5 + _noise(points / diagonal, hills + 1, 3.0)[:, None]
    clouds.append(Cloud(points, normals.astype(np.float32), _bytes(np.array([0.35, 0.42, 0.2]) * shade)))
    return replace(trial, scene=concatenate(clouds), coverage=0.0 if absent else trial.coverage)


def _bytes(colors):
    return (255 * np.clip(colors, 0, 1)).astype(np.uint8)


def _soil(rng, centre, diagonal, slope):
    """Uneven ground through z = 0 under the object."""
    x, y = np.meshgrid(np.linspace(-1.1, 1.1, 40) * diagonal, np.linspace(-1.1, 1.1, 40) * diagonal, indexing="ij")
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    z = slope * xy[:, 0] + 0.02 * diagonal * (
        _noise(np.c_[xy, 0 * xy[:, 0]] / diagonal, int(rng.integers(100)), 4.0) - 0.5
    )
    return grid(np.concatenate([xy + centre[:2], z[:, None]], axis=1).reshape(40, 40, 3), 0)


def _bush(rng, centre, diagonal):
    """A bush beside the object, from near enough to touch it to out of its box."""
    angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 0.7) * diagonal
    size = rng.uniform(0.05, 0.12) * diagonal
    at = (centre[0] + reach * np.cos(angle), centre[1] + reach * np.sin(angle), 0.5 * size)
    return blob((size, size, 1.2 * size), 0.3, 3, int(rng.integers(1000)), 0).moved(at)


def _area(part):
    a, b, c = (part.vertices[part.triangles[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _sampled(part, count, hue, rng):
    """Points, outward normals and colours on a mesh of one hue."""
    a, b, c = (part.vertices[part.triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    size = np.linalg.norm(cross, axis=1)
    index = rng.choice(len(size), count, p=size / size.sum())
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points = a[index] + u * (b - a)[index] + v * (c - a)[index]
    shade = 0.5 + _noise(points, 8, 1.0)[:, None]
    return points, cross[index] / size[index, None], np.clip(np.array(hue) * shade, 0, 1)


def _depth_maps(rays, own, cameras, shown, centre, diagonal, noise, rng):
    """What each of the scene's cameras measured: nothing where the object was not reconstructed."""
    tree = cKDTree(shown)
    views: list[View] = []
    for camera in cameras:
        width, height = 160, 120
        focal = 0.9 * width * np.linalg.norm(camera - centre) / (2.4 * diagonal)
        intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        forward = (centre - camera) / np.linalg.norm(centre - camera)
        right = np.cross(forward, [0.0, 1e-3, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        local = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)], -1)
        ray = np.concatenate([np.broadcast_to(camera, (*u.shape, 3)), local @ rotation], -1).astype(np.float32)
        hit = rays.cast_rays(o3d.core.Tensor.from_numpy(ray))
        depth, of = hit["t_hit"].numpy(), hit["geometry_ids"].numpy()
        depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        world = camera + depth[..., None] * (local @ rotation)
        lost = np.zeros(depth.shape, bool)
        lost[of == own] = tree.query(world[of == own], distance_upper_bound=0.03 * diagonal)[0] > 0.03 * diagonal
        depth = np.where(lost | (depth <= 0), 0, depth + rng.normal(0, noise * diagonal, depth.shape)).astype(
            np.float32
        )
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ camera
        views.append(View(f"{len(views)}.jpg", intrinsics, pose, width, height, depth))
    return views


def _fiducials(points):
    """What a person would click: the extreme points of what the scene shows."""
    directions = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 0], [-1, -1, 0]])
    return points[np.unique(np.argmax(points @ directions.T, axis=0))]


def errors(estimate: Sim3, truth: Sim3, centre_in_object, diagonal, axis=None):
    """Scale error in %, rotation error in degrees (about `axis` free when given), translation error over diagonal."""
    turn = estimate.rotation @ truth.rotation.T
    if axis is None:
        angle = rotation_angle_deg(turn)
    else:
        angle = float(np.degrees(np.arccos(np.clip((turn @ axis) @ axis, -1, 1))))
    shift = np.linalg.norm(estimate.apply(centre_in_object) - truth.apply(centre_in_object)) / diagonal
    return 100 * (estimate.scale / truth.scale - 1), angle, float(shift)


def deviations(estimate: Sim3, truth: Sim3, centre_in_object, axis=None):
    """(7,) errors of rotation vector (radians), shift of a place (3,) in the object's frame, log scale, as in `AXES`.

    Where an axis (3,) in the scene is given, about which the object may turn freely, the turn is the least that brings
    the axis back to its place.
    """
    turn = estimate.rotation @ truth.rotation.T
    if axis is not None:
        turn = rotation_between(axis, turn @ axis)
    shift = estimate.apply(centre_in_object) - truth.apply(centre_in_object)
    return np.array([*Rotation.from_matrix(turn).as_rotvec(), *shift, np.log(estimate.scale / truth.scale)])
