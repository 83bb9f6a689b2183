"""Stage 3's choice between sets of depth maps, by three measures that need no truth."""

import numpy as np
import torch
from torch import Tensor

from scenefuse.nerf.prior.consistency import consistency_between_views, residuals_at_points
from scenefuse.nerf.prior.inputs import DepthPhotos
from scenefuse.nerf.prior.maps import tolerance_of
from scenefuse.nerf.prior.self_supervision import minimum_reprojection, photometric_error, warp
from scenefuse.photos.views import chosen_by

Scores = dict[str, dict[str, float | None]]

# Photometric error of a pixel that no other photo shows: that of two unlike colours.
UNSEEN_ERROR = 0.5


def score_candidates(candidates: dict[str, Tensor], photos: DepthPhotos) -> Scores:
    """Three measures of each set of depth maps, smaller is better, on trained photos and pixels that all sets have.

    Returns:
        For each candidate: `photometric` (minimum reprojection error of the two nearest of every other held-out photo,
        `chosen_by`, or of the sources where none is held out), `inconsistency` (one minus the mean confidence),
        `residual` (median relative residual at the SfM points kept for checking), None where it cannot be measured.
    """
    common = torch.stack([d > 0 for d in candidates.values()]).all(0) & (photos.masks > 0)
    common[~torch.as_tensor(photos.trained)] = False
    tolerance = tolerance_of(photos)
    return {
        name: {
            "photometric": _photometric(depth, photos, common),
            "inconsistency": _mean(1.0 - consistency_between_views(depth, photos, tolerance).confidence[common]),
            "residual": _residual(depth, photos, candidates),
        }
        for name, depth in candidates.items()
    }


def best_candidate(scores: Scores) -> str:
    """The candidate with the smallest sum of ranks over the measures that all have; a tie goes to the earlier one."""
    names = list(scores)
    total = dict.fromkeys(names, 0)
    for measure in scores[names[0]]:
        values = {name: scores[name][measure] for name in names}
        known = [v for v in values.values() if v is not None]
        if len(known) < len(names):
            continue
        for name in names:
            total[name] += sum(v < values[name] for v in known)  # type: ignore[operator]
    return min(names, key=lambda name: total[name])


@torch.no_grad()
def _photometric(depth: Tensor, photos: DepthPhotos, common: Tensor) -> float | None:
    """Mean error over the pixels in `common` of the photos that come closest to each photo."""
    held_out = torch.as_tensor(np.flatnonzero(chosen_by(~photos.trained)), device=depth.device)
    centres = photos.object_from_cam[:, :3, 3]
    total, number = 0.0, 0
    for index in np.flatnonzero(photos.trained):
        nearest = photos.sources[index][:2]
        if len(held_out):
            nearest = held_out[torch.argsort((centres[held_out] - centres[index]).norm(dim=1))[:2]]
        target = torch.full_like(nearest, int(index))
        moves = photos.source_from_target(target, nearest)
        warped, valid = warp(
            photos.images[nearest], depth[target], moves, photos.intrinsics[target], photos.intrinsics[nearest]
        )
        errors = photometric_error(photos.images[target], warped)
        smallest, counts = minimum_reprojection(errors.transpose(0, 1), valid.transpose(0, 1), None)
        inside = common[index : index + 1]
        total += float(smallest[inside & counts].sum()) + UNSEEN_ERROR * float((inside & ~counts).sum())
        number += int(inside.sum())
    return total / number if number else None


def _residual(depth: Tensor, photos: DepthPhotos, candidates: dict[str, Tensor]) -> float | None:
    """At the check points where no candidate has a hole in the four pixels around."""
    mine = residuals_at_points(depth, photos.checks)
    at_depth_one = [np.column_stack([p[:, :2], np.ones(len(p), np.float32)]) for p in photos.checks]
    holes = [residuals_at_points((d > 0).float(), at_depth_one) for d in candidates.values()]
    whole = [np.all([h[i] < 1e-3 for h in holes], axis=0) for i in range(len(mine))]
    values = np.concatenate([m[w] for m, w in zip(mine, whole)])
    return float(np.median(values)) if len(values) else None


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if len(values) else None
