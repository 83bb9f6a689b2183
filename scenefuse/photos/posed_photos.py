"""Photos whose cameras another program found: COLMAP, nerfstudio's transforms.json, Blender's transforms_train.json."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from scenefuse.core.stage import StageError
from scenefuse.photos.photo_files import frame_name
from scenefuse.photos.workspace import posed_images, read_model

ENDINGS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
LAYOUTS = "sparse/ or sparse/0 (COLMAP), transforms.json (nerfstudio) or transforms_train.json (Blender)"


@dataclass(frozen=True)
class PosedPhoto:
    """One photo on disk and its camera.

    Attributes:
        name: what to call it, without folders; unique up to the ending.
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


def find_posed_photos(data: Path, images: Path | None) -> tuple[list[PosedPhoto], str]:
    """Photos and cameras of a folder or file in any of the formats, and the format's name.

    Args:
        data: a transforms JSON, or a folder that holds one or a COLMAP model; JSON comes first where a folder has both.
        images: folder of the photos of a COLMAP model, where they are not in `data`/images.

    Raises:
        StageError: no known format, photos that are missing, JSON or a model that cannot be read.
    """
    if not data.exists():
        raise StageError(f"--data {data} does not exist; give a folder with {LAYOUTS}")
    if data.is_file():
        files, models = [data], []
    else:
        files = [p for p in (data / "transforms.json", data / "transforms_train.json") if p.is_file()]
        folders = (data / "sparse/0", data / "sparse", data)
        models = [p for p in folders if (p / "images.bin").is_file() or (p / "images.txt").is_file()]
    if files:
        if images is not None:
            raise StageError(f"--images goes with a COLMAP model; {files[0]} names its photos itself")
        photos = _read_transforms_and_test(files[0])
        kind = "Blender" if files[0].name == "transforms_train.json" else "nerfstudio"
    elif models:
        photos, kind = _read_colmap(models[0], images or data / "images"), "COLMAP"
    else:
        raise StageError(f"{data} holds no cameras in a known format; give a folder with {LAYOUTS}")
    if not photos:
        raise StageError(f"{data} holds no photo with a camera; reconstruct the photos first")
    stems = [Path(photo.name).stem for photo in photos]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise StageError(f"two photos of {data} are both called {twice}; rename one")
    return photos, kind


def _read_colmap(model: Path, images: Path) -> list[PosedPhoto]:
    reconstruction, photos = read_model(model), []
    for image in posed_images(reconstruction):
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        camera = reconstruction.cameras[image.camera_id]
        name = frame_name(image.name)
        # Frames lie in one folder.
        file = images / (image.name if (images / image.name).is_file() else name)
        photos.append(PosedPhoto(name, file, camera, pose, None, False))
    missing = [photo.file for photo in photos if not photo.file.is_file()]
    if missing:
        raise StageError(
            f"{len(missing)} of {len(photos)} photos of the model {model} are missing, {missing[0]} for one; "
            "give their folder with --images"
        )
    return photos


def _read_transforms_and_test(file: Path) -> list[PosedPhoto]:
    """A transforms JSON; beside Blender's transforms_train.json, transforms_test.json is held out."""
    photos = _read_transforms(file, False)
    test = file.with_name("transforms_test.json")
    if file.name == "transforms_train.json" and test.is_file():
        photos += _read_transforms(test, True)
    common = Path(os.path.commonpath([photo.file.parent for photo in photos]))
    return [
        PosedPhoto("_".join(p.file.relative_to(common).parts), p.file, p.camera, p.object_from_cam, p.mask, p.held_out)
        for p in photos
    ]


def _read_transforms(file: Path, held_out: bool) -> list[PosedPhoto]:
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise StageError(f"{file} is no readable JSON ({error}); export it again") from None
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise StageError(f"{file} has no list of frames; give a transforms JSON as nerfstudio or Blender write it")
    kept_out = {name for key in ("val_filenames", "test_filenames") for name in content.get(key) or []}
    photos = []
    for number, frame in enumerate(frames):
        values = {key: value for key, value in content.items() if key != "frames"} | frame
        where = f"{file}, frame {number} ({values.get('file_path', 'no file_path')})"
        if not isinstance(values.get("file_path"), str):
            raise StageError(f"{where}: names no photo; every frame needs a file_path")
        photo = _existing(file.parent, values["file_path"], where)
        mask = values.get("mask_path")
        camera, pose = _camera(values, photo, where), _pose(values.get("transform_matrix"), where)
        masked = None if mask is None else _existing(file.parent, mask, where)
        photos.append(PosedPhoto("", photo, camera, pose, masked, held_out or values["file_path"] in kept_out))
    return photos


def _existing(folder: Path, path: str, where: str) -> Path:
    """A file named relative to a folder, with or without its ending."""
    named = Path(os.path.abspath(folder / path))
    for candidate in (named, *(named.with_name(named.name + ending) for ending in ENDINGS)):
        if candidate.is_file():
            return candidate
    raise StageError(f"{where}: {named} does not exist; put it back, or take the frame out")


def _camera(values: dict[str, Any], photo: Path, where: str) -> pycolmap.Camera:
    """The lens of a frame; COLMAP's FULL_OPENCV holds all coefficients that the JSON may have."""
    model = values.get("camera_model", "OPENCV")
    if model not in PERSPECTIVE or values.get("is_fisheye"):
        model = "fisheye" if model in PERSPECTIVE else model
        raise StageError(f"{where}: the camera model {model} is not read; undistort the photos to PINHOLE first")
    try:
        numbers = {
            key: float(values[key])
            for key in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "k1", "k2", "k3", "k4", "p1", "p2")
            if values.get(key) is not None
        }
    except (TypeError, ValueError):
        raise StageError(f"{where}: the camera's values have to be numbers; correct them") from None
    if numbers.get("k4"):
        raise StageError(f"{where}: distortion with k4 is not read; undistort the photos to PINHOLE first")
    if not {"w", "h"} <= numbers.keys():
        numbers["w"], numbers["h"] = photo_size(photo)
    width, height = numbers["w"], numbers["h"]
    if "fl_x" in numbers:
        focal = numbers["fl_x"]
    elif "camera_angle_x" in numbers:
        focal = 0.5 * width / np.tan(0.5 * numbers["camera_angle_x"])
    else:
        raise StageError(f"{where}: no focal length; give fl_x (pixels) or camera_angle_x (radians)")
    middle = numbers.get("cx", width / 2), numbers.get("cy", height / 2)
    bent = [numbers.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    params = [focal, numbers.get("fl_y", focal), *middle, *bent, 0.0, 0.0, 0.0]
    if not (np.isfinite(params).all() and min(params[:2]) > 0):
        raise StageError(f"{where}: a focal length has to be positive and all values finite; correct them")
    return pycolmap.Camera(model="FULL_OPENCV", width=round(width), height=round(height), params=params)


def _pose(matrix: Any, where: str) -> NDArray[np.float64]:
    """OpenGL's object_from_cam (x right, y up, looking along -z) in OpenCV's axes."""
    try:
        given = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        given = np.zeros(0)
    if given.shape not in ((4, 4), (3, 4)) or not np.isfinite(given).all():
        raise StageError(f"{where}: transform_matrix has to be 4 x 4 numbers; export the cameras again")
    pose = np.eye(4)
    pose[:3] = given[:3]
    axes = pose[:3, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-3 or np.linalg.det(axes) < 0:
        raise StageError(f"{where}: transform_matrix is no rotation and translation; remove scale and mirroring")
    left, _, right = np.linalg.svd(axes)
    pose[:3, :3] = left @ right @ np.diag([1.0, -1.0, -1.0])
    return pose


def photo_size(photo: Path) -> tuple[int, int]:
    """Width and height of a photo as it is stored, from its header.

    Raises:
        StageError: the file is no picture.
    """
    try:
        with Image.open(photo) as picture:
            return picture.size
    except OSError:
        raise StageError(f"{photo} is not a readable picture; export it again") from None
