"""Masks of the object in every photo: GrabCut or SAM 2 from prompts, or supplied; the visual hull makes them agree."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.masks.algebra import kept_part, mask_folders
from scenefuse.masks.contact_sheet import contact_sheet as draw_sheet
from scenefuse.masks.grabcut_passes import first_cuts, second_cuts
from scenefuse.masks.sam2 import Sam2, Sam2Onnx, Sam2Transformers, ask, check_weights
from scenefuse.masks.supplied import supplied_masks
from scenefuse.masks.target import Target, points_in_masks, target_from_points
from scenefuse.mvs.visual_hull import Frame, Hull, Mask, agreement, carve, silhouette
from scenefuse.sfm.fiducials import locate
from scenefuse.sfm.frames import original_sizes
from scenefuse.stage import (
    StageError,
    atomic_directory,
    atomic_file,
    manifest,
    quantity,
    read_json,
    setting,
    threads,
    value,
    write_json,
)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MaskSettings:
    """How masks are made."""

    box_margin: float = setting(0.15, unit="of the diagonal", least=0)
    """Growth of the prompts' box on each side, as a share of its diagonal."""
    ground_margin: float = setting(0.02, unit="of the diagonal", least=0)
    """A sparse point is on the object only when it is this much above the ground, as a share of the box's diagonal."""
    grabcut_width_px: int = setting(320, unit="px", least=0)
    """The first cut runs on photos at most this wide."""
    grabcut_iterations: int = setting(4, least=0)
    """Rounds of learning colours and cutting in the first cut."""
    hull_voxels: int = setting(96, least=0)
    """Voxels of the visual hull along the longest side of the box."""
    hull_tolerance: float = setting(0.1, least=0)
    """Share of the photos that may contradict a voxel of the hull."""
    band_px: float = setting(5, unit="px", least=0)
    """Half width of the band along the hull's outline where a photo's own evidence decides, at a photo width of 640."""
    min_agreement: float = setting(0.6, least=0)
    """Smallest IoU of a mask with the hull's outline; below it the photo is dropped."""
    min_photos: int = setting(5, least=0)
    """Fewest good masks to go on with."""
    max_click_residual_px: float = setting(4, unit="px", least=0)
    """Largest reprojection error of a clicked prompt."""
    sam2_encoder_sha256: str = setting("54e9ee80bd43e36da6c7cd33031a525bb1d70577eadb31190a28999250b13dfe")
    """SHA-256 of the SAM 2 encoder's weights."""
    sam2_decoder_sha256: str = setting("4a4c8a8a53d9722834b66d8ced88770e2cc783e367965ba62a13be3ab5f1ba89")
    """SHA-256 of the SAM 2 decoder's weights."""


def make_masks(
    *,
    cameras: Path,
    cameras_json: Path,
    sfm: Path,
    photos: Path,
    method: Literal["grabcut", "sam2", "supplied"],
    prompts: Path | None,
    supplied: Path | None,
    sam2_encoder: Path,
    sam2_decoder: Path,
    sam2_checkpoint: Path | None,
    keep: str,
    settings: MaskSettings,
    seed: int,
    masks: Path,
    contact_sheet: Path,
    report: Path,
) -> None:
    """Write a mask of the object for every undistorted photo (method K1, K3).

    Prompts give an upright box; the sparse points in it and above the ground seed GrabCut in each photo, whose masks
    carve a visual hull, along which they are cut again. SAM 2 is asked in each photo with all prompts and the box
    around them, and again with the hull where it disagrees. Supplied masks are undistorted, never changed. A photo
    whose mask disagrees with the hull is dropped. What `keep` says is applied last.

    Args:
        cameras: undistorted COLMAP workspace of the object (PINHOLE cameras).
        cameras_json: its report, with `up_in_camera_frame`.
        sfm: the COLMAP model before undistortion.
        photos: JSON list of the frames, with the sizes of the photos they were made from: clicks are in their pixels.
        method: where masks come from.
        prompts: for grabcut and sam2: TSV of pixels clicked in two or more photos, or of points in the
            object's frame, on the object and spanning it.
        supplied: for supplied: folder of masks named like the photos, with or without `_mask`; non-zero on the object.
        sam2_encoder: for sam2: weights of the encoder (.ort or .onnx).
        sam2_decoder: for sam2: weights of the decoder (.onnx).
        sam2_checkpoint: for sam2: folder of a checkpoint that transformers runs instead, or none.
        keep: what the masks keep, `object` or an expression with other folders of masks (mask_algebra.py).
        settings: see MaskSettings.
        seed: seed of the ground's RANSAC.
        masks: output folder, {photo without suffix}.png, uint8 0 or 255, the size of the undistorted photo.
        contact_sheet: output PNG, all masks over their photos.
        report: output JSON: method, area and agreement per photo, photos dropped and why.

    Raises:
        StageError: prompts, weights or masks are missing or wrong; too few good masks.
    """
    cv2.setNumThreads(threads())
    frames, sparse = read_frames(cameras)
    up = np.array(value(read_json(cameras_json), "up_in_camera_frame"), dtype=np.float64)
    without: dict[str, str] = {}
    if method == "supplied":
        if supplied is None:
            raise StageError("method supplied needs a folder of masks; set its path in config/objects.tsv")
        found = supplied_masks(supplied, sfm, frames)
        without = {f.name: "no mask was supplied" for f in frames if f.name not in found}
        frames = [f for f in frames if f.name in found]
        points = points_in_masks(frames, [found[f.name] for f in frames], sparse, up)
    else:
        points = _prompt_points(prompts, sfm, original_sizes(read_json(photos)), settings)
    target = target_from_points(points, frames, sparse, up, settings.box_margin, settings.ground_margin, seed)
    print(f"{np.sum(target.kind > 0)} sparse points on the object, {np.sum(target.kind < 0)} not", flush=True)
    if method == "supplied":
        made = _judged([found[f.name] for f in frames], frames, target, settings)
    elif method == "sam2":
        made = _segment(_network(sam2_encoder, sam2_decoder, sam2_checkpoint, settings), target, frames, settings)
    else:
        made = _cut(target, frames, settings)
    made = _kept(made, keep, sfm, frames)
    dropped = without | made.dropped
    kept = [k for k, f in enumerate(frames) if f.name not in dropped]
    for name, reason in sorted(dropped.items()):
        print(f"{name} dropped: {reason}", flush=True)
    if len(kept) < settings.min_photos:
        raise StageError(
            f"only {len(kept)} of {len(frames)} photos in {cameras} have a good mask, {settings.min_photos} needed: "
            "check that the prompts span the object, or supply masks"
        )
    with atomic_directory(masks) as folder:
        for k in kept:
            path = folder / f"{Path(frames[k].name).stem}.png"
            cv2.imwrite(str(path), made.masks[k].astype(np.uint8) * 255)
        files = manifest(folder)
    with atomic_file(contact_sheet) as path:
        notes = [f"{score:.2f}" for score in made.scores]
        cv2.imwrite(str(path), draw_sheet(frames, made.masks, notes, [f.name in dropped for f in frames]))
    per_photo = {
        f.name: {"area": round(float(m.mean()), 5), "agreement": round(float(score), 4)}
        for f, m, score in zip(frames, made.masks, made.scores)
    }
    median = float(np.median([made.scores[k] for k in kept]))
    print(f"{len(kept)} of {len(frames)} masks, median agreement {median:.3f}", flush=True)
    write_json(
        report,
        {
            "method": quantity(method, ""),
            "keep": quantity(keep, ""),
            "masks": quantity(len(kept), "1"),
            "photos": quantity(len(frames) + len(without), "1"),
            "median_agreement": quantity(median, "1"),
            "ground": quantity("measured" if target.ground_found else "not found; bottom of the box", ""),
            "hull_voxel": quantity(made.hull.voxel, "object units"),
            "dropped": dropped,
            "per_photo": per_photo,
            "files": files,
        },
    )


@dataclass(frozen=True)
class _Made:
    """Masks of all photos and how well they agree.

    Attributes:
        masks: (H, W) per photo.
        scores: IoU of each with the outline of the hull, 0..1.
        dropped: photo name -> why it has no usable mask.
        hull: of all masks.
    """

    masks: list[Mask]
    scores: list[float]
    dropped: dict[str, str]
    hull: Hull


def _cut(target: Target, frames: list[Frame], settings: MaskSettings) -> _Made:
    """GrabCut photo by photo, then twice more along the visual hull."""
    masks = first_cuts(target, frames, settings.grabcut_width_px, settings.grabcut_iterations)
    # The first masks are made photo by photo: their hull lets twice as many of them disagree.
    hull = _carve(target, frames, masks, settings, 2 * settings.hull_tolerance)
    masks = second_cuts(target, masks, frames, hull, settings.band_px)
    hull = _carve(target, frames, masks, settings, settings.hull_tolerance)
    masks = second_cuts(target, masks, frames, hull, settings.band_px)
    return _judged(masks, frames, target, settings)


def _segment(network: Sam2, target: Target, frames: list[Frame], settings: MaskSettings) -> _Made:
    """SAM 2 photo by photo, and once more, with the visual hull's box, where a mask disagrees with the hull."""
    masks = [ask(network, target, f, None) for f in frames]
    hull = _carve(target, frames, masks, settings, 2 * settings.hull_tolerance)
    for k, frame in enumerate(frames):
        outline = silhouette(hull, frame)
        if agreement(masks[k], outline) < settings.min_agreement:
            again = ask(network, target, frame, outline)
            masks[k] = max(masks[k], again, key=lambda m: agreement(m, outline))
            print(f"{frame.name} asked again, IoU {agreement(masks[k], outline):.2f}", flush=True)
    return _judged(masks, frames, target, settings)


def _judged(masks: list[Mask], frames: list[Frame], target: Target, settings: MaskSettings) -> _Made:
    """Masks judged by their agreement with their visual hull."""
    hull = _carve(target, frames, masks, settings, settings.hull_tolerance)
    scores = [agreement(m, silhouette(hull, f)) for m, f in zip(masks, frames)]
    dropped = {}
    for frame, mask, score in zip(frames, masks, scores):
        if not mask.any():
            dropped[frame.name] = "empty mask"
        elif score < settings.min_agreement:
            dropped[frame.name] = (
                f"IoU with the visual hull is {score:.2f}, below {settings.min_agreement} (min_agreement)"
            )
    return _Made(masks, scores, dropped, hull)


def _network(encoder: Path, decoder: Path, checkpoint: Path | None, settings: MaskSettings) -> Sam2:
    """SAM 2 by transformers if there is a checkpoint, else by ONNX Runtime."""
    if checkpoint is not None:
        return Sam2Transformers(checkpoint)
    return Sam2Onnx(
        check_weights(encoder, settings.sam2_encoder_sha256, "encoder"),
        check_weights(decoder, settings.sam2_decoder_sha256, "decoder"),
        threads(),
    )


def _kept(made: _Made, keep: str, sfm: Path, frames: list[Frame]) -> _Made:
    """The part of the masks that an expression keeps; their agreement stays that of the whole object."""
    others = {folder: supplied_masks(folder, sfm, frames) for folder in mask_folders(keep)}
    masks, dropped = [], dict(made.dropped)
    for frame, mask in zip(frames, made.masks):
        here = {folder: found[frame.name] for folder, found in others.items() if frame.name in found}
        masks.append(kept_part(keep, mask, here))
        if not masks[-1].any():
            dropped.setdefault(frame.name, f"nothing is left of the mask ({keep})")
    return replace(made, masks=masks, dropped=dropped)


def read_frames(cameras: Path) -> tuple[list[Frame], Array]:
    """The photos of an undistorted workspace in name order, and the (P, 3) sparse points."""
    try:
        model = pycolmap.Reconstruction(cameras / "sparse")
    except Exception as error:
        raise StageError(
            f"{cameras}/sparse is not a readable COLMAP model ({error}); rerun the cameras stage"
        ) from None
    rows = {point: row for row, point in enumerate(sorted(model.points3D))}
    sparse = np.array([model.points3D[p].xyz for p in rows], dtype=np.float64).reshape(-1, 3)
    frames = []
    for image in sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name):
        picture = cv2.imread(str(cameras / "images" / image.name), cv2.IMREAD_COLOR)
        if picture is None:
            raise StageError(f"{cameras}/images/{image.name} cannot be read; rerun the cameras stage")
        seen = image.get_observation_points2D()
        frames.append(
            Frame(
                image.name,
                np.asarray(picture, dtype=np.uint8),
                model.cameras[image.camera_id].calibration_matrix(),
                image.cam_from_world().matrix(),
                np.array([p.xy for p in seen], dtype=np.float64).reshape(-1, 2),
                np.array([rows[p.point3D_id] for p in seen], dtype=np.int64),
            )
        )
    if not frames:
        raise StageError(f"{cameras} holds no photo with a camera; look at the report of the object's SfM")
    return frames, sparse


def _prompt_points(prompts: Path | None, sfm: Path, sizes: dict[str, tuple[int, int]], settings: MaskSettings) -> Array:
    """(N, 3) prompts in the object's frame."""
    if prompts is None:
        raise StageError("masks from prompts need a prompts file; set its path in config/objects.tsv, or supply masks")
    names, points, _ = locate(prompts, sfm, settings.max_click_residual_px, sizes)
    if len(points) < 3:
        raise StageError(
            f"{prompts} holds {len(names)} points on the object, three or more are needed; mark some at its ends"
        )
    return points


def _carve(target: Target, frames: list[Frame], masks: list[Mask], settings: MaskSettings, tolerance: float) -> Hull:
    """The visual hull; photos that contradict a tolerant hull have no say in the one that counts."""
    trusted = [k for k, m in enumerate(masks) if m.any()]
    for share in (max(tolerance, 0.34), tolerance):
        if len(trusted) < 2:
            break
        voters = [frames[k] for k in trusted], [masks[k] for k in trusted]
        hull = carve(target.box, target.ground.height_of, *voters, settings.hull_voxels, share)
        if share == tolerance:
            break
        trusted = [k for k in trusted if agreement(masks[k], silhouette(hull, frames[k])) >= settings.min_agreement]
    if len(trusted) < 2 or len(hull.shell) == 0:
        raise StageError(
            "the masks of the photos have no common object; check that the prompts lie on one object and span it, "
            "or supply masks"
        )
    return hull
