"""What the page opens for an object: its tables and photos, and the masks of its clicks."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.user_project import HEADER, Project

from scenefuse.core.stage import StageError, write_json
from scenefuse.geometry.visual_hull import mask_iou
from scenefuse.marks.clicks import Click, label_name
from scenefuse.pick.photo_tiles import Picture
from scenefuse.pick.segmenter import Segmenter
from scenefuse.pick.session import Session, next_command

GRABCUT = {"method": "grabcut", "max_click_residual_px": 4}


@pytest.fixture
def yard(tmp_path, monkeypatch):
    project = Project(tmp_path)
    project.photos("flight")
    project.photos("close", 5)
    monkeypatch.chdir(tmp_path)
    return project


def opened(project, name="shed"):
    return Session(name, (project.write(),))


def test_an_object_has_its_prompts_and_the_marks_in_its_scene(yard):
    first, second, _ = opened(yard).tables
    assert (first.document.path.name, second.document.path.name) == ("prompts.tsv", "clicks.tsv")
    for table, folder in ((first, "close"), (second, "flight")):
        assert [str(picture.path) for picture in table.pictures.values()] == [f"{folder}/{k}.jpg" for k in range(5)]
    assert first.sizes["0.jpg"] == (64, 48) and first.listed and first.cameras is None


def test_of_several_settings_files_the_last_one_counts(yard):
    first, last = yard.write(), yard.path / "last.yaml"
    last.write_text("object: {masks: {method: auto}}")
    assert Session("shed", (first,)).segmenter._settings["method"] == "grabcut"
    assert Session("shed", (first, last)).segmenter._settings["method"] == "auto"


def test_masks_of_one_s_own_are_said_to_count_in_the_place_of_clicks(yard):
    yard.objects = HEADER + "shed\tyard\tclose\tclicks.tsv\tprompts.tsv\tmy masks\n"
    assert any("the column masks is filled (my masks)" in note for note in opened(yard).tables[0].notes)


def test_clicks_that_the_workflow_left_out_are_said(yard):
    report = {"dropped": {"0.jpg": "too small"}, "per_photo": {"0.jpg": {"area": 0.0, "agreement": 0.1}}}
    report |= {"clicks_left_out": {"value": ["the click inside is off"]}, "notes": {"value": []}}
    write_json(yard.path / "results/objects/shed/masks.json", report)
    assert opened(yard).masks.notes == ["the click inside is off"]


def test_photos_say_what_the_workflow_makes_of_them(yard):
    report = {"dropped": {"0.jpg": "too small"}, "per_photo": {"0.jpg": {"area": 0.0, "agreement": 0.1}}}
    report["per_photo"] |= {"1.jpg": {"area": 0.1, "agreement": 0.93}}
    report |= {"clicks_left_out": {"value": []}, "notes": {"value": []}}
    write_json(yard.path / "results/objects/shed/masks.json", report)
    session = opened(yard)
    assert [session.standing(0, f"{k}.jpg") for k in range(3)] == [("left out", True), ("0.93", False), ("", False)]
    assert session.standing(1, "1.jpg") == ("", False)
    session.tables[0].cameras = {"1.jpg"}
    assert [session.standing(0, f"{k}.jpg")[0] for k in range(3)] == ["no camera", "0.93", "no camera"]


def test_a_photo_that_cannot_be_read_does_not_keep_the_others_waiting(yard):
    session = opened(yard)
    (yard.path / "close/2.jpg").write_bytes(b"cut")
    session.make_thumbnails()
    assert session.thumbnails_left(0) == 0 and any("2.jpg" in note for note in session.tables[0].notes)


def test_without_cells_tables_lie_beside_the_table_of_objects_and_it_is_said(yard):
    yard.objects = HEADER + "shed\tyard\tclose\t\t\t\n"
    tables = opened(yard).tables
    assert [table.document.path.name for table in tables] == [
        "shed_prompts.tsv",
        "shed_fiducials.tsv",
        "yard_lengths.tsv",
    ]
    assert not any(table.listed for table in tables)


def test_known_lengths_are_clicked_in_the_scene_s_photos(yard):
    (yard.path / "bars.tsv").write_text(
        "length\tmetres\tend\tphoto\tx_px\ty_px\nbar\t1.5\tleft\t0.jpg\t10\t20\nbar\t1.5\tright\t1.jpg\t30\t20\n"
    )
    yard.scenes = "scene\tphotos\tlengths\nyard\tflight\tbars.tsv\n"
    table = opened(yard).tables[2]
    assert table.document.kind == "lengths" and table.listed and not table.document.trouble
    assert [label_name(row.label) for row in table.document.rows] == ["bar, 1.5 m: left", "bar, 1.5 m: right"]
    assert table.pictures.keys() == opened(yard).tables[1].pictures.keys()


def test_an_object_by_itself_has_known_lengths_in_its_own_photos(yard):
    yard.objects = "object\tphotos\tprompts\nshed\tclose\tprompts.tsv\n"
    first, second = opened(yard).tables
    assert (first.document.path.name, second.document.path.name) == ("prompts.tsv", "shed_lengths.tsv")
    assert second.document.kind == "lengths" and second.of == "objects"
    assert second.result.as_posix() == "results/objects/shed/sparse.json"


def test_photos_have_the_names_that_the_workflow_gives_them(yard):
    (yard.path / "close/ring").mkdir()
    (yard.path / "close/0.jpg").rename(yard.path / "close/ring/0.jpg")
    yard.config["object"] = {"frames": {"frame_step": 2}}
    assert list(opened(yard).tables[0].pictures) == ["1.jpg", "3.jpg", "ring_0.jpg"]


def test_frames_of_a_video_are_clicked_in_the_video_s_pixels(yard):
    (yard.path / "walk.mp4").write_bytes(b"video")
    yard.objects = HEADER + "shed\tyard\twalk.mp4\t\tprompts.tsv\t\n"
    with pytest.raises(StageError, match="scenefuse run results/objects/shed/photos.json"):
        opened(yard)
    frames = yard.path / "results/objects/shed/frames"
    frames.mkdir(parents=True)
    cv2.imwrite(str(frames / "frame_000003.jpg"), np.zeros((300, 400, 3), dtype=np.uint8))
    origin = {"frame_000003.jpg": {"frame": 3, "width": 1600, "height": 1200}}
    write_json(frames.parent / "photos.json", {"origin": {"value": origin, "unit": ""}})
    picture = opened(yard).tables[0].pictures["frame_000003.jpg"]
    assert (picture.width, picture.height, picture.scale) == (1600, 1200, 0.25)


def test_a_scene_s_video_is_clicked_in_once_its_frames_are_there(yard):
    (yard.path / "flown.mp4").write_bytes(b"video")
    yard.scenes = "scene\tphotos\nyard\tflown.mp4\n"
    assert [table.column for table in opened(yard).tables] == ["prompts"]
    frames = yard.path / "results/scenes/yard/photos"
    frames.mkdir(parents=True)
    cv2.imwrite(str(frames / "frame_000003.jpg"), np.zeros((300, 400, 3), dtype=np.uint8))
    origin = {"frame_000003.jpg": {"frame": 3, "width": 400, "height": 300}}
    write_json(frames.parent / "photos.json", {"origin": {"value": origin, "unit": ""}})
    fiducials = opened(yard).tables[1]
    assert fiducials.column == "fiducials" and fiducials.sizes == {"frame_000003.jpg": (400, 300)}


def test_the_only_object_needs_no_name_and_of_two_one_is_named(yard):
    assert Session(None, (yard.write(),)).name == "shed"
    yard.objects += "barn\tyard\tclose\t\t\t\n"
    with pytest.raises(StageError, match="say by --object which one of shed, barn"):
        Session(None, (yard.write(),))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda p: None, "unknown object 'barn'; objects.tsv lists: shed"),
        (lambda p: (p.path / "close/2.jpg").write_bytes(b"x"), r"close/2\.jpg cannot be decoded"),
    ],
)
def test_what_is_wrong_is_said_before_the_page_opens(yard, change, expected):
    change(yard)
    with pytest.raises(StageError, match=expected):
        opened(yard, "barn" if "barn" in expected else "shed")


def test_an_object_without_photos_has_nothing_to_click_in(yard):
    yard.objects = "object\tscene\tcloud\nshed\tyard\tshed.ply\n"
    yard.scenes = "scene\tcloud\nyard\tyard.ply\n"
    with pytest.raises(StageError, match="no photos to click in"):
        opened(yard)


def test_results_are_noticed_when_they_come(yard):
    session = opened(yard)
    assert not session.masks.agreement
    report = {"dropped": {}, "per_photo": {"0.jpg": {"area": 0.1, "agreement": 0.8}}}
    write_json(yard.path / "results/objects/shed/masks.json", report)
    session.read_results()
    assert session.masks.agreement == {"0.jpg": 0.8}
    (yard.path / "results/objects/shed/masks.json").write_text("{")
    assert "cannot be read" in opened(yard).masks.notes[0]


@pytest.fixture
def ball(tmp_path):
    """A red disc on green, at 600 x 400 pixels, and its mask."""
    v, u = np.mgrid[:400, :600]
    mask = np.hypot(u - 250, v - 180) < 90
    noise = np.random.default_rng(0).normal(0, 6, (400, 600, 3))
    pixels = np.where(mask[..., None], [190, 60, 50], [70, 130, 60]) + noise
    cv2.imwrite(str(tmp_path / "ball.png"), pixels.clip(0, 255).astype(np.uint8)[..., ::-1])
    return Picture("ball.png", tmp_path / "ball.png", 1200, 800, 0.5), mask


def test_clicks_give_the_mask_of_their_photo(ball):
    picture, mask = ball
    rows = tuple(Click("inside", "ball.png", 2 * x, 2 * y) for x, y in ((250, 120), (200, 220), (300, 220)))
    rows += (Click("outside", "ball.png", 1100, 700), Click("inside", "other.png", 3, 3))
    found, notes = Segmenter(GRABCUT, 1600).mask(picture, rows)
    assert found.shape == mask.shape and mask_iou(found, mask) > 0.95 and notes == []


def test_a_box_gives_a_mask_and_a_click_that_contradicts_it_is_counted(ball):
    picture, mask = ball
    box = (Click("box", "ball.png", 280, 140), Click("box", "ball.png", 720, 580))
    found, notes = Segmenter(GRABCUT, 1600).mask(picture, box)
    assert mask_iou(found, mask) > 0.95 and notes == []
    rows = (*box, Click("inside", "ball.png", 1100, 700))
    _, notes = Segmenter(GRABCUT, 1600).mask(picture, rows)
    assert any(note.startswith("left out: the click inside at (1100, 700) in ball.png") for note in notes)
    alone = (Click("inside", "ball.png", 500, 360), Click("outside", "other.png", 3, 3))
    assert any("click beside the object too" in note for note in Segmenter(GRABCUT, 1600).mask(picture, alone)[1])


def test_a_click_on_the_sky_is_told_at_once_and_one_on_the_object_is_not(tmp_path):
    pixels = np.full((400, 600, 3), 235, dtype=np.uint8)
    pixels[200:] = np.random.default_rng(0).integers((20, 90, 20), (80, 150, 80), (200, 600, 3))
    cv2.imwrite(str(tmp_path / "a.png"), pixels)
    picture, segmenter = Picture("a.png", tmp_path / "a.png", 600, 400), Segmenter(GRABCUT, 1600)
    up, down = Click("inside", "a.png", 300, 80), Click("inside", "a.png", 300, 320)
    doubts = "a click lies where other photos can share nothing, as in the sky"
    sky, ground = (segmenter.mask(picture, (a, replace(b, label="outside")))[1] for a, b in ((up, down), (down, up)))
    assert any(doubts in note for note in sky) and not any(doubts in note for note in ground)
    # Once the workflow has sparse points, these decide.
    shared = np.array([(300.0, 60.0)])
    notes = segmenter.mask(picture, (up, replace(down, label="outside")), shared)[1]
    assert not any(doubts in note for note in notes)


def test_a_box_that_makes_a_mask_worse_is_left_out_and_that_is_said(ball):
    picture, mask = ball
    good = tuple(Click("inside", "ball.png", 2 * x, 2 * y) for x, y in ((250, 120), (200, 220), (300, 220)))
    good += (Click("outside", "ball.png", 1100, 700),)
    # The box holds a third of the disc: two of the clicks on it lie outside.
    box = (Click("box", "ball.png", 320, 140), Click("box", "ball.png", 680, 300))
    segmenter = Segmenter(GRABCUT, 1600)
    found, notes = segmenter.mask(picture, good + box)
    assert mask_iou(found, mask) > 0.95
    assert notes[0] == "left out: the box in ball.png: without it the mask holds more of the clicks"
    assert segmenter.mask(picture, good)[1] == []


def test_without_weights_grabcut_takes_their_place_and_the_page_says_so(ball, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results/weights/sam2").mkdir(parents=True)
    segmenter = Segmenter(GRABCUT | {"method": "sam2"}, 1600)
    segmenter.load()
    assert segmenter.method == "GrabCut" and "encoder.ort do not exist" in segmenter.trouble


def test_weights_that_cannot_be_fetched_leave_nothing_behind_and_the_page_says_so(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NPM_CONFIG_REGISTRY", (tmp_path / "none").as_uri())
    settings = {"method": "auto"}
    segmenter = Segmenter(GRABCUT | settings, 1600)
    segmenter.load()
    assert segmenter.method == "GrabCut" and "No such file" in segmenter.trouble
    assert not list((tmp_path / "results/weights").iterdir())


def test_the_next_command_is_the_one_to_type():
    target = Path("results/objects/shed/masks.png")
    for own in ((), (Path("config/config.yaml"),)):
        assert next_command(own, target) == "scenefuse run results/objects/shed/masks.png"
    given = next_command((Path("/a/my settings.yaml"), Path("few.yaml")), target)
    assert given.startswith("scenefuse run --configfile '/a/my settings.yaml' few.yaml results/")
