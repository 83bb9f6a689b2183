"""Masks of all photos from a few clicks in one: the sparse points inside and outside its mask prompt the next photo."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from scenefuse.masks.clicks import PhotoClicks
from scenefuse.masks.grabcut import cleaned
from scenefuse.mvs.visual_hull import Mask
from scenefuse.stage import StageError
from scenefuse.transforms import Array
from scenefuse.workspace import View, Workspace

LEAST_QUALITY = 0.5
"""Quality of a mask, as its method judges it, below which it does not vote: the network's own was 0.44 to 0.77 for the
bronze statue's good masks, and is below 0.3 for most bad ones."""
LEAST_AGREEMENT = 0.8
"""Share of the points known to be inside that a mask has to hold, less the share of those outside it holds."""
SURE = 0.8
"""Share of a point's votes for one side from which it counts for that side."""
LEAST_KNOWN = 4
"""Points known to be on the object that a photo has to see to be prompted by them."""
NEIGHBOURS = 7
"""A known point prompts where most of so many known points around it in the photo say the same: it may be mismatched,
and it is hidden points' neighbours that differ."""
EDGE = 0.003
"""Half width of the band along a mask's outline in which no point votes, as a share of the photo's longer side."""
QUALITY_WEIGHT = 0.3
"""Of a mask's quality beside its agreement, when one of several is chosen."""

NO_CLICKS = PhotoClicks(np.zeros((0, 2)), np.zeros(0, dtype=bool))

Ask = Callable[[View, tuple[Array, Array], tuple[Array, Array], Array | None], tuple[list[Mask], Array]]
"""Masks (H, W) of a photo with RGB pixels and their qualities, from pixels on the object, pixels off it, each (N, 2)
clicked and (M, 2) carried on, and a box (2, 2) or None."""


@dataclass(frozen=True)
class Carried:
    """What became of the clicks.

    Attributes:
        masks: (H, W) per photo, empty where none was good enough.
        reasons: why a photo's mask is not good enough, by the photo's name.
        kind: (P,) per sparse point, 1 on the object, -1 not on it, 0 unknown.
        left_out: the clicks that contradict their mask, a sentence each.
        clicked: the others, by row of the photo.
    """

    masks: list[Mask]
    reasons: dict[str, str]
    kind: NDArray[np.int8]
    left_out: list[str]
    clicked: dict[int, PhotoClicks]


@dataclass
class _Voter:
    """A photo's mask, the clicks that it agrees with, and what it says of the sparse points that the photo sees."""

    mask: Mask
    quality: float
    agreement: float
    rows: NDArray[np.int64]
    inside: NDArray[np.bool_]
    clicks: PhotoClicks

    @property
    def votes(self) -> bool:
        return self.quality >= LEAST_QUALITY and self.agreement >= LEAST_AGREEMENT


def carry(ask: Ask, photos: Workspace, clicked: dict[int, PhotoClicks], tolerance_px: float) -> Carried:
    """Masks of all photos from clicks in one or more of them (method K1).

    The photo with most clicks comes first. Then always the photo that sees most points known to be the object's, so
    that the masks go round the object both ways; a photo with clicks of its own is prompted by these too. A mask of
    low quality, or one that contradicts what prompted it, does not vote. All that do not, or that the others
    contradict in the end, are made once more from the votes of all others.

    Args:
        ask: the method: SAM 2 or GrabCut.
        photos: views with RGB pixels, sparse points and who observes them.
        clicked: clicks by row of the photo.
        tolerance_px: a click this far on the wrong side of its mask's outline is no contradiction.

    Raises:
        StageError: no photo has a good mask from its own clicks.
    """
    made: dict[int, _Voter] = {}
    left_out: dict[int, list[str]] = {}
    left = list(range(len(photos.views)))
    while left:
        shares = _shares(photos, made)
        known = [int((shares[photos.seen[k]] >= SURE).sum()) for k in left]
        k = left[int(np.argmax(known))]
        if max(known) < LEAST_KNOWN:
            own = [row for row in left if row in clicked and clicked[row].prompt]
            if not own:
                break
            k = max(own, key=lambda row: len(clicked[row].pixels))
        left.remove(k)
        made[k], left_out[k] = _make(ask, photos, k, clicked.get(k, NO_CLICKS), made, tolerance_px)
        print(f"{photos.views[k].name}: quality {made[k].quality:.2f}, agreement {made[k].agreement:.2f}", flush=True)
    if not any(voter.votes for voter in made.values()):
        _refuse(photos, made, left_out)
    for k in range(len(photos.views)):
        others = {row: voter for row, voter in made.items() if row != k}
        if k in made and made[k].votes and _agreement(photos, k, made[k].mask, others) >= LEAST_AGREEMENT:
            continue
        made[k], left_out[k] = _make(ask, photos, k, clicked.get(k, NO_CLICKS), others, tolerance_px)
        voter = made[k]
        print(f"{photos.views[k].name} again: quality {voter.quality:.2f}, agreement {voter.agreement:.2f}", flush=True)
    return _carried(photos, made, [note for _, notes in sorted(left_out.items()) for note in notes])


def one_photo(ask: Ask, view: View, clicks: PhotoClicks, tolerance_px: float) -> tuple[Mask, float, float, list[str]]:
    """The mask (H, W) of a photo from its own clicks alone, with which `carry` begins; its quality, its agreement with
    the clicks, and the clicks that contradict it, a sentence each. Arguments as of `carry`; the view has RGB pixels."""
    nothing = np.zeros((0, 3)), [np.zeros(0, dtype=np.int64)], [np.zeros((0, 2))]
    voter, left_out = _make(ask, Workspace(Path(), [view], *nothing), 0, clicks, {}, tolerance_px)
    return voter.mask, voter.quality, voter.agreement, left_out


def _make(
    ask: Ask, photos: Workspace, k: int, clicks: PhotoClicks, others: dict[int, _Voter], tolerance_px: float
) -> tuple[_Voter, list[str]]:
    """A photo's mask from its clicks and the others' votes, and the clicks left out as they contradict it."""
    inside, outside = _known(photos, k, others)
    keep, view = np.ones(len(clicks.pixels), dtype=bool), photos.views[k]
    notes: list[str] = []
    voter = _voter(photos, k, np.zeros((view.height, view.width), dtype=bool), 0.0, 0.0, NO_CLICKS)
    for _ in range(2):
        kept = clicks.only(keep)
        if len(inside) < LEAST_KNOWN and not kept.prompt:
            break
        found = _asked(ask, view, (kept.on, inside), (kept.off, outside), clicks.box, tolerance_px)
        voter = _voter(photos, k, *found, kept)
        x, y = _pixel(clicks.pixels, voter.mask)
        miss = np.where(clicks.inside, _distance(voter.mask)[y, x], _distance(~voter.mask)[y, x])
        wrong = keep & (miss > tolerance_px)
        if not wrong.any():
            break
        notes += [
            f"the click {'inside' if clicks.inside[row] else 'outside'} at ({x[row]}, {y[row]}) of the undistorted"
            f" {view.name} is {miss[row]:.0f} px on the wrong side of its mask's outline"
            for row in np.flatnonzero(wrong)
        ]
        keep &= ~wrong
    return voter, notes


def _asked(
    ask: Ask,
    view: View,
    inside: tuple[Array, Array],
    outside: tuple[Array, Array],
    box: Array | None,
    tolerance_px: float,
) -> tuple[Mask, float, float]:
    """The best of the masks for pixels clicked and carried on, without parts that hold none; quality, agreement."""
    masks, quality = ask(view, inside, outside, box)
    on, off = np.concatenate(inside), np.concatenate(outside)
    masks = [prompted_parts(cleaned(mask), on, off) for mask in masks]
    agreement = []
    for mask in masks:
        held = np.concatenate([_held(mask, inside[0], tolerance_px), _held(mask, inside[1], 0)])
        spared = np.concatenate([_held(~mask, outside[0], tolerance_px), _held(~mask, outside[1], 0)])
        agreement.append((held.mean() if len(held) else 1.0) - ((~spared).mean() if len(spared) else 0.0))
    best = int(np.argmax([a + QUALITY_WEIGHT * q - 2 * (not m.any()) for m, a, q in zip(masks, agreement, quality)]))
    return masks[best], float(quality[best]) * bool(masks[best].any()), float(agreement[best])


def _held(mask: Mask, pixels: Array, tolerance_px: float) -> NDArray[np.bool_]:
    """(N,) whether (N, 2) pixels lie in a mask, or no farther off it than the tolerance."""
    u, v = _pixel(pixels, mask)
    return mask[v, u] if tolerance_px == 0 or not len(pixels) else _distance(mask)[v, u] <= tolerance_px


def _voter(photos: Workspace, k: int, mask: Mask, quality: float, agreement: float, clicks: PhotoClicks) -> _Voter:
    """What a photo's mask says of the points that the photo sees, but for those next to its outline."""
    u, v = _pixel(photos.seen_at[k], mask)
    sure = (_distance(mask) + _distance(~mask))[v, u] > EDGE * max(mask.shape)
    return _Voter(mask, quality, agreement, photos.seen[k][sure], mask[v, u][sure], clicks)


def _shares(photos: Workspace, made: dict[int, _Voter]) -> Array:
    """(P,) share of the votes that are for the object, per sparse point; NaN where nobody votes."""
    votes, total = np.zeros(len(photos.points)), np.zeros(len(photos.points))
    for voter in made.values():
        if voter.votes:
            np.add.at(total, voter.rows, voter.quality)
            np.add.at(votes, voter.rows, voter.quality * voter.inside)
    with np.errstate(invalid="ignore"):
        return votes / total


def _known(photos: Workspace, k: int, others: dict[int, _Voter]) -> tuple[Array, Array]:
    """Pixels (N, 2) of a photo's points on the object and (M, 2) of those off it, by the votes of the others; those
    clicked in the others, where this photo has them in its frame: what hides them is mostly the object."""
    share = _shares(photos, others)[photos.seen[k]]
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


def _agreement(photos: Workspace, k: int, mask: Mask, others: dict[int, _Voter]) -> float:
    """How well a mask agrees with the votes of the others, at most 1; 1 where these know nothing of its photo."""
    inside, outside = _known(photos, k, others)
    return _share(mask, inside, 1.0) - _share(mask, outside, 0.0)


def _share(mask: Mask, pixels: Array, of_none: float) -> float:
    """Share of (N, 2) pixels that a mask holds."""
    u, v = _pixel(pixels, mask)
    return float(mask[v, u].mean()) if len(pixels) else of_none


def _pixel(pixels: Array, mask: Mask) -> NDArray[np.intp]:
    """(2, N) column and row of (N, 2) pixels, inside the mask."""
    return np.clip(pixels.astype(np.intp), 0, np.array(mask.shape[::-1]) - 1).T


def _distance(mask: Mask) -> Array:
    """(H, W) distance of the pixels off a mask to it, 0 on it; far away where it is empty."""
    return ndimage.distance_transform_edt(~mask) if mask.any() else np.full(mask.shape, float(max(mask.shape)))


def prompted_parts(mask: Mask, inside: Array, outside: Array) -> Mask:
    """The connected parts of a mask (H, W) that hold one of (N, 2) pixels inside, and not as many of (M, 2) outside;
    all of it where no pixel inside is known."""
    labels, count = ndimage.label(mask)
    if not count or not len(inside):
        return mask
    on, off = (np.bincount(labels[v, u], minlength=count + 1) for u, v in (_pixel(p, mask) for p in (inside, outside)))
    wanted = on > off
    wanted[0] = False
    return wanted[labels]


def _refuse(photos: Workspace, made: dict[int, _Voter], left_out: dict[int, list[str]]) -> None:
    """Say why no photo has a mask to begin with."""
    about = "; ".join(
        f"{photos.views[k].name}: quality {voter.quality:.2f} (least {LEAST_QUALITY}), agreement with the clicks"
        f" {voter.agreement:.2f} (least {LEAST_AGREEMENT})"
        for k, voter in made.items()
    )
    wrong = "".join(f"; {note}" for notes in left_out.values() for note in notes)
    raise StageError(f"no clicked photo has a good mask from its clicks ({about}{wrong}); correct or add clicks")


def _carried(photos: Workspace, made: dict[int, _Voter], left_out: list[str]) -> Carried:
    """Masks that vote, empty ones for the other photos, and what they say of each point seen in three photos."""
    reasons, masks = {}, []
    for k, view in enumerate(photos.views):
        masks.append(made[k].mask if made[k].votes else np.zeros((view.height, view.width), dtype=bool))
        if not made[k].votes:
            reasons[view.name] = (
                f"the mask from the clicks has quality {made[k].quality:.2f} (least {LEAST_QUALITY}) and agrees with"
                f" {made[k].agreement:.2f} of its prompts (least {LEAST_AGREEMENT})"
            )
    shares = _shares(photos, made)
    counts = np.bincount(np.concatenate([v.rows for v in made.values() if v.votes]), minlength=len(photos.points))
    kind = np.where(shares >= SURE, 1, np.where(shares <= 1 - SURE, -1, 0)).astype(np.int8)
    kind[counts < 3] = 0
    return Carried(
        masks, reasons, kind, left_out, {k: voter.clicks for k, voter in made.items() if voter.clicks is not NO_CLICKS}
    )
