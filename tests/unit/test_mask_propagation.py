"""Masks from clicks in one photo: a planted ball, sparse points on it and around it, photos on a circle."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.planted_ball import (
    HEIGHT,
    MIDDLE,
    PHOTOS,
    WIDTH,
    BallNetwork,
    clicks,
    photos_of_a_ball,
    planted_view,
    true_mask,
)

from scenefuse.core.stage import StageError
from scenefuse.geometry.visual_hull import mask_iou, silhouette
from scenefuse.masks import segmentation
from scenefuse.masks.grabcut import along_edges, grow_seeds, query_grabcut
from scenefuse.masks.prompts import NO_PIXELS, Prompts, far_apart, overlap
from scenefuse.masks.propagation import NO_CLICKS, best_mask, one_photo, propagate
from scenefuse.masks.sam2 import query_sam2
from scenefuse.masks.segmentation import (
    MaskSettings,
    carve_consistent,
    score_masks,
    segment_again,
    segment_by_grabcut,
)
from scenefuse.masks.target import target_from_votes
from scenefuse.masks.votes import Voter, known_pixels, known_points, voter_of
from scenefuse.photos.workspace import Workspace

COARSE = MaskSettings(grabcut_width_px=120, hull_voxels=40)


@pytest.fixture(scope="module")
def photos():
    return photos_of_a_ball()


class PlantedNetwork:
    """Answers with the true mask and half of it, or with all the rest for photos that it is to get wrong."""

    def __init__(self, wrong=(), quality=0.9):
        self.wrong, self.quality, self.asked = dict.fromkeys(wrong, 0), quality, []

    def __call__(self, view, prompts, box):
        self.asked.append(view.name)
        mask = true_mask(view)
        if view.name in self.wrong:
            return [~mask], np.array([self.quality])
        half = mask & (np.arange(WIDTH) < WIDTH / 2)
        return [half, mask], np.array([0.9, 0.8])


def test_one_click_goes_round_both_ways(photos):
    network = PlantedNetwork()
    carried = propagate(network, photos, {3: clicks([MIDDLE, (70, 45)])}, 2)
    assert all(mask_iou(m, true_mask(v)) == 1 for m, v in zip(carried.masks, photos.views))
    assert network.asked[0] == "f03.png" and network.asked[1] in ("f02.png", "f04.png")
    # Both ways: the last one is opposite.
    assert network.asked[-1] in ("f08.png", "f09.png", "f10.png")
    assert len(network.asked) == PHOTOS and not carried.reasons and not carried.left_out
    counted = np.bincount(np.concatenate(photos.seen), minlength=1200) >= 5
    assert (carried.kind[:600][counted[:600]] >= 0).all() and (carried.kind[600:] <= 0).all()
    assert (carried.kind[:600] == 1).sum() > 300 and (carried.kind[600:] == -1).sum() > 50


@pytest.mark.parametrize("quality", [0.95, 0.2])
def test_a_mask_that_is_bad_or_disagrees_does_not_vote_and_the_round_goes_on(photos, quality):
    network = PlantedNetwork(wrong=["f05.png"], quality=quality)
    carried = propagate(network, photos, {3: clicks([MIDDLE, (70, 45)])}, 2)
    assert list(carried.reasons) == ["f05.png"] and not carried.masks[5].any()
    assert "f05.png" in network.asked[6:]
    for k in set(range(PHOTOS)) - {5}:
        assert mask_iou(carried.masks[k], true_mask(photos.views[k])) == 1
    assert (carried.kind[600:] <= 0).all()


def test_low_quality_ends_nothing_where_a_mask_agrees_with_the_clicks(photos):
    """A balcony whose whole the network rates lowest of the three."""

    def segment(view, prompts, box):
        mask = true_mask(view)
        return [mask & (np.arange(WIDTH) < 55), mask, ~mask], np.array([0.51, 0.36, 0.55])

    found = propagate(segment, photos, {3: clicks([MIDDLE, (70, 45), (50, 40)], [(60, 80)])}, 2)
    assert all(mask_iou(m, true_mask(v)) == 1 for m, v in zip(found.masks, photos.views))
    assert not found.reasons and set(found.quality.values()) == {0.36}


def test_parts_without_a_prompt_are_not_the_object(photos):
    def segment(view, prompts, box):
        mask = true_mask(view)
        mask[5:25, 5:25] = True
        return [mask], np.ones(1)

    carried = propagate(segment, photos, {0: clicks([MIDDLE])}, 2)
    assert all(mask_iou(m, true_mask(v)) == 1 for m, v in zip(carried.masks, photos.views))


def test_by_overlap_a_part_of_a_house_beats_the_house_around_it(photos):
    view = photos.views[0]
    part = hat(view)
    house = true_mask(view) | part
    house[15:45, 60:100] = True
    on, off = np.argwhere(part)[::5, ::-1] + 0.5, np.argwhere(true_mask(view))[::200, ::-1] + 0.5
    ground = np.argwhere(np.arange(HEIGHT)[:, None] > np.full(WIDTH, 72))[::4, ::-1] + 0.5
    known = Prompts(known=on, known_off=np.concatenate([off, ground]))

    def segment(view, prompts, box):
        return [part, house], np.array([0.5, 0.9])

    large, _, _ = best_mask(segment, view, known, None, 0)
    small, _, _ = best_mask(segment, view, known, None, 0, overlap)
    assert large.sum() > 3 * part.sum() and mask_iou(small, part) > 0.9


def test_contradictory_clicks_are_named_all_at_once_and_left_out(photos):
    wrong = clicks([MIDDLE, (70, 45), (100, 45), (60, 80)], [(50, 45)])
    carried = propagate(PlantedNetwork(), photos, {3: wrong}, 2)
    assert len(carried.left_out) == 3
    assert "click inside at (100, 45) in f03.png is 18 px" in carried.left_out[0]
    assert "click inside at (60, 80)" in carried.left_out[1] and "click outside at (50, 45)" in carried.left_out[2]
    assert mask_iou(carried.masks[3], true_mask(photos.views[3])) == 1
    # As a person clicked it, before the photo was undistorted.
    again = propagate(PlantedNetwork(), photos, {3: replace(wrong, original=2 * wrong.pixels + 0.5)}, 2)
    assert "click inside at (200.5, 90.5) in f03.png is 18 px" in again.left_out[0]
    # Within the tolerance nothing contradicts.
    assert not propagate(PlantedNetwork(), photos, {3: clicks([MIDDLE, (84, 45)])}, 4).left_out


def test_too_few_clicks_left_is_an_error_that_names_them(photos):
    with pytest.raises(StageError, match=r"no clicked photo has a good mask .*f03\.png: agreement .*\(100, 45\)"):
        propagate(PlantedNetwork(), photos, {3: clicks([(100, 45), (10, 10)])}, 2)


def test_an_object_that_fills_its_only_clicked_photo_is_named_where_grabcut_sees_nothing_else():
    photos = photos_of_a_ball()
    whole = clicks([MIDDLE, (50, 40), (70, 50)], box=[[0, 0], [WIDTH, HEIGHT]])
    with pytest.raises(StageError, match=r"f00\.png: agreement .*, the mask empty or all of the photo\)"):
        propagate(partial(query_grabcut, WIDTH), photos, {0: whole}, 4)


def test_a_mask_that_agrees_with_some_clicks_only_is_used_and_said_where_there_is_no_better(photos):
    def segment(view, prompts, box):
        # Without the click that contradicts this mask, the next one lacks another click.
        return [true_mask(view) & (np.arange(WIDTH) > (0 if len(prompts.clicked) == 4 else 56))], np.ones(1)

    found = propagate(segment, photos, {3: clicks([(50, 45), (60, 45), (62, 47), (100, 45)])}, 0)
    assert found.masks[3].any() and len(found.left_out) > 0
    assert "f03.png agrees with 0.75 of its clicks" in found.notes[0] and "correct or add clicks" in found.notes[0]


def test_a_further_click_that_the_mask_holds_changes_nothing(photos):
    asked = []

    def segment(view, prompts, box):
        asked.append(len(prompts.clicked))
        return [true_mask(view) & (np.arange(WIDTH) > (57 if len(prompts.clicked) > 3 else 0))], np.ones(1)

    own = clicks([(50, 45), (60, 45), (55, 45), (61, 45)], [(5, 5)])
    mask, _, _, left_out = one_photo(segment, photos.views[3], own, 0)
    assert np.array_equal(mask, true_mask(photos.views[3])) and asked == [3] and not left_out


def test_a_further_click_counts_where_its_mask_holds_more_of_the_clicks(photos):
    def segment(view, prompts, box):
        spoilt = true_mask(view) & (np.arange(WIDTH) < 55)
        whole = true_mask(view) | hat(view)
        return [
            spoilt if (prompts.clicked_off[:, 0] < 90).any() else true_mask(view) if len(prompts.clicked_off) else whole
        ], np.ones(1)

    view, inside = photos.views[3], [(50, 45), (60, 45), (62, 47)]
    mask, _, _, left_out = one_photo(segment, view, clicks(inside, [(100, 20)]), 0)
    assert np.array_equal(mask, true_mask(view)) and not left_out
    # By mistake on the object: with it two of the clicks inside are off the mask.
    mask, _, _, left_out = one_photo(segment, view, clicks(inside, [(65, 45), (100, 20)]), 0)
    assert np.array_equal(mask, true_mask(view))
    assert ["the click outside at (65, 45) in f03.png is" in note for note in left_out] == [True]


def test_a_box_prompts_sam2_only_where_the_clicks_are_too_few(photos):
    network, own, box = (
        BallNetwork(photos),
        np.array([(50.0, 45), (60, 45), (62, 47)]),
        np.array([(56.0, 20), (90, 70)]),
    )
    query_sam2(network, photos.views[3], Prompts(own[:2]), box)
    query_sam2(network, photos.views[3], Prompts(own), box)
    assert [given is not None for _, _, given, _ in network.prompts] == [True, False]


def test_clicks_on_two_objects_and_a_mask_of_most_of_the_photo_are_said(photos):
    def two(view, prompts, box):
        return [true_mask(view) | hat(view)], np.ones(1)

    found = propagate(two, photos, {3: clicks([MIDDLE, (70, 45), (100, 20)])}, 2)
    assert ["2 parts of its mask that do not touch" in note for note in found.notes] == [True]

    def most(view, prompts, box):
        return [
            true_mask(view) if view.name != "f03.png" else np.arange(HEIGHT)[:, None] > np.full(WIDTH, 20)
        ], np.ones(1)

    found = propagate(most, photos, {3: clicks([MIDDLE, (70, 45), (50, 45)])}, 2)
    assert [note[:44] for note in found.notes] == ["the mask from the clicks in f03.png covers 77"[:44]]


def test_clicks_in_a_further_photo_prompt_that_photo(photos):
    told = {}

    def segment(view, prompts, box):
        told[view.name] = prompts.clicked, prompts.clicked_off
        return [true_mask(view)], np.ones(1)

    propagate(segment, photos, {3: clicks([MIDDLE, (70, 45)]), 8: clicks([(55, 40)], [(10, 10)])}, 2)
    assert told["f08.png"][0].tolist() == [[55, 40]] and told["f08.png"][1].tolist() == [[10, 10]]
    assert len(told["f03.png"][0]) == 2 and not len(told["f07.png"][0])


def hat(view):
    """A disc beside the ball."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.hypot(u - 100, v - 20) < 8


def ask_for_the_clearest(view, prompts, box):
    """The ball if anything on it prompts, else the disc, else everything around both."""
    mask, part, at = true_mask(view), hat(view), prompts.inside.astype(int)
    there = mask if mask[at[:, 1], at[:, 0]].any() else part if part[at[:, 1], at[:, 0]].any() else ~(mask | part)
    return [there], np.array([0.9])


def test_a_part_that_the_network_prefers_to_leave_out_is_asked_for_alone(photos):
    view = photos.views[0]
    whole = true_mask(view) | hat(view)
    mask, _, agreement, notes = one_photo(ask_for_the_clearest, view, clicks([MIDDLE, (100, 20)]), 2)
    assert (mask == whole).all() and agreement == 1 and not notes
    # Not what a click outside says, and nothing that is larger than the object.
    for inside, outside in (([MIDDLE, (100, 20)], [(101, 21), (99, 19)]), ([MIDDLE, (5, 5)], [])):
        mask, _, _, notes = one_photo(ask_for_the_clearest, view, clicks(inside, outside), 2)
        assert (mask == true_mask(view)).all() and "click inside" in notes[0]


def test_what_the_objects_points_enclose_is_never_said_to_be_outside():
    points = np.concatenate([np.random.default_rng(0).uniform(-1, 1, (300, 3)), [[0, 0, 0.1], [0.1, 0, 0], [5, 5, 5]]])
    views, empty = [planted_view(0)] * 3, np.zeros((HEIGHT, WIDTH), dtype=bool)
    photos = Workspace(Path(), views, points, [], [])

    def known(votes):
        rows = np.arange(303)
        return known_points(photos, dict.fromkeys(range(votes), Voter(empty, 0.9, 1.0, rows, rows < 300, NO_CLICKS)))

    assert (known(3)[:300] == 1).all() and known(3)[300:].tolist() == [0, 0, -1]
    # By one or two masks nothing is enclosed.
    assert known(2)[300:].tolist() == [-1, -1, -1]
    # Points by stereo are dense: those that a first mask lacks do not outweigh it.
    photos = replace(photos, points=np.concatenate([points[200:], points[:200] / 4]), by_stereo=200)
    voter = Voter(empty, 0.9, 1.0, np.arange(303), np.arange(303) < 100, NO_CLICKS)
    assert known_points(photos, dict.fromkeys(range(3), voter))[100:].tolist() == [0, 0, -1] + [0] * 200


def test_what_is_farther_off_than_the_object_is_large_is_not_known_to_be_its_own(photos):
    """All photos' masks hold points of the shell, twelve radii away, wherever they see them."""

    def known(masks):
        voters = {
            k: Voter(mask, 0.9, 1.0, photos.seen[k], photos.seen[k] < 700, NO_CLICKS) for k, mask in enumerate(masks)
        }
        kind = known_points(photos, voters)
        return kind[:600], kind[600:700][np.isin(np.arange(600, 700), np.concatenate(photos.seen))]

    ball, shell = known([true_mask(view) for view in photos.views])
    assert (ball[np.unique(np.concatenate(photos.seen)[np.concatenate(photos.seen) < 600])] == 1).all()
    assert len(shell) and (shell == 0).all()
    # Where masks end with their photos, nobody knows how large it is.
    ball, shell = known([np.ones((HEIGHT, WIDTH), dtype=bool)] * PHOTOS)
    assert (shell == 1).all()


def test_a_click_outside_counts_in_all_photos_whatever_their_masks_hold(photos):
    """All other photos' masks hold what stands beside the ball, where one photo has a click outside."""
    at, rows = photos.seen_at[3], photos.seen[3]
    beside = int(np.argmin(np.where(rows >= 600, np.linalg.norm(at - [60, 80], axis=1), np.inf)))
    others = {
        k: voter_of(photos, k, np.ones((HEIGHT, WIDTH), dtype=bool), 0.9, 1.0, NO_CLICKS)
        for k in range(PHOTOS)
        if k != 3
    }
    own = voter_of(photos, 3, true_mask(photos.views[3]), 0.9, 1.0, clicks([MIDDLE], [at[beside]]))
    assert known_points(photos, others)[rows[beside]] == 1
    assert known_points(photos, {**others, 3: own})[rows[beside]] == -1
    # There it prompts each photo that sees the point, as a click.
    shown = [k for k in others if rows[beside] in photos.seen[k]]
    for k in others:
        found = known_pixels(photos, k, {row: voter for row, voter in others.items() if row != k} | {3: own})
        place = photos.seen_at[k][photos.seen[k] == rows[beside]]
        assert found.clicked_off.tolist() == place.tolist() or k not in shown
    # Points nearer to the mask than to the click are not denied.
    near = voter_of(photos, 3, true_mask(photos.views[3]), 0.9, 1.0, clicks([MIDDLE], [[2.0, 2.0]]))
    assert all((np.linalg.norm(at[rows == row] - [2, 2], axis=1) < 40).all() for row in near.denied[0])


def test_no_other_photo_overrules_three_clicks(photos):
    """In the clicked photo the network takes the left half for the object, in all others the whole."""

    def segment(view, prompts, box):
        mask = true_mask(view)
        return [mask & (np.arange(WIDTH) < 60) if view.name == "f03.png" else mask], np.array([0.9])

    told = clicks([(50, 45), (45, 40), (52, 50)])
    found = propagate(segment, photos, {3: told}, 2)
    half = true_mask(photos.views[3]) & (np.arange(WIDTH) < 60)
    assert (found.masks[3] == half).all()
    network = BallNetwork(photos)
    masks = [half if k == 3 else true_mask(view) for k, view in enumerate(photos.views)]
    again = segment_again(network, of_points(photos), masks, photos, COARSE, {3: told})
    assert "f03.png" not in {name for name, *_ in network.prompts} and mask_iou(again[3], half) > 0.9
    # It is reported, but stays.
    for names, dropped in (((), ["f03.png"]), (("f03.png",), [])):
        settings = replace(COARSE, min_agreement=0.7)
        assert list(score_masks(masks, of_points(photos), photos.views, settings, names).dropped) == dropped


@pytest.mark.parametrize(("quality", "count", "whole"), [(0.7, 3, True), (0.7, 2, False), (0.95, 3, False)])
def test_of_masks_about_as_good_for_several_clicks_the_largest_is_taken_unless_one_is_certain(
    photos, quality, count, whole
):
    ball, view = true_mask(photos.views[3]), photos.views[3]
    part = ball & (np.arange(WIDTH) < 75)

    def segment(view, prompts, box):
        return [part, ball, ~ball], np.array([quality, quality - 0.1, 0.1])

    told = clicks([MIDDLE, (50, 45), (65, 50)][:count])
    mask, *_ = one_photo(segment, view, told, 2)
    assert (mask == (ball if whole else part)).all()


def test_a_click_that_missed_the_outline_is_no_part(photos):
    view = photos.views[0]
    edge = int(np.flatnonzero(true_mask(view)[45]).max())

    def segment(view, prompts, box):
        at = prompts.inside.astype(int)
        beside = np.zeros_like(true_mask(view))
        beside[43:48, edge + 1 : edge + 6] = True
        return [true_mask(view) if true_mask(view)[at[:, 1], at[:, 0]].any() else beside], np.array([0.9])

    assert (one_photo(segment, view, clicks([MIDDLE, (edge + 3, 45)]), 4)[0] == true_mask(view)).all()
    assert one_photo(segment, view, clicks([MIDDLE, (edge + 3, 45)]), 1)[0][45, edge + 3]


def test_a_click_on_a_part_beats_what_other_photos_say_of_it(photos):
    """The points behind the disc are no object's for all other photos."""
    carried = propagate(ask_for_the_clearest, photos, {0: clicks([MIDDLE]), 1: clicks([MIDDLE, (100, 20)])}, 2)
    assert (carried.masks[1] == (true_mask(photos.views[1]) | hat(photos.views[1]))).all() and not carried.left_out
    assert all((carried.masks[k] == true_mask(photos.views[k])).all() for k in range(PHOTOS) if k != 1)


def test_a_photo_with_clicks_comes_as_soon_as_enough_is_known_of_it(photos):
    network = PlantedNetwork()
    propagate(network, photos, {3: clicks([MIDDLE, (70, 45)]), 6: clicks([MIDDLE])}, 2)
    assert network.asked.index("f06.png") <= 2


def test_a_photo_that_looks_away_is_named_and_does_not_end_the_round(photos):
    turned = photos.views[9].cam_from_world.copy()
    turned[:3] = np.diag([1.0, -1.0, -1.0]) @ turned[:3]
    views = [replace(view, cam_from_world=turned) if k == 9 else view for k, view in enumerate(photos.views)]
    rows = [r[:0] if k == 9 else r for k, r in enumerate(photos.seen)]
    away = replace(photos, views=views, seen=rows, seen_at=[at[: len(r)] for r, at in zip(rows, photos.seen_at)])
    carried = propagate(PlantedNetwork(), away, {3: clicks([MIDDLE, (70, 45)])}, 2)
    assert list(carried.reasons) == ["f09.png"] and mask_iou(carried.masks[8], true_mask(photos.views[8])) == 1


@pytest.mark.parametrize(
    "prompts", [clicks([MIDDLE, (50, 35), (70, 55)], [(100, 45)]), clicks([], [], [[36, 21], [84, 69]])]
)
def test_grabcut_goes_round_from_clicks_or_a_box(photos, prompts):
    some = photos.subset([0, 1, 2, 11])
    carried = propagate(lambda *asked: query_grabcut(120, *asked), some, {0: prompts}, 3)
    assert min(mask_iou(m, true_mask(v)) for m, v in zip(carried.masks, some.views)) > 0.95


def test_sam2_is_told_every_click_and_a_few_carried_points_near_the_object(photos):
    class Network:
        told = []

        def encode(self, image):
            return None

        def masks(self, features, size, points_px, box, outside_px=NO_PIXELS):
            self.told.append((points_px, box, outside_px))
            return [len(points_px)], np.ones(1)

    network, generator = Network(), np.random.default_rng(0)
    clicked, carried = generator.uniform(40, 60, (12, 2)), generator.uniform(40, 60, (50, 2))
    off = np.concatenate([generator.uniform(62, 64, (20, 2)), [[119.0, 89.0]]])
    answers, qualities = query_sam2(network, photos.views[0], Prompts(clicked, known=carried, known_off=off), None)
    assert np.array_equal(network.told[0][0], clicked) and network.told[0][1] is None
    assert len(network.told[0][2]) == 6 and network.told[0][2].max() < 65
    # Once more from a few in the middle and the box: on all ends of an object the network is sure of nothing.
    everywhere = np.concatenate([clicked, carried])
    assert (network.told[1][1][0] < everywhere.min(0)).all() and (network.told[1][1][1] > everywhere.max(0)).all()
    assert answers == [12, 4] and len(qualities) == 2
    assert np.abs(network.told[1][0] - 50).max() < np.abs(network.told[0][0] - 50).max()
    query_sam2(network, photos.views[0], Prompts(clicked[:3], known=carried, known_off=off), None)
    assert len(network.told[2][0]) == 10 and np.array_equal(network.told[2][0][:3], clicked[:3])
    assert query_sam2(network, photos.views[0], Prompts(clicked[:3], known_off=off), None)[0] == [3]
    drawn = np.array([[30.0, 20], [90, 70]])
    del network.told[:]
    query_sam2(network, photos.views[0], Prompts(clicked[:2], known_off=off), drawn)
    assert [box.tolist() for _, box, _ in network.told] == [drawn.tolist()]


def test_far_apart_points_stop_when_all_are_chosen():
    points = np.array([[0, 0], [1, 0], [10, 0], [1, 0.0]])
    assert far_apart(NO_PIXELS, points, 2).tolist() == [[0, 0], [10, 0]]
    assert len(far_apart(NO_PIXELS, points, 9)) == 3
    assert far_apart(points[:1], NO_PIXELS, 3).tolist() == [[0, 0]]


def of_points(photos):
    """Where the ball is, by the points on it and on the shell around."""
    kind = np.where(np.arange(len(photos.points)) < 600, 1, -1).astype(np.int8)
    return target_from_votes(kind, photos, np.array([0, 0, 1.0]), 0)


@pytest.mark.slow
def test_clicks_count_in_their_own_photo_to_the_end_with_grabcut(photos):
    told = {2: clicks([], [], [[30, 15], [90, 45]])}
    plain, corrected = (segment_by_grabcut(of_points(photos), photos, COARSE, clicked) for clicked in ({}, told))
    assert plain[2][60:].any() and not corrected[2][50:].any() and corrected[2][30, 60]
    assert mask_iou(corrected[7], plain[7]) > 0.95


def test_a_small_part_that_was_clicked_stays_with_grabcut_too(photos):
    view = photos.views[2]
    pixels = view.pixels.copy()
    pixels[80:85, 58:63] = (190, 60, 50)
    marked = replace(photos, views=[*photos.views[:2], replace(view, pixels=pixels), *photos.views[3:]])
    told = {2: clicks([MIDDLE, (60.5, 82.5)])}
    found = segment_by_grabcut(of_points(marked), marked, COARSE, told)[2]
    assert found[82, 60] and mask_iou(found[:75], true_mask(view)[:75]) > 0.9


def test_clicks_and_box_prompt_their_own_photo_again_with_sam2(photos):
    network = BallNetwork(photos)
    masks = [true_mask(view) for view in photos.views]
    masks[8] = np.zeros_like(masks[8])
    told = {8: clicks([MIDDLE], [(100.0, 80.0)], [[30, 15], [90, 75]]), 3: clicks([MIDDLE])}
    segment_again(network, of_points(photos), masks, photos, COARSE, told)
    ((name, inside, box, outside),) = network.prompts
    assert name == "f08.png" and inside[0].tolist() == list(MIDDLE) and len(inside) == 5
    assert outside.tolist() == [[100, 80]] and box.tolist() == [[30, 15], [90, 75]]


def test_a_mask_made_again_is_not_taken_where_it_holds_what_other_masks_leave_out(photos):
    """What the masks that agree see now goes before the first masks' votes, which stand where those see nothing."""
    lower = np.arange(HEIGHT)[:, None] > HEIGHT / 2
    blind = replace(
        photos,
        seen=[rows if k == 8 else rows[:0] for k, rows in enumerate(photos.seen)],
        seen_at=[at if k == 8 else at[:0] for k, at in enumerate(photos.seen_at)],
    )
    for vote, others, seen, taken in (
        (-1, True, photos, True),
        (1, lower, photos, False),
        (-1, True, blind, False),
        (1, True, blind, True),
    ):
        votes = np.full(len(photos.points), vote, np.int8)
        masks = [true_mask(view) & (others if k != 8 else False) for k, view in enumerate(photos.views)]
        again = segment_again(BallNetwork(photos), of_points(photos), masks, seen, COARSE, votes=votes)
        assert again[8].any() == taken


def test_where_most_masks_agree_on_nothing_the_hull_grows_from_the_clicked_one(photos):
    u, v = np.meshgrid(np.arange(WIDTH) - WIDTH / 2, np.arange(HEIGHT) - HEIGHT / 2)
    masks = [true_mask(view) for view in photos.views]
    for k in range(5, PHOTOS):
        masks[k] = np.hypot(u - 18 * np.cos(2 * k), v - 18 * np.sin(2 * k)) < 6
    carved = partial(carve_consistent, of_points(photos), photos.views, masks, COARSE, 0.1)
    with pytest.raises(StageError, match="no common object"):
        carved()
    hull = carved((photos.views[2].name,))
    assert all(mask_iou(silhouette(hull, view), true_mask(view)) > 0.9 for view in photos.views[:5])


def test_masks_are_made_again_by_the_hull_of_those_that_were_made_again(photos, monkeypatch):
    rounds = []

    def carved(target, views, masks, *rest):
        rounds.append([mask.any() for mask in masks])
        return carve_consistent(target, views, masks, *rest)

    monkeypatch.setattr(segmentation, "carve_consistent", carved)
    masks = [true_mask(view) for view in photos.views]
    segment_again(BallNetwork(photos), of_points(photos), masks, photos, COARSE)
    assert len(rounds) == 1  # nothing to make again
    masks[8] = np.zeros_like(masks[8])
    segment_again(BallNetwork(photos), of_points(photos), masks, photos, COARSE)
    assert len(rounds) == 3 and not rounds[1][8] and rounds[2][8]


def test_a_part_with_the_background_s_colour_is_found_from_a_click_by_the_edge_around_it():
    pixels = np.full((120, 160, 3), (120, 100, 80), np.uint8)
    pixels[20:60, 50:110] = (200, 60, 50)
    basket = np.zeros((120, 160), bool)
    basket[64:84, 70:92] = True
    pixels[62:86, 68:94] = (30, 25, 20)
    pixels[basket] = (120, 100, 80)
    trimap = np.full((120, 160), cv2.GC_PR_BGD, np.uint8)
    trimap[:10], trimap[95:] = cv2.GC_BGD, cv2.GC_BGD
    for x, y in ((80, 40), (81, 74)):
        cv2.circle(trimap, (x, y), 2, cv2.GC_FGD, -1)
    grow_seeds(pixels, trimap, 160)
    sure = trimap == cv2.GC_FGD
    assert sure[basket].mean() > 0.9 and sure[22:58, 52:108].mean() > 0.95
    assert not sure[:, :45].any() and not sure[:, 115:].any() and not sure[86:].any()
    alone = np.full((120, 160), cv2.GC_PR_BGD, np.uint8)
    grow_seeds(pixels, alone, 160)
    assert (alone == cv2.GC_PR_BGD).all()


def test_a_coarse_mask_is_moved_to_the_edges_of_its_photo_and_no_farther():
    pixels = np.full((120, 160, 3), (200, 205, 210), np.uint8)
    pixels[20:100, 50:110] = (40, 60, 50)
    pixels[5:20, 78:82] = (40, 60, 50)
    truth = pixels[..., 0] < 100
    coarse = np.zeros_like(truth)
    coarse[23:97, 53:113] = True
    assert mask_iou(coarse, truth) < 0.9
    sharp = along_edges(pixels, coarse, 5.0, 160)
    assert mask_iou(sharp[20:], truth[20:]) > 0.99
    # The pole reaches farther than the band.
    assert not sharp[:15].any() and not along_edges(pixels, np.zeros_like(truth), 5.0, 160).any()


def test_a_small_part_that_was_asked_for_stays_and_specks_that_the_edges_leave_do_not(photos):
    """A basket below a balloon, on ropes that no photo shows."""
    views = []
    for view in photos.views:
        pixels = view.pixels.copy()
        pixels[80:84, 58:62] = (190, 60, 50)
        views.append(replace(view, pixels=pixels))
    marked = replace(photos, views=views)
    masks = [true_mask(view) for view in views]
    assert masks[0][80:84, 58:62].all() and masks[0][80:84, 58:62].sum() < 0.02 * masks[0].sum()
    found = segment_again(BallNetwork(marked), of_points(marked), masks, marked, COARSE)
    assert all(mask[80:84, 58:62].sum() >= 8 for mask in found)
