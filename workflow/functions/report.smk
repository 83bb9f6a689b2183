# What the summary reads, the command that writes it, and what is still to be done when a job has failed.


def results_of(wildcards):
    """Everything that the summary reads: what the last stage of each scene and object writes, and the truth where it is known."""
    ends = [
        "metrics.json",
        "fusion.json",
        "missing.json",
        "frames.json",
        *(f"registration/{variant}/metrics.json" for variant in list(VARIANTS)[1:]),
    ]
    scene_ends = ["dense.json", "completed.json", "metrics.json"]
    files = [f"results/scenes/{name}/{end}" for name in SCENES for end in scene_ends]
    files += [f"results/objects/{name}/{end}" for name in JOINED for end in ends]
    files += [f"results/objects/{name}/object.json" for name in LONE]
    files += [
        f"results/scenes/{name}/truth.json"
        for name, row in SCENES.items()
        if row.get("truth")
    ]
    files += [
        f"results/objects/{name}/truth.json"
        for name, row in OBJECTS.items()
        if row.get("truth")
    ]
    return files


def scene_model(wildcards):
    """The cameras of a scene; none where it has no photos."""
    folder = f"results/scenes/{wildcards.scene}/georeferenced"
    return [folder] if scene_row(wildcards.scene).get("photos") else []


def run_options(wildcards=None):
    """What the run works on, and where it leaves results and records, as options; also a params function."""
    given = {
        "scene_of": [row.get("scene", "") for row in OBJECTS.values()],
        "cloud_scenes": CLOUD_SCENES,
        "cloud_objects": CLOUD_OBJECTS,
        "posed_scenes": POSED_SCENES,
        "posed_objects": POSED_OBJECTS,
    }
    given = flags({name: found for name, found in given.items() if found})
    return (
        f"{result_folders()} --chunks {len(CHUNKS)} --variants {' '.join(VARIANTS)}"
        f" --benchmarks results/benchmarks --logs results/logs {given}"
    )


def summary_command(log):
    """The shell line that writes the tables and summary.txt; also run when a job has failed, so that the summary names it."""
    command = f"python {script('report/write_summary.py')} {run_options()}"
    return f"{command} --summary results/summary &> {log}"


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


def held_up(rule):
    """The jobs of a rule that have not run, because of what failed before them. An object that fails holds up those that
    wait for all objects; they run at the end without it."""
    jobs = set(workflow.dag.needrun_jobs()) - workflow.scheduler.failed
    return [job for job in jobs if job.rule.name == rule]


def run_anyway(job, options=""):
    """Run a job whose inputs are not all there. Its outputs stay marked as incomplete: the next run makes them anew."""
    workflow.persistence.started(job)
    folders = {str(Path(file).parent) for file in (*job.log, job.benchmark)}
    command = f"{job.shellcmd.removeprefix('exec ')}{options}"
    # The benchmark says that the job has ended well.
    shell(f"mkdir -p {' '.join(folders)}; {command} && touch {job.benchmark} || true")


def without_the_failed(job):
    """The option that names the objects that a job has to do without; None when the scene itself is missing."""
    missing = [
        Path(file).parts
        for other, files in workflow.dag.dependencies[job].items()
        if not workflow.dag.noneedrun_finished(other)
        for file in files
    ]
    if any(parts[:2] != ("results", "objects") for parts in missing):
        return None
    return f" --failed {' '.join(sorted({parts[2] for parts in missing}))}"
