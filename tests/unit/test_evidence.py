"""Evidence on a painted plane: the photos of both sides decide what is added, kept and taken away."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.photographed_plane import BLANK, photographs

from scenefuse.cloud.clouds import Cloud, concatenate
from scenefuse.core.stage import value
from scenefuse.core.transforms import Sim3, look_at
from scenefuse.fuse import compare, measure, modes
from scenefuse.fuse.compare import Reason, better_measured
from scenefuse.fuse.fuse_object import evidence_report
from scenefuse.fuse.measure import FIELDS, Evidence, Measured, deviations_of_pose
from scenefuse.fuse.modes import FusionSettings, check, fuse_by_evidence
from scenefuse.fuse.settle import half_sampling, settle
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.photo_check import Matches, moved_photos, pack
from scenefuse.geometry.surface import prepare

NOBODY = pack([])


def sheet(low, high, step, noise=0.0, z=0.0, half=0.6):
    """Points of the plane, x from low to high, y from -half to half, with noise along z."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(low, high, step), np.arange(-half, half, step))
    points = np.stack([x.ravel(), y.ravel(), z + noise * rng.normal(size=x.size)], axis=1)
    colors = np.full((len(points), 3), 120, np.uint8)
    return Cloud(points, np.tile(np.array([0, 0, 1], np.float32), (len(points), 1)), colors)


@pytest.fixture(scope="module")
def near():
    """The close-ups."""
    return pack(photographs(8, 3.0))


@pytest.fixture(scope="module")
def far():
    """The scene's photos, from twice as far."""
    return pack(photographs(8, 6.0, radius=4.0))


@pytest.mark.slow
def test_the_sharper_side_stays_where_both_measured(near, far):
    obj, scene = sheet(-0.8, 0.4, 0.03), sheet(-0.4, 0.8, 0.06, noise=0.005)
    found = check(obj, scene, near, far, unconfirmed="none")
    assert found.added.mean() > 0.97
    inside, outside = scene.points[:, 0] < 0.3, scene.points[:, 0] > 0.5
    assert (found.reason[inside] == Reason.REPLACED).mean() > 0.95 and (found.reason[outside] == Reason.KEPT).all()
    assert (found.scene.fields["evidence"][outside] == Evidence.MEASURED).mean() > 0.9
    # The other way round the scene is the sharper one, and nothing comes in where it is.
    farther = pack(photographs(8, 9.0, radius=6.0))
    found = check(scene, obj, farther, near, unconfirmed="none")
    assert found.added[scene.points[:, 0] < 0.3].mean() < 0.05 and found.added[scene.points[:, 0] > 0.5].mean() > 0.9
    assert (found.reason == Reason.KEPT).all()


@pytest.mark.parametrize("bare", ["object", "scene"])
def test_a_cloud_without_normals_is_measured_as_one_with_them(near, far, bare):
    # Turned, so that no side of a plane comes out by chance.
    turn = Sim3(1.0, Rotation.random(random_state=0).as_matrix(), np.zeros(3))
    obj, scene = (sheet(*ends, 0.06).transformed(turn) for ends in ((-0.8, 0.4), (-0.4, 0.8)))
    obj, scene = (replace(c, normals=None) if bare == name else c for name, c in (("object", obj), ("scene", scene)))
    found = check(obj, scene, moved_photos(near, turn), moved_photos(far, turn), unconfirmed="none")
    assert (found.obj.fields["evidence"] == Evidence.MEASURED).mean() > 0.95 and found.added.mean() > 0.95
    assert (found.scene.fields["evidence"] == Evidence.MEASURED).mean() > 0.95


def test_neighbours_of_a_large_cloud_are_looked_at_a_part_at_a_time(monkeypatch):
    monkeypatch.setattr(measure, "AT_ONCE", 1 << 16)
    points = sheet(-0.6, 0.6, 0.005).points
    half = points[:, 0] < 0
    tracemalloc.start()
    found = measure.supported(points, half, 2.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200 * len(points)
    assert found[points[:, 0] < -0.03].all() and not found[~half].any()


@pytest.mark.slow
def test_a_roof_without_normals_is_measured_though_cameras_below_it_are_nearer():
    above, roof, low = photographs(8, 3.0), sheet(-0.6, 0.6, 0.04).points, []
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-0.6, 0.6, 0.04), np.arange(-0.6, 0, 0.04)))
    for turn in Rotation.from_euler("z", np.arange(0, 360, 45)[:, None], degrees=True):
        pose = np.eye(4)
        pose[:3, :3] = look_at(turn.apply([1.5, 0, -0.3]), [0, 0, -0.3], [0, 0, 1])
        pose[:3, 3] = -pose[:3, :3] @ turn.apply([1.5, 0, -0.3])
        low.append(replace(above[0], name=f"{len(low)} low", cam_from_world=pose, pixels=0 * above[0].pixels))
    quarter = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    walls = [np.column_stack([0 * y + 0.6, y, z]) @ np.linalg.matrix_power(quarter, k) for k in range(4)]
    bare = Cloud(np.concatenate([roof, *walls]))
    found = measure.measure(bare, pack([*above, *low]), bare.diagonal)
    assert found.surface[: len(roof)].mean() > 0.9


def test_a_rough_object_does_not_take_the_place_of_a_smooth_scene(near, far):
    rough, smooth = sheet(-0.4, 0.4, 0.015, noise=0.012), sheet(-0.4, 0.4, 0.02)
    of_rough, of_smooth = (np.abs(cloud.points[:, 0]) < 0.3 for cloud in (rough, smooth))
    found = check(rough, smooth, near, far, unconfirmed="none")
    assert (found.reason[of_smooth] == Reason.KEPT).mean() > 0.95 and found.added[of_rough].mean() < 0.02
    # A rough scene gives way to a smooth object.
    found = check(smooth, rough, near, far, unconfirmed="none")
    assert (found.reason[of_rough] != Reason.KEPT).mean() > 0.95 and found.added.mean() > 0.95


def test_ground_beside_an_object_stays_where_photos_confirm_it(near, far):
    # The scene's points are six times as far apart as the object's, whose rim they touch.
    obj, scene = sheet(-0.8, 0.0, 0.02), sheet(-0.8, 0.8, 0.12)
    found = check(obj, scene, near, far, unconfirmed="none")
    beside = (scene.points[:, 0] > 0.03) & (scene.points[:, 0] < 0.17) & (np.abs(scene.points[:, 1]) < 0.9)
    assert beside.any() and (found.reason[beside] == Reason.KEPT).all()


def test_what_photos_see_through_goes_from_the_scene_and_does_not_come_with_the_object(near, far):
    floating = sheet(-0.2, 0.2, 0.06, z=0.3)
    scene = concatenate([sheet(-0.8, 0.8, 0.06), floating])
    above = scene.points[:, 2] > 0.1
    obj = concatenate([sheet(-0.8, 0.8, 0.03), floating])
    found = check(obj, scene, near, far, unconfirmed="all")
    middle = np.abs(scene.points[:, 1]) < 0.6
    assert (found.reason[above & middle] == Reason.SEEN_THROUGH).all()
    last = np.arange(len(obj)) >= len(obj) - len(floating)
    last &= np.abs(obj.points[:, 1]) < 0.6
    assert not found.added[last].any() and found.contradicted[last].all()


def test_photos_see_through_an_object_to_a_scene_whose_points_are_far_sparser(near):
    floating = sheet(0.2, 0.5, 0.02, z=0.3, half=0.2)
    obj, scene = concatenate([sheet(-0.8, 0.0, 0.02), floating]), sheet(-0.8, 0.8, 0.12)
    last = np.arange(len(obj)) >= len(obj) - len(floating)
    sides = known(obj, 0.002, ~last), known(scene, 0.002)
    _, contradicted, _ = compare.compare(*sides, np.zeros(len(scene), bool), near.views)
    assert contradicted[last].all() and not contradicted[~last].any()


@pytest.mark.slow
def test_what_close_ups_show_and_do_not_confirm_beside_the_object_goes_though_the_flight_confirms_it(near):
    flight = pack(photographs(8, 9.0, radius=6.0))
    obj, floating = sheet(-1.0, 0.0, 0.01, half=1), sheet(0.01, 0.02, 0.01, z=0.037, half=1)
    floating = floating[np.abs(floating.points[:, 1]) < 0.5]
    scene = concatenate([sheet(-0.2, 0.4, 0.01, half=1), floating])
    found = check(obj, scene, near, flight, unconfirmed="none")
    last = np.arange(len(scene)) >= len(scene) - len(floating)
    gone = found.reason == Reason.DISPUTED
    assert gone[last].mean() > 0.4 and not gone[~last].any()
    assert (found.scene.fields["evidence"][last & gone] == Evidence.MEASURED).mean() > 0.8
    # Photos that resolve no more than the scene's own dispute nothing.
    assert not (check(obj, scene, flight, near, unconfirmed="none").reason == Reason.DISPUTED).any()


def test_fewer_than_half_of_the_close_ups_that_are_compared_confirm_nothing(monkeypatch):
    """Of ten photos three match beside an edge by chance."""
    cloud, ones = sheet(0.0, 0.3, 0.1, half=0.1), np.ones(4)
    cloud = cloud[:4]
    coarse = Matches(ones, ones, np.full(4, 5), np.full(4, 6), 0.1 * ones, 20 * ones, ones)
    fine = replace(coarse, photos=np.array([3, 5, 6, 3]), tested=np.array([10, 10, 10, 4]), step=0.5 * ones)
    monkeypatch.setattr(measure, "match_in", lambda *_: fine)
    known = measure.Measured(cloud, coarse, np.ones(4, dtype=bool))
    assert measure.measure_again(known, pack([]), 1.0)[1].tolist() == [True, True, False, False]


def test_what_the_scene_measured_goes_only_where_something_is_left_beside_it(near, far, monkeypatch):
    obj, scene = sheet(-0.8, 0.4, 0.03), sheet(-0.4, 0.8, 0.06, noise=0.005)
    holed = obj.points[:, 0] > 0.1
    monkeypatch.setattr(compare, "better_measured", lambda *_: (np.ones(len(scene), dtype=bool), holed))
    found = check(obj, scene, near, far, unconfirmed="none")
    assert (found.reason[scene.points[:, 0] < 0.0] == Reason.REPLACED).all()
    inside = (scene.points[:, 0] > 0.25) & (scene.points[:, 0] < 0.35) & (np.abs(scene.points[:, 1]) < 0.8)
    assert inside.any() and (found.reason[inside] == Reason.KEPT).all()


@pytest.mark.slow
def test_of_a_very_dense_scene_some_points_are_checked_and_the_others_follow(near, far, monkeypatch):
    floating = sheet(-0.2, 0.2, 0.03, z=0.3)
    obj, scene = sheet(-0.8, 0.4, 0.03), concatenate([sheet(-0.8, 0.8, 0.02), floating])
    whole = check(obj, scene, near, far, unconfirmed="none")
    monkeypatch.setattr(modes, "MAX_CHECKED", len(scene) // 2)
    some = check(obj, scene, near, far, unconfirmed="none")
    assert len(some.reason) == len(some.scene) == len(scene) and set(some.scene.fields) == set(FIELDS)
    assert (some.reason == whole.reason).mean() > 0.97 and (some.added == whole.added).mean() > 0.97
    assert any(f"{len(scene) // 2} were checked" in note for note in some.notes) and some.notes[:-1] == whole.notes


def test_what_no_photo_confirms_is_told_apart_and_added_only_on_demand(near, far):
    blank = sheet(BLANK + 0.15, BLANK + 0.4, 0.03)
    obj = concatenate([sheet(-0.5, 0.5, 0.03), blank])
    scene = concatenate([sheet(-0.5, 0.0, 0.06), sheet(BLANK + 0.4, BLANK + 0.5, 0.06)])
    found = check(obj, scene, near, far, unconfirmed="none")
    last = slice(-len(blank), None)
    assert (found.obj.fields["evidence"][last] == Evidence.NERF_ONLY).all() and not found.added[last].any()
    beyond = scene.points[:, 0] > BLANK
    assert (found.scene.fields["evidence"][beyond] == Evidence.STEREO_ONLY).all() and (
        found.reason[beyond] == Reason.KEPT
    ).all()
    assert check(obj, scene, near, far, unconfirmed="all").added[last].mean() > 0.8


@pytest.mark.slow
def test_an_object_that_is_a_little_off_is_laid_on_the_scene(near, far):
    obj, scene = sheet(-0.8, 0.8, 0.03), sheet(-0.8, 0.8, 0.04)
    off = Sim3(1.0, np.eye(3), np.array([0, 0, 0.04]))
    found = check(obj.transformed(off), scene, moved_photos(near, off), far, unconfirmed="none")
    assert np.abs(found.obj.points[:, 2]).max() < 0.005 and found.moved == pytest.approx(0.04 / obj.diagonal, rel=0.2)
    far_off = Sim3(1.0, np.eye(3), np.array([0, 0, 0.3]))
    found = check(obj.transformed(far_off), scene, moved_photos(near, far_off), far, unconfirmed="none")
    assert np.abs(found.obj.points[:, 2] - 0.3).max() < 0.05


@pytest.mark.slow
def test_an_object_whose_pose_is_more_certain_than_the_surfaces_stays(near, far):
    obj, scene = sheet(-0.8, 0.8, 0.03), sheet(-0.8, 0.8, 0.04)
    off = Sim3(1.0, np.eye(3), np.array([0, 0, 0.008]))
    sides = obj.transformed(off), scene, moved_photos(near, off), far
    stays, settles = (check(*sides, unconfirmed="none", certain=certain) for certain in (0.0, 0.1))
    assert stays.moved == 0 and any("more certain" in note for note in stays.notes)
    assert settles.moved > 0.002
    away = Sim3(1.0, np.eye(3), np.array([0, 0, 0.04]))
    sides = obj.transformed(away), scene, moved_photos(near, away), far
    assert check(*sides, unconfirmed="none", certain=0.0).moved > 0.005


@pytest.mark.slow
def test_a_sheet_that_does_not_say_how_large_it_is_keeps_its_scale():
    rng = np.random.default_rng(1)
    sheets = [sheet(-0.8, 0.8, step, noise=noise) for step, noise in ((0.02, 0.003), (0.03, 0.008))]
    plain = [Cloud(cloud.points + rng.normal(0, 0.002, cloud.points.shape), cloud.normals) for cloud in sheets]
    pose, moved = settle(*plain, plain[0].diagonal)
    assert pose.scale == pytest.approx(1.0, abs=1e-9) and moved < 0.01


@pytest.mark.slow
def test_spread_of_a_pose_grows_with_noise():
    def spread(noise):
        eggs = []
        for rng in map(np.random.default_rng, range(2)):
            points = rng.normal(size=(3000, 3))
            points /= np.linalg.norm(points, axis=1, keepdims=True)
            eggs.append(prepare(Cloud((points + noise * rng.normal(size=(3000, 3))) * [1, 1.3, 1.6]), 0.05, 0, 3000))
        return half_sampling(*eggs, Sim3.identity(), ScaleRange(1.0, 0.2), 0.1)

    fine, rough = spread(0.002), spread(0.02)
    assert fine.scale_sd_log < rough.scale_sd_log
    assert fine.covariance.shape == (7, 7) and np.allclose(fine.covariance, fine.covariance.T)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hardly_any_point_of_the_scene_is_no_error(near, far, count):
    obj = sheet(-0.8, 0.8, 0.03)
    scene = Cloud(obj.points[:count].copy() if count else np.zeros((0, 3)))
    assert len(fuse_by_evidence(obj, scene, near, far, FusionSettings())[0].added) > 500


@pytest.mark.slow
def test_one_wrong_camera_changes_little(near, far):
    obj, scene = sheet(-0.8, 0.8, 0.03), sheet(-0.8, 0.8, 0.06)
    views = photographs(8, 3.0)
    pose = views[0].cam_from_world.copy()
    pose[:3, 3] += 0.4
    views[0] = replace(views[0], cam_from_world=pose)
    found = check(obj, scene, pack(views), far, unconfirmed="none")
    good = check(obj, scene, near, far, unconfirmed="none")
    assert good.added.mean() > 0.97 and found.added.mean() > 0.9
    assert np.abs(found.obj.points[found.added][:, 2]).max() < 0.01


def test_the_pose_adds_along_the_normal_what_it_may_be_off():
    cloud = Cloud(np.array([[2.0, 0, 0], [0, 0, 1]]), np.array([[0, 0, 1], [0, 0, 1]], np.float32))
    turn_y, shift_z, scale = (np.diag(sd) for sd in np.eye(7)[[1, 5, 6]] * [[0.2], [0.4], [0.5]])
    for deviation, expected in ((turn_y, [0.4, 0.0]), (shift_z, [0.4, 0.4]), (scale, [0.0, 0.5])):
        np.testing.assert_allclose(deviations_of_pose(cloud, deviation**2, np.zeros(3)), expected, atol=1e-9)


def test_what_moved_between_flight_and_close_ups_takes_nothing_from_the_scene_and_is_said(near, far):
    up = Sim3(1.0, np.eye(3), np.array([0, 0, 0.5]))
    obj, scene = sheet(-0.5, 0.5, 0.03).transformed(up), sheet(-0.8, 0.8, 0.06)
    fused, checked = fuse_by_evidence(obj, scene, moved_photos(near, up), far, FusionSettings())
    assert len(fused.removed) == 0
    notes = value(evidence_report(fused, checked), "notes")
    assert any("stays where the registration put it" in note for note in notes)


@pytest.mark.slow
@pytest.mark.parametrize("without", ["object", "scene", "both"])
def test_a_side_without_photos_is_judged_by_the_other(near, far, without):
    obj, scene = sheet(-0.8, 0.8, 0.03), sheet(-0.8, 0.2, 0.06)
    sides = NOBODY if without != "scene" else near, NOBODY if without != "object" else far
    fused, checked = fuse_by_evidence(obj, scene, *sides, FusionSettings())
    notes = value(evidence_report(fused, checked), "notes")
    if without == "both":
        assert len(fused.added) == len(fused.removed) == 0 and any("nothing is added" in note for note in notes)
    else:
        assert any(f"photos of the {without} see it" in note for note in notes)
        assert (fused.added.points[:, 0] > 0.3).sum() > 500 and (
            fused.added.fields["evidence"] == Evidence.MEASURED
        ).all()


def test_clouds_without_normals_or_colors_and_a_scene_far_away(near, far):
    obj, scene = sheet(-0.8, 0.8, 0.03), sheet(-0.8, 0.2, 0.06)
    plain = Cloud(obj.points), Cloud(scene.points)
    fused, _ = fuse_by_evidence(*plain, near, far, FusionSettings())
    assert (fused.added.points[:, 0] > 0.3).sum() > 500
    fused, _ = fuse_by_evidence(obj, replace(scene, points=scene.points + 50), near, far, FusionSettings())
    assert len(fused.rows) == 0 and len(fused.added) > 0.9 * len(obj)


def test_every_point_says_what_is_known_of_it(near, far):
    obj, scene = sheet(-0.8, 0.8, 0.03), concatenate([sheet(-0.8, 0.2, 0.06), sheet(8, 9, 0.06)])
    up_and_down = np.diag([0, 0, 0, 0, 0, 0.1**2, 0])
    fused, checked = fuse_by_evidence(obj, scene, near, far, FusionSettings(), on_world=up_and_down)
    of_both = np.hypot(fused.added.fields["deviation"], 0.1)
    np.testing.assert_allclose(fused.added.fields["world_deviation"], of_both, rtol=1e-2)
    assert set(FIELDS) == set(fused.added.fields) == set(fused.scene.fields)
    assert (fused.added.fields["photos"] >= 3).all() and (fused.added.fields["deviation"] < 0.02).all()
    beyond = fused.scene.points[:, 0] > 5
    assert not fused.scene.fields["evidence"][beyond].any() and np.isnan(fused.scene.fields["deviation"][beyond]).all()
    report = evidence_report(fused, checked)
    assert len(fused.rows) >= value(report, "scene_measured") > 0
    assert sum(value(report, "scene_removed").values()) == len(fused.removed) > 0
    assert value(report, "object_measured_share") > 0.9
    assert value(report, "object_measured") + value(report, "object_contradicted") <= len(obj)


@pytest.mark.slow
def test_a_pot_before_a_wall_stays_where_photos_confirm_it():
    photos, flight = pack(photographs(8, 3.0, panel=0.3)), pack(photographs(8, 6.0, radius=4.0, panel=0.3))
    pot, middle = sheet(-0.13, 0.13, 0.02, z=0.3), 0.13
    pot = pot[np.abs(pot.points[:, 1]) < middle]
    scene = concatenate([sheet(-0.8, 0.8, 0.04), pot])
    # The object is the wall and a sill as high as the pot, so that the pot lies in its box.
    obj = concatenate([sheet(-0.8, 0.8, 0.03), sheet(0.7, 0.8, 0.03, z=0.32)])
    found = check(obj, scene, photos, flight, unconfirmed="none")
    assert (found.scene.fields["evidence"][-len(pot) :] == Evidence.MEASURED).mean() > 0.95
    assert (found.reason[-len(pot) :] == Reason.KEPT).mean() > 0.95


def test_the_objects_points_give_way_to_better_ones_within_a_spacing_only(near):
    obj, scene, far = sheet(-0.8, 0.8, 0.02), sheet(-0.8, 0.8, 0.12), pack(photographs(8, 9.0, radius=6.0))
    found = check(obj, scene, far, near, unconfirmed="none")
    inside = np.abs(obj.points[:, :2]).max(1) < 0.6
    distance = np.linalg.norm(obj.points[inside, None, :2] - scene.points[:, :2], axis=2).min(1)
    added = found.added[inside]
    assert added[distance > 0.022].mean() > 0.95 and added[distance < 0.018].mean() < 0.5


@pytest.mark.slow
def test_of_equals_the_denser_side_stays(near, far):
    coarse, fine = sheet(-0.8, 0.8, 0.04), sheet(-0.8, 0.8, 0.015)
    for obj, scene, added in ((coarse, fine, False), (fine, coarse, True)):
        found = check(obj, scene, near, near, unconfirmed="none")
        middle, around = (np.abs(cloud.points[:, :2]).max(1) < 0.6 for cloud in (obj, scene))
        assert (found.added[middle].mean() > 0.95) == added
        assert ((found.reason[around] == Reason.KEPT).mean() < 0.05) == added


@pytest.mark.slow
def test_in_a_hole_of_a_denser_scene_the_objects_points_are_added(near, far):
    obj, scene = sheet(-0.8, 0.8, 0.03), sheet(-0.8, 0.8, 0.012)
    scene = scene[np.linalg.norm(scene.points[:, :2], axis=1) > 0.08]
    found = check(obj, scene, near, near, unconfirmed="none")
    inside, beside = (np.linalg.norm(obj.points[:, :2], axis=1) < r for r in (0.05, 0.5))
    assert found.added[inside].mean() > 0.7 and found.added[beside & (np.abs(obj.points[:, 0]) > 0.2)].mean() < 0.05


@pytest.mark.slow
def test_doubles_do_not_make_a_scene_dense(near):
    obj, scene = sheet(-0.8, 0.8, 0.03), sheet(-0.8, 0.8, 0.06)
    found = check(obj, concatenate([scene] * 10), near, near, unconfirmed="none")
    assert found.added.mean() > 0.95


def test_a_scene_of_which_nothing_is_measured_gives_way(near, far):
    obj, floating = sheet(-0.8, 0.4, 0.03), sheet(-0.2, 0.2, 0.06, z=0.3)
    found = check(obj, floating, near, far, unconfirmed="none")
    assert found.added.mean() > 0.9 and (found.reason != Reason.KEPT).mean() > 0.9


@pytest.mark.parametrize(("inexact", "stay"), [(0.02, True), (0.004, False)])
def test_what_the_scene_did_not_measure_stays_where_the_object_measures_less_exactly(inexact, stay):
    obj, scene = sheet(-0.8, 0.8, 0.03, half=1), sheet(-0.8, 0.8, 0.04, z=0.01, half=1)
    measured = scene.points[:, 0] < 0
    theirs = known(scene, np.where(measured, 0.005, np.inf), measured)
    worse, better = better_measured(known(obj, inexact), theirs, obj.diagonal, 1.0)
    assert (not worse[~measured].any()) if stay else worse[~measured].all()
    # What lies farther off than the object's own deviation explains goes.
    away = replace(theirs, cloud=replace(scene, points=scene.points + [0, 0, 0.035]))
    worse, _ = better_measured(known(obj, 0.008), away, obj.diagonal, 1.0)
    assert worse[~measured].mean() > 0.95


def known(cloud, deviation, surface=True):
    """A cloud with texture that photos measured, of that standard deviation."""
    nothing = np.zeros(len(cloud))
    matches = Matches(nothing, nothing, nothing, nothing, nothing + deviation, nothing + 20, nothing)
    return Measured(cloud, matches, np.broadcast_to(surface, len(cloud)))
