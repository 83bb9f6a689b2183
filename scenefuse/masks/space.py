"""The space that masks leave to the object while they are carried on: it bounds what has no sparse points.

Source: Laurentini 1994 (visual hull), of the masks made so far.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from scenefuse.core.transforms import Array
from scenefuse.geometry.visual_hull import (
    NO_POINTS,
    Box,
    Hull,
    Mask,
    Outline,
    count_silhouettes,
    least_framing,
    mask_iou,
    silhouette,
)
from scenefuse.masks.grabcut import fill_hull
from scenefuse.masks.votes import SURE, Voter, central, shares_of
from scenefuse.photos.workspace import View, Workspace

VOXELS = 72
"""Along the longest side of the grid: a box around the object asks for no more."""
DRAWN_PX = 480
"""Longer side at which the space is drawn, likewise."""
REACH = 0.5
"""Growth of the grid beyond the points known to be the object's on each side, as a share of their diagonal: parts
without texture have none."""
LEAST_POINTS = 4
"""Points that a grid surrounds."""
LEAST_VOTERS = 3
"""Photos whose masks leave a bounded space."""
TOLERANCE = 0.34
"""Share of the masks that may lack a voxel: a third of them may be wrong there."""
UNSHOWN, SHOWN, MISSED = 0, 1, 2


@dataclass(frozen=True)
class Left:
    """The space that masks leave, as a photo sees it.

    Attributes:
        mask: (H, W) the space.
        told: (H, W) where the grid reaches: of what is beside it nothing is known.
    """

    mask: Mask
    told: Mask

    @property
    def box(self) -> Array:
        """(2, 2) corners of the box around it, upper left first."""
        rows, columns = np.flatnonzero(self.mask.any(1)), np.flatnonzero(self.mask.any(0))
        return np.array([[columns[0], rows[0]], [columns[-1] + 1, rows[-1] + 1]], dtype=np.float64)

    def beyond(self, mask: Mask) -> float:
        """Share of a mask (H, W) that is off it."""
        return float((mask & self.told & ~self.mask).sum() / mask.sum()) if mask.any() else 0.0

    def filled(self, mask: Mask) -> float:
        """IoU of a mask (H, W) with it."""
        return mask_iou(mask & self.told, self.mask & self.told)


class Space:
    """Voxels around the object, and what each photo's mask says of them.

    The grid is laid anew whenever the voting photos have doubled: the points that are known to be the object's, which
    it surrounds, are few in the beginning.
    """

    def __init__(self, photos: Workspace) -> None:
        """Nothing is known yet."""
        self._photos = photos
        self._voters = 0
        self._own = NO_POINTS
        self._grid: tuple[Box, Array, float, tuple[int, ...]] | None = None
        self._said: dict[int, tuple[Voter, NDArray[np.uint8]]] = {}

    def left(self, k: int, made: dict[int, Voter]) -> Left | None:
        """What the masks of the voting photos but photo k leave; None where these are few or leave nothing."""
        others = {row: voter for row, voter in made.items() if row != k and voter.votes}
        if len(others) < LEAST_VOTERS or not self._laid(others):
            return None
        assert self._grid is not None
        box, centres, voxel, shape = self._grid
        shown, missed = (np.zeros(len(centres), dtype=np.int32) for _ in range(2))
        for row, voter in others.items():
            says = self._says(row, voter, centres)
            shown += says != UNSHOWN
            missed += says == MISSED
        views = [replace(self._photos.views[row], pixels=voter.mask) for row, voter in others.items()]
        free = ((shown >= least_framing(views, self._own)) & (missed <= TOLERANCE * shown)).reshape(shape)
        # Thin parts pass between the voxels' centres.
        free = ndimage.binary_dilation(free)
        shell = free & ~ndimage.binary_erosion(free)
        return _drawn(Hull(centres[shell.ravel()], voxel, float(free.mean())), box, self._photos.views[k])

    def _says(self, row: int, voter: Voter, centres: Array) -> NDArray[np.uint8]:
        """(N,) what a photo's mask says of each voxel; kept while the mask is the same."""
        known = self._said.get(row)
        if known is None or known[0] is not voter:
            view = replace(self._photos.views[row], pixels=voter.mask)
            counts = count_silhouettes(centres.astype(np.float32), [Outline(view)])
            says = np.where(counts.missed > 0, MISSED, np.where(counts.shown > 0, SHOWN, UNSHOWN)).astype(np.uint8)
            known = self._said[row] = voter, says
        return known[1]

    def _laid(self, voters: dict[int, Voter]) -> bool:
        """Whether there is a grid, laid anew if the voting photos have doubled."""
        if self._grid is not None and len(voters) < 2 * self._voters:
            return True
        self._own = self._photos.points[shares_of(self._photos, voters) >= SURE]
        placed = [voter.clicks.placed for voter in voters.values()]
        placed.append(central(self._own))
        points = np.concatenate([np.zeros((0, 3)), *placed])
        grow = REACH * float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) >= LEAST_POINTS else 0.0
        if grow == 0.0:
            return False
        box = Box(np.eye(3, 4), points.min(0) - grow, points.max(0) + grow)
        voxel = float((box.high - box.low).max()) / VOXELS
        shape = np.maximum(np.ceil((box.high - box.low) / voxel).astype(int), 1)
        index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
        self._grid, self._voters, self._said = (
            (box, box.low + (index + 0.5) * voxel, voxel, tuple(shape)),
            len(voters),
            {},
        )
        return True


def _drawn(hull: Hull, box: Box, view: View) -> Left | None:
    """A hull as a photo sees it; None where it is not in its frame."""
    scale = min(1.0, DRAWN_PX / max(view.width, view.height))
    width, height = max(1, round(scale * view.width)), max(1, round(scale * view.height))
    resize = np.diag([width / view.width, height / view.height, 1.0])
    small = replace(view, intrinsics=resize @ view.intrinsics, width=width, height=height, pixels=None)
    space, told = silhouette(hull, small), np.ones((height, width), dtype=np.uint8)
    pixels, depth = small.project(box.corners())
    if (depth > 0).all():
        told[:] = 0
        fill_hull(told, pixels, 1)
    if not space.any():
        return None
    size = (view.width, view.height)
    mask, known = (cv2.resize(a.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0 for a in (space, told))
    return Left(mask, known) if mask.any() else None
