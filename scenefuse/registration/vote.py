"""Which points of a scene an object's masks vote for, seen through the object's cameras and a known similarity."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.clouds import spacing
from scenefuse.stage import StageError
from scenefuse.transforms import Array, Sim3

Columns = tuple[NDArray[np.float32], ...]

MOST_PHOTOS = 60
SLACK = 0.005
CELL_SPACINGS = 4
HIDDEN_CELLS = 2


@dataclass(frozen=True)
class Silhouette:
    """The object's mask in one photo, (H, W) bool, and the camera, (3, 4) pixels from the object's frame."""

    mask: NDArray[np.bool_]
    projection: Array


def read_silhouettes(cameras: Path, masks: Path) -> list[Silhouette]:
    """Masks and cameras of an object's photos, at most 60 spread evenly; masks grown by 0.5 % of the photo's width.

    The growth allows for what the similarity and the masks err by at outlines.

    Args:
        cameras: undistorted COLMAP workspace of the object.
        masks: folder of {name}.png, non-zero on the object.

    Raises:
        StageError: fewer than three photos have a mask.
    """
    model = pycolmap.Reconstruction(cameras / "sparse")
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    files = [(image, masks / f"{Path(image.name).stem}.png") for image in images]
    files = [(image, path) for image, path in files if path.is_file()]
    if len(files) < 3:
        raise StageError(f"{len(files)} photos of {cameras} have a mask in {masks}, three are needed; rerun the masks")
    chosen = np.unique(np.linspace(0, len(files) - 1, min(MOST_PHOTOS, len(files))).round().astype(int))
    found = []
    for image, path in (files[k] for k in chosen):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if mask is None:
            raise StageError(f"{path} cannot be read; rerun the masks")
        reach = 2 * int(np.ceil(SLACK * mask.shape[1])) + 1
        grown = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
        camera = model.cameras[image.camera_id].calibration_matrix()
        found.append(Silhouette(grown > 0, camera @ image.cam_from_world().matrix()))
    return found


def vote(points: Array, silhouettes: list[Silhouette], scene_from_object: Sim3, min_share: float) -> NDArray[np.bool_]:
    """(N,) scene points that lie inside the mask in most photos that show them.

    A photo has a say on a point that falls into its frame and that no nearer scene point hides. At least a quarter of
    the photos must frame the point, and three must have a say: what only stands behind the object passes neither.

    Args:
        points: (N, 3) in the scene frame.
        silhouettes: masks and cameras.
        scene_from_object: the similarity.
        min_share: of the photos that have a say, how many must have the point inside the mask.
    """
    in_object = scene_from_object.inverse().apply(points)
    columns = tuple(np.ascontiguousarray(in_object.T, dtype=np.float32))
    framed, shown, inside = (np.zeros(len(points), dtype=np.int32) for _ in range(3))
    for one in silhouettes:
        framed[_in_frame(columns, one)[0]] += 1
    around = np.flatnonzero(framed >= len(silhouettes) / 4)
    if len(around) < 2:
        return np.zeros(len(points), dtype=bool)
    step = spacing(in_object[around])
    for one in silhouettes:
        rows, pixels, depth = _in_frame(columns, one)
        seen = ~_hidden(pixels, depth, step, one)
        rows, pixels = rows[seen], pixels[seen]
        shown[rows] += 1
        inside[rows] += one.mask[pixels[:, 1], pixels[:, 0]]
    return (framed >= len(silhouettes) / 4) & (shown >= 3) & (inside >= min_share * shown)


def _in_frame(points: Columns, one: Silhouette) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """Rows of the points in a photo's frame, their pixels (K, 2) and depths (K,)."""
    height, width = one.mask.shape
    x, y, z = points
    u, v, depth = (a * x + b * y + c * z + d for a, b, c, d in one.projection.astype(np.float32))
    rows = np.flatnonzero((depth > 0) & (u >= 0) & (u < width * depth) & (v >= 0) & (v < height * depth))
    depth = depth[rows]
    pixels = np.stack([u[rows] / depth, v[rows] / depth], axis=1).astype(np.int64)
    # A quotient may round up to the edge.
    return rows, np.minimum(pixels, [width - 1, height - 1]), depth


def _hidden(pixels: NDArray[np.int64], depth: NDArray[np.float32], step: float, one: Silhouette) -> NDArray[np.bool_]:
    """Which points lie behind a nearer one in the same cell of a photo; a cell is four spacings of the points wide."""
    if len(depth) == 0:
        return np.zeros(0, dtype=bool)
    size = CELL_SPACINGS * step
    cell = max(1, int(np.ceil(size * np.linalg.norm(one.projection[0, :3]) / np.median(depth))))
    key = (pixels[:, 1] // cell) * (one.mask.shape[1] // cell + 1) + pixels[:, 0] // cell
    nearest = np.full(key.max() + 1, np.inf, dtype=np.float32)
    np.minimum.at(nearest, key, depth)
    return depth > nearest[key] + HIDDEN_CELLS * size
