"""The scale of each pair, the length of its baseline: a depth network learns depths that all pairs of a photo share.

A pair of photos knows the depths d of its matches in units of its own baseline b. Of the network's depth D,

    log D(x) - log d(x) = log b  for all matches x of the pair, in both photos                      (1)

so the loss is the spread of the left side within each pair, and b its mean. Pairs of one photo share its depths, so
their scales become consistent (as in FlowMap, Smith et al. 2024, poses are not free variables but follow from depth
and matches).
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from scenefuse.core.checkpoints import learning_rate_factor
from scenefuse.nerf.prior.networks import DepthNetwork, depth_from_disparity, disparity_from_depth
from scenefuse.nerf.prior.self_supervision import masked_mean, points_in_cam, sample, smoothness
from scenefuse.photos.workspace import View
from scenefuse.poses.correspondences import PhotoFeatures, TwoViewPair

# Nearest and farthest depth of the network, in units of the typical one.
NEAR, FAR = 0.2, 20.0
# Highest rate of Adam, and the share of the steps in which it rises.
LEARNING_RATE, WARMUP = 0.005, 0.1
# Weight of the edge-aware smoothness of disparity, as in Monodepth2.
SMOOTHNESS_WEIGHT = 0.001
MAX_GRADIENT = 1.0
PRINT_EVERY = 20
# Disagreement (relative depth) at which a match loses half its weight. Smaller, and two groups of photos that few
# pairs join keep the lengths that they began with.
ROBUST = 0.3


def learn_pair_scales(
    views: list[View],
    features: list[PhotoFeatures],
    pairs: list[TwoViewPair],
    steps: int,
    device: torch.device,
) -> tuple[NDArray[np.float64], float]:
    """Train a depth network on the pairs' depths.

    Args:
        views: V small photos of one size, (h, w, 3) uint8 RGB.
        features: of the photos at their full size.
        pairs: of the photos.
        steps: of Adam, each over all photos.
        device: where to train.

    Returns:
        (P,) baseline of each pair, in units of the typical depth; and the median relative disagreement of depths.
    """
    intrinsics = np.array([view.intrinsics for view in views])
    photos = (
        torch.as_tensor(np.stack([view.pixels for view in views]), dtype=torch.float32, device=device).permute(
            0, 3, 1, 2
        )
        / 255.0
    )
    count, _, height, width = photos.shape
    cameras = torch.as_tensor(intrinsics, dtype=torch.float32, device=device)
    one = torch.ones(count, 1, height, width, device=device)
    inputs = torch.cat([photos * 2 - 1, points_in_cam(one, cameras)[:, :2].view(count, 2, height, width)], 1)
    first = disparity_from_depth(one, NEAR, FAR)
    points = _Matches(features, intrinsics, pairs, device)
    network = DepthNetwork(inputs.shape[1]).to(device)
    optimizer = torch.optim.Adam(network.parameters(), lr=LEARNING_RATE)
    for step in range(steps):
        for group in optimizer.param_groups:
            group["lr"] = LEARNING_RATE * learning_rate_factor(step, steps, WARMUP * steps)
        disparity = network(inputs, first)
        residual, _, weight = points.disagreement(depth_from_disparity(disparity, NEAR, FAR))
        loss = masked_mean(functional.huber_loss(residual, torch.zeros_like(residual), "none", ROBUST), weight)
        total = loss + SMOOTHNESS_WEIGHT * smoothness(disparity, photos, one)
        optimizer.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT)
        optimizer.step()
        if step % PRINT_EVERY == 0 or step == steps - 1:
            print(f"step {step}: disagreement {float(residual.detach().abs().median()):.4f}", flush=True)
    with torch.no_grad():
        residual, length, _ = points.disagreement(depth_from_disparity(network(inputs, first), NEAR, FAR))
    return length.exp().double().cpu().numpy(), float(residual.abs().median())


class _Matches:
    """All matches of all pairs, once for each of their two photos."""

    def __init__(
        self,
        features: list[PhotoFeatures],
        intrinsics: NDArray[np.float64],
        pairs: list[TwoViewPair],
        device: torch.device,
    ) -> None:
        most = max(len(f.pixels) for f in features)
        pixels = np.zeros((len(features), most, 2), np.float32)
        for index, f in enumerate(features):
            rays = np.column_stack([f.rays, np.ones(len(f.rays))])
            pixels[index, : len(f.rays)] = (rays @ intrinsics[index].T)[:, :2]
        sides = [(pair, side, photo) for pair in pairs for side, photo in enumerate((pair.first, pair.second))]
        where = [photo * most + pair.rows[:, side] for pair, side, photo in sides]
        known = [np.log(pair.depths[:, side]) for pair, side, _ in sides]
        of_pair = np.repeat(np.arange(len(pairs)), [2 * len(pair.rows) for pair in pairs])
        self.pixels = torch.from_numpy(pixels).to(device)
        self.where = torch.from_numpy(np.concatenate(where)).to(device)
        self.known = torch.from_numpy(np.concatenate(known).astype(np.float32)).to(device)
        self.of_pair = torch.from_numpy(of_pair).to(device)
        self.pairs = len(pairs)

    def disagreement(self, depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Equation (1) for (V, 1, h, w) depths: (N,) residuals, (P,) log lengths, and (N,) robust weights."""
        ratio = sample(depth.log(), self.pixels)[:, 0].reshape(-1)[self.where] - self.known
        weight = torch.ones_like(ratio)
        for _ in range(3):
            total = ratio.new_zeros(self.pairs).index_add(0, self.of_pair, weight)
            length = ratio.new_zeros(self.pairs).index_add(0, self.of_pair, weight * ratio) / total
            residual = ratio - length[self.of_pair]
            weight = 1.0 / (1.0 + (residual.detach() / ROBUST) ** 2)
        return residual, length, weight
