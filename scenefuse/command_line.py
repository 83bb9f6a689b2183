"""The command `scenefuse`: its parts import what they run only when they are called."""

import argparse
import inspect
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from scenefuse.core.version import VERSION

ALL = "pip install 'scenefuse[all]'"
SCENES = Path("config/scenes.tsv")
REPORT = Path("results/summary/report.html")
# Snakemake's options that say how much runs at a time, or that another machine decides it.
PARALLEL = ("--cores", "-c", "--jobs", "-j", "--profile", "--workflow-profile", "--executor", "-e")


def main() -> None:
    """Run the part that the first word names with the others; an unknown one or none ends in a message and status 2."""
    parser = argparse.ArgumentParser(
        prog="scenefuse",
        description="Complete single objects in a drone reconstruction by close-up photos, or a cloud by another.",
        epilog="\n".join(f"{name:10}{(part.__doc__ or '').splitlines()[0]}" for name, part in PARTS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"scenefuse {VERSION}")
    parser.add_argument("part", choices=PARTS, help="what to do; scenefuse PART --help says more", metavar="PART")
    part = parser.parse_args(sys.argv[1:2]).part
    sys.argv = [f"scenefuse {part}", *sys.argv[2:]]
    # Ctrl-C ends imports without a traceback; what runs then handles it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        PARTS[part]()
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("scenefuse"):
            raise
        sys.exit(f"error: scenefuse {part} needs {error.name}, which is not installed; {ALL}")


def _register() -> None:
    """register one cloud with another, and fuse both"""
    from scenefuse.core.stage import run
    from scenefuse.two_clouds.register import register

    run(register)


def _nerf() -> None:
    """train a NeRF on posed photos"""
    from scenefuse.core.stage import run
    from scenefuse.nerf.train_nerf import train_nerf

    run(train_nerf)


def _pick() -> None:
    """open a page to click what an object is in its photos"""
    from scenefuse.core.stage import run
    from scenefuse.pick.pick import pick

    _need_project("--configfile", "-h", "--help")
    if not Path("Snakefile").is_file():
        sys.argv += _settings_files()[1]
    run(pick)


def _init() -> None:
    """make a folder for a project of your own"""
    from scenefuse.core.stage import run
    from scenefuse.new_project import init

    run(init)


def _need_project(*elsewhere: str) -> None:
    """Exit with a sentence where the folder holds no project and no option begins with one of these words."""
    from scenefuse.core.settings import ROOT

    if not (SCENES.is_file() or Path.cwd() == ROOT or any(word.startswith(elsewhere) for word in sys.argv[1:])):
        where = f"there is no {SCENES} here ({Path.cwd()})"
        sys.exit(f"error: {where}; run this in a project that scenefuse init FOLDER made, or give --configfile")


def _settings_files() -> tuple[list[Path], list[str]]:
    """The settings files of the command line, or the project's; and the words that name the latter to Snakemake."""
    from scenefuse.core.settings import OWN_SETTINGS

    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--configfile", "--configfiles", nargs="+", type=Path, default=[])
    parser.add_argument("--directory", "-d", type=Path, default=Path())
    words = parser.parse_known_args(sys.argv[1:])[0]
    given, file = words.configfile, words.directory / OWN_SETTINGS
    # Snakemake refuses a file without keys, as one is whose only line was commented out.
    has_own = file.is_file() and re.search(r"^[^#\s]", file.read_text(errors="replace"), re.MULTILINE)
    own = [file] if has_own and not given else []
    return given or own, ["--configfile", *map(str, own)] if own else []


def _export() -> None:
    """make what is handed over of finished objects: surfaces, drawings, cameras, tiles, a PDF"""
    from scenefuse.core.project import read_project
    from scenefuse.core.settings import read_settings
    from scenefuse.core.stage import StageError

    parser = argparse.ArgumentParser(
        prog="scenefuse export",
        description="Make surfaces, drawings, cameras, tiles and a PDF of finished objects, shown in the report."
        " Nothing before them runs again.",
        epilog="All other options are those of scenefuse run, as -n to see what would be made.",
    )
    parser.add_argument("--what", nargs="+", choices=EXPORTS, default=list(EXPORTS), help="default: all of them")
    parser.add_argument("--object", nargs="+", dest="names", metavar="NAME", help="default: all that are finished")
    facade = "three points of a facade of one object, to draw it as well"
    parser.add_argument("--facade", nargs=9, type=float, metavar=("X", "Y", "Z") * 3, help=facade)
    parser.add_argument("--zip", type=Path, metavar="FILE", help="and all of it with the report in one file to send")
    words, others = parser.parse_known_args(sys.argv[1:])
    try:
        project = read_project(read_settings(*_settings_files()[0]))
    except StageError as error:
        sys.exit(f"error: {error}")
    # Results of rows that were removed or renamed stay.
    finished, missing = (
        [name for name in names if Path(f"results/objects/{name}/fused.ply").is_file() == there]
        for names, there in ((project.objects, True), (words.names or (), False))
    )
    if missing or not finished:
        which = f"results/objects/{missing[0]}/fused.ply is not" if missing else "no results/objects/NAME/fused.ply is"
        sys.exit(f"error: {which} here ({Path.cwd()}); run the workflow first (scenefuse run)")
    names = sorted(words.names or finished)
    if words.zip and not REPORT.is_file():
        sys.exit(f"error: --zip needs {REPORT}, which is not here; run the workflow to its end first (scenefuse run)")
    if words.facade:
        if len(names) > 1:
            sys.exit("error: --facade is of one object; name it by --object")
        import numpy as np

        from scenefuse.core.transforms import along_a_line

        # Once they are kept, every export draws them.
        if along_a_line(np.reshape(words.facade, (3, 3))):
            sys.exit("error: the three points of --facade lie in a line; click three of its corners")
        Path(f"results/objects/{names[0]}/facade.txt").write_text(" ".join(map(str, words.facade)))
    scenes = sorted(name for name in project.scenes if Path(f"results/scenes/{name}/dense.ply").is_file())
    # Given clouds have no cameras, and a scene that was not completed has no tiles.
    needed = {"cameras": "results/*/*/undistorted", "tiles": "results/scenes/*/completed.ply", "pdf": str(REPORT)}
    what = [item for item in words.what if any(Path().glob(needed.get(item, "*")))]
    targets = {EXPORTS[item].format(object=name, scene=scene) for item in what for name in names for scene in scenes}
    targets = {t for t in targets if not t.endswith("/tiles") or Path(t).with_name("completed.ply").is_file()}
    run = [sys.executable, "-m", "scenefuse", "run"]
    rules = ["make_surface", "draw_surface", "export_cameras", "make_tiles", "write_pdf"]
    ended = subprocess.run([*run, *sorted(targets), *others, "--allowed-rules", *rules]).returncode
    if ended or {"-n", "--dry-run", "--dryrun"} & set(others):
        sys.exit(ended)
    name, scene = ("{" + ",".join(found) + "}" if len(found) > 1 else found[0] for found in (names, scenes))
    print("Export:", ", ".join(EXPORTS[item].format(object=name, scene=scene) for item in what), flush=True)
    if REPORT.is_file():
        from scenefuse.report.facts import closing_lines

        # The page shows what was exported. A run that makes it says where it is.
        shown = REPORT.stat().st_mtime
        page = [*run, str(REPORT), *others, "--quiet", "all", "--allowed-rules", "write_report"]
        ended = subprocess.run(page).returncode
        if not ended and REPORT.stat().st_mtime == shown:
            print(closing_lines(REPORT.parent), flush=True)
    if words.zip and not ended:
        from scenefuse.report.pack import write_zip

        try:
            write_zip(REPORT, map(Path, targets), words.zip)
        except OSError as error:
            sys.exit(f"error: {error}")
        print(f"To send: {words.zip} ({words.zip.stat().st_size / 1e6:.0f} MB); unpacked, open its {REPORT.name}")
    sys.exit(ended)


def _run() -> None:
    """run the workflow in this folder, by Snakemake and with its options

    usage: scenefuse run [FILE ...] [OPTION ...]    in the folder of a project

    Makes what is missing or no longer up to date: all, or the given files, as results/objects/NAME/fused.ply.

      -n, --dry-run            say what would run, and why
      --cores N                processor cores; all, where it is left out
      --configfile FILE ...    settings in place of config/config.yaml
      --directory FOLDER       the project, where it is not this folder
      --forcerun RULE ...      make the outputs of a rule again
      --until RULE ...         stop after a rule
      --resources mem_mb=N     use no more memory than this
      --profile FOLDER         on a cluster
      --printshellcmds         print the command of each job
      --report FILE.html       no run; a report of what made the results
      --unlock                 go on after a run that was killed
      --version                of Snakemake

    All options are Snakemake's: python -m snakemake --help
    """
    from scenefuse.complete import snakemake_command
    from scenefuse.core.stage import StageError

    if find_spec("snakemake") is None:
        raise ModuleNotFoundError(name="snakemake")
    if {"-h", "--help"} & set(sys.argv):
        print(inspect.getdoc(_run))
        return
    # Options of Snakemake that say where the project is, or that none is needed.
    _need_project("--config", "--directory", "-d", "--version")
    files, own = _settings_files()
    own += [] if any(word.startswith(PARALLEL) for word in sys.argv[1:]) else ["--cores", "all"]
    try:
        command = snakemake_command([*sys.argv[1:], *own], files)
    except StageError as error:
        sys.exit(f"error: {error}")
    # The process becomes Snakemake: signals and the exit status are its own.
    os.execv(sys.executable, command)


def _complete() -> None:
    """complete objects in a scene: photos in, the completed cloud and a report out"""
    from scenefuse.complete import complete
    from scenefuse.core.stage import run

    if find_spec("snakemake") is None:
        raise ModuleNotFoundError(name="snakemake")
    run(complete)


# What is handed over.
EXPORTS = {
    "surface": "results/objects/{object}/surface.glb",
    "drawings": "results/objects/{object}/drawings",
    "cameras": "results/scenes/{scene}/cameras",
    "tiles": "results/scenes/{scene}/tiles",
    "pdf": "results/summary/report.pdf",
}
PARTS: dict[str, Callable[[], None]] = {
    "complete": _complete,
    "register": _register,
    "init": _init,
    "pick": _pick,
    "run": _run,
    "export": _export,
    "nerf": _nerf,
}
