"""Posed photos of any format as the workspace and the masks that the training stages read."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.io.mask_files import mask_files, matte_of
from scenefuse.sfm.gravity import estimate_up
from scenefuse.sfm.posed_photos import PERSPECTIVE, PosedPhoto, find_posed_photos, photo_size
from scenefuse.sfm.undistort import UndistortSettings
from scenefuse.stage import StageError, atomic_directory, quantity, value, write_json

Picture = NDArray[np.uint8]

# Photos and cameras differ in shape by no more than what rounding to whole pixels does.
SHAPE_TOLERANCE = 0.01
BLEED_PX = 16


def import_photos(
    *,
    data: Path,
    images: Path | None,
    masks: Path | None,
    cameras: Path,
    mattes: Path,
    report: Path,
    settings: UndistortSettings,
) -> None:
    """Write a COLMAP workspace of undistorted photos, and their masks, from cameras that another program found.

    Masks come from the folder `masks`, else from those that the JSON names, else from the photos' alpha channel; alpha
    is kept as it is (0 to 255), other masks become 0 or 255. Photos without a mask are left out.

    Args:
        data: folder or file with the cameras; see `find_posed_photos`.
        images: folder of a COLMAP model's photos; None for `data`/images.
        masks: folder of masks named like the photos; None to look elsewhere.
        cameras: output, workspace with images/, sparse/ (PINHOLE, no points), and held_out.txt where the data say which
            photos are held out.
        mattes: output, folder of {photo}.png, 8-bit grey.
        report: output, JSON: the format, where masks come from, what was left out, `up_in_camera_frame`.
        settings: size and quality of photos that have to be undistorted; the others are copied.

    Raises:
        StageError: what the readers say; photos without masks, unlike sizes, an unreadable file.
    """
    if masks is not None and not masks.is_dir():
        raise StageError(f"--masks {masks} is no folder; give the folder of the masks")
    photos, kind = find_posed_photos(data, images)
    files = {} if masks is None else mask_files(masks)
    exact = masks is None and not any(photo.mask for photo in photos)
    lenses = _lenses(photos, settings)
    kept: list[tuple[PosedPhoto, str, pycolmap.Camera]] = []
    with atomic_directory(cameras) as workspace, atomic_directory(mattes) as folder:
        (workspace / "images").mkdir()
        (workspace / "sparse").mkdir()
        for photo, (lens, target) in zip(photos, lenses):
            picture, alpha = _read(photo.file)
            file = photo.mask if masks is None else files.get(Path(photo.name).stem)
            matte = alpha if exact else _mask(file, picture)
            if matte is None:
                continue
            stem, jpeg = Path(photo.name).stem, Path(photo.name).suffix.lower() in (".jpg", ".jpeg")
            if exact:
                picture = _bled(picture, matte)
            if _straight(lens) and not exact:
                name = photo.name
                shutil.copyfile(photo.file, workspace / "images" / name)
            else:
                name = photo.name if jpeg and not exact else f"{stem}.png"
                _write(workspace / "images" / name, _straightened(picture, lens, target, settings), settings)
            _write(folder / f"{stem}.png", _straightened(matte, lens, target, settings), settings)
            kept.append((photo, name, target))
        if not kept:
            raise StageError(_no_masks(data, photos, masks, files))
        _write_model(workspace / "sparse", kept)
        held_out = [name for photo, name, _ in kept if photo.held_out]
        if held_out:
            (workspace / "held_out.txt").write_text("".join(f"{name}\n" for name in held_out))
    source = "the photos' alpha channel" if exact else str(masks or "the masks that the data name")
    content = {
        "format": quantity(kind, ""),
        "masks_from": quantity(source, ""),
        "masks_exact": quantity(exact, ""),
        "held_out_by_the_data": quantity(held_out, ""),
        **_described(photos, lenses, kept),
    }
    write_json(report, content)
    left_out = value(content, "left_out_without_mask")
    print(
        f"{len(kept)} photos ({kind}), {value(content, 'undistorted')} undistorted, masks from {source}"
        + (f"; {len(left_out)} left out without a mask, {left_out[0]} for one" if left_out else ""),
        flush=True,
    )


def _described(photos, lenses, kept):  # type: ignore[no-untyped-def]
    """What was read, as quantities: counts, sizes, photos left out, which way is up."""
    poses = np.stack([photo.object_from_cam for photo, _, _ in kept])
    up, cue = estimate_up(poses[:, :3, :3], poses[:, :3, 3])
    return {
        "photos": quantity(len(kept), "1"),
        "left_out_without_mask": quantity(sorted({p.name for p in photos} - {p.name for p, _, _ in kept}), ""),
        "undistorted": quantity(sum(not _straight(lens) for lens, _ in lenses), "1"),
        "sizes_px": quantity(sorted({(target.width, target.height) for _, _, target in kept}), "px"),
        "up_in_camera_frame": quantity(up, "1"),
        "up_cue": quantity(cue, ""),
    }


def _no_masks(data: Path, photos: list[PosedPhoto], masks: Path | None, files: dict[str, Path]) -> str:
    """Why no photo has a mask, and what to do."""
    if masks is not None:
        example = next(iter(files.values())).name if files else "none"
        return (
            f"masks that match no photo: {len(files)} masks in {masks} (first: {example}), photos are named like "
            f"{photos[0].name}; name a mask like its photo, with or without _mask"
        )
    return (
        f"the photos of {data} have no masks; give a folder of masks with --masks (white on the object, named like the "
        "photos), mask_path in the JSON, or photos with an alpha channel"
    )


def _straight(camera: pycolmap.Camera) -> bool:
    """Whether a camera has no distortion; fisheye models with coefficients of zero have one all the same."""
    return camera.model_name in (*PERSPECTIVE, "FULL_OPENCV") and camera.is_undistorted()


def _lenses(photos: list[PosedPhoto], settings: UndistortSettings) -> list[tuple[pycolmap.Camera, pycolmap.Camera]]:
    """Of every photo, its camera at its own size, and the PINHOLE camera it gets.

    Undistorted photos that had one size get one size: cameras calibrated photo by photo lose a few columns and rows at
    the right and the bottom.
    """
    options = pycolmap.UndistortCameraOptions(max_image_size=settings.max_size_px)
    pairs = []
    for photo in photos:
        width, height = photo_size(photo.file)
        lens = pycolmap.Camera(photo.camera.todict())
        if abs(lens.width / lens.height * height / width - 1) > SHAPE_TOLERANCE:
            raise StageError(
                f"{photo.file} has {width} x {height} pixels, but its camera {lens.width} x {lens.height}; give the "
                "photos that the cameras were computed for, or smaller copies"
            )
        lens.rescale(width, height)
        if _straight(lens):
            params = [lens.focal_length_x, lens.focal_length_y, lens.principal_point_x, lens.principal_point_y]
            target = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params)
        else:
            target = pycolmap.undistort_camera(options, lens)
        pairs.append((lens, target))
    for lens, target in pairs:
        alike = [t for other, t in pairs if (other.width, other.height) == (lens.width, lens.height)]
        target.width, target.height = min(t.width for t in alike), min(t.height for t in alike)
    return pairs


def _read(file: Path) -> tuple[Picture, Picture | None]:
    """A photo as stored, whatever its EXIF orientation: (H, W, 3) BGR, and (H, W) alpha where it varies."""
    stored = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if stored is None or stored.dtype not in (np.uint8, np.uint16):
        raise StageError(f"{file} is not a readable picture of 8 or 16 bits; export it again")
    picture = np.asarray(stored // 257 if stored.dtype == np.uint16 else stored, dtype=np.uint8)
    if picture.ndim == 2:
        picture = np.repeat(picture[..., None], 3, axis=2)
    alpha = picture[..., 3] if picture.shape[2] == 4 and picture[..., 3].min() < 255 else None
    return np.ascontiguousarray(picture[..., :3]), alpha


def _mask(file: Path | None, picture: Picture) -> Picture | None:
    """A mask file at the photo's size, 0 or 255 but where it was resampled; None without a file."""
    if file is None:
        return None
    matte = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if matte is None:
        raise StageError(f"the mask {file} is not a readable picture; export it again as PNG")
    height, width = picture.shape[:2]
    if abs(matte.shape[1] / matte.shape[0] * height / width - 1) > SHAPE_TOLERANCE:
        raise StageError(
            f"the mask {file} has {matte.shape[1]} x {matte.shape[0]} pixels, but its photo {width} x {height}; "
            "make masks of the photos as they are"
        )
    whole = matte_of(matte).astype(np.uint8) * 255
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _bled(picture: Picture, alpha: Picture) -> Picture:
    """Transparent pixels near others take the nearest one's colour, so that resampling mixes no background in."""
    if not alpha.any():
        return picture
    far, (rows, columns) = ndimage.distance_transform_edt(alpha == 0, return_indices=True)
    return np.where(far[..., None] <= BLEED_PX, picture[rows, columns], 0).astype(np.uint8)


def _straightened(
    picture: Picture, lens: pycolmap.Camera, target: pycolmap.Camera, settings: UndistortSettings
) -> Picture:
    """A photo or mask (H, W) or (H, W, 3) in the pixels of the PINHOLE camera, black where the photo shows nothing."""
    if _straight(lens):
        return picture
    options = pycolmap.UndistortCameraOptions(max_image_size=settings.max_size_px)
    bitmap, _ = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(picture), lens)
    return np.ascontiguousarray(bitmap.to_array()[: target.height, : target.width])


def _write(file: Path, picture: Picture, settings: UndistortSettings) -> None:
    quality = [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality] if file.suffix.lower() in (".jpg", ".jpeg") else []
    if not cv2.imwrite(str(file), picture, quality):
        raise StageError(f"{file} cannot be written; check the space on the disk")


def _write_model(folder: Path, kept: list[tuple[PosedPhoto, str, pycolmap.Camera]]) -> None:
    """A COLMAP model of cameras and poses alone; photos with the same lens share a camera."""
    model = pycolmap.Reconstruction()
    known: dict[tuple[float, ...], int] = {}
    for number, (photo, name, target) in enumerate(kept, start=1):
        lens = target.width, target.height, *target.params
        if lens not in known:
            known[lens] = target.camera_id = len(known) + 1
            model.add_camera_with_trivial_rig(target)
        cam_from_object = np.linalg.inv(photo.object_from_cam)[:3]
        image = pycolmap.Image(name=name, camera_id=known[lens], image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_from_object))
    model.write(folder)
