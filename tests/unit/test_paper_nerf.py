"""What the paper adds to a NeRF's training: the order of depths, longer steps of the hash grid at edges."""

import os
import signal
from dataclasses import replace

import pytest
import torch
from support.painted_sphere import photos_of, sphere_views, sphere_volume

import scenefuse.nerf.training as training_module
from scenefuse.core.machine import use_threads
from scenefuse.nerf.field import Field, FieldSettings, encode
from scenefuse.nerf.rays import LossWeights, draw_batch
from scenefuse.nerf.training import Nerf, NerfRecipe, Schedule, Training, new_nerf, train
from scenefuse.paper.train_nerf_as_paper import RANK_MARGIN, RANK_WEIGHT, OrderAndEdges, rank_loss

FIELD = FieldSettings(levels=6, log2_table=12, coarsest=8, finest=64, width=16)
RECIPE = NerfRecipe(
    images_per_batch=8, rays_per_image=64, warmup_epochs=0.2, learning_rate=1e-2, grid_learning_rate=2e-2,
    samples=16, coarse_until=0.0, mask_band_px=1, appearance=False,
)  # fmt: skip
NO_ORDER = 1e-9
WEIGHTS = LossWeights()


@pytest.fixture(scope="module")
def sphere():
    return sphere_views()


def _train(sphere, steps, weights=WEIGHTS, scales=None, checkpoint=None, report=lambda line: None, **added):
    use_threads(1)
    cube, hull = sphere_volume(sphere)
    photos = photos_of(sphere, cube, prior=1.0)
    if scales is not None:
        photos = replace(photos, depths=scales * photos.depths)
    nerf = new_nerf(FIELD, torch.from_numpy(hull), len(photos), 0, "cpu")
    additions = OrderAndEdges(nerf, photos, RECIPE.images_per_batch, **added)
    training = Training(photos, Schedule(2, steps * 512 // 2), RECIPE, weights, warm=False, seed=0, additions=additions)
    return nerf, train(nerf, training, checkpoint=checkpoint, report=report)


def test_rank_punishes_the_wrong_order_only():
    opacity, weight = torch.ones(2), torch.ones(2)
    uv = torch.tensor([[0.0, 0.0], [50.0, 0.0]])
    prior = torch.tensor([1.0, 2.0])

    def rank(a, b, apart=10.0):
        return float(rank_loss(torch.tensor([a, b]), opacity, prior, weight, uv, 1, apart))

    assert rank(1.0, 2.0) == 0.0
    assert rank(2.0, 1.0) == pytest.approx((RANK_MARGIN + 1.0) / RANK_MARGIN, rel=1e-4)
    assert rank(2.0, 1.0, apart=60.0) == 0.0


@pytest.mark.slow
def test_the_order_is_learned_beside_the_depths_that_it_is_of(sphere):
    """Both losses of the same maps, each with a scale of its own as monocular maps have, at the recipe's weights."""
    scales = 1 + 0.15 * torch.randn((12, 1, 1), generator=torch.Generator().manual_seed(2))
    ranked, not_ranked = (_train(sphere, 60, scales=scales, rank_weight=w)[1] for w in (RANK_WEIGHT, NO_ORDER))
    assert ranked["rank"] < 0.95 * not_ranked["rank"]


def test_a_killed_training_goes_on_with_the_edges_that_it_has_seen(sphere, tmp_path, monkeypatch):
    whole = _train(sphere, 24)[0]

    def draw_and_end_at_ten(*arguments):
        if arguments[3] == 10:
            os.kill(os.getpid(), signal.SIGTERM)
        return draw_batch(*arguments)

    monkeypatch.setattr(training_module, "draw_batch", draw_and_end_at_ten)
    with pytest.raises(SystemExit):
        _train(sphere, 24, checkpoint=tmp_path / "state.pt")
    monkeypatch.setattr(training_module, "draw_batch", draw_batch)
    resumed = _train(sphere, 24, checkpoint=tmp_path / "state.pt")[0]
    assert torch.equal(whole.field.table, resumed.field.table)


def as_adam(monkeypatch):
    """Every row takes Adam's own step."""
    monkeypatch.setattr(OrderAndEdges, "factor", lambda self, field: 1.0)


def test_rows_of_fine_levels_take_longer_steps_at_edges(sphere, monkeypatch):
    def moved():
        """How far one step moves the rows of the coarse and of the fine levels, both in learning rates."""
        nerf = _train(sphere, 1, weights=LossWeights())[0]
        start = new_nerf(FIELD, torch.from_numpy(sphere_volume(sphere)[1]), 12, 0, "cpu").field
        steps = (nerf.field.table - start.table).detach().abs() / RECIPE.grid_learning_rate
        first_fine = int(start.grid.offset[FIELD.levels // 2])
        return steps[:first_fine], steps[first_fine:]

    same, faster = moved()
    as_adam(monkeypatch)
    coarse, fine = moved()
    assert torch.equal(same, coarse)
    ratio = (faster / fine)[fine > 0.9]
    assert float(ratio.min()) > 0.99 and float(ratio.max()) == pytest.approx(2.0, rel=1e-3)
    assert (ratio > 1.5).float().mean() > 0.05 and (ratio < 1.1).float().mean() > 0.05


def _errors(sphere):
    """What is left of a wave after 40 steps, root mean square, where x < 0.5 is called an edge, and elsewhere."""
    rng = torch.Generator().manual_seed(0)
    field = Field(FieldSettings(levels=4, log2_table=14, coarsest=4, finest=24), rng)
    optimizer = torch.optim.Adam([field.table], lr=1e-2, betas=(0.9, 0.99), eps=1e-15)
    cube, hull = sphere_volume(sphere)
    untrained = new_nerf(FIELD, torch.from_numpy(hull), 12, 0, "cpu")
    nerf = Nerf(field, untrained.occupancy, untrained.appearance)
    added = OrderAndEdges(nerf, photos_of(sphere, cube), 8)

    def off(x):
        wave = torch.sin(60 * x[:, 0]) * torch.sin(60 * x[:, 1])
        return encode(x, field.table, field.grid, field.level_weight).sum(1) - wave

    for _ in range(40):
        x = torch.rand(2000, 3, generator=rng)
        (off(x) ** 2).mean().backward()
        added.see(field, x, torch.ones(len(x)), (x[:, 0] < 0.5).float())
        added.descend(nerf, optimizer)
        optimizer.zero_grad()
    x = torch.rand(5000, 3, generator=rng)
    left = off(x).detach() ** 2
    return [float(left[at].mean().sqrt()) for at in (x[:, 0] < 0.5, x[:, 0] >= 0.5)]


def test_the_adaptive_grid_learns_edges_better_and_the_rest_as_well(sphere, monkeypatch):
    as_papers = _errors(sphere)
    as_adam(monkeypatch)
    plain = _errors(sphere)
    assert as_papers[0] < 0.95 * plain[0] and as_papers[1] == pytest.approx(plain[1], rel=0.02)
