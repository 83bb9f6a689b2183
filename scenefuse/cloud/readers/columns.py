"""The columns of a cloud's file in parts: their names, whatever the file calls them, and the range of colours."""

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = dict[str, NDArray[Any]]

# Rows of a file, or points of a cloud, that are in memory together when all of it is gone through.
AT_ONCE = 1 << 20
# Normals may be this far from unit length; other ones say nothing of the surface.
UNIT_TOLERANCE = 0.05
POSITION, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
# What other programs call the same columns, in lower case and without spaces, dots and underscores.
OTHER_NAMES = {
    **dict(zip(("normalx", "normaly", "normalz"), NORMAL)),
    **dict(
        zip(("r", "g", "b", "rf", "gf", "bf", "diffusered", "diffusegreen", "diffuseblue"), (*COLOR, *COLOR, *COLOR))
    ),
}


def common_name(name: str) -> str:
    """The name that PLY uses for a column; its own where it is none of position, normal and colour."""
    plain = re.sub(r"[\s._]", "", name.lower())
    return OTHER_NAMES.get(plain, plain if plain in (*POSITION, *NORMAL, *COLOR) else name)


def positions(columns: Columns) -> NDArray[np.float64]:
    """(N, 3) positions."""
    return np.stack([columns[axis].astype(np.float64) for axis in POSITION], axis=1)


def joined(parts: Iterable[Columns]) -> Columns:
    """All parts of a file one after the other."""
    found = list(parts)
    if not found:
        return {name: np.empty(0) for name in POSITION}
    return found[0] if len(found) == 1 else {name: np.concatenate([part[name] for part in found]) for name in found[0]}


def bytes_of(colors: NDArray[Any], most: float | None = None) -> NDArray[np.uint8]:
    """Colours (N, 3) as 0..255, from bytes, from 16 bits, or from fractions of 1; which one it is, the greatest value
    tells, or `most` where these are a part of the colours."""
    if colors.dtype == np.uint8:
        return colors
    values = np.nan_to_num(colors.astype(np.float64))
    if most is None:
        most = values.max(initial=0)
    if most > 255:
        values = values / 257
    elif np.issubdtype(colors.dtype, np.floating) and most <= 1:
        values = values * 255
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
