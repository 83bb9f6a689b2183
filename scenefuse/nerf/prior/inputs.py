"""The photos of an object, cut to it and as tensors: depth range, photos to compare with, SfM points."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from torch import Tensor

from scenefuse.core.stage import StageError
from scenefuse.mvs.photo_refinement import BEST_ANGLE_DEG
from scenefuse.photos.views import Views

# Every tenth SfM point is kept from training, to measure with.
CHECK_EVERY = 10
# A point belongs to the object when this share of the photos that observe it have it in their mask.
MIN_IN_MASKS_SHARE = 0.7
# The depth range spans these percentiles of the points' depths, widened at both ends by a share of the range; the box
# around the object spans the percentiles of BOX_PERCENTILES.
DEPTH_PERCENTILES, BOX_PERCENTILES = (1, 99), (2, 98)
RANGE_MARGIN = 0.15
# Kept around a mask's box, share of the box: windows and warps at the outline need pixels beyond it.
MARGIN = 0.06
# The canvas fits the boxes of this percentage of the photos with some pixels to spare; larger ones are shrunk.
FITTING_PERCENT = 90
MIN_CANVAS_PX = 32
# Sides of the canvas relative to each other: no more elongated than this.
MAX_ASPECT = 2.0
# A pixel of a moved map has a depth when at least this share of what it is made of has one; it is interpolated unless
# that differs from the nearest depth by more than this share, as at an edge.
MIN_KNOWN_SHARE, EDGE_JUMP = 0.3, 0.02
Map = NDArray[np.float32]


@dataclass(frozen=True)
class Crops:
    """The photos cut out around their masks, all on canvases of one size.

    Attributes:
        views: the cut photos with intrinsics to match; each begins anywhere on its canvas, so `sizes` say nothing.
        crop_from_photo: (V, 2, 3) affine maps between pixels with centres at +0.5.
        masks: (V, H, W) bool, the masks of the whole photos.
        sizes: (V, 2) rows and columns of the whole photos (`Views.sizes`).
    """

    views: Views
    crop_from_photo: NDArray[np.float64]
    masks: NDArray[np.bool_]
    sizes: NDArray[np.int64]

    def paste(self, index: int, on_canvas: Map) -> Map:
        """(h, w) map of the whole photo from the one on photo `index`'s canvas; 0 off the object."""
        height, width = self.sizes[index]
        mask = self.masks[index, :height, :width]
        return _moved(on_canvas, cv2.invertAffineTransform(self.crop_from_photo[index]), mask.shape) * mask


def crop_to_object(views: Views, crop_px: int) -> Crops:
    """Cut each photo to the box around its mask.

    The canvas has the median shape of these boxes and about crop_px squared pixels; a cut is shrunk to fit, never
    enlarged. Sides are multiples of four. A photo whose mask is empty shows its middle.
    """
    height, width = views.masks.shape[1:]
    boxes = np.array([_box(mask) for mask in views.masks])
    extent = (boxes[:, 2:] - boxes[:, :2]) * (1 + 2 * MARGIN)
    aspect = float(np.clip(np.median(extent[:, 0] / extent[:, 1]), 1 / MAX_ASPECT, MAX_ASPECT))
    ideal = np.array([crop_px * aspect**0.5, crop_px / aspect**0.5])
    largest = np.minimum(np.minimum(ideal, np.percentile(extent, FITTING_PERCENT, axis=0) + 8), [width, height])
    canvas = np.maximum(np.round(largest / 4) * 4, MIN_CANVAS_PX).astype(int)
    wholes = {"images": views.images, "mattes": views.mattes, "known": (~views.beyond).astype(np.uint8)}
    parts: dict[str, list[NDArray[np.uint8]]] = {name: [] for name in wholes}
    intrinsics, moves = [], []
    for index, box in enumerate(boxes):
        shrink = min(1.0, *(canvas / extent[index]))
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        scale = np.array(size) / [width, height]
        corner = np.round((box[:2] + box[2:]) / 2 * scale - canvas / 2).astype(int)
        move = np.column_stack([np.diag(scale), -corner])
        for name, whole in wholes.items():
            smaller = cv2.resize(whole[index], size, interpolation=cv2.INTER_AREA)
            parts[name].append(_window(smaller, corner, canvas))
        intrinsics.append(np.vstack([move, [0, 0, 1]]) @ views.intrinsics[index])
        moves.append(move)
    images, mattes, known = (np.stack(pictures) for pictures in parts.values())
    cut = replace(views, images=images, mattes=mattes, beyond=known == 0, intrinsics=np.stack(intrinsics))
    return Crops(cut, np.stack(moves), views.masks, views.sizes)


def _box(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Left, top, right, bottom of the mask; the middle half of the photo when it is empty."""
    height, width = mask.shape
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return np.array([0.25 * width, 0.25 * height, 0.75 * width, 0.75 * height])
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], dtype=np.float64)


def _window(image: NDArray, corner: NDArray, canvas: NDArray) -> NDArray:
    """The canvas (width, height) whose top left pixel is `corner` of the image; the border is repeated."""
    (left, top), (width, height) = corner, canvas
    rows = np.clip(np.arange(top, top + height), 0, image.shape[0] - 1)
    columns = np.clip(np.arange(left, left + width), 0, image.shape[1] - 1)
    inside = (rows == np.arange(top, top + height))[:, None] & (columns == np.arange(left, left + width))
    window = image[rows][:, columns]
    return window if image.ndim == 3 else np.where(inside, window, 0)


def _moved(source: Map, target_from_source: NDArray[np.float64], size: tuple[int, ...]) -> Map:
    """A map with holes (0) on another raster: bilinear between valid pixels, nearest where they differ much."""
    inverse = cv2.invertAffineTransform(target_from_source)
    v, u = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5, indexing="ij")
    x, y = np.einsum("ij,jhw->ihw", inverse, np.stack([u, v, np.ones_like(u)])).astype(np.float32) - 0.5
    valid = (source > 0).astype(np.float32)
    share = _remap(valid, x, y, cv2.INTER_LINEAR)
    smooth = _remap(source, x, y, cv2.INTER_LINEAR) / np.maximum(share, 1e-6)
    nearest = _remap(source, x, y, cv2.INTER_NEAREST)
    edge = (nearest > 0) & (np.abs(smooth - nearest) > EDGE_JUMP * nearest)
    return np.where(share > MIN_KNOWN_SHARE, np.where(edge, nearest, smooth), 0.0).astype(np.float32)


def _remap(source: Map, x: Map, y: Map, interpolation: int) -> Map:
    moved = cv2.remap(source, x, y, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(moved, dtype=np.float32)


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
    low, high = np.percentile(views.sparse[on_object], BOX_PERCENTILES, axis=0)
    depths = np.concatenate([pixels[:, 2] for _, pixels in seen])
    closest, farthest = np.percentile(depths, DEPTH_PERCENTILES)
    margin = RANGE_MARGIN * (farthest - closest) + 1e-3 * farthest  # a range of its own where all depths are equal

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
    belongs = votes[0] > MIN_IN_MASKS_SHARE * votes[1]
    return [(ids[belongs[ids]], pixels[belongs[ids]]) for ids, pixels in seen]


def _observed(views: Views, index: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Indices of the SfM points that photo `index` observes on the object, and their column, row and depth."""
    ids = views.tracks[index]
    pixels, depths = views.view(index).project(views.sparse[ids])
    in_front = depths > 1e-6
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
