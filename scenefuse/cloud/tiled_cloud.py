"""The cloud of a scene in tiles: read by place, and written in two passes over its parts.

It is a PLY like any other, whose points lie tile by tile; a second element behind them, `tile`, holds the number of
points and the bounding box of each tile. So a stage reads what is near an object, and the row of a point in the file is
its name. Memory does not grow with the scene.
"""

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, cloud_of, records_of, spacing
from scenefuse.cloud.readers.columns import AT_ONCE
from scenefuse.cloud.readers.ply import Element, check_size, header_of, read_header
from scenefuse.core.stage import StageError, atomic_file
from scenefuse.core.transforms import Array

# Points of a tile, about: what is read in excess around a box is a few of these.
TILE = 1 << 16
# A cloud of up to so many points is one tile and keeps its order: reading all of it takes no longer.
WHOLE = AT_ONCE
BOX = ("low_x", "low_y", "low_z", "high_x", "high_y", "high_z")
# A row of the element `tile`.
ROW_OF_TILE = np.dtype([("count", "<u4"), *((name, "<f8") for name in BOX)])
# The box of a cloud is divided into one cell for so many points; most are empty.
POINTS_A_CELL = 1 << 10
# Places along three axes in one integer.
MORTON_BITS = 21
# Points outside this percentile of a sample on each side lie in the outermost cells: strays far off widen none.
OUTER_PERCENT = 0.1

Rows = NDArray[np.int64]
# Gives the parts of a cloud, the same ones each time.
Parts = Callable[[], Iterable[Cloud]]


@dataclass(frozen=True)
class TiledCloud:
    """A cloud on disk.

    Attributes:
        path: of the PLY.
        row: NumPy type of a point.
        offset: byte where the points begin.
        starts: (T + 1,) first row of each of T tiles, and the number of points.
        low: (T, 3) corner of each tile's bounding box.
        high: (T, 3) opposite corner.
    """

    path: Path
    row: np.dtype[Any]
    offset: int
    starts: Rows
    low: Array
    high: Array

    def __len__(self) -> int:
        return int(self.starts[-1])

    @property
    def like(self) -> Cloud:
        """None of its points, with the columns that it has."""
        return _cloud(np.empty(0, self.row))

    def touching(self, low: Array, high: Array) -> Rows:
        """The tiles whose boxes touch the box from `low` (3,) to `high` (3,); the nearest one where none does."""
        gap = np.maximum(np.maximum(self.low - high, low - self.high), 0).max(1, initial=0)
        return np.flatnonzero(gap <= gap.min()) if len(gap) else np.zeros(0, np.int64)

    def near(self, low: Array, high: Array) -> tuple[Rows, Cloud]:
        """The points of the tiles that touch a box: all in it, and some around it; and their rows (N,) in the file."""
        return self.read(self.touching(low, high))

    def read(self, tiles: Rows) -> tuple[Rows, Cloud]:
        """The points of some tiles (in rising order), and their rows (N,) in the file."""
        runs = np.split(tiles, np.flatnonzero(np.diff(tiles) > 1) + 1) if len(tiles) else []
        spans = [(int(self.starts[run[0]]), int(self.starts[run[-1] + 1])) for run in runs]
        parts = [self._records(first, last) for first, last in spans]
        rows = np.concatenate([np.arange(first, last) for first, last in spans]) if spans else np.zeros(0, np.int64)
        return rows, _cloud(np.concatenate(parts) if parts else np.empty(0, self.row))

    def parts(self, every: int = 1) -> Iterator[tuple[Rows, Cloud]]:
        """All points in the order of the file, AT_ONCE at a time, or every so manyth of them; with their rows (N,)."""
        for first in range(0, len(self), AT_ONCE):
            last = min(first + AT_ONCE, len(self))
            chosen = np.arange(-first % every, last - first, every)
            yield first + chosen, _cloud(self._records(first, last)[chosen])

    def rows(self, rows: Rows) -> Cloud:
        """The points of some rows (N,), in that order."""
        found = np.empty(len(rows), self.row)
        order = np.argsort(rows, kind="stable")
        ends = np.searchsorted(rows[order], np.arange(0, len(self) + AT_ONCE, AT_ONCE))
        for number, (start, end) in enumerate(zip(ends[:-1], ends[1:])):
            chosen = order[start:end]
            if len(chosen):
                first = number * AT_ONCE
                found[chosen] = self._records(first, min(first + AT_ONCE, len(self)))[rows[chosen] - first]
        return _cloud(found)

    def spacing(self, seed: int = 0) -> float:
        """Median distance from a point to its nearest neighbour; of a larger cloud in a few tiles, drawn by points."""
        return float(np.median([spacing(points, seed=seed) for points in self.samples(seed)]))

    def samples(self, seed: int = 0) -> list[Array]:
        """All points (N, 3), or of a larger cloud those of a few tiles, drawn by points."""
        if len(self) <= WHOLE:
            return [self.read(np.arange(len(self.low)))[1].points]
        drawn = np.random.default_rng(seed).integers(0, len(self), 8)
        tiles = np.unique(np.searchsorted(self.starts, drawn, side="right") - 1)
        return [self.read(tiles[k : k + 1])[1].points for k in range(len(tiles))]

    def _records(self, first: int, last: int) -> NDArray[Any]:
        with open(self.path, "rb") as file:
            file.seek(self.offset + first * self.row.itemsize)
            return np.fromfile(file, self.row, last - first)


def open_cloud(path: Path) -> TiledCloud:
    """Open a cloud that a stage wrote; one without tiles is gone through once, and its tiles are runs of its rows.

    Raises:
        StageError: the file is missing, cut short, or not as this project writes clouds.
    """
    path = Path(path)
    elements, offset, is_text = read_header(path)
    row, count = (elements[0].row, elements[0].count) if elements and not is_text else (None, 0)
    if row is None or not {"x", "y", "z"} <= set(row.names or ()):
        raise StageError(f"{path} is no cloud that a stage of this project wrote; delete it and rerun its stage")
    check_size(path, elements, offset, "delete it and rerun the stage that writes it")
    if len(elements) > 1 and elements[1].name == "tile" and elements[1].row == ROW_OF_TILE:
        with open(path, "rb") as file:
            file.seek(offset + count * row.itemsize)
            table = np.fromfile(file, ROW_OF_TILE, elements[1].count)
        starts = np.concatenate([[0], np.cumsum(table["count"], dtype=np.int64)])
        box = np.stack([table[name] for name in BOX], axis=1)
        return TiledCloud(path, row, offset, starts, box[:, :3], box[:, 3:])
    return _in_order(path, row, count, offset)


def _in_order(path: Path, row: np.dtype[Any], count: int, offset: int) -> TiledCloud:
    """A cloud without a table of tiles: all of it, or runs of TILE rows, whose boxes are found by reading it once."""
    step = TILE if count > WHOLE else max(count, 1)
    starts = np.append(np.arange(0, count, step), count).astype(np.int64)
    empty = np.zeros((len(starts) - 1, 3))
    cloud = TiledCloud(path, row, offset, starts, empty, empty.copy())
    for tile in range(len(starts) - 1):
        inside = cloud.read(np.array([tile]))[1].points
        cloud.low[tile], cloud.high[tile] = inside.min(0), inside.max(0)
    return cloud


def _cloud(records: NDArray[Any]) -> Cloud:
    assert records.dtype.names is not None
    return cloud_of({name: np.ascontiguousarray(records[name]) for name in records.dtype.names})


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
def reserved(
    path: Path, row: np.dtype[Any], count: int, tiles: int = 0, comments: Sequence[str] = ()
) -> Iterator[tuple[BinaryIO, int]]:
    """A PLY of so many points and tiles with its header written and its space reserved, and where its points begin.

    Without tiles it is a PLY like any other.

    It gets its name when everything is written.

    Raises:
        StageError: the disk has too little space.
    """
    elements = [Element("vertex", count, row), Element("tile", tiles, ROW_OF_TILE)]
    header = header_of(elements if tiles else elements[:1], comments)
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
        low, high = np.percentile(sample, [OUTER_PERCENT, 100 - OUTER_PERCENT], axis=0)
        most = min(AT_ONCE, count // POINTS_A_CELL) if count > WHOLE else 1
        side, shape = max(float((high - low).max()), 1e-300), np.ones(3, np.int64)
        for _ in range(MORTON_BITS):
            finer = np.ceil((high - low) / (side / 2)).astype(np.int64).clip(1)
            if finer.prod() > most:
                break
            side, shape = side / 2, finer
        index = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), axis=-1).reshape(-1, 3)
        rank = np.empty(len(index), np.int64)
        rank[np.argsort(morton(index), kind="stable")] = np.arange(len(index))
        return _Grid(low, side, shape, rank)

    def cells(self, points: Array) -> Rows:
        """The numbers (N,) of the cells of points (N, 3); those outside the box are in the outermost ones."""
        index = np.clip((points - self.low) / self.side, 0, self.shape - 1).astype(np.int64)
        return np.asarray(self.rank[(index[:, 0] * self.shape[1] + index[:, 1]) * self.shape[2] + index[:, 2]])


def morton(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """(C,) places along a Morton curve of cells (C, 3)."""
    keys = np.zeros(len(index), dtype=np.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            keys |= ((index[:, axis] >> bit) & 1) << (3 * bit + axis)
    return keys
