"""Clicks of one table as a person edits them: pure functions of immutable rows, and their history."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

from scenefuse.core.stage import StageError
from scenefuse.marks.clicks import Click, Kind, length_label

ENDS = ("a", "b")
"""Of a length that is new."""
Sizes = Mapping[str, tuple[int, int]]
"""Photo name -> (width, height), the pixels that clicks in it are in."""

SMALLEST_BOX_PX = 4
LEAST_POINTS = 4
"""Points that bound an object in the scene."""


Rows = tuple[Click, ...]


class History:
    """Rows, and what they were before and after an undo."""

    def __init__(self, rows: Rows = ()) -> None:
        self.rows = rows
        self._past: list[Rows] = []
        self._future: list[Rows] = []

    def change(self, rows: Rows) -> None:
        """Replace the rows; what was undone can no longer be redone."""
        if rows != self.rows:
            self._past.append(self.rows)
            self._future.clear()
            self.rows = rows

    def undo(self) -> bool:
        """One change back; False where there is none."""
        return self._step(self._past, self._future)

    def redo(self) -> bool:
        """One undone change forward; False where there is none."""
        return self._step(self._future, self._past)

    def _step(self, source: list[Rows], target: list[Rows]) -> bool:
        if not source:
            return False
        target.append(self.rows)
        self.rows = source.pop()
        return True


def with_label(rows: Rows, label: str, photo: str, x: float, y: float, sizes: Sizes) -> Rows:
    """The rows and a click inside or outside.

    Raises:
        StageError: it lies outside the photo, or was clicked already.
    """
    click = _checked(label, photo, x, y, sizes)
    for other in rows:
        if other.label != "box" and (other.photo, other.x_px, other.y_px) == (photo, click.x_px, click.y_px):
            raise StageError(f"({click.x_px:g}, {click.y_px:g}) in {photo} is already marked {other.label}")
    return (*rows, click)


def with_box(rows: Rows, photo: str, corners: tuple[tuple[float, float], tuple[float, float]], sizes: Sizes) -> Rows:
    """The rows with a box, cut to the photo, in the place of the photo's former one.

    Raises:
        StageError: next to nothing of it lies in the photo.
    """
    width, height = sizes[photo]
    columns, lines = (sorted(min(max(c[k], 0.0), size) for c in corners) for k, size in ((0, width), (1, height)))
    if columns[1] - columns[0] < SMALLEST_BOX_PX or lines[1] - lines[0] < SMALLEST_BOX_PX:
        raise StageError(f"the box in {photo} is too small; drag it around the whole object")
    kept = tuple(row for row in rows if (row.label, row.photo) != ("box", photo))
    return (*kept, *(_checked("box", photo, x, y, sizes) for x, y in zip(columns, lines)))


def with_point(rows: Rows, name: str, photo: str, x: float, y: float, sizes: Sizes) -> Rows:
    """The rows with a named point in a photo, moved where it was there already.

    Raises:
        StageError: it lies outside the photo, or the name is empty or cannot stand in a table.
    """
    return with_end(rows, _name(name, "point"), photo, x, y, sizes)


def with_end(rows: Rows, label: str, photo: str, x: float, y: float, sizes: Sizes) -> Rows:
    """The rows with an end of a length in a photo, moved where it was there already.

    Raises:
        StageError: it lies outside the photo.
    """
    click = _checked(label, photo, x, y, sizes)
    place = next((k for k, row in enumerate(rows) if (row.label, row.photo) == (label, photo)), len(rows))
    return (*rows[:place], click, *rows[place + 1 :])


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
        if not 0 < metres < float("inf"):
            raise ValueError
    except ValueError:
        raise StageError("write a name and a length in metres: bar 1.5") from None
    name = _name(name, "length")
    cells = [row.label.split("\t") for row in rows]
    ends = list(dict.fromkeys([cell[2] for cell in cells if cell[0] == name] + list(ENDS)))
    changed = [
        replace(row, label=length_label(name, metres, cell[2])) if cell[0] == name else row
        for row, cell in zip(rows, cells)
    ]
    return tuple(changed), (length_label(name, metres, ends[0]), length_label(name, metres, ends[1]))


def without_nearest(rows: Rows, photo: str, x: float, y: float, within_px: float) -> Rows:
    """The rows without the click of a photo that is nearest to a pixel; with a corner goes its whole box."""
    near = [((r.x_px - x) ** 2 + (r.y_px - y) ** 2, k) for k, r in enumerate(rows) if r.photo == photo]
    if not near or min(near)[0] > within_px**2:
        return rows
    gone = rows[min(near)[1]]
    if gone.label == "box":
        return tuple(row for row in rows if (row.label, row.photo) != ("box", photo))
    return tuple(row for row in rows if row is not gone)


def merged(base: Rows, mine: Rows, theirs: Rows) -> Rows:
    """Theirs, with what I added to the base and without what I removed from it; a box or point that both moved is
    mine."""
    added, removed = [row for row in mine if row not in base], set(base) - set(mine)
    replaced = {(row.label, row.photo) for row in added if row.label not in ("inside", "outside")}
    kept = [row for row in theirs if row not in removed and (row.label, row.photo) not in replaced]
    boxes = [row for row in mine if row.label == "box" and (row.label, row.photo) in replaced and row not in added]
    return tuple(kept) + tuple(row for row in (*boxes, *added) if row not in kept)


def difference(old: Rows, new: Rows) -> str:
    """What changed between two states, for a person: "2 added, 1 removed"."""
    added, removed = len(set(new) - set(old)), len(set(old) - set(new))
    words = [f"{count} {what}" for count, what in ((added, "added"), (removed, "removed")) if count]
    return ", ".join(words) or "no difference"


def problems(rows: Rows, kind: Kind, sizes: Sizes, least_inside: int = 1) -> list[str]:
    """What the workflow would refuse or leave out, a sentence each; nothing where it would go on.

    Args:
        rows: of the table.
        kind: of the table.
        sizes: of the photos that there are.
        least_inside: labels: fewest clicks inside, where no box takes their place.
    """
    if not rows:
        return ["Nothing is marked yet."]
    found = []
    for photo, count in Counter(row.photo for row in rows if row.photo not in sizes).items():
        found.append(
            f"{photo} is not among the photos ({count} clicks): was it renamed, or left out by max_frames?"
            " Its clicks do not count."
        )
    for row in rows:
        width, height = sizes.get(row.photo, (row.x_px, row.y_px))
        if not (0 <= row.x_px <= width and 0 <= row.y_px <= height):
            found.append(f"{row.name} at ({row.x_px:g}, {row.y_px:g}) lies outside {row.photo}: remove it.")
    if kind == "labels":
        return found + _label_problems(rows, least_inside)
    found += [
        f"{row.name} is marked in one photo: click it in another one, too."
        for row in rows
        if sum(other.label == row.label for other in rows) < 2
    ]
    return found + (_point_problems(rows) if kind == "points" else _length_problems(rows))


def _label_problems(rows: Rows, least_inside: int) -> list[str]:
    corners = Counter(row.photo for row in rows if row.label == "box")
    found = [f"The box in {photo} has {n} corners: drag it again." for photo, n in corners.items() if n != 2]
    if all(row.label == "outside" for row in rows):
        found.append("There are only clicks outside: click the object itself.")
    elif (inside := sum(row.label == "inside" for row in rows)) < least_inside and (least_inside > 1 or not corners):
        found.append(f"{inside} of at least {least_inside} clicks inside are there.")
    return found


def _point_problems(rows: Rows) -> list[str]:
    count = len({row.label for row in rows})
    return [f"{count} of at least {LEAST_POINTS} points are marked."] if count < LEAST_POINTS else []


def _length_problems(rows: Rows) -> list[str]:
    metres: dict[str, set[str]] = {}
    ends: dict[str, set[str]] = {}
    for name, long, end in (row.label.split("\t") for row in rows):
        metres.setdefault(name, set()).add(long)
        ends.setdefault(name, set()).add(end)
    found = [f"{name} has one end: click the other one, too." for name in ends if len(ends[name]) < 2]
    return found + [f"{name} is {' and '.join(m)} m: write it again." for name, m in metres.items() if len(m) > 1]


def _name(name: str, what: str) -> str:
    name = name.strip()
    if not name or not name.isprintable() or name.startswith("#"):
        raise StageError(f"a {what} needs a name of printable characters that does not begin with #")
    return name


def _checked(label: str, photo: str, x: float, y: float, sizes: Sizes) -> Click:
    width, height = sizes[photo]
    if not (0 <= x <= width and 0 <= y <= height):
        raise StageError(f"({x:.0f}, {y:.0f}) lies outside {photo}, which has {width} x {height} pixels")
    return Click(label, photo, round(x, 1), round(y, 1))
