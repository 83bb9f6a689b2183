"""A photo with the camera that another program found for it: at the photo's own size, and turned along with a photo
that EXIF says is rotated, which stands upright here."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.photos.photo_files import MAX_PIXELS
from scenefuse.photos.photos import SHAPE_TOLERANCE

# EXIF orientation -> clockwise quarter turns that stand a stored photo upright; the others are mirrored.
QUARTERS = {6: 1, 3: 2, 8: 3}
# Camera axes after a clockwise quarter turn from those before, OpenCV axes.
FROM_STORED = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
# OpenCV axes from those of OpenGL and Bundler: x right, y up, looking along -z.
FLIP = np.diag([1.0, -1.0, -1.0])
# Parameters of a lens that a turn leaves as they are.
EVEN = ("f", "k", "k1", "k2", "k3", "k4", "k5", "k6")

Size = tuple[int, int]


@dataclass(frozen=True)
class GivenCamera:
    """A camera as another program's file gives it.

    Attributes:
        name: of its photo.
        camera: COLMAP's model of its lens, or what gives it for the file of the photo, where its size counts.
        object_from_cam: (4, 4) float64 rigid pose, OpenCV axes.
        mask: file of the photo's mask where the format names one.
        held_out: the format keeps the photo for measuring.
    """

    name: str
    camera: pycolmap.Camera | Callable[[Path], pycolmap.Camera]
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
    """

    name: str
    file: Path
    camera: pycolmap.Camera
    object_from_cam: NDArray[np.float64]
    mask: Path | None
    held_out: bool


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
    if min(camera.params[k] for k in camera.focal_length_idxs()) <= 0:
        raise ValueError("a focal length has to be positive")
    return camera


def at_size(camera: pycolmap.Camera, size: Size, where: str) -> pycolmap.Camera:
    """A camera for copies of its photos of another size.

    Raises:
        StageError: the copies have another shape.
    """
    width, height = size
    if not _same_shape(camera, size):
        raise StageError(
            f"{where} has {width} x {height} pixels, but its camera {camera.width} x {camera.height}; give the photos"
            " that the camera was computed for, or copies scaled alike"
        )
    scaled = pycolmap.Camera(camera.todict())
    scaled.rescale(width, height)
    return scaled


def _same_shape(camera: pycolmap.Camera, size: Size) -> bool:
    return bool(abs(camera.width / camera.height * size[1] / size[0] - 1) <= SHAPE_TOLERANCE)


def possible_turns(
    posed: Mapping[str, PosedPhoto], orientations: Mapping[str, int], sizes: Mapping[str, Size]
) -> list[dict[str, PosedPhoto]]:
    """The cameras of photos by name as they may be meant, one way or two: for upright photos, or for stored ones.

    The size of a photo on its side tells which, and then counts for those that stand on their heads as well. Where none
    does, both ways are possible.

    Args:
        posed: cameras as given.
        orientations: EXIF orientation of the photos that were turned here.
        sizes: (width, height) of the upright photos.

    Raises:
        StageError: a photo on its side has a lens that cannot be turned.
    """
    turned = {
        name: QUARTERS[o] for name, o in orientations.items() if o in QUARTERS and name in posed and name in sizes
    }
    shapes = {
        name: (_same_shape(posed[name].camera, sizes[name]), _same_shape(posed[name].camera, sizes[name][::-1]))
        for name, quarters in turned.items()
        if quarters % 2
    }
    stored = [name for name, (upright, lying) in shapes.items() if lying and not upright]
    as_they_are = [name for name, (upright, lying) in shapes.items() if upright and not lying]
    if not turned or (as_they_are and not stored):
        return [dict(posed)]
    other = dict(posed) | {
        name: stood_upright(posed[name], quarters) for name, quarters in turned.items() if name not in as_they_are
    }
    return [other] if stored else [dict(posed), other]


def stood_upright(photo: PosedPhoto, quarters: int) -> PosedPhoto:
    """A camera after so many clockwise quarter turns of its photo.

    Raises:
        StageError: its lens has parameters that depend on the axes and that are not known here.
    """
    for _ in range(quarters):
        camera, old = pycolmap.Camera(photo.camera.todict()), photo.camera
        names = [name.strip() for name in old.params_info.split(",")]
        own = dict(zip(names, np.asarray(old.params).tolist()))
        new = {name: own[name] for name in names if name in EVEN}
        new |= {"cx": old.height - own["cy"], "cy": own["cx"]}
        if "fx" in own:
            new |= {"fx": own["fy"], "fy": own["fx"]}
        if "p1" in own:
            new |= {"p1": own["p2"], "p2": -own["p1"]}
        if set(new) != set(own):
            raise StageError(
                f"{photo.file.name} is rotated by EXIF, and its camera, a {old.model.name}, cannot be turned along;"
                " undistort the photos in the program that found the cameras, or rotate them before"
            )
        camera.width, camera.height = old.height, old.width
        camera.params = [new[name] for name in names]
        photo = replace(photo, camera=camera, object_from_cam=photo.object_from_cam @ FROM_STORED.T)
    return photo
