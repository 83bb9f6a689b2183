"""Point cloud files of any known ending as named columns: PLY, LAS and LAZ (COPC too), E57, PCD, rows of text, and
meshes (PLY with faces, OBJ, glTF), from whose faces points are drawn.

Columns have the names that PLY uses (x, y, z, nx, ny, nz, red, green, blue); all others keep their own. Positions keep
the precision of the file. Libraries are loaded when a file needs them. A new format is a reader in READERS.
"""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import AT_ONCE, POSITION, Columns, named
from scenefuse.cloud.readers.e57 import read_e57
from scenefuse.cloud.readers.las import check_projected, las_crs, read_las
from scenefuse.cloud.readers.meshes import named_by_gltf, named_by_obj, read_gltf, read_obj
from scenefuse.cloud.readers.pcd import read_pcd
from scenefuse.cloud.readers.ply import in_rows, named_by_ply, read_ply
from scenefuse.cloud.readers.text import TEXTS, read_text
from scenefuse.core.stage import StageError

# Narrower than this share of its height, a cloud at coordinates like longitude and latitude is in degrees.
MAX_DEGREES_WIDTH = 1e-3

ColumnParts = Callable[[], Iterator[Columns]]
# Each gives the columns of a file so many rows at a time, or of a mesh all at once.
READERS: dict[str, Callable[[Path, int], Iterator[Columns]]] = {
    ".ply": read_ply,
    ".obj": lambda path, _: iter([read_obj(path)]),
    ".glb": lambda path, _: iter([read_gltf(path)]),
    ".gltf": lambda path, _: iter([read_gltf(path)]),
    ".las": read_las,
    ".laz": read_las,
    ".e57": read_e57,
    ".pcd": read_pcd,
    **dict.fromkeys(TEXTS, read_text),
}

# Give the files that a mesh names.
NAMED: dict[str, Callable[[Path], Iterable[Path]]] = {
    ".obj": named_by_obj,
    ".gltf": named_by_gltf,
    ".ply": named_by_ply,
}


def columns_in_parts(path: Path, degrees: bool = False) -> ColumnParts:
    """The columns of a cloud file, AT_ONCE rows at a time each time this is called.

    Clouds are read anew each time, meshes once, and held; of a compressed PCD all columns are held while it is read.
    Colours of a LAS file may all be black, and its columns hold what the format says of points.

    Args:
        path: of the file.
        degrees: whether LAS and LAZ may be in degrees.

    Raises:
        StageError: the ending is not known, or the file is missing, damaged or without positions; in the middle, where
            it is cut short.
    """
    reader, ending = READERS.get(path.suffix.lower()), path.suffix.lower()
    if path.is_dir():
        raise StageError(f"{path} is a folder; give one cloud, its tiles merged into a file ({', '.join(READERS)})")
    if reader is None:
        raise StageError(
            f"{path}: '{path.suffix}' is no cloud's ending; unpack or convert it to one of {', '.join(READERS)}"
        )
    if not path.is_file():
        raise StageError(f"{path} does not exist; give the path of a cloud ({', '.join(READERS)})")

    def parts() -> Iterator[Columns]:
        with readable(path):
            for columns in reader(path, AT_ONCE):
                yield _checked(path, columns)

    with readable(path):
        if not degrees:
            check_projected(path)
        is_mesh = ending in (".obj", ".glb", ".gltf") or (ending == ".ply" and not in_rows(path))
    if is_mesh:
        held = list(parts())
        return lambda: iter(held)
    return parts


def with_named(path: Path) -> list[Path]:
    """A cloud's file and, of a mesh, what it names: materials, textures, buffers, whether these are there or not."""
    found = [path]
    with suppress(OSError, ValueError, LookupError, AttributeError):  # a damaged file, of which its reader tells
        found += NAMED[path.suffix.lower()](path)
    return found


@contextmanager
def readable(path: Path) -> Iterator[None]:
    """What a library says of a damaged file, as one sentence.

    Raises:
        StageError: the file is empty, or cannot be read.
    """
    try:
        if path.is_file() and path.stat().st_size == 0:
            raise StageError(f"{path} is empty (0 bytes); copy or export it again")
        yield
    except (MemoryError, ImportError):
        raise
    except Exception as error:  # each library has its own errors for a damaged file
        said = str(error)
        if not isinstance(error, StageError):
            kind = path.suffix.removeprefix(".").upper()
            why = ((said or type(error).__name__).splitlines() or ["?"])[0][:200]
            # What this package itself says of a strange file is a ValueError.
            cut = "" if isinstance(error, ValueError) else "copy it again, for it may be cut short, or "
            said = f"{path} is not a readable {kind} cloud ({why}); {cut}export it again"
        # What the workflow made, it makes again.
        if path.parts[:1] == ("results",):
            said = f"{said.rpartition('; ')[0]}; delete it and run again"
        raise StageError(said) from None


def _checked(path: Path, columns: Columns) -> Columns:
    """Columns by their common names; StageError without positions."""
    columns = named(columns)
    if not set(POSITION) <= set(columns):
        raise StageError(f"{path} has no columns x, y and z but {', '.join(columns) or 'none'}; export it again")
    return columns


def check_not_degrees(path: Path, points: NDArray[np.float64]) -> None:
    """StageError where points (N, 3) of a file without a CRS can only be longitude, latitude and a height in metres:
    far from zero, and narrow beside their height. Of a flat site that cannot be told."""
    crs = las_crs(path)
    low, high = np.percentile(points, [10, 90], axis=0)
    far = np.minimum(abs(low), abs(high))[:2]
    wide, tall = float((high - low)[:2].max()), float(high[2] - low[2])
    if crs is None and far.min() > 1 and far.max() <= 360 and far.min() <= 90 and 0 < wide < MAX_DEGREES_WIDTH * tall:
        raise StageError(
            f"{path} seems to be in degrees: x and y vary by {wide:.3g} where z varies by {tall:.3g}; project it to"
            " metres first, to UTM for instance (if it is in metres, subtract its x and y)"
        )
