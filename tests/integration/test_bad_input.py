"""Bad input ends in one clear sentence, a non-zero exit, and no partial output."""

import json

import cv2
import numpy as np
import pytest
import yaml

HEADER = "object\tscene\tphotos\tfiducials\tprompts\tmasks\ttruth\n"


@pytest.fixture
def project(tmp_path, snakemake):
    """A working directory of a user's own; call it with the targets to run."""

    class Project:
        path = tmp_path
        config: dict = {"scenes": "scenes.tsv", "objects": "objects.tsv"}
        scenes = "scene\tphotos\tyard\tflight\n".replace("\tyard", "\nyard")
        objects = HEADER + "shed\tyard\tclose\tclicks.tsv\tprompts.tsv\t\t\n"

        def photos(self, folder: str, count: int = 3) -> None:
            (self.path / folder).mkdir()
            rng = np.random.default_rng(0)
            for index in range(count):
                picture = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
                cv2.imwrite(str(self.path / folder / f"{index}.jpg"), picture)

        def run(self, *targets: str) -> str:
            (self.path / "scenes.tsv").write_text(self.scenes)
            (self.path / "objects.tsv").write_text(self.objects)
            (self.path / "mine.yaml").write_text(yaml.safe_dump(self.config))
            result = snakemake(self.path, *targets, config=self.path / "mine.yaml")
            assert result.returncode != 0
            return result.stdout

    return Project()


def test_typo_in_a_key(project):
    project.config = project.config | {"scene": {"matches": {"max_rati": 0.8}}}
    assert "config, scene.matches: unknown key 'max_rati'; did you mean 'max_ratio'?" in project.run("-n")


def test_value_of_the_wrong_kind(project):
    project.config = project.config | {"fusion": {"mode": "fil"}}
    assert "config, fusion.mode: 'fil' is not one of ['fill', 'append', 'replace']" in project.run("-n")


def test_unknown_object_in_a_target(project):
    assert "unknown object 'shad'; objects.tsv lists: shed" in project.run("-n", "results/objects/shad/fused.ply")


def test_unknown_scene_of_an_object(project):
    project.objects = HEADER + "shed\tgarden\tclose\tclicks.tsv\tprompts.tsv\t\t\n"
    assert "object 'shed' lies in scene 'garden', which scenes.tsv does not list" in project.run("-n")


def test_missing_photo_folder(project):
    assert "scenes.tsv, scene 'yard': 'flight' does not exist" in project.run("-n", "results/scenes/yard/photos.json")


def test_empty_photo_folder(project):
    (project.path / "flight").mkdir()
    output = project.run("results/scenes/yard/photos.json")
    assert "error: " in output and "flight" in output
    assert not (project.path / "results/scenes/yard/photos.json").exists()


def test_unreadable_photo(project):
    project.photos("flight")
    (project.path / "flight/1.jpg").write_bytes(b"\xff\xd8\xff\xe0 broken")
    output = project.run("results/scenes/yard/photos.json")
    assert "error: " in output and "1.jpg" in output
    assert not (project.path / "results/scenes/yard/photos.json").exists()


def test_too_few_registered_photos(project):
    project.photos("flight", 4)
    output = project.run("results/scenes/yard/sparse.json")
    assert "error: " in output
    assert not (project.path / "results/scenes/yard/sparse").exists()


def test_object_without_prompts_and_masks(project):
    project.photos("close")
    project.objects = HEADER + "shed\tyard\tclose\tclicks.tsv\t\t\t\n"
    assert "'shed' has neither prompts nor masks" in project.run("-n", "results/objects/shed/masks.json")


def test_a_failed_object_does_not_block_the_other_and_is_named(project):
    project.photos("close", 4)
    project.photos("other", 4)
    (project.path / "other/2.jpg").write_bytes(b"")
    project.objects = (
        HEADER + "shed\tyard\tclose\tclicks.tsv\tprompts.tsv\t\t\n" + "barn\tyard\tother\tclicks.tsv\tprompts.tsv\t\t\n"
    )
    targets = [f"results/objects/{name}/photos.json" for name in ("shed", "barn")]
    project.run("--keep-going", *targets)
    assert json.loads((project.path / targets[0]).read_text())["photos"]
    summary = (project.path / "results/summary/summary.txt").read_text()
    assert "barn" in summary and "2.jpg" in summary
