"""The command `scenefuse`: its parts import what they run only when they are called."""

import argparse
import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

from scenefuse.core.version import VERSION

ALL = "pip install 'scenefuse[all]'"
OWN_SETTINGS, SCENES = Path("config/config.yaml"), Path("config/scenes.tsv")


def main() -> None:
    """Run the part that the first word names with the others; an unknown one or none ends in a message and status 2."""
    parser = argparse.ArgumentParser(
        prog="scenefuse",
        description="Complete single objects in a drone reconstruction by close-up photos, or a cloud by another.",
        epilog="\n".join(f"{name:10}{part.__doc__}" for name, part in PARTS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"scenefuse {VERSION}")
    parser.add_argument("part", choices=PARTS, help="what to do; scenefuse PART --help says more", metavar="PART")
    part = parser.parse_args(sys.argv[1:2]).part
    sys.argv = [f"scenefuse {part}", *sys.argv[2:]]
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
    if _takes_own_settings() and not Path("Snakefile").is_file():
        sys.argv += ["--configfile", str(OWN_SETTINGS)]
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


def _takes_own_settings() -> bool:
    """Whether the project has settings of its own, and no others are given."""
    return OWN_SETTINGS.is_file() and not any(word.startswith("--configfile") for word in sys.argv[1:])


def _configfiles() -> list[str]:
    """The files after --configfile, or --configfiles; its values go on up to the next option."""
    found, taking = list[str](), False
    for word in sys.argv[1:]:
        name, equals, given = word.partition("=")
        if word.startswith("-"):
            taking = name in ("--configfile", "--configfiles")
            found += [given] if taking and equals else []
        elif taking:
            found.append(word)
    return found


def _run() -> None:
    """run the workflow in this folder, by Snakemake and with its options"""
    from scenefuse.core.settings import ROOT

    if find_spec("snakemake") is None:
        raise ModuleNotFoundError(name="snakemake")
    # Options of Snakemake that say where the project is, or that none is needed.
    _need_project("--config", "--directory", "-d", "-h", "--help", "--version")
    own = ["--configfile", str(OWN_SETTINGS)] if _takes_own_settings() else []
    for path in [*_configfiles(), *own[1:]]:
        if not Path(path).is_file():
            sys.exit(f"error: the settings file {path} cannot be read; correct its path")
        if b"__use_yte__" in Path(path).read_bytes():
            sys.exit(f"error: {path} asks Snakemake to run Python in it; remove __use_yte__ (docs/trust.md)")
    words = [*own, *sys.argv[1:]]
    # As `python -m snakemake`, but its help and errors name the command that was typed.
    start = "import sys; sys.argv[0] = 'scenefuse run'; from snakemake.cli import main; main()"
    command = [sys.executable, "-c", start, "--snakefile", str(ROOT / "Snakefile"), *words]
    # The process becomes Snakemake: signals and the exit status are its own.
    os.execv(sys.executable, command)


PARTS: dict[str, Callable[[], None]] = {
    "register": _register,
    "init": _init,
    "pick": _pick,
    "run": _run,
    "nerf": _nerf,
}
