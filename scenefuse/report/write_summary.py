"""The summary of a run: tables as TSV and a plain text that reads well in a terminal."""

from pathlib import Path

from scenefuse.core.stage import atomic_file
from scenefuse.report.collected import Collected, RunInputs, collect_run, read_fields, status_of
from scenefuse.report.disk import disk_table
from scenefuse.report.summary_text import summary_text
from scenefuse.report.tables import (
    completion_table,
    objects_table,
    registration_table,
    runtime_table,
    scenes_table,
)
from scenefuse.report.values import Fields, find


def write_summary(*, run: RunInputs, summary: Path) -> None:
    """Collect every stage JSON and benchmark into tables and a text that reads well in a terminal.

    Writes registration.tsv, completion.tsv, runtime.tsv, scenes.tsv, objects.tsv, disk.tsv and,
    last, summary.txt.
    A value that does not exist is '-'. An object without results is named with the last error of its logs. What an
    earlier run left behind a step that failed since is not shown.

    Args:
        run: see RunInputs.
        summary: output folder; other files in it are left alone.

    Raises:
        StageError: no variant is given, or not one scene for each object.
    """
    parts, found = collect_run(run)
    scene_fields = {name: fields for name, (fields, _) in parts.items()}
    for folder in run.scenes:
        of_scene = [item for item, scene in zip(found, run.scene_of) if scene == folder.name]
        if not parts[folder.name][1]:
            scene_fields[folder.name] |= _completed(folder, of_scene, run.variants[0])
    tables = {
        "registration": registration_table(found, run.variants),
        "completion": completion_table(found, run.variants[0]),
        "runtime": runtime_table(run.jobs.benchmarks),
        "scenes": scenes_table(scene_fields, run.jobs),
        "objects": objects_table(found),
        "disk": disk_table([*run.scenes, *run.objects]),
    }
    for name, table in tables.items():
        with atomic_file(summary / f"{name}.tsv") as temporary:
            table.to_csv(temporary, sep="\t", index=False, na_rep="-", float_format="%.6g")
    text = summary_text(scene_fields, found, run.variants, tables)
    with atomic_file(summary / "summary.txt") as temporary:
        temporary.write_text(text)
    print(text, flush=True)


def _completed(folder: Path, objects: list[Collected], variant: str) -> Fields:
    """What the completed scene holds and its metrics; nothing when it is from before an object failed or was mended."""
    fields = read_fields(folder, ["completed.json", "metrics.json"])
    undecided = {item.name for item in objects if status_of(item, variant) in ("failed", "missing")}
    return fields if set(find(fields, "completed.failed") or {}) == undecided else {}
