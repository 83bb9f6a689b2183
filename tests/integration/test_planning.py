"""What planning costs: jobs for each object, and what is imported before any of them runs."""

import os
import re
import subprocess
import sys

import pytest
from support.packages import PACKAGES
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


def test_one_more_object_costs_nineteen_jobs(dry_run):
    one, two = (int(re.findall(r"^total +(\d+)", dry_run(objects), re.MULTILINE)[0]) for objects in (1, 2))
    assert two - one == 19


def test_no_photo_and_no_cloud_comes_back_to_a_package_that_it_has_left(snakemake, tmp_path):
    package, rules = dict[str, str](), r"^use rule (\w+) as (\w+)|^rule (\w+):|script=script\(.(\w+)/"
    for path in {*(ROOT / "workflow/rules").glob("*.smk")} - {ROOT / "workflow/rules/paper.smk"}:
        rule = ""
        for like, new, own, folder in re.findall(rules, path.read_text(), re.MULTILINE):
            rule = new or own or rule
            package |= {rule: package[like]} if like else {rule: folder} if folder else {}
    project = Project(tmp_path)
    project.clicked(1)
    graph = snakemake(project.path, "-n", "--rulegraph", config=project.write()).stdout
    name = dict(re.findall(r'(\d+)\[label = "(\w+)"', graph))
    steps = {(name[one], name[other]) for one, other in re.findall(r"(\d+) -> (\d+)", graph)}
    assert ("georegister", "estimate_scene_spread") in steps and len(steps) > 40
    place = {rule: PACKAGES.index(package.get(rule, "report")) for rule in set(name.values()) - {"all"}}
    assert [step for step in steps if "all" not in step and place[step[0]] > place[step[1]]] == []


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
