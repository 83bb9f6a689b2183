"""Planted trials of shared photos: right without bending, and bent where the true cameras are not those assumed."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.joint_adjustment import joined
from support.photo_trials import drawn
from support.photographed_place import HALF_ANGLE_DEG, HALF_SCALE_LOG
from support.planted import errors
from support.planted_photos import Plan, mapped, plant_photos, truth

from scenefuse.core.stage import value
from scenefuse.core.transforms import Sim3
from scenefuse.georef.align_models import AlignmentSettings, align_landmarks

SEED = 2
TINY = Plan(kind="row", scene_photos=16, object_photos=14, alike=80, bend=0.0, noise_px=(0.1, 0.1), points=(1800, 1500))


def mapped_trial(plan):
    trial = plant_photos(SEED, plan)
    for side in (trial.obj, trial.scene):
        mapped(side)
    return trial


@pytest.fixture(scope="module")
def straight():
    return mapped_trial(TINY)


@pytest.mark.slow
def test_a_trial_without_bending_is_solved_right(straight):
    object_from_world = Sim3(3.0, np.eye(3)[[1, 2, 0]], np.array([4.0, 5, 6]))
    straight.obj.move(object_from_world @ straight.obj.world_from_model())
    straight.scene.move(straight.scene.world_from_model())
    settings, known = AlignmentSettings(), truth(straight)
    content = align_landmarks(straight.obj.landmarks(), straight.scene.landmarks(), settings, seed=0)
    assert value(content, "found") is True
    pose = Sim3.from_matrix(np.array(value(content, "scene_from_object")))
    for true in (known.scene_from_object, known.here, object_from_world.inverse()):
        scale_pct, angle, shift = errors(pose, true, known.centre, straight.diagonal)
        assert abs(scale_pct) < 0.5 and angle < 0.5 and shift < 0.01


def test_other_lenses_bend_the_models_and_the_same_lenses_do_not(straight):
    def off(trial):
        rows, points, _ = trial.scene.points()
        x = trial.scene.world_from_model().apply(points)
        return np.median(np.linalg.norm(x - trial.features.x[rows], axis=1)) / trial.diagonal

    assert off(mapped_trial(replace(TINY, bend=1.0))) > 2 * off(straight)


def test_features_are_shown_from_about_one_direction_and_distance(straight):
    f, capture = straight.features, straight.obj.capture
    for photo, rows in zip(capture.photos, capture.shown):
        to_eye = photo.centre - f.x[rows]
        distance = np.linalg.norm(to_eye, axis=1)
        assert ((to_eye * f.towards[rows]).sum(1) >= np.cos(np.radians(HALF_ANGLE_DEG)) * distance).all()
        ratio = distance / capture.camera.mean_focal_length() / f.size[rows]
        assert (np.abs(np.log(ratio)) <= HALF_SCALE_LOG).all()


def test_a_twin_looks_like_the_object():
    f = plant_photos(SEED, replace(TINY, twin=True)).features
    looks = [set(f.look[f.owner == owner]) for owner in ("object", "twin")]
    assert looks[0] and looks[0] == looks[1]


def test_the_same_seed_gives_the_same_trial():
    a, b = (plant_photos(SEED, TINY) for _ in range(2))
    np.testing.assert_array_equal(a.obj.looks, b.obj.looks)
    np.testing.assert_array_equal(a.scene.points()[1], b.scene.points()[1])
    assert drawn(SEED) == drawn(SEED)


def test_close_ups_may_find_features_a_little_elsewhere(straight):
    apart = plant_photos(SEED, replace(TINY, apart_px=1.0))
    for side, off in (("obj", True), ("scene", False)):
        before, after = (getattr(trial, side).capture for trial in (straight, apart))
        moved = np.concatenate(after.pixels) - np.concatenate(before.pixels)
        assert (0.1 < np.median(np.linalg.norm(moved, axis=1)) < 10) if off else (moved == 0).all()


def test_a_joint_model_has_all_observations_and_shared_points_once(straight):
    sides = straight.obj.model, straight.scene.model
    ids = sorted(set(sides[0].points3D) & set(sides[1].points3D))
    pose = straight.scene.world_from_model().inverse() @ straight.obj.world_from_model()
    joint = joined(*sides, pose, np.stack([ids, ids], axis=1))
    assert len(ids) > 20
    assert joint.model.num_points3D() == sum(side.num_points3D() for side in sides) - len(ids)
    assert joint.model.compute_num_observations() == sum(side.compute_num_observations() for side in sides)
    there = np.array([joint.model.points3D[i].xyz for i in joint.object_ids.tolist()])
    off = np.linalg.norm(there - pose.apply(straight.obj.points()[1]), axis=1)
    assert np.median(off) < 0.01 * straight.diagonal
