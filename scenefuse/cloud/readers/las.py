"""LAS and LAZ read: points, what the format says of them, and the coordinate system."""

import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scenefuse.cloud.readers.columns import AT_ONCE, COLOR, POSITION, Columns, check_count
from scenefuse.core.stage import StageError

if TYPE_CHECKING:
    import pyproj

ENDINGS = (".las", ".laz")
# What LAS says of a point that a scene's cloud keeps, and as what; of points that were measured otherwise both are 0.
LAS_DIMENSIONS = {"classification": np.uint8, "intensity": np.uint16}
# Classes of LAS that are no surface: low and high noise; the flag of points that whoever edited the cloud took out.
NOISE = (7, 18)
WITHHELD = "withheld"
# The least and the greatest number of steps that a coordinate counts.
ENDS = (np.iinfo(np.int32).min, np.iinfo(np.int32).max)


def las_crs(path: Path) -> "pyproj.CRS | None":
    """The coordinate system of a LAS or LAZ file; None where it has none, and for any other file."""
    if path.suffix.lower() not in ENDINGS:
        return None
    import laspy

    _check_header(path)
    with laspy.open(path) as file:
        return _crs(file.header)


def check_projected(path: Path) -> None:
    """StageError where a LAS or LAZ file is in degrees, geocentric or stretched."""
    from scenefuse.cloud.crs import MERCATOR, is_stretched

    crs = las_crs(path)
    if crs is not None and (crs.is_geocentric or crs.is_geographic or is_stretched(crs)):
        why = "geocentric coordinates, with z along the earth's axis" if crs.is_geocentric else "degrees"
        why = MERCATOR if is_stretched(crs) else why
        raise StageError(f"{path} is in {why} ({crs.name}); project it to metres first, to UTM for instance")


def las_dimensions(path: Path) -> list[str]:
    """What a LAS or LAZ file says of its points beside position, colour and extra dimensions, as far as it differs
    among the first million or is a class: names of the format; empty for any other file."""
    if path.suffix.lower() not in ENDINGS:
        return []
    import laspy

    with laspy.open(path) as file:
        points = next(iter(file.chunk_iterator(AT_ONCE)), None)
    if points is None:
        return []
    names = [n for n in points.point_format.standard_dimension_names if n.lower() not in (*POSITION, *COLOR)]
    values = {name: np.asarray(points[name]) for name in names}
    differing = {name for name in names if values[name].min() != values[name].max()}
    return [name for name in names if name in differing or (name == "classification" and values[name].any())]


def read_las(path: Path, at_once: int) -> Iterator[Columns]:
    """Positions, colours, extra dimensions of one number, classes and intensities, and what is withheld, so many points
    at a time. A format with colours is used for points without, which are all black then."""
    import laspy

    with laspy.open(path) as file:
        form, count = file.header.point_format, 0
        if file.header.are_points_compressed:
            check_count(path, file.header.point_count, max(file.header.point_count, _packed(path, file.header)))
        at_once = max(1, min(at_once, 256 * AT_ONCE // form.size))  # however wide the header says that a point is
        named = [*POSITION, *(COLOR if set(COLOR) <= set(form.dimension_names) else ())]
        for points in file.chunk_iterator(at_once):
            count += len(points)
            extra = {name: np.asarray(points[name]) for name in form.extra_dimension_names}
            own = {name: np.asarray(points[name]).astype(kind) for name, kind in LAS_DIMENSIONS.items()}
            own[WITHHELD] = np.asarray(points[WITHHELD]) != 0
            found = {name: np.asarray(points[name]) for name in named}
            for axis in POSITION:  # coordinates beyond what 32 bits count are cut off there by what wrote the file
                cut = np.isin(points.array[axis.upper()], ENDS)
                found[axis] = np.where(cut, np.nan, found[axis]) if cut.any() else found[axis]
            yield (
                found | own | {name: values for name, values in extra.items() if values.ndim == 1 and name not in own}
            )
        check_count(path, file.header.point_count, count)


def _packed(path: Path, header: Any) -> int:
    """How many points the chunks of a LAZ hold at least; 0 where it has no table of chunks."""
    import lazrs

    laszip = lazrs.LazVlr(header.vlrs.get("LasZipVlr")[0].record_data)
    with open(path, "rb") as file, suppress(lazrs.LazrsError):
        file.seek(header.offset_to_point_data)
        chunks = lazrs.read_chunk_table(file, laszip)
        counts = [count for count, _ in chunks]
        if counts and not laszip.uses_variable_size_chunks():
            counts[-1] = 1
            if header.point_format.id >= 6:  # behind its first point, a chunk says how many it has
                file.seek(sum(size for _, size in chunks[:-1]) + laszip.item_size(), 1)
                counts[-1] = int.from_bytes(file.read(4), "little")
        return sum(counts)
    return 0


def _check_header(path: Path) -> None:
    """Refuse a header that counts other than the file holds, before a library believes it (LAS 1.4 R15, 2.4).

    Raises:
        StageError: the file is cut short, or holds more points.
        ValueError: it is no LAS file.
    """
    with open(path, "rb") as file:
        head = file.read(375)
        there = file.seek(0, 2)
        if len(head) < 227 or not head.startswith(b"LASF"):
            raise ValueError("it does not begin as LAS does")
        begin, records, kind, length, count = struct.unpack_from("<IIBHI", head, 96)
        end = there
        if not np.isfinite(scales := struct.unpack_from("<3d", head, 131)).all() or not all(scales):
            raise ValueError(f"its coordinates count in steps of {scales}")
        if head[25] >= 4 and len(head) == 375:
            start, more, long_count = struct.unpack_from("<QIQ", head, 235)
            count, end = long_count or count, min(struct.unpack_from("<Q", head, 227)[0] or there, start or there)
            for _ in range(more):  # extended records behind the points, each with its length
                file.seek(min(start + 20, there))
                start += 60 + int.from_bytes(file.read(8), "little")
                if start > there or start < begin:
                    raise StageError(f"{path} is cut short: its last records are missing; copy it again")
    if 54 * records > begin or length < 20:
        raise ValueError("its header counts more records than it holds")
    held, odd = divmod(max(end - begin, 0), length)
    if begin > there or (not kind & 128 and (held < count or not odd)):
        check_count(path, count, held)


def _crs(header: Any) -> "pyproj.CRS | None":
    """The CRS of a LAS header, or None; an entry that pyproj cannot read counts as none."""
    from pyproj.exceptions import CRSError

    from scenefuse.cloud.crs import with_units

    try:
        crs = header.parse_crs()
        keys = {
            key.id: key.value_offset
            for record in header.vlrs.get("GeoKeyDirectoryVlr")
            for key in record.geo_keys
            if key.tiff_tag_location == 0
        }
        if crs is not None and crs.is_geographic and keys.get(1024) == 1:
            raise CRSError(f"its keys name no number of a projected one, only its datum, {crs.name}")
        return crs if crs is None or not crs.is_projected or crs.is_compound else with_units(crs, keys)
    except CRSError as error:
        print(f"the file's coordinate system cannot be read and is ignored: {error}", flush=True)
        return None
