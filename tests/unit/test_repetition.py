"""An object that repeats itself, as stairs and colonnades do, is refused where the scene does not tell by how many
steps it is shifted."""

from dataclasses import replace

import numpy as np
import pytest
from support.planted import errors, sampled

from demo.objects import box, sheet
from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import Sim3, Uncertainty
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.surface import prepare
from scenefuse.register.decision import FineSettings
from scenefuse.register.problem import Alignment, Constraints, Problem
from scenefuse.register.refinement import refine_hypotheses
from scenefuse.register.repetition import shifts_onto_itself

STEP, BAY = np.array([0.3, 0.0, 0.17]), np.array([2.0, 0.0, 0.0])
NOTHING, NARROW = Constraints(), ScaleRange(1.0, 0.1)
# Coarser than by default, for speed.
FINE = replace(FineSettings(), voxel_fraction=0.016, turn_steps=2)


def stairs(seed):
    """Twenty steps, 2 m wide; a newel post at their foot."""
    parts = [box((-0.15, -0.15, 0), (0, 0, 1.1), 0)]
    for k in range(20):
        x, z = k * STEP[0], k * STEP[2]
        parts += [sheet((x, 0, z), (x + 0.3, 0, z), (x + 0.3, 2, z), (x, 2, z), 0)]
        parts += [sheet((x, 0, z - 0.17), (x, 2, z - 0.17), (x, 2, z), (x, 0, z), 0)]
    return sampled(parts, 10000, seed, 0.004).points


def row(bays, seed):
    """Piers on a plinth, an architrave above them; a block at one end."""
    length = 2.0 * bays
    parts = [box((0, 0, -0.3), (length, 1.4, 0), 0), box((0, 0.2, 3), (length, 1.2, 3.6), 0)]
    parts += [box((2 * k + 0.7, 0.4, 0), (2 * k + 1.3, 1.0, 3), 0) for k in range(bays)]
    return sampled([*parts, box((-0.4, 0, -0.3), (0, 1.4, 4.2), 0)], 600 * bays, seed, 0.004).points


def between(points, low, high):
    return points[(points[:, 0] > low) & (points[:, 0] < high)]


def registered(obj, scene, off, evidence=NOTHING, colors=None):
    """Registered from a pose that is `off` (3,)."""
    of_object, of_scene = (None, None) if colors is None else (colors(obj), colors(scene))
    problem = Problem(Cloud(obj, colors=of_object), Cloud(scene, colors=of_scene), NARROW, evidence)
    return refine_hypotheses(problem, [(Sim3(1.0, np.eye(3), np.asarray(off)), "planted")], FINE)


def is_true(outcome, obj):
    scale, angle, shift = errors(outcome.ranked[0].pose, Sim3.identity(), obj.mean(0), 10.0)
    return abs(scale) < 1 and angle < 1 and shift < 0.005


@pytest.mark.parametrize(("points", "period"), [(stairs(0), STEP), (row(10, 0), BAY)])
def test_the_shift_by_which_an_object_repeats_itself_is_found(points, period):
    spacing = 0.007 * float(np.linalg.norm(np.ptp(points, axis=0)))
    (shift,) = shifts_onto_itself(prepare(Cloud(points), spacing, 0, 12000), spacing)
    assert np.linalg.norm(np.abs(shift) - period) < 0.03


def test_a_wall_that_slides_along_itself_and_a_box_do_not_repeat():
    wall = [box((0, 0, 0), (8, 0.2, 3), 0)]
    hut = [box((0, 0, 0), (5, 3, 3), 0), box((1, -0.2, 1), (2, 0, 2), 0), box((3, -0.2, 1), (4, 0, 2), 0)]
    for parts in (wall, hut):
        assert shifts_onto_itself(prepare(sampled(parts, 20000, 0, 0.004), 0.06, 0, 12000), 0.06) == []


@pytest.mark.slow
def test_stairs_one_step_off_are_refused_where_the_scene_shows_some_of_their_steps():
    outcome = registered(stairs(0), between(stairs(1), 1.5, 4.8), STEP)
    decision = outcome.decision
    assert not decision.registered and decision.margin < FINE.min_margin
    assert decision.reason.startswith("the object repeats itself every 0.3")
    assert decision.rival.source == "shifted" or outcome.ranked[0].source == "shifted"


@pytest.mark.slow
def test_a_row_shifted_by_one_of_many_bays_is_a_rival_and_no_turn_onto_itself():
    outcome = registered(row(24, 0), between(row(24, 1), 11, 37), 4 * BAY)
    assert not outcome.decision.registered and outcome.decision.margin < 0.1
    assert outcome.decision.free_axis is None


@pytest.mark.slow
def test_two_parts_of_a_row_that_overlap_little_are_not_laid_on_each_other():
    obj, scene = between(row(12, 0), 8.5, 23.3), between(row(12, 1), 1, 14.8)
    outcome = registered(obj, scene, -4 * BAY)
    assert not is_true(outcome, obj) and not outcome.decision.registered
    assert "repeats itself every 2" in outcome.decision.reason


@pytest.mark.slow
def test_a_row_is_registered_where_the_scene_ends_where_it_does():
    obj = row(8, 0)
    outcome = registered(obj, row(8, 1), (0.05, 0.0, 0.0))
    assert outcome.decision.registered, outcome.decision.reason
    assert is_true(outcome, obj)


@pytest.mark.slow
def test_colours_tell_by_how_many_bays_a_row_is_shifted():
    def painted(points):
        paint = np.random.default_rng(0).integers(30, 220, (20, 3))
        return paint[np.clip(points[:, 0] / 2, 0, 19).astype(int)].astype(np.uint8)

    obj = row(10, 0)
    outcome = registered(obj, between(row(10, 1), 3.5, 14.5), (0.05, 0.0, 0.0), colors=painted)
    assert outcome.decision.registered, outcome.decision.reason
    assert is_true(outcome, obj)


@pytest.mark.slow
def test_photos_tell_by_how_many_bays_a_row_is_shifted():
    obj, scene = between(row(12, 0), 8.5, 23.3), between(row(12, 1), 1, 14.8)
    alignment = Alignment(Sim3.identity(), Uncertainty.even(0.002, 0.1, 0.01))
    outcome = registered(obj, scene, -4 * BAY, Constraints(alignment=alignment))
    assert outcome.decision.registered, outcome.decision.reason
    assert is_true(outcome, obj)
