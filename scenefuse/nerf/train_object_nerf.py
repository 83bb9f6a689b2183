"""Stages 2 and 4 of an object: a depth-guided NeRF on its masked photos, and the depth maps it renders."""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor

from scenefuse.core.checkpoints import State, key_of
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError, atomic_directory, quantity, setting, threads, value, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.mvs.sparse_depths import own_points, sparse_depths
from scenefuse.mvs.stereo_points import with_stereo
from scenefuse.nerf.appearance import measured_sharpness, photo_weights
from scenefuse.nerf.field import FieldSettings, kernels_on
from scenefuse.nerf.rays import SOLID_OPACITY, LossWeights, PhotoTensors
from scenefuse.nerf.rendered_maps import (
    DepthPrior,
    RenderedMaps,
    RenderedMapSettings,
    measure_quality,
    read_nerf,
    read_prior,
    render_maps,
    write_maps,
    write_nerf,
)
from scenefuse.nerf.training import (
    Additions,
    Nerf,
    NerfRecipe,
    Schedule,
    Training,
    go_on_from,
    keep_memory,
    new_nerf,
    train,
)
from scenefuse.nerf.volume import Volume, find_volume, hidden_pixels, silhouettes
from scenefuse.photos.views import Views, load_views

# A rendered depth is confident from here on; what later stages and the export call confident.
MIN_CONFIDENCE = SOLID_OPACITY
# What a training returns beside its losses.
NO_LOSSES = ("steps", "seconds", "rays_per_second", "samples_per_second", "psnr")


@dataclass(frozen=True)
class NerfSettings:
    """Of a NeRF stage."""

    device: Literal["auto", "cpu", "cuda"] = setting("auto")
    """Where the NeRF trains; `auto` takes CUDA where there is a GPU."""
    width_px: int = setting(800, unit="px", least=16)
    """Photos are scaled down to this width, for training and for the rendered maps; points come from their pixels."""
    hull_tolerance: float = setting(0.04, least=0, most=1)
    """Share of the photos that may have a part of the object outside their mask; raise it where thin parts are lost."""
    field: FieldSettings = FieldSettings()
    """Size of the field."""
    schedule: Schedule = Schedule()
    """Length of the training."""
    recipe: NerfRecipe = NerfRecipe()
    """Batches, rates and samples."""
    losses: LossWeights = LossWeights()
    """Weights of the losses."""
    maps: RenderedMapSettings = RenderedMapSettings()
    """Of the rendered maps."""


@dataclass(frozen=True)
class NerfInputs:
    """What a NeRF stage reads."""

    workspace: Path
    """Undistorted COLMAP workspace of the object."""
    masks: Path
    """Folder of masks named like the photos, .png."""
    prior: Path | None = None
    """Stage folder with depth_maps/ and confidence_maps/ (object units, along z), or none."""
    previous: Path | None = None
    """Folder of an earlier NeRF stage to go on from, or none to start afresh."""


def train_object_nerf(
    *,
    inputs: NerfInputs,
    stage: Path,
    report: Path,
    checkpoints: Path,
    settings: NerfSettings,
    hold_out_every: int,
    seed: int,
    add: Annotated[Callable[[Nerf, PhotoTensors], Additions] | None, tyro.conf.Suppress] = None,
) -> None:
    """Train a NeRF of one object and render depth, normals and confidence for every photo.

    Instant-ngp's field (Mueller et al. 2022) in a cube around the visual hull of the masks, with the paper's losses:
    photometric, depth, mask, sparsity (method N2 to N9). Depth is the median along
    the ray where opacity exceeds 0.9; its confidence is opacity times the share of other views that agree.

    Args:
        inputs: photos, masks, prior and earlier stage.
        stage: output folder: model.pt, depth_maps/, confidence_maps/, normal_maps/, renders/ of held-out photos.
        report: output JSON.
        checkpoints: folder for training states; a killed run resumes from it.
        settings: of field, training and maps.
        hold_out_every: every n-th photo is not trained on and measures quality; 0 holds out none.
        seed: of the weights and of every random draw.
        add: what another recipe adds to the training of these photos.

    Raises:
        StageError: no masks, an empty visual hull, CUDA asked for and missing, a training that diverged, or no
            surface found.
    """
    start = time.monotonic()
    device = prepare_device(settings.device)
    given = _read(inputs, settings, hold_out_every)
    nerf = new_nerf(settings.field, torch.from_numpy(given.volume.hull), len(given.trained), seed, device)
    warm = given.earlier is not None and given.earlier["model"]["settings"] == nerf.state()["settings"]
    if given.earlier is not None and warm:
        go_on_from(nerf, given.earlier["model"])
    photos = given.photos
    additions = None if add is None else add(nerf, photos)
    weight = torch.ones(len(photos))
    if settings.recipe.appearance:
        weight = photo_weights(measured_sharpness(photos.images, photos.masks), photos.center)
    training = Training(photos, settings.schedule, settings.recipe, settings.losses, warm, seed, weight, additions)
    checkpoint = checkpoints / _key(given, settings, device, seed) / "state.pt"
    what = f"{len(given.trained)} photos, hull {given.volume.hull.mean():.1%} of the cube, {training.steps} steps"
    print(f"{what} on {device} ({kernels_on(device)})", flush=True)
    result = train(nerf, training, checkpoint=checkpoint, report=lambda line: print(line, flush=True))
    nerf_from_object = given.volume.nerf_from_object
    photos = photo_tensors(given.views, nerf_from_object, None, exact=True)
    maps = render_maps(nerf, photos, given.views, nerf_from_object.scale, settings.maps)
    exact = settings.recipe.mask_band_px == 0
    content = {
        "nerf_from_object": quantity(nerf_from_object.matrix, "nerf units per object unit"),
        "started_from_previous": quantity(warm, ""),
        **_report(nerf, given, settings, result, maps),
        **_appearance(given, weight, maps),
        **measure_quality(given.views, maps.rendered, maps.measured, exact),
    }
    with atomic_directory(stage) as folder:
        write_maps(maps, folder)
        write_nerf(folder / "model.pt", nerf, nerf_from_object, maps)
    content["seconds"] = quantity(round(time.monotonic() - start, 1), "s")
    write_json(report, content)
    shutil.rmtree(checkpoint.parent, ignore_errors=True)
    _print_summary(content)


def photo_tensors(views: Views, nerf_from_object: Sim3, prior: DepthPrior | None, exact: bool) -> PhotoTensors:
    """All photos in the unit cube's frame, with the depth prior if there is one; grey mattes only where `exact`."""
    rotation = np.stack([nerf_from_object.rotation @ pose[:3, :3] for pose in views.object_from_cam])
    nothing = np.zeros(views.masks.shape, np.float32)
    depths, confidence = (nothing, nothing) if prior is None else (prior.depths, prior.confidence)
    return PhotoTensors(
        torch.from_numpy(views.images),
        torch.from_numpy(views.masks),
        torch.from_numpy(views.mattes if exact else views.masks.astype(np.uint8) * 255),
        torch.from_numpy(views.intrinsics.astype(np.float32)),
        torch.from_numpy(rotation.astype(np.float32)),
        torch.from_numpy(nerf_from_object.apply(views.object_from_cam[:, :3, 3]).astype(np.float32)),
        torch.from_numpy((depths * nerf_from_object.scale).astype(np.float32)),
        torch.from_numpy(confidence),
    )


@dataclass(frozen=True)
class _Given:
    """What a stage has read: photos, the rows (T,) of those it trains on, where the object is, prior, these photos as
    tensors, earlier stage."""

    views: Views
    trained: NDArray[np.int64]
    volume: Volume
    prior: DepthPrior | None
    photos: PhotoTensors
    earlier: State | None


def _read(inputs: NerfInputs, settings: NerfSettings, hold_out_every: int) -> _Given:
    """Photos, the object's volume (in the earlier stage's cube), and the prior."""
    views = load_views(inputs.workspace, inputs.masks, settings.width_px, hold_out_every)
    earlier, cube = None, None
    if inputs.previous is not None:
        earlier = read_nerf(inputs.previous)
        cube = Sim3.from_matrix(earlier["nerf_from_object"].numpy())
    trained = np.flatnonzero(~views.held_out)
    hides = sparse_depths(with_stereo(views))
    outlines = silhouettes(views.masks, hides, views.intrinsics, views.object_from_cam, views.sizes)
    seen = [outlines[row] for row in trained]
    cells, tolerance = settings.recipe.occupancy_cells, settings.hull_tolerance
    volume = find_volume(seen, cells, tolerance, cube, views.sparse[own_points(views)])
    prior = None if inputs.prior is None else read_prior(inputs.prior, views)
    photos = photo_tensors(views, volume.nerf_from_object, prior, exact=settings.recipe.mask_band_px == 0)
    photos = replace(photos, hidden=torch.from_numpy(hidden_pixels(volume, outlines))).select(trained)
    return _Given(views, trained, volume, prior, photos, earlier)


def prepare_device(device: str) -> str:
    """Set threads, arithmetic and memory for training; cpu or cuda.

    Raises:
        StageError: CUDA is asked for and there is none.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise StageError("device is set to cuda, but PyTorch sees no CUDA device; set it to auto or cpu")
    use_threads(threads())
    torch.backends.cuda.matmul.fp32_precision = "tf32"
    keep_memory()
    return "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"


def _key(given: _Given, settings: NerfSettings, device: str, seed: int) -> str:
    """What a checkpoint belongs to: all that the training depends on."""
    parts = [settings, device, seed, given.trained.tolist(), given.volume.hull, *vars(given.photos).values()]
    if given.earlier is not None:
        parts += [*given.earlier["model"]["field"].values(), given.earlier["model"]["density"]]
    return key_of(*parts)


def _report(
    nerf: Nerf, given: _Given, settings: NerfSettings, result: dict[str, float], maps: RenderedMaps
) -> dict[str, Any]:
    """Quantities of the training and of its maps."""
    prior, device = given.prior, nerf.field.table.device.type
    return {
        "steps": quantity(int(result["steps"]), "1"),
        "epochs": quantity(settings.schedule.epochs, "1"),
        "training_seconds": quantity(round(result["seconds"], 1), "s"),
        "rays_per_second": quantity(round(result["rays_per_second"]), "1/s"),
        "samples_per_second": quantity(round(result["samples_per_second"]), "1/s"),
        "device": quantity(device, ""),
        "kernels": quantity(kernels_on(device), ""),
        "prior_confident_share": quantity(prior and _confident_share(prior, given), "1"),
        "hull_share": quantity(float(given.volume.hull.mean()), "1"),
        "diagonal": quantity(maps.diagonal, "object units"),
        **{f"loss_{name}": quantity(value, "1") for name, value in result.items() if name not in NO_LOSSES},
        "confident_share": quantity(float((maps.confidence > MIN_CONFIDENCE).sum() / given.views.masks.sum()), "1"),
    }


def _confident_share(prior: DepthPrior, given: _Given) -> float:
    """Share of the training photos' masks that have a prior."""
    masked = int(given.views.masks[given.trained].sum())
    return float((prior.confidence > 0).sum() / max(masked, 1))


def _appearance(given: _Given, weight: Tensor, maps: RenderedMaps) -> dict[str, Any]:
    """What the photos differ in: gains and weights of those trained on, by name, and the vignetting."""
    names = [given.views.names[row] for row in given.trained]
    gains = maps.log_gain[torch.from_numpy(given.trained)].exp()
    blurred = {name: round(float(w), 3) for name, w in zip(names, weight) if w < 1}
    for name, share in blurred.items():
        print(f"{name} is blurred beside the photos taken near it: its colours count {share:.0%}", flush=True)
    return {
        "photo_gains": quantity({n: [round(float(g), 4) for g in row] for n, row in zip(names, gains)}, "1"),
        "log_gain_deviation": quantity(float(gains.mean(1).log().std(correction=0)), "1"),
        "vignetting_at_corner": quantity(float(maps.falloff.exp()), "1"),
        "blurred_photos": quantity(blurred, "1"),
    }


def _print_summary(report: dict[str, Any]) -> None:
    print(
        f"{value(report, 'measured_on')}: PSNR {value(report, 'psnr_held_out'):.2f} dB as rendered, right half "
        f"{value(report, 'psnr_right_half'):.2f}, with gains fitted on the left half "
        f"{value(report, 'psnr_right_half_fitted_on_left'):.2f}, "
        f"SSIM {value(report, 'ssim'):.3f}, confident {value(report, 'confident_share'):.1%}, "
        f"{value(report, 'seconds')} s",
        flush=True,
    )
