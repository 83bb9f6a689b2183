"""A 3D view: a scene before and after, in one thinned cloud; its files, and the bytes that a browser reads.

A view's cloud has the fields `shown` (see Shown), `source`, and `near` (1 on what a reader wants to see), and
`evidence` and `deviation` where the completed cloud has them. Every point of it is a point of one of the two clouds:
none is averaged or moved.

The bytes are planes of one value a point: positions in 16 bits an axis along a space-filling curve, as differences, so
that they compress; everything else in 8 bits or less. About 8 bytes a point after zlib.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import (
    Cloud,
    concatenate,
    occupied_voxels,
    plane_normals,
    read_cloud,
    voxel_downsample,
    write_cloud,
)
from scenefuse.cloud.tiled_cloud import MORTON_BITS, morton
from scenefuse.core.stage import StageError, quantity, read_json, threads, value, write_json
from scenefuse.core.transforms import Array, inside_box
from scenefuse.report.render import brightened, luminance, point_radii

Bytes = NDArray[np.uint8]


class Shown(IntEnum):
    """When a point is shown."""

    BOTH, BEFORE, AFTER = range(3)


# `source` and `evidence` of a point that fusion took away.
REMOVED = 255
# Points of one view: with three objects and a scene, the page stays well below 15 MB.
VIEW_POINTS = 175_000
# How far around an object its view and its figures show the scene, over the object's diagonal.
REACH = 0.35
# How much farther apart points stand that are not near: a reader looks at the objects.
SURROUNDINGS_SPACING = 2.0
# Direction to the light that shades what is not in photo colours (high, from the left of the first picture), and the
# shade of a surface that faces away from it.
LIGHT, DARKEST_SHADE = np.array([-0.39, -0.55, 0.74]), 0.45
# Points of a local plane: the normals of stereo are too noisy to be lit one by one.
PLANE_POINTS = 12
# Steps of radii, shades and deviations: nobody sees more, and five bits compress better than eight.
LEVELS = 31


@dataclass(frozen=True)
class View:
    """What one 3D view shows.

    Attributes:
        cloud: the points (see `merge`), z up.
        sources: name of each number in the field `source`.
        unit: of the scene's lengths.
        low, high: (3,) corners of the box that the first picture shows.
        azimuth_deg, elevation_deg: where it is seen from, counter-clockwise from x and above the horizontal.
        before_points, after_points: how many points there were before thinning.
    """

    cloud: Cloud
    sources: dict[int, str]
    unit: str
    low: Array
    high: Array
    azimuth_deg: float
    elevation_deg: float
    before_points: int
    after_points: int


def merge(before: Cloud, after: Cloud) -> Cloud:
    """Both clouds as one view; a point in both, of the same colour, is held once, as it is in `after`.

    A point that is in both with two colours is held twice; one that only `before` has gets the source REMOVED. All are
    near.
    """
    low = np.minimum(before.points.min(0), after.points.min(0))
    high = np.maximum(before.points.max(0), after.points.max(0))
    # Two points in one cell, a twentieth of a millimetre on 100 m, are the same.
    step = max(float(np.linalg.norm(high - low)) / (2**MORTON_BITS - 2), 1e-300)
    places, tints = zip(*((_places(cloud, low, step), _tints(cloud)) for cloud in (before, after)))
    keys = [place ^ tint for place, tint in zip(places, tints)]
    only_before, only_after = _not_in(keys[0], keys[1]), _not_in(keys[1], keys[0])
    gone = _not_in(places[0], places[1])
    first = _with_fields(before, np.where(gone, REMOVED, 0), Shown.BEFORE, after)[only_before]
    second = _with_fields(after, after.fields.get("source", np.zeros(len(after))), Shown.BOTH, after)
    second.fields["shown"][only_after] = Shown.AFTER
    return concatenate([first, second]) if len(first) else second


def view_of(
    before: Cloud,
    after: Cloud,
    low: Array,
    high: Array,
    sources: dict[int, str],
    unit: str,
    azimuth_deg: float,
    elevation_deg: float = 20.0,
    near: Sequence[tuple[Array, Array]] = (),
) -> View:
    """Both clouds as one thinned view of the box from `low` to `high`; near is what lies in the boxes `near`, else in
    that one."""
    points = merge(*brightened(before, after))
    points.fields["near"][:] = np.any([within(points.points, *box) for box in near or [(low, high)]], axis=0)
    counts = len(before), len(after)
    return View(thin(points, VIEW_POINTS), sources, unit, low, high, azimuth_deg, elevation_deg, *counts)


def thin(points: Cloud, limit: int) -> Cloud:
    """At most that many points of a view, evenly spaced; those that are not near stand farther apart.

    What is shown before, after or both is thinned by itself, so that neither picture gets holes from the other.
    """
    if len(points) <= limit:
        return points
    shown, is_near = points.fields["shown"], points.fields["near"]
    parts = [
        (points[(shown == when) & (is_near == near)], 1.0 if near else SURROUNDINGS_SPACING)
        for when in Shown
        for near in (1, 0)
    ]
    parts = [(part, factor) for part, factor in parts if len(part)]
    voxel = points.diagonal / np.sqrt(limit)
    for _ in range(20):
        count = sum(occupied_voxels(part.points, voxel * factor) for part, factor in parts)
        if 0.92 * limit <= count <= limit:
            break
        # Points lie on surfaces: their number falls with the square of the voxel.
        voxel *= np.sqrt(count / (0.96 * limit))
    return concatenate([voxel_downsample(part, voxel * factor, mean_colors=True) for part, factor in parts])


def within(points: Array, low: Array, high: Array, margin: float = 0.05) -> NDArray[np.bool_]:
    """(N,) whether points lie in a box that is widened by a share of its diagonal."""
    return inside_box(points, low, high, margin * float(np.linalg.norm(np.subtract(high, low))))


def _not_in(keys: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which of some keys are not among others; by hashing, 25 times as fast as NumPy's sorting."""
    return ~pd.Series(keys).isin(others).to_numpy()


def _places(cloud: Cloud, low: Array, step: float) -> NDArray[np.int64]:
    """(N,) one number for a position."""
    cells = np.rint((cloud.points - low) / step).astype(np.int64)
    return (cells[:, 0] << 2 * MORTON_BITS) | (cells[:, 1] << MORTON_BITS) | cells[:, 2]


def _tints(cloud: Cloud) -> NDArray[np.int64]:
    """(N,) one number for a colour, spread over 63 bits so that it mixes with a position's."""
    if cloud.colors is None:
        return np.zeros(len(cloud), dtype=np.int64)
    packed = cloud.colors.astype(np.uint64) @ np.array([1 << 16, 1 << 8, 1], dtype=np.uint64)
    return ((packed * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(1)).astype(np.int64)


def _with_fields(cloud: Cloud, source: NDArray[np.generic], shown: Shown, after: Cloud) -> Cloud:
    """The cloud with the fields of a view, and those of `after` filled up where it lacks them."""
    count = len(cloud)
    fields = {"shown": np.full(count, shown, dtype=np.uint8), "source": np.asarray(source).astype(np.uint8)}
    fields["near"] = np.ones(count, dtype=np.uint8)
    for name, kind, absent in (("evidence", np.uint8, REMOVED), ("deviation", np.float32, np.nan)):
        if name in after.fields:
            fields[name] = np.asarray(cloud.fields.get(name, np.full(count, absent))).astype(kind)
    return replace(cloud, fields=fields)


def write_view(folder: Path, view: View) -> None:
    """Write view.ply and view.json into a folder."""
    write_cloud(folder / "view.ply", view.cloud)
    units = {"low": view.unit, "high": view.unit, "azimuth_deg": "deg", "elevation_deg": "deg"}
    units |= dict.fromkeys(("before_points", "after_points"), "points")
    about = {name: item for name, item in vars(view).items() if name not in ("cloud", "unit")}
    about["sources"] = {str(number): name for number, name in view.sources.items()}
    write_json(folder / "view.json", {name: quantity(item, units.get(name, "")) for name, item in about.items()})


def read_view(folder: Path) -> View | None:
    """The view of a folder; None where it has none.

    Raises:
        StageError: one of its files is missing or damaged.
    """
    path = folder / "view.json"
    if not path.is_file():
        return None
    about, cloud = read_json(path), read_cloud(folder / "view.ply")
    try:
        found = {name: value(about, name) for name in about}
        found["sources"] = {int(number): name for number, name in found["sources"].items()}
        found |= {"low": np.array(found["low"]), "high": np.array(found["high"]), "unit": about["low"]["unit"]}
        return View(cloud, **found)
    except (KeyError, TypeError) as error:
        raise StageError(f"{path} is damaged ({error}); delete it and rerun the stage that writes it") from None


def encode(view: View) -> tuple[dict[str, Any], bytes]:
    """A view as what the page's script reads: a description for JSON, and zlib-compressed planes.

    Positions are relative to the middle of the view's points; they are exact to `step` / 2 on each axis.
    """
    cloud = view.cloud
    low, high = cloud.points.min(0), cloud.points.max(0)
    step = np.maximum(high - low, 1e-12) / 65535
    cells = np.rint((cloud.points - low) / step).astype(np.int64)
    shown = cloud.fields["shown"]
    # What is shown before, then both, then after: each picture is one run of points.
    order = np.lexsort((morton(cells), np.choose(shown, [1, 0, 2])))
    planes, about = _planes(cells[order], cloud[order])
    middle = (low + high) / 2
    about |= {
        "points": {when.name.lower(): int((shown == when).sum()) for when in Shown},
        "step": step.tolist(),
        "corner": (low - middle).tolist(),
        "low": (view.low - middle).tolist(),
        "high": (view.high - middle).tolist(),
        "azimuth": view.azimuth_deg,
        "elevation": view.elevation_deg,
        "unit": view.unit,
        "levels": LEVELS,
        "total": {"before": view.before_points, "after": view.after_points},
        "planes": list(planes),
    }
    return about, zlib.compress(b"".join(plane.tobytes() for plane in planes.values()), 9)


def _planes(cells: NDArray[np.int64], cloud: Cloud) -> tuple[dict[str, Bytes], dict[str, Any]]:
    """The planes of points in their final order, and the ranges of what is packed between two ends."""
    planes: dict[str, Bytes] = {}
    about: dict[str, Any] = {}
    for name, column in zip("xyz", cells.T):
        planes |= difference_planes(name, column)
    planes |= color_planes(cloud)
    radii = _radii(cloud)
    about["radius"] = [float(radii[radii > 0].min()), float(radii.max())]
    planes["radius_before"], planes["radius_after"] = log_levels(radii, *about["radius"])
    planes["shade"] = np.rint(LEVELS * _shade(cloud)).astype(np.uint8)
    planes |= {name: cloud.fields[name].astype(np.uint8) for name in ("source", "evidence") if name in cloud.fields}
    deviation = np.nan_to_num(cloud.fields.get("deviation", np.zeros(0)), posinf=0.0)
    if (deviation > 0).any():
        about["deviation"] = [float(end) for end in np.percentile(deviation[deviation > 0], [2, 98])]
        planes["deviation"] = log_levels(deviation, *about["deviation"])
    return planes, about


def color_planes(cloud: Cloud) -> dict[str, Bytes]:
    """Planes of the colours; none without."""
    if cloud.colors is None:
        return {}
    red, green, blue = cloud.colors.T
    # Bytes wrap around; differences to green compress better than red and blue do.
    return {"green": green, "red_less_green": red - green, "blue_less_green": blue - green}


def difference_planes(name: str, column: NDArray[np.int64]) -> dict[str, Bytes]:
    """Differences of successive cells, modulo 2^16, small ones of either sign as small numbers; low and high bytes."""
    steps = (np.diff(column, prepend=0) + 32768) % 65536 - 32768
    folded = np.where(steps >= 0, 2 * steps, -2 * steps - 1)
    return {f"{name}_low": (folded & 255).astype(np.uint8), f"{name}_high": (folded >> 8).astype(np.uint8)}


def _radii(cloud: Cloud) -> NDArray[np.float32]:
    """(2, N) disc radii before and after, from the spacing of what is shown with a point; 0 where it is not shown."""
    radii = np.zeros((2, len(cloud)), dtype=np.float32)
    for row, absent in zip(radii, (Shown.AFTER, Shown.BEFORE)):
        shown = cloud.fields["shown"] != absent
        part = cloud[shown]
        row[shown] = point_radii(part.points, source=part.fields.get("source"))
    return radii


def log_levels(values: NDArray[np.floating], low: float, high: float) -> Bytes:
    """Positive values as 1 to LEVELS, in equal ratios between two ends; anything else is 0."""
    ratio = np.log(max(high / low, 1.0 + 1e-9))
    share = np.clip(np.log(np.maximum(values, low) / low) / ratio, 0, 1)
    return np.where(values > 0, 1 + np.rint((LEVELS - 1) * share), 0).astype(np.uint8)


def _shade(cloud: Cloud) -> Array:
    """(N,) brightness from DARKEST_SHADE to 1: the mean of the light on local planes, from either side, and of the
    colours' brightness."""
    if len(cloud) < PLANE_POINTS:
        return np.ones(len(cloud))
    nearest = cKDTree(cloud.points).query(cloud.points, k=PLANE_POINTS, workers=threads())[1]
    parts = [np.abs(plane_normals(cloud.points, nearest) @ LIGHT)]
    if cloud.colors is not None:
        parts.append(luminance(cloud.colors) / 255)
    return DARKEST_SHADE + (1 - DARKEST_SHADE) * np.mean(parts, axis=0)
