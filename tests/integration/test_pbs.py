"""profiles/pbs with stand-ins for PBS's commands: what jobs ask for, one that fails, and one that is killed."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.user_project import write_clouds

from scenefuse.cloud.clouds import read_cloud

pytest.importorskip("snakemake_executor_plugin_cluster_generic", reason="pip install -r tests/requirements.txt")

ROOT = Path(__file__).resolve().parents[2]
# Every job runs at once; qstat knows it afterwards, as with job_history_enable.
QSUB = """#!/bin/bash
id=$(($(ls "$JOBS" | grep -c options) + 1))
echo "$@" > "$JOBS/$id.options"
(setsid bash "${@: -1}" &> "$JOBS/$id.out"; echo $? > "$JOBS/$id.status") &> /dev/null &
echo "$id.server"
"""
QSTAT = """#!/bin/bash
id=${2%.server}
echo "Job Id: $2"
[ -f "$JOBS/$id.status" ] || { echo "    job_state = R"; exit; }
printf '    job_state = F\\n    Exit_status = %s\\n' "$(cat "$JOBS/$id.status")"
"""
KILLED = """
rule killed:
    output:
        "done.txt",
    resources:
        runtime=lambda wildcards, attempt: 10 * attempt,
        gpu=1,
    shell:
        "if [ -f before ]; then touch {output}; else touch before; kill -9 $PPID; sleep 60; fi"
"""


@pytest.fixture
def pbs(tmp_path):
    """Run Snakemake with the profile in a folder; returns its output, and the options that jobs were submitted with."""
    for name, script in (("qsub", QSUB), ("qstat", QSTAT)):
        (tmp_path / "bin").mkdir(exist_ok=True)
        (tmp_path / "bin" / name).write_text(script)
        (tmp_path / "bin" / name).chmod(0o755)
    (tmp_path / "jobs").mkdir()
    env = os.environ | {"PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "JOBS": str(tmp_path / "jobs")}

    def run(folder, *words):
        command = [sys.executable, "-m", "snakemake", "--profile", ROOT / "profiles/pbs", "--directory", folder]
        command += ["--workflow-profile", ROOT / "profiles/default", "--seconds-between-status-checks", "1", *words]
        done = subprocess.run(
            list(map(str, command)), cwd=folder, env=env | {"PYTHONPATH": str(ROOT)}, timeout=300, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        submitted = sorted((tmp_path / "jobs").glob("*.options"), key=lambda path: int(path.stem))
        return done, [re.findall(r"-l (\S+)", path.read_text()) for path in submitted]

    return run


def test_jobs_are_submitted_with_what_they_need_and_the_others_go_on(pbs, tmp_path):
    write_clouds(tmp_path)
    files = [f"results/objects/{name}/object.ply" for name in ("house", "shed")]
    done, asked = pbs(tmp_path, *files, "--snakefile", ROOT / "Snakefile", "--configfile", "mine.yaml")
    assert done.returncode == 1 and "shed.ply has only 1 different positions" in done.stdout, done.stdout
    assert len(read_cloud(tmp_path / files[0])) == 500 and not (tmp_path / files[1]).exists()
    select = "select=1:ncpus=1:mem={}mb"
    asked = [tuple(options) for options in asked]
    assert (select.format(4001), "walltime=1800") in asked and (select.format(8000), "walltime=3600") in asked


def test_a_job_that_is_killed_is_tried_again_with_more_time(pbs, tmp_path):
    (tmp_path / "Snakefile").write_text(KILLED)
    done, asked = pbs(tmp_path)
    assert done.returncode == 0, done.stdout
    assert [walltime for _, walltime in asked] == ["walltime=600", "walltime=1200"]
    assert all("ngpus=1" in select for select, _ in asked)
