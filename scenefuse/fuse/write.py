"""Write: what fusion changes in a scene, and the completed scene with the changes of one object or of several (F3).

A scene is never copied for an object: its changes name the rows of the scene's cloud, and are laid on the part of it
that is read.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud, concatenate, records_of
from scenefuse.cloud.readers.las import LAS_DIMENSIONS
from scenefuse.cloud.tiled_cloud import Rows, TiledCloud, open_cloud, reserved
from scenefuse.core.transforms import Array
from scenefuse.fuse.compare import KEPT
from scenefuse.fuse.measure import FIELDS, MEASURED, unchecked

FROM_SCENE, FROM_OBJECT = 0, 1
"""Values of the field `source` of an object's clouds."""


@dataclass(frozen=True)
class Changes:
    """Of one object, or of several.

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
        part, left = with_source(unchecked(cloud), FROM_SCENE), np.ones(len(cloud), dtype=bool)
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
    rows, removed = fields["row"].astype(np.int64), fields["reason"] != KEPT
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
    order = np.lexsort((fields["evidence"] == MEASURED, rows)) if changes else np.zeros(0, np.int64)
    last = np.flatnonzero(np.diff(rows[order], append=-1))
    starts = np.concatenate([[0], last[:-1] + 1]) if len(last) else last
    gone = np.logical_or.reduceat(removed[order], starts) if len(last) else removed
    chosen = order[last]
    return Changes(rows[chosen], gone, {name: values[chosen] for name, values in fields.items()})


def added_by(fused: Path) -> Cloud:
    """The points that an object brought in, from the cloud of its surroundings."""
    tiles = open_cloud(fused)
    whole = tiles.read(np.arange(len(tiles.low)))[1]
    return whole[whole.fields["source"] == FROM_OBJECT]


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
    """
    columns = changes.left_of(np.zeros(0, np.int64), like)
    columns = replace(columns, fields=dict(sorted(columns.fields.items())))
    with reserved(path, records_of(columns, path).dtype, count, len(tiles)) as (file, _):
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
