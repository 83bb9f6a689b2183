"""Snakemake run by tests in a forked copy of this process, which has imported it."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from snakemake.cli import main

ROOT = Path(__file__).resolve().parents[2]


def run_snakemake(cwd: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """The finished process, with all its output in `stdout`."""
    arguments = [str(word) for word in words]
    with tempfile.TemporaryFile() as output:
        child = os.fork()
        if child == 0:
            status = 1
            try:
                for stream in (1, 2):
                    os.dup2(output.fileno(), stream)
                sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
                os.environ |= {"COLUMNS": "200", "PYTHONPATH": str(ROOT)}
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
