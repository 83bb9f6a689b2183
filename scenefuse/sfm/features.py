"""SIFT features with COLMAP, the first step of structure from motion, the same for scenes and objects; and guided
matching: features of a verified pair are matched again where its geometry lets them lie.

As COLMAP's (Schoenberger, Frahm 2016), with the same tests; descriptors are compared only where the geometry allows, in
place of all with all, which takes a tenth of the time.
"""

import contextlib
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pycolmap
from numba import njit
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, read_json, resumed_file, setting, threads
from scenefuse.core.tables import read_lines
from scenefuse.photos.cameras.given import QUARTERS, at_size, turned
from scenefuse.photos.cameras.read_cameras import camera_of
from scenefuse.photos.photos import Photo, check_unchanged, orientations_in, read_photos
from scenefuse.photos.pictures import same_shape
from scenefuse.sfm.colmap import MIN_PHOTOS, cancellable

# Fewer features in a photo than this deserve a note: blur, fog, or a wall without texture.
FEW_FEATURES = 100
# Descriptors are unit vectors times this, in bytes.
LENGTH = 512
# Photos whose features are kept while their pairs are matched: 0.5 MB each.
KEPT_PHOTOS = 200
Configuration = pycolmap.TwoViewGeometryConfiguration
BY_HOMOGRAPHY = (Configuration.PLANAR, Configuration.PANORAMIC, Configuration.PLANAR_OR_PANORAMIC)
BY_LINES = (Configuration.CALIBRATED, Configuration.UNCALIBRATED)


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
    """Which photos share one camera; auto: uncropped ones of one size, EXIF camera, focal length, rotation."""


def extract_features(
    *, folder: Path, photos: Path, features: Path, calibration: Path | None = None, settings: FeatureSettings
) -> None:
    """Find SIFT features in every photo and write them, with cameras and GPS priors, to a COLMAP database.

    Args:
        folder: folder of photos.
        photos: JSON list of them.
        features: output, COLMAP database.
        calibration: a known camera, in the form of COLMAP's cameras.txt, for all photos; it is held from here on, and
            turned along with photos that EXIF rotates.
        settings: SIFT and camera settings.

    Raises:
        StageError: `camera_mode` is single and the photos differ in size, or a photo is missing, has changed
            since it was listed, or cannot be read.
    """
    listed = read_photos(photos)
    check_unchanged(folder, listed)
    known = None if calibration is None else read_calibration(calibration)
    quarters = quarter_turns(known, listed, orientations_in(read_json(photos)))
    least = 1 if known else MIN_PHOTOS
    groups = [own for names in camera_groups(listed, settings.camera_mode) for own in by_turn(names, quarters, least)]
    sift = pycolmap.SiftExtractionOptions(max_num_features=settings.max_features, first_octave=settings.first_octave)
    options = pycolmap.FeatureExtractionOptions(num_threads=threads(), use_gpu=False, sift=sift)
    options.max_image_size = settings.max_image_size_px
    recipe = settings, photos.read_text(), calibration and calibration.read_text()
    with resumed_file(features, *recipe) as temporary:
        # Photos that do not get all the features they may have are searched again, for ones of less contrast.
        for peak in (options.sift.peak_threshold, options.sift.peak_threshold / 3):
            options.sift.peak_threshold = peak
            with pycolmap.Database.open(temporary) as opened:
                camera_of_done = {image.name: image.camera_id for image in opened.read_all_images()}
            full = _keep_full(temporary, settings.max_features)
            for names in groups:
                left = [name for name in names if name not in full]
                if not left:
                    continue
                first = next(p for p in listed if p.name == names[0])
                lens = None if known is None else turned(known, quarters[first.name], first.name)
                reader = _reader_options(settings, lens, first)
                reader.existing_camera_id = next((camera_of_done[n] for n in names if n in camera_of_done), -1)
                cancellable(
                    pycolmap.extract_features,
                    temporary,
                    folder,
                    image_names=left,
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
    print(f"{np.median(list(counts.values())):.0f} features in the median photo, {len(groups)} cameras", flush=True)


def _keep_full(database: Path, count: int) -> set[str]:
    """Names of the photos that have `count` features or more; those of the others are taken out of the database, which
    pycolmap does for all photos only."""
    poor = "WHERE image_id IN (SELECT image_id FROM keypoints WHERE rows < ?)"
    with contextlib.closing(sqlite3.connect(database)) as opened, opened:
        for table in ("descriptors", "keypoints"):
            opened.execute(f"DELETE FROM {table} {poor}", (count,))
        return {name for (name,) in opened.execute("SELECT name FROM images JOIN keypoints USING (image_id)")}


def camera_groups(photos: list[Photo], mode: str) -> list[list[str]]:
    """Photo names grouped by the camera they share, in order of first appearance.

    Raises:
        StageError: mode "single" and photos of different sizes.
    """
    keys: dict[str, Callable[[Photo], Any]] = {
        "auto": lambda p: p.name if p.cropped else (p.width, p.height, p.camera, _zoom(p)),
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


def quarter_turns(
    known: pycolmap.Camera | None, photos: list[Photo], orientations: Mapping[str, int]
) -> dict[str, int]:
    """How many clockwise quarters each photo was turned by, by name, since its camera took it; none where the shape of
    one on its side shows that the known camera is of upright photos."""
    turns = {photo.name: QUARTERS.get(orientations.get(photo.name, 1), 0) for photo in photos}
    own = known and (known.width, known.height)
    upright = own and any(turns[p.name] % 2 and same_shape(own, (p.width, p.height)) for p in photos)
    return dict.fromkeys(turns, 0) if upright else turns


def by_turn(names: list[str], quarters: Mapping[str, int], least: int) -> list[list[str]]:
    """Photos of one camera parted by their quarters, for its principal point turns along. Fewer than `least`, which do
    not determine a lens of their own, stay with the most."""
    parts = sorted(([n for n in names if quarters[n] == k] for k in range(4)), key=len, reverse=True)
    few = [name for part in parts[1:] if len(part) < least for name in part]
    return [parts[0] + few, *(part for part in parts[1:] if len(part) >= least)]


def _reader_options(
    settings: FeatureSettings, known: pycolmap.Camera | None, photo: Photo
) -> pycolmap.ImageReaderOptions:
    """The camera that photos like this one begin with: the known one at their size, or a guess by EXIF."""
    if known is None:
        return pycolmap.ImageReaderOptions(camera_model=settings.camera_model)
    camera = at_size(known, (photo.width, photo.height), f"{photo.name}, upright as it is used,")
    numbers = ",".join(repr(float(number)) for number in camera.params)
    return pycolmap.ImageReaderOptions(camera_model=camera.model_name, camera_params=numbers)


def match_guided(database: pycolmap.Database, max_error_px: float, max_ratio: float, max_distance: float) -> None:
    """Replace the inliers of every verified pair of a database by its guided matches, where these are more.

    Args:
        database: open, with features, and pairs that COLMAP has verified.
        max_error_px: largest Sampson error, or distance from where a homography puts a feature.
        max_ratio: best over second-best descriptor distance, in either direction.
        max_distance: largest descriptor distance, as an angle in radians.
    """

    @lru_cache(KEPT_PHOTOS)
    def features(image: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        places = np.ascontiguousarray(database.read_keypoints(image)[:, :2], np.float32)
        return places, np.ascontiguousarray(database.read_descriptors(image).data)

    def jobs() -> Iterator[tuple[Any, ...]]:
        for number, count in zip(*database.read_two_view_geometry_num_inliers()):
            a, b = pycolmap.pair_id_to_image_pair(number)
            found = database.read_two_view_geometry(a, b) if count else None
            if found is None or found.config not in (*BY_HOMOGRAPHY, *BY_LINES):
                continue
            planar = found.config in BY_HOMOGRAPHY
            matrix = np.ascontiguousarray(found.H if planar else found.F)
            yield a, b, found, (matrix, planar, *features(a), *features(b), max_error_px**2, max_ratio, max_distance)

    with ThreadPoolExecutor(threads()) as pool:
        # Windows of jobs, so that features of few photos are in memory.
        waiting = list[tuple[Any, ...]]()
        for a, b, found, arguments in jobs():
            waiting.append((a, b, found, pool.submit(_matches, *arguments)))
            if len(waiting) == KEPT_PHOTOS:
                _write(database, waiting)
                waiting.clear()
        _write(database, waiting)


def _write(database: pycolmap.Database, waiting: list[tuple[Any, ...]]) -> None:
    for a, b, found, job in waiting:
        matches = job.result()
        if len(matches) > len(found.inlier_matches):
            found.inlier_matches = matches
            database.update_two_view_geometry(a, b, found)


@njit(nogil=True, cache=True, fastmath=True)
def _matches(matrix, planar, here, words_here, there, words_there, max_square, max_ratio, max_distance):  # type: ignore[no-untyped-def]
    """Mutual best matches (M, 2) of features at here (N, 2) and there (K, 2), descriptors (N, 128) and (K, 128)."""
    count = len(there)
    best, first, second = _nothing(len(here))
    best_there, first_there, second_there = _nothing(count)
    u, v = there[:, 0].copy(), there[:, 1].copy()
    square = np.zeros(count, np.float32)
    if not planar:
        for j in range(count):
            a = matrix[0, 0] * u[j] + matrix[1, 0] * v[j] + matrix[2, 0]
            b = matrix[0, 1] * u[j] + matrix[1, 1] * v[j] + matrix[2, 1]
            square[j] = a * a + b * b
    near = np.empty(count, np.bool_)
    for i in range(len(here)):
        x, y = here[i, 0], here[i, 1]
        a = np.float32(matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2])
        b = np.float32(matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2])
        c = np.float32(matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2])
        if planar:
            a, b = a / c, b / c
            for j in range(count):
                near[j] = (u[j] - a) ** 2 + (v[j] - b) ** 2 <= max_square
        else:
            length = a * a + b * b
            for j in range(count):
                off = a * u[j] + b * v[j] + c
                near[j] = off * off <= max_square * (length + square[j])
        for j in range(count):
            if near[j]:
                dot = np.int32(0)
                for k in range(words_here.shape[1]):
                    dot += np.int32(words_here[i, k]) * np.int32(words_there[j, k])
                if dot > first[i]:
                    best[i], first[i], second[i] = j, dot, first[i]
                else:
                    second[i] = max(second[i], dot)
                if dot > first_there[j]:
                    best_there[j], first_there[j], second_there[j] = i, dot, first_there[j]
                else:
                    second_there[j] = max(second_there[j], dot)
    found = np.empty((len(here), 2), np.uint32)
    size = 0
    for i in range(len(here)):
        j = best[i]
        if j >= 0 and best_there[j] == i:
            angle = _angle(first[i])
            if angle <= max_distance and angle < max_ratio * _angle(max(second[i], second_there[j])):
                found[size, 0], found[size, 1] = i, j
                size += 1
    return found[:size]


@njit(nogil=True)
def _nothing(count):  # type: ignore[no-untyped-def]
    """No best match, and the two largest products of descriptors, of each feature."""
    return np.full(count, -1, np.int64), np.zeros(count, np.int32), np.zeros(count, np.int32)


@njit(nogil=True)
def _angle(dot):  # type: ignore[no-untyped-def]
    """Angle between two descriptors."""
    return np.arccos(min(dot / np.float64(LENGTH * LENGTH), 1.0))
