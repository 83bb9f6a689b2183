"""What a person who marks an object in a cloud clicks."""

import numpy as np

from scenefuse.transforms import Array

OFF = 0.01
"""How far off the marks are clicked, one standard deviation over the object's diagonal."""


def marks_of(surface: Array, diagonal: float, seed: int) -> Array:
    """(6, 3) the ends of a surface (N, 3) along the axes, not quite met."""
    ends = np.concatenate([surface[surface.argmin(0)], surface[surface.argmax(0)]])
    return ends + np.random.default_rng(seed).normal(0, OFF * diagonal, ends.shape)
