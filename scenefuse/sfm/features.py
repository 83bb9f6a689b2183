"""SIFT features with COLMAP, the first step of structure from motion; the same code serves scenes and objects."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap

from scenefuse.core.stage import StageError, atomic_file, setting, threads
from scenefuse.core.tables import read_lines
from scenefuse.photos.cameras.given import at_size
from scenefuse.photos.cameras.read_cameras import camera_of
from scenefuse.photos.photos import Photo, check_unchanged, read_photos
from scenefuse.sfm.colmap import cancellable

# Fewer features in a photo than this deserve a note: blur, fog, or a wall without texture.
FEW_FEATURES = 100


@dataclass(frozen=True)
class FeatureSettings:
    """SIFT and the camera model."""

    max_image_size_px: int = setting(2000, unit="px", least=0)
    """Longest side at which features are looked for; larger photos are scaled down for this stage only."""
    max_features: int = setting(4000, least=0)
    """Most features kept per photo, the largest first."""
    first_octave: int = setting(-1, least=-1)
    """-1 looks for features in photos enlarged twice as well: more small features, four times the work; 0 does not."""
    camera_model: Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"] = setting("SIMPLE_RADIAL")
    """COLMAP's camera model; focal length and distortion are refined."""
    camera_mode: Literal["auto", "single", "per_folder", "per_photo"] = setting("auto")
    """Which photos share one camera; auto: those with one size, EXIF camera and focal length."""


def extract_features(
    *, folder: Path, photos: Path, features: Path, calibration: Path | None = None, settings: FeatureSettings
) -> None:
    """Find SIFT features in every photo and write them, with cameras and GPS priors, to a COLMAP database.

    Args:
        folder: folder of photos.
        photos: JSON list of them.
        features: output, COLMAP database.
        calibration: a known camera, in the form of COLMAP's cameras.txt, for all photos; it is held from here on.
        settings: SIFT and camera settings.

    Raises:
        StageError: `camera_mode` is single and the photos differ in size, or a photo is missing, has changed
            since it was listed, or cannot be read.
    """
    listed = read_photos(photos)
    check_unchanged(folder, listed)
    groups = camera_groups(listed, settings.camera_mode)
    known = None if calibration is None else read_calibration(calibration)
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = settings.max_image_size_px
    options.num_threads = threads()
    options.use_gpu = False
    options.sift.max_num_features = settings.max_features
    options.sift.first_octave = settings.first_octave
    with atomic_file(features) as temporary:
        for names in groups:
            reader = _reader_options(settings, known, next(p for p in listed if p.name == names[0]))
            cancellable(
                pycolmap.extract_features,
                temporary,
                folder,
                image_names=names,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
        with pycolmap.Database.open(temporary) as opened:
            counts = {i.name: opened.num_keypoints_for_image(i.image_id) for i in opened.read_all_images()}
        missing = [p.name for p in listed if p.name not in counts]
        if missing:
            raise StageError(
                f"COLMAP could not read {len(missing)} photos, {missing[0]} for one; save them again as JPEG or PNG"
            )
    few = [name for name, count in counts.items() if count < FEW_FEATURES]
    if few:
        print(f"note: {len(few)} photos have fewer than {FEW_FEATURES} features, {few[0]} for one", flush=True)
    middle = int(np.median(list(counts.values())))
    print(f"{middle} features in the median photo, {len(groups)} cameras", flush=True)


def camera_groups(photos: list[Photo], mode: str) -> list[list[str]]:
    """Photo names grouped by the camera they share, in order of first appearance.

    Raises:
        StageError: mode "single" and photos of different sizes.
    """
    keys: dict[str, Callable[[Photo], Any]] = {
        "auto": lambda p: (p.width, p.height, p.camera, _zoom(p)),
        "single": lambda p: (p.width, p.height),
        "per_folder": lambda p: (str(Path(p.name).parent), p.width, p.height),
        "per_photo": lambda p: p.name,
    }
    groups: dict[Any, list[str]] = {}
    for photo in photos:
        groups.setdefault(keys[mode](photo), []).append(photo.name)
    if mode == "single" and len(groups) > 1:
        sizes = ", ".join(f"{w}x{h} ({names[0]})" for (w, h), names in groups.items())
        raise StageError(f"camera_mode is single but the photos differ in size: {sizes}; set it to auto")
    return list(groups.values())


def _zoom(photo: Photo) -> str:
    """The focal length that EXIF gives, in words that are the same for photos of one: the 35 mm equivalent to a pixel,
    or, where EXIF lacks it, millimetres, and tenths of them below ten."""
    if photo.focal_px:
        return f"{round(photo.focal_px)} px"
    return f"{photo.focal_mm:.{int(photo.focal_mm < 10)}f} mm" if photo.focal_mm else ""


def read_calibration(path: Path) -> pycolmap.Camera:
    """The camera of a file in the form of COLMAP's cameras.txt: one line `id MODEL width height parameters`.

    Raises:
        StageError: no camera, more than one, an unknown model, or a wrong number of parameters.
    """
    lines = [line.split() for _, line in read_lines(path)]
    form = "write one line like '1 OPENCV 4000 3000 fx fy cx cy k1 k2 p1 p2', as in COLMAP's cameras.txt"
    if len(lines) != 1:
        raise StageError(f"the calibration {path} holds {len(lines)} cameras; {form}")
    try:
        return camera_of(lines[0])
    except ValueError as error:
        raise StageError(f"the calibration {path} is no camera of COLMAP ({error}); {form}") from None


def _reader_options(
    settings: FeatureSettings, known: pycolmap.Camera | None, photo: Photo
) -> pycolmap.ImageReaderOptions:
    """The camera that photos like this one begin with: the known one at their size, or a guess by EXIF."""
    if known is None:
        return pycolmap.ImageReaderOptions(camera_model=settings.camera_model)
    camera = at_size(known, (photo.width, photo.height), f"{photo.name}, upright as it is used,")
    numbers = ",".join(repr(float(number)) for number in camera.params)
    return pycolmap.ImageReaderOptions(camera_model=camera.model_name, camera_params=numbers)
