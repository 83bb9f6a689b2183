"""From GPS to a local metric frame: east, north, up about an origin, and its place in a UTM zone."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray

from scenefuse.cloud.crs import crs_name, points_north, unit_m, unit_name
from scenefuse.core.stage import read_json, value
from scenefuse.core.transforms import Sim3, fit_sim3

Array = NDArray[np.float64]

# Of positions spread evenly, none is farther from the middle than twice the median distance. Only wild ones are farther
# than this many.
MAX_MEDIAN_DISTANCES = 10.0
# What was surveyed farther from where GPS saw the cameras, in metres, is in another CRS or has swapped axes.
MAX_GPS_OFF_M = 1000.0


@dataclass(frozen=True)
class LocalFrame:
    """East, north, up in metres about an origin on the WGS84 ellipsoid.

    Attributes:
        latitude_deg: of the origin.
        longitude_deg: of the origin.
        altitude_m: of the origin, as GPS or the control points gave it; 0 where there is no height.
        grid: the projected CRS of the control points; "" for the UTM zone of the origin.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    grid: str = field(default="", kw_only=True)

    def apply(self, positions: Array) -> Array:
        """(N, 3) latitude (deg), longitude (deg), altitude (m) to (N, 3) east, north, up in metres.

        An altitude of NaN becomes an up of NaN; east and north are then those at the origin's altitude.
        """
        latitude, longitude, altitude = np.asarray(positions, dtype=np.float64).T
        known = np.isfinite(altitude)
        altitude = np.where(known, altitude, self.altitude_m)
        east, north, up = self._topocentric().transform(longitude, latitude, altitude)
        return np.stack([east, north, np.where(known, up, np.nan)], axis=1)

    def inverse(self, x_in_local: Array) -> Array:
        """(N, 3) east, north, up in metres to (N, 3) latitude (deg), longitude (deg), altitude (m)."""
        east, north, up = np.asarray(x_in_local, dtype=np.float64).T
        longitude, latitude, altitude = self._topocentric().transform(east, north, up, direction="INVERSE")
        return np.stack([latitude, longitude, altitude], axis=1)

    @property
    def crs(self) -> str:
        """Where results are written: the control points' CRS, else the UTM zone of the origin, as an EPSG code."""
        if self.grid:
            return self.grid
        zone = min(int((self.longitude_deg + 180.0) // 6.0) + 1, 60)
        return f"EPSG:{(32600 if self.latitude_deg >= 0 else 32700) + zone}"

    @property
    def has_north(self) -> bool:
        """Whether y is known to point north."""
        return True

    @property
    def crs_unit(self) -> str:
        """The unit of `crs`, "m" for metres."""
        return unit_name(pyproj.CRS.from_user_input(self.crs))

    def in_crs(self, x_in_local: Array) -> Array:
        """(N, 3) east, north, up in metres to (N, 3) easting, northing, altitude in `crs` and its unit, exactly.

        Heights are only counted in that unit; their zero is that of the positions that made the frame. No similarity
        does: up is vertical at the origin only, so that 5 km away altitude and up differ by 2 m.
        """
        geographic, grid = self.inverse(x_in_local), pyproj.CRS.from_user_input(self.crs)
        grid = grid.sub_crs_list[0] if grid.is_compound else grid
        to_grid = pyproj.Transformer.from_crs("EPSG:4326", grid, always_xy=True)
        easting, northing = to_grid.transform(geographic[:, 1], geographic[:, 0])
        return np.stack([easting, northing, geographic[:, 2] / grid.axis_info[0].unit_conversion_factor], axis=1)

    def crs_from_local(self) -> Sim3:
        """The similarity that comes nearest to `in_crs` about the origin: 8 cm off at 1 km, 2 m at 5 km, in height.

        It holds the grid's scale and the angle between its north and true north at the origin; the height is scaled
        along, by less than 0.1 %.
        """
        corners = np.array([[0, 0, 0], [100, 0, 0], [0, 100, 0], [-100, 0, 0], [0, -100, 0]], dtype=np.float64)
        grid = self.in_crs(corners)
        grid[:, 2] = grid[0, 2]
        return fit_sim3(corners, grid)

    def _topocentric(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 "
            f"+lat_0={self.latitude_deg!r} +lon_0={self.longitude_deg!r} +h_0={self.altitude_m!r}"
        )


def local_frame(positions: Array) -> LocalFrame:
    """The frame about the middle of (N, 3) WGS84 positions, rounded (about 1 m) so that it is easily written down.

    A few wild positions do not move it; altitudes of NaN take no part.
    """
    latitude, longitude, altitude = np.asarray(positions, dtype=np.float64).T
    # About the mean direction, longitudes on both sides of the antimeridian are neighbours.
    mean = float(np.degrees(np.angle(np.exp(1j * np.radians(longitude)).sum())))
    middle = mean + _middle((longitude - mean + 180.0) % 360.0 - 180.0)
    known = altitude[np.isfinite(altitude)]
    return LocalFrame(
        round(_middle(latitude), 5),
        round((middle + 180.0) % 360.0 - 180.0, 5),
        float(round(_middle(known))) if len(known) else 0.0,
    )


def _middle(values: Array) -> float:
    """Mean of the values that are no farther from the median than `MAX_MEDIAN_DISTANCES` times the median distance."""
    distance = np.abs(values - np.median(values))
    return float(values[distance <= MAX_MEDIAN_DISTANCES * np.median(distance)].mean())


@dataclass(frozen=True)
class GridFrame:
    """The axes of a projected CRS about an origin, as an imported cloud has them.

    Attributes:
        crs: anything pyproj understands; None where the file names none.
        origin: (3,) in the file's coordinates.
    """

    crs: str | None
    origin: Array

    @property
    def has_north(self) -> bool:
        """Whether y is known to point north."""
        return self.crs is not None and points_north(self.crs)

    def in_crs(self, x_in_local: Array) -> Array:
        """(N, 3) points of the frame in the file's coordinates."""
        return np.asarray(x_in_local, dtype=np.float64) + self.origin

    def inverse(self, x_in_local: Array) -> Array:
        """(N, 3) points of the frame to (N, 3) WGS84 latitude (deg), longitude (deg), and height, in metres."""
        assert self.crs is not None
        easting, northing, height = self.in_crs(x_in_local).T
        to_wgs84 = pyproj.Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True)
        longitude, latitude = to_wgs84.transform(easting, northing)
        return np.stack([latitude, longitude, height * unit_m(pyproj.CRS.from_user_input(self.crs))], axis=1)


def scene_frame(georeference: Mapping[str, Any]) -> LocalFrame | GridFrame | None:
    """The frame of a scene by the content of its georeference.json; None where the scene is not georeferenced."""
    if "origin_latitude_deg" not in georeference:
        if "origin_in_crs" not in georeference:
            return None
        return GridFrame(value(georeference, "crs"), np.array(value(georeference, "origin_in_crs")))
    latitude, longitude, altitude = (
        value(georeference, f"origin_{name}") for name in ("latitude_deg", "longitude_deg", "altitude_m")
    )
    grid = value(georeference, "crs") if "crs" in georeference else ""
    return LocalFrame(float(latitude), float(longitude), float(altitude or 0.0), grid=grid)


def length_unit(georeference: Path | None) -> str:
    """The unit of lengths in a scene's frame by its `georeference.json`: "m", or (without that file) "scene units"."""
    return "scene units" if georeference is None else str(value(read_json(georeference), "length_unit"))


def frame_notes(georeference: Path | None) -> list[str]:
    """What the coordinates of a scene's files are, for headers in ASCII: unit, origin, CRS, heights, the way there."""
    known = {} if georeference is None else {name: entry["value"] for name, entry in read_json(georeference).items()}
    unit, crs = known.get("length_unit", "scene units"), known.get("crs")
    notes = [f"x y z: {'metres' if unit == 'm' else unit}"]
    if "origin_in_crs" not in known:
        notes[0] += " in a local frame"
    else:
        notes[0] += " east, north, up of" if "origin_latitude_deg" in known else ", less"
        place = "{:.12g} {:.12g} {:.12g}".format(*known["origin_in_crs"])
        notes[0] += f" {place} in {crs_name(crs) if crs else 'the coordinates of the given cloud'}"
    if crs and "origin_latitude_deg" in known:
        heights = heights_of(crs, known.get("control_points"), known.get("origin_altitude_m"), given_place(known))
        apart = "not by adding the origin, for the grid's north is another; completed.copc.laz is in it"
        notes += [f"heights: {heights}", f"into the CRS: {apart}"]
    return [" ".join(note.encode("ascii", "replace").decode().split()) for note in notes]


def compass(heading_deg: float) -> str:
    """The name of a direction clockwise from north."""
    names = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
    return names[round(heading_deg / 45) % len(names)]


def given_place(known: Mapping[str, Any]) -> str:
    """What a user gave that says where the photos lie: the cloud on which they were laid, or cameras; "" for neither.

    Args:
        known: values of georeference.json, or the cells that scenes.tsv has of them.
    """
    return "cloud" if "met_share" in known else "cameras" if known.get("up_cue") == "given cameras" else ""


def heights_of(crs: str | None, control_points: int | None, altitude_m: float | None, given: str = "") -> str:
    """From where heights of a scene with photos are counted.

    Args:
        crs: of the scene.
        control_points: how many place it.
        altitude_m: of its origin; None where no position has a height.
        given: what `given_place` says.
    """
    if altitude_m is None:
        return "relative to the middle camera: no position has a height"
    if crs is not None and (whole := pyproj.CRS.from_user_input(crs)).is_compound:
        return whole.sub_crs_list[1].name
    if given or control_points:
        return f"those of the {f'given {given}' if given else 'control points'}"
    return "as the photos' GPS gives them, which does not say whether above the ellipsoid or the sea"
