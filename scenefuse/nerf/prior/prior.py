"""The depth prior of a NeRF stage: maps of an earlier stage, moved to where the training photos match, and checked."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.geometry.consistency import compare, extent, surface_points
from scenefuse.mvs.photo_refinement import RefinementSettings, refine_by_photos
from scenefuse.photos.maps import read_depth
from scenefuse.photos.views import Views

# Other views that have to have the same surface: one may agree by chance.
AGREEING_VIEWS = 2


@dataclass(frozen=True)
class DepthPrior:
    """What is known of the surface before a NeRF is trained.

    Attributes:
        depths: (V, H, W) float32 along z in object units, 0 for none, at the size of the views; none in held-out views.
        confidence: (V, H, W) float32 in 0..1.
        refined_share: share of the prior's pixels that photos moved.
        confident_share: share of the training photos' masks with a prior.
        order: (V, H, W) float32, the same depths before anything was checked: their order is learned (method N3); None
            where that of `depths` is.
    """

    depths: NDArray[np.float32]
    confidence: NDArray[np.float32]
    refined_share: float
    confident_share: float
    order: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Unconfirmed:
    """What takes all depths of the earlier stage, and not only those that photos do not contradict and views confirm.

    Attributes:
        order: their order.
        depths: the depths themselves, with full confidence.
    """

    order: bool = False
    depths: bool = False


def read_prior(
    folder: Path, views: Views, settings: RefinementSettings, agreement: float, of_all: Unconfirmed = Unconfirmed()
) -> DepthPrior:
    """Read a stage's depth maps, move them to where photos match, and keep what photos do not contradict and two other
    maps confirm.

    Held-out photos take no part: neither their maps nor their pixels.

    Args:
        folder: of the earlier stage, with depth_maps/ and confidence_maps/.
        views: photos, masks and cameras at the NeRF's size.
        settings: of the refinement by photos.
        agreement: largest difference of depth that agrees, share of the object's diagonal.
        of_all: what takes all depths.
    """
    training = np.flatnonzero(~views.held_out)
    seen = views.select(training)
    depths, certain = (_scaled_maps(folder / kind, seen) for kind in ("depth_maps", "confidence_maps"))
    depths = np.where(np.isfinite(depths) & (depths > 0) & seen.masks, depths, 0).astype(np.float32)
    everything = depths
    matched = refine_by_photos(seen, seen.object_from_cam, depths, settings)
    refined = float(matched.moved.sum() / max(int((depths > 0).sum()), 1))
    depths = np.where(matched.inconsistent, 0, matched.depths)
    confidence = np.where(matched.moved, 1, np.nan_to_num(certain).clip(0, 1)) * _confirmed(seen, depths, agreement)
    depths = np.where(confidence > 0, depths, 0)
    if of_all.depths:
        depths, confidence, refined = everything, (everything > 0).astype(np.float32), 0.0
    shape = views.masks.shape
    whole = tuple(np.zeros(shape, np.float32) for _ in range(3))
    for place, of_training in zip(whole, (depths, confidence, everything)):
        place[training] = of_training
    share = float((confidence > 0).sum() / max(int(seen.masks.sum()), 1))
    return DepthPrior(whole[0], whole[1], refined, share, whole[2] if of_all.order else None)


def _scaled_maps(folder: Path, views: Views) -> NDArray[np.float32]:
    """The maps (V, H, W) of views at their size, zeros where there is none."""
    maps = np.zeros(views.masks.shape, np.float32)
    for place, name, (height, width) in zip(maps, views.names, views.sizes.tolist()):
        path = folder / f"{name}.bin"
        if path.is_file():
            place[:height, :width] = cv2.resize(read_depth(path), (width, height), interpolation=cv2.INTER_NEAREST)
    return maps


def _confirmed(views: Views, depths: NDArray[np.float32], agreement: float) -> NDArray[np.bool_]:
    """(V, H, W), True where enough other views have the same surface."""
    known = [surface_points(*view) for view in zip(depths, views.intrinsics, views.object_from_cam)]
    tolerance = agreement * extent(np.concatenate([points for points, _, _ in known]))
    confirmed = np.zeros(depths.shape, bool)
    for index, (points, rows, columns) in enumerate(known):
        others = compare(points, index, depths, views.masks, views.intrinsics, views.object_from_cam, tolerance)
        confirmed[index, rows, columns] = others.agree >= AGREEING_VIEWS
    return confirmed
