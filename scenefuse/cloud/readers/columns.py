"""The columns of a cloud's file in parts: their names, whatever the file calls them, and the range of colours."""

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = dict[str, NDArray[Any]]

# Rows of a file, or points of a cloud, that are in memory together when all of it is gone through.
AT_ONCE = 1 << 20
# Normals may be this far from unit length; other ones say nothing of the surface.
UNIT_TOLERANCE = 0.05
# Share of colours above a range that interpolation overshoots.
MAX_OVERSHOOT_SHARE = 0.1
POSITION, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
# What other programs call colours, in lower case, in the languages of their users.
COLOR_NAMES = (
    {"r", "red", "rf", "rot", "rouge", "rojo", "rosso", "vermelho", "rood", "czerwony", "rod", "röd", "rød"},
    {"g", "green", "gf", "grün", "grun", "gruen", "vert", "verde", "groen", "zielony", "gron", "grön", "grønn"},
    {"b", "blue", "bf", "blau", "bleu", "azul", "blu", "blauw", "niebieski", "bla", "blå"},
)
# What they call positions and normals; ParaView numbers them.
OTHER_NAMES = {name: name for name in (*POSITION, *NORMAL)} | {
    f"{word}{k}": name
    for words, names in ((("points",), POSITION), (("normals", "normal"), NORMAL))
    for axis, name in enumerate(names)
    for word in words
    for k in (axis, "xyz"[axis])
}
# What may stand before or behind the name of a column: whose colour it is, a unit, a range.
AROUND = re.compile(r"^(diffuse|colou?r|rgb|scalar|vertex|farbe|couleur)(?=.)|[\[(].*$")


def common_names(names: Sequence[str]) -> list[str]:
    """The names that PLY uses for columns; their own where they are none of position, normal and colour."""
    plain = [AROUND.sub("", re.sub(r"[\s._:-]+", "", name.lower())) for name in names]
    found = [OTHER_NAMES.get(short, name) for short, name in zip(plain, names)]
    colored = [[k for k, short in enumerate(plain) if short in called] for called in COLOR_NAMES]
    if all(colored):
        for axis, (first, *_) in zip(COLOR, colored):
            found[first] = axis
    return found


def positions(columns: Columns) -> NDArray[np.float64]:
    """(N, 3) positions."""
    return np.stack([columns[axis].astype(np.float64) for axis in POSITION], axis=1)


def joined(parts: Iterable[Columns]) -> Columns:
    """All parts of a file one after the other."""
    found = list(parts)
    if not found:
        return {name: np.empty(0) for name in POSITION}
    return found[0] if len(found) == 1 else {name: np.concatenate([part[name] for part in found]) for name in found[0]}


def colors_of(columns: Columns) -> NDArray[Any] | None:
    """(N, 3) colours, if there are any."""
    return np.stack([columns[name] for name in COLOR], axis=1) if set(COLOR) <= set(columns) else None


def color_counts(colors: NDArray[Any]) -> NDArray[np.int64]:
    """(3,) how many numbers of colours are above 0, above 1 and above 255."""
    return np.array([np.count_nonzero(colors > least) for least in (0, 1, 255)])


def white_of(kind: np.dtype[Any], counts: NDArray[np.int64]) -> float:
    """The number that stands for white: 1 or 255 in real numbers, 255 in bytes, 255 or 65535 in longer integers.

    Args:
        kind: type of the colours.
        counts: (3,) of the whole file, by `color_counts`. Few numbers above a range overshoot it, and are clipped.
    """
    few = MAX_OVERSHOOT_SHARE * counts[0]
    if kind == np.uint8:
        return 255.0
    if counts[1] <= few and kind.kind == "f":
        return 1.0
    return 255.0 if counts[2] <= few else 65535.0


def bytes_of(colors: NDArray[Any], white: float | None = None) -> NDArray[np.uint8]:
    """Colours (N, 3) as 0..255, from those whose white is that number; None where these are all of a file."""
    if colors.dtype == np.uint8:
        return colors
    white = white or white_of(colors.dtype, color_counts(colors))
    return np.clip(np.rint(np.nan_to_num(colors.astype(np.float64)) * (255 / white)), 0, 255).astype(np.uint8)
