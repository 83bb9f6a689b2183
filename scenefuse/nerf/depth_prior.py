"""Stage 1 of an object: depth of every photo by stereo and from SfM points, moved to where photos match, and confirmed
by other views."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import NEIGHBOURS
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import StageError, atomic_directory, quantity, threads, value, write_json
from scenefuse.core.transforms import Array
from scenefuse.geometry.surface import ends_of
from scenefuse.mvs.plane_sweep import DepthMapSettings, estimate_depth
from scenefuse.mvs.sparse_depths import MIN_SHARED_POINTS, beside_mask, own_points, pair_worth
from scenefuse.mvs.stereo_points import FEW_POINTS, gray, with_enough_points
from scenefuse.nerf.rendered_maps import MAP_AGREEMENT, confirm, write_prior
from scenefuse.photos.views import Views, load_views

# Stereo sees photos cut to the object, about this many pixels squared.
CROP_PX = 144
# The depth range is widened at both ends by this share of it.
RANGE_MARGIN = 0.15
# Kept around a mask's box, share of the box: windows and warps at the outline need pixels beyond it.
MARGIN = 0.06
# As for a scene's photos (M7), with smaller windows, because the cut photos are small.
STEREO = DepthMapSettings(sources=6, best_sources=2, window_px=5)
# Matching score at which stereo and SfM points count the same.
EVEN_SCORE = 0.3
Map = NDArray[np.float32]


def estimate_depth_prior(
    *,
    workspace: Path,
    masks: Path,
    stage: Path,
    report: Path,
    width_px: int,
    hold_out_every: int,
    crop_px: int = CROP_PX,
    map_agreement: float = MAP_AGREEMENT,
) -> None:
    """Write a depth map for each photo of one object.

    Depths are along z, in object units, 0 off the object: by stereo where photos match, between SfM points elsewhere,
    then moved to where photos match at full size, and marked by which other views confirm them (methods N10, N4).

    Args:
        workspace: undistorted COLMAP workspace of the object.
        masks: folder of masks named like the photos, .png.
        stage: output folder: depth_maps/{photo}.bin and confidence_maps/{photo}.bin (0..1).
        report: output JSON: photos, shares of the depths that photos moved, contradicted, confirmed, seconds.
        width_px: width of the depth maps, that of the NeRF's photos.
        hold_out_every: every n-th photo helps no other photo's depth; 0 holds out none.
        crop_px: pixels squared of the photos cut to the object.
        map_agreement: two depths of one place agree within this share of the object's diagonal.

    Raises:
        StageError: no photo with a mask, fewer than three photos, or fewer than eight points on the object, those by
            coarse stereo included.
    """
    start = time.monotonic()
    use_threads(threads())
    photos = load_views(workspace, masks, width_px, hold_out_every)
    views = with_enough_points(photos)
    crops = crop_to_object(views, crop_px)
    known = points_on_object(crops.views, STEREO.sources)
    depths = np.zeros(views.masks.shape, np.float32)
    for index, (place, (height, width)) in enumerate(zip(depths, views.sizes.tolist())):
        place[:height, :width] = crops.paste(index, first_depth(crops.views, known, index))
    prior, shares = confirm(views, depths, map_agreement=map_agreement)
    with atomic_directory(stage) as folder:
        write_prior(folder, views, prior)
    content = {"photos": quantity(len(views.names), "1"), **shares}
    if views is not photos:
        content["fallback"] = quantity(FEW_POINTS, "")
    write_json(report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    print(f"depth maps written: {value(content, 'confirmed_share'):.0%} of the object confirmed by other views")


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
    enlarged. Sides are multiples of four.
    """
    height, width = views.masks.shape[1:]
    boxes = np.array([_box(mask) for mask in views.masks])
    extent = (boxes[:, 2:] - boxes[:, :2]) * (1 + 2 * MARGIN)
    aspect = float(np.median(extent[:, 0] / extent[:, 1]))
    ideal = np.array([crop_px * aspect**0.5, crop_px / aspect**0.5])
    largest = np.minimum(np.minimum(ideal, extent.max(0)), [width, height])
    canvas = np.maximum(np.ceil(largest / 4) * 4, 32).astype(int)
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
    """Left, top, right, bottom of a mask that is not empty."""
    rows, columns = np.nonzero(mask)
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
class ObjectPoints:
    """The SfM points on an object, and what they say of its V photos.

    Attributes:
        ids: V arrays of the points that each photo observes on the object.
        pixels: V float32 arrays (N, 3): their column, row (pixels) and depth (object units).
        sources: (V, S) indices of the photos that each photo is matched with, best first, never held out.
        near, far: (V,) depths between which the surface is, object units.
    """

    ids: list[NDArray[np.int64]]
    pixels: list[NDArray[np.float32]]
    sources: NDArray[np.int64]
    near: Array
    far: Array


def points_on_object(views: Views, sources: int) -> ObjectPoints:
    """The SfM points that photos observe in their masks, the depth range, and at most so many sources of each photo.

    Raises:
        StageError: fewer than three photos to match with, or fewer than eight SfM points on the object.
    """
    if (~views.held_out).sum() < 3:
        raise StageError(
            f"only {(~views.held_out).sum()} photos with a mask can be trained on; depth needs at least 3: "
            "take more photos around the object, or set object.hold_out_every to 0"
        )
    own, ids, pixels = own_points(views), [], []
    for index, track in enumerate(views.tracks):
        rows, on_mask, _, place, depth = beside_mask(views, index, track)
        kept = on_mask & own[rows]
        ids.append(rows[kept])
        pixels.append(np.column_stack([place, depth])[kept].astype(np.float32))
    on_object = np.unique(np.concatenate(ids))
    if len(on_object) < MIN_SHARED_POINTS:
        raise StageError(
            f"only {len(on_object)} points lie on the object in all photos; depth needs at least 8: "
            "check that the masks show the object, and that the photos are sharp"
        )
    chosen = _choose_sources(views, ids, sources)
    # Of each photo by what it and its sources observe: others may have been taken from far nearer or farther.
    around = [np.unique(np.concatenate([ids[k] for k in (index, *others)])) for index, others in enumerate(chosen)]
    depths = [views.view(index).visible(views.sparse[rows])[2] for index, rows in enumerate(around)]
    every = np.concatenate(depths)
    ends = [ends_of(depth if len(depth) >= MIN_SHARED_POINTS else every) for depth in depths]
    closest, farthest = np.array(ends).T
    margin = RANGE_MARGIN * (farthest - closest) + 1e-3 * farthest  # a range of its own where all depths are equal
    return ObjectPoints(ids, pixels, chosen, np.maximum(closest - margin, 0.2 * closest), farthest + margin)


def _choose_sources(views: Views, seen: list[NDArray[np.int64]], count: int) -> NDArray[np.int64]:
    """For each photo the best others to match it with: many shared points, seen under good angles."""
    centres, worth = views.object_from_cam[:, :3, 3], np.full((len(seen), len(seen)), -2.0)
    for k, j in zip(*np.triu_indices(len(seen), 1)):
        shared = views.sparse[np.intersect1d(seen[k], seen[j], assume_unique=True)]
        worth[k, j], worth[j, k] = (pair_worth(shared, *pair)[0] for pair in (centres[[k, j]], centres[[j, k]]))
    worth[:, views.held_out] = -1.0
    np.fill_diagonal(worth, -2.0)
    available = int((~views.held_out).sum()) - 1
    return np.argsort(-worth, axis=1, kind="stable")[:, : min(count, available)]


def first_depth(views: Views, known: ObjectPoints, index: int) -> Map:
    """(H, W) depth of a photo: inverse depths by stereo and between SfM points, weighted by stereo's score."""
    between = _between_points(views, known, index)
    reference, *sources = (gray(views.view(row)) for row in (index, *known.sources[index].tolist()))
    device = "cuda" if torch.cuda.is_available() else "cpu"
    near, far = float(known.near[index]), float(known.far[index])
    found = estimate_depth(reference, sources, near, far, STEREO, device)
    score = found.score.clip(0, 1) ** 4
    swept = 1 / found.best.clip(near, far)
    return (1 / (between + score / (score + EVEN_SCORE**4) * (swept - between))).astype(np.float32)


def _between_points(views: Views, known: ObjectPoints, index: int) -> Array:
    """(H, W) inverse depth of a photo: inverse-distance mean of the nearest SfM points, with outliers left out."""
    height, width = views.masks.shape[1:]
    points = known.pixels[index]
    if len(points) < 3:
        middle = np.median(np.concatenate([pixels[:, 2] for pixels in known.pixels]))
        points = np.array([[width / 2, height / 2, middle]], dtype=np.float32)
    near, far = known.near[index], known.far[index]
    inverse = 1 / points[:, 2].astype(np.float64).clip(near, far)
    tree = cKDTree(points[:, :2])
    around = inverse[tree.query(points[:, :2], min(NEIGHBOURS, len(points)))[1].reshape(len(points), -1)]
    off = np.abs(inverse - np.median(around, axis=1))
    keep = off <= 4.0 * np.median(off) + 0.02 * (1 / near - 1 / far)
    rows, columns = np.indices((height, width)).reshape(2, -1) + 0.5
    near_by = min(NEIGHBOURS, int(keep.sum()))
    distance, neighbour = cKDTree(points[keep, :2]).query(np.column_stack([columns, rows]), near_by)
    distance, neighbour = distance.reshape(-1, near_by), neighbour.reshape(-1, near_by)
    weight = 1.0 / (distance**2 + 1.0)
    return ((inverse[keep][neighbour] * weight).sum(1) / weight.sum(1)).reshape(height, width)
