"""The radiance field: hash grid, density network, colour network."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from scenefuse.core.stage import setting
from scenefuse.nerf.encoding import encode, hash_grid, spherical_harmonics

# exp(11) in a unit cube is opaque within a ten-thousandth of its side; beyond it gradients overflow.
MAX_LOG_DENSITY = 11.0


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
        return torch.exp(out[:, 0].clamp(max=MAX_LOG_DENSITY)), out

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
