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


def why_unfinished(jobs: JobRecords, *names: str) -> str:
    """Why jobs stopped: the last error line of the newest unfinished log that holds one.

    A job that was killed, out of memory for instance, leaves a log without an error. "" when every job that left a
    log has finished.

    Args:
        jobs: where the records are.
        names: of logs, {name}.log, in the order in which they are searched; after them, all whose name holds the first.
    """
    named = re.compile(rf"(^|[^A-Za-z0-9_]){re.escape(names[0])}($|[^A-Za-z0-9_])")
    logs = [p for p in jobs.logs.rglob("*.log") if not _finished(p, jobs)]
    logs.sort(key=lambda p: (p.stat().st_mtime, p.as_posix()), reverse=True)
    exact = ([p for p in logs if p.stem == name] for name in names)
    for found in (*exact, [p for p in logs if named.search(p.relative_to(jobs.logs).as_posix())]):
        if found:
            return next(filter(None, (_error(p, jobs) for p in found)), "") or (
                "its job ended without a message: perhaps killed (out of memory?);"
                f" see the log [{found[0].relative_to(jobs.logs).as_posix()}]"
            )
    return ""


def _error(log: Path, jobs: JobRecords) -> str:
    """The last error line of a log, and the log; "" without one."""
    lines = log.read_text(errors="replace").splitlines()
    errors = [line.strip() for line in lines if re.match(r"\s*(error:|[\w.]*(Error|Exception)\b)", line)]
    return f"{errors[-1].removeprefix('error: ')} [{log.relative_to(jobs.logs).as_posix()}]" if errors else ""


def _finished(log: Path, jobs: JobRecords) -> bool:
    benchmark = jobs.benchmarks / log.relative_to(jobs.logs).with_suffix(".tsv")
    return benchmark.is_file() and benchmark.stat().st_mtime >= log.stat().st_mtime
