"""What photos of one object differ in beside their view: exposure, white balance, vignetting, sharpness.

Colours are those of the files, 0..1, as a tone curve left them. Where the curve is a power of the light, which gamma
is, a factor of the light is a factor of the colour: so a gain per photo and channel stands for exposure and white
balance.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, max_pool2d, pad

from scenefuse.core.transforms import DEPTH_JUMP
from scenefuse.nerf.field import Field
from scenefuse.nerf.rays import COLOR_DELTA, PhotoTensors, dilate
from scenefuse.nerf.render import Occupancy, render_view

# Colours of a place are compared in photos shrunk to at most this width: depths need not be exact to a pixel for it.
SMALL_PX = 96
# A place is compared in the photos taken nearest to the one it is found in, where both show it.
COMPARED_PHOTOS = 24
MIN_OPACITY = 0.9
# Pixels nearer to black are mostly noise, and nearer to white mostly clipped.
COLOR_MARGIN = 0.03
# A photo that was not trained on gets the mean gains of this many nearest training photos.
GAIN_NEIGHBOURS = 2
# Sharpness compares details finer than a Gaussian's sigma of one pixel with those between it and this one.
COARSE_PX = 3.0
# A photo is blurred with less than this share of the median sharpness of those that it is compared with.
MIN_SHARPNESS_SHARE = 0.7


@dataclass
class Appearance:
    """Log gains (V, 3) of V photos' red, green and blue, and the coefficient () of one vignetting for all of them.

    The vignetting is exp(a r^2), a <= 0, r = 0 at the principal point and 1 at half the picture's diagonal from it: the
    first term of the even polynomial of Goldman, "Vignette and exposure calibration and compensation" (2010). More
    terms would be extrapolated, as objects seldom reach the corners. Photos determine gains up to one factor per
    channel, which is fixed by a mean log gain of 0.
    """

    log_gain: Tensor
    falloff: Tensor

    @classmethod
    def none(cls, photos: int, device: str) -> "Appearance":
        """All photos alike."""
        return cls(torch.zeros(photos, 3, device=device), torch.zeros((), device=device))

    def factor(self, view: Tensor, radius2: Tensor) -> Tensor:
        """(R, 3) what colours of the field are multiplied by in photos `view` (R,) at squared radii (R,)."""
        return torch.exp(self.log_gain[view] + (self.falloff * radius2)[:, None])


def find_appearance(field: Field, occupancy: Occupancy, photos: PhotoTensors, samples: int) -> Appearance:
    """Gains and vignetting from the places that several photos show, as the field's depths have them.

    The field's own colours are not used: they depend on the direction of view, and could take over whatever differs
    smoothly from photo to photo.
    """
    small = shrunk(photos)
    views = [
        render_view(field, occupancy, small.camera(view), mask, samples, colored=False)
        for view, mask in enumerate(small.masks)
    ]
    depths = torch.stack([torch.where(view.opacity > MIN_OPACITY, view.depth, 0.0) for view in views])
    shared = shared_colors(small, depths)
    found = solved(shared, len(photos))
    device = field.table.device
    return Appearance(found.log_gain.to(device), found.falloff.to(device))


def shrunk(photos: PhotoTensors) -> PhotoTensors:
    """Photos (V, h, w) of a whole fraction of the size; a pixel's mask holds where all of it lies on the object."""
    factor = -(-photos.images.shape[2] // SMALL_PX)
    images = avg_pool2d(photos.images.permute(0, 3, 1, 2).float(), factor).permute(0, 2, 3, 1)
    masks = max_pool2d((~photos.masks).float()[:, None], factor)[:, 0] == 0
    intrinsics = photos.intrinsics.clone()
    intrinsics[:, :2] /= factor
    nothing = torch.zeros(masks.shape)
    mattes = masks.to(torch.uint8) * 255
    return PhotoTensors(images, masks, mattes, intrinsics, photos.rotation, photos.center, nothing, nothing)


def shared_colors(photos: PhotoTensors, depths: Tensor) -> tuple[Tensor, ...]:
    """Places that two photos show, from depths (V, h, w) along z, 0 for none: views a and b (N,), squared radii (N, 2),
    log colour in a less that in b (N, 3)."""
    near = nearest(photos.center, COMPARED_PHOTOS)
    parts = [_shared(photos, depths, view, int(other)) for view in range(len(photos)) for other in near[view]]
    return tuple(torch.cat(column) for column in zip(*parts))


def _shared(photos: PhotoTensors, depths: Tensor, a: int, b: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What one photo's pixels are in another, where both show the place in colours that can be compared."""
    height, width = depths.shape[1:]
    rows, columns = torch.nonzero(depths[a] > 0).unbind(1)
    uv = torch.stack([columns, rows], 1) + 0.5
    (k_a, turn_a, center_a), (k_b, turn_b, center_b) = photos.camera(a), photos.camera(b)
    ray = torch.cat([(uv - k_a[:2, 2]) / k_a.diagonal()[:2], torch.ones(len(uv), 1)], 1)
    x = ((ray * depths[a, rows, columns, None]) @ turn_a.T + center_a - center_b) @ turn_b
    there = x[:, :2] / x[:, 2:].clamp(min=1e-9) * k_b.diagonal()[:2] + k_b[:2, 2]
    u, v = (there[:, axis].clamp(0, size - 1).long() for axis, size in ((0, width), (1, height)))
    ours, theirs = (photos.images[view, y, x] / 255.0 for view, y, x in ((a, rows, columns), (b, v, u)))
    kept = (x[:, 2] > 0) & ((there > 0) & (there < torch.tensor([width, height]))).all(1)
    kept &= (depths[b, v, u] - x[:, 2]).abs() < DEPTH_JUMP * x[:, 2]
    kept &= ((torch.stack([ours, theirs]) - 0.5).abs() < 0.5 - COLOR_MARGIN).all(2).all(0)
    radius2 = [squared_radius(p, k.expand(len(p), 3, 3), width, height) for p, k in ((uv, k_a), (there, k_b))]
    index = torch.ones(int(kept.sum()), dtype=torch.int64)
    return index * a, index * b, torch.stack(radius2, 1)[kept], (ours[kept] / theirs[kept]).log()


def solved(shared: tuple[Tensor, ...], photos: int) -> Appearance:
    """Gains and vignetting that shared colours agree under: least squares of log colours, with Huber's weights.

    A weak pull, a share of the pairs, holds gains at 1 and the vignetting at none where the pairs leave them open. A
    photo that shares no colours gets a gain of 1.
    """
    a, b, radius2, difference = shared
    radial, difference, count = (radius2[:, 0] - radius2[:, 1]).double(), difference.double(), max(len(a), 1)
    pairs = torch.bincount(a, minlength=photos) + torch.bincount(b, minlength=photos)
    log_gain, falloff = torch.zeros(photos, 3, dtype=torch.float64), torch.zeros((), dtype=torch.float64)
    for _ in range(10):
        left = difference - (log_gain[a] - log_gain[b]) - (falloff * radial)[:, None]
        weight = (COLOR_DELTA / left.abs().amax(1).clamp(min=1e-9)).clamp(max=1.0)
        log_gain = _gains(a, b, weight, difference - (falloff * radial)[:, None], 1e-3 * pairs.clamp(min=1))
        left = (difference - (log_gain[a] - log_gain[b])).mean(1)
        falloff = (weight * radial * left).sum() / ((weight * radial**2).sum() + 1e-5 * count)
        falloff = falloff.clamp(max=0.0)
    known = (pairs > 0)[:, None]
    mean = (log_gain * known).sum(0) / known.sum().clamp(min=1)
    return Appearance(((log_gain - mean) * known).float(), falloff.float())


def _gains(a: Tensor, b: Tensor, weight: Tensor, difference: Tensor, pull: Tensor) -> Tensor:
    """Log gains (V, 3) with g_a - g_b nearest to the differences (N, 3), weighted (N,), and pulled to 0 (V,)."""
    photos = len(pull)
    laplacian = torch.zeros(photos * photos, dtype=torch.float64).index_add(0, a * photos + b, weight)
    laplacian = laplacian.view(photos, photos) + laplacian.view(photos, photos).T
    normal = torch.diag(laplacian.sum(1) + pull) - laplacian
    right = torch.zeros(photos, 3, dtype=torch.float64)
    right = right.index_add(0, a, weight[:, None] * difference).index_add(0, b, -weight[:, None] * difference)
    return torch.linalg.solve(normal, right)


def nearest(center: Tensor, count: int) -> Tensor:
    """(V, n) for each camera centre (V, 3) the nearest others, `count` or all."""
    distance = torch.cdist(center, center).fill_diagonal_(torch.inf)
    return distance.topk(min(count, len(center) - 1), largest=False).indices


def squared_radius(uv: Tensor, intrinsics: Tensor, width: int, height: int) -> Tensor:
    """Squared distance (R,) of pixels (R, 2) from the principal points of (R, 3, 3), 1 at half the diagonal."""
    return 4 * ((uv - intrinsics[:, :2, 2]) ** 2).sum(1) / (width**2 + height**2)


def falloff_map(falloff: Tensor, intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Vignetting (H, W, 1) of a photo with intrinsics (3, 3)."""
    down, across = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    uv = torch.stack([across.flatten(), down.flatten()], 1)
    radius2 = squared_radius(uv, intrinsics.expand(len(uv), 3, 3), width, height)
    return torch.exp(falloff * radius2).view(height, width, 1)


def fitted_log_gain(rendered: Tensor, photo: Tensor) -> Tensor:
    """Log gains (3,) that bring rendered colours (N, 3) to a photo's (N, 3).

    Least squares with Huber's weights, iterated, and a weak pull towards a gain of 1. Black renders, and none, give 0.
    """
    gain = torch.ones(3, dtype=torch.float64)
    c, p = rendered.double(), photo.double()
    ridge = 1e-4 * max(len(c), 1)
    for _ in range(10):
        weight = (COLOR_DELTA / (gain * c - p).abs().clamp(min=1e-9)).clamp(max=1.0)
        gain = ((weight * c * p).sum(0) + ridge) / ((weight * c * c).sum(0) + ridge)
    return gain.log().float()


def gains_nearby(log_gain: Tensor, center: Tensor, trained: Tensor) -> Tensor:
    """Log gains (V, 3) of all photos: for training photos their own, for others the mean of the nearest ones.

    Args:
        log_gain: (T, 3) of the photos trained on.
        center: (V, 3) camera centres of all.
        trained: (T,) indices of the photos trained on.
    """
    distance = torch.cdist(center, center[trained])
    nearest = distance.topk(min(GAIN_NEIGHBOURS, len(trained)), largest=False).indices
    return log_gain[nearest].mean(1).index_copy(0, trained, log_gain)


def without_appearance(images: Tensor, intrinsics: Tensor, log_gain: Tensor, falloff: Tensor) -> Tensor:
    """Photos (V, H, W, 3) uint8 with gains (V, 3) and vignetting () taken out: all as if of one exposure."""
    height, width = images.shape[1:3]
    result = torch.empty_like(images)
    for index, image in enumerate(images):
        factor = log_gain[index].exp() * falloff_map(falloff, intrinsics[index], height, width)
        result[index] = (image / factor).round().clamp(0, 255).to(torch.uint8)
    return result


def photo_weights(sharpness: Tensor, center: Tensor) -> Tensor:
    """Weight (V,) of each photo's colours: 1, or less where it is blurred beside the photos from nearby.

    Args:
        sharpness: (V,) as `measured_sharpness` has it.
        center: (V, 3) camera centres.
    """
    # Where nothing has any detail, as in clipped photos, all are alike.
    sharpness = sharpness.clamp(min=1e-9)
    share = sharpness / torch.quantile(sharpness[nearest(center, COMPARED_PHOTOS)], 0.5, dim=1)
    return torch.where(share < MIN_SHARPNESS_SHARE, (share / MIN_SHARPNESS_SHARE) ** 2, torch.ones(len(share)))


def measured_sharpness(images: Tensor, masks: Tensor) -> Tensor:
    """Sharpness (V,) of (V, H, W, 3) uint8 photos in their masks (V, H, W): fine detail as a share of coarser detail.

    The ratio of two neighbouring bands depends little on contrast and on what is shown; blur takes the finer band away.
    It is read a coarse sigma inside the mask, whose outline is sharp in a blurred photo too. Photos with too little in
    their mask get the median of the others.
    """
    found = torch.full((len(images),), torch.nan)
    for index, (image, mask) in enumerate(zip(images, dilate(masks, -round(COARSE_PX)))):
        if mask.sum() < 2:
            continue
        gray = image.float().mean(2)[None]
        smooth = blurred(gray, 1.0)
        found[index] = (gray - smooth)[:, mask].std() / (smooth - blurred(gray, COARSE_PX))[:, mask].std().clamp(
            min=1e-6
        )
    return torch.where(found.isnan(), found.nanmedian().nan_to_num(1.0), found)


def blurred(planes: Tensor, sigma: float) -> Tensor:
    """Planes (C, H, W) under a Gaussian of sigma pixels, cut off at three sigma; beyond them their border goes on."""
    reach = int(3 * sigma + 0.5)
    line = torch.exp(-((torch.arange(-reach, reach + 1) / sigma) ** 2) / 2)
    line = (line / line.sum()).view(1, 1, 1, -1)
    rows = conv2d(pad(planes[:, None], (reach,) * 4, "replicate"), line)
    return conv2d(rows, line.transpose(2, 3))[:, 0]
