"""The completed scene: all registered objects in one cloud, each point naming where it is from."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.fusion.evidence import FIELDS, KEPT, MEASURED, unchecked
from scenefuse.fusion.fuse_object import FROM_OBJECT, FROM_SCENE, together, with_source, write_scene
from scenefuse.io.clouds import Cloud, read_cloud, spacing
from scenefuse.job_records import JobRecords, why_unfinished
from scenefuse.stage import quantity, read_json, threads, value, write_json
from scenefuse.version import VERSION


@dataclass(frozen=True)
class CompletionInputs:
    """What the completed scene is made of."""

    scene: Path
    """Dense scene cloud (PLY)."""
    objects: list[Path]
    """Result folders of all the scene's objects; of each, fused.ply, checked.ply and fusion.json are read."""
    jobs: JobRecords
    """For the reason why an object failed."""
    failed: tuple[str, ...] = ()
    """Names of the objects that failed before they were fused; whatever is in their folders is out of date."""
    georeference_json: Path | None = None
    """JSON with `crs` and `crs_from_scene` for the LAZ file, or nothing."""


def complete_scene(*, inputs: CompletionInputs, completed: Path, completed_laz: Path, report: Path) -> None:
    """Put into the scene what every object adds, and leave out what any takes away (method F3).

    Where objects overlap, a later one's points that lie on an earlier one's are left out. The field `source` is 0 on
    the scene's points and the object's place among the scene's objects, counted from 1, on what it added; the others
    keep their number when one fails.

    Args:
        inputs: see CompletionInputs.
        completed: output PLY, the scene's frame.
        completed_laz: output LAZ of the same, in the CRS where the scene is georeferenced.
        report: output JSON: what each `source` is, the points that each object added, and the objects that are not in
            it, unregistered or failed, each with its reason.
    """
    start = time.perf_counter()
    scene = unchecked(read_cloud(inputs.scene))
    kept, added = np.ones(len(scene), dtype=bool), list[Cloud]()
    failed = {
        name: why_unfinished(inputs.jobs, name, f"{name}-full") or "its jobs did not run" for name in inputs.failed
    }
    unregistered: dict[str, str] = {}
    for number, folder in enumerate(inputs.objects, 1):
        if folder.name in failed:
            print(f"{folder.name} failed: {failed[folder.name]}", flush=True)
            continue
        fusion = read_json(folder / "fusion.json")
        if value(fusion, "status") != "fused":
            unregistered[folder.name] = value(fusion, "reason")
            continue
        if value(fusion, "checked_points"):
            _take_away(scene, kept, read_cloud(folder / "checked.ply"))
        mine = read_cloud(folder / "fused.ply")
        mine = _apart(mine[mine.fields["source"] == FROM_OBJECT], added)
        added.append(with_source(mine, number))
        print(f"{folder.name}: {len(mine)} points", flush=True)
    whole = with_source(scene[kept], FROM_SCENE)
    for cloud in added:
        whole = together(whole, cloud)
    crs = write_scene(completed, completed_laz, whole, inputs.georeference_json)
    content = _report(whole, len(scene), [folder.name for folder in inputs.objects], unregistered, failed) | {
        "crs": quantity(crs, ""),
        "version": quantity(VERSION, ""),
        "seconds": quantity(time.perf_counter() - start, "s"),
    }
    write_json(report, content)


def _take_away(scene: Cloud, kept: NDArray[np.bool_], checked: Cloud) -> None:
    """Mark in `kept` what an object took away, and put what photos know of the checked points into the scene's."""
    rows = checked.fields["row"].astype(np.int64)
    kept[rows[checked.fields["reason"] != KEPT]] = False
    # What another object's photos measured stays known.
    new = (checked.fields["evidence"] == MEASURED) | (scene.fields["evidence"][rows] != MEASURED)
    for name in FIELDS:
        scene.fields[name][rows[new]] = checked.fields[name][new]


def _apart(cloud: Cloud, before: list[Cloud]) -> Cloud:
    """The points farther than a spacing from those that other objects added."""
    if not before or len(cloud) < 2:
        return cloud
    there = np.concatenate([other.points for other in before])
    return cloud[cKDTree(there).query(cloud.points, workers=threads())[0] > spacing(cloud.points)]


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
