"""A 3D view on its way into the page: the files that the figures leave, and the bytes that a browser reads.

The bytes are planes of one value a point: positions in 16 bits an axis along a space-filling curve, as differences, so
that they compress; everything else in 8 bits or less. About 8 bytes a point after zlib.
"""

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, plane_normals, read_cloud, write_cloud
from scenefuse.core.stage import StageError, quantity, read_json, threads, value, write_json
from scenefuse.core.transforms import Array
from scenefuse.report.render import point_radii
from scenefuse.report.view.view_points import AFTER, BEFORE, BOTH

Bytes = NDArray[np.uint8]

LIGHT = np.array([-0.39, -0.55, 0.74])
"""Where the light comes from that shades what is not in photo colours: high, from the left of the first picture."""
DARKEST = 0.45
"""Shade of a surface that faces away from the light."""
_CODES = {"before": BEFORE, "both": BOTH, "after": AFTER}
_SMOOTHED = 12
"""Points whose normals are averaged before they are lit."""
_RADIUS = 0.8
"""Radius over spacing: less than in the figures, as these discs face the camera from every side."""
LEVELS = 31
"""Steps of radii, shades and deviations: nobody sees more, and five bits compress better than eight."""


@dataclass(frozen=True)
class View:
    """What one 3D view shows.

    Attributes:
        cloud: the points (`view_points.merge`), z up.
        sources: name of each number in the field `source`.
        unit: of the scene's lengths.
        low, high: (3,) corners of the box that the first picture shows.
        azimuth_deg, elevation_deg: where it is seen from, counter-clockwise from x and above the horizontal.
        before_points, after_points: how many points there were before thinning.
        brighter: factor by which the colours are brighter than measured.
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
    brighter: float = 1.0


def write_view(folder: Path, view: View) -> None:
    """Write view.ply and view.json into a folder."""
    write_cloud(folder / "view.ply", view.cloud)
    about = {
        "sources": quantity({str(number): name for number, name in view.sources.items()}, ""),
        "low": quantity(view.low, view.unit),
        "high": quantity(view.high, view.unit),
        "azimuth_deg": quantity(view.azimuth_deg, "deg"),
        "elevation_deg": quantity(view.elevation_deg, "deg"),
        "before_points": quantity(view.before_points, "points"),
        "after_points": quantity(view.after_points, "points"),
        "brighter": quantity(view.brighter, "1"),
    }
    write_json(folder / "view.json", about)


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
        return View(
            cloud,
            {int(number): name for number, name in value(about, "sources").items()},
            about["low"]["unit"],
            np.array(value(about, "low")),
            np.array(value(about, "high")),
            value(about, "azimuth_deg"),
            value(about, "elevation_deg"),
            value(about, "before_points"),
            value(about, "after_points"),
            value(about, "brighter"),
        )
    except KeyError as error:
        raise StageError(f"{path} lacks {error}; delete it and rerun the stage that writes it") from None


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
    order = np.lexsort((_curve(cells), np.choose(shown, [1, 0, 2])))
    planes, about = _planes(cells[order], cloud[order])
    middle = (low + high) / 2
    about |= {
        "points": {name: int((shown == code).sum()) for name, code in _CODES.items()},
        "step": step.tolist(),
        "corner": (low - middle).tolist(),
        "low": (view.low - middle).tolist(),
        "high": (view.high - middle).tolist(),
        "azimuth": view.azimuth_deg,
        "elevation": view.elevation_deg,
        "unit": view.unit,
        "sources": {str(number): name for number, name in view.sources.items()},
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
        planes |= _difference_planes(name, column)
    if cloud.colors is not None:
        red, green, blue = cloud.colors.T
        # Bytes wrap around; differences to green compress better than red and blue do.
        planes |= {"green": green, "red_less_green": red - green, "blue_less_green": blue - green}
    radii = _radii(cloud)
    planes["radius_before"], planes["radius_after"], about["radius"] = _log_bytes(radii)
    planes["shade"] = np.rint(LEVELS * _shade(cloud)).astype(np.uint8)
    planes |= {name: cloud.fields[name].astype(np.uint8) for name in ("source", "evidence") if name in cloud.fields}
    deviation = cloud.fields.get("deviation")
    if deviation is not None and (deviation > 0).any():
        planes["deviation"], about["deviation"] = _deviation(deviation)
    return planes, about


def _curve(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) place of cells (N, 3) of 16 bits along the Morton curve."""
    keys = np.zeros(len(cells), dtype=np.int64)
    for bit in range(16):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return keys


def _difference_planes(name: str, column: NDArray[np.int64]) -> dict[str, Bytes]:
    """Differences of successive cells, modulo 2^16, small ones of either sign as small numbers; low and high bytes."""
    steps = (np.diff(column, prepend=0) + 32768) % 65536 - 32768
    folded = np.where(steps >= 0, 2 * steps, -2 * steps - 1)
    return {f"{name}_low": (folded & 255).astype(np.uint8), f"{name}_high": (folded >> 8).astype(np.uint8)}


def _radii(cloud: Cloud) -> NDArray[np.float32]:
    """(2, N) disc radii before and after, from the spacing of what is shown with a point; 0 where it is not shown."""
    radii = np.zeros((2, len(cloud)), dtype=np.float32)
    for row, absent in zip(radii, (AFTER, BEFORE)):
        shown = cloud.fields["shown"] != absent
        part = cloud[shown]
        row[shown] = point_radii(part.points, factor=_RADIUS, source=part.fields.get("source"))
    return radii


def _log_bytes(values: NDArray[np.float32]) -> tuple[Bytes, Bytes, list[float]]:
    """Two rows of positive values as 1 to LEVELS, in equal ratios between the range's ends; 0 stays 0."""
    low, high = float(values[values > 0].min()), float(values.max())
    ratio = np.log(max(high / low, 1.0 + 1e-9))
    scaled = 1 + np.rint((LEVELS - 1) * np.log(np.maximum(values, low) / low) / ratio)
    first, second = np.where(values > 0, scaled, 0).astype(np.uint8)
    return first, second, [low, high]


def _shade(cloud: Cloud) -> Array:
    """(N,) brightness from DARKEST to 1: the mean of the light on the normals and of the photo colours' brightness.

    Where there is neither, that of the light on local planes, from either side.
    """
    parts = []
    if cloud.normals is not None:
        parts.append(np.clip(0.4 + 0.7 * (_smooth(cloud.points, cloud.normals) @ LIGHT), 0, 1))
    if cloud.colors is not None:
        parts.append(cloud.colors @ np.array([0.299, 0.587, 0.114]) / 255)
    if not parts and len(cloud) < _SMOOTHED:
        return np.ones(len(cloud))
    if not parts:
        nearest = cKDTree(cloud.points).query(cloud.points, k=_SMOOTHED, workers=threads())[1]
        parts = [np.clip(np.abs(plane_normals(cloud.points, nearest) @ LIGHT), 0, 1)]
    return DARKEST + (1 - DARKEST) * np.mean(parts, axis=0)


def _smooth(points: Array, normals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Normals averaged over the nearest points: those of stereo are too noisy to be lit one by one."""
    nearest = cKDTree(points).query(points, k=min(_SMOOTHED, len(points)), workers=threads())[1]
    mean = normals[nearest.reshape(len(points), -1)].mean(1)
    return np.asarray(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-6), dtype=np.float32)


def _deviation(values: NDArray[np.float32]) -> tuple[Bytes, list[float]]:
    """Standard deviations as 1 to LEVELS in equal ratios between their 2nd and 98th percentile; 0: there is none."""
    known = np.isfinite(values) & (values > 0)
    low, high = (float(end) for end in np.percentile(values[known], [2, 98]))
    ratio = np.log(max(high / low, 1.0 + 1e-9))
    share = np.clip(np.log(np.where(known, values, low) / low) / ratio, 0, 1)
    return np.where(known, 1 + np.rint((LEVELS - 1) * share), 0).astype(np.uint8), [low, high]
