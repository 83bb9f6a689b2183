"""What a run has left of its scenes and objects; a run may be partial."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from scenefuse.core.job_records import JobRecords, why_unfinished
from scenefuse.core.stage import StageError
from scenefuse.report.values import Fields, find, load

# What each step leaves, in the order in which the steps run.
_OBJECT_FILES = (
    *("photos.json", "features.db", "matches.json", "sparse.json", "undistorted.json", "masks.json"),
    *("stage1.json", "stage2.json", "stage3.json", "stage4.json", "object.json"),
)
_SCENE_FILES = ("photos.json", "features.db", "matches.json", "sparse.json", "georeference.json", "undistorted.json")
# The same of an object whose cloud was given with its photos; masks are made only where they mark it.
_POSED_FILES = tuple(name for name in _OBJECT_FILES if not name.startswith(("masks", "stage")))
_JOIN_FILES = ("crop.json", "scale.json", "coarse.json", "fine.json")
Given = Literal["photos", "cloud", "both"]
"""What of a scene or an object the user gave; `both`: photos, cameras, and a cloud in their coordinates."""
ALONE = "by itself"
"""Status of an object that is done and lies in no scene."""


@dataclass(frozen=True)
class RunInputs:
    """What a run works on, and where it leaves results and records."""

    chunks: int
    """Jobs that a scene's depth maps are split into."""
    variants: list[str]
    """Registration variants, the one that is fused first."""
    jobs: JobRecords
    """Folders of the rules' logs and benchmarks; see JobRecords."""
    scenes: tuple[Path, ...] = ()
    """Result folders of the scenes (results/scenes/{scene})."""
    objects: tuple[Path, ...] = ()
    """Result folders of the objects (results/objects/{object}); they need not exist."""
    scene_of: tuple[str, ...] = ()
    """Name of the scene that each object lies in; empty for one by itself."""
    cloud_scenes: tuple[str, ...] = ()
    """Names of the scenes that were given as clouds without photos."""
    cloud_objects: tuple[str, ...] = ()
    """Names of the objects that were."""
    posed_scenes: tuple[str, ...] = ()
    """Names of the scenes whose clouds were given with photos and cameras."""
    posed_objects: tuple[str, ...] = ()
    """Names of the objects whose were."""


@dataclass(frozen=True)
class Collected:
    """What a run has left of one object.

    Attributes:
        name: the object's name.
        stages: its own stages' quantities, `stage4.psnr` for instance.
        variants: variant -> quantities of its registration, `fine.scale` for instance.
        fusion: quantities of the fusion.
        missing: the first file that should be there and is not, or "".
        failed: why a job of it failed, when something is missing; "" when nothing failed.
        failed_variants: variant -> why its own jobs failed.
        alone: whether it lies in no scene, so that nothing but its own stages is to be done.
    """

    name: str
    stages: Fields
    variants: dict[str, Fields]
    fusion: Fields
    missing: str
    failed: str
    failed_variants: dict[str, str]
    alone: bool = False


def collect_run(run: RunInputs) -> tuple[dict[str, tuple[Fields, str]], list[Collected]]:
    """What is left of each scene (see `collect_scene`), by its name, and of each object.

    Raises:
        StageError: no variant is given, or not one scene for each object.
    """
    if not run.variants:
        raise StageError("no registration variant is given; name at least one, the one that is fused first")
    if len(run.scene_of) != len(run.objects):
        raise StageError(
            f"{len(run.objects)} objects but {len(run.scene_of)} scenes are given; name the scene of each object"
        )
    scenes = {
        folder.name: collect_scene(folder, run.chunks, _given(folder.name, run.cloud_scenes, run.posed_scenes))
        for folder in run.scenes
    }
    objects = [
        collect(
            folder,
            run.variants,
            run.jobs,
            scene,
            scenes[scene][1] if scene in scenes else "",
            _given(folder.name, run.cloud_objects, run.posed_objects),
            bool(scene) and folder.name not in run.cloud_objects and scene not in run.cloud_scenes,
        )
        for folder, scene in zip(run.objects, run.scene_of)
    ]
    return scenes, objects


def _given(name: str, clouds: tuple[str, ...], posed: tuple[str, ...]) -> Given:
    """What of a scene or an object was given."""
    return "cloud" if name in clouds else "both" if name in posed else "photos"


def collect_scene(folder: Path, chunks: int, given: Given = "photos") -> tuple[Fields, str]:
    """The quantities of a scene's stages, and the first file that is missing up to its cloud, or "".

    Args:
        folder: the scene's results.
        chunks: jobs that its depth maps are split into.
        given: what of it was given.
    """
    maps = tuple(f"depth/{k}.json" for k in range(chunks)) if given == "photos" else ()
    made = ("georeference.json",) if given == "cloud" else (*_SCENE_FILES, *maps)
    there, gap = unbroken(folder, (*made, "dense.json"))
    found = read_fields(folder, [name for name in there if "/" not in name])
    return found | ({} if gap else read_fields(folder, ["truth.json"])), gap


def collect(
    folder: Path,
    variants: list[str],
    jobs: JobRecords,
    scene: str = "",
    scene_gap: str = "",
    given: Given = "photos",
    linked: bool = True,
) -> Collected:
    """Everything about one object. What stands behind a missing file is from an earlier run and is left out.

    Args:
        folder: the object's results.
        variants: registration variants, the one that is fused first.
        jobs: where the rules' logs and benchmarks are.
        scene: name of the scene that the object lies in; "" for one by itself.
        scene_gap: the first file that this scene lacks, or "".
        given: what of the object was given.
        linked: whether object and scene both have photos.
    """
    alone = not scene
    there, gap = unbroken(folder, {"photos": _OBJECT_FILES, "cloud": ("object.json",), "both": _POSED_FILES}[given])
    stages = read_fields(folder, [*there, *(["alignment.json"] if linked and not gap else [])])
    stages |= read_fields(folder, ["masks.json"] if given == "both" and not gap else [])
    who = folder.name
    if not gap and scene_gap:
        gap, who = f"{scene_gap} of the scene {scene}", scene
    if linked and not gap:
        there, gap = unbroken(folder, ("alignment.json",))
        stages |= read_fields(folder, there)
    nothing: tuple[dict[str, Fields], dict[str, str]] = ({variant: {} for variant in variants}, {})
    per_variant, gaps = nothing if gap or alone else _collect_variants(folder, variants)
    fusion: Fields = {}
    if "fine.status" in per_variant[variants[0]]:
        there, gap = unbroken(folder, ("evidence.json", "fusion.json", "metrics.json"))
        fusion = {key: item for key, item in read_fields(folder, there[:2]).items() if key != "evidence.notes"}
        found, without = unbroken(folder, ("fusion.json", "missing.json"))
        gap, fusion = gap or without, fusion | read_fields(folder, found[1:])
        per_variant[variants[0]] |= read_fields(folder, [name for name in there if name == "metrics.json"])
    # A variant's own log, else one of the object as a whole.
    failed_variants = {variant: why_unfinished(jobs, f"{folder.name}-{variant}", folder.name) for variant in gaps}
    gap = next(iter(gaps.values()), gap)
    if fusion and all("fine.status" in per_variant[variant] for variant in variants):
        truth = read_fields(folder, ["truth.json"])
        stages |= {key: item for key, item in truth.items() if not key.startswith("truth.variants.")}
        _add_truth(per_variant, truth)
    unit = per_variant[variants[0]].get("crop.diagonal", {}).get("unit", "scene units")
    per_variant = {variant: _in_unit(fields, unit) for variant, fields in per_variant.items()}
    failed = why_unfinished(jobs, who) if gap else ""
    return Collected(folder.name, stages, per_variant, fusion, gap, failed, failed_variants, alone)


def _collect_variants(folder: Path, variants: list[str]) -> tuple[dict[str, Fields], dict[str, str]]:
    """The quantities of each variant's registration, and the first file that each incomplete one lacks.

    The first variant is fused, and its metrics are the object's.
    """
    found: dict[str, Fields] = {}
    gaps: dict[str, str] = {}
    for variant in variants:
        names = _JOIN_FILES if variant == variants[0] else (*_JOIN_FILES, "metrics.json")
        there, lacking = unbroken(folder / "registration" / variant, names)
        found[variant] = read_fields(folder / "registration" / variant, there)
        if lacking:
            gaps[variant] = f"registration/{variant}/{lacking}"
    return found, gaps


def _add_truth(per_variant: dict[str, Fields], truth: Fields) -> None:
    """Add each variant's errors against truth to its quantities, as `truth.NAME`."""
    for variant, fields in per_variant.items():
        prefix = f"truth.variants.{variant}."
        fields |= {f"truth.{k.removeprefix(prefix)}": v for k, v in truth.items() if k.startswith(prefix)}


def unbroken(folder: Path, names: Sequence[str]) -> tuple[list[str], str]:
    """The files of a chain before the first that is missing, and that one, or "".

    Snakemake removes what a rule wrote before it runs the rule again: what is behind a gap is from an earlier run.
    """
    there = list(itertools.takewhile(lambda name: (folder / name).is_file(), names))
    return there, names[len(there)] if len(there) < len(names) else ""


def read_fields(folder: Path, names: Sequence[str]) -> Fields:
    """The quantities of the JSONs among some files of a folder, each prefixed by its file's name."""
    stems = [name.removesuffix(".json") for name in names if name.endswith(".json")]
    return {f"{stem}.{key}": item for stem in stems for key, item in load(folder / f"{stem}.json").items()}


def _in_unit(fields: Fields, unit: str) -> Fields:
    """The quantities with the scene's own unit of length where a stage knows it as "scene units" only."""
    return {k: {**item, "unit": item["unit"].replace("scene units", unit)} for k, item in fields.items()}


def status_of(item: Collected, variant: str) -> str:
    """registered, unregistered, ungated (a pose that nothing checked), failed (an error), missing, or ALONE."""
    if item.alone and not item.missing:
        return ALONE
    decided = find(item.variants.get(variant, {}), "fine.status")
    return str(decided) if decided else "failed" if _failure(item, variant) else "missing"


def reason_of(item: Collected, variant: str) -> str | None:
    """Why an object is not registered in a variant."""
    if item.alone and not item.missing:
        return None
    if find(item.variants.get(variant, {}), "fine.status"):
        return find(item.variants[variant], "fine.reason") or None
    return why_missing(_failure(item, variant))


def why_missing(failed: str) -> str:
    """Why something is missing, for the reader: the failure, or that nothing of it ran."""
    return failed or "no error in its logs; it has not run yet"


def _failure(item: Collected, variant: str) -> str:
    return item.failed_variants.get(variant, item.failed)
