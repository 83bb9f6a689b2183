"""The one reader of cameras that other programs found: COLMAP, nerfstudio, Blender, OpenSfM, Metashape, and Bundler's
bundle.out with list.txt, which RealityCapture and Metashape export too."""

import re
from pathlib import Path

import numpy as np
import pycolmap

from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_lines
from scenefuse.core.transforms import Array
from scenefuse.photos.cameras.metashape import metashape_place, read_metashape
from scenefuse.photos.cameras.opensfm import find_opensfm, opensfm_place, read_opensfm
from scenefuse.photos.cameras.place import Place
from scenefuse.photos.cameras.posed_photo import FLIP, PosedPhoto
from scenefuse.photos.cameras.transforms import TRANSFORMS, read_transforms
from scenefuse.photos.photo_files import BUNDLER, PhotosByName, bundler_list, frame_name, stored_size
from scenefuse.photos.workspace import posed_images, read_model

LAYOUTS = (
    "sparse/ or sparse/0 (COLMAP), transforms.json (nerfstudio), transforms_train.json (Blender) or"
    " reconstruction.json (OpenSfM); or Metashape's XML or Bundler's .out"
)
METASHAPE = "in Metashape, export the cameras as Agisoft XML (File, Export, Export Cameras)"
REALITY = "in RealityCapture, export the registration as Bundler v0.3 (.out) with the list of photos"
# What to do about files of other programs that hold cameras in a form that is not read.
EXPORTS = {".psx": METASHAPE, ".psz": METASHAPE, ".csv": REALITY, ".rcproj": REALITY}
# What may follow a photo's name in the list: a zero, and its focal length by EXIF.
FOCAL = re.compile(r"\s+0\s+[-+.\deE]+$")


def read_posed_photos(cameras: Path, folder: Path) -> tuple[list[PosedPhoto], str]:
    """Photos and cameras of a file, or of a folder that holds one, and the program's name.

    Args:
        cameras: of any program; of a COLMAP model and JSON in one folder the JSON is read.
        folder: of the photos. A photo that is not there has the path that it would have.

    Raises:
        StageError: no known format, or cameras that cannot be read.
    """
    if not cameras.exists():
        raise StageError(f"the cameras {cameras} do not exist; correct the path")
    ending = cameras.suffix.lower()
    if ending in EXPORTS:
        raise StageError(f"{cameras} is not read; {EXPORTS[ending]}")
    if ending == ".xml":
        return read_metashape(cameras, folder), "Metashape"
    if cameras.suffix == BUNDLER:
        return _read_bundler(cameras, folder), "Bundler"
    if (file := find_opensfm(cameras)) is not None:
        return read_opensfm(file, folder), "OpenSfM"
    jsons = [cameras] if cameras.is_file() else [cameras / name for name in TRANSFORMS if (cameras / name).is_file()]
    if jsons:
        return read_transforms(jsons[0], folder), TRANSFORMS.get(jsons[0].name, "nerfstudio")
    for model in (cameras / "sparse/0", cameras / "sparse", cameras):
        if (model / "images.bin").is_file() or (model / "images.txt").is_file():
            return _read_colmap(model, folder), "COLMAP"
    raise StageError(f"{cameras} holds no cameras in a known format; give a folder with {LAYOUTS}")


def place_of(cameras: Path) -> Place | None:
    """Where the cameras that `read_posed_photos` gives lie on the earth; None where their project does not say."""
    if cameras.suffix.lower() == ".xml":
        return metashape_place(cameras)
    file = find_opensfm(cameras)
    return None if file is None else opensfm_place(file)


def _read_colmap(model: Path, folder: Path) -> list[PosedPhoto]:
    reconstruction, photos, by_name = read_model(model), [], PhotosByName(folder)
    for image in posed_images(reconstruction):
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        camera = reconstruction.cameras[image.camera_id]
        photos.append(PosedPhoto(frame_name(image.name), by_name.find(image.name), camera, pose, None, False))
    return photos


def _read_bundler(file: Path, folder: Path) -> list[PosedPhoto]:
    """The photos that have a camera (v0.3 of the format: a focal length of 0 is none).

    The principal point is the photo's middle; k1 and k2 are radial, over undistorted coordinates, as COLMAP's.

    Args:
        file: bundle.out.
        folder: of the photos; list.txt beside the file names them, in its order.

    Raises:
        StageError: there is no list, it is shorter than the cameras, or one of the files is not well formed.
    """
    names = [FOCAL.sub("", line.strip()) for _, line in read_lines(_bundler_photos(file))]
    by_name, found, cameras = PhotosByName(folder), [], _bundler_cameras(file)
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


def _bundler_photos(file: Path) -> Path:
    listed = bundler_list(file)
    if listed is None:
        raise StageError(f"the list of photos of {file} is missing; put it beside it as list.txt")
    return listed


def _bundler_cameras(file: Path) -> list[tuple[Array, Array, Array]]:
    """Focal length and radial coefficients (3,), rotation (3, 3) and translation (3,) of each camera."""
    lines = [line.split() for _, line in read_lines(file)]
    try:
        count = int(lines[0][0])
        rows = [np.array(line, dtype=float) for line in lines[1 : 1 + 5 * count]]
        blocks = [np.stack(rows[5 * k : 5 * k + 5]) for k in range(count)]
        return [(block[0], block[1:4], block[4]) for block in blocks]
    except (ValueError, IndexError) as error:
        raise StageError(f"{file} is no file of Bundler ({error}); export it again") from None
