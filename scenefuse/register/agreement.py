"""How well a registered object and the scene crop agree: in numbers (method R10, R11, G1) and in a picture."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, sampled, spacing
from scenefuse.core.stage import atomic_file, quantity, threads
from scenefuse.core.transforms import Array, Sim3
from scenefuse.geometry.surface import NORMAL_NEIGHBOURS, SAMPLED_POINTS, normals_at
from scenefuse.photos.pictures import write_picture

# Of each of the picture's six views.
SIDE_PX = 460


@dataclass(frozen=True)
class AgreementSettings:
    """When points correspond."""

    tau_fraction: float = 0.016
    """Distance within which points correspond, as a share of the crop's diagonal."""


def registration_metrics(
    obj: Cloud, scene: Cloud, scene_from_object: Sim3, tau: float, diagonal: float, unit: str
) -> dict[str, dict[str, Any]]:
    """The registration.* numbers of one pose.

    The object's inliers are its points with a scene point within tau. The names without a suffix are the paper's:
    fitness = share of scene points with an object point within tau (the paper divides by the target); inlier_rmse = RMS
    distance of the object's inliers to their nearest scene points; normal_consistency = mean |n . n_nearest| over these
    pairs (chance 0.5). Beside them: fitness_source = share of the object's points that are inliers (Open3D's fitness);
    fitness_f_score = harmonic mean of both fitnesses; normal_consistency_self = mean |n . n'| between points and their
    neighbours in both whole clouds together.

    Args:
        obj: the object in its own frame.
        scene: the scene's points on the object.
        scene_from_object: the pose.
        tau: inlier distance.
        diagonal: of the full variant's crop.
        unit: of the scene's lengths.
    """
    moved = scene_from_object.apply(obj.points)
    ahead, partner = cKDTree(scene.points).query(moved, workers=threads())
    back = cKDTree(moved).query(scene.points, workers=threads())[0]
    inlier = ahead <= tau
    source, target = float(inlier.mean()), float((back <= tau).mean())
    rmse = float(np.sqrt((ahead[inlier] ** 2).mean())) if inlier.any() else None
    normals_object, normals_scene = (normals_at(points, points) for points in (moved, scene.points))
    facing = np.abs((normals_object[inlier] * normals_scene[partner[inlier]]).sum(1))
    return {
        "fitness": quantity(target, "1"),
        "fitness_source": quantity(source, "1"),
        "fitness_f_score": quantity(2 * source * target / max(source + target, 1e-12), "1"),
        "inlier_rmse": quantity(rmse, unit),
        "inlier_rmse_over_diagonal": quantity(None if rmse is None else rmse / diagonal, "1"),
        "normal_consistency": quantity(float(facing.mean()) if inlier.any() else None, "1"),
        "normal_consistency_self": quantity(self_consistency(np.concatenate([moved, scene.points])), "1"),
        "tau": quantity(tau, unit),
        "object_spacing": quantity(spacing(moved), unit),
        "scene_spacing": quantity(spacing(scene.points), unit),
    }


def self_consistency(points: Array) -> float:
    """Mean |n . n'| between points (N, 3) and their neighbours: how smooth a surface is, whatever it is of (method G1).

    Measured at SAMPLED_POINTS points at most; neighbours and normals are those of the whole cloud.
    """
    tree, at = cKDTree(points), sampled(points, SAMPLED_POINTS, seed=0)
    neighbours = tree.query(at, k=min(NORMAL_NEIGHBOURS, len(points)), workers=threads())[1]
    used, place = np.unique(neighbours, return_inverse=True)
    normals = normals_at(points, points[used])[place.reshape(neighbours.shape)]
    return float(np.abs(np.einsum("nk,njk->nj", normals[:, 0], normals[:, 1:])).mean())


def draw_alignment(path: Path, cloud: Cloud, scene: Cloud, scene_from_object: Sim3, seed: int) -> None:
    """Write a PNG: top, front and side views; above in two colours (scene grey, object orange), below as measured."""
    rng = np.random.default_rng(seed)
    obj, ground = (c[np.sort(rng.permutation(len(c))[:SAMPLED_POINTS])] for c in (cloud, scene))
    obj = obj.transformed(scene_from_object)
    # Strays at either side do not count.
    ends = np.array([np.percentile(each.points, [0.5, 99.5], axis=0) for each in (obj, ground)])
    low, high = ends[:, 0].min(0), ends[:, 1].max(0)
    points, half = np.concatenate([ground.points, obj.points]) - (low + high) / 2, 0.62 * float((high - low).max())
    flat, real = [], []
    for each, color in ((ground, (60, 60, 60)), (obj, (214, 92, 30))):
        flat.append(np.tile(color, (len(each), 1)))
        real.append(flat[-1] if each.colors is None else each.colors)
    views = (0, 1), (0, 2), (1, 2)
    rows = [
        np.concatenate([_splat(points, np.concatenate(colors), *axes, half) for axes in views], axis=1)
        for colors in (flat, real)
    ]
    with atomic_file(path) as temporary:
        write_picture(temporary, np.concatenate(rows))


def _splat(points: Array, colors: NDArray[Any], right: int, up: int, half: float) -> NDArray[np.uint8]:
    """Points with two axes to the right and up, the nearest drawn last, on white."""
    order = np.argsort(points @ np.cross(*np.eye(3)[[right, up]]), kind="stable")
    at = np.stack([1 - points[order, up] / half, points[order, right] / half + 1]) / 2 * SIDE_PX
    inside = ((at > 0) & (at < SIDE_PX - 1)).all(0)
    rows, columns = at[:, inside].astype(int)
    image = np.full((SIDE_PX, SIDE_PX, 3), 255, np.uint8)
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        image[rows + dv, columns + du] = colors[order][inside]
    return image
