"""The paper's networks: depth and pose, trained together; and errors of the motions found, for the report."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from scenefuse.core.stage import StageError, quantity
from scenefuse.core.transforms import Array, rotation_angle_deg
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.networks import DepthNetwork, convolutions


class PoseNetwork(nn.Module):
    """Strided convolutions over two stacked photos, averaged into one motion.

    Args:
        width: channels of the first layer.
        unit: length that an output of one stands for, in object units (the typical distance camera to object).
    """

    def __init__(self, unit: float, width: int = 16) -> None:
        super().__init__()
        self.unit = unit
        sizes = [6, width, width * 2, width * 4, width * 6]
        self.encoder = nn.Sequential(*(convolutions(before, after, 2) for before, after in zip(sizes, sizes[1:])))
        self.last = nn.Conv2d(sizes[-1], 6, 1)
        nn.init.normal_(self.last.weight, std=1e-3)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(self, target: Tensor, source: Tensor) -> Tensor:
        """(B, 3, H, W) target and source photos in 0..1 -> (B, 4, 4) source_from_target."""
        motion = self.last(self.encoder(torch.cat([target, source], 1) - 0.5)).mean((2, 3))
        return rigid(motion[:, :3], motion[:, 3:] * self.unit)


def rigid(axis_angle: Tensor, translation: Tensor) -> Tensor:
    """(B, 3) rotation vectors in radians and (B, 3) translations -> (B, 4, 4) transforms (Rodrigues' formula)."""
    x, y, z = axis_angle.unbind(1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    top = torch.cat([torch.matrix_exp(cross), translation[:, :, None]], 2)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(top), 1, 4)
    return torch.cat([top, bottom], 1)


def small_photos(photos: DepthPhotos) -> Tensor:
    """What the pose network sees: the photos at half size, unless they are tiny."""
    return functional.avg_pool2d(photos.images, 2) if min(photos.images.shape[2:]) > 64 else photos.images


@dataclass(frozen=True)
class Networks:
    """The two networks that are trained together."""

    depth: DepthNetwork
    pose: PoseNetwork

    def parts(self) -> dict[str, nn.Module]:
        """Both by name."""
        return {"depth": self.depth, "pose": self.pose}

    def load(self, state: dict[str, Any]) -> None:
        """Take the weights of `state`."""
        for name, network in self.parts().items():
            network.load_state_dict(state[name])


def save_networks(path: Path, networks: Networks, settings: dict[str, Any]) -> None:
    """What stage 3 continues from."""
    weights = {name: network.state_dict() for name, network in networks.parts().items()}
    torch.save(weights | {"settings": settings}, path)


def load_networks(path: Path) -> dict[str, Any]:
    """What `save_networks` wrote: `depth` and `pose` for `Networks.load`, and `settings`.

    Raises:
        StageError: the file is missing or holds something else.
    """
    if not path.is_file():
        raise StageError(f"{path} does not exist; run stage 1 first")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a truncated file raises any of half a dozen
        why = " ".join(str(error).split())[:200]
        raise StageError(f"{path} cannot be read ({why}); delete it and run stage 1 again") from None
    if not {"depth", "pose", "settings"} <= set(state):
        raise StageError(f"{path} holds no networks of stage 1; delete it and run stage 1 again")
    return state


@torch.no_grad()
def pose_quantities(network: PoseNetwork, photos: DepthPhotos, poses: np.ndarray) -> dict[str, Any]:
    """The network's relative rotations and translations against those of (V, 4, 4) poses object_from_cam.

    The same motion for all pairs tells nothing: beside the errors stand how far those found differ from their own mean,
    and what the mean of the true ones leaves.
    """
    small = small_photos(photos)
    order = np.flatnonzero(photos.trained)
    pairs = np.column_stack([order, photos.sources[order, 0].cpu().numpy()])
    target, source = torch.as_tensor(pairs).T
    found = network(small[target], small[source]).double().cpu().numpy()
    true = np.linalg.inv(poses[pairs[:, 1]]) @ poses[pairs[:, 0]]
    turns, true_turns = found[:, :3, :3], true[:, :3, :3]
    off = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1) / np.linalg.norm(true[:, :3, 3], axis=1)
    return {
        "pose_network_rotation_error_deg": quantity(_apart_deg(turns, true_turns), "deg"),
        "pose_network_rotation_to_find_deg": quantity(_apart_deg(true_turns, np.eye(3)), "deg"),
        "pose_network_rotation_varies_deg": quantity(_apart_deg(turns, _mean(turns)), "deg"),
        "rotation_error_of_one_motion_for_all_deg": quantity(_apart_deg(true_turns, _mean(true_turns)), "deg"),
        "pose_network_translation_error": quantity(float(np.median(off)), "1"),
    }


def _apart_deg(turns: Array, others: Array) -> float:
    """Median angle between rotations (N, 3, 3) and others, (N, 3, 3) or one (3, 3), in degrees."""
    return float(np.median([rotation_angle_deg(turn) for turn in turns @ others.swapaxes(-1, -2)]))


def _mean(turns: Array) -> Array:
    """The rotation (3, 3) nearest to all of (N, 3, 3)."""
    u, _, vt = np.linalg.svd(turns.sum(0))
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt)
