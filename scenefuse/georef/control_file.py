"""Control and check points in OpenDroneMap's gcp_list.txt."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj

from scenefuse.cloud.crs import read_crs, to_wgs84
from scenefuse.core.stage import StageError
from scenefuse.core.tables import comma_advice, read_lines
from scenefuse.core.transforms import Array
from scenefuse.marks.clicks import Click, in_photos
from scenefuse.marks.triangulation import read_ends
from scenefuse.photos.photo_files import SUFFIXES

# A point whose name begins so is a check point, as OpenDroneMap's users mark it.
CHECK = "CHK-"
# Standard deviations of a point's coordinates, horizontal and vertical, where the file gives none: a GNSS receiver's.
SD_M = (0.02, 0.03)
# Coordinates, standard deviations, photo and pixel.
Row = tuple[Array, tuple[float, float], str, Array]
# Columns; those that are needed come first.
NEEDED = ("x", "y", "z", "pixel_x", "pixel_y", "photo")
LAYOUT = f"{' '.join(NEEDED)} [name [horizontal sd [vertical sd]]]"
MIN_CELLS = len(NEEDED)


@dataclass(frozen=True)
class SurveyedPoint:
    """A point of known coordinates and where it was clicked.

    Attributes:
        name: of the point.
        position: (3,) WGS84 latitude (deg), longitude (deg), height (m; NaN where unknown).
        sd_m: standard deviations of the coordinates, horizontal (of each axis) and vertical.
        check: whether it is only measured, never used.
        clicks: on it, one in each photo.
    """

    name: str
    position: Array
    sd_m: tuple[float, float]
    check: bool
    clicks: list[Click]


@dataclass(frozen=True)
class ControlFile:
    """A file of surveyed points.

    Attributes:
        path: of the file, for messages.
        crs: of its coordinates.
        points: in order of appearance.
    """

    path: Path
    crs: pyproj.CRS
    points: list[SurveyedPoint]


def read_control(path: Path) -> ControlFile:
    """Read a gcp_list.txt: the CRS in the first line, then one click a line, `x y z pixel_x pixel_y photo name`.

    Points without a name are named by their coordinates; z may be NaN. Numbers in the eighth and ninth column are
    standard deviations in metres, horizontal and vertical. Points named CHK-... are check points. Columns are separated
    by tabs, semicolons, commas or blanks. Lines that begin with # are ignored.

    Raises:
        StageError: no such file, no CRS, a line that is not well formed, a name with two positions, a photo clicked
            twice for one point, coordinates outside the CRS.
    """
    lines = read_lines(path)
    crs = read_crs(lines[0][1] if lines else "", str(path))
    rows: dict[str, list[Row]] = {}
    for number, line in lines[1:]:
        name, row = _row(_cells(line.strip()), f"{path}, line {number}")
        rows.setdefault(name, []).append(row)
    if not rows:
        raise StageError(f"{path} holds no points below its first line; write lines {LAYOUT}")
    positions = to_wgs84(crs, np.array([clicks[0][0] for clicks in rows.values()]), str(path))
    points = [_point(name, clicks, place, path) for (name, clicks), place in zip(rows.items(), positions)]
    return ControlFile(path, crs, points)


def _cells(line: str) -> list[str]:
    """The columns of a line; between blanks, a photo's name that holds some ends where a photo's ending does."""
    blank = len(line.split()) >= MIN_CELLS and not line.split()[0].endswith((",", ";"))
    marks = "\t" if blank else "\t;,"
    mark = next((mark for mark in marks if line.count(mark) >= MIN_CELLS - 1), None)
    cells = [cell.strip() for cell in line.split(mark)]
    if mark is None:
        ends = (k for k, cell in enumerate(cells) if k >= MIN_CELLS - 1 and Path(cell).suffix.lower() in SUFFIXES)
        last = next(ends, MIN_CELLS - 1)
        cells[MIN_CELLS - 1 : last + 1] = [" ".join(cells[MIN_CELLS - 1 : last + 1])]
    return cells


def unknown_photo(path: Path, point: str, photo: str, names: Collection[str]) -> StageError:
    """The error of a click in a photo that the scene does not have; it has those of `names`."""
    return StageError(
        f"{path}: point {point} is clicked in {photo}, which is none of the {len(names)} photos"
        f" ({next(iter(names), '')}, ...); correct the name"
    )


def _row(cells: list[str], where: str) -> tuple[str, Row]:
    """Name of the point; its coordinates, standard deviations, photo and pixel."""
    try:
        numbers = np.array([float(cell) for cell in cells[:5]])
        photo = cells[5]
        if not (np.isfinite(numbers[[0, 1, 3, 4]]).all() and photo):
            raise ValueError
    except (ValueError, IndexError):
        raise StageError(f"{where}: expected {LAYOUT}, got '{' '.join(cells)}'{comma_advice(cells[:5])}") from None
    name = cells[6] if len(cells) > 6 and cells[6] else f"{cells[0]} {cells[1]} {cells[2]}"
    stated = [number for cell in cells[7:9] if (number := _number(cell)) is not None]
    if any(sd <= 0 for sd in stated):
        raise StageError(f"{where}: a standard deviation (columns 8 and 9, metres) has to be positive")
    sd_m = (stated[0], stated[-1]) if stated else SD_M
    return name, (numbers[:3], sd_m, photo, numbers[3:])


def _number(cell: str) -> float | None:
    try:
        number = float(cell)
    except ValueError:
        return None
    return number if np.isfinite(number) else None


def _point(name: str, rows: list[Row], position: Array, path: Path) -> SurveyedPoint:
    """One point of its lines."""
    if any(not np.array_equal(row[0], rows[0][0], equal_nan=True) for row in rows):
        raise StageError(f"{path}: the lines of point {name} give different coordinates; correct them, or its name")
    photos = [photo for _, _, photo, _ in rows]
    twice = next((photo for photo in photos if photos.count(photo) > 1), None)
    if twice is not None:
        raise StageError(f"{path}: point {name} is clicked more than once in {twice}; keep one line of it")
    clicks = [Click(name, photo, *pixel.tolist()) for _, _, photo, pixel in rows]
    return SurveyedPoint(name, position, rows[0][1], name.upper().startswith(CHECK), clicks)


def check_survey_files(names: list[str], control: Path | None = None, lengths: Path | None = None) -> None:
    """Check that the files of a survey can be read, and that their clicks are in photos of these names.

    Raises:
        StageError: what `read_control` and `read_ends` say; a click in a photo that does not exist.
    """
    clicked: list[tuple[Path, list[Click]]] = []
    if control is not None:
        clicked.append((control, [click for point in read_control(control).points for click in point.clicks]))
    if lengths is not None:
        clicked.append((lengths, list(read_ends(lengths).rows)))
    for path, clicks in clicked:
        for click in in_photos(clicks, names, path):
            if click.photo not in names:
                raise unknown_photo(path, click.name, click.photo, names)
