"""An object in a landscape much wider than itself: where it may stand, and which of several places is taken."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planted import plant, plant_wide

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import UP, Sim3
from scenefuse.crop.crop_cloud import CropSettings
from scenefuse.geometry.icp import ScaleRange
from scenefuse.register.coarse import CoarseSettings
from scenefuse.register.decision import Decision, FineSettings
from scenefuse.register.problem import Problem
from scenefuse.register.refinement import Outcome
from scenefuse.register.score import Hypothesis, Score
from scenefuse.two_clouds import find as register
from scenefuse.two_clouds.find import Registration, RegistrationSettings, Search, find_in_scene, total_at_scale
from scenefuse.two_clouds.places import likely_places

LITTLE = RegistrationSettings(
    coarse=CoarseSettings(ransac_samples=5000, feature_scale_steps=1, scale_steps=5, candidates=6, keep=2),
    fine=FineSettings(voxel_fraction=0.02, turn_steps=6),
)


@pytest.fixture(scope="module")
def yard():
    """A house in a landscape ten times as wide, on a slope."""
    return plant_wide("house", 3, 10, object_points=6000, density_ratio=0.5, slope=0.05, ground_points=40_000)


def place_of(trial):
    return trial.scene_from_object.apply(trial.object.points).mean(0)


@pytest.mark.slow
def test_one_of_the_likely_places_is_the_object_without_its_ground(yard):
    def off(rows):
        return np.linalg.norm(np.median(yard.scene.points[rows], axis=0) - place_of(yard))

    nearest = min(likely_places(yard.object, yard.scene, UP, CropSettings(), 0, 6), key=off)
    assert off(nearest) < 0.2 * yard.diagonal
    assert np.linalg.norm(np.ptp(yard.scene.points[nearest], axis=0)) < 1.3 * yard.diagonal


@pytest.mark.slow
def test_a_house_is_found_in_a_landscape_ten_times_as_wide(yard):
    found, part, places = find_in_scene(yard.object, yard.scene, LITTLE, 0, up_in_scene=UP)
    assert found.registered, found.reason
    assert np.linalg.norm(found.scene_from_object.apply(yard.object.points).mean(0) - place_of(yard)) < (
        0.02 * yard.diagonal
    )
    assert abs(found.scene_from_object.scale / yard.scene_from_object.scale - 1) < 0.02
    assert len(part) < 0.2 * len(yard.scene) and 1 <= len(places) <= 2


def tried(total, at, registered=True, precision=0.7):
    """A registration of a certain score at a place."""
    score = Score(total, precision, 0.8, None, None, total)
    best = Hypothesis(Sim3(1.0, np.eye(3), np.array(at, float)), "features", score)
    decision = Decision(registered, "its own reason", "geometry", 0.5, None, None)
    origins = np.zeros(3), np.zeros(3)
    return Registration(Outcome([best], decision, None), origins, ScaleRange(1.0, 0.5), {})


def chosen(monkeypatch, yard, *there):
    """What is chosen of registrations in the whole scene and at places."""
    there = iter(there)
    monkeypatch.setattr(register, "search", lambda *known: next(there))
    monkeypatch.setattr(register, "refined", lambda found, *known: found)
    monkeypatch.setattr(register, "with_agreement", lambda found, *known: found)
    monkeypatch.setattr(register, "total_at_scale", lambda there, found, scale: found.total)
    monkeypatch.setattr(register, "likely_places", lambda *known: [np.arange(300), np.arange(300, 600)])
    return find_in_scene(yard.object, yard.scene, LITTLE, 0)


def test_the_best_place_that_passes_the_gate_is_taken(monkeypatch, yard):
    far = [3 * yard.object.diagonal, 0, 0]
    found, _, _ = chosen(monkeypatch, yard, tried(0.1, far, False), tried(0.8, [0, 0, 0]), tried(0.4, far))
    assert found.registered and found.total == 0.8
    # The margin is the lead over the next place where that is less than over other poses.
    assert found.outcome.decision.margin == 0.5
    found, _, _ = chosen(monkeypatch, yard, tried(0.1, far, False), tried(0.8, [0, 0, 0]), tried(0.6, far))
    assert found.outcome.decision.margin == pytest.approx(0.25)


def test_at_a_known_scale_parts_that_are_far_smaller_than_the_object_are_not_searched(monkeypatch, yard):
    searched = []
    monkeypatch.setattr(register, "search", lambda obj, scene, *known: searched.append(scene) or tried(0.1, [0, 0, 0]))
    monkeypatch.setattr(register, "refined", lambda found, *known: found)
    monkeypatch.setattr(register, "with_agreement", lambda found, *known: found)
    monkeypatch.setattr(register, "likely_places", lambda *known: [np.arange(300)])
    size = yard.scene[np.arange(300)].diagonal / yard.object.diagonal
    for scale, count in ((9 * size, 2), (11 * size, 1)):
        searched.clear()
        find_in_scene(yard.object, yard.scene, LITTLE, 0, scales=ScaleRange(scale, 0.0))
        assert len(searched) == count


def test_an_object_that_fits_two_places_is_refused(monkeypatch, yard):
    far = [3 * yard.object.diagonal, 0, 0]
    for passes in (True, False):
        found, _, _ = chosen(monkeypatch, yard, tried(0.1, far, False), tried(0.8, [0, 0, 0]), tried(0.79, far, passes))
        assert not found.registered and "another place is nearly as good, at (" in found.reason
    # The same place twice, by the whole scene and by a part of it, is one.
    near = [0.03 * yard.object.diagonal, 0, 0]
    assert chosen(monkeypatch, yard, tried(0.1, far, False), tried(0.8, [0, 0, 0]), tried(0.79, near))[0].registered


def test_places_are_compared_by_the_object_s_size_not_by_boxes_that_grow_where_they_are_turned():
    trial, totals, boxes = plant("house", 3, ground=False, object_points=6000), [], []
    for turn in (0.0, 0.7):
        placed = Sim3(1.0, Rotation.from_euler("z", turn).as_matrix(), np.zeros(3))
        pose, scene = placed @ trial.scene_from_object, trial.scene.transformed(placed)
        problem = Problem(trial.object, scene, ScaleRange(pose.scale, 0.0))
        there = Search(problem, (np.zeros(3), np.zeros(3)), [])
        one = Hypothesis(pose, "planted", Score(1.0, 1.0, 1.0, None, None, 1.0))
        found = Registration(Outcome([one], None, None), there.origins, problem.scales, {})
        totals.append(total_at_scale(there, found, pose.scale))
        boxes.append(scene.diagonal)
    assert boxes[1] > 1.1 * boxes[0] and abs(totals[1] - totals[0]) < 0.01 and totals[0] > 0.6


def test_where_normals_face_inwards_on_one_side_it_is_searched_again_without_those_of_either(monkeypatch, yard):
    monkeypatch.setattr(
        register, "search", lambda *two: tried(0.8, [0, 0, 0], two[0].normals is None and two[1].normals is None)
    )
    monkeypatch.setattr(register, "refined", lambda found, *known: found)
    monkeypatch.setattr(register, "with_agreement", lambda found, *known: found)
    right, wrong = (replace(yard.object, normals=side * yard.object.normals) for side in (1, -1))
    for obj, scene, found in ((wrong, right, True), (right, wrong, True), (right, right, False)):
        registration, part, _ = find_in_scene(obj, scene, LITTLE, 0, marked=True)
        assert registration.registered == registration.sides_estimated == found
        assert part.normals is not None  # which are those of the scene's file


def test_an_object_that_fits_nowhere_may_not_be_there(monkeypatch, yard):
    found, _, _ = chosen(
        monkeypatch,
        yard,
        tried(0.1, [0, 0, 0], False),
        tried(0.3, [9, 0, 0], False, 0.12),
        tried(0.2, [0, 9, 0], False),
    )
    assert not found.registered
    assert found.reason.startswith("the best place shows 12% of the object, which may not be in this scene: its own")


def test_places_are_ranked_by_their_scores_each_with_its_box(monkeypatch, yard):
    tries = tried(0.15, [0, 0, 0], False), tried(0.2, [0, 0, 0], False), tried(0.3, [9, 0, 0], False)
    places = chosen(monkeypatch, yard, *tries)[2]
    assert [score for score, _ in places] == [0.3, 0.2]
    points = yard.scene.points[300:600]
    assert np.array_equal(places[0][1], [points.min(0), points.max(0)])


@pytest.mark.slow
def test_a_plane_has_two_sides(yard):
    flat = Cloud(np.random.default_rng(0).uniform(0, 5, (3000, 3)) * [1, 1, 0])
    with np.errstate(all="raise"):
        likely_places(flat, yard.scene, UP, CropSettings(), 0, 1)


def test_a_scene_without_a_raised_part_has_no_place(yard):
    rng = np.random.default_rng(0)
    flat = np.c_[rng.uniform(0, 50, (20_000, 2)), rng.normal(0, 0.01, 20_000)]
    scene = replace(yard.scene[np.arange(20_000)], points=flat)
    assert likely_places(yard.object, scene, None, CropSettings(), 0, 6) == []
