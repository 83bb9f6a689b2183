"""The most likely pose: its derivatives are those of the likelihood, it is right, and so is what it states."""

from dataclasses import replace

import numpy as np
import pytest
from support.planted import deviations, errors, plant

from scenefuse.core.transforms import Uncertainty
from scenefuse.geometry.icp import ScaleRange, moved_about
from scenefuse.geometry.surface import prepare, with_queries
from scenefuse.register import refinement
from scenefuse.register.decision import FineSettings
from scenefuse.register.likelihood import certified, explain, most_likely
from scenefuse.register.problem import Problem

SPACING = 0.01  # of the clouds, as a share of the object's diagonal
OFF = np.array([0.01, -0.01, 0.01, 0, 0, 0, 0.015])


def planted(noise=0.01, **given):
    """A gate, whose tubes are as thin as the noise is thick, and its surfaces."""
    trial = plant("gate", 5, coverage=0.35, ground=False, noise=noise, object_points=6000, density_ratio=1.0, **given)
    voxel = SPACING * trial.diagonal
    obj = prepare(trial.object, voxel / trial.scene_from_object.scale, 0, 12000)
    return trial, obj, with_queries(prepare(trial.scene, voxel, 0, 12000), 800)


@pytest.fixture(scope="module")
def gate():
    return planted()


def disturbed(trial):
    truth = trial.scene_from_object
    return moved_about(truth, OFF, truth.apply(trial.object.points.mean(0)), ScaleRange(truth.scale, 0.5))


def settled(gate, width=0.5):
    trial, obj, scene = gate
    scales = ScaleRange(disturbed(trial).scale, width)
    found = certified(obj, scene, disturbed(trial), scales, SPACING * trial.diagonal, trial.diagonal, seed=0)
    assert found is not None
    return found


@pytest.mark.slow
def test_a_thin_object_under_thick_noise_is_laid_right_and_states_how_certain_it_is(gate):
    trial = gate[0]
    pose, uncertainty = settled(gate)
    scale, angle, shift = errors(pose, trial.scene_from_object, trial.object.points.mean(0), trial.diagonal)
    assert abs(scale) < 1 and angle < 1 and shift < 0.005
    off = deviations(pose, trial.scene_from_object, trial.object.points.mean(0))
    assert (np.abs(off) < 4 * np.sqrt(np.diag(uncertainty.covariance))).all()
    assert uncertainty.scale_sd_log < 0.01


@pytest.mark.slow
def test_less_noise_is_more_certain(gate):
    diagonal, rough, fine = gate[0].diagonal, settled(gate)[1], settled(planted(noise=0.003))[1]
    assert fine.size(diagonal) < 0.7 * rough.size(diagonal)


def test_gradient_and_information_are_the_derivatives_of_the_likelihood(gate, monkeypatch):
    # With few neighbours, the likelihood jumps a little wherever the farthest of them is another.
    monkeypatch.setattr("scenefuse.register.likelihood.NEIGHBOURS", 300)
    trial, obj, scene = gate
    scene, spacing, scales = with_queries(scene, 200), SPACING * trial.diagonal, ScaleRange(1.0, 9.0)
    found = most_likely(obj, scene, disturbed(trial), ScaleRange(trial.scene_from_object.scale, 0.5), spacing, 7.0)

    def likelihood(change):
        pose = moved_about(found.pose, change, found.centre, scales)
        return explain(obj, scene, pose, found.noise, spacing).log_likelihood

    unit, middle = np.array([2e-4] * 3 + [1e-3] * 3 + [2e-4]), likelihood(np.zeros(7))
    for axis, step in zip(np.eye(7), unit):
        ahead, back = likelihood(step * axis), likelihood(-step * axis)
        curvature = axis @ found.information @ axis
        assert (ahead - back) / (2 * step) == pytest.approx(axis @ found.gradients.sum(0), abs=0.05 * curvature * step)
        assert -(ahead - 2 * middle + back) / step**2 == pytest.approx(curvature, rel=0.15)


def test_a_scale_of_no_width_is_held_and_certain(gate):
    pose, uncertainty = settled(gate, width=0.0)
    assert pose.scale == pytest.approx(disturbed(gate[0]).scale, rel=1e-12)
    assert uncertainty.scale_sd_log == pytest.approx(0, abs=1e-9)


@pytest.mark.slow
def test_two_runs_agree_bit_for_bit(gate):
    first, second = settled(gate), settled(gate)
    assert np.array_equal(first[0].matrix, second[0].matrix)
    assert np.array_equal(first[1].covariance, second[1].covariance)


def test_too_few_points_determine_nothing(gate):
    trial, obj, scene = gate
    scales, start = ScaleRange(trial.scene_from_object.scale, 0.5), disturbed(trial)
    few = with_queries(scene, 60)
    assert certified(obj, few, start, scales, SPACING * trial.diagonal, trial.diagonal, seed=0) is None


@pytest.mark.slow
def test_the_most_likely_pose_is_taken_and_without_one_the_object_is_refused(gate, monkeypatch):
    trial, truth = gate[0], gate[0].scene_from_object
    problem = Problem(trial.object, trial.scene, ScaleRange(truth.scale, 0.3))
    settings = replace(FineSettings(), turn_steps=3, voxel_fraction=0.02)

    def outcome(found):
        monkeypatch.setattr(refinement, "certified", lambda *_: found)
        return refinement.refine_hypotheses(problem, [(truth, "planted")], settings)

    sure = outcome((truth, Uncertainty.even(1e-6, 1e-6, 1e-6)))
    assert sure.ranked[0].pose is truth and sure.uncertainty.scale_sd_log == 1e-6
    without = outcome(None)
    assert without.uncertainty is None and not without.decision.registered
