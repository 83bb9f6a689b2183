"""Measure config/examples/castle_fountain against the photos' true cameras, after that workflow has run.

python tests/benchmarks/castle_fountain.py --results results --truth data/castle_fountain/truth.json
"""

from pathlib import Path

import numpy as np

from demo.truth import CameraFit, Cameras, fit_cameras, read_posed, registration_error
from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import read_json, run, value
from scenefuse.core.transforms import Sim3


def cameras(truth: dict, capture: str) -> Cameras:
    """The true cameras of `scene` or `object`, both in one metric frame."""
    photos = truth[capture]
    return Cameras(
        list(photos),
        np.array(next(iter(photos.values()))["K"]),
        1536,
        1024,
        np.array([photo["cam_from_world_rotation"] for photo in photos.values()]),
        np.array([photo["center_m"] for photo in photos.values()]),
    )


def line(name: str, fit: CameraFit) -> str:
    """One capture's cameras against the truth."""
    return (
        f"{name}: {len(fit.position)} cameras, position error median {np.median(fit.position):.4f} m, "
        f"rotation error median {np.median(fit.rotation_deg):.3f} degrees"
    )


def castle_fountain(*, results: Path, truth: Path) -> None:
    """Print errors of the cameras, and of every variant's similarity, against the truth.

    Args:
        results: the results folder of the workflow.
        truth: truth.json with the true cameras of both captures.
    """
    known = read_json(truth)
    scene, fountain = results / "scenes/courtyard", results / "objects/fountain"
    fits = {}
    for name, model in (("scene", scene / "georeferenced"), ("object", fountain / "undistorted/sparse")):
        true = cameras(known, name)
        fits[name] = fit_cameras(read_posed(model, true), true)
        print(line(name, fits[name]))
    scene_from_object = fits["scene"].truth_from_model.inverse() @ fits["object"].truth_from_model
    points = read_cloud(fountain / "object.ply").points
    low, high = np.percentile(points, [1, 99], axis=0)
    diagonal = scene_from_object.scale * float(np.linalg.norm(high - low))
    for path in sorted(fountain.glob("registration/*/fine.json")):
        fine = read_json(path)
        matrix = value(fine, "scene_from_object")
        if matrix is None:
            print(f"{path.parent.name}: {value(fine, 'status')} ({value(fine, 'reason')})")
            continue
        error = registration_error(Sim3.from_matrix(np.array(matrix)), scene_from_object, points.mean(0), diagonal)
        decision = f"{path.parent.name}: {value(fine, 'status')} ({value(fine, 'reason')})"
        shift = 100 * error.translation_over_diagonal
        print(
            f"{decision}; scale {error.scale_pct:.2f} %, rotation {error.rotation_deg:.2f} degrees, shift {shift:.2f} %"
        )


if __name__ == "__main__":
    run(castle_fountain)
