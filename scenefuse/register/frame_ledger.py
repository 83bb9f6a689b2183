"""The frame ledger: every similarity between an object's frames, the scene and the world, in one file."""

from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.core.stage import StageError, quantity, read_json
from scenefuse.core.transforms import Sim3


def frame_ledger(pose: Sim3 | None, object_json: Path | None, georeference_json: Path | None) -> dict[str, Any]:
    """The transforms between the frames of one object (docs/frames.md), as quantities; null where one is not known.

    Frames: `nerf` (normalised, what the field is trained in), `object` (the object's cameras), `scene`, `world`
    (easting, northing, height in the scene's CRS, where it is georeferenced; the file's own coordinates where the scene
    was given as a cloud), `file` (the own coordinates of an object that was given as a cloud).

    Args:
        pose: scene_from_object of the added points; None for an object that is not fused.
        object_json: JSON of the object cloud, with `nerf_from_object` or `object_from_file`, or None.
        georeference_json: JSON of the scene, with `crs_from_scene` where it is known, or None.

    Raises:
        StageError: a stored matrix is no similarity.
    """
    nerf = _read(object_json, "nerf_from_object")
    file = _read(object_json, "object_from_file")
    world = _read(georeference_json, "crs_from_scene")
    world_from_object = world @ pose if world and pose else None
    known = {
        "nerf_from_object": nerf,
        "object_from_file": file,
        "scene_from_object": pose,
        "world_from_scene": world,
        "world_from_object": world_from_object,
        "world_from_file": world_from_object @ file if world_from_object and file else None,
        "scene_from_nerf": pose @ nerf.inverse() if pose and nerf else None,
    }
    content: dict[str, Any] = {}
    for name, transform in known.items():
        content[name] = quantity(None if transform is None else transform.matrix, "")
        content[f"{name}_inverse_error"] = quantity(None if transform is None else round_trip(transform), "1")
    return content


def round_trip(transform: Sim3) -> float:
    """Largest entry of T T^-1 - I: how well the inverse undoes the transform."""
    return float(np.abs(transform.matrix @ transform.inverse().matrix - np.eye(4)).max())


def _read(path: Path | None, name: str) -> Sim3 | None:
    """One transform of a stage JSON, or None where the file does not hold it."""
    entry = None if path is None else read_json(path).get(name)
    if entry is None or entry["value"] is None:
        return None
    try:
        return Sim3.from_matrix(np.array(entry["value"]))
    except (ValueError, np.linalg.LinAlgError) as error:
        raise StageError(f"{name} in {path} is {error}; delete the file and rerun its stage") from None
