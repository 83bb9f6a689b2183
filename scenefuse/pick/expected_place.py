"""Where a point that was clicked in some photos is to be expected in another one, once their cameras are known."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.marks.clicks import Click, Clicks
from scenefuse.marks.triangulation import triangulate_consistent
from scenefuse.photos.workspace import posed_images, ray_through, read_model
from scenefuse.pick.document import Sizes

# A ray reaches so many times nearer and farther than the sparse points that the photo sees.
RAY_REACH = 4


class Cameras:
    """The cameras of a COLMAP model, in pixels of the original photos."""

    def __init__(self, folder: Path, sizes: Sizes) -> None:
        """Read a model.

        Raises:
            StageError: it cannot be read.
        """
        self._model, self._sizes = read_model(folder), sizes
        self._images = {image.name: image for image in posed_images(self._model) if image.name in sizes}

    def __contains__(self, photo: str) -> bool:
        return photo in self._images

    def seen_pixels(self, photo: str) -> Array:
        """(N, 2) pixels of a photo at which it sees sparse points."""
        image = self._images[photo]
        camera = self._model.cameras[image.camera_id]
        pixels = np.array([point.xy for point in image.get_observation_points2D()]).reshape(-1, 2)
        return pixels * self._sizes[photo] / np.array([camera.width, camera.height])

    def expected(self, clicks: Iterable[Click], photo: str) -> Array | None:
        """(N, 2) pixels where the clicks on one point in other photos say that it is in this one: one, or from a single
        photo a line of them; none where this photo does not see it; None where they say nothing."""
        others = [c for c in clicks if c.photo != photo and c.photo in self._images]
        if photo not in self._images or not others:
            return None
        if len(others) == 1:
            return self._line(others[0], photo)
        position = self._position(others)
        return None if position is None else self._seen(position[None], photo)

    def residuals(self, clicks: Iterable[Click]) -> dict[str, float]:
        """How far each click on one point is from where all say that it is, px by photo; empty for fewer than two."""
        known = [c for c in clicks if c.photo in self._images]
        position = self._position(known)
        if position is None:
            return {}
        found = {}
        for click in known:
            at = self._projected(position, click.photo)
            if at is not None:
                found[click.photo] = float(np.hypot(*(at - click.pixel)))
        return found

    def _position(self, clicks: list[Click]) -> Array | None:
        """(3,) of a point in the model's frame, from two or more photos."""
        if len(clicks) < 2:
            return None
        try:
            _, found, _, _ = triangulate_consistent(
                Clicks(Path(), "points", tuple(clicks)), self._model, np.inf, self._sizes
            )
        except StageError:
            return None
        return found[0] if len(found) else None

    def _line(self, click: Click, photo: str) -> Array:
        """(N, 2) pixels of a photo on the ray through a click in another one (Hartley and Zisserman, 9.1)."""
        image = self._images[click.photo]
        camera = self._model.cameras[image.camera_id]
        pixel = click.pixel * [camera.width, camera.height] / np.array(self._sizes[click.photo])
        ray = np.array([*ray_through(camera, pixel), 1.0])
        if not np.isfinite(ray).all():
            return np.zeros((0, 2))
        pose = image.cam_from_world().matrix()
        seen = np.array([self._model.points3D[p.point3D_id].xyz for p in image.get_observation_points2D()])
        depth = seen @ pose[2, :3] + pose[2, 3] if len(seen) else np.ones(1)
        steps = np.geomspace(max(depth.min(), 1e-6) / RAY_REACH, RAY_REACH * depth.max(), 200)
        return self._seen((ray * steps[:, None] - pose[:, 3]) @ pose[:, :3], photo)

    def _seen(self, points: Array, photo: str) -> Array:
        """(N, 2) pixels of those points (P, 3) that lie in a photo: a lens's model does not hold outside."""
        pixels = [at for point in points if (at := self._projected(point, photo)) is not None]
        found = np.array(pixels).reshape(-1, 2)
        return found[((found >= 0) & (found <= self._sizes[photo])).all(1)]

    def _projected(self, point: Array, photo: str) -> Array | None:
        image = self._images[photo]
        at, camera = image.project_point(point), self._model.cameras[image.camera_id]
        return None if at is None else np.asarray(at) * self._sizes[photo] / np.array([camera.width, camera.height])
