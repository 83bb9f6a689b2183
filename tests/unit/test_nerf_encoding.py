"""The Numba hash encoding against plain PyTorch, and both against values worked out by hand."""

import numpy as np
import pytest
import torch

from scenefuse.nerf import kernels
from scenefuse.nerf.encoding import encode, encode_reference, hash_grid, spherical_harmonics

needs_numba = pytest.mark.skipif(not kernels.AVAILABLE, reason="Numba is not installed")


def _problem(seed=0):
    rng = torch.Generator().manual_seed(seed)
    grid = hash_grid(levels=6, log2_table=10, coarsest=4, finest=100)
    table = torch.rand(grid.rows, 2, generator=rng) - 0.5
    x = torch.rand(500, 3, generator=rng)
    weight = torch.tensor([1.0, 1.0, 0.7, 1.0, 0.3, 0.0])
    return grid, table, x, weight


def test_levels_grow_geometrically_and_small_ones_are_dense():
    grid = hash_grid(levels=4, log2_table=12, coarsest=8, finest=64)
    assert grid.resolution.tolist() == [8, 16, 32, 64]
    assert grid.stride.tolist() == [9, 0, 0, 0]
    assert grid.offset.tolist() == [0, 729, 729 + 4096, 729 + 2 * 4096]
    assert grid.rows == 729 + 3 * 4096


def test_dense_level_interpolates_trilinearly():
    grid = hash_grid(levels=1, log2_table=10, coarsest=2, finest=2)
    z, y, x = np.indices((3, 3, 3))
    table = torch.from_numpy(np.stack([(x + 10 * y + 100 * z).ravel(), x.ravel()], 1).astype(np.float32))
    out = encode(torch.tensor([[0.25, 0.5, 0.9]]), table, grid, torch.ones(1))
    assert out[0].tolist() == pytest.approx([0.5 + 10.0 + 180.0, 0.5], rel=1e-5)


@needs_numba
def test_kernel_values_and_gradients_match_the_reference():
    grid, table, x, weight = _problem()
    results = []
    for function in (encode, encode_reference):
        t, p = table.clone().requires_grad_(), x.clone().requires_grad_()
        out = function(p, t, grid, weight)
        (out * torch.linspace(-1, 1, out.numel()).view_as(out)).sum().backward()
        results.append((out.detach(), t.grad, p.grad))
    for ours, reference in zip(*results):
        assert (ours - reference).abs().max() <= 1e-4 * reference.abs().max()


@needs_numba
def test_boost_multiplies_fine_gradients_only_and_no_values():
    grid, table, x, weight = _problem()
    boost = torch.full((len(x),), 3.0)
    gradients, values = [], []
    for factor in (None, boost):
        t = table.clone().requires_grad_()
        out = encode(x, t, grid, weight, factor, 3)
        out.sum().backward()
        gradients.append(t.grad)
        values.append(out.detach())
    first_fine = int(grid.offset[3])
    assert torch.equal(values[0], values[1])
    assert torch.equal(gradients[0][:first_fine], gradients[1][:first_fine])
    assert torch.allclose(3 * gradients[0][first_fine:], gradients[1][first_fine:], rtol=1e-4, atol=1e-6)


def test_reference_boost_agrees_with_the_kernel(monkeypatch):
    grid, table, x, weight = _problem()
    boost = torch.linspace(1, 4, len(x))
    gradients = []
    for available in (kernels.AVAILABLE, False):
        monkeypatch.setattr(kernels, "AVAILABLE", available)
        t = table.clone().requires_grad_()
        encode(x, t, grid, weight, boost, 2).sum().backward()
        gradients.append(t.grad)
    assert (gradients[0] - gradients[1]).abs().max() <= 1e-4 * gradients[1].abs().max()


def test_spherical_harmonics_are_orthonormal():
    generator = np.random.default_rng(0)
    directions = torch.from_numpy(generator.normal(size=(200_000, 3)).astype(np.float32))
    basis = spherical_harmonics(directions / directions.norm(dim=1, keepdim=True))
    gram = 4 * np.pi * (basis.T @ basis / len(basis)).numpy()
    assert np.abs(gram - np.eye(16)).max() < 0.03
