"""A user's cloud or mesh in the place of photos: a scene's dense cloud, or an object's."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scenefuse.cloud.cloud_file import (
    STRAY_PERCENT,
    FileSummary,
    lengths_fault,
    normals_fault,
    summarise,
    without_strays,
)
from scenefuse.cloud.clouds import Cloud, cloud_of, concatenate, spacing, write_cloud
from scenefuse.cloud.readers.columns import Columns
from scenefuse.cloud.readers.las import LAS_DIMENSIONS, WITHHELD, las_crs, las_dimensions
from scenefuse.cloud.tiled_cloud import open_cloud, write_tiled
from scenefuse.core.stage import StageError, quantity, write_json
from scenefuse.core.transforms import Array, Sim3

if TYPE_CHECKING:
    import pyproj

# Fewer different points give no features to register by.
MIN_POINTS = 200
# What `backend` says of a scene's cloud that was not made here.
IMPORTED = "imported"


def import_scene_cloud(
    *, source: Path, crs: str | None = None, cloud: Path, report: Path, georeference_json: Path
) -> None:
    """Take a cloud for a scene. The scene's frame has its axes, and z is up; its origin is near the points.

    Args:
        source: PLY, LAS, LAZ, E57, PCD, text, or a mesh (PLY, OBJ, glTF) that points are drawn from.
        crs: of its coordinates, where the file does not say it.
        cloud: output PLY in the scene's frame, tile by tile (`open_cloud`), with classes and intensities of LAS;
            however large, it is never all in memory.
        report: output JSON: points, spacing, notes.
        georeference_json: output JSON: `crs` (null where the file names none), `length_unit`, `origin_in_crs` and
            `crs_from_scene`, the shift back into the file's coordinates.

    Raises:
        StageError: the file is missing, damaged, in degrees, of an unknown ending, not where its CRS is used, in
            another CRS than `crs`, or has too few different points.
    """
    file = ImportedFile.of(source, LAS_DIMENSIONS)
    sample = file.summary.sample
    own = crs_of(source, crs)
    unit, name = unit_and_name(own)
    _check_axes(own, source)
    if own is not None:
        from scenefuse.cloud.crs import check_place

        check_place(own, sample, source)
    origin = near_origin(sample)
    shift = Sim3(1.0, np.eye(3), origin)
    content = file.write(cloud, lambda part: part.transformed(shift.inverse()), unit)
    write_json(report, content | {"backend": quantity(IMPORTED, "")})
    place = {
        "length_unit": quantity(unit, ""),
        "crs": quantity(name, ""),
        "origin_in_crs": quantity(origin, unit),
        "crs_from_scene": quantity(shift.matrix, unit),
    }
    write_json(georeference_json, place)


def crs_of(source: Path, said: str | None) -> "pyproj.CRS | None":
    """The CRS of a file: its own, or the one that a user says, perhaps with heights that the file does not know."""
    known = las_crs(source)
    if said is None:
        return known
    from scenefuse.cloud.crs import plane, projected_crs, registered

    crs = projected_crs(said, f"the column crs for {source.name}", heights=True)
    own = None if known is None else registered(known)
    if own is not None and (plane(own) != plane(crs) or (own.is_compound and own != crs)):
        raise StageError(f"{source} is in {own.name}, but the column crs says {crs.name}; empty that cell")
    return crs


def _check_axes(crs: "pyproj.CRS | None", source: Path) -> None:
    """StageError where the axes of a file's CRS stretch or mirror what lies in it (`crs.usable`)."""
    if crs is not None:
        from scenefuse.cloud.crs import usable

        usable(crs, str(source), local=True)


def import_object_cloud(*, source: Path, cloud: Path, report: Path) -> None:
    """Take a cloud for an object, in any frame and unit.

    Args:
        source: as of `import_scene_cloud`.
        cloud: output PLY; the file's axes and unit, relative to an origin near the points.
        report: output JSON: points, spacing, notes, and the shift `object_from_file`.

    Raises:
        StageError: as of `import_scene_cloud`.
    """
    file = ImportedFile.of(source)
    _check_axes(las_crs(source), source)
    whole, notes = without_strays(concatenate(list(file.clouds())), source.name)
    origin = near_origin(whole.points)
    placed = replace(whole, points=whole.points - origin)
    write_cloud(cloud, placed)
    shift = Sim3(1.0, np.eye(3), -origin)
    content = file.report(placed.points, spacing(placed.points), placed.diagonal, "object units", notes)
    content["points"] = quantity(len(placed), "1")
    write_json(report, content | {"object_from_file": quantity(shift.matrix, "object units")})


def near_origin(points: Array) -> Array:
    """A round place (3,) near points (N, 3): their middle, rounded to the next power of ten above their extent.

    Relative to it, float32 is a hundredth of a millimetre in a hundred metres. Points near zero keep their coordinates.
    """
    low, middle, high = np.percentile(points, [STRAY_PERCENT, 50, 100 - STRAY_PERCENT], axis=0)
    step = 10.0 ** np.ceil(np.log10(max(float((high - low).max()), 1e-12)))
    return np.asarray(np.round(middle / step) * step + 0.0)


@dataclass(frozen=True)
class ImportedFile:
    """A file whose points are taken over.

    Attributes:
        summary: what is known of all its points.
        fault: of its normals, see `normals_fault`; they are left out.
        kept: names of further columns that are taken over.
        unused: names of further columns.
    """

    summary: FileSummary
    fault: str
    kept: tuple[str, ...]
    unused: list[str]

    @classmethod
    def of(cls, source: Path, keep: Collection[str] = (), degrees: bool = False) -> "ImportedFile":
        """Go through a file once.

        Args:
            source: the file.
            keep: dimensions of LAS to take over, where the file says something by them.
            degrees: whether LAS and LAZ may be in degrees.

        Raises:
            StageError: it is missing, damaged, of an unknown ending, or has too few different points.
        """
        fault, said, names = None, set[str](), set[str]()

        def look(_: Columns, surface: Columns) -> None:
            nonlocal fault
            part = cloud_of(surface)
            names.update(part.fields)
            said.update(name for name in {*keep} - said if name in part.fields and part.fields[name].any())
            # The first part is as dense as the file; the last may be a few points.
            fault = normals_fault(part) if fault is None else fault or lengths_fault(part)

        whole = summarise(source, look, degrees)
        enough = len(np.unique(whole.sample[:, 0])) >= MIN_POINTS
        if not enough and (different := len(np.unique(whole.sample, axis=0))) < MIN_POINTS:
            raise StageError(
                f"{source} has only {different} different positions among its {whole.count} points; {MIN_POINTS} or"
                " more are needed to place it"
            )
        own = set(LAS_DIMENSIONS) if whole.is_las else set[str]()
        unused = (names - own | set(las_dimensions(source))) - own.intersection(keep) - {WITHHELD, ""}
        return cls(whole, fault or "", tuple(sorted(said & own)), sorted(unused))

    def clouds(self) -> Iterator[Cloud]:
        """The points in parts, with unit normals or none, colours as bytes or none, and only the fields kept."""
        for columns in self.summary.columns():
            surface = self.summary.surface(columns)
            cloud, normals = self.summary.cloud(surface), None
            if not self.fault and cloud.normals is not None:
                normals = (cloud.normals / np.linalg.norm(cloud.normals, axis=1, keepdims=True)).astype(np.float32)
            yield replace(cloud, normals=normals, fields={name: surface[name] for name in self.kept})

    def write(self, cloud: Path, move: Callable[[Cloud], Cloud], unit: str) -> dict[str, Any]:
        """Write the points in another frame, tile by tile; the report of it.

        Args:
            cloud: output PLY.
            move: from the file's frame into another.
            unit: of lengths in that frame.
        """

        def placed() -> Iterator[Cloud]:
            return map(move, self.clouds())

        write_tiled(cloud, placed, self.summary.count, move(Cloud(self.summary.sample)).points)
        tiles = open_cloud(cloud)
        diagonal = float(np.linalg.norm(tiles.high.max(0) - tiles.low.min(0)))
        return self.report(np.concatenate(tiles.samples()), tiles.spacing(), diagonal, unit)

    def report(
        self, points: Array, step: float, diagonal: float, unit: str, more: Sequence[str] = ()
    ) -> dict[str, Any]:
        """What was taken over, and what became of the rest; printed too.

        Args:
            points: (N, 3) some that were taken over, as dense as all.
            step: distance between neighbouring ones.
            diagonal: of the points' box.
            unit: of both.
            more: further notes.
        """
        notes = [*self.summary.notes(points, step), *more]
        if self.fault:
            notes.append(f"its normals {self.fault} and were left out: they are estimated from the points")
        if self.unused:
            notes.append(f"not taken over, and so not in the results: {', '.join(self.unused)}")
        for note in notes:
            print(note, flush=True)
        return {
            "points": quantity(self.summary.count, "1"),
            "spacing": quantity(step, unit),
            "diagonal": quantity(diagonal, unit),
            "source": quantity(self.summary.path.name, ""),
            "columns_not_used": quantity(self.unused, ""),
            "notes": quantity(notes, ""),
        }


def unit_and_name(crs: "pyproj.CRS | None") -> tuple[str, str | None]:
    """The unit of a projected CRS (`unit_name`), and its name: an EPSG code where it has one, else its WKT."""
    if crs is None:
        return "scene units", None
    from scenefuse.cloud.crs import unit_name

    return unit_name(crs), crs.to_string()
