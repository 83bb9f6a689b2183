"""The repository's own promises: one set of versions, settings that are documented, docs that are not stale."""

import ast
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from scenefuse.core.settings import problem, read_differences, schema_of, with_defaults
from scenefuse.new_project import init
from workflow import generate

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


def test_a_container_has_the_system_libraries_of_the_default_environment():
    listed = re.search(r"PACKAGES=\((.*)\)", (ROOT / "envs/setup.sh").read_text())[1].split()
    installed = re.search(r"--no-install-recommends (.*) \\\n", (ROOT / "Dockerfile").read_text())[1].split()
    assert set(installed) == set(listed) - {"python3-venv"}


def test_the_catalogue_is_told_how_the_workflow_is_used():
    told = yaml.safe_load((ROOT / ".snakemake-workflow-catalog.yml").read_text())["usage"]
    assert told["software-stack-deployment"]["conda"] and told["report"]
    assert (ROOT / "workflow/Snakefile").is_file() and (ROOT / "config/README.md").is_file()


def test_there_are_at_most_eighty_settings():
    schema = yaml.safe_load((ROOT / "workflow/schemas/config.schema.yaml").read_text())
    assert len(list(leaves(schema))) <= 80


def test_every_setting_is_described():
    schema = yaml.safe_load((ROOT / "workflow/schemas/config.schema.yaml").read_text())
    assert [name for name, part in leaves(schema) if not part.get("description")] == []


@pytest.mark.slow
def test_schema_and_page_of_settings_are_not_stale(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["generate.py", "--check"])
    assert generate.main() == 0, "run `make docs`"


def test_the_shown_settings_are_the_shipped_ones():
    schema = yaml.safe_load((ROOT / "workflow/schemas/config.schema.yaml").read_text())
    shown = yaml.safe_load((ROOT / "config/config.yaml").read_text())
    assert problem(shown, schema) is None
    assert with_defaults(shown, schema) == with_defaults({}, schema)


def test_a_seed_that_colmap_cannot_take_is_refused_before_anything_runs():
    assert problem({"seed": 20261129}, schema_of("config")) is None
    assert "seed" in problem({"seed": 20261129184400}, schema_of("config"))


@pytest.mark.parametrize("preset", ["draft", "normal", "high"])
def test_a_preset_holds_settings_and_goes_into_a_new_project(preset, tmp_path):
    found = read_differences(ROOT / f"config/presets/{preset}.yaml")
    init(tmp_path / "yard", preset=preset)
    assert read_differences(tmp_path / "yard/config/config.yaml") == found
    width = with_defaults(found, schema_of("config"))["object"]["nerf"]["width_px"]
    assert (preset, width > 800, width < 800) in {
        ("draft", False, True),
        ("normal", False, False),
        ("high", True, False),
    }


SCRIPTS = sorted((ROOT / "scripts").rglob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_is_the_command_line_of_the_function_of_its_name(script):
    source = script.read_text()
    assert len(source.splitlines()) <= 8
    assert source.endswith(f'if __name__ == "__main__":\n    run({script.stem})\n')


def test_rules_and_scripts_share_their_names():
    rules = "".join(path.read_text() for path in (ROOT / "workflow").rglob("*.smk"))
    used = set(re.findall(r"script\([\"'](\S+?)[\"']\)", rules))
    assert used == {str(p.relative_to(ROOT / "scripts")) for p in SCRIPTS if p.parent.name != "scripts"}


@pytest.mark.process
def test_reading_the_rules_imports_nothing_heavy():
    # Every job on a cluster reads them again. Snakemake itself imports NumPy and pandas.
    rules = [*(ROOT / "workflow").rglob("*.smk"), ROOT / "Snakefile"]
    imported = r"^(?:from|import) [^(\n]*(?:\([^)]*\))?"
    lines = [line for path in rules for line in re.findall(imported, path.read_text(), re.MULTILINE)]
    heavy = "{'torch', 'open3d', 'pycolmap', 'cv2', 'numba', 'scipy', 'PIL', 'matplotlib'}"
    source = "\n".join([*lines, "import sys", f"print(sorted({heavy} & set(sys.modules)))"])
    done = subprocess.run(
        [sys.executable, "-c", source], env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True
    )
    assert done.stdout.decode().strip() == "[]", done.stderr.decode()


@pytest.mark.process
def test_crops_registration_and_metrics_begin_without_numba_and_torch():
    # Of the jobs of an object with four variants these are a half, each of a few seconds.
    stages = ("crop.crop_scene", "register.coarse", "register.register_object", "metrics.compute_metrics")
    modules = ", ".join(f"scenefuse.{stage}" for stage in stages)
    source = f"import sys, {modules}\nprint(sorted({{'numba', 'torch', 'open3d', 'pandas'}} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", source], env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True
    )
    assert done.stdout.decode().strip() == "[]", done.stderr.decode()


def test_default_profile_holds_nothing_of_a_machine_and_shows_no_commands():
    profile = yaml.safe_load((ROOT / "profiles/default/config.yaml").read_text())
    assert not {"cores", "jobs", "executor", "resources", "default-resources"} & set(profile)
    assert not profile.get("printshellcmds")


def test_no_job_asks_a_cluster_for_more_cores_than_its_smallest_node_may_have():
    assert yaml.safe_load((ROOT / "profiles/slurm/config.yaml").read_text())["max-threads"] <= 2


TESTS = sorted(path for path in (ROOT / "tests").rglob("*.py") if "__pycache__" not in path.parts)


@pytest.mark.slow
@pytest.mark.parametrize("path", TESTS, ids=lambda path: str(path.relative_to(ROOT / "tests")))
def test_a_test_uses_public_names_and_no_other_test_file(path):
    assert private_uses(ast.parse(path.read_text())) == []


def test_private_uses_are_found():
    source = """
from scenefuse.nerf import field
from scenefuse.cloud.clouds import _spacing
from scenefuse.photos import views as photos
import scenefuse.core.stage
from test_depth import plane
field._encode(photos._matte, scenefuse.core.stage._run)
monkeypatch.setattr(field, "_encode", None)
patch.setattr("scenefuse.core.stage._run", None)
field.encode(photos.__name__, mine._own)
"""
    found = ["_encode", "_encode", "_matte", "_run", "_run", "_spacing", "test_depth"]
    assert sorted(private_uses(ast.parse(source))) == found


def private_uses(tree: ast.Module) -> list[str]:
    """Private names of scenefuse, and test files, that a module imports, names as an attribute, or patches."""
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    sources = [(getattr(node, "module", None), alias) for node in imports for alias in node.names]
    other = [
        name
        for source, alias in sources
        if (name := source or alias.name).split(".")[0].startswith(("test_", "conftest"))
    ]
    ours = [alias for source, alias in sources if (source or alias.name).split(".")[0] == "scenefuse"]
    roots = {(alias.asname or alias.name).split(".")[0] for alias in ours}
    named = [alias.name for alias in ours]
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node.value).split(".")[0] in roots:
            named.append(node.attr)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(".setattr"):
            owner, name = (ast.unparse(argument).strip("'") for argument in node.args[:2])
            if owner.startswith("scenefuse."):
                named.append(owner.rsplit(".", 1)[-1])
            elif owner.split(".")[0] in roots:
                named.append(name)
    return other + [name for name in named if name.startswith("_") and not name.startswith("__")]
