"""Depths moved by matching: a known plane with wrong depths comes back; without texture they stay as they were."""

from dataclasses import replace

import numpy as np
from support.textured_plane import plane_views, speckled, wrong_depths

from scenefuse.geometry.consistency import back_project
from scenefuse.mvs.photo_refinement import RefinementSettings, choose_sources, refine_by_photos


def test_wrong_depths_of_a_textured_plane_come_back():
    views, truth = plane_views(count=8, width=160, height=120)
    views = speckled(views, truth)
    wrong = wrong_depths(truth)
    refined = refine_by_photos(views, wrong, RefinementSettings(match_reach_px=8))
    known = truth > 0
    error = [np.median(np.abs(d - truth)[known] / truth[known]) for d in (wrong, refined.depths)]
    assert error[1] < 0.2 * error[0]
    assert refined.moved[known].mean() > 0.5 and not refined.depths[~known].any()
    assert refined.inconsistent[known].mean() < 0.05


def test_smooth_surfaces_are_left_alone():
    views, truth = plane_views(count=8, width=160, height=120)
    depths = truth.astype(np.float32)
    refined = refine_by_photos(views, depths, RefinementSettings(match_reach_px=8))
    assert refined.moved[truth > 0].mean() < 0.05 and refined.inconsistent[truth > 0].mean() < 1e-3
    assert np.quantile(np.abs(refined.depths - depths)[truth > 0] / truth[truth > 0], 0.9) < 1e-6


def test_depths_stay_where_nothing_can_be_matched():
    views, truth = plane_views(count=8, width=96, height=72)
    plain = replace(views, images=np.full_like(views.images, 120))
    wrong = wrong_depths(truth)
    refined = refine_by_photos(plain, wrong, RefinementSettings(match_reach_px=8))
    assert not (refined.moved | refined.inconsistent).any() and np.array_equal(refined.depths, wrong)


def worth_of_a_pixel(views, depths):
    """(V,) changes of the inverse depths of each photo that shift it by a pixel in the photo where it shifts most."""
    worth, change = [], 1e-4
    for index, depth in enumerate(depths):
        rows, columns = np.nonzero(depth > 0)
        inverse = 1 / depth[rows, columns].astype(np.float64)
        camera = views.intrinsics[index], views.object_from_cam[index]
        ends = [back_project(1 / q, *camera, rows, columns) for q in (inverse, inverse + change)]
        others = [views.view(other) for other in range(len(depths)) if other != index]
        shifts = [np.linalg.norm(view.project(ends[1])[0] - view.project(ends[0])[0], axis=1) for view in others]
        worth.append(change / np.median(shifts, axis=1).max())
    return np.array(worth)


def test_no_depth_moves_farther_than_its_reach():
    views, truth = plane_views(count=8, width=160, height=120)
    views, known = speckled(views, truth), truth > 0
    far = np.arange(8) % 2 == 1
    # Every second photo has depths that are wrong by four to six pixels, the others by less than one.
    wrong = (np.where(far, 1.06, 1.008)[:, None, None] * truth).astype(np.float32)
    worth = worth_of_a_pixel(views, wrong)
    for reach, repaired in ((1, ~far), (8, far | ~far)):
        refined = refine_by_photos(views, wrong, RefinementSettings(match_reach_px=reach))
        for k, found in enumerate(refined.depths):
            start, end, true = wrong[k][known[k]], found[known[k]], truth[k][known[k]]
            assert (np.abs(1 / end - 1 / start) < 1.1 * reach * worth[k]).all()
            assert (np.median(np.abs(end / true - 1)) < 0.003) == repaired[k]


def test_a_textured_surface_far_from_where_it_is_is_not_photo_consistent():
    views, truth = plane_views(count=8, width=160, height=120)
    views, far_off = speckled(views, truth), (1.3 * truth).astype(np.float32)
    refined = refine_by_photos(views, far_off, RefinementSettings(match_reach_px=1))
    assert refined.inconsistent[truth > 0].mean() > 0.9


def test_close_ups_are_matched_with_each_other_first():
    """Photos from four times as far show what they show too, and from as good angles, but too coarsely."""
    views, truth = plane_views(12, distances=(3.0, 3.0, 0.75))
    near = np.arange(12) % 3 == 2
    first = choose_sources(views, truth.astype(np.float32))[:, :2]
    assert near[first[near]].all()
