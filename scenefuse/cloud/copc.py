"""COPC written (Cloud Optimized Point Cloud 1.0, copc.io): a LAZ whose chunks are the nodes of an octree, so that a
program reads what is near or what is coarse, and any reader of LAZ reads all of it.

A node holds one point for each occupied cell of its grid, the one nearest to the cell's middle, and its children hold
the others; so every level shows the surface evenly, however densely parts of it were measured. The octree is gone
through depth first, and what is in memory are the points of one small enough cube and those that the cubes around it
may take.
"""

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import lazrs
import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import AT_ONCE
from scenefuse.cloud.tiled_cloud import TILE, TiledCloud
from scenefuse.cloud.write_las import LENGTHS, LasLayout
from scenefuse.core.stage import StageError, atomic_file
from scenefuse.core.transforms import Array

# A node's grid has 2^7 cells along each axis, as is usual.
GRID_BITS = 7
# A cube of no more points is not divided.
NODE_POINTS = TILE
# Tiles of the source that are kept for the neighbouring cubes.
TILES_HELD = 32
# A node in the hierarchy, and the head of the record that holds it.
ENTRY, EXTENDED = struct.Struct("<4iQ2i"), struct.Struct("<H16sHQ32s")

# Level and place along x, y, z of a cube.
Key = tuple[int, int, int, int]
# Points as the file has them.
Records = NDArray[Any]
# Places counted in the file's steps, or numbers of tiles.
Steps = NDArray[np.int64]


def write_copc(path: Path, cloud: TiledCloud, in_crs: Callable[[Array], Array], crs: str | None) -> None:
    """Write a cloud of any size as COPC; steps, offsets and columns as of `write_laz`.

    Args:
        path: output, .copc.laz.
        cloud: the points, with at least one.
        in_crs: gives the coordinates (N, 3) in the CRS of points (N, 3).
        crs: anything pyproj understands; None when the coordinates are in no CRS.

    Raises:
        StageError: points lie where the CRS has no coordinates.
    """
    box = cloud.low.min(0), cloud.high.max(0)
    layout = LasLayout.of(path, cloud.like, box, in_crs(np.zeros((1, 3)))[0], crs, cloud.spacing())
    source = _Source.of(cloud, in_crs, layout)
    low, high = source.low.min(0), source.high.max(0)
    bits = max(int((high - low).max()).bit_length(), GRID_BITS)
    layout.header.mins, layout.header.maxs = (end * layout.header.scales + layout.header.offsets for end in (low, high))
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        nodes = _Nodes(file, layout.header, low, bits)
        octree = _Octree(source, nodes, low, bits)
        root = (0, 0, 0, 0)
        nodes.add(root, octree.of_tiles(root, np.arange(len(cloud.low))))
        nodes.finish()


@dataclass(frozen=True)
class _Source:
    """The cloud as LAS has it.

    Attributes:
        low: (T, 3) corner of each tile's box, in steps of the file.
        high: (T, 3) opposite corner.
        counts: (T,) points of each tile.
        read: gives the records of a tile.
        none: no records.
    """

    low: Steps
    high: Steps
    counts: Steps
    read: Callable[[int], Records]
    none: Records

    @classmethod
    def of(cls, cloud: TiledCloud, in_crs: Callable[[Array], Array], layout: LasLayout) -> "_Source":
        """Goes through the cloud once, for the boxes of its tiles in the CRS."""
        unit = np.float32(np.ptp(in_crs(np.array([[0, 0, 0], [0, 0, 1.0]]))[:, 2]))  # heights have no scale factor

        @lru_cache(TILES_HELD)
        def read(tile: int) -> Records:
            part = cloud.read(np.array([tile]))[1]
            points = in_crs(part.points) - layout.origin
            nowhere = ~np.isfinite(points).all(1)
            if nowhere.any():
                one = ", ".join(f"{x:.6g}" for x in part.points[nowhere][0])
                raise StageError(
                    f"{cloud.path}: points such as ({one}) lie so far from the origin that the scene's CRS has no"
                    " coordinates there: remove them from the scene's cloud"
                )
            fields = {name: values * unit if name in LENGTHS else values for name, values in part.fields.items()}
            records: Records = layout.records(replace(part, points=points, fields=fields)).array
            return records

        places = (_places(read(tile)) for tile in range(len(cloud.low)))
        low, high = zip(*((steps.min(0), steps.max(0)) for steps in places))
        return cls(np.stack(low), np.stack(high), np.diff(cloud.starts), read, read(0)[:0])

    def shares(self, tiles: Steps, low: Steps, high: Steps) -> Array:
        """(T,) the share of each tile's box that lies in the cube from `low` (3,) up to, without, `high` (3,)."""
        begin, end = self.low[tiles], self.high[tiles] + 1
        inside = np.minimum(end, high) - np.maximum(begin, low)
        return (np.maximum(inside, 0) / (end - begin)).prod(1)


@dataclass(frozen=True)
class _Octree:
    """Divides the cube from `low` (3,) with a side of 2^bits steps, and writes its nodes from the finest on."""

    source: _Source
    nodes: "_Nodes"
    low: Steps
    bits: int

    def of_tiles(self, key: Key, tiles: Steps) -> Records:
        """The points of a cube's own node, all below it written; from the tiles that touch the cube."""
        side = 1 << (self.bits - key[0])
        low = self.low + np.array(key[1:]) * side
        shares = self.source.shares(tiles, low, low + side)
        few = shares @ self.source.counts[tiles] <= AT_ONCE
        tiles = tiles[shares > 0]
        finest = key[0] == self.bits
        if few or finest:
            inside = self._inside(tiles, low, low + side, np.inf if finest else 2 * AT_ONCE)
            if inside is not None:
                return self._of_records(key, inside)
        return self._coarser(key, [(child, self.of_tiles(child, tiles)) for child in _children(key)])

    def _inside(self, tiles: Steps, low: Steps, high: Steps, most: float) -> Records | None:
        """The points in a cube; None if there are more than so many, as where a tile's points lie in heaps."""
        found, count = [self.source.none], 0
        for records in (self.source.read(int(tile)) for tile in tiles):
            places = _places(records)
            found.append(records[((places >= low) & (places < high)).all(1)])
            count += len(found[-1])
            if count > most:
                return None
        return np.concatenate(found)

    def _of_records(self, key: Key, records: Records) -> Records:
        """The same from the points in the cube."""
        if len(records) <= NODE_POINTS or key[0] == self.bits:
            return records
        bit = (_places(records) - self.low) >> (self.bits - key[0] - 1) & 1
        octant = bit @ np.array([1, 2, 4])
        children = enumerate(_children(key))
        return self._coarser(key, [(child, self._of_records(child, records[octant == k])) for k, child in children])

    def _coarser(self, key: Key, children: list[tuple[Key, Records]]) -> Records:
        """What a cube takes of its children's points, one for each cell of its grid; writes what each keeps."""
        every = np.concatenate([self.source.none, *(records for _, records in children)])
        chosen = _one_a_cell(_places(every) - self.low, max(self.bits - key[0] - GRID_BITS, 0))
        end = 0
        for child, records in children:
            start, end = end, end + len(records)
            self.nodes.add(child, records[~chosen[start:end]])
        return every[chosen]


def _one_a_cell(places: Steps, shift: int) -> NDArray[np.bool_]:
    """(N,) whether a point is the one nearest to the middle of its cell, a cube of 2^shift steps, in a node's grid."""
    cells = places >> shift & (1 << GRID_BITS) - 1
    number = cells @ (1 << GRID_BITS * np.arange(3))
    from_middle = ((2 * (places & (1 << shift) - 1) + 1 - (1 << shift)).astype(np.float64) ** 2).sum(1)
    order = np.lexsort((from_middle, number))
    chosen = np.zeros(len(places), bool)
    chosen[order[np.flatnonzero(np.diff(number[order], prepend=-1))]] = True
    return chosen


class _Nodes:
    """The file: header, nodes as chunks of LAZ one after the other, table of chunks, hierarchy.

    `low` (3,) and `bits` are in steps, as in the octree; `middle` (3,) and `half` of its cube in coordinates.
    """

    def __init__(self, file: BinaryIO, header: Any, low: Steps, bits: int) -> None:
        self.file, self.header, self.half = file, header, 2.0 ** (bits - 1) * header.scales[0]
        self.middle = (low + 2.0 ** (bits - 1)) * header.scales + header.offsets
        columns = header.point_format
        self.laszip = lazrs.LazVlr.new_for_compression(columns.id, columns.num_extra_bytes, True)
        self.further = [*header.vlrs]
        self.chunks: list[tuple[Key, int, int, int]] = []
        file.write(self._head(0, 0))
        file.write(bytes(8))

    def add(self, key: Key, records: Records) -> None:
        """Write a node, if it has points."""
        if not len(records):
            return
        stream = io.BytesIO()
        compressor = lazrs.LasZipCompressor(stream, self.laszip)
        compressor.compress_many(records.tobytes())
        compressor.done()
        written = stream.getbuffer()
        chunk = written[8 : struct.unpack("<q", written[:8])[0]]  # before it the table's place, behind it the table
        self.chunks.append((key, self.file.tell(), len(chunk), len(records)))
        self.file.write(chunk)

    def finish(self) -> None:
        """Write what lies behind the nodes, and the header once more."""
        place, table = self.file.tell(), io.BytesIO()
        lazrs.write_chunk_table(table, [(count, size) for _, _, size, count in self.chunks], self.laszip)
        self.file.write(table.getvalue())
        end = self.file.tell()
        nodes = {key: rest for key, *rest in self.chunks}
        for level, x, y, z in list(nodes):
            for up in range(1, level + 1):  # without points of their own, but readers come to their children by them
                nodes.setdefault((level - up, x >> up, y >> up, z >> up), [0, 0, 0])
        entries = b"".join(ENTRY.pack(*key, *rest) for key, rest in nodes.items())
        self.file.write(EXTENDED.pack(0, b"copc", 1000, len(entries), b"") + entries)
        self.header.point_count = sum(count for *_, count in self.chunks)
        self.header.number_of_points_by_return = np.array([self.header.point_count, *[0] * 14], np.uint64)
        self.file.seek(0)
        self.file.write(self._head(end, len(entries)))
        self.file.write(struct.pack("<q", place))

    def _head(self, end: int, length: int) -> bytes:
        """Header and records before the points; the hierarchy of so many bytes begins at `end`."""
        import laspy
        from laspy.vlrs.known import LasZipVlr

        info = struct.pack(
            "<5d2Q2d88x", *self.middle, self.half, self.half / (1 << GRID_BITS - 1), end + EXTENDED.size, length, 0, 0
        )
        self.header.vlrs.clear()
        self.header.vlrs.extend([laspy.VLR("copc", 1, "", info), *self.further, LasZipVlr(self.laszip.record_data())])
        self.header.are_points_compressed, self.header.number_of_evlrs = True, 1
        self.header.start_of_first_evlr = end
        stream = io.BytesIO()
        self.header.write_to(stream)
        return stream.getvalue()


def _children(key: Key) -> list[Key]:
    """The eight cubes in a cube, x first."""
    level, x, y, z = key
    return [(level + 1, 2 * x + (k & 1), 2 * y + (k >> 1 & 1), 2 * z + (k >> 2)) for k in range(8)]


def _places(records: Records) -> Steps:
    """(N, 3) in steps of the file."""
    return np.stack([records[axis].astype(np.int64) for axis in "XYZ"], axis=1)
