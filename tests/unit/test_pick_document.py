"""Tables of clicks on disk: each change is written, what others wrote is kept, and so are files of something else."""

import unicodedata

import pytest

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import Click, read_points
from scenefuse.marks.triangulation import read_ends
from scenefuse.pick.document import Document, with_length, with_point

HEAD, FOOT = Click("inside", "Füße 2.jpg", 10.5, 20), Click("outside", "a b.jpg", 3, 4)
TEXT = "label\tphoto\tx_px\ty_px\n"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "prompts.tsv"


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


def test_each_change_is_in_the_file_at_once_for_the_page_and_for_the_workflow(path):
    document = Document(path, "labels")
    document.change((HEAD, FOOT))
    assert Document(path, "labels").rows == (HEAD, FOOT)
    marked = read_points(path)
    assert marked.photos == ["Füße 2.jpg", "a b.jpg"] and marked.pixels.tolist() == [[10.5, 20], [3, 4]]
    document.undo()
    assert Document(path, "labels").rows == () and [file.name for file in path.parent.iterdir()] == ["prompts.tsv"]


def test_known_lengths_are_read_back_by_the_page_and_by_the_workflow_one_end_or_two(path):
    document = Document(path, "lengths")
    sizes = {"a b.jpg": (9, 9), "c.jpg": (9, 9)}
    first = with_point((), with_length((), "north door 2.05")[1][0], "a b.jpg", 3, 4, sizes)
    document.change(first)
    again = Document(path, "lengths")
    assert again.rows == first and not again.trouble
    ends = [Click(f"north door\t2.05\t{end}", photo, 5, 6) for end in "ab" for photo in sizes]
    again.change((*first, *ends[1:]))
    clicks = read_ends(path)
    assert clicks.labels == ["north door\t2.05\ta"] * 2 + ["north door\t2.05\tb"] * 2
    assert clicks.pixels[:2].tolist() == [[3, 4], [5, 6]]


def test_a_file_from_a_spreadsheet_is_edited_with_the_names_that_the_photos_have(path):
    own, quoted = unicodedata.normalize("NFD", "Füße 2.jpg"), '"7" inch.jpg'
    path.write_text(f"# by hand\n{TEXT}inside\tFüße 2.jpg\t10.5\t20\t\n", encoding="utf-16")
    document = Document(path, "labels", [own, quoted])
    assert document.rows == (Click("inside", own, 10.5, 20),) and not document.trouble
    document.change((*document.rows, Click("outside", quoted, 1, 2)))
    assert read_points(path).photos == [own, quoted] and path.read_text().startswith("# by hand\n")
    path.write_text(TEXT.replace("\n", "\t\n"), encoding="utf-16")
    assert Document(path, "labels").rows == () and not Document(path, "labels").trouble


def test_a_file_of_points_is_edited_as_such_whatever_was_expected(path):
    path.write_text("point\tphoto\tx_px\ty_px\nhat\ta.jpg\t1\t2\n")
    document = Document(path, "labels")
    assert document.kind == "points" and document.rows == (Click("hat", "a.jpg", 1, 2),)
    with pytest.raises(StageError, match="remove them all"):
        document.choose_kind("labels")


@pytest.mark.parametrize("comment", ["# by hand", '"# by ""hand"", as a spreadsheet quotes it"'])
def test_comments_survive(path, comment):
    path.write_text(f"{comment}\n{TEXT}inside\ta.jpg\t1\t2\n")
    document = Document(path, "labels")
    document.change((*document.rows, HEAD))
    assert path.read_text().startswith(f"{comment}\nlabel\t") and len(Document(path, "labels").rows) == 2


@pytest.mark.parametrize(
    ("kind", "content"),
    [
        ("labels", b"label\tphoto\nx"),
        ("labels", TEXT.encode() + b"inside\ta.jpg\tone\t2\n"),
        ("labels", b"\xff\xfe\x00\x01"),
        ("lengths", TEXT.encode() + b"inside\ta.jpg\t1\t2\n"),
        ("points", b"point\tx\ty\tz\nhat\t1\t2\t3\n"),
    ],
)
def test_a_file_that_holds_no_such_clicks_is_named_and_never_overwritten(path, kind, content):
    path.write_bytes(content)
    document = Document(path, kind)
    assert "prompts.tsv" in document.trouble and document.rows == ()
    with pytest.raises(StageError, match=r"prompts\.tsv"):
        document.change((HEAD,))
    assert path.read_bytes() == content and document.rows == ()


@pytest.mark.parametrize("content", ["", TEXT, "# nothing yet\n"])
def test_a_file_without_rows_is_no_trouble(path, content):
    path.write_text(content)
    assert Document(path, "labels").trouble == ""


def test_what_someone_else_wrote_just_now_is_read_and_not_overwritten(path):
    first, second = Document(path, "labels"), Document(path, "labels")
    first.change((HEAD,))
    with pytest.raises(StageError, match="was changed by someone else just now, and read again; click once more"):
        second.change((FOOT,))
    assert second.rows == (HEAD,) == Document(path, "labels").rows
    second.change((HEAD, FOOT))
    assert Document(path, "labels").rows == (HEAD, FOOT)


@pytest.mark.parametrize("content", ["garbage", "point\tphoto\tx_px\ty_px\nroof\ta b.jpg\t3\t4\n"])
def test_a_file_that_became_another_one_meanwhile_is_not_overwritten(path, content):
    document = Document(path, "labels")
    document.change((HEAD,))
    path.write_text(content)
    with pytest.raises(StageError, match=r"prompts\.tsv"):
        document.change((HEAD, FOOT))
    assert path.read_text() == content


def test_a_file_that_was_removed_meanwhile_has_changed(path):
    path.write_text(f"{TEXT}outside\ta b.jpg\t3\t4\n")
    document = Document(path, "labels")
    path.unlink()
    assert document.changed_on_disk()


def test_a_link_stays_a_link(path):
    target = path.parent / "elsewhere" / "table.tsv"
    target.parent.mkdir()
    target.write_text(TEXT)
    path.symlink_to(target)
    Document(path, "labels").change((HEAD,))
    assert path.is_symlink() and Document(target, "labels").rows == (HEAD,)


def test_a_file_that_cannot_be_written_is_named_and_the_click_is_not_taken(tmp_path):
    document = Document(tmp_path / "prompts.tsv", "labels")
    (tmp_path / "prompts.tsv").mkdir()
    with pytest.raises(StageError, match=r"prompts\.tsv"):
        document.change((HEAD,))
    assert document.rows == () and not document.undo()
    (tmp_path / "config").touch()
    with pytest.raises(StageError, match=r"prompts\.tsv cannot be written \(File exists\); correct that"):
        Document(tmp_path / "config/prompts.tsv", "labels").change((HEAD,))
