"""Stages 2 and 4 of an object: a depth-guided NeRF on its masked photos, and the depth maps it renders."""

import hashlib
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from scenefuse.cores import use_threads
from scenefuse.depth.prior import DepthPrior, read_prior
from scenefuse.io.maps import write_depth, write_normals
from scenefuse.mvs.consistency import compare, extent, normals_from_depth, surface_points
from scenefuse.mvs.photo_refinement import RefinementSettings
from scenefuse.mvs.views import Views, load_views
from scenefuse.nerf.encoding import kernels_on
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.losses import LossWeights
from scenefuse.nerf.occupancy import Occupancy, tight_cube, visual_hull
from scenefuse.nerf.quality import psnr, silhouette_iou, ssim
from scenefuse.nerf.rays import Photos, cube_from_cameras, dilate
from scenefuse.nerf.render import Rendered, render_view
from scenefuse.nerf.training import Model, Schedule, keep_memory, new_model, refined, train
from scenefuse.stage import StageError, atomic_directory, quantity, setting, threads, write_json
from scenefuse.transforms import Sim3, fit_sim3

# A rendered depth is confident from here on; what later stages and the export call confident.
CONFIDENT = 0.5


@dataclass(frozen=True)
class NerfSettings:
    """What a NeRF stage needs besides field, schedule and losses."""

    width_px: int = setting(480, unit="px", least=0)
    """photos are scaled down to this width, for training and for the rendered maps"""
    occupancy_cells: int = setting(128, least=0)
    """cells per side of the occupancy grid, a multiple of 4 times a power of 2"""
    mask_band_px: int = setting(2, unit="px", least=0)
    """half-width of the band around a mask's edge that no loss touches; 0: masks are exact, grey values included"""
    hull_tolerance: float = setting(0.04, least=0)
    """share of the photos that may deny a cell of the visual hull"""
    render_samples: int = setting(32, least=0)
    """samples per ray when views are rendered"""
    agreement: float = setting(0.005, unit="of the diagonal", least=0)
    """two rendered depths agree within this share of the object's diagonal"""


def train_object_nerf(
    *,
    cameras: Path,
    masks: Path,
    prior: Path | None,
    previous: Path | None,
    stage: Path,
    report: Path,
    checkpoints: Path,
    field: FieldSettings,
    schedule: Schedule,
    losses: LossWeights,
    refinement: RefinementSettings,
    settings: NerfSettings,
    hold_out_every: int,
    device: Literal["auto", "cpu", "cuda"],
    seed: int,
) -> None:
    """Train a NeRF of one object and render depth, normals and confidence for every photo.

    Instant-ngp's field (Mueller et al. 2022) in a cube around the visual hull of the masks, with the paper's losses:
    photometric, absolute and relative depth, mask, sparsity, distortion (method N2 to N9). Depth is the median along
    the ray where opacity exceeds 0.9; its confidence is opacity times the share of other views that agree.

    Args:
        cameras: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        prior: stage folder with depth_maps/ and confidence_maps/ (object units, along z), or none.
        previous: folder of an earlier NeRF stage to go on from, with its poses, or none to start afresh.
        stage: output folder: model.pt, depth_maps/, confidence_maps/, normal_maps/, renders/ of held-out photos.
        report: output JSON.
        checkpoints: folder for training states; a killed run resumes from it.
        field: size of the field.
        schedule: of the training.
        losses: weights of the losses.
        refinement: of the prior's depths by photos.
        settings: sizes and gates.
        hold_out_every: every n-th photo is not trained on and measures quality; 0 holds out none.
        device: `auto` takes CUDA where it is; the networks then multiply in TF32.
        seed: of the weights and of every random draw.

    Raises:
        StageError: no masks, an empty visual hull, CUDA asked for and missing, or no surface found.
    """
    start = time.monotonic()
    use_threads(threads())
    torch.backends.cuda.matmul.fp32_precision = "tf32"
    keep_memory()
    chosen = _device(device)
    views = load_views(cameras, masks, settings.width_px, hold_out_every)
    training = np.flatnonzero(~views.held_out)
    earlier = None if previous is None else _read_model(previous / "model.pt")
    if earlier is not None and earlier["names"] == views.names:
        views = replace(views, object_from_cam=earlier["object_from_cam"].numpy())
    nerf_from_object, hull = _volume(views, training, settings, earlier)
    known = None if prior is None else read_prior(prior, views, refinement, settings.agreement)
    photos = make_photos(views, nerf_from_object, known, exact=settings.mask_band_px == 0)
    model = new_model(field, torch.from_numpy(hull), len(training), seed, chosen)
    warm = earlier is not None and earlier["model"]["settings"] == model.state()["settings"]
    if warm and earlier is not None:
        model.field.load_state_dict(earlier["model"]["field"])
        hull_before = model.occupancy.hull
        model.occupancy = Occupancy(hull_before, earlier["model"]["density"].to(chosen), hull_before)
        model.field.level_weight.fill_(1.0)
    key = _key(field, schedule, losses, settings, seed, views.held_out.tolist(), chosen, photos, earlier)
    checkpoint = checkpoints / key / "state.pt"
    kernel = kernels_on(chosen)
    print(
        f"{len(training)} photos, hull {hull.mean():.1%} of the cube, {schedule.steps} steps on {chosen} ({kernel})",
        flush=True,
    )
    result = train(
        model, photos.select(training), schedule, losses, warm=warm, seed=seed, threads=threads(),
        checkpoint=checkpoint, report=lambda line: print(line, flush=True), band_px=settings.mask_band_px,
    )  # fmt: skip
    poses, nerf_from_object, drift = _final_poses(views, training, nerf_from_object, model)
    photos = make_photos(replace(views, object_from_cam=poses), nerf_from_object, None, exact=True)
    measured = views.held_out if views.held_out.any() else np.ones(len(views.names), bool)
    rendered = _render_all(model, photos, settings.render_samples, measured)
    depths = np.stack([_gated_depth(r) for r in rendered]) / nerf_from_object.scale
    if not (depths > 0).any():
        raise StageError(f"the NeRF of {cameras} found no surface: no ray reached an opacity of 0.9; check the masks")
    diagonal = extent(np.concatenate([surface_points(*view)[0] for view in zip(depths, views.intrinsics, poses)]))
    confidence = _confidence(depths, rendered, views, poses, settings.agreement * diagonal)
    content: dict[str, Any] = {
        "nerf_from_object": quantity(nerf_from_object.matrix, "nerf units per object unit"),
        "steps": quantity(int(result["steps"]), "1"),
        "epochs": quantity(schedule.epochs, "1"),
        "training_seconds": quantity(round(result["seconds"], 1), "s"),
        "rays_per_second": quantity(round(result["rays_per_second"]), "1/s"),
        "samples_per_second": quantity(round(result["samples_per_second"]), "1/s"),
        "device": quantity(chosen, ""),
        "kernels": quantity(kernel, ""),
        "started_from_previous": quantity(warm, ""),
        "depth_prior": quantity(prior is not None, ""),
        "prior_refined_share": quantity(known and known.refined_share, "1"),
        "prior_confident_share": quantity(known and known.confident_share, "1"),
        "hull_share": quantity(float(hull.mean()), "1"),
        "occupied_share": quantity(float(model.occupancy.occupied.float().mean()), "1"),
        "diagonal": quantity(diagonal, "object units"),
        **{f"loss_{name}": quantity(v, "1") for name, v in result.items() if name in _TERMS},
        "psnr_training": quantity(result.get("psnr"), "dB"),
        **drift,
        "confident_share": quantity(float((confidence > CONFIDENT).sum() / views.masks.sum()), "1"),
    }
    with atomic_directory(stage) as folder:
        for index, name in enumerate(views.names):
            write_depth(folder / "depth_maps" / f"{name}.bin", depths[index])
            write_depth(folder / "confidence_maps" / f"{name}.bin", confidence[index])
            normals = normals_from_depth(depths[index], views.intrinsics[index], 2, 0.03)
            write_normals(folder / "normal_maps" / f"{name}.bin", normals)
        exact = settings.mask_band_px == 0
        content |= _held_out_quality(views, rendered, np.flatnonzero(measured), folder / "renders", exact)
        saved = {"model": model.state(), "nerf_from_object": torch.from_numpy(nerf_from_object.matrix),
                 "names": views.names, "object_from_cam": torch.from_numpy(poses)}  # fmt: skip
        torch.save(saved, folder / "model.pt")
    content["seconds"] = quantity(round(time.monotonic() - start, 1), "s")
    write_json(report, content)
    checkpoint.unlink(missing_ok=True)
    print(
        f"{content['measured_on']['value']}: PSNR {content['psnr_held_out']['value']:.2f} dB, "
        f"SSIM {content['ssim']['value']:.3f}, "
        f"confident {content['confident_share']['value']:.1%}, {content['seconds']['value']} s",
        flush=True,
    )


_TERMS = ("color", "depth", "rank", "mask", "sparsity", "distortion")


def make_photos(views: Views, nerf_from_object: Sim3, prior: DepthPrior | None, exact: bool) -> Photos:
    """All photos in the unit cube's frame, with the depth prior if there is one; grey mattes only where `exact`."""
    rotation = np.stack([nerf_from_object.rotation @ pose[:3, :3] for pose in views.object_from_cam])
    nothing = np.zeros(views.masks.shape, np.float32)
    depths, confidence = (nothing, nothing) if prior is None else (prior.depths, prior.confidence)
    return Photos(
        torch.from_numpy(views.images),
        torch.from_numpy(views.masks),
        torch.from_numpy(views.mattes if exact else views.masks.astype(np.uint8) * 255),
        torch.from_numpy(views.intrinsics.astype(np.float32)),
        torch.from_numpy(rotation.astype(np.float32)),
        torch.from_numpy(nerf_from_object.apply(views.object_from_cam[:, :3, 3]).astype(np.float32)),
        torch.from_numpy((depths * nerf_from_object.scale).astype(np.float32)),
        torch.from_numpy(confidence),
    )


def _device(device: str) -> str:
    if device == "cuda" and not torch.cuda.is_available():
        raise StageError("device is set to cuda, but PyTorch sees no CUDA device; set it to auto or cpu")
    return "cuda" if device != "cpu" and torch.cuda.is_available() else "cpu"


def _volume(
    views: Views, training: NDArray[np.int64], settings: NerfSettings, earlier: dict[str, Any] | None
) -> tuple[Sim3, NDArray[np.bool_]]:
    """The unit cube (of the earlier stage if there is one) and the visual hull in it."""
    data = views.masks[training], views.intrinsics[training], views.object_from_cam[training]
    try:
        if earlier is not None:
            cube = Sim3.from_matrix(earlier["nerf_from_object"].numpy())
        else:
            first = cube_from_cameras(*data)
            cube = tight_cube(visual_hull(*data, first, 64, settings.hull_tolerance), first, 0.02)
        hull = visual_hull(*data, cube, settings.occupancy_cells, settings.hull_tolerance)
    except ValueError as error:
        raise StageError(f"no volume for the object: {error}; check the masks and the cameras") from None
    if not hull.any():
        raise StageError("the visual hull of the masks is empty: masks and cameras contradict each other; check both")
    return cube, hull


def _read_model(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise StageError(f"{path} does not exist; run the earlier NeRF stage first")
    return torch.load(path, map_location="cpu", weights_only=True)


def _key(*parts: Any) -> str:
    """Hash of settings and inputs: what a checkpoint belongs to."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, Photos):
            for name in part.__dataclass_fields__:
                digest.update(getattr(part, name).numpy().tobytes())
        elif isinstance(part, dict):
            digest.update(part["model"]["field"]["table"].numpy().tobytes())
        else:
            digest.update(repr(part).encode())
    return digest.hexdigest()[:16]


def _final_poses(
    views: Views, training: NDArray[np.int64], nerf_from_object: Sim3, model: Model
) -> tuple[NDArray[np.float64], Sim3, dict[str, Any]]:
    """Refined poses with the gauge's drift moved into nerf_from_object (method N11), and how far they went."""
    poses = views.object_from_cam.copy()
    correction = model.pose.cpu()
    if not correction.any():
        return poses, nerf_from_object, {"pose_refinement": quantity(False, "")}
    before = poses[training]
    rotation = torch.from_numpy(nerf_from_object.rotation @ before[:, :3, :3])
    turned, moved = refined(rotation, torch.from_numpy(nerf_from_object.apply(before[:, :3, 3])), correction.double())
    back = nerf_from_object.inverse()
    after = before.copy()
    after[:, :3, :3] = back.rotation @ turned.numpy()
    after[:, :3, 3] = back.apply(moved.numpy())
    gauge = fit_sim3(before[:, :3, 3], after[:, :3, 3])
    undo = gauge.inverse()
    after[:, :3, :3] = undo.rotation @ after[:, :3, :3]
    after[:, :3, 3] = undo.apply(after[:, :3, 3])
    poses[training] = after
    angle = np.linalg.norm(correction[:, :3].numpy(), axis=1)
    shift = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    drift = {
        "pose_refinement": quantity(True, ""),
        "pose_rotation_median": quantity(float(np.degrees(np.median(angle))), "degrees"),
        "pose_shift_median": quantity(float(np.median(shift)), "object units"),
        "gauge_scale_removed": quantity(gauge.scale, "1"),
        "gauge_shift_removed": quantity(float(np.linalg.norm(gauge.translation)), "object units"),
    }
    return poses, nerf_from_object @ gauge, drift


def _render_all(model: Model, photos: Photos, samples: int, colored: NDArray[np.bool_]) -> list[Rendered]:
    where = dilate(photos.masks, 4)
    field, grid = model.field, model.occupancy
    cameras = zip(photos.intrinsics, photos.rotation, photos.center, where, colored)
    return [render_view(field, grid, k, r, c, pixels, samples, 0.25, show) for k, r, c, pixels, show in cameras]


def _gated_depth(rendered: Rendered) -> NDArray[np.float32]:
    """Median depth where the ray is opaque and its weights are not spread over more than a few hundredths."""
    keep = (rendered.opacity > 0.9) & (rendered.deviation < 0.05)
    return torch.where(keep, rendered.depth, torch.zeros_like(rendered.depth)).numpy()


def _confidence(
    depths: NDArray[np.float32], rendered: list[Rendered], views: Views, poses: NDArray[np.float64], tolerance: float
) -> NDArray[np.float32]:
    """Opacity times the share of the views that should see a point and agree (at least two are asked for)."""
    confidence, masks = np.zeros_like(depths), views.masks
    for index in range(len(depths)):
        points, rows, columns = surface_points(depths[index], views.intrinsics[index], poses[index])
        said = compare(points, index, depths, masks, views.intrinsics, poses, tolerance)
        share = said.agree / np.maximum(said.agree + said.through, 2)
        confidence[index, rows, columns] = share * rendered[index].opacity.numpy()[rows, columns].clip(0, 1)
    return confidence


def _held_out_quality(
    views: Views, rendered: list[Rendered], index: NDArray[np.int64], folder: Path, exact: bool
) -> dict[str, Any]:
    """Quality on held-out photos (on all when none is held out), and their renders as PNG beside the photo's.

    Renders are on black, and so is the photo where mattes are `exact`: its grey pixels hold part of the background.
    """
    folder.mkdir()
    rows = []
    for i in index:
        mask = torch.from_numpy(views.masks[i])
        photo = torch.from_numpy(views.images[i]).float() / 255.0
        picture, everything = rendered[i].color.clamp(0, 1), torch.ones_like(mask)
        masked = photo * (torch.from_numpy(views.mattes[i]) / 255.0 if exact else mask)[..., None]
        rows.append(
            (
                psnr(picture, masked, mask),
                psnr(picture, masked, everything),
                ssim(picture, masked, dilate(mask[None], 5)[0]),
                silhouette_iou(rendered[i].opacity, mask),
            )
        )
        out = (picture.numpy() * 255 + 0.5).astype(np.uint8)
        cv2.imwrite(str(folder / f"{Path(views.names[i]).stem}.png"), out[..., ::-1])
    inside, whole, structure, outline = np.mean(rows, axis=0)
    return {
        "psnr_held_out": quantity(float(inside), "dB"),
        "psnr_held_out_masked_photo": quantity(float(whole), "dB"),
        "ssim": quantity(float(structure), "1"),
        "silhouette_iou": quantity(float(outline), "1"),
        "measured_on": quantity("held-out photos" if views.held_out.any() else "training photos", ""),
        "photos_measured": quantity(len(index), "1"),
    }
