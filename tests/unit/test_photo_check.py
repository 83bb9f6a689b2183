"""Points checked in photos of a painted plane, whose place and texture are known exactly."""

from dataclasses import replace

import numpy as np
import pytest
from support.photographed_plane import BLANK, photographs

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.transforms import Sim3
from scenefuse.geometry import photo_check
from scenefuse.geometry.depth_test import see
from scenefuse.geometry.photo_check import match_in, moved_photos, pack, read_photos
from scenefuse.photos.workspace import Workspace

UP = np.array([0.0, 0, 1])


@pytest.fixture(scope="module")
def photos():
    return pack(photographs(8, 3.0))


def grid(low, high, z=0.0, step=0.05):
    x, y = np.meshgrid(np.arange(low, high, step), np.arange(-1, 1, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)


def up(points):
    return np.tile(UP, (len(points), 1))


def test_points_on_the_surface_are_measured_and_points_off_it_are_not(photos):
    on, off = grid(-1, 1), grid(-1, 1, z=0.15)
    assert match_in(on, up(on), photos).measured.mean() > 0.99
    # Here and there a patch matches by chance.
    assert match_in(off, up(off), photos).measured.mean() < 0.1


def test_where_there_is_no_texture_nothing_is_measured(photos):
    blank = grid(BLANK + 0.15, BLANK + 0.5)
    found = match_in(blank, up(blank), photos)
    assert (found.tested >= 3).all() and not found.measured.any() and np.isinf(found.deviation).mean() > 0.9


def test_the_standard_deviation_covers_the_error_and_grows_with_the_distance(photos):
    rng = np.random.default_rng(1)
    points = grid(-1, 1)
    near = match_in(points, up(points), photos)
    far = match_in(points, up(points), pack(photographs(8, 6.0, radius=4.0)))
    assert 1.4 < np.median(far.deviation) / np.median(near.deviation) < 2.5
    # Of points at all heights, those that are measured lie within two standard deviations of the plane.
    points[:, 2] = rng.uniform(-0.05, 0.05, len(points))
    found = match_in(points, up(points), photos)
    inside = np.abs(points[found.measured, 2]) <= 2 * found.deviation[found.measured]
    assert inside.mean() > 0.9 and found.measured.mean() < 0.7


def test_texture_that_noise_hides_in_single_pixels_measures_less_exactly_in_photos_of_half_the_size(monkeypatch):
    rng = np.random.default_rng(2)

    def faint(view):
        grey = 128 + 0.08 * (view.pixels - 128.0) + rng.normal(0, 3, view.pixels.shape)
        return replace(view, pixels=np.clip(np.rint(grey), 0, 255).astype(np.uint8))

    photos, points = pack([faint(view) for view in photographs(8, 3.0)]), grid(-1, 1)
    found = match_in(points, up(points), photos)
    off = match_in(grid(-1, 1, z=0.15), up(points), photos)
    blank = grid(BLANK + 0.15, BLANK + 0.5)
    assert not match_in(blank, up(blank), photos).measured.any() and off.measured.mean() < 0.1
    monkeypatch.setattr(photo_check, "halved", lambda photos: photo_check.pack([]))
    full = match_in(points, up(points), photos)
    assert full.measured.mean() < 0.6 and found.measured.mean() > full.measured.mean() + 0.2
    more = found.measured & ~full.measured
    assert np.median(found.deviation[more]) > 1.2 * np.median(full.deviation[full.measured])


def test_one_wrong_camera_and_one_covered_lens_do_no_harm(photos):
    views = photographs(8, 3.0)
    views[2] = replace(views[2], cam_from_world=views[3].cam_from_world)
    views[5] = replace(views[5], pixels=np.zeros_like(views[5].pixels))
    points = grid(-1, 1)
    found = match_in(points, up(points), pack(views))
    assert found.measured.mean() > 0.97 and np.median(found.photos) <= 5


def test_two_photos_are_not_enough(photos):
    points = grid(-1, 1)
    assert not match_in(points, up(points), pack(photographs(2, 3.0))).measured.any()
    assert not match_in(points, up(points), pack([])).measured.any()
    assert len(match_in(points[:0], up(points[:0]), photos).match) == 0


def test_another_frame_and_unit_change_nothing(photos):
    b_from_a = Sim3(3.0, np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]), np.array([5.0, -2, 7]))
    # Off the symmetry axes of the ring of cameras: on them photos are equally good, and rounding would choose.
    points = grid(-1, 1, step=0.2) + [0.03, 0.017, 0]
    here = match_in(points, up(points), photos)
    there = match_in(b_from_a.apply(points), b_from_a.rotate(up(points)), moved_photos(photos, b_from_a))
    assert np.array_equal(here.photos, there.photos) and np.allclose(here.match, there.match, atol=1e-6)
    assert np.median(there.deviation / here.deviation) == pytest.approx(3, rel=0.01)


def test_only_photos_that_see_the_points_are_read(tmp_path):
    views = photographs(6, 3.0)
    aside = replace(views[0], name="missing.png", cam_from_world=np.diag([1.0, -1, -1, 1]) @ np.eye(4))
    far = replace(aside, cam_from_world=aside.cam_from_world + np.array([[0, 0, 0, 500]] + [[0] * 4] * 3))

    class Known(Workspace):
        def gray(self, view):
            assert view.name != "missing.png"
            return next(v for v in views if v.name == view.name)

    known = Known(tmp_path, [*views, far], np.zeros((0, 3)), [], [])
    assert [v.name for v in read_photos(known, grid(-0.5, 0.5)).views] == [v.name for v in views]


def test_photos_see_through_what_stands_before_a_surface_and_not_what_is_behind():
    points = grid(-1.5, 1.5, step=0.03)
    surface = Cloud(points, up(points).astype(np.float32))
    asked = np.array([[0, 0, 0.5], [0, 0, -0.5], [0, 0, 0.02], [9.0, 9, 9]])
    seen = see(asked, surface, photographs(8, 3.0), 0.03, margin=0.05)
    assert seen.through[0] == 8 and seen.hidden[0] == 0
    assert seen.through[1] == 0 and seen.hidden[1] == seen.in_view[1] == 8
    assert seen.through[2] == seen.hidden[2] == 0 and seen.in_view[3] == 0
    # A surface that turns its back on the cameras stops nothing.
    back = replace(surface, normals=-surface.normals)
    assert see(asked, back, photographs(8, 3.0), 0.03, margin=0.05).hidden[1] == 0
