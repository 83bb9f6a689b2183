"""Where another program's project lies on the earth: its cameras in coordinates of its own, its clouds in a CRS."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyproj
from pyproj.transformer import TransformerGroup

from scenefuse.cloud.crs import plane, to_wgs84, unit_m
from scenefuse.core.stage import StageError, quantity
from scenefuse.core.transforms import Array, Sim3

NAMES = ("earth_from_given", "earth_is_geocentric", "given_crs")


@dataclass(frozen=True)
class Place:
    """How coordinates of a project's cameras become those of a CRS.

    Attributes:
        earth_from_model: into metres about the earth's centre, or into the CRS itself.
        geocentric: whether it is the former.
        crs: of the project, in which it exports its clouds.
    """

    earth_from_model: Sim3
    geocentric: bool
    crs: pyproj.CRS

    def in_crs(self, x_in_model: Array) -> Array:
        """(N, 3) points among the cameras to (N, 3) easting or longitude, northing or latitude, height."""
        earth = self.earth_from_model.apply(x_in_model)
        return self._crs_from_earth(earth) if self.geocentric else earth

    def model_from(self, points: Array, crs: pyproj.CRS) -> Array:
        """The inverse, (N, 3) to (N, 3), of points in any CRS."""
        if crs != self.crs:
            points = _through(_best(crs, self.crs, f"{crs.name} and {self.crs.name}"), points)
        earth = self._earth_from_crs(points) if self.geocentric else points
        return self.earth_from_model.inverse().apply(earth)

    def wgs84(self, x_in_model: Array, where: str) -> Array:
        """(N, 3) points among the cameras to (N, 3) WGS84 latitude, longitude (deg), and height as the CRS counts it.

        Raises:
            StageError: they lie nowhere near the area of the CRS.
        """
        return to_wgs84(self.crs, self.in_crs(x_in_model), where)

    def after(self, model_from_given: Sim3) -> "Place":
        """The same for cameras that were moved since."""
        return replace(self, earth_from_model=self.earth_from_model @ model_from_given.inverse())

    def report(self) -> dict[str, Any]:
        """What `read_place` reads again, as quantities."""
        content = (self.earth_from_model.matrix.tolist(), self.geocentric, self.crs.to_wkt())
        return {name: quantity(part, "") for name, part in zip(NAMES, content)}

    def _crs_from_earth(self, earth: Array) -> Array:
        return _through(self._projection(), _through(self._ellipsoid(), earth, "INVERSE"))

    def _earth_from_crs(self, points: Array) -> Array:
        return _through(self._ellipsoid(), _through(self._projection(), points, "INVERSE"))

    def _ellipsoid(self) -> pyproj.Transformer:
        """From longitude, latitude (deg) and height (m) on the CRS's own datum to metres about its centre."""
        shape = plane(self.crs).ellipsoid
        assert shape is not None
        return pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart"
            f" +a={shape.semi_major_metre!r} +rf={shape.inverse_flattening!r}"
        )

    def _projection(self) -> pyproj.Transformer:
        """From longitude, latitude and height on the CRS's datum to the CRS."""
        datum = plane(self.crs).geodetic_crs
        assert datum is not None
        return _best(datum.to_3d(), self.crs, self.crs.name)


def check_crs(crs: pyproj.CRS, where: str) -> None:
    """StageError where a CRS counts other than metres, or degrees from Greenwich.

    Args:
        crs: of a project.
        where: the file that names it, for the message.
    """
    datum = plane(crs).geodetic_crs
    odd = unit_m(crs) != 1 or datum is None or {axis.unit_name for axis in datum.axis_info[:2]} != {"degree"}
    if odd or (datum is not None and datum.prime_meridian is not None and datum.prime_meridian.longitude != 0):
        raise StageError(
            f"{where}: the CRS {crs.name} does not count in metres, or not in degrees from Greenwich; choose another"
            " for the project, a UTM zone for instance, and export cameras and cloud again"
        )


def read_place(content: Mapping[str, Any]) -> Place | None:
    """The place that `Place.report` wrote; None where there is none."""
    if NAMES[0] not in content:
        return None
    matrix, geocentric, wkt = (content[name]["value"] for name in NAMES)
    return Place(Sim3.from_matrix(np.array(matrix)), geocentric, pyproj.CRS.from_wkt(wkt))


def _best(one: pyproj.CRS, two: pyproj.CRS, names: str) -> pyproj.Transformer:
    """The way from one CRS to another, heights too."""
    one, two = (crs if crs.is_compound else crs.to_3d() for crs in (one, two))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyproj warns of the grids of which the error below tells.
        group = TransformerGroup(one, two, always_xy=True, allow_ballpark=False)
    if not (group.transformers and group.best_available):
        raise StageError(
            f"heights of {names} need a geoid, or a grid, that is not installed; export cameras and cloud again with"
            " heights above the ellipsoid, in a UTM zone for instance, or install PROJ's grids (projsync)"
        )
    return group.transformers[0]


def _through(transformer: pyproj.Transformer, points: Array, direction: str = "FORWARD") -> Array:
    """(N, 3) points after a transformation; infinite where there is none."""
    x, y, z = points.T
    return np.stack(transformer.transform(x, y, z, direction=direction), axis=1)
