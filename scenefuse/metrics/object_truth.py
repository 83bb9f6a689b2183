"""An object of the demo as it truly is, and how far its depth maps and its cloud are from that."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import sampled
from scenefuse.core.stage import quantity, read_json, value
from scenefuse.core.transforms import Array
from scenefuse.metrics.scores import nearest, scores_at
from scenefuse.metrics.true_cameras import Cameras, read_cameras, visible
from scenefuse.metrics.truth import (
    HIDDEN,
    CameraFit,
    Mesh,
    Posed,
    belongs_to_object,
    cast_together,
    distances,
    fit_cameras,
    read_mesh,
    read_posed,
    sample_surface,
    true_depth,
)
from scenefuse.photos.pictures import read_depth

# Photos whose depth maps are compared, spread evenly.
COMPARED_PHOTOS = 8
# How far around the object's true box a scene's points count as its own, as a share of its diagonal: farther off than
# any stray point that a person would take for a part of it.
MARGIN = 0.05


@dataclass(frozen=True)
class ObjectTruth:
    """An object of the demo as it truly is, and the photos of its model placed in the truth; lengths in metres.

    Attributes:
        diagonal: of its bounding box.
        middle: (3,) of its bounding box.
        mesh: its surface.
        rest: terrain and clutter.
        everything: ray caster of the object, as mesh 0, and all else that stands there.
        orbit: the true cameras.
        posed: the photos of its model.
        fit: of their cameras to the true ones.
        surface: (N, 3) points spread over its surface.
        seen: (N,) those that any photo of the orbit sees.
    """

    diagonal: float
    middle: Array
    mesh: Mesh
    rest: Mesh
    everything: Any
    orbit: Cameras
    posed: Posed
    fit: CameraFit
    surface: Array
    seen: NDArray[np.bool_]


def read_object_truth(workspace: Path, truth_scene: Path, truth_object: Path, samples: int, seed: int) -> ObjectTruth:
    """The truth of an object and the poses of its model in it; arguments and errors as in `evaluate_object`."""
    orbit = read_cameras(truth_object / "cameras.json")
    extent = read_json(truth_object / "cameras.json")["object"]
    mesh, rest = read_mesh(truth_object / "mesh.ply"), read_mesh(truth_scene / "meshes" / "world.ply")
    others = [
        read_mesh(path)
        for path in sorted((truth_scene / "meshes").glob("*.ply"))
        if path.stem not in ("world", truth_object.name)
    ]
    everything = cast_together([mesh, rest, *others])
    posed = read_posed(workspace / "sparse", orbit)
    surface = sample_surface(mesh, samples, seed)
    return ObjectTruth(
        float(value(extent, "diagonal")),
        np.array(value(extent, "middle")),
        mesh,
        rest,
        everything,
        orbit,
        posed,
        fit_cameras(posed, orbit),
        surface,
        np.asarray(visible(everything, orbit, surface, HIDDEN)[1].any(0)),
    )


def depth_results(stages: list[Path], known: ObjectTruth, max_photos: int = COMPARED_PHOTOS) -> dict[str, Any]:
    """Depth errors of every stage over pixels that truly show the object; a missing depth is outside the 1 %."""
    posed, truth_from_object = known.posed, known.fit.truth_from_model
    chosen = np.unique(np.linspace(0, len(posed) - 1, min(max_photos, len(posed))).astype(int))
    result: dict[str, Any] = {}
    for stage in stages:
        errors, pixels = [np.empty(0)], 0
        for view in (posed[k][0] for k in chosen):
            path = stage / "depth_maps" / f"{view.name}.bin"
            if not path.is_file():
                continue
            depth = read_depth(path)
            size = depth.shape[1], depth.shape[0]
            true, hit = true_depth(known.everything, view, truth_from_object, size)
            on_object = hit == 0
            pixels += int(on_object.sum())
            valid = on_object & (depth > 0)
            errors.append(np.abs(depth[valid] * truth_from_object.scale - true[valid]) / known.diagonal)
        error = np.concatenate(errors)
        result |= {
            f"{stage.name}_depth_error": quantity(float(np.median(error)) if len(error) else None, "diagonals"),
            f"{stage.name}_depth_within_1pct": quantity(float((error <= 0.01).sum()) / pixels if pixels else None, "1"),
            f"{stage.name}_depth_present": quantity(len(error) / pixels if pixels else None, "1"),
        }
    return result


def cloud_results(points: Array, known: ObjectTruth, samples: int, seed: int) -> dict[str, Any]:
    """Accuracy, F-scores, precision and recall of the object's cloud (N, 3), in the truth's frame."""
    to_mesh = distances(known.mesh.caster(), sampled(points, samples, seed)) / known.diagonal
    to_cloud = nearest(known.surface[known.seen], points) / known.diagonal
    result = {
        "cloud_accuracy_median": quantity(100 * float(np.median(to_mesh)), "% of the diagonal"),
        "cloud_accuracy_90": quantity(100 * float(np.quantile(to_mesh, 0.9)), "% of the diagonal"),
    }
    for ending, scores in scores_at(to_mesh, to_cloud, 1.0).items():
        result |= {f"cloud_{name}_{ending}": quantity(score, "1") for name, score in scores.items()}
    return result


def around_object(points: Array, known: ObjectTruth) -> NDArray[np.bool_]:
    """(N,) points of a scene (N, 3), in the truth's frame, that count as the object's; see `belongs_to_object`.

    The box is that of the object's true surface, widened by MARGIN of its diagonal.
    """
    low, high, margin = known.surface.min(0), known.surface.max(0), MARGIN * known.diagonal
    near = ((points >= low - margin) & (points <= high + margin)).all(1)
    inside = np.flatnonzero(near)
    if len(inside):
        own, other = (distances(mesh.caster(), points[inside]) for mesh in (known.mesh, known.rest))
        near[inside] = belongs_to_object(points[inside], own, other, low, high, margin)
    return near


def scene_scores(points: Array, known: ObjectTruth, surface: Array) -> dict[str, dict[str, float]]:
    """F-score, precision and recall of a scene around the object, at every threshold; see `scores_at`.

    Args:
        points: (N, 3) the scene's points in the truth's frame.
        known: the object as it truly is.
        surface: (M, 3) what is to be found of the object's surface.
    """
    points = points[around_object(points, known)]
    to_mesh = distances(known.mesh.caster(), points) if len(points) else np.empty(0, dtype=np.float32)
    return scores_at(to_mesh, nearest(surface, points), known.diagonal)


def surface_to_find(known: ObjectTruth, flight: Cameras) -> Array:
    """(M, 3) what of the object's true surface any photo of its orbit or of the flight sees, in the truth's frame."""
    return known.surface[known.seen | visible(known.everything, flight, known.surface, HIDDEN)[1].any(0)]
