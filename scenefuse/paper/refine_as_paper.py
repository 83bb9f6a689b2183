"""Stage 3 by the paper: depth rendered by the NeRF, fused with stage 1's, refines the depth and the pose network."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scenefuse.core.checkpoints import key_of
from scenefuse.core.stage import StageError, quantity, write_json
from scenefuse.core.transforms import Array
from scenefuse.nerf.prior.refine_depth import read_stage_maps
from scenefuse.nerf.prior.training import loss_quantities, optimise, predict, prepare_torch
from scenefuse.nerf.train_object_nerf import MIN_CONFIDENCE
from scenefuse.paper.estimate_as_paper import (
    PoseSource,
    StageOutputs,
    chained,
    in_unit,
    photos_at,
    place,
    write_stage,
)
from scenefuse.paper.fused_depth import blend_depths, print_quality
from scenefuse.paper.monocular import (
    MonocularSettings,
    frames_of,
    load_networks,
    monocular_losses,
    new_monocular_networks,
    pose_quantities,
    recipe_of,
    supervision_of,
)
from scenefuse.photos.views import Views, load_views


@dataclass(frozen=True)
class EarlierStages:
    """What stage 3 starts from."""

    previous: Path
    """Stage 1's folder."""
    rendered: Path
    """Stage 2's folder, with depth_maps/ and confidence_maps/."""


def refine_as_paper(
    *,
    workspace: Path,
    masks: Path,
    poses: Path,
    earlier: EarlierStages,
    outputs: StageOutputs,
    checkpoints: Path,
    settings: MonocularSettings,
    pose_source: PoseSource,
    hold_out_every: int,
    seed: int,
) -> None:
    """Refine both networks of stage 1 on rendered and predicted depth, and chain the poses again (4.2.2, stage 3).

    Both depths are blended by inverse variance where views agree (method N12). The blend is the depth network's target,
    and what the pose network's motions are judged by. What is written is the refined networks' depth and poses: nothing
    is chosen by held-out photos.

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        poses: workspace with the poses that stages 1 and 2 used.
        earlier: folders of stages 1 and 2.
        outputs: see StageOutputs.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of the training.
        pose_source: as in stage 1.
        hold_out_every: as in stage 1.
        seed: of the batches.

    Raises:
        StageError: stage 1's folder holds no networks, stage 2's no depth map of any photo, or as in stage 1.
    """
    start = time.monotonic()
    device = prepare_torch(seed)
    state = load_networks(earlier.previous / "networks.pt")
    unit = state["settings"]["unit"]
    views = load_views(workspace, masks, state["settings"]["width_px"], hold_out_every)
    used = load_views(poses, masks, state["settings"]["width_px"], hold_out_every).object_from_cam
    frames, networks = frames_of(views, device), new_monocular_networks(device)
    networks.load(state)
    before = chained(networks.pose, frames)
    predicted, rendered = _depths(earlier, views, device)
    blend = blend_depths(predicted, rendered, photos_at(used, views, frames))
    supervision, recipe = supervision_of(frames, blend.depth / unit, blend.weight), recipe_of(settings)
    key = key_of("paper, stage 3", recipe, seed, frames, supervision, state)
    checkpoint = checkpoints / key / "state.pt"
    objective = monocular_losses(networks, frames, supervision, recipe)
    losses = optimise(networks.parts(), frames, objective, recipe, checkpoint, seed)
    raw = predict(networks.depth, frames, supervision.colors, supervision.first)
    placed = place(raw, networks, frames, views, pose_source, seed)
    settings = replace(settings, width_px=views.images.shape[2])
    content = {
        **{name: quantity(share, "1") for name, share in blend.shares.items()},
        "steps": quantity(recipe.steps(frames), "1"),
        "chain_moved_over_extent": quantity(shift_over_extent(before, placed.chain), "1"),
        **write_stage(outputs, workspace, views, networks, placed, settings, pose_source),
        **loss_quantities(losses),
        **pose_quantities(networks.pose, frames, in_unit(views.object_from_cam, placed.unit)),
    }
    write_json(outputs.report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    checkpoint.unlink(missing_ok=True)
    print(f"accepted {100 * blend.shares['accepted_share']:.0f} % of the object's pixels", flush=True)
    print_quality(content)


def _depths(earlier: EarlierStages, views: Views, device: torch.device) -> tuple[Tensor, Tensor]:
    """(V, 1, H, W) depths of stage 1, and those of stage 2 that are confident; an error where the latter has none."""
    rendered = read_stage_maps(earlier.rendered / "depth_maps", views)
    if not rendered.any():
        raise StageError(f"{earlier.rendered}/depth_maps holds no depth for any photo of the object; run stage 2 again")
    confident = read_stage_maps(earlier.rendered / "confidence_maps", views) >= MIN_CONFIDENCE
    found = read_stage_maps(earlier.previous / "depth_maps", views), rendered * confident * views.masks
    predicted, kept = (torch.from_numpy(maps.astype(np.float32))[:, None].to(device) for maps in found)
    return predicted, kept


def shift_over_extent(before: Array, after: Array) -> float:
    """Root mean square shift of the centres of poses (V, 4, 4), as a share of their extent."""
    extent = max(float(np.linalg.norm(np.ptp(before[:, :3, 3], axis=0))), 1e-9)
    return float(np.sqrt(((after - before)[:, :3, 3] ** 2).sum(1).mean()) / extent)
