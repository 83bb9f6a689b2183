"""E57, the exchange format of laser scanners."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import COLOR, POSITION, Columns


def read_e57(path: Path, at_once: int) -> Iterator[Columns]:
    """All scans of the file, each moved by its pose, so many points at a time; points marked as invalid are left out.

    Colours and intensities are read where every scan has them.
    """
    import pye57

    file = pye57.E57(str(path))
    try:
        scans = [pye57.ScanHeader(node) for node in file.data3d]
        with_colors, with_intensity = ([name in h.point_fields for h in scans] for name in ("colorRed", "intensity"))
        if any(with_colors) and not all(with_colors):
            said = f"{with_colors.count(False)} of the {len(scans)} scans of {path.name} have no colours"
            print(f"note: {said}: none are read", flush=True)
        for header in scans:
            yield from _scan(file, header, all(with_colors), all(with_intensity), at_once)
    finally:
        file.close()


def _scan(file: Any, header: Any, colored: bool, measured: bool, at_once: int) -> Iterator[Columns]:
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
    reader, turn, shift = header.points.reader(buffers) if header.point_count else None, *_pose(header)
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


def _pose(header: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and position (3,) of a scan in its file."""
    from scipy.spatial.transform import Rotation

    if not header.has_pose():
        return np.eye(3), np.zeros(3)
    rotation, translation = header.pose["rotation"], header.pose["translation"]
    turn = Rotation.from_quat([rotation[part].value() for part in "xyzw"]).as_matrix()
    return turn, np.array([translation[part].value() for part in "xyz"])
