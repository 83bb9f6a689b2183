"""Cameras that another program found: a sparse model of their poses, lenses, and points from the photos' matches."""

import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from scenefuse.core.stage import StageError, scratch_directory
from scenefuse.photos.cameras.given import PosedPhoto, at_size, possible_turns
from scenefuse.photos.cameras.read_cameras import read_posed_photos
from scenefuse.photos.frames import original_sizes
from scenefuse.photos.photos import orientations_in
from scenefuse.sfm.colmap import STRONG_PAIR, cancellable


def triangulated(
    cameras: Path,
    folder: Path,
    content: dict[str, Any],
    database: Path,
    work: Path,
    options: pycolmap.IncrementalPipelineOptions,
) -> tuple[pycolmap.Reconstruction, list[str]]:
    """The model of given cameras: poses and lenses as they are, points from the photos' own matches; and notes, on
    cameras without a photo and photos that EXIF rotates for instance.

    Args:
        cameras: a COLMAP model, nerfstudio's transforms.json, or OpenSfM's reconstruction.json, or a folder with one;
            Metashape's XML; Bundler's .out with its list.
        folder: of the photos, upright.
        content: of photos.json: how EXIF turned these photos for that, and how large they were.
        database: COLMAP database with verified matches.
        work: folder for files in between; it is removed again.
        options: COLMAP's, of triangulation.

    Raises:
        StageError: what the readers say; cameras of no photo, or of other shape than their photos; cameras that do not
            fit the photos.
    """
    root, originals, orientations = Path(os.path.abspath(folder)), original_sizes(content), orientations_in(content)
    given, _, notes = read_posed_photos(cameras, folder, lambda file: originals[file.relative_to(root).as_posix()])
    with pycolmap.Database.open(database) as opened:
        own = {camera.camera_id: (camera.width, camera.height) for camera in opened.read_all_cameras()}
        sizes = {image.name: own[image.camera_id] for image in opened.read_all_images()}
    paths = {photo.file.relative_to(root).as_posix(): photo for photo in given}
    posed = {name: photo for name, photo in paths.items() if name in sizes}
    ways = possible_turns(posed, orientations, sizes)
    models = [_model(way, cameras, folder, database, work, options) for way in ways]
    met = [model.num_points3D() for model in models]
    best = int(np.argmax(met))
    found, turned = models[best], sum(ways[best][name] is not posed[name] for name in posed)
    points = [found.images[i].num_points3D for i in found.reg_image_ids()]
    if not points or np.median(points) < STRONG_PAIR:
        raise StageError(
            f"{cameras}: its cameras do not fit the photos: half of them see fewer than {STRONG_PAIR} points where"
            " their matches meet; give cameras of these photos, as large as they were computed for or scaled down alike"
        )
    if len(ways) > 1:
        notes.append(
            f"EXIF rotates photos, and {cameras.name} does not say whether its cameras are for them as they are stored:"
            f" they are taken as {('upright', 'stored')[best]}, whose matches meet in {met[best]} points, and not as"
            f" {('stored', 'upright')[best]}, with {met[1 - best]}"
        )
    elif turned:
        notes.append(f"the cameras of {turned} photos were turned, as EXIF rotates these photos")
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
            _give_lenses(opened, posed, str(cameras))
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


def _give_lenses(database: pycolmap.Database, posed: Mapping[str, PosedPhoto], where: str) -> None:
    """Put the lenses of photos, by name, into a database; photos that share a camera there and not here part."""
    frame_of = {data.id: frame for frame in database.read_all_frames() for data in frame.image_ids}
    given: dict[int, dict[tuple[Any, ...], tuple[int, int]]] = {}
    for image in (image for image in database.read_all_images() if image.name in posed):
        own = database.read_camera(image.camera_id)
        camera = at_size(posed[image.name].camera, (own.width, own.height), f"{where}: the photo {image.name}")
        camera.has_prior_focal_length = True
        lens, known = (camera.model_name, *camera.params), given.setdefault(own.camera_id, {})
        if not known:
            camera.camera_id, known[lens] = own.camera_id, (own.camera_id, 0)
            database.update_camera(camera)
        elif lens not in known:
            number, rig = database.write_camera(camera), pycolmap.Rig()
            rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
            known[lens] = number, database.write_rig(rig)
        number, rig_id = known[lens]
        if number != image.camera_id:
            image.camera_id, frame = number, frame_of[image.image_id]
            frame.rig_id = rig_id
            frame.clear_data_ids()
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
            frame.add_data_id(pycolmap.data_t(sensor, image.image_id))
            database.update_frame(frame)
            database.update_image(image)
