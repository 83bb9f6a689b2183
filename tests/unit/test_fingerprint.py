import ast
import os
import shutil
from importlib import metadata
from pathlib import Path

import pytest

from scenefuse.core.fingerprint import DISTRIBUTIONS, files_fingerprint, fingerprint, forget, imported_names, reached


@pytest.fixture
def project(tmp_path):
    def write(**modules: str) -> str:
        forget()
        for name, source in modules.items():
            path = tmp_path / f"{name.replace('__', '/')}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(source)
        return fingerprint(tmp_path / "scripts" / "s.py", tmp_path)

    return write


START_B = "class C:\n    a: int = 0\n    '''An attribute.'''\n\n\ndef g():\n    import lib.late\n    return 1\n"
START = {
    "scripts__s": "from lib.a import f\nf()\n",
    "lib__a": "from . import b\ndef f():\n    '''Doc.'''\n    return b.g()\n",
    "lib__b": START_B,
    "lib__late": "x = 1\n",
    "lib__unused": "y = 1\n",
}


@pytest.mark.parametrize(
    "edit",
    [
        {"lib__a": "from . import b\n\n\n# why\ndef f():\n    '''Other doc.'''\n    return b.g()  # because\n"},
        {"lib__unused": "y = 2\n"},
        {
            "lib__b": START["lib__b"]
            .replace("An attribute", "Other words")
            .replace("return 1", "return (\n        1\n    )")
        },
    ],
    ids=["comment and docstring", "module not imported", "formatting and attribute docstring"],
)
def test_edits_that_change_nothing(project, edit):
    assert project(**START) == project(**edit)


@pytest.mark.parametrize(
    "edit",
    [{"scripts__s": "from lib.a import f\nf(2)\n"}, {"lib__b": "def g():\n    return 2\n"}, {"lib__late": "x = 2\n"}],
    ids=["script", "imported by an import", "imported inside a function"],
)
def test_edits_that_change_the_code(project, edit):
    before = project(**START)
    assert before != project(**edit)
    assert before == project(**START)


def test_assets_count_with_the_module_that_reads_them_and_with_no_other(project, tmp_path):
    reader = START | {"lib__b": "from importlib import resources\ndef g():\n    return 1\n"}
    others, readers = project(**START), project(**reader)
    (tmp_path / "lib/assets").mkdir()
    for text in ("body {}", "p {}"):
        (tmp_path / "lib/assets/page.css").write_text(text)
        assert project(**START) == others
        assert readers != (readers := project(**reader))


def test_an_upgraded_package_changes_what_imports_it_and_nothing_else(project, monkeypatch):
    versions = {"numpy": "2.0", "opencv-python-headless": "5.0", "torch": "2.0+cpu", "scipy": "1.0"}
    monkeypatch.setattr("importlib.metadata.version", versions.__getitem__)
    start = START | {"lib__late": "import numpy as np\nfrom torch import nn\ndef f():\n    import cv2\n"}
    before = project(**start)
    versions |= {"scipy": "2.0", "torch": "2.0+cu130"}
    assert project(**start) == before
    for name in ("numpy", "torch", "opencv-python-headless"):
        old, versions[name] = versions[name], "9.9"
        assert project(**start) != before, name
        versions[name] = old


def test_the_versions_of_all_packages_that_stages_import_are_known():
    root, installed = Path(__file__).parents[2], metadata.packages_distributions()
    files = frozenset().union(*(reached(script, root) for script in root.glob("scripts/*/*.py")))
    names = {name.split(".")[0] for file in files for name in imported_names(file.read_text(), file, root)}
    names = {name for name in names & installed.keys() if not (root / name).is_dir()}
    found = {name: {like.lower() for like in installed[name]} for name in names}
    assert [name for name, held in found.items() if held.isdisjoint(DISTRIBUTIONS.get(name, (name,)))] == []


def test_imports_in_brackets_and_over_lines_are_followed(project):
    for source in (
        "from lib import (  # both\n    b,\n    a,\n)\n",
        "from lib import b, \\\n    a\n",
        "import lib.b, lib.a as x\n",
    ):
        before = project(**START | {"scripts__s": source})
        assert project(lib__a="z = 3\n") != before


@pytest.fixture
def photo(tmp_path):
    def write(content: bytes, seconds: int) -> str:
        path = tmp_path / "photo.jpg"
        path.write_bytes(content)
        os.utime(path, (seconds, seconds))
        forget()
        return files_fingerprint((str(path),))

    return write


def test_a_file_replaced_by_an_older_one_is_noticed(photo):
    assert photo(b"new", 2000) != photo(b"old", 1000)
    large = 2_000_000
    assert photo(b"n" * large, 2000) != photo(b"o" * large, 1000)


def test_a_height_that_is_corrected_in_a_large_photo_without_another_size_or_date_is_noticed(photo):
    rest = b"o" * 2_000_000
    assert photo(b"EXIF 512.3 m" + rest, 1000) != photo(b"EXIF 498.1 m" + rest, 1000)


def test_a_small_file_that_is_only_touched_stays_the_same(photo):
    assert photo(b"same", 1000) == photo(b"same", 2000)


def test_a_folder_goes_by_what_lies_in_it(tmp_path):
    (tmp_path / "truth").mkdir()
    found = set()
    for content in ("a", "b"):
        (tmp_path / "truth/cameras.json").write_text(content)
        forget()
        found.add(files_fingerprint((str(tmp_path / "truth"),)))
    assert len(found) == 2


@pytest.mark.slow
def test_no_import_of_the_library_is_overlooked():
    root = Path(__file__).resolve().parents[2]
    for module in sorted((root / "scenefuse").rglob("*.py")):
        source = module.read_text()
        nodes = list(ast.walk(ast.parse(source)))
        names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        for node in (node for node in nodes if isinstance(node, ast.ImportFrom)):
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        assert names <= set(imported_names(source, module, root)), module


@pytest.fixture(scope="module")
def copied(tmp_path_factory):
    """A copy of the library and of its scripts."""
    root, copy = Path(__file__).resolve().parents[2], tmp_path_factory.mktemp("project")
    for part in ("scenefuse", "scripts"):
        shutil.copytree(root / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
    return copy


def changed_by(edit, module, root):
    """The scripts whose fingerprint changes when a module's source is edited, and not the module back again."""

    def fingerprints():
        forget()
        return {path.relative_to(root / "scripts").as_posix(): fingerprint(path, root) for path in scripts}

    scripts, path = sorted((root / "scripts").rglob("*.py")), root / module
    source, before = path.read_text(), fingerprints()
    path.write_text(edit(source))
    after = fingerprints()
    path.write_text(source)
    return {script for script in before if before[script] != after[script]}


def one_more_statement(source):
    return source + "\n\ndef added():\n    return 1\n"


def new_words(source):
    """The same code with other comments and another docstring."""
    return "# A comment.\n" + source.replace('"""', '"""Anew: ', 1) + "\n# Another comment.\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    "module, reached",
    [
        # Not only what runs it: the paper's recipe takes no more than a constant from it, register.py all stages.
        (
            "scenefuse/register/refinement.py",
            {"register.py", "paper/register_as_paper.py", "register/register_object.py"},
        ),
        ("scenefuse/masks/grabcut.py", {"masks/make_masks.py", "pick.py"}),
        ("scripts/masks/make_masks.py", {"masks/make_masks.py"}),
    ],
)
def test_an_edit_changes_exactly_the_scripts_that_import_the_module_and_a_comment_none(copied, module, reached):
    assert changed_by(one_more_statement, module, copied) == reached
    assert changed_by(new_words, module, copied) == set()


def test_an_edit_of_what_all_stages_share_changes_every_script(copied):
    scripts = {path.relative_to(copied / "scripts").as_posix() for path in (copied / "scripts").rglob("*.py")}
    assert changed_by(one_more_statement, "scenefuse/core/stage.py", copied) == scripts
    assert changed_by(new_words, "scenefuse/core/stage.py", copied) == set()
