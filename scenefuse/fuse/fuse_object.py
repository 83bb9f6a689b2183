"""Fusion: a registered object comes into the scene, each point with what photos know of it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud, write_cloud
from scenefuse.cloud.tiled_cloud import Rows, open_cloud
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import quantity, read_json, threads, value, write_json
from scenefuse.core.transforms import Array, Sim3, Uncertainty, box_around, inside_box
from scenefuse.fuse.compare import REASONS
from scenefuse.fuse.measure import Evidence, deviations_of_pose, unchecked
from scenefuse.fuse.modes import (
    Checked,
    Fused,
    FusionSettings,
    color_notes,
    fuse_by_distance,
    fuse_by_evidence,
)
from scenefuse.fuse.surroundings import ground_to_add, reach_of
from scenefuse.fuse.write import Source, as_bytes, frame_ledger, together, with_source
from scenefuse.geometry.photo_check import Photos, moved_photos, pack, read_photos
from scenefuse.photos.geodesy import frame_notes, length_unit
from scenefuse.photos.workspace import read_workspace


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
    object_workspace: Path | None = None
    """The object's undistorted COLMAP workspace; without it the object is judged by the scene's photos."""
    scene_workspace: Path | None = None
    """The scene's, in the frame of its cloud; without it the scene is judged by the object's photos."""
    georeference_json: Path | None = None
    """JSON of the scene, for the unit of its lengths and its place in the world, or nothing."""
    object_json: Path | None = None
    """JSON of the object cloud, for its other frames, or nothing."""


@dataclass(frozen=True)
class FusionOutputs:
    """What the fusion of one object writes."""

    fused: Path
    """PLY, the object's surroundings: the scene in the crop's box and what was added."""
    checked: Path
    """PLY, the changes to the scene: its points near the object, with their `row` in its cloud, what photos know of
    them, and the `reason` why each is taken away, or 0."""
    evidence: Path
    """JSON: what photos say of both sides' points."""
    report: Path
    """JSON: counts, distances, gain, status."""
    frames: Path | None = None
    """JSON, the frame ledger: every transform between the object's frames."""


def fuse_object(*, inputs: FusionInputs, outputs: FusionOutputs, settings: FusionSettings) -> None:
    """Add a registered object to the scene (method F1 to F4); an unregistered one leaves the scene as it is.

    Args:
        inputs: see FusionInputs.
        outputs: see FusionOutputs. Clouds have the fields `source` (0 scene, 1 object), `photos` (that confirm the
            point), `match` (mean NCC of the best), `deviation` (one standard deviation, the file's unit),
            `world_deviation` (the same; of the object's points with the uncertainty of its pose), `evidence` (0 not
            checked, 1 measured, 2 NeRF or given cloud only, 3 stereo only, 4 plain).
        settings: see FusionSettings.
    """
    use_threads(threads())
    whole, part, obj = open_cloud(inputs.scene), read_cloud(inputs.crop), read_cloud(inputs.object)
    registration, crop_json = read_json(inputs.fine_json), read_json(inputs.crop_json)
    settings, notes = possible(settings, inputs.object_workspace is not None, inputs.scene_workspace is not None)
    placed = is_placed(registration)
    pose = Sim3.from_matrix(np.array(value(registration, "scene_from_object"))) if placed else None
    rows, scene = whole.near(*_region(obj, pose, crop_json))
    checked: Checked | None = None
    if pose is None:
        print(f"the object is not fused: {value(registration, 'reason')}", flush=True)
        fused, notes = _unchanged(obj, scene), []
    elif settings.mode == "evidence":
        fused, checked = _by_evidence(obj, scene, pose, inputs, registration, settings)
        notes, pose = checked.notes + notes, checked.settled @ pose
    else:
        fused = fuse_by_distance(obj, scene, part, pose, settings)
    fused, of_colors = color_notes(fused, obj, scene)
    notes += of_colors
    for note in notes:
        print(note, flush=True)
    _write(fused, rows, crop_json, outputs, frame_notes(inputs.georeference_json))
    unit = length_unit(inputs.georeference_json)
    write_json(outputs.evidence, evidence_report(fused, checked))
    content = _report(fused, checked, registration, len(whole), unit) | {
        "scene_from_object": quantity(None if pose is None else pose.matrix, unit),
        "mode": quantity(settings.mode, ""),
        "notes": quantity(notes, ""),
        "object_points": quantity(len(obj), "points"),
    }
    write_json(outputs.report, content)
    if outputs.frames is not None:
        ledger = frame_ledger(pose, inputs.object_json, inputs.georeference_json)
        write_json(outputs.frames, ledger | {"status": content["registration"]})


def _region(obj: Cloud, pose: Sim3 | None, crop_json: dict[str, Any]) -> tuple[Array, Array]:
    """Corners (3,) of the part of the scene that fusion reads: the crop's box, and what is near the object in place."""
    scene_from_level = Sim3(1.0, np.array(value(crop_json, "level_from_scene")).T, np.zeros(3))
    low, high = box_around(value(crop_json, "box_low"), value(crop_json, "box_high"), scene_from_level)
    if pose is None:
        return low, high
    placed = obj.transformed(pose)
    reach = reach_of(placed)
    return np.minimum(low, placed.points.min(0) - reach), np.maximum(high, placed.points.max(0) + reach)


def _by_evidence(
    obj: Cloud, scene: Cloud, pose: Sim3, inputs: FusionInputs, registration: dict[str, Any], settings: FusionSettings
) -> tuple[Fused, Checked]:
    """`fuse_by_evidence` of an object in its own frame."""
    placed = obj.transformed(pose)
    photos = photos_of(inputs.object_workspace, obj.points, pose), photos_of(inputs.scene_workspace, placed.points)
    stated = value(registration, "covariance") if "covariance" in registration else None
    on_world = None if stated is None else np.array(stated)
    fused, checked = fuse_by_evidence(placed, scene, *photos, settings, uncertainty_on_scene(registration), on_world)
    if inputs.object_workspace is None:
        return fused, checked
    own, picture = moved_photos(photos[0], checked.settled), read_workspace(inputs.object_workspace).rgb
    ground = ground_to_add(checked.obj, fused.kept, fused.added, own, picture)
    if ground.colors is None or not len(ground):
        return fused, checked
    if on_world is not None:
        of_pose = deviations_of_pose(ground, on_world, placed.points.mean(0))
        ground.fields["world_deviation"] = np.hypot(ground.fields["deviation"], of_pose).astype(np.float32)
    ground = replace(ground, colors=as_bytes(ground.colors * fused.gain + fused.bias))
    return replace(fused, added=concatenate([fused.added, ground]), ground=len(ground)), checked


def possible(settings: FusionSettings, object_photos: bool, scene_photos: bool) -> tuple[FusionSettings, list[str]]:
    """What can be done of `evidence` with the photos that there are, and notes of what cannot.

    An object given as a cloud was measured by something else: where no photo contradicts its points, they fill what the
    scene lacks, marked as not confirmed. Without any photo, distances alone decide.
    """
    if settings.mode != "evidence" or object_photos:
        return settings, []
    if scene_photos:
        note = (
            "the object has no photos: what the scene's neither confirm nor contradict is added where nothing else is"
        )
        return replace(settings, unconfirmed="all"), [note]
    note = "neither side has photos: no point is checked; the object's points fill what the scene lacks, by distance"
    return replace(settings, mode="fill"), [note]


def is_placed(registration: dict[str, Any]) -> bool:
    """Whether a fine registration's JSON puts the object into the scene: accepted, or made without any check."""
    return value(registration, "status") in ("registered", "ungated")


def uncertainty_on_scene(registration: dict[str, Any]) -> Uncertainty | None:
    """How certain a pose is on the scene as it is, by a fine registration's JSON; None where nothing checked it."""
    known = value(registration, "on_scene") if "on_scene" in registration else {}
    covariance = known["covariance"]["value"] if known else None
    return None if covariance is None else Uncertainty.of(np.array(covariance))


def _unchanged(obj: Cloud, scene: Cloud) -> Fused:
    """The scene as it is, with nothing of the object."""
    nothing = unchecked(obj[np.zeros(len(obj), dtype=bool)])
    none = np.zeros(0, np.int64)
    return Fused(unchecked(scene), none, none.astype(np.uint8), nothing, np.ones(3), np.zeros(3), 0.0)


def photos_of(workspace: Path | None, points: Array, frame: Sim3 | None = None) -> Photos:
    """The photos that see points (N, 3; the workspace's frame), moved by `frame`; none without a workspace."""
    if workspace is None:
        return pack([])
    photos = read_photos(read_workspace(workspace), points)
    return moved_photos(photos, frame) if frame else photos


def _write(fused: Fused, rows: Rows, crop_json: dict[str, Any], outputs: FusionOutputs, comments: list[str]) -> None:
    """The clouds; rows: (N,) of the part of the scene in its cloud."""
    kept, added = with_source(fused.kept, Source.SCENE), with_source(fused.added, Source.OBJECT)
    write_cloud(outputs.fused, together(_in_box(kept, crop_json), added), comments)
    checked = fused.scene[fused.rows]
    checked.fields["row"], checked.fields["reason"] = rows[fused.rows].astype(np.uint32), fused.reason
    write_cloud(outputs.checked, checked, comments)


def _report(
    fused: Fused, checked: Checked | None, registration: dict[str, Any], scene_points: int, unit: str
) -> dict[str, Any]:
    """What was added and taken away, with units."""
    unconfirmed = None if checked is None else int((checked.obj.fields["evidence"] == Evidence.NERF_ONLY).sum())
    return {
        "status": quantity("fused" if is_placed(registration) else "unregistered", ""),
        "registration": quantity(value(registration, "status"), ""),
        "reason": quantity(value(registration, "reason"), ""),
        "scene_points": quantity(scene_points, "points"),
        "checked_points": quantity(len(fused.rows), "points"),
        "removed_points": quantity(len(fused.removed), "points"),
        "added_points": quantity(len(fused.added), "points"),
        "ground_points": quantity(fused.ground, "points"),
        "plain_points": quantity(int((fused.added.fields["evidence"] == Evidence.PLAIN).sum()), "points"),
        "nerf_only_points": quantity(unconfirmed, "points"),
        "settled_by": quantity(None if checked is None else checked.moved, "diagonals"),
        "fill_distance": quantity(fused.same_distance, unit),
        "color_gain": quantity(fused.gain, "1"),
    }


def evidence_report(fused: Fused, checked: Checked | None) -> dict[str, Any]:
    """What photos say of both sides' points; without `evidence`, only what was taken away.

    Photos see through the `object_contradicted` points; about the others that are not measured they say nothing.
    """
    removed = {text: int((fused.reason == code).sum()) for code, text in REASONS.items()}
    content = {"scene_removed": quantity(removed, "points")}
    if checked is None:
        return content | {"notes": quantity(["no photo was compared"], "")}
    of_object, of_scene = (c.fields["evidence"] == Evidence.MEASURED for c in (checked.obj, checked.scene))
    return content | {
        "scene_measured": quantity(int(of_scene.sum()), "points"),
        "object_measured": quantity(int(of_object.sum()), "points"),
        "object_measured_share": quantity(float(of_object.mean()) if len(of_object) else None, "1"),
        "object_contradicted": quantity(int(checked.contradicted.sum()), "points"),
        "notes": quantity(checked.notes, ""),
    }


def _in_box(cloud: Cloud, crop_json: dict[str, Any]) -> Cloud:
    """The points in the box of a crop stage."""
    level, low, high = (np.array(value(crop_json, name)) for name in ("level_from_scene", "box_low", "box_high"))
    return cloud[inside_box(cloud.points @ level.T, low, high)]
