"""The radiance field: hash grid, density network, colour network."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from scenefuse.core.stage import setting
from scenefuse.nerf import kernels

triton_kernels: Any = None
with contextlib.suppress(ImportError):  # comes with PyTorch's CUDA build
    from scenefuse.nerf import triton_kernels


@dataclass(frozen=True)
class HashGrid:
    """Where each level of the grid lives in one (T, 2) table.

    Attributes:
        resolution: (L,) float32, cells per side of the unit cube.
        stride: (L,) uint32, vertices per side of a level stored densely, 0 for a hashed level.
        offset: (L,) uint32, first row of the level in the table.
        mask: (L,) uint32, rows of a hashed level minus one.
        rows: T, rows of the whole table.
    """

    resolution: np.ndarray
    stride: np.ndarray
    offset: np.ndarray
    mask: np.ndarray
    rows: int
    _on: dict[torch.device, tuple[Tensor, ...]] = field(default_factory=dict, repr=False, compare=False)

    def on(self, device: torch.device) -> tuple[Tensor, ...]:
        """resolution, stride, offset and mask as tensors on a device."""
        if device not in self._on:
            arrays = self.resolution, self.stride, self.offset, self.mask
            self._on[device] = tuple(torch.from_numpy(a).to(device) for a in arrays)
        return self._on[device]


def hash_grid(levels: int, log2_table: int, coarsest: int, finest: int) -> HashGrid:
    """Levels in geometric progression (Mueller et al. 2022, equations 2 and 3).

    A level whose vertices all fit into 2^log2_table rows is stored densely, without collisions.
    """
    growth = math.exp(math.log(finest / coarsest) / max(levels - 1, 1))
    cells = [int(coarsest * growth**level + 1e-6) for level in range(levels)]
    dense = [(size + 1) ** 3 <= 2**log2_table for size in cells]
    rows = [(size + 1) ** 3 if fits else 2**log2_table for size, fits in zip(cells, dense)]
    return HashGrid(
        np.array(cells, dtype=np.float32),
        np.array([size + 1 if fits else 0 for size, fits in zip(cells, dense)], dtype=np.uint32),
        np.concatenate([[0], np.cumsum(rows)[:-1]]).astype(np.uint32),
        np.full(levels, 2**log2_table - 1, dtype=np.uint32),
        int(sum(rows)),
    )


def encode_reference(x: Tensor, table: Tensor, grid: HashGrid, level_weight: Tensor) -> Tensor:
    """`encode` in plain PyTorch, on every device."""
    device = x.device
    resolution = torch.from_numpy(grid.resolution).to(device)
    stride = torch.from_numpy(grid.stride.astype(np.int64)).to(device)[None, :, None]
    offset = torch.from_numpy(grid.offset.astype(np.int64)).to(device)[None, :, None]
    mask = torch.from_numpy(grid.mask.astype(np.int64)).to(device)[None, :, None]
    scaled = x[:, None, :] * resolution[None, :, None]
    low = scaled.detach().floor()
    part = (scaled - low)[:, :, None, :]
    corners = torch.tensor([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)], device=device)
    vertex = low.long()[:, :, None, :] + corners
    vx, vy, vz = vertex.unbind(-1)
    hashed = (vx ^ (vy * kernels.PRIMES[0]) ^ (vz * kernels.PRIMES[1])) & mask
    row = torch.where(stride > 0, vx + stride * (vy + stride * vz), hashed) + offset
    weight = torch.where(corners.bool(), part, 1 - part).prod(-1)
    features = (table[row] * weight[..., None]).sum(2)
    return (features * level_weight.to(device)[None, :, None]).flatten(1)


class _Encode(torch.autograd.Function):
    """The kernels of a device as one function, differentiable by the table."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, table: Tensor, grid: HashGrid, level_weight: Tensor) -> Tensor:
        kernel, plain = kernel_module(x.device)
        levels = tuple(plain(t) for t in (*grid.on(x.device), level_weight))
        out = torch.empty(len(x), 2 * len(grid.resolution), device=x.device)
        kernel.encode(plain(x), plain(table), levels, plain(out))
        ctx.save_for_backward(x, table)
        ctx.levels = levels
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        x, table = ctx.saved_tensors
        kernel, plain = kernel_module(x.device)
        g_table = torch.empty_like(table)
        kernel.encode_backward(plain(x), plain(gradients[0].contiguous()), ctx.levels, plain(g_table))
        return None, g_table, None, None


def kernels_on(device: str) -> str:
    """What computes the encoding on a device: numba, triton or torch."""
    module = kernel_module(torch.device(device))[0]
    return "torch" if module is None else "triton" if module is triton_kernels else "numba"


def kernel_module(device: torch.device) -> tuple[Any, Callable[[Tensor], Any]]:
    """The module whose kernels run on a device, and how they take a tensor; no module: plain PyTorch has to do it."""
    if device.type == "cpu":
        return kernels, lambda tensor: tensor.detach().numpy()
    if device.type == "cuda" and triton_kernels is not None:
        return triton_kernels, Tensor.detach
    return None, Tensor.detach


def encode(x: Tensor, table: Tensor, grid: HashGrid, level_weight: Tensor) -> Tensor:
    """Encode (N, 3) positions in 0..1 as (N, 2 L) features, differentiable by the table.

    Args:
        x: positions; the upper bound 1 itself is excluded.
        table: (T, 2) trainable features.
        grid: the levels.
        level_weight: (L,) in 0..1: coarse-to-fine training holds fine levels back.
    """
    if kernel_module(x.device)[0] is not None:
        return _Encode.apply(x.contiguous(), table, grid, level_weight)
    return encode_reference(x, table, grid, level_weight)


def spherical_harmonics(direction: Tensor) -> Tensor:
    """Real spherical harmonics of degrees 0 to 3 ("degree 4" in hash-grid papers) of (N, 3) unit vectors: (N, 16)."""
    x, y, z = direction.unbind(-1)
    xx, yy, zz, xy, yz, xz = x * x, y * y, z * z, x * y, y * z, x * z
    return torch.stack(
        [
            torch.full_like(x, 0.28209479177387814),
            -0.48860251190291987 * y,
            0.48860251190291987 * z,
            -0.48860251190291987 * x,
            1.0925484305920792 * xy,
            -1.0925484305920792 * yz,
            0.94617469575755997 * zz - 0.31539156525251999,
            -1.0925484305920792 * xz,
            0.54627421529603959 * (xx - yy),
            0.59004358992664352 * y * (-3.0 * xx + yy),
            2.8906114426405538 * xy * z,
            0.45704579946446572 * y * (1.0 - 5.0 * zz),
            0.3731763325901154 * z * (5.0 * zz - 3.0),
            0.45704579946446572 * x * (1.0 - 5.0 * zz),
            1.4453057213202769 * z * (xx - yy),
            0.59004358992664352 * x * (-xx + 3.0 * yy),
        ],
        dim=-1,
    )


@dataclass(frozen=True)
class FieldSettings:
    """Size of the radiance field."""

    levels: int = setting(12, least=1)
    """Levels of the hash grid."""
    log2_table: int = setting(16, least=4, most=24)
    """2-logarithm of the rows that a hashed level of the grid has; more holds finer detail, and is slower."""
    finest: int = setting(512, least=2)
    """Cells per side of the cube around the object at the finest level."""
    width: int = setting(32, least=1)
    """Width of the hidden layers."""
    coarsest: int = 16
    """Cells per side at the coarsest level, as in instant-ngp."""


class Field(nn.Module):
    """Density and colour at positions of the unit cube (instant-ngp's architecture).

    `level_weight` (L,) in 0..1 holds fine levels back while training goes from coarse to fine.
    """

    def __init__(self, settings: FieldSettings, generator: torch.Generator) -> None:
        super().__init__()
        self.settings = settings
        self.grid = hash_grid(settings.levels, settings.log2_table, settings.coarsest, settings.finest)
        # Features begin uniform in +-1e-4, as in instant-ngp.
        self.table = nn.Parameter((torch.rand(self.grid.rows, 2, generator=generator) * 2 - 1) * 1e-4)
        # Of the density network's outputs the first is the density's logarithm (Mueller et al. 2022, section 5.4).
        width, inputs, outputs = settings.width, 2 * settings.levels, 16
        self.density_in = _linear(inputs, width, generator)
        self.density_out = _linear(width, outputs, generator)
        self.color_geometry = _linear(outputs, width, generator)
        self.color_direction = _linear(16, width, generator)
        self.color_hidden = _linear(width, width, generator)
        self.color_out = _linear(width, 3, generator)
        self.level_weight: Tensor
        self.register_buffer("level_weight", torch.ones(settings.levels))

    def geometry(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Density (N,) per unit of length and features (N, 16) at positions (N, 3), in the unit cube."""
        inside = x.clamp(0.0, 1.0 - 1e-6)
        features = encode(inside, self.table, self.grid, self.level_weight)
        out = self.density_out(torch.relu(self.density_in(features)))
        # exp(11) in a unit cube is opaque within a ten-thousandth of its side; beyond it gradients overflow.
        return torch.exp(out[:, 0].clamp(max=11.0)), out

    def color(self, features: Tensor, direction: Tensor) -> Tensor:
        """RGB (R, S, 3) in 0..1 from features (R S, 16) of S samples on each of R rays with unit directions (R, 3)."""
        rays = direction.shape[0]
        view = self.color_direction(spherical_harmonics(direction))
        hidden = self.color_geometry(features).view(rays, -1, self.settings.width) + view[:, None, :]
        return torch.sigmoid(self.color_out(torch.relu(self.color_hidden(torch.relu(hidden)))))

    def density(self, x: Tensor) -> Tensor:
        """Density (N,) at positions (N, 3)."""
        return self.geometry(x)[0]


def coarse_to_fine(field: Field, progress: float, finished: float) -> None:
    """Open the levels one after the other, from half of them to all once `progress` (0..1) reaches `finished`.

    The window is linear; Park et al. 2021 (Nerfies) and Lin et al. 2021 (BARF) use a cosine.
    """
    levels = field.settings.levels
    first = levels // 2
    opened = levels if finished <= 0 else first + (levels - first) * progress / finished
    field.level_weight.copy_((opened - torch.arange(levels, device=field.level_weight.device)).clamp(0.0, 1.0))


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A layer with uniform weights after Glorot and Bengio 2010, and biases of 0."""
    layer = nn.Linear(inputs, outputs)
    bound = (6.0 / (inputs + outputs)) ** 0.5
    with torch.no_grad():
        layer.weight.copy_((torch.rand(outputs, inputs, generator=generator) * 2 - 1) * bound)
        layer.bias.zero_()
    return layer
