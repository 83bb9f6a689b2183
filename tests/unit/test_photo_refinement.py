"""Depths moved by matching: a known plane with wrong depths comes back; without texture they stay as they were."""

from dataclasses import replace

import numpy as np
import pytest
from support.textured_plane import plane_views, speckled, wrong_depths

from scenefuse.mvs.photo_refinement import RefinementSettings, refine_by_photos


def test_wrong_depths_of_a_textured_plane_come_back():
    views, truth = plane_views(count=8, width=160, height=120)
    views = speckled(views, truth)
    wrong = wrong_depths(truth)
    refined = refine_by_photos(views, views.object_from_cam, wrong, RefinementSettings(match_reach_px=8))
    known = truth > 0
    error = [np.median(np.abs(d - truth)[known] / truth[known]) for d in (wrong, refined.depths)]
    assert error[1] < 0.2 * error[0]
    assert refined.moved[known].mean() > 0.5 and not refined.depths[~known].any()
    assert refined.inconsistent[known].mean() < 0.05


def test_smooth_surfaces_are_left_alone():
    views, truth = plane_views(count=8, width=160, height=120)
    depths = truth.astype(np.float32)
    refined = refine_by_photos(views, views.object_from_cam, depths, RefinementSettings(match_reach_px=8))
    assert refined.moved[truth > 0].mean() < 0.05 and refined.inconsistent[truth > 0].mean() < 1e-3
    assert np.quantile(np.abs(refined.depths - depths)[truth > 0] / truth[truth > 0], 0.9) < 1e-6


def test_depths_stay_where_nothing_can_be_matched():
    views, truth = plane_views(count=8, width=96, height=72)
    plain = replace(views, images=np.full_like(views.images, 120))
    wrong = wrong_depths(truth)
    refined = refine_by_photos(plain, plain.object_from_cam, wrong, RefinementSettings(match_reach_px=8))
    assert not (refined.moved | refined.inconsistent).any() and np.array_equal(refined.depths, wrong)


@pytest.fixture(scope="module")
def far_off():
    """A textured plane with depths far from the truth: views, true depths, these depths, and what they become."""
    views, truth = plane_views(count=8, width=160, height=120)
    views, depths = speckled(views, truth), np.where(truth > 0, 1.3 * truth, 0).astype(np.float32)
    return (
        views,
        truth,
        depths,
        refine_by_photos(views, views.object_from_cam, depths, RefinementSettings(match_reach_px=1)),
    )


def test_no_depth_moves_farther_than_its_reach(far_off):
    views, truth, depths, refined = far_off
    moved = np.abs(1 / refined.depths[truth > 0] - 1 / depths[truth > 0])
    baseline = np.linalg.norm(np.diff(views.object_from_cam[:, :3, 3], axis=0), axis=1).min()
    assert moved.max() < 4.0 / (views.intrinsics[0, 0, 0] * baseline)


def test_a_textured_surface_far_from_where_it_is_is_not_photo_consistent(far_off):
    _, truth, _, refined = far_off
    assert refined.inconsistent[truth > 0].mean() > 0.9
