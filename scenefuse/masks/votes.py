"""What the masks of photos say of the sparse points, and so of each other."""

from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS
from scenefuse.geometry.visual_hull import MIN_OWN_POINTS, MIN_WHOLE_SHARE, Mask, is_whole
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.prompts import POINT_RADIUS_SHARE, Measure, Prompts, distance_to, pixel_of
from scenefuse.masks.target import in_hull, without_outermost
from scenefuse.mvs.sparse_depths import MIN_AGREEMENT
from scenefuse.photos.workspace import View, Workspace

# Points that a photo, or a click outside, is known by.
MIN_KNOWN_POINTS = 4


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
        denied: sparse points that each click outside says not to be the object's, the nearest to it first.
        only: whether no clicked photo has a better mask: then it counts although it contradicts some clicks.
    """

    mask: Mask
    quality: float
    agreement: float
    rows: NDArray[np.int64]
    inside: NDArray[np.bool_]
    clicks: PhotoClicks
    denied: list[NDArray[np.int64]] = field(default_factory=list)
    only: bool = False

    @property
    def can_vote(self) -> bool:
        """Whether it counts."""
        return self.quality > 0 and (self.only or self.agreement >= MIN_AGREEMENT)

    @property
    def final(self) -> bool:
        """Whether it is what a person clicked, which no other photo overrules."""
        return self.can_vote and self.clicks.enough

    @cached_property
    def extent(self) -> float:
        """Diagonal of the mask's box in pixels; 0 where the mask does not end before the photo does."""
        if not is_whole(self.mask):
            return 0.0
        rows, columns = (np.flatnonzero(self.mask.any(axis)) for axis in (1, 0))
        return float(np.hypot(np.ptp(rows), np.ptp(columns)))


def voter_of(photos: Workspace, k: int, mask: Mask, quality: float, agreement: float, clicks: PhotoClicks) -> Voter:
    """What a photo's mask says of the points that the photo sees, but for those next to its outline."""
    u, v = pixel_of(photos.seen_at[k], mask)
    band = POINT_RADIUS_SHARE * max(mask.shape)
    sure = (distance_to(mask) + distance_to(~mask))[v, u] > band if len(u) else np.zeros(0, dtype=bool)
    return Voter(
        mask, quality, agreement, photos.seen[k][sure], mask[v, u][sure], clicks, _denied(photos, k, mask, clicks)
    )


def _denied(photos: Workspace, k: int, mask: Mask, clicks: PhotoClicks) -> list[NDArray[np.int64]]:
    """Rows of the few points nearest to each click outside that are nearer to it than to the mask (H, W)."""
    rows, at = photos.seen[k], photos.seen_at[k]
    u, v = pixel_of(at, mask)
    away, denied = distance_to(mask)[v, u], []
    for click in clicks.off:
        off = np.linalg.norm(at - click, axis=1)
        near = np.argsort(off, kind="stable")[:MIN_KNOWN_POINTS]
        denied.append(rows[near[off[near] < away[near]]])
    return denied


def points_held(photos: Workspace, k: int, mask: Mask) -> NDArray[np.int64]:
    """Rows of the points that a photo sees in a mask (H, W) of it."""
    u, v = pixel_of(photos.seen_at[k], mask)
    return photos.seen[k][mask[v, u]]


def vote_shares(photos: Workspace, made: dict[int, Voter]) -> Array:
    """(P,) share of the votes that are for the object, per sparse point, weighted by quality; NaN without votes."""
    votes, total = np.zeros(len(photos.points)), np.zeros(len(photos.points))
    for voter in made.values():
        if voter.can_vote:
            np.add.at(total, voter.rows, voter.quality)
            np.add.at(votes, voter.rows, voter.quality * voter.inside)
    with np.errstate(invalid="ignore"):
        return votes / total


def _largest(views: list[View], extents: list[float], middle: Array) -> float:
    """How large an object can be: as the largest of its masks that are whole, of these extents in pixels, at the depth
    of its middle (3,), in its unit; infinite where few photos show it whole."""
    whole = [(view, extent) for view, extent in zip(views, extents) if extent]
    if len(whole) < MIN_WHOLE_SHARE * len(views):
        return np.inf
    sizes = [view.project(middle[None])[1][0] * extent / view.intrinsics[0, 0] for view, extent in whole]
    return float(max(sizes, default=np.inf))


def known_points(photos: Workspace, made: dict[int, Voter]) -> NDArray[np.int8]:
    """(P,) 1 for sparse points known to be the object's, -1 for those known not to be, 0 for all others.

    A first mask that lacks a part (a wall in the shade) would have all others leave it out. So within the convex
    hull of the object's points no mask says that a point is not on it. Points by stereo are known to be the object's,
    or unknown: they are dense, so a part is full of them, and so is what lies between the object's parts. A click
    outside overrules all of this. What is farther from the object's middle than it is large is unknown: neighbouring
    masks that hold the trees behind it all vote for these, and other photos do not see them.
    """
    share = vote_shares(photos, made)
    known = np.where(share >= MIN_AGREEMENT, 1, np.where(share <= 1 - MIN_AGREEMENT, -1, 0)).astype(np.int8)
    rows = [voter.rows for voter in made.values() if voter.can_vote]
    counts = np.bincount(np.concatenate([np.zeros(0, np.int64), *rows]), minlength=len(known))
    shown = [k for k, voter in made.items() if voter.can_vote]
    votes, own = np.flatnonzero(known > 0), photos.points[(known > 0) & (counts >= CONFIRMING_PHOTOS)]
    if len(shown) >= CONFIRMING_PHOTOS and len(own) >= MIN_OWN_POINTS:
        middle = np.median(own, axis=0)
        largest = _largest([photos.views[k] for k in shown], [made[k].extent for k in shown], middle)
        near = votes[np.linalg.norm(photos.points[votes] - middle, axis=1) <= largest]
        known[votes] = 0
        known[near] = 1
    own = without_outermost(photos.points[(known > 0) & (counts >= CONFIRMING_PHOTOS)])
    if len(own) >= MIN_OWN_POINTS:
        with suppress(QhullError):  # of points in a plane, which enclose nothing
            known[(known < 0) & in_hull(photos.points, own)] = 0
    by_stereo = np.arange(len(known)) >= len(known) - photos.by_stereo
    known[by_stereo & (known < 0)] = 0
    for voter in made.values():
        for near in voter.denied if voter.can_vote else []:
            known[near] = -1
    return known


def settled_points(photos: Workspace, made: dict[int, Voter]) -> NDArray[np.int8]:
    """The same of points on which three photos vote, where so many do; 0 for all others."""
    kind, rows = known_points(photos, made), [voter.rows for voter in made.values() if voter.can_vote]
    counts = np.bincount(np.concatenate([np.zeros(0, np.int64), *rows]), minlength=len(kind))
    kind[counts < min(CONFIRMING_PHOTOS, len(rows))] = 0
    return kind


def known_pixels(photos: Workspace, k: int, others: dict[int, Voter]) -> Prompts:
    """What the others say of a photo's points: by their votes, and by their clicks outside, each of which is a click in
    this photo, too, at the nearest of its points that this photo sees."""
    kind, at = known_points(photos, others)[photos.seen[k]], photos.seen_at[k]
    place = dict(zip(photos.seen[k].tolist(), at))
    denied = (near for voter in others.values() if voter.can_vote for near in voter.denied)
    off = [next((place[row] for row in near.tolist() if row in place), None) for near in denied]
    clicked_off = np.array([pixel for pixel in off if pixel is not None]).reshape(-1, 2)
    return Prompts(clicked_off=clicked_off, known=at[kind > 0], known_off=at[kind < 0])


def agrees_with_others(photos: Workspace, k: int, mask: Mask, others: dict[int, Voter], measure: Measure) -> bool:
    """Whether a mask (H, W) agrees with the votes of the others; so it does where these know nothing of its photo."""
    return measure(mask, known_pixels(photos, k, others), 0) >= MIN_AGREEMENT


def points_in_masks(photos: Workspace, masks: list[Mask]) -> Array:
    """(N, 3) sparse points that lie in the masks (H, W) of photos with RGB pixels wherever they are seen, without the
    outermost; where an object has hardly a feature, points by coarse stereo too.

    Raises:
        StageError: there are fewer than ten of them.
    """
    own = in_masks(photos, masks)
    if len(own) < MIN_OWN_POINTS:
        # It loads PyTorch, which the page to click in does without.
        from scenefuse.mvs.stereo_points import with_stereo_points

        own = in_masks(with_stereo_points(photos), masks)
    if len(own) < MIN_OWN_POINTS:
        raise StageError(
            f"only {len(own)} points, those by stereo included, lie in the supplied masks; "
            "are they white on the object, and of these photos?"
        )
    return without_outermost(own)


def in_masks(photos: Workspace, masks: list[Mask]) -> Array:
    """(N, 3) points that lie in nearly all of the masks (H, W) of the photos that see them."""
    seen, hit = np.zeros(len(photos.points)), np.zeros(len(photos.points))
    for rows, pixels, mask in zip(photos.seen, photos.seen_at, masks):
        u, v = pixel_of(pixels, mask)
        np.add.at(seen, rows, 1)
        np.add.at(hit, rows, mask[v, u])
    return photos.points[(seen >= 2) & (hit > MIN_AGREEMENT * seen)]


def spread_less_than_surroundings(photos: Workspace, masks: list[Mask]) -> bool:
    """Whether the sparse points in masks (H, W) lie nearer together than those off them, where there are both: an
    object's do, as its surroundings reach farther on all sides."""
    own, others = in_masks(photos, masks), in_masks(photos, [~mask for mask in masks])
    if min(len(own), len(others)) < MIN_OWN_POINTS:
        return False
    near, far = (np.median(np.linalg.norm(side - np.median(side, axis=0), axis=1)) for side in (own, others))
    return bool(near < far)
