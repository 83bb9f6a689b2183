"""A user's cloud file of any size: gone through in parts, with a summary of it and what is looked at in memory; and
points that are none of a cloud: strays far from all others, and what scanners write at 0 0 0."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import (
    NEIGHBOURS,
    Cloud,
    chosen_rows,
    cloud_of,
    coincidence_note,
    concatenate,
    finite_rows,
    precision_note,
    quick_tree,
    sampled_rows,
    spacing,
    voxel_downsample,
    voxels,
)
from scenefuse.cloud.formats import ColumnParts, check_not_degrees, columns_in_parts
from scenefuse.cloud.readers.columns import (
    AT_ONCE,
    COLOR,
    MAX_ODD_SHARE,
    POSITION,
    UNIT_TOLERANCE,
    Columns,
    color_counts,
    colors_of,
    positions,
    white_of,
)
from scenefuse.cloud.readers.las import ENDINGS, LAS_DIMENSIONS, NOISE, WITHHELD
from scenefuse.cloud.readers.text import text_notes
from scenefuse.cloud.tiled_cloud import Rows
from scenefuse.core.stage import StageError, threads
from scenefuse.core.transforms import Array, inside_box

# Points of a file, at most twice as many, that say where it lies.
SAMPLE = AT_ONCE
# Why rows are left out.
NOT_FINITE, AT_ZERO = "rows without a finite position", "points at exactly 0 0 0"
# Column of the number of a row in its file; no file can have one of that name.
ROW = "\n"
EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)

# Least and greatest corner (3,).
Box = tuple[Array, Array]
# Looks at a part of a file: at its rows, and at those of them that are points of a surface or lie at 0 0 0.
Look = Callable[[Columns, Columns], None]
# Points below this percentile along an axis, and above the same on the other side, do not say how far a cloud reaches.
STRAY_PERCENT = 1.0
# A stray's neighbours are farther than this share of the cloud's diagonal, and than so many times the usual distance;
# so many sizes of a cloud away from it, nothing is a part of it.
MIN_STRAY_SHARE, MIN_STRAY_TIMES = 0.02, 10.0
# In sizes of the box: cubes in which more points than a stray has neighbours are a part of the cloud, and by which a
# box has to grow.
COARSE_CUBE = 0.25


@dataclass(frozen=True)
class FileSummary:
    """A file that was gone through once.

    Attributes:
        path: of the file.
        columns: its columns in parts; held where the file is small.
        is_las: whether it is LAS or LAZ.
        rows: of the file.
        count: of its points of a surface: with a finite position, and neither noise, withheld nor at 0 0 0 far away.
        left_out: why rows are none of these -> how many.
        sample: (S, 3) positions of every so manyth of the points of a surface.
        white: the number of white among the colours; None where there are none.
        without_zero: whether points at 0 0 0 are none; they are not among the sample in any case.
    """

    path: Path
    columns: ColumnParts
    is_las: bool
    rows: int
    count: int
    left_out: dict[str, int]
    sample: Array
    white: float | None
    without_zero: bool

    def surface(self, columns: Columns) -> Columns:
        """The rows of a part that are points of a surface."""
        return surface_rows(columns, self.is_las, self.without_zero)[0]

    def cloud(self, surface: Columns) -> Cloud:
        """Points of a surface, without what LAS says beside colours, and without colours where all are black."""
        left_out = {*LAS_DIMENSIONS, WITHHELD} if self.is_las else set()
        left_out |= set(COLOR) if self.white is None else set()
        return cloud_of({name: values for name, values in surface.items() if name not in left_out}, self.white)

    def notes(self, points: Array, step: float) -> list[str]:
        """What a user should know of the file; of (N, 3) points as dense as its own, which are so far apart."""
        left_out = [f"{count} {why} of {self.path.name} were left out" for why, count in self.left_out.items() if count]
        more = [*precision_note(self.path, self.sample, step), *coincidence_note(self.path, points)]
        if self.path.suffix.lower() in (".glb", ".gltf"):
            more.append(f"{self.path.name} is turned so that z is up: what is x, y, z here is x, -z, y there")
        return [*left_out, *text_notes(self.path), *more]


def summarise(path: Path, look: Look, degrees: bool = False) -> FileSummary:
    """Go through a file once.

    Args:
        path: of the file.
        look: called with each part.
        degrees: whether it may be in degrees.

    Raises:
        StageError: it is missing, damaged, of an unknown ending, in degrees, or holds no point of a surface.
    """
    parts = columns_in_parts(path, degrees)
    is_las, rows, count, zeros = path.suffix.lower() in ENDINGS, 0, 0, 0
    held, sample, left_out, white = list[Columns](), Thinned(SAMPLE), dict[str, int](), None
    bright = np.zeros(3, np.int64)
    for columns in parts():
        held = [*held, columns] if rows < AT_ONCE else []
        rows += len(columns["x"])
        surface, without = surface_rows(columns, is_las)
        left_out = {why: left_out.get(why, 0) + number for why, number in without.items()}
        at_zero = (positions(surface) == 0).all(1)
        count, zeros = count + len(at_zero), zeros + int(at_zero.sum())
        sample.add(chosen_rows({axis: surface[axis] for axis in POSITION}, ~at_zero)[0])
        if (colors := colors_of(columns)) is not None:
            bright += color_counts(colors)
            white = white_of(colors.dtype, bright)
        look(columns, surface)
    if not rows:
        raise StageError(f"{path} holds no points; look at what wrote it")
    chosen = positions(sample.columns)
    without_zero = is_nothing_at_zero(chosen, zeros)
    if without_zero:
        left_out[AT_ZERO], count = zeros, count - zeros
    if count == 0:
        said = ", ".join(f"{number} {why}" for why, number in left_out.items() if number)
        raise StageError(f"{path} holds no point of a surface ({said}); look at what wrote it, and give the surface")
    chosen = chosen if len(chosen) else np.zeros((1, 3))
    if not degrees:
        check_not_degrees(path, chosen)
    if not bright.any() and is_las:
        white = None  # Formats with colours are used for points without, which are black then.
    return FileSummary(
        path, held.__iter__ if rows <= AT_ONCE else parts, is_las, rows, count, left_out, chosen, white, without_zero
    )


def surface_rows(columns: Columns, is_las: bool, without_zero: bool = False) -> tuple[Columns, dict[str, int]]:
    """The rows that are points of a surface, without the column `withheld`, and why others were left out -> how
    many. `without_zero` is true where points at 0 0 0 are none, which only the whole file says."""
    without = dict[str, int]()
    columns, without[NOT_FINITE] = finite_rows(columns)
    if without_zero:
        elsewhere = np.any([columns[axis] != 0 for axis in POSITION], axis=0)
        columns, without[AT_ZERO] = chosen_rows(columns, elsewhere)
    if is_las:
        columns, noise = chosen_rows(columns, ~np.isin(columns["classification"], NOISE))
        without[f"points of the classes {NOISE[0]} and {NOISE[1]} (noise)"] = noise
        columns, without["withheld points"] = chosen_rows(columns, ~columns[WITHHELD])
        columns = {name: values for name, values in columns.items() if name != WITHHELD}
    return columns, without


class Thinned:
    """Rows that come in parts, every so manyth of them, so that there are at most twice as many as wanted."""

    def __init__(self, most: float) -> None:
        """Hold `most` rows, or up to twice as many."""
        self.every, self._most, self._seen, self._held = 1, most, 0, list[Columns]()

    def add(self, columns: Columns) -> None:
        """The next rows."""
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


@dataclass(frozen=True)
class CloudFile:
    """A cloud file, and a part of it in memory.

    Attributes:
        summary: what is known of all its points.
        part: points of a surface in the box that was asked for.
        every: that part has every so manyth of them.
        last: greatest value of the field `source`; 0 where there is none.
    """

    summary: FileSummary
    part: Cloud
    every: int
    last: int

    @classmethod
    def of(cls, path: Path, box: Box = EVERYWHERE, most: float = np.inf) -> "CloudFile":
        """Go through a file once.

        Args:
            path: PLY, LAS, LAZ (COPC too), E57, PCD, text, or a mesh (PLY, OBJ, glTF).
            box: what becomes the part.
            most: points that the part should have; of more than twice as many every second, fourth, ... is held.

        Raises:
            StageError: the file is missing, damaged, of an unknown ending, in degrees, or holds no point of a surface.
        """
        part, last = Thinned(most), 0

        def look(columns: Columns, surface: Columns) -> None:
            nonlocal last
            part.add(chosen_rows(surface, inside_box(positions(surface), *box))[0])
            last = max(last, int(np.nan_to_num(columns["source"]).max(initial=0)) if "source" in columns else 0)

        whole = summarise(path, look)
        cloud = whole.cloud(surface_rows(part.columns, False, whole.without_zero)[0])
        return cls(whole, cloud, part.every, last)

    @cached_property
    def notes(self) -> list[str]:
        """What a user should know of the file."""
        return self.summary.notes(self.part.points, self.spacing)

    @cached_property
    def spacing(self) -> float:
        """Median distance from a point of the part to its nearest neighbour, as if the part had all: on a surface, a
        quarter of the points lie twice as far apart."""
        return spacing(self.part.points) / float(np.sqrt(self.every))

    @property
    def like(self) -> Cloud:
        """None of the points, with the columns that they have."""
        return self.part[np.zeros(0, np.int64)]

    def parts(self) -> Iterator[tuple[Rows, Cloud]]:
        """The points of a surface in the order of the file, with the number of each one's row (N,) in it."""
        first = 0
        for columns in self.summary.columns():
            numbered = columns | {ROW: np.arange(first, first + len(columns["x"]))}
            first += len(columns["x"])
            chosen = self.summary.surface(numbered)
            rows = chosen.pop(ROW)
            yield rows, self.summary.cloud(chosen)

    def near(self, low: Array, high: Array) -> tuple[Rows, Cloud]:
        """All points of a surface in the box from `low` (3,) to `high` (3,), and their rows (N,)."""
        found = [(np.zeros(0, np.int64), self.like)]
        for rows, cloud in self.parts():
            inside = inside_box(cloud.points, low, high)
            found.append((rows[inside], cloud[inside]))
        return np.concatenate([rows for rows, _ in found]), concatenate([cloud for _, cloud in found])


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
        tree, least = quick_tree(points[near]), MIN_STRAY_SHARE * float(np.linalg.norm(high - low))

        def away(rows: NDArray[np.int64]) -> NDArray[np.float64]:
            parts = np.array_split(tree.data[rows], 1 + len(rows) // AT_ONCE)
            return np.concatenate([tree.query(part, k=NEIGHBOURS + 1, workers=threads())[0][:, -1] for part in parts])

        among = Cloud(tree.data, fields={"row": np.arange(len(near))})[together]
        usual = away(voxel_downsample(among, MIN_STRAY_SHARE * size).fields["row"]) if len(among) else np.inf
        # Where a cube that is so long across holds more points, all of these have their neighbours in it.
        group, counts = voxels(tree.data, least / np.sqrt(3))
        sparse = np.flatnonzero(counts[group] <= NEIGHBOURS)
        far[near[sparse]] = away(sparse) > max(least, MIN_STRAY_TIMES * float(np.median(usual)))
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
        near = np.flatnonzero(inside_box(points, low, high, size))
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


def normals_fault(cloud: Cloud) -> str:
    """Why a cloud's normals say nothing, in words; "" where nothing is wrong, or there are none.

    Programs fit planes without turning them outwards: then neighbours on one surface face either side. Of right normals
    a few of a hundred do, at edges and on thin sheets.
    """
    fault = lengths_fault(cloud)
    if fault or cloud.normals is None or not len(cloud):
        return fault
    some = sampled_rows(len(cloud), SAMPLE // 100, seed=0)
    near = quick_tree(cloud.points).query(cloud.points[some], range(1, min(NEIGHBOURS + 1, len(cloud)) + 1))[1]
    facing = np.einsum("ni,nki->nk", cloud.normals[some], cloud.normals[near])[:, 1:]
    facing = facing[np.abs(facing) > 0.5]
    # Where a share of the points is turned, nearly twice as many pairs differ.
    most = 2 * MAX_ODD_SHARE * (1 - MAX_ODD_SHARE)
    return "face either side, unlike their neighbours'" if (facing < 0).sum() > most * len(facing) else ""


def lengths_fault(cloud: Cloud) -> str:
    """The same of their lengths alone, as of a part of a file."""
    lengths = np.ones(1) if cloud.normals is None else np.linalg.norm(cloud.normals, axis=1)
    return "are not all of unit length" if (np.abs(lengths - 1) > UNIT_TOLERANCE).any() else ""
