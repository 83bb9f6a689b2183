"""A table of clicks on disk: every change is written at once."""

import csv
import hashlib
import io
from collections.abc import Iterable
from pathlib import Path

from scenefuse.core.stage import StageError, atomic_file
from scenefuse.core.tables import read_cells, read_text
from scenefuse.marks.clicks import HEADERS, Click, Kind, ScenePoints, in_photos, read_length_clicks, read_points
from scenefuse.pick.edits import Rows


class Document:
    """One table: the rows as edited, which the file holds too.

    Attributes:
        path: of the file, which need not exist.
        kind: what its rows are; that of the file where it exists.
        rows: as edited.
        trouble: why the file cannot be edited here; "" where it can.
        version: counts changes, so that every open page notices those of others.
    """

    def __init__(self, path: Path, kind: Kind, photos: Iterable[str] = ()) -> None:
        """Read the file; names of photos are spelled as in `photos`, where the file writes them otherwise."""
        self.path, self.kind = path, kind
        self._photos = list(photos)
        self.version = 0
        self.read()

    def read(self) -> None:
        """Take the rows that the file holds; what was changed before can no longer be undone."""
        self.rows: Rows = ()
        self.trouble, self._digest = "", digest(self.path)
        self._past: list[Rows] = []
        self._future: list[Rows] = []
        try:
            self.kind, self.rows = self._on_disk()
        except StageError as error:
            self.trouble = f"{error}; the file stays as it is, and cannot be clicked until it is corrected or removed"
        self.version += 1

    def change(self, rows: Rows) -> None:
        """Replace the rows and write them; what was undone can no longer be redone.

        Raises:
            StageError: the file holds something that cannot be edited here, or cannot be written.
        """
        if rows != self.rows:
            before = self.rows
            self._take(rows)
            self._past.append(before)
            self._future.clear()

    def undo(self, forward: bool = False) -> bool:
        """One change back, or forward again; False where there is none. Raises as `change`."""
        source, target = (self._future, self._past) if forward else (self._past, self._future)
        if not source:
            return False
        before = self.rows
        self._take(source[-1])
        source.pop()
        target.append(before)
        return True

    def choose_kind(self, kind: Kind) -> None:
        """Hold rows of the other kind; StageError where there are rows already."""
        if kind != self.kind and (self.rows or self.trouble):
            raise StageError(f"{self.path} holds {self.kind}; remove them all to begin with {kind}")
        self.kind = kind
        self._past, self._future = [], []
        self.version += 1

    def changed_on_disk(self) -> bool:
        """Whether somebody else wrote, made or removed the file since it was read or written."""
        return digest(self.path) != self._digest

    def _take(self, rows: Rows) -> None:
        """Write rows and hold them, unless others have written since."""
        if self.trouble:
            raise StageError(self.trouble)
        if self.changed_on_disk():
            self.read()
            raise StageError(f"{self.path} was changed by someone else just now, and read again; click once more")
        self._write(rows)
        self.rows, self._digest = rows, digest(self.path)
        self.version += 1

    def _on_disk(self) -> tuple[Kind, Rows]:
        """The rows of the file, and what they are; a table of lengths holds nothing else. StageError: unreadable."""
        cells = read_cells(self.path) if self.path.exists() else []
        if not cells or (len(cells) == 1 and cells[0][1] in HEADERS.values()):
            return self.kind, ()
        marked = read_length_clicks(self.path) if self.kind == "lengths" else read_points(self.path)
        if isinstance(marked, ScenePoints):
            raise StageError(f"{self.path} holds points by their coordinates, which are not clicked")
        return marked.kind, tuple(in_photos(marked.rows, self._photos, self.path))

    def _write(self, rows: Rows) -> None:
        lines = read_text(self.path).splitlines() if self.path.exists() else []
        comments = [line for line in lines if line.startswith("#")]
        text = "\n".join([*comments, "\t".join(HEADERS[self.kind]), *map(_line, rows)]) + "\n"
        try:
            # A link stays one: what it points to is replaced.
            with atomic_file(self.path.resolve()) as temporary:
                temporary.write_text(text, encoding="utf-8")
        except OSError as error:
            message = f"{self.path} cannot be written ({error.strerror}); check its folder's permissions"
            raise StageError(message) from None


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes; "" where there is none."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""


def _line(click: Click) -> str:
    line = io.StringIO()
    cells = [*click.label.split("\t"), click.photo, f"{click.x_px:.10g}", f"{click.y_px:.10g}"]
    csv.writer(line, delimiter="\t", lineterminator="").writerow(cells)
    return line.getvalue()
