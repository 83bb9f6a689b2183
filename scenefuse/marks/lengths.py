"""Known lengths in photos: scale bars, which bring a model into metres where there is neither GPS nor control."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from scenefuse.core.stage import StageError
from scenefuse.core.tables import comma_advice, read_cells
from scenefuse.core.transforms import Array
from scenefuse.marks.fiducials import Clicks, triangulate

COLUMNS = ["length", "metres", "end", "photo", "x_px", "y_px"]
# Clicks on one point that miss each other by more are no clicks on one point: as a share of the photo's longer side.
CLICK_LIMIT = 0.005
# Lengths that differ by more from one scale say that one of them is wrong.
MOST_OFF = 0.05


class EndClick(NamedTuple):
    """A line of lengths.tsv: a click on one end of a known length, in pixels of the original photo."""

    length: str
    metres: float
    end: str
    photo: str
    x_px: float
    y_px: float


@dataclass(frozen=True)
class Lengths:
    """Known lengths in a model.

    Attributes:
        names: of L lengths.
        metres: (L,) how long they are.
        in_model: (L,) how long they are in the model.
    """

    names: list[str]
    metres: Array
    in_model: Array

    @property
    def scale(self) -> float:
        """Metres in a unit of the model, by least squares."""
        return float(self.metres @ self.in_model / (self.in_model @ self.in_model))

    @property
    def off_m(self) -> Array:
        """(L,) metres that they are too long in the model once it is scaled."""
        return self.scale * self.in_model - self.metres


def read_lengths(path: Path, model: pycolmap.Reconstruction, sizes: Mapping[str, tuple[int, int]]) -> Lengths:
    """Read lengths.tsv, a line a click: name of the length, metres, end (any two words), photo, pixel. Both ends are
    clicked in two photos or more.

    Args:
        path: of the file.
        model: cameras of the photos.
        sizes: photo name -> (width, height) of the photos clicked in.

    Raises:
        StageError: no such file, a line that is not well formed, a length that is not positive or given twice with
            different values, an end that is missing, clicks that contradict each other, lengths that do.
    """
    metres, ends, clicks = read_ends(path)
    limit_px = CLICK_LIMIT * max(max(camera.width, camera.height) for camera in model.cameras.values())
    names, places, _ = triangulate(clicks, model, limit_px, sizes)
    at = dict(zip(names, places))
    in_model = np.array([np.linalg.norm(np.subtract(*(at[f"{name} {end}"] for end in ends[name]))) for name in metres])
    if not (in_model > 0).all():
        raise StageError(
            f"{path}: both ends of {list(metres)[int(in_model.argmin())]} lie at one place; click them again"
        )
    found = Lengths(list(metres), np.array(list(metres.values())), in_model)
    off = found.scale * in_model / found.metres - 1
    if np.abs(off).max() > MOST_OFF:
        each = ", ".join(f"{name} {100 * o:+.1f} %" for name, o in zip(metres, off))
        raise StageError(f"{path}: the lengths contradict each other: off one scale by {each}; correct the wrong one")
    return found


def read_ends(path: Path) -> tuple[dict[str, float], dict[str, list[str]], Clicks]:
    """Lengths in metres and their two ends by name, and the clicks on `name end`.

    Raises:
        StageError: no such file, a line that is not well formed, a length that is not positive or given twice with
            different values, an end that is missing.
    """
    clicks = read_end_clicks(path)
    ends: dict[str, list[str]] = {}
    for click in clicks:
        known = ends.setdefault(click.length, [])
        known += [] if click.end in known else [click.end]
    odd = next((name for name, two in ends.items() if len(two) != 2), None)
    if odd is not None:
        raise StageError(f"{path}: {odd} has the ends {', '.join(ends[odd])}; click two, each in two photos or more")
    points, pixels = [f"{c.length} {c.end}" for c in clicks], np.array([[c.x_px, c.y_px] for c in clicks])
    return {c.length: c.metres for c in clicks}, ends, Clicks(path, points, [c.photo for c in clicks], pixels)


def read_end_clicks(path: Path) -> list[EndClick]:
    """The lines of lengths.tsv, whether both ends are there or not.

    Raises:
        StageError: no such file, a line that is not well formed, a length that is not positive or given twice with
            different values.
    """
    rows = read_cells(path)
    if not rows or rows[0][1] != COLUMNS or len(rows) == 1:
        raise StageError(
            f"{path} has to begin with the tab-separated header '{' '.join(COLUMNS)}', and to go on with clicks"
        )
    metres: dict[str, float] = {}
    found = []
    for number, cells in rows[1:]:
        try:
            name, end, photo = cells[0], cells[2], cells[3]
            long, x, y = (float(cell) for cell in (cells[1], *cells[4:6]))
            if len(cells) != 6 or not np.isfinite([long, x, y]).all():
                raise ValueError
        except (ValueError, IndexError):
            raise StageError(
                f"{path}, line {number}: expected {' '.join(COLUMNS)}, got '{' '.join(cells)}'"
                f"{comma_advice([cells[1], *cells[4:]] if len(cells) > 1 else [])}"
            ) from None
        if long <= 0 or metres.setdefault(name, long) != long:
            raise StageError(f"{path}, line {number}: {name} is {long:g} m here; give one positive length, in metres")
        found.append(EndClick(name, long, end, photo, x, y))
    return found
