"""The completed scene: all registered objects in one cloud, each point naming where it is from."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, spacing
from scenefuse.cloud.copc import write_copc
from scenefuse.cloud.tiled_cloud import BOX, ROW_OF_TILE, TiledCloud, open_cloud
from scenefuse.core.job_records import JobRecords, why_unfinished
from scenefuse.core.stage import StageError, quantity, read_json, threads, value, write_json
from scenefuse.core.version import VERSION
from scenefuse.fuse.write import Changes, added_by, merged, read_changes, with_source, write_completed
from scenefuse.photos.geodesy import scene_frame


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
    """JSON with `crs` and `crs_from_scene` for the COPC file, or nothing."""


def complete_scene(*, inputs: CompletionInputs, completed: Path, completed_copc: Path, report: Path) -> None:
    """Put into the scene what every object adds, and leave out what any takes away (method F3).

    The scene is read and written part by part, so that memory does not grow with it. Where objects overlap, the points
    of the less exactly measured one that lie on the other's are left out. The field `source` is 0 on the scene's points
    and the object's place among the scene's objects, counted from 1, on what it added; the others keep their number
    when one fails.

    Args:
        inputs: see CompletionInputs.
        completed: output PLY, the scene's frame, tile by tile; the points in the order of the scene's cloud.
        completed_copc: output COPC (a LAZ with an octree) of the same, in the CRS where the scene is georeferenced.
        report: output JSON: what each `source` is, the points that each object added, and the objects that are not in
            it, unregistered or failed, each with its reason.

    Raises:
        StageError: no point is left.
    """
    start = time.perf_counter()
    scene = open_cloud(inputs.scene)
    changes, added = list[Changes](), list[Cloud]()
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
        changes.append(read_changes(folder / "checked.ply"))
        added.append(with_source(added_by(folder / "fused.ply"), number))
    added = without_overlaps(added)
    for cloud in added:
        if len(cloud):
            print(f"{inputs.objects[cloud.fields['source'][0] - 1].name}: {len(cloud)} points", flush=True)
    frame = None if inputs.georeference_json is None else scene_frame(read_json(inputs.georeference_json))
    counts = _write(scene, merged(changes), added, completed)
    if frame is None:
        write_copc(completed_copc, open_cloud(completed), lambda points: points, None)
    else:
        write_copc(completed_copc, open_cloud(completed), frame.in_crs, frame.crs)
    content = _report(counts, len(scene), [folder.name for folder in inputs.objects], unregistered, failed) | {
        "crs": quantity(None if frame is None else frame.crs, ""),
        "version": quantity(VERSION, ""),
        "seconds": quantity(time.perf_counter() - start, "s"),
    }
    write_json(report, content)


def _write(scene: TiledCloud, changes: Changes, added: list[Cloud], path: Path) -> dict[int, int]:
    """Write the completed scene: the scene's tiles in their order, then a tile for what each object adds.

    Returns the number of points of each `source`.
    """
    left = np.diff(scene.starts) - changes.removed_in(scene.starts)
    added = [cloud for cloud in added if len(cloud)]
    if not added and not left.any():
        raise StageError(f"of {scene.path} no point is left, and no object adds any: there is no scene to write")
    boxes = np.concatenate([scene.low, scene.high], axis=1)[left > 0]
    boxes = np.concatenate([boxes, *([[*cloud.points.min(0), *cloud.points.max(0)]] for cloud in added)])
    tiles = np.zeros(len(boxes), ROW_OF_TILE)
    tiles["count"] = [*left[left > 0], *map(len, added)]
    for name, values in zip(BOX, boxes.T):
        tiles[name] = values
    write_completed(path, scene.like, scene.parts(), changes, added, int(tiles["count"].sum()), tiles)
    return {0: int(left.sum())} | {int(cloud.fields["source"][0]): len(cloud) for cloud in added}


def without_overlaps(clouds: list[Cloud]) -> list[Cloud]:
    """The clouds, each without its points on one that is measured more exactly, by the median standard deviation."""
    order = sorted(range(len(clouds)), key=lambda k: _deviation(clouds[k]))
    left = list(clouds)
    for place, k in enumerate(order):
        left[k] = _apart(clouds[k], [left[before] for before in order[:place]])
    return left


def _deviation(cloud: Cloud) -> float:
    """Median standard deviation of the points for which one is known."""
    known = cloud.fields.get("deviation", np.zeros(0))
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else np.inf


def _apart(cloud: Cloud, before: list[Cloud]) -> Cloud:
    """The points farther than a spacing from those that other objects added."""
    if not before or len(cloud) < 2:
        return cloud
    step = spacing(cloud.points)
    low, high = cloud.points.min(0) - step, cloud.points.max(0) + step
    there = np.concatenate([one.points[((one.points >= low) & (one.points <= high)).all(1)] for one in before])
    if not len(there):
        return cloud
    return cloud[cKDTree(there).query(cloud.points, workers=threads())[0] > step]


def _report(
    counts: dict[int, int], points_before: int, names: list[str], unregistered: dict[str, str], failed: dict[str, str]
) -> dict[str, dict[str, object]]:
    """What each `source` is and how many points it has."""
    added = {n: counts.get(k, 0) for k, n in enumerate(names, 1) if n not in unregistered and n not in failed}
    return {
        "sources": quantity({"0": "scene"} | {str(k): name for k, name in enumerate(names, 1)}, ""),
        "points": quantity(sum(counts.values()), "points"),
        "scene_points": quantity(counts[0], "points"),
        "removed_points": quantity(points_before - counts[0], "points"),
        "added_points": quantity(added, "points"),
        "unregistered": quantity(unregistered, ""),
        "failed": quantity(failed, ""),
    }
