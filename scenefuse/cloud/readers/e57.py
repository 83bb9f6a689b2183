"""E57, the exchange format of laser scanners."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.readers.columns import COLOR, POSITION, Columns


def read_e57(path: Path, at_once: int) -> Iterator[Columns]:
    """All scans of the file, each moved by its pose, so many points at a time.

    Rays without return, marked as invalid or at the scanner's own place, have no position: they are NaN.

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
    flag, unpainted = "isColorInvalid" if colored else "", 0
    wanted = [name for name in (*cartesian, *spherical, *color, *more, *states, flag) if name in header.point_fields]
    limits = [_limits(header, name) for name in color]
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
        points[~points.any(1) | (columns[state] != 0 if state in columns else False)] = np.nan
        found: Columns = dict(zip(POSITION, (points @ turn.T + shift).T))
        for name, own, (low, high) in zip(COLOR, color, limits):
            share = (columns[own] - low) / (high - low)
            found[name] = (
                share.astype(np.float32) if high == 1 else np.clip(np.rint(255 * share), 0, 255).astype(np.uint8)
            )
        unpainted += int(np.count_nonzero(columns.get(flag, 0)))
        yield found | {name: columns[name].astype(np.float32) for name in more}
    if unpainted:
        print(f"note: {unpainted} points of a scan have no colours, and those that the file has for them are used")


def _limits(header: Any, name: str) -> tuple[float, float]:
    """The least and the greatest a colour can be: by the scan's limits, else by the type of the column; 0 and 1 where
    the file does not say."""
    from pye57 import libe57

    node, limits = header.node, None
    if node.isDefined("colorLimits"):
        limits = node["colorLimits"]
    ends = [f"{name}{end}" for end in ("Minimum", "Maximum")]
    if limits is not None and all(limits.isDefined(end) for end in ends):
        low, high = (float(limits[end].value()) for end in ends)
    else:
        column = libe57.StructureNode(header.points.prototype())[name]
        whole = isinstance(column, libe57.IntegerNode)
        low, high = (float(column.minimum()), float(column.maximum())) if whole else (0.0, 1.0)
    # A limit beyond 16 bits is that of the type of number.
    return (low, high) if 0 <= low < high <= np.iinfo(np.uint16).max else (0.0, 1.0)


def _pose(header: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation (3, 3) and position (3,) of a scan in its file; parts that are absent change nothing."""
    from scipy.spatial.transform import Rotation

    if not header.has_pose():
        return np.eye(3), np.zeros(3)
    turn, shift = np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3)
    for values, part, axes in ((turn, "rotation", "xyzw"), (shift, "translation", "xyz")):
        for k, axis in enumerate(axes):
            if header.pose.isDefined(f"{part}/{axis}"):
                values[k] = header.pose[part][axis].value()
    return Rotation.from_quat(turn if turn.any() else [0, 0, 0, 1]).as_matrix(), shift
