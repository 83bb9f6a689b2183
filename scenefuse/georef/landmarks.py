"""The triangulated points of a COLMAP model with their SIFT descriptors, and matches between two models' points."""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.photos.workspace import posed_images, read_model
from scenefuse.sfm.colmap import require_database

# Points of a model at most, those with the most observations.
MAX_POINTS = 100_000
# Views of a point whose descriptors are compared.
DESCRIPTORS_PER_POINT = 3


@dataclass(frozen=True)
class Landmarks:
    """P points of a sparse model and the K observations that they were triangulated from.

    Attributes:
        photos: V names of the registered photos.
        cam_from_model: (V, 3, 4) their poses.
        focal: (V,) mean focal lengths in pixels.
        points: (P, 3) in the model's frame.
        descriptors: (P, D, 128) float32 unit vectors, each point's most different views; see `read_landmarks`.
        start: (P + 1,) the observations of point p are rows start[p] to start[p + 1].
        seen_in: (K,) photo of each observation.
        rays: (K, 2) x / z and y / z of each observation in its camera, free of distortion.
    """

    photos: list[str]
    cam_from_model: Array
    focal: Array
    points: Array
    descriptors: NDArray[np.float32]
    start: NDArray[np.int64]
    seen_in: NDArray[np.int64]
    rays: Array

    def observations_of(self, points: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the observations of some points, and which of these points each belongs to."""
        counts = self.start[points + 1] - self.start[points]
        owner = np.repeat(np.arange(len(points)), counts)
        offset = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        return self.start[points][owner] + offset, owner

    def looked_at(self) -> Array:
        """(3,) the point that the optical axes of all photos pass nearest to, by least squares.

        Axes side by side, along a front, may meet behind the cameras: then the middle of all points.
        """
        axes, rotations = self.cam_from_model[:, 2, :3], self.cam_from_model[:, :, :3]
        centres = -np.einsum("nji,nj->ni", rotations, self.cam_from_model[:, :, 3])
        across = np.eye(3) - axes[:, :, None] * axes[:, None]
        place = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centres), rcond=1e-9)[0]
        ahead = ((place - centres) * axes).sum(1) > 0
        return place if ahead.mean() > 0.5 else np.median(self.points, axis=0)

    def pixel_size(self, points: NDArray[np.int64]) -> Array:
        """What one pixel of the nearest photo covers at each of some points, in the model's unit."""
        rows, owner = self.observations_of(points)
        view = self.seen_in[rows]
        pose = self.cam_from_model[view]
        depth = np.einsum("ij,ij->i", pose[:, 2, :3], self.points[points][owner]) + pose[:, 2, 3]
        size = np.full(len(points), np.inf)
        np.minimum.at(size, owner, depth / self.focal[view])
        return size


def read_landmarks(model: Path, database: Path, max_points: int = MAX_POINTS) -> Landmarks:
    """Read a sparse model and the descriptors of its points.

    Args:
        model: COLMAP model of the original photos (not of undistorted ones).
        database: COLMAP database that it was made from; holds the descriptors.
        max_points: where the model has more, those with the most observations are kept.

    Raises:
        StageError: the database does not belong to the model.
    """
    require_database(database)
    with _untouched(database) as copy, pycolmap.Database.open(copy) as opened:

        def descriptors(image: pycolmap.Image) -> NDArray[np.uint8]:
            known = opened.exists_image(image.image_id)
            found = opened.read_descriptors(image.image_id).data if known else np.zeros((0, 128), np.uint8)
            if len(found) != len(image.points2D):
                raise StageError(
                    f"{database} holds {len(found)} features of photo {image.name}, but {model} was made from"
                    f" {len(image.points2D)}; rerun the matching and mapping of these photos"
                )
            return found

        return landmarks_of(read_model(model), descriptors, max_points)


def landmarks_of(
    reconstruction: pycolmap.Reconstruction,
    descriptors_of: Callable[[pycolmap.Image], NDArray[Any]],
    max_points: int = MAX_POINTS,
) -> Landmarks:
    """The landmarks of a sparse model; `descriptors_of` a photo are (N, 128), one for each of its features."""
    images = {image.image_id: image for image in sorted(posed_images(reconstruction), key=lambda i: i.image_id)}
    view_of = {image_id: k for k, image_id in enumerate(images)}
    ids = sorted(reconstruction.points3D, key=lambda p: (-reconstruction.points3D[p].track.length(), p))[:max_points]
    ids.sort()
    tracks = [
        sorted((e.image_id, e.point2D_idx) for e in reconstruction.points3D[p].track.elements if e.image_id in view_of)
        for p in ids
    ]
    start = np.concatenate([[0], np.cumsum([len(track) for track in tracks])]).astype(np.int64)
    elements = np.array([element for track in tracks for element in track], dtype=np.int64).reshape(-1, 2)
    chosen = _spread_evenly(start, DESCRIPTORS_PER_POINT)
    rays = np.zeros((len(elements), 2))
    descriptors = np.zeros((len(ids) * DESCRIPTORS_PER_POINT, 128), dtype=np.float32)
    for image_id, image in images.items():
        rows = np.flatnonzero(elements[:, 0] == image_id)
        xy = np.array([image.points2D[k].xy for k in elements[rows, 1]]).reshape(-1, 2)
        rays[rows] = np.asarray(reconstruction.cameras[image.camera_id].cam_from_img(xy)).reshape(-1, 2)
        taken = np.flatnonzero(elements[chosen, 0] == image_id)
        descriptors[taken] = descriptors_of(image)[elements[chosen[taken], 1]]
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)
    return Landmarks(
        [image.name for image in images.values()],
        np.array([image.cam_from_world().matrix() for image in images.values()]),
        np.array([reconstruction.cameras[image.camera_id].mean_focal_length() for image in images.values()]),
        np.array([reconstruction.points3D[p].xyz for p in ids]).reshape(-1, 3),
        descriptors.reshape(len(ids), DESCRIPTORS_PER_POINT, 128),
        start,
        np.array([view_of[i] for i in elements[:, 0]], dtype=np.int64),
        rays,
    )


@contextmanager
def _untouched(database: Path) -> Iterator[Path]:
    """A temporary copy: COLMAP writes to every database that it opens, and a changed input reruns the workflow."""
    with tempfile.TemporaryDirectory(prefix="scenefuse-") as folder:
        yield Path(shutil.copyfile(database, Path(folder) / database.name))


def match_landmarks(a: Landmarks, b: Landmarks, max_ratio: float, block: int = 4096) -> NDArray[np.int64]:
    """Pairs (M, 2) of points that look most alike, mutually, and clearly more alike than any other two.

    Two points differ in look by the distance of their most similar descriptors. The ratio test is made from both
    sides. Blocks of descriptors bound the memory, whatever the number of points.

    Args:
        a: points of one model.
        b: points of the other.
        max_ratio: largest distance to the partner over the distance to the next point (Lowe 2004).
        block: points of either side that are compared at once.
    """
    best_a, best_b = np.full((len(a.points), 2), -1.0, np.float32), np.full((len(b.points), 2), -1.0, np.float32)
    partner_a, partner_b = np.zeros(len(a.points), np.int64), np.zeros(len(b.points), np.int64)
    for i in range(0, len(a.points), block):
        ours = a.descriptors[i : i + block]
        for j in range(0, len(b.points), block):
            alike = _most_alike(ours, b.descriptors[j : j + block])
            _update(best_a[i : i + block], partner_a[i : i + block], alike, j)
            _update(best_b[j : j + block], partner_b[j : j + block], alike.T, i)
    mine = np.arange(len(a.points))
    mutual = (partner_b[partner_a] == mine) & (best_a[:, 0] > 0) if len(b.points) else np.zeros(len(mine), bool)
    pairs = np.stack([mine[mutual], partner_a[mutual]], axis=1)
    ratio = np.maximum(_ratio(best_a[pairs[:, 0]]), _ratio(best_b[pairs[:, 1]]))
    return pairs[ratio <= max_ratio]


def _most_alike(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, M) largest inner product between any two descriptors of (N, D, 128) and (M, D, 128) points."""
    most = None
    for k in range(a.shape[1]):
        for n in range(b.shape[1]):
            product = a[:, k] @ b[:, n].T
            most = product if most is None else np.maximum(most, product, out=most)
    assert most is not None
    return most


def _update(best: NDArray[np.float32], partner: NDArray[np.int64], alike: NDArray[np.float32], offset: int) -> None:
    """Carry the two largest values of each row, and the column of the largest, on over one more block; in place."""
    rows = np.arange(len(alike))
    first = alike.argmax(1)
    top = alike[rows, first]
    masked = alike.copy()
    masked[rows, first] = -1
    second = masked.max(1)
    better = top > best[:, 0]
    best[:, 1] = np.where(better, np.maximum(best[:, 0], second), np.maximum(best[:, 1], top))
    partner[better] = first[better] + offset
    best[:, 0] = np.where(better, top, best[:, 0])


def _ratio(best: NDArray[np.float32]) -> NDArray[np.floating]:
    """Distance to the best over distance to the second best, from inner products (N, 2) of unit vectors."""
    distance = np.sqrt(np.maximum(2 - 2 * best, 0))
    return distance[:, 0] / np.maximum(distance[:, 1], 1e-9)


def _spread_evenly(start: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """(P * count,) rows: `count` observations of each point, evenly through its photos; repeated where it has fewer."""
    length = np.diff(start)
    steps = (np.arange(count) + 0.5) / count
    return (start[:-1, None] + np.floor(steps * length[:, None]).astype(np.int64)).ravel()
