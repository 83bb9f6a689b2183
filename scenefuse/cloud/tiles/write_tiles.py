"""Clouds of any size written as tiles, in two passes over their parts: count the points of each cell, then put every
point in its place."""

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, records_of
from scenefuse.cloud.tiles.ply_header import Element, header_of
from scenefuse.cloud.tiles.tiled_cloud import BOX, ROW_OF_TILE, TILE, WHOLE, Rows
from scenefuse.core.stage import StageError, atomic_file
from scenefuse.core.transforms import Array

Parts = Callable[[], Iterable[Cloud]]
"""Gives the parts of a cloud, the same ones each time."""
POINTS_A_CELL, MOST_CELLS = 1 << 10, 1 << 20
"""The box of a cloud is divided into one cell for so many points, and no more cells than that; most are empty."""
BITS = 20
"""Of a cell's place along an axis, at most."""
STRAY_PERCENT = 0.1
"""Points outside this percentile of a sample on each side lie in the outermost cells: strays far off widen none."""


def write_tiled(path: Path, parts: Parts, count: int, sample: Array) -> None:
    """Write a cloud as `open_cloud` reads it; one of more than WHOLE points is sorted along a Morton curve of cells.

    Points of a cell keep their order. The space on the disk is reserved first.

    Args:
        path: output PLY, columns as of `write_cloud`.
        parts: all with the same columns.
        count: of all points.
        sample: (S, 3) some of them, spread evenly.

    Raises:
        StageError: the disk has too little space, or the parts do not hold as many points.
    """
    grid = _Grid.of(sample, count)
    counts, like = np.zeros(len(grid.rank), np.int64), None
    for part in parts():
        counts += np.bincount(grid.cells(part.points), minlength=len(counts))
        like = part if like is None else like
    if like is None or counts.sum() != count:
        raise StageError(
            f"{path} was to hold {count} points and has {counts.sum()}: its source changes; run this again"
        )
    begins = np.cumsum(counts) - counts
    tile_of, occupied = np.zeros(len(counts), np.int64), counts > 0
    slots = begins[occupied] // (TILE if count > WHOLE else count)
    tiles, tile_of[occupied] = np.unique(slots, return_inverse=True)
    table = np.zeros(len(tiles), ROW_OF_TILE)
    table["count"] = np.bincount(tile_of, counts, len(tiles))
    low, high = np.full((len(tiles), 3), np.inf), np.full((len(tiles), 3), -np.inf)
    row = records_of(like, path).dtype
    with reserved(path, row, count, len(tiles)) as (file, offset):
        for part in (part for part in parts() if len(part)):
            cells = grid.cells(part.points)
            order = np.argsort(cells, kind="stable")
            records, points, cells = records_of(part, path)[order], part.points[order], cells[order]
            first = np.flatnonzero(np.diff(cells, prepend=-1))
            np.minimum.at(low, tile_of[cells[first]], np.minimum.reduceat(points, first))
            np.maximum.at(high, tile_of[cells[first]], np.maximum.reduceat(points, first))
            for cell, start, end in zip(cells[first], first, np.append(first[1:], len(cells))):
                file.seek(offset + int(begins[cell]) * row.itemsize)
                file.write(records[start:end].tobytes())
                begins[cell] += end - start
        for name, values in zip(BOX, np.concatenate([low, high], axis=1).T):
            table[name] = values
        file.seek(offset + count * row.itemsize)
        file.write(table.tobytes())


@contextmanager
def reserved(path: Path, row: np.dtype[Any], count: int, tiles: int = 0) -> Iterator[tuple[BinaryIO, int]]:
    """A PLY of so many points and tiles with its header written and its space reserved, and where its points begin.

    Without tiles it is a PLY like any other.

    It gets its name when everything is written.

    Raises:
        StageError: the disk has too little space.
    """
    elements = [Element("vertex", count, row), Element("tile", tiles, ROW_OF_TILE)]
    header = header_of(elements if tiles else elements[:1])
    size = len(header) + count * row.itemsize + tiles * ROW_OF_TILE.itemsize
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        file.write(header)
        file.flush()
        free = shutil.disk_usage(temporary.parent).free
        if size > free:
            raise StageError(
                f"the disk is too full for {path}: it needs {size / 1e9:.3g} GB and {free / 1e9:.3g} GB are free; free"
                " some space and run this again"
            )
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        yield file, len(header)


@dataclass(frozen=True)
class _Grid:
    """Cubes that divide a box; the place of each along a Morton curve (Morton 1966) is its number.

    Attributes:
        low: (3,) corner of the box.
        side: of a cube.
        shape: (3,) cubes along x, y, z.
        rank: (C,) place of each, counted along z first.
    """

    low: Array
    side: float
    shape: Rows
    rank: Rows

    @staticmethod
    def of(sample: Array, count: int) -> "_Grid":
        """About a sample (S, 3) of so many points; one cell for a cloud that stays in its order."""
        low, high = np.percentile(sample, [STRAY_PERCENT, 100 - STRAY_PERCENT], axis=0)
        most = min(MOST_CELLS, count // POINTS_A_CELL) if count > WHOLE else 1
        side, shape = max(float((high - low).max()), 1e-300), np.ones(3, np.int64)
        for _ in range(BITS):
            finer = np.ceil((high - low) / (side / 2)).astype(np.int64).clip(1)
            if finer.prod() > most:
                break
            side, shape = side / 2, finer
        index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
        rank = np.empty(len(index), np.int64)
        rank[np.argsort(_morton(index), kind="stable")] = np.arange(len(index))
        return _Grid(low, side, shape, rank)

    def cells(self, points: Array) -> Rows:
        """The numbers (N,) of the cells of points (N, 3); those outside the box are in the outermost ones."""
        index = np.clip((points - self.low) / self.side, 0, self.shape - 1).astype(np.int64)
        return np.asarray(self.rank[(index[:, 0] * self.shape[1] + index[:, 1]) * self.shape[2] + index[:, 2]])


def _morton(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """(C,) places along a Morton curve of cells (C, 3)."""
    keys = np.zeros(len(index), dtype=np.int64)
    for bit in range(BITS):
        for axis in range(3):
            keys |= ((index[:, axis] >> bit) & 1) << (3 * bit + axis)
    return keys
