"""Stage 1 of an object: self-supervised depth and pose networks, and a depth map with a confidence for every photo."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scenefuse.core.checkpoints import key_of
from scenefuse.core.stage import atomic_directory, quantity, setting, write_json
from scenefuse.nerf.prior.consistency import consistency_between_views, residuals_at_points
from scenefuse.nerf.prior.crops import Crops, crop_to_object
from scenefuse.nerf.prior.first_depth import NetworkInputs, network_inputs
from scenefuse.nerf.prior.inputs import DepthPhotos, depth_photos
from scenefuse.nerf.prior.maps import (
    Content,
    align_maps,
    map_quantities,
    print_quality,
    residual_at_checks,
    tolerance_of,
    write_maps,
)
from scenefuse.nerf.prior.networks import depth_from_disparity, parameters
from scenefuse.nerf.prior.pose_network import pose_quantities
from scenefuse.nerf.prior.training import (
    Networks,
    Recipe,
    Supervision,
    loss_quantities,
    new_networks,
    predict,
    prepare_torch,
    save_networks,
    train_networks,
)
from scenefuse.photos.views import load_views

# The first part of the training compares photos at half size, where wrong depths still find their way.
COARSE_SHARE = 0.3


@dataclass(frozen=True)
class DepthTrainingSettings:
    """How stage 1 trains."""

    crop_px: int = setting(144, unit="px", least=32)
    """The networks see photos cut to the object, about this many pixels squared. More gives finer depth in more time
    and memory."""
    epochs: int = setting(15, least=0)
    """Epochs of training, each over all photos."""
    width_px: int = 320
    """Width at which photos are read and depth maps are written, pixels."""
    sources: int = 6
    """Other photos each photo is compared with."""
    sweep_planes: int = 48
    """Depth hypotheses of the plane sweep that feeds the network; 0 leaves it out."""
    batch_photos: int = 24
    """Photos per step."""
    warmup_epochs: int = 2
    """Epochs of linear rise of the learning rate before the cosine."""


def train_depth(
    *,
    workspace: Path,
    masks: Path,
    stage: Path,
    report: Path,
    checkpoints: Path,
    settings: DepthTrainingSettings,
    hold_out_every: int,
    seed: int,
) -> None:
    """Train the depth and pose networks on one object's photos and write a depth map for each photo.

    The networks and losses are those of Monodepth2 (method N10), trained from scratch. The depth network corrects a
    first disparity made of sparse points and a plane sweep, and the pose network learns beside it from detached depth.
    Depth maps are along z, in object units, aligned to the sparse points of their photo by a robust scale and shift
    (N1), 0 off the object.

    Args:
        workspace: undistorted COLMAP workspace of the object, with poses of SfM or those found without it (N11).
        masks: folder of masks named like the photos, .png.
        stage: output folder: depth_maps/{photo}.bin, confidence_maps/{photo}.bin (0..1) and networks.pt.
        report: output JSON: residuals at sparse points, losses, consistency, errors of the pose network, seconds.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of the training.
        hold_out_every: every n-th photo is not trained on; 0 holds out none.
        seed: of weights, batches and sources.

    Raises:
        StageError: no photo with a mask, fewer than three photos, fewer than eight SfM points on the object, or the
            training diverged.
    """
    start = time.monotonic()
    device = prepare_torch(seed)
    crops, photos, inputs = prepare_inputs(workspace, masks, settings, hold_out_every, device)
    print(f"{len(photos.points)} photos, depth {photos.near:.4g} to {photos.far:.4g}, inputs ready", flush=True)
    networks = new_networks(inputs.channels.shape[1], photos)
    supervision = Supervision(inputs.channels, inputs.first)
    recipe = Recipe(settings.epochs, settings.warmup_epochs, settings.batch_photos, COARSE_SHARE)
    checkpoint = checkpoints / key_of("stage 1", recipe, seed, photos, supervision) / "state.pt"
    losses = train_networks(networks, photos, supervision, recipe, checkpoint, seed)
    raw = predict(networks.depth, photos, supervision)
    depth = align_maps(raw, photos, seed)
    consistency = consistency_between_views(depth, photos, tolerance_of(photos))
    content: Content = {
        "workspace": quantity(workspace.name, ""),
        **_input_quantities(crops, photos, inputs, networks),
        "residual_before_alignment": quantity(residual_at_checks(raw, photos), "1"),
        "residual_per_photo": quantity(_residual_per_photo(depth, photos, crops.views.names), "1"),
        **map_quantities(depth, consistency, photos),
        **loss_quantities(losses),
        **pose_quantities(networks.pose, photos, crops.views.object_from_cam),
    }
    with atomic_directory(stage) as folder:
        write_maps(folder, crops, depth * photos.masks, consistency.confidence)
        save_networks(folder / "networks.pt", networks, asdict(settings))
    write_json(report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    checkpoint.unlink(missing_ok=True)
    print_quality(content)


def prepare_inputs(
    workspace: Path, masks: Path, settings: DepthTrainingSettings, hold_out_every: int, device: torch.device
) -> tuple[Crops, DepthPhotos, NetworkInputs]:
    """Photos cut to the object, the same as tensors, and what the depth network is given; for stages 1 and 3."""
    crops = crop_to_object(load_views(workspace, masks, settings.width_px, hold_out_every), settings.crop_px)
    photos = depth_photos(crops.views, settings.sources, device)
    return crops, photos, network_inputs(photos, settings.sweep_planes)


def _input_quantities(crops: Crops, photos: DepthPhotos, inputs: NetworkInputs, networks: Networks) -> Content:
    """What the training had to work with, and how good depth was before it."""

    def residual(disparity: Tensor) -> float | None:
        return residual_at_checks(depth_from_disparity(disparity, photos.near, photos.far), photos)

    return {
        "photos": quantity(len(photos.points), "1"),
        "photos_held_out": quantity(int((~photos.trained).sum()), "1"),
        "width_px": quantity(crops.masks.shape[2], "px"),
        "crop_px": quantity([photos.images.shape[3], photos.images.shape[2]], "px"),
        "nearest_depth": quantity(photos.near, "object units"),
        "farthest_depth": quantity(photos.far, "object units"),
        "diagonal": quantity(photos.diagonal, "object units"),
        "parameters": quantity(parameters(networks.depth, networks.pose), "1"),
        "device": quantity(str(photos.images.device), ""),
        "residual_between_points": quantity(residual(inputs.between_points), "1"),
        "residual_before_training": quantity(residual(inputs.first), "1"),
    }


def _residual_per_photo(depth: Tensor, photos: DepthPhotos, names: list[str]) -> dict[str, float]:
    residuals = residuals_at_points(depth, photos.points)
    return {name: float(np.median(r)) for name, r in zip(names, residuals) if len(r)}
