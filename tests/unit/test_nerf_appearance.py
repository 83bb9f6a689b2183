"""What photos differ in beside their view: planted gains and vignetting are found, exact photos stay as they are."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.painted_sphere import photos_of, sphere_views, sphere_volume

from scenefuse.core.machine import use_threads
from scenefuse.nerf.appearance import (
    falloff_map,
    fitted_log_gain,
    gains_nearby,
    measured_sharpness,
    photo_weights,
    shared_colors,
    shrunk,
    solved,
    without_appearance,
)
from scenefuse.nerf.field import FieldSettings
from scenefuse.nerf.rays import LossWeights
from scenefuse.nerf.rendered_maps import fitted_to_left_half, right_half
from scenefuse.nerf.training import NerfRecipe, Schedule, Training, new_nerf, train

FALLOFF = torch.tensor(-0.35)


@pytest.fixture(scope="module")
def sphere():
    return sphere_views(size=96)


@pytest.fixture(scope="module")
def exact(sphere):
    """Photos with their true depth as prior, all of one exposure, dark enough to stay below white with any gain."""
    photos = photos_of(sphere, sphere_volume(sphere)[0], prior=1.0)
    return replace(photos, images=(photos.images * 0.6).to(torch.uint8))


@pytest.fixture(scope="module")
def gains():
    """Log gains (12, 3) of mean 0, a fifth and more apart."""
    drawn = torch.from_numpy(np.random.default_rng(4).normal(0, 0.2, (12, 3))).float()
    return drawn - drawn.mean(0)


@pytest.fixture(scope="module")
def spoilt(exact, gains):
    """The same photos under these gains and a vignetting."""
    height, width = exact.images.shape[1:3]
    factors = [g.exp() * falloff_map(FALLOFF, k, height, width) for g, k in zip(gains, exact.intrinsics)]
    return replace(exact, images=(exact.images * torch.stack(factors)).round().clamp(0, 255).to(torch.uint8))


def _found(photos):
    small = shrunk(photos)
    return solved(shared_colors(small, torch.where(small.masks, photos.depths, 0.0)), len(photos))


def _at_rim(falloff):
    """Vignetting at half of the corner's radius, about where the sphere's outline lies."""
    return float((falloff * 0.25).exp())


def test_planted_gains_and_vignetting_are_found(spoilt, gains):
    found = _found(spoilt)
    assert float((found.log_gain - gains).abs().max()) < 0.02
    assert _at_rim(found.falloff) == pytest.approx(_at_rim(FALLOFF), abs=0.01)


def test_exact_photos_stay_as_they_are(exact):
    found = _found(exact)
    assert float(found.log_gain.abs().max()) < 0.01
    assert _at_rim(found.falloff) == pytest.approx(1.0, abs=0.01)


def test_photos_that_share_nothing_keep_a_gain_of_one(spoilt, gains):
    small = shrunk(spoilt)
    depths = torch.where(small.masks, spoilt.depths, 0.0)
    depths[5] = 0
    found = solved(shared_colors(small, depths), len(spoilt))
    others = torch.arange(12) != 5
    between = found.log_gain[others] - gains[others]
    assert float((between - between.mean(0)).abs().max()) < 0.02
    assert not found.log_gain[5].any()
    alone = solved(shared_colors(small.select(np.array([0, 6])), 0 * depths[:2]), 2)
    assert not alone.log_gain.any() and not alone.falloff.any()


def _trained(photos, sphere, steps=160):
    use_threads(1)
    hull = torch.from_numpy(sphere_volume(sphere)[1])
    nerf = new_nerf(
        FieldSettings(levels=6, log2_table=12, coarsest=8, finest=64, width=16), hull, len(photos), 0, "cpu"
    )
    recipe = NerfRecipe(
        images_per_batch=8, rays_per_image=64, warmup_epochs=0.2, learning_rate=1e-2, grid_learning_rate=2e-2,
        samples=16, mask_band_px=1,
    )  # fmt: skip
    schedule = Schedule(epochs=2, rays_per_epoch=steps * 512 // 2)
    train(nerf, Training(photos, schedule, recipe, LossWeights(), False, 0), checkpoint=None, report=lambda line: None)
    return nerf.appearance


@pytest.mark.slow
def test_training_finds_planted_gains_and_leaves_exact_photos_alone(exact, spoilt, gains, sphere):
    assert float((_trained(spoilt, sphere).log_gain - gains).abs().max()) < 0.05
    assert float(_trained(exact, sphere).log_gain.abs().max()) < 0.05


def test_one_exposure_is_what_is_left(exact, spoilt, gains):
    neutral = without_appearance(spoilt.images, spoilt.intrinsics, gains, FALLOFF)
    assert int((neutral.int() - exact.images.int()).abs().max()) <= 2
    none = torch.zeros(12, 3), torch.tensor(0.0)
    assert torch.equal(without_appearance(exact.images, exact.intrinsics, *none), exact.images)


def test_a_photo_that_was_not_trained_on_looks_like_its_neighbours():
    center = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [9.0, 0, 0]])
    gains = gains_nearby(torch.tensor([[0.2], [0.4], [-0.6]]).expand(3, 3), center, torch.tensor([0, 2, 3]))
    assert torch.allclose(gains[:, 0], torch.tensor([0.2, 0.3, 0.4, -0.6]))


def test_gains_are_fitted_in_spite_of_a_highlight():
    render = torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) * 0.6
    photo = render * torch.tensor([1.3, 1.0, 0.8])
    photo[:40] = 1.0
    assert torch.allclose(fitted_log_gain(render, photo).exp(), torch.tensor([1.3, 1.0, 0.8]), atol=0.04)
    assert not fitted_log_gain(render[:0], photo[:0]).any()
    assert torch.isfinite(fitted_log_gain(torch.zeros(5, 3), photo[:5])).all()


def test_the_fit_on_the_left_half_does_not_see_the_right_half():
    render = torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(1)) * 0.6
    mask = torch.zeros(20, 30, dtype=torch.bool)
    mask[3:17, 4:28] = True
    photo = render * torch.tensor([1.2, 0.9, 0.7])
    right = right_half(mask)
    assert right.sum() == (mask & ~right).sum() and not (right & ~mask).any()
    fitted = fitted_to_left_half(render, photo, mask)
    assert torch.allclose(fitted[mask], photo[mask], atol=2e-3)
    pole = mask & (torch.arange(30) == 9)  # one column, whose quality would be no number
    assert torch.equal(right_half(pole), pole)
    assert torch.equal(fitted_to_left_half(render, photo, pole), render)
    changed = photo.clone()
    changed[right] = 0.1
    assert torch.equal(fitted_to_left_half(render, changed, mask), fitted)
    changed[mask & ~right] *= 0.5
    assert not torch.allclose(fitted_to_left_half(render, changed, mask), fitted, atol=0.05)


def test_a_blurred_photo_weighs_less_and_sharp_ones_do_not():
    noise = np.random.default_rng(2).normal(size=(12, 96, 96))
    detail = np.fft.ifft2(np.fft.fft2(noise) / (0.02 + np.hypot(*np.meshgrid(*[np.fft.fftfreq(96)] * 2)))).real
    images = torch.from_numpy(np.clip(128 + 40 * detail / detail.std(), 0, 255).astype(np.uint8))[..., None]
    images = images.expand(-1, -1, -1, 3).clone()
    masks = torch.zeros(12, 96, 96, dtype=torch.bool)
    masks[:, 10:86, 10:86] = True
    angle = torch.arange(12) / 12 * 2 * torch.pi
    center = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    assert (photo_weights(measured_sharpness(images, masks), center) == 1).all()
    soft = images[3].float()
    for _ in range(3):
        soft = torch.nn.functional.avg_pool2d(soft.permute(2, 0, 1), 3, 1, 1, count_include_pad=False).permute(1, 2, 0)
    images[3] = soft.to(torch.uint8)
    weight = photo_weights(measured_sharpness(images, masks), center)
    assert weight[3] < 0.7 and (weight[torch.arange(12) != 3] == 1).all()
    # The frame that a large object reaches is no detail of it.
    found = (measured_sharpness(images, where)[3] for where in (masks, masks | True))
    assert next(found) == pytest.approx(float(next(found)), rel=0.1)
    empty = measured_sharpness(images, masks & False)
    assert (photo_weights(empty, center) == 1).all()


def test_photos_without_any_detail_weigh_as_much_as_each_other():
    images, masks = torch.full((3, 20, 20, 3), 255, dtype=torch.uint8), torch.ones(3, 20, 20, dtype=torch.bool)
    assert (photo_weights(measured_sharpness(images, masks), torch.eye(3)) == 1).all()
