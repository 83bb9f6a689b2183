"""Masks of the object in every photo: by GrabCut or SAM 2 from prompts, or supplied; checked by their visual hull."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.io.pictures import write_picture
from scenefuse.masks.algebra import kept_part, mask_folders
from scenefuse.masks.contact_sheet import draw_contact_sheet
from scenefuse.masks.sam2 import load_network
from scenefuse.masks.segmentation import (
    MaskSettings,
    ScoredMasks,
    score_masks,
    segment_by_grabcut,
    segment_by_sam2,
)
from scenefuse.masks.supplied import supplied_masks
from scenefuse.masks.target import Target, points_in_masks, target_from_points
from scenefuse.mvs.visual_hull import Mask
from scenefuse.sfm.fiducials import locate
from scenefuse.sfm.frames import original_sizes
from scenefuse.stage import (
    StageError,
    atomic_directory,
    atomic_file,
    manifest,
    quantity,
    read_json,
    threads,
    value,
    write_json,
)
from scenefuse.transforms import Array
from scenefuse.workspace import View, Workspace, read_workspace


@dataclass(frozen=True)
class MaskInputs:
    """The files that masks are made from."""

    workspace: Path
    """Undistorted COLMAP workspace of the object (PINHOLE cameras)."""
    workspace_json: Path
    """Its report, with `up_in_camera_frame`."""
    sparse: Path
    """COLMAP model of the photos before undistortion."""
    photos_json: Path
    """JSON list of the frames, with the sizes of the photos they were made from: clicks are in their pixels."""
    prompts: Path | None = None
    """For grabcut and sam2: TSV of pixels clicked in two or more photos, or of points in the object's frame, on the
    object and spanning it."""
    supplied: Path | None = None
    """For supplied: folder of masks named like the photos, with or without `_mask`; non-zero on the object."""


def make_masks(
    *, inputs: MaskInputs, settings: MaskSettings, seed: int, masks: Path, contact_sheet: Path, report: Path
) -> None:
    """Write a mask of the object for every undistorted photo (method K1, K3).

    Prompts give an upright box; the sparse points in it and above the ground seed GrabCut in each photo, whose masks
    carve a visual hull, along which they are cut again. SAM 2 is prompted in each photo with all points and the box
    around them, and again with the hull's box where it disagrees. Supplied masks are undistorted, never changed. A
    photo without a usable mask, or whose mask disagrees with the hull, is left out. `keep` is applied last.

    Args:
        inputs: see MaskInputs.
        settings: see MaskSettings.
        seed: seed of the ground's RANSAC.
        masks: output folder, {photo without suffix}.png, uint8 0 or 255, the size of the undistorted photo.
        contact_sheet: output PNG, all masks over their photos.
        report: output JSON: method, weights, area and agreement per photo, photos left out and why.

    Raises:
        StageError: prompts, weights or masks are missing or wrong; too few good masks.
    """
    cv2.setNumThreads(threads())
    workspace = read_workspace(inputs.workspace)
    photos = replace(workspace, views=[workspace.rgb(view) for view in workspace.views])
    made, target, weights = _make(inputs, photos, settings, seed)
    for name, reason in sorted(made.dropped.items()):
        print(f"{name} left out: {reason}", flush=True)
    kept = [view.name for view in photos.views if view.name not in made.dropped]
    if len(kept) < settings.min_photos:
        raise StageError(
            f"only {len(kept)} of {len(photos.views)} photos in {inputs.workspace} have a good mask,"
            f" {settings.min_photos} needed: check that the prompts span the object, or supply masks"
        )
    with atomic_directory(masks) as folder:
        for name in kept:
            write_picture(folder / f"{Path(name).stem}.png", made.masks[name].astype(np.uint8) * 255)
        files = manifest(folder)
    with atomic_file(contact_sheet) as path:
        write_picture(path, _sheet(photos.views, made))
    content = _report(made, target, len(photos.views), kept, settings)
    print(f"{len(kept)} of {len(photos.views)} masks, median agreement {value(content, 'median_agreement'):.3f}")
    write_json(report, content | ({"weights": quantity(weights, "")} if weights else {}) | {"files": files})


def _make(inputs: MaskInputs, photos: Workspace, settings: MaskSettings, seed: int) -> tuple[ScoredMasks, Target, str]:
    """Masks of all photos that have one, where the object is, and which weights segmented them."""
    up = np.array(value(read_json(inputs.workspace_json), "up_in_camera_frame"), dtype=np.float64)
    unusable: dict[str, str] = {}
    masks: list[Mask] = []
    if settings.method == "supplied":
        masks, photos, unusable = _supplied(inputs, photos)
        points = points_in_masks(photos, masks, up)
    else:
        points = _prompt_points(inputs, settings)
    target, weights = target_from_points(points, photos, up, seed), ""
    print(f"{np.sum(target.kind > 0)} sparse points on the object, {np.sum(target.kind < 0)} not", flush=True)
    if settings.method == "sam2":
        checkpoint = Path(settings.sam2_checkpoint) if settings.sam2_checkpoint else None
        encoder, decoder = Path(settings.sam2_encoder), Path(settings.sam2_decoder)
        network, weights = load_network(encoder, decoder, checkpoint, threads())
        masks = segment_by_sam2(network, target, photos, settings)
    elif settings.method == "grabcut":
        masks = segment_by_grabcut(target, photos, settings)
    made = _kept(score_masks(masks, target, photos.views, settings), settings.keep, inputs.sparse, photos.views)
    return replace(made, dropped=unusable | made.dropped), target, weights


def _supplied(inputs: MaskInputs, photos: Workspace) -> tuple[list[Mask], Workspace, dict[str, str]]:
    """Supplied masks (H, W), the photos they belong to, and why the other photos have none."""
    if inputs.supplied is None:
        raise StageError("method supplied needs a folder of masks; set its path in config/objects.tsv")
    found, unusable = supplied_masks(inputs.supplied, inputs.sparse, photos.views)
    missing = {view.name: "no mask was supplied" for view in photos.views if view.name not in found}
    photos = photos.subset([k for k, view in enumerate(photos.views) if view.name in found])
    return [found[view.name] for view in photos.views], photos, missing | unusable


def _prompt_points(inputs: MaskInputs, settings: MaskSettings) -> Array:
    """(N, 3) prompts in the object's frame."""
    if inputs.prompts is None:
        raise StageError("masks from prompts need a prompts file; set its path in config/objects.tsv, or supply masks")
    sizes = original_sizes(read_json(inputs.photos_json))
    names, points, _ = locate(inputs.prompts, inputs.sparse, settings.max_click_residual_px, sizes)
    if len(points) < 3:
        raise StageError(
            f"{inputs.prompts} holds {len(names)} points on the object, three or more are needed; mark some at its ends"
        )
    return points


def _kept(made: ScoredMasks, keep: str, sparse: Path, views: list[View]) -> ScoredMasks:
    """The part of the masks that an expression keeps; their agreement stays that of the whole object."""
    masks, dropped, others = {}, dict(made.dropped), {}
    for folder in mask_folders(keep):
        others[folder], unusable = supplied_masks(folder, sparse, views)
        dropped = unusable | dropped
    for name, mask in made.masks.items():
        here = {folder: found[name] for folder, found in others.items() if name in found}
        masks[name] = kept_part(keep, mask, here)
        if not masks[name].any():
            dropped.setdefault(name, f"nothing is left of the mask ({keep})")
    return replace(made, masks=masks, dropped=dropped)


def _sheet(views: list[View], made: ScoredMasks) -> NDArray[np.uint8]:
    """All masks over their photos, (H, W, 3) RGB."""
    notes = [f"{made.scores[v.name]:.2f}" if v.name in made.scores else "no mask" for v in views]
    masks = [made.masks.get(view.name, np.zeros((view.height, view.width), dtype=bool)) for view in views]
    return draw_contact_sheet(views, masks, notes, [view.name in made.dropped for view in views])


def _report(made: ScoredMasks, target: Target, photos: int, kept: list[str], settings: MaskSettings) -> dict[str, Any]:
    """What the stage found, without its files."""
    per_photo = {
        name: {"area": round(float(mask.mean()), 5), "agreement": round(float(made.scores[name]), 4)}
        for name, mask in made.masks.items()
    }
    return {
        "method": quantity(settings.method, ""),
        "keep": quantity(settings.keep, ""),
        "masks": quantity(len(kept), "1"),
        "photos": quantity(photos, "1"),
        "photos_left_out": quantity(sorted(made.dropped), ""),
        "median_agreement": quantity(float(np.median([made.scores[name] for name in kept])), "1"),
        "ground": quantity("measured" if target.ground_found else "not found; bottom of the box", ""),
        "hull_voxel": quantity(made.hull.voxel, "object units"),
        "dropped": made.dropped,
        "per_photo": per_photo,
    }
