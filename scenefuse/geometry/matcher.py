"""Photo-consistency in PyTorch: how well a depth per pixel of one photo matches the other photos.

Source: Goesele et al. 2006 (the best K of several views are averaged, which leaves occluded ones out).
"""

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from scenefuse.geometry.matching_kernel import keep_best as keep_best_on_cpu
from scenefuse.photos.workspace import View

# One grey level of 255, squared, the noise of a photo: keeps windows without texture from matching anything.
NOISE_VARIANCE = 1.5e-5
# Difference of grey values, 0..1, at which a pixel's weight in a support falls to 1 / e, and at which it ends: beside a
# dark statue, the smallest weight is texture enough for a blank sky to match at the statue's depth.
GREY_FALL, MAX_GREY_STEP = 0.07, 0.28
# Distance, in radii of the window, at which it falls to 1 / e.
DISTANCE_FALL = 0.6
# Score of a hypothesis outside a source photo: worse than a window that does not match.
OUTSIDE_SCORE = -0.5


class Matcher:
    """Scores inverse-depth hypotheses of one reference photo by the mean NCC of its best sources.

    Attributes:
        reference: (h, w) float32 the photo, without its mean.
        mean, variance: (h, w) of its windows.
        weights: (2, h, window, w) of the pixels in a window, see `support_weights`.
        windows: (3, h, w) reference, mean and variance.
        best: sources that count.
    """

    def __init__(
        self,
        reference: View,
        sources: list[View],
        best_sources: int,
        window_px: int,
        device: torch.device | str,
        flat: float = NOISE_VARIANCE,
    ) -> None:
        """Place each pixel's ray in each source photo; `pixels` of all are (H, W) float32 grey values in 0..1.

        `flat` is the variance that is added to all windows', see NOISE_VARIANCE.
        """
        height, width = reference.height, reference.width
        self.best, self.flat = min(best_sources, len(sources)), flat
        u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.linalg.inv(reference.intrinsics) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
        rotation, shift = reference.cam_from_world[:3, :3], reference.cam_from_world[:3, 3]
        pixels = torch.from_numpy(_centred(reference.pixels)).to(device)
        self.weights = support_weights(pixels, window_px)
        mean = self._mean(pixels)
        self.windows = torch.stack([pixels, mean, (self._mean(pixels**2) - mean**2).clamp(min=0)])
        self.reference, self.mean, self.variance = self.windows
        self.sources: list[tuple[Tensor, Tensor, Tensor]] = []
        for source in sources:
            turn = source.cam_from_world[:3, :3] @ rotation.T
            move = source.cam_from_world[:3, 3] - turn @ shift
            # From pixels to grid_sample's -1..1, where 0.5 px is the first pixel's centre.
            to_grid = np.array([[2 / source.width, 0, -1], [0, 2 / source.height, -1], [0, 0, 1]]) @ source.intrinsics
            directions = (to_grid @ turn @ rays).reshape(3, height, width)
            self.sources.append(
                (
                    torch.from_numpy(_centred(source.pixels))[None, None].to(device),
                    torch.from_numpy(directions.astype(np.float32)).to(device),
                    torch.from_numpy((to_grid @ move).astype(np.float32)).to(device),
                )
            )

    def score(self, inverse: Tensor) -> Tensor:
        """Mean NCC of the best sources for D hypotheses per pixel: (D, h, w) inverse depths -> (D, h, w) in -1..1."""
        best = inverse.new_full((self.best, *inverse.shape), OUTSIDE_SCORE)
        keep = self._keep_best_on_cpu if inverse.device.type == "cpu" else self.keep_best
        for source in self.sources:
            keep(inverse, best, *source)
        return best.mean(0)

    def _keep_best_on_cpu(self, inverse: Tensor, best: Tensor, gray: Tensor, directions: Tensor, move: Tensor) -> None:
        """The same as `keep_best`, by the CPU's kernel."""
        first, last = (inverse.contiguous(), self.windows, self.weights), (gray[0, 0], directions, move, best)
        keep_best_on_cpu(*(p.numpy() for p in first), np.float32(self.flat), *(p.numpy() for p in last))  # type: ignore[call-arg]

    def keep_best(self, inverse: Tensor, best: Tensor, gray: Tensor, directions: Tensor, move: Tensor) -> None:
        """Put the scores of one of `sources` among the best (K, D, h, w), the largest first."""
        score = self._ncc(inverse, gray, directions, move)
        for k in range(self.best):
            best[k], score = torch.maximum(best[k], score), torch.minimum(best[k], score)

    def seen_by(self, inverse: Tensor) -> Tensor:
        """Number (h, w) of source photos in which a hypothesis per pixel (h, w) lies."""
        return sum(self._place(inverse[None], *source[1:])[1][0].int() for source in self.sources)  # type: ignore[return-value]

    @staticmethod
    def _place(inverse: Tensor, directions: Tensor, move: Tensor) -> tuple[Tensor, Tensor]:
        """Where D hypotheses per pixel lie in a source photo, (D, h, w, 2) in -1..1, and whether they do, (D, h, w)."""
        z = directions[2] + move[2] * inverse
        scale = 1 / z.clamp(min=1e-6)
        grid = torch.stack(
            [(directions[0] + move[0] * inverse) * scale, (directions[1] + move[1] * inverse) * scale], dim=-1
        )
        return grid, (z > 1e-6) & (grid.abs().amax(-1) < 1)

    def _ncc(self, inverse: Tensor, gray: Tensor, directions: Tensor, move: Tensor) -> Tensor:
        """NCC of one source, (D, h, w); OUTSIDE_SCORE where the hypothesis lies outside the source photo."""
        grid, inside = self._place(inverse, directions, move)
        count, height, width = inverse.shape
        grid = grid.reshape(1, count * height, width, 2)
        warped = F.grid_sample(gray, grid, padding_mode="border", align_corners=False)
        warped = warped.reshape(count, height, width)
        mean = self._mean(warped)
        variance = (self._mean(warped * warped) - mean * mean).clamp(min=0)
        covariance = self._mean(warped * self.reference) - mean * self.mean
        ncc = covariance / torch.sqrt((variance + self.flat) * (self.variance + self.flat))
        return torch.where(inside, ncc, torch.full_like(ncc, OUTSIDE_SCORE))

    def _mean(self, values: Tensor) -> Tensor:
        """Weighted mean of values (..., h, w) over the support of each pixel."""
        return supported_mean(values, self.weights)

    def shift_per_inverse_depth(self, low: float, high: float) -> float:
        """Largest shift in any source photo, in its pixels, between the two ends of the inverse depth range."""
        return max(self._shifts(low, high))

    def middle_shift_per_inverse_depth(self, low: float, high: float) -> float:
        """The same in the middle one of the source photos: half of them move by at least as much."""
        return float(np.median(self._shifts(low, high)))

    def _shifts(self, low: float, high: float) -> list[float]:
        """Shift in each source photo, in its pixels; 0 where both ends of the range never lie in it."""
        shifts = []
        for gray, directions, move in self.sources:
            half = torch.tensor([gray.shape[-1] / 2, gray.shape[-2] / 2], device=gray.device)
            thinned = directions[:, ::8, ::8]
            ends = []
            for inverse in (low, high):
                p = thinned + move[:, None, None] * inverse
                ends.append(p[:2] / p[2].clamp(min=1e-6))
            inside = (ends[0].abs().amax(0) < 1) & (ends[1].abs().amax(0) < 1)
            length = ((ends[1] - ends[0]) * half[:, None, None]).norm(dim=0)
            shifts.append(float(length[inside].median()) if inside.any() else 0.0)
        return shifts


def support_weights(gray: Tensor, window: int) -> Tensor:
    """Weights of pixels along a row, and of rows across it, in each pixel's support, (2, h, window, w).

    A pixel counts as far as it is near and of the same grey (Yoon, Kweon 2006), along the rows first and then across
    them (Pham, van Vliet 2005), so that a window of n x n pixels costs 2 n products. A pixel's weights sum to one, and
    are zero outside the photo.

    Args:
        gray: (h, w) in 0..1.
        window: its side, odd.
    """
    radius = window // 2
    parts = []
    for axis in (0, 1):
        values = gray.movedim(axis, 0)  # the axis that the support runs along, first
        padded = F.pad(values, (0, 0, radius, radius), value=float("inf"))
        weights = []
        for k in range(window):
            step = (padded[k : k + len(values)] - values).abs()
            weights.append(
                torch.exp(-step / GREY_FALL - abs(k - radius) / (DISTANCE_FALL * radius)) * (step < MAX_GREY_STEP)
            )
        stacked = torch.stack(weights, dim=1)
        stacked = (stacked / stacked.sum(1, keepdim=True)).transpose(0, 2 * axis)
        parts.append(stacked)
    return torch.stack([parts[1], parts[0]])


def supported_mean(values: Tensor, weights: Tensor) -> Tensor:
    """Mean of values (..., h, w) over each pixel's support, weighted as `support_weights` says."""
    along, across = weights
    window, radius = along.shape[1], along.shape[1] // 2
    height, width = values.shape[-2:]
    row = F.pad(values, (radius, radius))
    sums, total = torch.zeros_like(values), torch.zeros_like(values)
    for k in range(window):
        sums.addcmul_(along[:, k], row[..., k : k + width])
    rows = F.pad(sums, (0, 0, radius, radius))
    for k in range(window):
        total.addcmul_(across[:, k], rows[..., k : k + height, :])
    return total


def box(values: Tensor, window: int) -> Tensor:
    """Mean over a window of the last two axes; at the border, over what the padding by zero leaves."""
    radius = window // 2
    padded = F.pad(values, (radius + 1, radius, radius + 1, radius))
    sums = padded.cumsum(-1)
    sums = (sums[..., window:] - sums[..., :-window]).cumsum(-2)
    return (sums[..., window:, :] - sums[..., :-window, :]) / window**2


def _centred(gray: NDArray[np.float32]) -> NDArray[np.float32]:
    """The photo (H, W) without its mean, so that sums of squares stay small and exact."""
    return gray - gray.mean()
