"""Connected and separate parts of a mask, told by the pixels that prompt it."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask
from scenefuse.masks.grabcut import cleaned
from scenefuse.masks.pixels import distance_to, held, pixel_of, share_in
from scenefuse.masks.votes import LEAST_QUALITY, SURE
from scenefuse.photos.workspace import View

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
NEAREST_PX = 0.03
"""A part's colours are compared with what is this near it, likewise, or within twice its radius where that is more."""
COLOR_BINS = 8
"""Bins of a histogram of colours along each axis of CIELAB."""
CLEAR, LEAST_REACH = 2.0, 0.4
"""Mean logarithm of how much likelier a part's colours are in the mask near it than around, or the reverse, by which
they decide; where they do not, how far the points in a part reach from the mask, over how far it does, does. Of 99
parts on four objects with true masks the two rules leave out 49, of which 45 were at most half on the object (sky
between an arm and a leg, the hill behind a roof), and keep 50, of which 47 were more."""

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
    the mask. Unless it was clicked, its colours have to be the mask's, not those around it, or where this is not clear
    its points must reach into it: a few next to an outline may be mismatched. Pixels of points that the object's
    enclose, (N, 2), are asked about likewise.
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
            sound = quality[row] >= LEAST_QUALITY and holds and own >= SURE * (own + foreign)
            sound = sound and part.sum() <= mask.sum()
            if sound and (len(group[0]) or _vouched(view.pixels, mask, part & ~mask, on)):
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


def _vouched(image: NDArray[np.uint8], mask: Mask, part: Mask, on: Array) -> bool:
    """Whether the colours of a part (H, W) outside a mask, and how far the pixels (N, 2) in it lie from this, speak for
    it."""
    if not part.any():
        return True
    own = own_colors(image, mask, part)
    if abs(own) >= CLEAR:
        return own > 0
    away = distance_to(mask)
    u, v = pixel_of(on, mask)
    return bool(np.percentile(away[v, u], 90) >= LEAST_REACH * np.percentile(away[part], 90))


def own_colors(image: NDArray[np.uint8], mask: Mask, part: Mask) -> float:
    """Mean logarithm, in nats, of how much likelier the colours of a part (H, W) are in the mask near it than outside
    both, by histograms; 0 where there is nothing to compare.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W).
        part: (H, W), outside the mask, not empty.
    """
    reach = max(NEAREST_PX * max(mask.shape), 2 * float(np.sqrt(part.sum() / np.pi)))
    rows, columns = (np.flatnonzero(part.any(axis)) for axis in (1, 0))
    box = tuple(slice(max(0, int(k[0] - reach)), int(k[-1] + reach) + 1) for k in (rows, columns))
    image, mask, part = image[box], mask[box], part[box]
    near = distance_to(part) < reach
    inside, outside = near & mask, near & ~mask & ~part
    if not inside.any() or not outside.any():
        return 0.0
    bins = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(np.int64) * COLOR_BINS // 256 @ [COLOR_BINS**2, COLOR_BINS, 1]
    counts = [np.bincount(bins[where], minlength=COLOR_BINS**3) + 0.5 for where in (inside, outside)]
    likelier = np.log(counts[0] / counts[0].sum()) - np.log(counts[1] / counts[1].sum())
    return float(likelier[bins[part]].mean())


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
