"""What the columns of a cloud are called here, whatever its file calls them."""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

Columns = dict[str, NDArray[Any]]

POSITION, NORMAL, COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
# What other programs call the same columns, in lower case and without spaces, dots and underscores.
OTHER_NAMES = {
    **dict(zip(("normalx", "normaly", "normalz"), NORMAL)),
    **dict(zip(("r", "g", "b", "rf", "gf", "bf", "diffusered", "diffusegreen", "diffuseblue"), COLOR * 3)),
}


def common_name(name: str) -> str:
    """The name that PLY uses for a column; its own where it is none of position, normal and colour."""
    plain = re.sub(r"[\s._]", "", name.lower())
    return OTHER_NAMES.get(plain, plain if plain in (*POSITION, *NORMAL, *COLOR) else name)


def positions(columns: Columns) -> NDArray[np.float64]:
    """(N, 3) positions."""
    return np.stack([columns[axis].astype(np.float64) for axis in POSITION], axis=1)
