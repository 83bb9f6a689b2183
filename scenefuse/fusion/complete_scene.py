"""The completed scene: all registered objects fused into one cloud, each point naming where it is from."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scenefuse.fusion.fuse_object import (
    FROM_SCENE,
    FusionSettings,
    fuse_registered,
    is_placed,
    with_provenance,
    write_scene,
)
from scenefuse.io.clouds import Cloud, concatenate, read_cloud
from scenefuse.job_records import JobRecords, why_unfinished
from scenefuse.stage import quantity, read_json, value, write_json


@dataclass(frozen=True)
class CompletionInputs:
    """What the completed scene is made of."""

    scene: Path
    """Dense scene cloud (PLY)."""
    objects: list[Path]
    """Result folders of all the scene's objects; of each, object.ply, registration/full/crop.ply and fine.json are
    read."""
    jobs: JobRecords
    """For the reason why an object failed."""
    failed: tuple[str, ...] = ()
    """Names of the objects that failed before a decision on their pose; whatever is in their folders is out of date."""
    georeference_json: Path | None = None
    """JSON with `crs` and `crs_from_scene` for the LAZ file, or nothing."""


def complete_scene(
    *, inputs: CompletionInputs, completed: Path, completed_laz: Path, report: Path, settings: FusionSettings
) -> None:
    """Fuse every registered object of a scene into it, one after the other (method F3).

    Each is fused into what the ones before it left, so that objects that overlap are not doubled. The field `source`
    is 0 on the scene's points and the object's place among the scene's objects, counted from 1, on what it added; the
    others keep their number when one fails.

    Args:
        inputs: see CompletionInputs.
        completed: output PLY, the scene's frame.
        completed_laz: output LAZ of the same, in the CRS where the scene is georeferenced.
        report: output JSON: what each `source` is, the points that each object added, and the objects that are not in
            it, unregistered or failed, each with its reason.
        settings: see FusionSettings.
    """
    start = time.perf_counter()
    before = read_cloud(inputs.scene)
    whole = _from(with_provenance(before, FROM_SCENE), FROM_SCENE)
    failed = {
        name: why_unfinished(inputs.jobs, name, f"{name}-full") or "its jobs did not run" for name in inputs.failed
    }
    unregistered: dict[str, str] = {}
    for number, folder in enumerate(inputs.objects, 1):
        if folder.name in failed:
            print(f"{folder.name} failed: {failed[folder.name]}", flush=True)
            continue
        registration = read_json(folder / "registration/full/fine.json")
        crop = read_cloud(folder / "registration/full/crop.ply")
        fusion = fuse_registered(read_cloud(folder / "object.ply"), whole, crop, registration, settings)
        if not is_placed(registration):
            unregistered[folder.name] = value(registration, "reason")
        kept = whole[fusion.kept]
        whole = concatenate([kept, _from(fusion.added, number)]) if len(fusion.added) else kept
        print(f"{folder.name}: {unregistered.get(folder.name) or f'{len(fusion.added)} points'}", flush=True)
    crs = write_scene(completed, completed_laz, whole, inputs.georeference_json)
    content = _report(whole, len(before), [folder.name for folder in inputs.objects], unregistered, failed) | {
        "mode": quantity(settings.mode, ""),
        "crs": quantity(crs, ""),
        "seconds": quantity(time.perf_counter() - start, "s"),
    }
    write_json(report, content)


def _report(
    whole: Cloud, points_before: int, names: list[str], unregistered: dict[str, str], failed: dict[str, str]
) -> dict[str, dict[str, object]]:
    """What each `source` is and how many points it has."""
    counts = np.bincount(whole.fields["source"], minlength=len(names) + 1)
    added = {n: int(c) for n, c in zip(names, counts[1:]) if n not in unregistered and n not in failed}
    return {
        "sources": quantity({"0": "scene"} | {str(k): name for k, name in enumerate(names, 1)}, ""),
        "points": quantity(len(whole), "points"),
        "scene_points": quantity(int(counts[0]), "points"),
        "removed_points": quantity(points_before - int(counts[0]), "points"),
        "added_points": quantity(added, "points"),
        "unregistered": quantity(unregistered, ""),
        "failed": quantity(failed, ""),
    }


def _from(cloud: Cloud, source: int) -> Cloud:
    """The cloud with its `source` set, wide enough for 65535 objects."""
    return replace(cloud, fields=cloud.fields | {"source": np.full(len(cloud), source, dtype=np.uint16)})
