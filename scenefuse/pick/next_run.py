"""What the workflow will make of the tables: the next command, and which rules it will run, by a dry run."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

from scenefuse.core.settings import ROOT

TIME_LIMIT_S = 300
OWN_SETTINGS = "config/config.yaml"
"""What `scenefuse run` reads without being told."""


def command(configfiles: tuple[Path, ...], target: str) -> list[str]:
    """The command line that makes a target, as a person types it in the working directory."""
    words = ["snakemake"]
    if not Path("Snakefile").is_file():
        words += ["--snakefile", str(ROOT / "Snakefile")]
    if configfiles:
        words += ["--configfile", *map(str, configfiles)]
    return [*words, "--cores", "2", target]


def as_text(words: list[str]) -> str:
    """A command line of `command` to be pasted into a shell, as who started the page by `scenefuse pick` knows it."""
    if Path(sys.argv[0]).name.startswith("scenefuse"):
        shipped = ["--snakefile", str(ROOT / "Snakefile")]
        own = ["--configfile", OWN_SETTINGS, "--cores"]
        rest = words[3:] if words[1:3] == shipped else words[1:]
        words = ["scenefuse", "run", *(rest[2:] if rest[:3] == own else rest)]
    return shlex.join(words)


def planned_rules(words: list[str]) -> tuple[dict[str, int], str]:
    """Rules that a command would run now and how often each, and why that cannot be said; "" where it can.

    Nothing is run or locked.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-m", *words, "--dry-run", "--nolock"],
            capture_output=True,
            text=True,
            timeout=TIME_LIMIT_S,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return {}, f"the dry run did not end: {error}"
    if done.returncode:
        lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        return {}, " ".join(lines[-6:])
    table = re.findall(r"^([a-z0-9_]+) +(\d+)$", done.stdout + done.stderr, re.MULTILINE)
    return {rule: int(count) for rule, count in table if rule != "total"}, ""
