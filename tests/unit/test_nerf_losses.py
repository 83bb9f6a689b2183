"""Each loss against a value worked out by hand."""

import math

import pytest
import torch

from scenefuse.nerf import rays


def test_color_counts_rays_inside_only():
    predicted, target = torch.tensor([[0.1, 0.1, 0.1], [1.0, 1.0, 1.0]]), torch.zeros(2, 3)
    value = rays.color_loss(predicted, target, torch.tensor([True, False]))
    assert float(value) == pytest.approx(0.5 * 0.01)


def test_depth_is_huber_where_opaque_and_known():
    distance, prior = torch.tensor([1.0, 1.005, 1.1, 2.0]), torch.ones(4)
    opacity, weight = torch.tensor([1.0, 1.0, 1.0, 0.2]), torch.tensor([0.0, 1.0, 0.5, 1.0])
    quadratic, linear = 0.5 * 0.005**2 / 0.01, 0.1 - 0.005
    value = rays.depth_loss(distance, opacity, prior, weight)
    assert float(value) == pytest.approx((quadratic + 0.5 * linear) / 3, rel=1e-3)


def test_mask_is_binary_cross_entropy():
    value = rays.mask_loss(torch.tensor([0.9, 0.2]), torch.tensor([1.0, 0.0]))
    assert float(value) == pytest.approx(-(math.log(0.9) + math.log(0.8)) / 2, rel=1e-5)


def test_sparsity_sees_empty_rays_only():
    sigma, delta = torch.tensor([[5.0, 5.0], [1.0, 0.0]]), torch.ones(2, 2)
    value = rays.sparsity_loss(sigma, delta, torch.tensor([True, False]))
    assert float(value) == pytest.approx((1 - math.exp(-1)) / 2, rel=1e-5)
    assert float(rays.sparsity_loss(sigma, delta, torch.tensor([True, True]))) == 0.0
