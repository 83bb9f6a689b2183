"""Stage 1 by the paper: self-supervised depth and pose networks, and poses chained from the latter."""

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from scenefuse.core.checkpoints import key_of
from scenefuse.core.stage import atomic_directory, quantity, write_json
from scenefuse.core.transforms import Array
from scenefuse.nerf.prior.alignment import align_maps, residual_at_checks
from scenefuse.nerf.prior.confirmed import DepthPrior, write_prior
from scenefuse.nerf.prior.inputs import DepthPhotos, depth_photos
from scenefuse.nerf.prior.networks import parameters
from scenefuse.nerf.prior.self_supervision import sample
from scenefuse.nerf.prior.training import loss_quantities, optimise, predict, prepare_torch
from scenefuse.paper.chain import chain_quantities, chained, place_chain, write_posed
from scenefuse.paper.fused_depth import Content, consistency_between_views, map_quantities, print_quality
from scenefuse.paper.monocular import (
    MonocularSettings,
    frames_of,
    monocular_losses,
    new_monocular_networks,
    recipe_of,
    supervision_of,
)
from scenefuse.paper.networks import Networks, pose_quantities, save_networks
from scenefuse.paper.recipe import BATCH_PHOTOS
from scenefuse.photos.views import Views, load_views

PoseSource = Literal["chain", "sfm"]


@dataclass(frozen=True)
class StageOutputs:
    """What stages 1 and 3 write."""

    stage: Path
    """Folder: depth_maps/{photo}.bin, confidence_maps/{photo}.bin (1 wherever there is a depth) and networks.pt."""
    report: Path
    """JSON."""
    posed: Path
    """COLMAP workspace with the poses that later stages read."""
    posed_json: Path
    """Its JSON: whose poses these are, how far the chain is from SfM's, `up_in_camera_frame`."""


@dataclass(frozen=True)
class Placed:
    """What the networks say, in the object's frame.

    Attributes:
        chain: (V, 4, 4) first_from_cam of the pose network, in its unit.
        poses: (V, 4, 4) object_from_cam that later stages use: the chain's or SfM's.
        depth: (V, 1, H, W) in object units.
        unit: object units per unit of the networks.
        measured: the photos at these poses, with SfM's points to measure residuals at.
    """

    chain: Array
    poses: Array
    depth: Tensor
    unit: float
    measured: DepthPhotos


def estimate_as_paper(
    *,
    workspace: Path,
    masks: Path,
    outputs: StageOutputs,
    checkpoints: Path,
    settings: MonocularSettings,
    pose_source: PoseSource,
    hold_out_every: int,
    seed: int,
) -> None:
    """Train depth and pose networks on the frames of a monocular video (paper 4.2.2, stage 1).

    Of the workspace only frames and intrinsics are used. SfM's poses serve to bring the chain into the frame of masks
    and gravity by one similarity, and to say how far off it is. With `pose_source` sfm the later stages get SfM's poses
    instead, and each depth map is laid on the SfM points of its frame by a robust scale and shift (method N1).

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        outputs: see StageOutputs.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of the training.
        pose_source: whose poses the later stages use.
        hold_out_every: every n-th frame is not trained on; 0 holds out none.
        seed: of weights and batches.

    Raises:
        StageError: fewer than three frames, frames without motion, fewer than eight SfM points on the object to measure
            with, a chain that does not move, or a training that diverged.
    """
    start = time.monotonic()
    device = prepare_torch(seed)
    views = load_views(workspace, masks, settings.width_px, hold_out_every)
    frames, networks = frames_of(views, device), new_monocular_networks(device)
    supervision, recipe = supervision_of(frames), recipe_of(settings)
    notes = few_frames(int(frames.trained.sum()))
    print(f"{len(views.names)} frames, {recipe.steps(frames)} steps of at most {BATCH_PHOTOS} frames", flush=True)
    checkpoint = checkpoints / key_of("paper, stage 1", recipe, seed, frames, supervision) / "state.pt"
    objective = monocular_losses(networks, frames, supervision, recipe)
    losses = optimise(networks.parts(), frames, objective, recipe, checkpoint, seed)
    raw = predict(networks.depth, frames, supervision.colors, supervision.first)
    placed = place(raw, networks, frames, views, pose_source, seed)
    content: Content = {
        "workspace": quantity(outputs.posed.name, ""),
        "photos": quantity(len(views.names), "1"),
        "photos_held_out": quantity(int(views.held_out.sum()), "1"),
        "width_px": quantity(views.images.shape[2], "px"),
        "steps": quantity(recipe.steps(frames), "1"),
        "parameters": quantity(parameters(networks.depth, networks.pose), "1"),
        "device": quantity(str(device), ""),
        "notes": quantity(notes, ""),
        **write_stage(outputs, workspace, views, networks, placed, settings, pose_source),
        **loss_quantities(losses),
        **pose_quantities(networks.pose, frames, in_unit(views.object_from_cam, placed.unit)),
    }
    write_json(outputs.report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    checkpoint.unlink(missing_ok=True)
    print_quality(content)


def few_frames(count: int) -> list[str]:
    """A note where there are fewer frames than the paper's batch holds."""
    if count >= BATCH_PHOTOS:
        return []
    note = f"{count} frames are fewer than the paper's batch of {BATCH_PHOTOS}: a batch holds all of them once"
    print(note, flush=True)
    return [note]


def place(
    raw: Tensor, networks: Networks, frames: DepthPhotos, views: Views, pose_source: PoseSource, seed: int
) -> Placed:
    """Depths (V, 1, H, W) and poses of the networks in the object's frame; errors as of `estimate_as_paper`."""
    chain = chained(networks.pose, frames)
    if pose_source == "chain":
        poses, object_from_first = place_chain(chain, views.object_from_cam)
        unit = object_from_first.scale
        return Placed(chain, poses, raw * unit, unit, photos_at(poses, views, frames))
    known = photos_at(views.object_from_cam, views, frames)
    unit = median_ratio(raw, known)
    return Placed(chain, views.object_from_cam, align_maps(raw * unit, known, seed), unit, known)


def photos_at(poses: Array, views: Views, frames: DepthPhotos) -> DepthPhotos:
    """The frames at poses (V, 4, 4) object_from_cam, with SfM's points, to measure with."""
    device = frames.images.device
    known = depth_photos(views, frames.sources.shape[1], device)
    at = torch.as_tensor(poses, dtype=torch.float32, device=device)
    return replace(known, object_from_cam=at, sources=frames.sources)


def median_ratio(raw: Tensor, known: DepthPhotos) -> float:
    """Depth of SfM points over that of the maps, the median of all frames."""
    ratios = []
    for index, points in enumerate(known.points):
        pixels = torch.from_numpy(points[None, :, :2]).to(raw.device)
        ratios.append(points[:, 2] / sample(raw[index : index + 1], pixels)[0, 0].cpu().numpy())
    return float(np.median(np.concatenate(ratios)))


def in_unit(poses: Array, unit: float) -> Array:
    """Poses (V, 4, 4) with their centres in units of the networks."""
    scaled = poses.copy()
    scaled[:, :3, 3] /= unit
    return scaled


def write_stage(
    outputs: StageOutputs,
    workspace: Path,
    views: Views,
    networks: Networks,
    placed: Placed,
    settings: MonocularSettings,
    pose_source: PoseSource,
) -> Content:
    """Write maps, networks and the posed workspace; what the stage's report says of them."""
    depth, measured = placed.depth * placed.measured.masks, placed.measured
    consistency, maps = consistency_between_views(depth, measured), depth[:, 0].cpu().numpy()
    with atomic_directory(outputs.stage) as folder:
        write_prior(folder, views, DepthPrior(maps, (maps > 0).astype(np.float32)))
        save_networks(folder / "networks.pt", networks, asdict(settings) | {"unit": placed.unit})
    write_posed(workspace, outputs.posed, views, placed.poses)
    chain = chain_quantities(placed.chain, views.object_from_cam, placed.poses, pose_source)
    write_json(outputs.posed_json, chain)
    return {
        **{name: part for name, part in chain.items() if name not in ("frame", "up_in_camera_frame")},
        "unit": quantity(placed.unit, "object units per unit of the networks"),
        **map_quantities(depth, consistency, measured),
        "residual_each_map_aligned": quantity(residual_at_checks(align_maps(placed.depth, measured, 0), measured), "1"),
    }
