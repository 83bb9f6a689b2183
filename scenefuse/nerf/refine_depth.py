"""The depth prior of a NeRF stage, moved to where the training photos match and confirmed by other views; and stage 3.

In stage 3 of an object, photos correct the depth that the NeRF rendered, for the NeRF to be trained again on it.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError, atomic_directory, quantity, threads, value, write_json
from scenefuse.geometry.consistency import compare, extent, surface_points
from scenefuse.geometry.photo_kernel import MIN_AGREEING
from scenefuse.mvs.photo_refinement import RefinementSettings, refine_by_photos
from scenefuse.photos.pictures import read_depth, write_depth
from scenefuse.photos.views import Views, load_views

# Two depths of one place agree within this share of the object's diagonal.
MAP_AGREEMENT = 0.005
SHIPPED = RefinementSettings()

Maps = NDArray[np.float32]


@dataclass(frozen=True)
class DepthPrior:
    """What is known of the surface before a NeRF is trained.

    Attributes:
        depths: (V, H, W) along z in object units, 0 for none, at the size of the views.
        confidence: (V, H, W) in 0..1, 0 in held-out views.
    """

    depths: Maps
    confidence: Maps


def confirm(
    views: Views, depths: Maps, settings: RefinementSettings = SHIPPED, map_agreement: float = MAP_AGREEMENT
) -> tuple[DepthPrior, dict[str, Any]]:
    """Depth maps (V, H, W) as a prior, and what the report of their stage says of it.

    Depths are moved to where the training photos match best, and those that photos contradict are left out. The
    confidence is 1 where photos moved a depth and elsewhere the share of the views that agree among those that should
    see the place; 0 unless two other views have the same surface. Held-out photos take no part: their maps stay as they
    are, without confidence.

    Args:
        views: photos, masks and cameras at the maps' size.
        depths: along z in object units, 0 for none.
        settings: of the refinement by photos.
        map_agreement: largest difference of depth that agrees, share of the object's diagonal.
    """
    training = np.flatnonzero(~views.held_out)
    seen, before = views.select(training), depths[training] * views.masks[training]
    matched = refine_by_photos(seen, before, settings)
    kept = np.where(matched.inconsistent, 0, matched.depths).astype(np.float32)
    agree, through, _ = agreement(seen, kept, map_agreement)
    share = np.where(matched.moved, 1, agree / np.maximum(agree + through, MIN_AGREEING))
    share = np.where(agree >= MIN_AGREEING, share, 0).astype(np.float32)
    prior = DepthPrior(depths * views.masks, np.zeros_like(depths))
    prior.depths[training], prior.confidence[training] = kept, share
    there, masked = max(int((before > 0).sum()), 1), max(int(seen.masks.sum()), 1)
    return prior, {
        "refined_share": quantity(float(matched.moved.sum() / there), "1"),
        "inconsistent_share": quantity(float(matched.inconsistent.sum() / there), "1"),
        "confirmed_share": quantity(float((share > 0).sum() / masked), "1"),
    }


def agreement(views: Views, depths: Maps, share: float) -> tuple[NDArray[np.int32], NDArray[np.int32], float]:
    """(V, H, W) how many other views have the same surface, and how many see through it; the object's diagonal, of
    which depths of one place differ by `share` at most."""
    known = [surface_points(*view) for view in zip(depths, views.intrinsics, views.object_from_cam)]
    diagonal = extent(np.concatenate([points for points, _, _ in known]))
    cameras, tolerance = (views.intrinsics, views.object_from_cam), share * diagonal
    agree, through = np.zeros((2, *depths.shape), np.int32)
    for index, (points, rows, columns) in enumerate(known):
        found = compare(points, index, depths, views.masks, *cameras, tolerance)
        agree[index, rows, columns], through[index, rows, columns] = found.agree, found.through
    return agree, through, diagonal


def write_prior(folder: Path, views: Views, prior: DepthPrior) -> None:
    """Write depth_maps/ and confidence_maps/ of a stage folder: one COLMAP map of each photo."""
    for kind, maps in (("depth_maps", prior.depths), ("confidence_maps", prior.confidence)):
        for name, (height, width), values in zip(views.names, views.sizes.tolist(), maps):
            write_depth(folder / kind / f"{name}.bin", values[:height, :width])


def read_prior(folder: Path, views: Views) -> DepthPrior:
    """The prior in a stage folder, at the size of the views."""
    depths, confidence = (read_stage_maps(folder / kind, views) for kind in ("depth_maps", "confidence_maps"))
    depths = np.where(np.isfinite(depths) & views.masks, depths, 0).clip(0)
    confidence = np.nan_to_num(confidence).clip(0, 1) * (depths > 0) * ~views.held_out[:, None, None]
    return DepthPrior(depths, confidence)


def read_stage_maps(folder: Path, views: Views) -> Maps:
    """The maps (V, H, W) in a folder at the size of the views, zeros where there is none."""
    maps = np.zeros(views.masks.shape, np.float32)
    for place, name, (height, width) in zip(maps, views.names, views.sizes.tolist()):
        path = folder / f"{name}.bin"
        if path.is_file():
            place[:height, :width] = cv2.resize(read_depth(path), (width, height), interpolation=cv2.INTER_NEAREST)
    return maps


def refine_depth(
    *, workspace: Path, masks: Path, rendered: Path, stage: Path, report: Path, width_px: int, hold_out_every: int
) -> None:
    """Move rendered depth to where the training photos match, and mark what other views confirm (method N12).

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        rendered: stage 2's folder, with depth_maps/.
        stage: output folder: depth_maps/{photo}.bin and confidence_maps/{photo}.bin (0..1).
        report: output JSON: shares of the depths that photos moved, contradicted, confirmed.
        width_px: width of the rendered maps.
        hold_out_every: as in stage 1.

    Raises:
        StageError: no photo of the object has a rendered depth.
    """
    start = time.monotonic()
    use_threads(threads())
    views = load_views(workspace, masks, width_px, hold_out_every)
    depths = read_stage_maps(rendered / "depth_maps", views)
    if not depths.any():
        raise StageError(f"{rendered}/depth_maps holds no depth for any photo of the object; run stage 2 again")
    prior, content = confirm(views, depths)
    with atomic_directory(stage) as folder:
        write_prior(folder, views, prior)
    write_json(report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    print(f"photos moved {value(content, 'refined_share'):.0%} of the rendered depths", flush=True)
