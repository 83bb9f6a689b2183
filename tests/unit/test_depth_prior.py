"""The depth prior: photos sharpen it, views that disagree get no confidence, held-out photos take no part; stage 3."""

from dataclasses import replace

import numpy as np
import pytest
from support.textured_plane import plane_views, speckled, wrong_depths

from scenefuse.core.stage import StageError, read_json, value
from scenefuse.mvs.photo_refinement import RefinementSettings
from scenefuse.nerf import rendered_maps as feedback
from scenefuse.nerf.rendered_maps import DepthPrior, confirm, read_prior, write_prior
from scenefuse.photos.pictures import read_depth, write_depth

MATCHING = RefinementSettings(match_reach_px=8.0)
AS_IT_IS = RefinementSettings(match_reach_px=0.0)


@pytest.fixture(scope="module")
def plane():
    views, truth = plane_views(count=8, width=160, height=120, held_out=2)
    return speckled(views, truth), truth.astype(np.float32)


def test_photos_sharpen_the_prior_and_make_it_sure(plane):
    views, truth = plane
    wrong = wrong_depths(truth)
    prior, report = confirm(views, wrong, MATCHING, 0.01)
    known = (prior.confidence > 0) & (truth > 0)
    errors = [np.median(np.abs(d - truth)[known] / truth[known]) for d in (wrong, prior.depths)]
    assert known.sum() > 0.5 * (truth[~views.held_out] > 0).sum() and errors[1] < 0.2 * errors[0]
    assert value(report, "refined_share") > 0.5 and np.median(prior.confidence[known]) == 1


def test_held_out_photos_and_their_maps_change_nothing(plane):
    views, truth = plane
    other = wrong_depths(truth)
    other[views.held_out] *= 1.2
    images = np.where(views.held_out[:, None, None, None], 255 - views.images, views.images)
    one, _ = confirm(views, wrong_depths(truth), MATCHING, 0.01)
    two, _ = confirm(replace(views, images=images), other, MATCHING, 0.01)
    assert np.array_equal(one.depths[~views.held_out], two.depths[~views.held_out])
    assert np.array_equal(one.confidence, two.confidence) and not one.confidence[views.held_out].any()


def test_maps_that_contradict_each_other_get_no_confidence(plane):
    views, truth = plane
    factor = np.where(np.arange(len(truth)) % 2, 1.0, 1.1)[:, None, None]
    alone = np.flatnonzero(~views.held_out)[0]
    factor[alone] = 1.25
    prior, report = confirm(views, (truth * factor).astype(np.float32), AS_IT_IS, 0.01)
    assert prior.confidence[alone][truth[alone] > 0].mean() < 0.05
    assert value(report, "refined_share") == 0 and 0.5 < prior.confidence.max() <= 1


def test_a_prior_is_read_as_written_and_a_missing_map_is_none_of_its_photo(plane, tmp_path):
    views, truth = plane
    confidence = np.where(truth > 0, np.float32(0.5), np.float32(0))
    write_prior(tmp_path, views, DepthPrior(truth, confidence))
    missing = np.flatnonzero(~views.held_out)[1]
    (tmp_path / "depth_maps" / f"{views.names[missing]}.bin").unlink()
    prior = read_prior(tmp_path, views)
    rest = np.arange(len(truth)) != missing
    assert np.array_equal(prior.depths[rest], (truth * views.masks)[rest]) and not prior.depths[missing].any()
    assert not prior.confidence[missing].any() and not prior.confidence[views.held_out].any()
    assert (prior.confidence[rest & ~views.held_out][(truth * views.masks)[rest & ~views.held_out] > 0] == 0.5).all()


def test_stage_3_writes_rendered_depth_as_photos_correct_it(plane, tmp_path, monkeypatch):
    views, truth = plane
    monkeypatch.setattr(feedback, "load_views", lambda *_: views)

    def refine():
        feedback.refine_depth(
            workspace=tmp_path, masks=tmp_path, rendered=tmp_path / "stage2", stage=tmp_path / "stage3",
            report=tmp_path / "stage3.json", width_px=160, hold_out_every=4,
        )  # fmt: skip

    with pytest.raises(StageError, match="holds no depth for any photo"):
        refine()
    wrong = wrong_depths(truth)
    for name, depth in zip(views.names, wrong):
        write_depth(tmp_path / "stage2/depth_maps" / f"{name}.bin", depth)
    refine()
    found = np.stack([read_depth(tmp_path / "stage3/depth_maps" / f"{name}.bin") for name in views.names])
    there = (found > 0) & (truth > 0) & ~views.held_out[:, None, None]
    errors = [np.median(np.abs(depth - truth)[there]) for depth in (wrong, found)]
    assert errors[1] < 0.2 * errors[0] and value(read_json(tmp_path / "stage3.json"), "confirmed_share") > 0.4
