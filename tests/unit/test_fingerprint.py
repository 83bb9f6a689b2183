import pytest

from scenefuse.fingerprint import _normalised, _tree, fingerprint


@pytest.fixture
def project(tmp_path):
    def write(**modules: str) -> str:
        for cached in (fingerprint, _normalised, _tree):
            cached.cache_clear()
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
