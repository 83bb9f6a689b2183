"""The command `scenefuse`: its parts import what they run only when they are called."""

import argparse
import inspect
import os
import re
import signal
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from scenefuse.core.stage import StageError, run
from scenefuse.core.version import VERSION

ALL = "pip install 'scenefuse[all]'"
SCENES = Path("config/scenes.tsv")
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
    from scenefuse.two_clouds.register import register

    run(register)


def _nerf() -> None:
    """train a NeRF on posed photos"""
    from scenefuse.nerf.train_nerf import train_nerf

    run(train_nerf)


def _pick() -> None:
    """open a page to click what an object is in its photos"""
    from scenefuse.pick.pick import pick

    _need_project("--configfile", "-h", "--help")
    if not Path("Snakefile").is_file():
        sys.argv += _settings_files()[1]
    run(pick)


def _init() -> None:
    """make a folder for a project of your own"""
    from scenefuse.new_project import init

    run(init)


def _need_project(*elsewhere: str) -> None:
    """Exit with a sentence where the folder holds no project and no option begins with one of these words."""
    from scenefuse.core.settings import ROOT

    folder = _given().directory.absolute()
    if not ((folder / SCENES).is_file() or folder == ROOT or any(word.startswith(elsewhere) for word in sys.argv[1:])):
        where = f"there is no {SCENES} here ({folder})"
        sys.exit(f"error: {where}; run this in a project of scenefuse complete or scenefuse init, or give --configfile")


def _given() -> argparse.Namespace:
    """The options of Snakemake that say where the project and its settings are."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--configfile", "--configfiles", nargs="+", type=Path, default=[])
    parser.add_argument("--directory", "-d", type=Path, default=Path())
    return parser.parse_known_args(sys.argv[1:])[0]


def _settings_files() -> tuple[list[Path], list[str]]:
    """The settings files of the command line, or the project's; and the words that name the latter to Snakemake."""
    from scenefuse.core.settings import OWN_SETTINGS

    words = _given()
    given, file = words.configfile, words.directory / OWN_SETTINGS
    # Snakemake refuses a file without keys, as one is whose only line was commented out.
    has_own = file.is_file() and re.search(r"^[^#\s]", file.read_text(errors="replace"), re.MULTILINE)
    own = [file] if has_own and not given else []
    return given or own, ["--configfile", *map(str, own)] if own else []


def _export() -> None:
    """make what is handed over of finished objects: surfaces, drawings, cameras, tiles, a PDF"""
    from scenefuse.export import export

    sys.exit(export(sys.argv[1:], _settings_files()[0]))


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

    if find_spec("snakemake") is None:
        raise ModuleNotFoundError(name="snakemake")
    if {"-h", "--help"} & set(sys.argv):
        print(inspect.getdoc(_run))
        return
    # Options of Snakemake that say what the project is, or that none is needed.
    _need_project("--config", "--version")
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

    if find_spec("snakemake") is None:
        raise ModuleNotFoundError(name="snakemake")
    run(complete)


PARTS: dict[str, Callable[[], None]] = {
    "complete": _complete,
    "register": _register,
    "init": _init,
    "pick": _pick,
    "run": _run,
    "export": _export,
    "nerf": _nerf,
}
