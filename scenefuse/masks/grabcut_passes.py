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
    second_trimap,
)
from scenefuse.masks.prompts import Prompts, prompted_parts
from scenefuse.masks.target import Target
from scenefuse.photos.workspace import Rows, View, Workspace

# Rounds of learning colours and cutting in the first cut; later ones start from a good mask and take one.
FIRST_ROUNDS = 4
# Seeds grow along paths in photos at most this wide.
PATHS_WIDTH_PX = 320
# Half width of the band along the hull's outline where a photo's own evidence decides, as a share of its width.
HULL_BAND_SHARE = 5 / 640
# Radius of the disc that a sparse point makes certain, as a share of the photo's width: about two pixels at 640.
SEED_RADIUS_SHARE = 0.003
# Outside a clicked box nothing is object from this share of its longer side on: a person's corners miss.
MAX_BOX_MISS_SHARE = 0.04


def first_cuts(target: Target, photos: Workspace, width_px: int, clicked: Mapping[int, PhotoClicks]) -> list[Mask]:
    """First masks (H, W), seeded by the prompts and the sparse points.

    Args:
        target: box, prompts and sparse points of the object.
        photos: views with RGB pixels.
        width_px: photos are cut at most this wide.
        clicked: clicks by row of the photo.
    """
    masks = []
    for k, (view, seen, seen_at) in enumerate(zip(photos.views, photos.seen, photos.seen_at)):
        outline, spanning = target.outline(view), view.project(target.spanning)[0]
        trimap = first_trimap((view.height, view.width), outline, spanning)
        stamp(trimap, target, view, seen, seen_at, clicked.get(k))
        if clicked:
            grow_seeds(view.pixels, trimap, PATHS_WIDTH_PX)
        masks.append(cleaned(grabcut(view.pixels, trimap, width_px, FIRST_ROUNDS)))
    return masks


def query_grabcut(width_px: int, view: View, prompts: Prompts, box: Array | None) -> tuple[list[Mask], Array]:
    """One mask (H, W) of a photo by GrabCut, and its quality: 1, or 0 where it is empty or all of the photo.

    Args:
        width_px: photos are cut at most this wide.
        view: the photo, with RGB pixels.
        prompts: what those inside span is likely object.
        box: (2, 2) corners of a box, upper left first, outside of which nothing is object; or None.
    """
    on, off = prompts.inside, prompts.outside
    trimap = np.full((view.height, view.width), cv2.GC_PR_BGD, dtype=np.uint8)
    if box is not None:
        trimap[_off_box(trimap, box, MAX_BOX_MISS_SHARE)] = cv2.GC_BGD
        trimap[~_off_box(trimap, box, 0)] = cv2.GC_PR_FGD
    elif len(on) >= 3:
        fill_hull(trimap, on, cv2.GC_PR_FGD)
    _discs(trimap, off, on, SEED_RADIUS_SHARE * view.width)
    grow_seeds(view.pixels, trimap, PATHS_WIDTH_PX)
    mask = cleaned(grabcut(view.pixels, trimap, width_px, FIRST_ROUNDS))
    return [mask], np.array([float(mask.any() and not mask.all())])


def _off_box(trimap: Trimap, box: Array, slack: float) -> Mask:
    """(H, W) what lies outside a box (2, 2) in pixels, grown on all sides by a share of its longer side."""
    grow = slack * float((box[1] - box[0]).max())
    (left, top), (right, bottom) = np.maximum(box + [[-grow], [grow]], 0).astype(int)
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
    clicked: Mapping[int, PhotoClicks],
) -> list[Mask]:
    """GrabCut once more, where a photo's mask and the hull do not agree.

    Args:
        target: box, prompts and sparse points of the object.
        masks: (H, W) per photo.
        photos: views with RGB pixels.
        hull: of these masks.
        clicked: clicks by row of the photo.
    """
    outlines = [silhouette(hull, view) for view in photos.views]
    own, others = [m & o for m, o in zip(masks, outlines)], [~m & ~o for m, o in zip(masks, outlines)]
    colours = learn_colours([view.pixels for view in photos.views], own, others)
    cut = []
    for k, (view, mask, outline) in enumerate(zip(photos.views, masks, outlines)):
        trimap = second_trimap(outline, mask, colours.evidence(view.pixels), HULL_BAND_SHARE * view.width)
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
    radius, kind = SEED_RADIUS_SHARE * view.width, target.kind[seen]
    _discs(trimap, seen_at[kind < 0], seen_at[kind > 0], radius)
    pixels, depth = view.project(target.spanning)
    for part in [*target.parts, *np.arange(len(pixels))[:, None]]:
        if (depth[part] > 0).all():
            fill_hull(trimap, pixels[part], cv2.GC_FGD)
    if clicks is None:
        return
    if clicks.box is not None:
        trimap[_off_box(trimap, clicks.box, MAX_BOX_MISS_SHARE)] = cv2.GC_BGD
    _discs(trimap, clicks.off, clicks.on, radius)
