"""The depth prior: photos sharpen it, views that disagree get no confidence, held-out photos take no part."""

from dataclasses import replace

import numpy as np
import pytest
from support.textured_plane import plane_views, speckled, wrong_depths

from scenefuse.mvs.photo_refinement import RefinementSettings
from scenefuse.nerf.prior.prior import Unconfirmed, read_prior
from scenefuse.photos.maps import write_depth

MATCHING = RefinementSettings(match_reach_px=8.0)
AS_IT_IS = RefinementSettings(match_reach_px=0.0)


def _write(folder, views, depths, confidence=0.5):
    for name, depth in zip(views.names, depths):
        write_depth(folder / "depth_maps" / f"{name}.bin", depth)
        write_depth(folder / "confidence_maps" / f"{name}.bin", np.full(depth.shape, confidence, np.float32))


@pytest.fixture(scope="module")
def plane():
    views, truth = plane_views(count=8, width=160, height=120, held_out=2)
    return speckled(views, truth), truth.astype(np.float32)


def test_photos_sharpen_the_prior_and_make_it_sure(plane, tmp_path):
    views, truth = plane
    wrong = wrong_depths(truth)
    _write(tmp_path, views, wrong)
    prior = read_prior(tmp_path, views, MATCHING, 0.01)
    known = (prior.confidence > 0) & (truth > 0)
    errors = [np.median(np.abs(d - truth)[known] / truth[known]) for d in (wrong, prior.depths)]
    assert known.sum() > 0.5 * (truth[~views.held_out] > 0).sum() and errors[1] < 0.2 * errors[0]
    assert prior.refined_share > 0.5 and np.median(prior.confidence[known]) == 1
    assert not prior.depths[views.held_out].any()


def test_all_depths_are_taken_as_they_are_where_nothing_has_to_confirm_them(plane, tmp_path):
    views, truth = plane
    wrong = wrong_depths(truth) * np.linspace(0.5, 1.5, len(truth), dtype=np.float32)[:, None, None]
    _write(tmp_path, views, wrong)
    assert read_prior(tmp_path, views, AS_IT_IS, 0.01).confident_share < 0.1
    prior = read_prior(tmp_path, views, AS_IT_IS, 0.01, Unconfirmed(depths=True))
    there = views.masks & (truth > 0) & ~views.held_out[:, None, None]
    assert np.array_equal(prior.depths[there], wrong[there]) and (prior.confidence[there] == 1).all()
    assert prior.order is None and not prior.depths[views.held_out].any()


def test_held_out_photos_and_their_maps_change_nothing(plane, tmp_path):
    views, truth = plane
    _write(tmp_path / "whole", views, wrong_depths(truth))
    other = wrong_depths(truth)
    other[views.held_out] *= 1.2
    _write(tmp_path / "other", views, other)
    images = np.where(views.held_out[:, None, None, None], 255 - views.images, views.images)
    one = read_prior(tmp_path / "whole", views, MATCHING, 0.01)
    two = read_prior(tmp_path / "other", replace(views, images=images), MATCHING, 0.01)
    assert np.array_equal(one.depths, two.depths) and np.array_equal(one.confidence, two.confidence)


def test_maps_that_contradict_each_other_get_no_confidence(plane, tmp_path):
    views, truth = plane
    factor = np.where(np.arange(len(truth)) % 2, 1.0, 1.1)[:, None, None]
    alone = np.flatnonzero(~views.held_out)[0]
    factor[alone] = 1.25
    _write(tmp_path, views, (truth * factor).astype(np.float32))
    prior = read_prior(tmp_path, views, AS_IT_IS, 0.01)
    inside = truth[alone] > 0
    assert prior.confidence[alone][inside].mean() < 0.05
    assert prior.refined_share == 0 and prior.confidence.max() == pytest.approx(0.5)


def test_a_missing_map_is_no_prior_of_its_photo(plane, tmp_path):
    views, truth = plane
    _write(tmp_path, views, truth)
    missing = np.flatnonzero(~views.held_out)[1]
    (tmp_path / "depth_maps" / f"{views.names[missing]}.bin").unlink()
    prior = read_prior(tmp_path, views, AS_IT_IS, 0.01)
    assert not prior.depths[missing].any() and prior.confidence[~views.held_out].any()
