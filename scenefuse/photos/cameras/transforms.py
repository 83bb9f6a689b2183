"""Cameras of nerfstudio's transforms.json and of Blender's transforms_train.json."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.photos.cameras.posed_photo import FLIP, PosedPhoto
from scenefuse.photos.photo_files import PhotosByName, stored_size

TRANSFORMS = {"transforms.json": "nerfstudio", "transforms_train.json": "Blender"}
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def read_transforms(file: Path, folder: Path) -> list[PosedPhoto]:
    """The photos of a transforms JSON; beside Blender's transforms_train.json, transforms_test.json is held out.

    Args:
        file: the JSON; it names photos relative to its own folder.
        folder: where else they may be.

    Raises:
        StageError: the file is no such JSON, or has a lens that is no perspective one.
    """
    photos = _read(file, folder, False)
    test = file.with_name("transforms_test.json")
    if file.name == "transforms_train.json" and test.is_file():
        photos += _read(test, folder, True)
    common = Path(os.path.commonpath([photo.file.parent for photo in photos]))
    return [
        PosedPhoto("_".join(p.file.relative_to(common).parts), p.file, p.camera, p.object_from_cam, p.mask, p.held_out)
        for p in photos
    ]


def _read(file: Path, folder: Path, held_out: bool) -> list[PosedPhoto]:
    try:
        content = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise StageError(f"{file} is no readable JSON ({error}); export it again") from None
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise StageError(f"{file} has no list of frames; give a transforms JSON as nerfstudio or Blender write it")
    kept_out = {name for key in ("val_filenames", "test_filenames") for name in content.get(key) or []}
    photos, by_name = [], PhotosByName(folder, file.parent)
    for number, frame in enumerate(frames):
        values = {key: value for key, value in content.items() if key != "frames"} | frame
        where = f"{file}, frame {number} ({values.get('file_path', 'no file_path')})"
        if not isinstance(values.get("file_path"), str):
            raise StageError(f"{where}: names no photo; every frame needs a file_path")
        photo, mask = by_name.find(values["file_path"]), values.get("mask_path")
        camera, pose = _camera(values, photo, where), _pose(values.get("transform_matrix"), where)
        masked = None if mask is None else by_name.at(mask)
        if mask is not None and masked is None:
            raise StageError(f"{where}: its mask {mask} does not exist; put it back, or take mask_path out")
        photos.append(PosedPhoto("", photo, camera, pose, masked, held_out or values["file_path"] in kept_out))
    return photos


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
        numbers["w"], numbers["h"] = stored_size(photo)
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
    pose[:3, :3] = left @ right @ FLIP
    return pose
