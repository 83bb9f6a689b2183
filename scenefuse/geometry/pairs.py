"""Nearest neighbours of two surfaces at a pose, both ways, and the gain of colours between them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.transforms import Array, Sim3
from scenefuse.geometry.surface import Surface


@dataclass(frozen=True)
class Pairs:
    """Nearest neighbours both ways at one pose.

    Attributes:
        object_index: (M,) indices into the object's points.
        scene_index: (M,) indices into the scene's points.
        distance: (M,) distances in scene units, all within the threshold.
        forward: the first `forward` pairs go from object points to the scene, the rest from scene points to the object.
    """

    object_index: NDArray[np.int64]
    scene_index: NDArray[np.int64]
    distance: Array
    forward: int


def pair(obj: Surface, scene: Surface, scene_from_object: Sim3, tau: float) -> Pairs:
    """Nearest neighbours within `tau` (scene units), from the object to the scene and back.

    The object's own search serves at every pose: a similarity keeps the order of distances.
    """
    s = scene_from_object.scale
    ahead, there = scene.nearest(scene_from_object.apply(obj.points[obj.queries]), tau)
    back, here = obj.nearest(scene_from_object.inverse().apply(scene.points[scene.queries]), tau / s)
    found, met = np.isfinite(ahead), np.isfinite(back)
    return Pairs(
        np.concatenate([obj.queries[found], here[met]]),
        np.concatenate([there[found], scene.queries[met]]),
        np.concatenate([ahead[found], back[met] * s]),
        int(found.sum()),
    )


def color_gain(obj: Surface, scene: Surface, pairs: Pairs) -> tuple[Array, Array]:
    """Gain and bias (3,) per channel that bring the object's colours to the scene's over the pairs."""
    assert obj.colors is not None and scene.colors is not None
    a, b = obj.colors[pairs.object_index], scene.colors[pairs.scene_index]
    mean_a, mean_b = a.mean(0), b.mean(0)
    gain = ((a - mean_a) * (b - mean_b)).sum(0) / np.maximum(((a - mean_a) ** 2).sum(0), 1e-9)
    gain = np.clip(gain, 0.25, 4.0)
    return gain, mean_b - gain * mean_a
