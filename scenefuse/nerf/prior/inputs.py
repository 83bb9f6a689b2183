"""The photos of an object as tensors: depth range, photos to compare with, SfM points to learn from and to check."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from torch import Tensor

from scenefuse.core.stage import StageError
from scenefuse.photos.views import Views

# Photos seen under about this angle match well and still fix depth (after MVSNet's pair score, Yao et al. 2018).
BEST_ANGLE_DEG = 15.0
# Every tenth SfM point is kept from training, to measure with.
CHECK_EVERY = 10
# A point belongs to the object when this share of the photos that observe it have it in their mask.
SHARE_IN_MASKS = 0.7
# The depth range spans these percentiles of the points' depths, widened at both ends by shares of the range and of the
# farthest depth; the box around the object spans the percentiles of BOX.
RANGE, BOX = (1, 99), (2, 98)
WIDER, WIDER_FAR = 0.15, 1e-3
# Points nearer than this, in object units, are behind the camera or in it.
MIN_DEPTH = 1e-6


@dataclass(frozen=True)
class DepthPhotos:
    """The V photos of an object as tensors.

    Attributes:
        images: (V, 3, H, W) in 0..1.
        masks: (V, 1, H, W) zeros and ones.
        beyond: (V, 1, H, W) ones beyond the photo's border, where nothing is known.
        intrinsics: (V, 3, 3).
        object_from_cam: (V, 4, 4).
        trained: (V,) bool, False for held-out photos.
        sources: (V, S) indices of the photos each photo is compared with, best first, never held out.
        points: V float32 arrays (N, 3): column, row (pixels) and depth of the SfM points on the object.
        checks: as `points`: every tenth SfM point, never shown to the network, to measure with.
        near: nearest depth the network can say, object units.
        far: farthest.
        diagonal: diagonal of the box around the object's SfM points, object units.
    """

    images: Tensor
    masks: Tensor
    beyond: Tensor
    intrinsics: Tensor
    object_from_cam: Tensor
    trained: NDArray[np.bool_]
    sources: Tensor
    points: list[NDArray[np.float32]]
    checks: list[NDArray[np.float32]]
    near: float
    far: float
    diagonal: float

    def source_from_target(self, target: Tensor, source: Tensor) -> Tensor:
        """(..., 4, 4) SfM transforms between photos given by index, broadcast against each other."""
        return torch.linalg.inv(self.object_from_cam[source]) @ self.object_from_cam[target]


def depth_photos(views: Views, sources: int, device: torch.device) -> DepthPhotos:
    """Turn Views into tensors, find the depth range, and choose the source photos.

    Raises:
        StageError: fewer than three photos to train on, or fewer than eight SfM points on the object.
    """
    if (~views.held_out).sum() < 3:
        raise StageError(
            f"only {(~views.held_out).sum()} photos with a mask can be trained on; depth needs at least 3: "
            "take more photos around the object, or set object.hold_out_every to 0"
        )
    seen = _points_on_object(views)
    on_object = np.unique(np.concatenate([ids for ids, _ in seen]))
    if len(on_object) < 8:
        raise StageError(
            f"only {len(on_object)} SfM points lie on the object in all photos; depth needs at least 8: "
            "check that the masks show the object, and that the photos are sharp"
        )
    low, high = np.percentile(views.sparse[on_object], BOX, axis=0)
    depths = np.concatenate([pixels[:, 2] for _, pixels in seen])
    closest, farthest = np.percentile(depths, RANGE)
    margin = WIDER * (farthest - closest) + WIDER_FAR * farthest

    def as_tensor(array: NDArray[np.generic]) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    return DepthPhotos(
        as_tensor(views.images).permute(0, 3, 1, 2).contiguous() / 255.0,
        as_tensor(views.masks)[:, None],
        as_tensor(views.beyond)[:, None],
        as_tensor(views.intrinsics),
        as_tensor(views.object_from_cam),
        ~views.held_out,
        torch.as_tensor(_choose_sources(views, [ids for ids, _ in seen], sources), device=device),
        [pixels[ids % CHECK_EVERY != 0] for ids, pixels in seen],
        [pixels[ids % CHECK_EVERY == 0] for ids, pixels in seen],
        float(max(closest - margin, 0.2 * closest)),
        float(farthest + margin),
        float(np.linalg.norm(high - low)),
    )


def _points_on_object(views: Views) -> list[tuple[NDArray[np.int64], NDArray[np.float32]]]:
    """For each photo the SfM points it observes on the object, as `_observed`.

    A point belongs to the object when most photos that observe it have it in their mask: masks are a pixel or two wide
    of the outline, and a point far behind the object must not widen the depth range.
    """
    seen = [_observed(views, index) for index in range(len(views.names))]
    votes = np.zeros((2, len(views.sparse)), dtype=np.int64)
    for (ids, _), track in zip(seen, views.tracks):
        votes[0, ids] += 1
        votes[1, track] += 1
    belongs = votes[0] > SHARE_IN_MASKS * votes[1]
    return [(ids[belongs[ids]], pixels[belongs[ids]]) for ids, pixels in seen]


def _observed(views: Views, index: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Indices of the SfM points that photo `index` observes on the object, and their column, row and depth."""
    ids = views.tracks[index]
    pixels, depths = views.view(index).project(views.sparse[ids])
    in_front = depths > MIN_DEPTH
    ids, pixels, depths = ids[in_front], pixels[in_front], depths[in_front]
    height, width = views.masks.shape[1:]
    column, row = np.floor(pixels).astype(int).T
    keep = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    keep[keep] = views.masks[index][row[keep], column[keep]]
    return ids[keep], np.column_stack([pixels, depths])[keep].astype(np.float32)


def _choose_sources(views: Views, seen: list[NDArray[np.int64]], count: int) -> NDArray[np.int64]:
    """For each photo the best others: many shared points, seen under about 15 degrees (after MVSNet's pair score)."""
    centres = views.object_from_cam[:, :3, 3]
    middle = np.median(views.sparse[np.unique(np.concatenate(seen))], axis=0)
    rays = centres - middle
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(rays @ rays.T, -1.0, 1.0)))
    photo = np.repeat(np.arange(len(seen)), [len(ids) for ids in seen])
    observed = csr_matrix((np.ones(len(photo)), (photo, np.concatenate(seen))), shape=(len(seen), len(views.sparse)))
    shared = (observed @ observed.T).toarray()
    score = (shared + 1.0) * np.exp(-(((angle - BEST_ANGLE_DEG) / BEST_ANGLE_DEG) ** 2))
    score[:, views.held_out] = -1.0
    np.fill_diagonal(score, -2.0)
    available = int((~views.held_out).sum()) - 1
    return np.argsort(-score, axis=1, kind="stable")[:, : min(count, available)]
