"""What a person does to a table, without a browser."""

from types import SimpleNamespace

import pytest

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import Click
from scenefuse.pick.document import Document
from scenefuse.pick.photo_tiles import Picture
from scenefuse.pick.tables import Editor

PICTURES = {name: Picture(name, None, 100, 50) for name in ("a.jpg", "b.jpg")}


@pytest.fixture
def edited(tmp_path):
    """An editor of an empty table of a kind."""

    def edit(kind):
        table = SimpleNamespace(document=Document(tmp_path / f"{kind}.tsv", kind), pictures=PICTURES)
        table.sizes = {name: (100, 50) for name in PICTURES}
        return Editor(table, PICTURES["a.jpg"])

    return edit


def test_the_tool_labels_clicks_and_a_box_gives_it_back(edited):
    editor = edited("labels")
    editor.click(1, 2)
    editor.choose_tool("outside")
    editor.click(3, 4)
    editor.choose_tool("box")
    editor.draw_box(((5, 6), (50, 40)))
    assert [row.label for row in editor.here] == ["inside", "outside", "box", "box"] and editor.tool == "inside"
    editor.remove(1, 2, 5)
    editor.undo()
    assert editor.here[0] == Click("inside", "a.jpg", 1, 2)


def test_a_point_needs_a_name_first(edited):
    editor = edited("points")
    with pytest.raises(StageError, match="Name a point first"):
        editor.click(1, 2)
    editor.name_point(" hat ")
    editor.click(1, 2)
    editor.picture = PICTURES["b.jpg"]
    editor.click(3, 4)
    assert editor.table.document.rows == (Click("hat", "a.jpg", 1, 2), Click("hat", "b.jpg", 3, 4))
    assert editor.points == ["hat"]


def test_after_one_end_of_a_length_comes_the_other_in_each_photo(edited):
    editor = edited("lengths")
    editor.name_point("bar 1.5")
    for photo in PICTURES.values():
        editor.picture = photo
        editor.click(1, 2)
        editor.click(3, 4)
    ends = [(row.label, row.photo) for row in editor.table.document.rows]
    a, b = "bar\t1.5\ta", "bar\t1.5\tb"
    assert ends == [(a, "a.jpg"), (b, "a.jpg"), (a, "b.jpg"), (b, "b.jpg")]


def test_a_click_where_a_box_begins_is_read_back(edited):
    editor = edited("labels")
    editor.draw_box(((0, 0), (50, 40)))
    editor.click(0, 0)
    again = Document(editor.table.document.path, "labels")
    assert again.rows == editor.here and not again.trouble


def test_a_length_whose_change_is_undone_is_clicked_with_the_metres_that_it_has(edited):
    editor = edited("lengths")
    editor.name_point("bar 1.5")
    editor.click(1, 2)
    editor.name_point("bar 2")
    assert editor.points == ["bar\t2\ta", "bar\t2\tb"]
    editor.undo()
    editor.choose_point("bar\t2\tb")
    assert editor.points == ["bar\t1.5\ta", "bar\t1.5\tb"] and editor.point == "bar\t1.5\tb"
    editor.click(3, 4)
    again = Document(editor.table.document.path, "lengths")
    assert [row.label for row in again.rows] == editor.points and not again.trouble


def test_clicks_in_photos_that_are_gone_can_be_removed(edited):
    editor = edited("labels")
    editor.table.document.change((Click("inside", "gone.jpg", 1, 2), Click("inside", "b.jpg", 3, 4)))
    editor.remove_lost()
    assert editor.table.document.rows == (Click("inside", "b.jpg", 3, 4),)
