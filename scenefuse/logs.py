"""What the jobs' logs say of how they ended; a rule's log and benchmark share their path below two folders."""

import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class JobRecords:
    """Where the workflow records its jobs."""

    logs: Path
    """Folder of the rules' logs, {rule}/{job}.log."""
    benchmarks: Path
    """Folder of the benchmark files, {rule}/{job}.tsv; a job that ends well leaves one newer than its log."""


def why_unfinished(name: str, jobs: JobRecords) -> str:
    """Why the jobs of a scene or object stopped: the last error line of the newest unfinished log that holds one.

    A job that was killed, out of memory for instance, leaves a log without an error. "" when every job that left a
    log has finished.
    """
    named = re.compile(rf"(^|[^A-Za-z0-9_]){re.escape(name)}($|[^A-Za-z0-9_])")
    logs = (p for p in jobs.logs.rglob("*.log") if named.search(_job(p, jobs).as_posix()))
    unfinished = sorted((p for p in logs if not _finished(p, jobs)), key=lambda p: (p.stat().st_mtime, p.as_posix()))
    for path in reversed(unfinished):
        lines = path.read_text(errors="replace").splitlines()
        errors = [line.strip() for line in lines if re.match(r"\s*(error:|[\w.]*(Error|Exception)\b)", line)]
        if errors:
            return f"{errors[-1].removeprefix('error: ')} [{path.relative_to(jobs.logs).as_posix()}]"
    if not unfinished:
        return ""
    log = unfinished[-1].relative_to(jobs.logs).as_posix()
    return f"its job ended without a message: perhaps killed (out of memory?); see the log [{log}]"


def _job(log: Path, jobs: JobRecords) -> Path:
    """{rule}/{job} of a log."""
    return log.relative_to(jobs.logs).with_suffix("")


def _finished(log: Path, jobs: JobRecords) -> bool:
    job = _job(log, jobs)
    benchmark = jobs.benchmarks / job.parent / f"{job.name}.tsv"
    return benchmark.is_file() and benchmark.stat().st_mtime >= log.stat().st_mtime
