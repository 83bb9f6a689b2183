"""The demo's objects without any structure from motion: poses, stages 1 to 4 and the cloud from frames and masks.

snakemake --configfile config/demo.yaml config/examples/ideal_camera.yaml --cores 2
PYTHONPATH=. python tests/benchmarks/no_sfm.py --results results --settings config/demo.yaml --out results/bench/no_sfm

Without SfM nothing calibrates a lens, so the demo has to be the one of the ideal camera.
Taken from a finished demo are the frames and, as a person's own, the masks. The focal length is the one in the photos'
EXIF, as COLMAP reads it (without EXIF its guess, 1.2 times the longer side). Only the last step, which measures the
trajectory and the cloud, reads the truth; it aligns by the cameras' centres alone.
"""

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap

from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import StageError, quantity, run, value, write_json
from scenefuse.demo.cameras import read_cameras
from scenefuse.metrics.object_truth import cloud_results, read_object_truth
from scenefuse.nerf.object_cloud import CloudInputs, CloudSettings, make_object_cloud
from scenefuse.nerf.prior.refine_depth import EarlierStages, FeedbackSettings, refine_depth
from scenefuse.nerf.prior.train_depth import DepthTrainingSettings, train_depth
from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, train_object_nerf
from scenefuse.poses.find_poses import PoseSettings, find_poses


def workspace(frames: Path, masks: Path, folder: Path) -> None:
    """An undistorted workspace that knows no poses: the photos, their EXIF's focal length, and masks of their size."""
    for name in ("undistorted/images", "undistorted/sparse", "masks"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    model = pycolmap.Reconstruction()
    for number, path in enumerate(sorted(p for p in frames.iterdir() if not p.name.startswith(".")), 1):
        guess = pycolmap.infer_camera_from_image(path)
        params = [guess.mean_focal_length()] * 2 + [guess.width / 2, guess.height / 2]
        size = {"width": guess.width, "height": guess.height}
        model.add_camera_with_trivial_rig(pycolmap.Camera(model="PINHOLE", params=params, camera_id=number, **size))
        image = pycolmap.Image(name=path.name, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
        shutil.copy(path, folder / "undistorted/images" / path.name)
        mask = cv2.imread(str(masks / f"{path.stem}.png"), cv2.IMREAD_GRAYSCALE)
        if mask is not None:
            # the workflow's masks are those of undistorted photos, a pixel smaller here
            cv2.imwrite(str(folder / "masks" / f"{path.stem}.png"), cv2.resize(mask, (guess.width, guess.height)))
    model.write(folder / "undistorted/sparse")


def reconstruct(folder: Path, settings: dict[str, Any], hold_out_every: int, seed: int) -> None:
    """All stages from a workspace to the cloud, as the workflow runs them."""
    posed, masks = folder / "poses", folder / "masks"
    find_poses(
        workspace=folder / "undistorted", posed=posed, report=folder / "poses.json",
        settings=build(PoseSettings, settings["poses"]), seed=seed,
    )  # fmt: skip
    common: dict[str, Any] = {"checkpoints": folder / "checkpoints", "hold_out_every": hold_out_every, "seed": seed}

    def outputs(name: str) -> dict[str, Any]:
        return {"stage": folder / name, "report": folder / f"{name}.json"}

    def nerf(name: str, prior: str, previous: Path | None) -> None:
        train_object_nerf(
            inputs=NerfInputs(posed, masks, folder / prior, previous), **outputs(name), **common,
            settings=build(NerfSettings, settings["nerf"] | settings[name]),
        )  # fmt: skip

    train_depth(
        workspace=posed, masks=masks, **common, **outputs("stage1"),
        settings=build(DepthTrainingSettings, settings["stage1"]),
    )  # fmt: skip
    nerf("stage2", "stage1", None)
    refine_depth(
        workspace=posed, masks=masks, **common, **outputs("stage3"),
        earlier=EarlierStages(previous=folder / "stage1", rendered=folder / "stage2"),
        settings=build(FeedbackSettings, settings["stage3"]),
    )  # fmt: skip
    nerf("stage4", "stage3", folder / "stage2")
    make_object_cloud(
        inputs=CloudInputs(
            workspace=posed, workspace_json=folder / "poses.json", masks=masks,
            stage=folder / "stage4", stage_json=folder / "stage4.json",
        ),
        cloud=folder / "object.ply", report=folder / "object.json",
        settings=build(CloudSettings, settings["cloud"]), seed=seed,
    )  # fmt: skip


def no_sfm(
    *,
    results: Path = Path("results"),
    out: Path = Path("results/bench/no_sfm"),
    objects: tuple[str, ...] = ("house", "balloon", "sculpture"),
    settings: Path | None = None,
) -> None:
    """Reconstruct and measure; truth.json of each object's folder holds what is printed.

    Args:
        results: folder of a finished demo.
        out: output folder.
        objects: of the demo.
        settings: laid over the shipped ones, or none.
    """
    chosen = read_settings(settings)
    own, seed, samples = chosen["object"], chosen["seed"], chosen["evaluation"]["object"]["samples"]
    truth = results / "demo/demo/truth"
    for name in objects:
        source, folder = results / "objects" / name, out / name
        if read_cameras(truth / name / "cameras.json").distortion.any():
            raise StageError(
                f"the photos of {name} in {results} are distorted, and without SfM nothing calibrates their camera;"
                " render the demo with config/examples/ideal_camera.yaml"
            )
        workspace(source / "frames", source / "masks", folder)
        reconstruct(folder, own, own["hold_out_every"], seed)
        known = read_object_truth(folder / "poses", truth / "scene", truth / name, samples, seed)
        extent = float(np.linalg.norm(np.ptp(known.orbit.centres[[true for _, true in known.posed]], axis=0)))
        points = known.fit.truth_from_model.apply(read_cloud(folder / "object.ply").points)
        measured = {
            "photos": quantity(len(known.orbit.names), "1"),
            "photos_with_pose": quantity(len(known.posed), "1"),
            "trajectory_error_over_extent": quantity(float(np.sqrt(np.mean(known.fit.position**2))) / extent, "1"),
            "rotation_error_median_deg": quantity(float(np.median(known.fit.rotation_deg)), "deg"),
            "rotation_error_max_deg": quantity(float(known.fit.rotation_deg.max()), "deg"),
            **cloud_results(points, known, samples, seed),
        }
        write_json(folder / "truth.json", measured)
        print(f"{name}: " + ", ".join(f"{key} {value(measured, key):.5g}" for key in measured), flush=True)


if __name__ == "__main__":
    run(no_sfm)
