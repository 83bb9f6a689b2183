"""Cameras of OpenSfM, which OpenDroneMap runs: reconstruction.json."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from scenefuse.cloud.crs import plane, read_crs
from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_lines, read_text
from scenefuse.core.transforms import Sim3
from scenefuse.photos.cameras.place import Place, check_crs
from scenefuse.photos.cameras.posed_photo import GivenCamera, colmap_camera
from scenefuse.photos.photo_files import COORDS

FILE = "reconstruction.json"
# Where an OpenDroneMap project has it.
PLACES = (FILE, f"opensfm/{FILE}")
# What an OpenDroneMap project that lies on the earth has beside it.
TOPOCENTRIC = "reconstruction.topocentric.json"


def find_opensfm(data: Path) -> Path | None:
    """The reconstruction.json of a folder; None where there is none."""
    return next((data / place for place in PLACES if (data / place).is_file()), None)


def read_opensfm(file: Path) -> dict[str, list[GivenCamera]]:
    """The posed photos of each of the file's reconstructions; lenses perspective and brown.

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
        cameras = {name: _camera(entry, f"{file}, camera {name}") for name, entry in part["cameras"].items()}
        shots = sorted(part["shots"].items())
        found[str(number)] = [GivenCamera(name, cameras[shot["camera"]], _pose(shot)) for name, shot in shots]
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


def _camera(entry: dict[str, Any], where: str) -> pycolmap.Camera:
    width, height, kind = float(entry["width"]), float(entry["height"]), entry["projection_type"]
    size = max(width, height)
    if kind == "perspective":
        return colmap_camera(
            "RADIAL", width, height, [entry["focal"] * size, width / 2, height / 2, entry["k1"], entry["k2"]]
        )
    if kind == "brown":
        focal_x, focal_y = entry["focal_x"] * size, entry["focal_y"] * size
        middle = width / 2 + entry["c_x"] * size, height / 2 + entry["c_y"] * size
        bent_by = [entry[key] for key in ("k1", "k2", "p1", "p2", "k3")]
        return colmap_camera("FULL_OPENCV", width, height, [focal_x, focal_y, *middle, *bent_by, 0.0, 0.0, 0.0])
    raise StageError(f"{where} is of the kind {kind}; perspective and brown are read")


def _pose(shot: dict[str, Any]) -> np.ndarray:
    """(4, 4) world_from_cam."""
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = Rotation.from_rotvec(shot["rotation"]).as_matrix()
    cam_from_world[:3, 3] = shot["translation"]
    return np.asarray(np.linalg.inv(cam_from_world))
