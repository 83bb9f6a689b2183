"""An object of the demo as it truly is, and how far its depth maps and its cloud are from that."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.demo.cameras import Cameras, read_cameras, visible
from scenefuse.io.clouds import sampled
from scenefuse.io.maps import read_depth
from scenefuse.metrics.truth import (
    HIDDEN,
    CameraFit,
    Mesh,
    Posed,
    cast_together,
    distances,
    f_score,
    fit_cameras,
    nearest,
    read_mesh,
    read_posed,
    sample_surface,
    true_depth,
)
from scenefuse.stage import quantity, read_json, value
from scenefuse.transforms import Array


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


def depth_results(stages: list[Path], known: ObjectTruth, max_photos: int) -> dict[str, Any]:
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
    """Accuracy, completeness and F-scores of the object's cloud, in the truth's frame."""
    to_mesh = distances(known.mesh.caster(), sampled(points, samples, seed)) / known.diagonal
    to_cloud = nearest(known.surface[known.seen], points) / known.diagonal
    result = {
        "cloud_accuracy_median": quantity(100 * float(np.median(to_mesh)), "% of the diagonal"),
        "cloud_accuracy_90": quantity(100 * float(np.quantile(to_mesh, 0.9)), "% of the diagonal"),
    }
    for percent, label in ((0.5, "05"), (1.0, "1")):
        precision, recall, score = f_score(to_mesh, to_cloud, percent / 100)
        result[f"cloud_precision_{label}pct"] = quantity(precision, "1")
        result[f"cloud_completeness_{label}pct"] = quantity(recall, "1")
        result[f"cloud_f_score_{label}pct"] = quantity(score, "1")
    return result
