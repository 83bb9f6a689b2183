"""Fingerprints for Snakemake's `params:`: of a script and all code that it reaches, and of a user's files.

Snakemake sees neither an edited library module nor an upgraded package, and it takes a file of an older date for the
one that it knew. A fingerprint of code changes when code that a stage can reach changes, and not when comments,
docstrings, formatting or file dates do.

What a module holds is remembered between runs by the SHA-256 of its source, in ~/.cache/scenefuse: it takes a second to
work out for all modules, and nothing to look up.
"""

import ast
import atexit
import contextlib
import functools
import hashlib
import json
import os
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from scenefuse.core.stage import atomic_file

# Packages that are imported by another name than they are installed by, most likely first.
DISTRIBUTIONS = {
    "PIL": ("pillow",),
    "open3d": ("open3d", "open3d-cpu"),
    "cv2": ("opencv-python-headless", "opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
    "yaml": ("pyyaml",),
    "fpdf": ("fpdf2",),
}
IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+(\S+)[ \t]+)?import[ \t]+(\([^)]*\)|(?:\\\n|[^\n#;])+)", re.MULTILINE)
REMEMBERED = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "scenefuse/modules.json")
LIBRARY = Path(__file__).resolve().parent.parent
# Files in the assets/ folder beside a module that imports this are part of its code.
ASSETS_READER = "importlib.resources"
OWN_SOURCE = Path(__file__).read_bytes()  # an edit here forgets all that is remembered
# A file of a user up to this size is read whole; of a larger one size, date and beginning are looked at.
MAX_READ_BYTES = 200_000


class _Module(NamedTuple):
    code: str
    """Digest of its code."""
    files: frozenset[Path]
    """Modules of the project that it imports."""
    packages: frozenset[str]
    """Top names of everything else that it imports, but for the standard library."""


@functools.cache
def fingerprint(script: Path, root: Path) -> str:
    """Twelve hex digits that identify `script`, all modules of the project that it reaches, and versions of packages.

    The project is what lies below `root`, and this library, which lies elsewhere where it was installed.

    Raises:
        SyntaxError: a module does not parse.
    """
    modules = _modules(script, root)
    names = {path.relative_to(_above(path, root)).as_posix(): module for path, module in modules.items()}
    lines = [f"{name} {names[name].code}" for name in sorted(names)]
    lines += [f"{name} {_version(name)}" for name in sorted(set().union(*(m.packages for m in modules.values())))]
    return _digest("\n".join(lines))


def reached(script: Path, root: Path) -> frozenset[Path]:
    """The script and all modules of the project that it imports, directly or indirectly.

    Raises:
        SyntaxError: a module does not parse.
    """
    return frozenset(_modules(script, root))


def _modules(script: Path, root: Path) -> dict[Path, _Module]:
    modules, todo = {}, [script]
    while todo:
        path = todo.pop()
        if path not in modules:
            modules[path] = _module(path, root)
            todo += modules[path].files
    return modules


@functools.cache
def files_fingerprint(paths: tuple[str, ...]) -> str:
    """Twelve hex digits that identify files by their names and contents; large ones by name, size, date, beginning."""
    return _digest("\n".join(f"{path} {_state(Path(path))}" for path in sorted(paths)))


def _state(path: Path) -> str:
    if path.is_dir():
        return "\n".join(f"{file} {_state(file)}" for file in sorted(path.rglob("*")) if file.is_file())
    # The stage says what is wrong with one that may not be read.
    if not path.is_file() or not os.access(path, os.R_OK):
        return "no file"
    about = path.stat()
    large = about.st_size > MAX_READ_BYTES
    with open(path, "rb") as file:
        # A JPEG's EXIF lies in its first 64 KB: exiftool -P corrects heights in it, and keeps size and date.
        content = hashlib.sha256(file.read(2**16 if large else -1)).hexdigest()
    return f"{about.st_size} {about.st_mtime_ns} {content}" if large else content


@functools.cache
def _module(path: Path, root: Path) -> _Module:
    source = path.read_text(encoding="utf-8")
    names = set(imported_names(source, path, root))
    assets = sorted((path.parent / "assets").rglob("*")) if ASSETS_READER in names else []
    known, key = _remembered(), hashlib.sha256(OWN_SOURCE + source.encode()).hexdigest()
    if key not in known:
        known[key] = _digest(_normalised(source, path))
    files: frozenset[Path] = frozenset().union(*(_files(name, root) for name in names))
    packages = {name.split(".")[0] for name in names if _home(name.split(".")[0], root) is None}
    code = _digest("".join([known[key], *(f" {file.name} {_state(file)}" for file in assets)]))
    return _Module(code, files, frozenset(packages - sys.stdlib_module_names))


def _normalised(source: str, path: Path) -> str:
    """A module's code without comments, formatting, and strings that stand alone (docstrings of anything)."""
    tree = ast.parse(source, filename=str(path))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [part for part in node.body if not _is_docstring(part)] or [ast.Pass()]
    return ast.unparse(tree)


def _is_docstring(part: ast.stmt) -> bool:
    return isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant) and isinstance(part.value.value, str)


@functools.cache
def _remembered() -> dict[str, str]:
    """Digests of the code of modules by the SHA-256 of their sources; written back when the process ends."""
    known: dict[str, str] = {}
    with contextlib.suppress(OSError, ValueError):
        known = json.loads(REMEMBERED.read_text())
    atexit.register(_remember, known, len(known))
    return known


def _remember(known: dict[str, str], before: int) -> None:
    if len(known) > before and REMEMBERED.is_absolute():
        with contextlib.suppress(OSError), atomic_file(REMEMBERED) as temporary:
            temporary.write_text(json.dumps(known))


@functools.cache
def _home(top: str, root: Path) -> Path | None:
    """The folder that holds a module of the project by its first name; None for any other package."""
    if (root / top).is_dir() or (root / f"{top}.py").is_file():
        return root
    return LIBRARY.parent if top == LIBRARY.name else None


def _above(path: Path, root: Path) -> Path:
    """The folder that names of a module begin at."""
    return root if path.is_relative_to(root) else LIBRARY.parent


@functools.cache
def _files(name: str, root: Path) -> frozenset[Path]:
    """The project's files that Python runs to import a dotted name."""
    parts = name.split(".")
    home = _home(parts[0], root)
    if home is None:
        return frozenset()
    stem = home.joinpath(*parts)
    here = [file for file in (stem / "__init__.py", stem.with_name(f"{stem.name}.py")) if file.is_file()]
    return frozenset(here).union(_files(".".join(parts[:-1]), root) if len(parts) > 1 else ())


def imported_names(source: str, module: Path, root: Path) -> Iterator[str]:
    """Absolute dotted names of everything a module may import, at any depth; names that are no modules do no harm."""
    for base, listed in IMPORT.findall(source):
        names = re.findall(r"(?:^|,)\s*([\w.]+)", re.sub(r"#[^\n]*|[()\\]", "", listed))
        if base.startswith("."):
            above = len(base) - len(base.lstrip("."))
            package = module.relative_to(_above(module, root)).parent.parts
            base = ".".join([*package[: len(package) - above + 1], *filter(None, [base[above:]])])
        yield from [base, *(f"{base}.{name}" for name in names)] if base else names


@functools.cache
def _version(package: str) -> str:
    """The installed version of an imported package, without the build of it (`+cpu`), which is the machine's."""
    for name in DISTRIBUTIONS.get(package, (package,)):
        try:
            return metadata.version(name).split("+")[0]
        except metadata.PackageNotFoundError:
            continue
    return "not installed"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def forget() -> None:
    """Read all files and versions again."""
    for cached in (fingerprint, files_fingerprint, _module, _home, _files, _version):
        cached.cache_clear()
