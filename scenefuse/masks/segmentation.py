"""Masks of all photos of an object by GrabCut or SAM 2, and their agreement with the visual hull of all of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, setting
from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import MAX_WRONG_SHARE, Hull, Mask, carve, mask_iou, silhouette
from scenefuse.marks.clicks import Clicks, ScenePoints
from scenefuse.marks.photo_clicks import SUFFICIENT_CLICKS, PhotoClicks, clicks_per_photo
from scenefuse.marks.triangulation import marked_size, triangulate_consistent
from scenefuse.masks.grabcut import along_edges, cleaned, first_cuts, query_grabcut, second_cuts
from scenefuse.masks.prompts import BOX_GROWTH_SHARE, Measure, Segmenter, agreement
from scenefuse.masks.propagation import NO_CLICKS, propagate
from scenefuse.masks.sam2 import SIDE_PX, Sam2, query_sam2, segment, segment_like
from scenefuse.masks.target import Target, target_from_points, target_from_votes
from scenefuse.masks.votes import MIN_AGREEMENT, MIN_KNOWN_POINTS, points_held, settled_points, voter_of
from scenefuse.mvs.stereo_points import with_stereo_points
from scenefuse.photos.photo_files import MIN_OBJECT_PHOTOS
from scenefuse.photos.workspace import View, Workspace, read_model

# As MAX_WRONG_SHARE, for GrabCut's first masks, and for another hull by which masks are compared: where many lack a
# part, they would carve it away.
MAX_LACKING_SHARE = 0.34
# Times that masks are made again by the hull of those before: each brings a better hull, the last ones little.
MAX_ROUNDS = 3
# Share of the median mask's agreement with the hull below which SAM 2 makes a mask once more.
MIN_SHARE_OF_MEDIAN = 0.9
NOTHING: Mapping[int, PhotoClicks] = {}


@dataclass(frozen=True)
class MaskSettings:
    """How masks are made."""

    method: Literal["auto", "sam2", "grabcut", "supplied"] = setting("auto")
    """Where masks come from: SAM 2, GrabCut, or (`auto`) SAM 2, and GrabCut where its weights cannot be fetched. A
    folder in the column `masks` of the objects' table goes before."""
    keep: str = setting("object")
    """What the masks keep: `object`, or an expression with folders of other masks in quotes, `and`, `or`, `not` and
    brackets. `{object}` in a folder stands for the object's name. Masks are named like the photos; a photo without one
    shows nothing of that."""
    min_agreement: float = 0.6
    """Smallest IoU of a mask with the hull's outline; below it the photo is left out."""
    max_click_residual_px: float = setting(4, unit="px", least=0)
    """Largest reprojection error of a prompt clicked in several photos, if 5 % of what is clicked in one is not more;
    and how far a click inside or outside may lie on the wrong side of its mask's outline. Others are left out and
    named."""
    min_photos: int = MIN_OBJECT_PHOTOS
    """Fewest good masks to go on with."""
    hull_voxels: int = 160
    """Voxels of the visual hull along the longest side of the box."""
    grabcut_width_px: int = 320
    """The first cut runs on photos at most this wide, in pixels."""


@dataclass(frozen=True)
class ScoredMasks:
    """Masks and how well they agree, by the name of their photo.

    Attributes:
        masks: (H, W) each.
        scores: IoU of each with the outline of the hull, 0..1.
        dropped: why a photo has no usable mask.
    """

    masks: dict[str, Mask]
    scores: dict[str, float]
    dropped: dict[str, str]


def segment_by_grabcut(
    target: Target, photos: Workspace, settings: MaskSettings, clicked: Mapping[int, PhotoClicks] = NOTHING
) -> list[Mask]:
    """GrabCut photo by photo, then twice more along the visual hull: masks (H, W) of V views with RGB pixels.

    Clicks, by row of the photo, are certain in their own photo.
    """
    masks = first_cuts(target, photos, settings.grabcut_width_px, clicked)
    for tolerance in (MAX_LACKING_SHARE, MAX_WRONG_SHARE):
        hull = carve_consistent(target, photos.views, masks, settings, tolerance)
        masks = second_cuts(target, masks, photos, hull, clicked)
    return masks


def segment_by_sam2(network: Sam2, target: Target, photos: Workspace, settings: MaskSettings) -> list[Mask]:
    """SAM 2 photo by photo, and once more, with the visual hull's box, where a mask disagrees with the hull."""
    masks = [segment(network, target, view) for view in photos.views]
    return segment_again(network, target, masks, photos, settings)


def segment_again(
    network: Sam2,
    target: Target,
    masks: list[Mask],
    photos: Workspace,
    settings: MaskSettings,
    clicked: Mapping[int, PhotoClicks] = NOTHING,
    votes: NDArray[np.int8] | None = None,
) -> list[Mask]:
    """SAM 2 once more, by what the other photos say and the photo's own clicks, where one of the masks (H, W) disagrees
    with the hull, or much more than most, unless clicks alone suffice for it; again with the hull of the masks that
    this changed, and then all at the photo's resolution.

    A mask that holds points of something else, as of a tree before a wall, by the `votes` (P,) of the first masks, is
    not taken; before these go the votes of the masks that agree with the hull.
    """
    masks = list(masks)
    certain = tuple(photos.views[k].name for k, clicks in clicked.items() if clicks.enough)
    for _ in range(MAX_ROUNDS):
        hull = carve_consistent(target, photos.views, masks, settings, MAX_WRONG_SHARE, certain)
        outlines = [silhouette(hull, view) for view in photos.views]
        agreement = [mask_iou(mask, outline) for mask, outline in zip(masks, outlines)]
        least = max(settings.min_agreement, MIN_SHARE_OF_MEDIAN * float(np.median(agreement)))
        kind = np.zeros(len(photos.points), np.int8)
        if votes is not None:
            agreeing = [k for k, share in enumerate(agreement) if share >= least]
            voters = {k: voter_of(photos, k, masks[k], 1.0, 1.0, clicked.get(k, NO_CLICKS)) for k in agreeing}
            own = settled_points(photos, voters)
            kind = np.where(own != 0, own, votes)
        changed = False
        for k, (view, outline) in enumerate(zip(photos.views, outlines)):
            final = masks[k].any() and view.name in certain
            if outline.any() and agreement[k] < least and not final:
                again = segment_like(network, target, view, outline, clicked.get(k, NO_CLICKS))
                held = kind[points_held(photos, k, again)]
                foreign = np.count_nonzero(held) >= MIN_KNOWN_POINTS and np.mean(held[held != 0] > 0) < MIN_AGREEMENT
                if mask_iou(again, outline) > agreement[k] and not foreign:
                    masks[k], changed = again, True
                print(f"{view.name} segmented again, IoU {mask_iou(masks[k], outline):.2f}", flush=True)
        if not changed:
            break
    return [_at_full_size(view, mask) for view, mask in zip(photos.views, masks)]


def _at_full_size(view: View, mask: Mask) -> Mask:
    """A mask (H, W) at its photo's resolution. Small parts of it stay: they were asked for, by a click or by points of
    other photos; small parts that the edges leave do not."""
    edges = along_edges(view.pixels, mask, 4 * max(view.width, view.height) / SIDE_PX, SIDE_PX)
    asked = mask & ~cleaned(mask)
    return np.asarray(cleaned(edges, view.pixels) | (edges & asked))


def score_masks(
    masks: list[Mask], target: Target, views: list[View], settings: MaskSettings, clicked: tuple[str, ...] = ()
) -> ScoredMasks:
    """The masks of V views with their agreement with their visual hull; empty and contradicting ones are dropped, but
    not those that a person clicked, by the names of their photos."""
    hull = carve_consistent(target, views, masks, settings, MAX_WRONG_SHARE, clicked)
    scores = {view.name: mask_iou(mask, silhouette(hull, view)) for view, mask in zip(views, masks)}
    dropped = {}
    for view, mask in zip(views, masks):
        if not mask.any():
            dropped[view.name] = "empty mask"
        elif scores[view.name] < settings.min_agreement and view.name not in clicked:
            dropped[view.name] = f"IoU with the visual hull is {scores[view.name]:.2f}, below {settings.min_agreement}"
    return ScoredMasks({view.name: mask for view, mask in zip(views, masks)}, scores, dropped)


def carve_consistent(
    target: Target,
    views: list[View],
    masks: list[Mask],
    settings: MaskSettings,
    tolerance: float,
    certain: tuple[str, ...] = (),
) -> Hull:
    """The visual hull of the largest set of masks (H, W) that agree with the hull of their set.

    A strict hull of all masks is too small where some lack a part, a tolerant one too large where few photos bound it;
    the larger set of those that begin with the one and the other is taken, and all masks where no two agree. Where it
    contradicts a mask that a person clicked, by the names of their photos in `certain`, a third grows from these
    outwards, by each nearest photo whose mask agrees with a hull that these agree with.

    Raises:
        StageError: the masks have nothing in common.
    """
    shown = [replace(view, pixels=mask) for view, mask in zip(views, masks) if mask.any()]
    own = target.sparse[target.kind > 0]

    def carved(among: list[View], voxels: int, share: float) -> Hull:
        return carve(target.box, target.ground.height_of, among, voxels, share, own)

    def agreeing(hull: Hull, among: list[View]) -> list[View]:
        return [view for view in among if mask_iou(view.pixels, silhouette(hull, view)) >= settings.min_agreement]

    largest: list[View] = []
    coarse = settings.hull_voxels // 2  # enough to compare by, in an eighth of the time
    for share in (MAX_LACKING_SHARE, tolerance):
        chosen = agreeing(carved(shown, coarse, share), shown) if len(shown) > 1 else []
        consistent = agreeing(carved(chosen, coarse, tolerance), shown) if len(chosen) > 1 else []
        largest = max(largest, consistent, key=len)
    clicked = [view for view in shown if view.name in certain]
    if not {view.name for view in largest}.issuperset(view.name for view in clicked):
        centres, grown = np.array([view.centre for view in clicked]), list(clicked)
        others = [view for view in shown if view.name not in certain]
        for view in sorted(others, key=lambda one: np.linalg.norm(centres - one.centre, axis=1).min()):
            needed = [*clicked, view]
            if len(agreeing(carved([*grown, view], coarse, tolerance), needed)) == len(needed):
                grown.append(view)
        largest = max(largest, grown, key=len)
    hull = carved(largest if len(largest) > 1 else shown, settings.hull_voxels, tolerance)
    if len(hull.shell) == 0:
        raise StageError(
            "the masks of the photos have no common object; check that the prompts lie on one object and span it, "
            "or supply masks"
        )
    return hull


@dataclass(frozen=True)
class Prompted:
    """What prompts lead to.

    Attributes:
        masks: (H, W) per photo, empty where there is none.
        target: where the object is.
        reasons: why a photo's mask was not good enough to be carried on, by the photo's name.
        left_out: clicks that contradict the others, or whose photo has no camera, a sentence each.
        notes: what else a user should know of the clicks.
        clicked: names of the photos whose masks come from clicks in them alone.
        quality: of the masks by SAM 2's own estimate, by the photo's name.
    """

    masks: list[Mask]
    target: Target
    reasons: dict[str, str]
    left_out: list[str]
    notes: tuple[str, ...] = ()
    clicked: tuple[str, ...] = ()
    quality: Mapping[str, float] = field(default_factory=dict)


def masks_from_prompts(
    marked: Clicks | ScenePoints,
    sparse: Path,
    sizes: Mapping[str, tuple[int, int]],
    photos: Workspace,
    up: Array,
    network: Sam2 | None,
    settings: MaskSettings,
    seed: int,
    measure: Measure = agreement,
) -> Prompted:
    """Masks of all photos by SAM 2, or by GrabCut where there is no network.

    Args:
        marked: the prompts.
        sparse: COLMAP model of the photos before undistortion.
        sizes: photo name -> (width, height) of the photos clicked in.
        photos: views with RGB pixels.
        up: (3,) the direction against gravity.
        network: SAM 2, or None.
        settings: see MaskSettings.
        seed: seed of the ground's RANSAC.
        measure: of a propagated mask's agreement with its prompts.

    Raises:
        StageError: the prompts are wrong or too few, or lead to no mask.
    """
    if isinstance(marked, Clicks) and marked.kind == "labels":
        own, left_out = clicks_per_photo(marked, sparse, photos.views, sizes)
        cut: Segmenter = partial(query_grabcut, settings.grabcut_width_px)
        segment = partial(query_sam2, network) if network else cut
        photos = with_stereo_points(photos) if network else photos
        found = propagate(segment, photos, own, settings.max_click_residual_px, measure)
        target = target_from_votes(found.kind, photos, up, seed)
        if network:
            masks = segment_again(network, target, found.masks, photos, settings, found.clicked, found.kind)
        else:
            masks = segment_by_grabcut(target, photos, settings, found.clicked)
        names = tuple(photos.views[k].name for k, clicks in found.clicked.items() if clicks.enough)
        left_out += found.left_out
        return Prompted(masks, target, found.reasons, left_out, tuple(found.notes), names, found.quality)
    points, exact, left_out, notes = _points(marked, sparse, sizes, settings.max_click_residual_px)
    target = replace(target_from_points(points, photos, up, seed), inexact=np.flatnonzero(~exact))
    by = partial(segment_by_sam2, network) if network else segment_by_grabcut
    return Prompted(by(target, photos, settings), target, {}, left_out, notes)


def _points(
    marked: Clicks | ScenePoints, sparse: Path, sizes: Mapping[str, tuple[int, int]], max_residual_px: float
) -> tuple[Array, NDArray[np.bool_], list[str], tuple[str, ...]]:
    """(N, 3) prompts in the object's frame, (N,) which are exact, the points and clicks left out, and a note on the
    others that are not exact."""
    left_out: list[str] = []
    notes: tuple[str, ...] = ()
    if isinstance(marked, ScenePoints):
        names, points, exact = marked.points, marked.positions, np.ones(len(marked.points), dtype=bool)
    else:
        model = read_model(sparse)
        # A little farther off they still say where the object ends: corners that a hand misses, or a hat's brim.
        limit = max(max_residual_px, BOX_GROWTH_SHARE * marked_size(marked, model, sizes))
        names, points, residuals, left_out = triangulate_consistent(marked, model, limit, sizes)
        exact = residuals <= max_residual_px
        off = [f"{name} {px:.1f} px" for name, px in zip(names, residuals) if px > max_residual_px]
        if off:
            notes = (
                f"the clicks on {len(off)} of {len(names)} points miss each other by more than {max_residual_px:g} px"
                f" ({', '.join(off)}): these points only say how far the object reaches",
            )
    if len(points) < SUFFICIENT_CLICKS:
        wrong = f" ({'; '.join(left_out)})" if left_out else ""
        raise StageError(
            f"{marked.path} holds {len(names)} points on the object that can be used, three or more are needed{wrong};"
            " mark some at its ends"
        )
    return points, exact, left_out, notes
