"""GrabCut in all photos of an object: seeded by the prompts and sparse points, then cut again along the visual hull."""

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.masks.grabcut import (
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
from scenefuse.mvs.visual_hull import Frame, Hull, Mask, silhouette


def first_cuts(target: Target, frames: list[Frame], width_px: int, iterations: int) -> list[Mask]:
    """First masks, seeded by the prompts, the sparse points, and the colours of both over all photos.

    Args:
        target: box, prompts and sparse points of the object.
        frames: the photos.
        width_px: photos are cut at most this wide.
        iterations: rounds of learning colours and cutting.
    """
    trimaps = []
    for frame in frames:
        size = frame.image.shape[:2]
        trimaps.append(first_trimap(size, target.outline(frame), frame.project(target.spanning)[0]))
        stamp(trimaps[-1], target, frame)
    colours = learn_colours(
        [f.image for f in frames], [t == cv2.GC_FGD for t in trimaps], [t == cv2.GC_BGD for t in trimaps]
    )
    masks = []
    for frame, trimap in zip(frames, trimaps):
        prefer_colour(trimap, colours.evidence(frame.image))
        masks.append(cleaned(grabcut(frame.image, trimap, width_px, iterations)))
    return masks


def second_cuts(target: Target, masks: list[Mask], frames: list[Frame], hull: Hull, band_px: float) -> list[Mask]:
    """GrabCut once more, on all that a photo's mask and the hull do not agree on.

    Args:
        target: box, prompts and sparse points of the object.
        masks: (H, W) per photo.
        frames: the photos.
        hull: of these masks.
        band_px: half width of the band along its outline that is never certain, at a photo width of 640.
    """
    outlines = [silhouette(hull, f) for f in frames]
    colours = learn_colours(
        [f.image for f in frames], [m & o for m, o in zip(masks, outlines)], [~m & ~o for m, o in zip(masks, outlines)]
    )
    cut = []
    for frame, mask, outline in zip(frames, masks, outlines):
        width = frame.image.shape[1]
        trimap = second_trimap(outline, mask, colours.evidence(frame.image), band_px * width / 640)
        stamp(trimap, target, frame)
        cut.append(cleaned(grabcut(frame.image, trimap, width, 1)) if outline.any() else outline)
    return cut


def stamp(trimap: NDArray[np.uint8], target: Target, frame: Frame) -> None:
    """Mark what the sparse points that a photo sees make certain, the prompts, and what close prompts enclose.

    A prompt that the photo does not see is hidden by the object itself, so its pixel is the object's all the same.
    """
    height, width = trimap.shape
    rows = frame.point_rows
    radius, diagonal = 0.003 * width, target.box.diagonal
    stamp_seeds(trimap, frame.observed, target.sparse[rows], target.kind[rows], radius, 0.06 * diagonal)
    pixels, depth = frame.project(target.spanning)
    for part in [*target.parts, *np.arange(len(pixels))[:, None]]:
        if (depth[part] > 0).all():
            fill_hull(trimap, pixels[part], cv2.GC_FGD)
