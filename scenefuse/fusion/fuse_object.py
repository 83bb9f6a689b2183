"""Fusion: what the object knows and the scene lacks, added to the scene with its provenance."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.io.clouds import Cloud, concatenate, read_cloud, spacing, voxel_downsample, write_cloud, write_laz
from scenefuse.io.units import length_unit
from scenefuse.sfm.geodesy import scene_frame
from scenefuse.stage import quantity, read_json, setting, threads, value, write_json
from scenefuse.transforms import Array, Sim3

FROM_SCENE, FROM_OBJECT = 0, 1


@dataclass(frozen=True)
class FusionSettings:
    """How the object is added. Spacing is the median distance between neighbours in the scene crop."""

    mode: Literal["fill", "append", "replace"] = setting("fill")
    """`fill` adds the object points that the scene lacks, `append` all of them; `replace` puts the object in the place
    of the scene's points on it."""
    fill_spacings: float = setting(1.5, least=0)
    """Object points farther than this many spacings from every scene point are new."""
    density: float = setting(1, least=0)
    """Spacing of the added points over the scene's; 0 keeps every object point."""
    match_colors: bool = setting(True)
    """Whether the object's colours get a gain and bias per channel from the overlap."""
    fill_residuals: float = 1.5
    """Points are new at no less than this many median distances between the clouds where both exist, so that noise
    does not add a second layer."""
    feather_spacings: float = 4
    """Width of the seam in spacings: colours, and in `replace` positions too, blend over it."""
    min_confidence: float = 0
    """Object points with a lower confidence are not used; the object's cloud has a limit of its own."""


@dataclass(frozen=True)
class FusionInputs:
    """What the fusion of one object reads."""

    object: Path
    """Object cloud (PLY) in its own frame."""
    scene: Path
    """Dense scene cloud (PLY)."""
    crop: Path
    """The scene's points on the object (PLY)."""
    crop_json: Path
    """JSON of the crop stage, for the box."""
    fine_json: Path
    """JSON of the fine registration."""
    georeference_json: Path | None = None
    """JSON with `crs` and `crs_from_scene` for the LAZ file, or nothing."""


@dataclass(frozen=True)
class Fusion:
    """The parts of a fused scene.

    Attributes:
        kept: (N,) bool over the scene's points.
        added: new points in the scene frame, with `source`, `confidence`, `views`.
        gain: (3,) colour gain of the object.
        bias: (3,) colour bias, 0..255.
        fill_distance: distance from the scene at which object points are new.
    """

    kept: NDArray[np.bool_]
    added: Cloud
    gain: Array
    bias: Array
    fill_distance: float


def fuse_object(
    *, inputs: FusionInputs, fused: Path, fused_scene: Path, fused_laz: Path, report: Path, settings: FusionSettings
) -> None:
    """Add a registered object to the scene (method F1, F2); an unregistered one leaves the scene as it is.

    `append` adds every object point; `fill` those the scene lacks; `replace` takes the scene's points on the object
    away and puts the object in their place, with a feathered seam.

    Args:
        inputs: see FusionInputs.
        fused: output PLY, the object's surroundings: the scene in the crop's box and what was added.
        fused_scene: output PLY, the whole scene with what was added.
        fused_laz: output LAZ of the same, in the CRS where the scene is georeferenced, else in scene units without one.
        report: output JSON: counts, distances, gain, status.
        settings: see FusionSettings.
    """
    start = time.perf_counter()
    whole = with_provenance(read_cloud(inputs.scene), FROM_SCENE)
    registration = read_json(inputs.fine_json)
    part, obj = read_cloud(inputs.crop), read_cloud(inputs.object)
    fusion = fuse_registered(obj, whole, part, registration, settings)
    if not is_placed(registration):
        print(f"the object is not fused: {value(registration, 'reason')}", flush=True)
    kept = whole[fusion.kept]
    around = _in_box(kept, read_json(inputs.crop_json))
    write_cloud(fused, _together(around, fusion.added))
    crs = write_scene(fused_scene, fused_laz, _together(kept, fusion.added), inputs.georeference_json)
    unit = length_unit(inputs.georeference_json)
    content = _report(fusion, registration, spacing(part.points), unit) | {
        "mode": quantity(settings.mode, ""),
        "object_points": quantity(len(obj), "points"),
        "surroundings_points": quantity(len(around) + len(fusion.added), "points"),
        "crs": quantity(crs, ""),
        "seconds": quantity(time.perf_counter() - start, "s"),
    }
    write_json(report, content)


def _report(fusion: Fusion, registration: dict[str, Any], scene_spacing: float, unit: str) -> dict[str, Any]:
    """What was added and taken away, with units."""
    added = fusion.added
    return {
        "status": quantity("fused" if is_placed(registration) else "unregistered", ""),
        "registration": quantity(value(registration, "status"), ""),
        "reason": quantity(value(registration, "reason"), ""),
        "scene_points": quantity(len(fusion.kept), "points"),
        "removed_points": quantity(int((~fusion.kept).sum()), "points"),
        "added_points": quantity(len(added), "points"),
        "scene_spacing": quantity(scene_spacing, unit),
        "added_spacing": quantity(spacing(added.points) if len(added) > 10 else None, unit),
        "fill_distance": quantity(fusion.fill_distance, unit),
        "color_gain": quantity(fusion.gain, "1"),
        "color_bias": quantity(fusion.bias, "of 255"),
    }


def _in_box(cloud: Cloud, crop_json: dict[str, Any]) -> Cloud:
    """The points in the box of a crop stage."""
    low, high = np.array(value(crop_json, "box_low")), np.array(value(crop_json, "box_high"))
    levelled = cloud.points @ np.array(value(crop_json, "level_from_scene")).T
    return cloud[((levelled >= low) & (levelled <= high)).all(1)]


def _together(kept: Cloud, added: Cloud) -> Cloud:
    return concatenate([kept, added]) if len(added) else kept


def is_placed(registration: dict[str, Any]) -> bool:
    """Whether a fine registration's JSON puts the object into the scene: accepted, or made without any check."""
    return value(registration, "status") in ("registered", "ungated")


def fuse_registered(
    obj: Cloud, scene: Cloud, part: Cloud, registration: dict[str, Any], settings: FusionSettings
) -> Fusion:
    """`fuse_clouds` at the pose of a fine registration's JSON; an unregistered object leaves the scene as it is."""
    if is_placed(registration):
        pose = Sim3.from_matrix(np.array(value(registration, "scene_from_object")))
        return fuse_clouds(obj, scene, part, pose, settings)
    nothing = with_provenance(obj, FROM_OBJECT)[np.zeros(len(obj), dtype=bool)]
    return Fusion(np.ones(len(scene), dtype=bool), nothing, np.ones(3), np.zeros(3), 0.0)


def fuse_clouds(obj: Cloud, scene: Cloud, part: Cloud, scene_from_object: Sim3, settings: FusionSettings) -> Fusion:
    """Decide what is added and what is taken away; see `fuse_object`.

    Args:
        obj: the object in its own frame.
        scene: the whole scene, with provenance.
        part: the scene's points on the object.
        scene_from_object: the registration.
        settings: see FusionSettings.
    """
    moved = with_provenance(obj, FROM_OBJECT).transformed(scene_from_object)
    moved = moved[moved.fields["confidence"] >= settings.min_confidence]
    step = spacing(part.points)
    low, high = moved.points.min(0), moved.points.max(0)
    reach = 10 * step
    near = ((scene.points >= low - reach) & (scene.points <= high + reach)).all(1)
    tree = cKDTree(scene.points[near] if near.any() else scene.points)
    local = scene[near] if near.any() else scene
    distance, partner = tree.query(moved.points, workers=threads())
    fill = settings.fill_spacings * step
    overlap = distance <= 3 * fill
    if overlap.sum() > 50:
        fill = max(fill, settings.fill_residuals * float(np.median(distance[overlap])))
    gain, bias = np.ones(3), np.zeros(3)
    if settings.match_colors and moved.colors is not None and local.colors is not None:
        close = distance <= fill
        if close.sum() >= 50:
            gain, bias = match_colors(moved.colors[close], local.colors[partner[close]])
            moved = replace(moved, colors=_bytes(moved.colors * gain + bias))
    kept = np.ones(len(scene), dtype=bool)
    if settings.mode == "fill":
        moved = moved[distance > fill]
    elif settings.mode == "replace":
        index = np.flatnonzero(near)
        to_object = cKDTree(moved.points).query(scene.points[index], workers=threads())[0]
        kept[index[to_object <= fill]] = False
    added = _thin(moved, settings.density * step) if settings.density > 0 and len(moved) > 10 else moved
    if settings.mode != "append" and len(added) and kept.any():
        width = settings.feather_spacings * step
        added = _feather(added, scene[kept & near], width, settings.mode == "replace", fill)
    return Fusion(kept, added, gain, bias, fill)


def match_colors(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Gain and bias (3,) per channel with gain a + bias = b, from medians and median deviations of pairs (M, 3)."""
    mine, theirs = a.astype(np.float64), b.astype(np.float64)
    middle_a, middle_b = np.median(mine, axis=0), np.median(theirs, axis=0)
    wide_a = np.abs(mine - middle_a).mean(0)
    wide_b = np.abs(theirs - middle_b).mean(0)
    gain = np.clip(wide_b / np.maximum(wide_a, 1.0), 0.5, 2.0)
    return gain, middle_b - gain * middle_a


def with_provenance(cloud: Cloud, source: int) -> Cloud:
    """The cloud with `source` (uint8), `confidence` (float32) and `views` (int32), measured ones where it has them."""
    n, had = len(cloud), cloud.fields
    fields: dict[str, NDArray[Any]] = {
        "source": had.get("source", np.full(n, source)).astype(np.uint8),
        "confidence": had.get("confidence", np.ones(n)).astype(np.float32),
        "views": had.get("views", np.zeros(n)).astype(np.int32),
    }
    return replace(cloud, fields=fields)


def write_scene(ply: Path, laz: Path, cloud: Cloud, georeference: Path | None) -> str | None:
    """Write a cloud in the scene's frame as PLY, and as LAZ in the scene's CRS; returns that CRS, None without one."""
    write_cloud(ply, cloud)
    frame = None if georeference is None else scene_frame(read_json(georeference))
    if frame is None:
        write_laz(laz, cloud, np.zeros(3), None)
        return None
    origin = frame.in_crs(np.zeros((1, 3)))[0]
    write_laz(laz, replace(cloud, points=frame.in_crs(cloud.points) - origin), origin, frame.crs)
    return frame.crs


def _thin(cloud: Cloud, wanted: float) -> Cloud:
    """Thin a cloud to a median spacing of `wanted`; one that is sparser already stays as it is."""
    if spacing(cloud.points) >= wanted:
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


def _feather(added: Cloud, kept: Cloud, width: float, move: bool, fill: float) -> Cloud:
    """Blend added points into what is kept, over `width` from the seam: colours, and positions when `move` is set.

    At the seam a point takes the mean of its own and its nearest kept neighbours' values; the share of the
    neighbours falls linearly to nothing.
    """
    if width <= 0 or len(kept) < 8:
        return added
    distance, partner = cKDTree(kept.points).query(added.points, k=4, workers=threads())
    share = 0.5 * np.clip(1 - (distance[:, :1] - fill) / width, 0, 1)
    if added.colors is not None and kept.colors is not None:
        around = kept.colors[partner].astype(np.float64).mean(1)
        added = replace(added, colors=_bytes((1 - share) * added.colors + share * around))
    if move and added.normals is not None:
        offset = kept.points[partner].mean(1) - added.points
        normal = added.normals.astype(np.float64)
        height = np.clip((offset * normal).sum(1, keepdims=True), -fill, fill)
        added = replace(added, points=added.points + share * height * normal)
    return added


def _bytes(colors: Array) -> NDArray[np.uint8]:
    return np.clip(np.rint(colors), 0, 255).astype(np.uint8)
