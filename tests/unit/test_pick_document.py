"""Tables of clicks on disk: what is read back, what others wrote, and files that cannot be read."""

import unicodedata

import pytest

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import Click, read_points
from scenefuse.marks.lengths import read_ends
from scenefuse.pick.document import Document, FileChanged
from scenefuse.pick.edits import with_length, with_point

HEAD, FOOT = Click("inside", "Füße 2.jpg", 10.5, 20), Click("outside", "a b.jpg", 3, 4)
TEXT = "label\tphoto\tx_px\ty_px\n"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "prompts.tsv"


def names(path):
    return sorted(file.name for file in path.parent.iterdir())


def test_undo_and_redo_go_back_and_forth_until_a_new_change(path):
    document = Document(path, "labels")
    document.change((HEAD,))
    document.change((HEAD, FOOT))
    document.change((HEAD, FOOT))  # no change
    assert document.undo() and document.rows == (HEAD,) and document.undo() and not document.undo()
    assert document.undo(forward=True) and document.undo(forward=True) and document.rows == (HEAD, FOOT)
    assert document.undo() and document.rows == (HEAD,)
    document.change(())
    assert not document.undo(forward=True) and document.rows == ()


def test_saved_clicks_are_read_back_by_the_page_and_by_the_workflow(path):
    document = Document(path, "labels")
    document.change((HEAD, FOOT))
    assert document.unsaved
    document.save()
    assert not document.unsaved and Document(path, "labels").rows == (HEAD, FOOT)
    marked = read_points(path)
    assert marked.photos == ["Füße 2.jpg", "a b.jpg"] and marked.pixels.tolist() == [[10.5, 20], [3, 4]]
    assert names(path) == ["prompts.tsv"]


def test_known_lengths_are_read_back_by_the_page_and_by_the_workflow_one_end_or_two(path):
    document = Document(path, "lengths")
    first = with_point((), with_length((), "north door 2.05")[1][0], "a b.jpg", 3, 4, {"a b.jpg": (9, 9)})
    document.change(first)
    document.save()
    again = Document(path, "lengths")
    assert again.rows == first and not again.trouble
    again.change((*first, Click("north door\t2.05\tb", "a b.jpg", 5, 6)))
    again.keep_draft()
    draft = Document(path, "lengths")
    assert draft.unsaved and draft.rows == again.rows
    draft.save()
    clicks = read_ends(path)
    assert clicks.labels == ["north door\t2.05\ta", "north door\t2.05\tb"] and clicks.pixels.tolist() == [
        [3, 4],
        [5, 6],
    ]


def test_a_file_from_a_spreadsheet_is_edited_with_the_names_that_the_photos_have(path):
    own, quoted = unicodedata.normalize("NFD", "Füße 2.jpg"), '"7" inch.jpg'
    path.write_text(f"# by hand\n{TEXT}inside\tFüße 2.jpg\t10.5\t20\t\n", encoding="utf-16")
    document = Document(path, "labels", [own, quoted])
    assert document.rows == (Click("inside", own, 10.5, 20),) and not document.trouble
    document.change((*document.rows, Click("outside", quoted, 1, 2)))
    document.save()
    assert read_points(path).photos == [own, quoted] and path.read_text().startswith("# by hand\n")
    path.write_text(TEXT.replace("\n", "\t\n"), encoding="utf-16")
    assert Document(path, "labels").rows == () and not Document(path, "labels").trouble


def test_a_table_of_lengths_that_is_none_is_kept_beside(path):
    path.write_text(f"{TEXT}inside\ta.jpg\t1\t2\n")
    document = Document(path, "lengths")
    assert document.trouble and document.rows == ()
    document.change((Click("bar\t2\ta", "a.jpg", 5, 6),))
    assert "prompts.kept-1.tsv" in document.save()


def test_a_file_of_points_is_edited_as_such_whatever_was_expected(path):
    path.write_text("point\tphoto\tx_px\ty_px\nhat\ta.jpg\t1\t2\n")
    document = Document(path, "labels")
    assert document.kind == "points" and document.rows == (Click("hat", "a.jpg", 1, 2),)
    with pytest.raises(StageError, match="remove them all"):
        document.choose_kind("labels")


def test_comments_survive(path):
    path.write_text(f"# by hand\n{TEXT}inside\ta.jpg\t1\t2\n")
    document = Document(path, "labels")
    document.change((*document.rows, HEAD))
    document.save()
    assert path.read_text().startswith("# by hand\nlabel\t") and len(Document(path, "labels").rows) == 2


@pytest.mark.parametrize(
    "content", [b"label\tphoto\nx", TEXT.encode() + b"inside\ta.jpg\tone\t2\n", b"\xff\xfe\x00\x01"]
)
def test_a_corrupt_file_is_kept_beside_and_never_overwritten(path, content):
    path.write_bytes(content)
    document = Document(path, "labels")
    assert document.trouble and document.rows == ()
    assert path.read_bytes() == content
    document.change((HEAD,))
    assert "prompts.kept-1.tsv" in document.save()
    assert (path.parent / "prompts.kept-1.tsv").read_bytes() == content
    assert Document(path, "labels").rows == (HEAD,) and not document.trouble


@pytest.mark.parametrize("content", ["", TEXT, "# nothing yet\n"])
def test_a_file_without_rows_is_no_trouble(path, content):
    path.write_text(content)
    assert Document(path, "labels").trouble == ""


def test_points_by_coordinates_cannot_be_edited_and_stay(path):
    content = "point\tx\ty\tz\nhat\t1\t2\t3\n"
    path.write_text(content)
    document = Document(path, "points")
    for action in (lambda: document.change((HEAD,)), document.save):
        with pytest.raises(StageError, match="by their coordinates"):
            action()
    assert path.read_text() == content


def test_of_two_that_save_the_second_is_told_and_nothing_is_lost(path):
    first, second = Document(path, "labels"), Document(path, "labels")
    first.change((HEAD,))
    first.save()
    second.change((FOOT,))
    with pytest.raises(FileChanged, match="1 added"):
        second.save()
    assert Document(path, "labels").rows == (HEAD,)
    second.merge()
    assert set(second.rows) == {HEAD, FOOT}
    second.save()
    assert set(Document(path, "labels").rows) == {HEAD, FOOT}


def test_keeping_the_own_clicks_sets_the_other_version_aside(path):
    document = Document(path, "labels")
    document.change((HEAD,))
    path.write_text(f"{TEXT}outside\ta b.jpg\t3\t4\n")
    assert "prompts.kept-1.tsv" in document.keep_mine()
    assert Document(path, "labels").rows == (HEAD,)
    assert Document(path.parent / "prompts.kept-1.tsv", "labels").rows == (FOOT,)


def test_a_file_that_became_unreadable_meanwhile_is_kept_too(path):
    document = Document(path, "labels")
    document.change((HEAD,))
    path.write_text("garbage")
    with pytest.raises(FileChanged, match="no longer readable"):
        document.save()
    document.merge()
    assert document.rows == (HEAD,)
    document.save()
    assert (path.parent / "prompts.kept-1.tsv").read_text() == "garbage"
    assert Document(path, "labels").rows == (HEAD,)


def test_a_file_that_was_removed_meanwhile_has_changed(path):
    path.write_text(f"{TEXT}outside\ta b.jpg\t3\t4\n")
    document = Document(path, "labels")
    path.unlink()
    assert document.changed_on_disk()


def test_unsaved_clicks_are_taken_up_again(path):
    path.write_text(f"{TEXT}outside\ta b.jpg\t3\t4\n")
    document = Document(path, "labels")
    document.change((FOOT, HEAD))
    assert document.keep_draft() == path.parent / "prompts.unsaved.tsv"
    again = Document(path, "labels")
    assert again.unsaved and again.rows == (FOOT, HEAD)
    again.save()
    assert names(path) == ["prompts.tsv"]


def test_what_is_saved_leaves_no_draft(path):
    document = Document(path, "labels")
    document.change((HEAD,))
    document.save()
    assert document.keep_draft() is None and names(path) == ["prompts.tsv"]


def test_a_link_stays_a_link(path):
    target = path.parent / "elsewhere" / "table.tsv"
    target.parent.mkdir()
    target.write_text(TEXT)
    path.symlink_to(target)
    document = Document(path, "labels")
    document.change((HEAD,))
    document.save()
    assert path.is_symlink() and Document(target, "labels").rows == (HEAD,)


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    document = Document(tmp_path / "prompts.tsv", "labels")
    document.change((HEAD,))
    (tmp_path / "prompts.tsv").mkdir()
    with pytest.raises((StageError, FileChanged), match="prompts.tsv"):
        document.save()
    assert document.unsaved


def test_a_file_that_was_written_after_the_draft_is_shown_with_it(path):
    path.write_text(f"{TEXT}outside\ta b.jpg\t3\t4\n")
    document = Document(path, "labels")
    document.change((FOOT, HEAD))
    document.keep_draft()
    path.write_text(f"{TEXT}outside\ta b.jpg\t3\t4\ninside\tc.jpg\t5\t6\n")
    again = Document(path, "labels")
    assert set(again.rows) == {FOOT, Click("inside", "c.jpg", 5, 6), HEAD} and "both are shown" in again.notes[0]


def test_a_draft_without_rows_means_that_all_were_removed(path):
    path.write_text(f"{TEXT}outside\ta b.jpg\t3\t4\n")
    document = Document(path, "labels")
    document.change(())
    document.keep_draft()
    assert Document(path, "labels").rows == () and Document(path, "labels").unsaved


def test_a_draft_that_cannot_be_read_changes_nothing_and_is_kept(path):
    path.write_text(f"{TEXT}outside\ta b.jpg\t3\t4\n")
    (path.parent / "prompts.unsaved.tsv").write_text("mangled\n")
    document = Document(path, "labels")
    assert document.rows == (FOOT,) and not document.unsaved and "prompts.unsaved.kept-1.tsv" in document.notes[0]
    assert names(path) == ["prompts.tsv", "prompts.unsaved.kept-1.tsv"]
    assert (path.parent / "prompts.unsaved.kept-1.tsv").read_text() == "mangled\n"


def test_of_two_pages_one_does_not_remove_the_draft_of_the_other(path):
    first, second = Document(path, "labels"), Document(path, "labels")
    first.change((HEAD,))
    first.keep_draft()
    second.change((FOOT,))
    second.save()
    again = Document(path, "labels")
    assert set(again.rows) == {HEAD, FOOT} and again.unsaved


def test_clicks_of_another_kind_are_not_laid_over_and_keeping_the_own_ones_keeps_their_kind(path):
    document = Document(path, "labels")
    document.change((HEAD,))
    points = "point\tphoto\tx_px\ty_px\nroof\ta b.jpg\t3\t4\n"
    for text in (points, "point\tx\ty\tz\nroof\t1\t2\t3\n"):
        path.write_text(text)
        with pytest.raises(FileChanged):
            document.save()
    path.write_text(points)
    with pytest.raises(StageError, match="holds points now, and here are labels"):
        document.merge()
    assert document.rows == (HEAD,)
    document.keep_mine()
    assert Document(path, "labels").rows == (HEAD,) and (path.parent / "prompts.kept-1.tsv").read_text() == points
