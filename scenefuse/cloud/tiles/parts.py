"""A user's cloud file read in parts, so that memory does not grow with it."""

from collections.abc import Callable, Iterator
from pathlib import Path

from scenefuse.cloud.formats import check_projected, checked, part_reader, read_columns, readable
from scenefuse.cloud.readers.columns import Columns
from scenefuse.cloud.tiles.tiled_cloud import AT_ONCE

ColumnParts = Callable[[], Iterator[Columns]]


def columns_in_parts(path: Path, degrees: bool = False) -> ColumnParts:
    """The columns of a cloud file, as `read_columns` has them, AT_ONCE rows at a time each time this is called.

    Clouds are read anew each time, meshes once, and held; of a compressed PCD all columns are held while it is read.
    Here colours of a LAS file may all be black.

    Args:
        path: of the file.
        degrees: whether LAS and LAZ may be in degrees.

    Raises:
        StageError: the file is missing, damaged, of an unknown ending or without positions; in the middle, where it is
            cut short.
    """
    reader = part_reader(path) if path.is_file() else None
    if reader is None:
        whole = read_columns(path)
        return lambda: _slices(whole)

    if not degrees:
        with readable(path):
            check_projected(path)

    def parts() -> Iterator[Columns]:
        with readable(path):
            for columns in reader(path, AT_ONCE):
                yield checked(path, columns)

    return parts


def _slices(whole: Columns) -> Iterator[Columns]:
    for first in range(0, len(whole["x"]), AT_ONCE):
        yield {name: values[first : first + AT_ONCE] for name, values in whole.items()}
