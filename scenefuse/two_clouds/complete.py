"""The scene with a registered object in it, where neither has photos: what the scene lacks comes in, by distance."""

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.cloud_file import CloudFile
from scenefuse.cloud.clouds import MAX_STEP, Cloud, spacing
from scenefuse.cloud.import_cloud import unit_and_name
from scenefuse.cloud.readers.columns import AT_ONCE, COLOR
from scenefuse.cloud.readers.las import LAS_DIMENSIONS, las_crs
from scenefuse.cloud.tiled_cloud import ROW_OF_TILE, Rows
from scenefuse.cloud.write_las import LAS_DESCRIPTIONS, finer, las_writer
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import StageError, quantity, scratch_directory, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.core.version import VERSION
from scenefuse.fuse.fuse_object import possible
from scenefuse.fuse.measure import unchecked
from scenefuse.fuse.modes import NEAR, FusionSettings, color_notes, fuse_by_distance
from scenefuse.fuse.write import Changes, Source, together, was_completed, with_source, write_completed

FILES = ("completed.ply", "completed.laz", "completed.json")
# Integers of a LAS file's coordinates, and the greatest of them.
AXES, MAX_INTEGER = ("X", "Y", "Z"), np.iinfo(np.int32).max


@dataclass(frozen=True)
class Completed:
    """A scene with an object in it.

    Attributes:
        before, after: the scene around the object, and the same with what came in.
        removed: (R,) rising: rows of the scene's file that are taken away.
        changes: to the scene's file.
        added: the object's points that come in, in the scene's coordinates, with `source` and the fields of evidence
            (method F4), not checked.
        source: their `source`; 1, or the next number of a scene that was completed before.
        fill_distance: distance within which both show the same place.
        mode: `fill`, or the mode for comparison that the settings name.
        notes: what a user should know.
    """

    before: Cloud
    after: Cloud
    removed: Rows
    changes: Changes
    added: Cloud
    source: int
    fill_distance: float
    mode: str
    notes: list[str]


def fusion_settings(config: Path | None) -> FusionSettings:
    """The shipped settings of the fusion with those of a YAML file laid over them."""
    return build(FusionSettings, read_settings(config)["fusion"])


def complete(
    obj: Cloud, scene: CloudFile, scene_from_object: Sim3, settings: FusionSettings, around: float = 0.0
) -> Completed:
    """Add a registered object to a scene as the workflow does where neither has photos (method F1).

    Args:
        obj: the object in its own frame.
        scene: the scene's file; the spacing of its part, in which the object was found, says what is new.
        scene_from_object: the registration.
        settings: of the fusion; `evidence` needs photos and becomes `fill`, which a note says.
        around: how far around the object the scene is read at least.
    """
    settings, notes = possible(settings, False, False)
    moved = obj.transformed(scene_from_object)
    reach = max(NEAR * moved.diagonal, around)
    rows, near = scene.near(moved.points.min(0) - reach, moved.points.max(0) + reach)
    fused = fuse_by_distance(obj, near, scene.part if scene.every == 1 else near, scene_from_object, settings)
    fused, of_colors = color_notes(fused, obj, near)
    notes += of_colors
    if near.colors is None and obj.colors is not None:
        notes.append("the scene has no colours: the completed scene leaves out the object's, object_in_scene has them")
    known = set(fused.added.fields) | {"source"} if was_completed(near) else set()
    of_scene, of_object = near.fields.keys() - known - LAS_DIMENSIONS.keys(), obj.fields.keys() - known
    for whose, left_out in (("scene", of_scene), ("object", of_object)):
        if left_out:
            notes.append(f"completed.ply leaves out the {whose}'s columns {', '.join(sorted(left_out))}")
    source = scene.last + 1 if was_completed(near) else Source.OBJECT
    changes, added = fused.changes(rows), with_source(fused.added, source)
    after = together(changes.left_of(rows, near), added)
    return Completed(
        near, after, rows[fused.removed], changes, added, source, fused.same_distance, settings.mode, notes
    )  # fmt: skip


def write_files(out: Path, done: Completed, object: Path, scene: CloudFile) -> list[Path]:
    """Write completed.ply, completed.laz where the scene is LAS or LAZ, and completed.json; returns their paths.

    The scene is read and written in parts. The files appear together, when all are written.

    Raises:
        StageError: the disk is full, or the object reaches farther than a LAS file's coordinates can.
    """
    with scratch_directory(out / "completed") as folder:
        notes = list(done.notes)
        if scene.summary.is_las:
            notes += append_to_las(folder / "completed.laz", scene, done)
            if noise := scene.summary.rows - scene.summary.count:
                notes.append(f"completed.ply leaves out the {noise} points that are not used; completed.laz has them")
        count, no_tiles = scene.summary.count - len(done.removed) + len(done.added), np.zeros(0, ROW_OF_TILE)
        write_completed(
            folder / "completed.ply", scene.like, scene.parts(), done.changes, [done.added], count, no_tiles
        )
        _write_report(folder / "completed.json", done, object, scene, notes)
        written = [folder / name for name in FILES if (folder / name).exists()]
        return [path.replace(out / path.name) for path in written]


def _write_report(path: Path, done: Completed, object: Path, scene: CloudFile, notes: list[str]) -> None:
    """Write completed.json, and print the notes."""
    for note in notes:
        print(f"note       {note}", flush=True)
    unit, name = unit_and_name(las_crs(scene.summary.path))
    earlier = {str(number): f"{number} in {scene.summary.path.name}" for number in range(Source.OBJECT, done.source)}
    kept = scene.summary.count - len(done.removed)
    content = {
        "sources": quantity({str(Source.SCENE): "scene", **earlier, str(done.source): object.stem}, ""),
        "points": quantity(kept + len(done.added), "points"),
        "scene_points": quantity(kept, "points"),
        "removed_points": quantity(len(done.removed), "points"),
        "added_points": quantity({object.stem: len(done.added)}, "points"),
        "mode": quantity(done.mode, ""),
        "fill_distance": quantity(done.fill_distance, unit),
        "notes": quantity(notes, ""),
        "crs": quantity(name, ""),
        "version": quantity(VERSION, ""),
    }
    write_json(path, content)


def append_to_las(path: Path, scene: CloudFile, done: Completed) -> list[str]:
    """Copy a LAS or LAZ file with all that its points have, and append what was added.

    Coordinates keep the file's own steps, or have a tenth, a hundredth, ... of them where the added points are too
    dense for these: the scene's points stay exactly where they are. The CRS stays. The fields of `Completed` become
    extra dimensions. Added points have colours where the file has them; their classification and the like are 0. Points
    are copied in parts, so that memory stays small.

    Returns:
        Notes of the steps, and of what has another name there.

    Raises:
        StageError: the object reaches farther than the file's coordinates can.
    """
    import laspy

    with laspy.open(scene.summary.path) as reader:
        header = copy.deepcopy(reader.header)
        _keep_no_data(header)
        times, notes = _finer_steps(header, done, scene.summary.path)
        # What laspy writes; a later version has all that 1.0 and 1.1 have.
        header.version = max(header.version, laspy.header.Version(1, 2))
        # An index of the points (COPC) is not one of more points.
        header.vlrs = type(header.vlrs)(_but_copc(header.vlrs))
        further = type(header.vlrs)(_but_copc(header.evlrs or []))
        own = set(header.point_format.dimension_names)
        again = own >= set(done.added.fields)
        names = {name: name if again else _free(name, own) for name in done.added.fields}
        types = {} if again else {name: values.dtype.str[1:] for name, values in done.added.fields.items()}
        described = {name: LAS_DESCRIPTIONS.get(name, "") for name in types}
        header.add_extra_dims([laspy.ExtraBytesParams(names[n], kind, described[n]) for n, kind in types.items()])
        with las_writer(path, header) as writer:
            first = 0
            for chunk in reader.chunk_iterator(AT_ONCE):
                stay = ~np.isin(np.arange(first, first + len(chunk)), done.removed)
                first, chunk = first + len(chunk), chunk[stay]
                part = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=header)
                for name in chunk.array.dtype.names:
                    part.array[name] = chunk.array[name]
                for axis in AXES if times > 1 else ():
                    if np.abs(chunk.array[axis].astype(np.int64)).max(initial=0) * times > MAX_INTEGER:
                        raise StageError(f"points of {scene.summary.path} lie outside the box it names; write it again")
                    part.array[axis] *= times
                if not again:
                    unknown = with_source(unchecked(Cloud(np.zeros((len(chunk), 3)))), Source.SCENE).fields
                    _fill_in(part, {names[name]: values for name, values in unknown.items()})
                writer.write_points(part)
            writer.write_points(_added_record(header, done, names, scene.summary.white or 0.0))
            if further:
                writer.write_evlrs(further)
    return [*notes, *(f"in {path.name}, '{name}' is '{other}'" for name, other in names.items() if name != other)]


def _finer_steps(header: Any, done: Completed, scene: Path) -> tuple[int, list[str]]:
    """Make the steps of a file's coordinates as fine as the added points need, as far as 32 bits count.

    Returns:
        How many of the new steps an old one is, and a note of the change, or that there is none.

    Raises:
        StageError: the object reaches farther than the file's coordinates can.
    """
    own, apart, notes = header.scales.copy(), spacing(done.added.points), list[str]()
    farthest = np.abs(done.added.points - header.offsets).max(0, initial=0) / own
    if farthest.max() > MAX_INTEGER:
        raise StageError(
            f"the coordinates of {scene} end before the object does: its steps of {own.max():g} are too small; write it"
            " again with larger ones (0.001)"
        )
    farthest = np.maximum(farthest, np.abs([header.mins, header.maxs] - header.offsets).max(0) / own)
    step = finer(own.max(), apart, lambda step: bool(farthest.max() * (own.max() / step) <= MAX_INTEGER))
    times = round(own.max() / step)
    if times > 1:
        header.scales = own / times
        notes.append(f"completed.laz counts in steps of {step:g}, not {own.max():g}, as the object is so dense")
    if step > MAX_STEP * apart > 0:
        notes.append(
            f"the added points are {apart:.3g} apart, and completed.laz counts in steps of {step:g}: use completed.ply,"
            " or write the scene again with an offset near its points and finer steps"
        )
    return times, notes


def _keep_no_data(header: Any) -> None:
    """What a file's further dimensions say of no value; laspy forgets it with every change of them."""
    said = [one for record in header.vlrs.get("ExtraBytesVlr") for one in record.extra_bytes_structs]
    known = {one.format_name(): one.no_data for one in said}
    dimensions = header.point_format.dimensions
    dimensions[:] = [one._replace(no_data=known.get(one.name, one.no_data)) for one in dimensions]


def _free(name: str, taken: set[str]) -> str:
    """A name that no dimension has."""
    return _free(f"{name}_after", taken) if name in taken else name


def _but_copc(records: Iterable[Any]) -> list[Any]:
    return [record for record in records if record.user_id != "copc"]


def _added_record(header: Any, done: Completed, names: dict[str, str], white: float) -> Any:
    """The added points as a LAS file's points, in whose colours a number is white: 255 in a file of 8 bits."""
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(done.added), header=header)
    steps = (done.added.points - header.offsets) / header.scales
    columns: dict[str, NDArray[Any]] = dict(zip(AXES, np.rint(steps).astype(np.int32).T))
    columns |= dict.fromkeys(("return_number", "number_of_returns"), np.ones(len(record), np.uint8))
    if done.added.colors is not None and done.before.colors is not None:
        columns |= dict(zip(COLOR, done.added.colors.astype(np.uint16).T * round(white / 255)))
    _fill_in(record, columns | {names[name]: values for name, values in done.added.fields.items()})
    return record


def _fill_in(record: Any, columns: dict[str, NDArray[Any]]) -> None:
    for name, values in columns.items():
        record[name] = values
