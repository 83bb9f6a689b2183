"""What a change of a user's own files reruns. The jobs are not run: their outputs are there, and taken for results."""

import os
import shutil

import pytest
from support.user_project import CLICKS, Project, film, planned

from scenefuse.core.stage import read_json, value
from scenefuse.marks.clicks import Click
from scenefuse.pick.document import Document

CROP, MASKS = "results/objects/shed/registration/full/crop.json", "results/objects/shed/masks.json"


@pytest.fixture(scope="module")
def finished(tmp_path_factory, snakemake):
    """A project in which all jobs up to the masks and the crop of an object count as done."""
    project = Project(tmp_path_factory.mktemp("finished"))
    project.config |= {"scene": {"chunks": 1}, "registration": {"variants": ["full"]}}
    project.photos("flight")
    project.photos("close")
    for name in ("clicks.tsv", "prompts.tsv"):
        (project.path / name).write_text(CLICKS)
    config = project.write()
    listed = snakemake(project.path, "--summary", CROP, MASKS, config=config).stdout
    for name in [line.split("\t")[0] for line in listed.splitlines() if line.startswith("results/")]:
        path = project.path / name
        (path.parent if path.suffix else path).mkdir(parents=True, exist_ok=True)
        if path.suffix:
            path.write_text("{}")
    done = snakemake(project.path, "--touch", "--forceall", CROP, MASKS, config=config)
    assert done.returncode == 0, done.stdout
    return project.path


@pytest.fixture
def plan(finished, tmp_path, snakemake):
    """What a run of a copy would do, after the change that `edit` makes in the copy."""

    def run(edit, place="copy") -> set[str]:
        shutil.copytree(finished, tmp_path / place)
        edit(tmp_path / place)
        done = snakemake(tmp_path / place, "--dry-run", CROP, MASKS, config=tmp_path / place / "mine.yaml")
        assert done.returncode == 0, done.stdout
        return planned(done.stdout)

    return run


def replace(name: str):
    """An edit that puts another file in the place of one, with an older date as `cp -p`, rsync and unzip do."""

    def edit(path):
        (path / name).write_bytes(CLICKS.replace("40", "41").encode() if name.endswith(".tsv") else b"other")
        os.utime(path / name, (1_000_000_000, 1_000_000_000))

    return edit


def test_neither_another_place_nor_a_file_that_is_no_photo_reruns_anything(plan):
    def edit(path):
        (path / "flight/.DS_Store").write_bytes(b"desktop")
        (path / "close/notes.txt").write_text("sunny")

    assert plan(edit, place="much/deeper/than/before") == set()


def test_a_photo_replaced_by_an_older_one_reruns_what_reads_it(plan):
    rules = plan(replace("flight/1.jpg"))
    assert {"list_photos", "extract_scene_features", "map_scene_photos", "undistort_scene_photos"} <= rules
    assert not {"extract_frames", "make_masks"} & rules


def test_an_older_photo_of_the_object_reruns_its_frames(plan):
    assert "extract_frames" in plan(replace("close/1.jpg"))


# The masks mark the crop.
@pytest.mark.parametrize("name, rules", [("prompts.tsv", {"make_masks", "crop_scene"}), ("clicks.tsv", {"crop_scene"})])
def test_older_clicks_rerun_what_reads_them_and_nothing_else(plan, name, rules):
    assert plan(replace(name)) == rules


def test_a_correction_that_the_page_saves_reruns_the_masks_and_what_they_mark(plan):
    def correct(path):
        (path / "prompts.tsv").write_text("label\tphoto\tx_px\ty_px\ninside\t0.jpg\t30\t20\n")
        document = Document(path / "prompts.tsv", "labels")
        document.change((*document.rows, Click("outside", "1.jpg", 3, 4)))

    assert plan(correct) == {"make_masks", "crop_scene"}


def test_a_mask_that_lies_among_the_photos_reruns_the_masks_when_it_changes(plan, snakemake):
    def give(path):
        for k in range(3):
            (path / f"close/{k}_mask.png").write_bytes(b"a mask")
        (path / "objects.tsv").write_text("object\tscene\tphotos\tmasks\nshed\tyard\tclose\tclose\n")
        done = snakemake(path, "--touch", "--forceall", MASKS, config=path / "mine.yaml")
        assert done.returncode == 0, done.stdout

    def give_and_change(path):
        give(path)
        replace("close/1_mask.png")(path)

    assert "make_masks" not in plan(give) and "make_masks" in plan(give_and_change, place="changed")


@pytest.mark.parametrize("name", ["a{1}.jpg", "a<b>.jpg"])
def test_a_photo_whose_name_snakemake_would_expand_is_listed_and_a_change_of_it_is_noticed(plan, name):
    def add(project):
        shutil.copy(next((project / "flight").glob("*.jpg")), project / "flight" / name)

    assert "list_photos" in plan(add)


def test_a_scene_s_video_is_listed_by_a_run_and_its_subtitles_are_inputs(tmp_path, snakemake):
    project, listed = Project(tmp_path), "results/scenes/yard/photos.json"
    film(tmp_path / "flown.mp4")
    project.photos("close")
    for name in ("clicks.tsv", "prompts.tsv"):
        (tmp_path / name).write_text(CLICKS)
    project.scenes = "scene\tphotos\nyard\tflown.mp4\n"
    config = project.write()
    whole = snakemake(tmp_path, "-n", config=config)
    assert whole.returncode == 0 and {"list_photos", "georegister", "complete_scene"} <= planned(whole.stdout)
    made = snakemake(tmp_path, listed, config=config)
    assert made.returncode == 0, made.stdout
    content = read_json(tmp_path / listed)
    assert (value(content, "kind"), value(content, "count"), value(content, "with_gps")) == ("video", 12, 12)
    assert "Nothing to be done" in snakemake(tmp_path, "-n", listed, config=config).stdout
    replace("flown.SRT")(tmp_path)
    assert planned(snakemake(tmp_path, "-n", listed, config=config).stdout) == {"list_photos"}


def test_settings_of_a_row_rerun_that_row_only_and_what_reads_it(plan):
    def of_object(path):
        (path / "own.yaml").write_text("object: { undistort: { max_size_px: 900 } }")
        table = (path / "objects.tsv").read_text().splitlines()
        (path / "objects.tsv").write_text(f"{table[0]}\tconfig\n{table[1]}\town.yaml\n")

    def of_scene(path):
        (path / "own.yaml").write_text("scene: { undistort: { max_size_px: 900 } }")
        (path / "scenes.tsv").write_text("scene\tphotos\tconfig\nyard\tflight\town.yaml\n")

    assert plan(of_object) == {"undistort_object_photos", "make_masks", "crop_scene"}
    assert "undistort_scene_photos" in plan(of_scene, place="scene") and "undistort_object_photos" not in plan(
        of_scene, place="again"
    )
