"""Stages 2 and 4 by the paper: a depth-guided NeRF with its rates, batches and losses; stage 4 starts afresh.

Beside its constants (He et al. 2026, section 4.2.2 and Table 1) stand values for what it names without a number;
docs/paper.md lists which is which. How long stages are is a setting; in config/paper.yaml they sum to its 60 epochs. To
a NeRF's training the paper adds the order of depths, and longer steps of the hash grid at edges.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from scenefuse.core.stage import quantity, read_json, write_json
from scenefuse.core.transforms import DEPTH_JUMP
from scenefuse.nerf.field import Field, FieldSettings, encode
from scenefuse.nerf.rays import DEPTH_DELTA, SOLID_OPACITY, LossWeights, PhotoTensors, dilate
from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, prepare_device, train_object_nerf
from scenefuse.nerf.training import OCCUPANCY_EVERY, Nerf, NerfRecipe, Rendered, Schedule
from scenefuse.paper.network_training import LEARNING_RATE, Recipe
from scenefuse.photos.views import load_views

# Batches, warm-up and rate are the depth network's. The paper has neither samples near the prior, nor turned rays, nor
# gains of photos, nor levels that open one by one.
NERF = NerfRecipe(
    images_per_batch=Recipe.batch_photos,
    rays_per_image=170,
    warmup_epochs=Recipe.warmup_epochs,
    learning_rate=LEARNING_RATE,
    grid_learning_rate=LEARNING_RATE,
    coarse_until=0.0,
    prior_share=0.0,
    turned_share=0.0,
    appearance=False,
)
# Where there is a GPU: instant-ngp's field, which the paper's encoding is. On a CPU, the field of `object.nerf`.
FIELD = FieldSettings(levels=16, log2_table=19, finest=2048, width=64)
# The paper gives no weight of its loss of relative depth.
RANK_WEIGHT = 0.02
# Pixels of a pair lie apart by this share of the photo's width (method N3).
MIN_APART = 0.02
# Their depths differ by this, in nerf units: twice what the loss of absolute depth takes for noise.
RANK_MARGIN = 2 * DEPTH_DELTA


class OrderAndEdges:
    """The paper's relative depth and adaptive grid, for a training's `additions`.

    The order that is learned is that of the prior's depths. Adam divides every row's gradient by its own usual size,
    and with it any factor that a row's gradients share; a factor on Adam's steps stays.

    Args:
        nerf: that is trained.
        photos: that it is trained on, with their prior.
        images: photos of a batch.
        rank_weight: weight of the order's loss.
    """

    def __init__(self, nerf: Nerf, photos: PhotoTensors, images: int, rank_weight: float = RANK_WEIGHT) -> None:
        device = nerf.field.table.device
        self.weights: Mapping[str, float] = {"rank": rank_weight}
        # (T, 2) opacity that each row of the table has shown at edges, and in all.
        self.state = torch.zeros(len(nerf.field.table), 2, device=device)
        self.images, self.apart_px = images, MIN_APART * photos.images.shape[2]
        border = dilate(photos.masks, 1) & ~dilate(photos.masks, -1)
        # Rays are drawn beyond the band: the zone around mask edges and depth jumps that counts as an edge is wider.
        self.edges = dilate(border | depth_jumps(photos.depths), NERF.mask_band_px + 1).float().to(device)

    def losses(self, rendered: Rendered, nerf: Nerf) -> dict[str, Tensor]:
        """The loss of order; edges are counted whenever the occupancy is updated."""
        rays, ray, seen = rendered.rays, rendered.drawn.ray, rendered.seen
        if rendered.step % OCCUPANCY_EVERY == 0:
            self._count(rendered, nerf.field)
        nothing = torch.zeros_like(rays.length)
        distance, opacity = (nothing.index_put((ray,), part) for part in (seen.distance, seen.opacity))
        known, uv = rays.prior.distance, rendered.batch.uv
        return {"rank": rank_loss(distance, opacity, known, rays.confidence, uv, self.images, self.apart_px)}

    def descend(self, nerf: Nerf, optimizer: torch.optim.Optimizer) -> None:
        """The optimiser's step, longer where edges are."""
        table = nerf.field.table
        before = table.detach().clone()
        optimizer.step()
        with torch.no_grad():
            table.copy_(before + self.factor(nerf.field) * (table - before))

    def factor(self, field: Field) -> Tensor:
        """(T, 1) how much longer the step of each row is (method N9): 1 on the coarse half of the levels, 2 where a row
        shows nothing but edges."""
        factor = 1 + self.state[:, :1] / self.state[:, 1:].clamp(min=1e-12)
        factor[: int(field.grid.offset[field.settings.levels // 2])] = 1.0
        return factor

    def _count(self, rendered: Rendered, field: Field) -> None:
        """Count the samples of a step."""
        rays, drawn, batch = rendered.rays, rendered.drawn, rendered.batch
        x = rays.origin[drawn.ray, None] + drawn.t[..., None] * rays.direction[drawn.ray, None]
        opacity = (1 - torch.exp(-rendered.sigma.detach() * drawn.delta)).view(-1)
        across, down = batch.uv.long().unbind(1)
        edge = self.edges[batch.view, down, across][drawn.ray]
        self.see(field, x.view(-1, 3), opacity, edge.repeat_interleave(drawn.t.shape[1]))

    def see(self, field: Field, x: Tensor, opacity: Tensor, edge: Tensor) -> None:
        """Count N samples at positions (N, 3): their opacities (N,), and how much of an edge, 0..1, each is (N,)."""
        table = torch.zeros_like(field.table, requires_grad=True)
        features = encode(x.clamp(0.0, 1.0 - 1e-6), table, field.grid, torch.ones_like(field.level_weight))
        seen = torch.stack([opacity * edge, opacity], dim=1).repeat(1, field.settings.levels)
        self.state += torch.autograd.grad(features, table, seen)[0]


def rank_loss(
    distance: Tensor, opacity: Tensor, prior: Tensor, weight: Tensor, uv: Tensor, images: int, apart_px: float
) -> Tensor:
    """The paper's relative depth: order of two pixels' depths as the prior has it (method N3).

    The ranking hinge of SparseNeRF (Wang et al. 2023), in units of its margin.

    Args:
        distance: (R,) expected depth along the ray, `images` equal groups of rays one after the other.
        opacity: (R,); both pixels of a pair have to be solid.
        prior: (R,) prior depth along the ray.
        weight: (R,) confidence of the prior, 0 where there is none (also outside the mask).
        uv: (R, 2) pixels.
        images: number of groups; pairs never cross them.
        apart_px: least distance between two pixels of a pair.
    """
    groups = [a.view(images, -1) for a in (distance, opacity.detach(), prior, weight)]
    half = groups[0].shape[1] // 2
    (d, d2), (o, o2), (p, p2), (w, w2) = ((a[:, -2 * half : -half], a[:, -half:]) for a in groups)
    grouped = uv.view(images, -1, 2)
    apart = (grouped[:, -2 * half : -half] - grouped[:, -half:]).norm(dim=-1) >= apart_px
    sign = torch.sign(p2 - p)
    valid = apart & (w > 0) & (w2 > 0) & (o > SOLID_OPACITY) & (o2 > SOLID_OPACITY) & ((p2 - p).abs() > RANK_MARGIN)
    hinge = torch.relu(RANK_MARGIN - sign * (d2 - d)) / RANK_MARGIN
    return (hinge * torch.minimum(w, w2) * valid).sum() / valid.sum().clamp(min=1)


def depth_jumps(depths: Tensor) -> Tensor:
    """Pixels (V, H, W) where the depth jumps from one to the next; never those without depth."""
    jump = torch.zeros_like(depths, dtype=torch.bool)
    for axis in (1, 2):
        a, b = depths.narrow(axis, 0, depths.shape[axis] - 1), depths.narrow(axis, 1, depths.shape[axis] - 1)
        found = (a > 0) & (b > 0) & ((a - b).abs() > DEPTH_JUMP * torch.minimum(a, b))
        jump.narrow(axis, 0, depths.shape[axis] - 1).logical_or_(found)
        jump.narrow(axis, 1, depths.shape[axis] - 1).logical_or_(found)
    return jump


def train_nerf_as_paper(
    *,
    workspace: Path,
    masks: Path,
    prior: Path,
    stage: Path,
    report: Path,
    checkpoints: Path,
    settings: NerfSettings,
    hold_out_every: int,
    seed: int,
) -> None:
    """Train a NeRF from fresh weights on the depth and poses of the stage before (paper 4.2.2, stages 2 and 4).

    Constants are those of `recipe`. An epoch of the paper shows every pixel of the object in every training photo once.
    On a GPU that is what is drawn, with the paper's field; on a CPU it is `rays_per_epoch`, with the field of the
    settings; log and report say how many the paper's are.

    Args:
        workspace: undistorted COLMAP workspace of the object, with the poses of the stage before.
        masks: folder of masks named like the photos, .png.
        prior: folder of the stage before, with depth_maps/ and confidence_maps/.
        stage: output folder, as of `train_object_nerf`.
        report: output JSON, as of `train_object_nerf`, with both budgets.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: size of photos and, on a CPU, of field and epochs.
        hold_out_every: every n-th photo is not trained on and measures quality; 0 holds out none.
        seed: of the weights and of every random draw.

    Raises:
        StageError: as of `train_object_nerf`.
    """
    device = prepare_device(settings.device)
    letter = rays_of_an_epoch(workspace, masks, settings.width_px, hold_out_every)
    drawn = as_paper(settings, letter, device)
    print(f"{drawn.schedule.rays_per_epoch} rays an epoch are drawn, of the paper's {letter}", flush=True)
    train_object_nerf(
        inputs=NerfInputs(workspace, masks, prior), stage=stage, report=report, checkpoints=checkpoints,
        settings=drawn, hold_out_every=hold_out_every, seed=seed,
        add=partial(OrderAndEdges, images=NERF.images_per_batch),
    )  # fmt: skip
    content = read_json(report) | {
        "rays_per_epoch": quantity(drawn.schedule.rays_per_epoch, "1"),
        "rays_per_epoch_paper": quantity(letter, "1"),
        "field_is_the_papers": quantity(drawn.field == FIELD, ""),
    }
    write_json(report, content)


def as_paper(settings: NerfSettings, letter: int, device: str) -> NerfSettings:
    """The paper's recipe; its field and its rays an epoch (`letter`) on a GPU, those of the settings on a CPU."""
    field, rays = settings.field, min(letter, settings.schedule.rays_per_epoch)
    if device == "cuda":
        field, rays = FIELD, letter
    schedule = Schedule(settings.schedule.epochs, rays)
    return replace(settings, field=field, schedule=schedule, recipe=NERF, losses=LossWeights())


def rays_of_an_epoch(workspace: Path, masks: Path, width_px: int, hold_out_every: int) -> int:
    """Pixels of the object in all training photos."""
    views = load_views(workspace, masks, width_px, hold_out_every)
    return int(views.masks[~views.held_out].sum())
