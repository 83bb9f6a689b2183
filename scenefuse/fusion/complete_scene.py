"""The completed scene: all registered objects fused into one cloud, each point naming where it is from."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from scenefuse.fusion.fuse_object import FROM_SCENE, FusionSettings, fuse_registered, with_provenance, write_scene
from scenefuse.io.clouds import Cloud, concatenate, read_cloud
from scenefuse.stage import StageError, quantity, read_json, value, write_json


def complete_scene(
    *,
    scene: Path,
    names: list[str],
    objects: list[Path],
    crops: list[Path],
    fines: list[Path],
    georeference: Path | None = None,
    completed: Path,
    completed_laz: Path,
    report: Path,
    mode: Literal["fill", "append", "replace"],
    settings: FusionSettings,
) -> None:
    """Fuse every registered object of a scene into it, one after the other (method F3).

    Each is fused into what the ones before it left, so that objects that overlap are not doubled. The field `source`
    is 0 on the scene's points and the object's place in `names`, counted from 1, on what it added.

    Args:
        scene: dense scene cloud (PLY).
        names: the scene's objects.
        objects: their clouds (PLY), each in its own frame, in the order of `names`.
        crops: the scene's points on each (PLY).
        fines: JSON of the fine registration of each.
        georeference: JSON of the scene, with its origin for the LAZ file, or nothing.
        completed: output PLY, the scene's frame.
        completed_laz: output LAZ of the same, in the CRS where the scene is georeferenced.
        report: output JSON: what each `source` is, the points that each object added, the unregistered with the reason.
        mode: fill, append or replace, as in the fusion of one object.
        settings: see FusionSettings.

    Raises:
        StageError: the lists differ in length.
    """
    if not len(names) == len(objects) == len(crops) == len(fines):
        raise StageError(
            f"{len(names)} names, {len(objects)} objects, {len(crops)} crops and {len(fines)} registrations are given;"
            " give one of each for every object"
        )
    start = time.perf_counter()
    before = read_cloud(scene)
    whole = _from(with_provenance(before, FROM_SCENE), FROM_SCENE)
    unregistered: dict[str, str] = {}
    for number, (name, cloud, crop, fine) in enumerate(zip(names, objects, crops, fines), 1):
        registration = read_json(fine)
        fusion = fuse_registered(read_cloud(cloud), whole, read_cloud(crop), registration, mode, settings)
        if value(registration, "status") != "registered":
            unregistered[name] = value(registration, "reason")
        kept = whole[fusion.kept]
        whole = concatenate([kept, _from(fusion.added, number)]) if len(fusion.added) else kept
        print(f"{name}: {unregistered.get(name) or f'{len(fusion.added)} points'}", flush=True)
    crs = write_scene(completed, completed_laz, whole, georeference)
    counts = np.bincount(whole.fields["source"], minlength=len(names) + 1)
    write_json(
        report,
        {
            "sources": quantity({"0": "scene"} | {str(k): name for k, name in enumerate(names, 1)}, ""),
            "points": quantity(len(whole), "points"),
            "scene_points": quantity(int(counts[0]), "points"),
            "removed_points": quantity(len(before) - int(counts[0]), "points"),
            "added_points": quantity({n: int(c) for n, c in zip(names, counts[1:]) if n not in unregistered}, "points"),
            "unregistered": quantity(unregistered, ""),
            "mode": quantity(mode, ""),
            "crs": quantity(crs, ""),
            "seconds": quantity(time.perf_counter() - start, "s"),
        },
    )


def _from(cloud: Cloud, source: int) -> Cloud:
    """The cloud with its `source` set, wide enough for 65535 objects."""
    return replace(cloud, fields=cloud.fields | {"source": np.full(len(cloud), source, dtype=np.uint16)})
