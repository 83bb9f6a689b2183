"""The points of the 3D view: told apart before and after, thinned, and packed for the page."""

import zlib

import numpy as np
import pytest
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, spacing
from scenefuse.core.stage import StageError
from scenefuse.report.view import REMOVED, Shown, View, encode, merge, read_view, thin, within, write_view


def square(count, seed=0, height=0.0, color=(90, 160, 70), **fields):
    """Random points on the unit square."""
    points = np.random.default_rng(seed).uniform(0, 1, (count, 3)) * [1, 1, 0] + [0, 0, height]
    normals = np.tile(np.float32([0, 0, 1]), (count, 1))
    return Cloud(points, normals, np.tile(np.uint8(color), (count, 1)), fields)


def completed(before, keep, added):
    """Some points of a scene, and added ones with source 1."""
    kept = before[keep]
    return Cloud(
        np.concatenate([kept.points, added.points]),
        np.concatenate([kept.normals, added.normals]),
        np.concatenate([kept.colors, added.colors]),
        {"source": np.repeat([0, 1], [len(kept), len(added)]).astype(np.uint16)},
    )


def view_of(cloud, sources=None, total=(0, 0)):
    low, high = cloud.points.min(0), cloud.points.max(0)
    return View(cloud, sources or {0: "scene", 1: "house"}, "m", low, high, 40.0, 20.0, *total)


def test_points_are_told_apart_by_where_they_are_shown():
    before, added = square(100), square(30, 1, 0.5)
    view = merge(before, completed(before, np.arange(100) < 80, added))
    shown, source = view.fields["shown"], view.fields["source"]
    assert [int((shown == code).sum()) for code in (Shown.BOTH, Shown.BEFORE, Shown.AFTER)] == [80, 20, 30]
    assert (source[shown == Shown.BEFORE] == REMOVED).all()
    assert (source[shown == Shown.BOTH] == 0).all() and (source[shown == Shown.AFTER] == 1).all()
    np.testing.assert_array_equal(view.points[shown == Shown.BEFORE], before.points[80:])


def test_a_recoloured_point_shows_both_its_colours_and_was_not_removed():
    before = square(50)
    after = Cloud(before.points, before.normals, before.colors.copy(), {"source": np.zeros(50, dtype=np.uint16)})
    after.colors[:10] = 7
    view = merge(before, after)
    shown = view.fields["shown"]
    assert [int((shown == code).sum()) for code in (Shown.BOTH, Shown.BEFORE, Shown.AFTER)] == [40, 10, 10]
    assert (view.colors[shown == Shown.AFTER] == 7).all() and (view.colors[shown == Shown.BEFORE] != 7).all()
    assert (view.fields["source"] == 0).all()


def test_fields_of_the_completed_cloud_are_kept_and_unknown_where_only_the_scene_had_a_point():
    before = square(40)
    after = before[np.arange(40) < 30]
    after = Cloud(
        after.points,
        after.normals,
        after.colors,
        {"evidence": np.ones(30, dtype=np.uint8), "deviation": np.full(30, 0.02, dtype=np.float32)},
    )
    view = merge(before, after)
    gone = view.fields["shown"] == Shown.BEFORE
    assert gone.sum() == 10
    assert (view.fields["evidence"][gone] == REMOVED).all() and (view.fields["evidence"][~gone] == 1).all()
    assert np.isnan(view.fields["deviation"][gone]).all()
    assert set(merge(before, before).fields) == {"shown", "source", "near"}


def test_points_that_moved_by_rounding_alone_are_the_same():
    before = square(200)
    after = Cloud(before.points + 1e-14, before.normals, before.colors)
    assert (merge(before, after).fields["shown"] == Shown.BOTH).all()


def test_thinning_keeps_the_budget_and_the_even_spacing():
    before, added = square(210_000), square(90_000, 1, 0.2)
    view = merge(before, completed(before, np.arange(210_000) >= 30_000, added))
    thinned = thin(view, 18_000)
    assert 15_000 < len(thinned) <= 18_000
    for code in (Shown.BOTH, Shown.BEFORE, Shown.AFTER):
        part = thinned.points[thinned.fields["shown"] == code]
        assert len(part) > 1500, code
        # Every point is a measured one, and no two are much closer than the rest.
        assert np.isin(part[:, 0], view.points[:, 0]).all()
        assert spacing(part) > 3 * spacing(view.points[view.fields["shown"] == code])
    few = square(50)
    assert thin(merge(few, few), 100).points.shape == (50, 3)


def test_surroundings_are_thinned_more_than_the_object():
    view = merge(square(60_000), square(60_000))
    box = np.array([[0.3, 0.3, -1], [0.5, 0.5, 1]])
    view.fields["near"][:] = within(view.points, *box, margin=0.0)
    thinned = thin(view, 3_000)
    inside = within(thinned.points, *box, margin=0.0)
    density = inside.sum() / 0.04, (~inside).sum() / 0.96
    assert density[0] / density[1] == pytest.approx(4, rel=0.15)


def planes_of(about, data):
    raw = np.frombuffer(zlib.decompress(data), dtype=np.uint8)
    return dict(zip(about["planes"], raw.reshape(len(about["planes"]), -1)))


def test_packed_positions_colours_and_fields_come_back():
    before, added = square(3000), square(1000, 1, 0.5, (200, 40, 10))
    after = completed(before, np.arange(3000) < 2500, added)
    after.fields["deviation"] = np.linspace(0.001, 0.1, len(after)).astype(np.float32)
    cloud = merge(before, after)
    about, data = encode(view_of(cloud, total=(3000, 3500)))
    planes = planes_of(about, data)
    assert about["points"] == {"before": 500, "both": 2500, "after": 1000}
    assert about["total"] == {"before": 3000, "after": 3500}
    decoded = np.empty((4000, 3))
    for k, axis in enumerate("xyz"):
        folded = planes[f"{axis}_low"].astype(int) | planes[f"{axis}_high"].astype(int) << 8
        steps = np.where(folded & 1, -(folded + 1) // 2, folded // 2)
        decoded[:, k] = about["corner"][k] + (np.cumsum(steps) % 65536) * about["step"][k]
    middle = (cloud.points.min(0) + cloud.points.max(0)) / 2
    distance, match = cKDTree(decoded).query(cloud.points - middle)
    assert distance.max() <= np.linalg.norm(about["step"]) / 2 + 1e-12
    assert len(set(match)) == 4000
    red = planes["red_less_green"] + planes["green"]
    assert set(red[:3000]) == {90} and set(red[3000:]) == {200}
    assert set(planes["source"][:500]) == {REMOVED} and set(planes["source"][3000:]) == {1}
    assert set(planes["deviation"][:500]) == {0} and planes["deviation"].max() == about["levels"]
    assert about["deviation"] == pytest.approx([0.003, 0.098], rel=0.05)


def test_disc_sizes_follow_what_is_shown_with_a_point():
    before, added = square(400), square(40_000, 1)
    about, data = encode(view_of(merge(before, completed(before, np.ones(400, dtype=bool), added))))
    planes, (least, largest) = planes_of(about, data), about["radius"]
    levels = np.stack([planes["radius_before"], planes["radius_after"]]).astype(float)
    radii = np.where(levels > 0, least * (largest / least) ** ((levels - 1) / (about["levels"] - 1)), 0)
    assert (radii[0, 400:] == 0).all()
    # Among dense points a scene point is as small as they are, and by itself as large as the scene needs.
    assert np.median(radii[1, :400]) == pytest.approx(np.median(radii[1, 400:]), rel=0.3)
    assert np.median(radii[0, :400]) > 5 * np.median(radii[1, :400])


def test_a_view_without_colours_and_normals_and_of_one_point_is_packed():
    about, data = encode(
        view_of(Cloud(np.zeros((1, 3)), None, None, {"shown": np.uint8([0]), "source": np.uint8([0])}))
    )
    planes = planes_of(about, data)
    assert "green" not in planes and "deviation" not in planes and planes["shade"][0] == about["levels"]


def test_the_shape_of_a_cloud_without_colours_and_normals_shows_by_its_light():
    rng = np.random.default_rng(0)
    floor, wall = np.c_[rng.random((400, 2)), np.zeros(400)], np.c_[np.zeros(400), rng.random((400, 2))]
    fields = {"shown": np.zeros(800, np.uint8), "source": np.zeros(800, np.uint8)}
    about, data = encode(view_of(Cloud(np.concatenate([floor, wall]), None, None, fields)))
    darker, brighter = np.percentile(planes_of(about, data)["shade"], [10, 90])
    assert brighter - darker > 0.1 * about["levels"]


def test_deviations_that_say_nothing_are_left_out():
    for values in (np.zeros(30, dtype=np.float32), np.full(30, np.nan, dtype=np.float32)):
        scene = square(30, deviation=values)
        assert "deviation" not in encode(view_of(merge(scene, scene)))[0]


def test_a_written_view_is_read_as_it_was(tmp_path):
    view = view_of(merge(square(30), square(30, 2)), {0: "scene", 1: "house", 2: "shed"}, (30, 30))
    assert read_view(tmp_path) is None
    write_view(tmp_path, view)
    found = read_view(tmp_path)
    np.testing.assert_array_equal(found.cloud.points, view.cloud.points)
    np.testing.assert_array_equal(found.cloud.fields["shown"], view.cloud.fields["shown"])
    assert (found.sources, found.unit, found.azimuth_deg, found.before_points) == (view.sources, "m", 40.0, 30)


def test_a_damaged_view_is_named(tmp_path):
    write_view(tmp_path, view_of(merge(square(30), square(30, 2))))
    (tmp_path / "view.json").write_text("{}")
    with pytest.raises(StageError, match=r"view.json is damaged .*'sources'.*; delete it"):
        read_view(tmp_path)
