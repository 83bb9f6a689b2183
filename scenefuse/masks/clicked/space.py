"""The space that masks leave to the object while they are carried on: it bounds what has no sparse points."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.masks.clicked.votes import SURE, Voter, shares_of
from scenefuse.mvs.visual_hull import Hull, Mask, Outline, count_silhouettes, silhouette
from scenefuse.transforms import Array
from scenefuse.workspace import Workspace

VOXELS = 72
"""Along the longest side of the grid: a box around the object asks for no more."""
REACH = 0.5
"""Growth of the grid beyond the points known to be the object's on each side, as a share of their diagonal: parts
without texture have none."""
OUTERMOST = 1.0
"""Percentage of these points that are taken for mismatched at each side."""
LEAST_VOTERS = 3
"""Photos whose masks leave a bounded space."""
TOLERANCE = 0.34
"""Share of the masks that may lack a voxel: a third of them may be wrong there."""


class Space:
    """Voxels around the object, and what each photo's mask says of them.

    The grid is laid anew whenever the voting photos have doubled: the points that are known to be the object's, which
    it surrounds, are few in the beginning.
    """

    def __init__(self, photos: Workspace) -> None:
        """Nothing is known yet."""
        self._photos = photos
        self._voters = 0
        self._grid: tuple[Array, float, tuple[int, ...]] | None = None
        self._said: dict[int, tuple[Voter, NDArray[np.bool_], NDArray[np.bool_]]] = {}

    def outline(self, k: int, made: dict[int, Voter]) -> Mask | None:
        """The space left by the masks of the voting photos but photo k, as k sees it, (H, W); None where these are few
        or leave nothing."""
        others = {row: voter for row, voter in made.items() if row != k and voter.votes}
        if len(others) < LEAST_VOTERS or not self._laid(others):
            return None
        assert self._grid is not None
        centres, voxel, shape = self._grid
        shown, missed = (np.zeros(len(centres), dtype=np.int32) for _ in range(2))
        for row, voter in others.items():
            known = self._said.get(row)
            if known is None or known[0] is not voter:
                view = replace(self._photos.views[row], pixels=voter.mask)
                counts = count_silhouettes(centres.astype(np.float32), [Outline(view)])
                known = self._said[row] = voter, counts.shown > 0, counts.missed > 0
            shown += known[1]
            missed += known[2]
        left = ((shown >= max(2, len(others) // 4)) & (missed <= TOLERANCE * shown)).reshape(shape)
        # Thin parts pass between the voxels' centres.
        left = ndimage.binary_dilation(left)
        shell = left & ~ndimage.binary_erosion(left)
        found = silhouette(Hull(centres[shell.ravel()], voxel, float(left.mean())), self._photos.views[k])
        return found if found.any() else None

    def _laid(self, voters: dict[int, Voter]) -> bool:
        """Whether there is a grid, laid anew if the voting photos have doubled."""
        if self._grid is not None and len(voters) < 2 * self._voters:
            return True
        own = self._photos.points[shares_of(self._photos, voters) >= SURE]
        placed = [voter.clicks.placed for voter in voters.values()]
        if len(own):
            low, high = np.percentile(own, [OUTERMOST, 100 - OUTERMOST], axis=0)
            placed.append(own[((own >= low) & (own <= high)).all(1)])
        points = np.concatenate([np.zeros((0, 3)), *placed])
        if len(points) < 2:
            return False
        grow = REACH * np.linalg.norm(np.ptp(points, axis=0))
        low, high = points.min(0) - grow, points.max(0) + grow
        voxel = float((high - low).max()) / VOXELS
        shape = np.maximum(np.ceil((high - low) / voxel).astype(int), 1)
        index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
        self._grid, self._voters, self._said = (low + (index + 0.5) * voxel, voxel, tuple(shape)), len(voters), {}
        return True


def beyond(mask: Mask, space: Mask | None) -> float:
    """Share of a mask (H, W) that is off the space that others leave; 0 where they leave none in particular."""
    return float((mask & ~space).sum() / mask.sum()) if space is not None and mask.any() else 0.0
