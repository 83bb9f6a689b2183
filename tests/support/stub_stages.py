"""The workflow with a stub in the place of every stage.

A stub's outputs hold a hash of its command and of what it reads: results are equal where all that they come from is,
and a whole run takes seconds. A stub fails as a file in faults/ says.
"""

import copy
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from support.snakemake_runs import ROOT
from support.user_project import Project

RECORDS = {"logs", "benchmarks", "checkpoints"}
# It finds its job by its log, and the files of all jobs in jobs.json.
STUB = """\
import hashlib, json, os, pathlib, signal, sys, time

log = os.path.relpath(os.readlink("/proc/self/fd/1"))
job = "-".join(pathlib.Path(log).with_suffix("").parts[2:])
inputs, outputs = json.loads(pathlib.Path("jobs.json").read_text())[log]
fault = pathlib.Path("faults", job)
fault = fault.read_text() if fault.is_file() else ""


def content(path):
    path = pathlib.Path(path)
    files = sorted(f for f in path.rglob("[!.]*") if f.is_file()) if path.is_dir() else [path]
    return b"".join(f.as_posix().encode() + f.read_bytes() for f in files)


words = sys.argv[1:]
read = b"".join(content(path) for path in inputs if os.path.exists(path))
own = pathlib.Path(__file__).read_bytes()
digest = hashlib.sha256(" ".join(words).encode() + read + own).hexdigest()
if fault == "error":
    sys.exit("error: planted")
if fault.startswith("run "):
    # As a stage writes, and says that it cannot.
    from scenefuse.core.stage import atomic_file, run

    def write():
        os.system(fault.removeprefix("run "))
        path = pathlib.Path(outputs[0])
        with atomic_file(path / "part" if path.suffix == "" else path) as temporary:
            temporary.write_bytes(bytes(100_000))

    sys.argv = sys.argv[:1]
    run(write)
if fault.startswith("sleep "):
    pathlib.Path(log).with_suffix(".started").touch()
    try:
        time.sleep(float(fault.split()[1]))
    except KeyboardInterrupt:
        sys.exit("error: stopped by SIGINT")
for number, output in enumerate(outputs):
    if number and fault == "parent SIGKILL":
        break
    output = pathlib.Path(output)
    folder = output.suffix == ""
    (output if folder else output.parent).mkdir(parents=True, exist_ok=True)
    (output / "part" if folder else output).write_text(digest)
if fault in ("SIGKILL", "SIGTERM", "SIGINT"):
    os.kill(os.getpid(), signal.Signals[fault])
if fault == "parent SIGKILL":
    os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(0.2)
    os.kill(os.getpid(), signal.SIGKILL)
if fault == "parent SIGTERM":
    os.kill(os.getppid(), signal.SIGTERM)
if fault.startswith("write "):
    pathlib.Path(fault.split()[1]).write_bytes(b"changed")
"""


def stub_workflow(folder: Path) -> Path:
    """Write the workflow with stubs for stages below a folder; returns its Snakefile."""
    for name in ("workflow", "profiles"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "Snakefile", folder)
    # A plan lists the files of a job that has no message.
    for rules in (folder / "workflow/rules").glob("*.smk"):
        rules.write_text(re.sub(r'    message:\n        ".*"\n', "", rules.read_text()))
    for name in ("config", "envs"):
        (folder / name).symlink_to(ROOT / name)
    for script in (ROOT / "scripts").rglob("*.py"):
        stub = folder / script.relative_to(ROOT)
        stub.parent.mkdir(parents=True, exist_ok=True)
        stub.write_text(STUB)
    return folder / "Snakefile"


class StubRun:
    """A project of photos with the object shed0, that a workflow of stubs works on."""

    def __init__(self, folder: Path, snakefile: Path) -> None:
        self.path, self.snakefile, self.settings = folder, snakefile, dict[str, object]()
        folder.mkdir(parents=True, exist_ok=True)
        self.project = Project(folder)
        self.project.clicked(1)
        self.project.config["scene"] = {"chunks": 1}
        self.set(masks={"method": "grabcut"})

    def set(self, **sections: object) -> None:
        """Change settings of objects."""
        self.settings |= sections
        self.project.config["object"] = self.settings
        self.config = self.project.write()

    def copy(self, folder: Path) -> "StubRun":
        """A copy of the project and of what it has made."""
        shutil.copytree(self.path, folder)
        other = copy.copy(self)
        other.path, other.settings, other.project = folder, dict(self.settings), copy.deepcopy(self.project)
        other.project.path, other.config = folder, folder / self.config.name
        return other

    def plant(self, job: str, fault: str) -> None:
        """Let a stage, named RULE-JOB, fail from now on; "" mends it."""
        (self.path / "faults").mkdir(exist_ok=True)
        (self.path / "faults" / job).write_text(fault)

    def command(self, *words: str) -> list[str]:
        """The command that runs the workflow."""
        where = ["--snakefile", str(self.snakefile), "--directory", str(self.path), "--configfile", str(self.config)]
        return [sys.executable, "-m", "snakemake", *where, "--cores", "2", *words]

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run the workflow."""
        if not (self.path / "jobs.json").is_file():
            self._list_jobs()
        env = os.environ | {"COLUMNS": "200", "PYTHONPATH": str(ROOT)}
        return subprocess.run(
            self.command(*words), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=env
        )

    def _list_jobs(self) -> None:
        """Write what each job reads and makes by its log, as a plan lists it."""
        (self.path / "jobs.json").write_text("{}")
        plan = self.run("-n", "--quiet", "progress").stdout
        jobs = re.findall(r"^ +input: (.+)\n +output: (.+)\n +log: (.+)$", plan, re.MULTILINE)
        files = {log: [part.split(", ") for part in parts] for *parts, log in jobs}
        (self.path / "jobs.json").write_text(json.dumps(files))

    def start(self) -> subprocess.Popen[str]:
        """Start the workflow in a process group of its own."""
        env = os.environ | {"COLUMNS": "200", "PYTHONPATH": str(ROOT)}
        return subprocess.Popen(
            self.command(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=env,
            start_new_session=True,
        )

    def outputs_of(self, job: str) -> list[str]:
        """What a stage, named RULE-JOB, makes."""
        rule, name = job.split("-", 1)
        return json.loads((self.path / "jobs.json").read_text())[f"results/logs/{rule}/{name}.log"][1]

    def results(self) -> dict[str, str]:
        """See `results_in`."""
        return results_in(self.path)


def results_in(folder: Path) -> dict[str, str]:
    """The hash of every file in results/, hidden ones too, but for logs, benchmarks and checkpoints."""
    files = (file for file in (folder / "results").rglob("*") if file.is_file())
    return {
        name: hashlib.sha256(file.read_bytes()).hexdigest()
        for file in files
        if (name := file.relative_to(folder / "results").as_posix()).split("/")[0] not in RECORDS
        and file.name != ".snakemake_timestamp"
    }
