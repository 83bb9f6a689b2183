"""A user's cloud file of any size: gone through in parts, with what is looked at in memory and nothing else."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.io.clouds import (
    Cloud,
    chosen_rows,
    cloud_of,
    concatenate,
    finite_rows,
    is_nothing_at_zero,
    precision_note,
    spacing,
)
from scenefuse.io.formats import LAS_DIMENSIONS, WITHHELD, check_not_degrees
from scenefuse.io.import_cloud import AT_ZERO, surface_rows
from scenefuse.io.readers.columns import COLOR, POSITION, Columns
from scenefuse.io.readers.text import text_notes
from scenefuse.io.tiles.parts import ColumnParts, columns_in_parts
from scenefuse.io.tiles.tiled_cloud import AT_ONCE, Rows
from scenefuse.stage import StageError
from scenefuse.transforms import Array

SAMPLE = 1 << 16
"""Points of the whole file, at most twice as many, that say where it lies."""
ROW = "\n"
"""Column of the number of a row in its file; no file can have one of that name."""
EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)

Box = tuple[Array, Array]
"""Least and greatest corner (3,)."""


@dataclass(frozen=True)
class CloudFile:
    """A cloud file, and a part of it in memory.

    Attributes:
        path: of the file.
        count: of its points of a surface: with a finite position, and neither noise, withheld nor at 0 0 0 far away.
        total: of the points that are copied (`parts`): of LAS and LAZ all.
        part: points of a surface in the box that was asked for.
        every: that part has every so manyth of them.
        sample: (S, 3) positions all over the file.
        last: greatest value of the field `source`; 0 where there is none.
        notes: what a user should know of the file.
    """

    path: Path
    count: int
    total: int
    part: Cloud
    every: int
    sample: Array
    last: int
    notes: list[str]
    _columns: ColumnParts
    _most_color: float | None
    _without_zero: bool

    @classmethod
    def of(cls, path: Path, box: Box = EVERYWHERE, most: float = np.inf) -> "CloudFile":
        """Go through a file once.

        Args:
            path: PLY, LAS, LAZ (COPC too), E57, PCD, text, or a mesh (PLY, OBJ, GLB).
            box: what becomes the part.
            most: points that the part should have; of more than twice as many every second, fourth, ... is held.

        Raises:
            StageError: the file is missing, damaged, of an unknown ending, in degrees, or holds no point of a surface.
        """
        columns, is_las, rows, count, total, last, zeros = columns_in_parts(path), _is_las(path), 0, 0, 0, 0, 0
        held, part, sample = list[Columns](), _Thinned(most), _Thinned(SAMPLE)
        left_out, most_color = dict[str, int](), None
        for some in columns():
            held = [*held, some] if rows < AT_ONCE else []
            rows += len(some["x"])
            surface, without = surface_rows(some, is_las)
            points = _points(surface)
            at_zero = (points == 0).all(1)
            count, zeros = count + len(points), zeros + int(at_zero.sum())
            total += int(np.isfinite(_points(some)).all(1).sum()) if is_las else len(points)
            left_out = {why: left_out.get(why, 0) + number for why, number in without.items()}
            part.add(chosen_rows(surface, _inside(points, box))[0])
            sample.add(chosen_rows({name: surface[name] for name in POSITION}, ~at_zero)[0])
            if set(COLOR) <= set(some):
                here = max(float(np.nan_to_num(some[name].astype(np.float64)).max(initial=0)) for name in COLOR)
                most_color = max(here, most_color or 0.0)
            last = max(last, int(np.nan_to_num(some["source"]).max(initial=0)) if "source" in some else 0)
        without_zero = zeros > 0 and is_nothing_at_zero(_points(sample.columns))
        if without_zero:
            left_out[AT_ZERO], count, total = zeros, count - zeros, total - zeros * (not is_las)
        if count == 0:
            raise StageError(_empty(path, rows, left_out))
        if most_color == 0 and is_las:
            most_color = None  # Formats with colours are used for points without, which are black then.
        if rows <= AT_ONCE:
            columns = held.__iter__
        cloud = _cloud(surface_rows(part.columns, False, without_zero)[0], most_color, is_las)
        positions = _points(sample.columns)
        positions = positions if len(positions) else np.zeros((1, 3))
        notes = [*text_notes(path)]
        notes += [f"{number} {why} of {path} are not used" for why, number in left_out.items() if number]
        found = cls(path, count, total, cloud, part.every, positions, last, notes, columns, most_color, without_zero)
        check_not_degrees(path, positions)
        notes += precision_note(path, cloud.points, found.spacing)
        return found

    @property
    def spacing(self) -> float:
        """Median distance from a point of the part to its nearest neighbour, as if the part had all: on a surface, a
        quarter of the points lie twice as far apart."""
        return spacing(self.part.points) / float(np.sqrt(self.every))

    @property
    def like(self) -> Cloud:
        """None of the points, with the columns that they have."""
        return self.part[np.zeros(0, np.int64)]

    def parts(self) -> Iterator[tuple[Rows, Cloud]]:
        """The points of a surface, of LAS and LAZ all points, in the order of the file; with the number of each one's
        row (N,) in it."""
        return self._clouds(everything=_is_las(self.path))

    def near(self, low: Array, high: Array) -> tuple[Rows, Cloud]:
        """All points of a surface in the box from `low` (3,) to `high` (3,), and their rows (N,)."""
        found = [(np.zeros(0, np.int64), self.like)]
        for rows, cloud in self._clouds(everything=False):
            inside = _inside(cloud.points, (low, high))
            found.append((rows[inside], cloud[inside]))
        return np.concatenate([rows for rows, _ in found]), concatenate([cloud for _, cloud in found])

    def _clouds(self, everything: bool) -> Iterator[tuple[Rows, Cloud]]:
        first, is_las = 0, _is_las(self.path)
        for columns in self._columns():
            numbers = np.arange(first, first + len(columns["x"]))
            first += len(numbers)
            numbered = columns | {ROW: numbers}
            chosen = finite_rows(numbered) if everything else surface_rows(numbered, is_las, self._without_zero)
            rows = chosen[0].pop(ROW)
            yield rows, _cloud(chosen[0], self._most_color, is_las)


class _Thinned:
    """Rows that come in parts, every so manyth of them, so that there are at most twice as many as wanted."""

    def __init__(self, most: float) -> None:
        self.every, self._most, self._seen, self._held = 1, most, 0, list[Columns]()

    def add(self, columns: Columns) -> None:
        count = len(columns["x"])
        chosen = np.arange(-self._seen % self.every, count, self.every)
        self._held.append({name: values[chosen] for name, values in columns.items()})
        self._seen += count
        while sum(len(part["x"]) for part in self._held) > 2 * self._most:
            self._held, self.every = [{name: v[::2] for name, v in self.columns.items()}], 2 * self.every

    @property
    def columns(self) -> Columns:
        """All that are held."""
        if len(self._held) > 1:
            self._held = [{name: np.concatenate([p[name] for p in self._held]) for name in self._held[0]}]
        return self._held[0]


def _cloud(columns: Columns, most_color: float | None, is_las: bool) -> Cloud:
    """Without what LAS says beside colours, and without colours where all are black."""
    left_out = {*(LAS_DIMENSIONS if is_las else ()), *((WITHHELD,) if is_las else ())}
    left_out |= set(COLOR) if most_color is None else set()
    return cloud_of({name: values for name, values in columns.items() if name not in left_out}, most_color)


def _empty(path: Path, rows: int, left_out: dict[str, int]) -> str:
    """What is wrong with a file without a point of a surface."""
    if not rows:
        return f"{path} holds no points; look at what wrote it"
    said = ", ".join(f"{number} {why.rstrip(',')}" for why, number in left_out.items() if number)
    return f"{path} holds no point of a surface ({said}); look at what wrote it, and give the surface"


def _points(columns: Columns) -> Array:
    return np.stack([columns[axis].astype(np.float64) for axis in POSITION], axis=1)


def _inside(points: Array, box: Box) -> NDArray[np.bool_]:
    return np.asarray(((points >= box[0]) & (points <= box[1])).all(1))


def _is_las(path: Path) -> bool:
    return path.suffix.lower() in (".las", ".laz")
