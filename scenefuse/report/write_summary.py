"""The summary of a run: tables as TSV and a plain text that reads well in a terminal."""

from pathlib import Path

from scenefuse.job_records import JobRecords
from scenefuse.report.collected import Collected, Given, collect, collect_scene, read_fields, status_of
from scenefuse.report.disk import disk_table
from scenefuse.report.summary_text import summary_text
from scenefuse.report.tables import (
    ablation_table,
    completion_table,
    objects_table,
    registration_table,
    runtime_table,
    scenes_table,
)
from scenefuse.report.values import Fields, find
from scenefuse.stage import StageError, atomic_file


def write_summary(
    *,
    chunks: int,
    variants: list[str],
    jobs: JobRecords,
    summary: Path,
    scenes: tuple[Path, ...] = (),
    objects: tuple[Path, ...] = (),
    scene_of: tuple[str, ...] = (),
    cloud_scenes: tuple[str, ...] = (),
    cloud_objects: tuple[str, ...] = (),
    posed_scenes: tuple[str, ...] = (),
    posed_objects: tuple[str, ...] = (),
) -> None:
    """Collect every stage JSON and benchmark into tables and a text that reads well in a terminal.

    Writes registration.tsv, completion.tsv, ablation.tsv, runtime.tsv, scenes.tsv, objects.tsv, disk.tsv and,
    last, summary.txt.
    A value that does not exist is '-'. An object without results is named with the last error of its logs. What an
    earlier run left behind a step that failed since is not shown.

    Args:
        chunks: jobs that a scene's depth maps are split into.
        variants: registration variants, the one that is fused first.
        jobs: folders of the rules' logs and benchmarks; see JobRecords.
        summary: output folder; other files in it are left alone.
        scenes: result folders of the scenes (results/scenes/{scene}).
        objects: result folders of the objects (results/objects/{object}); they need not exist.
        scene_of: name of the scene that each object lies in; empty for one by itself.
        cloud_scenes: names of the scenes that were given as clouds without photos.
        cloud_objects: names of the objects that were.
        posed_scenes: names of the scenes whose clouds were given with photos and cameras.
        posed_objects: names of the objects whose were.

    Raises:
        StageError: no variant is given, or not one scene for each object.
    """
    if not variants:
        raise StageError("no registration variant is given; name at least one, the one that is fused first")
    if len(scene_of) != len(objects):
        raise StageError(f"{len(objects)} objects but {len(scene_of)} scenes are given; name the scene of each object")
    parts = {
        folder.name: collect_scene(folder, chunks, _given(folder.name, cloud_scenes, posed_scenes)) for folder in scenes
    }
    found = [
        collect(
            folder,
            variants,
            jobs,
            scene,
            parts[scene][1] if scene in parts else "",
            _given(folder.name, cloud_objects, posed_objects),
            bool(scene) and folder.name not in cloud_objects and scene not in cloud_scenes,
        )
        for folder, scene in zip(objects, scene_of)
    ]
    scene_fields = {name: fields for name, (fields, _) in parts.items()}
    for folder in scenes:
        of_scene = [item for item, scene in zip(found, scene_of) if scene == folder.name]
        if not parts[folder.name][1]:
            scene_fields[folder.name] |= _completed(folder, of_scene, variants[0])
    tables = {
        "registration": registration_table(found, variants),
        "completion": completion_table(found, variants[0]),
        "ablation": ablation_table(found, variants),
        "runtime": runtime_table(jobs.benchmarks),
        "scenes": scenes_table(scene_fields, jobs),
        "objects": objects_table(found),
        "disk": disk_table([*scenes, *objects]),
    }
    for name, table in tables.items():
        with atomic_file(summary / f"{name}.tsv") as temporary:
            table.to_csv(temporary, sep="\t", index=False, na_rep="-", float_format="%.6g")
    text = summary_text(scene_fields, found, variants, tables)
    with atomic_file(summary / "summary.txt") as temporary:
        temporary.write_text(text)
    print(text, flush=True)


def _given(name: str, clouds: tuple[str, ...], posed: tuple[str, ...]) -> Given:
    """What of a scene or an object was given."""
    return "cloud" if name in clouds else "both" if name in posed else "photos"


def _completed(folder: Path, objects: list[Collected], variant: str) -> Fields:
    """What the completed scene holds and its metrics; nothing when it is from before an object failed or was mended."""
    fields = read_fields(folder, ["completed.json", "metrics.json"])
    undecided = {item.name for item in objects if status_of(item, variant) in ("failed", "missing")}
    return fields if set(find(fields, "completed.failed") or {}) == undecided else {}
