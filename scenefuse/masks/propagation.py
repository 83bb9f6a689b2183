"""Masks of all photos from a few clicks in one: the sparse points inside and outside its mask prompt the next photo."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask
from scenefuse.marks.photo_clicks import SUFFICIENT_CLICKS, PhotoClicks
from scenefuse.masks.grabcut import cleaned
from scenefuse.masks.prompts import (
    OUTLINE_BAND_SHARE,
    Measure,
    Prompts,
    Segmenter,
    agreement,
    distance_to,
    held,
    pixel_of,
    prompted_parts,
)
from scenefuse.masks.votes import (
    MIN_AGREEMENT,
    MIN_KNOWN_POINTS,
    Voter,
    agrees_with_others,
    known_pixels,
    settled_points,
    vote_shares,
    voter_of,
)
from scenefuse.photos.workspace import View, Workspace

# Weight of a mask's quality beside its agreement, when one of several is chosen.
QUALITY_WEIGHT = 0.3
# With only several clicks, and no mask of this quality, the largest mask is taken whose score is within this margin:
# whoever clicks several parts means the whole.
CERTAIN_QUALITY, SCORE_MARGIN = 0.9, 0.06

NO_CLICKS = PhotoClicks()


@dataclass(frozen=True)
class Propagated:
    """What the clicks lead to.

    Attributes:
        masks: (H, W) per photo, empty where none was good enough.
        reasons: why a photo's mask is not good enough, by the photo's name.
        kind: (P,) per sparse point, 1 on the object, -1 not on it, 0 unknown.
        left_out: the clicks that contradict their mask, a sentence each.
        clicked: the others, by row of the photo.
        quality: of each photo's mask by the segmenter's own estimate, by the photo's name.
        notes: what a person should know of the clicks, a sentence each.
    """

    masks: list[Mask]
    reasons: dict[str, str]
    kind: NDArray[np.int8]
    left_out: list[str]
    clicked: dict[int, PhotoClicks]
    quality: dict[str, float]
    notes: list[str]


def propagate(
    segment: Segmenter,
    photos: Workspace,
    clicked: dict[int, PhotoClicks],
    tolerance_px: float,
    measure: Measure = agreement,
) -> Propagated:
    """Masks of all photos from clicks in one or more of them (method K1).

    Photos with three clicks or a box come first, those with most clicks before. Then always the photo that sees most
    points known to be the object's, so that the masks go round the object both ways; one with clicks is prompted by
    these too. A mask that contradicts what prompted it does not vote. Masks that do not vote, or that the others
    contradict in the end, are made once more from the others' votes; three clicks or a box are never overruled.

    Args:
        segment: SAM 2 or GrabCut.
        photos: views with RGB pixels, sparse points and who observes them.
        clicked: clicks by row of the photo.
        tolerance_px: a click this far on the wrong side of its mask's outline is no contradiction.

    Raises:
        StageError: no photo has a mask that holds clicks in it.
    """
    made: dict[int, Voter] = {}
    left_out: dict[int, list[str]] = {}
    notes: list[str] = []

    def make(k: int, note: str = "") -> None:
        others = {row: voter for row, voter in made.items() if row != k}
        made[k], left_out[k] = _make(segment, photos, k, clicked.get(k, NO_CLICKS), others, tolerance_px, measure)
        name, voter = photos.views[k].name, made[k]
        print(f"{name}{note}: quality {voter.quality:.2f}, agreement {voter.agreement:.2f}", flush=True)

    def make_all() -> None:
        while (following := _next(photos, made, clicked)) is not None:
            make(following)

    make_all()
    if not any(voter.can_vote for voter in made.values()):
        best = max(made, key=lambda k: (made[k].quality > 0, made[k].agreement))
        if made[best].quality == 0 or made[best].agreement <= 0:
            _refuse(photos, made, left_out)
        made[best].only = True
        notes.append(
            f"the mask of {photos.views[best].name} agrees with {made[best].agreement:.2f} of its clicks, and is used"
            " since no clicked photo has a better one; look at it, and correct or add clicks"
        )
        make_all()
    for k in range(len(photos.views)):
        others = {row: voter for row, voter in made.items() if row != k}
        settled = k in made and made[k].can_vote and agrees_with_others(photos, k, made[k].mask, others, measure)
        if not settled and not (k in made and made[k].final):
            make(k, " again")
    for k, voter in made.items():
        notes += _doubts(photos.views[k].name, voter)
    return _propagated(photos, made, [said for _, some in sorted(left_out.items()) for said in some], notes)


def _doubts(name: str, voter: Voter) -> Iterator[str]:
    """What may be wrong with the mask of a photo's clicks, a sentence each."""
    labels = cv2.connectedComponents(voter.mask.astype(np.uint8))[1]
    u, v = pixel_of(voter.clicks.on, voter.mask)
    parts = len(set(labels[v, u].tolist()) - {0})
    if parts > 1:
        yield (
            f"the clicks inside in {name} lie on {parts} parts of its mask that do not touch: if they are several"
            " objects, delete the clicks on all but one"
        )
    if voter.final and np.mean(voter.mask) > 0.5:
        yield (
            f"the mask from the clicks in {name} covers {np.mean(voter.mask):.0%} of the photo: if it holds what is"
            " around the object, click outside there"
        )


def _next(photos: Workspace, made: dict[int, Voter], clicked: dict[int, PhotoClicks]) -> int | None:
    """The next photo: one with clicks enough for a mask of its own; else the one of which most is known, one with
    clicks before the others; else one with fewer clicks; None where nothing says what the object is."""
    left = [k for k in range(len(photos.views)) if k not in made]
    shares = vote_shares(photos, made)
    known = {k: int((shares[photos.seen[k]] >= MIN_AGREEMENT).sum()) for k in left}
    prompted = [k for k in left if known[k] >= MIN_KNOWN_POINTS]
    alone = [k for k in left if k in clicked and clicked[k].enough]
    if prompted and not alone:
        return max(prompted, key=lambda k: (k in clicked, known[k]))
    some = [k for k in left if k in clicked and clicked[k].prompt]
    return max(alone or some, key=lambda k: len(clicked[k].pixels), default=None)


def one_photo(
    segment: Segmenter, view: View, clicks: PhotoClicks, tolerance_px: float
) -> tuple[Mask, float, float, list[str]]:
    """The mask (H, W) of a photo from its own clicks alone, with which `propagate` begins; its quality, its agreement
    with the clicks, and the clicks that contradict it, a sentence each. Arguments as of `propagate`."""
    nothing = np.zeros((0, 3)), [np.zeros(0, dtype=np.int64)], [np.zeros((0, 2))]
    voter, left_out = _make(segment, Workspace(Path(), [view], *nothing), 0, clicks, {}, tolerance_px)
    return voter.mask, voter.quality, voter.agreement, left_out


def _make(
    segment: Segmenter,
    photos: Workspace,
    k: int,
    clicks: PhotoClicks,
    others: dict[int, Voter],
    tolerance_px: float,
    measure: Measure = agreement,
) -> tuple[Voter, list[str]]:
    """A photo's mask from its clicks and the others' votes; and the clicks left out as they contradict it.

    Three clicks inside, and those before them, prompt it together. A further one has it made again, with all clicks so
    far, where the mask does not hold it, and counts if the new mask holds more of these: it never spoils a mask that
    agrees with it.
    """
    known, view = known_pixels(photos, k, others), photos.views[k]
    notes: list[str] = []

    def mask_from(some: PhotoClicks) -> tuple[tuple[Mask, float, float], NDArray[np.bool_]]:
        made = np.zeros((view.height, view.width), dtype=bool), 0.0, 0.0
        if len(known.known) >= MIN_KNOWN_POINTS or some.prompt:
            prompts = known._replace(clicked=some.on, clicked_off=np.concatenate([some.off, known.clicked_off]))
            made = best_mask(segment, view, prompts, some.box, tolerance_px, measure)
        return made, _held_clicks(made[0], clicks, tolerance_px)

    used = np.asarray(np.cumsum(clicks.inside) - clicks.inside < SUFFICIENT_CLICKS)
    made, holds = mask_from(clicks.only(used))
    without = replace(clicks, box=None)
    if clicks.box is not None and without.enough and not holds.all():
        other, its = mask_from(without.only(used))
        if its.sum() > holds.sum():
            made, holds, clicks = other, its, without
            notes.append(f"the box in {view.name}: without it the mask holds more of the clicks")
    for row in np.flatnonzero(~used).tolist():
        used[row] = True
        if not holds[row]:
            other, its = mask_from(clicks.only(used))
            if its[: row + 1].sum() > holds[: row + 1].sum():
                made, holds = other, its
            else:
                used[row] = False
    if (used & ~holds).any():
        other, its = mask_from(clicks.only(used & holds))
        if its.sum() >= holds.sum():
            made, holds = other, its
    x, y = pixel_of(clicks.pixels, made[0])
    miss = np.where(clicks.inside, distance_to(made[0])[y, x], distance_to(~made[0])[y, x])
    notes += [
        f"{clicks.named(row)} in {view.name} is {miss[row]:.0f} px on the wrong side of its mask's outline"
        for row in np.flatnonzero(~holds).tolist()
    ]
    return voter_of(photos, k, *made, clicks.only(holds)), notes


def _held_clicks(mask: Mask, clicks: PhotoClicks, tolerance_px: float) -> NDArray[np.bool_]:
    """(N,) which clicks are on their side of a mask's outline, or no farther off than the tolerance."""
    return np.where(clicks.inside, held(mask, clicks.pixels, tolerance_px), held(~mask, clicks.pixels, tolerance_px))


def best_mask(
    segment: Segmenter,
    view: View,
    prompts: Prompts,
    box: Array | None,
    tolerance_px: float,
    measure: Measure = agreement,
) -> tuple[Mask, float, float]:
    """The best mask for prompts: without parts that hold none, with clicked parts that it lacks.

    A mask that agrees with more clicks is better, whatever its quality. For several clicks alone the largest of those
    about as good is taken, if the segmenter is certain of none.

    Args:
        segment: SAM 2 or GrabCut.
        view: the photo, with RGB pixels.
        prompts: its own clicks, and what is known from other photos' masks.
        box: (2, 2) corners of a box that was drawn, or None.
        tolerance_px: a click this far on the wrong side of a mask's outline is no contradiction.
        measure: of a mask's agreement with its prompts.

    Returns:
        The mask (H, W); its quality by the segmenter's own estimate, 0 where it is empty; its agreement.
    """
    clicks = Prompts(prompts.clicked, prompts.clicked_off)
    reach_px = max(tolerance_px, OUTLINE_BAND_SHARE * max(view.height, view.width))
    found: list[tuple[tuple[float, float], Mask, float]] = []
    for mask, quality in zip(*segment(view, prompts, box)):
        mask = prompted_parts(cleaned(mask, view.pixels), prompts.inside, prompts.outside)
        if mask.any():
            score = measure(mask, prompts, tolerance_px) + QUALITY_WEIGHT * float(quality)
            found.append(((agreement(mask, clicks, tolerance_px), score), mask, float(quality)))
    if not found:
        return np.zeros((view.height, view.width), dtype=bool), 0.0, 0.0
    rank, best, quality = max(found, key=lambda one: one[0])
    if not len(prompts.known) and len(prompts.clicked) >= SUFFICIENT_CLICKS and quality < CERTAIN_QUALITY:
        alike = [one for one in found if one[0][0] == rank[0] and one[0][1] > rank[1] - SCORE_MARGIN]
        _, best, quality = max(alike, key=lambda one: one[1].sum())
    mask = _with_clicked_parts(segment, view, best, prompts, reach_px)
    return mask, quality, measure(mask, prompts, tolerance_px)


def _with_clicked_parts(segment: Segmenter, view: View, mask: Mask, prompts: Prompts, reach_px: float) -> Mask:
    """A mask (H, W) with the parts that were clicked and that it lacks: prompted on several things, SAM 2 returns only
    the clearest. Each click alone prompts its part, which is no larger than the mask and holds no click outside."""
    whole = mask
    if held(mask, prompts.clicked, reach_px).any():
        for click in prompts.clicked[~held(mask, prompts.clicked, reach_px), None]:
            if held(whole, click, 0).all():
                continue
            masks, quality = segment(view, Prompts(click, prompts.clicked_off), None)
            for row in np.argsort(-quality):
                part = prompted_parts(cleaned(masks[row], view.pixels), click, prompts.clicked_off)
                if 0 < part.sum() <= mask.sum() and not held(part, prompts.clicked_off, 0).any():
                    whole = whole | part
                    break
    return whole


def _refuse(photos: Workspace, made: dict[int, Voter], left_out: dict[int, list[str]]) -> None:
    """Say why no photo has a mask to begin with."""
    about = "; ".join(
        f"{photos.views[k].name}: agreement with the clicks {voter.agreement:.2f} (least {MIN_AGREEMENT})"
        f"{'' if voter.quality else ', the mask empty or all of the photo'}"
        for k, voter in made.items()
    )
    wrong = "".join(f"; {note}" for notes in left_out.values() for note in notes)
    raise StageError(f"no clicked photo has a good mask from its clicks ({about}{wrong}); correct or add clicks")


def _propagated(photos: Workspace, made: dict[int, Voter], left_out: list[str], notes: list[str]) -> Propagated:
    """Masks that vote, empty ones for the other photos, and what they say of each point seen in three photos."""
    reasons, masks = {}, []
    for k, view in enumerate(photos.views):
        masks.append(made[k].mask if made[k].can_vote else np.zeros((view.height, view.width), dtype=bool))
        if not made[k].can_vote:
            reasons[view.name] = (
                f"the mask's agreement with its prompts is {made[k].agreement:.2f}, at least {MIN_AGREEMENT} is needed"
            )
    kind = settled_points(photos, made)
    clicked = {k: voter.clicks for k, voter in made.items() if voter.clicks is not NO_CLICKS}
    quality = {photos.views[k].name: voter.quality for k, voter in sorted(made.items())}
    return Propagated(masks, reasons, kind, left_out, clicked, quality, notes)
