"""Where rays are sampled: a grid of cached densities, which starts as a visual hull and prunes it (instant-ngp's)."""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from scenefuse.nerf.field import Field

# Interval that rays are cut into, in cells: no cell is stepped over, whatever the direction.
STEP_IN_CELLS = 0.75
# The grid's upkeep follows Mueller et al. 2022, appendix E.2: random cells are evaluated now and then, an old density
# decays before the larger of it and the new one is kept, and cells below an opacity are left out.
DECAY = 0.9
MIN_OPACITY = 0.005


@dataclasses.dataclass
class Occupancy:
    """A grid over the unit cube; it changes while a field is trained.

    Attributes:
        hull: (G, G, G) bool, cells inside the visual hull; nothing is ever sampled elsewhere.
        density: (G, G, G) float32, cached density.
        occupied: (G, G, G) bool, cells that rays are sampled in.
        alpha: (G, G, G) float32, opacity of one marching step, -1 in cells that are not occupied.
        blocks_used: (G / 4, G / 4, G / 4) uint8, 1 where a block of 4 x 4 x 4 cells has an occupied one.
    """

    hull: Tensor
    density: Tensor
    occupied: Tensor
    alpha: Tensor = dataclasses.field(init=False)
    blocks_used: Tensor = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        """What marching looks up, from densities and occupied cells."""
        opacity = 1 - torch.exp(-self.density * self.step)
        self.alpha = torch.where(self.occupied, opacity, torch.full_like(opacity, -1.0))
        side = self.size // 4
        self.blocks_used = self.occupied.view(side, 4, side, 4, side, 4).any(5).any(3).any(1).to(torch.uint8)

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
        """All of the hull occupied, nothing known about densities."""
        return cls(hull, torch.zeros(hull.shape, device=hull.device), hull.clone())


@torch.no_grad()
def updated(occupancy: Occupancy, field: Field, seed: int, step: int, prune: bool) -> Occupancy:
    """The grid with the cached density of random hull cells refreshed, and nearly empty cells dropped.

    Args:
        occupancy: the grid so far.
        field: the field being trained.
        seed: seed of the run.
        step: training step; seed and step determine the cells.
        prune: False drops no cell.
    """
    density = occupancy.density.clone()
    chosen, x = _drawn_cells(occupancy, seed, step)
    flat = density.view(-1)
    flat[chosen] = torch.maximum(flat[chosen] * DECAY, field.density(x))
    if not prune:
        return Occupancy(occupancy.hull, density, occupancy.occupied)
    solid = 1 - torch.exp(-density / occupancy.size) > MIN_OPACITY
    return Occupancy(occupancy.hull, density, occupancy.hull & _with_neighbours(solid))


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


def _with_neighbours(solid: Tensor) -> Tensor:
    """Cells (G, G, G) and the 26 around each: the surface may still move by one cell."""
    for axis in range(3):
        grown, last = solid.clone(), len(solid) - 1
        grown.narrow(axis, 0, last).logical_or_(solid.narrow(axis, 1, last))
        grown.narrow(axis, 1, last).logical_or_(solid.narrow(axis, 0, last))
        solid = grown
    return solid
