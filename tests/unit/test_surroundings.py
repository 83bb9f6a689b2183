"""The ground at the foot of a panel on a pole: completed where photos show it and the scene has none, and counted."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.photographed_plane import BLANK, PANEL, paint, photographs

from scenefuse.cloud.clouds import Cloud, concatenate
from scenefuse.fuse.measure import FIELDS, Evidence
from scenefuse.fuse.surroundings import ground_to_add, missing_ground
from scenefuse.geometry.photo_check import pack

NOBODY = pack([])
HOLE = 0.3


def flat(low, high, step, z=0.0):
    """Points of a level square, x and y from low to high."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(low, high, step), np.arange(low, high, step)))
    return Cloud(np.stack([x, y, np.full_like(x, z)], 1), np.tile(np.float32([0, 0, 1]), (len(x), 1)))


@pytest.fixture(scope="module")
def views():
    return photographs(8, 3.0, panel=PANEL)


@pytest.fixture(scope="module")
def obj():
    """A panel, and a pole from it that makes its tenth reach beyond the hole."""
    pole = np.linspace(PANEL, 3.0, 100)
    pole = Cloud(np.stack([0 * pole, 0 * pole, pole], 1), np.tile(np.float32([1, 0, 0]), (100, 1)))
    return concatenate([flat(-PANEL, PANEL, 0.02, PANEL), pole])


@pytest.fixture(scope="module")
def holed():
    """The scene: the plane without what lies under the panel and beside it, rough by a centimetre."""
    scene = flat(-1.0, 1.0, 0.06)
    scene.points[:, 2] += 0.01 * np.random.default_rng(0).normal(size=len(scene))
    return scene[np.abs(scene.points[:, :2]).max(1) > HOLE]


def completed(obj, scene, views):
    picture = {view.name: replace(view, pixels=np.repeat(view.pixels[..., None], 3, axis=2)) for view in views}
    return ground_to_add(obj, scene, obj, pack(list(views)), lambda view: picture[view.name])


def test_the_ground_that_close_ups_show_at_an_objects_foot_comes_in_where_it_is(obj, holed, views):
    ground = completed(obj, holed, views)
    beside = flat(-HOLE, HOLE, 0.02).points
    beside = beside[np.abs(beside[:, :2]).max(1) > PANEL + 0.03]
    there = [cKDTree(points).query(beside)[0] < 0.06 for points in (ground.points, holed.points)]
    assert (there[0] | there[1]).mean() > 0.95 and there[1].mean() < 0.3
    assert (np.abs(ground.points[:, 2]) <= 2 * ground.fields["deviation"]).mean() > 0.9
    assert set(ground.fields) == set(FIELDS) and (ground.fields["evidence"] == Evidence.MEASURED).all()
    assert ground.fields["photos"].min() >= 3
    # Under the middle of the panel no photo sees any, and where the scene has some nothing is added.
    assert np.abs(ground.points[:, :2]).max(1).min() > 0.04 and np.abs(ground.points[:, :2]).max() < HOLE + 0.06
    true = paint(*ground.points[:, :2].T)
    assert np.median(np.abs(ground.colors.mean(1) - true)) < 6


def test_the_ground_that_is_missing_is_counted_until_it_is_there(obj, holed, views):
    photos = pack(list(views)), NOBODY
    before, after = (
        missing_ground(obj, concatenate([Cloud(c.points, c.normals) for c in (obj, holed, *more)]), photos)
        for more in ([], [completed(obj, holed, views)])
    )
    assert before > 0.4 and after < before / 4


def test_an_object_above_the_ground_or_on_blank_ground_gets_none(obj, holed, views):
    up = replace(obj, points=obj.points + [0, 0, 1.0])
    assert len(completed(up, holed, views)) == 0
    assert missing_ground(up, holed, (pack(list(views)), NOBODY)) is None
    assert len(completed(obj, holed[:5], views)) == 0
    aside = [BLANK + 0.6, 0, 0]
    moved = [replace(cloud, points=cloud.points + aside) for cloud in (obj, holed)]
    assert len(completed(*moved, views)) == 0
