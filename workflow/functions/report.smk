# What the summary reads, the command that writes it, and what is still to be done when a job has failed.
import platform
import subprocess

from scenefuse.core.job_records import why_ended
from scenefuse.core.stage import STOPPED, own_sigterm, remove_leftovers
from scenefuse.report.run_summary import (
    OBJECT_FILES,
    REGISTRATION_FILES,
    SCENE_FILES,
)


def results_of(wildcards):
    """Everything that the summary reads, and the clouds. `all` asks for it too, so that what was deleted is made again."""
    scenes, objects = {}, {}
    for name, row in SCENES.items():
        given = what_is_given(row)
        chunks = (
            [f"depth/{chunk}.json" for chunk in CHUNKS] if given == "photos" else []
        )
        ends = ["dense.ply", "dense.json", "completed.json"]
        scenes[name] = [*SCENE_FILES[given], *chunks, *ends]
        scenes[name] += ["truth.json"] if is_rendered(row) else []
    for name, row in OBJECTS.items():
        objects[name] = [*OBJECT_FILES[what_is_given(row)], "object.ply"]
        if name in JOINED:
            objects[name] += ["evidence.json", "fusion.json", "missing.json"]
            objects[name] += ["frames.json", "metrics.json"]
            objects[name] += [
                f"registration/{variant}/{file}"
                for variant in VARIANTS
                for file in REGISTRATION_FILES
            ]
            objects[name] += [
                f"registration/{variant}/metrics.json" for variant in list(VARIANTS)[1:]
            ]
        if name in JOINED and is_rendered(row) and is_rendered(SCENES[row["scene"]]):
            objects[name] += ["truth.json"]
    return [
        f"results/{kind}/{name}/{file}"
        for kind, found in (("scenes", scenes), ("objects", objects))
        for name, files in found.items()
        for file in files
    ]


def truth_of(row):
    """The folder with the truth of photos that the demo has rendered."""
    photos = Path(row["photos"])
    return str(photos.parents[1] / "truth" / photos.parent.name)


def is_rendered(row):
    """Whether the demo has rendered the photos of a row, so that their truth is known."""
    if not DEMO or not Path(row.get("photos", "")).match("demo/*/*/photos"):
        return False
    return made_here(truth_of(row)) or Path(truth_of(row)).is_dir()


def exported_surfaces():
    """The reports of the surfaces that `scenefuse export` has made."""
    files = [Path(f"results/objects/{name}/surface.json") for name in OBJECTS]
    return [str(path) for path in files if path.is_file()]


def there_if_exported(pattern, **names):
    """Input function: a file of each scene or object; of those that `scenefuse export` does not make, as of an object that failed,
    only the ones that are there."""

    def files(wildcards):
        found = expand(pattern, **names)
        exported = workflow.dag_settings.allowed_rules
        return [path for path in found if Path(path).exists() or not exported]

    return files


def facade_of(name):
    """The option with the three points of an object's facade that `scenefuse export --facade` was given."""
    path = Path(f"results/objects/{name}/facade.txt")
    return f"--facade {path.read_text()}" if path.is_file() else ""


def what_is_given(row):
    """What of a scene or an object its row gives: photos, cloud, or both."""
    if not row.get("cloud"):
        return "photos"
    return "both" if row.get("photos") else "cloud"


def if_flown(name):
    """Input function: a scene's file; none where the scene has no photos."""

    def files(wildcards):
        has_photos = scene_row(wildcards.scene).get("photos")
        return [f"results/scenes/{wildcards.scene}/{name}"] if has_photos else []

    return files


def run_options(wildcards=None):
    """What the run works on, and where it leaves results and records, as options; also a params function."""
    given = {
        "scene_of": [row.get("scene", "") for row in OBJECTS.values()],
        "given_scenes": [what_is_given(row) for row in SCENES.values()],
        "made_by": [row.get("made_by", "") for row in SCENES.values()],
        "given_objects": [what_is_given(row) for row in OBJECTS.values()],
    }
    given = flags({name: found for name, found in given.items() if found})
    return (
        f"{result_folders()} --chunks {len(CHUNKS)} --variants {' '.join(VARIANTS)}"
        f" --benchmarks results/benchmarks --logs results/logs {given}"
    )


def summary_command(log, options=""):
    """The shell line that writes the tables and summary.txt; also run when a job has failed, so that the summary names it."""
    command = f"python {script('report/write_summary.py')} {run_options()}{options}"
    return f"{command} --summary results/summary &> {log}"


def run_summary_command(log, options=""):
    """Write the summary outside of a rule. (`shell` replaces what stands in braces, but not in what it puts there.)"""
    command = summary_command(log, options)
    shell("mkdir -p results/logs/write_summary; {command} || true")


def forget_failures():
    """Write a summary that names jobs which failed in an earlier run again, without them, where this run does not: `scenefuse
    export` makes none."""
    text = Path("results/summary/summary.txt")
    if "write_summary" in {job.rule.name for job in workflow.dag.needrun_jobs()}:
        return
    if text.is_file() and "\njobs that failed\n" in text.read_text():
        run_summary_command("results/logs/write_summary/onstart.log")


def closing_lines():
    """What a finished run ends with: the result, the report page, the next step."""
    from scenefuse.report import facts

    return facts.closing_lines(Path("results/summary"))


def result_folders(wildcards=None):
    """The result folders of all scenes and objects, as options; also a params function."""
    names = {"scenes": SCENES, "objects": OBJECTS}
    return flags(
        {
            kind: [f"results/{kind}/{name}" for name in rows]
            for kind, rows in names.items()
            if rows
        }
    )


def mark_as_unfinished():
    """Mark what the jobs of this run made before as incomplete. Each job that ends well removes its marks. What a failed job, a kill
    or a power cut holds up keeps them, and the next run makes it again: Snakemake itself forgets a failed job, whose
    parameters it records as if it had ended well, and a missing file alone is no reason to make what follows from it.
    """
    for job in workflow.dag.needrun_jobs():
        if any(Path(output).exists() for output in job.output):
            workflow.persistence.started(job)


def jobs_that_ended_badly():
    """The jobs that failed, and those that ran when the run was stopped."""
    ended = workflow.scheduler.failed | workflow.scheduler.running
    return {job for jobs in ended for job in (jobs if jobs.is_group() else [jobs])}


def record_failures():
    """Let the jobs that failed or were stopped run again whatever is asked for next, and remove the marks of those that are not
    reached by these."""
    stopped = jobs_that_ended_badly()
    for job in stopped:
        for output in job.output:
            remove_leftovers(Path(output))
            record = workflow.persistence.metadata(output)
            if record is not None:
                record.params = []
                workflow.persistence._write_record(str(output), record)
    reached = set(workflow.dag.bfs(workflow.dag.depending, *stopped))
    for job in set(workflow.dag.needrun_jobs()) - reached:
        for output in job.output:
            workflow.persistence._unmark_incomplete(str(output))


def refuse_read_only_folders():
    """End before the first job where one of this run could not write what it makes."""
    folders = {
        Path(file).parent for job in workflow.dag.needrun_jobs() for file in job.output
    }
    folders = {
        next(filter(Path.exists, (folder, *folder.parents))) for folder in folders
    }
    frozen = sorted(str(folder) for folder in folders if not os.access(folder, os.W_OK))
    if frozen:
        refuse(f"{', '.join(frozen)} cannot be written to; check who may write there")


def forecast_run():
    """What this run will take, in sentences; its jobs' seconds are left for the summary to compare."""
    with own_sigterm():
        from scenefuse.report import forecast

    rows = {("scene", name): row for name, row in SCENES.items()}
    rows |= {("object", name): row for name, row in OBJECTS.items()}
    taken = {
        key: forecast.job_seconds(key[0], row, PROJECT.of(*key))
        for key, row in rows.items()
    }
    seconds, by_rule, memory = {}, {}, {}
    for job in workflow.dag.needrun_jobs():
        name, of = job.rule.name, dict(job.wildcards.items())
        kind = "object" if "object" in of else "scene"
        cost = taken.get((kind, of.get(kind)), {}).get(name, forecast.JOB_S)
        by_rule[name] = by_rule.get(name, 0) + cost
        # Known once a job's inputs are there.
        asked = job.resources.get("mem_mb")
        memory[name] = max(memory.get(name, 0), asked if isinstance(asked, int) else 0)
        if job.benchmark:
            seconds[str(job.benchmark)] = cost
    if not by_rule:
        return []
    forecast.write_forecast(Path("results/logs", forecast.FORECAST), seconds)
    needed = {
        Path(f"results/{kind}s/{name}"): forecast.disk_bytes(
            kind, row, PROJECT.of(kind, name)
        )
        for (kind, name), row in rows.items()
    }
    cores = workflow.resource_settings.cores or 1
    try:
        return forecast.forecast_lines(
            by_rule, cores, memory, memory_mb(), needed, config["keep_maps"]
        )
    except StageError as error:
        refuse(str(error))


def held_up(rule):
    """The jobs of a rule that have not run, because of what failed before them. An object that fails holds up those that
    wait for all objects; they run at the end without it."""
    jobs = set(workflow.dag.needrun_jobs()) - workflow.scheduler.failed
    return [job for job in jobs if job.rule.name == rule]


def run_anyway(job, options=""):
    """Run a job whose inputs are not all there; returns whether it ended well. Its outputs stay marked as incomplete: the next run
    makes them anew."""
    workflow.persistence.started(job)
    folders = " ".join({str(Path(file).parent) for file in (*job.log, job.benchmark)})
    command = f"{job.shellcmd.removeprefix('exec ')}{options}"
    try:
        # The benchmark says that the job has ended well.
        shell("mkdir -p {folders}; {command} && touch {job.benchmark}")
    except subprocess.CalledProcessError:
        return False
    return True


def finish_scenes():
    """Complete, draw and show the scenes without the objects that failed. Where the scene itself failed, its figure and view of
    before go: the page would show them as if they were of this run."""
    made = set()
    takes = {"complete_scene": failed_logs(), "draw_scene": ""}
    for step in (*takes, "view_scene"):
        for job in held_up(step):
            missing = [
                other
                for other in workflow.dag.dependencies[job]
                if other not in made and not workflow.dag.noneedrun_finished(other)
            ]
            objects = {other.wildcards.get("object") for other in missing}
            if None not in objects:
                without = f" --failed {' '.join(sorted(objects))}{takes.get(step, '')}"
                if run_anyway(job, without if step in takes and objects else ""):
                    made.add(job)
            elif step != "complete_scene":
                for output in job.output:
                    Path(output).unlink(missing_ok=True)


def failed_logs():
    """The option that names the logs of the jobs that failed."""
    logs = sorted(log for job in jobs_that_ended_badly() for log in job.log)
    return f" --failed-logs {' '.join(logs)}" if logs else ""


def print_failures(stopped):
    """Print what failed, and why; `stopped` is whether a signal ended the run."""
    if stopped:
        print(f"failed: the run was stopped {STOPPED}", file=sys.stderr)
    started = os.fstat(run_lock.fileno()).st_mtime
    for job in sorted(jobs_that_ended_badly(), key=lambda job: job.jobid):
        for log in job.log:
            why = why_ended(Path(log), Path(job.benchmark or ""), started)
            about = job.message or job.rule.name
            print(f"failed: {about}: {why} [{log}]", file=sys.stderr)


def hold_run_lock():
    """Hold a file among Snakemake's locks until this process ends."""
    global run_lock
    RUN_LOCK.parent.mkdir(parents=True, exist_ok=True)
    run_lock = RUN_LOCK.open("w")
    print(platform.node(), file=run_lock, flush=True)
    try:
        fcntl.flock(run_lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        RUN_LOCK.unlink()
