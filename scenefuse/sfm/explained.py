"""How many of the verified matches a model explains: which of two models is right, and which photos stand wrong in one.

A photo that stands in a wrong place has a small reprojection error there, for what contradicts it is no longer part of
the model; its matches still are.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.sfm.colmap import MAX_REPROJECTION_ERROR_PX

# Matches that chance hardly gives a pair: as many as COLMAP needs to place a photo. Between leaves, guided matching
# along a wrong epipolar line finds 15 to 20.
STRONG_PAIR = pycolmap.IncrementalMapperOptions().abs_pose_min_num_inliers
# Share of the matches of a photo's strong pairs that the model explains where the photo stands right. A sculpture alike
# from two sides leaves 0.76; in models with a group of frames in wrong places some had 0.28 to 0.66.
MIN_EXPLAINED = 0.7


@dataclass(frozen=True)
class Explained:
    """What a model says of each verified pair.

    Attributes:
        pairs: (P, 2) numbers of photos.
        matches: (P,) verified matches.
        explained: (P,) of these, how many lie on the epipolar lines of the model; 0 where a photo is not in it.
        placed: (P,) whether both photos are in the model.
    """

    pairs: NDArray[np.int64]
    matches: NDArray[np.int64]
    explained: NDArray[np.int64]
    placed: NDArray[np.bool_]

    @property
    def total(self) -> int:
        """Matches that the model explains."""
        return int(self.explained.sum())

    def shares(self) -> dict[int, float]:
        """Of each photo in strong pairs of the model's photos, the share of their matches that the model explains."""
        strong = (self.matches >= STRONG_PAIR) & self.placed
        shares = {}
        for photo in np.unique(self.pairs[strong]):
            own = strong & (self.pairs == photo).any(1)
            shares[int(photo)] = float(self.explained[own].sum() / self.matches[own].sum())
        return shares


def explained_matches(model: pycolmap.Reconstruction, database: Path) -> Explained:
    """Compare the verified matches of a COLMAP database with the epipolar geometry of a model (Sampson's error).

    Args:
        model: the model; photos are those of the database, by their numbers.
        database: COLMAP database with verified matches.
    """
    with pycolmap.Database.open(database) as opened:
        ids, _ = opened.read_two_view_geometry_num_inliers()
        pairs = np.array([pycolmap.pair_id_to_image_pair(i) for i in ids], dtype=np.int64).reshape(-1, 2)
        inside = set(model.reg_image_ids())
        placed: NDArray[np.bool_] = np.asarray(np.isin(pairs, list(inside)).all(axis=1))
        rays = {i: _rays(model, i, np.asarray(opened.read_keypoints(i))[:, :2]) for i in inside}
        matches, explained = np.zeros(len(pairs), np.int64), np.zeros(len(pairs), np.int64)
        for k, (a, b) in enumerate(pairs.tolist()):
            found = np.asarray(opened.read_two_view_geometry(a, b).inlier_matches, dtype=np.int64).reshape(-1, 2)
            matches[k] = len(found)
            if placed[k]:
                off = _sampson(model, a, b, rays[a][found[:, 0]], rays[b][found[:, 1]])
                explained[k] = np.count_nonzero(off <= MAX_REPROJECTION_ERROR_PX)
    return Explained(pairs, matches, explained, placed)


def doubtful_photos(model: pycolmap.Reconstruction, found: Explained) -> dict[str, float]:
    """Photos of a model that may stand in wrong places, by name, with the share of their matches that it explains.

    Each has too small a share: where that lies at a wrong neighbour, the neighbour's own share is hardly touched.
    """
    shares = {model.images[i].name: share for i, share in found.shares().items()}
    return {name: round(share, 3) for name, share in sorted(shares.items()) if share < MIN_EXPLAINED}


def _rays(model: pycolmap.Reconstruction, photo: int, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """(N, 3) viewing rays of pixels in a photo's camera, with z 1."""
    flat = np.asarray(model.cameras[model.images[photo].camera_id].cam_from_img(pixels.astype(np.float64)))
    return np.column_stack([flat.reshape(-1, 2), np.ones(len(pixels))])


def _sampson(
    model: pycolmap.Reconstruction, one: int, other: int, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N,) distances in pixels of matched rays x (N, 3) and y (N, 3) to the epipolar lines of two photos of a model."""
    images = model.images[one], model.images[other]
    moved = images[1].cam_from_world() * images[0].cam_from_world().inverse()
    essential = np.cross(moved.translation, moved.rotation.matrix(), axisb=0, axisc=0)  # [t]x R
    lines, back = x @ essential.T, y @ essential
    slope = np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    focal = np.mean([model.cameras[image.camera_id].mean_focal_length() for image in images])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(focal * np.abs((y * lines).sum(1)) / slope)
