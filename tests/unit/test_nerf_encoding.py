"""The hash encoding's kernels against plain PyTorch, and both against values worked out by hand."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from scenefuse.nerf import field
from scenefuse.nerf.field import encode, encode_reference, hash_grid, spherical_harmonics


@pytest.fixture(params=["numba", "triton"])
def device(request, monkeypatch):
    """Where each kind of kernels runs: the GPU's without a GPU on the CPU, in Triton's interpreter (conftest.py)."""
    if request.param == "numba":
        return "cpu"
    pytest.importorskip("triton", reason="Triton is not installed: pip install -r tests/requirements.txt")
    if torch.cuda.is_available():
        return "cuda"
    monkeypatch.setattr(field, "kernel_module", lambda _: (field.triton_kernels, torch.Tensor.detach))
    return "cpu"


def _problem(log2_table=10):
    rng = torch.Generator().manual_seed(0)
    grid = hash_grid(levels=6, log2_table=log2_table, coarsest=4, finest=100)
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


@pytest.mark.slow
@pytest.mark.parametrize("log2_table", [10, 18])  # the larger one has levels that are fetched ahead
def test_kernel_values_and_gradients_match_the_reference(device, log2_table):
    grid, table, x, weight = _problem(log2_table)
    results = []
    for function in (encode, encode_reference):
        t = table.clone().to(device).requires_grad_()
        out = function(x.to(device), t, grid, weight.to(device))
        (out * torch.linspace(-1, 1, out.numel(), device=device).view_as(out)).sum().backward()
        results.append((out.detach(), t.grad))
    for ours, reference in zip(*results):
        assert (ours - reference).abs().max() <= 1e-5 * reference.abs().max()


COMPILE = """
import triton
from triton.backends.compiler import GPUTarget
from scenefuse.nerf import triton_kernels

floats, levels = "*fp32", ["*fp32", "*u32", "*u32", "*u32", "*fp32"]
arguments = {
    "_encode": [floats, floats, *levels, floats, "i32"],
    "_encode_backward": [floats, floats, *levels, floats, "i32"],
}
for name, types in arguments.items():
    function = getattr(triton_kernels, name)
    aligned = {(i,): [["tt.divisibility", 16]] for i, kind in enumerate(types) if kind.startswith("*")}
    source = triton.compiler.ASTSource(
        fn=function,
        signature=dict(zip(function.arg_names, [*types, "constexpr", "constexpr"])),
        constexprs={"LEVELS": 16, "BLOCK": triton_kernels.BLOCK},
        attrs=aligned,
    )
    for capability in (75, 80, 90):
        text = triton.compile(source, target=GPUTarget("cuda", capability, 32)).asm["ptx"]
        print(name, capability, text.count("ld.global.v2"), text.count("atom.global"), text.count("bar.sync"))
"""


@pytest.mark.process
def test_gpu_kernels_compile_to_one_load_or_addition_per_vertex(tmp_path):
    pytest.importorskip("triton", reason="Triton is not installed: pip install -r tests/requirements.txt")
    environment = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", COMPILE], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:-1] == [
        "_encode 75 8 0 0", "_encode 80 8 0 0", "_encode 90 8 0 0",
        "_encode_backward 75 1 16 0", "_encode_backward 80 1 16 0", "_encode_backward 90 1 8 0",
    ]  # fmt: skip


def test_spherical_harmonics_are_orthonormal():
    generator = np.random.default_rng(0)
    directions = torch.from_numpy(generator.normal(size=(200_000, 3)).astype(np.float32))
    basis = spherical_harmonics(directions / directions.norm(dim=1, keepdim=True))
    gram = 4 * np.pi * (basis.T @ basis / len(basis)).numpy()
    assert np.abs(gram - np.eye(16)).max() < 0.03
