"""Cutting every photo to its object, so that the networks spend their pixels there, and putting maps back."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.photos.views import Views

# Kept around a mask's box, share of the box: windows and warps at the outline need pixels beyond it.
MARGIN = 0.06
# The canvas fits the boxes of this percentage of the photos; larger ones are shrunk.
FITTING_PERCENT, SPARE_PX = 90, 8
MIN_CANVAS_PX = 32
# Sides of the canvas relative to each other: no more elongated than this.
MAX_ASPECT = 2.0
# A pixel of a moved map has a depth when at least this share of what it is made of has one; it is interpolated unless
# that differs from the nearest depth by more than this share, as at an edge.
MIN_KNOWN, EDGE = 0.3, 0.02
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

    def cut(self, index: int, depth: Map) -> Map:
        """(h, w) depth of a whole photo, of any size, on photo `index`'s canvas; 0 where there is none."""
        height, width = self.sizes[index]
        photo_from_map = np.diag([width / depth.shape[1], height / depth.shape[0]])
        a = self.crop_from_photo[index]
        return _moved(depth, np.column_stack([a[:, :2] @ photo_from_map, a[:, 2]]), self.views.masks.shape[1:])

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
    largest = np.minimum(np.minimum(ideal, np.percentile(extent, FITTING_PERCENT, axis=0) + SPARE_PX), [width, height])
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
    edge = (nearest > 0) & (np.abs(smooth - nearest) > EDGE * nearest)
    return np.where(share > MIN_KNOWN, np.where(edge, nearest, smooth), 0.0).astype(np.float32)


def _remap(source: Map, x: Map, y: Map, interpolation: int) -> Map:
    moved = cv2.remap(source, x, y, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(moved, dtype=np.float32)
