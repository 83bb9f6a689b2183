"""Where rays are sampled: a visual hull with cached densities (instant-ngp's grid)."""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from scenefuse.nerf.field import Field

# Interval that rays are cut into, in cells: no cell is stepped over, whatever the direction.
STEP_IN_CELLS = 0.75
# Random cells are evaluated now and then, and an old density decays by this before the larger of it and the new one is
# kept (Mueller et al. 2022, appendix E.2).
DECAY = 0.9


@dataclasses.dataclass
class Occupancy:
    """A grid over the unit cube; its densities change while a field is trained.

    Attributes:
        hull: (G, G, G) bool, cells inside the visual hull; nothing is ever sampled elsewhere.
        density: (G, G, G) float32, cached density.
        alpha: (G, G, G) float32, opacity of one marching step, -1 outside the hull.
        blocks_used: (G / 4, G / 4, G / 4) uint8, 1 where a block of 4 x 4 x 4 cells has one of the hull.
    """

    hull: Tensor
    density: Tensor
    alpha: Tensor = dataclasses.field(init=False)
    blocks_used: Tensor = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        """What marching looks up."""
        opacity = 1 - torch.exp(-self.density * self.step)
        self.alpha = torch.where(self.hull, opacity, torch.full_like(opacity, -1.0))
        side = self.size // 4
        self.blocks_used = self.hull.view(side, 4, side, 4, side, 4).any(5).any(3).any(1).to(torch.uint8)

    @property
    def step(self) -> float:
        """Length of an interval that rays are cut into."""
        return STEP_IN_CELLS / self.size

    @property
    def size(self) -> int:
        """Cells per side."""
        return self.hull.shape[0]

    @classmethod
    def from_hull(cls, hull: Tensor) -> "Occupancy":
        """Nothing is known about densities."""
        return cls(hull, torch.zeros(hull.shape, device=hull.device))


@torch.no_grad()
def updated(occupancy: Occupancy, field: Field, seed: int, step: int) -> Occupancy:
    """The grid with the cached density of random hull cells refreshed; seed and training step determine the cells."""
    density = occupancy.density.clone()
    chosen, x = _drawn_cells(occupancy, seed, step)
    flat = density.view(-1)
    flat[chosen] = torch.maximum(flat[chosen] * DECAY, field.density(x))
    return Occupancy(occupancy.hull, density)


def _drawn_cells(occupancy: Occupancy, seed: int, step: int) -> tuple[Tensor, Tensor]:
    """Flat indices (N,) of random hull cells, and a random position (N, 3) in each."""
    rng = np.random.default_rng((seed, step, 1))
    inside = torch.nonzero(occupancy.hull.flatten())[:, 0]
    # Half of the hull's cells and some more, but never many more than a training step has samples.
    count = min(len(inside) // 2, 1 << 16) + (1 << 12)
    chosen = inside[torch.from_numpy(rng.integers(0, len(inside), min(count, 2 * len(inside))))].unique()
    size = occupancy.size
    index = torch.stack([chosen // (size * size), chosen // size % size, chosen % size], dim=1)
    jitter = torch.from_numpy(rng.random((len(chosen), 3), dtype=np.float32)).to(chosen.device)
    return chosen, (index + jitter) / size
