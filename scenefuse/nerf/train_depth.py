"""Stage 1 of an object: a self-supervised depth network, and depth of every photo that photos and views confirm.

Its maps are laid on the SfM points of their photos by a robust scale and shift (method N1).
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import siegelslopes
from torch import Tensor

from scenefuse.cloud.cloud_file import NEIGHBOURS
from scenefuse.core.checkpoints import key_of
from scenefuse.core.stage import atomic_directory, quantity, setting, write_json
from scenefuse.core.transforms import Array
from scenefuse.mvs.photo_refinement import RefinementSettings
from scenefuse.nerf.monodepth import DepthNetwork, sample
from scenefuse.nerf.prior_inputs import STEREO, DepthPhotos, crop_to_object, depth_photos, network_inputs
from scenefuse.nerf.prior_training import Recipe, loss_quantities, predict, prepare_torch, train_network
from scenefuse.nerf.rendered_maps import MAP_AGREEMENT, confirm, write_prior
from scenefuse.photos.views import load_views

Content = dict[str, Any]


@dataclass(frozen=True)
class DepthTrainingSettings:
    """How stage 1 trains."""

    epochs: int = setting(5, least=0)
    """Epochs of training, each over all photos."""
    crop_px: int = 144
    """The network sees photos cut to the object, about this many pixels squared."""
    refinement: RefinementSettings = RefinementSettings()
    """Of its depths by photos."""
    map_agreement: float = MAP_AGREEMENT
    """Two depths of one place agree within this share of the object's diagonal."""


def train_depth(
    *,
    workspace: Path,
    masks: Path,
    stage: Path,
    report: Path,
    checkpoints: Path,
    settings: DepthTrainingSettings,
    width_px: int,
    hold_out_every: int,
    seed: int,
) -> None:
    """Train the depth network on one object's photos and write a depth map for each photo.

    Network and losses are those of Monodepth2 (method N10), trained from scratch. The network corrects a first
    disparity made of sparse points and stereo. Depth maps are along z, in object units, aligned to the sparse
    points of their photo by a robust scale and shift (N1), moved to where photos match (N13), 0 off the object.

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        stage: output folder: depth_maps/{photo}.bin and confidence_maps/{photo}.bin (0..1).
        report: output JSON: residuals at sparse points, losses, shares of the depths that photos moved, contradicted,
            confirmed, seconds.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of the training.
        width_px: width of the depth maps, that of the NeRF's photos.
        hold_out_every: every n-th photo is not trained on; 0 holds out none.
        seed: of weights, batches and sources.

    Raises:
        StageError: no photo with a mask, fewer than three photos, fewer than eight SfM points on the object, or the
            training diverged.
    """
    start = time.monotonic()
    device = prepare_torch(seed)
    views = load_views(workspace, masks, width_px, hold_out_every)
    crops = crop_to_object(views, settings.crop_px)
    photos = depth_photos(crops.views, STEREO.sources, device)
    inputs = network_inputs(photos)
    print(f"{len(photos.points)} photos, depth {photos.near:.4g} to {photos.far:.4g}, inputs ready", flush=True)
    network = DepthNetwork(inputs.channels.shape[1]).to(device)
    recipe = Recipe(settings.epochs)
    checkpoint = checkpoints / key_of("stage 1", recipe, seed, photos, inputs) / "state.pt"
    losses = train_network(network, photos, inputs, recipe, checkpoint, seed)
    aligned = align_maps(predict(network, photos, inputs.channels, inputs.first), photos)
    depths = np.zeros(views.masks.shape, np.float32)
    for index, place in enumerate(depths):
        height, width = views.sizes[index]
        place[:height, :width] = crops.paste(index, aligned[index, 0].cpu().numpy())
    prior, confirmed = confirm(views, depths, settings.refinement, settings.map_agreement)
    content: Content = {
        "photos": quantity(len(photos.points), "1"),
        "diagonal": quantity(photos.diagonal, "object units"),
        "device": quantity(str(device), ""),
        "residual_after_alignment": quantity(residual_at_checks(aligned, photos), "1"),
        **confirmed,
        **loss_quantities(losses),
    }
    with atomic_directory(stage) as folder:
        write_prior(folder, views, prior)
    write_json(report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    checkpoint.unlink(missing_ok=True)
    _print_quality(content)


def _print_quality(content: Content) -> None:
    residual, share = content["residual_after_alignment"]["value"], content["confirmed_share"]["value"]
    known = "no SfM points to check" if residual is None else f"median residual at SfM points {residual:.2%}"
    print(f"depth maps written: {known}, {share:.0%} of the object confirmed by other views", flush=True)


def align_maps(raw: Tensor, photos: DepthPhotos) -> Tensor:
    """Each (1, H, W) depth map aligned to the SfM points of its photo, never to those kept for checking."""
    aligned = []
    for maps, predicted, points in zip(raw, depths_at(raw, photos.points), photos.points):
        scale, shift = align_to_points(predicted, points[:, 2].astype(np.float64))
        aligned.append((scale * maps + shift).clamp_min(1e-3 * photos.near))
    return torch.stack(aligned)


def align_to_points(predicted: Array, measured: Array) -> tuple[float, float]:
    """Robust (scale, shift) with measured = scale * predicted + shift; 30 % and more outliers do no harm.

    Repeated medians (Siegel 1982). The shift is used, and the scale differs from one, only where each lowers the median
    residual by more than its sampling error, 1 / sqrt(N): with few points the depth map itself is the better evidence
    (method N1).

    Args:
        predicted: (N,) depths of the map at SfM points.
        measured: (N,) depths of those points.
    """
    if len(predicted) < NEIGHBOURS:
        return 1.0, 0.0

    line = siegelslopes(measured, predicted)
    options = [(1.0, 0.0), (float(np.median(measured / predicted)), 0.0), (float(line.slope), float(line.intercept))]
    costs = [
        float(np.median(np.abs(scale * predicted + shift - measured))) * (1 + free / np.sqrt(len(predicted)))
        for free, (scale, shift) in enumerate(options)
    ]
    return options[int(np.nanargmin(costs))]


def depths_at(maps: Tensor, points: list[NDArray[np.float32]]) -> list[Array]:
    """Depths of (V, 1, H, W) maps at each photo's points (N, 3; column, row, depth): V arrays."""
    pixels = (torch.from_numpy(of_photo[None, :, :2]).to(maps.device) for of_photo in points)
    return [sample(depth[None], at)[0, 0].double().cpu().numpy() for depth, at in zip(maps, pixels)]


def residual_at_checks(depth: Tensor, photos: DepthPhotos) -> float | None:
    """Median relative residual at the SfM points that no training saw; None where there are none."""
    pairs = zip(depths_at(depth, photos.checks), photos.checks)
    residuals = np.concatenate([np.abs(found / points[:, 2] - 1.0) for found, points in pairs])
    return float(np.median(residuals)) if len(residuals) else None
