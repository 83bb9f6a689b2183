"""Depth and pose networks of a monocular video, trained by nothing but its frames and masks (Godard et al. 2019).

Lengths are in the networks' own unit, about the distance of the camera to the object: a video says nothing of scale.
In stage 3 they learn two sets of depth maps, fused by inverse variance where views agree (after AltNeRF; method N12).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from scenefuse.core.checkpoints import State, read_state
from scenefuse.core.stage import StageError, quantity, setting
from scenefuse.core.transforms import Array, rotation_angle_deg
from scenefuse.mvs.plane_sweep import MIN_TEXTURE
from scenefuse.nerf.rendered_maps import MAP_AGREEMENT
from scenefuse.paper.depth_photos import DepthPhotos, pictures, residual_at_checks
from scenefuse.paper.monodepth import (
    NEAR,
    DepthNetwork,
    convolutions,
    depth_from_disparity,
    inside,
    masked_mean,
    points_in_cam,
    project,
    sample,
    smoothness,
)
from scenefuse.paper.network_training import Objective, PhotoScale, Recipe, huber, reprojection_error
from scenefuse.photos.views import Views

# Photos are compared at these fractions of their size one after the other, in equal parts of the training.
SHRINKS = (4, 2, 1)
Content = dict[str, Any]

# Depths that differ by more standard deviations are of different surfaces.
MAX_DEVIATIONS = 3.0


class PoseNetwork(nn.Module):
    """Strided convolutions over two stacked photos, averaged into one motion."""

    def __init__(self) -> None:
        super().__init__()
        sizes = [6, 16, 32, 64, 96]
        self.encoder = nn.Sequential(*(convolutions(before, after, 2) for before, after in zip(sizes, sizes[1:])))
        self.last = nn.Conv2d(sizes[-1], 6, 1)
        nn.init.normal_(self.last.weight, std=1e-3)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(self, target: Tensor, source: Tensor) -> Tensor:
        """(B, 3, H, W) target and source photos in 0..1 -> (B, 4, 4) source_from_target."""
        motion = self.last(self.encoder(torch.cat([target, source], 1) - 0.5)).mean((2, 3))
        return rigid(motion[:, :3], motion[:, 3:])


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

    def state(self) -> State:
        """The weights of both by name."""
        return {name: network.state_dict() for name, network in self.parts().items()}


def save_networks(path: Path, networks: Networks, width_px: int, unit: float) -> None:
    """What stage 3 continues from: the networks, the width of their frames, object units per unit of theirs."""
    torch.save(networks.state() | {"width_px": width_px, "unit": unit}, path)


def load_networks(path: Path, device: torch.device) -> tuple[Networks, int, float]:
    """What `save_networks` wrote.

    Raises:
        StageError: the file is missing or damaged.
    """
    networks = new_monocular_networks(device)
    like = networks.state() | {"width_px": 0, "unit": 0.0}
    saved = read_state(path, like, "delete its folder and run stage 1 again")
    for name, network in networks.parts().items():
        network.load_state_dict(saved[name])
    return networks, saved["width_px"], saved["unit"]


@torch.no_grad()
def pose_quantities(network: PoseNetwork, photos: DepthPhotos, poses: Array) -> dict[str, Any]:
    """The network's relative rotations and translations against those of (V, 4, 4) poses object_from_cam, and how far
    these turn: the error of standing still."""
    small = small_photos(photos)
    target = torch.as_tensor(np.flatnonzero(photos.trained))
    source = photos.sources[target, 0].cpu()
    found = network(small[target], small[source]).double().cpu().numpy()
    true = np.linalg.inv(poses[source]) @ poses[target]
    off = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1) / np.linalg.norm(true[:, :3, 3], axis=1)
    apart, turns = found[:, :3, :3] @ true[:, :3, :3].swapaxes(1, 2), true[:, :3, :3]
    error, to_find = (float(np.median([rotation_angle_deg(turn) for turn in of])) for of in (apart, turns))
    return {
        "pose_network_rotation_error_deg": quantity(error, "deg"),
        "pose_network_rotation_to_find_deg": quantity(to_find, "deg"),
        "pose_network_translation_error": quantity(float(np.median(off)), "1"),
    }


@dataclass(frozen=True)
class MonocularSettings:
    """How long the networks train, and on what."""

    epochs: int = setting(15, least=0)
    """Recipe `paper` only: epochs of this stage, each over all photos."""
    width_px: int = 192
    """Width of the frames, pixels."""


def frames_of(views: Views, device: torch.device) -> DepthPhotos:
    """The frames without any pose or point, each compared with the trained frames before and after it in time.

    Raises:
        StageError: fewer than three frames to train on, or frames that do not differ.
    """
    if (~views.held_out).sum() < 3:
        raise StageError(
            f"only {(~views.held_out).sum()} frames with a mask can be trained on; the pose network needs at least 3: "
            "take more photos around the object, or set object.hold_out_every to 0"
        )
    nothing = [np.zeros((0, 3), np.float32)] * len(views.names)
    frames = DepthPhotos(
        *pictures(views, device),
        torch.eye(4, device=device).repeat(len(views.names), 1, 1),
        ~views.held_out,
        torch.as_tensor(neighbours(~views.held_out), device=device),
        nothing,
        nothing,
        NEAR,
        diagonal=1.0,
    )
    _check_motion(frames)
    return frames


def neighbours(trained: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(V, 2) the trained frames next to each frame in time, one before and one after; at an end the nearest two."""
    rows = np.flatnonzero(trained)
    found = []
    for index in range(len(trained)):
        before, after = rows[rows < index][-1:], rows[rows > index][:1]
        near = np.concatenate([before, after])
        if len(near) < 2:
            others = rows[rows != index]
            near = others[np.argsort(np.abs(others - index), kind="stable")[:2]]
        found.append(near)
    return np.array(found)


def _check_motion(frames: DepthPhotos) -> None:
    """StageError where no frame differs from the next: depth and poses are learned from parallax alone."""
    change = (frames.images - frames.images[frames.sources[:, 1]]).abs().mean(1, keepdim=True)
    if float(masked_mean(change, frames.masks)) < MIN_TEXTURE:
        raise StageError(
            "the object looks the same in all frames: without motion of the camera there is no parallax to learn depth "
            "and poses from; walk around the object, or set object.frames.frame_step higher"
        )


def new_monocular_networks(device: torch.device) -> Networks:
    """Untrained networks: depth from colours alone, motion in the networks' unit."""
    return Networks(DepthNetwork().to(device), PoseNetwork().to(device))


def monocular_losses(
    networks: Networks, frames: DepthPhotos, recipe: Recipe, known: tuple[Tensor, Tensor] | None = None
) -> Objective:
    """Monodepth2's loss of depth and motion together: minimum reprojection over the neighbours, auto-mask, smoothness.

    The auto-mask is that of full size, as there: on small photos of an object in their middle it leaves nothing at all.
    With known depths (V, 1, H, W) and their weights, 0 where there is none (stage 3), the depth network is also held to
    these, and the pose network to what the frames look like through them.
    """
    scales, small = [PhotoScale(frames, shrink) for shrink in SHRINKS], small_photos(frames)
    steps = recipe.steps(frames)

    def losses(chosen: Tensor, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        scale = scales[step * len(scales) // steps]
        disparity = networks.depth(frames.images[chosen])
        depth = depth_from_disparity(disparity)
        sources = frames.sources[chosen]
        moves = torch.stack([networks.pose(small[chosen], small[of]) for of in sources.T], 1)
        unmoved = scale.unmoved[chosen] if scale is scales[-1] else None
        error, counts = reprojection_error(scale, chosen, sources, depth, moves, unmoved)
        parts = {
            "photometric": masked_mean(error, counts),
            "smoothness": smoothness(disparity, frames.images[chosen], frames.masks[chosen]),
        }
        if known is not None:
            target, weight = (maps[chosen] for maps in known)
            given = torch.where(weight > 0, target, depth.detach())
            error, seen = reprojection_error(scale, chosen, sources, given, moves, None)
            off = huber(depth / target.clamp_min(NEAR) - 1.0)
            parts["target"] = (off * weight).sum() / weight.sum().clamp_min(1.0)
            parts["pose"] = masked_mean(error, seen)
        return parts

    return losses


@torch.no_grad()
def variance_between_views(depth: Tensor, photos: DepthPhotos) -> Tensor:
    """(V, 1, H, W) mean squared difference from the depths of source views, object units squared.

    Infinite where no source view agrees within MAX_DEVIATIONS times the difference that other depth maps may have, and
    off the object. The square of this difference is added: no depth is better known.

    Args:
        depth: (V, 1, H, W), 0 where there is none.
        photos: the photos; their sources are the views compared with.
    """
    depth, tolerance = depth * photos.masks, MAP_AGREEMENT * photos.diagonal
    variance = torch.full_like(depth, torch.inf)
    for view, sources in enumerate(photos.sources):
        moves = photos.source_from_target(torch.full_like(sources, view), sources)
        cameras = photos.intrinsics[view : view + 1], photos.intrinsics[sources]
        difference, seen = reprojection_differences(depth[view : view + 1], depth[sources], moves, *cameras)
        close = seen & (difference.abs() < MAX_DEVIATIONS * tolerance)
        mean_square = (difference**2 * close).sum(0) / close.sum(0)
        variance[view, 0] = torch.where(close.any(0), mean_square + tolerance**2, torch.inf)
    return variance


def blend_depths(predicted: Tensor, rendered: Tensor, photos: DepthPhotos) -> tuple[Tensor, Tensor, dict[str, float]]:
    """Blend two sets of (V, 1, H, W) depth maps, each weighted by its agreement between views: depths, 0 where neither
    was accepted; their weights as targets, 0..1; shares of the object's pixels that were rendered, accepted, blended.
    """
    variances = [variance_between_views(depth, photos) for depth in (predicted, rendered)]
    depth, variance = fuse_by_inverse_variance(predicted, rendered, *variances)
    weight = ((MAP_AGREEMENT * photos.diagonal) ** 2 / variance).clamp(0.0, 1.0)
    both = (depth > 0) & torch.isfinite(variances[0]) & torch.isfinite(variances[1])
    counted = {"accepted_share": depth > 0, "blended_share": both, "rendered_share": rendered > 0}
    area = photos.masks.sum().clamp_min(1)
    return depth, weight, {name: float(where.sum() / area) for name, where in counted.items()}


def fuse_by_inverse_variance(first: Tensor, second: Tensor, *variances: Tensor) -> tuple[Tensor, Tensor]:
    """Blend two depth maps of the same view by inverse variance (after AltNeRF; method N12).

    A map without a variance has no weight. Where both have one and differ by more than three standard deviations of
    their difference, neither is accepted.

    Args:
        first: (V, 1, H, W) depth, 0 where there is none.
        second: the other.
        variances: of either, squared units, infinite where no other view agrees.

    Returns:
        (V, 1, H, W) fused depth, 0 where rejected, and its variance, infinite where rejected.
    """
    a, b = variances
    rejected = (first - second) ** 2 >= MAX_DEVIATIONS**2 * (a + b)
    weight = torch.where(rejected, 0.0, 1 / a + 1 / b)
    mean = (first / a + second / b) / weight
    return torch.where(weight > 0, mean, 0.0), 1 / weight


def reprojection_differences(
    depth: Tensor, others: Tensor, other_from_view: Tensor, of_view: Tensor, of_others: Tensor
) -> tuple[Tensor, Tensor]:
    """Forward-backward check of one view's depth map against those of other views.

    Each pixel goes into another view with its depth, takes the depth found there, and comes back.

    Args:
        depth: (1, 1, H, W) depth, 0 where there is none.
        others: (S, 1, H, W) depths of the other views, 0 where there is none.
        other_from_view: (S, 4, 4) rigid transforms.
        of_view: (1, 3, 3) intrinsics.
        of_others: (S, 3, 3) intrinsics.

    Returns:
        (S, H, W) depth that came back minus depth; (S, H, W) bool, True where both views have a depth.
    """
    count, (height, width) = len(others), depth.shape[2:]
    points = points_in_cam(depth, of_view).expand(count, -1, -1)
    pixels, z = project(points, other_from_view, of_others)
    have = (others > 0).to(depth.dtype)
    found = sample(torch.cat([others, have], 1), pixels)
    seen = inside(pixels, z, height, width) & (found[:, 1] > 0.999) & (depth > 0).view(1, -1)
    rays = torch.linalg.inv(of_others) @ torch.cat([pixels, torch.ones_like(pixels[..., :1])], 2).transpose(1, 2)
    _, returned = project(rays * found[:, :1], torch.linalg.inv(other_from_view), of_view.expand(count, -1, -1))
    return (returned - depth.view(1, -1)).view(count, height, width), seen.view(count, height, width)


def map_quantities(depth: Tensor, photos: DepthPhotos) -> Content:
    """Residual at SfM points, and the share of the object's pixels with which another view agrees."""
    agrees = torch.isfinite(variance_between_views(depth, photos))
    return {
        "residual_after_alignment": quantity(residual_at_checks(depth, photos), "1"),
        "consistent_share": quantity(float(agrees.sum() / photos.masks.sum().clamp_min(1)), "1"),
    }
