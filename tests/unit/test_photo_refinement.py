"""Depths moved by matching: a known plane with wrong depths comes back; without texture they stay as they were."""

from dataclasses import replace

import cv2
import numpy as np
from test_depth import plane_views

from scenefuse.mvs.consistency import back_project
from scenefuse.mvs.photo_refinement import RefinementSettings, refine_by_photos


def _wrong(truth, share=0.05):
    """True depths with a smooth error of up to a share of them."""
    waves = np.sin(np.arange(truth.shape[2]) / 15)[None, None] * np.cos(np.arange(truth.shape[1]) / 12)[None, :, None]
    return (truth * (1 + share * waves)).astype(np.float32)


def _speckled(views, truth):
    """The same views of the plane, painted with fine speckles."""
    speckles = cv2.GaussianBlur(np.random.default_rng(0).random((400, 400)).astype(np.float32), (0, 0), 2.0)
    speckles = (speckles - speckles.min()) / np.ptp(speckles) * 255
    images = []
    for depth, k, pose in zip(truth, views.intrinsics, views.object_from_cam):
        rows, columns = np.indices(depth.shape).reshape(2, -1)
        points = back_project(depth.ravel().astype(np.float64), k, pose, rows, columns).reshape(*depth.shape, 3)
        place = ((points[..., :2] + 1) * 199.5).astype(np.float32)
        images.append(cv2.remap(speckles, place[..., 0], place[..., 1], cv2.INTER_LINEAR).astype(np.uint8))
    return replace(views, images=np.repeat(np.stack(images)[..., None], 3, axis=3))


def test_wrong_depths_of_a_textured_plane_come_back():
    views, truth = plane_views(count=8, width=160, height=120)
    views = _speckled(views, truth)
    wrong = _wrong(truth)
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
    wrong = _wrong(truth)
    refined = refine_by_photos(plain, plain.object_from_cam, wrong, RefinementSettings(match_reach_px=8))
    assert not (refined.moved | refined.inconsistent).any() and np.array_equal(refined.depths, wrong)


def test_no_depth_moves_farther_than_its_reach():
    views, truth = plane_views(count=8, width=160, height=120)
    views = _speckled(views, truth)
    far_off = np.where(truth > 0, 1.3 * truth, 0).astype(np.float32)
    refined = refine_by_photos(views, views.object_from_cam, far_off, RefinementSettings(match_reach_px=1))
    moved = np.abs(1 / refined.depths[truth > 0] - 1 / far_off[truth > 0])
    baseline = np.linalg.norm(np.diff(views.object_from_cam[:, :3, 3], axis=0), axis=1).min()
    assert moved.max() < 4.0 / (views.intrinsics[0, 0, 0] * baseline)


def test_a_textured_surface_far_from_where_it_is_is_not_photo_consistent():
    views, truth = plane_views(count=8, width=160, height=120)
    views = _speckled(views, truth)
    far_off = np.where(truth > 0, 1.3 * truth, 0).astype(np.float32)
    refined = refine_by_photos(views, views.object_from_cam, far_off, RefinementSettings(match_reach_px=1))
    assert refined.inconsistent[truth > 0].mean() > 0.9
