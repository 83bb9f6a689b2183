"""Stage 3 of an object: depth rendered by the NeRF refines the depth network, and the best of all depths goes on."""

import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from scenefuse.core.checkpoints import key_of
from scenefuse.core.stage import StageError, atomic_directory, quantity, setting, write_json
from scenefuse.nerf.prior.candidates import Scores, best_candidate, score_candidates
from scenefuse.nerf.prior.consistency import consistency_between_views, fuse_by_inverse_variance
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.maps import (
    Content,
    align_maps,
    map_quantities,
    print_quality,
    read_maps,
    tolerance_of,
    write_maps,
)
from scenefuse.nerf.prior.networks import disparity_from_depth
from scenefuse.nerf.prior.train_depth import DepthTrainingSettings, prepare_inputs
from scenefuse.nerf.prior.training import (
    Recipe,
    Supervision,
    load_networks,
    loss_quantities,
    new_networks,
    predict,
    prepare_torch,
    save_networks,
    train_networks,
)

# Rendered depths below this confidence (0..1) are not used.
MIN_RENDERED_CONFIDENCE = 0.5
# Standard deviation that no map is better than, in tolerances of consistency.
FLOOR = 0.3


@dataclass(frozen=True)
class FeedbackSettings:
    """How stage 3 refines; sizes and sources are those of stage 1."""

    epochs: int = setting(5, least=0)
    """Epochs of refinement, each over all photos."""
    batch_photos: int = 24
    """Photos per step."""
    warmup_epochs: int = 1
    """Epochs of linear rise of the learning rate before the cosine."""


@dataclass(frozen=True)
class EarlierStages:
    """What stage 3 starts from."""

    previous: Path
    """Stage 1's folder."""
    rendered: Path
    """Stage 2's folder, with depth_maps/ and confidence_maps/."""


@dataclass(frozen=True)
class Blend:
    """Stage 1's and rendered depth blended.

    Attributes:
        depth: (V, 1, H, W), 0 where neither was accepted.
        weight: (V, 1, H, W) weight of each pixel as a target, 0..1.
        shares: of the object's pixels that were rendered, accepted, blended.
    """

    depth: Tensor
    weight: Tensor
    shares: dict[str, float]


def refine_depth(
    *,
    workspace: Path,
    masks: Path,
    earlier: EarlierStages,
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
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        earlier: folders of stages 1 and 2.
        stage: output folder, as stage 1's.
        report: output JSON; `kept` says which depth was written.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of the refinement.
        hold_out_every: as in stage 1.
        seed: of batches and sources.

    Raises:
        StageError: stage 1's folder holds no networks, stage 2's no depth map of any photo, or the training diverged.
    """
    start = time.monotonic()
    device = prepare_torch(seed)
    state = load_networks(earlier.previous / "networks.pt")
    before = DepthTrainingSettings(**state["settings"])
    crops, photos, inputs = prepare_inputs(workspace, masks, before, hold_out_every, device)
    networks = new_networks(inputs.channels.shape[1], photos)
    networks.load(state)
    networks.depth.restart()
    predicted, _ = read_maps(earlier.previous, crops, device)
    rendered = read_rendered(earlier.rendered, *read_maps(earlier.rendered, crops, device)) * photos.masks
    blend = blend_depths(predicted, rendered, photos)
    supervision = _supervision(inputs.channels, blend, predicted, photos)
    recipe = Recipe(settings.epochs, settings.warmup_epochs, settings.batch_photos, coarse_share=0.0)
    checkpoint = checkpoints / key_of("stage 3", recipe, seed, photos, supervision, networks.state()) / "state.pt"
    losses = train_networks(networks, photos, supervision, recipe, checkpoint, seed)
    refined = align_maps(predict(networks.depth, photos, supervision), photos, seed) * photos.masks
    candidates = {"rendered": rendered, "refined": refined, "stage1": predicted}
    scores = score_candidates(candidates, photos)
    kept = best_candidate(scores)
    depth = torch.where(candidates[kept] > 0, candidates[kept], refined)
    consistency = consistency_between_views(depth, photos, tolerance_of(photos))
    content = {
        **_choice_quantities(kept, candidates[kept], scores, blend, photos),
        **map_quantities(depth, consistency, photos),
        **loss_quantities(losses),
    }
    with atomic_directory(stage) as folder:
        write_maps(folder, crops, depth, consistency.confidence)
        save_networks(folder / "networks.pt", networks, asdict(before))
    write_json(report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    checkpoint.unlink(missing_ok=True)
    accepted = blend.shares["accepted_share"]
    print(f"accepted {100 * accepted:.0f} % of the object's pixels; kept the {kept} depth", flush=True)
    print_quality(content)


def blend_depths(predicted: Tensor, rendered: Tensor, photos: DepthPhotos) -> Blend:
    """Blend two sets of (V, 1, H, W) depth maps, each weighted by its consistency between views."""
    tolerance = tolerance_of(photos)
    floor = FLOOR * tolerance
    own, other = (consistency_between_views(depth, photos, tolerance).variance for depth in (predicted, rendered))
    depth, variance, blended = fuse_by_inverse_variance(predicted, rendered, own, other, floor)
    depth = depth * photos.masks
    weight = torch.where(depth > 0, floor**2 / variance, torch.zeros_like(depth)).clamp(0.0, 1.0)
    area, on_object = photos.masks.sum().clamp_min(1), photos.masks > 0
    shares = {
        "accepted_share": float((depth > 0).sum() / area),
        "blended_share": float((blended & on_object).sum() / area),
        "rendered_share": float((rendered > 0).sum() / area),
    }
    return Blend(depth, weight, shares)


def read_rendered(folder: Path, depth: Tensor, confidence: Tensor) -> Tensor:
    """Rendered depth where it is confident; an error if there is none at all."""
    if not (depth > 0).any():
        raise StageError(f"{folder}/depth_maps holds no depth for any photo of the object; run stage 2 again")
    return torch.where(confidence >= MIN_RENDERED_CONFIDENCE, depth, torch.zeros_like(depth))


def _supervision(channels: Tensor, blend: Blend, predicted: Tensor, photos: DepthPhotos) -> Supervision:
    """The networks start from the blend and learn it; where there is none they start from stage 1's depth."""
    farthest = torch.full_like(predicted, photos.far)
    filled = torch.where(blend.depth > 0, blend.depth, torch.where(predicted > 0, predicted, farthest))
    first = disparity_from_depth(filled, photos.near, photos.far)
    return Supervision(channels, first, blend.depth, blend.weight)


def _choice_quantities(kept: str, chosen: Tensor, scores: Scores, blend: Blend, photos: DepthPhotos) -> Content:
    """Which depth was kept, the measures of all, and how much of the object each came from."""
    holes = ((chosen <= 0) & (photos.masks > 0)).sum() / photos.masks.sum().clamp_min(1)
    return {
        "kept": quantity(kept, ""),
        **{f"{measure}_{name}": quantity(v, "1") for name, row in scores.items() for measure, v in row.items()},
        **{name: quantity(share, "1") for name, share in blend.shares.items()},
        "pixels_filled_from_refined": quantity(float(holes), "1"),
        "device": quantity(str(photos.images.device), ""),
    }
