"""Snakemake run by tests: plans in a forked copy of this process, which has imported it; runs in processes."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from snakemake.cli import main

ROOT = Path(__file__).resolve().parents[2]
PLANS = {"-n", "--dry-run", "--summary", "--touch", "--unlock", "--cleanup-metadata"}
"""Words with which Snakemake starts no job."""


def run_snakemake(cwd: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """The finished process, with all its output in `stdout`."""
    arguments = [str(word) for word in words]
    if PLANS & set(arguments):
        return _forked(cwd, arguments)
    env = os.environ | {"COLUMNS": "200", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "snakemake", *arguments]
    return subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=cwd, env=env)


def _forked(cwd: Path, arguments: list[str]) -> subprocess.CompletedProcess[str]:
    with tempfile.TemporaryFile() as output:
        child = os.fork()
        if child == 0:
            status = 1
            try:
                for stream in (1, 2):
                    os.dup2(output.fileno(), stream)
                sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
                os.environ["COLUMNS"] = "200"
                os.chdir(cwd)
                main(arguments)
            except SystemExit as end:
                status = end.code if isinstance(end.code, int) else int(bool(end.code and not print(end.code)))
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        output.seek(0)
        return subprocess.CompletedProcess(arguments, status, output.read().decode())
