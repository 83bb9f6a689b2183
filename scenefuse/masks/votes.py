"""What the masks of photos say of the sparse points, and so of each other."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.box import in_hull
from scenefuse.masks.prompts import Prompts, agreement, distance_to, pixel_of
from scenefuse.photos.workspace import Workspace

# Quality of a mask, by its method's own estimate, from which it votes: SAM 2's was 0.44 to 0.77 for the bronze statue's
# good masks, and is below 0.3 for most bad ones.
MIN_QUALITY = 0.5
# Agreement with its prompts from which a mask votes.
MIN_AGREEMENT = 0.8
# Share of a point's votes for one side from which it is known to be on that side.
MIN_VOTE_SHARE = 0.8
# Percentage of the object's points at each side, along each axis, that may be mismatched.
OUTERMOST_PERCENT = 1.0
# So many of these points, on which so many photos vote, span the object: a single mask may hold what is around it.
MIN_SPANNING_POINTS, SPANNING_PHOTOS = 8, 2
# Half width of the band along a mask's outline in which no point votes, as a share of the photo's longer side.
OUTLINE_BAND_SHARE = 0.003


@dataclass
class Voter:
    """A photo's mask, and what it says of the sparse points that the photo sees.

    Attributes:
        mask: (H, W).
        quality: of the mask, by its method's own estimate.
        agreement: of the mask with its prompts.
        rows: (N,) sparse points it votes on.
        inside: (N,) whether they are the object's.
        clicks: those in this photo that the mask agrees with.
    """

    mask: Mask
    quality: float
    agreement: float
    rows: NDArray[np.int64]
    inside: NDArray[np.bool_]
    clicks: PhotoClicks

    @property
    def votes(self) -> bool:
        """Whether it counts."""
        return self.quality >= MIN_QUALITY and self.agreement >= MIN_AGREEMENT


def voter_of(photos: Workspace, k: int, mask: Mask, quality: float, agreement: float, clicks: PhotoClicks) -> Voter:
    """What a photo's mask says of the points that the photo sees, but for those next to its outline."""
    u, v = pixel_of(photos.seen_at[k], mask)
    band = OUTLINE_BAND_SHARE * max(mask.shape)
    sure = (distance_to(mask) + distance_to(~mask))[v, u] > band if len(u) else np.zeros(0, dtype=bool)
    return Voter(mask, quality, agreement, photos.seen[k][sure], mask[v, u][sure], clicks)


def vote_shares(photos: Workspace, made: dict[int, Voter]) -> Array:
    """(P,) share of the votes that are for the object, per sparse point, weighted by quality; NaN without votes."""
    votes, total = np.zeros(len(photos.points)), np.zeros(len(photos.points))
    for voter in made.values():
        if voter.votes:
            np.add.at(total, voter.rows, voter.quality)
            np.add.at(votes, voter.rows, voter.quality * voter.inside)
    with np.errstate(invalid="ignore"):
        return votes / total


def without_outermost(points: Array) -> Array:
    """Of (N, 3) points of the object those that are not the outermost along an axis, where there are many."""
    if not len(points):
        return points
    low = np.percentile(points, OUTERMOST_PERCENT, axis=0, method="lower")
    high = np.percentile(points, 100 - OUTERMOST_PERCENT, axis=0, method="higher")
    return points[((points >= low) & (points <= high)).all(1)]


def known_points(photos: Workspace, made: dict[int, Voter]) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
    """(P,) 1 for sparse points known to be the object's, -1 for those known not to be, 0 for all others; and (P,) those
    of the others that the object's enclose.

    A first mask that lacks a part (a wall in the shade) would have all others leave it out. So within the convex
    hull of the object's points no mask says that a point is not on it. Points by stereo are known to be the object's,
    or unknown: they are dense, so a part is full of them, and so is what lies between the object's parts.
    """
    share = vote_shares(photos, made)
    known = np.where(share >= MIN_VOTE_SHARE, 1, np.where(share <= 1 - MIN_VOTE_SHARE, -1, 0)).astype(np.int8)
    rows = [voter.rows for voter in made.values() if voter.votes]
    counts = np.bincount(np.concatenate([np.zeros(0, np.int64), *rows]), minlength=len(known))
    own = without_outermost(photos.points[(known > 0) & (counts >= SPANNING_PHOTOS)])
    enclosed, sparse = np.zeros(len(known), dtype=bool), np.arange(len(known)) < len(known) - photos.by_stereo
    if len(own) >= MIN_SPANNING_POINTS:
        with suppress(QhullError):  # of points in a plane, which enclose nothing
            enclosed = (known <= 0) & in_hull(photos.points, own)
    known[enclosed] = 0
    known[~sparse & (known < 0)] = 0
    return known, enclosed & sparse


def known_pixels(photos: Workspace, k: int, others: dict[int, Voter]) -> Prompts:
    """What the votes of the others say of a photo's points."""
    known, enclosing = known_points(photos, others)
    kind, enclosed = known[photos.seen[k]], enclosing[photos.seen[k]]
    at = photos.seen_at[k]
    return Prompts(known=at[kind > 0], known_off=at[kind < 0], enclosed=at[enclosed])


def agrees_with_others(photos: Workspace, k: int, mask: Mask, others: dict[int, Voter]) -> bool:
    """Whether a mask (H, W) agrees with the votes of the others; so it does where these know nothing of its photo."""
    return agreement(mask, known_pixels(photos, k, others), 0) >= MIN_AGREEMENT
