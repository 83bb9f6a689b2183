"""Masks of the object in every photo: by GrabCut or SAM 2 from prompts, or those that a person supplies for the
original photos, moved into the undistorted ones; what of them `keep` keeps; all checked by their visual hull."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.core.machine import use_threads
from scenefuse.core.stage import (
    StageError,
    atomic_directory,
    atomic_file,
    quantity,
    read_json,
    threads,
    value,
    write_json,
)
from scenefuse.geometry.visual_hull import Mask
from scenefuse.marks.clicks import read_points
from scenefuse.masks.algebra import kept_part, mask_folders
from scenefuse.masks.prompts import overlap
from scenefuse.masks.sam2 import Sam2, load_network
from scenefuse.masks.sam2_weights import WEIGHTS, why_unavailable
from scenefuse.masks.segmentation import MaskSettings, Prompted, ScoredMasks, masks_from_prompts, score_masks
from scenefuse.masks.target import target_from_points
from scenefuse.masks.votes import in_masks, points_in_masks, spread_less_than_surroundings
from scenefuse.mvs.undistort import undistort_picture
from scenefuse.photos.cameras.given import QUARTERS
from scenefuse.photos.frames import original_sizes
from scenefuse.photos.photo_files import masks_by_name, no_match
from scenefuse.photos.photos import orientations_in
from scenefuse.photos.pictures import read_supplied_mask, require_white_object, write_picture
from scenefuse.photos.workspace import View, Workspace, read_cameras, read_workspace

# Width of a photo on the contact sheet, and photos side by side.
TILE_WIDTH_PX, TILE_COLUMNS = 240, 8
# Photos whose features the network keeps, 17 MB each: an object whose masks disagree is segmented up to four times.
KEPT_PHOTOS = 100


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
    """For grabcut and sam2: TSV of pixels labelled inside, outside or box in one photo or more; or of points on the
    object and spanning it, each clicked in two or more photos or in the object's frame."""
    supplied: Path | None = None
    """For supplied: folder of masks named like the photos, with or without `_mask`; non-zero on the object."""


def make_masks(
    *, inputs: MaskInputs, settings: MaskSettings, seed: int, masks: Path, contact_sheet: Path, report: Path
) -> None:
    """Write a mask of the object for every undistorted photo (method K1, K3).

    Clicks inside and outside the object in one photo give its mask, whose sparse points prompt the next photos. Or
    points clicked in several photos give an upright box; the sparse points in it and above the ground seed GrabCut in
    each photo, whose masks carve a visual hull, along which they are cut again. SAM 2 is prompted in each photo with
    all points and the box around them, and again with the hull's box where it disagrees. Supplied masks are
    undistorted, never changed. A photo without a usable mask, or whose mask disagrees with the hull, is left out.
    `keep` is applied last.

    Args:
        inputs: see MaskInputs.
        settings: see MaskSettings.
        seed: seed of the ground's RANSAC.
        masks: output folder, {photo without suffix}.png, uint8 0 or 255, the size of the undistorted photo.
        contact_sheet: output PNG, all masks over their photos.
        report: output JSON: method, area and agreement per photo, photos left out and why.

    Raises:
        StageError: prompts, weights or masks are missing or wrong; too few good masks.
    """
    use_threads(threads())
    # On several threads GrabCut does not repeat to the last pixel; stereo and the network have them all.
    cv2.setNumThreads(1)
    workspace = read_workspace(inputs.workspace)
    photos = replace(workspace, views=[workspace.rgb(view) for view in workspace.views])
    made, found, by = _make(inputs, photos, settings, seed)
    made, found = _with_disputed(made, found, settings.min_photos)
    for sentence in found.left_out:
        print(f"left out of {inputs.prompts}: {sentence}", flush=True)
    for note in found.notes:
        print(f"note: {note}", flush=True)
    for name, reason in sorted(made.dropped.items()):
        print(f"{name} left out: {reason}", flush=True)
    kept = [view.name for view in photos.views if view.name not in made.dropped]
    if len(kept) < settings.min_photos:
        enough = len(photos.views) >= settings.min_photos
        masked = settings.method == "supplied"
        mask_more = "supply masks of more" if masked else "check that the prompts span the object, or supply masks"
        advice = mask_more if enough else "take more photos of the object"
        raise StageError(
            f"only {len(kept)} of {len(photos.views)} photos in {inputs.workspace} have a good mask,"
            f" {settings.min_photos} needed: {advice}"
        )
    with atomic_directory(masks) as folder:
        for name in kept:
            write_picture(folder / f"{Path(name).stem}.png", made.masks[name].astype(np.uint8) * 255)
    with atomic_file(contact_sheet) as path:
        write_picture(path, _contact_sheet(photos.views, made))
    content = _report(made, found, len(photos.views), kept, settings) | by
    print(f"{len(kept)} of {len(photos.views)} masks, median agreement {value(content, 'median_agreement'):.3f}")
    write_json(report, content)


def _make(
    inputs: MaskInputs, photos: Workspace, settings: MaskSettings, seed: int
) -> tuple[ScoredMasks, Prompted, dict[str, Any]]:
    """Masks of all photos that have one, what they were made from, and by which method."""
    up = np.array(value(read_json(inputs.workspace_json), "up_in_camera_frame"), dtype=np.float64)
    unusable: dict[str, str] = {}
    by = {"method": quantity(settings.method, "")}
    if settings.method == "supplied":
        masks, photos, unusable = _supplied(inputs, photos)
        target = target_from_points(points_in_masks(photos, masks), photos, up, seed)
        found = Prompted(masks, target, {}, [])
    else:
        if inputs.prompts is None:
            raise StageError(
                "masks from prompts need a prompts file; set its path in config/objects.tsv, or supply masks"
            )
        marked, sizes = read_points(inputs.prompts), original_sizes(read_json(inputs.photos_json))
        network, by = _network(settings)
        given = marked, inputs.sparse, sizes, photos, up, network, settings, seed
        found = masks_from_prompts(*given)
    scored = score_masks(found.masks, found.target, photos.views, settings, found.clicked)
    if _least_clicked(scored, found) < settings.min_agreement:
        print("the propagated masks contradict the clicks: once more, with fewer points outside allowed", flush=True)
        with suppress(StageError):
            strict = masks_from_prompts(*given, overlap)
            again = score_masks(strict.masks, strict.target, photos.views, settings, strict.clicked)
            if _least_clicked(again, strict) > _least_clicked(scored, found):
                scored, found = again, strict
    own = found.target.kind
    print(f"{np.sum(own > 0)} points on the object, {np.sum(own < 0)} not", flush=True)
    for name in set(scored.dropped) & set(found.reasons):
        scored.dropped[name] += f"; {found.reasons[name]}"
    against = sorted(name for name in found.clicked if scored.scores[name] < settings.min_agreement)
    if against:
        note = (
            f"the masks propagated from the clicks in {', '.join(against)} contradict the masks there: they lack a"
            " part of the object, or hold more than it; look at them, and click in a photo where they are wrong"
        )
        found = replace(found, notes=(*found.notes, note))
    made = _kept(scored, settings.keep, inputs, photos.views)
    return replace(made, dropped=unusable | made.dropped), found, by


def _least_clicked(scored: ScoredMasks, found: Prompted) -> float:
    """Least IoU with the hull's outline of the masks that come from clicks in their own photo; 1 without any."""
    return min((scored.scores[name] for name in found.clicked), default=1.0)


def _with_disputed(made: ScoredMasks, found: Prompted, min_photos: int) -> tuple[ScoredMasks, Prompted]:
    """Where fewer masks agree than are needed, the others too: low certainty is said and shown, and ends nothing."""
    disputed = {name for name in made.dropped if name in made.masks and made.masks[name].any()}
    if len(made.masks) - len(set(made.dropped) & set(made.masks)) >= min_photos or not disputed:
        return made, found
    note = (
        f"fewer than {min_photos} masks agree with each other: those of {', '.join(sorted(disputed))} are used although"
        " they do not; look at them, and correct those that are wrong, or click in their photos"
    )
    dropped = {name: why for name, why in made.dropped.items() if name not in disputed}
    return replace(made, dropped=dropped), replace(found, notes=(*found.notes, note))


def _network(settings: MaskSettings) -> tuple[Sam2 | None, dict[str, Any]]:
    """SAM 2, or None for GrabCut; and for the report which of them, and why not the better one."""
    if settings.method == "grabcut":
        return None, {"method": quantity("grabcut", "")}
    if settings.method == "auto" and (why := why_unavailable()):
        fallback = (
            f"masks by GrabCut, since SAM 2's weights could not be fetched ({why}); delete {WEIGHTS} and run"
            " again to try once more"
        )
        print(fallback, flush=True)
        return None, {"method": quantity("grabcut", ""), "fallback": quantity(fallback, "")}
    network = load_network(threads())
    network.kept = KEPT_PHOTOS
    return network, {"method": quantity("sam2", "")}


Supplied = tuple[list[Mask], Workspace, dict[str, str]]
"""Supplied masks (H, W), the photos they belong to, and why the other photos have none."""


def _supplied(inputs: MaskInputs, photos: Workspace) -> Supplied:
    """The supplied masks. Those of photos that were stored upside down may be so, too: they are turned where more
    sparse points then lie in all masks, as their shape does not tell."""
    turned = orientations_in(read_json(inputs.photos_json))
    ways = [_on_their_sides(turned), turned] if turned != _on_their_sides(turned) else [turned]
    made = [_supplied_as(inputs, photos, way) for way in ways]
    return max(made, key=lambda one: len(in_masks(one[1], one[0])))


def _on_their_sides(turned: dict[str, int]) -> dict[str, int]:
    """The orientations of photos without those that were stored upside down."""
    return {name: orientation for name, orientation in turned.items() if QUARTERS.get(orientation) != 2}


def _supplied_as(inputs: MaskInputs, photos: Workspace, turned: dict[str, int]) -> Supplied:
    """The supplied masks, those of photos that were turned so taken to lie as these did."""
    if inputs.supplied is None:
        raise StageError("method supplied needs a folder of masks; set its path in config/objects.tsv")
    found, unusable = supplied_masks(inputs.supplied, inputs.sparse, photos.views, turned)
    missing = {view.name: "no mask was supplied" for view in photos.views if view.name not in found}
    # Programs write a black mask of each photo in which nothing was drawn: it denies no point.
    missing |= {name: "empty mask" for name, mask in found.items() if not mask.any()}
    found = {name: mask for name, mask in found.items() if mask.any()}
    photos = photos.subset([k for k, view in enumerate(photos.views) if view.name in found])
    masks = [found[view.name] for view in photos.views]
    # An arch is white around a black middle, too.
    if not spread_less_than_surroundings(photos, masks):
        require_white_object(masks, inputs.supplied)
    return masks, photos, missing | unusable


def _kept(made: ScoredMasks, keep: str, inputs: MaskInputs, views: list[View]) -> ScoredMasks:
    """The part of the masks that an expression keeps; their agreement stays that of the whole object."""
    masks, dropped, others = {}, dict(made.dropped), {}
    for folder in mask_folders(keep):
        turned = _on_their_sides(orientations_in(read_json(inputs.photos_json)))
        others[folder], unusable = supplied_masks(folder, inputs.sparse, views, turned)
        dropped = unusable | dropped
    for name, mask in made.masks.items():
        here = {folder: found[name] for folder, found in others.items() if name in found}
        masks[name] = kept_part(keep, mask, here)
        if not masks[name].any():
            dropped.setdefault(name, f"nothing is left of the mask ({keep})")
    return replace(made, masks=masks, dropped=dropped)


def _contact_sheet(views: list[View], made: ScoredMasks) -> NDArray[np.uint8]:
    """(H, W, 3) RGB, all masks for a person to check in ten seconds: the background dimmed, the outline green, or red
    where the photo is left out, and the mask's agreement with the hull beside its name."""
    tiles = []
    for view in views:
        mask = made.masks.get(view.name, np.zeros((view.height, view.width), dtype=bool))
        note = f"{made.scores[view.name]:.2f}" if view.name in made.scores else "no mask"
        color = (255, 0, 0) if view.name in made.dropped else (0, 255, 0)
        picture = np.where(mask[..., None], view.pixels, view.pixels // 3).astype(np.uint8)
        picture[mask & ~ndimage.binary_erosion(mask, iterations=max(1, view.width // 640))] = color
        height = round(TILE_WIDTH_PX * view.height / view.width)
        tile = cv2.resize(picture, (TILE_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        if view.name in made.dropped:
            cv2.rectangle(tile, (0, 0), (TILE_WIDTH_PX - 1, height - 1), color, 3)
        cv2.putText(tile, f"{Path(view.name).stem} {note}", (5, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255,) * 3, 1)
        tiles.append(tile)
    columns, tallest = min(TILE_COLUMNS, len(tiles)), max(len(tile) for tile in tiles)
    sheet = np.zeros((-(-len(tiles) // columns) * tallest, columns * TILE_WIDTH_PX, 3), dtype=np.uint8)
    for k, tile in enumerate(tiles):
        row, column = divmod(k, columns)
        sheet[row * tallest :, column * TILE_WIDTH_PX :][: len(tile), :TILE_WIDTH_PX] = tile
    return sheet


def _report(made: ScoredMasks, found: Prompted, photos: int, kept: list[str], settings: MaskSettings) -> dict[str, Any]:
    """What the stage found."""
    per_photo = {
        name: {"area": round(float(mask.mean()), 5), "agreement": round(float(made.scores[name]), 4)}
        | ({"quality": round(found.quality[name], 4)} if name in found.quality else {})
        for name, mask in made.masks.items()
    }
    return {
        "keep": quantity(settings.keep, ""),
        "masks": quantity(len(kept), "1"),
        "photos": quantity(photos, "1"),
        "photos_left_out": quantity(sorted(made.dropped), ""),
        "median_agreement": quantity(float(np.median([made.scores[name] for name in kept])), "1"),
        "ground": quantity("measured" if found.target.ground_found else "not found; bottom of the box", ""),
        "clicks_left_out": quantity(found.left_out, ""),
        "notes": quantity(list(found.notes), ""),
        "dropped": made.dropped,
        "per_photo": per_photo,
    }


def supplied_masks(
    folder: Path, sparse: Path, views: list[View], turned: Mapping[str, int] = MappingProxyType({})
) -> tuple[dict[str, Mask], dict[str, str]]:
    """Masks from a folder by the name of the photo they belong to, undistorted like it; and why others are unusable.

    Args:
        folder: pictures named like the photos, with or without `_mask`; non-zero on the object. A mask may be larger
            or smaller than its photo.
        sparse: COLMAP model of the original photos, before undistortion.
        views: the undistorted photos.
        turned: EXIF orientation of the photos that were stood upright: their masks may still lie as they are stored,
            those of photos that were upside down do.

    Raises:
        StageError: no such folder, masks that belong to none of the photos, or none that is usable.
    """
    if not folder.is_dir():
        raise StageError(
            f"the folder of masks {folder} does not exist; set its path in config/objects.tsv, or in object.masks.keep"
        )
    files, originals = masks_by_name([view.name for view in views], folder), read_cameras(sparse)
    masks: dict[str, Mask] = {}
    unusable: dict[str, str] = {}
    for view in views:
        file = files.get(view.name)
        if file is None or view.name not in originals:
            continue
        try:
            camera = originals[view.name]
            quarters = QUARTERS.get(turned.get(view.name, 1), 0)
            mask = read_supplied_mask(file, (camera.width, camera.height), quarters)
            masks[view.name] = undistort_picture(mask.astype(np.float32), camera, view) > 0.5
        except StageError as error:
            unusable[view.name] = str(error)
    if not masks and unusable:
        raise StageError(f"none of {len(unusable)} masks in {folder} can be used; {next(iter(unusable.values()))}")
    if not masks:
        raise StageError(no_match(folder, views[0].name))
    print(f"{len(masks)} of {len(views)} photos have a mask in {folder}", flush=True)
    return masks, unusable
