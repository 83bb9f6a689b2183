"""The points of a 3D view: a scene before and after, told apart, and thinned to what a page can hold.

A view is a cloud with the fields `shown` (BOTH, BEFORE or AFTER), `source`, and `near` (1 on what one wants to see);
`evidence` and `deviation` where the completed cloud has them. Every point of it is a point of one of the two clouds:
none is averaged or moved.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, concatenate, occupied_voxels, voxel_downsample
from scenefuse.core.transforms import Array

BOTH, BEFORE, AFTER = 0, 1, 2
REMOVED, UNKNOWN = 255, 255
"""`source` of a point that fusion took away; `evidence` of a point that the completed cloud does not hold."""
SURROUNDINGS_SPACING = 2.0
"""How much farther apart points stand that are not near: one looks at the objects."""
_SAME = 5e-7
"""Points closer than this share of the diagonal are the same: 21 bits an axis, a twentieth of a millimetre on 100 m."""


def merge(before: Cloud, after: Cloud) -> Cloud:
    """Both clouds as one view; a point in both, of the same colour, is held once, as it is in `after`.

    A point that is in both with two colours is held twice; one that only `before` has gets the source REMOVED. All are
    near.
    """
    low = np.minimum(before.points.min(0), after.points.min(0))
    high = np.maximum(before.points.max(0), after.points.max(0))
    step = max(float(np.linalg.norm(high - low)) * _SAME, 1e-300)
    places, tints = zip(*((_places(cloud, low, step), _tints(cloud)) for cloud in (before, after)))
    keys = [place ^ tint for place, tint in zip(places, tints)]
    only_before, only_after = _not_in(keys[0], keys[1]), _not_in(keys[1], keys[0])
    gone = _not_in(places[0], places[1])
    first = _view(before, np.where(gone, REMOVED, 0), BEFORE, after)[only_before]
    second = _view(after, after.fields.get("source", np.zeros(len(after))), BOTH, after)
    second.fields["shown"][only_after] = AFTER
    return concatenate([first, second]) if len(first) else second


def thin(view: Cloud, most: int) -> Cloud:
    """At most that many points of a view, evenly spaced; those that are not near stand farther apart.

    What is shown before, after or both is thinned by itself, so that neither picture gets holes from the other.
    """
    if len(view) <= most:
        return view
    parts = [
        (view[(view.fields["shown"] == shown) & (view.fields["near"] == near)], 1.0 if near else SURROUNDINGS_SPACING)
        for shown in (BOTH, BEFORE, AFTER)
        for near in (1, 0)
    ]
    parts = [(part, factor) for part, factor in parts if len(part)]
    voxel = view.diagonal / np.sqrt(most)
    for _ in range(20):
        count = sum(occupied_voxels(part.points, voxel * factor) for part, factor in parts)
        if 0.92 * most <= count <= most:
            break
        # Points lie on surfaces: their number falls with the square of the voxel.
        voxel *= np.sqrt(count / (0.96 * most))
    return concatenate([voxel_downsample(part, voxel * factor, mean_colors=True) for part, factor in parts])


def within(points: Array, low: Array, high: Array, margin: float = 0.05) -> NDArray[np.bool_]:
    """(N,) whether points lie in a box that is widened by a share of its diagonal."""
    wider = margin * float(np.linalg.norm(np.subtract(high, low)))
    return np.asarray(((points >= low - wider) & (points <= high + wider)).all(1))


def _not_in(keys: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of some keys are not among others; by hashing, 25 times as fast as NumPy's sorting."""
    return ~pd.Series(keys).isin(others).to_numpy()


def _places(cloud: Cloud, low: Array, step: float) -> NDArray[np.int64]:
    """(N,) one number for a position, 21 bits an axis."""
    cells = np.rint((cloud.points - low) / step).astype(np.int64)
    return (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2]


def _tints(cloud: Cloud) -> NDArray[np.int64]:
    """(N,) one number for a colour, spread over 63 bits so that it mixes with a position's."""
    if cloud.colors is None:
        return np.zeros(len(cloud), dtype=np.int64)
    packed = cloud.colors.astype(np.uint64) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint64)
    return ((packed * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(1)).astype(np.int64)


def _view(cloud: Cloud, source: NDArray[np.generic], shown: int, after: Cloud) -> Cloud:
    """The cloud with the fields of a view, and those of `after` filled up where it lacks them."""
    count = len(cloud)
    fields = {"shown": np.full(count, shown, dtype=np.uint8), "source": np.asarray(source).astype(np.uint8)}
    fields["near"] = np.ones(count, dtype=np.uint8)
    for name, kind, absent in (("evidence", np.uint8, UNKNOWN), ("deviation", np.float32, np.nan)):
        if name in after.fields:
            fields[name] = np.asarray(cloud.fields.get(name, np.full(count, absent))).astype(kind)
    return replace(cloud, fields=fields)
