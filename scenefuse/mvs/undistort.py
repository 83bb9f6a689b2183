"""Photos without lens distortion, as dense reconstruction, masks and training want them."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.core.stage import atomic_directory, quantity, read_json, setting, threads, value, write_json
from scenefuse.core.transforms import Array
from scenefuse.photos.photos import check_unchanged, read_photos
from scenefuse.photos.pictures import JPEG_QUALITY
from scenefuse.photos.workspace import View, read_model, read_workspace
from scenefuse.sfm.colmap import cancellable
from scenefuse.sfm.gravity import estimate_up

# A picture with more than this many times the pixels (along one side) is averaged before it is sampled. Undistorting
# alone scales by a few percent, which bilinear sampling does better without.
MIN_SHRINK = 1 / 0.9


@dataclass(frozen=True)
class UndistortSettings:
    """Size of undistorted photos."""

    max_size_px: int = setting(2000, unit="px", least=1)
    """Longest side of an undistorted photo; larger ones are scaled down (method M4)."""


def undistort_photos(
    *,
    folder: Path,
    photos: Path,
    sparse: Path,
    georeference: Path | None = None,
    workspace: Path,
    report: Path,
    settings: UndistortSettings,
) -> None:
    """Write a COLMAP workspace of undistorted photos with PINHOLE cameras, and find which way is up in its frame.

    Args:
        folder: folder of the original photos.
        photos: JSON list of them.
        sparse: COLMAP model of them; its world is the workspace's.
        georeference: JSON of a model that has been turned upright, whose z is up; without it the cameras say.
        workspace: output, COLMAP workspace with images/ and sparse/.
        report: output, JSON: up direction, sizes, hashes of all files.
        settings: size.

    Raises:
        StageError: a photo is missing in the folder, or has changed since it was listed.
    """
    check_unchanged(folder, read_photos(photos))
    # COLMAP would take a model that is cut short.
    read_model(sparse)
    with atomic_directory(workspace) as temporary:
        cancellable(
            pycolmap.undistort_images,
            temporary,
            sparse,
            folder,
            undistort_options=pycolmap.UndistortCameraOptions(max_image_size=settings.max_size_px),
            jpeg_quality=JPEG_QUALITY,
            num_threads=threads(),
        )
        # For COLMAP's own dense part, which reads neither from here.
        shutil.rmtree(temporary / "stereo", ignore_errors=True)
        for script in temporary.glob("run-colmap-*.sh"):
            script.unlink()
    known_cue = None if georeference is None else str(value(read_json(georeference), "up_cue"))
    write_json(report, _report(workspace, known_cue))


def undistort_picture(pixels: NDArray[Any], camera: pycolmap.Camera, view: View) -> NDArray[Any]:
    """Move a picture or mask from the pixels of an original photo into those of the undistorted one.

    Args:
        pixels: (H, W) or (H, W, C), uint8, uint16 or float32, of the photo's size or of a smaller or larger copy.
        camera: of the original photo.
        view: the undistorted photo; its pose does not matter.

    Returns:
        (view.height, view.width[, C]) of the same type, sampled bilinearly; 0 where the original shows nothing.
    """
    width, height = pixels.shape[1], pixels.shape[0]
    shrink = view.intrinsics[0, 0] * camera.width / (camera.mean_focal_length() * width)
    if shrink * MIN_SHRINK < 1:
        width, height = max(round(width * shrink), 1), max(round(height * shrink), 1)
        pixels = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    u, v = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.linalg.inv(view.intrinsics).T
    at = np.asarray(camera.img_from_cam(rays)).reshape(view.height, view.width, 2)
    at = (at * np.array([width / camera.width, height / camera.height]) - 0.5).astype(np.float32)
    x, y = np.moveaxis(at, -1, 0)
    return cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def _report(folder: Path, known_cue: str | None) -> dict[str, Any]:
    """Content of undistorted.json; `known_cue` says what turned the frame upright already."""
    workspace = read_workspace(folder)
    poses = np.stack([view.world_from_cam for view in workspace.views])
    up, cue = estimate_up(poses[:, :3, :3], poses[:, :3, 3])
    if known_cue is not None:
        up, cue = np.array([0.0, 0.0, 1.0]), known_cue
    print(f"{len(workspace.views)} undistorted photos; up: {np.round(up, 3)} from {cue}", flush=True)
    gap_deg, between = largest_gap(poses, up)
    return {
        "largest_gap_deg": quantity(gap_deg, "deg"),
        "gap_between": quantity([workspace.views[index].name for index in between], ""),
        "up_in_camera_frame": quantity(up, "1"),
        "up_cue": quantity(cue, ""),
        "photos": quantity(len(workspace.views), "1"),
        "points": quantity(len(workspace.points), "1"),
        "sizes_px": quantity(sorted({(view.width, view.height) for view in workspace.views}), "px"),
    }


def largest_gap(poses: Array, up: Array) -> tuple[float, tuple[int, int]]:
    """The widest horizontal angle, in degrees, from which none of (N, 4, 4) cameras looks, and the two beside it.

    Seen from the point that their optical axes pass nearest to.
    """
    centres, axes = poses[:, :3, 3], poses[:, :3, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None]
    middle = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centres), rcond=None)[0]
    east, north = np.linalg.svd(up[None])[2][1:]
    away = centres - middle
    heading = np.degrees(np.arctan2(away @ north, away @ east))
    order = np.argsort(heading)
    gaps = np.diff(heading[order], append=heading[order[0]] + 360.0)
    widest = int(np.argmax(gaps))
    return float(gaps[widest]), (int(order[widest]), int(order[(widest + 1) % len(order)]))
