"""What is known of an object's surface before a NeRF is trained, and what the trained one shows of its photos: depth,
confidence and normal maps, renders, and how good they are.

The prior's depths are moved to where the training photos match, and confirmed by other views; in stage 3 those are the
depths that the NeRF rendered, for it to be trained again on them.
"""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scenefuse.core.checkpoints import read_state
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError, atomic_directory, quantity, threads, value, write_json
from scenefuse.core.transforms import DEPTH_JUMP, Sim3
from scenefuse.geometry.consistency import compare, extent, normals_from_depth, surface_points
from scenefuse.geometry.depth_test import MIN_AGREEING
from scenefuse.mvs.photo_refinement import RefinementSettings, refine_by_photos
from scenefuse.nerf.appearance import MIN_OPACITY, blurred, falloff_map, fitted_log_gain, gains_nearby
from scenefuse.nerf.rays import SURFACE_DEPTH, PhotoTensors, dilate
from scenefuse.nerf.render import RenderedView, render_view
from scenefuse.nerf.training import Nerf
from scenefuse.photos.pictures import read_depth, write_depth, write_normals, write_picture
from scenefuse.photos.views import Views, load_views

# Two depths of one place agree within this share of the object's diagonal.
MAP_AGREEMENT = 0.005
SHIPPED = RefinementSettings()

Maps = NDArray[np.float32]

# Views are rendered so far beyond their masks: what the object shows beyond them counts against it. Windows of 11
# pixels, in which structural similarity is measured, reach as far.
BEYOND_MASK_PX = 5
# Normals come from depths so many pixels apart, unless these jump.
NORMAL_STEP_PX = 2


@dataclass(frozen=True)
class DepthPrior:
    """What is known of the surface before a NeRF is trained.

    Attributes:
        depths: (V, H, W) along z in object units, 0 for none, at the size of the views.
        confidence: (V, H, W) in 0..1, 0 in held-out views.
    """

    depths: Maps
    confidence: Maps


def confirm(
    views: Views, depths: Maps, settings: RefinementSettings = SHIPPED, map_agreement: float = MAP_AGREEMENT
) -> tuple[DepthPrior, dict[str, Any]]:
    """Depth maps (V, H, W) as a prior, and what the report of their stage says of it.

    Depths are moved to where the training photos match best, and those that photos contradict are left out. The
    confidence is 1 where photos moved a depth and elsewhere the share of the views that agree among those that should
    see the place; 0 unless two other views have the same surface. Held-out photos take no part: their maps stay as they
    are, without confidence.

    Args:
        views: photos, masks and cameras at the maps' size.
        depths: along z in object units, 0 for none.
        settings: of the refinement by photos.
        map_agreement: largest difference of depth that agrees, share of the object's diagonal.
    """
    training = np.flatnonzero(~views.held_out)
    seen, before = views.select(training), depths[training] * views.masks[training]
    matched = refine_by_photos(seen, before, settings)
    kept = np.where(matched.inconsistent, 0, matched.depths).astype(np.float32)
    agree, through, _ = agreement(seen, kept, map_agreement)
    share = np.where(matched.moved, 1, agree / np.maximum(agree + through, MIN_AGREEING))
    share = np.where(agree >= MIN_AGREEING, share, 0).astype(np.float32)
    prior = DepthPrior(depths * views.masks, np.zeros_like(depths))
    prior.depths[training], prior.confidence[training] = kept, share
    there, masked = max(int((before > 0).sum()), 1), max(int(seen.masks.sum()), 1)
    return prior, {
        "refined_share": quantity(float(matched.moved.sum() / there), "1"),
        "inconsistent_share": quantity(float(matched.inconsistent.sum() / there), "1"),
        "confirmed_share": quantity(float((share > 0).sum() / masked), "1"),
    }


def agreement(views: Views, depths: Maps, share: float) -> tuple[NDArray[np.int32], NDArray[np.int32], float]:
    """(V, H, W) how many other views have the same surface, and how many see through it; the object's diagonal, of
    which depths of one place differ by `share` at most."""
    known = [surface_points(*view) for view in zip(depths, views.intrinsics, views.object_from_cam)]
    diagonal = extent(np.concatenate([points for points, _, _ in known]))
    cameras, tolerance = (views.intrinsics, views.object_from_cam), share * diagonal
    agree, through = np.zeros((2, *depths.shape), np.int32)
    for index, (points, rows, columns) in enumerate(known):
        found = compare(points, index, depths, views.masks, *cameras, tolerance)
        agree[index, rows, columns], through[index, rows, columns] = found.agree, found.through
    return agree, through, diagonal


def write_prior(folder: Path, views: Views, prior: DepthPrior) -> None:
    """Write depth_maps/ and confidence_maps/ of a stage folder: one COLMAP map of each photo."""
    for kind, maps in (("depth_maps", prior.depths), ("confidence_maps", prior.confidence)):
        for name, (height, width), values in zip(views.names, views.sizes.tolist(), maps):
            write_depth(folder / kind / f"{name}.bin", values[:height, :width])


def read_prior(folder: Path, views: Views) -> DepthPrior:
    """The prior in a stage folder, at the size of the views."""
    depths, confidence = (read_stage_maps(folder / kind, views) for kind in ("depth_maps", "confidence_maps"))
    depths = np.where(np.isfinite(depths) & views.masks, depths, 0).clip(0)
    confidence = np.nan_to_num(confidence).clip(0, 1) * (depths > 0) * ~views.held_out[:, None, None]
    return DepthPrior(depths, confidence)


def read_stage_maps(folder: Path, views: Views) -> Maps:
    """The maps (V, H, W) in a folder at the size of the views, zeros where there is none."""
    maps = np.zeros(views.masks.shape, np.float32)
    for place, name, (height, width) in zip(maps, views.names, views.sizes.tolist()):
        path = folder / f"{name}.bin"
        if path.is_file():
            place[:height, :width] = cv2.resize(read_depth(path), (width, height), interpolation=cv2.INTER_NEAREST)
    return maps


def refine_depth(
    *, workspace: Path, masks: Path, rendered: Path, stage: Path, report: Path, width_px: int, hold_out_every: int
) -> None:
    """Move rendered depth to where the training photos match, and mark what other views confirm (method N12).

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        rendered: stage 2's folder, with depth_maps/.
        stage: output folder: depth_maps/{photo}.bin and confidence_maps/{photo}.bin (0..1).
        report: output JSON: shares of the depths that photos moved, contradicted, confirmed.
        width_px: width of the rendered maps.
        hold_out_every: as in stage 1.

    Raises:
        StageError: no photo of the object has a rendered depth.
    """
    start = time.monotonic()
    use_threads(threads())
    views = load_views(workspace, masks, width_px, hold_out_every)
    depths = read_stage_maps(rendered / "depth_maps", views)
    if not depths.any():
        raise StageError(f"{rendered}/depth_maps holds no depth for any photo of the object; run stage 2 again")
    prior, content = confirm(views, depths)
    with atomic_directory(stage) as folder:
        write_prior(folder, views, prior)
    write_json(report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    print(f"photos moved {value(content, 'refined_share'):.0%} of the rendered depths", flush=True)


@dataclass(frozen=True)
class RenderedMapSettings:
    """How depth maps are rendered and compared."""

    render_samples: int = 32
    """Samples per ray when views are rendered."""
    map_agreement: float = MAP_AGREEMENT
    """Two depths of one place agree within this share of the object's diagonal."""


@dataclass(frozen=True)
class RenderedMaps:
    """All V photos as the NeRF shows them, in the object's frame and unit.

    Attributes:
        views: photos, masks and cameras.
        depths: (V, H, W) along z, 0 for none.
        confidence: (V, H, W), opacity times the share of the views that should see a point and agree.
        rendered: V renders in nerf units, with the vignetting and `log_gain`; those of photos that do not measure
            quality have no colours.
        log_gain: (V, 3) of training photos as trained, of held-out ones as of the nearest (`gains_nearby`).
        falloff: () of the vignetting.
        measured: (V,) bool, photos that measure quality: the held-out ones, or all.
        diagonal: of the object, in its unit.
    """

    views: Views
    depths: Maps
    confidence: Maps
    rendered: list[RenderedView]
    log_gain: Tensor
    falloff: Tensor
    measured: NDArray[np.bool_]
    diagonal: float


def render_maps(
    nerf: Nerf,
    photos: PhotoTensors,
    views: Views,
    scale: float,
    settings: RenderedMapSettings,
) -> RenderedMaps:
    """Render every photo.

    Args:
        nerf: trained.
        photos: as tensors in the unit cube's frame.
        views: the same photos.
        scale: nerf units per object unit.
        settings: samples, and what agrees.

    Raises:
        StageError: no ray met a surface.
    """
    measured = views.held_out if views.held_out.any() else np.ones(len(views.names), bool)
    where = dilate(photos.masks, BEYOND_MASK_PX) & ~torch.from_numpy(views.beyond)
    looks = nerf.appearance.log_gain.cpu(), nerf.appearance.falloff.cpu()
    log_gain = gains_nearby(looks[0], photos.center, torch.from_numpy(np.flatnonzero(~views.held_out)))
    rendered = [
        render_view(nerf.field, nerf.occupancy, photos.camera(view), where[view], settings.render_samples, colored)
        for view, colored in enumerate(measured)
    ]
    for view in np.flatnonzero(measured):
        factor = log_gain[view].exp() * falloff_map(looks[1], photos.intrinsics[view], *photos.masks.shape[1:])
        rendered[view] = replace(rendered[view], color=rendered[view].color * factor)
    depths: Any = np.stack([_solid_depth(view).numpy() for view in rendered]) / scale
    if not (depths > 0).any():
        raise StageError(
            f"the NeRF found no surface: no ray reached an opacity of {MIN_OPACITY}; check the masks and the cameras"
        )
    agree, through, diagonal = agreement(views, depths, settings.map_agreement)
    opacity = np.stack([view.opacity.numpy() for view in rendered]).clip(0, 1)
    confidence = (agree / np.maximum(agree + through, MIN_AGREEING) * opacity).astype(np.float32)
    return RenderedMaps(views, depths, confidence, rendered, log_gain, looks[1], measured, diagonal)


def write_maps(maps: RenderedMaps, folder: Path) -> None:
    """Write depth_maps/, confidence_maps/, normal_maps/ of all photos, and renders/ of those that measure quality."""
    sizes = maps.views.sizes.tolist()
    for index, (name, (height, width)) in enumerate(zip(maps.views.names, sizes)):
        photo = np.s_[:height, :width]
        write_depth(folder / "depth_maps" / f"{name}.bin", maps.depths[index][photo])
        write_depth(folder / "confidence_maps" / f"{name}.bin", maps.confidence[index][photo])
        normals = normals_from_depth(maps.depths[index], maps.views.intrinsics[index], NORMAL_STEP_PX, DEPTH_JUMP)
        write_normals(folder / "normal_maps" / f"{name}.bin", normals[photo])
    (folder / "renders").mkdir()
    for row in np.flatnonzero(maps.measured):
        height, width = sizes[row]
        picture = (maps.rendered[row].color.clamp(0, 1).numpy()[:height, :width] * 255 + 0.5).astype(np.uint8)
        write_picture(folder / "renders" / f"{Path(maps.views.names[row]).stem}.png", picture)


def write_nerf(path: Path, nerf: Nerf, nerf_from_object: Sim3, maps: RenderedMaps) -> None:
    """Write what a later stage goes on from: the field, its cube, and the appearance of the photos.

    The gains of held-out photos, which the cloud's colours need too, are fitted to the whole photo here.
    """
    log_gain = maps.log_gain.clone()
    for row in np.flatnonzero(maps.views.held_out):
        mask, photo = torch.from_numpy(maps.views.masks[row]), torch.from_numpy(maps.views.images[row])
        log_gain[row] += fitted_log_gain(maps.rendered[row].color[mask], photo[mask] / 255.0)
    saved = {
        "model": nerf.state(),
        "nerf_from_object": torch.from_numpy(nerf_from_object.matrix),
        "names": maps.views.names,
        "log_gain": log_gain,
        "falloff": maps.falloff,
    }
    torch.save(saved, path)


def read_nerf(stage: Path) -> dict[str, Any]:
    """What `write_nerf` wrote into a stage's folder, on the CPU wherever it was trained.

    Raises:
        StageError: there is none, or it is damaged.
    """
    path = stage / "model.pt"
    if not path.is_file():
        raise StageError(f"{path} does not exist; run the NeRF stage first")
    return read_state(path, {"model": {}, "names": []}, f"delete {stage} and run the NeRF stage again")


def measure_quality(
    views: Views, rendered: list[RenderedView], measured: NDArray[np.bool_], exact: bool
) -> dict[str, Any]:
    """Mean quality on the photos `measured` (V,), for the report.

    Renders are on black, and so is the photo where mattes are `exact`: its grey pixels hold part of the background. The
    quality of the right half is given twice: as rendered, and with gains fitted to the left half, as in NeRF in the
    Wild (Martin-Brualla et al. 2021, section 5).
    """
    rows = []
    for index in np.flatnonzero(measured):
        mask, everything = torch.from_numpy(views.masks[index]), torch.from_numpy(~views.beyond[index])
        photo = torch.from_numpy(views.images[index]).float() / 255.0
        picture = rendered[index].color.clamp(0, 1)
        masked = photo * (torch.from_numpy(views.mattes[index]) / 255.0 if exact else mask)[..., None]
        right, fitted = right_half(mask), fitted_to_left_half(rendered[index].color, masked, mask).clamp(0, 1)
        rows.append(
            {
                "psnr_held_out": psnr(picture, masked, mask),
                "psnr_held_out_masked_photo": psnr(picture, masked, everything),
                "ssim": ssim(picture, masked, dilate(mask[None], BEYOND_MASK_PX)[0]),
                "psnr_right_half": psnr(picture, masked, right),
                "psnr_right_half_fitted_on_left": psnr(fitted, masked, right),
                "silhouette_iou": silhouette_iou(rendered[index].opacity, mask),
            }
        )
    unit = {True: "dB", False: "1"}
    return {
        **{n: quantity(float(np.mean([row[n] for row in rows])), unit[n.startswith("psnr")]) for n in rows[0]},
        "measured_on": quantity("held-out photos" if views.held_out.any() else "training photos", ""),
        "photos_measured": quantity(int(measured.sum()), "1"),
    }


def right_half(mask: Tensor) -> Tensor:
    """The pixels of a mask (H, W) on the right of their median column; all where there are none."""
    columns = torch.arange(mask.shape[1]).expand_as(mask)
    right = mask & (columns > columns[mask].median()) if mask.any() else mask
    return right if right.any() else mask


def fitted_to_left_half(rendered: Tensor, photo: Tensor, mask: Tensor) -> Tensor:
    """A render (H, W, 3) with the gains that suit the photo best in the left half of the mask (H, W)."""
    left = mask & ~right_half(mask)
    return rendered * fitted_log_gain(rendered[left], photo[left]).exp()


def psnr(a: Tensor, b: Tensor, where: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of (H, W, 3) pictures in 0..1 over the pixels `where` (H, W)."""
    error = ((a - b) ** 2)[where].mean()
    return float(-10 * torch.log10(error.clamp(min=1e-10)))


def ssim(a: Tensor, b: Tensor, where: Tensor) -> float:
    """Structural similarity (Wang et al. 2004) of (H, W, 3) pictures in 0..1; Gaussian window, sigma 1.5 pixels."""
    a, b = (picture.permute(2, 0, 1) for picture in (a, b))
    mean_a, mean_b, aa, bb, ab = (blurred(planes, 1.5) for planes in (a, b, a * a, b * b, a * b))
    c1, c2 = 0.01**2, 0.03**2
    covariance, spread = ab - mean_a * mean_b, (aa - mean_a**2) + (bb - mean_b**2)
    score = (2 * mean_a * mean_b + c1) * (2 * covariance + c2) / ((mean_a**2 + mean_b**2 + c1) * (spread + c2))
    return float(score[:, where].mean())


def silhouette_iou(opacity: Tensor, mask: Tensor) -> float:
    """Intersection over union of opacity > 0.5 and a mask, both (H, W)."""
    solid = opacity > 0.5
    return float((solid & mask).sum() / (solid | mask).sum().clamp(min=1))


def _solid_depth(rendered: RenderedView) -> Tensor:
    """(H, W) median depth, 0 where the ray is not opaque or its weights are spread."""
    keep = (rendered.opacity > MIN_OPACITY) & (rendered.deviation < SURFACE_DEPTH)
    return torch.where(keep, rendered.depth, torch.zeros_like(rendered.depth))
