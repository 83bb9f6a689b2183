"""What the depth network is given: photos, depth range, source views, sparse SfM depth and a plane sweep."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from scenefuse.depth.networks import depth_from_disparity, disparity_from_depth
from scenefuse.depth.self_supervision import plane_sweep, points_in_cam
from scenefuse.mvs.views import Views
from scenefuse.stage import StageError

BEST_ANGLE_DEG = 15.0
CHECK_EVERY = 10
WINDOW_PX = 5
COARSE_WINDOW_PX = 3
MEDIAN_PX = 5
SWEEP_SOURCES = 4
FINE_STEPS = 3


@dataclass(frozen=True)
class Frames:
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


def make_frames(views: Views, sources: int, device: torch.device) -> Frames:
    """Turn Views into tensors, find the depth range, and choose the source photos.

    Raises:
        StageError: fewer than three photos to train on, or fewer than eight SfM points on the object.
    """
    if (~views.held_out).sum() < 3:
        raise StageError(
            f"only {(~views.held_out).sum()} photos with a mask can be trained on; depth needs at least 3: "
            "take more photos around the object, or lower hold_out_every"
        )
    seen = _points_on_object(views)
    on_object = np.unique(np.concatenate([ids for ids, _ in seen]))
    if len(on_object) < 8:
        raise StageError(
            f"only {len(on_object)} SfM points lie on the object in all photos; depth needs at least 8: "
            "check that the masks show the object, and that the photos are sharp"
        )
    low, high = np.percentile(views.sparse[on_object], [2, 98], axis=0)
    depths = np.concatenate([pixels[:, 2] for _, pixels in seen])
    closest, farthest = np.percentile(depths, [1, 99])
    margin = 0.15 * (farthest - closest) + 1e-3 * farthest

    def as_tensor(array: NDArray[np.generic]) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    return Frames(
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


def network_inputs(frames: Frames, planes: int) -> tuple[Tensor, Tensor, Tensor]:
    """The network's input channels and the disparity it starts from.

    Args:
        frames: the photos.
        planes: depth hypotheses of the plane sweep; 0 leaves the sweep out.

    Returns:
        (V, 9, H, W) inputs: colour (3), mask, ray (2), disparity between SfM points, sweep disparity, sweep score;
        (V, 1, H, W) first disparity; (V, 1, H, W) disparity between SfM points.
    """
    count, _, height, width = frames.images.shape
    flat = torch.full((count, 1, height, width), 0.5, device=frames.images.device)
    ray = points_in_cam(torch.ones_like(flat), frames.intrinsics)[:, :2].view(count, 2, height, width)
    interpolated = torch.cat([_between_points(frames, index) for index in range(count)])
    swept, score = flat, torch.zeros_like(flat)
    if planes > 0:
        pairs = [_sweep(frames, index, planes) for index in range(count)]
        swept, score = torch.cat([d for d, _ in pairs]), torch.cat([s for _, s in pairs])
    trust = (score**4) / (score**4 + 0.3**4)
    first = interpolated + trust * (swept - interpolated)
    colour = (frames.images * 2.0 - 1.0) * frames.masks
    inputs = torch.cat([colour, frames.masks * 2 - 1, ray, interpolated * 2 - 1, swept * 2 - 1, score], 1)
    return inputs, first, interpolated


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
    belongs = votes[0] > 0.7 * votes[1]
    return [(ids[belongs[ids]], pixels[belongs[ids]]) for ids, pixels in seen]


def _observed(views: Views, index: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Indices of the SfM points that photo `index` observes on the object, and their column, row and depth."""
    ids = views.tracks[index]
    pose = views.object_from_cam[index]
    points = (views.sparse[ids] - pose[:3, 3]) @ pose[:3, :3]
    in_front = points[:, 2] > 1e-6
    ids, points = ids[in_front], points[in_front]
    pixels = points @ views.intrinsics[index].T
    pixels = pixels[:, :2] / pixels[:, 2:]
    height, width = views.masks.shape[1:]
    column, row = np.floor(pixels).astype(int).T
    keep = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    keep[keep] = views.masks[index][row[keep], column[keep]]
    return ids[keep], np.column_stack([pixels, points[:, 2]])[keep].astype(np.float32)


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


def _between_points(frames: Frames, index: int) -> Tensor:
    """(1, 1, H, W) disparity: inverse-distance mean of the eight nearest SfM points, with outliers left out."""
    height, width = frames.images.shape[2:]
    points = frames.points[index]
    if len(points) < 3:
        middle = np.median(np.concatenate([p[:, 2] for p in frames.points]))
        points = np.array([[width / 2, height / 2, middle]], dtype=np.float32)
    disparity = disparity_from_depth(torch.from_numpy(points[:, 2]), frames.near, frames.far).numpy()
    tree = cKDTree(points[:, :2])
    around = disparity[tree.query(points[:, :2], min(7, len(points)))[1].reshape(len(points), -1)]
    off = np.abs(disparity - np.median(around, axis=1))
    keep = off <= 4.0 * np.median(off) + 0.02
    rows, columns = np.indices((height, width)).reshape(2, -1) + 0.5
    near_by = min(8, int(keep.sum()))
    distance, neighbour = cKDTree(points[keep, :2]).query(np.column_stack([columns, rows]), near_by)
    distance, neighbour = distance.reshape(-1, near_by), neighbour.reshape(-1, near_by)
    weight = 1.0 / (distance**2 + 1.0)
    value = (disparity[keep][neighbour] * weight).sum(1) / weight.sum(1)
    return torch.from_numpy(value.astype(np.float32)).view(1, 1, height, width).to(frames.images.device)


def _sweep(frames: Frames, index: int, planes: int) -> tuple[Tensor, Tensor]:
    """(1, 1, H, W) disparity of the plane sweep and its score in 0..1; flat off the object.

    All planes at half size first; then, at full size, a few finer steps around what each pixel found there.
    """
    device = frames.images.device
    height, width = frames.images.shape[2:]
    disparity = torch.full((1, 1, height, width), 0.5, device=device)
    score = torch.zeros_like(disparity)
    rows, columns = torch.nonzero(frames.masks[index, 0], as_tuple=True)
    if len(rows) == 0:
        return disparity, score
    top, bottom = max(int(rows.min()) - WINDOW_PX, 0) // 2 * 2, min(int(rows.max()) + WINDOW_PX + 1, height)
    left, right = max(int(columns.min()) - WINDOW_PX, 0) // 2 * 2, min(int(columns.max()) + WINDOW_PX + 1, width)
    cut = (slice(top, bottom), slice(left, right))
    coarse_size = ((bottom - top + 1) // 2, (right - left + 1) // 2)
    steps = torch.linspace(0.0, 1.0, planes, device=device)[:, None, None]
    coarse, _ = _best_hypothesis(frames, index, cut, steps.expand(-1, *coarse_size), 2)
    around = functional.interpolate(coarse[None, None], size=(bottom - top, right - left), mode="bilinear")[0]
    finer = torch.arange(-FINE_STEPS, FINE_STEPS + 1, device=device)[:, None, None] / (2.0 * (planes - 1))
    fine, certain = _best_hypothesis(frames, index, cut, around + finer, 1)
    disparity[0, 0, top:bottom, left:right] = fine.clamp(0.0, 1.0)
    score[0, 0, top:bottom, left:right] = certain
    return disparity, score


def _best_hypothesis(
    frames: Frames, index: int, cut: tuple[slice, slice], hypotheses: Tensor, shrink: int
) -> tuple[Tensor, Tensor]:
    """Disparity with the best score among (D, h, w) equidistant hypotheses, to a fraction of a step, and its score."""
    chosen = frames.sources[index][:SWEEP_SOURCES]
    image, sources, silhouettes = (
        frames.images[index : index + 1].mean(1, keepdim=True),
        frames.images[chosen].mean(1, keepdim=True),
        functional.max_pool2d(frames.masks[chosen], 5, 1, 2),
    )
    of_cut, of_sources = frames.intrinsics[index : index + 1].clone(), frames.intrinsics[chosen].clone()
    of_cut[:, 0, 2] -= cut[1].start
    of_cut[:, 1, 2] -= cut[0].start
    image = image[:, :, cut[0], cut[1]]
    if shrink > 1:
        image, sources, silhouettes = (
            functional.avg_pool2d(x, shrink, ceil_mode=True, count_include_pad=False)
            for x in (image, sources, silhouettes)
        )
        of_cut[:, :2] /= shrink
        of_sources[:, :2] /= shrink
    depths = depth_from_disparity(hypotheses.clamp(0.0, 1.0), frames.near, frames.far)
    moves = frames.source_from_target(torch.full_like(chosen, index), chosen)
    window = WINDOW_PX if shrink == 1 else COARSE_WINDOW_PX
    scores = plane_sweep(image, sources, depths, moves, of_cut, of_sources, silhouettes, window)
    best = scores.argmax(0)[None]
    last = len(hypotheses) - 1
    before, here, after = (scores.gather(0, (best + step).clamp(0, last))[0] for step in (-1, 0, 1))
    shift = ((after - before) / (2 * (2 * here - before - after)).clamp_min(1e-6)).clamp(-0.5, 0.5)
    found = hypotheses.gather(0, best)[0] + shift * (hypotheses[1] - hypotheses[0])
    smooth = cv2.medianBlur(found.cpu().numpy().astype(np.float32), MEDIAN_PX)
    return torch.from_numpy(smooth).to(found.device), here.clamp(0.0, 1.0)
