import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from scenefuse.sfm.gravity import UNSURE_CUES, estimate_up, roll_spread_deg

UP = np.array([0.0, 0.0, 1.0])


def camera(heading_deg, pitch_deg, roll_deg=0.0):
    """world_from_cam of a camera looking along `heading`, `pitch` above the horizon, then rolled about its own axis."""
    heading, pitch = np.radians([heading_deg, pitch_deg])
    z = np.array([np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)])
    x = np.array([np.sin(heading), -np.cos(heading), 0.0])
    level = np.stack([x, np.cross(z, x), z], axis=1)
    return level @ Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()


def noisy(rotations, sigma_deg, seed=0):
    noise = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, np.radians(sigma_deg), (len(rotations), 3)))
    return noise.as_matrix() @ np.array(rotations)


def grid(columns, rows, step=10.0, height=50.0):
    x, y = np.meshgrid(np.arange(columns) * step, np.arange(rows) * step)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)


def orbit(pitch_deg, span_deg, count=30):
    angles = np.linspace(0, span_deg, count)
    centres = np.stack([-np.cos(np.radians(angles)), -np.sin(np.radians(angles)), 0 * angles], axis=1) * 5.0
    return [camera(a, pitch_deg) for a in angles], centres


def walk(count=15):
    return [camera(90.0, 0.0)] * count, np.stack([np.arange(count) * 2.0, np.zeros(count), np.zeros(count)], axis=1)


def nadir(headings):
    centres = grid(6, 5)
    strips = [headings[i // 6 % len(headings)] for i in range(len(centres))]
    return [camera(h, -90.0) for h in strips], centres


CASES = {
    "orbit looking down": orbit(-30, 360),
    "orbit looking up": orbit(35, 360),
    "partial orbit": orbit(-10, 60),
    "nadir, one heading": nadir([0.0]),
    "nadir, strips there and back": nadir([0.0, 180.0]),
    "nadir, crossed strips": nadir([0.0, 90.0]),
    "level walk along a wall": walk(),
    "nadir with obliques": (
        [camera(0, -90)] * 30 + [camera(a, -45) for a in range(0, 360, 45)],
        np.concatenate([grid(6, 5), grid(8, 1)]),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_up_is_found_in_any_frame(name):
    rotations, centres = CASES[name]
    rotations = noisy(rotations, 1.0)
    world = Rotation.from_euler("xyz", [40, -110, 65], degrees=True).as_matrix()
    up, _ = estimate_up(world @ rotations, centres @ world.T)
    assert np.degrees(np.arccos(np.clip(up @ world @ UP, -1, 1))) < 3.0


def test_heights_by_gps_tell_photos_of_a_facade_from_a_flight_in_strips():
    rng, turn = np.random.default_rng(0), Rotation.from_euler("xyz", [40, -110, 65], degrees=True).as_matrix()
    strips = grid(8, 6, 4.0)
    rows = strips[:, [0, 2, 1]]
    for centres, pitch, cue in ((rows, 0.0, "image up"), (strips, -90.0, "viewing direction")):
        rotations = turn @ noisy([camera(90.0, pitch)] * 48, 1.0)
        positions = centres + rng.normal(0, [1.5, 1.5, 3.0], (48, 3))
        positions[::5, 2] = np.nan
        positions[1::9, 2] += 200.0
        up, found = estimate_up(rotations, 0.1 * centres @ turn.T, positions)
        assert found == cue and np.degrees(np.arccos(up @ turn @ UP)) < 3.0
        same = np.full((48, 3), [1.0, 2.0, 3.0])
        for unknown in (positions * np.nan, same):
            assert estimate_up(rotations, centres @ turn.T, unknown)[1] == "viewing direction"


def test_a_few_photos_on_their_side_do_no_harm():
    rotations, centres = orbit(-20, 360, 30)
    for index in range(0, 30, 6):
        rotations[index] = rotations[index] @ Rotation.from_euler("z", 90, degrees=True).as_matrix()
    up, cue = estimate_up(np.array(rotations), centres)
    assert cue == "headings"
    assert np.degrees(np.arccos(up @ UP)) < 1.0
    assert roll_spread_deg(np.array(rotations), up) < 1.0


def test_roll_spread_is_the_median_tilt():
    rotations = np.array([camera(a, 0.0, 10.0) for a in range(0, 360, 30)])
    assert roll_spread_deg(rotations, UP) == pytest.approx(10.0)


def test_a_short_walk_that_looks_up_does_not_say_surely_which_way_is_up():
    def front(half_walk, count=10, seed=0):
        x = np.linspace(-half_walk, half_walk, count)
        headings = 90.0 - np.degrees(np.arctan2(-x, 12.0))
        rolls = np.random.default_rng(seed).normal(0, 2.0, count)
        centres = np.stack([x, np.full(count, -12.0), np.zeros(count)], axis=1)
        return np.array([camera(h, 26.0, roll) for h, roll in zip(headings, rolls)]), centres

    assert estimate_up(*front(2.0))[1] in UNSURE_CUES
    assert estimate_up(*front(3.0))[1] in UNSURE_CUES
    for seed in range(20):
        up, cue = estimate_up(*front(12.0, 30, seed))
        assert cue == "headings" and np.degrees(np.arccos(up @ UP)) < 3.0


def test_photos_that_lean_the_same_way_one_after_the_other_do_not_say_surely_which_way_is_up():
    def leaning(swings):
        headings = np.linspace(0, 250, 28)
        rolls = 9.0 * np.sin(2 * np.pi * swings * np.arange(28) / 28)
        return np.array([camera(h, -30.0, roll) for h, roll in zip(headings, rolls)]), np.zeros((28, 3))

    assert estimate_up(*leaning(13))[1] == "headings"
    assert estimate_up(*leaning(2))[1] in UNSURE_CUES
