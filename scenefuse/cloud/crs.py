"""Coordinate reference systems as survey files name them, and their way to WGS84."""

import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyproj
from pyproj.database import get_units_map

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array

# OpenDroneMap's way to name a UTM zone.
UTM = re.compile(r"WGS84 UTM (0?[1-9]|[1-5]\d|60)([NS])", re.IGNORECASE)
# A CRS is used so far beyond its area at most, in degrees: one UTM zone.
MAX_BEYOND_DEG = 6.0
# Coordinates this small are a site's own, unless the zero of their CRS lies where that is used.
MAX_SITE_COORDINATE = 10_000.0
# The feet of surveyors and of everybody else differ by less, which is a millimetre of a height.
MAX_UNIT_RATIO = 1e-5
# One unit's digits differ by less; two feet, by more.
SAME_UNIT_RATIO = 1e-7
MERCATOR = "Mercator's projection, whose metres are no metres on the ground"


def read_crs(text: str, where: str) -> pyproj.CRS:
    """The CRS of a header: `EPSG:25832`, with heights `EPSG:25832+7837`, `WGS84 UTM 32N`, or a PROJ string.

    Raises:
        StageError: `text` names none, or what `usable` says.
    """
    # A spreadsheet fills the row up with empty cells.
    return usable(_named(text.strip().rstrip(",;\t ").strip('"'), f"{where}, in its first line"), where)


def projected_crs(text: str, where: str, heights: bool) -> pyproj.CRS:
    """The projected CRS that a cell of a table names, as `read_crs` has it; with heights of its own only if `heights`.

    Raises:
        StageError: `text` names none, one in degrees, or one with heights where there may be none.
    """
    crs = usable(_named(text, where), where)
    if not plane(crs).is_projected:
        raise StageError(f"{where}: {crs.name} is in degrees; name a projected one, a UTM zone for instance")
    if crs.is_compound and not heights:
        raise StageError(
            f"{where}: heights of GPS are not those of {crs.name}; name its plane alone, {plane(crs).to_string()}, or"
            " give control points with such heights"
        )
    return crs


def _named(text: str, where: str) -> pyproj.CRS:
    """The CRS that a text names; StageError where it names none."""
    zone = UTM.fullmatch(text.strip())
    code = f"EPSG:{(32600 if zone[2].upper() == 'N' else 32700) + int(zone[1])}" if zone else text.strip()
    try:
        return pyproj.CRS.from_user_input(code)
    except pyproj.exceptions.CRSError:
        raise StageError(
            f"{where}: '{text.strip()[:60]}' names no coordinate reference system; write EPSG:25832, with heights"
            " EPSG:25832+7837, WGS84 UTM 32N, or a PROJ string"
        ) from None


def usable(crs: pyproj.CRS, where: str, local: bool = False) -> pyproj.CRS:
    """A CRS as its register has it, where it does.

    Raises:
        StageError: its heights have another unit than its plane, it is neither projected nor geographic nor, if that is
            allowed, a site's own, or its axes are a mirror image of east and north.
    """
    crs = registered(crs)
    if [axis.direction for axis in plane(crs).axis_info[:2]] == ["south", "west"]:
        raise StageError(
            f"{where}: the axes of the CRS {crs.name} point south and west, a mirror image of the ground; name its"
            " variant with axes to the east and north, EPSG:5514 for EPSG:5513"
        )
    if units := mixed_units(crs):
        raise StageError(f"{where}: the CRS {crs.name} counts {units}; give heights in the unit of the plane")
    if is_stretched(crs):
        raise StageError(f"{where}: the CRS {crs.name} is {MERCATOR}; give coordinates in another, a UTM zone")
    if not (plane(crs).is_projected or plane(crs).is_geographic or (local and plane(crs).is_engineering)):
        raise StageError(
            f"{where}: the CRS {crs.name} is neither projected nor geographic; give coordinates in such a one"
        )
    return crs


def registered(crs: pyproj.CRS) -> pyproj.CRS:
    """A CRS as its register has it, where it does: older WKT does not say where it is used."""
    # Older WKT names a way to WGS84 as well; for a CRS of its register PROJ knows better ones.
    known = (crs.source_crs if crs.is_bound and crs.source_crs is not None else crs).to_epsg()
    return crs if known is None else pyproj.CRS.from_epsg(known)


def with_units(crs: pyproj.CRS, keys: dict[int, int]) -> pyproj.CRS:
    """A projected CRS in the units of GeoTIFF keys, and with the heights that these name (GeoTIFF 1.1, annex B)."""
    own = crs.axis_info[0].unit_conversion_factor
    units = {unit.code: (unit.name, unit.conv_factor) for unit in get_units_map("EPSG", "linear").values()}
    unit = units.get(str(keys.get(3076)))
    if unit is not None and abs(unit[1] / own - 1) > MAX_UNIT_RATIO:
        about = crs.to_json_dict()
        for axis in about["coordinate_system"]["axis"]:
            axis["unit"] = {"type": "LinearUnit", "name": unit[0], "conversion_factor": unit[1]}
        about.pop("id", None)
        crs, own = pyproj.CRS.from_json_dict(about), unit[1]
    heights, factor = None, own
    with suppress(pyproj.exceptions.CRSError):
        heights = pyproj.CRS.from_epsg(keys.get(4096, 0))
        factor = heights.axis_info[0].unit_conversion_factor
    unit = units.get(str(keys.get(4099)))
    if unit is not None and abs(unit[1] / factor - 1) > MAX_UNIT_RATIO:
        name = "heights" if heights is None else f"{heights.name} in {unit[0]}"
        heights = pyproj.CRS.from_wkt(f'VERT_CS["{name}",VERT_DATUM["{name}",2005],UNIT["{unit[0]}",{unit[1]}]]')
    return crs if heights is None else pyproj.crs.CompoundCRS(f"{crs.name} + {heights.name}", [crs, heights])


def mixed_units(crs: pyproj.CRS) -> str | None:
    """The units of a CRS's axes, where these are lengths of clearly different units."""
    found = {axis.unit_name: axis.unit_conversion_factor for axis in crs.axis_info}
    mixed = not plane(crs).is_geographic and max(found.values()) / min(found.values()) - 1 > MAX_UNIT_RATIO
    return " and ".join(sorted(found)) if mixed else None


def is_stretched(crs: pyproj.CRS) -> bool:
    """Whether a CRS is a Mercator projection, in which only the equator has its length."""
    operation = plane(registered(crs)).coordinate_operation
    return operation is not None and operation.method_name.startswith(("Mercator", "Popular Visualisation"))


def has_place(crs: str | None) -> bool:
    """Whether a CRS lies somewhere on the earth, as a site's own system does not."""
    return crs is not None and not plane(pyproj.CRS.from_user_input(crs)).is_engineering


def points_north(crs: str) -> bool:
    """Whether y of a CRS counts to the north: South Africa's counts to the south, and x to the west."""
    axes = plane(pyproj.CRS.from_user_input(crs)).axis_info[:2]
    return {axis.direction for axis in axes} == {"east", "north"}


def crs_name(crs: str) -> str:
    """The name of a coordinate system, with its code."""
    try:
        name = pyproj.CRS.from_user_input(crs).name
    except pyproj.exceptions.CRSError:
        return crs
    return f"{name} ({crs})" if len(crs) < len(name) else name


def plane(crs: pyproj.CRS) -> pyproj.CRS:
    """The horizontal part of a CRS."""
    return crs.sub_crs_list[0] if crs.is_compound else crs


def unit_m(crs: pyproj.CRS) -> float:
    """Metres in the unit of a CRS's heights, which is that of its plane too where it is projected."""
    axes = crs.axis_info if len(crs.axis_info) > 2 else [] if plane(crs).is_geographic else crs.axis_info
    return float(axes[-1].unit_conversion_factor) if axes else 1.0


def unit_name(crs: pyproj.CRS) -> str:
    """The unit of a projected CRS as the register calls it, "m" for metres; WKT has many words for one foot."""
    factor, own = (crs.axis_info[0].unit_conversion_factor, crs.axis_info[0].unit_name) if crs.axis_info else (1.0, "")
    units = get_units_map("EPSG", "linear").values()
    off, name = min((abs(unit.conv_factor / factor - 1), unit.name) for unit in units)
    name = name if off < SAME_UNIT_RATIO else own
    return "m" if name == "metre" else name


def grid_name(crs: pyproj.CRS) -> str:
    """What `LocalFrame.grid` calls a projected CRS; "" for a geographic one, whose points go into a UTM zone."""
    return "" if plane(crs).is_geographic else crs.to_string()


def to_wgs84(crs: pyproj.CRS, points: Array, where: str) -> Array:
    """(N, 3) x (easting or longitude), y, height to (N, 3) WGS84 latitude (deg), longitude (deg), height (m).

    Heights keep their zero: they are only brought into metres. NaN stays NaN.

    Raises:
        StageError: points that lie nowhere near the area of the CRS, with a guess where the axes are swapped.
    """
    found = check_in_area(crs, points, where)
    return np.column_stack([found[:, ::-1], points[:, 2] * unit_m(crs)])


def check_place(crs: pyproj.CRS, points: Array, source: Path) -> None:
    """StageError where the middle of a file's points (N, 3) lies far from where their projected CRS is used; near the
    CRS's zero, where it lies outside at all."""
    known = registered(plane(registered(crs)))
    if known.is_projected:
        middle = np.median(points, axis=0)
        beyond = 0.0 if (abs(middle[:2]) < MAX_SITE_COORDINATE).all() else MAX_BEYOND_DEG
        check_in_area(known, middle[None], f"{source}, the middle of its points", beyond)


def check_in_area(crs: pyproj.CRS, points: Array, where: str, beyond_deg: float = MAX_BEYOND_DEG) -> Array:
    """(N, 2) longitude, latitude of points (N, 3) in a CRS, so far beyond its area at most; StageError as of
    `to_wgs84`."""
    if plane(crs).is_engineering:
        raise StageError(f"{where}: {crs.name} is a site's own system, which has no place on the earth; name a CRS")
    found = _in_degrees(crs, points[:, :2])
    strange = ~_in_area(crs, found, beyond_deg)
    if strange.any():
        row = int(np.flatnonzero(strange)[0])
        swapped = _in_area(crs, _in_degrees(crs, points[:, 1::-1]), beyond_deg).all()
        advice = "x and y are swapped: x is easting or longitude" if swapped else "correct the CRS or the coordinates"
        if (zone := plane(crs).utm_zone) and (points[:, 0] // 1e6 == int(zone[:-1])).all():
            advice = f"x begins with the zone: take {zone[:-1]} off, or name a CRS whose eastings have it, as EPSG:4647"
        raise StageError(
            f"{where}: {points[row, 0]:.12g} {points[row, 1]:.12g} does not lie in {crs.name}"
            f" ({strange.sum()} of {len(points)} points); {advice}"
        )
    return found


def _in_degrees(crs: pyproj.CRS, points: Array) -> Array:
    """(N, 2) longitude, latitude; infinite where there is none."""
    transformer = pyproj.Transformer.from_crs(plane(crs), "EPSG:4326", always_xy=True)
    return np.column_stack(transformer.transform(points[:, 0], points[:, 1]))


def _in_area(crs: pyproj.CRS, degrees: Array, beyond_deg: float) -> np.ndarray:
    """(N,) whether longitude, latitude exist and lie in the area of the CRS or near it."""
    longitude, latitude = np.where(np.isfinite(degrees), degrees, 1e9).T
    good = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 360)
    area = plane(crs).area_of_use
    if area is None:
        return good
    good &= (latitude >= area.south - beyond_deg) & (latitude <= area.north + beyond_deg)
    wide = (area.east - area.west) % 360 or 360.0  # an area may lie on both sides of the antimeridian
    return np.asarray(good & ((longitude - area.west + beyond_deg) % 360 <= wide + 2 * beyond_deg))
