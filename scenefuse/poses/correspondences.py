"""Which pixels of two photos show the same point: SIFT matches that one relative pose explains, and their depths.

Two photos of known intrinsics and M matches fix the motion between them up to its length (essential matrix, Longuet-
Higgins 1981; five-point solver in MAGSAC++, Barath et al. 2020), and each match's depths in units of that length.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

Array = NDArray[np.float64]

# SIFT's least contrast: half of OpenCV's shipped value, for surfaces with little texture.
CONTRAST = 0.02
# A match's distance over that of the next best feature (Lowe 2004).
MAX_RATIO = 0.8
# Largest distance of a match from its epipolar line.
MAX_EPIPOLAR_PX = 1.0
# Two rays that meet under a smaller angle give no depth.
MIN_ANGLE_DEG = 1.5


@dataclass(frozen=True)
class PhotoFeatures:
    """SIFT features of one photo.

    Attributes:
        pixels: (F, 2) float64 column and row, pixel centres at +0.5.
        rays: (F, 2) float64, K^-1 pixel: the point at depth 1 in the camera's frame.
        descriptors: (F, 128) float32, RootSIFT (Arandjelovic and Zisserman 2012), unit length.
        focal_px: of the photo.
    """

    pixels: Array
    rays: Array
    descriptors: NDArray[np.float32]
    focal_px: float


@dataclass(frozen=True)
class TwoViewPair:
    """Two photos that share M points.

    Attributes:
        first: index of a photo.
        second: index of a later photo.
        rows: (M, 2) rows of the matched features in both photos.
        rotation: (3, 3) second_from_first.
        direction: (3,) unit length: x_in_second = rotation @ x_in_first + baseline * direction.
        depths: (M, 2) depth of each match in both photos, in baselines.
    """

    first: int
    second: int
    rows: NDArray[np.int64]
    rotation: Array
    direction: Array
    depths: Array


def find_features(image: NDArray[np.uint8], intrinsics: Array, count: int) -> PhotoFeatures:
    """The `count` strongest SIFT features of an (H, W, 3) RGB photo."""
    sift = cv2.SIFT.create(nfeatures=count, contrastThreshold=CONTRAST)
    found, descriptors = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
    focal_px = float(intrinsics[0, 0])
    if not found:
        return PhotoFeatures(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 128), np.float32), focal_px)
    pixels = np.array([feature.pt for feature in found]) + 0.5
    rays = np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(intrinsics).T
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return PhotoFeatures(pixels, rays[:, :2] / rays[:, 2:], root.astype(np.float32), focal_px)


def find_pairs(
    features: list[PhotoFeatures], min_matches: int, max_epipolar_px: float = MAX_EPIPOLAR_PX
) -> Iterator[TwoViewPair]:
    """All pairs of photos with at least `min_matches` matches that one relative pose explains.

    Args:
        features: of every photo.
        min_matches: fewer matches make no pair.
        max_epipolar_px: largest distance of a match from its epipolar line.
    """
    for i, j in combinations(range(len(features)), 2):
        rows = match(features[i].descriptors, features[j].descriptors)
        if len(rows) < min_matches:
            continue
        a, b = features[i].rays[rows[:, 0]], features[j].rays[rows[:, 1]]
        tolerance = 2.0 * max_epipolar_px / (features[i].focal_px + features[j].focal_px)
        essential, inliers = cv2.findEssentialMat(a, b, np.eye(3), cv2.USAC_MAGSAC, 0.9999, tolerance)
        if essential is None or essential.shape != (3, 3):
            continue
        kept = inliers.ravel() > 0
        rows, a, b = rows[kept], a[kept], b[kept]
        if len(rows) < min_matches:
            continue
        motion = cv2.recoverPose(essential, a, b, np.eye(3))
        rotation, direction = np.asarray(motion[1], np.float64), np.asarray(motion[2], np.float64)[:, 0]
        depths, angle_deg = two_view_depths(a, b, rotation, direction)
        good = (depths > 0).all(1) & (angle_deg > MIN_ANGLE_DEG)
        if good.sum() >= min_matches:
            yield TwoViewPair(i, j, rows[good], rotation, direction, depths[good])


def match(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.int64]:
    """(M, 2) rows of unit descriptors that are each other's nearest, and pass the ratio test (Lowe 2004) forwards."""
    if min(len(first), len(second)) < 2:
        return np.zeros((0, 2), np.int64)
    similarity = torch.from_numpy(first) @ torch.from_numpy(second).T
    (best, next_best), (there, _) = (x.T for x in similarity.topk(2, dim=1))
    back = similarity.argmax(0)
    squared = MAX_RATIO**2
    good = (2 - 2 * best < squared * (2 - 2 * next_best)) & (back[there] == torch.arange(len(first)))
    rows = torch.nonzero(good)[:, 0]
    return torch.stack([rows, there[rows]], 1).numpy()


def two_view_depths(a: Array, b: Array, rotation: Array, translation: Array) -> tuple[Array, Array]:
    """Depths (M, 2) at which two rays pass closest, and the angle (M,) between them in degrees.

    Args:
        a: (M, 2) points at depth 1 in the first camera.
        b: (M, 2) likewise in the second.
        rotation: (3, 3) second_from_first.
        translation: (3,) of the same transform.
    """
    p = np.column_stack([a, np.ones(len(a))]) @ rotation.T
    q = np.column_stack([b, np.ones(len(b))])
    pp, qq, pq = (p * p).sum(1), (q * q).sum(1), (p * q).sum(1)
    pt, qt = p @ translation, q @ translation
    # least squares of || z_q q - z_p p - t ||; the determinant is that of the normal equations
    determinant = np.maximum(pp * qq - pq**2, 1e-15)
    depths = np.column_stack([(pq * qt - qq * pt) / determinant, (pp * qt - pq * pt) / determinant])
    angle = np.degrees(np.arcsin(np.sqrt(np.clip(determinant / (pp * qq), 0.0, 1.0))))
    return depths, angle
