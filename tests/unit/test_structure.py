"""The library's structure: which way imports run, and what stays out of it."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.packages import PACKAGES

ROOT = Path(__file__).resolve().parents[2]
LIBRARY = ROOT / "scenefuse"
MAY_IMPORT = {name: set(PACKAGES[: PACKAGES.index(name) + 1]) for name in PACKAGES}
MAY_IMPORT |= {name: MAY_IMPORT[name] - {"crop"} for name in ("register", "fuse")}
MAY_IMPORT |= {"new_project": {"core", "cloud", "photos"}, "complete": {"core", "marks", "report", "new_project"}}
MAY_IMPORT |= {"command_line": {*PACKAGES, "new_project", "complete", "export"}}
MAY_IMPORT |= {"export": {"core", "report"}}
MAY_IMPORT |= {"__main__": {"command_line"}}
CORE = ("field", "kernels", "triton_kernels", "rays", "render", "training")
CORE += ("appearance",)
OUTSIDE = {"numpy", "torch", "numba", "llvmlite", "triton", *sys.stdlib_module_names}
OURS = {f"scenefuse.core.{name}" for name in ("stage", "transforms", "machine", "checkpoints")}


def modules() -> list[Path]:
    return sorted(path for path in LIBRARY.rglob("*.py") if path.name != "__init__.py")


def imported(path: Path) -> Iterator[str]:
    """The modules that a file imports, at its top or inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = str(node.module)
            package = (ROOT / module.replace(".", "/")).is_dir()
            yield from (f"{module}.{alias.name}" for alias in node.names) if package else [module]


def part(module: str) -> str:
    """The package of a module, or its name where it lies in none: `scenefuse.photos.photos` -> `sfm`."""
    return module.split(".")[1]


def test_every_module_has_its_place_in_the_order():
    assert {part(".".join(path.relative_to(ROOT).with_suffix("").parts)) for path in modules()} == set(MAY_IMPORT)


@pytest.mark.slow
def test_imports_run_from_later_packages_to_earlier_ones():
    backwards = []
    for path in modules():
        here = path.relative_to(LIBRARY).with_suffix("").parts[0]
        for module in imported(path):
            allowed = not module.startswith("scenefuse") or part(module) in MAY_IMPORT[here]
            if not allowed and module.removeprefix("scenefuse.") not in MAY_IMPORT[here]:
                backwards.append(f"{path.relative_to(ROOT)} imports {module}")
    assert backwards == []


@pytest.mark.slow
def test_the_demo_stands_on_a_few_packages_and_no_package_imports_it():
    rendering = [path for path in (ROOT / "demo").glob("*.py") if path.stem != "evaluate"]
    used = {name for path in rendering for name in imported(path) if name.startswith("scenefuse")}
    assert {part(name) for name in used} <= {"core", "photos"}
    assert [str(path) for path in modules() for name in imported(path) if name.split(".")[0] == "demo"] == []


@pytest.mark.slow
def test_the_library_never_sees_snakemake():
    assert [str(path) for path in modules() for name in imported(path) if name.split(".")[0] == "snakemake"] == []


@pytest.mark.parametrize("name", CORE)
def test_the_core_of_the_nerf_imports_numpy_and_pytorch_only(name):
    found = set(imported(LIBRARY / f"nerf/{name}.py"))
    ours = {module for module in found if module.startswith("scenefuse")}
    assert {module.split(".")[0] for module in found - ours} <= OUTSIDE
    assert ours <= OURS | {f"scenefuse.nerf.{other}" for other in CORE}


@pytest.mark.slow
def test_one_module_reads_colmap_models():
    readers = set()
    for path in modules():
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call) and node.args]
        if any(ast.unparse(call.func).endswith("Reconstruction") for call in calls):
            readers.add(str(path.relative_to(LIBRARY)))
    assert readers == {"photos/workspace.py"}
