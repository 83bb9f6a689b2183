"""Add the object's parts that a photo's mask lacks: prompted on several things, SAM 2 returns only the clearest."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask
from scenefuse.masks.grabcut import cleaned
from scenefuse.masks.prompts import (
    NO_PIXELS,
    Prompts,
    Segmenter,
    agreement,
    distance_to,
    held,
    pixel_of,
    prompted_parts,
)
from scenefuse.masks.votes import MIN_QUALITY, MIN_VOTE_SHARE
from scenefuse.photos.workspace import View

# Points known to be on the object that prompt a photo, or a part, by themselves.
MIN_KNOWN_POINTS = 4
# Pixels that a mask lacks are of one part if they are this near each other, as a share of the photo's longer side.
PART_GAP_SHARE = 0.05
# A mask that agrees less with what prompts it does not lack parts: it is another thing.
MIN_WHOLE_AGREEMENT = 0.5
# Pixels outside prompt a part if they are this near it, as a share of the photo's longer side.
PART_REACH_SHARE = 0.1
# A click off a mask by less than this share of the photo's longer side missed its outline; others are on a part.
NEAR_MISS_SHARE = 0.015
# A part's colours are compared with what is this near it, likewise, or within twice its radius where that is more.
COLOR_REACH_SHARE = 0.03
# Bins of a histogram of colours along each axis of CIELAB.
COLOR_BINS = 8
# Mean logarithm of how much likelier a part's colours are in the mask near it than around, or the reverse, from which
# they decide; where they do not, how far the points in a part reach from the mask, over how far the part does, does.
# Of 99 parts on four objects with true masks the two rules leave out 49, of which 45 were at most half on the object
# (sky between an arm and a leg, the hill behind a roof), and keep 50, of which 47 were more.
CLEAR_COLOR_NATS, MIN_REACH_SHARE = 2.0, 0.4


def with_parts(segment: Segmenter, view: View, mask: Mask, prompts: Prompts, tolerance_px: float) -> Mask:
    """A mask (H, W) with the parts that it lacks.

    Each group of pixels inside that the mask does not hold, near each other, prompts alone. The answer is a part of
    the object if it holds them, holds few pixels outside beside those inside, and is no larger than the mask. Unless
    it was clicked, its colours have to be the mask's rather than those around it, or, where they are like both, its
    points must reach into it: a few next to an outline may be mismatched.
    """
    if agreement(mask, prompts, tolerance_px) < MIN_WHOLE_AGREEMENT:
        return mask
    whole, side_px = mask, max(mask.shape)
    perhaps = np.concatenate([prompts.known, prompts.enclosed])
    clicked = prompts.clicked[~held(mask, prompts.clicked, max(tolerance_px, NEAR_MISS_SHARE * side_px))]
    for group in _groups(clicked, perhaps[~held(mask, perhaps, 0)], PART_GAP_SHARE * side_px):
        on = group.inside
        # What is clicked in a photo beats what other photos know of it.
        off = prompts if not len(group.clicked) else prompts._replace(known_off=NO_PIXELS)
        # Far from a part, pixels outside say nothing of it and mislead the network.
        reach = cKDTree(on), PART_REACH_SHARE * side_px
        near = group._replace(clicked_off=_near(off.clicked_off, *reach), known_off=_near(off.known_off, *reach))
        masks, quality = segment(view, near, None)
        for row in np.argsort(-quality):
            part = prompted_parts(cleaned(masks[row], view.pixels), on, off.outside)
            own = held(part, np.concatenate([prompts.clicked, perhaps]), 0).sum()
            sound = quality[row] >= MIN_QUALITY and part.any() and part.sum() <= mask.sum()
            sound = sound and held(part, on, 0).mean() >= MIN_VOTE_SHARE
            sound = sound and own >= MIN_VOTE_SHARE * (own + held(part, off.outside, 0).sum())
            if sound and (len(group.clicked) or _looks_alike(view.pixels, mask, part & ~mask, on)):
                whole = whole | part
                break
    return whole


def _looks_alike(image: NDArray[np.uint8], mask: Mask, part: Mask, on: Array) -> bool:
    """Whether the colours of a part (H, W) outside a mask are the mask's, or, where they are not clear, the pixels
    (N, 2) that prompt it reach into it."""
    if not part.any():
        return True
    own = own_colors(image, mask, part)
    if abs(own) >= CLEAR_COLOR_NATS:
        return own > 0
    away = distance_to(mask)
    u, v = pixel_of(on, mask)
    return bool(np.percentile(away[v, u], 90) >= MIN_REACH_SHARE * np.percentile(away[part], 90))


def own_colors(image: NDArray[np.uint8], mask: Mask, part: Mask) -> float:
    """Mean logarithm, in nats, of how much likelier the colours of a part (H, W) are in the mask near it than outside
    both, by histograms; 0 where there is nothing to compare.

    Args:
        image: (H, W, 3) RGB.
        mask: (H, W).
        part: (H, W), outside the mask, not empty.
    """
    reach = max(COLOR_REACH_SHARE * max(mask.shape), 2 * float(np.sqrt(part.sum() / np.pi)))
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


def _groups(clicked: Array, known: Array, gap_px: float) -> Iterator[Prompts]:
    """Pixels (N, 2) clicked and (M, 2) known, those near each other together; a few known ones alone are left out."""
    pixels = np.concatenate([clicked, known])
    if len(pixels):
        tree = cKDTree(pixels)
        _, group = connected_components(tree.sparse_distance_matrix(tree, gap_px))
        for number in range(group.max() + 1):
            of_clicked, of_known = np.split(group == number, [len(clicked)])
            if of_clicked.any() or of_known.sum() >= MIN_KNOWN_POINTS:
                yield Prompts(clicked=clicked[of_clicked], known=known[of_known])
