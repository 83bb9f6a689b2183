"""Stage 3 by the paper: depth rendered by the NeRF, fused with stage 1's, refines the depth and the pose network."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from scenefuse.core.stage import StageError, quantity
from scenefuse.nerf.prior.refine_depth import read_stage_maps
from scenefuse.nerf.prior.training import prepare_torch
from scenefuse.nerf.train_object_nerf import MIN_CONFIDENCE
from scenefuse.paper.estimate_as_paper import PoseSource, Stage, StageOutputs, photos_at
from scenefuse.paper.fused_depth import blend_depths
from scenefuse.paper.monocular import MonocularSettings, frames_of, load_networks, supervision_of
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
    device = prepare_torch(seed)
    networks, width_px, unit = load_networks(earlier.previous / "networks.pt", device)
    views, used = (load_views(folder, masks, width_px, hold_out_every) for folder in (workspace, poses))
    frames = frames_of(views, device)
    blend = blend_depths(*_depths(earlier, views, device), photos_at(used.object_from_cam, views, frames))
    print(f"accepted {blend.shares['accepted_share']:.0%} of the object's pixels", flush=True)
    content = {name: quantity(share, "1") for name, share in blend.shares.items()}
    stage = Stage(workspace, outputs, checkpoints, views, frames, pose_source, seed)
    stage.run(networks, supervision_of(frames, blend.depth / unit, blend.weight), settings.epochs, content)


def _depths(earlier: EarlierStages, views: Views, device: torch.device) -> tuple[Tensor, Tensor]:
    """(V, 1, H, W) depths of stage 1, and those of stage 2 that are confident; an error where the latter has none."""
    rendered = read_stage_maps(earlier.rendered / "depth_maps", views)
    if not rendered.any():
        raise StageError(f"{earlier.rendered}/depth_maps holds no depth for any photo of the object; run stage 2 again")
    confident = read_stage_maps(earlier.rendered / "confidence_maps", views) >= MIN_CONFIDENCE
    found = read_stage_maps(earlier.previous / "depth_maps", views), rendered * confident * views.masks
    predicted, kept = (torch.from_numpy(maps.astype(np.float32))[:, None].to(device) for maps in found)
    return predicted, kept
