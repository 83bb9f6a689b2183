"""Which points of a scene an object's masks vote for, seen through the object's cameras and a known similarity."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.io.clouds import spacing
from scenefuse.stage import StageError, threads
from scenefuse.transforms import Array, Sim3

Columns = tuple[NDArray[np.float32], ...]

MOST_PHOTOS = 60
SLACK = 0.005
CELL_SPACINGS = 4
HIDDEN_CELLS = 2
NEAR_OWN = 0.15
MIN_OWN = 10


@dataclass(frozen=True)
class Silhouette:
    """The object's mask in one photo, (H, W) bool, and the camera, (3, 4) pixels from the object's frame."""

    mask: NDArray[np.bool_]
    projection: Array


@dataclass(frozen=True)
class Votes:
    """What an object's masks say of points of the scene.

    Attributes:
        object: (N,) bool, True for points of the object.
        other: (N,) bool, True for points of something else; what no photo tells is neither.
        own: (K, 3) SfM points of the object's photos on the object, in the scene frame.
    """

    object: NDArray[np.bool_]
    other: NDArray[np.bool_]
    own: Array


def vote(points: Array, cameras: Path, masks: Path, scene_from_object: Sim3, min_share: float) -> Votes:
    """Look at every point of a scene through an object's masks.

    A photo has a say on a point that falls into its frame and that no nearer scene point hides; three of them make a
    decision. A point is the object's when at least `min_share` of them have it inside their mask, a quarter of all
    photos frame it, and one of the object's own SfM points is near; something else's when most have it outside.

    Args:
        points: (N, 3) in the scene frame.
        cameras: undistorted COLMAP workspace of the object.
        masks: folder of {name}.png, non-zero on the object.
        scene_from_object: the similarity.
        min_share: of the photos that have a say, how many must have a point inside the mask.

    Raises:
        StageError: too few photos have a mask, or too few SfM points lie inside.
    """
    silhouettes, own = read_silhouettes(cameras, masks, min_share)
    in_object = scene_from_object.inverse().apply(points)
    framed, shown, inside = count(in_object, silhouettes)
    told = shown >= 3
    is_object = told & (framed >= len(silhouettes) / 4) & (inside >= min_share * shown)
    rows = np.flatnonzero(is_object)
    reach = NEAR_OWN * float(np.linalg.norm(np.ptp(own, axis=0)))
    is_object[rows] = cKDTree(own).query(in_object[rows], workers=threads())[0] <= reach
    return Votes(is_object, told & (inside < 0.5 * shown), scene_from_object.apply(own))


def read_silhouettes(cameras: Path, masks: Path, min_share: float) -> tuple[list[Silhouette], Array]:
    """Masks and cameras of at most 60 of an object's photos, spread evenly, and the SfM points (K, 3) on the object.

    Masks are grown by 0.5 % of the photo's width, for what the similarity and the masks err by at outlines. An SfM
    point is on the object when it is inside the mask in `min_share` of the photos that observe it, three or more; the
    outermost 1 % on each side are left out.

    Args:
        cameras: undistorted COLMAP workspace of the object.
        masks: folder of {name}.png, non-zero on the object.
        min_share: see `vote`.

    Raises:
        StageError: too few photos have a mask, or too few SfM points lie inside.
    """
    model = pycolmap.Reconstruction(cameras / "sparse")
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: image.name)
    files = [(image, masks / f"{Path(image.name).stem}.png") for image in images]
    files = [(image, path) for image, path in files if path.is_file()]
    if len(files) < 3:
        raise StageError(f"{len(files)} photos of {cameras} have a mask in {masks}, three are needed; rerun the masks")
    row_of = {point: row for row, point in enumerate(sorted(model.points3D))}
    sparse = np.array([model.points3D[point].xyz for point in row_of]).reshape(-1, 3)
    seen, inside = (np.zeros(len(sparse), dtype=np.int32) for _ in range(2))
    found = []
    chosen = np.unique(np.linspace(0, len(files) - 1, min(MOST_PHOTOS, len(files))).round().astype(int))
    for image, path in (files[k] for k in chosen):
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if mask is None:
            raise StageError(f"{path} cannot be read; rerun the masks")
        extent = 2 * int(np.ceil(SLACK * mask.shape[1])) + 1
        grown = cv2.dilate(mask, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (extent, extent)))
        camera = model.cameras[image.camera_id].calibration_matrix()
        one = Silhouette(grown > 0, camera @ image.cam_from_world().matrix())
        found.append(one)
        observed = np.array(sorted({row_of[p.point3D_id] for p in image.get_observation_points2D()}), dtype=np.int64)
        rows, pixels, _ = _in_frame(_columns(sparse[observed]), one)
        seen[observed[rows]] += 1
        inside[observed[rows]] += one.mask[pixels[:, 1], pixels[:, 0]]
    own = sparse[(seen >= 3) & (inside >= min_share * seen)]
    if len(own) < MIN_OWN:
        raise StageError(
            f"only {len(own)} SfM points of {cameras} lie inside the masks of {masks}, {MIN_OWN} are needed; look at"
            " the masks, and take sharper photos of the object"
        )
    low, high = np.percentile(own, [1, 99], axis=0)
    return found, own[((own >= low) & (own <= high)).all(1)]


def count(
    in_object: Array, silhouettes: list[Silhouette]
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """How many photos frame each of (N, 3) points, show it unhidden, and have it inside the mask then."""
    columns = _columns(in_object)
    framed, shown, inside = (np.zeros(len(in_object), dtype=np.int32) for _ in range(3))
    for one in silhouettes:
        framed[_in_frame(columns, one)[0]] += 1
    around = np.flatnonzero(framed >= len(silhouettes) / 4)
    if len(around) < 2:
        return framed, shown, inside
    step = spacing(in_object[around])
    for one in silhouettes:
        rows, pixels, depth = _in_frame(columns, one)
        unhidden = ~_hidden(pixels, depth, step, one)
        rows, pixels = rows[unhidden], pixels[unhidden]
        shown[rows] += 1
        inside[rows] += one.mask[pixels[:, 1], pixels[:, 0]]
    return framed, shown, inside


def _columns(points: Array) -> Columns:
    return tuple(np.ascontiguousarray(points.T, dtype=np.float32))


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
