"""How an object comes into a scene: the settings, the modes for comparison, and colours that follow the scene's."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, spacing, voxel_downsample
from scenefuse.core.stage import setting, threads
from scenefuse.core.transforms import Array, Sim3

FILL_SPACINGS = 1.5
"""Points farther than so many spacings of the scene from all of its points are new to it."""
GAINS = (0.5, 2.0)
"""Least and largest gain of an object's colours."""
FILL_RESIDUALS = 1.5
"""Points are new at no less than this many median distances between the clouds where both exist, so that noise does not
add a second layer."""
NEAR_SPACINGS = 10.0
"""Points of the scene within so many of its spacings of the object's box are held against it."""
FEATHER_SPACINGS = 4.0
"""Width of the seam over which colours blend, in spacings of the scene."""
LEAST_PAIRS = 50
"""Pairs of points that a gain and bias of colours need."""


@dataclass(frozen=True)
class FusionSettings:
    """How the object is added."""

    mode: Literal["evidence", "fill", "append", "replace"] = setting("evidence")
    """`evidence` checks the points of both sides in the photos of both and keeps what these confirm. For comparison,
    `fill` adds the object points that the scene lacks, `append` all of them, and `replace` puts the object in the place
    of the scene's points on it."""
    density: float = setting(0, least=0)
    """Spacing of the added points over the scene's; 0 keeps every point."""
    match_colors: bool = setting(True)
    """Whether the object's colours get a gain and bias per channel from the overlap."""
    nerf_only: bool = setting(False)
    """Whether points of the object that no photo confirms are added where nothing else is (`evidence` only)."""


@dataclass(frozen=True)
class Fusion:
    """The parts of a fused scene.

    Attributes:
        kept: (N,) bool over the scene's points.
        added: new points in the scene frame.
        gain: (3,) colour gain of the object.
        bias: (3,) colour bias, 0..255.
        fill_distance: distance from the scene within which both show the same place.
    """

    kept: NDArray[np.bool_]
    added: Cloud
    gain: Array
    bias: Array
    fill_distance: float


def fuse_clouds(obj: Cloud, scene: Cloud, part: Cloud, scene_from_object: Sim3, settings: FusionSettings) -> Fusion:
    """Decide what is added and what is taken away by distances alone: `fill`, `append` and `replace` (method F1).

    Args:
        obj: the object in its own frame.
        scene: the scene around it, or all of it.
        part: the scene's points on the object.
        scene_from_object: the registration.
        settings: see FusionSettings.
    """
    moved = obj.transformed(scene_from_object)
    step = spacing(part.points)
    near = np.flatnonzero(_near(scene, moved, NEAR_SPACINGS * step))
    near = near if len(near) else np.arange(len(scene))
    distance = cKDTree(scene.points[near]).query(moved.points, workers=threads())[0]
    fill = FILL_SPACINGS * step
    overlap = distance <= 3 * fill
    if overlap.sum() > LEAST_PAIRS:
        fill = max(fill, FILL_RESIDUALS * float(np.median(distance[overlap])))
    moved, gain, bias = with_colors_of(moved, scene[near], fill, settings.match_colors)
    kept = np.ones(len(scene), dtype=bool)
    if settings.mode == "fill":
        moved = moved[distance > fill]
    elif settings.mode == "replace":
        kept[near] = cKDTree(moved.points).query(scene.points[near], workers=threads())[0] > fill
    added = thinned(moved, settings.density * step)
    if settings.mode != "append":
        added = feathered(added, scene[near[kept[near]]], FEATHER_SPACINGS * step, fill)
    return Fusion(kept, added, gain, bias, fill)


def _near(scene: Cloud, obj: Cloud, reach: float) -> NDArray[np.bool_]:
    low, high = obj.points.min(0) - reach, obj.points.max(0) + reach
    return ((scene.points >= low) & (scene.points <= high)).all(1)


def with_colors_of(obj: Cloud, scene: Cloud, reach: float, wanted: bool) -> tuple[Cloud, Array, Array]:
    """The object with its colours brought to the scene's by pairs of points within `reach`; the gain and bias (3,)."""
    gain, bias = np.ones(3), np.zeros(3)
    if not wanted or obj.colors is None or scene.colors is None or len(scene) == 0:
        return obj, gain, bias
    distance, partner = cKDTree(scene.points).query(obj.points, distance_upper_bound=reach, workers=threads())
    close = np.isfinite(distance)
    if close.sum() < LEAST_PAIRS:
        return obj, gain, bias
    gain, bias = match_colors(obj.colors[close], scene.colors[partner[close]])
    return replace(obj, colors=_bytes(obj.colors * gain + bias)), gain, bias


def match_colors(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Gain and bias (3,) per channel with gain a + bias = b, from medians and median deviations of pairs (M, 3)."""
    mine, theirs = a.astype(np.float64), b.astype(np.float64)
    middle_a, middle_b = np.median(mine, axis=0), np.median(theirs, axis=0)
    wide_a = np.abs(mine - middle_a).mean(0)
    wide_b = np.abs(theirs - middle_b).mean(0)
    gain = np.clip(wide_b / np.maximum(wide_a, 1.0), *GAINS)
    return gain, middle_b - gain * middle_a


def thinned(cloud: Cloud, wanted: float) -> Cloud:
    """Thin a cloud to a median spacing of `wanted`; one that is sparser already stays as it is, and any with 0."""
    if wanted <= 0 or len(cloud) <= 10 or spacing(cloud.points) >= wanted:
        return cloud
    low, high = 0.3 * wanted, 2.0 * wanted
    best = cloud
    for _ in range(8):
        middle = float(np.sqrt(low * high))
        best = voxel_downsample(cloud, middle)
        if len(best) < 10 or spacing(best.points) > wanted:
            high = middle
        else:
            low = middle
    return best


def feathered(added: Cloud, kept: Cloud, width: float, fill: float) -> Cloud:
    """The added points with colours blended into what is kept, over `width` from the seam; no point moves.

    At the seam a point's colour is the mean of its own and its nearest kept neighbours'; the share of the neighbours
    falls linearly to nothing.
    """
    if len(kept) < 8 or len(added) == 0 or added.colors is None or kept.colors is None:
        return added
    distance, partner = cKDTree(kept.points).query(added.points, k=4, workers=threads())
    share = 0.5 * np.clip(1 - (distance[:, :1] - fill) / width, 0, 1)
    around = kept.colors[partner].astype(np.float64).mean(1)
    return replace(added, colors=_bytes((1 - share) * added.colors + share * around))


def _bytes(colors: Array) -> NDArray[np.uint8]:
    return np.clip(np.rint(colors), 0, 255).astype(np.uint8)
