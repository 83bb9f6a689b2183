"""profiles/slurm on a Slurm that the test starts: jobs are submitted, steps of seconds together, one with a card; one
fails, one runs out of time and goes on."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.user_project import write_clouds

from scenefuse.cloud.clouds import read_cloud

ROOT = Path(__file__).resolve().parents[2]
ISOLATED = ("unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc")
SLOW = """
rule slow:
    output:
        "slow.txt",
    resources:
        runtime=lambda wildcards, attempt: 10 * attempt,
    shell:
        "if [ -f checkpoint ]; then echo resumed at $(cat checkpoint) > {output}; "
        "else echo 7 > checkpoint; echo $SLURM_JOB_ID > started; sleep 600; fi"
"""
CARD = """
rule card:
    output:
        "card.txt",
    resources:
        gpu=1,
    shell:
        "echo $SLURM_JOB_PARTITION $CUDA_VISIBLE_DEVICES > {output}"
"""
# Slurm looks at time limits every half minute; this job's is brought forward, so that it is over at once.
RUN = """
{snakemake} {targets} --snakefile {root}/Snakefile --directory clouds --configfile clouds/mine.yaml &> clouds.txt &
{snakemake} --snakefile slow/Snakefile --directory slow &> slow.txt &
{snakemake} --snakefile card/Snakefile --directory card --set-resources card:slurm_partition=cards &> card.txt &
for _ in $(seq 1200); do [ -s slow/started ] && break; sleep 0.1; done
until scontrol update JobId=$(cat slow/started) EndTime=now; do sleep 0.1; done  # not in the second of its start
wait %1 && echo 0 > clouds.status || echo $? > clouds.status
wait %2 && echo 0 > slow.status || echo $? > slow.status
wait %3 && echo 0 > card.status || echo $? > card.status
scontrol show jobs --oneliner > jobs.txt
"""


def why_not():
    """What is missing for this test, or ""."""
    missing = [name for name in ("slurmctld", "slurmd", "sbatch", "unshare") if shutil.which(name) is None]
    if missing:
        return f"{', '.join(missing)} not installed; envs/slurm.sh installs Slurm"
    if subprocess.run([*ISOLATED, "true"], capture_output=True).returncode:
        return "Slurm's own namespaces (unshare) need root's rights"
    return "" if Path("/etc/slurm").is_dir() else "there is no folder /etc/slurm"


pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not())


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """The folder in which three workflows have run: clouds/, one of which has a single point, slow/ and card/."""
    folder = tmp_path_factory.mktemp("slurm")
    yard = folder / "clouds"
    for name, content in (("slow", SLOW), ("card", CARD)):
        (folder / name).mkdir()
        (folder / name / "Snakefile").write_text(content)
    write_clouds(yard)
    targets = "results/scenes/yard/dense.ply results/objects/shed/object.ply"
    targets += " results/objects/house/registration/full/fine.json"
    command = f"{sys.executable} -m snakemake"
    command += f" --profile {ROOT}/profiles/slurm --workflow-profile {ROOT}/profiles/default"
    command += " --slurm-init-seconds-before-status-checks 2 --seconds-between-status-checks 2"
    (folder / "run.sh").write_text(RUN.format(snakemake=command, root=ROOT, targets=targets))
    env = {name: text for name, text in os.environ.items() if not name.startswith("SLURM_")}
    done = subprocess.run(
        [*ISOLATED, ROOT / "tests/support/on_slurm.sh", folder / "slurm", "bash", "run.sh"],
        cwd=folder, env=env | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def jobs(ran):
    """What Slurm says of each job, by the number of the job."""
    lines = (ran / "jobs.txt").read_text().splitlines()
    return [dict(re.findall(r"(\w+)=(\S+)", line)) for line in lines]


def text_of(path):
    return path.read_text() + "".join(log.read_text() for log in path.parent.glob("*/.snakemake/slurm_logs/**/*.log"))


def test_jobs_of_the_workflow_are_submitted_with_what_they_need(ran, jobs):
    assert len(read_cloud(ran / "clouds/results/scenes/yard/dense.ply")) == 2000
    assert len(read_cloud(ran / "clouds/results/objects/house/object.ply")) == 500
    done = [job for job in jobs if job["JobState"] == "COMPLETED" and job["TimeLimit"] == "00:30:00"]
    assert len(done) == 2 and {job["Partition"] for job in done} == {"main"}
    # The object's cloud, which is read whole, asks for a little more.
    assert sorted(job["MinMemoryNode"] for job in done) == ["4000M", "4001M"]


def test_steps_of_seconds_are_one_job_with_the_time_of_all(ran, jobs):
    of_house = ran / "clouds/results/objects/house/registration/full"
    assert all((of_house / f"{step}.json").exists() for step in ("crop", "scale", "coarse", "fine"))
    assert len([job for job in jobs if job["JobState"] == "COMPLETED" and job["Partition"] == "main"]) == 4
    assert "02:30:00" in [job["TimeLimit"] for job in jobs]


def test_a_job_that_asks_for_a_card_gets_one_in_its_partition(ran, jobs):
    assert (ran / "card.status").read_text().strip() == "0", text_of(ran / "card.txt")
    assert (ran / "card/card.txt").read_text() == "cards 0\n"
    assert len([job for job in jobs if job["Partition"] == "cards" and "gpu" in job["TresPerJob"]]) == 1


def test_a_job_that_fails_is_tried_again_with_more_and_then_named_and_the_others_go_on(ran, jobs):
    assert (ran / "clouds.status").read_text().strip() == "1"
    failed = [job for job in jobs if job["JobState"] == "FAILED"]
    asked = [(job["MinMemoryNode"], job["TimeLimit"]) for job in failed]
    assert asked == [("4000M", "00:30:00"), ("8000M", "01:00:00")]
    assert "shed.ply has only 1 different positions" in text_of(ran / "clouds.txt")
    assert not (ran / "clouds/results/objects/shed/object.ply").exists()


def test_a_job_that_runs_out_of_time_goes_on_where_it_was_with_more_time(ran, jobs):
    assert (ran / "slow.status").read_text().strip() == "0", text_of(ran / "slow.txt")
    assert (ran / "slow/slow.txt").read_text() == "resumed at 7\n"
    timed_out = next(job for job in jobs if job["JobState"] == "TIMEOUT")
    again = next(job for job in jobs if job["TimeLimit"] == "00:20:00")
    assert timed_out["JobId"] == (ran / "slow/started").read_text().strip() != again["JobId"]
    assert again["JobState"] == "COMPLETED"
