"""The metrics stage: one registration, and the completion where the object was fused."""

from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.fuse.fuse_object import FROM_OBJECT
from scenefuse.metrics.completion import MetricSettings, completion_metrics, completion_of, variation_radius
from scenefuse.register.agreement import registration_metrics


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
        report: output JSON with `registration` and `completion`.
        seed: of samples and of the random clouds that give the null values.
        settings: see MetricSettings.
    """
    obj, scene = read_cloud(object), read_cloud(crop)
    registration = read_json(fine_json)
    pose = Sim3.from_matrix(np.array(value(registration, "scene_from_object")))
    extent = read_json(crop_json)["diagonal"]
    diagonal, unit = float(extent["value"]), str(extent["unit"])
    tau = settings.agreement.tau_fraction * diagonal
    found = registration_metrics(obj, scene, pose, tau, diagonal, unit)
    found["status"] = quantity(value(registration, "status"), "")
    content: dict[str, Any] = {"registration": found}
    if fused is not None:
        part = completion_of(scene.points, read_cloud(fused), FROM_OBJECT, diagonal)
        radius = {"surface_variation_radius": quantity(variation_radius(part, settings), unit)}
        content["completion"] = completion_metrics([part], settings, seed) | radius
    for name, item in found.items():
        print(f"{name:28s} {item['value']} {item['unit']}", flush=True)
    write_json(report, content)
