"""Posed, masked photos in the NeRF's unit cube, and the rays that training draws from them."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import max_pool2d

from scenefuse.transforms import Sim3

INSIDE, OUTSIDE = 0, 1


@dataclass(frozen=True)
class Photos:
    """V photos of one size, in the frame of the unit cube ("nerf").

    Attributes:
        images: (V, H, W, 3) uint8 RGB.
        masks: (V, H, W) bool, True on the object.
        mattes: (V, H, W) uint8, the share of each pixel that is object, in 255ths.
        intrinsics: (V, 3, 3) float32, pixel centres at +0.5.
        rotation: (V, 3, 3) float32, nerf_from_cam rotations.
        center: (V, 3) float32 camera centres.
        depths: (V, H, W) float32 prior depth along z in nerf units, 0 where there is none.
        confidence: (V, H, W) float32 in 0..1, weight of the prior.
    """

    images: Tensor
    masks: Tensor
    mattes: Tensor
    intrinsics: Tensor
    rotation: Tensor
    center: Tensor
    depths: Tensor
    confidence: Tensor

    def __len__(self) -> int:
        return self.images.shape[0]

    def select(self, index: NDArray[np.int64]) -> "Photos":
        """The photos at these indices."""
        chosen = torch.from_numpy(np.asarray(index, dtype=np.int64))
        return Photos(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Pool:
    """Pixels that training draws from, view after view: `pixel` holds row * W + column, `start` (V + 1,) the bounds.

    Attributes:
        inside: pixels of the object.
        inside_start: bounds of each view in `inside`.
        outside: pixels beside the object.
        outside_start: bounds of each view in `outside`.
        edge: (V, H, W) float32 in 0..1, 1 at mask edges and at jumps of the prior depth.
    """

    inside: NDArray[np.int32]
    inside_start: NDArray[np.int64]
    outside: NDArray[np.int32]
    outside_start: NDArray[np.int64]
    edge: Tensor


@dataclass(frozen=True)
class Batch:
    """Rays of one step, image after image.

    Attributes:
        view: (R,) int64 index of the photo.
        uv: (R, 2) float32 pixel coordinates (centre of the pixel).
        inside: (R,) bool, drawn from the object's pixels; the others lie beside it.
        matte: (R,) float32 in 0..1, the share of the pixel that is object.
        color: (R, 3) float32 in 0..1.
        depth: (R,) float32 prior along z, 0 without one.
        confidence: (R,) float32.
        edge: (R,) float32.
    """

    view: Tensor
    uv: Tensor
    inside: Tensor
    matte: Tensor
    color: Tensor
    depth: Tensor
    confidence: Tensor
    edge: Tensor


def dilate(masks: Tensor, radius_px: int) -> Tensor:
    """Grow (V, H, W) bool masks by a square of half-width `radius_px`; negative radii shrink them."""
    if radius_px == 0:
        return masks
    size = 2 * abs(radius_px) + 1
    source = (masks if radius_px > 0 else ~masks).float()[:, None]
    rows = max_pool2d(source, (size, 1), stride=1, padding=(abs(radius_px), 0))
    grown = max_pool2d(rows, (1, size), stride=1, padding=(0, abs(radius_px)))[:, 0] > 0.5
    return grown if radius_px > 0 else ~grown


def pixel_pool(photos: Photos, band_px: int, ring_px: int, edge_px: int) -> Pool:
    """Split the pixels into inside, outside and an ignored band of `band_px` on both sides of the mask's edge.

    Args:
        photos: the training photos.
        band_px: half-width of the band that no loss touches; 0 draws from every pixel with some of the object in it.
        ring_px: how far beyond the band outside pixels are drawn.
        edge_px: half-width of the zone around mask edges and depth jumps that counts as edge.
    """
    whole = photos.masks if band_px else photos.mattes > 0
    inner = dilate(whole, -band_px)
    few = inner.flatten(1).sum(1) < 0.2 * whole.flatten(1).sum(1)
    inner[few] = whole[few]
    outer = dilate(whole, band_px)
    ring = dilate(outer, ring_px) & ~outer
    inside, inside_start = _flatten(inner)
    outside, outside_start = _flatten(ring)
    border = dilate(photos.masks, 1) & ~dilate(photos.masks, -1)
    edges = dilate(border | depth_jumps(photos.depths), edge_px)
    return Pool(inside, inside_start, outside, outside_start, edges.float())


def depth_jumps(depths: Tensor, relative: float = 0.03) -> Tensor:
    """Pixels (V, H, W) whose depth differs from a neighbour's by more than `relative`; never those without depth."""
    jump = torch.zeros_like(depths, dtype=torch.bool)
    for axis in (1, 2):
        a, b = depths.narrow(axis, 0, depths.shape[axis] - 1), depths.narrow(axis, 1, depths.shape[axis] - 1)
        found = (a > 0) & (b > 0) & ((a - b).abs() > relative * torch.minimum(a, b))
        jump.narrow(axis, 0, depths.shape[axis] - 1).logical_or_(found)
        jump.narrow(axis, 1, depths.shape[axis] - 1).logical_or_(found)
    return jump


def _flatten(masks: Tensor) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    views, pixels = np.nonzero(masks.flatten(1).numpy())
    return pixels.astype(np.int32), np.searchsorted(views, np.arange(len(masks) + 1))


def draw_batch(photos: Photos, pool: Pool, seed: int, step: int, images: int, rays: int, outside: float) -> Batch:
    """Draw `rays` pixels in each of `images` photos; the same seed and step give the same batch.

    Args:
        photos: the training photos.
        pool: their pixels.
        seed: seed of the run.
        step: training step.
        images: photos of the batch; drawn without repetition as far as they go.
        rays: pixels per photo.
        outside: share of the pixels drawn outside the mask.
    """
    rng = np.random.default_rng((seed, step))
    order = np.concatenate([rng.permutation(len(photos)) for _ in range(-(-images // len(photos)))])[:images]
    count_out = round(rays * outside)
    pixel = np.empty((images, rays), dtype=np.int64)
    inside = np.zeros((images, rays), dtype=bool)
    for row, view in enumerate(order):
        first, last = pool.inside_start[view], pool.inside_start[view + 1]
        out_first, out_last = pool.outside_start[view], pool.outside_start[view + 1]
        outside_here = count_out if out_last > out_first else 0
        outside_here = rays if last == first else outside_here
        inside[row, outside_here:] = True
        if outside_here:
            pixel[row, :outside_here] = (
                pool.outside[rng.integers(out_first, out_last, outside_here)] if out_last > out_first else 0
            )
        if outside_here < rays:
            pixel[row, outside_here:] = pool.inside[rng.integers(first, last, rays - outside_here)]
    width = photos.images.shape[2]
    view = torch.from_numpy(np.repeat(order, rays))
    flat = torch.from_numpy(pixel.reshape(-1))
    down, across = flat // width, flat % width
    return Batch(
        view,
        torch.stack([across + 0.5, down + 0.5], dim=1).float(),
        torch.from_numpy(inside.reshape(-1)),
        photos.mattes[view, down, across].float() / 255.0,
        photos.images[view, down, across].float() / 255.0,
        photos.depths[view, down, across],
        photos.confidence[view, down, across],
        pool.edge[view, down, across],
    )


def camera_rays(intrinsics: Tensor, rotation: Tensor, center: Tensor, uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rays through pixels.

    Args:
        intrinsics: (R, 3, 3).
        rotation: (R, 3, 3) nerf_from_cam.
        center: (R, 3) camera centres.
        uv: (R, 2) pixel coordinates, centres at +0.5.

    Returns:
        origins (R, 3), unit directions (R, 3), and (R,) the length of ray per unit of depth along z.
    """
    x = (uv[:, 0] - intrinsics[:, 0, 2]) / intrinsics[:, 0, 0]
    y = (uv[:, 1] - intrinsics[:, 1, 2]) / intrinsics[:, 1, 1]
    in_camera = torch.stack([x, y, torch.ones_like(x)], dim=1)
    length = in_camera.norm(dim=1)
    direction = (rotation @ (in_camera / length[:, None])[:, :, None])[:, :, 0]
    return center, direction, length


def cube_from_cameras(
    masks: NDArray[np.bool_], intrinsics: NDArray[np.float64], object_from_cam: NDArray[np.float64]
) -> Sim3:
    """A generous cube around the object from masks and cameras alone: unit_from_object.

    Its centre is the point nearest to the viewing rays of the masks' centres; its size follows from their extents.

    Raises:
        ValueError: fewer than two photos have a mask.
    """
    normal, right, rays, angles = np.zeros((3, 3)), np.zeros(3), [], []
    for mask, k, pose in zip(masks, intrinsics, object_from_cam):
        rows, columns = np.nonzero(mask)
        if len(rows) < 16:
            continue
        box = np.percentile(columns, [0.5, 99.5]), np.percentile(rows, [0.5, 99.5])
        middle = np.array([box[0].mean() + 0.5, box[1].mean() + 0.5, 1.0])
        direction = pose[:3, :3] @ np.linalg.solve(k, middle)
        direction /= np.linalg.norm(direction)
        project = np.eye(3) - np.outer(direction, direction)
        normal, right = normal + project, right + project @ pose[:3, 3]
        rays.append(pose[:3, 3])
        angles.append(0.5 * np.hypot(np.ptp(box[0]) / k[0, 0], np.ptp(box[1]) / k[1, 1]))
    if len(rays) < 2:
        raise ValueError("fewer than two photos have a mask of the object")
    center = np.linalg.solve(normal, right)
    radius = max(np.percentile(np.linalg.norm(np.array(rays) - center, axis=1) * np.array(angles), 90), 1e-9)
    scale = 0.5 / (1.5 * radius)
    return Sim3(scale, np.eye(3), 0.5 - scale * center)
