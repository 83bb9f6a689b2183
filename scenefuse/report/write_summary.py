"""The summary of a run: tables as TSV and a plain text that reads well in a terminal."""

from pathlib import Path

from scenefuse.core.stage import atomic_file
from scenefuse.report.disk import disk_table
from scenefuse.report.run_summary import RunInputs, summarise
from scenefuse.report.summary_text import summary_text
from scenefuse.report.tables import (
    completion_table,
    objects_table,
    registration_table,
    runtime_table,
    scenes_table,
)


def write_summary(*, run: RunInputs, summary: Path) -> None:
    """Collect every stage JSON and benchmark into tables and a text that reads well in a terminal.

    Writes registration.tsv, completion.tsv, runtime.tsv, scenes.tsv, objects.tsv, disk.tsv and, last, summary.txt.
    A value that does not exist is '-'. An object without results is named with the last error of its logs. What an
    earlier run left behind a step that failed since is not shown.

    Args:
        run: see RunInputs.
        summary: output folder; other files in it are left alone.

    Raises:
        StageError: no variant is given, or not one scene for each object.
    """
    found = summarise(run)
    tables = {
        "registration": registration_table(found),
        "completion": completion_table(found),
        "runtime": runtime_table(run.jobs.benchmarks),
        "scenes": scenes_table(found.scenes),
        "objects": objects_table(found.objects),
        "disk": disk_table([*run.scenes, *run.objects]),
    }
    for name, table in tables.items():
        with atomic_file(summary / f"{name}.tsv") as temporary:
            table.to_csv(temporary, sep="\t", index=False, na_rep="-", float_format="%.6g")
    text = summary_text(found, tables)
    with atomic_file(summary / "summary.txt") as temporary:
        temporary.write_text(text)
    print(text, flush=True)
