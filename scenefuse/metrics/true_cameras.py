"""True cameras of a capture: where each photo shows a point, what hides it, and the truth file that holds them."""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import pycolmap
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, quantity, read_json, threads, value


@dataclass(frozen=True)
class Cameras:
    """Photos of one capture: one camera, pinhole or with Brown's distortion, at many poses.

    Attributes:
        names: file names.
        intrinsics: (3, 3), pixels, pixel centres at +0.5.
        width: columns.
        height: rows.
        cam_from_world: (N, 3, 3) rotations, OpenCV axes.
        centres: (N, 3) in the world, metres.
        distortion: (4,) k1, k2, p1, p2 of Brown (1971), as in OpenCV and in COLMAP's OPENCV camera; zeros: a pinhole.
    """

    names: list[str]
    intrinsics: NDArray[np.float64]
    width: int
    height: int
    cam_from_world: NDArray[np.float64]
    centres: NDArray[np.float64]
    distortion: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))

    @cached_property
    def camera(self) -> pycolmap.Camera:
        """The same camera without a pose, as COLMAP's OPENCV."""
        k = self.intrinsics
        params = [k[0, 0], k[1, 1], k[0, 2], k[1, 2], *self.distortion]
        return pycolmap.Camera(model="OPENCV", width=self.width, height=self.height, params=params)

    @cached_property
    def reach(self) -> float:
        """Tangent of the largest angle off the optical axis that a photo shows, at one of its corners."""
        corners = np.array([[x, y] for x in (0, self.width) for y in (0, self.height)], dtype=np.float64)
        return float(np.linalg.norm(np.asarray(self.camera.cam_from_img(corners)), axis=1).max())

    def rays(self, side: int) -> NDArray[np.float64]:
        """(H * W * side**2, 2) x and y at z = 1 of the rays through a grid of `side` x `side` samples in each pixel.

        Row by row; the samples of a pixel lie next to each other. The distortion is inverted exactly.
        """
        step = (np.arange(side) + 0.5) / side
        row, column, y, x = np.ix_(np.arange(self.height), np.arange(self.width), step, step)
        pixels = np.stack(np.broadcast_arrays(column + x, row + y), axis=-1)
        return np.asarray(self.camera.cam_from_img(pixels.reshape(-1, 2)))

    def project(self, photo: int, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(M, 2) pixels of (M, 3) points of the world in one photo, and which of them fall inside it.

        Pixels are NaN behind the camera and beyond `reach`: far outside a photo Brown's polynomial turns back and would
        put points into it that no ray comes from.
        """
        in_cam = (points - self.centres[photo]) @ self.cam_from_world[photo].T
        ahead = (in_cam[:, 2] > 0) & (np.linalg.norm(in_cam[:, :2], axis=1) <= self.reach * in_cam[:, 2])
        pixels = np.full((len(points), 2), np.nan)
        pixels[ahead] = self.camera.img_from_cam(in_cam[ahead])
        inside = (pixels >= 0) & (pixels < [self.width, self.height])
        return pixels, ahead & inside.all(1)


def pinhole(focal_px: float, width: int, height: int, shift: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """(3, 3) intrinsics with the principal point in the middle, or off it by shares of width and height."""
    return np.array([[focal_px, 0, width * (0.5 + shift[0])], [0, focal_px, height * (0.5 + shift[1])], [0, 0, 1.0]])


def visible(
    scene: o3d.t.geometry.RaycastingScene, cameras: Cameras, points: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where each photo shows each of (M, 3) points: (N, M, 2) pixels, and (N, M) whether nothing hides it.

    Pixels are those of the photo as taken, distorted if its lens does; NaN as in `Cameras.project`.
    A point counts as hidden when a ray towards it ends more than `tolerance` metres before it.
    """
    pixels = np.zeros((len(cameras.names), len(points), 2))
    seen = np.zeros((len(cameras.names), len(points)), dtype=bool)
    for k, centre in enumerate(cameras.centres):
        pixels[k], seen[k] = cameras.project(k, points)
        inside = np.flatnonzero(seen[k])
        away = points[inside] - centre
        distance = np.linalg.norm(away, axis=1)
        rays = np.concatenate([np.broadcast_to(centre, away.shape), away / distance[:, None]], axis=1)
        hit = scene.cast_rays(o3d.core.Tensor.from_numpy(rays.astype(np.float32)), nthreads=threads())["t_hit"].numpy()
        seen[k, inside] = hit > distance - tolerance
    return pixels, seen


def cameras_json(cameras: Cameras) -> dict[str, Any]:
    """The truth file of a capture; `distortion` is k1, k2, p1, p2 of COLMAP's camera model OPENCV."""
    return {
        "width": quantity(cameras.width, "px"),
        "height": quantity(cameras.height, "px"),
        "intrinsics": quantity(cameras.intrinsics, "px"),
        "distortion": quantity(cameras.distortion, "1"),
        "photos": {
            name: {
                "cam_from_world_rotation": quantity(rotation, "1"),
                "centre": quantity(centre, "m"),
            }
            for name, rotation, centre in zip(cameras.names, cameras.cam_from_world, cameras.centres)
        },
    }


def read_cameras(path: Path) -> Cameras:
    """Read a capture's truth file; StageError when it is missing or another file."""
    content = read_json(path)
    try:
        photos = content["photos"]
        return Cameras(
            list(photos),
            np.array(value(content, "intrinsics")),
            value(content, "width"),
            value(content, "height"),
            np.array([value(p, "cam_from_world_rotation") for p in photos.values()]),
            np.array([value(p, "centre") for p in photos.values()]),
            np.array(value(content, "distortion")),
        )
    except (KeyError, TypeError):
        raise StageError(f"{path} is not a truth file of the demo; render the capture again") from None
