"""Clicks as they are edited: what is refused, and merging with another page's."""

import pytest

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import Click, label_name
from scenefuse.pick.document import point_name, problems, with_box, with_label, with_length, with_point, without_nearest

SIZES = {"a.jpg": (100, 50), "Füße 2.jpg": (100, 50)}
HEAD = Click("inside", "a.jpg", 10, 20)
SKY = Click("outside", "a.jpg", 90, 5)
BOX = (Click("box", "a.jpg", 1, 2), Click("box", "a.jpg", 30, 40))


def test_a_click_is_kept_to_a_tenth_of_a_pixel():
    assert with_label((), "inside", "Füße 2.jpg", 10.04, 20.06, SIZES) == (Click("inside", "Füße 2.jpg", 10.0, 20.1),)


@pytest.mark.parametrize("place", [(-0.5, 10), (10, -1), (100.5, 10), (10, 51)])
def test_a_click_outside_the_photo_is_refused(place):
    with pytest.raises(StageError, match="outside a.jpg, which has 100 x 50"):
        with_label((), "inside", "a.jpg", *place, SIZES)


@pytest.mark.parametrize("label", ["inside", "outside"])
def test_the_same_place_twice_is_refused(label):
    with pytest.raises(StageError, match="already marked inside"):
        with_label((HEAD,), label, "a.jpg", 10.01, 20, SIZES)


def test_a_box_is_cut_to_the_photo_and_takes_the_place_of_the_former_one():
    rows = with_box((HEAD, *BOX), "a.jpg", ((120, 45), (50, -3)), SIZES)
    assert rows == (HEAD, Click("box", "a.jpg", 50, 0), Click("box", "a.jpg", 100, 45))


@pytest.mark.parametrize(("corners", "size"), [(((120, 10), (150, 40)), (100, 50)), (((20, 10), (30, 40)), (6000, 50))])
def test_a_box_beside_the_photo_or_by_a_slip_is_refused(corners, size):
    with pytest.raises(StageError, match="too small"):
        with_box((), "a.jpg", corners, {"a.jpg": size})


def test_a_point_clicked_again_in_its_photo_moves():
    rows = with_point((), "hat", "a.jpg", 1, 1, SIZES)
    rows = with_point(with_point(rows, "boot", "a.jpg", 9, 9, SIZES), "hat", "a.jpg", 5, 6, SIZES)
    assert rows == (Click("hat", "a.jpg", 5, 6), Click("boot", "a.jpg", 9, 9))


@pytest.mark.parametrize("name", ["", "  ", "a\tb", "#1", '"#1'])
def test_a_name_that_a_table_cannot_hold_is_refused(name):
    with pytest.raises(StageError, match="printable characters"):
        point_name(name)


def test_the_click_under_the_pointer_is_removed_and_no_other():
    rows = (HEAD, SKY)
    assert without_nearest(rows, "a.jpg", 12, 21, 5) == (SKY,)
    assert without_nearest(rows, "a.jpg", 50, 40, 5) == rows
    assert without_nearest(rows, "Füße 2.jpg", 10, 20, 5) == rows


def test_with_a_corner_the_whole_box_is_removed():
    assert without_nearest((HEAD, *BOX), "a.jpg", 29, 41, 5) == (HEAD,)


@pytest.mark.parametrize(
    ("rows", "kind", "expected"),
    [
        ((), "labels", "Nothing is marked yet"),
        ((SKY,), "labels", "only clicks outside"),
        ((HEAD, BOX[0]), "labels", "has 1 corners"),
        ((HEAD, Click("inside", "renamed.jpg", 1, 1)), "labels", "renamed.jpg is not among the photos"),
        ((HEAD, Click("inside", "a.jpg", 300, 1)), "labels", "outside a.jpg"),
        ((Click("hat", "a.jpg", 1, 1),), "points", "hat is marked in one photo"),
        ((Click("hat", "a.jpg", 1, 1),), "points", "1 of at least 4 points"),
        ((Click("bar\t2\ta", "a.jpg", 1, 1),), "lengths", "bar, 2 m: a is marked in one photo"),
        ((Click("bar\t2\ta", "a.jpg", 1, 1),), "lengths", "bar has one end"),
    ],
)
def test_what_the_workflow_would_refuse_is_said(rows, kind, expected):
    assert any(expected in sentence for sentence in problems(rows, kind, SIZES))


def test_nothing_is_said_where_the_workflow_would_go_on():
    assert problems((HEAD, SKY), "labels", SIZES) == []
    assert problems(BOX, "labels", SIZES) == []
    photos = [(name, photo) for name in "abcd" for photo in SIZES]
    assert problems(tuple(Click(*p, 1, 1) for p in photos), "points", SIZES) == []
    ends = tuple(Click(f"bar\t2\t{end}", photo, 1, 1) for end in "ab" for photo in SIZES)
    assert problems(ends, "lengths", SIZES) == []


@pytest.mark.parametrize("text", ["bar 1.5", "  bar 1,5 m ", "bar 1.50m"])
def test_a_length_is_written_as_people_do(text):
    assert with_length((), text) == ((), ("bar\t1.5\ta", "bar\t1.5\tb"))
    assert with_length((), "north door 2")[1][0] == "north door\t2\ta"


@pytest.mark.parametrize("text", ["", "bar", "1.5", "bar 0", "bar -2", "bar inf", "1.5 m", "#bar 2", "b\tar 2"])
def test_a_length_without_a_name_or_metres_is_refused(text):
    with pytest.raises(StageError, match="printable characters" if "ar 2" in text else "a name and a length in metres"):
        with_length((), text)


def test_a_length_that_is_there_keeps_its_clicks_and_ends_and_gets_the_new_metres():
    rows = (Click("bar\t1.5\tleft", "a.jpg", 1, 2), Click("door\t2\ta", "a.jpg", 3, 4))
    changed, ends = with_length(rows, "bar 1.6")
    assert changed == (Click("bar\t1.6\tleft", "a.jpg", 1, 2), rows[1])
    assert ends == ("bar\t1.6\tleft", "bar\t1.6\ta") and label_name(ends[0]) == "bar, 1.6 m: left"
    moved = with_point(changed, ends[0], "a.jpg", 7, 8, SIZES)
    assert moved == (Click("bar\t1.6\tleft", "a.jpg", 7, 8), rows[1])


def test_clicks_in_the_scene_have_to_be_three():
    assert problems((HEAD, SKY), "labels", SIZES, min_inside=3) == ["1 of at least 3 clicks inside are there."]
