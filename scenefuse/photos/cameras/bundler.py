"""Cameras in Bundler's format, bundle.out with list.txt, which RealityCapture and Metashape export too."""

import re
from pathlib import Path

import numpy as np
import pycolmap

from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_lines
from scenefuse.core.transforms import Array
from scenefuse.photos.cameras.posed_photo import FLIP, PosedPhoto
from scenefuse.photos.photo_files import PhotosByName, bundler_list, stored_size

# What may follow a photo's name in the list: a zero, and its focal length by EXIF.
FOCAL = re.compile(r"\s+0\s+[-+.\deE]+$")


def read_bundler(file: Path, folder: Path) -> list[PosedPhoto]:
    """The photos that have a camera (v0.3 of the format: a focal length of 0 is none).

    The principal point is the photo's middle; k1 and k2 are radial, over undistorted coordinates, as COLMAP's.

    Args:
        file: bundle.out.
        folder: of the photos; list.txt beside the file names them, in its order.

    Raises:
        StageError: there is no list, it is shorter than the cameras, or one of the files is not well formed.
    """
    names = [FOCAL.sub("", line.strip()) for _, line in read_lines(_list(file))]
    by_name, found, cameras = PhotosByName(folder), [], _cameras(file)
    if len(names) < len(cameras):
        raise StageError(f"{file} has {len(cameras)} cameras, its list names {len(names)} photos; export both again")
    for name, (lens, turn, shift) in zip(names, cameras):
        photo = by_name.find(name)
        if lens[0] > 0 and photo.is_file():
            width, height = stored_size(photo)
            params = [lens[0], width / 2, height / 2, lens[1], lens[2]]
            camera = pycolmap.Camera(model="RADIAL", width=width, height=height, params=params)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = (FLIP @ turn).T, -turn.T @ shift
            found.append(PosedPhoto(photo.name, photo, camera, pose, None, False))
    return found


def _list(file: Path) -> Path:
    listed = bundler_list(file)
    if listed is None:
        raise StageError(f"the list of photos of {file} is missing; put it beside it as list.txt")
    return listed


def _cameras(file: Path) -> list[tuple[Array, Array, Array]]:
    """Focal length and radial coefficients (3,), rotation (3, 3) and translation (3,) of each camera."""
    lines = [line.split() for _, line in read_lines(file)]
    try:
        count = int(lines[0][0])
        rows = [np.array(line, dtype=float) for line in lines[1 : 1 + 5 * count]]
        blocks = [np.stack(rows[5 * k : 5 * k + 5]) for k in range(count)]
        return [(block[0], block[1:4], block[4]) for block in blocks]
    except (ValueError, IndexError) as error:
        raise StageError(f"{file} is no file of Bundler ({error}); export it again") from None
