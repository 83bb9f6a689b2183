"""A user's cloud or mesh in the place of photos: a scene's dense cloud, or an object's."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.io.clouds import (
    Cloud,
    chosen_rows,
    cloud_of,
    concatenate,
    finite_rows,
    is_nothing_at_zero,
    precision_note,
    spacing,
    write_cloud,
)
from scenefuse.io.formats import LAS_DIMENSIONS, NOISE, WITHHELD, check_not_degrees, las_crs, las_dimensions
from scenefuse.io.readers.columns import COLOR, POSITION, Columns
from scenefuse.io.readers.text import text_notes
from scenefuse.io.tiles.parts import ColumnParts, columns_in_parts
from scenefuse.io.tiles.tiled_cloud import open_cloud
from scenefuse.io.tiles.write_tiles import write_tiled
from scenefuse.stage import StageError, quantity, write_json
from scenefuse.transforms import Array, Sim3

# Fewer different points give no features to register by.
LEAST_POINTS = 200
# Among so many points they are looked for before they are counted among all.
ENOUGH = 10_000
# Positions below this share of the points, and above the same share, are strays: they do not move the origin.
STRAY_PERCENT = 1.0
# Of a larger cloud, its place is found from every so manyth point: from so many at least.
SAMPLE = 1 << 20
# Normals may be this far from unit length.
UNIT_TOLERANCE = 0.05
# Why points at 0 0 0 are left out.
AT_ZERO = "points at 0 0 0, far from all others,"
# What `backend` says of a scene's cloud that was not made here.
IMPORTED = "imported"


def import_scene_cloud(
    *, source: Path, crs: str | None = None, cloud: Path, report: Path, georeference_json: Path
) -> None:
    """Take a cloud for a scene. The scene's frame has its axes, and z is up; its origin is near the points.

    Args:
        source: PLY, LAS, LAZ, E57, PCD, text, or a mesh (PLY, OBJ, GLB) that points are drawn from.
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
    parts = columns_in_parts(source)
    own = survey(source, parts, LAS_DIMENSIONS)
    check_not_degrees(source, own.sample)
    crs = crs_of(source, crs)
    unit, name = "scene units", None
    if crs is not None:
        unit, name = unit_and_name(crs)
        from scenefuse.io.crs import check_place

        check_place(crs, own.sample, source)
    origin = near_origin(own.sample)
    shift = Sim3(1.0, np.eye(3), origin)
    content = write_placed(cloud, source, parts, own, lambda part: part.transformed(shift.inverse()), unit)
    write_json(report, content | {"backend": quantity(IMPORTED, "")})
    place = {
        "length_unit": quantity(unit, ""),
        "crs": quantity(name, ""),
        "origin_in_crs": quantity(origin, unit),
        "crs_from_scene": quantity(shift.matrix, unit),
    }
    write_json(georeference_json, place)


def crs_of(source: Path, said: str | None) -> str | None:
    """The CRS of a file: its own, or the one that a user says, perhaps with heights that the file does not know."""
    known = las_crs(source)
    if said is None:
        return known
    import pyproj

    from scenefuse.io.crs import plane, projected_crs, registered

    crs = projected_crs(said, f"the column crs for {source.name}", heights=True)
    own = None if known is None else registered(pyproj.CRS.from_wkt(known))
    if own is not None and (plane(own) != plane(crs) or (own.is_compound and own != crs)):
        raise StageError(f"{source} is in {own.name}, but the column crs says {crs.name}; empty that cell")
    return str(crs.to_string())


def import_object_cloud(*, source: Path, cloud: Path, report: Path) -> None:
    """Take a cloud for an object, in any frame and unit.

    Args:
        source: as of `import_scene_cloud`.
        cloud: output PLY; the file's axes and unit, relative to an origin near the points.
        report: output JSON: points, spacing, notes, and the shift `object_from_file`.

    Raises:
        StageError: as of `import_scene_cloud`.
    """
    parts = columns_in_parts(source)
    own = survey(source, parts)
    check_not_degrees(source, own.sample)
    whole = concatenate(list(clouds_in_parts(parts, own)))
    origin = near_origin(whole.points)
    placed = replace(whole, points=whole.points - origin)
    write_cloud(cloud, placed)
    shift = Sim3(1.0, np.eye(3), -origin)
    content = import_report(source, own, spacing(placed.points), placed.diagonal, "object units")
    write_json(report, content | {"object_from_file": quantity(shift.matrix, "object units")})


def near_origin(points: Array) -> Array:
    """A round place (3,) near points (N, 3): their middle, rounded to the next power of ten above their extent.

    Relative to it, float32 is a hundredth of a millimetre in a hundred metres. Points near zero keep their coordinates.
    """
    low, middle, high = np.percentile(points, [STRAY_PERCENT, 50, 100 - STRAY_PERCENT], axis=0)
    step = 10.0 ** np.ceil(np.log10(max(float((high - low).max()), 1e-12)))
    return np.asarray(np.round(middle / step) * step + 0.0)


@dataclass(frozen=True)
class Survey:
    """What has to be known of all of a file's points before any is written.

    Attributes:
        count: of the rows with a finite position.
        left_out: why rows were left out -> how many.
        sample: (S, 3) positions of every so manyth of them: of all up to SAMPLE.
        unit_normals: whether there are normals, all of unit length; None where there are none.
        most_color: the greatest colour; None where there are none.
        without_zero: whether points at 0 0 0 are none; they are not among the sample in any case.
        is_las: whether the file is LAS or LAZ.
        kept: names of further columns that are taken over.
        unused: names of further columns.
    """

    count: int
    left_out: dict[str, int]
    sample: Array
    unit_normals: bool | None
    most_color: float | None
    without_zero: bool
    is_las: bool
    kept: tuple[str, ...]
    unused: list[str]


def survey(source: Path, parts: ColumnParts, keep: Collection[str] = ()) -> Survey:
    """Go through a file once.

    Args:
        source: the file.
        parts: its columns.
        keep: dimensions of LAS to take over, where the file says something by them.

    Raises:
        StageError: it is damaged, or has too few different points.
    """
    known = set(LAS_DIMENSIONS) if source.suffix.lower() in (".las", ".laz") else set()
    count, left_out, every, sample = 0, dict[str, int](), 1, np.zeros((0, 3))
    unit_normals, most_color, unused, kept, zeros = None, None, set[str](), set[str](), 0
    for columns in parts():
        columns, without = surface_rows(columns, bool(known))
        left_out = {why: left_out.get(why, 0) + rows for why, rows in without.items()}
        part = cloud_of(columns)
        at_zero = (part.points == 0).all(1)
        zeros += int(at_zero.sum())
        sample = np.concatenate([sample, part.points[-count % every :: every][~at_zero[-count % every :: every]]])
        while len(sample) > 2 * SAMPLE:
            sample, every = sample[::2], 2 * every
        count, unused = count + len(part), unused | (set(part.fields) - known)
        kept |= {name for name in known.intersection(keep) - kept if part.fields[name].any()}
        if part.normals is not None:
            off = np.abs(np.linalg.norm(part.normals, axis=1) - 1) > UNIT_TOLERANCE
            unit_normals = unit_normals is not False and not off.any()
        if part.colors is not None:
            here = max(float(np.nan_to_num(columns[name].astype(np.float64)).max(initial=0)) for name in COLOR)
            most_color = max(here, most_color or 0.0)
    without_zero = zeros > 0 and is_nothing_at_zero(sample)
    if without_zero:
        left_out[AT_ZERO], count = zeros, count - zeros
    sample = sample if len(sample) else np.zeros((min(count, 1), 3))
    if count == 0:
        what = "point with a finite position" if any(left_out.values()) else "points"
        raise StageError(f"{source} holds no {what}; look at what wrote it")
    unused = (unused | set(las_dimensions(source))) - known.intersection(keep) - {WITHHELD}
    different = len(np.unique(sample[:: max(1, len(sample) // ENOUGH)], axis=0))
    if different < LEAST_POINTS and (different := len(np.unique(sample, axis=0))) < LEAST_POINTS:
        raise StageError(
            f"{source} has only {different} different positions among its {count} points; {LEAST_POINTS} or more"
            " are needed to place it"
        )
    if most_color == 0 and source.suffix.lower() in (".las", ".laz"):
        most_color = None  # Formats with colours are used for points without, which are black then.
    names = tuple(sorted(kept)), sorted(unused - {""})
    return Survey(count, left_out, sample, unit_normals, most_color, without_zero, bool(known), *names)


def surface_rows(columns: Columns, is_las: bool, without_zero: bool = False) -> tuple[Columns, dict[str, int]]:
    """The rows that are points of a surface, without the column `withheld`, and why others were left out -> how
    many. `without_zero` is true where points at 0 0 0 are none, which only the whole file says."""
    without = dict[str, int]()
    columns, without["rows without a finite position"] = finite_rows(columns)
    if without_zero:
        elsewhere = np.any([columns[axis] != 0 for axis in POSITION], axis=0)
        columns, without[AT_ZERO] = chosen_rows(columns, elsewhere)
    if is_las:
        columns, noise = chosen_rows(columns, ~np.isin(columns["classification"], NOISE))
        without[f"points of the classes {NOISE[0]} and {NOISE[1]} (noise)"] = noise
        columns, without["withheld points"] = chosen_rows(columns, ~columns[WITHHELD])
        columns = {name: values for name, values in columns.items() if name != WITHHELD}
    return columns, without


def clouds_in_parts(parts: ColumnParts, own: Survey) -> Iterator[Cloud]:
    """The file's points in parts, with unit normals or none, colours as bytes or none, and only the fields kept."""
    for columns in parts():
        cloud = cloud_of(surface_rows(columns, own.is_las, own.without_zero)[0], own.most_color)
        normals = None
        if own.unit_normals and cloud.normals is not None:
            normals = (cloud.normals / np.linalg.norm(cloud.normals, axis=1, keepdims=True)).astype(np.float32)
        colors = None if own.most_color is None else cloud.colors
        yield Cloud(cloud.points, normals, colors, {name: cloud.fields[name] for name in own.kept})


def write_placed(
    cloud: Path, source: Path, parts: ColumnParts, own: Survey, move: Callable[[Cloud], Cloud], unit: str
) -> dict[str, Any]:
    """Write a file's points in another frame, tile by tile; the report of it.

    Args:
        cloud: output PLY.
        source: the file.
        parts: its columns.
        own: what `survey` says of it.
        move: from the file's frame into another.
        unit: of lengths in that frame.
    """

    def placed() -> Iterator[Cloud]:
        return map(move, clouds_in_parts(parts, own))

    write_tiled(cloud, placed, own.count, move(Cloud(own.sample)).points)
    tiles = open_cloud(cloud)
    diagonal = float(np.linalg.norm(tiles.high.max(0) - tiles.low.min(0)))
    return import_report(source, own, tiles.spacing(), diagonal, unit)


def import_report(source: Path, own: Survey, step: float, diagonal: float, unit: str) -> dict[str, Any]:
    """What was taken over, and what became of the rest; printed too."""
    notes = [f"{count} {why} were left out" for why, count in own.left_out.items() if count]
    notes += [*text_notes(source), *precision_note(source, own.sample, step)]
    if own.unit_normals is False:
        notes.append("its normals are not all of unit length and were left out: they are estimated from the points")
    if own.unused:
        notes.append(f"not taken over, and so not in the results: {', '.join(own.unused)}")
    for note in notes:
        print(note, flush=True)
    return {
        "points": quantity(own.count, "1"),
        "spacing": quantity(step, unit),
        "diagonal": quantity(diagonal, unit),
        "source": quantity(source.name, ""),
        "columns_not_used": quantity(own.unused, ""),
        "has_colors": quantity(own.most_color is not None, ""),
        "has_normals": quantity(bool(own.unit_normals), ""),
        "notes": quantity(notes, ""),
    }


def unit_and_name(crs: str) -> tuple[str, str]:
    """The unit of a projected CRS, "m" for metres, and its name: an EPSG code where it has one, else its WKT."""
    import pyproj

    known = pyproj.CRS.from_user_input(crs)
    unit = known.axis_info[0].unit_name if known.axis_info else "metre"
    return "m" if unit in ("metre", "meter") else unit, known.to_string()
