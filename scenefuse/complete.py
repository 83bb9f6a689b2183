"""`scenefuse complete`: from photos or videos to the completed scene; the same command again goes on."""

import contextlib
import fcntl
import os
import re
import signal
import subprocess
import sys
import time
import webbrowser
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from scenefuse.core.job_records import KILLED, last_error
from scenefuse.core.machine import has_screen
from scenefuse.core.settings import OWN_SETTINGS, PACKAGE, ROOT, read_differences
from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_cells, read_table
from scenefuse.marks.clicks import check_marks
from scenefuse.new_project import OBJECTS, SCENES, cell_of, default_name, fill, is_cloud, make_project, project_rows
from scenefuse.report.facts import closing_lines
from scenefuse.report.forecast import FORECAST, duration, read_forecast, seconds_left

LOG, SUMMARY = Path("results/logs/run.log"), Path("results/summary")
# Lines of a run that people want to see, or that say why it failed.
JOB, FORECAST_LINE = re.compile(r"Job \d+: (.+)"), re.compile("(time|memory|disk): .+")
FAILED_LOG = re.compile(r"Logfile (results/logs/\S+/(\S+)\.log):")
ERROR, CLOSING = re.compile(r"\w*(Error|Exception)\b.*:"), "Result: "
FAILED = tuple(map(re.compile, ("failed: (.*)", "error: (.*)", "(another run works .*)")))
Preset = Literal["draft", "normal", "high"]
Folder = tyro.conf.Positional[Path]


def _shown(metavar: str | None = None) -> Any:
    """How the help shows an argument: under this name, without its default."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint="")


def complete(
    flight: Annotated[Folder, _shown("FLIGHT")],
    house: Annotated[Folder, _shown("HOUSE")],
    others: Annotated[tyro.conf.Positional[tuple[Path, ...]], _shown("[SHED ...]")] = (),
    *,
    out: Annotated[Path | None, _shown("FOLDER")] = None,
    prompts: Annotated[tuple[Path, ...], _shown("FILE ...")] = (),
    masks: Annotated[tuple[Path, ...], _shown("FOLDER ...")] = (),
    preset: Annotated[Preset | None, _shown()] = None,
    cores: Annotated[int | None, _shown("N")] = None,
    no_browser: Annotated[tyro.conf.UseCounterAction[int], _shown()] = 0,
) -> None:
    """Complete objects in a drone reconstruction: makes a project, opens the page to click on each object, runs the
    workflow, and opens the report. The same command again goes on where it was left.

    Args:
        flight: photos of the scene (a folder or a video), or its cloud.
        house: close-up photos of an object in it, likewise.
        others: the same of more objects.
        out: folder of the project; where it is left out, FLIGHT_completed.
        prompts: tables of clicks (label, photo, x_px, y_px, tab-separated), one for each object with photos in its
            order, in place of the page.
        masks: folders of masks, likewise, named like its photos; white is the object.
        preset: of a new project: settings for a first look, the shipped ones (normal, where it is left out), or larger
            ones for a GPU.
        cores: processor cores; where it is left out, all.
        no_browser: open neither the page nor the report.

    Raises:
        StageError: a folder is not what it should be, an object has no clicks, or the run failed.
    """
    objects, shows = (house, *others), has_screen() and not no_browser
    project, files = out or Path(f"{default_name(flight)}_completed"), {"prompts": prompts, "masks": masks}
    photographed = [path for path in objects if not is_cloud(path)]
    _check_options(files, len(photographed), cores)
    _make_or_go_on(project, flight, objects, preset)
    for column, given in files.items():
        if given:
            cells = {default_name(o): cell_of(path, project) for o, path in zip(photographed, given)}
            fill(project / OBJECTS, column, cells)
    masked = [name for name, row in read_table(project / OBJECTS, "object").items() if row.get("masks")]
    if prompts and not masks and masked:
        # An earlier run's masks would go before these clicks.
        fill(project / OBJECTS, "masks", dict.fromkeys({*masked} & {*map(default_name, photographed)}, ""))
    for name in _without_clicks(project, cores):
        _click(project, name, shows)
    _run_workflow(project, [], cores)
    print(closing_lines(project / SUMMARY), flush=True)
    if shows:
        webbrowser.open((project / SUMMARY / "report.html").resolve().as_uri())


def _make_or_go_on(project: Path, flight: Path, objects: Sequence[Path], preset: Preset | None) -> None:
    """Make the project, where it is not there yet; objects beside all that it has are added.

    Raises:
        StageError: the folder holds another project.
    """
    if not (project / SCENES).is_file():
        make_project(project, flight, objects, preset or "normal")
        return
    for table, rows in project_rows(project, flight, objects).items():
        kind = table.stem.removesuffix("s")
        there = read_table(project / table, kind)
        new = [row for row in rows if row[kind] not in there]
        known = [(row, there[row[kind]]) for row in rows if row[kind] in there]
        differs = any(held.get(key) != row[key] for row, held in known for key in row if key != "prompts")
        if differs or (new and (kind == "scene" or len(known) < len(there))):
            more = "" if differs or kind == "scene" else f"; to add {new[0][kind]} to these, give their folders as well"
            raise StageError(
                f"{project} holds another project ({kind}s: {', '.join(there)}); give another folder by --out, or,"
                f" where these have moved, correct {project / table}{more}"
            )
        for added in new:
            for column, cell in added.items():
                fill(project / table, column, {added[kind]: cell})
    print(f"Going on with {project}", flush=True)
    if preset:
        print(
            f"--preset {preset} is left out: the settings of this project are in {project / OWN_SETTINGS}", flush=True
        )


def _check_options(files: Mapping[str, Sequence[Path]], objects: int, cores: int | None) -> None:
    """StageError where an option cannot be used: before anything is made, so that a corrected command starts anew."""
    for column, given in files.items():
        if given and len(given) != objects:
            raise StageError(
                f"--{column} names {len(given)} for {objects} objects with photos; give one for each, in their order"
            )
        missing = next((path for path in given if not path.exists()), None)
        if missing is not None:
            raise StageError(f"{missing} does not exist; correct --{column}")
    for path in files["prompts"]:
        check_marks(path)
    most = os.cpu_count() or 1
    if cores is not None and not 1 <= cores <= most:
        raise StageError(f"--cores {cores} cannot be had; give 1 to {most}, or leave it out for all")


def _without_clicks(project: Path, cores: int | None) -> list[str]:
    """Names of the objects that nothing says yet what they are; of a video, its frames are there then."""
    found = []
    for name, row in read_table(project / OBJECTS, "object").items():
        clicks = project / (row.get("prompts") or f"config/{name}_prompts.tsv")
        # A cloud with its cameras is cut by clicks, if there are any.
        needed = row.get("photos") and not row.get("masks") and (row.get("prompts") or not row.get("cloud"))
        if needed and not (clicks.is_file() and len(read_cells(clicks)) > 1):
            found.append(name)
            if (project / row["photos"]).is_file():
                # Those of a video that was replaced since are made anew.
                _run_workflow(project, [f"results/objects/{name}/photos.json"], cores)
    return found


def _click(project: Path, name: str, shows: bool) -> None:
    """Let a person click on an object, in a page that ends by its button.

    Raises:
        StageError: nobody can, or nobody did.
    """
    by_file = (
        f"give its clicks by --prompts FILE or its masks by --masks FOLDER ({project / 'README.md'} says how), or run"
        f" scenefuse pick in {project} and open the address that it prints from a computer with a screen"
    )
    if not shows and not sys.stdin.isatty():
        raise StageError(f"{name} has no clicks yet, and there is no screen to click on; {by_file}")
    print(f"{name}: click on it in the page{'' if shows else f' below; without a browser, {by_file}'}", flush=True)
    command = [sys.executable, "-m", "scenefuse", "pick", "--object", name, *([] if shows else ["--no-browser"])]
    if subprocess.run(command, cwd=project, env=_environment()).returncode or name in _without_clicks(project, None):
        raise StageError(f"{name} has no clicks yet; run the same command again and click on it, or {by_file}")


def snakemake_command(words: Sequence[str], configfiles: Iterable[Path]) -> list[str]:
    """The command that runs the workflow by Snakemake, with its options; settings files are checked before.

    Raises:
        StageError: a settings file cannot be read, or holds what it may not.
    """
    for path in configfiles:
        if path.is_file() and b"__use_yte__" in path.read_bytes():
            raise StageError(f"{path} asks Snakemake to run Python in it; remove __use_yte__")
        read_differences(path)
    # As `python -m snakemake`, but its help and errors name the command that was typed.
    start = "import sys; sys.argv[0] = 'scenefuse run'; from snakemake.cli import main; main()"
    return [sys.executable, "-c", start, "--snakefile", str(ROOT / "Snakefile"), *words]


def _environment() -> dict[str, str]:
    """This process's, in which this library is found from every folder."""
    return os.environ | {
        "PYTHONPATH": os.pathsep.join(filter(None, [str(PACKAGE.parent), os.environ.get("PYTHONPATH")]))
    }


def _run_workflow(project: Path, targets: list[str], cores: int | None) -> None:
    """Run the workflow; a line for each step, what else Snakemake says goes into a file.

    Raises:
        StageError: it failed.
    """
    cores = cores or os.cpu_count() or 1
    # Snakemake refuses a file without keys.
    own = ["--configfile", str(OWN_SETTINGS)] if read_differences(project / OWN_SETTINGS) else []
    words = [*own, "--cores", str(cores), *targets]
    command, log = snakemake_command(words, [project / OWN_SETTINGS]), project / LOG
    log.parent.mkdir(parents=True, exist_ok=True)
    print(f"Running on {cores} {'core' if cores == 1 else 'cores'}; all that Snakemake says: {log}", flush=True)
    started = time.time()
    with open(log, "a") as written, open(log, errors="replace") as read:
        try:
            fcntl.flock(written, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StageError(f"another run works in {project}; wait until it ends, or stop it") from None
        written.truncate(0)
        # In a session of its own, so that Ctrl-C reaches it once, from here.
        process = subprocess.Popen(
            command, cwd=project, env=_environment(), stdout=written, stderr=subprocess.STDOUT, start_new_session=True
        )
        try:
            ended = False
            while not ended:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=1)
                    ended = True
                for line in read:
                    report_step(project, line.rstrip(), started, cores)
        except BaseException:
            # Its jobs, too, as a terminal does: Snakemake waits for them until they end by themselves.
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
            process.wait()
            raise
    if process.returncode:
        lines = log.read_text(errors="replace").splitlines()
        if any(line.startswith(CLOSING) for line in lines):
            print(closing_lines(project / SUMMARY), flush=True)
        raise StageError(f"{_why(lines)}; all that Snakemake says: {log}")


def report_step(project: Path, line: str, started: float, cores: int) -> None:
    """Print a line of a run's log, if it says what a run will take, that a job starts, or that one failed."""
    job, failed = JOB.fullmatch(line), FAILED_LOG.fullmatch(line)
    if FORECAST_LINE.fullmatch(line):
        print(line[0].upper() + line[1:], flush=True)
    elif job:
        planned = read_forecast(project / "results/logs" / FORECAST)
        left = duration(seconds_left(planned, project, started, cores))
        print(f"{time.strftime('%H:%M')} {job[1]}; about {left} left", flush=True)
    elif failed and (project / failed[1]).is_file():
        why = last_error(project / failed[1]) or KILLED
        print(f"{time.strftime('%H:%M')} {failed[2]} failed: {why} [{project / failed[1]}]", flush=True)


def _why(lines: Sequence[str]) -> str:
    """Why a run failed, from its log: the jobs that failed, else the first error."""
    for pattern in FAILED:
        said = [found[1] for line in lines if (found := pattern.fullmatch(line))]
        if said:
            return "; ".join(said)
    first = next((at + 1 for at, line in enumerate(lines[:-1]) if ERROR.fullmatch(line)), None)
    if first is None:
        return "Snakemake ended early"
    # Indented lines say which files are meant.
    below = takewhile(lambda line: line.startswith(" "), lines[first + 1 :])
    return " ".join([lines[first], *map(str.strip, below)])
