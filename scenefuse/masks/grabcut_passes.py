"""GrabCut in all photos of an object: seeded by the prompts and sparse points, then cut again along the visual hull."""

from collections.abc import Mapping

import cv2
import numpy as np

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Hull, Mask, silhouette
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.grabcut import (
    Trimap,
    cleaned,
    fill_hull,
    first_trimap,
    grabcut,
    grow_seeds,
    learn_colours,
    prefer_colour,
    second_trimap,
    stamp_seeds,
)
from scenefuse.masks.parts import prompted_parts
from scenefuse.masks.target import Target
from scenefuse.photos.workspace import Rows, View, Workspace

FIRST_ROUNDS = 4
"""Rounds of learning colours and cutting in the first cut; later ones start from a good mask and take one."""
PATHS_WIDTH_PX = 320
"""Seeds grow along paths in photos at most this wide."""
REFERENCE_WIDTH_PX = 640
"""Photo width that `band_px` is meant for."""
SEED_RADIUS = 0.003
"""Radius of the disc that a sparse point makes certain, as a share of the photo's width: about two pixels at 640."""
BOX_SLACK = 0.04
"""Outside a clicked box nothing is object from this share of its longer side on: a person's corners miss."""
SEED_EDGE = 0.06
"""Longest side of a triangle of sparse points that is filled, as a share of the box's diagonal: holes are larger."""


def first_cuts(target: Target, photos: Workspace, width_px: int, clicked: Mapping[int, PhotoClicks]) -> list[Mask]:
    """First masks (H, W), seeded by the prompts, the sparse points, and the colours of both over all photos.

    Args:
        target: box, prompts and sparse points of the object.
        photos: views with RGB pixels.
        width_px: photos are cut at most this wide.
        clicked: clicks by row of the photo.
    """
    trimaps = []
    for k, (view, seen, seen_at) in enumerate(zip(photos.views, photos.seen, photos.seen_at)):
        outline, spanning = target.outline(view), view.project(target.spanning)[0]
        trimaps.append(first_trimap((view.height, view.width), outline, spanning))
        stamp(trimaps[-1], target, view, seen, seen_at, clicked.get(k))
        if clicked:
            grow_seeds(view.pixels, trimaps[-1], PATHS_WIDTH_PX)
    images = [view.pixels for view in photos.views]
    colours = learn_colours(images, [t == cv2.GC_FGD for t in trimaps], [t == cv2.GC_BGD for t in trimaps])
    masks = []
    for image, trimap in zip(images, trimaps):
        prefer_colour(trimap, colours.evidence(image))
        masks.append(cleaned(grabcut(image, trimap, width_px, FIRST_ROUNDS)))
    return masks


def ask_grabcut(
    width_px: int,
    view: View,
    inside: tuple[Array, Array],
    outside: tuple[Array, Array],
    box_px: Array | None,
    likely_px: Array | None,
) -> tuple[list[Mask], Array]:
    """One mask (H, W) of a photo by GrabCut, and its quality: 1, or 0 where it is empty or all of the photo.

    Args:
        width_px: photos are cut at most this wide.
        view: the photo, with RGB pixels.
        inside: (N, 2) pixels clicked on the object and (M, 2) carried on to it; what they span is likely object.
        outside: the same off the object.
        box_px: (2, 2) corners of a box, upper left first, outside of which nothing is object; or None.
        likely_px: the same of a box in which the object probably is: nothing comes of it, as colours would fill it.
    """
    if likely_px is not None:
        return [], np.zeros(0)
    on, off = np.concatenate(inside), np.concatenate(outside)
    trimap = np.full((view.height, view.width), cv2.GC_PR_BGD, dtype=np.uint8)
    if box_px is not None:
        trimap[_off_box(trimap, box_px, BOX_SLACK)] = cv2.GC_BGD
        trimap[~_off_box(trimap, box_px, 0)] = cv2.GC_PR_FGD
    elif len(on) >= 3:
        fill_hull(trimap, on, cv2.GC_PR_FGD)
    _discs(trimap, off, on, SEED_RADIUS * view.width)
    grow_seeds(view.pixels, trimap, PATHS_WIDTH_PX)
    mask = cleaned(grabcut(view.pixels, trimap, width_px, FIRST_ROUNDS))
    return [mask], np.array([float(mask.any() and not mask.all())])


def _off_box(trimap: Trimap, box_px: Array, slack: float) -> Mask:
    """(H, W) what lies outside a box (2, 2) in pixels, grown on all sides by a share of its longer side."""
    grow = slack * float((box_px[1] - box_px[0]).max())
    (left, top), (right, bottom) = np.maximum(box_px + [[-grow], [grow]], 0).astype(int)
    off = np.ones(trimap.shape, dtype=bool)
    off[top : bottom + 1, left : right + 1] = False
    return off


def _discs(trimap: Trimap, off: Array, on: Array, radius_px: float) -> None:
    """Make the discs around pixels (M, 2) off the object and (N, 2) on it certain, in place."""
    for pixels, label in ((off, cv2.GC_BGD), (on, cv2.GC_FGD)):
        for x, y in pixels.astype(int):
            cv2.circle(trimap, (int(x), int(y)), max(1, round(radius_px)), label, -1)


def second_cuts(
    target: Target,
    masks: list[Mask],
    photos: Workspace,
    hull: Hull,
    band_px: float,
    clicked: Mapping[int, PhotoClicks],
) -> list[Mask]:
    """GrabCut once more, where a photo's mask and the hull do not agree.

    Args:
        target: box, prompts and sparse points of the object.
        masks: (H, W) per photo.
        photos: views with RGB pixels.
        hull: of these masks.
        band_px: half width of the band along its outline that is never certain, at a photo width of 640.
        clicked: clicks by row of the photo.
    """
    outlines = [silhouette(hull, view) for view in photos.views]
    own, others = [m & o for m, o in zip(masks, outlines)], [~m & ~o for m, o in zip(masks, outlines)]
    colours = learn_colours([view.pixels for view in photos.views], own, others)
    cut = []
    for k, (view, mask, outline) in enumerate(zip(photos.views, masks, outlines)):
        band = band_px * view.width / REFERENCE_WIDTH_PX
        trimap = second_trimap(outline, mask, colours.evidence(view.pixels), band)
        stamp(trimap, target, view, photos.seen[k], photos.seen_at[k], clicked.get(k))
        if not outline.any():
            cut.append(outline)
            continue
        found, told = grabcut(view.pixels, trimap, view.width, 1), clicked.get(k)
        cut.append(cleaned(found))
        if told is not None and len(told.on):
            # A small part that was clicked is no speck.
            cut[-1] = cut[-1] | prompted_parts(found, told.on, told.off)
    return cut


def stamp(
    trimap: Trimap, target: Target, view: View, seen: Rows, seen_at: Array, clicks: PhotoClicks | None = None
) -> None:
    """Mark in place what the sparse points that a photo sees make certain, the prompts, what close prompts enclose, and
    the photo's own clicks and box.

    A prompt that the photo does not see is hidden by the object itself, so its pixel is the object's all the same.

    Args:
        trimap: (H, W) labels.
        target: box, prompts and sparse points of the object.
        view: the photo.
        seen: (K,) rows of the sparse points that it observes.
        seen_at: (K, 2) pixels where it does.
        clicks: made in this photo, if any.
    """
    radius, edge = SEED_RADIUS * view.width, SEED_EDGE * target.box.diagonal
    stamp_seeds(trimap, seen_at, target.sparse[seen], target.kind[seen], radius, edge)
    pixels, depth = view.project(target.spanning)
    for part in [*target.parts, *np.arange(len(pixels))[:, None]]:
        if (depth[part] > 0).all():
            fill_hull(trimap, pixels[part], cv2.GC_FGD)
    if clicks is None:
        return
    if clicks.box is not None:
        trimap[_off_box(trimap, clicks.box, BOX_SLACK)] = cv2.GC_BGD
    _discs(trimap, clicks.off, clicks.on, radius)
