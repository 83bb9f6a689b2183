"""Cameras of the demo: the mapping flight and the orbits, and their truth files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from scenefuse.stage import StageError, quantity, read_json, threads, value
from scenefuse.workspace import View


@dataclass(frozen=True)
class Cameras:
    """Photos of one capture: one pinhole camera at many poses.

    Attributes:
        names: file names.
        intrinsics: (3, 3), pixels, pixel centres at +0.5.
        width: columns.
        height: rows.
        cam_from_world: (N, 3, 3) rotations, OpenCV axes.
        centres: (N, 3) in the world, metres.
    """

    names: list[str]
    intrinsics: NDArray[np.float64]
    width: int
    height: int
    cam_from_world: NDArray[np.float64]
    centres: NDArray[np.float64]

    def view(self, photo: int) -> View:
        """One photo's camera."""
        pose = np.eye(4)
        pose[:3, :3] = self.cam_from_world[photo]
        pose[:3, 3] = -self.cam_from_world[photo] @ self.centres[photo]
        return View(self.names[photo], self.intrinsics, pose, self.width, self.height)

    def project(self, photo: int, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(M, 2) pixels of (M, 3) points of the world in one photo, and which of them fall inside it."""
        pixels, depth = self.view(photo).project(points)
        return pixels, (depth > 0) & (pixels >= 0).all(1) & (pixels < [self.width, self.height]).all(1)


def pinhole(focal_px: float, width: int, height: int) -> NDArray[np.float64]:
    """(3, 3) intrinsics with the principal point in the middle."""
    return np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1.0]])


def visible(
    scene: o3d.t.geometry.RaycastingScene, cameras: Cameras, points: NDArray[np.float64], tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Where each photo shows each of (M, 3) points: (N, M, 2) pixels, and (N, M) whether nothing hides it.

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
    """The truth file of a capture."""
    return {
        "width": quantity(cameras.width, "px"),
        "height": quantity(cameras.height, "px"),
        "intrinsics": quantity(cameras.intrinsics, "px"),
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
        )
    except (KeyError, TypeError):
        raise StageError(f"{path} is not a truth file of the demo; render the capture again") from None
