"""The frame ledger: every similarity between an object's frames, the scene and the world, in one file."""

from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.stage import StageError, quantity, read_json, value, write_json
from scenefuse.transforms import Sim3


def write_frame_ledger(
    *, object_json: Path, fusion_json: Path, georeference_json: Path | None = None, report: Path
) -> None:
    """Collect the transforms between the frames of one object (docs/frames.md).

    Frames: `nerf` (normalised, what the field is trained in), `object` (the object's cameras), `scene`, `world`
    (easting, northing, height in the scene's CRS, where it is georeferenced; the file's own coordinates where the scene
    was given as a cloud), `file` (the own coordinates of an object that was given as a cloud).

    Args:
        object_json: JSON of the object cloud, with `nerf_from_object` or `object_from_file`.
        fusion_json: JSON of the fusion, with `scene_from_object`, the pose of the added points.
        georeference_json: JSON of the scene, with `crs_from_scene` where it is known.
        report: output JSON; a transform that is not known is null.

    Raises:
        StageError: a stored matrix is no similarity.
    """
    known: dict[str, Sim3 | None] = {
        "nerf_from_object": _read(object_json, "nerf_from_object"),
        "object_from_file": _read(object_json, "object_from_file"),
        "scene_from_object": _read(fusion_json, "scene_from_object"),
        "world_from_scene": _read(georeference_json, "crs_from_scene"),
    }
    scene, world, nerf = (known[n] for n in ("scene_from_object", "world_from_scene", "nerf_from_object"))
    known["world_from_object"] = world @ scene if world and scene else None
    known["world_from_file"] = _world_from_file(known)
    known["scene_from_nerf"] = scene @ nerf.inverse() if scene and nerf else None
    content: dict[str, Any] = {}
    for name, transform in known.items():
        content[name] = quantity(None if transform is None else transform.matrix, "")
        content[f"{name}_inverse_error"] = quantity(None if transform is None else round_trip(transform), "1")
    content["status"] = quantity(value(read_json(fusion_json), "registration"), "")
    write_json(report, content)


def _world_from_file(known: dict[str, Sim3 | None]) -> Sim3 | None:
    """From the coordinates of an object's own file to the world; None where there is no such file, or no pose."""
    world, obj = known["world_from_object"], known["object_from_file"]
    return world @ obj if world and obj else None


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
