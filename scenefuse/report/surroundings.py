"""One object's part of the scene before and after fusion, turned upright: what figures and the 3D view show."""

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.cloud.clouds import Cloud, read_cloud
from scenefuse.cloud.tiled_cloud import open_cloud
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.core.transforms import Array, Sim3, box_around, rotation_between
from scenefuse.fuse.fuse_object import is_placed
from scenefuse.fuse.write import after_fusion
from scenefuse.report.object_sheet import inner
from scenefuse.report.render import luminance
from scenefuse.report.values import find, flatten, load, number, unit_of
from scenefuse.report.view import within

# How far around the object, as shares of its diagonal: sideways enough to see what it stands on.
REACH = (0.35, 0.35, 0.15)
# A place in the shade would be a black picture: where nine points in ten are darker than DARK (0 to 255), colours are
# shown brighter, so that the tenth is as bright as BRIGHT, by a factor of at most MAX_FACTOR.
DARK, BRIGHT, MAX_FACTOR = 100.0, 160.0, 4.0


@dataclass(frozen=True)
class Surroundings:
    """The clouds of one object in the scene's frame, turned so that z points up.

    Attributes:
        before: the scene around the object.
        after: the same part of the scene after fusion.
        crop: the object's part of the scene, as registration saw it.
        object_cloud: the object at its estimated pose, or None when there is no pose.
        framed: (N, 3) points every picture has to show.
        fused: whether the object was fused.
        decision: one line: status, reason, scores.
        unit: of the scene's lengths.
        missing: cells of the object's surface that the completed scene lacks; None where they were not looked for.
        stations: (S, 3) places to photograph these from, best first.
        brighter: factor on the colours of all clouds, for pictures; those of the files are darker by it.
    """

    before: Cloud
    after: Cloud
    crop: Cloud
    object_cloud: Cloud | None
    framed: Array
    fused: bool
    decision: str
    unit: str
    missing: Cloud | None
    stations: Array
    brighter: float = 1.0


@dataclass(frozen=True)
class FigureInputs:
    """What the figures of one object show."""

    name: str
    """The object's name, for titles."""
    scene: Path
    """The scene's dense cloud, scene frame."""
    fused: Path
    """The object's surroundings after fusion, with the field `source` (0 scene, 1 object)."""
    checked: Path
    """What fusion changed in the scene."""
    crop: Path
    """The object's part of the scene, scene frame."""
    crop_json: Path
    """JSON of the crop; `up_in_scene` is the direction opposite to gravity, z when absent."""
    object_cloud: Path
    """The object's cloud in its own frame."""
    fine_json: Path
    """JSON of the fine registration: status, reason, scene_from_object."""
    metrics_json: Path
    """JSON of the metrics, for the scores in titles."""
    missing: Path
    """Cells of the object's surface that are still missing (PLY, scene frame)."""
    missing_json: Path
    """JSON of the same."""
    next_photos: Path
    """CSV of the stations from where photos would show them."""
    workspace: Path | None = None
    """The object's undistorted COLMAP workspace (images/, sparse/); None where it has no photos."""
    masks: Path | None = None
    """Folder of the object's masks, {photo}.png, where it has some."""
    stages: tuple[Path, ...] = ()
    """Folders of stages 1 to 4, each with depth_maps/; the last with renders/ too; none where its cloud was given."""


def read_surroundings(inputs: FigureInputs) -> Surroundings:
    """Read the clouds and turn them upright; the surroundings are cut to a box around the object.

    Raises:
        StageError: a file is missing or damaged, or the scene has no points around the object.
    """
    fine, scores = read_json(inputs.fine_json), flatten(read_json(inputs.metrics_json))
    up = read_json(inputs.crop_json).get("up_in_scene", {}).get("value")
    level = Sim3(1.0, rotation_between(np.array(up or [0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0])), np.zeros(3))
    crop = read_cloud(inputs.crop).transformed(level)
    pose = fine.get("scene_from_object", {}).get("value")
    placed = None
    if pose is not None:
        placed = read_cloud(inputs.object_cloud).transformed(level @ Sim3.from_matrix(np.array(pose)))
    fused = is_placed(fine)
    shown = placed if fused and placed is not None else crop
    low, high = np.percentile(shown.points, [0.5, 99.5], axis=0)
    reach = np.array(REACH) * float(np.linalg.norm(high - low))
    scene, box = open_cloud(inputs.scene), box_around(low - reach, high + reach, level.inverse())
    clouds = scene.near(*box)[1], after_fusion(scene, inputs.checked, inputs.fused, *box)
    level_clouds = (cloud.transformed(level) for cloud in clouds)
    before, after = (cloud[within(cloud.points, low - reach, high + reach, margin=0.0)] for cloud in level_clouds)
    if not len(before):
        raise StageError(
            f"{inputs.scene} has no points around {inputs.name}; look at the crop and at the registration's log"
        )
    unit = unit_of(load(inputs.crop_json), "diagonal") or "scene units"
    missing, brighter = _missing(inputs), how_much_brighter(after)
    decision = _decision(fine, scores) + ("" if brighter == 1 else f"; colours {brighter:.1f} x as bright as measured")
    return Surroundings(
        with_brighter(before, brighter), with_brighter(after, brighter), crop, placed, inner(shown.points), fused,
        decision, unit, None if missing is None else missing.transformed(level),
        level.apply(read_stations(inputs.next_photos)), brighter,
    )  # fmt: skip


def how_much_brighter(cloud: Cloud) -> float:
    """The factor by which a cloud's colours are shown brighter; 1 where they are bright enough, or it has none."""
    if cloud.colors is None or not len(cloud):
        return 1.0
    upper = float(np.percentile(luminance(cloud.colors), 90))
    return 1.0 if upper >= DARK else round(min(BRIGHT / max(upper, 1.0), MAX_FACTOR), 1)


def with_brighter(cloud: Cloud, factor: float) -> Cloud:
    """The cloud with its colours brighter by a factor."""
    if cloud.colors is None or factor == 1:
        return cloud
    return replace(cloud, colors=np.minimum(np.rint(cloud.colors * factor), 255).astype(np.uint8))


def _missing(inputs: FigureInputs) -> Cloud | None:
    """The cells; none where nothing is missing; None where the object has no pose or no photos."""
    content = read_json(inputs.missing_json)
    if "missing" not in content:
        return None
    share = value(content, "missing")
    return read_cloud(inputs.missing) if share else Cloud(np.zeros((0, 3)))


def read_stations(path: Path) -> Array:
    """(S, 3) places of the stations in a table of photos, scene frame: the middle one of the photos of each."""
    with open(path, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["photo"] == "2"]
    return np.array([[float(row[axis]) for axis in "xyz"] for row in rows]).reshape(-1, 3)


def _decision(report: dict[str, Any], scores: dict[str, dict[str, Any]]) -> str:
    """One line: the status, the reason of a refusal, and the scores that there are."""
    fields = flatten(report) | scores
    parts = [str(value(report, "status"))]
    reason = find(fields, "reason")
    if parts[0] != "registered" and reason:
        parts.append(str(reason))
    names = {
        "scale": "scale",
        "F-score": "f_score",
        "fitness": "registration.fitness",
        "inlier RMSE / diagonal": "registration.inlier_rmse_over_diagonal",
        "normal consistency": "registration.normal_consistency",
        "margin": "margin",
    }
    found = {label: find(fields, key) for label, key in names.items()}
    return ", ".join([*parts, *(f"{k} {number(v)}" for k, v in found.items() if isinstance(v, (int, float)))])
