"""An object's cloud as it comes from elsewhere, and what a person who marks it in a scene clicks."""

import numpy as np
from scipy.spatial.transform import Rotation

from scenefuse.core.transforms import Array, Sim3

# One standard deviation of how far marks are off, over the object's diagonal.
MISS_SHARE = 0.01


def marks_of(surface: Array, diagonal: float, seed: int) -> Array:
    """(6, 3) the ends of a surface (N, 3) along the axes, missed a little."""
    ends = np.concatenate([surface[surface.argmin(0)], surface[surface.argmax(0)]])
    return ends + np.random.default_rng(seed).normal(0, MISS_SHARE * diagonal, ends.shape)


def frame_of_its_own(seed: int) -> Sim3:
    """A turn, a move and a scale at random."""
    rng, turn = np.random.default_rng(seed), Rotation.random(random_state=seed).as_matrix()
    return Sim3(float(np.exp(rng.uniform(-2, 2))), turn, rng.normal(0, 100, 3))
