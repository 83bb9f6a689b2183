"""Stage 1's photos, cut to the object and as tensors, and the depth that its network starts from.

First depths lie between SfM points, and are measured by stereo (M7).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from scenefuse.cloud.cloud_file import NEIGHBOURS
from scenefuse.core.stage import StageError
from scenefuse.geometry.surface import ends_of
from scenefuse.mvs.plane_sweep import DepthMapSettings, estimate_depth
from scenefuse.mvs.sparse_depths import beside_mask, own_points, pair_worth
from scenefuse.nerf.monodepth import disparity_from_depth, points_in_cam
from scenefuse.photos.views import Views
from scenefuse.photos.workspace import View

# Every tenth SfM point is kept from training, to measure with.
CHECK_EVERY = 10
# The depth range is widened at both ends by this share of it.
RANGE_MARGIN = 0.15
# Kept around a mask's box, share of the box: windows and warps at the outline need pixels beyond it.
MARGIN = 0.06
# As for a scene's photos (M7), with smaller windows, because the cut photos are small.
STEREO = DepthMapSettings(sources=6, best_sources=2, window_px=5)
# Matching score at which stereo and SfM points count the same.
EVEN_SCORE = 0.3
Map = NDArray[np.float32]


@dataclass(frozen=True)
class Crops:
    """The photos cut out around their masks, all on canvases of one size.

    Attributes:
        views: the cut photos with intrinsics to match; beyond a photo, its border is repeated.
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
        height, width = self.sizes[index].tolist()
        move = cv2.invertAffineTransform(self.crop_from_photo[index])
        move[:, 2] += 0.5 * move[:, :2].sum(1) - 0.5  # OpenCV has pixel centres at integers
        photo = cv2.warpAffine(on_canvas, move, (width, height), borderMode=cv2.BORDER_REPLICATE)
        return np.where(self.masks[index, :height, :width], photo, np.float32(0))


def crop_to_object(views: Views, crop_px: int) -> Crops:
    """Cut each photo to the box around its mask.

    The canvas has the median shape of these boxes and about crop_px squared pixels; a cut is shrunk to fit, never
    enlarged. Sides are multiples of four. A photo whose mask is empty shows its middle.
    """
    height, width = views.masks.shape[1:]
    boxes = np.array([_box(mask) for mask in views.masks])
    extent = (boxes[:, 2:] - boxes[:, :2]) * (1 + 2 * MARGIN)
    aspect = float(np.median(extent[:, 0] / extent[:, 1]))
    ideal = np.array([crop_px * aspect**0.5, crop_px / aspect**0.5])
    largest = np.minimum(np.minimum(ideal, extent.max(0)), [width, height])
    # The network halves its maps four times.
    canvas = np.maximum(np.ceil(largest / 4) * 4, 2 * 2**4).astype(int)
    pictures: tuple[list[NDArray[np.uint8]], list[NDArray[np.uint8]]] = ([], [])
    intrinsics, moves = [], []
    for index, box in enumerate(boxes):
        shrink = min(1.0, *(canvas / extent[index]))
        size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
        scale = np.array(size) / [width, height]
        corner = np.round((box[:2] + box[2:]) / 2 * scale - canvas / 2).astype(int)
        move = np.column_stack([np.diag(scale), -corner])
        for parts, whole in zip(pictures, (views.images, views.mattes)):
            parts.append(_window(cv2.resize(whole[index], size, interpolation=cv2.INTER_AREA), corner, canvas))
        intrinsics.append(np.vstack([move, [0, 0, 1]]) @ views.intrinsics[index])
        moves.append(move)
    images, mattes = (np.stack(parts) for parts in pictures)
    nothing = np.zeros(mattes.shape, np.bool_)
    cut = replace(views, images=images, mattes=mattes, beyond=nothing, intrinsics=np.stack(intrinsics))
    return Crops(cut, np.stack(moves), views.masks, views.sizes)


def _box(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Left, top, right, bottom of the mask; the middle half of the photo when it is empty."""
    height, width = mask.shape
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return np.array([0.25 * width, 0.25 * height, 0.75 * width, 0.75 * height])
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], dtype=np.float64)


def _window(image: NDArray, corner: NDArray, canvas: NDArray) -> NDArray:
    """The canvas (width, height) whose top left pixel is `corner` of a photo, or of a matte, which is 0 beyond it."""
    (left, top), (width, height) = corner, canvas
    rows = np.clip(np.arange(top, top + height), 0, image.shape[0] - 1)
    columns = np.clip(np.arange(left, left + width), 0, image.shape[1] - 1)
    inside = (rows == np.arange(top, top + height))[:, None] & (columns == np.arange(left, left + width))
    window = image[rows][:, columns]
    return window if image.ndim == 3 else np.where(inside, window, 0)


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
        near: nearest depth the network can say, object units.
        far: farthest.
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
    low, high = ends_of(views.sparse[on_object])
    depths = np.concatenate([pixels[:, 2] for _, pixels in seen])
    closest, farthest = ends_of(depths)
    margin = RANGE_MARGIN * (farthest - closest) + 1e-3 * farthest  # a range of its own where all depths are equal

    def as_tensor(array: NDArray[np.generic]) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    return DepthPhotos(
        as_tensor(views.images).permute(0, 3, 1, 2).contiguous() / 255.0,
        as_tensor(views.masks)[:, None],
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
    """For each photo the SfM points of the object that it observes in its mask, and their column, row and depth."""
    own, seen = own_points(views), []
    for index, track in enumerate(views.tracks):
        rows, on_mask, _, pixels, depth = beside_mask(views, index, track)
        kept = on_mask & own[rows]
        seen.append((rows[kept], np.column_stack([pixels, depth])[kept].astype(np.float32)))
    return seen


def _choose_sources(views: Views, seen: list[NDArray[np.int64]], count: int) -> NDArray[np.int64]:
    """For each photo the best others to match it with: many shared points, seen under good angles."""
    centres, photos = views.object_from_cam[:, :3, 3], range(len(seen))
    shared = [[np.intersect1d(seen[k], seen[j], assume_unique=True) for j in photos] for k in photos]
    worth = np.array(
        [[pair_worth(views.sparse[shared[k][j]], centres[k], centres[j])[0] for j in photos] for k in photos]
    )
    worth[:, views.held_out] = -1.0
    np.fill_diagonal(worth, -2.0)
    available = int((~views.held_out).sum()) - 1
    return np.argsort(-worth, axis=1, kind="stable")[:, : min(count, available)]


@dataclass(frozen=True)
class NetworkInputs:
    """What the depth network is given of V photos.

    Attributes:
        channels: (V, 9, H, W): colour (3), mask, ray (2), disparity between SfM points, disparity by stereo, its score.
        first: (V, 1, H, W) disparity that the network corrects.
    """

    channels: Tensor
    first: Tensor


def network_inputs(photos: DepthPhotos, settings: DepthMapSettings | None = STEREO) -> NetworkInputs:
    """The network's input channels and the disparity it starts from.

    Args:
        photos: the photos.
        settings: of the stereo; None leaves it out.
    """
    count, _, height, width = photos.images.shape
    flat = torch.full((count, 1, height, width), 0.5, device=photos.images.device)
    ray = points_in_cam(torch.ones_like(flat), photos.intrinsics)[:, :2].view(count, 2, height, width)
    between = torch.cat([_between_points(photos, index) for index in range(count)])
    swept, score = flat, torch.zeros_like(flat)
    if settings is not None:
        pairs = [_swept(photos, index, settings) for index in range(count)]
        swept, score = torch.cat([d for d, _ in pairs]), torch.cat([s for _, s in pairs])
    weight = (score**4) / (score**4 + EVEN_SCORE**4)
    first = between + weight * (swept - between)
    colour = (photos.images * 2.0 - 1.0) * photos.masks
    channels = torch.cat([colour, photos.masks * 2 - 1, ray, between * 2 - 1, swept * 2 - 1, score], 1)
    return NetworkInputs(channels, first)


def _between_points(photos: DepthPhotos, index: int) -> Tensor:
    """(1, 1, H, W) disparity: inverse-distance mean of the nearest SfM points, with outliers left out."""
    height, width = photos.images.shape[2:]
    points = photos.points[index]
    if len(points) < 3:
        middle = np.median(np.concatenate([p[:, 2] for p in photos.points]))
        points = np.array([[width / 2, height / 2, middle]], dtype=np.float32)
    disparity = disparity_from_depth(torch.from_numpy(points[:, 2]), photos.near, photos.far).numpy()
    tree = cKDTree(points[:, :2])
    around = disparity[tree.query(points[:, :2], min(NEIGHBOURS, len(points)))[1].reshape(len(points), -1)]
    off = np.abs(disparity - np.median(around, axis=1))
    keep = off <= 4.0 * np.median(off) + 0.02
    rows, columns = np.indices((height, width)).reshape(2, -1) + 0.5
    near_by = min(NEIGHBOURS, int(keep.sum()))
    distance, neighbour = cKDTree(points[keep, :2]).query(np.column_stack([columns, rows]), near_by)
    distance, neighbour = distance.reshape(-1, near_by), neighbour.reshape(-1, near_by)
    weight = 1.0 / (distance**2 + 1.0)
    value = (disparity[keep][neighbour] * weight).sum(1) / weight.sum(1)
    return torch.from_numpy(value.astype(np.float32)).view(1, 1, height, width).to(photos.images.device)


def _swept(photos: DepthPhotos, index: int, settings: DepthMapSettings) -> tuple[Tensor, Tensor]:
    """(1, 1, H, W) disparity by stereo and its score in 0..1."""
    device = photos.images.device
    reference, *sources = (_gray(photos, row) for row in (index, *photos.sources[index][: settings.sources].tolist()))
    found = estimate_depth(reference, sources, photos.near, photos.far, settings, str(device))
    depth, score = (torch.from_numpy(maps)[None, None].to(device) for maps in (found.best, found.score))
    return disparity_from_depth(depth, photos.near, photos.far), score.clamp(0.0, 1.0)


def _gray(photos: DepthPhotos, index: int) -> View:
    """A photo in grey."""
    pixels = photos.images[index].mean(0).cpu().numpy()
    intrinsics = photos.intrinsics[index].double().cpu().numpy()
    pose = np.linalg.inv(photos.object_from_cam[index].double().cpu().numpy())
    return View(str(index), intrinsics, pose, pixels.shape[1], pixels.shape[0], pixels)
