"""How many jobs Snakemake plans for many objects in one scene, and what the planning costs.

PYTHONPATH=tests python tests/benchmarks/planning.py --objects 40 400
"""

import os
import re
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from support.user_project import Project

from scenefuse.core.settings import ROOT
from scenefuse.core.stage import StageError, run


def planning(*, objects: tuple[int, ...] = (40, 400)) -> None:
    """Print jobs, seconds of processor time and memory of a dry run for each number of objects, photos on both sides.

    Args:
        objects: how many.
    """
    for count in objects:
        with tempfile.TemporaryDirectory() as folder:
            project = Project(Path(folder))
            project.clicked(count)
            print(f"{count} objects: {_planned(project)}", flush=True)


def _planned(project: Project) -> str:
    """What a dry run says and takes; StageError where it fails."""
    command = [sys.executable, "-m", "snakemake", "-n", "--cores", "2", "--snakefile", ROOT / "Snakefile"]
    command += ["--directory", project.path, "--configfile", project.write()]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        list(map(str, command)), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    total = re.search(r"^total +(\d+)", done.stdout, re.MULTILINE)
    if done.returncode or total is None:
        raise StageError(f"the dry run failed: {done.stdout[-2000:]}")
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return f"{total[1]} jobs, {seconds:.1f} s of processor time, {after.ru_maxrss / 1024:.0f} MB at most so far"


if __name__ == "__main__":
    run(planning)
