"""A table of clicks on disk: read, changed, and saved without losing what others wrote."""

import csv
import fcntl
import hashlib
import io
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from scenefuse.core.stage import StageError, atomic_file
from scenefuse.core.tables import composed, read_cells, read_text
from scenefuse.marks.clicks import HEADERS, Click, Kind, ScenePoints, read_length_clicks, read_points
from scenefuse.pick.clicks import History, Rows, difference, merged

_BASE = "# unsaved clicks, laid over the file of SHA-256 "


class FileChanged(Exception):
    """The file is no longer what was read; the message says what differs."""


class NotClicked(StageError):
    """The file holds what is not clicked."""


class Document:
    """One table: the rows as edited, as last read or saved, and what is wrong with the file.

    Attributes:
        path: of the file, which need not exist.
        kind: what its rows are; that of the file where it exists.
        history: the rows, with undo.
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
        self.version, self._drafted = 0, ""
        self.notes: list[str] = []
        self.read()
        self._restore()

    def read(self) -> None:
        """Take the rows that the file holds, and forget all others."""
        self.trouble = self.fixed = ""
        self._digest = digest(self.path)
        self._comments: list[str] = []
        try:
            self.saved = self._rows()
        except StageError as error:
            self.saved, self.trouble = (), str(error)
        self.history = History(self.saved)
        self.version += 1

    @property
    def rows(self) -> Rows:
        """The rows as edited."""
        return self.history.rows

    @property
    def unsaved(self) -> bool:
        """Whether they differ from the file's."""
        return set(self.rows) != set(self.saved)

    def change(self, rows: Rows) -> None:
        """Edit the rows."""
        if self.fixed:
            raise StageError(self.fixed)
        self.history.change(rows)
        self.version += 1

    def choose_kind(self, kind: Kind) -> None:
        """Hold rows of the other kind; StageError where there are rows already."""
        if kind != self.kind and (self.rows or self.fixed):
            raise StageError(f"{self.path} holds {self.kind}; remove them all to begin with {kind}")
        self.kind = kind
        self.history = History(self.rows)
        self.version += 1

    def undo(self) -> bool:
        """One change back."""
        self.version += 1
        return self.history.undo()

    def redo(self) -> bool:
        """One change forward again."""
        self.version += 1
        return self.history.redo()

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
        with _locked(self.path.parent):
            if self.changed_on_disk():
                raise FileChanged(self._what_changed())
            message = f"{len(self.rows)} rows saved in {self.path}"
            if self.trouble:
                message += f"; the unreadable file is kept as {_kept(self.path).name}"
            lines = ["\t".join(HEADERS[self.kind]), *map(_line, self.rows)]
            _write(self.path, "\n".join([*self._comments, *lines]) + "\n")
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
        with suppress(StageError):  # which `read` notes
            kind = self._on_disk()[0]
        if mine and kind != self.kind:
            raise StageError(f"{self.path} holds {kind} now, and here are {self.kind}: take one of the two")
        self.read()
        if self.trouble or self.fixed:
            self.history.change(mine)
        else:
            self.history.change(merged(base, mine, self.saved))
        return "Both are shown now; save to write them."

    def keep_mine(self) -> str:
        """Save the own rows; the file as somebody else left it is kept under another name."""
        kept = _kept(self.path).name if self.path.exists() else ""
        self._digest, self.trouble = digest(self.path), ""
        return self.save() + (f"; the other version is kept as {kept}" if kept else "")

    def keep_draft(self) -> Path | None:
        """Write unsaved rows beside the file, for the next time; None where there are none, and what this object wrote
        there goes."""
        if not self.unsaved:
            if self._drafted and digest(self._draft) == self._drafted:
                self._draft.unlink(missing_ok=True)
            self._drafted = ""
            return None
        lines = [f"{_BASE}{self._digest}", "\t".join(HEADERS[self.kind]), *map(_line, self.rows)]
        text = "\n".join(lines) + "\n"
        if hashlib.sha256(text.encode()).hexdigest() != self._drafted:
            if self._draft.exists() and digest(self._draft) != self._drafted:
                _kept(self._draft)  # it is another page's, or could not be read
            _write(self._draft, text)
            self._drafted = digest(self._draft)
        return self._draft

    @property
    def _draft(self) -> Path:
        return self.path.with_name(f"{self.path.stem}.unsaved{self.path.suffix}")

    def _restore(self) -> None:
        """Take up the unsaved rows of the last time; where the file has changed since, beside its own."""
        if not self._draft.is_file() or self.fixed:
            return
        try:
            base = next((line for line in read_text(self._draft).splitlines() if line.startswith(_BASE)), _BASE)
            kind, rows = self._read_rows(self._draft) if _holds_rows(self._draft) else (self.kind, ())
        except StageError as error:
            self.notes.append(f"unsaved clicks cannot be read and are left where they are: {error}")
            return
        if self.saved and kind != self.kind:
            self.notes.append(f"unsaved {kind} are left in {self._draft.name}: {self.path.name} holds {self.kind} now")
            return
        self._drafted = digest(self._draft)
        if base.removeprefix(_BASE) == self._digest:
            self.kind = kind
            self.history.change(rows)
        elif set(rows) - set(self.saved):
            self.kind = kind
            self.history.change(merged((), rows, self.saved))
            self.notes.append(f"{self.path.name} has changed since clicks were left unsaved: both are shown")

    def _rows(self) -> Rows:
        try:
            self.kind, rows = self._on_disk()
        except NotClicked as error:
            self.fixed = str(error)
            return ()
        if rows:
            self._comments = [line for line in read_text(self.path).splitlines() if line.startswith("#")]
        return rows

    def _on_disk(self) -> tuple[Kind, Rows]:
        """What the file holds."""
        return self._read_rows(self.path) if self.path.exists() and _holds_rows(self.path) else (self.kind, ())

    def _read_rows(self, path: Path) -> tuple[Kind, Rows]:
        kind, rows = _read(path, self.kind)
        return kind, tuple(replace(row, photo=self._spelled.get(composed(row.photo), row.photo)) for row in rows)

    def _what_changed(self) -> str:
        try:
            return f"{self.path} was changed by someone else: {difference(self.saved, self._on_disk()[1])}"
        except StageError as error:
            return f"{self.path} was changed by someone else, and is no longer readable: {error}"


def _holds_rows(path: Path) -> bool:
    """False for an empty file, or a known header without rows: nothing is marked in it, and nothing is wrong."""
    try:
        rows = read_cells(path)
    except StageError:
        return True
    return len(rows) > 1 or (len(rows) == 1 and rows[0][1] not in HEADERS.values())


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes; "" where there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def _read(path: Path, kind: Kind) -> tuple[Kind, Rows]:
    """The rows of a table, and what they are; a table of lengths holds nothing else.

    Raises:
        NotClicked: points by their coordinates.
        StageError: it cannot be read.
    """
    marked = read_length_clicks(path) if kind == "lengths" else read_points(path)
    if isinstance(marked, ScenePoints):
        raise NotClicked(f"{path} holds points by their coordinates, which are not clicked; edit it as text")
    return marked.kind, marked.rows


def _line(click: Click) -> str:
    line = io.StringIO()
    cells = [*click.label.split("\t"), click.photo, f"{click.x_px:.10g}", f"{click.y_px:.10g}"]
    csv.writer(line, delimiter="\t", lineterminator="").writerow(cells)
    return line.getvalue()


def _write(path: Path, text: str) -> None:
    try:
        # A link stays one: what it points to is replaced.
        with atomic_file(path.resolve()) as temporary:
            temporary.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StageError(f"{path} cannot be written ({error.strerror}); check its folder's permissions") from None


def _kept(path: Path) -> Path:
    """A copy of a file under the first free name beside it."""
    number = 1
    while (other := path.with_name(f"{path.stem}.kept-{number}{path.suffix}")).exists():
        number += 1
    shutil.copy2(path, other)
    return other


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a folder, so that of two pages one after the other looks at the file and writes it."""
    folder.mkdir(parents=True, exist_ok=True)
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
