"""How an object comes into a scene: the settings, fusion by distances alone, colours that follow the scene's (F1)."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, spacing, voxel_downsample
from scenefuse.core.stage import setting, threads
from scenefuse.core.transforms import Array, Sim3
from scenefuse.fuse.compare import KEPT, REPLACED, SAME_PLACE_SPACINGS
from scenefuse.fuse.measure import FIELDS, unchecked
from scenefuse.fuse.write import Changes, Rows

# Points farther than SAME_PLACE_SPACINGS of the scene from all of its points are new to it, or so many median distances
# between the clouds where both exist, if that is more: noise does not add a second layer.
FILL_RESIDUALS = 1.5
# Least and largest gain of an object's colours, and pairs of points that it is computed from at least.
GAINS, MIN_PAIRS = (0.5, 2.0), 50
# Points of the scene within so many of its spacings of the object's box are compared with it.
NEAR_SPACINGS = 10.0
# Width of the seam over which colours blend, in spacings of the scene.
SEAM_SPACINGS = 4.0


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
class Fused:
    """A part of a scene with an object in it.

    Attributes:
        scene: its points with the fields of evidence.
        rows: (M,) rising, of these points, those that were checked.
        reason: (M,) uint8, KEPT or why the point is taken away.
        added: the object's points that come in, with the same fields.
        gain: (3,) colour gain of the object.
        bias: (3,) colour bias, 0..255.
        same_distance: distance within which both show the same place.
    """

    scene: Cloud
    rows: Rows
    reason: NDArray[np.uint8]
    added: Cloud
    gain: Array
    bias: Array
    same_distance: float

    @property
    def removed(self) -> Rows:
        """(R,) rows of the points that are taken away."""
        return self.rows[self.reason != KEPT]

    @property
    def kept(self) -> Cloud:
        """The part of the scene without them."""
        return self.scene[np.delete(np.arange(len(self.scene)), self.removed)]

    def changes(self, rows: Rows) -> Changes:
        """What changes in a scene's cloud that has the part's points in these rows (N,)."""
        fields = {name: self.scene.fields[name][self.rows] for name in FIELDS}
        return Changes(rows[self.rows], self.reason != KEPT, fields)


def fuse_by_distance(obj: Cloud, scene: Cloud, part: Cloud, pose: Sim3, settings: FusionSettings) -> Fused:
    """Decide what is added and what is taken away by distances alone: `fill`, `append` and `replace` (method F1).

    Args:
        obj: the object in its own frame.
        scene: the scene around it, or all of it.
        part: the scene's points on the object.
        pose: scene_from_object of the registration.
        settings: see FusionSettings.
    """
    moved, step = obj.transformed(pose), spacing(part.points)
    low, high = moved.points.min(0) - NEAR_SPACINGS * step, moved.points.max(0) + NEAR_SPACINGS * step
    near = np.flatnonzero(((scene.points >= low) & (scene.points <= high)).all(1))
    near = near if len(near) else np.arange(len(scene))
    distance = cKDTree(scene.points[near]).query(moved.points, workers=threads())[0]
    fill = SAME_PLACE_SPACINGS * step
    overlap = distance <= 3 * fill
    if overlap.sum() > MIN_PAIRS:
        fill = max(fill, FILL_RESIDUALS * float(np.median(distance[overlap])))
    moved, gain, bias = with_colors_of(moved, scene[near], fill, settings.match_colors)
    removed = near[:0]
    if settings.mode == "fill":
        moved = moved[distance > fill]
    elif settings.mode == "replace":
        removed = near[cKDTree(moved.points).query(scene.points[near], workers=threads())[0] <= fill]
    added = thinned(moved, settings.density * step)
    if settings.mode != "append":
        added = feathered(added, scene[np.setdiff1d(near, removed)], SEAM_SPACINGS * step, fill)
    reason = np.full(len(removed), REPLACED, np.uint8)
    return Fused(unchecked(scene), removed, reason, unchecked(added), gain, bias, fill)


def color_notes(fused: Fused, obj: Cloud, scene: Cloud) -> tuple[Fused, list[str]]:
    """The fusion, added points grey where only the scene has colours, and what a user should know of the colours."""
    notes = []
    if scene.colors is not None and obj.colors is None:
        notes.append("the object has no colours: its points are grey in the scene")
        grey = np.full((len(fused.added), 3), 128, np.uint8)
        fused = replace(fused, added=replace(fused.added, colors=grey))
    if np.isin(fused.gain, GAINS).any():
        notes.append(
            "the scene shows the object much darker or lighter, or with less or more contrast, than its own photos: its"
            f" colours are changed by the most that is done (gain {', '.join(f'{g:.2f}' for g in fused.gain)});"
            " fusion.match_colors: false leaves them as they are"
        )
    return fused, notes


def with_colors_of(obj: Cloud, scene: Cloud, reach: float, wanted: bool) -> tuple[Cloud, Array, Array]:
    """The object with its colours brought to the scene's by pairs of points within `reach`; the gain and bias (3,)."""
    gain, bias = np.ones(3), np.zeros(3)
    if not wanted or obj.colors is None or scene.colors is None or len(scene) == 0:
        return obj, gain, bias
    distance, partner = cKDTree(scene.points).query(obj.points, distance_upper_bound=reach, workers=threads())
    close = np.isfinite(distance)
    if close.sum() < MIN_PAIRS:
        return obj, gain, bias
    gain, bias = match_colors(obj.colors[close], scene.colors[partner[close]])
    return replace(obj, colors=_bytes(obj.colors * gain + bias)), gain, bias


def match_colors(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Gain and bias (3,) per channel with gain a + bias = b, from pairs (M, 3): medians and mean deviations."""
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
