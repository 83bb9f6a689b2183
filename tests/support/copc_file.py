"""COPC files, LAZ with an octree (copc.io), as other programs write them."""

import io
import struct

import laspy
import lazrs
import numpy as np
from laspy.vlrs.known import LasZipVlr

NODE_POINTS = 50_000
"""Points of a node that has children: a random choice of those in its cube."""
ENTRY, VLR = struct.Struct("<4iQ2i"), struct.Struct("<H16sHQ32s")


def write_copc(path, points, colors, scale=0.001, seed=0):
    """Write points (N, 3) with colours (N, 3) of 8 bits as COPC 1.0."""
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, scale), np.floor(points.min(0))
    record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
    record.x, record.y, record.z = points.T
    record.red, record.green, record.blue = colors.astype(np.uint16).T * 257
    header.grow(record)
    half = float(np.ptp(points, axis=0).max()) / 2 * 1.001
    centre = (points.min(0) + points.max(0)) / 2
    laszip = lazrs.LazVlr.new_for_compression(7, 0, True)
    nodes = list(_nodes(points, centre - half, 2 * half, np.random.default_rng(seed)))
    chunks = [_compressed(record.array[rows], laszip) for _, rows in nodes]

    begin = len(_head(header, laszip, centre, half, 0, 0)) + 8
    places = begin + np.concatenate([[0], np.cumsum([len(chunk) for chunk in chunks])])
    table = io.BytesIO()
    lazrs.write_chunk_table(table, [(len(rows), len(chunk)) for (_, rows), chunk in zip(nodes, chunks)], laszip)
    entries = b"".join(
        ENTRY.pack(*key, int(place), len(chunk), len(rows)) for (key, rows), chunk, place in zip(nodes, chunks, places)
    )
    end = int(places[-1]) + len(table.getvalue())
    with open(path, "wb") as file:
        file.write(_head(header, laszip, centre, half, end, len(entries)))
        file.write(struct.pack("<q", int(places[-1])))
        file.writelines(chunks)
        file.write(table.getvalue())
        file.write(VLR.pack(0, b"copc", 1000, len(entries), b"") + entries)


def _head(header, laszip, centre, half, end, length):
    """Header and VLRs; the hierarchy of so many bytes begins at `end`."""
    hierarchy = end + VLR.size
    info = struct.pack("<5d2Q2d11Q", *centre, half, half / 100, hierarchy, length, 0, 0, *[0] * 11)
    header.vlrs.clear()
    header.vlrs.append(laspy.VLR("copc", 1, "", info))
    header.vlrs.append(LasZipVlr(laszip.record_data()))
    header.are_points_compressed, header.number_of_evlrs, header.start_of_first_evlr = True, 1, end
    stream = io.BytesIO()
    header.write_to(stream)
    return stream.getvalue()


def _nodes(points, low, side, rng):
    """Keys (level, x, y, z) of the octree's nodes, and the rows of their points."""
    waiting = [((0, 0, 0, 0), rng.permutation(len(points)))]
    while waiting:
        (level, *at), rows = waiting.pop(0)
        if len(rows) <= 2 * NODE_POINTS:
            yield (level, *at), np.sort(rows)
            continue
        yield (level, *at), np.sort(rows[:NODE_POINTS])
        rows = rows[NODE_POINTS:]
        cells = np.floor((points[rows] - low) / side * 2 ** (level + 1)).astype(int)
        for key in np.unique(cells, axis=0):
            waiting.append(((level + 1, *key.tolist()), rows[(cells == key).all(1)]))


def _compressed(records, laszip):
    """One chunk."""
    stream = io.BytesIO()
    compressor = lazrs.LasZipCompressor(stream, laszip)
    compressor.compress_many(records.tobytes())
    compressor.done()
    data = stream.getvalue()
    return data[8 : struct.unpack("<q", data[:8])[0]]
