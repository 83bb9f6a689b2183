"""GrabCut in all photos of an object: seeded by the prompts and sparse points, then cut again along the visual hull."""

import cv2
import numpy as np

from scenefuse.masks.grabcut import (
    Trimap,
    cleaned,
    fill_hull,
    first_trimap,
    grabcut,
    learn_colours,
    prefer_colour,
    second_trimap,
    stamp_seeds,
)
from scenefuse.masks.target import Target
from scenefuse.mvs.visual_hull import Hull, Mask, silhouette
from scenefuse.transforms import Array
from scenefuse.workspace import Rows, View, Workspace

FIRST_ROUNDS = 4
"""Rounds of learning colours and cutting in the first cut; later ones start from a good mask and take one."""
REFERENCE_WIDTH_PX = 640
"""Photo width that `band_px` is meant for."""


def first_cuts(target: Target, photos: Workspace, width_px: int) -> list[Mask]:
    """First masks (H, W), seeded by the prompts, the sparse points, and the colours of both over all photos.

    Args:
        target: box, prompts and sparse points of the object.
        photos: views with RGB pixels.
        width_px: photos are cut at most this wide.
    """
    trimaps = []
    for view, seen, seen_at in zip(photos.views, photos.seen, photos.seen_at):
        outline, spanning = target.outline(view), view.project(target.spanning)[0]
        trimaps.append(first_trimap((view.height, view.width), outline, spanning))
        stamp(trimaps[-1], target, view, seen, seen_at)
    images = [view.pixels for view in photos.views]
    colours = learn_colours(images, [t == cv2.GC_FGD for t in trimaps], [t == cv2.GC_BGD for t in trimaps])
    masks = []
    for image, trimap in zip(images, trimaps):
        prefer_colour(trimap, colours.evidence(image))
        masks.append(cleaned(grabcut(image, trimap, width_px, FIRST_ROUNDS)))
    return masks


def second_cuts(target: Target, masks: list[Mask], photos: Workspace, hull: Hull, band_px: float) -> list[Mask]:
    """GrabCut once more, where a photo's mask and the hull do not agree.

    Args:
        target: box, prompts and sparse points of the object.
        masks: (H, W) per photo.
        photos: views with RGB pixels.
        hull: of these masks.
        band_px: half width of the band along its outline that is never certain, at a photo width of 640.
    """
    outlines = [silhouette(hull, view) for view in photos.views]
    own, others = [m & o for m, o in zip(masks, outlines)], [~m & ~o for m, o in zip(masks, outlines)]
    colours = learn_colours([view.pixels for view in photos.views], own, others)
    cut = []
    for k, (view, mask, outline) in enumerate(zip(photos.views, masks, outlines)):
        band = band_px * view.width / REFERENCE_WIDTH_PX
        trimap = second_trimap(outline, mask, colours.evidence(view.pixels), band)
        stamp(trimap, target, view, photos.seen[k], photos.seen_at[k])
        cut.append(cleaned(grabcut(view.pixels, trimap, view.width, 1)) if outline.any() else outline)
    return cut


def stamp(trimap: Trimap, target: Target, view: View, seen: Rows, seen_at: Array) -> None:
    """Mark in place what the sparse points that a photo sees make certain, the prompts, and what close prompts enclose.

    A prompt that the photo does not see is hidden by the object itself, so its pixel is the object's all the same.

    Args:
        trimap: (H, W) labels.
        target: box, prompts and sparse points of the object.
        view: the photo.
        seen: (K,) rows of the sparse points that it observes.
        seen_at: (K, 2) pixels where it does.
    """
    radius, diagonal = 0.003 * view.width, target.box.diagonal
    stamp_seeds(trimap, seen_at, target.sparse[seen], target.kind[seen], radius, 0.06 * diagonal)
    pixels, depth = view.project(target.spanning)
    for part in [*target.parts, *np.arange(len(pixels))[:, None]]:
        if (depth[part] > 0).all():
            fill_hull(trimap, pixels[part], cv2.GC_FGD)
