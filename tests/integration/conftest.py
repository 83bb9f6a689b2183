import subprocess
from pathlib import Path

import pytest
from support.snakemake_runs import ROOT, run_snakemake
from support.user_project import Project


@pytest.fixture(scope="session")
def snakemake():
    """Run Snakemake on the project in another working directory; returns the finished process with all its output."""

    def call(
        directory: Path, *words: str, config: Path = ROOT / "tests/data/tiny.yaml"
    ) -> subprocess.CompletedProcess[str]:
        # One core: tests run beside each other.
        where = ["--snakefile", ROOT / "Snakefile", "--directory", directory, "--configfile", config, "--cores", "1"]
        return run_snakemake(ROOT, *where, *words)

    return call


@pytest.fixture
def project(tmp_path):
    return Project(tmp_path)
