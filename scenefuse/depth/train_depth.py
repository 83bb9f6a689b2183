"""Stage 1 of an object: self-supervised depth and pose networks, and a depth map with a confidence for every photo."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scenefuse.cores import use_threads
from scenefuse.depth.consistency import Agreement, agreement_between_views, align_to_points, residuals_at_points
from scenefuse.depth.crops import Crops, crop_to_object
from scenefuse.depth.inputs import Frames, make_frames, network_inputs
from scenefuse.depth.networks import DepthNetwork, PoseNetwork, depth_from_disparity, parameters
from scenefuse.depth.self_supervision import sample
from scenefuse.depth.training import Recipe, Supervision, key_of, predict, small_photos, train_networks
from scenefuse.io.maps import write_depth
from scenefuse.mvs.views import Views, load_views
from scenefuse.stage import atomic_directory, quantity, setting, threads, write_json
from scenefuse.transforms import rotation_angle_deg

Content = dict[str, Any]


@dataclass(frozen=True)
class DepthSettings:
    """How stage 1 trains; every value comes from the config."""

    width_px: int = setting(320, unit="px", least=0)
    """Width at which photos are read and depth maps are written, pixels."""
    crop_px: int = setting(144, unit="px", least=0)
    """Photos are cut to the object, to about this many pixels squared, for the networks."""
    sources: int = setting(6, least=0)
    """Other photos each photo is compared with."""
    sweep_planes: int = setting(48, least=0)
    """Depth hypotheses of the plane sweep that feeds the network; 0 leaves it out."""
    epochs: int = setting(15, least=0)
    """Epochs of training."""
    passes_per_epoch: int = setting(1, least=0)
    """How often an epoch shows every photo."""
    batch_frames: int = setting(24, least=0)
    """Photos per step."""
    learning_rate: float = setting(0.001, least=0)
    """Maximum learning rate of Adam."""
    warmup_epochs: int = setting(2, least=0)
    """Epochs of linear warm-up before the cosine."""
    ssim_weight: float = setting(0.85, least=0)
    """Share of SSIM in the photometric error; the rest is the absolute difference."""
    smoothness_weight: float = setting(0.001, least=0)
    """Weight of the edge-aware smoothness of disparity."""
    anchor_weight: float = setting(1.0, least=0)
    """Weight of the relative depth error at SfM points."""
    consistency_tolerance: float = setting(0.01, unit="of the diagonal", least=0)
    """Disagreement between views that costs 40 % of a vote, as a share of the object's diagonal."""


def train_depth(
    *,
    cameras: Path,
    masks: Path,
    stage: Path,
    report: Path,
    checkpoints: Path,
    settings: DepthSettings,
    hold_out_every: int,
    seed: int,
) -> None:
    """Train the depth and pose networks on one object's photos and write a depth map for each photo.

    The networks and losses are those of Monodepth2 (method N10), trained from scratch. The depth network corrects a
    first disparity made of sparse points and a plane sweep, and the pose network learns beside it from detached depth.
    Depth maps are along z, in object units, aligned to the sparse points of their photo by a robust scale and shift
    (N1), 0 off the object.

    Args:
        cameras: undistorted COLMAP workspace of the object, with poses of SfM or those found without it (N11).
        masks: folder of masks named like the photos, .png.
        stage: output folder: depth_maps/{photo}.bin, confidence_maps/{photo}.bin (0..1) and networks.pt.
        report: output JSON: residuals at sparse points, losses, consistency, errors of the pose network, seconds.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of the training.
        hold_out_every: every n-th photo is not trained on; 0 holds out none.
        seed: of weights, batches and sources.

    Raises:
        StageError: no photo with a mask, fewer than three photos, or fewer than eight SfM points on the object.
    """
    start = time.monotonic()
    prepare_torch(seed)
    crops = crop_to_object(load_views(cameras, masks, settings.width_px, hold_out_every), settings.crop_px)
    views = crops.views
    frames = make_frames(views, settings.sources, device())
    inputs, first, interpolated = network_inputs(frames, settings.sweep_planes)
    print(f"{len(views.names)} photos, depth {frames.near:.4g} to {frames.far:.4g}, inputs ready", flush=True)
    depth_network, pose_network = make_networks(inputs.shape[1], frames)
    recipe = Recipe(
        epochs=settings.epochs,
        passes_per_epoch=settings.passes_per_epoch,
        batch_frames=settings.batch_frames,
        learning_rate=settings.learning_rate,
        warmup_epochs=settings.warmup_epochs,
        ssim_weight=settings.ssim_weight,
        smoothness_weight=settings.smoothness_weight,
        anchor_weight=settings.anchor_weight,
        target_weight=0.0,
        coarse_share=0.3,
    )
    key = key_of("stage 1", settings, seed, frames.images, frames.masks, frames.object_from_cam, first)
    checkpoint = checkpoints / key / "state.pt"
    supervision = Supervision(inputs, first)
    losses = train_networks(depth_network, pose_network, frames, supervision, recipe, checkpoint, seed)
    raw = predict(depth_network, frames, inputs, first)
    depth = align_maps(raw, frames, seed)
    tolerance = settings.consistency_tolerance * frames.diagonal
    agreement = agreement_between_views(depth, frames, tolerance)
    content: Content = {
        "workspace": quantity(cameras.name, ""),
        "photos": quantity(len(views.names), "1"),
        "photos_held_out": quantity(int(views.held_out.sum()), "1"),
        "width_px": quantity(crops.masks.shape[2], "px"),
        "crop_px": quantity([frames.images.shape[3], frames.images.shape[2]], "px"),
        "nearest_depth": quantity(frames.near, "object units"),
        "farthest_depth": quantity(frames.far, "object units"),
        "diagonal": quantity(frames.diagonal, "object units"),
        "parameters": quantity(parameters(depth_network, pose_network), "1"),
        "device": quantity(str(frames.images.device), ""),
        "residual_between_points": quantity(
            held_out_residual(depth_from_disparity(interpolated, frames.near, frames.far), frames), "1"
        ),
        "residual_before_training": quantity(
            held_out_residual(depth_from_disparity(first, frames.near, frames.far), frames), "1"
        ),
        "residual_before_alignment": quantity(held_out_residual(raw, frames), "1"),
        "residual_after_alignment": quantity(held_out_residual(depth, frames), "1"),
        "residual_per_photo": quantity(_residual_per_photo(depth, frames, views), "1"),
        **consistency_quantities(agreement, frames),
        **loss_quantities(losses),
        **_pose_quantities(pose_network, frames, views),
    }
    with atomic_directory(stage) as folder:
        write_maps(folder, crops, depth * frames.masks, agreement.confidence)
        save_networks(folder / "networks.pt", depth_network, pose_network, settings)
    content["seconds"] = quantity(round(time.monotonic() - start, 1), "s")
    write_json(report, content)
    checkpoint.unlink(missing_ok=True)
    print_residuals(content)


def prepare_torch(seed: int) -> None:
    """Threads of this stage and a fixed seed."""
    use_threads(threads())
    torch.manual_seed(seed)


def device() -> torch.device:
    """CUDA where it is, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def make_networks(channels: int, frames: Frames) -> tuple[DepthNetwork, PoseNetwork]:
    """Fresh networks on the frames' device; the pose network counts in typical distances to the object."""
    where = frames.images.device
    return DepthNetwork(channels).to(where), PoseNetwork((frames.near * frames.far) ** 0.5).to(where)


def align_maps(raw: Tensor, frames: Frames, seed: int) -> Tensor:
    """Each (1, H, W) depth map aligned to the SfM points of its photo, never to those kept for checking."""
    aligned = []
    for index, points in enumerate(frames.points):
        pixels = torch.from_numpy(points[None, :, :2]).to(raw.device)
        predicted = sample(raw[index : index + 1], pixels)[0, 0].cpu().numpy()
        scale, shift = align_to_points(predicted, points[:, 2], seed)
        aligned.append((scale * raw[index] + shift).clamp_min(1e-3 * frames.near))
    return torch.stack(aligned)


def held_out_residual(depth: Tensor, frames: Frames) -> float | None:
    """Median relative residual at the SfM points that no training saw; None where there are none."""
    residuals = np.concatenate(residuals_at_points(depth, frames.checks))
    return float(np.median(residuals)) if len(residuals) else None


def consistency_quantities(agreement: Agreement, frames: Frames) -> Content:
    """Share of the object's pixels that other views confirm, and the typical disagreement."""
    on_object = frames.masks > 0
    confirmed = agreement.confidence[on_object] > 0.5
    finite = agreement.variance[on_object & torch.isfinite(agreement.variance)]
    disagreement = float(finite.sqrt().median() / frames.diagonal) if len(finite) else None
    return {
        "consistent_share": quantity(float(confirmed.float().mean()) if len(confirmed) else 0.0, "1"),
        "disagreement_over_diagonal": quantity(disagreement, "1"),
    }


def loss_quantities(losses: list[dict[str, float]]) -> Content:
    """First and last epoch's mean of each loss."""
    return {
        f"{name}_loss_{when}": quantity(row[name], "1")
        for name in (losses[0] if losses else {})
        for when, row in (("first", losses[0]), ("last", losses[-1]))
    }


def write_maps(folder: Path, crops: Crops, depth: Tensor, confidence: Tensor) -> None:
    """depth_maps/ and confidence_maps/ of a stage folder: one COLMAP map of each whole photo."""
    for index, name in enumerate(crops.views.names):
        write_depth(folder / "depth_maps" / f"{name}.bin", crops.paste(index, depth[index, 0].cpu().numpy()))
        write_depth(folder / "confidence_maps" / f"{name}.bin", crops.paste(index, confidence[index, 0].cpu().numpy()))


def save_networks(path: Path, depth: DepthNetwork, pose: PoseNetwork, settings: DepthSettings) -> None:
    """What stage 3 continues from."""
    torch.save({"depth": depth.state_dict(), "pose": pose.state_dict(), "settings": asdict(settings)}, path)


def print_residuals(content: Content) -> None:
    """One line for the log."""
    residual, share = content["residual_after_alignment"]["value"], content["consistent_share"]["value"]
    known = "no SfM points to check" if residual is None else f"median residual at SfM points {100 * residual:.2f} %"
    print(f"depth maps written: {known}, {100 * share:.0f} % of the object confirmed by other views", flush=True)


def _residual_per_photo(depth: Tensor, frames: Frames, views: Views) -> dict[str, float]:
    residuals = residuals_at_points(depth, frames.points)
    return {name: float(np.median(r)) for name, r in zip(views.names, residuals) if len(r)}


@torch.no_grad()
def _pose_quantities(network: PoseNetwork, frames: Frames, views: Views) -> Content:
    """The pose network's relative rotations and translations against those that it learned from."""
    small = small_photos(frames)
    order = np.flatnonzero(frames.trained)
    pairs = np.column_stack([order, frames.sources[order, 0].cpu().numpy()])
    target, source = torch.as_tensor(pairs).T
    found = network(small[target], small[source]).double().cpu().numpy()
    poses = views.object_from_cam
    true = np.linalg.inv(poses[pairs[:, 1]]) @ poses[pairs[:, 0]]
    turned = [rotation_angle_deg(a[:3, :3] @ b[:3, :3].T) for a, b in zip(found, true)]
    moved = [rotation_angle_deg(b[:3, :3]) for b in true]
    off = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1) / np.linalg.norm(true[:, :3, 3], axis=1)
    return {
        "pose_network_rotation_error_deg": quantity(float(np.median(turned)), "deg"),
        "pose_network_rotation_to_find_deg": quantity(float(np.median(moved)), "deg"),
        "pose_network_translation_error": quantity(float(np.median(off)), "1"),
    }
