"""Points of coarse stereo: parts of the object in masks, and objects with hardly a feature."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.photographed_plane import BLANK, photographs
from support.textured_plane import plane_views, speckled

from scenefuse.core.stage import StageError
from scenefuse.crop import marked
from scenefuse.geometry.visual_hull import mask_iou
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.propagation import NO_CLICKS, propagate
from scenefuse.masks.votes import known_points, points_in_masks, voter_of
from scenefuse.mvs.sparse_depths import own_points, sparse_depths
from scenefuse.mvs.stereo_points import FEW_POINTS, with_enough_points, with_stereo, with_stereo_points
from scenefuse.photos.views import Views
from scenefuse.photos.workspace import Workspace


@pytest.fixture(scope="module")
def plane():
    """Photos of the painted plane, with sparse points where y < 0 alone."""
    views = [replace(view, pixels=np.dstack([view.pixels] * 3)) for view in photographs(6, 4.0, size=160)]
    rng = np.random.default_rng(0)
    sparse = np.column_stack([rng.uniform([-2, -2], [BLANK, 0], (250, 2)), np.zeros(250)])
    rows = [view.visible(sparse)[0] for view in views]
    return Workspace(Path(), views, sparse, rows, [v.project(sparse[r])[0] for v, r in zip(views, rows)])


@pytest.fixture(scope="module")
def more(plane):
    """The same with points by stereo."""
    return with_stereo_points(plane)


def places_of(view):
    """(H, W, 3) where the rays of a view's pixels meet the plane."""
    u, v = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(view.intrinsics).T @ view.cam_from_world[:3, :3]
    return np.where(rays[..., 2:] < 0, view.centre + rays * (-view.centre[2] / rays[..., 2:]), np.inf)


def disc(view, radius=1.0):
    """A view's mask of the disc of the plane about the origin."""
    return np.linalg.norm(places_of(view), axis=2) < radius


def below(view):
    """A view's mask of the half of the plane that holds the sparse points."""
    return places_of(view)[..., 1] < 0


def test_stereo_adds_points_where_there_are_none_and_only_on_what_has_texture(plane, more):
    new, known = more.points[len(plane.points) :], len(plane.points)
    assert (more.points[:known] == plane.points).all()
    inner = new[(np.abs(new[:, :2]) < 1).all(1)]
    assert (inner[:, 1] > 0.1).sum() > 150 and np.median(np.abs(inner[:, 2])) < 0.02
    assert (new[:, 0] > BLANK + 0.2).sum() < 0.01 * len(new)
    # Each is seen by three photos, where these have it.
    counts = np.bincount(np.concatenate(more.seen), minlength=len(more.points))[known:]
    assert counts.min() >= 3
    for view, rows, at in zip(more.views, more.seen, more.seen_at):
        added = rows >= known
        np.testing.assert_allclose(view.project(more.points[rows[added]])[0], at[added], atol=1e-6)
    # No place gets two.
    near = np.linalg.norm(inner[:, None] - inner[None], axis=2) + np.eye(len(inner))
    assert np.median(near.min(1)) > 0.02


@pytest.mark.slow
def test_an_object_without_a_feature_is_found_in_its_masks_by_points_of_stereo(plane):
    found = points_in_masks(plane, [disc(view) & ~below(view) for view in plane.views])
    assert len(found) > 50 and found[:, 1].min() > -0.05 and np.abs(found[:, 2]).max() < 0.2
    with pytest.raises(StageError, match="only 0 points, those by stereo included, lie in the supplied masks"):
        points_in_masks(plane, [np.zeros((view.height, view.width), bool) for view in plane.views])


def test_photos_that_stereo_cannot_match_are_left_as_they_are(plane, capsys):
    alone = plane.subset([0])
    assert with_stereo_points(alone) is alone and "no points by stereo" in capsys.readouterr().out


def test_points_by_stereo_say_what_is_the_object_and_never_what_is_not(plane, more):
    sparse = len(plane.points)
    lacking = voter_of(more, 0, disc(more.views[0], 0.5), 0.9, 1.0, NO_CLICKS)
    kind = known_points(more, {0: lacking})
    assert (kind[:sparse] == -1).any() and (kind[sparse:] == 1).any() and not (kind[sparse:] == -1).any()


def test_a_part_without_features_is_found_by_stereo_though_the_network_is_surer_of_the_rest(plane):
    def segment(view, prompts, box):
        whole, lower = disc(view), disc(view) & below(view)
        return [lower, whole], np.array([0.95, 0.9 if view.name == "0.png" else 0.85])

    own = [plane.points[rows][:, 1] < -0.2 for rows in plane.seen]
    few = replace(
        plane,
        seen=[rows[keep] for rows, keep in zip(plane.seen, own)],
        seen_at=[at[keep] for at, keep in zip(plane.seen_at, own)],
    )
    places = few.views[0].project(np.array([[0.0, -0.5, 0], [0.0, 0.9, 0], [0.5, 0.0, 0]]))[0]
    told = {0: PhotoClicks(places, np.ones(3, dtype=bool))}
    found = propagate(segment, few, told, 2)
    assert mask_iou(found.masks[1], disc(few.views[1])) < 0.8
    found = propagate(segment, with_stereo_points(few), told, 2)
    assert all(mask_iou(m, disc(v)) > 0.99 for m, v in zip(found.masks, few.views))


def test_an_object_with_hardly_a_feature_gets_points_by_stereo_and_any_other_keeps_its_own():
    views = speckled(*plane_views(width=128, height=96, held_out=0))
    assert with_enough_points(views) is views
    bare = views.sparse[:, 0] > 0
    off = replace(views, tracks=[np.flatnonzero(~bare)] * len(views.names))
    right = [view.project(views.sparse[bare])[0][:, 0].min() for view in map(views.view, range(len(views.names)))]
    for matte, column in zip(off.mattes, right):
        matte[:, : int(column)] = 0
    assert own_points(off).sum() < 8
    more = with_enough_points(off)
    found = more.sparse[own_points(more)]
    assert len(found) > 100 and (found[:, 0] > -0.1).mean() > 0.95
    assert np.median(np.abs(found[:, 2] - 3 - 0.3 * found[:, 0])) < 0.02


@pytest.fixture
def bare(plane, tmp_path, monkeypatch):
    """A workspace of the plane, and masks of a disc on it with no sparse point."""
    (tmp_path / "images").mkdir(), (tmp_path / "masks").mkdir()
    for view in plane.views:
        cv2.imwrite(str(tmp_path / "images" / view.name), view.pixels)
        there = np.linalg.norm(places_of(view)[..., :2] - [0, 1], axis=2) < 0.6
        cv2.imwrite(str(tmp_path / "masks" / view.name), np.uint8(255 * there))
    photos = replace(plane, folder=tmp_path, views=[replace(view, pixels=None) for view in plane.views])
    monkeypatch.setattr(marked, "read_workspace", lambda folder: photos)
    return tmp_path


def test_masks_without_sparse_points_mark_the_object_by_points_of_stereo_and_say_so(bare):
    found = marked.read_masked_views(bare, bare / "masks", 0.8)
    assert found.notes == (FEW_POINTS,) and len(found.own) > 50
    assert np.linalg.norm(found.own - [0, 1, 0], axis=1).max() < 0.75


def test_where_stereo_finds_nothing_either_the_error_says_so(bare):
    for path in (bare / "images").iterdir():
        cv2.imwrite(str(path), np.full((160, 160), 128, np.uint8))
    with pytest.raises(StageError, match="only 0 points of .* by features and by stereo, 8 are needed"):
        marked.read_masked_views(bare, bare / "masks", 0.8)


@pytest.mark.slow
def test_stereo_knows_that_something_without_sparse_points_hides_the_object():
    """A panel above the disc; no feature was found on it."""
    height = 0.25
    photos = photographs(8, 2.0, size=200, radius=1.0, panel=height)
    rng = np.random.default_rng(0)
    sparse = np.column_stack([rng.uniform(-1.2, 1.2, (400, 2)), np.zeros(400)])
    panels, tracks, mattes = [], [], []
    for view in photos:
        before = view.centre + (places_of(view) - view.centre) * ((2.0 - height) / 2.0)
        panels.append((np.abs(before[..., :2]) < 0.12).all(2))
        rows, pixels, _ = view.visible(sparse)
        tracks.append(rows[~panels[-1][pixels[:, 1], pixels[:, 0]]])
        mattes.append(np.uint8(255 * (disc(view) & ~panels[-1])))
    names, k, poses = (list(map(str, range(8))), [v.intrinsics for v in photos], [v.world_from_cam for v in photos])
    images = np.stack([np.dstack([view.pixels] * 3) for view in photos])
    nothing = np.zeros((8, 200, 200), bool)
    views = Views(
        names, images, np.stack(mattes), nothing, *map(np.stack, (k, poses)), nothing[:, 0, 0], sparse, tracks
    )

    def right(depths):
        found = []
        for view, panel, depth in zip(photos, panels, depths):
            true = view.project(view.centre + (places_of(view)[panel] - view.centre) * ((2.0 - height) / 2.0))[1]
            found.append((np.abs(depth[panel] / true - 1) < 0.05).mean())
        return min(found)

    # The panel is small, and its rim lies too near the mask.
    assert right(sparse_depths(views)) == 0 and right(sparse_depths(with_stereo(views))) > 0.15
