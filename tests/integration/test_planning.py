"""What planning costs: jobs for each object, and what is imported before any of them runs."""

import os
import re
import subprocess
import sys

import pytest
from support.snakemake_runs import ROOT
from support.user_project import Project


@pytest.fixture
def dry_run(tmp_path, snakemake):
    """What a dry run of so many objects says."""

    def run(objects: int) -> str:
        project = Project(tmp_path / str(objects))
        project.path.mkdir()
        project.clicked(objects)
        done = snakemake(project.path, "-n", config=project.write())
        assert done.returncode == 0, done.stdout[-3000:]
        return done.stdout

    return run


def test_one_more_object_costs_twenty_jobs(dry_run):
    one, two = (int(re.findall(r"^total +(\d+)", dry_run(objects), re.MULTILINE)[0]) for objects in (1, 2))
    assert two - one == 20


def test_planning_imports_nothing_heavy(tmp_path):
    # Every job on a cluster plans again. Without a survey, clicks are all that is looked into.
    project = Project(tmp_path)
    project.clicked(1)
    command = [sys.executable, "-m", "snakemake", "-n", "--snakefile", str(ROOT / "Snakefile")]
    command += ["--directory", str(tmp_path), "--configfile", str(project.write())]
    env = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONPROFILEIMPORTTIME": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stdout[-3000:]
    imported = set(re.findall(r"^import time: .*\| +(\S+)$", done.stderr, re.MULTILINE))
    assert "scenefuse.marks.clicks" in imported
    assert imported & {"torch", "open3d", "pycolmap", "pyproj", "cv2", "numba", "scipy"} == set()
