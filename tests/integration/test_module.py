"""The workflow as others use it: from either Snakefile, and as a module of another workflow."""

import numpy as np
import pytest
from support.snakemake_runs import ROOT, run_snakemake
from support.user_project import CLICKS, planned

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud

OTHER = """
configfile: "mine.yaml"


rule count_points:
    input:
        "results/scenes/yard/completed.ply",
    output:
        "points.txt",
    shell:
        "grep -a -m1 'element vertex' {{input}} > {{output}}"


module completion:
    snakefile:
        "{snakefile}"
    config:
        config["completion"]


use rule * from completion as completion_*
"""


def snakemake(directory, *words):
    done = run_snakemake(directory, *words)
    return done.returncode, done.stdout


def plan(directory, *words):
    return snakemake(directory, "--dry-run", *words)


@pytest.fixture
def yard(project):
    """A user's project with photos and clicks, and its settings in mine.yaml."""
    project.photos("flight")
    project.photos("close")
    for name in ("clicks.tsv", "prompts.tsv"):
        (project.path / name).write_text(CLICKS)
    project.write()
    return project.path


@pytest.mark.parametrize("snakefile", ["Snakefile", "workflow/Snakefile"])
def test_either_snakefile_makes_everything_from_any_folder(yard, snakefile):
    status, output = plan(yard, "--snakefile", ROOT / snakefile, "--configfile", "mine.yaml")
    assert status == 0, output
    assert {"all", "map_scene_photos", "complete_scene", "write_summary", "write_report"} <= planned(output)


@pytest.mark.parametrize("snakefile", ["Snakefile", "workflow/Snakefile"])
def test_another_workflow_uses_it_as_a_module_with_settings_and_rules_of_its_own(yard, snakefile):
    settings = (yard / "mine.yaml").read_text()
    (yard / "mine.yaml").write_text("completion:\n" + "".join(f"  {line}\n" for line in settings.splitlines()))
    (yard / "Snakefile").write_text(OTHER.format(snakefile=ROOT / snakefile))
    status, output = plan(yard)
    assert status == 0, output
    rules = planned(output)
    assert {"count_points", "completion_map_scene_photos", "completion_complete_scene"} <= rules
    assert not {rule for rule in rules if not rule.startswith("completion_")} - {"count_points"}


def test_jobs_of_a_module_run(tmp_path):
    write_cloud(tmp_path / "yard.ply", Cloud(np.random.default_rng(0).uniform(0, 9, (500, 3))))
    (tmp_path / "scenes.tsv").write_text("scene\tcloud\nyard\tyard.ply\n")
    (tmp_path / "objects.tsv").write_text("object\tscene\n")
    (tmp_path / "mine.yaml").write_text("completion: { scenes: scenes.tsv, objects: objects.tsv }\n")
    (tmp_path / "Snakefile").write_text(OTHER.format(snakefile=ROOT / "workflow/Snakefile"))
    status, output = snakemake(tmp_path, "--cores", "1", "results/scenes/yard/dense.ply")
    assert status == 0, output
    assert len(read_cloud(tmp_path / "results/scenes/yard/dense.ply")) == 500


def test_a_prefix_would_not_reach_all_files_and_is_refused(yard):
    text = OTHER.format(snakefile=ROOT / "workflow/Snakefile")
    text = text.replace("    config:", "    prefix:\n        'part'\n    config:")
    (yard / "mine.yaml").write_text("completion: { seed: 1 }\n")
    (yard / "Snakefile").write_text(text)
    status, output = plan(yard)
    assert status != 0 and "`prefix` and `replace_prefix` of a module do not reach" in output


def test_a_wrong_setting_of_the_module_is_named(yard):
    (yard / "mine.yaml").write_text("completion: { fusion: { mod: fill } }\n")
    (yard / "Snakefile").write_text(OTHER.format(snakefile=ROOT / "workflow/Snakefile"))
    status, output = plan(yard)
    assert status != 0 and "fusion: 'mod' is unknown; did you mean 'mode'?" in output
