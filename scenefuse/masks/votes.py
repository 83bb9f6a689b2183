"""What the masks of photos say of the sparse points, and so of each other."""

from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError, cKDTree

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.box import in_hull
from scenefuse.masks.pixels import distance_to, pixel_of, share_in
from scenefuse.photos.workspace import Workspace

LEAST_QUALITY = 0.5
"""Quality of a mask, as its method judges it, below which it does not vote: the network's own was 0.44 to 0.77 for the
bronze statue's good masks, and is below 0.3 for most bad ones."""
LEAST_AGREEMENT = 0.8
"""Share of the points known to be inside that a mask has to hold, less the share of those outside it holds."""
SURE = 0.8
"""Share of a point's votes for one side from which it counts for that side."""
NEIGHBOURS = 7
"""A known point prompts where most of so many known points around it in the photo say the same: it may be mismatched,
and it is hidden points' neighbours that differ."""
OUTERMOST = 1.0
"""Percentage of the points known to be the object's that are taken for mismatched at each side, where there are a
hundred."""
STRAY, FAR = 5.0, 1.0
"""Percentage at each side of the object's points that may be far from the rest; how far a point may be from the box of
the others, over its diagonal."""
LEAST_SPANNING, SPANNING_VOTES = 8, 2
"""So many of these points, on which so many photos vote, span the object: a single mask may hold what is around it."""
MOST_FOREIGN = 0.1
"""Points voted off the object in the hull of its own, for each of these, from which on a mask must have taken in what
is around it."""
EDGE = 0.003
"""Half width of the band along a mask's outline in which no point votes, as a share of the photo's longer side."""


@dataclass
class Voter:
    """A photo's mask, and what it says of the sparse points that the photo sees.

    Attributes:
        mask: (H, W).
        quality: of the mask, as its method judges it.
        agreement: share of what prompts it that it holds, less the share of what is outside that it holds.
        rows: (N,) sparse points it votes on.
        inside: (N,) whether they are the object's.
        clicks: those it agrees with.
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
        return self.quality >= LEAST_QUALITY and self.agreement >= LEAST_AGREEMENT


def voter_of(photos: Workspace, k: int, mask: Mask, quality: float, agreement: float, clicks: PhotoClicks) -> Voter:
    """What a photo's mask says of the points that the photo sees, but for those next to its outline."""
    u, v = pixel_of(photos.seen_at[k], mask)
    edge = EDGE * max(mask.shape)
    sure = (distance_to(mask) + distance_to(~mask))[v, u] > edge if len(u) else np.zeros(0, dtype=bool)
    return Voter(mask, quality, agreement, photos.seen[k][sure], mask[v, u][sure], clicks)


def shares_of(photos: Workspace, made: dict[int, Voter]) -> Array:
    """(P,) share of the votes that are for the object, per sparse point; NaN where nobody votes."""
    votes, total = np.zeros(len(photos.points)), np.zeros(len(photos.points))
    for voter in made.values():
        if voter.votes:
            np.add.at(total, voter.rows, voter.quality)
            np.add.at(votes, voter.rows, voter.quality * voter.inside)
    with np.errstate(invalid="ignore"):
        return votes / total


def central(points: Array) -> Array:
    """Of (N, 3) points of the object those that are not the OUTERMOST along an axis."""
    if not len(points):
        return points
    low = np.percentile(points, OUTERMOST, axis=0, method="lower")
    high = np.percentile(points, 100 - OUTERMOST, axis=0, method="higher")
    return points[((points >= low) & (points <= high)).all(1)]


def known_points(photos: Workspace, made: dict[int, Voter]) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
    """(P,) 1 for sparse points known to be the object's, -1 for those known not to be, 0 for all others; and (P,) those
    of the others that the object's enclose.

    A first mask that lacks a part (a wall in the shade) would have all others asked to leave it out. So in the convex
    hull of the object's points no mask says that a point is not on it. Points by stereo are known to be the object's,
    or unknown: they are dense, so a part is full of them, and so is what lies between the object's parts.
    """
    share = shares_of(photos, made)
    known = np.where(share >= SURE, 1, np.where(share <= 1 - SURE, -1, 0)).astype(np.int8)
    rows = [voter.rows for voter in made.values() if voter.votes]
    counts = np.bincount(np.concatenate([np.zeros(0, np.int64), *rows]), minlength=len(known))
    known[(known > 0) & ~near_most(photos.points, photos.points[known > 0])] = 0
    own = central(photos.points[(known > 0) & (counts >= SPANNING_VOTES)])
    enclosed, sparse = np.zeros(len(known), dtype=bool), np.arange(len(known)) < len(known) - photos.by_stereo
    if len(own) >= LEAST_SPANNING:
        with suppress(QhullError):  # of points in a plane, which enclose nothing
            inner = in_hull(photos.points, own)
            enclosed = (known <= 0) & inner
            foreign, mine = ((inner & sparse & side).sum() for side in (known < 0, known > 0))
            if foreign > MOST_FOREIGN * mine:
                enclosed[:] = False
    known[enclosed] = 0
    known[~sparse & (known < 0)] = 0
    return known, enclosed & sparse


def near_most(points: Array, own: Array) -> NDArray[np.bool_]:
    """(P,) which points (P, 3) are no farther from most of the object's own (N, 3) than these reach: a mask that leaks,
    or a click whose depth is wrong, takes in what is far behind the object, and would have the next photos look for
    that. All, where few of the object's own are known."""
    if len(own) < LEAST_SPANNING:
        return np.ones(len(points), dtype=bool)
    low, high = np.percentile(own, [STRAY, 100 - STRAY], axis=0)
    reach = FAR * np.linalg.norm(high - low)
    return np.asarray(((points >= low - reach) & (points <= high + reach)).all(1))


class Known(NamedTuple):
    """Pixels of a photo's points on the object (N, 2), off it (M, 2), and of those that are perhaps a part of it."""

    inside: Array
    outside: Array
    enclosed: Array


def known_pixels(photos: Workspace, k: int, others: dict[int, Voter]) -> Known:
    """What the votes of the others say of a photo's points; those clicked in the others are inside where this photo has
    them in its frame: what hides them is mostly the object."""
    known, enclosing = known_points(photos, others)
    kind, enclosed = known[photos.seen[k]], enclosing[photos.seen[k]]
    pixels, own = photos.seen_at[k][kind != 0], kind[kind != 0] > 0
    if len(pixels) > NEIGHBOURS:
        near = cKDTree(pixels).query(pixels, NEIGHBOURS + 1)[1][:, 1:]
        agree = (own[near] == own[:, None]).mean(1) > 0.5
        pixels, own = pixels[agree], own[agree]
    view, clicked = photos.views[k], [voter.clicks.placed for voter in others.values() if voter.votes]
    points = np.concatenate([np.zeros((0, 3)), *clicked])
    points = points[near_most(points, photos.points[known > 0])]
    shown = view.project(points[view.visible(points)[0]])[0]
    return Known(np.concatenate([shown, pixels[own]]), pixels[~own], photos.seen_at[k][enclosed])


def agreement_of(photos: Workspace, k: int, mask: Mask, others: dict[int, Voter]) -> float:
    """How well a mask agrees with the votes of the others, at most 1; 1 where these know nothing of its photo."""
    inside, outside, _ = known_pixels(photos, k, others)
    return share_in(mask, inside, 1.0) - share_in(mask, outside, 0.0)
