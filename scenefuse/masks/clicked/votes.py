"""What the masks of photos say of the sparse points, and so of each other."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.masks.clicked.clicks import PhotoClicks
from scenefuse.masks.pixels import distance_to, pixel_of, share_in
from scenefuse.mvs.visual_hull import Mask
from scenefuse.transforms import Array
from scenefuse.workspace import Workspace

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


def known_pixels(photos: Workspace, k: int, others: dict[int, Voter]) -> tuple[Array, Array]:
    """Pixels (N, 2) of a photo's points on the object and (M, 2) of those off it, by the votes of the others; those
    clicked in the others, where this photo has them in its frame: what hides them is mostly the object."""
    share = shares_of(photos, others)[photos.seen[k]]
    known = (share >= SURE) | (share <= 1 - SURE)
    pixels, own = photos.seen_at[k][known], share[known] >= SURE
    if len(pixels) > NEIGHBOURS:
        near = cKDTree(pixels).query(pixels, NEIGHBOURS + 1)[1][:, 1:]
        agree = (own[near] == own[:, None]).mean(1) > 0.5
        pixels, own = pixels[agree], own[agree]
    view, clicked = photos.views[k], [voter.clicks.placed for voter in others.values() if voter.votes]
    points = np.concatenate([np.zeros((0, 3)), *clicked])
    shown = view.project(points[view.visible(points)[0]])[0]
    return np.concatenate([shown, pixels[own]]), pixels[~own]


def agreement_of(photos: Workspace, k: int, mask: Mask, others: dict[int, Voter]) -> float:
    """How well a mask agrees with the votes of the others, at most 1; 1 where these know nothing of its photo."""
    inside, outside = known_pixels(photos, k, others)
    return share_in(mask, inside, 1.0) - share_in(mask, outside, 0.0)
