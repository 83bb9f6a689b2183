"""Stage 3 of an object: depth rendered by the NeRF refines the depth network, and the better of both goes on."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scenefuse.depth.consistency import agreement_between_views, fuse_by_inverse_variance, residuals_at_points
from scenefuse.depth.crops import Crops, crop_to_object
from scenefuse.depth.inputs import Frames, make_frames, network_inputs
from scenefuse.depth.networks import disparity_from_depth
from scenefuse.depth.self_supervision import minimum_reprojection, photometric_error, warp
from scenefuse.depth.train_depth import (
    DepthSettings,
    align_maps,
    consistency_quantities,
    device,
    held_out_residual,
    loss_quantities,
    make_networks,
    prepare_torch,
    print_residuals,
    save_networks,
    write_maps,
)
from scenefuse.depth.training import Recipe, Supervision, key_of, predict, train_networks
from scenefuse.io.maps import read_depth
from scenefuse.mvs.views import Views, load_views
from scenefuse.stage import StageError, atomic_directory, quantity, setting, write_json

FLOOR = 0.3


@dataclass(frozen=True)
class FeedbackSettings:
    """How stage 3 refines; sizes, sources and photometric weights are those of stage 1."""

    epochs: int = setting(5, least=0)
    """Epochs of refinement."""
    passes_per_epoch: int = setting(1, least=0)
    """How often an epoch shows every photo."""
    batch_frames: int = setting(24, least=0)
    """Photos per step."""
    learning_rate: float = setting(0.001, least=0)
    """Maximum learning rate of Adam."""
    warmup_epochs: int = setting(1, least=0)
    """Epochs of linear warm-up before the cosine."""
    target_weight: float = setting(1.0, least=0)
    """Weight of the relative depth error against the fused depth."""
    rendered_confidence: float = setting(0.5, least=0)
    """Rendered depths below this confidence (0..1) are not used."""


def refine_depth(
    *,
    cameras: Path,
    masks: Path,
    previous: Path,
    rendered: Path,
    stage: Path,
    report: Path,
    checkpoints: Path,
    settings: FeedbackSettings,
    hold_out_every: int,
    seed: int,
) -> None:
    """Fuse rendered depth with stage 1's, refine the networks on it, and keep the better of before and after.

    Both sets of maps are blended by inverse variance where views agree (method N12, after AltNeRF); the variance of a
    map is its own disagreement between views. The depth network starts from the fused depth and is trained on it and on
    the photometric loss. Rendered, refined and stage 1's depth are then compared, on the pixels that all of them
    have, by three measures that need no truth: photometric error against held-out photos, disagreement between views,
    and residual at SfM points that no training saw. The best rank sum is kept and written, and the numbers with it.

    Args:
        cameras: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        previous: stage 1's folder.
        rendered: stage 2's folder, with depth_maps/ and confidence_maps/.
        stage: output folder, as stage 1's.
        report: output JSON; `kept` says which depth was written.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of the refinement.
        hold_out_every: as in stage 1.
        seed: of batches and sources.

    Raises:
        StageError: `previous` holds no networks, or `rendered` no depth map of any photo.
    """
    start = time.monotonic()
    prepare_torch(seed)
    state = _load_networks(previous / "networks.pt")
    before = DepthSettings(**state["settings"])
    crops = crop_to_object(load_views(cameras, masks, before.width_px, hold_out_every), before.crop_px)
    views = crops.views
    frames = make_frames(views, before.sources, device())
    inputs, _, _ = network_inputs(frames, before.sweep_planes)
    depth_network, pose_network = make_networks(inputs.shape[1], frames)
    depth_network.load_state_dict(state["depth"])
    pose_network.load_state_dict(state["pose"])
    tolerance = before.consistency_tolerance * frames.diagonal
    predicted, _ = read_maps(previous, crops, frames)
    nerf, certain = read_maps(rendered, crops, frames)
    if not (nerf > 0).any():
        raise StageError(f"{rendered}/depth_maps holds no depth for any photo of {cameras}; run stage 2 again")
    nerf = torch.where(certain >= settings.rendered_confidence, nerf, torch.zeros_like(nerf)) * frames.masks
    fused, weight, shares = _fuse(predicted, nerf, frames, tolerance)
    filled = torch.where(fused > 0, fused, torch.where(predicted > 0, predicted, torch.full_like(fused, frames.far)))
    first = disparity_from_depth(filled, frames.near, frames.far)
    depth_network.restart()
    recipe = Recipe(
        epochs=settings.epochs,
        passes_per_epoch=settings.passes_per_epoch,
        batch_frames=settings.batch_frames,
        learning_rate=settings.learning_rate,
        warmup_epochs=settings.warmup_epochs,
        ssim_weight=before.ssim_weight,
        smoothness_weight=before.smoothness_weight,
        anchor_weight=before.anchor_weight,
        target_weight=settings.target_weight,
        coarse_share=0.0,
    )
    key = key_of("stage 3", settings, before, seed, frames.images, inputs, first, weight, *depth_network.parameters())
    checkpoint = checkpoints / key / "state.pt"
    supervision = Supervision(inputs, first, fused, weight)
    losses = train_networks(depth_network, pose_network, frames, supervision, recipe, checkpoint, seed)
    refined = align_maps(predict(depth_network, frames, inputs, first), frames, seed) * frames.masks
    candidates = {"rendered": nerf, "refined": refined, "stage1": predicted}
    scores = compare(candidates, views, frames, tolerance, before.ssim_weight)
    kept = choose(scores)
    depth = torch.where(candidates[kept] > 0, candidates[kept], refined)
    agreement = agreement_between_views(depth, frames, tolerance)
    content: dict[str, Any] = {
        "kept": quantity(kept, ""),
        **{f"{measure}_{name}": quantity(v, "1") for name, row in scores.items() for measure, v in row.items()},
        **{name: quantity(share, "1") for name, share in shares.items()},
        "pixels_filled_from_refined": quantity(
            float(((candidates[kept] <= 0) & (frames.masks > 0)).sum() / frames.masks.sum().clamp_min(1)), "1"
        ),
        "residual_after_alignment": quantity(held_out_residual(depth, frames), "1"),
        **consistency_quantities(agreement, frames),
        **loss_quantities(losses),
        "refined_poses": quantity(None, "object units"),
        "device": quantity(str(frames.images.device), ""),
    }
    with atomic_directory(stage) as folder:
        write_maps(folder, crops, depth, agreement.confidence)
        save_networks(folder / "networks.pt", depth_network, pose_network, before)
    content["seconds"] = quantity(round(time.monotonic() - start, 1), "s")
    write_json(report, content)
    checkpoint.unlink(missing_ok=True)
    print(f"accepted {100 * shares['accepted_share']:.0f} % of the object's pixels; kept the {kept} depth", flush=True)
    print_residuals(content)


def read_maps(folder: Path, crops: Crops, frames: Frames) -> tuple[Tensor, Tensor]:
    """(V, 1, H, W) depths and confidences of a stage folder, cut like the photos; zeros for a photo without a map."""
    height, width = frames.images.shape[2:]
    depths, confidences = np.zeros((2, len(crops.views.names), 1, height, width), np.float32)
    for index, name in enumerate(crops.views.names):
        if (folder / "depth_maps" / f"{name}.bin").is_file():
            depths[index, 0] = crops.cut(index, read_depth(folder / "depth_maps" / f"{name}.bin"))
            confidences[index, 0] = crops.cut(index, read_depth(folder / "confidence_maps" / f"{name}.bin"))
    where = frames.images.device
    return torch.from_numpy(depths).to(where), torch.from_numpy(confidences).to(where)


def compare(
    candidates: dict[str, Tensor], views: Views, frames: Frames, tolerance: float, ssim_weight: float
) -> dict[str, dict[str, float | None]]:
    """Three measures of each set of depth maps, smaller is better, on trained photos and pixels that all sets have.

    Returns:
        For each candidate: `photometric` (minimum reprojection error of the two nearest held-out photos, or of the
        sources where none is held out), `doubt` (one minus mean confidence), `residual` (median relative residual at
        the SfM points kept for checking), None where it cannot be measured.
    """
    common = torch.stack([d > 0 for d in candidates.values()]).all(0) & (frames.masks > 0)
    common[~torch.as_tensor(frames.trained)] = False
    return {
        name: {
            "photometric": _held_out_photometric(depth, views, frames, common, ssim_weight),
            "doubt": _mean(1.0 - agreement_between_views(depth, frames, tolerance).confidence[common]),
            "residual": _residual(depth, frames, candidates),
        }
        for name, depth in candidates.items()
    }


def choose(scores: dict[str, dict[str, float | None]]) -> str:
    """The candidate with the smallest sum of ranks over the measures that all have; a tie goes to the earlier one."""
    names = list(scores)
    total = dict.fromkeys(names, 0)
    for measure in scores[names[0]]:
        values = {name: scores[name][measure] for name in names}
        known = [v for v in values.values() if v is not None]
        if len(known) < len(names):
            continue
        for name in names:
            total[name] += sum(v < values[name] for v in known)  # type: ignore[operator]
    return min(names, key=lambda name: total[name])


def _fuse(predicted: Tensor, nerf: Tensor, frames: Frames, tolerance: float) -> tuple[Tensor, Tensor, dict[str, float]]:
    """Fused depth, the weight of each pixel as a target, and what share of the object was accepted."""
    own = agreement_between_views(predicted, frames, tolerance)
    other = agreement_between_views(nerf, frames, tolerance)
    floor = FLOOR * tolerance
    fused, variance, blended = fuse_by_inverse_variance(predicted, nerf, own.variance, other.variance, floor)
    fused = fused * frames.masks
    weight = torch.where(fused > 0, floor**2 / variance, torch.zeros_like(fused)).clamp(0.0, 1.0)
    area = frames.masks.sum().clamp_min(1)
    on_object = frames.masks > 0
    return (
        fused,
        weight,
        {
            "accepted_share": float((fused > 0).sum() / area),
            "blended_share": float((blended & on_object).sum() / area),
            "rendered_share": float((nerf > 0).sum() / area),
        },
    )


@torch.no_grad()
def _held_out_photometric(
    depth: Tensor, views: Views, frames: Frames, common: Tensor, ssim_weight: float
) -> float | None:
    held_out = torch.as_tensor(np.flatnonzero(views.held_out), device=depth.device)
    centres = frames.object_from_cam[:, :3, 3]
    total, number = 0.0, 0
    for index in np.flatnonzero(frames.trained):
        if len(held_out):
            nearest = held_out[torch.argsort((centres[held_out] - centres[index]).norm(dim=1))[:2]]
        else:
            nearest = frames.sources[index][:2]
        count = len(nearest)
        target = torch.full_like(nearest, int(index))
        warped, valid = warp(
            frames.images[nearest],
            depth[target],
            frames.source_from_target(target, nearest),
            frames.intrinsics[target],
            frames.intrinsics[nearest],
        )
        errors = photometric_error(frames.images[target], warped, ssim_weight)
        smallest, counts = minimum_reprojection(
            errors.view(1, count, *errors.shape[2:]), valid.view(1, count, *valid.shape[2:]), None
        )
        inside = common[index : index + 1]
        total += float(smallest[inside & counts].sum()) + 0.5 * float((inside & ~counts).sum())
        number += int(inside.sum())
    return total / number if number else None


def _residual(depth: Tensor, frames: Frames, candidates: dict[str, Tensor]) -> float | None:
    """At the check points where no candidate has a hole in the four pixels around."""
    mine = residuals_at_points(depth, frames.checks)
    have = [
        residuals_at_points((d > 0).float(), [_at_depth_one(p) for p in frames.checks]) for d in candidates.values()
    ]
    whole = [np.all([h[i] < 1e-3 for h in have], axis=0) for i in range(len(mine))]
    values = np.concatenate([m[w] for m, w in zip(mine, whole)])
    return float(np.median(values)) if len(values) else None


def _at_depth_one(points: np.ndarray) -> np.ndarray:
    return np.column_stack([points[:, :2], np.ones(len(points), np.float32)])


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if len(values) else None


def _load_networks(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise StageError(f"{path} does not exist; run stage 1 first")
    state = torch.load(path, map_location="cpu", weights_only=True)
    if not {"depth", "pose", "settings"} <= set(state):
        raise StageError(f"{path} holds no networks of stage 1; delete it and run stage 1 again")
    return state
