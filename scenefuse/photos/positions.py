"""Positions of photos and their accuracy: RTK and PPK values in XMP, and OpenDroneMap's geo.txt beside the photos."""

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.cloud.crs import read_crs, to_wgs84
from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_lines
from scenefuse.core.transforms import Array
from scenefuse.photos.photo_files import photos_by_name

LAYOUT = "photo x y [z [yaw pitch roll [horizontal sd [vertical sd]]]]"
# XMP names of standard deviations in metres, as attributes or elements: DJI's, then Pix4D's (Parrot, senseFly, ...).
EAST, NORTH, UP = (
    re.compile(rb"drone-dji:RtkStd%s\s*(?:=\s*[\"']|>)\s*([-+\d.eE]+)" % n) for n in (b"Lon", b"Lat", b"Hgt")
)
HORIZONTAL, VERTICAL = (
    re.compile(rb"Camera:GPS%sAccuracy\s*(?:=\s*[\"']|>)\s*([-+\d.eE]+)" % n) for n in (b"XY", b"Z")
)


@dataclass(frozen=True)
class Position:
    """Where a photo was taken.

    Attributes:
        latitude_deg, longitude_deg: WGS84.
        altitude_m: None where unknown.
        horizontal_sd_m, vertical_sd_m: standard deviations; None where unknown.
    """

    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    horizontal_sd_m: float | None = None
    vertical_sd_m: float | None = None


def rtk_accuracy(xmp: bytes) -> tuple[float | None, float | None]:
    """Standard deviations (m) of a photo's position, horizontal (of one axis) and vertical, that its XMP states."""
    east, north, up = (_first(pattern, xmp) for pattern in (EAST, NORTH, UP))
    if east is not None and north is not None:
        return float(np.sqrt((east**2 + north**2) / 2)), up
    return _first(HORIZONTAL, xmp), _first(VERTICAL, xmp)


def _first(pattern: re.Pattern[bytes], xmp: bytes) -> float | None:
    """A positive number in XMP, or None."""
    found = pattern.search(xmp)
    try:
        number = float(found[1]) if found else 0.0
    except ValueError:
        return None
    return number if np.isfinite(number) and number > 0 else None


def read_geo(path: Path) -> dict[str, Position]:
    """Read a geo.txt: the CRS in the first line, then `photo x y [z [yaw pitch roll [sd [vertical sd]]]]`.

    Returns:
        Photo name -> position. Angles are not used; a standard deviation of 0 is an unknown one.

    Raises:
        StageError: no CRS, a line that is not well formed, a photo given twice, positions outside the CRS.
    """
    lines = read_lines(path)
    crs = read_crs(lines[0][1] if lines else "", str(path))
    names: list[str] = []
    rows: list[list[float]] = []
    for number, line in lines[1:]:
        cells = [cell.strip() for cell in line.split("\t")] if "\t" in line.strip() else line.split()
        try:
            values = [float(cell) for cell in cells[1:9]]
            if len(values) < 2 or not np.isfinite(values[:2]).all():
                raise ValueError
        except ValueError:
            raise StageError(f"{path}, line {number}: expected {LAYOUT}, got '{' '.join(cells)}'") from None
        if cells[0] in names:
            raise StageError(f"{path}, line {number}: {cells[0]} is given more than once; keep one line of it")
        names.append(cells[0])
        rows.append(values + [np.nan] * (8 - len(values)))
    if not rows:
        raise StageError(f"{path} holds no positions below its first line; write lines {LAYOUT}, or remove it")
    table: Array = np.array(rows)
    places = to_wgs84(crs, table[:, :3], str(path))
    return {name: _position(place, row[6:8]) for name, place, row in zip(names, places, table)}


def positions_of(names: list[str], positions: dict[str, Position], path: Path) -> list[dict[str, Any]]:
    """The fields of a `Position` of each photo, None where the file has none.

    Raises:
        StageError: the file names none of the photos; what `photos_by_name` says.
    """
    found = {photo: name for name, photo in photos_by_name(positions, names, str(path)).items()}
    if not found:
        raise StageError(
            f"{path} names none of the photos beside it: it names {next(iter(positions))}, a photo is {names[0]};"
            " correct the names, or remove the file"
        )
    return [asdict(positions[found[name]] if name in found else Position()) for name in names]


def _position(place: Array, sd: Array) -> Position:
    horizontal, vertical = (float(s) if np.isfinite(s) and s > 0 else None for s in sd)
    altitude = float(place[2]) if np.isfinite(place[2]) else None
    return Position(float(place[0]), float(place[1]), altitude, horizontal, vertical or horizontal)
