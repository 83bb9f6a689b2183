"""Control and check points: their file, OpenDroneMap's gcp_list.txt, and where the cameras of a model see them."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyproj

from scenefuse.cloud.crs import grid_name, read_crs, to_wgs84
from scenefuse.core.stage import StageError
from scenefuse.core.tables import comma_advice, read_lines
from scenefuse.core.transforms import FIXING_POINTS, Array, Sim3, along_a_line
from scenefuse.marks.clicks import Click, in_photos
from scenefuse.marks.triangulation import MAX_CLICK_MISS, intersect, model_pixel, read_ends
from scenefuse.photos.photos import Photo
from scenefuse.photos.positions import cells_of, exif_number
from scenefuse.photos.workspace import images_by_name

if TYPE_CHECKING:
    import pycolmap

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
        name, row = _row(cells_of(line, MIN_CELLS - 1, MIN_CELLS), f"{path}, line {number}")
        rows.setdefault(name, []).append(row)
    if not rows:
        raise StageError(f"{path} holds no points below its first line; write lines {LAYOUT}")
    positions = to_wgs84(crs, np.array([clicks[0][0] for clicks in rows.values()]), str(path))
    points = [_point(name, clicks, place, path) for (name, clicks), place in zip(rows.items(), positions)]
    return ControlFile(path, crs, points)


def unknown_photo(path: Path, point: str, photo: str, names: Collection[str]) -> StageError:
    """The error of a click in a photo that the scene does not have; it has those of `names`."""
    return StageError(
        f"{path}: point {point} is clicked in {photo}, which is none of the {len(names)} photos"
        f" ({next(iter(names), '')}, ...); correct the name"
    )


def _row(cells: list[str], where: str) -> tuple[str, Row]:
    """Name of the point; its coordinates, standard deviations, photo and pixel."""
    try:
        numbers = np.array([float(cell or "nan") for cell in cells[:5]])
        photo = cells[5]
        if not (np.isfinite(numbers[[0, 1, 3, 4]]).all() and photo):
            raise ValueError
    except (ValueError, IndexError):
        raise StageError(f"{where}: expected {LAYOUT}, got '{' '.join(cells)}'{comma_advice(cells[:5])}") from None
    name = cells[6] if len(cells) > 6 and cells[6] else f"{cells[0]} {cells[1]} {cells[2]}"
    stated = [exif_number(cell) or 0.0 for cell in cells[7:9] if re.match(r"[-+.]*\d", cell)]
    if min(stated, default=1.0) <= 0:
        advice = comma_advice(cells[7:9])
        raise StageError(f"{where}: a standard deviation (columns 8 and 9, metres) has to be a positive number{advice}")
    sd_m = (stated[0], stated[-1]) if stated else SD_M
    return name, (numbers[:3], sd_m, photo, numbers[3:])


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


@dataclass(frozen=True)
class LocatedPoint:
    """A surveyed point as a model's cameras see it.

    Attributes:
        point: the point, with the clicks that agree, in pixels of the model's photos.
        x_in_model: (3,) its place by these clicks; NaN where they give none.
        problem: why it takes no part, or "".
    """

    point: SurveyedPoint
    x_in_model: Array
    problem: str = ""


@dataclass(frozen=True)
class Control:
    """A file of surveyed points, found in a model.

    Attributes:
        path: of the file, for messages.
        grid: the projected CRS of the coordinates, "" for a geographic one.
        located: of every point in the file.
        notes: a line for every click and point that is left out.
    """

    path: Path
    grid: str
    located: list[LocatedPoint]
    notes: list[str]

    @property
    def only_checks(self) -> bool:
        """Whether all points are check points, as beside RTK positions."""
        return all(s.point.check for s in self.located)


def read_control_points(path: Path, model: pycolmap.Reconstruction, photos: list[Photo]) -> Control:
    """Read surveyed points and find them in a model.

    Raises:
        StageError: what `read_control` and `locate_points` say; fewer than three control points that can be used, and
            others than check points.
    """
    surveyed = read_control(path)
    located, notes = locate_points(surveyed, model, {p.name: (p.width, p.height) for p in photos})
    good = [s for s in located if not (s.problem or s.point.check) and np.isfinite(s.point.position).all()]
    found = Control(path, grid_name(surveyed.crs), located, notes)
    if len(good) < FIXING_POINTS and not found.only_checks:
        reasons = "; ".join(f"{s.point.name}: {s.problem}" for s in located if s.problem and not s.point.check)
        raise StageError(
            f"{path}: {len(good)} control points with a height can be used, {FIXING_POINTS} are needed"
            f"{f' ({reasons})' if reasons else ''}; click more points, each in two photos or more"
        )
    return found


def locate_points(
    control: ControlFile, model: pycolmap.Reconstruction, sizes: Mapping[str, tuple[int, int]]
) -> tuple[list[LocatedPoint], list[str]]:
    """Find each surveyed point by its clicks, and say which clicks are left out and why.

    Clicks that do not agree with most of the others on the point are left out; so are those in photos that are not
    registered. A point with fewer than two clicks, or whose clicks contradict each other, takes no part.

    Args:
        control: points and clicks.
        model: of the photos clicked in.
        sizes: photo name -> (width, height), of every photo listed.

    Raises:
        StageError: a click in a photo that does not exist, or outside its photo.
    """
    images = images_by_name(model)
    located, notes = [], []
    for point in control.points:
        seen, lost = [], []
        for click in in_photos(point.clicks, sizes, control.path):
            photo = click.photo
            if photo not in sizes:
                raise unknown_photo(control.path, point.name, photo, sizes)
            if photo in images:
                x_px, y_px = model_pixel(control.path, click, images[photo], sizes).tolist()
                seen.append(Click(point.name, images[photo].name, x_px, y_px))
            else:
                lost.append(photo)
        notes += [f"{point.name}: {photo} could not be registered, its click is left out" for photo in lost]
        located_point, dropped = _agreed(replace(point, clicks=seen), images)
        located.append(located_point)
        notes += dropped + ([f"{point.name} is left out: {located_point.problem}"] if located_point.problem else [])
    return located, notes


def _agreed(point: SurveyedPoint, images: Mapping[str, pycolmap.Image]) -> tuple[LocatedPoint, list[str]]:
    """A point by the largest set of its clicks that agree, and a line for every other click."""
    nowhere = LocatedPoint(point, np.full(3, np.nan))
    if len(point.clicks) < 2:
        where = f"in {point.clicks[0].photo} only" if point.clicks else "in no registered photo"
        return replace(nowhere, problem=f"it is clicked {where}; click it in two or more"), []
    seen, pixels = [images[click.photo] for click in point.clicks], np.array([click.pixel for click in point.clicks])
    limit = np.array([MAX_CLICK_MISS * max(i.camera.width, i.camera.height) for i in seen if i.camera is not None])
    everyone = tuple(range(len(seen)))
    found: dict[tuple[int, ...], Array] = {}
    for chosen in [everyone, *combinations(everyone, 2)]:
        position, _ = intersect([seen[k] for k in chosen], pixels[list(chosen)])
        if position is not None:
            agree = tuple(int(k) for k in np.flatnonzero(off_px(position, seen, pixels) <= limit))
            if set(chosen) <= set(agree):
                found.setdefault(agree, position)
        if everyone in found:
            break
    most = max((len(agree) for agree in found), default=0)
    best = [agree for agree in found if len(agree) == most]
    if len(best) != 1:
        position, _ = intersect(seen, pixels)
        off = [np.inf] * len(seen) if position is None else off_px(position, seen, pixels)
        miss = ", ".join(f"{click.photo} {px:.0f} px" for click, px in zip(point.clicks, off))
        return replace(nowhere, problem=f"its clicks contradict each other ({miss}); correct them"), []
    agree = best[0]
    position, _ = intersect([seen[k] for k in agree], pixels[list(agree)])
    assert position is not None
    off = off_px(position, seen, pixels)
    dropped = [
        f"{point.name}: the click in {click.photo} is {off[k]:.0f} px off where {most} others show the point, and is"
        " left out"
        for k, click in enumerate(point.clicks)
        if k not in agree
    ]
    return LocatedPoint(replace(point, clicks=[point.clicks[k] for k in agree]), position), dropped


def off_px(position: Array, images: list[pycolmap.Image], pixels: Array) -> Array:
    """(N,) distances of a point (3,) in photos from pixels (N, 2); infinite behind a camera."""
    seen = [image.project_point(position) for image in images]
    return np.array([np.inf if at is None else np.linalg.norm(at - pixel) for at, pixel in zip(seen, pixels)])


def check_spread(target: Array, names: list[str], where: str) -> None:
    """StageError where points (N, 3; metres) lie at one place or along one line."""
    if along_a_line(target):
        raise StageError(
            f"{where}: the control points {', '.join(names)} lie along one line, which leaves the model free to turn"
            " about it; add one beside the line"
        )


def seen_at(located: list[LocatedPoint], model: pycolmap.Reconstruction) -> tuple[Array, Array]:
    """Places (N, 3) of points in a model by their clicks, and RMS distances (N,) of clicks from these, in pixels.

    NaN where clicks give nothing.
    """
    images = images_by_name(model)
    places, rms_px = np.full((len(located), 3), np.nan), np.full(len(located), np.nan)
    for row, located_point in enumerate(located):
        if not located_point.problem:
            seen = [images[click.photo] for click in located_point.point.clicks]
            position, residual = intersect(seen, np.array([click.pixel for click in located_point.point.clicks]))
            if position is not None:
                places[row], rms_px[row] = position, residual
    return places, rms_px


def describe_misses(located_point: LocatedPoint, local_from_model: Sim3, target: Array) -> str:
    """How far a point (3,) is from its coordinates, and where it was clicked."""
    miss = float(np.sqrt(np.nansum((local_from_model.apply(located_point.x_in_model) - target) ** 2)))
    photos = ", ".join(click.photo for click in located_point.point.clicks)
    return f"by its clicks in {photos} it lies {miss:.2f} m from its coordinates; correct these or the clicks"
