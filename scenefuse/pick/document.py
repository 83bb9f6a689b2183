"""A table of clicks: edits of its rows, what the workflow would refuse in them, and the file that holds each change."""

import csv
import io
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from scenefuse.core.stage import StageError, atomic_file, sha256
from scenefuse.core.tables import is_comment, read_cells, read_text
from scenefuse.crop.crop_scene import MIN_FIDUCIALS
from scenefuse.marks.clicks import (
    HEADERS,
    Click,
    Kind,
    ScenePoints,
    in_photos,
    length_label,
    read_length_clicks,
    read_points,
)
from scenefuse.pick.photo_tiles import MASK_PX

# The two ends of a length that is new.
ENDS = ("a", "b")

Rows = tuple[Click, ...]
# Photo name -> (width, height), the pixels that clicks in it are in.
Sizes = Mapping[str, tuple[int, int]]
Corners = tuple[tuple[float, float], tuple[float, float]]


def with_label(rows: Rows, label: str, photo: str, x: float, y: float, sizes: Sizes) -> Rows:
    """The rows and a click inside or outside.

    Raises:
        StageError: it lies outside the photo, or was clicked already.
    """
    click = _in_photo(label, photo, x, y, sizes)
    for other in rows:
        if other.label != "box" and replace(other, label=label) == click:
            raise StageError(f"({click.x_px:g}, {click.y_px:g}) in {photo} is already marked {other.label}")
    return (*rows, click)


def with_box(rows: Rows, photo: str, corners: Corners, sizes: Sizes) -> Rows:
    """The rows with a box, cut to the photo, in the place of the photo's former one.

    Raises:
        StageError: next to nothing of it lies in the photo, as of a slip.
    """
    (x0, x1), (y0, y1) = (sorted(min(max(c[k], 0.0), sizes[photo][k]) for c in corners) for k in (0, 1))
    # Two pixels or more where masks are made.
    if min(x1 - x0, y1 - y0) < 2 * max(1, max(sizes[photo]) / MASK_PX):
        raise StageError(f"the box in {photo} is too small; drag it around the whole object")
    kept = tuple(row for row in rows if (row.label, row.photo) != ("box", photo))
    return (*kept, _in_photo("box", photo, x0, y0, sizes), _in_photo("box", photo, x1, y1, sizes))


def with_point(rows: Rows, label: str, photo: str, x: float, y: float, sizes: Sizes) -> Rows:
    """The rows with a named point or an end of a length in a photo, moved where it was there already.

    Raises:
        StageError: it lies outside the photo.
    """
    click = _in_photo(label, photo, x, y, sizes)
    place = next((k for k, row in enumerate(rows) if (row.label, row.photo) == (label, photo)), len(rows))
    return (*rows[:place], click, *rows[place + 1 :])


def point_name(text: str) -> str:
    """The name of a point or a length as a table can hold it.

    Raises:
        StageError: it is empty, or cannot stand in a table.
    """
    name = text.strip()
    if not name or not name.isprintable() or is_comment(name):
        raise StageError("a name consists of printable characters and does not begin with #; write another one")
    return name


def with_length(rows: Rows, text: str) -> tuple[Rows, tuple[str, str]]:
    """The rows, where those of a length that is there already get its new metres, and the labels of its two ends.

    Args:
        rows: of the table.
        text: name and metres, as a person writes them: `bar 1.5` or `bar 1,5 m`.

    Raises:
        StageError: there is no name, or no positive number.
    """
    name, _, number = text.strip().removesuffix("m").strip().rpartition(" ")
    try:
        metres = float(number.replace(",", "."))
        if not (name and 0 < metres < float("inf")):
            raise ValueError
    except ValueError:
        raise StageError("write a name and a length in metres: bar 1.5") from None
    name = point_name(name)
    cells = [row.label.split("\t") for row in rows]
    ends = [*(cell[2] for cell in cells if cell[0] == name), *ENDS]
    labels = {end: length_label(name, metres, end) for end in ends}
    changed = [replace(row, label=labels[cell[2]]) if cell[0] == name else row for row, cell in zip(rows, cells)]
    first, second, *_ = labels.values()
    return tuple(changed), (first, second)


def label_in(rows: Rows, label: str) -> str:
    """A label of a point or an end, with the metres that its length has in the rows."""
    name, *rest = label.split("\t")
    metres = next((held[1:-1] for row in rows if (held := row.label.split("\t"))[0] == name), rest[:-1])
    return "\t".join([name, *metres, *rest[-1:]])


def without_nearest(rows: Rows, photo: str, x: float, y: float, within_px: float) -> Rows:
    """The rows without the click of a photo that is nearest to a pixel; with a corner goes its whole box."""
    near = [((r.x_px - x) ** 2 + (r.y_px - y) ** 2, k) for k, r in enumerate(rows) if r.photo == photo]
    if not near or min(near)[0] > within_px**2:
        return rows
    gone = rows[min(near)[1]]
    if gone.label == "box":
        return tuple(row for row in rows if (row.label, row.photo) != ("box", photo))
    return tuple(row for row in rows if row is not gone)


def problems(rows: Rows, kind: Kind, sizes: Sizes, min_inside: int = 1) -> list[str]:
    """What the workflow would refuse or leave out, a sentence each; nothing where it would go on.

    Args:
        rows: of the table.
        kind: of the table.
        sizes: of the photos that there are.
        min_inside: labels: fewest clicks inside; where it is one, a box takes its place.
    """
    if not rows:
        return ["Nothing is marked yet."]
    found = [
        f"{photo} is not among the photos, and its clicks ({count}) do not count: was it renamed, or left out by"
        " max_frames?"
        for photo, count in Counter(row.photo for row in rows if row.photo not in sizes).items()
    ]
    for row in rows:
        width, height = sizes.get(row.photo, (row.x_px, row.y_px))
        if not (0 <= row.x_px <= width and 0 <= row.y_px <= height):
            found.append(f"{row.name} at ({row.x_px:g}, {row.y_px:g}) lies outside {row.photo}: remove it.")
    if kind == "labels":
        return found + _label_problems(rows, min_inside)
    times = Counter(row.name for row in rows)
    found += [f"{name} is marked in one photo: click it in another one, too." for name in times if times[name] < 2]
    if kind == "points":
        return found + [f"{len(times)} of at least {MIN_FIDUCIALS} points are marked."] * (len(times) < MIN_FIDUCIALS)
    ends = Counter(label.split("\t")[0] for label in dict.fromkeys(row.label for row in rows))
    return found + [f"{name} has one end: click the other one, too." for name in ends if ends[name] < 2]


def _label_problems(rows: Rows, min_inside: int) -> list[str]:
    corners = Counter(row.photo for row in rows if row.label == "box")
    found = [f"The box in {photo} has {n} corners: drag it again." for photo, n in corners.items() if n != 2]
    inside = sum(row.label == "inside" for row in rows)
    if all(row.label == "outside" for row in rows):
        found.append("There are only clicks outside: click the object itself.")
    elif inside < min_inside and (min_inside > 1 or not corners):
        found.append(f"{inside} of at least {min_inside} clicks inside are there.")
    return found


def _in_photo(label: str, photo: str, x: float, y: float, sizes: Sizes) -> Click:
    """A click, to a tenth of a pixel; StageError where it lies outside its photo."""
    width, height = sizes[photo]
    if not (0 <= x <= width and 0 <= y <= height):
        raise StageError(f"({x:.0f}, {y:.0f}) lies outside {photo}, which has {width} x {height} pixels")
    return Click(label, photo, round(x, 1), round(y, 1))


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
        self.kind, self._past, self._future = kind, [], []
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
        comments = list(filter(is_comment, lines))
        text = "\n".join([*comments, "\t".join(HEADERS[self.kind]), *map(_line, rows)]) + "\n"
        try:
            # A link stays one: what it points to is replaced.
            with atomic_file(self.path.resolve()) as temporary:
                temporary.write_text(text, encoding="utf-8")
        except OSError as error:
            raise StageError(f"{self.path} cannot be written ({error.strerror}); correct that, and repeat it") from None


def digest(path: Path) -> str:
    """SHA-256 of a file's bytes; "" where there is none."""
    try:
        return sha256(path)
    except OSError:
        return ""


def _line(click: Click) -> str:
    line = io.StringIO()
    cells = [*click.label.split("\t"), click.photo, f"{click.x_px:.10g}", f"{click.y_px:.10g}"]
    csv.writer(line, delimiter="\t", lineterminator="").writerow(cells)
    return line.getvalue()
