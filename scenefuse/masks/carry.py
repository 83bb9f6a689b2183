"""Masks of all photos from a few clicks in one: the sparse points inside and outside its mask prompt the next photo."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse.csgraph import connected_components
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

PART_GAP = 0.05
"""Pixels that a mask lacks are of one part if they are this near each other, as a share of the photo's longer side."""

PART_AGREEMENT = 0.5
"""A mask that agrees less with what prompts it does not lack parts: it is another thing."""
PART_REACH = 0.1
"""Pixels outside prompt a part if they are this near it, likewise."""
NEAR_MISS = 0.015
"""A click off a mask by less than this share of the photo's longer side missed its outline; others are on a part."""

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
    contradict in the end, are made once more from the votes of all others; all get the parts that they lack by these.

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
        known = {k: int((shares[photos.seen[k]] >= SURE).sum()) for k in left}
        # A photo with clicks comes as soon as enough is known of it: what it says is certain.
        k = max(left, key=lambda row: (row in clicked and known[row] >= LEAST_KNOWN, known[row]))
        if known[k] < LEAST_KNOWN:
            own = [row for row in left if row in clicked and clicked[row].prompt]
            if not own:
                break
            k = max(own, key=lambda row: len(clicked[row].pixels))
        left.remove(k)
        made[k], left_out[k] = _make(ask, photos, k, clicked.get(k, NO_CLICKS), made, tolerance_px)
        _tell(photos.views[k].name, made[k])
    if not any(voter.votes for voter in made.values()):
        _refuse(photos, made, left_out)
    for k in range(len(photos.views)):
        others = {row: voter for row, voter in made.items() if row != k}
        if k not in made or not made[k].votes or _agreement(photos, k, made[k].mask, others) < LEAST_AGREEMENT:
            made[k], left_out[k] = _make(ask, photos, k, clicked.get(k, NO_CLICKS), others, tolerance_px)
            _tell(f"{photos.views[k].name} again", made[k])
    for k in [k for k in range(len(photos.views)) if made[k].votes]:
        others = {row: voter for row, voter in made.items() if row != k}
        made[k] = _extended(ask, photos, k, made[k], others, tolerance_px)
    return _carried(photos, made, [note for _, notes in sorted(left_out.items()) for note in notes])


def one_photo(ask: Ask, view: View, clicks: PhotoClicks, tolerance_px: float) -> tuple[Mask, float, float, list[str]]:
    """The mask (H, W) of a photo from its own clicks alone, with which `carry` begins; its quality, its agreement with
    the clicks, and the clicks that contradict it, a sentence each. Arguments as of `carry`; the view has RGB pixels."""
    nothing = np.zeros((0, 3)), [np.zeros(0, dtype=np.int64)], [np.zeros((0, 2))]
    voter, left_out = _make(ask, Workspace(Path(), [view], *nothing), 0, clicks, {}, tolerance_px)
    return voter.mask, voter.quality, voter.agreement, left_out


def _tell(name: str, voter: _Voter) -> None:
    print(f"{name}: quality {voter.quality:.2f}, agreement {voter.agreement:.2f}", flush=True)


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


def _extended(
    ask: Ask, photos: Workspace, k: int, voter: _Voter, others: dict[int, _Voter], tolerance_px: float
) -> _Voter:
    """A photo's mask with the parts that it lacks by the votes of all others."""
    known_on, known_off = _known(photos, k, others)
    inside, outside = (voter.clicks.on, known_on), (voter.clicks.off, known_off)
    mask = _with_parts(ask, photos.views[k], voter.mask, inside, outside, tolerance_px)
    if (mask == voter.mask).all():
        return voter
    print(f"{photos.views[k].name}: {mask.sum() / voter.mask.sum() - 1:.1%} added", flush=True)
    return _voter(photos, k, mask, voter.quality, _agrees(mask, inside, outside, tolerance_px), voter.clicks)


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
    agreement = [_agrees(mask, inside, outside, tolerance_px) for mask in masks]
    best = int(np.argmax([a + QUALITY_WEIGHT * q - 2 * (not m.any()) for m, a, q in zip(masks, agreement, quality)]))
    mask = _with_parts(ask, view, masks[best], inside, outside, tolerance_px)
    return mask, float(quality[best]) * bool(mask.any()), _agrees(mask, inside, outside, tolerance_px)


def _agrees(mask: Mask, inside: tuple[Array, Array], outside: tuple[Array, Array], tolerance_px: float) -> float:
    """Share of the pixels inside that a mask holds, less the share of those outside that it holds."""
    held = np.concatenate([_held(mask, inside[0], tolerance_px), _held(mask, inside[1], 0)])
    spared = np.concatenate([_held(~mask, outside[0], tolerance_px), _held(~mask, outside[1], 0)])
    return float((held.mean() if len(held) else 1.0) - ((~spared).mean() if len(spared) else 0.0))


def _with_parts(
    ask: Ask, view: View, mask: Mask, inside: tuple[Array, Array], outside: tuple[Array, Array], tolerance_px: float
) -> Mask:
    """A mask with the parts that it lacks: of several things that prompt it, a network takes the clearest.

    Each group of pixels inside that the mask does not hold, near each other, prompts alone. What it gives is a part of
    the object if it holds them, few pixels known to be outside beside those known to be inside, and is no larger than
    the mask.
    """
    whole = mask
    if _agrees(mask, inside, outside, tolerance_px) < PART_AGREEMENT:
        return whole
    missed_px = max(tolerance_px, NEAR_MISS * max(mask.shape))
    lacking = inside[0][~_held(mask, inside[0], missed_px)], inside[1][~_held(mask, inside[1], 0)]
    for group in _groups(*lacking, PART_GAP * max(mask.shape)):
        on = np.concatenate(group)
        # What is clicked in a photo beats what other photos say of it.
        certain, voted = outside if not len(group[0]) else (outside[0], outside[1][:0])
        off = np.concatenate([certain, voted])
        # Far from a part, they say nothing of it and mislead the network.
        reach = cKDTree(on), PART_REACH * max(mask.shape)
        masks, quality = ask(view, group, (_near(certain, *reach), _near(voted, *reach)), None)
        for row in np.argsort(-quality):
            part = prompted_parts(cleaned(masks[row]), on, off)
            own, foreign = (_held(part, pixels, 0).sum() for pixels in (np.concatenate(inside), off))
            holds = part.any() and _share(part, on, 1.0) >= SURE
            if quality[row] >= LEAST_QUALITY and holds and own >= SURE * (own + foreign) and part.sum() <= mask.sum():
                whole = whole | part
                break
    return whole


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
