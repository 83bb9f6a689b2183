"""Cameras in JSON: transforms.json of nerfstudio and Blender, and reconstruction.json of OpenSfM (OpenDroneMap)."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycolmap import Camera
from scipy.spatial.transform import Rotation

from scenefuse.cloud.crs import plane, read_crs
from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_lines, read_text
from scenefuse.core.transforms import Sim3
from scenefuse.photos.cameras.given import FLIP, GivenCamera, Place, Size, check_crs, colmap_camera, seen_from
from scenefuse.photos.photo_files import COORDS, HELD_OUT_FILE, files_by_name

TRANSFORMS = {"transforms.json": "nerfstudio", "transforms_train.json": "Blender"}
# What an OpenDroneMap project that lies on the earth has beside it.
TOPOCENTRIC = "reconstruction.topocentric.json"
# What describes a camera, of a frame or of all of them.
NUMBERS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "k1", "k2", "k3", "k4", "p1", "p2")
FISHEYE = "OPENCV_FISHEYE"
# OpenSfM's lenses -> whether they are fisheyes; all are special cases of COLMAP's two models.
LENSES = dict.fromkeys(("perspective", "simple_radial", "radial", "brown"), False)
LENSES |= dict.fromkeys(("fisheye", "fisheye_opencv"), True)
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def read_transforms(file: Path) -> list[GivenCamera]:
    """The photos of a transforms JSON; beside Blender's transforms_train.json, transforms_test.json is held out.

    Raises:
        StageError: a lens is no perspective one, a frame lacks what it needs, a mask is missing.
        ValueError, TypeError: the file is no such JSON.
    """
    photos = _read(file, False)
    test = file.with_name(HELD_OUT_FILE)
    return photos + (_read(test, True) if file.name == "transforms_train.json" and test.is_file() else [])


def _read(file: Path, held_out: bool) -> list[GivenCamera]:
    content = json.loads(read_text(file))
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise StageError(f"{file} has no list of frames; give a transforms JSON as nerfstudio or Blender write it")
    kept_out = {str(name) for key in ("val_filenames", "test_filenames") for name in content.get(key) or []}
    masks = _masks([str(frame["mask_path"]) for frame in frames if frame.get("mask_path")], file)
    found = []
    for number, frame in enumerate(frames):
        values = {key: value for key, value in content.items() if key != "frames"} | frame
        name, mask = values.get("file_path"), values.get("mask_path")
        where = f"{file}, frame {number} ({name or 'no file_path'})"
        if not isinstance(name, str):
            raise StageError(f"{where}: names no photo; every frame needs a file_path")
        if mask and mask not in masks:
            raise StageError(f"{where}: its mask {mask} does not exist; put it back, or take mask_path out")
        camera, pose = _camera(values, where), _pose(values.get("transform_matrix"), where)
        found.append(GivenCamera(name, camera, pose, masks[mask] if mask else None, held_out or name in kept_out))
    return found


def _masks(names: list[str], file: Path) -> dict[str, Path]:
    """The masks by the names that a JSON gives them; none from another folder, where photos may be called alike."""
    found = files_by_name(names, file.parent, str(file))
    named = {name: Path(name.replace("\\", "/")).parent.name.casefold() for name in found}
    return {name: mask for name, mask in found.items() if named[name] in ("", mask.parent.name.casefold())}


def _camera(values: dict[str, Any], where: str) -> Callable[[Callable[[], Size]], Camera]:
    """The lens of a frame for its photo; COLMAP's two models hold all coefficients that the JSON may have."""
    model = FISHEYE if values.get("is_fisheye") else values.get("camera_model", "OPENCV")
    if model not in (*PERSPECTIVE, FISHEYE):
        raise StageError(f"{where}: the camera model {model} is not read; undistort the photos to PINHOLE first")
    try:
        numbers = {key: float(values[key]) for key in NUMBERS if values.get(key) is not None}
    except (TypeError, ValueError):
        raise StageError(f"{where}: the camera's values have to be numbers; correct them") from None
    if numbers.get("k4") and model != FISHEYE:
        raise StageError(f"{where}: distortion with k4 is not read; undistort the photos to PINHOLE first")
    if "fl_x" not in numbers and (model == FISHEYE or "camera_angle_x" not in numbers):
        raise StageError(f"{where}: no focal length; give fl_x (pixels) or camera_angle_x (radians)")

    def camera(size: Callable[[], Size]) -> Camera:
        width, height = (numbers[side] for side in "wh") if {"w", "h"} <= numbers.keys() else size()
        across, upwards = (
            numbers.get(f"fl_{axis}") or _focal(side, numbers.get(f"camera_angle_{axis}", 0.0))
            for axis, side in (("x", width), ("y", height))
        )
        middle = numbers.get("cx", width / 2), numbers.get("cy", height / 2)
        return _bent(model == FISHEYE, (width, height), [across, upwards or across, *middle], numbers)

    return camera


def _focal(side: float, angle: float) -> float:
    """The focal length of a side of a photo seen by so wide an angle; 0 where none is given."""
    return 0.5 * side / float(np.tan(0.5 * angle)) if angle else 0.0


def _bent(fisheye: bool, size: tuple[float, float], straight: list[float], numbers: Mapping[str, float]) -> Camera:
    """COLMAP's camera of a focal length and middle in x and y, and of coefficients of distortion, 0 where absent."""
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "", "", "")
    params = [*straight, *(numbers.get(name, 0.0) for name in names)]
    return colmap_camera(FISHEYE if fisheye else "FULL_OPENCV", *size, params)


def _pose(matrix: Any, where: str) -> NDArray[np.float64]:
    """OpenGL's object_from_cam (x right, y up, looking along -z) in OpenCV's axes."""
    try:
        given = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        given = np.zeros(0)
    if given.shape not in ((4, 4), (3, 4)) or not np.isfinite(given).all():
        raise StageError(f"{where}: transform_matrix has to be 4 x 4 numbers; export the cameras again")
    if not np.allclose(given[3:], [0, 0, 0, 1]):
        raise StageError(f"{where}: the last row of transform_matrix is not 0 0 0 1; rows and columns may be swapped")
    return np.vstack([given[:3] * [*FLIP.diagonal(), 1.0], [0.0, 0.0, 0.0, 1.0]])


def read_opensfm(file: Path) -> dict[str, list[GivenCamera]]:
    """The posed photos of each of the file's reconstructions.

    OpenSfM counts pixels from the middle of the photo, in units of its longer side; a pose is an angle-axis rotation
    and a translation into the camera, whose axes are OpenCV's.

    Raises:
        StageError: a lens is of another kind.
        ValueError, KeyError, TypeError: the file is no such JSON.
    """
    found, parts = {}, json.loads(read_text(file))
    if not isinstance(parts, list):
        raise TypeError("it is no list of reconstructions")
    for number, part in enumerate(parts):
        cameras = {name: _lens(entry, f"{file}, camera {name}") for name, entry in part["cameras"].items()}
        shots = sorted(part["shots"].items())
        found[str(number)] = [GivenCamera(name, cameras[shot["camera"]], _shot_pose(shot)) for name, shot in shots]
    return found


def opensfm_place(file: Path) -> Place | None:
    """Where the cameras of an OpenDroneMap project lie on the earth; None for any other.

    Its reconstruction.json is in the CRS less the offset in odm_georeferencing/coords.txt, once
    reconstruction.topocentric.json lies beside it; its clouds are in the CRS.

    Raises:
        StageError: coords.txt is damaged.
    """
    coords = file.parent.parent / COORDS
    if not (file.with_name(TOPOCENTRIC).is_file() and coords.is_file()):
        return None
    lines = [line for _, line in read_lines(coords)]
    try:
        east, north = map(float, lines[1].split())
    except (IndexError, ValueError):
        east = north = np.nan
    if not np.isfinite([east, north]).all():
        raise StageError(f"{coords} is damaged: its second line is no offset; copy it again out of the project")
    crs = read_crs(lines[0], str(coords))
    check_crs(crs, str(coords))
    place = Place(Sim3(1.0, np.eye(3), np.array([east, north, 0.0])), False, crs)
    if plane(crs).is_geographic:
        raise StageError(f"{coords}: the CRS {crs.name} is in degrees, and its offset cannot be; copy it again")
    place.wgs84(np.zeros((1, 3)), str(coords))
    return place


def _lens(entry: dict[str, Any], where: str) -> Camera:
    width, height, kind = float(entry["width"]), float(entry["height"]), entry.get("projection_type", "perspective")
    if kind not in LENSES:
        raise StageError(f"{where} is of the kind {kind}, which is not read; undistort the photos in OpenSfM first")
    size = max(width, height)
    focal = [size * entry[name if name in entry else "focal"] for name in ("focal_x", "focal_y")]
    middle = width / 2 + size * entry.get("c_x", 0.0), height / 2 + size * entry.get("c_y", 0.0)
    return _bent(LENSES[kind], (width, height), [*focal, *middle], entry)


def _shot_pose(shot: dict[str, Any]) -> NDArray[np.float64]:
    """(4, 4) world_from_cam."""
    return seen_from(Rotation.from_rotvec(shot["rotation"]).as_matrix(), np.array(shot["translation"], np.float64))
