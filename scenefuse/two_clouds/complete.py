"""The scene with a registered object in it, where neither has photos: what the scene lacks comes in, by distance."""

import copy
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.fusion.changes import FROM_OBJECT, FROM_SCENE, together, with_source
from scenefuse.fusion.evidence import FIELDS, unchecked, with_normals
from scenefuse.fusion.fuse_object import GREY, possible
from scenefuse.fusion.modes import FusionSettings, fuse_clouds
from scenefuse.io.clouds import LAS_DESCRIPTIONS, Cloud, write_cloud
from scenefuse.io.formats import las_crs
from scenefuse.io.import_cloud import unit_and_name
from scenefuse.io.readers.columns import COLOR
from scenefuse.io.settings import build, read_settings
from scenefuse.stage import StageError, atomic_file, quantity, write_json
from scenefuse.transforms import Sim3
from scenefuse.version import VERSION

CHUNK = 1_000_000
"""Points of a LAS file that are copied at a time."""
OWN = {*FIELDS, "source"}
"""Fields of a completed scene; one that is completed again keeps them, and its numbers in `source` go on."""


@dataclass(frozen=True)
class Completed:
    """A scene with an object in it.

    Attributes:
        kept: (N,) of the scene's points that stay.
        scene: these points, with `source` and the fields of evidence (method F4), not checked unless they were before.
        added: the object's points that come in, in the scene's coordinates, likewise.
        source: their `source`; 1, or the next number of a scene that was completed before.
        fill_distance: distance within which both show the same place.
        mode: `fill`, or the mode for comparison that the settings name.
        notes: what a user should know.
        seconds: that it took.
    """

    kept: NDArray[np.bool_]
    scene: Cloud
    added: Cloud
    source: int
    fill_distance: float
    mode: str
    notes: list[str]
    seconds: float

    @property
    def cloud(self) -> Cloud:
        """All points."""
        return together(self.scene, self.added)


def fusion_settings(config: Path | None) -> FusionSettings:
    """The shipped settings of the fusion with those of a YAML file laid over them."""
    return build(FusionSettings, read_settings(config)["fusion"])


def complete(obj: Cloud, scene: Cloud, part: Cloud, scene_from_object: Sim3, settings: FusionSettings) -> Completed:
    """Add a registered object to a scene as the workflow does where neither has photos (method F1).

    Args:
        obj: the object in its own frame.
        scene: the whole scene.
        part: the scene's points among which the object was found; its spacing says what is new.
        scene_from_object: the registration.
        settings: of the fusion; `evidence` needs photos and becomes `fill`, which a note says.
    """
    start = time.perf_counter()
    settings, notes = possible(settings, False, False)
    if scene.normals is not None:
        obj = with_normals(obj)
    fusion = fuse_clouds(obj, scene, part, scene_from_object, settings)
    again = set(scene.fields) >= OWN
    source = int(scene.fields["source"].max()) + 1 if again else FROM_OBJECT
    added = with_source(unchecked(fusion.added), source)
    if scene.colors is not None and obj.colors is None:
        notes.append("the object has no colours: its points are grey in the scene")
        added = replace(added, colors=np.full((len(added), 3), GREY, np.uint8))
    left_out = sorted({*scene.fields, *obj.fields} - (OWN if again else set()))
    if left_out:
        notes.append(f"completed.ply leaves out the columns {', '.join(left_out)}")
    kept = with_source(unchecked(scene[fusion.kept]), FROM_SCENE)
    if again:
        known = {name: scene.fields[name][fusion.kept].astype(of.dtype) for name, of in kept.fields.items()}
        kept = replace(kept, fields=known)
    seconds = time.perf_counter() - start
    return Completed(fusion.kept, kept, added, source, fusion.fill_distance, settings.mode, notes, seconds)


def write_completed(out: Path, done: Completed, object: Path, scene: Path) -> list[Path]:
    """Write completed.ply, completed.laz where the scene is LAS or LAZ, and completed.json; returns their paths."""
    notes, crs, written = list(done.notes), las_crs(scene), [out / "completed.ply"]
    write_cloud(written[0], done.cloud)
    if scene.suffix.lower() in (".las", ".laz"):
        written.append(out / "completed.laz")
        notes += append_to_las(written[1], scene, done)
    for note in notes:
        print(f"note       {note}", flush=True)
    unit, name = ("scene units", None) if crs is None else unit_and_name(crs)
    earlier = {str(number): f"{number} in {scene.name}" for number in range(FROM_OBJECT, done.source)}
    content = {
        "sources": quantity({str(FROM_SCENE): "scene", **earlier, str(done.source): object.stem}, ""),
        "points": quantity(len(done.scene) + len(done.added), "points"),
        "scene_points": quantity(len(done.scene), "points"),
        "removed_points": quantity(int((~done.kept).sum()), "points"),
        "added_points": quantity({object.stem: len(done.added)}, "points"),
        "mode": quantity(done.mode, ""),
        "fill_distance": quantity(done.fill_distance, unit),
        "notes": quantity(notes, ""),
        "crs": quantity(name, ""),
        "version": quantity(VERSION, ""),
        "seconds": quantity(done.seconds, "s"),
    }
    write_json(out / "completed.json", content)
    return [*written, out / "completed.json"]


def append_to_las(path: Path, scene: Path, done: Completed) -> list[str]:
    """Copy a LAS or LAZ file with all that its points have, and append what was added.

    Coordinates keep the file's own steps, and its CRS stays. The fields of `Completed` become extra dimensions. Added
    points have colours where the file has them; their classification and the like are 0. Points are copied in parts, so
    that memory stays small.

    Returns:
        Notes of what has another name there.

    Raises:
        StageError: the object reaches farther than the file's coordinates can.
    """
    import laspy

    with laspy.open(scene) as reader:
        header = copy.deepcopy(reader.header)
        # An index of the points (COPC) is not one of more points.
        header.vlrs = type(header.vlrs)(_but_copc(header.vlrs))
        further = type(header.vlrs)(_but_copc(header.evlrs or []))
        own = set(header.point_format.dimension_names)
        again = own >= OWN
        names = {name: name if again else _free(name, own) for name in done.added.fields}
        types = {} if again else {name: values.dtype.str[1:] for name, values in done.added.fields.items()}
        described = {name: LAS_DESCRIPTIONS.get(name, "") for name in types}
        header.add_extra_dims([laspy.ExtraBytesParams(names[n], kind, described[n]) for n, kind in types.items()])
        with atomic_file(path) as temporary, laspy.open(temporary, mode="w", header=header) as writer:
            brightest = 0
            for chunk, fields in _kept_chunks(reader, done):
                part = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=header)
                for name in chunk.array.dtype.names:
                    part.array[name] = chunk.array[name]
                if "red" in own:
                    brightest = max(brightest, *(int(np.max(part[name], initial=0)) for name in COLOR))
                _fill_in(part, {names[name]: values for name, values in fields.items()})
                writer.write_points(part)
            colors = 1 if 0 < brightest <= 255 else 257
            writer.write_points(_added_record(header, done, names, colors, scene))
            if further:
                writer.write_evlrs(further)
    return [f"in {path.name}, '{name}' is '{other}'" for name, other in names.items() if name != other]


def _free(name: str, taken: set[str]) -> str:
    """A name that no dimension has."""
    return _free(f"{name}_after", taken) if name in taken else name


def _but_copc(records: Iterable[Any]) -> list[Any]:
    return [record for record in records if record.user_id != "copc"]


def _kept_chunks(reader: Any, done: Completed) -> Iterator[tuple[Any, dict[str, NDArray[Any]]]]:
    """Parts of a LAS file without the points that were taken away, and their fields."""
    first, placed = 0, 0
    for chunk in reader.chunk_iterator(CHUNK):
        part = chunk[done.kept[first : first + len(chunk)]]
        rows = slice(placed, placed + len(part))
        yield part, {name: values[rows] for name, values in done.scene.fields.items()}
        first, placed = first + len(chunk), placed + len(part)


def _added_record(header: Any, done: Completed, names: dict[str, str], colors: int, scene: Path) -> Any:
    """The added points as a LAS file's points; a file of 8-bit colours gets those, by the factor `colors`."""
    import laspy

    record = laspy.ScaleAwarePointRecord.zeros(len(done.added), header=header)
    steps = (done.added.points - header.offsets) / header.scales
    if len(steps) and np.abs(steps).max() > np.iinfo(np.int32).max:
        raise StageError(
            f"the coordinates of {scene} end before the object does: its steps of {header.scales.max():g} are too"
            " small; write it again with larger ones (0.001)"
        )
    columns: dict[str, NDArray[Any]] = dict(zip("XYZ", np.rint(steps).astype(np.int32).T))
    columns |= dict.fromkeys(("return_number", "number_of_returns"), np.ones(len(record), np.uint8))
    if done.added.colors is not None and "red" in header.point_format.dimension_names:
        columns |= dict(zip(COLOR, done.added.colors.astype(np.uint16).T * colors))
    _fill_in(record, columns | {names[name]: values for name, values in done.added.fields.items()})
    return record


def _fill_in(record: Any, columns: dict[str, NDArray[Any]]) -> None:
    for name, values in columns.items():
        record[name] = values
