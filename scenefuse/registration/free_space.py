"""Free space: what the scene's cameras saw through cannot be where the object is."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from scenefuse.io.maps import read_depth
from scenefuse.transforms import Array


@dataclass(frozen=True)
class DepthView:
    """What one photo of the scene measured.

    Attributes:
        depth: (H, W) float32 along the camera's z axis, scene units; 0 where nothing was measured.
        intrinsics: (3, 3) pixels, pixel centres at +0.5.
        rotation: (3, 3) cam_from_scene.
        translation: (3,) cam_from_scene.
    """

    depth: NDArray[np.float32]
    intrinsics: Array
    rotation: Array
    translation: Array

    @property
    def centre(self) -> Array:
        """The camera's centre (3,) in the scene."""
        return -self.rotation.T @ self.translation

    def look_at(self, points: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """Indices (K,) of the points (N, 3) that it shows, their pixels (K, 2; column, row) and depths (K,)."""
        local = points @ self.rotation.T + self.translation
        depth = local[:, 2]
        index = np.flatnonzero(depth > 0)
        pixel = local[index] @ self.intrinsics.T
        pixel = np.floor(pixel[:, :2] / pixel[:, 2:])
        height, width = self.depth.shape
        inside = ((pixel >= 0) & (pixel < [width, height])).all(1)
        index = index[inside]
        return index, pixel[inside].astype(np.int64), depth[index]

    def cautious(self) -> "DepthView":
        """The nearest depth of the pixels around each, nothing where one of them has none: edges prove nothing."""
        return DepthView(minimum_filter(self.depth, 3), self.intrinsics, self.rotation, self.translation)


@dataclass(frozen=True)
class FreeSpace:
    """The scene's depth maps around an object, and how far beyond a point a measurement must lie to prove it absent.

    Attributes:
        views: made cautious.
        tolerance: scene units.
    """

    views: list[DepthView]
    tolerance: float

    def blocked_share(self, points: Array) -> float | None:
        """Share of the points (N, 3; scene frame) that stand where the cameras saw through.

        A point counts where any camera has a measurement on its ray. It is blocked when, of those cameras, at least
        half measured a depth more than `tolerance` beyond it: light came through where it stands.

        Returns:
            The share, or None when fewer than a tenth of the points have any measurement on their rays.
        """
        judged, through = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
        for view in self.views:
            index, pixels, depth = view.look_at(points)
            measured = view.depth[pixels[:, 1], pixels[:, 0]]
            known = measured > 0
            judged[index[known]] += 1
            through[index[known]] += (measured > depth + self.tolerance)[known]
        met = judged > 0
        if met.mean() < 0.1:
            return None
        return float((through[met] >= 0.5 * judged[met]).mean())


def read_free_space(workspace: Path, depth: list[Path], points: Array, most: int, tolerance: float) -> FreeSpace | None:
    """The depth maps of the photos that see a place from the most different sides.

    Args:
        workspace: undistorted COLMAP workspace of the scene, with sparse/.
        depth: folders of the depth maps' chunks, each with depth_maps/{photo}.bin.
        points: (N, 3) scene points of the place.
        most: photos used at most.
        tolerance: see FreeSpace.

    Returns:
        None when no photo with a depth map sees half of the points.
    """
    model = pycolmap.Reconstruction(workspace / "sparse")
    centre = points.mean(0)
    sample = points[:: max(1, len(points) // 500)]
    seeing: list[tuple[Path, DepthView]] = []
    for image in sorted(model.images.values(), key=lambda i: i.name):
        path = next((p for d in depth if (p := d / "depth_maps" / f"{image.name}.bin").is_file()), None)
        if path is None or not image.has_pose:
            continue
        camera, pose = image.camera, image.cam_from_world()
        empty = np.zeros((camera.height, camera.width), dtype=np.float32)
        view = DepthView(empty, camera.calibration_matrix(), pose.rotation.matrix(), np.array(pose.translation))
        if len(view.look_at(sample)[0]) >= 0.5 * len(sample):
            seeing.append((path, view))
    if not seeing:
        return None
    directions = np.array([v.centre - centre for _, v in seeing])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    chosen = [0]
    nearest = directions @ directions[0]
    while len(chosen) < min(most, len(seeing)):
        chosen.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    views = []
    for path, view in (seeing[k] for k in sorted(chosen)):
        measured = read_depth(path)
        shrink = np.diag([measured.shape[1] / view.depth.shape[1], measured.shape[0] / view.depth.shape[0], 1.0])
        views.append(DepthView(measured, shrink @ view.intrinsics, view.rotation, view.translation).cautious())
    return FreeSpace(views, tolerance)
