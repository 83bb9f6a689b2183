"""How large the object is in the scene: estimates from the clouds' extents, and the prior made of them."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from scenefuse.cloud.clouds import Cloud, voxel_downsample
from scenefuse.core.stage import quantity
from scenefuse.core.transforms import Array, rotation_between
from scenefuse.geometry.icp import ScaleRange

# Voxels even out the density of both clouds, as a share of their diagonal.
EVEN_FRACTION = 0.02
# An extent below this share of the diagonal is noise, of a flat roof seen from above for instance: no ratio of it.
MIN_EXTENT = 0.01


@dataclass(frozen=True)
class ScaleSettings:
    """Settings of the scale."""

    width_log: float = 0.5
    """Half width of the scale prior, natural logarithm: 0.5 searches from 0.6 to 1.6 times the estimate."""
    method: Literal["prior", "none"] = "prior"
    """`none` holds the scale at 1: the ablation without scale rectification."""


@dataclass(frozen=True)
class Estimate:
    """One estimate of the scale.

    Attributes:
        name: where it comes from.
        scale: scene units per object unit.
        used: whether the prior's centre uses it.
    """

    name: str
    scale: float
    used: bool


def scale_quantities(ledger: list[Estimate], scales: ScaleRange, method: str) -> dict[str, Any]:
    """The JSON of the scale; every estimate is printed."""
    for e in ledger:
        print(f"{e.name:12s} {e.scale:.5g}", flush=True)
    return {
        "scale": quantity(scales.centre, "scene units per object unit"),
        "width_log": quantity(scales.width, "1"),
        "method": quantity(method, ""),
        "spread_log": quantity(float(np.std([np.log(e.scale) for e in ledger])), "1"),
        "ledger": quantity([{"name": e.name, "scale": e.scale, "used": e.used} for e in ledger], ""),
    }


def estimates(obj: Cloud, scene: Cloud, ups: tuple[Array, Array] | None) -> list[Estimate]:
    """Every estimate of the scale; the paper's whole-cloud RMS ratio comes first.

    Gravity adds two: the footprint (root of the area of the horizontal convex hull, which a flight sees whole)
    and the height. Voxels even out the density first, except for the paper's. What is flat on either side, to 1 % of
    the diagonal, gives no estimate.
    """
    even_obj, even_scene = (voxel_downsample(c, EVEN_FRACTION * c.diagonal).points for c in (obj, scene))
    found = [
        Estimate("rms", rms(scene.points) / rms(obj.points), False),
        Estimate("rms_even", rms(even_scene) / rms(even_obj), True),
    ]
    if ups is None:
        extents = {"hull": [_hull_size(p) for p in (even_obj, even_scene)]}
    else:
        z = np.array([0.0, 0.0, 1.0])
        level = [p @ rotation_between(up, z).T for p, up in zip((even_obj, even_scene), ups)]
        extents = {
            "footprint": [_hull_size(p[:, :2]) for p in level],
            "height": [float(np.ptp(np.percentile(p[:, 2], [1, 99]))) for p in level],
        }
    least = [MIN_EXTENT * cloud.diagonal for cloud in (obj, scene)]
    for name, (of_object, of_scene) in extents.items():
        if of_object > least[0] and of_scene > least[1]:
            found.append(Estimate(name, of_scene / of_object, True))
    return found


def prior(ledger: list[Estimate], settings: ScaleSettings) -> ScaleRange:
    """The prior made of the estimates.

    Its centre is their upper quartile: what the crop lacks makes all of them too small, rarely too large. The
    registration finds the scale within its width.
    """
    if settings.method == "none":
        return ScaleRange(1.0, 0.0)
    centre = float(np.exp(np.percentile([np.log(e.scale) for e in ledger if e.used], 75)))
    return ScaleRange(centre, settings.width_log)


def rms(points: Array) -> float:
    """Root mean square distance of points from their centroid."""
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))


def _hull_size(points: Array) -> float:
    """The d-th root of the convex hull's volume (area in the plane); 0 where the points are flat."""
    try:
        return float(ConvexHull(points).volume ** (1 / points.shape[1]))
    except QhullError:
        return 0.0
