"""Photos with pinhole cameras, and the one reader of COLMAP models and workspaces.

A workspace is a folder with images/ (undistorted photos) and sparse/ (a COLMAP model of PINHOLE cameras): what
undistortion writes, and what dense stereo, masks and training read. Axes are OpenCV's: x right, y down, z forward;
pixel centres lie at +0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, own_sigterm
from scenefuse.core.transforms import Array
from scenefuse.photos.pictures import read_gray, read_rgb

if TYPE_CHECKING:
    import pycolmap

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class View:
    """A photo with its pinhole camera.

    Attributes:
        name: of the photo, relative to the folder of photos.
        intrinsics: (3, 3) float64 calibration matrix in pixels.
        cam_from_world: (4, 4) float64 rigid pose; the world is the frame of the model that the view is from.
        width, height: of the photo in pixels.
        pixels: what is known of each of them, (H, W) or (H, W, C): grey values, colours, a mask, depths; None where
            only the camera counts.
    """

    name: str
    intrinsics: Array
    cam_from_world: Array
    width: int
    height: int
    pixels: Any = None

    @cached_property
    def world_from_cam(self) -> Array:
        """(4, 4) rigid pose of the camera."""
        pose = np.eye(4)
        pose[:3, :3] = self.cam_from_world[:3, :3].T
        pose[:3, 3] = self.centre
        return pose

    @cached_property
    def centre(self) -> Array:
        """(3,) position of the camera in the world."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    @cached_property
    def projection(self) -> Array:
        """(3, 4) matrix from homogeneous world points to homogeneous pixels; the third row gives the depth."""
        return self.intrinsics @ self.cam_from_world[:3]

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixels (N, 2) and depths (N,) along z of world points (N, 3); pixels count where the depth is positive."""
        x = self._homogeneous(points)
        divisor = np.where(np.abs(x[:, 2]) < 1e-9, 1e-9, x[:, 2])
        return x[:, :2] / divisor[:, None], x[:, 2]

    def visible(self, points: Array) -> tuple[Rows, Rows, Array]:
        """Rows (K,) of world points (N, 3) inside the photo, their pixels (K, 2; column, row) and depths (K,)."""
        x = self._homogeneous(points)
        u, v, depth = x.T
        # Compared before the division, which only what is inside needs.
        rows = np.flatnonzero((depth > 0) & (u >= 0) & (v >= 0) & (u < self.width * depth) & (v < self.height * depth))
        x = x[rows]
        pixels = (x[:, :2] / x[:, 2:]).astype(np.int64)
        return rows, np.minimum(pixels, (self.width - 1, self.height - 1)), x[:, 2]

    def _homogeneous(self, points: Array) -> Array:
        """(N, 3) homogeneous pixels of world points, by OpenCV: NumPy's product of so narrow matrices runs on threads
        that wait for each other, in ten times the time."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        return np.asarray(cv2.transform(points[:, None], self.projection)[:, 0]) if len(points) else points

    def resized(self, width: int, height: int) -> View:
        """The same photo at another size, its pixels averaged over areas: never sharper than they were."""
        if (width, height) == (self.width, self.height):
            return self
        shrink = np.diag([width / self.width, height / self.height, 1.0])
        pixels = self.pixels
        if pixels is not None:
            pixels = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), dtype=pixels.dtype)
        return replace(self, intrinsics=shrink @ self.intrinsics, width=width, height=height, pixels=pixels)

    def at_most(self, side_px: int) -> View:
        """The same photo, its longer side at most `side_px`."""
        scale = min(1.0, side_px / max(self.width, self.height))
        return self.resized(round(self.width * scale), round(self.height * scale))


@dataclass(frozen=True)
class Workspace:
    """The V posed photos of a COLMAP workspace in name order, and the P sparse points in the order of their ids.

    Attributes:
        folder: with images/ and sparse/.
        views: cameras without pixels; `rgb` and `gray` read these.
        points: (P, 3) float64 sparse points in the model's frame.
        seen: V arrays (K,) of rows of `points` that a photo observes, repeated where it observes one twice.
        seen_at: V arrays (K, 2) of the pixels where it does.
        by_stereo: how many of the points, the last ones, are not from features but from stereo.
    """

    folder: Path
    views: list[View]
    points: Array
    seen: list[Rows]
    seen_at: list[Array]
    by_stereo: int = 0

    def subset(self, rows: Sequence[int]) -> Workspace:
        """The same workspace with only these of its views, and all sparse points."""
        views, seen = [self.views[k] for k in rows], [self.seen[k] for k in rows]
        return replace(self, views=views, seen=seen, seen_at=[self.seen_at[k] for k in rows])

    def rgb(self, view: View) -> View:
        """A view with its photo, (H, W, 3) uint8 RGB."""
        path = self.folder / "images" / view.name
        return _with_pixels(view, path, read_rgb(path), "undistortion")

    def gray(self, view: View) -> View:
        """A view with its photo, (H, W) uint8."""
        path = self.folder / "images" / view.name
        return _with_pixels(view, path, read_gray(path), "undistortion")


def with_mask(view: View, path: Path) -> View:
    """A view with the grey values of its mask, (H, W) uint8, as pixels.

    Raises:
        StageError: the mask is missing, no picture, or not of its photo's size.
    """
    return _with_pixels(view, path, read_gray(path), "masks")


def _with_pixels(view: View, path: Path, pixels: NDArray[np.uint8], stage: str) -> View:
    """A view with the pixels of a file that a stage made."""
    height, width = pixels.shape[:2]
    if (height, width) != (view.height, view.width):
        raise StageError(
            f"{path} is {width} x {height} pixels, but its camera is made for {view.width} x {view.height}; rerun the"
            f" {stage}"
        )
    return replace(view, pixels=pixels)


def read_workspace(folder: Path) -> Workspace:
    """Read a COLMAP workspace.

    Raises:
        StageError: no readable model, no posed photo, or a camera with distortion.
    """
    folder = Path(folder)
    model = read_model(folder / "sparse")
    images = posed_images(model)
    if not images:
        raise StageError(f"{folder} holds no photo with a camera; look at the report of the mapping stage")
    bent = next((c for c in model.cameras.values() if c.model_name not in ("PINHOLE", "SIMPLE_PINHOLE")), None)
    if bent is not None:
        raise StageError(f"{folder}/sparse has a camera of type {bent.model_name}; undistort the photos first")
    row_of = {point: row for row, point in enumerate(sorted(model.points3D))}
    points = np.array([model.points3D[p].xyz for p in row_of], dtype=np.float64).reshape(-1, 3)
    observed = [image.get_observation_points2D() for image in images]
    return Workspace(
        folder,
        [view_of(model, image) for image in images],
        points,
        [np.array([row_of[p.point3D_id] for p in seen], dtype=np.int64) for seen in observed],
        [np.array([p.xy for p in seen], dtype=np.float64).reshape(-1, 2) for seen in observed],
    )


def read_views(folder: Path) -> list[View]:
    """The posed photos of a COLMAP model in name order; a lens's distortion is left out."""
    model = read_model(folder)
    return [view_of(model, image) for image in posed_images(model)]


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model (binary or text); StageError that names the folder when it cannot be read."""
    with own_sigterm():
        import pycolmap

    try:
        _require_whole_points(folder / "points3D.bin")
        model = pycolmap.Reconstruction(folder)
        _require_whole_cameras(folder / "cameras.bin", model)
        return model
    except Exception as error:
        why = " ".join(str(error).split())
        raise StageError(f"{folder} is not a readable COLMAP model ({why}); rerun the stage that writes it") from None


def _require_whole_cameras(path: Path, model: pycolmap.Reconstruction) -> None:
    """Raise ValueError where cameras.bin is cut short: COLMAP takes whatever numbers stand in memory for the rest."""
    if path.is_file():
        # A count; for each camera its number, model, width and height, and its parameters.
        size = 8 + sum(24 + 8 * len(camera.params) for camera in model.cameras.values())
        if path.stat().st_size < size:
            raise ValueError(f"{path.name} is cut short: {path.stat().st_size} of {size} bytes")


def _require_whole_points(path: Path) -> None:
    """Raise ValueError where points3D.bin is cut short: COLMAP takes whatever stands in memory for the length of a
    track, and may ask for all memory."""
    if path.is_file():
        content = path.read_bytes()
        left, at = int.from_bytes(content[:8], "little"), 8
        # Number, position, colour and error of a point, and the length of its track, whose elements have 8 bytes each.
        while left and at + 51 <= len(content):
            left, at = left - 1, at + 51 + 8 * int.from_bytes(content[at + 43 : at + 51], "little")
        if left or at > len(content):
            raise ValueError(f"{path.name} is cut short")


def read_cameras(folder: Path) -> dict[str, pycolmap.Camera]:
    """The cameras of a COLMAP model, with their distortion, by the name of the photo."""
    model = read_model(folder)
    return {image.name: model.cameras[image.camera_id] for image in model.images.values()}


def ray_through(camera: pycolmap.Camera, pixel: Array) -> Array:
    """(2,) where the ray of a pixel (2,) meets the plane z = 1 in front of its camera; NaN where the lens's model does
    not reach so far: a strong distortion folds back beyond some angle."""
    return np.asarray(camera.cam_from_img(np.asarray(pixel, dtype=np.float64).reshape(1, 2)))[0]


def posed_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """The images of a model that have a pose, sorted by name."""
    return sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)


def images_by_name(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """The images of a model that have a pose, by name."""
    return {image.name: image for image in posed_images(model)}


def view_of(model: pycolmap.Reconstruction, image: pycolmap.Image) -> View:
    """The pinhole camera of a posed image; a lens's distortion is left out."""
    camera, pose = model.cameras[image.camera_id], np.eye(4)
    pose[:3] = image.cam_from_world().matrix()
    return View(image.name, camera.calibration_matrix(), pose, camera.width, camera.height)


def write_model(folder: Path, views: list[View]) -> None:
    """Write a COLMAP model of PINHOLE cameras and poses into an existing folder, without points.

    Views with the same lens and size share a camera.
    """
    with own_sigterm():
        import pycolmap

    model = pycolmap.Reconstruction()
    known: dict[tuple[float, ...], int] = {}
    for number, view in enumerate(views, start=1):
        k = view.intrinsics
        lens = view.width, view.height, float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
        if lens not in known:
            known[lens] = len(known) + 1
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    camera_id=known[lens], model="PINHOLE", width=view.width, height=view.height, params=lens[2:]
                )
            )
        image = pycolmap.Image(name=view.name, camera_id=known[lens], image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.cam_from_world[:3]))
    model.write(folder)
