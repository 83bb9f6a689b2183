"""Posed, masked photos in the NeRF's unit cube, the rays that training draws from them, and the losses along these."""

from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import huber_loss, max_pool2d

# Pixels beside the object are drawn from a ring of so many pixels around its mask: farther away the hull is empty.
RING_PX = 12
# Share of a photo's rays that are drawn beside the object: they teach that nothing is there.
OUTSIDE_SHARE = 0.1
# Samples and depths of one surface lie this near each other along a ray, as a share of the cube's side.
SURFACE_DEPTH = 0.05
# Where the ignored band would leave less than this share of a mask, all of it is drawn from: it is thin everywhere.
THIN_SHARE = 0.2
# Colours in 0..1 that differ by more than this count linearly: reflections and shadows are no noise.
COLOR_DELTA = 0.1
# Below this opacity a ray has no depth to speak of.
SOLID_OPACITY = 0.5
# Absolute depth is quadratic within this distance of the prior, in nerf units (the cube's side is 1).
DEPTH_DELTA = 0.01


@dataclass(frozen=True)
class PhotoTensors:
    """V photos on pictures of one size, in the frame of the unit cube ("nerf").

    Attributes:
        images: (V, H, W, 3) uint8 RGB.
        masks: (V, H, W) bool, True on the object.
        mattes: (V, H, W) uint8, the share of each pixel that is object, in 255ths.
        intrinsics: (V, 3, 3) float32, pixel centres at +0.5.
        rotation: (V, 3, 3) float32, nerf_from_cam rotations.
        center: (V, 3) float32 camera centres.
        depths: (V, H, W) float32 prior depth along z in nerf units, 0 where there is none.
        confidence: (V, H, W) float32 in 0..1, weight of the prior.
        hidden: (V, H, W) bool, pixels off the mask where something in front may hide the object, which are no proof of
            emptiness; None for none.
    """

    images: Tensor
    masks: Tensor
    mattes: Tensor
    intrinsics: Tensor
    rotation: Tensor
    center: Tensor
    depths: Tensor
    confidence: Tensor
    hidden: Tensor | None = None

    def __len__(self) -> int:
        return self.images.shape[0]

    def select(self, index: NDArray[np.int64]) -> "PhotoTensors":
        """The photos at these indices."""
        chosen = torch.from_numpy(np.asarray(index, dtype=np.int64))
        return PhotoTensors(**{name: part[chosen] for name, part in vars(self).items() if part is not None})

    def camera(self, view: int) -> tuple[Tensor, Tensor, Tensor]:
        """Intrinsics (3, 3), rotation (3, 3) and centre (3,) of one photo."""
        return self.intrinsics[view], self.rotation[view], self.center[view]


@dataclass(frozen=True)
class PixelPool:
    """Pixels that training draws from, view after view: `pixel` holds row * W + column, `start` (V + 1,) the bounds.

    Attributes:
        inside: pixels of the object, of which every view has some.
        inside_start: bounds of each view in `inside`.
        outside: pixels beside the object.
        outside_start: bounds of each view in `outside`.
    """

    inside: NDArray[np.int32]
    inside_start: NDArray[np.int64]
    outside: NDArray[np.int32]
    outside_start: NDArray[np.int64]


@dataclass(frozen=True)
class PixelBatch:
    """Rays of one step, image after image.

    Attributes:
        view: (R,) int64 index of the photo.
        uv: (R, 2) float32 pixel coordinates (centre of the pixel).
        inside: (R,) bool, drawn from the object's pixels; the others lie beside it.
        matte: (R,) float32 in 0..1, the share of the pixel that is object.
        color: (R, 3) float32 in 0..1.
        depth: (R,) float32 prior along z, 0 without one.
        confidence: (R,) float32.
    """

    view: Tensor
    uv: Tensor
    inside: Tensor
    matte: Tensor
    color: Tensor
    depth: Tensor
    confidence: Tensor

    def to(self, device: torch.device) -> "PixelBatch":
        """The same on a device."""
        return PixelBatch(**{name: part.to(device) for name, part in vars(self).items()})


def dilate(masks: Tensor, radius_px: int) -> Tensor:
    """Grow (V, H, W) bool masks by a square of half-width `radius_px`; negative radii shrink them."""
    if radius_px == 0:
        return masks
    size = 2 * abs(radius_px) + 1
    source = (masks if radius_px > 0 else ~masks).float()[:, None]
    rows = max_pool2d(source, (size, 1), stride=1, padding=(abs(radius_px), 0))
    grown = max_pool2d(rows, (1, size), stride=1, padding=(0, abs(radius_px)))[:, 0] > 0.5
    return grown if radius_px > 0 else ~grown


def pixel_pool(photos: PhotoTensors, band_px: int) -> PixelPool:
    """Split the pixels into inside, outside and an ignored band of `band_px` on both sides of the mask's edge.

    Args:
        photos: the training photos.
        band_px: half-width of the band that no loss touches; 0 draws from every pixel with some of the object in it.
    """
    whole = photos.masks if band_px else photos.mattes > 0
    inner = dilate(whole, -band_px)
    thin = inner.flatten(1).sum(1) < THIN_SHARE * whole.flatten(1).sum(1)
    inner[thin] = whole[thin]
    outer = dilate(whole, band_px)
    ring = dilate(outer, RING_PX) & ~outer
    if photos.hidden is not None:
        ring &= ~photos.hidden
    return PixelPool(*_flatten(inner), *_flatten(ring))


def _flatten(masks: Tensor) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Pixels of (V, H, W) masks, view after view, and the bounds (V + 1,) of each view."""
    views, pixels = np.nonzero(masks.flatten(1).numpy())
    return pixels.astype(np.int32), np.searchsorted(views, np.arange(len(masks) + 1))


def draw_batch(photos: PhotoTensors, pool: PixelPool, seed: int, step: int, images: int, rays: int) -> PixelBatch:
    """Draw `rays` pixels in each of `images` photos; the same seed and step give the same batch.

    Args:
        photos: the training photos.
        pool: their pixels.
        seed: seed of the run.
        step: training step.
        images: photos of the batch; drawn without repetition as far as they go.
        rays: pixels per photo.
    """
    rng = np.random.default_rng((seed, step))
    order = np.concatenate([rng.permutation(len(photos)) for _ in range(-(-images // len(photos)))])[:images]
    drawn = [_draw_pixels(pool, int(view), rays, rng) for view in order]
    flat = torch.from_numpy(np.concatenate([pixels for pixels, _ in drawn]))
    inside = np.arange(rays) >= np.array([outside for _, outside in drawn])[:, None]
    view = torch.from_numpy(np.repeat(order, rays))
    width = photos.images.shape[2]
    down, across = flat // width, flat % width
    return PixelBatch(
        view,
        torch.stack([across + 0.5, down + 0.5], dim=1).float(),
        torch.from_numpy(inside.reshape(-1)),
        photos.mattes[view, down, across].float() / 255.0,
        photos.images[view, down, across].float() / 255.0,
        photos.depths[view, down, across],
        photos.confidence[view, down, across],
    )


def _draw_pixels(pool: PixelPool, view: int, rays: int, rng: np.random.Generator) -> tuple[NDArray[np.int64], int]:
    """Pixels (R,) of one photo, and how many of them, the first ones, lie beside the object."""
    first, last = pool.inside_start[view : view + 2]
    ring_first, ring_last = pool.outside_start[view : view + 2]
    outside = round(rays * OUTSIDE_SHARE) if ring_last > ring_first else 0
    beside = pool.outside[rng.integers(ring_first, ring_last, outside)]
    inside = pool.inside[rng.integers(first, last, rays - outside)]
    return np.concatenate([beside, inside]).astype(np.int64), outside


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


@dataclass(frozen=True)
class LossWeights:
    """Weight of each loss; 0 switches one off. The paper names the losses and gives no weights (method N2)."""

    color_weight: float = 1.0
    """Photometric loss inside the mask."""
    depth_weight: float = 2.0
    """Absolute depth against the prior."""
    mask_weight: float = 0.1
    """Opacity against the mask."""
    sparsity_weight: float = 0.05
    """Density on rays that miss the object."""

    def by_name(self) -> dict[str, float]:
        """The weights by the names of their losses."""
        return {name.removesuffix("_weight"): weight for name, weight in asdict(self).items()}


def color_loss(predicted: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Huber loss of (R, 3) colours in 0..1, mean over the rays by weight (R,): 0 outside the mask."""
    error = huber_loss(predicted, target, reduction="none", delta=COLOR_DELTA).mean(1)
    return (error * weight).sum() / weight.sum().clamp(min=1)


def depth_loss(distance: Tensor, opacity: Tensor, prior: Tensor, weight: Tensor) -> Tensor:
    """Huber loss of the expected distance (R,) where the ray is solid and a prior exists (weight > 0) (method N4).

    In units of DEPTH_DELTA; mean over all rays with a prior.
    """
    valid = (weight > 0) & (opacity.detach() > SOLID_OPACITY)
    error = huber_loss(distance[valid], prior[valid], reduction="none", delta=DEPTH_DELTA) / DEPTH_DELTA
    return (error * weight[valid]).sum() / (weight > 0).sum().clamp(min=1)


def mask_loss(opacity: Tensor, matte: Tensor) -> Tensor:
    """Binary cross-entropy of opacity (R,) against the matte (R,) in 0..1 (method N5)."""
    clipped = opacity.clamp(1e-4, 1 - 1e-4)
    return torch.nn.functional.binary_cross_entropy(clipped, matte)


def sparsity_loss(sigma: Tensor, delta: Tensor, inside: Tensor) -> Tensor:
    """Mean opacity of the single samples (R, S) on rays that miss the object (method N5)."""
    empty = ~inside
    opacity = 1 - torch.exp(-sigma[empty] * delta[empty])
    return opacity.mean() if len(opacity) else sigma.sum() * 0
