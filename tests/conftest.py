"""Options of the test run: `--part masks` selects the files of tests that reach a part of the library, and
`--serial-kernels` compiles Numba's kernels for one thread, which takes half as long."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from scenefuse.core.fingerprint import reached
from scenefuse.core.machine import has_gpu

ROOT = Path(__file__).resolve().parents[1]

# Workers of pytest share the cores: libraries, which read these when they are imported, start no threads beside them.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(name, "1")

# Without a GPU, Triton's interpreter runs the GPU kernels; it reads this when they are imported.
if not has_gpu():
    os.environ["TRITON_INTERPRET"] = "1"

# Cases that each fuzz test makes up; `make fuzz` chooses the second.
CHECKS = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
settings.register_profile("few", max_examples=30, deadline=None, derandomize=True, suppress_health_check=CHECKS)
settings.register_profile("many", max_examples=1000, deadline=None, derandomize=True, suppress_health_check=CHECKS)
settings.load_profile("few")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--part", help="only tests that reach this package of the library, as fingerprints of jobs do")
    parser.addoption("--serial-kernels", action="store_true", help="Numba compiles no parallel loops")


def pytest_configure(config: pytest.Config) -> None:
    """Numba does not tell kernels for one thread from the others in its cache; they have another."""
    if config.getoption("--serial-kernels"):
        import numba

        numba.config.CACHE_DIR = str(Path(numba.config.CACHE_DIR or config.rootpath / ".pytest_cache") / "serial")
        njit = numba.njit
        numba.njit = lambda *function, parallel=False, **options: njit(*function, **options)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    part = config.getoption("--part")
    if not part or not collection_path.name.startswith("test_"):
        return None
    home = ROOT / "scenefuse" / part
    if not home.is_dir():
        raise pytest.UsageError(f"PART={part}: there is no package scenefuse/{part}")
    return True if not any(path.is_relative_to(home) for path in reached(collection_path, ROOT)) else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A browser is a process."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker("process")


@pytest.fixture(autouse=True, scope="session")
def unsynced() -> Iterator[None]:
    """Files are written without waiting for the disk: no power cut comes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield
