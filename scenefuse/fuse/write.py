"""Write: what fusion changes in a scene, and the completed scene with the changes of one object or of all (F3), in
which each point names where it is from.

A scene is never copied for an object: its changes name the rows of the scene's cloud, and are laid on the part of it
that is read.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import Cloud, concatenate, records_of, spacing, within
from scenefuse.cloud.copc import write_copc
from scenefuse.cloud.readers.las import LAS_DIMENSIONS
from scenefuse.cloud.tiled_cloud import BOX, ROW_OF_TILE, Rows, TiledCloud, open_cloud, reserved
from scenefuse.core.job_records import JobRecords, why_unfinished
from scenefuse.core.stage import StageError, quantity, read_json, threads, value, write_json
from scenefuse.core.transforms import Array, Sim3, inside_box
from scenefuse.core.version import VERSION
from scenefuse.fuse.compare import Reason
from scenefuse.fuse.measure import FIELDS, Evidence, unchecked
from scenefuse.photos.geodesy import frame_notes, scene_frame

# Least and largest gain of an object's colours, and pairs of points that it is computed from at least.
GAINS, MIN_PAIRS = (0.5, 2.0), 50
# Width of the seam over which colours blend, in spacings of the scene.
SEAM_SPACINGS = 4.0


class Source(IntEnum):
    """Values of the field `source` of an object's clouds."""

    SCENE = 0
    OBJECT = 1


@dataclass(frozen=True)
class Changes:
    """What one object, or several, change in a scene's cloud.

    Attributes:
        rows: (M,) rising: the points of the scene's cloud that were checked.
        removed: (M,) whether each is taken away.
        fields: what photos know of each, name -> (M,).
    """

    rows: Rows
    removed: NDArray[np.bool_]
    fields: dict[str, NDArray[Any]]

    def left_of(self, rows: Rows, cloud: Cloud) -> Cloud:
        """What is left of some points of the scene, with fields of evidence, `source` 0, and what LAS knows of them.

        A scene that was completed before keeps its fields of evidence and its `source`.

        Args:
            rows: (N,) rising, of these points in the scene's cloud.
            cloud: the points.
        """
        part, left = with_source(unchecked(cloud), Source.SCENE), np.ones(len(cloud), dtype=bool)
        if was_completed(cloud):
            known = {name: cloud.fields[name].astype(values.dtype) for name, values in part.fields.items()}
            part = replace(part, fields=known)
        mine = slice(*np.searchsorted(self.rows, [rows[0], rows[-1] + 1])) if len(rows) else slice(0, 0)
        at = np.searchsorted(rows, self.rows[mine])
        there = rows[at] == self.rows[mine]
        at = at[there]
        for name, values in self.fields.items():
            part.fields[name][at] = values[mine][there]
        part.fields.update({name: cloud.fields[name] for name in LAS_DIMENSIONS if name in cloud.fields})
        left[at] = ~self.removed[mine][there]
        return part[left]

    def removed_in(self, starts: Rows) -> Rows:
        """(T,) how many points are taken away of each of T runs of rows from `starts` (T + 1,)."""
        return np.diff(np.searchsorted(self.rows[self.removed], starts))


def was_completed(scene: Cloud) -> bool:
    """Whether a scene has the fields of a completed one."""
    return set(scene.fields) >= {*FIELDS, "source"}


def read_changes(checked: Path) -> Changes:
    """The changes that an object makes, from what its fusion wrote of the scene's points; none where it is empty."""
    tiles = open_cloud(checked)
    fields = tiles.read(np.arange(len(tiles.low)))[1].fields
    rows, removed = fields["row"].astype(np.int64), fields["reason"] != Reason.KEPT
    return Changes(rows, removed, {name: fields[name] for name in FIELDS})


def merged(changes: list[Changes]) -> Changes:
    """The changes of several objects, in their order: a point goes if any takes it away.

    Of a point that several checked, what the last one knows counts; but what photos of another measured stays known.
    """
    if len(changes) == 1:
        return changes[0]
    rows = np.concatenate([np.zeros(0, np.int64), *(one.rows for one in changes)])
    removed = np.concatenate([np.zeros(0, bool), *(one.removed for one in changes)])
    fields = {name: np.concatenate([one.fields[name] for one in changes]) for name in FIELDS if changes}
    order = np.lexsort((fields["evidence"] == Evidence.MEASURED, rows)) if changes else np.zeros(0, np.int64)
    last = np.flatnonzero(np.diff(rows[order], append=-1))
    starts = np.concatenate([[0], last[:-1] + 1]) if len(last) else last
    gone = np.logical_or.reduceat(removed[order], starts) if len(last) else removed
    chosen = order[last]
    return Changes(rows[chosen], gone, {name: values[chosen] for name, values in fields.items()})


def added_by(fused: Path) -> Cloud:
    """The points that an object brought in, from the cloud of its surroundings."""
    tiles = open_cloud(fused)
    whole = tiles.read(np.arange(len(tiles.low)))[1]
    return whole[whole.fields["source"] == Source.OBJECT]


def after_fusion(scene: TiledCloud, checked: Path, fused: Path, low: Array, high: Array) -> Cloud:
    """The scene in the tiles that touch a box from `low` (3,) to `high` (3,), with what an object changes there, and
    all that it adds."""
    left = read_changes(checked).left_of(*scene.near(low, high))
    return together(left, added_by(fused))


def together(kept: Cloud, added: Cloud) -> Cloud:
    """Both clouds in one; normals and colours that only the object has are left out, never those of the scene."""
    return concatenate([kept, added]) if len(added) else kept


def with_source(cloud: Cloud, source: int) -> Cloud:
    """The cloud with its fields of evidence and `source`, wide enough for 65535 objects."""
    known = {name: cloud.fields[name] for name in FIELDS}
    return replace(cloud, fields=known | {"source": np.full(len(cloud), source, dtype=np.uint16)})


def write_completed(
    path: Path,
    like: Cloud,
    parts: Iterable[tuple[Rows, Cloud]],
    changes: Changes,
    added: list[Cloud],
    count: int,
    tiles: NDArray[Any],
    comments: Sequence[str] = (),
) -> None:
    """Write a completed scene as PLY, part by part: what the changes leave of the scene, then what comes in.

    Args:
        path: output.
        like: none of the scene's points, with the columns that they have.
        parts: the scene's points with their rows, in the order of its cloud.
        changes: that objects make to it.
        added: clouds with the fields of evidence and `source`.
        count: points that are left and come in.
        tiles: (T,) ROW_OF_TILE, a row for each tile, for the file's end; none for a file that is not read in tiles.
        comments: of the header.
    """
    columns = changes.left_of(np.zeros(0, np.int64), like)
    columns = replace(columns, fields=dict(sorted(columns.fields.items())))
    with reserved(path, records_of(columns, path).dtype, count, len(tiles), comments) as (file, _):
        for cloud in chain((changes.left_of(*part) for part in parts), added):
            file.write(records_of(_with_columns_of(columns, cloud), path).tobytes())
        file.write(tiles.tobytes())


def _with_columns_of(like: Cloud, cloud: Cloud) -> Cloud:
    """A cloud with only the columns that another has; normals and colours that only the object has are left out, and
    classes and intensities that only the scene has are 0."""
    return replace(
        cloud,
        normals=None if like.normals is None else cloud.normals,
        colors=None if like.colors is None else cloud.colors,
        fields={
            name: np.zeros(len(cloud), values.dtype)
            if name in LAS_DIMENSIONS and name not in cloud.fields
            else cloud.fields[name]
            for name, values in like.fields.items()
        },
    )


def with_colors_of(obj: Cloud, scene: Cloud, reach: float, wanted: bool) -> tuple[Cloud, Array, Array]:
    """The object with its colours brought to the scene's by pairs of points within `reach`; the gain and bias (3,)."""
    gain, bias = np.ones(3), np.zeros(3)
    if not wanted or obj.colors is None or scene.colors is None or len(scene) == 0:
        return obj, gain, bias
    distance, partner = cKDTree(scene.points).query(obj.points, distance_upper_bound=reach, workers=threads())
    close = np.isfinite(distance)
    if close.sum() < MIN_PAIRS:
        return obj, gain, bias
    gain, bias = match_colors(obj.colors[close], scene.colors[partner[close]])
    return replace(obj, colors=as_bytes(obj.colors * gain + bias)), gain, bias


def match_colors(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> tuple[Array, Array]:
    """Gain and bias (3,) per channel with gain a + bias = b, from pairs (M, 3): medians and mean deviations."""
    mine, theirs = a.astype(np.float64), b.astype(np.float64)
    middle_a, middle_b = np.median(mine, axis=0), np.median(theirs, axis=0)
    wide_a = np.abs(mine - middle_a).mean(0)
    wide_b = np.abs(theirs - middle_b).mean(0)
    gain = np.clip(wide_b / np.maximum(wide_a, 1.0), *GAINS)
    return gain, middle_b - gain * middle_a


def feathered(added: Cloud, kept: Cloud, width: float, fill: float) -> Cloud:
    """The added points with colours blended into what is kept, over `width` from the seam; no point moves.

    At the seam a point's colour is the mean of its own and its nearest kept neighbours'; the share of the neighbours
    falls linearly to nothing.
    """
    if len(kept) < 8 or len(added) == 0 or added.colors is None or kept.colors is None:
        return added
    distance, partner = cKDTree(kept.points).query(added.points, k=4, workers=threads())
    share = 0.5 * np.clip(1 - (distance[:, :1] - fill) / width, 0, 1)
    around = kept.colors[partner].astype(np.float64).mean(1)
    return replace(added, colors=as_bytes((1 - share) * added.colors + share * around))


def as_bytes(colors: Array) -> NDArray[np.uint8]:
    """Colours (N, 3) rounded, within 0..255."""
    return np.clip(np.rint(colors), 0, 255).astype(np.uint8)


def frame_ledger(pose: Sim3 | None, object_json: Path | None, georeference_json: Path | None) -> dict[str, Any]:
    """The transforms between the frames of one object (docs/frames.md), as quantities; null where one is not known.

    Frames: `nerf` (normalised, what the field is trained in), `object` (the object's cameras), `scene`, `world`
    (easting, northing, height in the scene's CRS, where it is georeferenced; the file's own coordinates where the scene
    was given as a cloud), `file` (the own coordinates of an object that was given as a cloud).

    Args:
        pose: scene_from_object of the added points; None for an object that is not fused.
        object_json: JSON of the object cloud, with `nerf_from_object` or `object_from_file`, or None.
        georeference_json: JSON of the scene, with `crs_from_scene` where it is known, or None.

    Raises:
        StageError: a stored matrix is no similarity.
    """
    nerf = _read(object_json, "nerf_from_object")
    file = _read(object_json, "object_from_file")
    world = _read(georeference_json, "crs_from_scene")
    world_from_object = world @ pose if world and pose else None
    known = {
        "nerf_from_object": nerf,
        "object_from_file": file,
        "scene_from_object": pose,
        "world_from_scene": world,
        "world_from_object": world_from_object,
        "world_from_file": world_from_object @ file if world_from_object and file else None,
        "scene_from_nerf": pose @ nerf.inverse() if pose and nerf else None,
    }
    return {name: quantity(None if pose is None else pose.matrix, "") for name, pose in known.items()}


def _read(path: Path | None, name: str) -> Sim3 | None:
    """One transform of a stage JSON, or None where the file does not hold it."""
    entry = None if path is None else read_json(path).get(name)
    if entry is None or entry["value"] is None:
        return None
    try:
        return Sim3.from_matrix(np.array(entry["value"]))
    except (ValueError, np.linalg.LinAlgError) as error:
        raise StageError(f"{name} in {path} is {error}; delete the file and rerun its stage") from None


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
    counts = _write(scene, merged(changes), added, completed, frame_notes(inputs.georeference_json))
    if frame is None:
        write_copc(completed_copc, open_cloud(completed), lambda points: points, None)
    else:
        write_copc(completed_copc, open_cloud(completed), frame.in_crs, frame.crs)
    content = _report(counts, len(scene), [folder.name for folder in inputs.objects], unregistered, failed) | {
        "crs": quantity(None if frame is None else frame.crs, ""),
        "version": quantity(VERSION, ""),
    }
    write_json(report, content)


def _write(
    scene: TiledCloud, changes: Changes, added: list[Cloud], path: Path, comments: Sequence[str]
) -> dict[int, int]:
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
    write_completed(path, scene.like, scene.parts(), changes, added, int(tiles["count"].sum()), tiles, comments)
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
    low, high = cloud.points.min(0), cloud.points.max(0)
    there = np.concatenate([one.points[inside_box(one.points, low, high, step)] for one in before])
    if not len(there):
        return cloud
    return cloud[~within(cloud.points, there, step)]


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
