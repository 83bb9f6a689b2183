"""Positions of photos and their accuracy: by EXIF, by XMP (RTK and PPK), and by OpenDroneMap's geo.txt beside them."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.cloud.crs import read_crs, to_wgs84
from scenefuse.core.stage import StageError
from scenefuse.core.tables import comma_advice, read_lines
from scenefuse.core.transforms import Array
from scenefuse.photos.geodesy import MAX_GPS_OFF_M, local_frame
from scenefuse.photos.photo_files import SUFFIXES, photos_by_name

LAYOUT = "photo x y [z [yaw pitch roll [horizontal sd [vertical sd]]]]"


def _xmp(names: str, value: str) -> re.Pattern[bytes]:
    """XMP properties, as attributes or elements."""
    return re.compile(rf"(?:{names})\s*(?:=\s*[\"']|>)\s*({value})".encode())


# Standard deviations in metres: DJI's, then Pix4D's (Parrot, senseFly, ...).
EAST, NORTH, UP = (_xmp(f"drone-dji:RtkStd{name}", r"[-+\d.eE/]+") for name in ("Lon", "Lat", "Hgt"))
HORIZONTAL, VERTICAL = (_xmp(f"Camera:GPS{name}Accuracy", r"[-+\d.eE/]+") for name in ("XY", "Z"))
# Positions; DJI spells longitude in two ways.
LATITUDE = _xmp("drone-dji:(?:Gps)?Latitude|exif:GPSLatitude", "[^\"'<]{1,60}")
LONGITUDE = _xmp("drone-dji:(?:Gps)?Longt?itude|exif:GPSLongitude", "[^\"'<]{1,60}")
ALTITUDE = _xmp("drone-dji:AbsoluteAltitude|exif:GPSAltitude", "[^\"'<]{1,60}")
BELOW = _xmp("exif:GPSAltitudeRef", r"\d")
# A number in text, perhaps a fraction.
NUMBER = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)(?:\s*/\s*(\d+(?:\.\d*)?))?")


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


def stated_position(gps: Mapping[int, Any], xmp: bytes) -> tuple[Position, str]:
    """Where a photo was taken by EXIF's GPS block, or by XMP where that has none, and its accuracy, by XMP first; and
    why there is no position, or what was assumed of it, "" for nothing.

    Degrees may be three numbers, fewer, one with decimals, or text; signed, with a reference, or both, which then count
    once; zero denominators are numbers that are missing.
    """
    latitude, longitude, altitude, below = (_first(pattern, xmp) for pattern in (LATITUDE, LONGITUDE, ALTITUDE, BELOW))
    by_exif = (gps.get(2), gps.get(1, ""), gps.get(4), gps.get(3, ""))
    heights = [_altitude(gps.get(6), gps.get(5)), _altitude(altitude, below)]
    problems = []
    for north, north_of, east, east_of in (by_exif, (latitude, None, longitude, None)):
        if north is not None or east is not None:
            place, problem = degrees_of(north, north_of, east, east_of)
            if place is not None:
                height = next(filter(None, heights), None)
                horizontal, vertical = rtk_accuracy(xmp)
                return Position(*place, height, horizontal or _positive(gps.get(31)), vertical), problem
            problems.append(problem)
        heights.reverse()  # a height is best that of the position, and one of 0 is none
    return Position(), problems[0] if problems else ""


def degrees_of(north: Any, north_of: Any, east: Any, east_of: Any) -> tuple[tuple[float, float] | None, str]:
    """Latitude and longitude in degrees, None where they are useless; and why, or what was assumed.

    References of None are those that a format does not have.
    """
    latitude, longitude = _degrees(north, north_of, "S"), _degrees(east, east_of, "W")
    if latitude is None or longitude is None:
        return None, f"its {'latitude' if latitude is None else 'longitude'} is missing or no number"
    longitude -= 360.0 * (180.0 < longitude <= 360.0)
    if abs(latitude) > 90 or abs(longitude) > 180:
        return None, f"{latitude:g}, {longitude:g} degrees lie nowhere on earth"
    if (latitude, longitude) == (0.0, 0.0):
        return None, "0, 0 degrees are what a receiver without a fix writes"
    sides = (latitude, north_of, "north"), (longitude, east_of, "east")
    unsure = [word for degrees, of, word in sides if degrees > 0 and of == ""]
    return (latitude, longitude), f"its hemisphere is not stated, {' and '.join(unsure)} is assumed" if unsure else ""


def _degrees(value: Any, reference: Any, negative: str) -> float | None:
    """Signed degrees from degrees, minutes and seconds, or as many of them as there are; None without degrees."""
    parts, text = _parts(value, 360.0), exif_text(value) if isinstance(value, str | bytes) else ""
    if not parts or parts[0] is None:
        return None
    size = sum(abs(part or 0.0) / 60.0**power for power, part in enumerate(parts[:3]))
    signed = text.startswith("-") or any(part is not None and part < 0 for part in parts)
    return -size if signed or (exif_text(reference) or text[-1:]).upper().startswith(negative) else size


def _altitude(value: Any, reference: Any) -> float | None:
    """Metres, negative where value or reference say so; None where there are none."""
    reference = tuple(reference) if isinstance(reference, bytes) and reference[:1] < b"0" else reference
    # EXIF 3.0: 1 is below the ellipsoid, or whatever zero; 3 below the sea. No photo is taken 100 km up.
    (altitude, *_), (code, *_) = _parts(value, 1e5) or [None], _parts(reference) or [None]
    return altitude if altitude is None or code not in (1, 3) else -abs(altitude)


def _parts(value: Any, most: float = np.inf) -> list[float | None]:
    """The numbers of a value of EXIF or XMP, None for those that are none; `most` as of `exif_number`."""
    if isinstance(value, str | bytes):
        return [
            exif_number(float(a) / float(b or 1)) if float(b or 1) else None
            for a, b in NUMBER.findall(exif_text(value))
        ]
    return [exif_number(part, most) for part in (value if isinstance(value, tuple | list) else [value])]


def exif_number(value: Any, most: float = np.inf) -> float | None:
    """A finite float, or None. Signed fractions that were written as EXIF's unsigned ones have wrapped numerators; a
    number up to `most` is right as it is: programs write unrounded ones with as large numerators as there are."""
    try:
        top, number = int(getattr(value, "numerator", 0)), float(value)
        number = (top - 2**32) / value.denominator if number > most and 2**31 <= top < 2**32 else number
    except (TypeError, ValueError, ArithmeticError, AttributeError):
        return None
    return number if np.isfinite(number) else None


def exif_text(value: Any) -> str:
    """EXIF text without the zero bytes that some cameras pad it with."""
    text = value.decode("latin-1") if isinstance(value, bytes) else str(value or "")
    return text.split("\x00")[0].strip()


def rtk_accuracy(xmp: bytes) -> tuple[float | None, float | None]:
    """Standard deviations (m) of a photo's position, horizontal (of one axis) and vertical, that its XMP states."""
    east, north, up = (_positive(_first(pattern, xmp)) for pattern in (EAST, NORTH, UP))
    if east is not None and north is not None:
        return float(np.sqrt((east**2 + north**2) / 2)), up
    return _positive(_first(HORIZONTAL, xmp)), _positive(_first(VERTICAL, xmp))


def _first(pattern: re.Pattern[bytes], xmp: bytes) -> bytes | None:
    """What XMP states first of a property, or None."""
    return found[1] if (found := pattern.search(xmp)) else None


def _positive(value: Any) -> float | None:
    """A positive number of EXIF or XMP, or None."""
    return next((number for number in _parts(value)[:1] if number is not None and number > 0), None)


def read_geo(path: Path) -> dict[str, Position]:
    """Read a geo.txt: the CRS in the first line, then `photo x y [z [yaw pitch roll [sd [vertical sd]]]]`
    between tabs, semicolons, commas or blanks.

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
        cells = cells_of(line, 0, 3)
        try:
            values = [float(cell or "nan") for cell in cells[1:9]]
            if len(values) < 2 or not np.isfinite(values[:2]).all():
                raise ValueError
        except ValueError:
            raise StageError(
                f"{path}, line {number}: expected {LAYOUT}, got '{' '.join(cells)}'{comma_advice(cells[1:9])}"
            ) from None
        if cells[0] in names:
            raise StageError(f"{path}, line {number}: {cells[0]} is given more than once; keep one line of it")
        names.append(cells[0])
        rows.append(values + [np.nan] * (8 - len(values)))
    if not rows:
        raise StageError(f"{path} holds no positions below its first line; write lines {LAYOUT}, or remove it")
    table: Array = np.array(rows)
    places = to_wgs84(crs, table[:, :3], str(path))
    return {name: _position(place, row[6:8]) for name, place, row in zip(names, places, table)}


def cells_of(line: str, photo: int, least: int) -> list[str]:
    """The cells of a line of at least so many columns, with a photo's name in one and a number in the second.

    Tabs, semicolons, commas or blanks separate them; between blanks, a name that holds some ends where a photo's ending
    does.
    """
    for mark in "\t;,":
        cells = [cell.strip(' \t"') for cell in line.strip().split(mark)]
        if len(cells) >= least and (mark != "," or exif_number(cells[1]) is not None):
            return cells
    cells = line.split()
    last = next((k for k in range(photo, len(cells)) if Path(cells[k]).suffix.lower() in SUFFIXES), photo)
    return [*cells[:photo], " ".join(cells[photo : last + 1]), *cells[last + 1 :]]


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


def check_beside_exif(given: list[dict[str, Any]], stated: list[dict[str, Any]], path: Path) -> None:
    """StageError where positions of photos that a file gives lie far from those of EXIF, as in another zone, or with
    latitude and longitude swapped: both are the fields of a `Position`, photo by photo."""
    names = ("latitude_deg", "longitude_deg")
    both = [[[one[name] for name in names] for one in pair] for pair in zip(given, stated)]
    table: Array = np.array([pair for pair in both if None not in [*pair[0], *pair[1]]]).reshape(-1, 2, 2)
    if not len(table):
        return
    # Heights are not compared.
    by_file, swapped, by_exif = (np.insert(t, 2, np.nan, axis=1) for t in (table[:, 0], table[:, 0, ::-1], table[:, 1]))
    frame = local_frame(by_exif)
    off_m, swapped_m = (
        float(np.median(np.linalg.norm((frame.apply(places) - frame.apply(by_exif))[:, :2], axis=1)))
        for places in (by_file, swapped)
    )
    if off_m <= MAX_GPS_OFF_M:
        return
    if swapped_m <= MAX_GPS_OFF_M:
        raise StageError(
            f"{path} gives latitude before longitude, as the positions in the photos' EXIF show; write the longitude"
            " (x) first"
        )
    raise StageError(
        f"{path} gives positions {off_m / 1000:.3g} km from those in the photos' EXIF; correct its CRS or swapped axes,"
        " or remove GPS from the EXIF if that is wrong"
    )


def _position(place: Array, sd: Array) -> Position:
    horizontal, vertical = (float(s) if np.isfinite(s) and s > 0 else None for s in sd)
    altitude = float(place[2]) if np.isfinite(place[2]) else None
    return Position(float(place[0]), float(place[1]), altitude, horizontal, vertical or horizontal)
