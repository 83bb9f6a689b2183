"""Edits of one table of clicks: pure functions of immutable rows, and what the workflow would refuse in them."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

from scenefuse.core.stage import StageError
from scenefuse.crop.crop_scene import MIN_FIDUCIALS
from scenefuse.marks.clicks import Click, Kind, length_label

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
        StageError: next to nothing of it lies in the photo.
    """
    (x0, x1), (y0, y1) = (sorted(min(max(c[k], 0.0), sizes[photo][k]) for c in corners) for k in (0, 1))
    if min(x1 - x0, y1 - y0) < 1:
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
    if not name or not name.isprintable() or name.startswith("#"):
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
        if not 0 < metres < float("inf"):
            raise ValueError
    except ValueError:
        raise StageError("write a name and a length in metres: bar 1.5") from None
    name = point_name(name)
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
    ends = {(name, end) for name, _, end in (row.label.split("\t") for row in rows)}
    metres = {(name, long) for name, long, _ in (row.label.split("\t") for row in rows)}
    for name in dict.fromkeys(row.label.split("\t")[0] for row in rows):
        if sum(other == name for other, _ in ends) < 2:
            found.append(f"{name} has one end: click the other one, too.")
        if sum(other == name for other, _ in metres) > 1:
            found.append(f"{name} has two lengths: write it again.")
    return found


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
