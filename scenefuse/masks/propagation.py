"""Masks of all photos from a few clicks in one: the sparse points inside and outside its mask prompt the next photo."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask, mask_iou
from scenefuse.marks.photo_clicks import SUFFICIENT_CLICKS, PhotoClicks
from scenefuse.masks.grabcut import cleaned
from scenefuse.masks.parts import LEAST_KNOWN, Ask, agrees, own_colors, prompted_parts, with_parts
from scenefuse.masks.pixels import distance_to, held, pixel_of
from scenefuse.masks.space import Left, Space
from scenefuse.masks.votes import (
    LEAST_AGREEMENT,
    LEAST_QUALITY,
    LEAST_SPANNING,
    SURE,
    Known,
    Voter,
    agreement_of,
    known_pixels,
    known_points,
    near_most,
    shares_of,
    voter_of,
)
from scenefuse.photos.workspace import View, Workspace

QUALITY_WEIGHT = 0.3
"""Of a mask's quality beside its agreement, when one of several is chosen."""
CERTAIN, AS_GOOD = 0.9, 0.06
"""For several clicks alone, where the network is not certain of its best mask (a lower quality), the largest is taken
of those within so much of its score: who clicks on several parts means the whole. To a certain one a loose space adds
only what looks like it."""
TIGHT = 0.7
"""IoU of a mask with the space from which this is tight: true masks have 0.75 where a ring of photos bounds it."""
FILL_WEIGHT = 0.5
"""Of how well it fills the space that the others leave, likewise."""
CROWD, CROWDED = 4, 3.0
"""A point that two photos vote for has so many others within so many times the distance that they mostly have."""
SAME = 0.9
"""IoU from which two masks are the same but for their seams, of which the space says nothing: it is coarse."""

NO_CLICKS = PhotoClicks(np.zeros((0, 2)), np.zeros(0, dtype=bool))


@dataclass(frozen=True)
class Carried:
    """What became of the clicks.

    Attributes:
        masks: (H, W) per photo, empty where none was good enough.
        reasons: why a photo's mask is not good enough, by the photo's name.
        kind: (P,) per sparse point, 1 on the object, -1 not on it, 0 unknown.
        ends: (E, 3) points on the object that two photos alone vote for: they say how far it reaches.
        left_out: the clicks that contradict their mask, a sentence each.
        clicked: the others, by row of the photo.
    """

    masks: list[Mask]
    reasons: dict[str, str]
    kind: NDArray[np.int8]
    ends: Array
    left_out: list[str]
    clicked: dict[int, PhotoClicks]


def carry(ask: Ask, photos: Workspace, clicked: dict[int, PhotoClicks], tolerance_px: float) -> Carried:
    """Masks of all photos from clicks in one or more of them (method K1).

    Photos with three clicks or a box come first, those with most clicks before. Then always the photo that sees most
    points known to be the object's, so that the masks go round the object both ways; one with clicks is prompted by
    these too. A mask of
    low quality, or one that contradicts what prompted it, does not vote. All that do not, or that the others
    contradict in the end, are made once more from the votes of all others; all get the parts that they lack by these.

    Args:
        ask: the method: SAM 2 or GrabCut.
        photos: views with RGB pixels, sparse points and who observes them.
        clicked: clicks by row of the photo.
        tolerance_px: a click this far on the wrong side of its mask's outline is no contradiction.

    Raises:
        StageError: no photo has a good mask from its own clicks.
    """
    made: dict[int, Voter] = {}
    left_out: dict[int, list[str]] = {}
    left, space = list(range(len(photos.views))), Space(photos)
    while (k := _next(photos, made, left, clicked)) is not None:
        left.remove(k)
        made[k], left_out[k] = _make(ask, photos, k, clicked.get(k, NO_CLICKS), made, tolerance_px, space.left(k, made))
        _tell(photos.views[k].name, made[k])
    if not any(voter.votes for voter in made.values()):
        _refuse(photos, made, left_out)
    for k in range(len(photos.views)):
        others = {row: voter for row, voter in made.items() if row != k}
        if k not in made or not made[k].votes or agreement_of(photos, k, made[k].mask, others) < LEAST_AGREEMENT:
            made[k], left_out[k] = _make(
                ask, photos, k, clicked.get(k, NO_CLICKS), others, tolerance_px, space.left(k, made)
            )
            _tell(f"{photos.views[k].name} again", made[k])
    for k in [k for k in range(len(photos.views)) if made[k].votes]:
        others = {row: voter for row, voter in made.items() if row != k}
        made[k] = _extended(ask, photos, k, made[k], others, tolerance_px)
    return _carried(photos, made, [note for _, notes in sorted(left_out.items()) for note in notes])


def _next(photos: Workspace, made: dict[int, Voter], left: list[int], clicked: dict[int, PhotoClicks]) -> int | None:
    """Whose turn it is: a photo with clicks enough for a mask of its own; else the one of which most is known, one with
    clicks before the others; else one with fewer clicks; None where nothing says what the object is."""
    shares = shares_of(photos, made)
    known = {k: int((shares[photos.seen[k]] >= SURE).sum()) for k in left}
    told = [k for k in left if known[k] >= LEAST_KNOWN]
    alone = [k for k in left if k in clicked and clicked[k].enough]
    if told and not alone:
        return max(told, key=lambda k: (k in clicked, known[k]))
    some = [k for k in left if k in clicked and clicked[k].prompt]
    return max(alone or some, key=lambda k: len(clicked[k].pixels), default=None)


def one_photo(ask: Ask, view: View, clicks: PhotoClicks, tolerance_px: float) -> tuple[Mask, float, float, list[str]]:
    """The mask (H, W) of a photo from its own clicks alone, with which `carry` begins; its quality, its agreement with
    the clicks, and the clicks that contradict it, a sentence each. Arguments as of `carry`; the view has RGB pixels."""
    nothing = np.zeros((0, 3)), [np.zeros(0, dtype=np.int64)], [np.zeros((0, 2))]
    voter, left_out = _make(ask, Workspace(Path(), [view], *nothing), 0, clicks, {}, tolerance_px, None)
    return voter.mask, voter.quality, voter.agreement, left_out


def _tell(name: str, voter: Voter) -> None:
    print(f"{name}: quality {voter.quality:.2f}, agreement {voter.agreement:.2f}", flush=True)


def _make(
    ask: Ask,
    photos: Workspace,
    k: int,
    clicks: PhotoClicks,
    others: dict[int, Voter],
    tolerance_px: float,
    space: Left | None,
) -> tuple[Voter, list[str]]:
    """A photo's mask from its clicks, the others' votes and the space that they leave; and the clicks left out as they
    contradict it."""
    known = known_pixels(photos, k, others)
    keep, view = np.ones(len(clicks.pixels), dtype=bool), photos.views[k]
    notes: list[str] = []
    voter = voter_of(photos, k, np.zeros((view.height, view.width), dtype=bool), 0.0, 0.0, NO_CLICKS)
    for _ in range(2):
        kept = clicks.only(keep)
        if len(known.inside) < LEAST_KNOWN and not kept.prompt:
            break
        found = best_mask(ask, view, kept, known, clicks.box, tolerance_px, space)
        voter = voter_of(photos, k, *found, kept)
        wrong = keep & ~_agreeing(voter.mask, clicks, tolerance_px)
        if not wrong.any():
            break
        x, y = pixel_of(clicks.pixels, voter.mask)
        miss = np.where(clicks.inside, distance_to(voter.mask)[y, x], distance_to(~voter.mask)[y, x])
        notes += [
            f"{clicks.named(int(row))} in {view.name} is {miss[row]:.0f} px on the wrong side of its mask's outline"
            for row in np.flatnonzero(wrong)
        ]
        keep &= ~wrong
    return voter, notes


def _agreeing(mask: Mask, clicks: PhotoClicks, tolerance_px: float) -> NDArray[np.bool_]:
    """(N,) which clicks are on their side of a mask's outline, or no farther off than the tolerance."""
    return np.where(clicks.inside, held(mask, clicks.pixels, tolerance_px), held(~mask, clicks.pixels, tolerance_px))


def _extended(
    ask: Ask, photos: Workspace, k: int, voter: Voter, others: dict[int, Voter], tolerance_px: float
) -> Voter:
    """A photo's mask with the parts that it lacks by the votes of all others."""
    known = known_pixels(photos, k, others)
    inside, outside = (voter.clicks.on, known.inside), (voter.clicks.off, known.outside)
    mask = with_parts(ask, photos.views[k], voter.mask, inside, outside, known.enclosed, tolerance_px)
    if (mask == voter.mask).all():
        return voter
    print(f"{photos.views[k].name}: {mask.sum() / voter.mask.sum() - 1:.1%} added", flush=True)
    return voter_of(photos, k, mask, voter.quality, agrees(mask, inside, outside, tolerance_px), voter.clicks)


def best_mask(
    ask: Ask,
    view: View,
    clicks: PhotoClicks,
    known: Known,
    box: Array | None,
    tolerance_px: float,
    space: Left | None,
) -> tuple[Mask, float, float]:
    """The best of the masks for pixels clicked and carried on, without parts that hold none (method K1).

    For several clicks alone the largest of those about as good, if the method is certain of none.
    The space that other photos leave bounds what has no sparse points. Its box prompts once more, and of all masks one
    is taken that agrees as well, fills the space better and is not beyond it; but not for another seam alone, nor
    where the network is certain of the best one and colours speak against what is added.

    Args:
        ask: the method: SAM 2 or GrabCut.
        view: the photo, with RGB pixels.
        clicks: its own.
        known: pixels of points that other photos' masks tell.
        box: (2, 2) corners of a box that was drawn, or None.
        tolerance_px: a click this far on the wrong side of a mask's outline is no contradiction.
        space: that the masks of other photos leave, or None.

    Returns:
        The mask (H, W); its quality as the method judges it, 0 where it is empty; its agreement with what prompts it.
    """
    inside, outside = (clicks.on, known.inside), (clicks.off, known.outside)
    found = _candidates(ask(view, inside, outside, box, None), view.pixels, inside, outside, tolerance_px)
    best = max(found, key=lambda one: one.score)
    if not len(known.inside) and len(clicks.on) >= SUFFICIENT_CLICKS and best.quality < CERTAIN:
        best = max((one for one in found if one.score > best.score - AS_GOOD), key=lambda one: one.mask.sum())
    if space is not None and box is None:
        more = ask(view, inside, outside, None, space.box)
        found += _candidates(more, view.pixels, inside, outside, tolerance_px)
        other = max(found, key=lambda one: one.score + FILL_WEIGHT * space.filled(one.mask) - space.beyond(one.mask))
        if mask_iou(other.mask, best.mask) < SAME and _may_replace(best, other, view, space):
            best = other
    mask = with_parts(ask, view, best.mask, inside, outside, known.enclosed, tolerance_px)
    return mask, best.quality * bool(mask.any()), agrees(mask, inside, outside, tolerance_px)


class _Candidate(NamedTuple):
    """A mask (H, W), its quality, and how good it is by this and its agreement with what prompts it."""

    mask: Mask
    quality: float
    score: float


def _may_replace(best: _Candidate, other: _Candidate, view: View, space: Left) -> bool:
    """Whether a mask that the space prefers may stand for the best one by its prompts.

    Of a side that few photos show, a loose space holds much of what is around the object. So to a mask that the
    network is certain of it adds only what looks, on the whole, more like this one than like what is around.
    """
    if best.quality < CERTAIN or space.filled(other.mask) > TIGHT:
        return True
    if mask_iou(best.mask, best.mask | other.mask) >= SAME:
        return True
    return own_colors(view.pixels, best.mask, other.mask & ~best.mask) > 0


def _candidates(
    asked: tuple[list[Mask], Array],
    image: NDArray[np.uint8],
    inside: tuple[Array, Array],
    outside: tuple[Array, Array],
    tolerance_px: float,
) -> list[_Candidate]:
    """What a method answers, without specks and parts that nothing prompts."""
    on, off = np.concatenate(inside), np.concatenate(outside)
    masks = [prompted_parts(cleaned(mask, image), on, off) for mask in asked[0]]
    return [
        _Candidate(
            m, float(q), agrees(m, inside, outside, tolerance_px) + QUALITY_WEIGHT * float(q) - 2 * (not m.any())
        )
        for m, q in zip(masks, asked[1])
    ]


def _refuse(photos: Workspace, made: dict[int, Voter], left_out: dict[int, list[str]]) -> None:
    """Say why no photo has a mask to begin with."""
    about = "; ".join(
        f"{photos.views[k].name}: quality {voter.quality:.2f} (least {LEAST_QUALITY}), agreement with the clicks"
        f" {voter.agreement:.2f} (least {LEAST_AGREEMENT})"
        for k, voter in made.items()
    )
    wrong = "".join(f"; {note}" for notes in left_out.values() for note in notes)
    raise StageError(f"no clicked photo has a good mask from its clicks ({about}{wrong}); correct or add clicks")


def _carried(photos: Workspace, made: dict[int, Voter], left_out: list[str]) -> Carried:
    """Masks that vote, empty ones for the other photos, and what they say of each point seen in three photos."""
    reasons, masks = {}, []
    for k, view in enumerate(photos.views):
        masks.append(made[k].mask if made[k].votes else np.zeros((view.height, view.width), dtype=bool))
        if not made[k].votes:
            reasons[view.name] = (
                f"the mask from the clicks has quality {made[k].quality:.2f} (least {LEAST_QUALITY}) and agrees with"
                f" {made[k].agreement:.2f} of its prompts (least {LEAST_AGREEMENT})"
            )
    counts = np.bincount(np.concatenate([v.rows for v in made.values() if v.votes]), minlength=len(photos.points))
    kind, _ = known_points(photos, made)
    ends = _ends(photos.points[(kind > 0) & (counts >= 3)], photos.points[(kind > 0) & (counts == 2)])
    kind[counts < 3] = 0
    clicked = {k: voter.clicks for k, voter in made.items() if voter.clicks is not NO_CLICKS}
    return Carried(masks, reasons, kind, ends, left_out, clicked)


def _ends(sure: Array, others: Array) -> Array:
    """Of points (N, 3) that two photos vote for those near which many of these or of the sure ones (M, 3) lie: the ends
    of what is photographed in passing are in two photos only; a mismatched point stands alone."""
    own = np.concatenate([sure, others])
    if len(sure) < LEAST_SPANNING or not len(others):
        return others[:0]
    others = others[near_most(others, sure)]
    away, usual = (cKDTree(own).query(points, CROWD + 1)[0][:, CROWD] for points in (others, sure))
    return others[away <= CROWDED * np.median(usual)]
