"""Points by coarse stereo, which carry parts without features from photo to photo."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.photographed_plane import BLANK, photographs

from scenefuse.geometry.visual_hull import mask_iou
from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.parts import with_parts
from scenefuse.masks.propagation import best_mask, carry
from scenefuse.masks.space import Left
from scenefuse.masks.stereo_points import with_stereo_points
from scenefuse.masks.votes import Known, known_points, voter_of
from scenefuse.photos.workspace import View, Workspace

NO_CLICKS = PhotoClicks(np.zeros((0, 2)), np.zeros(0, dtype=bool))


@pytest.fixture(scope="module")
def plane():
    """Photos of the painted plane, with sparse points where y < 0 alone."""
    views = [replace(view, pixels=np.dstack([view.pixels] * 3)) for view in photographs(6, 4.0, size=160)]
    rng = np.random.default_rng(0)
    sparse = np.column_stack([rng.uniform([-2, -2], [BLANK, 0], (250, 2)), np.zeros(250)])
    rows = [view.visible(sparse)[0] for view in views]
    return Workspace(Path(), views, sparse, rows, [v.project(sparse[r])[0] for v, r in zip(views, rows)])


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


def test_stereo_adds_points_where_there_are_none_and_only_on_what_has_texture(plane):
    more = with_stereo_points(plane)
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


def test_photos_that_stereo_cannot_match_are_left_as_they_are(plane, capsys):
    alone = plane.subset([0])
    assert with_stereo_points(alone) is alone and "no points by stereo" in capsys.readouterr().out


def test_points_by_stereo_say_what_is_the_object_and_never_what_is_not(plane):
    more, sparse = with_stereo_points(plane), len(plane.points)
    lacking = voter_of(more, 0, disc(more.views[0], 0.5), 0.9, 1.0, NO_CLICKS)
    kind, _ = known_points(more, {0: lacking})
    assert (kind[:sparse] == -1).any() and (kind[sparse:] == 1).any() and not (kind[sparse:] == -1).any()


def test_a_part_without_features_is_carried_by_stereo_though_the_network_is_surer_of_the_rest(plane):
    def ask(view, inside, outside, box, likely):
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
    carried = carry(ask, few, told, 2)
    assert mask_iou(carried.masks[1], disc(few.views[1])) < 0.8
    carried = carry(ask, with_stereo_points(few), told, 2)
    assert all(mask_iou(m, disc(v)) > 0.99 for m, v in zip(carried.masks, few.views))


@pytest.mark.parametrize(("like", "added"), [("mask", True), ("surroundings", False)])
def test_a_part_that_looks_like_what_is_around_it_is_added_only_if_it_was_clicked(like, added):
    rng = np.random.default_rng(0)
    mask, part = np.zeros((120, 160), dtype=bool), np.zeros((120, 160), dtype=bool)
    mask[40:80, 30:80] = True
    part[50:70, 80:100] = True
    colors = {"mask": (150, 80, 60), "surroundings": (120, 160, 220)}
    image = np.where((mask | (part if like == "mask" else False))[..., None], colors["mask"], colors["surroundings"])
    image = (image + rng.integers(-20, 20, image.shape)).astype(np.uint8)
    view = View("a.jpg", np.eye(3), np.eye(4), 160, 120, image)

    def ask(*_):
        return [part], np.array([0.9])

    on = np.column_stack([rng.uniform(82, 98, 6), rng.uniform(52, 68, 6)])
    of_mask, none = np.column_stack([rng.uniform(32, 78, 20), rng.uniform(42, 78, 20)]), np.zeros((0, 2))
    carried = with_parts(ask, view, mask, (none, np.concatenate([of_mask, on])), (none, none), none, 2.0)
    assert (carried == (mask | part if added else mask)).all()
    clicked = with_parts(ask, view, mask, (on, of_mask), (none, none), none, 2.0)
    assert (clicked == mask | part).all()


def test_a_part_that_goes_far_beyond_the_points_next_to_an_outline_is_not_added():
    mask, part, none = np.zeros((120, 160), dtype=bool), np.zeros((120, 160), dtype=bool), np.zeros((0, 2))
    mask[40:80, 30:80] = True
    part[45:75, 80:130] = True
    view = View("a.jpg", np.eye(3), np.eye(4), 160, 120, np.full((120, 160, 3), 100, np.uint8))
    rng = np.random.default_rng(0)
    for farthest, added in ((90, False), (125, True)):
        on = np.column_stack([np.linspace(82, farthest, 12), rng.uniform(56, 64, 12)])
        known = np.concatenate([np.column_stack([rng.uniform(32, 78, 20), rng.uniform(42, 78, 20)]), on])
        found = with_parts(lambda *_: ([part], np.array([0.9])), view, mask, (none, known), (none, none), none, 2.0)
        assert (found == (mask | part if added else mask)).all()


@pytest.mark.parametrize(
    ("quality", "like", "tight", "added"),
    [
        (0.95, "around", False, False),
        (0.95, "rather around", False, False),
        (0.95, "object", False, True),
        (0.95, "around", True, True),
        (0.6, "around", False, True),
    ],
)
def test_a_loose_space_adds_to_a_mask_that_the_network_is_certain_of_only_what_looks_like_it(
    quality, like, tight, added
):
    """Of a side that few photos show, the space holds much of what is around: a marble head got its pedestal."""
    head, stand, view, known = head_on_a_stand(like)

    def ask(view, inside, outside, box, likely):
        return ([head], np.array([quality])) if likely is None else ([head | stand], np.array([0.9]))

    space = head | stand if tight else np.ones_like(head)
    mask, *_ = best_mask(ask, view, NO_CLICKS, known, None, 2.0, Left(space, np.ones_like(head)))
    assert (mask == (head | stand if added else head)).all()


def test_the_space_cuts_what_leaked_from_a_mask_that_the_network_is_certain_of():
    """Also where the cut mask has another seam, whose pixels look like what is around."""
    head, stand, view, known = head_on_a_stand("around")
    wider = np.zeros_like(head)
    wider[19:80, 29:71] = True

    def ask(view, inside, outside, box, likely):
        return ([head | stand], np.array([0.95])) if likely is None else ([wider], np.array([0.95]))

    mask, *_ = best_mask(ask, view, NO_CLICKS, known, None, 2.0, Left(head, np.ones_like(head)))
    assert (mask == wider).all()


def head_on_a_stand(like):
    """Masks of both, a photo in which the stand's colours are the object's or those around, and points on the head."""
    rng, object_, around = np.random.default_rng(0), np.array([150, 110, 80]), np.array([90, 95, 105])
    head, stand = np.zeros((2, 120, 100), dtype=bool)
    head[20:80, 30:70], stand[80:100, 20:80] = True, True
    pixels = np.broadcast_to(around, (120, 100, 3)).copy()
    pixels[head] = object_
    if like != "around":
        pixels[stand] = object_
    if like == "rather around":
        # Some of both, so that their mean decides.
        pixels[stand & (rng.random(stand.shape) < 0.7)] = around
    noisy = np.clip(pixels + rng.normal(0, 3, pixels.shape), 0, 255).astype(np.uint8)
    inside = np.column_stack([rng.uniform(32, 68, 20), rng.uniform(22, 78, 20)])
    nothing = np.zeros((0, 2))
    return head, stand, View("a.jpg", np.eye(3), np.eye(4), 100, 120, noisy), Known(inside, nothing, nothing)
