"""Depth, normal and confidence maps on disk, in COLMAP's binary format, which its own tools read."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError


def write_depth(path: Path, depth: NDArray[np.float32]) -> None:
    """Write an (H, W) float32 map of depths along the camera's z axis; 0 marks pixels without a depth."""
    import pycolmap

    valid = depth[depth > 0]
    low, high = (float(valid.min()), float(valid.max())) if valid.size else (0.0, 0.0)
    path.parent.mkdir(parents=True, exist_ok=True)
    pycolmap.DepthMap.from_array(np.ascontiguousarray(depth, dtype=np.float32), low, high).write(path)


def read_depth(path: Path) -> NDArray[np.float32]:
    """Read an (H, W) float32 map (depth or confidence); StageError when the file is missing or damaged."""
    import pycolmap

    depth_map = pycolmap.DepthMap()
    try:
        depth_map.read(path)
    except Exception as error:
        raise StageError(f"{path} is not a readable COLMAP map ({error}); rerun the stage that writes it") from None
    return np.array(depth_map.to_array(), dtype=np.float32)


def write_normals(path: Path, normals: NDArray[np.float32]) -> None:
    """Write an (H, W, 3) float32 map of unit normals in the camera frame; zeros mark pixels without a normal.

    COLMAP's files hold all x, then all y, then all z. pycolmap.NormalMap (4.2) takes and gives arrays in the order of
    the file, which mixes the three up, so it is not used here.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width, _ = normals.shape
    planes = np.ascontiguousarray(np.moveaxis(normals, 2, 0), dtype="<f4")
    path.write_bytes(f"{width}&{height}&3&".encode() + planes.tobytes())


def read_normals(path: Path) -> NDArray[np.float32]:
    """Read an (H, W, 3) float32 normal map; StageError when the file is missing or damaged."""
    try:
        width, height, channels, values = path.read_bytes().split(b"&", 3)
        planes = np.frombuffer(values, dtype="<f4").reshape(int(channels), int(height), int(width))
    except (OSError, ValueError) as error:
        raise StageError(f"{path} is not a readable COLMAP map ({error}); rerun the stage that writes it") from None
    return np.ascontiguousarray(np.moveaxis(planes, 0, 2), dtype=np.float32)
