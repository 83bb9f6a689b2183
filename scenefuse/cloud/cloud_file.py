"""A user's cloud file of any size: gone through in parts, with what is looked at in memory and nothing else."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import (
    Cloud,
    chosen_rows,
    cloud_of,
    coincidence_note,
    concatenate,
    precision_note,
    spacing,
)
from scenefuse.cloud.formats import LAS_DIMENSIONS, WITHHELD, check_not_degrees
from scenefuse.cloud.readers.columns import COLOR, Columns, positions
from scenefuse.cloud.readers.text import text_notes
from scenefuse.cloud.tiles.parts import columns_in_parts
from scenefuse.cloud.tiles.statistics import Survey, Thinned, surface_rows, survey
from scenefuse.cloud.tiles.tiled_cloud import Rows
from scenefuse.core.transforms import Array

ROW = "\n"
"""Column of the number of a row in its file; no file can have one of that name."""
EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)

Box = tuple[Array, Array]
"""Least and greatest corner (3,)."""


@dataclass(frozen=True)
class CloudFile:
    """A cloud file, and a part of it in memory.

    Attributes:
        survey: what is known of all its points.
        part: points of a surface in the box that was asked for.
        every: that part has every so manyth of them.
        last: greatest value of the field `source`; 0 where there is none.
        notes: what a user should know of the file.
    """

    survey: Survey
    part: Cloud
    every: int
    last: int
    notes: list[str]

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
        part, last = Thinned(most), 0

        def look(columns: Columns, surface: Columns) -> None:
            nonlocal last
            part.add(chosen_rows(surface, _inside(positions(surface), box))[0])
            last = max(last, int(np.nan_to_num(columns["source"]).max(initial=0)) if "source" in columns else 0)

        whole = survey(path, columns_in_parts(path), look)
        check_not_degrees(path, whole.sample)
        cloud = _cloud(surface_rows(part.columns, False, whole.without_zero)[0], whole)
        notes = [*text_notes(path)]
        notes += [f"{number} {why} of {path} are not used" for why, number in whole.left_out.items() if number]
        found = cls(whole, cloud, part.every, last, notes)
        notes += [*precision_note(path, cloud.points, found.spacing), *coincidence_note(path, cloud.points)]
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
        """The points of a surface in the order of the file, with the number of each one's row (N,) in it."""
        first = 0
        for columns in self.survey.columns():
            numbered = columns | {ROW: np.arange(first, first + len(columns["x"]))}
            first += len(columns["x"])
            chosen = self.survey.surface(numbered)
            rows = chosen.pop(ROW)
            yield rows, _cloud(chosen, self.survey)

    def near(self, low: Array, high: Array) -> tuple[Rows, Cloud]:
        """All points of a surface in the box from `low` (3,) to `high` (3,), and their rows (N,)."""
        found = [(np.zeros(0, np.int64), self.like)]
        for rows, cloud in self.parts():
            inside = _inside(cloud.points, (low, high))
            found.append((rows[inside], cloud[inside]))
        return np.concatenate([rows for rows, _ in found]), concatenate([cloud for _, cloud in found])


def _cloud(columns: Columns, whole: Survey) -> Cloud:
    """Without what LAS says beside colours, and without colours where all are black."""
    left_out = {*LAS_DIMENSIONS, WITHHELD} if whole.is_las else set()
    left_out |= set(COLOR) if whole.most_color is None else set()
    return cloud_of({name: values for name, values in columns.items() if name not in left_out}, whole.most_color)


def _inside(points: Array, box: Box) -> NDArray[np.bool_]:
    return np.asarray(((points >= box[0]) & (points <= box[1])).all(1))
