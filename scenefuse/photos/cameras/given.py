"""What another program's project gives: a photo with its camera, at the photo's own size and turned along with a photo
that EXIF rotates and that stands upright here; and where the project lies on the earth, its cameras in coordinates of
its own, its clouds in a CRS."""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pyproj
from numpy.typing import NDArray
from pyproj.transformer import TransformerGroup

from scenefuse.cloud.crs import plane, to_wgs84, unit_m
from scenefuse.core.stage import StageError, quantity
from scenefuse.core.transforms import Array, Sim3
from scenefuse.photos.photo_files import MAX_PIXELS
from scenefuse.photos.pictures import same_shape

# EXIF orientation -> clockwise quarter turns that stand a stored photo upright; the others are mirrored.
QUARTERS = {6: 1, 3: 2, 8: 3}
# Camera axes after a clockwise quarter turn from those before, OpenCV axes.
FROM_STORED = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
# OpenCV axes from those of OpenGL and Bundler: x right, y up, looking along -z.
FLIP = np.diag([1.0, -1.0, -1.0])
# Parameters of a lens that a turn leaves as they are.
EVEN = ("f", "k", "k1", "k2", "k3", "k4", "k5", "k6", "omega", "alpha", "beta")

Size = tuple[int, int]
SizeOf = Callable[[Path], Size]
# Keys of a place in a report.
NAMES = ("earth_from_given", "earth_is_geocentric", "given_crs")


@dataclass(frozen=True)
class GivenCamera:
    """A camera as another program's file gives it.

    Attributes:
        name: of its photo.
        camera: COLMAP's model of its lens; where the format leaves out the photo's size, by a function that has it.
        object_from_cam: (4, 4) float64 rigid pose, OpenCV axes.
        mask: file of the photo's mask where the format names one.
        held_out: the format keeps the photo for measuring.
    """

    name: str
    camera: pycolmap.Camera | Callable[[Callable[[], Size]], pycolmap.Camera]
    object_from_cam: NDArray[np.float64]
    mask: Path | None = None
    held_out: bool = False


@dataclass(frozen=True)
class PosedPhoto:
    """One photo on disk and its camera.

    Attributes:
        name: as the program gives it.
        file: the photo.
        camera: COLMAP's model of its lens, for the photo's size or that of a larger or smaller original.
        object_from_cam: (4, 4) float64 rigid pose, OpenCV axes.
        mask: file of its mask where the format names one.
        held_out: the format keeps it for measuring.
        sized: the format says how large the photo was.
    """

    name: str
    file: Path
    camera: pycolmap.Camera
    object_from_cam: NDArray[np.float64]
    mask: Path | None
    held_out: bool
    sized: bool = True


def colmap_camera(model: str, width: float, height: float, params: Sequence[float]) -> pycolmap.Camera:
    """A camera of COLMAP.

    Raises:
        ValueError: no such model of a perspective or fisheye lens, or numbers that no camera has.
    """
    if model not in pycolmap.CameraModelId.__members__ or model in ("INVALID", "EQUIRECTANGULAR"):
        raise ValueError(f"the camera model {model} is not read; undistort the photos to PINHOLE first")
    if not (min(width, height) >= 1 and width * height <= MAX_PIXELS and np.isfinite(params).all()):
        raise ValueError(f"a camera's size is {width:g} x {height:g} pixels, and its parameters are {list(params)}")
    camera = pycolmap.Camera(model=model, width=round(width), height=round(height), params=list(map(float, params)))
    if not camera.verify_params():
        raise ValueError(f"a camera has {len(params)} parameters, but {model} has {camera.params_info}")
    # A hundredth of the width sees 179 degrees.
    if 100 * (focal := min(camera.params[k] for k in camera.focal_length_idxs())) < max(width, height):
        raise ValueError(f"a focal length is {focal:g}; it counts in pixels, of which there are {width:g} x {height:g}")
    middle = camera.principal_point_x, camera.principal_point_y
    if not (0 < middle[0] < width and 0 < middle[1] < height):
        raise ValueError(f"a principal point, {middle}, lies outside its {width:g} x {height:g} pixels")
    return camera


def seen_from(turn: Array, shift: Array) -> Array:
    """(4, 4) object_from_cam of a rotation (3, 3) and a translation (3,) into the camera."""
    return np.vstack([np.column_stack([turn.T, -turn.T @ shift]), [0, 0, 0, 1]])


def at_size(camera: pycolmap.Camera, size: Size, where: str) -> pycolmap.Camera:
    """A camera for copies of its photos of another size.

    Raises:
        StageError: the copies have another shape.
    """
    width, height = size
    if not same_shape((camera.width, camera.height), size):
        raise StageError(
            f"{where} has {width} x {height} pixels, but its camera {camera.width} x {camera.height}; give the photos"
            " that the camera was computed for, or copies scaled alike"
        )
    scaled = pycolmap.Camera(camera.todict())
    scaled.rescale(width, height)
    return scaled


def largest(models: Mapping[str, Sequence[object]]) -> tuple[str, list[str]]:
    """The name of the model with most photos, and a note where there are others."""
    (name, photos), *others = sorted(models.items(), key=lambda model: -len(model[1])) or [("", [])]
    counts = ", ".join(f"{other} with {len(given)}" for other, given in others)
    return name, [f"the model {name} is taken, with {len(photos)} photos, and not {counts}"] if others else []


def possible_turns(
    posed: Mapping[str, PosedPhoto], orientations: Mapping[str, int], sizes: Mapping[str, Size]
) -> list[dict[str, PosedPhoto]]:
    """The cameras of photos by name as they may be meant, one way or two: for upright photos, or for stored ones.

    The size of a photo on its side, where the format has it, tells which, and then counts for those that stand on their
    heads as well. Where none does, both ways are possible.

    Args:
        posed: cameras as given.
        orientations: EXIF orientation of the photos that were turned here.
        sizes: (width, height) of the upright photos.

    Raises:
        StageError: a photo on its side has a lens that cannot be turned.
    """
    turns = {name: QUARTERS[o] for name, o in orientations.items() if o in QUARTERS and name in posed and name in sizes}
    stored, as_they_are = list[str](), list[str]()
    for name in (name for name, quarters in turns.items() if quarters % 2 and posed[name].sized):
        own = posed[name].camera.width, posed[name].camera.height
        upright, lying = same_shape(own, sizes[name]), same_shape(own, sizes[name][::-1])
        stored += [name] if lying and not upright else []
        as_they_are += [name] if upright and not lying else []
    if not turns or (as_they_are and not stored):
        return [dict(posed)]
    other = dict(posed) | {
        name: stood_upright(posed[name], quarters) for name, quarters in turns.items() if name not in as_they_are
    }
    return [other] if stored else [dict(posed), other]


def stood_upright(photo: PosedPhoto, quarters: int) -> PosedPhoto:
    """A camera after so many clockwise quarter turns of its photo.

    Raises:
        StageError: its lens has parameters that depend on the axes and that are not known here.
    """
    pose = photo.object_from_cam @ np.linalg.matrix_power(FROM_STORED.T, quarters)
    # A lens for a photo of unknown shape was made for the upright one.
    lens = turned(photo.camera, quarters, photo.file.name) if photo.sized else photo.camera
    return replace(photo, camera=lens, object_from_cam=pose)


def turned(lens: pycolmap.Camera, quarters: int, name: str) -> pycolmap.Camera:
    """A lens after so many clockwise quarter turns of a photo of this name. Errors as of `stood_upright`."""
    for _ in range(quarters):
        camera, old = pycolmap.Camera(lens.todict()), lens
        names = [word.strip() for word in old.params_info.split(",")]
        own = dict(zip(names, np.asarray(old.params).tolist()))
        new = {word: own[word] for word in names if word in EVEN}
        new |= {"cx": old.height - own["cy"], "cy": own["cx"]}
        if "fx" in own:
            new |= {"fx": own["fy"], "fy": own["fx"]}
        if "p2" in own:
            new |= {"p1": own["p2"], "p2": -own["p1"]}
        if "sx1" in own:
            new |= {"sx1": -own["sy1"], "sy1": own["sx1"]}
        if set(new) != set(own):
            raise StageError(
                f"{name} is rotated by EXIF, and its camera, a {old.model.name}, cannot be turned along;"
                " undistort the photos in the program that found the cameras, or rotate them before"
            )
        camera.width, camera.height = old.height, old.width
        camera.params = [new[word] for word in names]
        lens = camera
    return lens


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
        if not self.geocentric:
            return earth
        return _through(self._projection(), _through(self._ellipsoid(), earth, "INVERSE"))

    def model_from(self, points: Array, crs: pyproj.CRS) -> Array:
        """The inverse, (N, 3) to (N, 3), of points in any CRS."""
        if crs != self.crs:
            points = _through(_best(crs, self.crs, f"{crs.name} and {self.crs.name}"), points)
        if self.geocentric:
            points = _through(self._ellipsoid(), _through(self._projection(), points, "INVERSE"))
        return self.earth_from_model.inverse().apply(points)

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
