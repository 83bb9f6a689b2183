"""Photos with cameras of another program as the workspace and the masks that training reads, without structure from
motion."""

import os
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.core.stage import StageError, atomic_directory, quantity, write_json
from scenefuse.core.transforms import Array
from scenefuse.mvs.undistort import UndistortSettings, undistort_picture
from scenefuse.photos.cameras.given import PosedPhoto, at_size
from scenefuse.photos.cameras.json_cameras import PERSPECTIVE
from scenefuse.photos.cameras.read_cameras import read_posed_photos
from scenefuse.photos.photo_files import JPEG, frame_name, masks_by_name, no_match, stored_size
from scenefuse.photos.photos import (
    bits_to_stretch,
    each_photo,
    has_16_bits,
    inspect_photo,
    stretch_notes,
)
from scenefuse.photos.pictures import (
    read_mask,
    read_raw,
    read_supplied_mask,
    require_white_object,
    stretched,
    write_picture,
)
from scenefuse.photos.workspace import View, write_model
from scenefuse.sfm.gravity import estimate_up

Picture = NDArray[np.uint8]
Lens = tuple[pycolmap.Camera, View]


def import_photos(
    *,
    data: Path,
    images: Path | None,
    masks: Path | None,
    workspace: Path,
    mattes: Path,
    report: Path,
    settings: UndistortSettings,
) -> None:
    """Write a COLMAP workspace of undistorted photos, and their masks, from cameras that another program found.

    Masks come from the folder `masks`, else from those that the JSON names, else from the photos' alpha channel; alpha
    is kept as it is (0 to 255), other masks become 0 or 255. Photos without a mask are left out.

    Args:
        data: folder or file with the cameras; see `read_posed_photos`.
        images: folder of the photos; None as for `read_posed_photos`.
        masks: folder of masks named like the photos; None to look elsewhere.
        workspace: output, with images/, sparse/ (PINHOLE, no points), and held_out.txt where the data say which photos
            are held out.
        mattes: output, folder of {photo}.png, 8-bit grey.
        report: output, JSON: the format, where masks come from, what was left out, `up_in_camera_frame`.
        settings: size of photos that have to be undistorted; the others are copied.

    Raises:
        StageError: what the readers say; photos without masks, unlike sizes, an unreadable file.
    """
    if masks is not None and not masks.is_dir():
        raise StageError(f"--masks {masks} is no folder; give the folder of the masks")
    photos, kind, notes = read_posed_photos(data, images)
    deep = [photo.file for photo in photos if has_16_bits(photo.file)]
    bits = bits_to_stretch(each_photo(lambda file: inspect_photo(file.parent, file.name), deep))
    notes += stretch_notes(bits)
    photos = _named(photos, Path(os.path.abspath(images or (data if data.is_dir() else data.parent) / "images")))
    files = {} if masks is None else masks_by_name([photo.name for photo in photos], masks)
    exact = masks is None and not any(photo.mask for photo in photos)
    lenses = _lenses(photos, settings)
    kept: list[View] = []
    held_out: list[str] = []
    with atomic_directory(workspace) as output, atomic_directory(mattes) as folder:
        (output / "images").mkdir()
        (output / "sparse").mkdir()
        for photo, lens in zip(photos, lenses):
            mask = photo.mask if masks is None else files.get(photo.name)
            view = _write_photo(photo, lens, mask, exact, bits, output / "images", folder)
            if view is not None:
                kept.append(view)
                held_out += [view.name] if photo.held_out else []
        if not kept:
            raise StageError(_no_masks(data, photos, masks))
        if not exact:  # what is cut out of a photo is the object, also an arch with its opening in the middle
            require_white_object(map(read_mask, sorted(folder.iterdir())), masks or data)
        write_model(output / "sparse", kept)
        if held_out:
            (output / "held_out.txt").write_text("".join(f"{name}\n" for name in held_out))
    source = "the photos' alpha channel" if exact else str(masks or "the masks that the data name")
    origin = {
        "format": quantity(kind, ""),
        "masks_exact": quantity(exact, ""),
        "held_out_by_the_data": quantity(held_out, ""),
        "notes": quantity(notes, ""),
    }
    for note in notes:
        print(f"note: {note}", flush=True)
    write_json(report, origin | _described(photos, lenses, kept))
    print(f"{len(kept)} of {len(photos)} photos ({kind}) have a mask, masks from {source}", flush=True)


def _named(photos: list[PosedPhoto], folder: Path) -> list[PosedPhoto]:
    """The photos by the names that they get: their paths below the folder, or below what holds them all, in one."""
    inside = all(photo.file.is_relative_to(folder) for photo in photos)
    root = folder if inside else os.path.commonpath([photo.file.parent for photo in photos])
    named = [replace(photo, name=frame_name(photo.file.relative_to(root).as_posix())) for photo in photos]
    stems = Counter(Path(photo.name).stem for photo in named)
    twice = next((stem for stem, count in stems.items() if count > 1), None)
    if twice is not None:
        raise StageError(f"two photos in {root} are both called {twice}; rename one")
    return named


def _write_photo(
    photo: PosedPhoto, lens: Lens, mask: Path | None, exact: bool, bits: int, images: Path, mattes: Path
) -> View | None:
    """Write one photo and its matte; returns its view by the name that it got, None without a mask, or for a black one.

    Args:
        photo, lens: what to write, and its cameras.
        mask: its file; None where there is none, or where the alpha channel is the mask.
        exact: whether it is.
        bits: that the photo's pixels are shifted by.
        images, mattes: folders.
    """
    camera, view = lens
    picture, alpha = _read(photo.file, bits)
    matte = alpha if exact else _mask(mask, picture)
    if matte is None or not (matte > 127).any():
        return None
    stem, straight = Path(photo.name).stem, _straight(camera)
    if straight and not exact and not bits:
        name = photo.name
        shutil.copyfile(photo.file, images / name)
    else:
        jpeg = Path(photo.name).suffix.lower() in JPEG
        name = photo.name if jpeg and not exact else f"{stem}.png"
        picture = _bled(picture, matte) if exact else picture
        write_picture(images / name, picture if straight else undistort_picture(picture, camera, view))
    write_picture(mattes / f"{stem}.png", matte if straight else undistort_picture(matte, camera, view))
    return replace(view, name=name)


def _described(photos: list[PosedPhoto], lenses: list[Lens], kept: list[View]) -> dict[str, Any]:
    """What was read, as quantities: counts, sizes, photos left out, which way is up."""
    poses = np.stack([view.world_from_cam for view in kept])
    up, cue = estimate_up(poses[:, :3, :3], poses[:, :3, 3])
    written = {Path(view.name).stem for view in kept}
    left_out = sorted(photo.name for photo in photos if Path(photo.name).stem not in written)
    if left_out:
        print(f"note: {len(left_out)} photos are left out without a mask, {left_out[0]} for one", flush=True)
    return {
        "photos": quantity(len(kept), "1"),
        "left_out_without_mask": quantity(left_out, ""),
        "undistorted": quantity(sum(not _straight(camera) for camera, _ in lenses), "1"),
        "sizes_px": quantity(sorted({(view.width, view.height) for view in kept}), "px"),
        "up_in_camera_frame": quantity(up, "1"),
        "up_cue": quantity(cue, ""),
    }


def _no_masks(data: Path, photos: list[PosedPhoto], masks: Path | None) -> str:
    """Why no photo has a mask, and what to do."""
    if masks is not None:
        return no_match(masks, photos[0].name)
    return (
        f"the photos of {data} have no masks; give a folder of masks with --masks (white on the object, named like the "
        "photos), mask_path in the JSON, or photos with an alpha channel"
    )


def _straight(camera: pycolmap.Camera) -> bool:
    """Whether a camera has no distortion; fisheye models with coefficients of zero have one all the same."""
    return camera.model_name in (*PERSPECTIVE, "FULL_OPENCV") and camera.is_undistorted()


def _lenses(photos: list[PosedPhoto], settings: UndistortSettings) -> list[Lens]:
    """Of every photo, its camera at its own size, and the view without distortion that it becomes."""
    options = pycolmap.UndistortCameraOptions(max_image_size=settings.max_size_px)
    pairs = []
    for photo in photos:
        camera = at_size(photo.camera, stored_size(photo.file), str(photo.file))
        target = camera if _straight(camera) else pycolmap.undistort_camera(options, camera)
        cam_from_object: Array = np.array(np.linalg.inv(photo.object_from_cam), dtype=np.float64)
        intrinsics: Array = np.array(target.calibration_matrix(), dtype=np.float64)
        view = View(photo.name, intrinsics, cam_from_object, target.width, target.height)
        pairs.append((camera, view))
    return pairs


def _read(file: Path, bits: int) -> tuple[Picture, Picture | None]:
    """A photo as stored, whatever its EXIF orientation, its pixels shifted by some bits: (H, W, 3) RGB, and (H, W)
    alpha where it varies."""
    stored = read_raw(file)
    if stored.dtype not in (np.uint8, np.uint16):
        raise StageError(f"{file} is no picture of 8 or 16 bits; export it again")
    picture = stretched(stored[..., :3], bits) if stored.ndim == 3 else stretched(stored, bits)[..., None]
    alpha = stretched(stored[..., 3], 0) if stored.ndim == 3 and stored.shape[2] == 4 else None
    return np.ascontiguousarray(np.broadcast_to(picture, (*picture.shape[:2], 3))[..., ::-1]), (
        alpha if alpha is not None and alpha.min() < 255 else None
    )


def _mask(file: Path | None, picture: Picture) -> Picture | None:
    """A mask file at the photo's size, 0 or 255 but where it was resampled; None without a file."""
    if file is None:
        return None
    size = picture.shape[1], picture.shape[0]
    return np.asarray(
        cv2.resize(255 * read_supplied_mask(file, size).astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    )


def _bled(picture: Picture, alpha: Picture) -> Picture:
    """Transparent pixels take the colour of the nearest other one, so that resampling mixes no background in."""
    if not alpha.any():
        return picture
    rows, columns = ndimage.distance_transform_edt(alpha == 0, return_distances=False, return_indices=True)
    return np.asarray(picture[rows, columns])
