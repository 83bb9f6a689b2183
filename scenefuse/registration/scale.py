"""How large the object is in the scene: every estimate we have, and the prior made of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from scenefuse.io.clouds import Cloud, read_cloud, voxel_downsample
from scenefuse.registration.evidence import known_ups
from scenefuse.registration.refine import ScaleRange
from scenefuse.stage import quantity, write_json
from scenefuse.transforms import Array, rotation_between


@dataclass(frozen=True)
class Estimate:
    """One opinion on the scale.

    Attributes:
        name: where it comes from.
        scale: scene units per object unit.
        used: whether the prior's centre uses it.
    """

    name: str
    scale: float
    used: bool


def estimate_scale(
    *,
    object: Path,
    crop: Path,
    crop_report: Path,
    cameras: Path | None = None,
    report: Path,
    method: Literal["rms", "prior", "none"],
    width_log: float,
) -> None:
    """Estimate scene units per object unit before any pose is known (method R1 to R3).

    `rms` is the paper's: the ratio of the root mean square distances to the centroids of the whole clouds, held
    fixed afterwards. `prior` takes the upper quartile of all estimates of extent as the centre of a prior with a width;
    the registration finds the scale inside. `none` holds the scale at 1: the ablation without scale rectification.

    Args:
        object: object cloud (PLY).
        crop: scene crop (PLY).
        crop_report: JSON of the crop stage, for `up_in_scene`.
        cameras: JSON with `up_in_camera_frame`, or nothing.
        report: output JSON: `scale`, `width_log` and the `ledger` of all estimates.
        method: rms, prior or none.
        width_log: half width of the prior, natural logarithm of the scale; used by `prior` only.
    """
    obj, scene = read_cloud(object), read_cloud(crop)
    ledger = estimates(obj, scene, known_ups(cameras, crop_report))
    scales = prior(ledger, method, width_log)
    for e in ledger:
        print(f"{e.name:12s} {e.scale:.5g}", flush=True)
    spread = float(np.std([np.log(e.scale) for e in ledger]))
    write_json(
        report,
        {
            "scale": quantity(scales.centre, "scene units per object unit"),
            "width_log": quantity(scales.width, "1"),
            "method": quantity(method, ""),
            "spread_log": quantity(spread, "1"),
            "ledger": quantity([{"name": e.name, "scale": e.scale, "used": e.used} for e in ledger], ""),
        },
    )


def estimates(obj: Cloud, scene: Cloud, ups: tuple[Array, Array] | None) -> list[Estimate]:
    """Every estimate of the scale; the paper's whole-cloud RMS ratio comes first.

    Gravity adds two: the footprint (root of the area of the horizontal convex hull, which a flight sees whole)
    and the height. Voxels even out the density first, except for the paper's.
    """
    even_obj, even_scene = (voxel_downsample(c, 0.02 * c.diagonal).points for c in (obj, scene))
    found = [
        Estimate("rms", _rms(scene.points) / _rms(obj.points), False),
        Estimate("rms_even", _rms(even_scene) / _rms(even_obj), True),
    ]
    if ups is None:
        found.append(Estimate("hull", _hull_size(even_scene) / _hull_size(even_obj), True))
        return found
    z = np.array([0.0, 0.0, 1.0])
    a, b = even_obj @ rotation_between(ups[0], z).T, even_scene @ rotation_between(ups[1], z).T
    heights = [float(np.ptp(np.percentile(p[:, 2], [1, 99]))) for p in (a, b)]
    found.append(Estimate("footprint", _hull_size(b[:, :2]) / _hull_size(a[:, :2]), True))
    found.append(Estimate("height", heights[1] / max(heights[0], 1e-12), True))
    return found


def prior(ledger: list[Estimate], method: str, width_log: float) -> ScaleRange:
    """The prior that a method of `estimate_scale` makes of the estimates."""
    if method == "none":
        return ScaleRange(1.0, 0.0)
    if method == "rms":
        return ScaleRange(ledger[0].scale, 0.0)
    return ScaleRange(prior_centre(ledger), width_log)


def prior_centre(ledger: list[Estimate]) -> float:
    """The upper quartile of the used estimates: what the crop lacks makes all of them too small, rarely too large."""
    return float(np.exp(np.percentile([np.log(e.scale) for e in ledger if e.used], 75)))


def _rms(points: Array) -> float:
    return float(np.sqrt(((points - points.mean(0)) ** 2).sum(1).mean()))


def _hull_size(points: Array) -> float:
    """The d-th root of the convex hull's volume (area in the plane); the RMS size where the points are flat."""
    try:
        return float(ConvexHull(points).volume ** (1 / points.shape[1]))
    except QhullError:
        return _rms(points)
