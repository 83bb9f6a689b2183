"""The metrics stage of a completed scene: what all its objects added to it, together."""

from pathlib import Path

from scenefuse.cloud.clouds import read_cloud
from scenefuse.cloud.tiles.tiled_cloud import open_cloud
from scenefuse.core.stage import quantity, read_json, value, write_json
from scenefuse.metrics.completion import MetricSettings, completion_metrics, completion_of


def compute_scene_metrics(
    *, completed: Path, completed_json: Path, objects: list[Path], report: Path, seed: int, settings: MetricSettings
) -> None:
    """Measure the completed scene (method G2 to G5): the objects that were added to it, each counted by its points.

    Args:
        completed: the completed scene (PLY, with `source`).
        completed_json: its JSON, which says which object each `source` is and which objects are in it.
        objects: result folders of all the scene's objects; of those in it, registration/full/crop.ply and crop.json are
            read.
        report: output JSON with `completion`; a measure is null where nothing was added.
        seed: of samples and of the random clouds that give the null values.
        settings: see MetricSettings.
    """
    whole, known = open_cloud(completed), read_json(completed_json)
    numbers = {name: int(number) for number, name in value(known, "sources").items()}
    parts = []
    for folder in objects:
        if value(known, "added_points").get(folder.name, 0) == 0:
            continue
        crop = folder / "registration/full"
        before, diagonal = read_cloud(crop / "crop.ply").points, float(value(read_json(crop / "crop.json"), "diagonal"))
        # What an object adds lies no farther from its crop than the object is wide.
        around = whole.near(before.min(0) - diagonal, before.max(0) + diagonal)[1]
        parts.append(completion_of(before, around, numbers[folder.name], diagonal))
    found = completion_metrics(parts, settings, seed) | {"objects": quantity(len(parts), "objects")}
    for name, item in found.items():
        print(f"{name:34s} {item['value']} {item['unit']}", flush=True)
    write_json(report, {"completion": found})
