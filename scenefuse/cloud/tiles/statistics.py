"""What has to be known of all points of a user's cloud file before any is used."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scenefuse.cloud.clouds import chosen_rows, finite_rows, is_nothing_at_zero
from scenefuse.cloud.formats import NOISE, WITHHELD
from scenefuse.cloud.readers.columns import COLOR, POSITION, Columns, positions
from scenefuse.cloud.tiles.parts import ColumnParts
from scenefuse.cloud.tiles.tiled_cloud import AT_ONCE
from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array

SAMPLE = 1 << 20
"""Points of a file, at most twice as many, that say where it lies."""
NOT_FINITE = "rows without a finite position"
AT_ZERO = "points at 0 0 0, far from all others,"
"""Why rows are left out."""

Look = Callable[[Columns, Columns], None]
"""Looks at a part of a file: at its rows, and at those of them that are points of a surface or lie at 0 0 0."""


@dataclass(frozen=True)
class Survey:
    """A file that was gone through once.

    Attributes:
        path: of the file.
        columns: its columns in parts; held where the file is small.
        is_las: whether it is LAS or LAZ.
        rows: of the file.
        count: of its points of a surface: with a finite position, and neither noise, withheld nor at 0 0 0 far away.
        left_out: why rows are none of these -> how many.
        sample: (S, 3) positions of every so manyth of the points of a surface.
        most_color: the greatest colour; None where there are none.
        without_zero: whether points at 0 0 0 are none; they are not among the sample in any case.
    """

    path: Path
    columns: ColumnParts
    is_las: bool
    rows: int
    count: int
    left_out: dict[str, int]
    sample: Array
    most_color: float | None
    without_zero: bool

    def surface(self, columns: Columns) -> Columns:
        """The rows of a part that are points of a surface."""
        return surface_rows(columns, self.is_las, self.without_zero)[0]


def survey(path: Path, parts: ColumnParts, look: Look) -> Survey:
    """Go through a file once.

    Args:
        path: of the file.
        parts: its columns.
        look: called with each part.

    Raises:
        StageError: it is damaged, or holds no point of a surface.
    """
    is_las, rows, count, zeros = path.suffix.lower() in (".las", ".laz"), 0, 0, 0
    held, sample, left_out, most_color = list[Columns](), Thinned(SAMPLE), dict[str, int](), None
    for columns in parts():
        held = [*held, columns] if rows < AT_ONCE else []
        rows += len(columns["x"])
        surface, without = surface_rows(columns, is_las)
        left_out = {why: left_out.get(why, 0) + number for why, number in without.items()}
        at_zero = (positions(surface) == 0).all(1)
        count, zeros = count + len(at_zero), zeros + int(at_zero.sum())
        sample.add(chosen_rows({axis: surface[axis] for axis in POSITION}, ~at_zero)[0])
        if set(COLOR) <= set(columns):
            here = max(float(np.nan_to_num(columns[name].astype(np.float64)).max(initial=0)) for name in COLOR)
            most_color = max(here, most_color or 0.0)
        look(columns, surface)
    if not rows:
        raise StageError(f"{path} holds no points; look at what wrote it")
    chosen = positions(sample.columns)
    without_zero = zeros > 0 and is_nothing_at_zero(chosen)
    if without_zero:
        left_out[AT_ZERO], count = zeros, count - zeros
    if count == 0:
        said = ", ".join(f"{number} {why.rstrip(',')}" for why, number in left_out.items() if number)
        raise StageError(f"{path} holds no point of a surface ({said}); look at what wrote it, and give the surface")
    if most_color == 0 and is_las:
        most_color = None  # Formats with colours are used for points without, which are black then.
    return Survey(
        path,
        held.__iter__ if rows <= AT_ONCE else parts,
        is_las,
        rows,
        count,
        left_out,
        chosen if len(chosen) else np.zeros((1, 3)),
        most_color,
        without_zero,
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
