"""Adam on the hash table: PyTorch's where every row has a gradient, nothing at all where none has."""

import numpy as np
import pytest
import torch

from scenefuse.nerf import kernels
from scenefuse.nerf.adam import BETAS, EPSILON, TableAdam, adam_reference


def _table(seed):
    return torch.nn.Parameter(torch.randn(300, 2, generator=torch.Generator().manual_seed(seed)))


def test_dense_gradients_give_pytorch_s_adam():
    ours, theirs = _table(0), _table(0)
    adam, peer = TableAdam(ours), torch.optim.Adam([theirs], lr=0.05, betas=BETAS, eps=EPSILON)
    for step in range(5):
        ours.grad, theirs.grad = _table(step + 1).detach(), _table(step + 1).detach()
        adam.step(0.05)
        peer.step()
    assert torch.allclose(ours, theirs, atol=1e-5)


def test_rows_without_gradient_keep_values_and_moments():
    table = _table(0)
    adam = TableAdam(table)
    table.grad = _table(1).detach()
    adam.step(0.1)
    before = [a.clone() for a in (table.detach(), adam.first, adam.second)]
    table.grad = _table(2).detach()
    table.grad[:100] = 0
    adam.step(0.1)
    for old, new in zip(before, (table.detach(), adam.first, adam.second)):
        assert torch.equal(old[:100], new[:100]) and not (old[100:] == new[100:]).any()


@pytest.mark.skipif(not kernels.AVAILABLE, reason="Numba is not installed")
def test_kernel_matches_the_reference():
    arrays = [_table(k).detach() for k in range(3)] + [_table(3).detach() ** 2]
    arrays[1][::3] = 0
    twins = [a.clone() for a in arrays]
    kernels.adam(*(a.numpy() for a in arrays), *(np.float32(v) for v in (0.1, *BETAS, EPSILON)))
    adam_reference(*twins, 0.1)
    for ours, theirs in zip(arrays, twins):
        assert torch.allclose(ours, theirs, atol=1e-6)


def test_state_continues_where_it_stopped():
    first, second = _table(0), _table(0)
    one, other = TableAdam(first), TableAdam(second)
    for step in range(4):
        if step == 2:
            fresh = TableAdam(second)
            fresh.load(other.state())
            other = fresh
        first.grad, second.grad = _table(step + 1).detach(), _table(step + 1).detach()
        one.step(0.1)
        other.step(0.1)
    assert torch.equal(first, second)
