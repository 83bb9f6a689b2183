"""Point cloud files of any known ending as named columns: PLY, LAS and LAZ (COPC too), E57, PCD, rows of text, and
meshes (PLY with faces, OBJ, GLB), from whose faces points are drawn.

Columns have the names that PLY uses (x, y, z, nx, ny, nz, red, green, blue); all others keep their own. Positions keep
the precision of the file. Libraries are loaded when a file needs them.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import COLOR, POSITION, Columns, common_name, positions
from scenefuse.cloud.readers.meshes import Mesh, read_glb, read_obj, sampled_columns, triangles
from scenefuse.cloud.readers.pcd import pcd_parts
from scenefuse.cloud.readers.text import TEXTS, text_parts
from scenefuse.cloud.tiles.ply_header import read_header, read_text_header
from scenefuse.core.stage import StageError

# What LAS says of a point that a scene's cloud keeps, and as what; of points that were measured otherwise both are 0.
LAS_DIMENSIONS = {"classification": np.uint8, "intensity": np.uint16}
# Classes of LAS that are no surface: low and high noise; the flag of points that whoever edited the cloud took out.
NOISE, WITHHELD = (7, 18), "withheld"
# Points of a LAS file that are looked at for what they say beside positions and colours.
LOOKED_AT = 1_000_000
# Narrower than this share of its height, a cloud at coordinates like longitude and latitude is in degrees.
DEGREES_BELOW = 1e-3
# More points than any file has.
EVERYTHING = 1 << 62
# Lines of a PLY of text that are taken at once: they take several times the memory of their numbers.
LINES_AT_ONCE = 1_000_000


def read_columns(path: Path) -> Columns:
    """The columns of a cloud file, as the file holds them.

    Raises:
        StageError: the ending is not known, or the file is missing, damaged, without positions or without points.
    """
    reader = READERS.get(path.suffix.lower())
    if path.is_dir():
        raise StageError(f"{path} is a folder; give the path of a cloud ({', '.join(READERS)})")
    if reader is None:
        raise StageError(
            f"{path}: '{path.suffix}' is no known ending of a cloud or mesh; convert it to one of {', '.join(READERS)}"
        )
    if not path.is_file():
        raise StageError(f"{path} does not exist; give the path of a cloud ({', '.join(READERS)})")
    with readable(path):
        check_projected(path)
        columns = reader(path)
    columns = checked(path, columns)
    if len(columns["x"]) == 0:
        raise StageError(f"{path} holds no points; look at what wrote it")
    return columns


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """What a library says of a damaged file, as one sentence.

    Raises:
        StageError: the file is empty, or cannot be read.
    """
    if path.is_file() and path.stat().st_size == 0:
        raise StageError(f"{path} is empty (0 bytes); copy or export it again")
    try:
        yield
    except (StageError, MemoryError):
        raise
    except Exception as error:  # each library has its own errors for a damaged file
        kind = path.suffix.removeprefix(".").upper()
        why = (str(error) or type(error).__name__).splitlines()[0]
        raise StageError(
            f"{path} is not a readable {kind} cloud ({why}); copy it again, for it may be cut short, or export it again"
        ) from None


def checked(path: Path, columns: Columns) -> Columns:
    """Columns by their common names; StageError where there are no positions."""
    columns = {common_name(name): values for name, values in columns.items()}
    if not set(POSITION) <= set(columns):
        raise StageError(f"{path} has no columns x, y and z but {', '.join(columns) or 'none'}; export it again")
    return columns


def bytes_of(colors: NDArray[Any], most: float | None = None) -> NDArray[np.uint8]:
    """Colours (N, 3) as 0..255, from bytes, from 16 bits, or from fractions of 1; which one it is, the greatest value
    tells, or `most` where these are a part of the colours."""
    if colors.dtype == np.uint8:
        return colors
    values = np.nan_to_num(colors.astype(np.float64))
    if most is None:
        most = values.max(initial=0)
    if most > 255:
        values = values / 257
    elif np.issubdtype(colors.dtype, np.floating) and most <= 1:
        values = values * 255
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def las_crs(path: Path) -> str | None:
    """The coordinate system of a LAS or LAZ file as WKT; None where it has none, and for any other file."""
    if path.suffix.lower() not in (".las", ".laz"):
        return None
    import laspy

    with laspy.open(path) as file:
        crs = _crs(file.header)
    return None if crs is None else crs.to_wkt()


def check_projected(path: Path) -> None:
    """StageError where a LAS or LAZ file is in degrees."""
    import pyproj

    wkt = las_crs(path)
    crs = None if wkt is None else pyproj.CRS.from_wkt(wkt)
    if crs is not None and crs.is_geocentric:
        raise StageError(
            f"{path} is in geocentric coordinates ({crs.name}), with z along the earth's axis; project it first"
        )
    if crs is not None and crs.is_geographic:
        raise StageError(f"{path} is in degrees ({crs.name}); project it to metres first, to UTM for instance")


def check_not_degrees(path: Path, points: NDArray[np.float64]) -> None:
    """StageError where points (N, 3) of a file without a CRS can only be longitude, latitude and a height in metres:
    far from zero, and narrow beside their height. Of a flat site that cannot be told."""
    crs = las_crs(path)
    low, high = np.percentile(points, [10, 90], axis=0)
    far = np.minimum(abs(low), abs(high))[:2]
    wide, tall = float((high - low)[:2].max()), float(high[2] - low[2])
    if crs is None and far.min() > 1 and far.max() <= 360 and far.min() <= 90 and 0 < wide < DEGREES_BELOW * tall:
        raise StageError(
            f"{path} seems to be in degrees: x and y vary by {wide:.3g} where z varies by {tall:.3g}; project it to"
            " metres first, to UTM for instance (if it is in metres, subtract its x and y)"
        )


def las_dimensions(path: Path) -> list[str]:
    """What a LAS or LAZ file says of its points beside position, colour and extra dimensions, as far as it differs
    among the first million or is a class: names of the format; empty for any other file."""
    if path.suffix.lower() not in (".las", ".laz"):
        return []
    import laspy

    with readable(path), laspy.open(path) as file:
        points = next(iter(file.chunk_iterator(LOOKED_AT)), None)
    if points is None:
        return []
    form = points.point_format
    names = [name for name in form.standard_dimension_names if name.lower() not in (*POSITION, *COLOR)]
    values = {name: np.asarray(points[name]) for name in names}
    differing = {name for name in names if values[name].min() != values[name].max()}
    return [name for name in names if name in differing or (name == "classification" and values[name].any())]


def _ply(path: Path) -> Columns:
    """Points, or points drawn from the faces where there are any."""
    if reader := part_reader(path):
        return _joined(reader(path, EVERYTHING))
    from plyfile import PlyData

    content = PlyData.read(path)
    vertex = content["vertex"].data
    columns = {name: np.array(vertex[name]) for name in vertex.dtype.names if vertex.dtype[name].kind in "iuf"}
    if "face" not in content or not len(content["face"].data):
        return columns
    face = content["face"].data
    corners = next((name for name in ("vertex_indices", "vertex_index") if name in face.dtype.names), None)
    if corners is None or not set(POSITION) <= set(columns):
        return columns
    named = {common_name(name): values for name, values in columns.items()}
    vertices = positions(columns)
    colors = None
    if set(COLOR) <= set(named):
        colors = bytes_of(np.stack([named[name] for name in COLOR], axis=1)).astype(np.float64)
    faces = triangles(list(face[corners]))[0]
    return sampled_columns(Mesh(vertices, faces, colors, None, np.full(len(faces), -1)))


def _ply_parts(path: Path, at_once: int) -> Iterator[Columns]:
    """The columns of a PLY whose points come first, without lists, so many rows at a time."""
    binary = read_header(path)
    elements, offset = binary or read_text_header(path) or ([], 0)
    row, left = elements[0].row, elements[0].count
    assert row is not None and row.names is not None
    kinds = {name: row[name] for name in row.names if row[name].kind in "iuf"}
    with open(path, "rb") as file:
        file.seek(offset)
        while left:
            most = min(left, at_once)
            rows: Any = np.fromfile(file, row, most) if binary else _rows_of_text(file, row, most)
            if not len(rows):
                raise StageError(f"{path} is cut short: its last {left} points are missing; copy it again")
            left -= len(rows)
            yield {name: np.ascontiguousarray(rows[name]) for name in kinds}


def _rows_of_text(file: BinaryIO, row: np.dtype[Any], most: int) -> NDArray[Any]:
    """The next rows of a PLY of text, so many at most; single precision has the digits of the text."""
    assert row.names is not None
    lines = list(islice(file, min(most, LINES_AT_ONCE)))
    wide = np.dtype([(name, "f8" if row[name].kind == "f" else row[name]) for name in row.names])
    return np.loadtxt((line.decode("ascii") for line in lines), wide, ndmin=1) if lines else np.empty(0, wide)


def _las(path: Path) -> Columns:
    """Positions, colours (unless all are black, which means none), and extra dimensions of one number."""
    own = {*LAS_DIMENSIONS, WITHHELD}
    columns = {name: values for name, values in _joined(_las_parts(path, -1)).items() if name not in own}
    if set(COLOR) <= set(columns) and not any(columns[name].any() for name in COLOR):
        columns = {name: values for name, values in columns.items() if name not in COLOR}
    return columns


def _las_parts(path: Path, at_once: int) -> Iterator[Columns]:
    """The same, so many points at a time, with classes and intensities, what is withheld, and black colours too."""
    import laspy

    with laspy.open(path) as file:
        form, count = file.header.point_format, 0
        named = [*POSITION, *(COLOR if set(COLOR) <= set(form.dimension_names) else ())]
        for points in file.chunk_iterator(at_once):
            count += len(points)
            extra = {name: np.asarray(points[name]) for name in form.extra_dimension_names}
            own = {name: np.asarray(points[name]).astype(kind) for name, kind in LAS_DIMENSIONS.items()}
            own[WITHHELD] = np.asarray(points[WITHHELD]) != 0
            yield (
                {name: np.asarray(points[name]) for name in named}
                | own
                | {name: values for name, values in extra.items() if values.ndim == 1 and name not in own}
            )
        if count < file.header.point_count:
            missing = file.header.point_count - count
            raise StageError(f"{path} is cut short: its last {missing} points are missing; copy it again")


def _joined(parts: Iterator[Columns]) -> Columns:
    found = list(parts)
    if not found:
        return {name: np.empty(0) for name in POSITION}
    return found[0] if len(found) == 1 else {name: np.concatenate([part[name] for part in found]) for name in found[0]}


def _crs(header: Any) -> Any:
    """The pyproj CRS of a LAS header, or None; an entry that pyproj cannot read counts as none."""
    from pyproj.exceptions import CRSError

    try:
        return header.parse_crs()
    except CRSError as error:
        print(f"the file's coordinate system cannot be read and is ignored: {error}", flush=True)
        return None


def _e57(path: Path) -> Columns:
    """All scans of the file, each moved by its pose; points marked as invalid are left out."""
    return _joined(_e57_parts(path, EVERYTHING))


def _e57_parts(path: Path, at_once: int) -> Iterator[Columns]:
    """The same, so many points at a time; colours and intensities where every scan has them."""
    import pye57

    file = pye57.E57(str(path))
    try:
        scans = [pye57.ScanHeader(node) for node in file.data3d]
        with_colors, with_intensity = ([name in h.point_fields for h in scans] for name in ("colorRed", "intensity"))
        if any(with_colors) and not all(with_colors):
            said = f"{with_colors.count(False)} of the {len(scans)} scans of {path.name} have no colours"
            print(f"note: {said}: none are read", flush=True)
        for header in scans:
            yield from _e57_scan(file, header, all(with_colors), all(with_intensity), at_once)
    finally:
        file.close()


def _e57_scan(file: Any, header: Any, colored: bool, measured: bool, at_once: int) -> Iterator[Columns]:
    """One scan in the file's frame, read as float64: pye57's own reader fails on colours above 255."""
    from pye57 import libe57

    spherical = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
    cartesian = ("cartesianX", "cartesianY", "cartesianZ")
    color = ("colorRed", "colorGreen", "colorBlue") if colored else ()
    states = ("cartesianInvalidState", "sphericalInvalidState")
    more = ("intensity",) if measured else ()
    wanted = [name for name in (*cartesian, *spherical, *color, *more, *states) if name in header.point_fields]
    # Fractions of 1, or bytes and 16 bits.
    columns_of = libe57.StructureNode(header.points.prototype())
    real = {name: not isinstance(columns_of[name], libe57.IntegerNode) for name in color}
    buffer = {name: np.empty(min(header.point_count, at_once)) for name in wanted}
    buffers = libe57.VectorSourceDestBuffer()
    for name, values in buffer.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, values, len(values), True, True))
    reader, turn, shift = header.points.reader(buffers) if header.point_count else None, *_e57_pose(header)
    while reader is not None and (count := reader.read()):
        columns = {name: values[:count] for name, values in buffer.items()}
        if cartesian[0] in columns:
            points, state = np.stack([columns[name] for name in cartesian], axis=1), states[0]
        else:
            distance, azimuth, elevation = (columns[name] for name in spherical)
            level = distance * np.cos(elevation)
            points = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], axis=1)
            state = states[1]
        found = dict(zip(POSITION, (points @ turn.T + shift).T))
        found |= {name: columns[own].astype(np.float32 if real[own] else np.uint16) for name, own in zip(COLOR, color)}
        found |= {name: columns[name].astype(np.float32) for name in more}
        valid = columns[state] == 0 if state in columns else np.ones(len(points), bool)
        yield {name: values[valid] for name, values in found.items()}


def _e57_pose(header: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and position (3,) of a scan in its file."""
    from scipy.spatial.transform import Rotation

    if not header.has_pose():
        return np.eye(3), np.zeros(3)
    rotation, translation = header.pose["rotation"], header.pose["translation"]
    turn = Rotation.from_quat([rotation[part].value() for part in "xyzw"]).as_matrix()
    return turn, np.array([translation[part].value() for part in "xyz"])


def part_reader(path: Path) -> Callable[[Path, int], Iterator[Columns]] | None:
    """What reads so many points of a file at a time; None where it has to be read whole."""
    ending = path.suffix.lower()
    if ending == ".ply":
        elements = (read_header(path) or read_text_header(path) or ([], 0))[0]
        plain = bool(elements) and elements[0].name == "vertex" and elements[0].row is not None
        mesh = any(element.name == "face" and element.count for element in elements)
        return _ply_parts if plain and not mesh else None
    in_parts = {".las": _las_parts, ".laz": _las_parts, ".e57": _e57_parts, ".pcd": pcd_parts}
    return (in_parts | dict.fromkeys(TEXTS, text_parts)).get(ending)


READERS = {
    ".ply": _ply,
    ".obj": read_obj,
    ".glb": read_glb,
    ".las": _las,
    ".laz": _las,
    ".e57": _e57,
    ".pcd": lambda path: _joined(pcd_parts(path)),
    **dict.fromkeys(TEXTS, lambda path: _joined(text_parts(path))),
}
