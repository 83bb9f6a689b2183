"""A table of clicks on disk: read, changed with undo, and saved without losing what others wrote."""

import csv
import hashlib
import io
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from scenefuse.core.stage import StageError, atomic_file
from scenefuse.core.tables import composed, read_cells, read_text
from scenefuse.marks.clicks import HEADERS, Click, Kind, ScenePoints, read_length_clicks, read_points
from scenefuse.pick.edits import Rows, merged

# Begins the line of a draft that names the state of the file that it was made from.
BASE = "# unsaved clicks, laid over the file of SHA-256 "


class FileChanged(Exception):
    """The file is no longer what was read; the message says what differs."""


class NotClicked(StageError):
    """The file holds what is not clicked."""


class Document:
    """One table: the rows as edited, as last read or saved, and what is wrong with the file.

    Attributes:
        path: of the file, which need not exist.
        kind: what its rows are; that of the file where it exists.
        rows: as edited.
        saved: the rows that the file held when it was last read or written.
        trouble: why the file cannot be read; it is then kept under another name when this is saved. "" where it can.
        fixed: why the file cannot be edited here; "" where it can.
        notes: what a person should know of unsaved clicks of the last time, a sentence each.
        version: counts changes, so that every open page notices those of others.
    """

    def __init__(self, path: Path, kind: Kind, photos: Iterable[str] = ()) -> None:
        """Read the file; names of photos are spelled as in `photos`, where the file writes their umlauts otherwise."""
        self.path, self.kind = path, kind
        self._spelled = {composed(name): name for name in photos}
        self._draft = path.with_name(f"{path.stem}.unsaved{path.suffix}")
        # The version that the draft holds; 0 where there is none of this page.
        self.version = self._drafted = 0
        self.notes: list[str] = []
        self.read()
        self._restore()

    def read(self) -> None:
        """Take the rows that the file holds, and forget all others."""
        self.trouble = self.fixed = ""
        self.rows: Rows = ()
        self._digest = digest(self.path)
        self._comments: list[str] = []
        try:
            self.kind, self.rows = self._on_disk()
            self._comments = [line for line in _lines(self.path) if line.startswith("#")]
        except NotClicked as error:
            self.fixed = str(error)
        except StageError as error:
            self.trouble = str(error)
        self.saved = self.rows
        self._past: list[Rows] = []
        self._future: list[Rows] = []
        self.version += 1

    @property
    def unsaved(self) -> bool:
        """Whether the rows differ from the file's."""
        return set(self.rows) != set(self.saved)

    def change(self, rows: Rows) -> None:
        """Replace the rows; what was undone can no longer be redone."""
        if self.fixed:
            raise StageError(self.fixed)
        if rows != self.rows:
            self._past.append(self.rows)
            self._future.clear()
            self.rows = rows
            self.version += 1

    def undo(self, forward: bool = False) -> bool:
        """One change back, or forward again; False where there is none."""
        source, target = (self._future, self._past) if forward else (self._past, self._future)
        if not source:
            return False
        target.append(self.rows)
        self.rows = source.pop()
        self.version += 1
        return True

    def choose_kind(self, kind: Kind) -> None:
        """Hold rows of the other kind; StageError where there are rows already."""
        if kind != self.kind and (self.rows or self.fixed):
            raise StageError(f"{self.path} holds {self.kind}; remove them all to begin with {kind}")
        self.kind = kind
        self._past, self._future = [], []
        self.version += 1

    def changed_on_disk(self) -> bool:
        """Whether somebody else wrote, made or removed the file since it was read."""
        return digest(self.path) != self._digest

    def save(self) -> str:
        """Write the file; what happened, for a person.

        Raises:
            FileChanged: somebody else did; nothing is written.
            StageError: it holds something that cannot be edited here, or cannot be written.
        """
        if self.fixed:
            raise StageError(self.fixed)
        if self.changed_on_disk():
            raise FileChanged(self._what_changed())
        message = f"{len(self.rows)} rows saved in {self.path}"
        if self.trouble:
            message += f"; the unreadable file is kept as {_kept(self.path)}"
        self._write(self.path, self._comments)
        self._digest = digest(self.path)
        self.saved, self.trouble = self.rows, ""
        self.keep_draft()
        self.version += 1
        return message

    def merge(self) -> str:
        """Take what the file holds now, with the own changes laid over it, still unsaved; what happened.

        Raises:
            StageError: it holds another kind of rows.
        """
        base, mine, kind = self.saved, self.rows, self.kind
        try:
            kind, _ = self._on_disk()
        except NotClicked:
            raise
        except StageError:
            pass  # which `read` notes
        if mine and kind != self.kind:
            raise StageError(f"{self.path} holds {kind} now, and here are {self.kind}: take one of the two")
        self.read()
        self.change(mine if self.trouble else merged(base, mine, self.saved))
        return "Both are shown now; save to write them."

    def keep_mine(self) -> str:
        """Save the own rows; the file as somebody else left it is kept under another name."""
        kept = f"; the other version is kept as {_kept(self.path)}" if self.path.exists() else ""
        self._digest, self.trouble = digest(self.path), ""
        return self.save() + kept

    def keep_draft(self) -> Path | None:
        """Write unsaved rows beside the file, for the next time; None where there are none, and an own draft goes."""
        if not self.unsaved:
            if self._drafted:
                self._draft.unlink(missing_ok=True)
            self._drafted = 0
            return None
        if self._drafted != self.version:
            self._write(self._draft, [f"{BASE}{self._digest}"])
            self._drafted = self.version
        return self._draft

    def _restore(self) -> None:
        """Take up the unsaved rows of the last time; where the file has changed since, beside its own."""
        if not self._draft.is_file() or self.fixed:
            return
        try:
            base = next((line for line in _lines(self._draft) if line.startswith(BASE)), BASE).removeprefix(BASE)
            kind, rows = self._read_rows(self._draft)
            if self.saved and kind != self.kind:
                raise StageError(f"they are {kind}, and {self.path.name} holds {self.kind}")
        except StageError as error:
            self.notes.append(f"unsaved clicks of the last time are kept as {_kept(self._draft)}: {error}")
            self._draft.unlink()
            return
        if base != self._digest and set(rows) - set(self.saved):
            self.notes.append(f"{self.path.name} has changed since clicks were left unsaved: both are shown")
        self.kind = kind
        self.change(rows if base == self._digest else merged((), rows, self.saved))
        self._drafted = self.version

    def _on_disk(self) -> tuple[Kind, Rows]:
        """What the file holds."""
        return self._read_rows(self.path) if self.path.exists() else (self.kind, ())

    def _read_rows(self, path: Path) -> tuple[Kind, Rows]:
        """The rows of a file, and what they are; a table of lengths holds nothing else.

        Raises:
            NotClicked: points by their coordinates.
            StageError: it cannot be read.
        """
        cells = read_cells(path)
        if not cells or (len(cells) == 1 and cells[0][1] in HEADERS.values()):
            return self.kind, ()
        marked = read_length_clicks(path) if self.kind == "lengths" else read_points(path)
        if isinstance(marked, ScenePoints):
            raise NotClicked(f"{path} holds points by their coordinates, which are not clicked; edit it as text")
        named = tuple(replace(row, photo=self._spelled.get(composed(row.photo), row.photo)) for row in marked.rows)
        return marked.kind, named

    def _write(self, path: Path, comments: list[str]) -> None:
        text = "\n".join([*comments, "\t".join(HEADERS[self.kind]), *map(_line, self.rows)]) + "\n"
        try:
            # A link stays one: what it points to is replaced.
            with atomic_file(path.resolve()) as temporary:
                temporary.write_text(text, encoding="utf-8")
        except OSError as error:
            raise StageError(f"{path} cannot be written ({error.strerror}); check its folder's permissions") from None

    def _what_changed(self) -> str:
        try:
            rows = set(self._on_disk()[1])
        except StageError as error:
            return f"{self.path} was changed by someone else, and is no longer readable: {error}"
        added, removed = len(rows - set(self.saved)), len(set(self.saved) - rows)
        return f"{self.path} was changed by someone else: {added} added, {removed} removed"


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes; "" where there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def _lines(path: Path) -> list[str]:
    return read_text(path).splitlines() if path.exists() else []


def _line(click: Click) -> str:
    line = io.StringIO()
    cells = [*click.label.split("\t"), click.photo, f"{click.x_px:.10g}", f"{click.y_px:.10g}"]
    csv.writer(line, delimiter="\t", lineterminator="").writerow(cells)
    return line.getvalue()


def _kept(path: Path) -> str:
    """The name of a copy of a file, the first free one beside it."""
    number = 1
    while (other := path.with_name(f"{path.stem}.kept-{number}{path.suffix}")).exists():
        number += 1
    shutil.copy2(path, other)
    return other.name
