"""Known lengths in photos: scale bars, which bring a model into metres where there is neither GPS nor control."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.marks.clicks import Clicks, read_length_clicks
from scenefuse.marks.triangulation import triangulate

# Clicks that miss each other by more are not on one point; as a share of the photo's longer side.
MAX_CLICK_MISS = 0.005
# Lengths that differ by more from one scale say that one of them is wrong; as a share of the length.
MAX_LENGTH_ERROR = 0.05


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
    """Read lengths.tsv and measure its lengths in a model.

    Args:
        path: of the file, a line a click: name of the length, metres, end (any two words), photo, pixel.
        model: cameras of the photos.
        sizes: photo name -> (width, height) of the photos clicked in.

    Raises:
        StageError: what `read_ends` and `triangulate` say; lengths that contradict each other.
    """
    clicks = read_ends(path)
    limit_px = MAX_CLICK_MISS * max(max(camera.width, camera.height) for camera in model.cameras.values())
    labels, places, _ = triangulate(clicks, model, limit_px, sizes)
    metres: dict[str, float] = {}
    ends: dict[str, list[Array]] = {}
    for label, place in zip(labels, places):
        name, long, _ = label.split("\t")
        metres[name] = float(long)
        ends.setdefault(name, []).append(place)
    in_model = np.array([np.linalg.norm(np.subtract(*two)) for two in ends.values()])
    if not (in_model > 0).all():
        raise StageError(
            f"{path}: both ends of {list(metres)[int(in_model.argmin())]} lie at one place; click them again"
        )
    found = Lengths(list(metres), np.array(list(metres.values())), in_model)
    off = found.scale * in_model / found.metres - 1
    if np.abs(off).max() > MAX_LENGTH_ERROR:
        each = ", ".join(f"{name} {100 * o:+.1f} %" for name, o in zip(metres, off))
        raise StageError(f"{path}: the lengths contradict each other: off one scale by {each}; correct the wrong one")
    return found


def read_ends(path: Path) -> Clicks:
    """Read lengths.tsv, where each length has two ends.

    Raises:
        StageError: what `read_length_clicks` says; an end that is missing, or a third one.
    """
    clicks = read_length_clicks(path)
    ends: dict[str, list[str]] = {}
    for label in dict.fromkeys(clicks.labels):
        name, _, end = label.split("\t")
        ends.setdefault(name, []).append(end)
    odd = next((name for name, two in ends.items() if len(two) != 2), None)
    if odd is not None:
        raise StageError(f"{path}: {odd} has the ends {', '.join(ends[odd])}; click two, each in two photos or more")
    return clicks
