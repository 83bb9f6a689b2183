"""A sparse model from cameras that another program found: its poses and lenses, and points from the photos' matches."""

import shutil
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pycolmap

from scenefuse.core.stage import StageError, scratch_directory
from scenefuse.photos.cameras.posed_photo import PosedPhoto, at_size, possible_turns
from scenefuse.photos.cameras.read_cameras import read_posed_photos
from scenefuse.photos.photo_files import frame_name
from scenefuse.sfm.colmap import cancellable

# Cameras that fit their photos give each photo so many points at least, in the median.
MIN_POINTS = 20


def triangulated(
    cameras: Path,
    folder: Path,
    orientations: Mapping[str, int],
    database: Path,
    work: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> tuple[pycolmap.Reconstruction, list[str]]:
    """The model of given cameras: poses and lenses as they are, points from the photos' own matches; and what was
    decided about photos that EXIF rotates, a sentence each.

    Args:
        cameras: a COLMAP model, nerfstudio's transforms.json, or OpenSfM's reconstruction.json, or a folder with one;
            Metashape's XML; Bundler's .out with its list.
        folder: of the photos, upright.
        orientations: EXIF orientation of the photos that were turned for that, by name.
        database: COLMAP database with verified matches.
        work: folder for files in between; it is removed again.
        options: COLMAP's, of triangulation.

    Raises:
        StageError: what the readers say; cameras of no photo, or of other shape than their photos; photos that share a
            camera in the database but not here; cameras that do not fit the photos.
    """
    given, _ = read_posed_photos(cameras, folder)
    with pycolmap.Database.open(database) as opened:
        own = {camera.camera_id: (camera.width, camera.height) for camera in opened.read_all_cameras()}
        sizes = {image.name: own[image.camera_id] for image in opened.read_all_images()}
    posed = _by_name(given, sizes, cameras)
    if not posed:
        some = ", ".join(sorted(photo.file.name for photo in given)[:3])
        raise StageError(f"{cameras} holds cameras of none of the photos in {folder}; it names {some}, ...")
    ways = possible_turns(posed, orientations, sizes)
    models = [_model(way, cameras, folder, database, work, options) for way in ways]
    met = [model.num_points3D() for model in models]
    best = int(np.argmax(met))
    found, turned = models[best], sum(ways[best][name] is not posed[name] for name in posed)
    points = [found.images[i].num_points3D for i in found.reg_image_ids()]
    if not points or np.median(points) < MIN_POINTS:
        raise StageError(
            f"{cameras}: its cameras do not fit the photos: half of them see fewer than {MIN_POINTS} points where their"
            " matches meet; give cameras of these photos, as large as they were computed for or scaled down alike"
        )
    notes = [f"the cameras of {turned} photos were turned, as EXIF rotates these photos"] if turned else []
    if len(ways) > 1:
        notes = [
            f"EXIF rotates photos, and {cameras.name} does not say whether its cameras are for them as they are stored:"
            f" they are taken as {('upright', 'stored')[best]}, whose matches meet in {met[best]} points, and not as"
            f" {('stored', 'upright')[best]}, with {met[1 - best]}"
        ]
    return found, notes


def _model(
    posed: Mapping[str, PosedPhoto],
    cameras: Path,
    folder: Path,
    database: Path,
    work: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> pycolmap.Reconstruction:
    """`triangulated` for cameras by the names of their photos; it may have no points."""
    with scratch_directory(work) as scratch:
        calibrated = scratch / "database.db"
        shutil.copyfile(database, calibrated)
        with pycolmap.Database.open(calibrated) as opened:
            images = {image.image_id: posed.get(image.name) for image in opened.read_all_images()}
            shared: dict[int, PosedPhoto] = {}
            for image in opened.read_all_images():
                photo = images[image.image_id]
                if photo is not None:
                    own = opened.read_camera(image.camera_id)
                    _check_same(shared.setdefault(image.camera_id, photo), photo, cameras)
                    camera = at_size(photo.camera, (own.width, own.height), f"{cameras}: the photo {image.name}")
                    camera.camera_id, camera.has_prior_focal_length = own.camera_id, True
                    opened.update_camera(camera)
            cache = pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions())
        model = pycolmap.Reconstruction()
        model.load(cache)
        for number, photo in images.items():
            if photo is not None and number in model.images:
                pose = pycolmap.Rigid3d(np.linalg.inv(photo.object_from_cam)[:3])
                frame = model.images[number].frame
                assert frame is not None
                frame.set_cam_from_world(model.images[number].camera_id, pose)
                model.register_frame(frame.frame_id)
        (scratch / "points").mkdir()
        return cancellable(pycolmap.triangulate_points, model, calibrated, folder, scratch / "points", options=options)


def _by_name(given: list[PosedPhoto], names: Iterable[str], cameras: Path) -> dict[str, PosedPhoto]:
    """The cameras of photos (paths below their folder): by the whole path, or by the file's name where camera and photo
    are the only ones that are called so.

    Raises:
        StageError: several cameras may be a photo's.
    """
    whole, alike = {photo.name: photo for photo in given}, dict[str, list[PosedPhoto]]()
    for photo in given:
        alike.setdefault(photo.file.name, []).append(photo)
    found = dict[str, PosedPhoto]()
    names = list(names)
    called = Counter(Path(name).name for name in names)
    for name in names:
        end = Path(name).name
        same = [whole[frame_name(name)]] if frame_name(name) in whole else alike.get(end, [])
        if len(same) > 1 or (same and called[end] > 1 and frame_name(name) not in whole):
            raise StageError(
                f"{cameras}: {max(len(same), called[end])} photos are called {end}, and it does not say which of them"
                " its camera is of; give every photo a name of its own"
            )
        if same:
            found[name] = same[0]
    return found


def _check_same(first: PosedPhoto, photo: PosedPhoto, cameras: Path) -> None:
    """StageError where photos of one camera in the database have two lenses here."""
    a, b = first.camera, photo.camera
    if a.model != b.model or not np.allclose(a.params, b.params):
        raise StageError(
            f"{cameras}: {first.file.name} and {photo.file.name} have different lenses, but count as photos of one"
            " camera; set features.camera_mode to per_photo"
        )
