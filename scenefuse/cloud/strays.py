"""Points that are none of a cloud: strays far from all others, and what scanners write at 0 0 0."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, voxel_downsample, voxels
from scenefuse.cloud.readers.columns import AT_ONCE, MAX_ODD_SHARE
from scenefuse.core.stage import threads

# Points below this percentile along an axis, and above the same on the other side, do not say how far a cloud reaches.
STRAY_PERCENT = 1.0
# Neighbours of a point that has company.
NEIGHBOURS = 8
# A stray's neighbours are farther than this share of the cloud's diagonal, and than so many times the usual distance;
# so many sizes of a cloud away from it, nothing is a part of it.
MIN_STRAY_SHARE, MIN_STRAY_TIMES = 0.02, 10.0
# In sizes of the box: cubes in which more points than a stray has neighbours are a part of the cloud, and by which a
# box has to grow.
COARSE_CUBE = 0.25


def is_nothing_at_zero(others: NDArray[np.float64], zeros: int) -> bool:
    """Whether so many points at 0 0 0 are none of a cloud: more than a place has neighbours, or its other points (N, 3)
    but strays lie far from there. Scanners write so what returned nothing."""
    if not zeros or not len(others):
        return False
    if zeros > NEIGHBOURS:
        return True
    low, high = np.percentile(others, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
    away = np.linalg.norm(np.maximum(np.maximum(low, -high), 0))
    return bool(away > MIN_STRAY_TIMES * np.linalg.norm(high - low))


def strays(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of (N, 3) points lie far from all others, N as many as one looks through at once.

    Outside the box around most of them, grown by its size on each side; or with the eighth neighbour farther away than
    2 % of that box's diagonal, and ten times as far as the median of points on an even grid, so that a part which was
    measured densely does not stand for all. None, if they are many.
    """
    low, high, near, together = _box_of_most(points)
    far, size = np.ones(len(points), dtype=bool), float((high - low).max())
    far[near] = False
    if len(near) > NEIGHBOURS and size:
        tree, parts = cKDTree(points[near]), np.array_split(points[near], 1 + len(near) // AT_ONCE)
        away = np.concatenate([tree.query(part, k=NEIGHBOURS + 1, workers=threads())[0][:, -1] for part in parts])
        evenly = voxel_downsample(Cloud(points[near], fields={"away": away})[together], MIN_STRAY_SHARE * size)
        usual = float(np.median(evenly.fields["away"])) if len(evenly) else np.inf
        far[near] = away > max(MIN_STRAY_SHARE * float(np.linalg.norm(high - low)), MIN_STRAY_TIMES * usual)
    return far if far.mean() <= MAX_ODD_SHARE else np.zeros(len(points), dtype=bool)


def _box_of_most(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Corners (3,) of the box around most of (N, 3) points, the rows (M,) in the box grown by its size on each side,
    and which of these lie among others.

    It begins as that of the middle 98 %, which may all lie in a part that was measured densely; while there are clearly
    larger ones, it becomes the box of those in the grown box that lie among others.
    """
    low, high = np.percentile(points, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
    while True:
        size = float((high - low).max())
        near = np.flatnonzero(((points >= low - size) & (points <= high + size)).all(1))
        group, counts = voxels(points[near], COARSE_CUBE * size or 1.0)
        together = counts[group] > NEIGHBOURS
        part = points[near[together]]
        ends = part.min(0, initial=np.inf), part.max(0, initial=-np.inf)
        if np.maximum(low - ends[0], ends[1] - high).max() <= COARSE_CUBE * size:
            return low, high, near, together
        low, high = np.minimum(low, ends[0]), np.maximum(high, ends[1])


def without_strays(cloud: Cloud, what: str) -> tuple[Cloud, list[str]]:
    """The cloud without its strays, and a note, if there are any, in which the cloud is called `what`."""
    far = strays(cloud.points)
    if not far.any():
        return cloud, []
    return cloud[np.flatnonzero(~far)], [f"{far.sum()} points of {what}, far from all others, are left out"]
