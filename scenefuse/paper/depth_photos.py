"""The photos of an object as tensors, for the paper's networks; depth maps laid on the SfM points of their photos."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import siegelslopes
from torch import Tensor

from scenefuse.cloud.clouds import NEIGHBOURS
from scenefuse.core.transforms import Array
from scenefuse.geometry.surface import ends_of
from scenefuse.nerf.depth_prior import points_on_object
from scenefuse.paper.monodepth import sample
from scenefuse.photos.views import Views

# Every tenth SfM point is kept from alignment, to measure with.
CHECK_EVERY = 10


@dataclass(frozen=True)
class DepthPhotos:
    """The V photos of an object as tensors.

    Attributes:
        images: (V, 3, H, W) in 0..1.
        masks: (V, 1, H, W) zeros and ones.
        intrinsics: (V, 3, 3).
        object_from_cam: (V, 4, 4).
        trained: (V,) bool, False for held-out photos.
        sources: (V, S) indices of the photos each photo is compared with, best first, never held out.
        points: V float32 arrays (N, 3): column, row (pixels) and depth of the SfM points on the object.
        checks: as `points`: every tenth SfM point, never shown to the network, to measure with.
        near: nearest depth of the object, its units.
        diagonal: diagonal of the box around the object's SfM points, object units.
    """

    images: Tensor
    masks: Tensor
    intrinsics: Tensor
    object_from_cam: Tensor
    trained: NDArray[np.bool_]
    sources: Tensor
    points: list[NDArray[np.float32]]
    checks: list[NDArray[np.float32]]
    near: float
    diagonal: float

    def source_from_target(self, target: Tensor, source: Tensor) -> Tensor:
        """(..., 4, 4) SfM transforms between photos given by index, broadcast against each other."""
        return torch.linalg.inv(self.object_from_cam[source]) @ self.object_from_cam[target]


def depth_photos(views: Views, sources: int, device: torch.device) -> DepthPhotos:
    """Views as tensors, with depth range and source photos; errors as of `points_on_object`."""
    known = points_on_object(views, sources)
    low, high = ends_of(views.sparse[np.unique(np.concatenate(known.ids))])
    pairs = list(zip(known.ids, known.pixels))
    return DepthPhotos(
        *pictures(views, device),
        torch.as_tensor(views.object_from_cam, dtype=torch.float32, device=device),
        ~views.held_out,
        torch.as_tensor(known.sources, device=device),
        [pixels[ids % CHECK_EVERY != 0] for ids, pixels in pairs],
        [pixels[ids % CHECK_EVERY == 0] for ids, pixels in pairs],
        float(known.near.min()),
        float(np.linalg.norm(high - low)),
    )


def pictures(views: Views, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """The (V, 3, H, W) images in 0..1, (V, 1, H, W) masks and (V, 3, 3) intrinsics of views."""
    images, masks, intrinsics = (
        torch.as_tensor(array, dtype=torch.float32, device=device)
        for array in (views.images, views.masks, views.intrinsics)
    )
    return images.permute(0, 3, 1, 2).contiguous() / 255.0, masks[:, None], intrinsics


def align_maps(raw: Tensor, photos: DepthPhotos) -> Tensor:
    """Each (1, H, W) depth map aligned to the SfM points of its photo, never to those kept for checking."""
    aligned = []
    for maps, predicted, points in zip(raw, depths_at(raw, photos.points), photos.points):
        scale, shift = align_to_points(predicted, points[:, 2].astype(np.float64))
        aligned.append((scale * maps + shift).clamp_min(1e-3 * photos.near))
    return torch.stack(aligned)


def align_to_points(predicted: Array, measured: Array) -> tuple[float, float]:
    """Robust (scale, shift) with measured = scale * predicted + shift; 30 % and more outliers do no harm.

    Repeated medians (Siegel 1982). The shift is used, and the scale differs from one, only where each lowers the median
    residual by more than its sampling error, 1 / sqrt(N): with few points the depth map itself is the better evidence
    (method N1).

    Args:
        predicted: (N,) depths of the map at SfM points.
        measured: (N,) depths of those points.
    """
    if len(predicted) < NEIGHBOURS:
        return 1.0, 0.0

    line = siegelslopes(measured, predicted)
    options = [(1.0, 0.0), (float(np.median(measured / predicted)), 0.0), (float(line.slope), float(line.intercept))]
    costs = [
        float(np.median(np.abs(scale * predicted + shift - measured))) * (1 + free / np.sqrt(len(predicted)))
        for free, (scale, shift) in enumerate(options)
    ]
    return options[int(np.nanargmin(costs))]


def depths_at(maps: Tensor, points: list[NDArray[np.float32]]) -> list[Array]:
    """Depths of (V, 1, H, W) maps at each photo's points (N, 3; column, row, depth): V arrays."""
    pixels = (torch.from_numpy(of_photo[None, :, :2]).to(maps.device) for of_photo in points)
    return [sample(depth[None], at)[0, 0].double().cpu().numpy() for depth, at in zip(maps, pixels)]


def residual_at_checks(depth: Tensor, photos: DepthPhotos) -> float | None:
    """Median relative residual at the SfM points that no training saw; None where there are none."""
    pairs = zip(depths_at(depth, photos.checks), photos.checks)
    residuals = np.concatenate([np.abs(found / points[:, 2] - 1.0) for found, points in pairs])
    return float(np.median(residuals)) if len(residuals) else None
