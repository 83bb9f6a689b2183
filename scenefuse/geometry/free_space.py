"""Free space: where the scene's depth maps measured surfaces behind a place, nothing stands there."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import minimum_filter

from scenefuse.core.transforms import Array
from scenefuse.geometry.depth_test import IN_FRONT, depth_test
from scenefuse.photos.pictures import read_depth
from scenefuse.photos.workspace import View, posed_images, read_model, view_of

# Below this share of points with a measurement on their rays, depth maps tell nothing of an object.
MIN_MEASURED = 0.1


@dataclass(frozen=True)
class FreeSpace:
    """The scene's depth maps around an object.

    Attributes:
        views: `pixels` are depths along the camera's z axis (H, W; float32, scene units), 0 where nothing was measured,
            without their edges (`without_edges`).
        tolerance: how far beyond a point a measurement must lie for the point to be in free space, scene units.
    """

    views: list[View]
    tolerance: float

    def violation(self, points: Array) -> float | None:
        """Share of the points (N, 3; scene frame) that lie in free space.

        A point counts where any camera has a measurement on its ray. It lies in free space when, of those cameras, at
        least half measured a depth more than `tolerance` beyond it.

        Returns:
            The share, or None when fewer than a tenth of the points have any measurement on their rays.
        """
        measured, beyond = np.zeros(len(points), dtype=np.int64), np.zeros(len(points), dtype=np.int64)
        for view in self.views:
            place = depth_test(points, view, self.tolerance)
            measured += place >= IN_FRONT
            beyond += place == IN_FRONT
        seen = measured > 0
        if seen.mean() < MIN_MEASURED:
            return None
        return float((beyond[seen] >= 0.5 * measured[seen]).mean())


def without_edges(view: View) -> View:
    """The nearest depth of the pixels around each, nothing where one of them has none: depths at edges are unsure."""
    return replace(view, pixels=minimum_filter(view.pixels, 3))


def read_free_space(
    workspace: Path, depth: tuple[Path, ...], points: Array, most: int, tolerance: float
) -> FreeSpace | None:
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
    model = read_model(workspace / "sparse")
    sample = points[:: max(1, len(points) // 500)]
    seeing: list[tuple[Path, View]] = []
    for image in posed_images(model):
        path = next((p for d in depth if (p := d / "depth_maps" / f"{image.name}.bin").is_file()), None)
        if path is None:
            continue
        view = view_of(model, image)
        if len(view.visible(sample)[0]) >= 0.5 * len(sample):
            seeing.append((path, view))
    if not seeing:
        return None
    views = []
    for path, view in (seeing[k] for k in most_different([v for _, v in seeing], points.mean(0), most)):
        measured = read_depth(path)
        sized = view.resized(measured.shape[1], measured.shape[0])
        views.append(without_edges(replace(sized, pixels=measured)))
    return FreeSpace(views, tolerance)


def most_different(views: list[View], place: Array, most: int) -> list[int]:
    """Rows of at most `most` views, each next one as far as possible in direction from those before; sorted."""
    directions = np.array([v.centre - place for v in views])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    chosen = [0]
    nearest = directions @ directions[0]
    while len(chosen) < min(most, len(views)):
        chosen.append(int(nearest.argmin()))
        nearest = np.maximum(nearest, directions @ directions[chosen[-1]])
    return sorted(chosen)
