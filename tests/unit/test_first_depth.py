"""Stage 1: first depths and the prior's maps beside the depths of a planted plane."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.textured_plane import plane_views, speckled

from scenefuse.core.stage import StageError
from scenefuse.geometry.consistency import extent
from scenefuse.nerf import depth_prior as stage
from scenefuse.nerf.depth_prior import first_depth, points_on_object
from scenefuse.photos.pictures import read_depth


def _first(views):
    """First depths of all photos, and the points that they come from."""
    known = points_on_object(views, 4)
    return np.stack([first_depth(views, known, index) for index in range(len(views.names))]), known


def _median_error(depths, truth, views):
    """Share of the object's diagonal."""
    return np.median(np.abs(depths - truth)[views.masks]) / extent(views.sparse)


def test_first_depth_is_near_the_truth_and_sources_are_never_held_out():
    views, truth = plane_views()
    depths, known = _first(views)
    assert not np.isin(np.flatnonzero(views.held_out), known.sources).any()
    assert _median_error(depths, truth, views) < 0.005


def test_photos_without_points_have_their_depth_by_stereo():
    """Three points set the depth between points, in the middle of the range: what is right beside it is stereo's."""
    views, truth = plane_views(width=160, height=120)
    views = speckled(views, truth)
    known = points_on_object(views, 4)
    nothing = replace(known, pixels=[pixels[:0] for pixels in known.pixels[:-1]] + known.pixels[-1:])
    depths = np.stack([first_depth(views, nothing, index) for index in range(len(views.names))])
    assert _median_error(depths, truth, views) < 0.01


def test_photos_from_far_off_have_their_own_range_of_depths():
    views, truth = plane_views(count=12, width=320, height=240, distances=(3.0, 15.0))
    views = speckled(views, truth)
    known = points_on_object(views, 4)
    nothing = replace(known, pixels=[pixels[:0] for pixels in known.pixels[:-1]] + known.pixels[-1:])
    far = [first_depth(views, nothing, index) for index in (3, 5)]
    assert _median_error(np.stack(far), truth[[3, 5]], views.select(np.array([3, 5]))) < 0.03


def test_where_stereo_finds_nothing_depth_is_between_the_points():
    views, truth = plane_views()
    blank = replace(views, images=np.full_like(views.images, 90))
    depths, _ = _first(blank)
    assert _median_error(depths, truth, views) < 0.005


def test_the_stage_writes_maps_near_the_truth_and_says_how_many_are_confirmed(tmp_path, monkeypatch):
    views, truth = plane_views()
    monkeypatch.setattr(stage, "load_views", lambda *_: views)
    stage.estimate_depth_prior(
        workspace=tmp_path, masks=tmp_path, stage=tmp_path / "stage1", report=tmp_path / "stage1.json", width_px=64,
        hold_out_every=8, crop_px=56, map_agreement=0.02,
    )  # fmt: skip
    report = json.loads((tmp_path / "stage1.json").read_text())
    errors, confident = [], []
    for index, name in enumerate(views.names):
        depth = read_depth(tmp_path / "stage1" / "depth_maps" / f"{name}.bin")
        confidence = read_depth(tmp_path / "stage1" / "confidence_maps" / f"{name}.bin")
        assert (depth[~views.masks[index]] == 0).all() and (confidence[~views.masks[index]] == 0).all()
        errors.append((np.abs(depth - truth[index]) / truth[index].max())[views.masks[index]])
        if not views.held_out[index]:
            confident.append(confidence[views.masks[index]])
    assert np.median(np.concatenate(errors)) < 0.01
    assert report["confirmed_share"]["value"] > 0.7
    assert np.concatenate(confident).mean() > 0.6


def test_too_few_points_or_photos_is_one_sentence():
    views, _ = plane_views()
    with pytest.raises(StageError, match="only 3 points lie on the object"):
        points_on_object(replace(views, tracks=[np.arange(3)] * 8), 4)
    with pytest.raises(StageError, match="needs at least 3"):
        points_on_object(replace(views, held_out=np.arange(8) > 1), 4)
