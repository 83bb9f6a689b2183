"""Planted registration trials: an object in an unknown frame and scale against a partial, noisy scene."""

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from scipy.spatial.transform import Rotation

from scenefuse.clouds import Cloud
from scenefuse.transforms import Sim3, rotation_angle_deg


@dataclass(frozen=True)
class Trial:
    """One trial: the object (own frame), the scene (z up), and what is true about them."""

    object: Cloud
    scene: Cloud
    scene_from_object: Sim3
    up_in_object: np.ndarray
    fiducials: np.ndarray
    coverage: float
    diagonal: float


def _mesh(parts):
    mesh = o3d.geometry.TriangleMesh()
    for part in parts:
        mesh += part
    return mesh


def _box(centre, size):
    box = o3d.geometry.TriangleMesh.create_box(*size)
    return box.translate(np.array(centre) - np.array(size) / 2)


def house():
    roof = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(
            [[-4.6, -3.6, 4], [4.6, -3.6, 4], [4.6, 3.6, 4], [-4.6, 3.6, 4], [-4.6, 0, 7], [4.6, 0, 7]]
        ),
        o3d.utility.Vector3iVector(
            [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [0, 4, 3], [1, 2, 5], [0, 3, 2], [0, 2, 1]]
        ),
    )
    windows = [_box((x, -3.02, 2.3), (1.2, 0.2, 1.2)) for x in (-2.6, 2.6)]
    return [
        _box((0, 0, 2), (8, 6, 4)),
        roof,
        _box((2, 1.2, 6.5), (0.9, 0.9, 2.5)),
        _box((0, -3.6, 1.2), (2.2, 1.4, 2.4)),
        *windows,
    ]


def sculpture():
    torus = o3d.geometry.TriangleMesh.create_torus(1.5, 0.55, 60, 30)
    torus.rotate(torus.get_rotation_matrix_from_xyz((np.pi / 2, 0, 0.3)), (0, 0, 0)).translate((0, 0, 4.2))
    sphere = o3d.geometry.TriangleMesh.create_sphere(0.8, 40).translate((0.35, 0.2, 6.6))
    return [torus, sphere, _box((0, 0, 1), (2.6, 2.2, 2.0)), _box((0.9, 0.4, 2.3), (0.6, 0.5, 0.6))]


def balloon():
    envelope = o3d.geometry.TriangleMesh.create_sphere(3.5, 60)
    vertices = np.asarray(envelope.vertices).copy()
    vertices[:, 2] = np.where(vertices[:, 2] < 0, vertices[:, 2] * 1.35, vertices[:, 2])
    envelope.vertices = o3d.utility.Vector3dVector(vertices)
    ropes = [_box((x, y, 2.9), (0.12, 0.12, 3)) for x in (-0.6, 0.6) for y in (-0.6, 0.6)]
    return [envelope.translate((0, 0, 8.5)), _box((0, 0, 1), (1.4, 1.4, 1.2)), *ropes]


SHAPES = {"house": house, "sculpture": sculpture, "balloon": balloon}


def _noise(points, seed, cells):
    """Smooth noise 0..1 in space: a few seeded plane waves."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, cells, (8, 3))
    return 0.5 + 0.5 * np.sin(points @ waves.T + rng.uniform(0, 6.28, 8)).mean(1) * 1.8


def paint(name, points, normals):
    """Colours 0..1 that depend on the place on the object only; the balloon has eight panels."""
    if name == "balloon":
        panel = np.floor((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * 8).astype(int) % 8
        palette = np.array(
            [
                [0.8, 0.15, 0.1],
                [0.95, 0.8, 0.1],
                [0.1, 0.3, 0.75],
                [0.9, 0.9, 0.88],
                [0.8, 0.15, 0.1],
                [0.15, 0.55, 0.25],
                [0.95, 0.8, 0.1],
                [0.45, 0.15, 0.5],
            ]
        )
        base = np.where((points[:, 2] > 4)[:, None], palette[panel], [0.45, 0.3, 0.15])
    else:
        roof = (normals[:, 2] > 0.3)[:, None]
        base = np.where(roof, [0.6, 0.28, 0.2], [0.78, 0.72, 0.6])
    shade = 0.55 + 0.6 * _noise(points, 3, 1.2)[:, None] * (0.7 + 0.5 * _noise(points, 4, 4.0)[:, None])
    return np.clip(base * shade, 0, 1)


def _visible(rays, points, cameras, least):
    """Points that at least `least` cameras see."""
    count = np.zeros(len(points), int)
    for camera in cameras:
        direction = camera - points
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        ray = np.concatenate([points + 2e-2 * direction, direction], 1).astype(np.float32)
        count += ~np.isfinite(rays.cast_rays(o3d.core.Tensor(ray))["t_hit"].numpy())
    return count >= least


def plant(
    name,
    seed,
    *,
    coverage=(0.5, 0.9),
    ground=True,
    noise=None,
    object_points=20000,
    scene_points=6000,
    slope=0.0,
    up_error_deg=2.0,
):
    """Make one trial; see the module's docstring."""
    rng = np.random.default_rng(seed)
    mesh = _mesh(SHAPES[name]())
    rays = o3d.t.geometry.RaycastingScene()
    rays.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    o3d.utility.random.seed(seed)
    sampled = mesh.sample_points_uniformly(4 * object_points, use_triangle_normal=True)
    points, normals = np.asarray(sampled.points), np.asarray(sampled.normals)
    centre, diagonal = mesh.get_center(), float(np.linalg.norm(np.ptp(np.asarray(mesh.vertices), axis=0)))
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    orbit = [
        centre + 1.3 * diagonal * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        for a in angles
        for e in (0.1, 0.6)
    ]
    outer = _visible(rays, points, orbit, 2)
    points, normals = points[outer], normals[outer]
    view = orbit[0] - centre
    outward = np.zeros(len(points), bool)
    for camera in orbit:
        view = camera - points
        seen = _visible(rays, points, [camera], 1)
        outward |= seen & ((view * normals).sum(1) > 0)
    normals = np.where(outward[:, None], normals, -normals)
    colors = paint(name, points, normals)

    azimuth = rng.uniform(0, 2 * np.pi)
    flight = [centre + np.array([x, y, 5 * diagonal]) for x in (-diagonal, diagonal) for y in (-diagonal, diagonal)]
    flight += [
        centre + 4 * diagonal * np.array([np.cos(azimuth + a) * 0.7, np.sin(azimuth + a) * 0.7, 0.7])
        for a in np.linspace(0, 1.5, rng.integers(1, 4))
    ]
    seen = np.flatnonzero(_visible(rays, points, flight, 1))
    wanted = rng.uniform(*coverage)
    if len(seen) > wanted * len(points):
        side = np.array([np.cos(azimuth), np.sin(azimuth), 0.6])
        order = np.argsort(-(points[seen] @ side))
        seen = seen[order[: int(wanted * len(points))]]
    share = len(seen) / len(points)
    seen = rng.permutation(seen)[:scene_points]
    sigma = (rng.choice([0.005, 0.01]) if noise is None else noise) * diagonal
    in_scene, scene_normals, scene_colors = points[seen], normals[seen], colors[seen]
    fiducials = _fiducials(in_scene)
    if ground:
        soil = rng.uniform(-1.1 * diagonal, 1.1 * diagonal, (3 * scene_points, 3)) + centre
        soil[:, 2] = slope * (soil[:, 0] - centre[0]) + 0.02 * diagonal * _noise(soil * [1, 1, 0], 9, 0.3)
        soil_colors = np.array([0.35, 0.42, 0.2]) * (0.5 + _noise(soil, 8, 1.0)[:, None])
        in_scene = np.concatenate([in_scene, soil])
        scene_normals = np.concatenate([scene_normals, np.tile([0.0, 0.0, 1.0], (len(soil), 1))])
        scene_colors = np.concatenate([scene_colors, soil_colors])
    in_scene = in_scene + rng.normal(0, sigma, in_scene.shape)
    gain = rng.uniform(0.7, 1.2, 3)
    chosen = rng.permutation(len(points))[:object_points]
    own = points[chosen] + rng.normal(0, 0.004 * diagonal, (len(chosen), 3))
    object_from_scene = Sim3(
        float(np.exp(rng.uniform(-2, 2))),
        Rotation.random(random_state=seed).as_matrix(),
        rng.normal(0, 20, 3),
    )
    tilt = Rotation.from_rotvec(np.radians(rng.normal(0, up_error_deg / 1.5, 3))).as_matrix()
    as_bytes = lambda c: (255 * np.clip(c, 0, 1)).astype(np.uint8)  # noqa: E731
    return Trial(
        Cloud(own, normals[chosen].astype(np.float32), as_bytes(colors[chosen] * gain)).transformed(object_from_scene),
        Cloud(in_scene, scene_normals.astype(np.float32), as_bytes(scene_colors)),
        object_from_scene.inverse(),
        object_from_scene.rotation @ tilt @ np.array([0.0, 0.0, 1.0]),
        fiducials,
        share,
        diagonal,
    )


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
