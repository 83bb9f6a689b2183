"""The repository's own promises: one set of versions, settings that are documented, docs that are not stale."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]


def leaves(schema: dict, prefix: str = ""):
    for key, part in schema["properties"].items():
        if "properties" in part:
            yield from leaves(part, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", part


def test_conda_files_pin_the_versions_of_the_default_environment():
    pins = set(re.findall(r"^[\w\[\]-]+==\S+", (ROOT / "envs/requirements.txt").read_text(), re.MULTILINE))
    for path in (ROOT / "envs").glob("*.yaml"):
        packages = yaml.safe_load(path.read_text())["dependencies"][-1]["pip"]
        assert set(packages) <= pins, path.name


def test_every_setting_is_described():
    schema = yaml.safe_load((ROOT / "workflow/schemas/config.schema.yaml").read_text())
    assert [name for name, part in leaves(schema) if not part.get("description")] == []


def test_the_page_of_settings_is_not_stale():
    page = [sys.executable, "workflow/config_docs.py", "--check"]
    assert subprocess.run(page, cwd=ROOT).returncode == 0, "run `make docs`"


@pytest.mark.parametrize("script", sorted((ROOT / "scripts").glob("*.py")), ids=lambda path: path.stem)
def test_a_script_is_the_command_line_of_one_function(script):
    source = script.read_text()
    assert len(source.splitlines()) <= 8
    assert re.search(r'if __name__ == "__main__":\n    run\(\w+\)\n$', source)
