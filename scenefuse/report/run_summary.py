"""The summary of a run as data: what its stages measured of each scene and object, what is missing, and why.

A run may be partial. What stands behind a missing file is from an earlier run, and is left out.
"""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from scenefuse.core.job_records import KILLED, JobRecords, last_error, why_unfinished
from scenefuse.report.values import Fields, find, load

# What of a scene or an object the user gave; `both`: photos, cameras, and a cloud in their coordinates.
Given = Literal["photos", "cloud", "both"]
# What each step leaves, in the order in which the steps run. Where a cloud was given with photos, masks are made only
# where they mark the object.
FROM_PHOTOS = ("photos.json", "features.db", "matches.json", "sparse.json")
OBJECT_FILES: dict[Given, tuple[str, ...]] = {
    "photos": (
        *(*FROM_PHOTOS, "undistorted.json", "masks.json"),
        *("stage1.json", "stage2.json", "stage3.json", "stage4.json", "object.json"),
    ),
    "cloud": ("object.json",),
    "both": (*FROM_PHOTOS, "undistorted.json", "object.json"),
}
SCENE_FILES: dict[Given, tuple[str, ...]] = {
    "photos": (*FROM_PHOTOS, "georeference.json", "undistorted.json"),
    "cloud": ("georeference.json",),
    "both": (*FROM_PHOTOS, "georeference.json", "undistorted.json"),
}
REGISTRATION_FILES = ("crop.json", "scale.json", "coarse.json", "fine.json")
# Status of an object that is done and lies in no scene.
ALONE = "by itself"


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
    given_scenes: tuple[Given, ...] = ()
    """What of each scene was given; photos of all where this is empty."""
    given_objects: tuple[Given, ...] = ()
    """What of each object was given, likewise."""
    made_by: tuple[str, ...] = ()
    """Who makes the results of each scene; nobody is named where this is empty."""


@dataclass(frozen=True)
class SceneSummary:
    """What a run has left of one scene.

    Attributes:
        name: the scene's name.
        fields: its stages' quantities, `dense.points` for instance; with those of the completed scene where it
            holds all decisions.
        missing: the first file up to its cloud that should be there and is not, or "".
        failed: why a job of it failed, when something is missing; "" when nothing failed.
    """

    name: str
    fields: Fields
    missing: str
    failed: str


@dataclass(frozen=True)
class ObjectSummary:
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

    def status(self, variant: str) -> str:
        """registered, unregistered, ungated (a pose that nothing checked), failed (an error), missing, or ALONE."""
        if self.alone and not self.missing:
            return ALONE
        decided = find(self.variants.get(variant, {}), "fine.status")
        return str(decided) if decided else "failed" if self._failure(variant) else "missing"

    def reason(self, variant: str) -> str | None:
        """Why it is not registered in a variant."""
        if self.alone and not self.missing:
            return None
        if find(self.variants.get(variant, {}), "fine.status"):
            return find(self.variants[variant], "fine.reason") or None
        return why_missing(self._failure(variant))

    def _failure(self, variant: str) -> str:
        return self.failed_variants.get(variant, self.failed)


@dataclass(frozen=True)
class RunSummary:
    """What a run has left of all its scenes and objects; the first of the variants is fused."""

    scenes: list[SceneSummary]
    objects: list[ObjectSummary]
    variants: list[str]
    failed: list[str]
    """The jobs that failed in this run, each with its error, where they are known."""


def summarise(run: RunInputs) -> RunSummary:
    """What a run has left."""
    given_scenes = dict(zip((folder.name for folder in run.scenes), run.given_scenes))
    scenes = {folder.name: _scene(folder, run, given_scenes.get(folder.name, "photos")) for folder in run.scenes}
    objects = []
    given_objects: Sequence[Given] = run.given_objects or ["photos"] * len(run.objects)
    for folder, scene, given in zip(run.objects, run.scene_of, given_objects, strict=True):
        linked = bool(scene) and "cloud" not in (given, given_scenes.get(scene))
        missing = scenes[scene].missing if scene in scenes else ""
        objects.append(summarise_object(folder, run.variants, run.jobs, scene, missing, given, linked))
    for folder in run.scenes:
        of_scene = [item for item, scene in zip(objects, run.scene_of) if scene == folder.name]
        undecided = {item.name for item in of_scene if item.status(run.variants[0]) in ("failed", "missing")}
        completed = read_fields(folder, ["completed.json"])
        # Otherwise it is from before an object failed or was mended.
        if not scenes[folder.name].missing and set(find(completed, "completed.failed") or {}) == undecided:
            scenes[folder.name].fields.update(completed)
    failed = [f"{log.parent.name}/{log.stem}: {last_error(log) or KILLED}" for log in run.jobs.failed_logs]
    return RunSummary(list(scenes.values()), objects, run.variants, failed)


def _scene(folder: Path, run: RunInputs, given: Given) -> SceneSummary:
    """A scene, up to its cloud."""
    maps = tuple(f"depth/{k}.json" for k in range(run.chunks)) if given == "photos" else ()
    there, missing = unbroken(folder, (*SCENE_FILES[given], *maps, "dense.json"))
    fields = read_fields(folder, [*(name for name in there if "/" not in name), *([] if missing else ["truth.json"])])
    return SceneSummary(folder.name, fields, missing, _why(folder / missing, run.jobs, folder.name) if missing else "")


def summarise_object(
    folder: Path,
    variants: list[str],
    jobs: JobRecords,
    scene: str = "",
    scene_missing: str = "",
    given: Given = "photos",
    linked: bool = True,
) -> ObjectSummary:
    """What a run has left of one object.

    Args:
        folder: the object's results.
        variants: registration variants, the one that is fused first.
        jobs: where the rules' logs and benchmarks are.
        scene: name of the scene that the object lies in; "" for one by itself.
        scene_missing: the first file that this scene lacks, or "".
        given: what of the object was given.
        linked: whether object and scene both have photos.
    """
    there, missing = unbroken(folder, OBJECT_FILES[given])
    who, optional = folder.name, ["masks.json"] if given == "both" and not missing else []
    if not missing and scene_missing:
        missing, who = f"{scene_missing} of the scene {scene}", scene
    if linked and not missing:
        aligned, missing = unbroken(folder, ("alignment.json",))
        optional += aligned
    stages = read_fields(folder, [*there, *optional])
    registered, gaps = {variant: Fields() for variant in variants}, dict[str, str]()
    if scene and not missing:
        registered, gaps = _registrations(folder, variants)
    fusion: Fields = {}
    if "fine.status" in registered[variants[0]]:
        there, missing = unbroken(folder, ("evidence.json", "fusion.json", "metrics.json"))
        looked_for, without = unbroken(folder, ("fusion.json", "missing.json"))
        missing = missing or without
        registered[variants[0]] |= read_fields(folder, [name for name in there if name == "metrics.json"])
        fusion = read_fields(folder, [*there[:2], *looked_for[1:]])
        fusion.pop("evidence.notes", None)
    # A variant's own log, else one of the object as a whole.
    failed_variants = {
        variant: _why(folder / gap, jobs, f"{folder.name}-{variant}", folder.name) for variant, gap in gaps.items()
    }
    missing = next(iter(gaps.values()), missing)
    if fusion and all("fine.status" in fields for fields in registered.values()):
        truth = read_fields(folder, ["truth.json"])
        stages |= {key: item for key, item in truth.items() if not key.startswith("truth.variants.")}
        for variant, fields in registered.items():
            prefix = f"truth.variants.{variant}."
            fields |= {f"truth.{k.removeprefix(prefix)}": v for k, v in truth.items() if k.startswith(prefix)}
    unit = registered[variants[0]].get("crop.diagonal", {}).get("unit", "scene units")
    stages, registered = _in_unit(stages, unit), {v: _in_unit(fields, unit) for v, fields in registered.items()}
    failed = _why(folder / missing, jobs, who) if missing else ""
    return ObjectSummary(folder.name, stages, registered, fusion, missing, failed, failed_variants, not scene)


def _registrations(folder: Path, variants: list[str]) -> tuple[dict[str, Fields], dict[str, str]]:
    """The quantities of each variant's registration, and the first file that each incomplete one lacks.

    The first variant is fused, and its metrics are the object's.
    """
    found: dict[str, Fields] = {}
    gaps: dict[str, str] = {}
    for variant in variants:
        names = REGISTRATION_FILES if variant == variants[0] else (*REGISTRATION_FILES, "metrics.json")
        there, lacking = unbroken(folder / "registration" / variant, names)
        found[variant] = read_fields(folder / "registration" / variant, there)
        if lacking:
            gaps[variant] = f"registration/{variant}/{lacking}"
    return found, gaps


def is_added(folder: Path) -> bool:
    """Whether an object of these results was added to its scene; one that was refused leaves the scene as it is."""
    return (folder / "fused.ply").is_file() and find(load(folder / "fusion.json"), "status") != "unregistered"


def unbroken(folder: Path, names: Sequence[str]) -> tuple[list[str], str]:
    """The files of a chain before the first that is missing, and that one, or "".

    Snakemake removes what a rule wrote before it runs the rule again: what is behind a gap is from an earlier run.
    """
    there = list(itertools.takewhile(lambda name: _readable(folder / name), names))
    return there, names[len(there)] if len(there) < len(names) else ""


def _readable(path: Path) -> bool:
    """Whether a file is there and, if it is JSON, whole."""
    if path.suffix != ".json" or not path.is_file():
        return path.is_file()
    try:
        json.loads(path.read_text())
    except ValueError:
        return False
    return True


def _why(path: Path, jobs: JobRecords, *names: str) -> str:
    """Why a file is missing: it is damaged, or a job with one of these names failed."""
    return f"{path} is damaged; delete it and run again" if path.is_file() else why_unfinished(jobs, *names)


def read_fields(folder: Path, names: Sequence[str]) -> Fields:
    """The quantities of the JSONs among some files of a folder, each prefixed by its file's name."""
    stems = [name.removesuffix(".json") for name in names if name.endswith(".json")]
    return {f"{stem}.{key}": item for stem in stems for key, item in load(folder / f"{stem}.json").items()}


def _in_unit(fields: Fields, unit: str) -> Fields:
    """The quantities with the scene's own unit of length where a stage knows it as "scene units" only."""
    return {k: {**item, "unit": item["unit"].replace("scene units", unit)} for k, item in fields.items()}


def why_missing(failed: str) -> str:
    """Why something is missing, for the reader: the failure, or that nothing of it ran."""
    return failed or "no error in its logs; it has not run to its end"
