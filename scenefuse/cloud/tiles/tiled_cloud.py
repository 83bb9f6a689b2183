"""The cloud of a scene, read by place.

It is a PLY like any other, whose points lie tile by tile; a second element behind them, `tile`, holds the number of
points and the bounding box of each tile. So a stage reads what is near an object, and the row of a point in the file is
its name. Memory does not grow with the scene.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, cloud_of, spacing
from scenefuse.cloud.tiles.ply_header import Element, read_header
from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array

TILE = 1 << 16
"""Points of a tile, about: what is read in excess around a box is a few of these."""
WHOLE = 1 << 20
"""A cloud of up to so many points is one tile and keeps its order: reading all of it takes no longer."""
AT_ONCE = 1 << 21
"""Points that are held in memory together when all of a cloud is gone through."""
SPACING_TILES = 8
"""Tiles of a larger cloud in which its spacing is measured."""
BOX = ("low_x", "low_y", "low_z", "high_x", "high_y", "high_z")
ROW_OF_TILE = np.dtype([("count", "<u4"), *((name, "<f8") for name in BOX)])
"""A row of the element `tile`."""

Rows = NDArray[np.int64]


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
        drawn = np.random.default_rng(seed).integers(0, len(self), SPACING_TILES)
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
    elements, offset = read_header(path) or ([], 0)
    row, count = (elements[0].row, elements[0].count) if elements else (None, 0)
    if row is None or not {"x", "y", "z"} <= set(row.names or ()):
        raise StageError(f"{path} is no cloud that a stage of this project wrote; delete it and rerun its stage")
    _check_size(path, elements, offset)
    if len(elements) > 1 and elements[1].name == "tile" and elements[1].row == ROW_OF_TILE:
        with open(path, "rb") as file:
            file.seek(offset + count * row.itemsize)
            table = np.fromfile(file, ROW_OF_TILE, elements[1].count)
        starts = np.concatenate([[0], np.cumsum(table["count"], dtype=np.int64)])
        box = np.stack([table[name] for name in BOX], axis=1)
        return TiledCloud(path, row, offset, starts, box[:, :3], box[:, 3:])
    return _in_order(path, row, count, offset)


def _check_size(path: Path, elements: list[Element], offset: int) -> None:
    if any(element.row is None for element in elements):
        return
    wanted = offset + sum(element.count * element.row.itemsize for element in elements if element.row is not None)
    there = path.stat().st_size
    if there < wanted:
        raise StageError(
            f"{path} is cut short: {there} of {wanted} bytes; delete it and rerun the stage that writes it"
        )


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
