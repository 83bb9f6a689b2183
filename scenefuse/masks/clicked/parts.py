"""Connected and separate parts of a mask, told by the pixels that prompt it."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenefuse.masks.clicked.votes import LEAST_QUALITY, SURE
from scenefuse.masks.grabcut import cleaned
from scenefuse.masks.pixels import held, pixel_of, share_in
from scenefuse.mvs.visual_hull import Mask
from scenefuse.transforms import Array
from scenefuse.workspace import View

LEAST_KNOWN = 4
"""Points known to be on the object that a photo has to see to be prompted by them."""
PART_GAP = 0.05
"""Pixels that a mask lacks are of one part if they are this near each other, as a share of the photo's longer side."""
PART_AGREEMENT = 0.5
"""A mask that agrees less with what prompts it does not lack parts: it is another thing."""
PART_REACH = 0.1
"""Pixels outside prompt a part if they are this near it, likewise."""
NEAR_MISS = 0.015
"""A click off a mask by less than this share of the photo's longer side missed its outline; others are on a part."""

Ask = Callable[[View, tuple[Array, Array], tuple[Array, Array], Array | None, Array | None], tuple[list[Mask], Array]]
"""Masks (H, W) of a photo with RGB pixels and their qualities, from pixels on the object, pixels off it, each (N, 2)
clicked and (M, 2) carried on, a box (2, 2) that was drawn or None, and one in which the object probably is or None:
what comes of that, if anything, is told by itself."""


def with_parts(
    ask: Ask,
    view: View,
    mask: Mask,
    inside: tuple[Array, Array],
    outside: tuple[Array, Array],
    enclosed: Array,
    tolerance_px: float,
) -> Mask:
    """A mask with the parts that it lacks: of several things that prompt it, a network takes the clearest.

    Each group of pixels inside that the mask does not hold, near each other, prompts alone. What it gives is a part of
    the object if it holds them, few pixels known to be outside beside those known to be inside, and is no larger than
    the mask. Pixels of points that the object's enclose, (N, 2), are asked about likewise.
    """
    whole = mask
    if agrees(mask, inside, outside, tolerance_px) < PART_AGREEMENT:
        return whole
    missed_px = max(tolerance_px, NEAR_MISS * max(mask.shape))
    perhaps = np.concatenate([inside[1], enclosed])
    lacking = inside[0][~held(mask, inside[0], missed_px)], perhaps[~held(mask, perhaps, 0)]
    for group in _groups(*lacking, PART_GAP * max(mask.shape)):
        on = np.concatenate(group)
        # What is clicked in a photo beats what other photos say of it.
        certain, voted = outside if not len(group[0]) else (outside[0], outside[1][:0])
        off = np.concatenate([certain, voted])
        # Far from a part, they say nothing of it and mislead the network.
        reach = cKDTree(on), PART_REACH * max(mask.shape)
        masks, quality = ask(view, group, (_near(certain, *reach), _near(voted, *reach)), None, None)
        for row in np.argsort(-quality):
            part = prompted_parts(cleaned(masks[row], view.pixels), on, off)
            own, foreign = (held(part, pixels, 0).sum() for pixels in (np.concatenate([inside[0], perhaps]), off))
            holds = part.any() and share_in(part, on, 1.0) >= SURE
            if quality[row] >= LEAST_QUALITY and holds and own >= SURE * (own + foreign) and part.sum() <= mask.sum():
                whole = whole | part
                break
    return whole


def agrees(mask: Mask, inside: tuple[Array, Array], outside: tuple[Array, Array], tolerance_px: float) -> float:
    """Share of the pixels inside that a mask holds, less the share of those outside that it holds.

    Of those inside one more counts as held: where four are known, one that is wrong is no reason to doubt the mask.
    """
    within = np.concatenate([held(mask, inside[0], tolerance_px), held(mask, inside[1], 0)])
    spared = np.concatenate([held(~mask, outside[0], tolerance_px), held(~mask, outside[1], 0)])
    return float((within.sum() + 1) / (len(within) + 1) - ((~spared).mean() if len(spared) else 0.0))


def _near(pixels: Array, others: cKDTree, reach_px: float) -> Array:
    """Those of (N, 2) pixels that are near one of the others."""
    return pixels[others.query(pixels)[0] < reach_px] if len(pixels) else pixels


def _groups(clicked: Array, carried: Array, gap_px: float) -> Iterator[tuple[Array, Array]]:
    """Pixels (N, 2) clicked and (M, 2) carried on, those near each other together; a few carried ones say nothing."""
    pixels = np.concatenate([clicked, carried])
    if len(pixels):
        tree = cKDTree(pixels)
        _, group = connected_components(tree.sparse_distance_matrix(tree, gap_px))
        for number in range(group.max() + 1):
            of_group = np.split(group == number, [len(clicked)])
            if of_group[0].any() or of_group[1].sum() >= LEAST_KNOWN:
                yield clicked[of_group[0]], carried[of_group[1]]


def prompted_parts(mask: Mask, inside: Array, outside: Array) -> Mask:
    """The connected parts of a mask (H, W) that hold one of (N, 2) pixels inside, and not as many of (M, 2) outside;
    all of it where no pixel inside is known."""
    if not len(inside):
        return mask
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    on, off = (np.bincount(labels[v, u], minlength=count) for u, v in (pixel_of(p, mask) for p in (inside, outside)))
    wanted = on > off
    wanted[0] = False
    return wanted[labels]
