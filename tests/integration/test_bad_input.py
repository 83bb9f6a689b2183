"""Bad input ends in one clear sentence, a non-zero exit, and no partial output."""

import re
import shutil

import pytest
from support.user_project import HEADER, planned


@pytest.fixture
def refused(project, snakemake):
    """Run targets of the project, which fails; returns what the user sees."""

    def run(*targets: str) -> str:
        result = snakemake(project.path, *targets, config=project.write())
        assert result.returncode != 0
        return result.stdout

    return run


def test_typo_in_a_key(project, refused):
    project.config = project.config | {"scene": {"matches": {"max_rati": 0.8}}}
    assert re.search(
        r"mine\.yaml, line \d, scene.matches: 'max_rati' is unknown; did you mean 'max_ratio'", refused("-n")
    )


def test_unknown_object_in_a_target(refused):
    assert "unknown object 'shad'; objects.tsv lists: shed" in refused("-n", "results/objects/shad/fused.ply")


def test_an_object_in_no_scene_ends_with_its_cloud(project, snakemake, refused):
    project.photos("close")
    project.scenes, project.objects = "scene\tphotos\n", HEADER + "shed\t\tclose\t\tprompts.tsv\t\n"
    (project.path / "prompts.tsv").write_text("label\tphoto\tx_px\ty_px\ninside\t1.jpg\t20\t20\n")
    result = snakemake(project.path, "-n", config=project.write())
    rules = planned(result.stdout)
    assert result.returncode == 0 and {"make_object_cloud", "draw_lone_object", "write_report"} <= rules
    assert not {rule for rule in rules if "scene" in rule or "fuse" in rule or "regist" in rule}
    told = refused("-n", "results/objects/shed/fused.ply")
    assert "objects.tsv: object 'shed' lies in no scene" in told and "name its scene in the column scene" in told


def test_weights_are_fetched_only_where_the_masks_may_need_them(project, snakemake):
    project.photos("close")
    project.scenes, project.objects = "scene\tphotos\n", HEADER + "shed\t\tclose\t\tprompts.tsv\t\n"
    (project.path / "prompts.tsv").write_text("label\tphoto\tx_px\ty_px\ninside\t1.jpg\t20\t20\n")

    def fetches(**masks):
        project.config["object"] = {"masks": masks}
        result = snakemake(project.path, "-n", "results/objects/shed/masks.png", config=project.write())
        assert result.returncode == 0, result.stdout
        return "fetch_sam2_weights" in planned(result.stdout)

    assert fetches() and fetches(method="sam2")
    assert not fetches(method="grabcut")
    # As the clicking page leaves them.
    (project.path / "results/weights/sam2").mkdir(parents=True)
    assert not fetches()


def test_missing_photo_folder(refused):
    assert "scenes.tsv, scene 'yard': the photos flight do not exist" in refused(
        "-n", "results/scenes/yard/photos.json"
    )


def test_empty_photo_folder(project, refused):
    (project.path / "flight").mkdir()
    output = refused("-n", "results/scenes/yard/photos.json")
    assert "scenes.tsv, scene 'yard': the photo folder flight holds no photos" in output


def test_an_unreadable_photo_is_named_and_jobs_of_one_machine_share_its_memory_and_its_card(project, refused):
    project.photos("flight")
    (project.path / "flight/1.jpg").write_bytes(b"\xff\xd8\xff\xe0 broken")
    output = refused("results/scenes/yard/photos.json")
    assert "error: " in output and "1.jpg" in output
    assert not (project.path / "results/scenes/yard/photos.json").exists()
    bounds = next(line for line in output.splitlines() if "Provided resources" in line)
    assert "mem_mb" in bounds and "gpu" in bounds


def test_too_few_registered_photos(project, refused):
    project.photos("flight", 4)
    output = refused("results/scenes/yard/sparse.json")
    assert "error: " in output
    assert not (project.path / "results/scenes/yard/sparse").exists()


def test_object_without_prompts_and_masks(project, refused):
    project.photos("close")
    project.objects = HEADER + "shed\tyard\tclose\tclicks.tsv\t\t\n"
    assert "'shed' has neither prompts nor masks" in refused("-n", "results/objects/shed/masks.json")


def test_an_object_of_few_photos_stops_before_anything_runs(project, refused):
    project.photos("close", 4)
    project.objects = "object\tphotos\tprompts\nshed\tclose\tprompts.tsv\n"
    assert "object 'shed' has 4 photos, 5 or more are needed" in refused("-n", "results/objects/shed/masks.png")


@pytest.mark.parametrize(
    ("table", "column", "target"),
    [
        ("scenes", "calibration", "results/scenes/yard/features.db"),
        ("scenes", "cameras", "results/scenes/yard/sparse.json"),
        ("scenes", "control", "results/scenes/yard/georeference.json"),
        ("scenes", "lengths", "results/scenes/yard/georeference.json"),
        ("objects", "lengths", "results/objects/shed/sparse.json"),
        ("objects", "prompts", "results/objects/shed/masks.json"),
        ("objects", "fiducials", "results/objects/shed/registration/full/crop.json"),
    ],
)
def test_a_file_in_a_table_that_is_not_there_is_one_sentence(project, refused, table, column, target):
    project.photos("flight")
    project.photos("close")
    (project.path / "prompts.tsv").write_text("label\tphoto\tx_px\ty_px\ninside\t0.jpg\t1\t2\n")
    cells = {"scene": "yard", "photos": "close", "prompts": "prompts.tsv"} | {column: "mine.x"}
    if table == "scenes":
        project.scenes = f"scene\tphotos\t{column}\nyard\tflight\tmine.x\n"
    else:
        project.objects = "\t".join(["object", *cells]) + "\n" + "\t".join(["shed", *cells.values()]) + "\n"
    name = "scene 'yard'" if table == "scenes" else "object 'shed'"
    output = refused("-n", target)
    assert "error: " in output and f"{table}.tsv, {name}: mine.x in the column {column} does not exist" in output
    assert "Traceback" not in output


def test_known_lengths_in_unknown_photos_of_an_object_stop_before_anything_runs(project, refused):
    project.photos("close")
    project.objects = "object\tphotos\tprompts\tlengths\nshed\tclose\tprompts.tsv\tbar.tsv\n"
    (project.path / "prompts.tsv").write_text("label\tphoto\tx_px\ty_px\ninside\t0.jpg\t1\t2\n")
    rows = [f"bar\t1.5\t{end}\t{photo}.jpg\t10\t10" for end in "ab" for photo in (0, 7)]
    (project.path / "bar.tsv").write_text("\n".join(["length\tmetres\tend\tphoto\tx_px\ty_px", *rows]) + "\n")
    output = refused("-n", "results/objects/shed/sparse.json")
    assert (
        "object 'shed': bar.tsv: point bar, 1.5 m: a is clicked in 7.jpg, which is none of the 5 photos (0.jpg, ...)"
        in output
    )


@pytest.mark.parametrize(
    ("column", "cells", "words"),
    [
        ("prompts", "7.jpg\t1\t2", "in 7.jpg, which is none of the 5 photos (0.jpg, ...)"),
        ("prompts", "2.jpg\t1\t2", "in 2.jpg, but only 2 of the 5 photos are used (object.frames)"),
        ("fiducials", "7.jpg\t1\t2", "in 7.jpg, which is none of the 5 photos (0.jpg, ...)"),
        ("fiducials", "0.jpg\t1,5\t2", "1,5 has a decimal comma, write 1.5"),
    ],
)
def test_clicks_that_cannot_be_used_stop_before_anything_runs(project, refused, column, cells, words):
    project.photos("flight")
    project.photos("close")
    project.config["object"]["frames"] = {"max_frames": 2}
    project.objects = HEADER + "shed\tyard\tclose\tfiducials.tsv\tprompts.tsv\t\n"
    for name in ("fiducials", "prompts"):
        click = cells if name == column else "0.jpg\t1\t2"
        (project.path / f"{name}.tsv").write_text(f"label\tphoto\tx_px\ty_px\ninside\t{click}\n")
    output = refused("-n", "results/objects/shed/fused.ply")
    assert f"objects.tsv, object 'shed': {column}.tsv" in output and words in output


def test_a_click_in_a_photo_that_is_used_since_others_are_copies_is_no_error(project, snakemake):
    project.photos("close")
    shutil.copy(project.path / "close/0.jpg", project.path / "close/0 copy.jpg")
    project.config["object"]["frames"] = {"frame_step": 3}
    project.scenes, project.objects = "scene\tphotos\n", HEADER + "shed\t\tclose\t\tprompts.tsv\t\n"
    (project.path / "prompts.tsv").write_text("label\tphoto\tx_px\ty_px\ninside\t3.jpg\t20\t20\n")
    result = snakemake(project.path, "-n", "results/objects/shed/masks.png", config=project.write())
    assert result.returncode == 0, result.stdout


def test_masks_of_other_photos_stop_before_anything_runs(project, refused):
    project.photos("close")
    project.photos("masks")
    for k in range(5):
        (project.path / f"masks/{k}.jpg").rename(project.path / f"masks/DJI_{k}.jpg")
    project.scenes, project.objects = "scene\tphotos\n", HEADER + "shed\t\tclose\t\t\tmasks\n"
    said = "object 'shed': masks that match no photo: 5 masks in masks (first: DJI_0.jpg), photos are named like 0.jpg;"
    assert said in refused("-n", "results/objects/shed/masks.png")


def test_control_points_in_unknown_photos_stop_before_anything_runs(project, refused):
    project.photos("flight")
    project.scenes = "scene\tphotos\tcontrol\nyard\tflight\tgcp.txt\n"
    (project.path / "gcp.txt").write_text("EPSG:32632\n1 2 3 10 10 0.jpg A\n1 2 3 10 10 7.jpg A\n")
    output = refused("-n", "results/scenes/yard/georeference.json")
    assert "scene 'yard': gcp.txt: point A is clicked in 7.jpg, which is none of the 5 photos (0.jpg, ...)" in output
