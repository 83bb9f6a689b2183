"""Guided matching: features of a verified pair are matched again where its geometry lets them lie.

As COLMAP's (Schoenberger, Frahm 2016), with the same tests; descriptors are compared only where the geometry allows, in
place of all with all, which takes a tenth of the time.
"""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import numpy as np
import pycolmap
from numba import njit
from numpy.typing import NDArray

from scenefuse.core.stage import threads

# Descriptors are unit vectors times this, in bytes.
LENGTH = 512
# Photos whose features are kept while their pairs are matched: 0.5 MB each.
KEPT_PHOTOS = 200
Configuration = pycolmap.TwoViewGeometryConfiguration
BY_HOMOGRAPHY = (Configuration.PLANAR, Configuration.PANORAMIC, Configuration.PLANAR_OR_PANORAMIC)
BY_LINES = (Configuration.CALIBRATED, Configuration.UNCALIBRATED)


def match_guided(database: pycolmap.Database, max_error_px: float, max_ratio: float, max_distance: float) -> None:
    """Replace the inliers of every verified pair of a database by its guided matches, where these are more.

    Args:
        database: open, with features, and pairs that COLMAP has verified.
        max_error_px: largest Sampson error, or distance from where a homography puts a feature.
        max_ratio: best over second-best descriptor distance, in either direction.
        max_distance: largest descriptor distance, as an angle in radians.
    """

    @lru_cache(KEPT_PHOTOS)
    def features(image: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        places = np.ascontiguousarray(database.read_keypoints(image)[:, :2], np.float32)
        return places, np.ascontiguousarray(database.read_descriptors(image).data)

    def jobs() -> Iterator[tuple[Any, ...]]:
        for number, count in zip(*database.read_two_view_geometry_num_inliers()):
            a, b = pycolmap.pair_id_to_image_pair(number)
            found = database.read_two_view_geometry(a, b) if count else None
            if found is None or found.config not in (*BY_HOMOGRAPHY, *BY_LINES):
                continue
            planar = found.config in BY_HOMOGRAPHY
            matrix = np.ascontiguousarray(found.H if planar else found.F)
            yield a, b, found, (matrix, planar, *features(a), *features(b), max_error_px**2, max_ratio, max_distance)

    with ThreadPoolExecutor(threads()) as pool:
        # Windows of jobs, so that features of few photos are in memory.
        waiting = list[tuple[Any, ...]]()
        for a, b, found, arguments in jobs():
            waiting.append((a, b, found, pool.submit(_matches, *arguments)))
            if len(waiting) == KEPT_PHOTOS:
                _write(database, waiting)
                waiting.clear()
        _write(database, waiting)


def _write(database: pycolmap.Database, waiting: list[tuple[Any, ...]]) -> None:
    for a, b, found, job in waiting:
        matches = job.result()
        if len(matches) > len(found.inlier_matches):
            found.inlier_matches = matches
            database.update_two_view_geometry(a, b, found)


@njit(nogil=True, cache=True, fastmath=True)
def _matches(matrix, planar, here, words_here, there, words_there, max_square, max_ratio, max_distance):  # type: ignore[no-untyped-def]
    """Mutual best matches (M, 2) of features at here (N, 2) and there (K, 2), descriptors (N, 128) and (K, 128)."""
    count = len(there)
    best, first, second = _nothing(len(here))
    best_there, first_there, second_there = _nothing(count)
    u, v = there[:, 0].copy(), there[:, 1].copy()
    square = np.zeros(count, np.float32)
    if not planar:
        for j in range(count):
            a = matrix[0, 0] * u[j] + matrix[1, 0] * v[j] + matrix[2, 0]
            b = matrix[0, 1] * u[j] + matrix[1, 1] * v[j] + matrix[2, 1]
            square[j] = a * a + b * b
    near = np.empty(count, np.bool_)
    for i in range(len(here)):
        x, y = here[i, 0], here[i, 1]
        a = np.float32(matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2])
        b = np.float32(matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2])
        c = np.float32(matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2])
        if planar:
            a, b = a / c, b / c
            for j in range(count):
                near[j] = (u[j] - a) ** 2 + (v[j] - b) ** 2 <= max_square
        else:
            length = a * a + b * b
            for j in range(count):
                off = a * u[j] + b * v[j] + c
                near[j] = off * off <= max_square * (length + square[j])
        for j in range(count):
            if near[j]:
                dot = np.int32(0)
                for k in range(words_here.shape[1]):
                    dot += np.int32(words_here[i, k]) * np.int32(words_there[j, k])
                if dot > first[i]:
                    best[i], first[i], second[i] = j, dot, first[i]
                else:
                    second[i] = max(second[i], dot)
                if dot > first_there[j]:
                    best_there[j], first_there[j], second_there[j] = i, dot, first_there[j]
                else:
                    second_there[j] = max(second_there[j], dot)
    found = np.empty((len(here), 2), np.uint32)
    size = 0
    for i in range(len(here)):
        j = best[i]
        if j >= 0 and best_there[j] == i:
            angle = _angle(first[i])
            if angle <= max_distance and angle < max_ratio * _angle(max(second[i], second_there[j])):
                found[size, 0], found[size, 1] = i, j
                size += 1
    return found[:size]


@njit(nogil=True)
def _nothing(count):  # type: ignore[no-untyped-def]
    """No best match, and the two largest products of descriptors, of each feature."""
    return np.full(count, -1, np.int64), np.zeros(count, np.int32), np.zeros(count, np.int32)


@njit(nogil=True)
def _angle(dot):  # type: ignore[no-untyped-def]
    """Angle between two descriptors."""
    return np.arccos(min(dot / np.float64(LENGTH * LENGTH), 1.0))
