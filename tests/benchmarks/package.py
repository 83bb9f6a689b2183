"""The package in an empty environment: its sizes, its import, and two clouds registered without the repository.

PYTHONPATH=tests python tests/benchmarks/package.py
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from support.planted import plant

from scenefuse.cloud.clouds import write_cloud
from scenefuse.core.stage import run

ROOT = Path(__file__).resolve().parents[2]
IMPORT = "import scenefuse.two_clouds.find"


def package(*, runs: int = 3, largest: int = 4) -> None:
    """Build a wheel of what git has here, install it alone, and print sizes and seconds.

    Args:
        runs: of which the quickest counts.
        largest: folders of the environment that are listed.
    """
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        _call("git", "clone", "--quiet", ROOT, work / "source")
        _call(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", work, work / "source")
        wheel = next(work.glob("*.whl"))
        _call(sys.executable, "-m", "venv", work / "environment")
        python, sites = work / "environment/bin/python", next(work.glob("environment/lib/*/site-packages"))
        empty = _megabytes(sites)
        _call(python, "-m", "pip", "install", "--quiet", wheel)
        parts = sorted(((_megabytes(path), path.name) for path in sites.iterdir() if path.is_dir()), reverse=True)
        print(f"wheel {_megabytes(wheel):.1f} MB; installed {_megabytes(sites) - empty:.0f} MB, of it", end=" ")
        print(", ".join(f"{name} {size:.0f}" for size, name in parts[:largest]))
        for text, words in (
            ("import", (python, "-c", IMPORT)),
            ("command", (python.with_name("scenefuse"), "register", "--help")),
        ):
            print(f"{text} {min(_seconds(words, work)[0] for _ in range(runs)):.1f} s")
        trial = plant("house", 5, ground=False, noise=0.005, object_points=6000, density_ratio=1.0)
        write_cloud(work / "house.ply", trial.object)
        write_cloud(work / "yard.ply", trial.scene)
        command = (python.with_name("scenefuse"), "register", "--object", "house.ply", "--scene", "yard.ply", "--fuse")
        seconds, processor = _seconds(command, work)
        points = f"{len(trial.object.points)} in {len(trial.scene.points)} points"
        print(f"register --fuse, {points}: {seconds:.1f} s, {processor:.1f} s of processor time")


def _call(*words: object) -> None:
    subprocess.run(list(map(str, words)), check=True)


def _seconds(words: tuple[object, ...], folder: Path) -> tuple[float, float]:
    """Seconds of a command by the clock and of the processors; outside the repository, without its path."""
    env = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    used, start = _processor_seconds(), time.monotonic()
    subprocess.run(list(map(str, words)), cwd=folder, env=env, check=True, stdout=subprocess.DEVNULL)
    return time.monotonic() - start, _processor_seconds() - used


def _processor_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _megabytes(path: Path) -> float:
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return sum(file.stat().st_size for file in files) / 1e6


if __name__ == "__main__":
    run(package)
