"""From GPS to a local metric frame: east, north, up about an origin, and its place in a UTM zone."""

from dataclasses import dataclass

import numpy as np
import pyproj
from numpy.typing import NDArray

from scenefuse.transforms import Sim3, fit_sim3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocalFrame:
    """East, north, up in metres about an origin on the WGS84 ellipsoid.

    Attributes:
        latitude_deg: of the origin.
        longitude_deg: of the origin.
        altitude_m: of the origin, as GPS gave it.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float

    def apply(self, positions: Array) -> Array:
        """(N, 3) latitude (deg), longitude (deg), altitude (m) to (N, 3) east, north, up in metres."""
        latitude, longitude, altitude = np.asarray(positions, dtype=np.float64).T
        return np.stack(self._topocentric().transform(longitude, latitude, altitude), axis=1)

    def inverse(self, x_in_local: Array) -> Array:
        """(N, 3) east, north, up in metres to (N, 3) latitude (deg), longitude (deg), altitude (m)."""
        east, north, up = np.asarray(x_in_local, dtype=np.float64).T
        longitude, latitude, altitude = self._topocentric().transform(east, north, up, direction="INVERSE")
        return np.stack([latitude, longitude, altitude], axis=1)

    @property
    def crs(self) -> str:
        """The UTM zone of the origin, as an EPSG code."""
        zone = min(int((self.longitude_deg + 180.0) // 6.0) + 1, 60)
        return f"EPSG:{(32600 if self.latitude_deg >= 0 else 32700) + zone}"

    def crs_from_local(self) -> Sim3:
        """The similarity that takes local coordinates to easting, northing, altitude in `crs`.

        It holds the grid's scale and the angle between its north and true north at the origin; the height is scaled
        along, by less than 0.1 %.
        """
        corners = np.array([[0, 0, 0], [100, 0, 0], [0, 100, 0], [-100, 0, 0], [0, -100, 0]], dtype=np.float64)
        geographic = self.inverse(corners)
        to_grid = pyproj.Transformer.from_crs("EPSG:4326", self.crs, always_xy=True)
        easting, northing = to_grid.transform(geographic[:, 1], geographic[:, 0])
        grid = np.stack([easting, northing, np.full(5, self.altitude_m)], axis=1)
        return fit_sim3(corners, grid)

    def _topocentric(self) -> pyproj.Transformer:
        return pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 "
            f"+lat_0={self.latitude_deg!r} +lon_0={self.longitude_deg!r} +h_0={self.altitude_m!r}"
        )


def local_frame(positions: Array) -> LocalFrame:
    """The frame about the mean of (N, 3) WGS84 positions, rounded (about 1 m) so that it is easily written down."""
    latitude, longitude, altitude = np.asarray(positions, dtype=np.float64).mean(0)
    return LocalFrame(round(float(latitude), 5), round(float(longitude), 5), float(round(altitude)))
