"""A registered object beside one reconstruction of all photos: how far its pose is off, where no truth is known.

snakemake --configfile config/examples/boulder/config.yaml --cores 2, and all photos as one scene of another run, then
PYTHONPATH=. python tests/benchmarks/joint_model.py --scene results/scenes/paving --object results/objects/boulder \\
    --joint joint/results/scenes/all
"""

from pathlib import Path

import numpy as np

from demo.truth import registration_error
from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import StageError, read_json, run, value
from scenefuse.core.transforms import Array, Sim3, fit_sim3_robust
from scenefuse.photos.workspace import posed_images, read_model

LEAST_PHOTOS = 4


def centres(model: Path) -> dict[str, Array]:
    """Camera centres (3,) of a COLMAP model by photo; photos that were turned or scaled since keep theirs."""
    return {image.name: image.projection_center() for image in posed_images(read_model(model))}


def from_joint(joint: dict[str, Array], model: Path) -> Sim3:
    """model_from_joint by the cameras that both have.

    Raises:
        StageError: they share too few.
    """
    own = centres(model)
    names = sorted(own.keys() & joint.keys())
    if len(names) < LEAST_PHOTOS:
        raise StageError(f"{model} shares {len(names)} photos with the joint model, {LEAST_PHOTOS} needed")
    in_joint, in_model = (np.array([side[name] for name in names]) for side in (joint, own))
    spread = float(np.linalg.norm(in_model.std(0)))
    model_from_joint, agree = fit_sim3_robust(in_joint, in_model, threshold=0.01 * spread)
    left = np.linalg.norm(model_from_joint.apply(in_joint) - in_model, axis=1)
    print(
        f"{model}: {agree.sum()} of {len(names)} cameras agree, {100 * np.median(left) / spread:.2f} % of their spread"
    )
    return model_from_joint


def joint_model(*, scene: Path, object: Path, joint: Path) -> None:
    """Print errors of every variant's pose, as if the joint model were true, beside its standard deviations.

    Args:
        scene: the scene's folder of results.
        object: the object's.
        joint: that of a scene made from the photos of both, under the same names.
    """
    together = centres(joint / "georeferenced")
    scene_from_joint = from_joint(together, scene / "georeferenced")
    scene_from_object = scene_from_joint @ from_joint(together, object / "sparse").inverse()
    points = read_cloud(object / "object.ply").points
    low, high = np.percentile(points, [1, 99], axis=0)
    diagonal = scene_from_object.scale * float(np.linalg.norm(high - low))
    for path in sorted(object.glob("registration/*/fine.json")):
        fine = read_json(path)
        print(f"{path.parent.name}: {value(fine, 'status')} ({value(fine, 'reason')})")
        matrix = value(fine, "scene_from_object")
        if matrix is None:
            continue
        error = registration_error(Sim3.from_matrix(np.array(matrix)), scene_from_object, points.mean(0), diagonal)
        stated = [value(fine, name) for name in ("scale_sd_log", "rotation_sd_deg", "translation_sd")]
        shift, sd = 100 * error.translation_over_diagonal, 100 * stated[2] / diagonal
        print(f"  scale {error.scale_pct:.3f} % (stated {100 * stated[0]:.3f})", end="")
        print(f", rotation {error.rotation_deg:.3f} degrees ({stated[1]:.3f}), shift {shift:.3f} % ({sd:.3f})")


if __name__ == "__main__":
    run(joint_model)
