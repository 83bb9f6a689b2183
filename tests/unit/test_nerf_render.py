"""Marching and compositing against values worked out by hand and against plain PyTorch."""

import math

import pytest
import torch

from scenefuse.nerf.render import Occupancy, RayPrior, composite, march, march_reference, median_distance


def _no_prior(rays):
    return RayPrior(torch.full((rays,), -1.0), torch.zeros(rays), torch.zeros(rays))


def test_composite_by_hand():
    half = math.log(2.0)
    sigma, delta = torch.tensor([[half, half, 2 * half]]), torch.ones(1, 3)
    t = torch.tensor([[1.0, 2.0, 3.0]])
    rgb = torch.eye(3)[None]
    ray = composite(sigma, rgb, t, delta)
    expected = [0.5, 0.25, 0.1875]
    assert ray.weights[0].tolist() == pytest.approx(expected, abs=1e-6)
    assert ray.color[0].tolist() == pytest.approx(expected, abs=1e-6)
    assert float(ray.opacity) == pytest.approx(0.9375, abs=1e-6)
    assert float(ray.moment) == pytest.approx(0.5 + 0.5 + 3 * 0.1875, abs=1e-6)


def test_uniform_marching_splits_the_occupied_length_evenly():
    occupied = torch.zeros(8, 8, 8, dtype=torch.bool)
    occupied[2:6] = True
    grid = Occupancy(occupied, torch.zeros(8, 8, 8))
    origin, direction = torch.tensor([[-1.0, 0.51, 0.51]]), torch.tensor([[1.0, 0.0, 0.0]])
    drawn = march(origin, direction, grid, torch.full((1, 4), 0.5), 1.0, _no_prior(1))
    step = grid.step
    assert float(drawn.delta.sum()) == pytest.approx(0.5, abs=step)
    assert drawn.delta[0].tolist() == pytest.approx([float(drawn.delta.sum()) / 4] * 4, rel=1e-5)
    assert ((drawn.t > 1.25 - step) & (drawn.t < 1.75 + step)).all()


def test_rays_that_meet_nothing_get_no_samples():
    occupied = torch.zeros(8, 8, 8, dtype=torch.bool)
    occupied[2:6] = True
    grid = Occupancy(occupied, torch.zeros(8, 8, 8))
    origin = torch.tensor([[-1.0, 0.5, 0.5], [0.1, -1.0, 0.5], [-1.0, 5.0, 0.5]])
    direction = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    assert march(origin, direction, grid, torch.full((3, 4), 0.5), 1.0, _no_prior(3)).ray.tolist() == [0]


def test_known_density_and_prior_draw_samples_to_the_surface():
    occupied = torch.ones(64, 64, 64, dtype=torch.bool)
    density = torch.zeros(64, 64, 64)
    density[32:] = 1000.0
    origin, direction = torch.tensor([[-1.0, 0.5, 0.5]]), torch.tensor([[1.0, 0.0, 0.0]])
    jitter = torch.full((1, 16), 0.5)
    by_density = march(origin, direction, Occupancy(occupied, density), jitter, 0.25, _no_prior(1))
    assert int(((by_density.t - 1.5).abs() < 0.05).sum()) >= 11
    prior = RayPrior(torch.tensor([1.3]), torch.tensor([0.05]), torch.tensor([0.6]))
    by_prior = march(origin, direction, Occupancy(occupied, 0 * density), jitter, 0.25, prior)
    assert int(((by_prior.t - 1.3).abs() < 0.06).sum()) >= 9


def test_marching_matches_the_reference():
    rng = torch.Generator().manual_seed(3)
    occupied = torch.rand(16, 16, 16, generator=rng) > 0.6
    grid = Occupancy(occupied, torch.rand(16, 16, 16, generator=rng) * 5)
    origin = torch.rand(200, 3, generator=rng) * 3 - 1
    direction = torch.rand(200, 3, generator=rng) - origin
    direction = direction / direction.norm(dim=1, keepdim=True)
    jitter = torch.rand(200, 12, generator=rng)
    prior = RayPrior(torch.rand(200, generator=rng) * 2, torch.full((200,), 0.1), torch.full((200,), 0.4))
    ours = march(origin, direction, grid, jitter, 0.3, prior)
    t, delta, hit = march_reference(origin, direction, grid, jitter, 0.3, prior)
    assert ours.ray.tolist() == torch.nonzero(hit)[:, 0].tolist()
    # Rounding may put a single interval or sample on the other side of a boundary.
    close = ((ours.t - t[hit]).abs() < 1e-3) & ((ours.delta - delta[hit]).abs() < 1e-3)
    assert close.float().mean() > 0.99


def test_median_distance_is_linear_inside_a_share():
    t, delta = torch.tensor([[1.0, 2.0, 3.0]]), torch.ones(1, 3)
    assert float(median_distance(t, delta, torch.tensor([[0.25, 0.5, 0.25]]))) == pytest.approx(2.0)
    assert float(median_distance(t, delta, torch.tensor([[0.1, 0.0, 0.3]]))) == pytest.approx(2.5 + 1 / 3, abs=1e-5)
