"""The metrics of one object's registration and completion."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from scenefuse.cloud.cloud_file import strays
from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import quantity, read_json, value, write_json
from scenefuse.core.transforms import Array, Sim3
from scenefuse.fuse.compare import MARGIN
from scenefuse.fuse.measure import SUPPORT
from scenefuse.fuse.write import Source
from scenefuse.metrics.completion import MetricSettings, completion_metrics, completion_of
from scenefuse.register.score import registration_metrics


def compute_metrics(
    *,
    object: Path,
    crop: Path,
    crop_json: Path,
    fine_json: Path,
    fused: Path | None = None,
    report: Path,
    seed: int,
    settings: MetricSettings,
) -> None:
    """Measure one registration and, where the object was fused, the completion (method G1 to G5, R10, R11).

    Args:
        object: object cloud (PLY) in its own frame.
        crop: scene points on the object (PLY); the full variant's for every variant, so that variants can be compared.
        crop_json: JSON of the full variant's crop stage: its diagonal sets all thresholds, and the unit of lengths.
        fine_json: JSON of the fine registration of this variant.
        fused: the object's fused surroundings (PLY, with `source`); without it completion is left out.
        report: output JSON with `registration`, `object` (its size in the scene: length, width and height; median
            standard deviations of the added points) and `completion`.
        seed: of samples and of the random clouds that give the null values.
        settings: see MetricSettings.
    """
    obj, scene = read_cloud(object), read_cloud(crop)
    registration = read_json(fine_json)
    pose = Sim3.from_matrix(np.array(value(registration, "scene_from_object")))
    crop_about = read_json(crop_json)
    diagonal, unit = float(value(crop_about, "diagonal")), str(crop_about["diagonal"]["unit"])
    tau = settings.agreement.tau_fraction * diagonal
    found = registration_metrics(obj, scene, pose, tau, diagonal, unit)
    found["status"] = quantity(value(registration, "status"), "")
    size = box_size(pose.apply(obj.points))
    content: dict[str, Any] = {"registration": found, "object": {"size": quantity(size, unit)}}
    if fused is not None:
        after = read_cloud(fused)
        added = after.fields["source"] == Source.OBJECT
        for name in ("deviation", "world_deviation"):
            known = after.fields[name][added] if name in after.fields else np.empty(0)
            if np.isfinite(known).any():
                content["object"][name] = quantity(float(np.nanmedian(known)), unit)
        part = completion_of(scene.points, after, Source.OBJECT, diagonal)
        content["completion"] = completion_metrics(part, settings, seed)
    for group in content.values():
        for name, item in group.items():
            print(f"{name:34s} {item['value']} {item['unit']}", flush=True)
    write_json(report, content)


def box_size(points: Array) -> list[float]:
    """Length, width and height of points (N, 3), z up: of the smallest upright box around them without strays. What may
    be ground at the foot, lower than twice MARGIN, counts in the height alone, unless it is most of the object."""
    points = points[~strays(points)]
    low, high = points.min(0), points.max(0)
    above = points[:, 2] > low[2] + 2 * MARGIN * np.linalg.norm(high - low)
    plan = points[above] if above.mean() > SUPPORT else points
    sides = cv2.minAreaRect((plan[:, :2] - low[:2]).astype(np.float32))[1]
    return [*sorted(map(float, sides), reverse=True), float(high[2] - low[2])]
