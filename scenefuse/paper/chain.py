"""Poses chained from a pose network, frame after frame, and brought into the frame that masks and registration use."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scenefuse.core.stage import StageError, atomic_directory, quantity
from scenefuse.core.transforms import Array, Sim3, fit_sim3, rotation_angle_deg
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.paper.networks import PoseNetwork, small_photos
from scenefuse.photos.views import Views
from scenefuse.photos.workspace import read_workspace, write_model
from scenefuse.sfm.gravity import estimate_up


@torch.no_grad()
def chained(network: PoseNetwork, frames: DepthPhotos) -> Array:
    """(V, 4, 4) poses in the frame of the first camera: the motions between consecutive frames one after the other."""
    small = small_photos(frames)
    motions: Tensor = network(small[:-1], small[1:])
    poses = [np.eye(4)]
    for next_from_this in motions.double().cpu().numpy():
        poses.append(poses[-1] @ np.linalg.inv(next_from_this))
    return np.stack(poses)


def place_chain(own: Array, known: Array) -> tuple[Array, Sim3]:
    """Lay a chain (V, 4, 4) on SfM's poses (V, 4, 4) by one similarity: masks and gravity count in their frame.

    Returns:
        (V, 4, 4) object_from_cam, and object_from_first; its scale is object units per unit of the networks.

    Raises:
        StageError: the chain does not move, or along one line only.
    """
    try:
        fit = fit_sim3(own[:, :3, 3], known[:, :3, 3])
    except ValueError as error:
        raise StageError(
            f"the pose network's motions make no trajectory around the object ({error}): either it has learned no "
            "motion from these frames, or the camera moved along one line; walk around the object, or set "
            "object.stage1.pose_source to sfm, which runs the later stages from SfM's poses"
        ) from None
    placed = own.copy()
    placed[:, :3, :3], placed[:, :3, 3] = fit.rotation @ own[:, :3, :3], fit.apply(own[:, :3, 3])
    return placed, fit


def trajectory_error(name: str, poses: Array, reference: Array) -> dict[str, Any]:
    """Errors of (V, 4, 4) poses against others after a similarity fitted to the centres; nothing when they coincide."""
    centres, target = poses[:, :3, 3], reference[:, :3, 3]
    try:
        placed = fit_sim3(centres, target)
    except ValueError:
        return {}
    error = np.linalg.norm(placed.apply(centres) - target, axis=1)
    turned = placed.rotation @ poses[:, :3, :3] @ reference[:, :3, :3].swapaxes(1, 2)
    extent = float(np.linalg.norm(np.ptp(target, axis=0)))
    return {
        f"trajectory_error_{name}_over_extent": quantity(float(np.sqrt(np.mean(error**2))) / extent, "1"),
        f"rotation_error_{name}_deg": quantity(float(np.median([rotation_angle_deg(r) for r in turned])), "deg"),
    }


def write_posed(workspace: Path, posed: Path, views: Views, poses: Array) -> None:
    """Write a copy of an undistorted workspace with these poses (V, 4, 4) object_from_cam, and without points."""
    cameras = {view.name: view for view in read_workspace(workspace).views}
    moved = [replace(cameras[name], cam_from_world=np.linalg.inv(pose)) for name, pose in zip(views.names, poses)]
    with atomic_directory(posed) as folder:
        left_out = shutil.ignore_patterns("sparse", ".snakemake_timestamp")
        shutil.copytree(workspace, folder, ignore=left_out, dirs_exist_ok=True)
        (folder / "sparse").mkdir()
        write_model(folder / "sparse", moved)


def chain_quantities(own: Array, known: Array, used: Array, pose_source: str) -> dict[str, Any]:
    """How far a chain is from SfM's poses, all (V, 4, 4), and what later stages read of those that are used."""
    error = trajectory_error("chain", own, known)
    return {
        "pose_source": quantity(pose_source, ""),
        "photos_with_pose": quantity(len(known), "1"),
        "chain_is_a_trajectory": quantity(bool(error), ""),
        "frame": quantity("sfm", ""),
        "up_in_camera_frame": quantity(estimate_up(used[:, :3, :3], used[:, :3, 3])[0], "1"),
        **error,
    }
