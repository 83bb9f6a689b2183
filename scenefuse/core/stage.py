"""What every stage shares: its command line, its errors, atomic outputs, JSON with units, hashes.

Nothing here imports more than the standard library, so that a stage that is told its input is bad says so at once.
"""

import contextlib
import ctypes
import dataclasses
import errno
import hashlib
import json
import os
import re
import shlex
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

# OpenMP's threads sleep while they wait, not spin: beside another process a training step takes a seventh of the time.
# The library reads it when it is loaded, which is after this module.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
OUT_OF_MEMORY = (
    "the memory, or a limit on it (ulimit -v, a container's), is too small; raise the limit, end other programs, or use"
    " fewer pixels (config/presets/draft.yaml)"
)
DISK_FULL = "the disk is full{}; free some space and run this again"
# What Python and the libraries say when memory or a thread cannot be had, also while they are loaded, or disk space.
LACKS = {
    OUT_OF_MEMORY: re.compile(
        "^MemoryError|bad_alloc|[Cc]annot allocate memory|can't allocate memory|failed to map segment"
        r"|ould not load.*llvm|Unable to allocate|can't start new thread|what\(\): +Resource temporarily unavailable"
    ),
    DISK_FULL.format(""): re.compile("out of disk space|No space left on device"),
}
# With less room a library may say that something else is wrong; records of jobs and logs take so much at least.
MIN_FREE_BYTES = 2**20
STOPPED = "from outside, as Ctrl-C or a time limit does; run again to go on"


class StageError(Exception):
    """Something a person has to mend. The message says what is wrong, where, and what to do."""


def setting(
    default: Any,
    *,
    unit: str = "",
    least: float | None = None,
    above: float | None = None,
    most: float | None = None,
) -> Any:
    """A field of a settings dataclass that a settings file may set; a field without it is a constant of the algorithm.

    The docstring below the field describes it. Schema and tables are generated from both (`workflow.settings`).

    Args:
        default: its value where nobody sets it.
        unit: of the value, "" for a pure number or a word.
        least, above: lower bound, included or not.
        most: upper bound, included.
    """
    bounds = {"minimum": least, "exclusiveMinimum": above, "maximum": most}
    about = {"unit": unit, "bounds": {key: bound for key, bound in bounds.items() if bound is not None}}
    return dataclasses.field(default=default, metadata={"setting": about})


def run(function: Callable[..., Any]) -> None:
    """Run a stage function as a command line built from its signature and docstring.

    A StageError, a full disk, too little memory or a file that may not be read or written ends in one sentence on
    stderr and exit status 1; a number that the function returns is the exit status. SIGTERM and SIGINT unwind the
    stack, so that temporary outputs are removed; the process also gets SIGTERM when its parent dies. A log of the
    workflow, which sets SCENEFUSE, begins with the command, to be pasted.
    """
    import tyro

    if "SCENEFUSE" in os.environ:
        print(shlex.join(["python", *sys.argv]), flush=True)

    _die_with_parent()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _exit_on_signal)
    try:
        named = [word.partition("=")[0] for word in sys.argv[1:] if word.startswith("--")]
        # tyro would take the last.
        if twice := next((name for name in named if named.count(name) > 1), ""):
            raise StageError(f"{twice} is given twice; give it once, with all its values")
        markers = (tyro.conf.FlagConversionOff, tyro.conf.OmitArgPrefixes, tyro.conf.DisallowNone)
        status = tyro.cli(function, config=markers)
    except SystemExit as stop:
        # tyro's, of words that it does not know.
        if stop.code == 2 and "SCENEFUSE" in os.environ:
            mixed = "two versions of scenefuse are mixed; install it again"
            print(f"error: the stage does not know its command's options (above): {mixed}", file=sys.stderr)
        raise
    except Exception as error:
        of_files = _of_files(error) if isinstance(error, OSError) else ""
        said = str(error) if isinstance(error, StageError) else of_files or lack_in(error)
        if not said:
            raise
        print(f"error: {said}", file=sys.stderr)
        sys.exit(1)
    if isinstance(status, int):
        sys.exit(status)


def _of_files(error: OSError) -> str:
    """What an error of the file system means to a person, in a sentence; "" for other errors."""
    # Not the temporary name.
    path = re.sub(r"/?\.[^/]*\.tmp-\d.*", "", str(error.filename or ""))
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return DISK_FULL.format(f" ({path})" if path else "")
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR) and error.filename is not None:
        why = (error.strerror or "not allowed").lower()
        return f"{path}: {why}; check the folder and who may write there"
    if error.errno == errno.ENAMETOOLONG:
        # Of a photo, the names of its folders are part of its copy's.
        return f"the name {Path(error.filename or '').name} is too long; shorten it, or the names of folders in it"
    return ""


def lack_in(said: BaseException | str | None) -> str:
    """What a library says to be lacking, by an error or one that it was raised from, or by a line; "" for nothing."""
    if isinstance(said, BaseException):
        line = f"{type(said).__name__}: {said}".removesuffix(": ")
        return lack_in(line) or lack_in(said.__cause__ or said.__context__)
    return next((f"{sentence} ({said})" for sentence, pattern in LACKS.items() if said and pattern.search(said)), "")


def _find_cause(error: Exception, folder: Path) -> None:
    """Raise what a library's error does not say: the folder cannot be written to, or its disk is full."""
    if isinstance(error, OSError | StageError):
        return
    number = 0
    if not os.access(folder, os.W_OK):
        number = errno.EROFS
    elif shutil.disk_usage(folder).free < MIN_FREE_BYTES:
        number = errno.ENOSPC
    if number:
        raise OSError(number, os.strerror(number), str(folder)) from error


def threads() -> int:
    """CPU threads this stage may use: OMP_NUM_THREADS (Snakemake sets it from `threads:`), else all cores."""
    value = os.environ.get("OMP_NUM_THREADS", "")
    return int(value) if value.isdigit() and int(value) > 0 else (os.cpu_count() or 1)


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary name with the same suffix; on success sync and rename it to `path`, else remove it.

    What else begins with the temporary name, a database's journals for instance, goes with it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.tmp-{os.getpid()}{path.suffix}")
    _remove_leftovers(path.parent, f".{path.stem}.tmp-", path.suffix)
    try:
        yield temporary
        _sync(temporary)
        os.replace(temporary, path)
        _sync(path.parent)
    except Exception as error:
        _find_cause(error, path.parent)
        raise
    finally:
        _remove_leftovers(path.parent, f".{path.stem}.tmp-", path.suffix)


@contextlib.contextmanager
def resumed_file(path: Path, *recipe: Any) -> Iterator[Path]:
    """Yield a file to work in; on success it becomes `path`, and on an error it goes. What a killed process leaves, the
    next one of the same recipe gets: only for formats that survive a kill, as a database does."""
    path.parent.mkdir(parents=True, exist_ok=True)
    key = hashlib.sha256(repr(recipe).encode()).hexdigest()[:16]
    part = path.with_name(f".{path.stem}.part-{key}{path.suffix}")

    def remove(kept: str) -> None:
        for left in path.parent.glob(f".{path.stem}.part-*"):
            if not kept or not left.name.startswith(kept):
                left.unlink(missing_ok=True)

    remove(part.name)
    try:
        yield part
        _sync(part)
        os.replace(part, path)
        _sync(path.parent)
        remove("")
    except Exception as error:
        remove("")
        _find_cause(error, path.parent)
        raise


@contextlib.contextmanager
def atomic_directory(path: Path) -> Iterator[Path]:
    """Yield an empty temporary directory; on success it is synced and replaces `path`, else it is removed."""
    path = Path(path)
    with scratch_directory(path) as temporary:
        yield temporary
        for item in (*temporary.rglob("*"), temporary):
            if not item.is_symlink():
                _sync(item)
        shutil.rmtree(path, ignore_errors=True)
        os.replace(temporary, path)
        _sync(path.parent)


@contextlib.contextmanager
def scratch_directory(path: Path) -> Iterator[Path]:
    """Yield an empty directory beside `path`, on the same file system, that is removed in the end."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.tmp-{os.getpid()}")
    _remove_leftovers(path.parent, f".{path.name}.tmp-")
    temporary.mkdir()
    try:
        yield temporary
    except Exception as error:
        _find_cause(error, path.parent)
        raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _sync(path: Path) -> None:
    """Write a file, or the names in a folder, to the disk, so that a power cut takes nothing of it."""
    if path.is_dir() and sys.platform == "win32":
        return
    # Windows syncs only what may be written.
    file = os.open(path, os.O_RDWR if sys.platform == "win32" else os.O_RDONLY)
    try:
        os.fsync(file)
    finally:
        os.close(file)


def remove_leftovers(path: Path) -> None:
    """Remove the temporary outputs of a file or folder that killed processes left behind."""
    _remove_leftovers(path.parent, f".{path.stem}.tmp-", path.suffix)
    _remove_leftovers(path.parent, f".{path.name}.tmp-")


def _remove_leftovers(folder: Path, start: str, suffix: str = "") -> None:
    """Remove temporary outputs of one destination: this process's own, and those that killed ones left behind."""
    pattern = re.compile(rf"{re.escape(start)}(\d+)" + (rf"{re.escape(suffix)}.*" if suffix else ""))
    for name in os.listdir(folder) if folder.is_dir() else ():
        found = pattern.fullmatch(name)
        if found and (int(found[1]) == os.getpid() or not _alive(int(found[1]))):
            left = folder / name
            if left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)


def _alive(process: int) -> bool:
    if sys.platform == "win32":
        return True  # there os.kill(process, 0) would end it
    try:
        os.kill(process, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False
    return True


def quantity(value: Any, unit: str) -> dict[str, Any]:
    """A number with its unit, as every stage JSON holds it: {"value": ..., "unit": ...}. Arrays become lists."""
    return {"value": value.tolist() if hasattr(value, "tolist") else value, "unit": unit}


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON atomically, keys in the order given; a NaN is an error, never a file that other tools refuse."""
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False, default=_plain) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Read a stage JSON; a missing or damaged file is a StageError that names it."""
    try:
        return json.loads(Path(path).read_text())
    except FileNotFoundError:
        raise StageError(f"{path} does not exist; run the stage that writes it first") from None
    except ValueError as error:
        raise StageError(f"{path} is not valid JSON ({error}); delete it and rerun the stage that writes it") from None


def value(content: Mapping[str, Any], name: str) -> Any:
    """The value of one quantity in a stage JSON, without its unit."""
    return content[name]["value"]


def sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, as hex."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _plain(item: Any) -> Any:
    """NumPy scalars and arrays, and paths, as JSON knows them."""
    if hasattr(item, "tolist"):
        return item.tolist()
    if isinstance(item, Path):
        return item.as_posix()
    raise TypeError(f"{type(item).__name__} cannot be written as JSON")


def _exit_on_signal(number: int, _frame: Any) -> None:
    print(f"error: {stopped_by(number)}", file=sys.stderr, flush=True)
    sys.exit(128 + number)


def stopped_by(number: int) -> str:
    """What a stage that a signal ends says."""
    return f"stopped by {signal.Signals(number).name} {STOPPED}"


@contextlib.contextmanager
def own_sigterm() -> Iterator[None]:
    """Keep the handler of SIGTERM while pycolmap is imported, which sets one that prints a stack and aborts."""
    before = signal.getsignal(signal.SIGTERM)
    yield
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, before)


def _die_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(1, signal.SIGTERM, 0, 0, 0)
