"""Masks from prompts: points triangulated from several photos, or clicks in one, carried on to the others."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import Mask
from scenefuse.marks.clicks import Clicks, ScenePoints
from scenefuse.marks.photo_clicks import SUFFICIENT_CLICKS, PhotoClicks, clicks_per_photo
from scenefuse.marks.triangulation import marked_size, triangulate_consistent
from scenefuse.masks.grabcut import query_grabcut
from scenefuse.masks.prompts import Segmenter, prompted_parts
from scenefuse.masks.propagation import propagate
from scenefuse.masks.sam2 import Sam2, query_sam2
from scenefuse.masks.segmentation import MaskSettings, segment_again, segment_by_grabcut, segment_by_sam2
from scenefuse.masks.stereo_points import with_stereo_points
from scenefuse.masks.target import Target, target_from_points, target_from_votes
from scenefuse.photos.workspace import Workspace, read_model

# Clicks on a point that miss each other by this share of what is clicked still say where the object ends: corners that
# a hand misses, or that are none (a hat's brim).
MAX_MISS_SHARE = 0.03
# GrabCut propagates masks in photos so many times as wide as those of its first cut: what one mask lacks is missing
# from the next.
PROPAGATION_WIDTHS = 2


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

    Raises:
        StageError: the prompts are wrong or too few, or lead to no mask.
    """
    if isinstance(marked, Clicks) and marked.kind == "labels":
        own, left_out = clicks_per_photo(marked, sparse, photos.views, sizes)
        width_px = PROPAGATION_WIDTHS * settings.grabcut_width_px
        segment: Segmenter = partial(query_sam2, network) if network else partial(query_grabcut, width_px)
        photos = with_stereo_points(photos) if network else photos
        found = propagate(segment, photos, own, settings.max_click_residual_px)
        target = target_from_votes(found.kind, photos, up, seed)
        if network:
            masks = segment_again(network, target, found.masks, photos, settings, found.clicked)
        else:
            masks = segment_by_grabcut(target, photos, settings, found.clicked)
        masks = [_own_parts(mask, target, photos, k, found.clicked.get(k)) for k, mask in enumerate(masks)]
        names = tuple(photos.views[k].name for k, clicks in found.clicked.items() if clicks.enough)
        left_out += found.left_out
        return Prompted(masks, target, found.reasons, left_out, clicked=names, quality=found.quality)
    points, exact, left_out, notes = _points(marked, sparse, sizes, settings.max_click_residual_px)
    target = replace(target_from_points(points, photos, up, seed), inexact=np.flatnonzero(~exact))
    if network:
        return Prompted(segment_by_sam2(network, target, photos, settings), target, {}, left_out, notes)
    return Prompted(segment_by_grabcut(target, photos, settings), target, {}, left_out, notes)


def _own_parts(mask: Mask, target: Target, photos: Workspace, k: int, clicks: PhotoClicks | None) -> Mask:
    """The parts of a photo's mask that hold a click, or a sparse point that is the object's: seen, or hidden by it."""
    at, kind = photos.seen_at[k], target.kind[photos.seen[k]]
    hidden, depth = photos.views[k].project(target.spanning)
    shown = (depth > 0) & (hidden >= 0).all(1) & (hidden < mask.shape[::-1]).all(1)
    on, off = [at[kind > 0], hidden[shown]], [at[kind < 0]]
    if clicks is not None:
        on, off = [*on, clicks.on], [*off, clicks.off]
    return prompted_parts(mask, np.concatenate(on), np.concatenate(off))


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
        limit = max(max_residual_px, MAX_MISS_SHARE * marked_size(marked, model, sizes))
        names, points, residuals, left_out = triangulate_consistent(marked, model, limit, sizes)
        exact = residuals <= max_residual_px
        off = [f"{name} {px:.1f} px" for name, px in zip(names, residuals) if px > max_residual_px]
        if off:
            notes = (
                f"the clicks on {len(off)} of {len(names)} points miss each other by more than {max_residual_px:g} px"
                f" ({', '.join(off)}): these points say how far the object reaches, and do not prompt SAM 2",
            )
    if len(points) < SUFFICIENT_CLICKS:
        wrong = f" ({'; '.join(left_out)})" if left_out else ""
        raise StageError(
            f"{marked.path} holds {len(names)} points on the object that can be used, three or more are needed{wrong};"
            " mark some at its ends"
        )
    return points, exact, left_out, notes
