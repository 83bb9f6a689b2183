"""Cameras of a COLMAP model, in text or binary form: lenses and poses alone, its points are not read."""

import struct
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from scenefuse.core.tables import read_lines, read_text
from scenefuse.photos.cameras.posed_photo import GivenCamera, colmap_camera

Image = tuple[str, int, list[float]]


def read_colmap(model: Path) -> list[GivenCamera]:
    """The posed photos of a model, by cameras and images in text or binary form.

    Raises:
        ValueError, OSError, struct.error, KeyError: the files are damaged.
    """
    binary = (model / "images.bin").is_file()
    cameras = _binary_cameras(model / "cameras.bin") if binary else _text_cameras(model / "cameras.txt")
    images = _binary_images(model / "images.bin") if binary else _text_images(model / "images.txt")
    found = []
    for name, camera, (*turn, x, y, z) in images:
        pose, rotation = np.eye(4), Rotation.from_quat(turn, scalar_first=True).as_matrix().T
        pose[:3, :3], pose[:3, 3] = rotation, -rotation @ [x, y, z]
        found.append(GivenCamera(name, cameras[camera], pose))
    return found


def camera_of(words: list[str]) -> pycolmap.Camera:
    """The camera of a line of cameras.txt: id, model, width, height, parameters.

    Raises:
        ValueError: it is not well formed.
    """
    if len(words) < 5:
        raise ValueError(f"{' '.join(words)} is no camera")
    return colmap_camera(words[1], float(words[2]), float(words[3]), [float(word) for word in words[4:]])


def _text_cameras(file: Path) -> dict[int, pycolmap.Camera]:
    return {int(line.split()[0]): camera_of(line.split()) for _, line in read_lines(file)}


def _text_images(file: Path) -> list[Image]:
    """Names, cameras, and poses; a line of observations may follow each image, or be left out, or empty."""
    found: list[Image] = []
    after_image = False
    for number, line in enumerate(read_text(file).splitlines(), 1):
        # Id, quaternion, translation, camera's id, and the name, which may hold blanks.
        words = line.split(maxsplit=9)
        if line.startswith("#"):
            continue
        if after_image and (not words or _are_observations(line.split())):
            after_image = False
        elif words:
            if len(words) < 10:
                raise ValueError(f"{file.name}, line {number}: neither an image nor its observations")
            found.append((words[9].strip(), int(words[8]), [float(word) for word in words[1:8]]))
            after_image = True
    return found


def _are_observations(words: list[str]) -> bool:
    """Whether a line is x y point, again and again."""
    try:
        return len([float(word) for word in words]) % 3 == 0
    except ValueError:
        return False


def _binary_cameras(file: Path) -> dict[int, pycolmap.Camera]:
    data, at, found = file.read_bytes(), 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, kind, width, height = struct.unpack_from("<IiQQ", data, at)
        model = pycolmap.CameraModelId(kind).name
        count = len(pycolmap.Camera.create_from_model_name(0, model, 1.0, 1, 1).params)
        found[number] = colmap_camera(model, width, height, list(struct.unpack_from(f"<{count}d", data, at + 24)))
        at += 24 + 8 * count
    return found


def _binary_images(file: Path) -> list[Image]:
    data, at, found = file.read_bytes(), 8, []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        _, *pose, camera = struct.unpack_from("<I7dI", data, at)
        end = data.index(b"\0", at + 64)
        found.append((data[at + 64 : end].decode(errors="replace"), camera, pose))
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
    return found
