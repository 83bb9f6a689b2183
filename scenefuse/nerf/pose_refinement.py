"""The paper's refinement of poses by the NeRF's own gradients (method N11); off unless a learning rate is given.

Corrections are (V, 6): a rotation vector in radians and a shift of the camera's centre in nerf units, a photo each.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scenefuse.core.stage import quantity
from scenefuse.core.transforms import Array, Sim3, fit_sim3


def corrected(rotation: Tensor, center: Tensor, correction: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (R, 3, 3) and centres (R, 3) after corrections (R, 6), which turn on the left of the rotations."""
    x, y, z = correction[:, :3].unbind(1)
    o = torch.zeros_like(x)
    skew = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=1).view(-1, 3, 3)
    return torch.linalg.matrix_exp(skew) @ rotation, center + correction[:, 3:]


def refined_poses(
    poses: Array, training: NDArray[np.int64], nerf_from_object: Sim3, correction: Tensor
) -> tuple[Array, Sim3, dict[str, Any]]:
    """Poses after training, in the object's own frame.

    Photos alone do not fix the frame they are posed in: all cameras may drift together, and the field with them. This
    drift, the similarity that fits the training cameras' centres before to those after, is taken out of the poses and
    put into nerf_from_object.

    Args:
        poses: (V, 4, 4) object_from_cam before training.
        training: (T,) the photos that were trained on.
        nerf_from_object: before training.
        correction: (T, 6); all zero where poses were not refined.

    Returns:
        poses, nerf_from_object, and for the report how far the poses went.
    """
    poses, correction = poses.copy(), correction.cpu()
    if not correction.any():
        return poses, nerf_from_object, {"pose_refinement": quantity(False, "")}
    before = poses[training]
    rotation = torch.from_numpy(nerf_from_object.rotation @ before[:, :3, :3])
    center = torch.from_numpy(nerf_from_object.apply(before[:, :3, 3]))
    turned, moved = corrected(rotation, center, correction.double())
    after = _transformed(nerf_from_object.inverse(), turned.numpy(), moved.numpy())
    drift = fit_sim3(before[:, :3, 3], after[:, :3, 3])
    poses[training] = _transformed(drift.inverse(), after[:, :3, :3], after[:, :3, 3])
    angle = np.linalg.norm(correction[:, :3].numpy(), axis=1)
    shift = np.linalg.norm(poses[training][:, :3, 3] - before[:, :3, 3], axis=1)
    return poses, nerf_from_object @ drift, {
        "pose_refinement": quantity(True, ""),
        "pose_rotation_median": quantity(float(np.degrees(np.median(angle))), "deg"),
        "pose_shift_median": quantity(float(np.median(shift)), "object units"),
        "gauge_scale_removed": quantity(drift.scale, "1"),
        "gauge_shift_removed": quantity(float(np.linalg.norm(drift.translation)), "object units"),
    }  # fmt: skip


def _transformed(b_from_a: Sim3, rotation: Array, center: Array) -> Array:
    """(T, 4, 4) poses in b of cameras with rotations (T, 3, 3) and centres (T, 3) in a."""
    poses = np.tile(np.eye(4), (len(center), 1, 1))
    poses[:, :3, :3] = b_from_a.rotation @ rotation
    poses[:, :3, 3] = b_from_a.apply(center)
    return poses
