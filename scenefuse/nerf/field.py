"""The radiance field: hash grid, density network, colour network."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from scenefuse.core.stage import setting
from scenefuse.nerf.encoding import encode, hash_grid, spherical_harmonics

# Of the density network's 16 outputs the first is the density's logarithm (Mueller et al. 2022, section 5.4).
GEOMETRY_FEATURES = 15
# exp(11) in a unit cube is opaque within a ten-thousandth of its side; beyond it gradients overflow.
LARGEST_LOG_DENSITY = 11.0
FIRST_FEATURE = 1e-4  # initial features are uniform in +-1e-4, as in instant-ngp
# Training from coarse to fine begins with half of the levels, and with so many at least.
LEVELS_AT_START = 4
TINY = 1e-12


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
        self.table = nn.Parameter((torch.rand(self.grid.rows, 2, generator=generator) * 2 - 1) * FIRST_FEATURE)
        width, inputs = settings.width, 2 * settings.levels
        self.density_in = _linear(inputs, width, generator)
        self.density_out = _linear(width, 1 + GEOMETRY_FEATURES, generator)
        self.color_geometry = _linear(1 + GEOMETRY_FEATURES, width, generator)
        self.color_direction = _linear(16, width, generator)
        self.color_hidden = _linear(width, width, generator)
        self.color_out = _linear(width, 3, generator)
        self.level_weight: Tensor
        self.register_buffer("level_weight", torch.ones(settings.levels))

    def geometry(self, x: Tensor, boost: Tensor | None = None, fine_from: int = 0) -> tuple[Tensor, Tensor]:
        """Density (N,) per unit of length and features (N, 16) at positions (N, 3), in the unit cube."""
        inside = x.clamp(0.0, 1.0 - 1e-6)
        features = encode(inside, self.table, self.grid, self.level_weight, boost, fine_from)
        out = self.density_out(torch.relu(self.density_in(features)))
        return torch.exp(out[:, 0].clamp(max=LARGEST_LOG_DENSITY)), out

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
    """Open the levels one after the other: all of them once `progress` (0..1) reaches `finished`.

    The window is linear; Park et al. 2021 (Nerfies) and Lin et al. 2021 (BARF) use a cosine.
    """
    levels = field.settings.levels
    first = max(LEVELS_AT_START, levels // 2)
    opened = levels if finished <= 0 else first + (levels - first) * progress / finished
    field.level_weight.copy_((opened - torch.arange(levels, device=field.level_weight.device)).clamp(0.0, 1.0))


@dataclass
class EdgeRates:
    """The paper's adaptive grid as longer steps (method N9): rows of the fine levels learn faster where edges are.

    Adam divides every row's gradient by its own usual size, and with it any factor that a row's gradients share. A
    factor on Adam's steps stays.

    Attributes:
        boost: a row that shows nothing but edges takes steps 1 + `boost` times as long; 0 for Adam's own.
        use: (T, 2) opacity that each row of the table has shown at edges, and in all; (0, 2) without a boost.
    """

    boost: float
    use: Tensor

    @staticmethod
    def of(field: Field, boost: float) -> "EdgeRates":
        """Before anything has been seen."""
        return EdgeRates(boost, torch.zeros(len(field.table) if boost else 0, 2, device=field.table.device))

    def see(self, field: Field, x: Tensor, opacity: Tensor, edge: Tensor) -> None:
        """Count N samples at positions (N, 3): their opacities (N,), and how much of an edge, 0..1, each is (N,)."""
        table = torch.zeros_like(field.table, requires_grad=True)
        features = encode(x.clamp(0.0, 1.0 - 1e-6), table, field.grid, torch.ones_like(field.level_weight))
        seen = torch.stack([opacity * edge, opacity], dim=1).repeat(1, field.settings.levels)
        self.use += torch.autograd.grad(features, table, seen)[0]

    def factor(self, field: Field) -> Tensor:
        """(T, 1) how much longer the step of each row is: 1 on the coarse half of the levels."""
        factor = 1 + self.boost * self.use[:, :1] / self.use[:, 1:].clamp(min=TINY)
        factor[: int(field.grid.offset[field.settings.levels // 2])] = 1.0
        return factor

    @torch.no_grad()
    def step(self, field: Field, optimizer: torch.optim.Optimizer) -> None:
        """The optimiser's step, longer where edges are."""
        if not self.boost:
            optimizer.step()
            return
        before = field.table.clone()
        optimizer.step()
        field.table.copy_(before + self.factor(field) * (field.table - before))


def _linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """A layer with uniform weights after Glorot and Bengio 2010, and biases of 0."""
    layer = nn.Linear(inputs, outputs)
    bound = (6.0 / (inputs + outputs)) ** 0.5
    with torch.no_grad():
        layer.weight.copy_((torch.rand(outputs, inputs, generator=generator) * 2 - 1) * bound)
        layer.bias.zero_()
    return layer
