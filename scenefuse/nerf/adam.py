"""Adam for the hash table: rows that no sample touched are left alone, as in instant-ngp."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from scenefuse.nerf import kernels

BETAS, EPSILON = (0.9, 0.99), 1e-15


class TableAdam:
    """Adam (Kingma and Ba 2015) on a (T, 2) table, skipping rows whose gradient is exactly zero.

    A step touches a small part of a large table; the other rows keep their values and their moments (Mueller et al.
    2022, section 4).
    """

    def __init__(self, table: Tensor) -> None:
        self.table = table
        self.first, self.second = torch.zeros_like(table), torch.zeros_like(table)
        self.steps = 0

    def step(self, rate: float) -> None:
        """Apply `table.grad`."""
        self.steps += 1
        rate = rate * (1 - BETAS[1] ** self.steps) ** 0.5 / (1 - BETAS[0] ** self.steps)
        state = self.table.detach(), self.table.grad, self.first, self.second
        if kernels.AVAILABLE and self.table.device.type == "cpu":
            kernels.adam(*(a.numpy() for a in state), *(np.float32(v) for v in (rate, *BETAS, EPSILON)))  # type: ignore[union-attr]
        else:
            adam_reference(*state, rate)  # type: ignore[arg-type]

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"first": self.first, "second": self.second, "steps": self.steps}

    def load(self, state: dict[str, Any]) -> None:
        """Back from `state`."""
        self.first.copy_(state["first"])
        self.second.copy_(state["second"])
        self.steps = int(state["steps"])


@torch.no_grad()
def adam_reference(table: Tensor, gradient: Tensor, first: Tensor, second: Tensor, rate: float) -> None:
    """`kernels.adam` in plain PyTorch."""
    row = (gradient != 0).any(1).nonzero()[:, 0]
    g = gradient[row]
    first[row] = BETAS[0] * first[row] + (1 - BETAS[0]) * g
    second[row] = BETAS[1] * second[row] + (1 - BETAS[1]) * g * g
    table[row] -= rate * first[row] / (second[row].sqrt() + EPSILON)
