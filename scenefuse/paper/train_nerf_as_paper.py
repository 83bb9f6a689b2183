"""Stages 2 and 4 by the paper: a depth-guided NeRF with its rates, batches and losses; stage 4 starts afresh."""

import time
from dataclasses import replace
from pathlib import Path

import torch

from scenefuse.core.stage import quantity, read_json, write_json
from scenefuse.nerf.field import Field, FieldSettings
from scenefuse.nerf.rays import PhotoTensors
from scenefuse.nerf.train_object_nerf import NerfInputs, NerfSettings, prepare_device, train_stage
from scenefuse.nerf.training import Nerf, Schedule
from scenefuse.paper.order_and_edges import OrderAndEdges
from scenefuse.paper.recipe import FIELD, LOSSES, NERF
from scenefuse.photos.views import load_views

# Samples that a field's speed is measured on.
PROBE_SAMPLES = 1 << 16


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
    settings, and what the paper's would take is said before and in the report.

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
    budgets = {"paper": (FIELD, letter), "drawn": (drawn.field, drawn.schedule.rays_per_epoch)}
    epochs = settings.schedule.epochs
    seconds = {name: epochs * rays * seconds_per_ray(field, device) for name, (field, rays) in budgets.items()}
    print(
        f"the paper's {epochs} epochs of {letter} rays would take about {seconds['paper']:.0f} s on this {device}; "
        f"{drawn.schedule.rays_per_epoch} rays an epoch are drawn: about {seconds['drawn']:.0f} s",
        flush=True,
    )
    train_stage(
        NerfInputs(workspace, masks, prior), stage, report, checkpoints, drawn, hold_out_every, seed, order_and_edges
    )
    content = read_json(report) | {
        "rays_per_epoch": quantity(drawn.schedule.rays_per_epoch, "1"),
        "rays_per_epoch_paper": quantity(letter, "1"),
        "seconds_estimated": quantity(round(seconds["drawn"], 1), "s"),
        "seconds_estimated_paper": quantity(round(seconds["paper"], 1), "s"),
        "field_is_the_papers": quantity(drawn.field == FIELD, ""),
    }
    write_json(report, content)


def as_paper(settings: NerfSettings, letter: int, device: str) -> NerfSettings:
    """The paper's recipe; its field and its rays an epoch (`letter`) on a GPU, those of the settings on a CPU."""
    field, rays = settings.field, min(letter, settings.schedule.rays_per_epoch)
    if device == "cuda":
        field, rays = FIELD, letter
    schedule = Schedule(settings.schedule.epochs, rays)
    return replace(settings, field=field, schedule=schedule, recipe=NERF, losses=LOSSES)


def order_and_edges(nerf: Nerf, photos: PhotoTensors) -> OrderAndEdges:
    """What the paper adds to the training."""
    return OrderAndEdges(nerf, photos, NERF.images_per_batch)


def rays_of_an_epoch(workspace: Path, masks: Path, width_px: int, hold_out_every: int) -> int:
    """Pixels of the object in all training photos."""
    views = load_views(workspace, masks, width_px, hold_out_every)
    return int(views.masks[~views.held_out].sum())


def seconds_per_ray(settings: FieldSettings, device: str) -> float:
    """Seconds that training takes for a ray, by the field's own part of it: a quick measurement, an estimate."""
    field = Field(settings, torch.Generator().manual_seed(0)).to(device)
    x = torch.rand(PROBE_SAMPLES, 3, generator=torch.Generator().manual_seed(0)).to(device)
    for _ in range(2):  # the first compiles
        start = time.perf_counter()
        density, features = field.geometry(x)
        (density.mean() + field.color(features, x[: PROBE_SAMPLES // 16]).mean()).backward()
        float(field.table.grad.sum())  # type: ignore[union-attr]  # waits for a GPU
        seconds = time.perf_counter() - start
    samples = (NERF.samples_first + 3 * NERF.samples_last) / 4
    return seconds * samples / PROBE_SAMPLES
