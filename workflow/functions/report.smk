# What the summary reads, and the command that writes it.


def results_of(wildcards):
    """Everything that the summary reads: what the last stage of each scene and object writes, and the truth where it is known."""
    ends = [
        "metrics.json",
        "fusion.json",
        "frames.json",
        *(f"registration/{variant}/metrics.json" for variant in VARIANTS),
    ]
    scene_ends = ["dense.json", "completed.json"]
    files = [f"results/scenes/{name}/{end}" for name in SCENES for end in scene_ends]
    files += [f"results/objects/{name}/{end}" for name in OBJECTS for end in ends]
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


def summary_command(log):
    """The shell line that writes the tables and summary.txt; also run when a job has failed, so that the summary names it."""
    return (
        f"python {script('report/write_summary.py')} --scenes {' '.join(f'results/scenes/{name}' for name in SCENES)}"
        f" --chunks {len(CHUNKS)} --objects {' '.join(f'results/objects/{name}' for name in OBJECTS)}"
        f" --scene-of {' '.join(row['scene'] for row in OBJECTS.values())} --variants {' '.join(VARIANTS)}"
        f" --benchmarks results/benchmarks --logs results/logs --summary results/summary &> {log}"
    )
