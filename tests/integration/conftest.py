import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.user_project import Project

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def snakemake():
    """Run Snakemake on the project in another working directory; returns the finished process with all its output."""

    def call(
        directory: Path, *words: str, config: Path = ROOT / "tests/data/tiny.yaml"
    ) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "snakemake", "--snakefile", ROOT / "Snakefile", "--directory", directory]
        command += ["--configfile", config, "--cores", "2", *words]
        return subprocess.run(
            list(map(str, command)),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=ROOT,
            env=os.environ | {"COLUMNS": "200"},
        )

    return call


@pytest.fixture
def project(tmp_path):
    return Project(tmp_path)
