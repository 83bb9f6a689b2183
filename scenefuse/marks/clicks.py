"""Clicks in photos: their types, the tables that hold them, and checks of both before any photo is matched.

The workflow imports this whenever it plans: nothing here takes long to import.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.tables import comma_advice, read_cells
from scenefuse.photos.photo_files import photos_by_name, upright_size

Array = NDArray[np.float64]
Cells = list[str]
Lines = list[tuple[int, Cells]]
Kind = Literal["labels", "points", "lengths"]
HEADERS: dict[Kind, Cells] = {
    "labels": ["label", "photo", "x_px", "y_px"],
    "points": ["point", "photo", "x_px", "y_px"],
    "lengths": ["length", "metres", "end", "photo", "x_px", "y_px"],
}
COORDINATES = ["point", "x", "y", "z"]
LABELS = ("inside", "outside", "box")


@dataclass(frozen=True)
class Click:
    """One line of a table: a pixel that a person clicked.

    Attributes:
        label: inside, outside or box (a corner); or the name of a point; or name, metres and end of a known length,
            tabs between them.
        photo: name of the photo.
        x_px, y_px: pixels of the original photo as people see it, pixel centres at +0.5.
    """

    label: str
    photo: str
    x_px: float
    y_px: float

    @property
    def pixel(self) -> Array:
        """(2,) the pixel."""
        return np.array([self.x_px, self.y_px])

    @property
    def name(self) -> str:
        """The label for a person."""
        return label_name(self.label)

    def __str__(self) -> str:
        on = f"the click {self.label}" if self.label in LABELS else f"the click on {self.name}"
        return f"{on} at ({self.x_px:g}, {self.y_px:g})"


@dataclass(frozen=True)
class Clicks:
    """A table of clicks.

    Attributes:
        path: the file they come from, for messages.
        kind: what their labels are.
        rows: its lines; a point or an end has one for each photo it was clicked in, a box two, opposite corners.
    """

    path: Path
    kind: Kind
    rows: tuple[Click, ...]

    @property
    def labels(self) -> list[str]:
        """N labels."""
        return [click.label for click in self.rows]

    @property
    def photos(self) -> list[str]:
        """N names of photos."""
        return [click.photo for click in self.rows]

    @property
    def pixels(self) -> Array:
        """(N, 2) pixels."""
        return np.array([(click.x_px, click.y_px) for click in self.rows]).reshape(-1, 2)

    def check_twice(self) -> None:
        """Raise StageError where a point or an end is clicked in one photo only, as one is whose name is misspelled."""
        times = Counter(self.labels)
        for click in (click for click in self.rows if times[click.label] < 2):
            raise StageError(f"{self.path}: {click.name} is clicked in {click.photo} only; click it in another one")


@dataclass(frozen=True)
class ScenePoints:
    """Points given by their coordinates in the scene frame.

    Attributes:
        path: the file they come from, for messages.
        points: N point names.
        positions: (N, 3) coordinates.
    """

    path: Path
    points: list[str]
    positions: Array


def in_photos(clicks: Iterable[Click], photos: Iterable[str], path: Path) -> list[Click]:
    """Clicks with the names of these photos, where their file calls them a little otherwise; see `photos_by_name`."""
    clicks = list(clicks)
    found = photos_by_name([click.photo for click in clicks], photos, str(path))
    return [replace(click, photo=found.get(click.photo, click.photo)) for click in clicks]


def read_points(path: Path) -> Clicks | ScenePoints:
    """Read a tab-separated file of labelled pixels (label, photo, x_px, y_px), clicked points (point, photo, x_px,
    y_px) or scene points (point, x, y, z).

    Scene points may be separated by semicolons, commas or spaces too; without a header, or with `x y z`, a line is
    x y z, perhaps behind a name, and points without a name are called 1, 2, ... in their order.

    Raises:
        StageError: the file is missing or empty, its header is none of these, or a line is not well formed.
    """
    lines = read_cells(path)
    loose = [(number, _words(cells)) for number, cells in lines]
    first = loose[0][1] if loose else []
    if first in (COORDINATES, COORDINATES[1:]) or _is_point(first):
        return _scene_points(path, loose[not _is_point(first) :])
    kind: Kind | None = next((kind for kind in ("labels", "points") if lines and lines[0][1] == HEADERS[kind]), None)
    if kind is None:
        if first in HEADERS.values():
            raise StageError(
                f"{path}: separate its columns by tabs (one between two columns); names of photos may hold spaces"
            )
        raise StageError(
            f"{path} has to begin with the tab-separated header 'point photo x_px y_px' or 'point x y z' or 'label"
            f" photo x_px y_px', not with '{' '.join(lines[0][1] if lines else [])}'{comma_advice(first)}"
        )
    return _clicks(path, kind, lines[1:])


def read_length_clicks(path: Path) -> Clicks:
    """Read a tab-separated file of clicks on the ends of known lengths (length, metres, end, photo, x_px, y_px),
    whether both ends are clicked or not.

    Raises:
        StageError: no such file, a line that is not well formed, a length that is not positive or given twice with
            different values.
    """
    lines = read_cells(path)
    if not lines or lines[0][1] != HEADERS["lengths"]:
        raise StageError(f"{path} has to begin with the tab-separated header '{' '.join(HEADERS['lengths'])}'")
    found = _clicks(path, "lengths", lines[1:])
    metres: dict[str, str] = {}
    for (number, _), click in zip(lines[1:], found.rows):
        name, long, _ = click.label.split("\t")
        if metres.setdefault(name, long) != long or float(long) <= 0:
            raise StageError(f"{path}, line {number}: {name} is {long} m here; give one positive length, in metres")
    return found


def length_label(name: str, metres: float, end: str) -> str:
    """The label of an end of a known length."""
    return f"{name}\t{metres:.10g}\t{end}"


def label_name(label: str) -> str:
    """A label for a person: the end of a length as `bar, 1.5 m: a`."""
    name, *length = label.split("\t")
    return f"{name}, {length[0]} m: {length[1]}" if length else name


def _clicks(path: Path, kind: Kind, lines: Lines) -> Clicks:
    """The clicks of the lines below a header."""
    if not lines:
        wanted = {"labels": "click on the object", "points": "mark at least four points on the object"}
        raise StageError(f"{path} holds no points below its header; {wanted.get(kind, 'click both ends of a length')}")
    rows = tuple(_click(path, kind, number, cells) for number, cells in lines)
    if all(0 <= number < 1 for click in rows for number in click.pixel):
        raise StageError(
            f"{path}: all clicks are within the first pixel; multiply shares by a photo's width and height"
        )
    # One click marks a point in a photo, and one label a pixel, where a box may begin too; ends of lengths are checked
    # by `read_ends`.
    marks = [(c.photo, (c.label == "box", c.x_px, c.y_px) if kind == "labels" else c.label) for c in rows]
    for click, mark in zip(rows, marks):
        if kind != "lengths" and marks.count(mark) > 1:
            what = f"({click.x_px:g}, {click.y_px:g})" if kind == "labels" else click.name
            raise StageError(f"{path}: {what} in {click.photo} is given more than once; keep one line of it")
    return Clicks(path, kind, rows)


def _click(path: Path, kind: Kind, number: int, cells: Cells) -> Click:
    """The click of a line."""
    header = HEADERS[kind]
    numeric = [cell for cell, column in zip(cells, header) if column in ("metres", "x_px", "y_px")]
    try:
        *metres, x, y = map(float, numeric)
        if len(cells) != len(header) or not np.isfinite([*metres, x, y]).all():
            raise ValueError
    except ValueError:
        raise StageError(
            f"{path}, line {number}: expected {' '.join(header)} separated by tabs, got '{' '.join(cells)}'"
            f"{comma_advice(numeric)}"
        ) from None
    if kind == "labels" and cells[0] not in LABELS:
        raise StageError(f"{path}, line {number}: the label is {', '.join(LABELS)}, not '{cells[0]}'")
    label = length_label(cells[0], metres[0], cells[2]) if kind == "lengths" else cells[0]
    return Click(label, cells[-3], x, y)


def _words(cells: Cells) -> Cells:
    """The cells of a line that tabs do not separate, by semicolons, commas or blanks."""
    if len(cells) > 1:
        return cells
    mark = next((mark for mark in ";," if mark in cells[0]), None)
    return [word.strip() for word in cells[0].split(mark)]


def _is_point(words: Cells) -> bool:
    """Whether a line is x y z, perhaps behind a name."""
    try:
        return len(words) in (3, 4) and bool(np.isfinite([float(word) for word in words[-3:]]).all())
    except ValueError:
        return False


def _scene_points(path: Path, lines: Lines) -> ScenePoints:
    """Points of the lines below the header; those without a name are numbered."""
    if not lines:
        raise StageError(f"{path} holds no points below its header; mark at least four points on the object")
    for number, words in lines:
        if not _is_point(words):
            raise StageError(
                f"{path}, line {number}: expected x y z, perhaps behind a name, got '{' '.join(words)}'"
                f"{comma_advice(words)}"
            )
    names = [words[0] if len(words) == 4 else str(index) for index, (_, words) in enumerate(lines, 1)]
    twice = next((name for name, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise StageError(f"{path}: {twice} is given more than once; keep one line of it")
    return ScenePoints(path, names, np.array([[float(word) for word in words[-3:]] for _, words in lines]))


def check_inside(path: Path, click: Click, size: tuple[int, int]) -> None:
    """Raise StageError where a click lies outside its photo of this (width, height)."""
    if not (0 <= click.x_px <= size[0] and 0 <= click.y_px <= size[1]):
        raise StageError(
            f"{path}: {click} lies outside {click.photo}, which has {size[0]} x {size[1]} pixels; correct the click"
        )


def check_marks(path: Path, photos: Mapping[str, Path] | None = None, used: list[str] | None = None) -> None:
    """Check that a file of clicks or points can be read, and that its clicks are in photos that will be used.

    Args:
        path: of the file.
        photos: the photos' files, by the names that they will have; None where they are not known yet.
        used: those of them that will be used; None for all.

    Raises:
        StageError: what `read_points` says; no click inside and no box; half a box; a point in one photo only; a click
            in a photo that does not exist, will not be used or cannot be read, or outside its photo.
    """
    marked = read_points(path)
    if isinstance(marked, ScenePoints):
        return
    if marked.kind == "labels":
        if set(marked.labels) == {"outside"}:
            raise StageError(f"{path} holds only clicks outside the object; add a few inside it, or a box around it")
        boxes = Counter(click.photo for click in marked.rows if click.label == "box")
        if odd := [photo for photo, corners in boxes.items() if corners != 2]:
            raise StageError(
                f"{path}: a box needs two lines, two opposite corners; in {odd[0]} there are {boxes[odd[0]]}"
            )
    else:
        marked.check_twice()
    if photos is None:
        return
    names = list(photos) if used is None else used
    sizes: dict[str, tuple[int, int]] = {}
    for click, written in zip(in_photos(marked.rows, photos, path), marked.rows):
        photo = click.photo
        if photo not in photos:
            raise StageError(
                f"{path}: {click} is in {photo}, which is none of the {len(photos)} photos"
                f" ({next(iter(photos))}, ...); correct the name"
            )
        if photo not in names:
            raise StageError(
                f"{path}: {click} is in {photo}, but only {len(names)} of the {len(photos)} photos are used"
                f" (object.frames), and this is none of them: click in one that is ({names[0]}, ...), or set"
                f" max_frames to {len(photos)} and frame_step to 1"
            )
        if photo not in sizes:
            sizes[photo] = upright_size(photos[photo])
        # A copy in another folder, which is left out.
        named = next((f for up in photos[photo].parents if (f := up / written.photo).is_file()), photos[photo])
        if named != photos[photo] and upright_size(named) != sizes[photo]:
            raise StageError(f"{path}: {click} is in {written.photo}, a smaller copy of {photo}; click in that one")
        check_inside(path, click, sizes[photo])
