"""The one reader of cameras that other programs found: COLMAP, nerfstudio, Blender, OpenSfM, Metashape, Bundler."""

from pathlib import Path

import numpy as np

from scenefuse.core.stage import StageError
from scenefuse.photos.cameras.bundler import read_bundler
from scenefuse.photos.cameras.metashape import metashape_place, read_metashape
from scenefuse.photos.cameras.opensfm import find_opensfm, opensfm_place, read_opensfm
from scenefuse.photos.cameras.place import Place
from scenefuse.photos.cameras.posed_photo import PosedPhoto
from scenefuse.photos.cameras.transforms import TRANSFORMS, read_transforms
from scenefuse.photos.photo_files import BUNDLER, PhotosByName, frame_name
from scenefuse.photos.workspace import posed_images, read_model

LAYOUTS = (
    "sparse/ or sparse/0 (COLMAP), transforms.json (nerfstudio), transforms_train.json (Blender) or"
    " reconstruction.json (OpenSfM); or Metashape's XML or Bundler's .out"
)
METASHAPE = "in Metashape, export the cameras as Agisoft XML (File, Export, Export Cameras)"
REALITY = "in RealityCapture, export the registration as Bundler v0.3 (.out) with the list of photos"
# What to do about files of other programs that hold cameras in a form that is not read.
EXPORTS = {".psx": METASHAPE, ".psz": METASHAPE, ".csv": REALITY, ".rcproj": REALITY}


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
        return read_bundler(cameras, folder), "Bundler"
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
