"""What the jobs' logs say of how they ended; a rule's log and benchmark share their path below two folders."""

import re
from dataclasses import dataclass
from pathlib import Path

from scenefuse.core.stage import lack_in

ERROR = re.compile(r"\s*(error:|[\w.]*(Error|Exception)\b)")
KILLED = (
    "its job ended without a message: it was stopped, or killed because memory ran out; run again to go on, with other"
    " programs ended or a higher memory limit"
)
NOT_ACCEPTED = "its job ended well, but Snakemake refused its outputs for the reason printed above"
NO_LOG = (
    "its job left no log: the machine that ran it may not see this folder or this environment; see the scheduler's log"
)


@dataclass(frozen=True)
class JobRecords:
    """Where the workflow records its jobs."""

    logs: Path
    """Folder of the rules' logs, {rule}/{job}.log."""
    benchmarks: Path
    """Folder of the benchmark files, {rule}/{job}.tsv; a job that ends well leaves one newer than its log."""
    failed_logs: tuple[Path, ...] = ()
    """Logs of the jobs that failed in this run, where they are known; other logs may be of earlier runs."""


def why_unfinished(jobs: JobRecords, *names: str) -> str:
    """Why jobs stopped: the last error line of a job that failed, or of the newest unfinished log that holds one.

    A job that was killed, out of memory for instance, leaves a log without an error. "" when every job that left a
    log has finished.

    Args:
        jobs: where the records are.
        names: of logs, {name}.log, in the order in which they are searched; after them, all whose name holds the first.
    """
    named = re.compile(rf"(^|[^A-Za-z0-9_]){re.escape(names[0])}($|[^A-Za-z0-9_])")
    unfinished = [p for p in jobs.logs.rglob("*.log") if not _finished(p, jobs)]
    unfinished.sort(key=lambda p: (p.stat().st_mtime, p.as_posix()), reverse=True)
    for logs in ([p for p in jobs.failed_logs if p.is_file()], unfinished):
        exact = ([p for p in logs if p.stem == name] for name in names)
        for found in (*exact, [p for p in logs if named.search(p.relative_to(jobs.logs).as_posix())]):
            if found:
                log = next(filter(last_error, found), found[0])
                return f"{last_error(log) or KILLED} [{log.relative_to(jobs.logs).as_posix()}]"
    return ""


def why_ended(log: Path, benchmark: Path, started: float) -> str:
    """Why a job of this run failed, whatever earlier runs left.

    Args:
        log: of the job.
        benchmark: of the job.
        started: time of the file system when the run began, in seconds.
    """
    if not log.is_file() or log.stat().st_mtime < started:
        return NO_LOG
    return last_error(log) or (NOT_ACCEPTED if _is_newer(benchmark, log) else KILLED)


def last_error(log: Path) -> str:
    """The last error line of a log; "" without one."""
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines()]
    # A library that lacks memory or room may end the process.
    errors = [line for line in lines if ERROR.match(line)] or [line for line in lines if lack_in(line)]
    if not errors:
        return ""
    last = errors[-1]
    if last.startswith("error: "):
        return last.removeprefix("error: ")
    return lack_in(last) or last


def _finished(log: Path, jobs: JobRecords) -> bool:
    return _is_newer(jobs.benchmarks / log.relative_to(jobs.logs).with_suffix(".tsv"), log)


def _is_newer(benchmark: Path, log: Path) -> bool:
    return benchmark.is_file() and benchmark.stat().st_mtime >= log.stat().st_mtime
