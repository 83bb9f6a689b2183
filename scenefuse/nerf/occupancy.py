"""Where the object can be: the visual hull of its masks, and a grid of cached densities that prunes it."""

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scenefuse.nerf.field import Field
from scenefuse.nerf.rays import dilate
from scenefuse.transforms import Sim3

STEP_IN_CELLS = 0.75


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


def visual_hull(
    masks: NDArray[np.bool_],
    intrinsics: NDArray[np.float64],
    object_from_cam: NDArray[np.float64],
    unit_from_object: Sim3,
    size: int,
    tolerance: float,
) -> NDArray[np.bool_]:
    """Cells (size, size, size) of the unit cube that project into (nearly) every mask that could see them.

    Args:
        masks: (V, H, W), True on the object.
        intrinsics: (V, 3, 3) in pixels.
        object_from_cam: (V, 4, 4).
        unit_from_object: the cube.
        size: cells per side, a multiple of 4.
        tolerance: share of the views that may disagree.
    """
    object_from_unit = unit_from_object.inverse()
    cells, count = np.stack(np.meshgrid(*[np.arange(size // 4)] * 3, indexing="ij"), -1).reshape(-1, 3), size // 4
    stack = torch.from_numpy(np.ascontiguousarray(masks))
    while True:
        points = object_from_unit.apply((cells + 0.5) / count)
        half = object_from_unit.scale * 0.87 / count
        outside, seen = np.zeros(len(cells), np.int32), np.zeros(len(cells), np.int32)
        for view, (k, pose) in enumerate(zip(intrinsics, object_from_cam)):
            in_camera = (points - pose[:3, 3]) @ pose[:3, :3]
            z = np.maximum(in_camera[:, 2], 1e-9)
            u = np.floor(in_camera[:, 0] / z * k[0, 0] + k[0, 2]).astype(np.int64)
            v = np.floor(in_camera[:, 1] / z * k[1, 1] + k[1, 2]).astype(np.int64)
            radius = int(np.ceil(half * k[0, 0] / max(float(np.median(z)), 1e-9)))
            grown = dilate(stack[view : view + 1], radius)[0].numpy()
            height, width = grown.shape
            visible = (in_camera[:, 2] > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
            seen += visible
            outside += visible & ~grown[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
        keep = (outside <= tolerance * seen) & (seen >= max(2, 0.3 * len(masks)))
        cells = cells[keep]
        if count == size or len(cells) == 0:
            hull = np.zeros((size, size, size), dtype=bool)
            hull[tuple(cells.T)] = True
            return hull
        children = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), -1).reshape(-1, 3)
        cells, count = (2 * cells[:, None] + children).reshape(-1, 3), 2 * count


def tight_cube(hull: NDArray[np.bool_], unit_from_object: Sim3, margin: float) -> Sim3:
    """The cube around a hull's cells, `margin` (share of its side) wider on each side: nerf_from_object.

    Raises:
        ValueError: the hull is empty.
    """
    cells = np.argwhere(hull)
    if len(cells) == 0:
        raise ValueError("the visual hull of the masks is empty")
    low, high = cells.min(0) / len(hull), (cells.max(0) + 1) / len(hull)
    object_from_unit = unit_from_object.inverse()
    center = object_from_unit.apply((low + high) / 2)
    scale = 1.0 / (object_from_unit.scale * float((high - low).max()) * (1 + 2 * margin))
    return Sim3(scale, np.eye(3), 0.5 - scale * center)


@torch.no_grad()
def updated(occupancy: Occupancy, field: Field, seed: int, step: int, cells: int, decay: float, prune: bool,
            threshold: float) -> Occupancy:  # fmt: skip
    """The grid with the cached density of `cells` random hull cells refreshed, and nearly empty ones dropped.

    Args:
        occupancy: the grid so far.
        field: the field being trained.
        seed: seed of the run.
        step: training step; seed and step determine the cells.
        cells: how many to evaluate.
        decay: factor on the old value before the maximum with the new one is taken.
        prune: False drops no cell.
        threshold: opacity over one cell below which it is empty.
    """
    rng = np.random.default_rng((seed, step, 1))
    inside = torch.nonzero(occupancy.hull.flatten())[:, 0]
    chosen = inside[torch.from_numpy(rng.integers(0, len(inside), min(cells, 2 * len(inside))))].unique()
    size = occupancy.size
    index = torch.stack([chosen // (size * size), chosen // size % size, chosen % size], dim=1)
    jitter = torch.from_numpy(rng.random((len(chosen), 3), dtype=np.float32)).to(chosen.device)
    fresh = field.density((index + jitter) / size)
    density = occupancy.density.clone()
    flat = density.view(-1)
    flat[chosen] = torch.maximum(flat[chosen] * decay, fresh)
    if not prune:
        return Occupancy(occupancy.hull, density, occupancy.occupied)
    near = 1 - torch.exp(-density / size) > threshold
    # A neighbour of an occupied cell stays: the surface may still move by one cell.
    for axis in range(3):
        grown, last = near.clone(), size - 1
        grown.narrow(axis, 0, last).logical_or_(near.narrow(axis, 1, last))
        grown.narrow(axis, 1, last).logical_or_(near.narrow(axis, 0, last))
        near = grown
    return Occupancy(occupancy.hull, density, occupancy.hull & near)
