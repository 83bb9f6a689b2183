"""Depth and pose networks of a monocular video, trained by nothing but its frames and masks (Godard et al. 2019).

Lengths are in the networks' own unit, about the distance of the camera to the object: a video says nothing of scale.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scenefuse.core.stage import StageError, setting
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.networks import DepthNetwork, depth_from_disparity, disparity_from_depth
from scenefuse.nerf.prior.self_supervision import masked_mean, smoothness
from scenefuse.nerf.prior.training import Objective, PhotoScale, Recipe, huber, reprojection_error
from scenefuse.paper.networks import Networks, PoseNetwork, small_photos
from scenefuse.paper.recipe import BATCH_PHOTOS, WARMUP_EPOCHS
from scenefuse.photos.views import Views

# What the depth network can say: an object that fits into its photos, about 1 away, is neither nearer nor farther.
NEAR, FAR = 0.5, 2.0
# Photos are compared at these fractions of their size one after the other, in equal parts of the training.
SHRINKS = (4, 2, 1)
# Frames that differ less on the object, on the mean, show no motion: two grey levels.
MIN_CHANGE = 2 / 255


@dataclass(frozen=True)
class Supervision:
    """What the networks are trained on, (V, 3, H, W) colours from -1 to 1 and (V, 1, H, W) first disparities; in stage
    3 (V, 1, H, W) depths to learn and their weights, 0 where there is none."""

    colors: Tensor
    first: Tensor
    target: Tensor | None = None
    weight: Tensor | None = None


@dataclass(frozen=True)
class MonocularSettings:
    """How long the networks train, and on what."""

    epochs: int = setting(15, least=0)
    """Epochs of this stage, each over all photos."""
    width_px: int = 192
    """Width of the frames, pixels."""


def recipe_of(settings: MonocularSettings) -> Recipe:
    """The paper's batches and warm-up."""
    return Recipe(settings.epochs, WARMUP_EPOCHS, BATCH_PHOTOS, even=False)


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
    count = len(views.names)

    def as_tensor(array: NDArray[np.generic]) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    nothing = [np.zeros((0, 3), np.float32)] * count
    frames = DepthPhotos(
        as_tensor(views.images).permute(0, 3, 1, 2).contiguous() / 255.0,
        as_tensor(views.masks)[:, None],
        as_tensor(views.beyond)[:, None],
        as_tensor(views.intrinsics),
        torch.eye(4, device=device).repeat(count, 1, 1),
        ~views.held_out,
        torch.as_tensor(neighbours(~views.held_out), device=device),
        nothing,
        nothing,
        NEAR,
        FAR,
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
    if float(masked_mean(change, frames.masks)) < MIN_CHANGE:
        raise StageError(
            "the object looks the same in all frames: without motion of the camera there is no parallax to learn depth "
            "and poses from; walk around the object, or set object.frames.frame_step higher"
        )


def new_monocular_networks(device: torch.device) -> Networks:
    """Untrained networks: depth from colours alone, motion in the networks' unit."""
    return Networks(DepthNetwork(3).to(device), PoseNetwork(1.0).to(device))


def supervision_of(frames: DepthPhotos, target: Tensor | None = None, weight: Tensor | None = None) -> Supervision:
    """Colours, with a first depth of 1 everywhere; (V, 1, H, W) target depths and weights."""
    one = disparity_from_depth(torch.ones_like(frames.masks), NEAR, FAR)
    return Supervision(frames.images * 2.0 - 1.0, one, target, weight)


def monocular_losses(networks: Networks, frames: DepthPhotos, supervision: Supervision, recipe: Recipe) -> Objective:
    """Monodepth2's loss of depth and motion together: minimum reprojection over the neighbours, auto-mask, smoothness.

    The auto-mask is that of full size, as there: on small photos of an object in their middle it leaves nothing at all.
    With target depths (stage 3) the depth network is also held to these, and the pose network to what the frames look
    like through them.
    """
    scales, small = [PhotoScale(frames, shrink) for shrink in SHRINKS], small_photos(frames)
    steps = recipe.steps(frames)

    def losses(chosen: Tensor, step: int, generator: torch.Generator) -> dict[str, Tensor]:
        scale = scales[step * len(scales) // steps]
        disparity = networks.depth(supervision.colors[chosen], supervision.first[chosen])
        depth = depth_from_disparity(disparity, NEAR, FAR)
        sources = frames.sources[chosen]
        moves = torch.stack([networks.pose(small[chosen], small[of]) for of in sources.T], 1)
        unmoved = scale.unmoved[chosen] if scale is scales[-1] else None
        error, counts = reprojection_error(scale, chosen, sources, depth, moves, unmoved)
        parts = {
            "photometric": masked_mean(error, counts),
            "smoothness": smoothness(disparity, frames.images[chosen], frames.masks[chosen]),
        }
        if supervision.target is not None and supervision.weight is not None:
            target, weight = supervision.target[chosen], supervision.weight[chosen]
            given = torch.where(weight > 0, target, depth.detach())
            error, seen = reprojection_error(scale, chosen, sources, given, moves, None)
            # Nothing says that these networks' depth is nearly right: every error counts in full.
            off = huber(depth / target.clamp_min(NEAR) - 1.0, math.inf)
            parts["target"] = (off * weight).sum() / weight.sum().clamp_min(1.0)
            parts["pose"] = masked_mean(error, seen)
        return parts

    return losses
