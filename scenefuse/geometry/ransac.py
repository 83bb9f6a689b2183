"""RANSAC for similarities of a free scale: random triples of matched points whose edges agree on one scale."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.transforms import Array


class Triples(NamedTuple):
    """Triples of matches.

    Attributes:
        rows: (N, 3) of the matches.
        edges: lengths (N, 3) of their edges on either side.
        scale: (N,) geometric mean of the three edges' ratios.
    """

    rows: NDArray[np.int64]
    edges: tuple[Array, Array]
    scale: Array


def triples_of_one_scale(x: Array, y: Array, count: int, min_ratio: float, rng: np.random.Generator) -> Triples:
    """Random triples of matches whose three edges are longer on one side by nearly the same factor (Fischler 1981).

    Args:
        x: (M, 3) points of one side.
        y: (M, 3) their partners.
        count: triples drawn.
        min_ratio: least of a triple's three factors over the largest.
        rng: draws them.
    """
    rows = rng.integers(0, len(x), (count, 3))
    a, b = (np.linalg.norm(side[rows] - side[np.roll(rows, 1, axis=1)], axis=2) for side in (x, y))
    ratio = b / np.maximum(a, 1e-12)
    good = ratio.min(1) > min_ratio * ratio.max(1)
    scale = np.exp(np.log(np.maximum(ratio[good], 1e-12)).mean(1))
    return Triples(rows[good], (a[good], b[good]), scale)
