"""True cameras of a capture, the truth file that holds them, and errors against a known truth: of cameras, depth,
surfaces with their F-scores, registrations."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.core.stage import StageError, quantity, read_json, threads, value
from scenefuse.core.transforms import Array, Sim3, fit_sim3, rotation_angle_deg
from scenefuse.photos.workspace import View, read_views

# The posed photos of a model that the truth knows, by name, each with the place of its true camera.
Posed = list[tuple[View, int]]
# A sampled point counts as hidden when a surface lies farther than this before it, metres.
HIDDEN = 0.02
# Points drawn from a true surface, and from a cloud for its distances to the truth.
SAMPLES = 60_000
# Distances at which clouds are scored, as shares of the object's diagonal, by the ending of their keys.
THRESHOLDS = {"025pct": 0.0025, "05pct": 0.005, "1pct": 0.01, "2pct": 0.02}


@dataclass(frozen=True)
class Cameras:
    """Photos of one capture: one camera, pinhole or with Brown's distortion, at many poses.

    Attributes:
        names: file names.
        intrinsics: (3, 3), pixels, pixel centres at +0.5.
        width: columns.
        height: rows.
        cam_from_world: (N, 3, 3) rotations, OpenCV axes.
        centres: (N, 3) in the world, metres.
        distortion: (4,) k1, k2, p1, p2 of Brown (1971), as in OpenCV and in COLMAP's OPENCV camera; zeros: a pinhole.
    """

    names: list[str]
    intrinsics: NDArray[np.float64]
    width: int
    height: int
    cam_from_world: NDArray[np.float64]
    centres: NDArray[np.float64]
    distortion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))

    @cached_property
    def camera(self) -> pycolmap.Camera:
        """The same camera without a pose, as COLMAP's OPENCV."""
        k = self.intrinsics
        params = [k[0, 0], k[1, 1], k[0, 2], k[1, 2], *self.distortion]
        return pycolmap.Camera(model="OPENCV", width=self.width, height=self.height, params=params)

    @cached_property
    def reach(self) -> float:
        """Tangent of the largest angle off the optical axis that a photo shows, at one of its corners."""
        corners = np.array([[x, y] for x in (0, self.width) for y in (0, self.height)], dtype=np.float64)
        return float(np.linalg.norm(np.asarray(self.camera.cam_from_img(corners)), axis=1).max())

    def rays(self, side: int) -> NDArray[np.float64]:
        """(H * W * side**2, 2) x and y at z = 1 of the rays through a grid of `side` x `side` samples in each pixel.

        Row by row; the samples of a pixel lie next to each other. The distortion is inverted exactly.
        """
        step = (np.arange(side) + 0.5) / side
        row, column, y, x = np.ix_(np.arange(self.height), np.arange(self.width), step, step)
        pixels = np.stack(np.broadcast_arrays(column + x, row + y), axis=-1)
        return np.asarray(self.camera.cam_from_img(pixels.reshape(-1, 2)))

    def project(self, photo: int, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(M, 2) pixels of (M, 3) points of the world in one photo, and which of them fall inside it.

        Pixels are NaN behind the camera and beyond `reach`: far outside a photo Brown's polynomial turns back and would
        put points into it that no ray comes from.
        """
        in_cam = (points - self.centres[photo]) @ self.cam_from_world[photo].T
        ahead = (in_cam[:, 2] > 0) & (np.linalg.norm(in_cam[:, :2], axis=1) <= self.reach * in_cam[:, 2])
        pixels = np.full((len(points), 2), np.nan)
        pixels[ahead] = self.camera.img_from_cam(in_cam[ahead])
        inside = (pixels >= 0) & (pixels < [self.width, self.height])
        return pixels, ahead & inside.all(1)


def pinhole(focal_px: float, width: int, height: int, shift: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """(3, 3) intrinsics with the principal point in the middle, or off it by shares of width and height."""
    return np.array([[focal_px, 0, width * (0.5 + shift[0])], [0, focal_px, height * (0.5 + shift[1])], [0, 0, 1.0]])


def visible(
    scene: o3d.t.geometry.RaycastingScene, cameras: Cameras, points: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where each photo shows each of (M, 3) points: (N, M, 2) pixels, and (N, M) whether nothing hides it.

    Pixels are those of the photo as taken, distorted if its lens does; NaN as in `Cameras.project`.
    A point counts as hidden when a ray towards it ends more than `tolerance` metres before it.
    """
    pixels = np.zeros((len(cameras.names), len(points), 2))
    seen = np.zeros((len(cameras.names), len(points)), dtype=bool)
    for k, centre in enumerate(cameras.centres):
        pixels[k], seen[k] = cameras.project(k, points)
        inside = np.flatnonzero(seen[k])
        away = points[inside] - centre
        distance = np.linalg.norm(away, axis=1)
        rays = np.concatenate([np.broadcast_to(centre, away.shape), away / distance[:, None]], axis=1)
        hit = scene.cast_rays(o3d.core.Tensor.from_numpy(rays.astype(np.float32)), nthreads=threads())["t_hit"].numpy()
        seen[k, inside] = hit > distance - tolerance
    return pixels, seen


def cameras_json(cameras: Cameras) -> dict[str, Any]:
    """The truth file of a capture; `distortion` is k1, k2, p1, p2 of COLMAP's camera model OPENCV."""
    return {
        "width": quantity(cameras.width, "px"),
        "height": quantity(cameras.height, "px"),
        "intrinsics": quantity(cameras.intrinsics, "px"),
        "distortion": quantity(cameras.distortion, "1"),
        "photos": {
            name: {
                "cam_from_world_rotation": quantity(rotation, "1"),
                "centre": quantity(centre, "m"),
            }
            for name, rotation, centre in zip(cameras.names, cameras.cam_from_world, cameras.centres)
        },
    }


def read_cameras(path: Path) -> Cameras:
    """Read a capture's truth file; StageError when it is missing or another file."""
    content = read_json(path)
    try:
        photos = content["photos"]
        return Cameras(
            list(photos),
            np.array(value(content, "intrinsics")),
            value(content, "width"),
            value(content, "height"),
            np.array([value(p, "cam_from_world_rotation") for p in photos.values()]),
            np.array([value(p, "centre") for p in photos.values()]),
            np.array(value(content, "distortion")),
        )
    except (KeyError, TypeError):
        raise StageError(f"{path} is not a truth file of the demo; render the capture again") from None


@dataclass(frozen=True)
class Mesh:
    """A true surface.

    Attributes:
        vertices: (V, 3) float32, metres, in the truth's frame.
        triangles: (T, 3) int32.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]

    def caster(self) -> o3d.t.geometry.RaycastingScene:
        """Open3D's ray caster with this mesh alone."""
        return cast_together([self])


@dataclass(frozen=True)
class CameraFit:
    """How well a model's cameras agree with the truth.

    Attributes:
        truth_from_model: similarity fitted to the camera centres.
        position: (N,) metres left after the fit.
        rotation_deg: (N,) angles left after the fit.
    """

    truth_from_model: Sim3
    position: Array
    rotation_deg: Array


def read_mesh(path: Path) -> Mesh:
    """Read a PLY mesh; StageError when it is missing or empty."""
    if not Path(path).is_file():
        raise StageError(f"{path} does not exist; render the demo again")
    mesh = o3d.t.io.read_triangle_mesh(str(path))
    if mesh.is_empty():
        raise StageError(f"{path} holds no mesh; render the demo again")
    return Mesh(mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy().astype(np.int32))


def cast_together(meshes: list[Mesh]) -> o3d.t.geometry.RaycastingScene:
    """One ray caster; a hit's geometry id is the mesh's place in the list."""
    scene = o3d.t.geometry.RaycastingScene(threads())
    for mesh in meshes:
        triangles = o3d.core.Tensor.from_numpy(mesh.triangles.astype(np.uint32))
        scene.add_triangles(o3d.core.Tensor.from_numpy(mesh.vertices), triangles)
    return scene


def distances(scene: o3d.t.geometry.RaycastingScene, points: Array) -> NDArray[np.float32]:
    """(N,) distance of (N, 3) points to the nearest surface, metres."""
    return scene.compute_distance(o3d.core.Tensor.from_numpy(points.astype(np.float32)), threads()).numpy()


def sample_surface(mesh: Mesh, count: int, seed: int) -> Array:
    """(count, 3) points spread evenly over a mesh's area."""
    rng = np.random.default_rng(seed)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = rng.choice(len(area), count, p=area / area.sum())
    u, v = np.sqrt(rng.random(count))[:, None], rng.random(count)[:, None]
    return (1 - u) * a[chosen] + u * (1 - v) * b[chosen] + u * v * c[chosen]


def read_posed(model: Path, truth: Cameras) -> Posed:
    """The posed photos of a COLMAP model whose names the truth knows; StageError when fewer than three are."""
    place = {Path(name).stem: k for k, name in enumerate(truth.names)}
    posed = [(view, place[Path(view.name).stem]) for view in read_views(model) if Path(view.name).stem in place]
    if len(posed) < 3:
        raise StageError(
            f"only {len(posed)} posed photos of {model} are known to the truth, three are needed; "
            "give the truth of the capture that the model was made from"
        )
    return posed


def fit_cameras(posed: Posed, truth: Cameras) -> CameraFit:
    """Fit the similarity from the model to the truth by camera centres, and measure what is left.

    The fit starts from the triple of cameras with the least median error (Rousseeuw 1984); cameras farther off than
    four times the median are left out of it, not of the errors.
    """
    centres, true = np.array([view.centre for view, _ in posed]), [k for _, k in posed]
    target = truth.centres[true]
    rng = np.random.default_rng(0)
    triples = [rng.choice(len(target), 3, replace=False) for _ in range(300)]
    error = min((_errors(centres, target, triple) for triple in triples), key=lambda e: float(np.median(e)))
    for _ in range(4):
        within = error <= max(4.0 * float(np.median(error)), 1e-9)
        fitted = fit_sim3(centres[within], target[within])
        error = np.linalg.norm(fitted.apply(centres) - target, axis=1)
    turned = [view.cam_from_world[:3, :3] @ fitted.rotation.T for view, _ in posed]
    angles = [rotation_angle_deg(a @ b.T) for a, b in zip(turned, truth.cam_from_world[true])]
    return CameraFit(fitted, error, np.array(angles))


def camera_results(fit: CameraFit, total: int) -> dict[str, Any]:
    """Errors of the cameras left after the fit, and the share of a capture's photos that have one."""
    return {
        "registered_share": quantity(len(fit.position) / total, "1"),
        "camera_position_median": quantity(float(np.median(fit.position)), "m"),
        "camera_position_max": quantity(float(fit.position.max()), "m"),
        "camera_rotation_median_deg": quantity(float(np.median(fit.rotation_deg)), "deg"),
        "camera_rotation_max_deg": quantity(float(fit.rotation_deg.max()), "deg"),
    }


def _errors(centres: Array, target: Array, chosen: NDArray[np.int64]) -> Array:
    """(N,) errors after fitting to the chosen pairs; infinite where they lie on one line."""
    try:
        return np.linalg.norm(fit_sim3(centres[chosen], target[chosen]).apply(centres) - target, axis=1)
    except ValueError:
        return np.full(len(target), np.inf)


def true_depth(
    scene: o3d.t.geometry.RaycastingScene, view: View, truth_from_model: Sim3, size: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """What a map of a photo should hold, cast from the model's own camera brought into the truth's frame.

    So a depth error is measured along the ray that the stage used, and does not count the camera's own error.

    Returns:
        (H, W) depth along z in metres, infinite for the sky, and (H, W) number of the mesh hit, -1 for none.
    """
    width, height = size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    # With z = 1 in the camera, the length along the ray is the depth.
    in_cam = pixels @ np.linalg.inv(view.resized(width, height).intrinsics).T
    directions = in_cam @ (view.cam_from_world[:3, :3] @ truth_from_model.rotation.T)
    centre = np.broadcast_to(truth_from_model.apply(view.centre), directions.shape)
    rays = np.concatenate([centre, directions], axis=-1).astype(np.float32)
    hits = scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=threads())
    return hits["t_hit"].numpy(), hits["geometry_ids"].numpy().view(np.int32).astype(np.int64)


@dataclass(frozen=True)
class RegistrationError:
    """An estimated scene_from_object against the true one."""

    scale_pct: float
    rotation_deg: float
    translation_over_diagonal: float


def registration_error(
    estimated: Sim3, true: Sim3, middle_in_object: Array, diagonal_in_scene: float
) -> RegistrationError:
    """Errors of a registration; the translation's is the shift of the object's middle, over its diagonal.

    Args:
        estimated: scene_from_object.
        true: the true one.
        middle_in_object: (3,) the object's middle in its own frame.
        diagonal_in_scene: the object's diagonal in the scene's unit.
    """
    shift = estimated.apply(middle_in_object) - true.apply(middle_in_object)
    return RegistrationError(
        100.0 * abs(estimated.scale / true.scale - 1.0),
        rotation_angle_deg(estimated.rotation @ true.rotation.T),
        float(np.linalg.norm(shift)) / diagonal_in_scene,
    )


def print_results(result: dict[str, Any]) -> None:
    """One line a number, with its unit."""
    for name, entry in result.items():
        if isinstance(entry.get("value"), float | int):
            print(f"{name}: {entry['value']:.5g} {entry['unit']}", flush=True)


def f_score(
    cloud_to_truth: NDArray[np.floating], truth_to_cloud: NDArray[np.floating], tau: float
) -> tuple[float, float, float]:
    """Precision, recall and their harmonic mean at a distance `tau`."""
    precision = float((cloud_to_truth <= tau).mean()) if len(cloud_to_truth) else 0.0
    recall = float((truth_to_cloud <= tau).mean()) if len(truth_to_cloud) else 0.0
    total = precision + recall
    return precision, recall, 2 * precision * recall / total if total > 0 else 0.0


def scores_at(
    cloud_to_truth: NDArray[np.floating], truth_to_cloud: NDArray[np.floating], diagonal: float
) -> dict[str, dict[str, float]]:
    """F-score, precision and recall at each of THRESHOLDS (method G8): {"1pct": {"f_score": ..., ...}, ...}.

    Args:
        cloud_to_truth: (N,) distances of the cloud's points to the true surface.
        truth_to_cloud: (M,) distances of points on the true surface to the cloud.
        diagonal: of the object's true bounding box, in the unit of the distances.
    """
    found = {}
    for ending, share in THRESHOLDS.items():
        precision, recall, score = f_score(cloud_to_truth, truth_to_cloud, share * diagonal)
        found[ending] = {"f_score": score, "precision": precision, "recall": recall}
    return found


def nearest(points: Array, cloud: Array) -> Array:
    """(N,) distance of each of (N, 3) points to the nearest point of a cloud; infinite when it is empty."""
    if len(cloud) == 0:
        return np.full(len(points), np.inf)
    return cKDTree(cloud).query(points, workers=threads())[0]
