"""The package: what its parts need, what a wheel holds, and that it works without the repository."""

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from packaging.requirements import Requirement
from support.planted import plant
from support.user_project import planned

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.core.stage import StageError
from scenefuse.core.version import VERSION
from scenefuse.new_project import init

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CORE, ALL = PROJECT["dependencies"], PROJECT["optional-dependencies"]["all"]
COMMAND = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {without}:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)

sys.meta_path.insert(0, Absent())
from scenefuse.command_line import main
main()
"""


def names(requirements):
    return {Requirement(line).name for line in requirements}


def scenefuse(*words, cwd, library=ROOT, without=()):
    """Exit status and output of the command, in a process that cannot import some packages."""
    program = COMMAND.replace("{without}", repr(list(without)))
    env = os.environ | {"PYTHONPATH": str(library), "COLUMNS": "200"}
    done = subprocess.run([sys.executable, "-c", program, *words], cwd=cwd, env=env, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


def test_two_clouds_are_registered_and_fused_without_what_the_slim_install_leaves_out(tmp_path):
    trial = plant("house", 5, ground=False, noise=0.005, object_points=6000, density_ratio=1.0)
    write_cloud(tmp_path / "house.ply", trial.object)
    write_cloud(tmp_path / "yard.ply", trial.scene)
    # Pygments comes with IPython, which k3d brings along.
    absent = [name.replace("-", "_") for name in names(ALL) - {"pygments"}]
    assert {"torch", "pycolmap", "snakemake", "nicegui", "onnxruntime"} <= set(absent)
    words = ("register", "--object", "house.ply", "--scene", "yard.ply", "--fuse")
    status, output = scenefuse(*words, cwd=tmp_path, without=absent)
    assert status == 0, output
    assert (read_cloud(tmp_path / "registered/completed.ply").fields["source"] == 1).any()


def test_a_part_that_needs_more_says_what_to_install(tmp_path):
    for part, package in (("nerf", "torch"), ("run", "snakemake")):
        status, output = scenefuse(part, "--help", cwd=tmp_path, without=[package])
        assert status == 1 and f"scenefuse {part} needs {package}" in output and "scenefuse[all]" in output


def test_the_version_is_one():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == VERSION
    assert scenefuse("--version", cwd=ROOT) == (0, f"scenefuse {VERSION}\n")


def test_an_unknown_part_is_named(tmp_path):
    status, output = scenefuse("fuse", cwd=tmp_path)
    assert status == 2 and "fuse" in output and "register" in output


def test_what_is_pinned_is_what_the_package_asks_for():
    lines = [line for line in (ROOT / "envs/requirements.txt").read_text().splitlines() if "==" in line]
    pins = {Requirement(line).name: next(iter(Requirement(line).specifier)).version for line in lines}
    pins["open3d-cpu"] = pins["open3d"]
    for requirement in map(Requirement, [*CORE, *ALL]):
        assert requirement.specifier.contains(pins[requirement.name]), requirement
    assert set(pins) - {"pytest", "ruff", "mypy", "snakefmt"} == names([*CORE, *ALL])


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel of what git knows and what is new here, built elsewhere: building leaves files behind."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines():
        if (ROOT / name).is_file() and not name.startswith(("tests/", "docs/figures/", "docs/results/")):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    command = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--quiet", "-w", out, source]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A folder with the package as installed, for PYTHONPATH."""
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def test_a_wheel_holds_the_library_and_the_workflow_and_nothing_of_the_demo(wheel):
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
    assert wheel.name.startswith(f"scenefuse-{VERSION}-py3-none-any")
    assert {path.relative_to(ROOT).as_posix() for path in ROOT.glob("scenefuse/**/assets/*")} <= held
    for folder in ("scripts", "workflow", "profiles", "envs"):
        files = [path for path in (ROOT / folder).rglob("*") if path.is_file()]
        files = [path for path in files if not {"__pycache__", "demo", "demo.smk"} & set(path.parts)]
        assert {f"scenefuse/shipped/{path.relative_to(ROOT).as_posix()}" for path in files} <= held
    # Those that messages name.
    assert {"scenefuse/shipped/docs/register.md", "scenefuse/shipped/docs/clicking.md"} <= held
    assert {"scenefuse/shipped/config/README.md", "scenefuse/shipped/Snakefile"} <= held
    assert {"scenefuse/shipped/Snakefile", "scenefuse/shipped/config/config.yaml", "scenefuse/core/stage.py"} <= held
    assert not [name for name in held if name.endswith("/config/objects.tsv") or name.split("/")[0] == "tests"]
    assert not [name for name in held if "demo" in name]


def test_an_installed_package_makes_a_project_and_plans_its_run(installed, tmp_path):
    rng = np.random.default_rng(0)
    for folder in ("flight", "my house"):
        (tmp_path / folder).mkdir()
        for index in range(5):
            cv2.imwrite(str(tmp_path / folder / f"{index}.jpg"), rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    words = ("init", "yard", "--scene", "flight", "--objects", "my house")
    status, output = scenefuse(*words, cwd=tmp_path, library=installed)
    assert status == 0, output
    clicks = tmp_path / "yard/config/my_house_prompts.tsv"
    clicks.write_text("label\tphoto\tx_px\ty_px\ninside\t0.jpg\t10\t10\n")
    status, output = scenefuse("run", "-n", cwd=tmp_path / "yard", library=installed)
    assert status == 0, output
    assert {"map_scene_photos", "fuse_object", "complete_scene", "write_report"} <= planned(output)
    assert "render_scene" not in planned(output)


def test_jobs_of_an_installed_package_run_its_own_code(installed, tmp_path):
    write_cloud(tmp_path / "yard.ply", Cloud(np.random.default_rng(0).uniform(0, 9, (500, 3))))
    assert scenefuse("init", "project", "--scene", "yard.ply", cwd=tmp_path, library=installed)[0] == 0
    words = ("run", "--cores", "1", "results/scenes/yard/dense.ply")
    status, output = scenefuse(*words, cwd=tmp_path / "project", library=installed)
    assert status == 0, output
    assert len(read_cloud(tmp_path / "project/results/scenes/yard/dense.ply")) == 500
    log = (tmp_path / "project/results/logs/import_scene_cloud/yard.log").read_text()
    assert log.startswith(f"python {installed}/scenefuse/shipped/scripts/cloud/import_scene_cloud.py")


def test_code_has_the_same_fingerprint_in_a_clone_and_installed(installed):
    ask = "import sys; from pathlib import Path; from scenefuse.core.fingerprint import fingerprint;"
    ask += "root = Path(sys.argv[1]);"
    ask += "print(fingerprint(root / 'scripts/fuse/fuse_object.py', root))"
    found = set()
    for library, root in ((ROOT, ROOT), (installed, installed / "scenefuse/shipped")):
        command = [sys.executable, "-c", ask, root]
        env = os.environ | {"PYTHONPATH": str(library)}
        found.add(subprocess.run(command, env=env, cwd=installed, capture_output=True, text=True, check=True).stdout)
    assert len(found) == 1


def test_environments_of_conda_are_refused_where_they_would_lack_the_library(installed, tmp_path):
    assert scenefuse("init", "yard", cwd=tmp_path, library=installed)[0] == 0
    status, output = scenefuse("run", "-n", "--sdm", "conda", cwd=tmp_path / "yard", library=installed)
    assert status == 1 and "run the workflow of a clone" in output


def test_an_empty_project_says_what_is_missing(installed, tmp_path):
    assert scenefuse("init", "yard", cwd=tmp_path, library=installed)[0] == 0
    status, output = scenefuse("run", "-n", cwd=tmp_path / "yard", library=installed)
    assert (
        status == 1
        and "config/scenes.tsv and config/objects.tsv have no rows; add one for each scene and object" in output
    )


def test_names_are_made_of_what_files_are_called_and_said(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("Häuschen neu.ply", "site.ply"):
        write_cloud(Path(name), Cloud(np.eye(3)))
    init(Path("new"), scene=Path("site.ply"), objects=(Path("Häuschen neu.ply"),))
    said = capsys.readouterr().out
    assert "Häuschen neu.ply: an object, called Hauschen_neu (names hold only" in said
    assert "site.ply: the scene\n" in said
    for name in ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "small/a.jpg"):
        Path("shots", name).parent.mkdir(parents=True, exist_ok=True)
        Path("shots", name).write_bytes(b"photo")
    init(Path("other"), objects=(Path("shots"),))
    assert "shots: an object, 5 photos, 1 of them in small/, which is few" in capsys.readouterr().out
    assert "Hauschen_neu\tsite\t" in Path("new/config/objects.tsv").read_text()


@pytest.mark.parametrize("words", [("run", "-n"), ("pick", "--object", "house")])
def test_in_a_folder_without_a_project_nothing_is_made_of_the_demo(tmp_path, words):
    status, output = scenefuse(*words, cwd=tmp_path)
    assert status == 1 and "there is no config/scenes.tsv here" in output and "scenefuse init" in output


@pytest.mark.parametrize("option", [["--configfile", "my.yaml"], ["--configfile=my.yaml"]])
def test_a_settings_file_that_is_not_there_is_one_sentence(tmp_path, option):
    status, output = scenefuse("run", "-n", *option, cwd=tmp_path)
    assert status == 1 and output.strip() == "error: the settings file my.yaml cannot be read; correct its path"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"folder": Path("taken")}, "README.md exists already"),
        ({"folder": Path("file")}, "file exists already"),
        ({"folder": Path("yard {2026}")}, "has braces, which Snakemake takes for wildcards"),
        ({"folder": Path("new"), "scene": Path("nowhere")}, "nowhere does not exist"),
        ({"folder": Path("new"), "scene": Path("taken"), "objects": (Path("a/x"), Path("b/x"))}, "two objects"),
        ({"folder": Path("new"), "scene": Path("taken")}, "taken holds no photos"),
        ({"folder": Path("new"), "scene": Path("walk.mp4")}, "walk.mp4 is empty; export it again"),
        ({"folder": Path("new"), "objects": (Path("code.py"),)}, "code.py is not a folder of photos, a video nor"),
        ({"folder": Path("new"), "objects": (Path("empty.ply"),)}, "empty.ply is empty"),
        ({"folder": Path("shots/new"), "objects": (Path("shots"),)}, "would lie among its photos in shots"),
    ],
)
def test_a_project_that_cannot_be_made_is_one_sentence(tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    for folder in ("taken", "a/x", "b/x", "shots"):
        Path(folder).mkdir(parents=True)
    Path("shots/a.jpg").write_bytes(b"photo")
    Path("taken/README.md").touch()
    for name in ("file", "walk.mp4", "code.py", "empty.ply"):
        Path(name).touch()
    with pytest.raises(StageError, match=words):
        init(**options)
    assert not Path("new").exists()
