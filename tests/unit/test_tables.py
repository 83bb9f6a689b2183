"""A user's tables and settings: read as people write them, or refused in one sentence."""

import codecs
import re
from pathlib import Path

import pytest
import yaml

from scenefuse.core.project import read_project
from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_table, read_text

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def table(tmp_path):
    def write(text: str, encoding: str = "utf-8"):
        path = tmp_path / "objects.tsv"
        path.write_bytes(text.encode(encoding))
        return path

    return write


def test_rows_go_by_the_named_column_wherever_it_stands(table):
    rows = read_table(table("scene\tobject\tphotos\nyard\tshed\tclose\n"), "object")
    assert rows == {"shed": {"scene": "yard", "object": "shed", "photos": "close"}}


def test_comments_empty_lines_and_line_ends_of_all_systems_do_no_harm(table):
    for end in ("\n", "\r\n", "\r"):
        lines = ["# mine", "object\tphotos", "", "# one", "shed\tclose", ""]
        assert list(read_table(table(end.join(lines)), "object").values()) == [{"object": "shed", "photos": "close"}]


def test_what_a_spreadsheet_puts_around_cells_does_no_harm(table, monkeypatch):
    monkeypatch.setenv("HOME", "/home/ann")
    lines = [
        '"# photos: a folder, or a video"',
        "object\tphotos \tmasks\t\t",
        "\t\t\t\t",
        "shed\t~/close up\t\t\t",
        "barn\tb",
    ]
    rows = read_table(table("\r\n".join(lines)), "object")
    assert rows["shed"] == {"object": "shed", "photos": "/home/ann/close up", "masks": ""}
    assert rows["barn"] == {"object": "barn", "photos": "b", "masks": ""}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_unicode_with_and_without_a_mark_is_read(table, encoding):
    path = table("object\tphotos\nshed\tGärten\n", encoding)
    assert read_table(path, "object")["shed"]["photos"] == "Gärten"


def test_the_mark_at_the_end_of_a_dos_text_is_no_row(table):
    assert list(read_table(table("object\nshed\n\x1a"), "object")) == ["shed"]


def test_big_endian_unicode_is_read(tmp_path):
    (tmp_path / "a.tsv").write_bytes(codecs.BOM_UTF16_BE + "object\nshed\n".encode("utf-16-be"))
    assert list(read_table(tmp_path / "a.tsv", "object")) == ["shed"]


@pytest.mark.parametrize(
    "encoding, sentence",
    [("latin-1", r"objects\.tsv, line 2: not UTF-8 text; save it as UTF-8"), ("utf-16-le", "looks like UTF-16")],
)
def test_another_encoding_is_named_with_its_file(table, encoding, sentence):
    with pytest.raises(StageError, match=sentence):
        read_text(table("object\tphotos\nshed\tGärten\n", encoding))


@pytest.mark.parametrize(
    "text, sentence",
    [
        ("scene\tphotos\nyard\tclose\n", "has no column 'object'; its first line names: scene, photos"),
        ("object;photos\nshed;close\n", "its first line names: object;photos; separate columns by tabs"),
        ("", "has no column 'object'; its first line names: nothing"),
        ("object\tobject\nshed\tshed\n", "two columns 'object'"),
        ("object\tphotos\nshed\n", "row 1: 1 columns, and the header has 2; separate them by tabs"),
        ("object\tphotos\nshed\ta\nbarn\ta\tb\n", "row 2: 3 columns, and the header has 2"),
        ('object\tphotos\n"shed\ta\nbarn\tb\n', "the quote before shed a barn b takes several cells into one"),
        ('object\tphotos\nshed\t"a\nbarn\tb\n', "the quote before a barn b takes several cells into one"),
        ("PK\3\4\0\0\0", "is a spreadsheet or an archive, whatever its name; save it as tab-separated text"),
        ("SQLite format 3\0\0\0", "is no text, it holds binary data; give a text file"),
        ("object\tphotos\nshed\ta\nshed\tb\n", "'shed' stands in two rows; names must differ"),
    ],
    ids=[
        "no such column",
        "semicolons",
        "empty",
        "column twice",
        "too few",
        "too many",
        "quote",
        "last quote",
        "xlsx",
        "binary",
        "name twice",
    ],
)
def test_a_bad_table_is_one_sentence_with_its_file(table, text, sentence):
    with pytest.raises(StageError, match=f"objects.tsv.*{sentence}"):
        read_table(table(text), "object")


@pytest.fixture
def project(tmp_path, monkeypatch):
    """Read a project whose tables hold these rows."""
    monkeypatch.chdir(tmp_path)

    def read(scene_row="yard\tflight", object_row="shed\tyard\tclose", **settings):
        (tmp_path / "scenes.tsv").write_text(f"scene\tphotos\n{scene_row}\n")
        (tmp_path / "objects.tsv").write_text(f"object\tscene\tphotos\n{object_row}\n")
        return read_project({"scenes": "scenes.tsv", "objects": "objects.tsv"} | settings)

    return read


def test_a_folder_whose_name_begins_like_an_option_stays_a_folder(project):
    assert project("yard\t-flight").scenes["yard"]["photos"] == "./-flight"


def test_as_shipped_only_the_registration_that_is_fused_runs_and_the_demo_adds_what_it_is_compared_with(project):
    assert set(project().variants) == {"full"}
    demo = yaml.safe_load((ROOT / "config/demo.yaml").read_text())
    assert set(project(**demo).variants) == {"full", "paper", "clouds_only"}


def test_variants_are_the_settings_of_registration_with_what_differs(project):
    whole = project(registration={"variants": ["full", "no_crop"], "crop": {"mode": "masks"}})
    found = {variant: whole.registration("shed", variant) for variant in whole.variants}
    assert set(found) == {"full", "no_crop"}
    assert found["full"]["crop"]["mode"] == found["no_crop"]["crop"]["mode"] == "masks"
    assert found["no_crop"]["crop"] != found["full"]["crop"]
    assert found["no_crop"]["fine"] == found["full"]["fine"] | {"use_alignment": False}


def test_with_recipe_paper_all_variants_have_the_papers_crop(project):
    some = {"variants": ["full", "paper", "no_scale", "no_crop"]}
    shipped, paper = (project(object={"recipe": r}, registration=some).variants for r in ("scenefuse", "paper"))
    assert paper["full"] == shipped["paper"] != shipped["full"]
    assert paper["no_scale"]["crop"] == paper["full"]["crop"] and paper["no_scale"]["scale"] == {"method": "none"}
    assert paper["no_crop"]["crop"] == paper["full"]["crop"] | {"whole_scene": True}


@pytest.fixture
def own_project(tmp_path, monkeypatch):
    """A project of two objects, one of which has settings of its own."""
    monkeypatch.chdir(tmp_path)

    def read(content, column="objects", **settings):
        (tmp_path / "own.yaml").write_text(content)
        cells = {name: "own.yaml" if name == column else "" for name in ("scenes", "objects")}
        (tmp_path / "scenes.tsv").write_text(f"scene\tphotos\tconfig\nyard\tflight\t{cells['scenes']}\n")
        rows = f"shed\tyard\tclose\t{cells['objects']}\nbarn\tyard\tother\t\n"
        (tmp_path / "objects.tsv").write_text(f"object\tscene\tphotos\tconfig\n{rows}")
        return read_project({"scenes": "scenes.tsv", "objects": "objects.tsv"} | settings)

    return read


def test_settings_of_a_row_are_those_of_the_run_with_what_differs(own_project):
    text = "object: {nerf: {width_px: 640}}\nregistration: {crop: {margin: 0.2}}\nfusion: {unconfirmed: all}"
    run = {"object": {"nerf": {"levels": 10}}, "registration": {"variants": ["full", "no_crop"]}}
    found = own_project(text, **run)
    shed, barn = found.of("object", "shed"), found.of("object", "barn")
    assert (shed["object"]["nerf"]["width_px"], barn["object"]["nerf"]["width_px"]) == (640, 800)
    assert shed["object"]["nerf"]["levels"] == barn["object"]["nerf"]["levels"] == 10
    assert [row["fusion"]["unconfirmed"] for row in (shed, barn)] == ["all", "plain"]
    assert found.registration("shed", "full")["crop"]["margin"] == 0.2
    assert found.registration("shed", "no_crop")["crop"] == shed["registration"]["crop"] | {"whole_scene": True}
    assert found.registration("barn", "full")["crop"]["margin"] == 0.05
    assert barn == found.settings and shed["scene"] == found.settings["scene"]


def test_a_scene_has_settings_of_its_own_too(own_project):
    found = own_project("scene: {undistort: {max_size_px: 3000}}", "scenes")
    assert found.of("scene", "yard")["scene"]["undistort"]["max_size_px"] == 3000
    assert found.settings["scene"]["undistort"]["max_size_px"] == 2000


@pytest.mark.parametrize(
    "content, column, sentence",
    [
        (
            "object: {nerf: {widht: 1}}",
            "objects",
            "object 'shed': own.yaml, line 1, object.nerf: 'widht' is unknown",
        ),
        (
            "scene: {matches: {max_ratio: 0.8}}",
            "objects",
            "'scene' does not concern one object; it may hold object",
        ),
        ("object: {hold_out_every: 4}", "scenes", "'object' does not concern one scene; it may hold scene"),
        ("seed: 3", "objects", "'seed' does not concern one object"),
        ("scene: {chunks: 9}", "scenes", "scene.chunks is the same for the whole run"),
        ("registration: {variants: [full]}", "objects", "registration.variants is the same for the whole run"),
        ("[1, 2]", "objects", "own.yaml holds no settings"),
        ("object: {", "objects", "own.yaml is no YAML"),
    ],
)
def test_bad_settings_of_a_row_are_one_sentence(own_project, content, column, sentence):
    with pytest.raises(StageError, match=re.escape(sentence)):
        own_project(content, column)


def test_settings_of_a_row_that_are_not_there_are_named_with_the_row(own_project, tmp_path):
    own_project("")
    (tmp_path / "own.yaml").unlink()
    with pytest.raises(StageError, match="object 'shed': the settings file .*own.yaml cannot be read"):
        read_project({"scenes": "scenes.tsv", "objects": "objects.tsv"})


def test_the_variant_that_is_fused_comes_first_in_whatever_order_they_are_written(project):
    found = project(registration={"variants": ["paper", "no_crop", "full"]})
    assert list(found.variants) == ["full", "paper", "no_crop"]


@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"scene": {"matches": {"max_rati": 0.8}}}, "config, scene.matches: 'max_rati' is unknown; did you mean"),
        (
            {"fusion": {"mode": "fil"}},
            r"config, fusion.mode: 'fil' is not one of \['evidence', 'fill', 'append', 'replace'\]",
        ),
        ({"object": {"frames": {"max_frames": 60.0}}}, "object.frames.max_frames: 60.0 is not of type 'integer'"),
        ({"gpu": "many"}, "config, gpu: 'many' does not match"),
        ({"registration": {"variants": ["full", "no_crops"]}}, "unknown variant 'no_crops'.*defines: full, paper"),
        ({"registration": {"variants": ["paper"]}}, "'full' is missing; it is the one that is fused"),
        ({"objects": "nowhere.tsv"}, "nowhere.tsv does not exist; write it as .*/config/README.md describes"),
    ],
)
def test_a_bad_setting_is_one_sentence_with_its_key(project, changes, sentence):
    with pytest.raises(StageError, match=sentence):
        project(**changes)


@pytest.mark.parametrize(
    "rows, sentence",
    [
        ({"object_row": "shed\tgarden\tclose"}, "object 'shed' lies in scene 'garden', which scenes.tsv does not list"),
        (
            {"object_row": "-shed\tyard\tclose"},
            "objects.tsv, object '-shed', column object: '-shed' will not do; use letters",
        ),
        (
            {"scene_row": "-yard\tflight"},
            "scenes.tsv, scene '-yard', column scene: '-yard' will not do.*no - at the beginning",
        ),
        ({"object_row": "shed\tyard\t"}, "objects.tsv: object .shed. has neither photos nor cloud; fill one of these"),
        ({"scene_row": "", "object_row": ""}, "scenes.tsv and objects.tsv have no rows; add one for each scene"),
    ],
    ids=["unknown scene", "object with a dash", "scene with a dash", "no photos", "nothing"],
)
def test_a_bad_row_is_one_sentence_with_its_table(project, rows, sentence):
    with pytest.raises(StageError, match=sentence):
        project(**rows)


def test_a_misspelt_column_is_named_as_a_column(tmp_path):
    (tmp_path / "scenes.tsv").write_text("scene\tfotos\nyard\tflight\n")
    with pytest.raises(StageError, match="scenes.tsv, scene 'yard', column 'fotos' is unknown; did you mean 'photos'"):
        read_project({"scenes": str(tmp_path / "scenes.tsv")})


def test_a_section_that_stands_twice_is_named_where_snakemake_has_read_the_file(tmp_path):
    (tmp_path / "mine.yaml").write_text("object: {recipe: paper}\nobject: {cloud: {}}\n")
    with pytest.raises(StageError, match=r"mine\.yaml is no YAML \(line 2: the key 'object' stands in line 1 already"):
        read_project({"object": {"cloud": {}}}, [tmp_path / "mine.yaml"])


@pytest.fixture
def cloud_project(tmp_path, monkeypatch):
    """Read a project whose tables have clouds: rows by column."""
    monkeypatch.chdir(tmp_path)

    def read(scene=None, obj=None):
        scene = {"scene": "yard", "cloud": "yard.laz"} | (scene or {})
        obj = {"object": "shed", "scene": "yard", "cloud": "shed.ply"} | (obj or {})
        for name, row in (("scenes.tsv", scene), ("objects.tsv", obj)):
            (tmp_path / name).write_text("\t".join(row) + "\n" + "\t".join(row.values()) + "\n")
        return read_project({"scenes": "scenes.tsv", "objects": "objects.tsv"})

    return read


def test_an_object_of_photos_may_lie_in_no_scene(project, cloud_project):
    assert project(scene_row="", object_row="shed\t\tclose").objects["shed"]["scene"] == ""
    with pytest.raises(StageError, match="object 'shed' is a cloud and lies in no scene, so there is nothing to do"):
        cloud_project(obj={"scene": ""})
    with pytest.raises(StageError, match="object 'shed' lies in no scene that its fiducials could be of; empty"):
        cloud_project(obj={"scene": "", "cloud": "", "photos": "close", "fiducials": "corners.tsv"})


def test_a_row_with_a_cloud_needs_no_photos(cloud_project):
    found = cloud_project()
    assert found.scenes["yard"]["cloud"] == "yard.laz" and found.objects["shed"]["cloud"] == "shed.ply"


def test_a_cloud_stands_beside_photos_whose_cameras_are_given(cloud_project):
    photographed = {"photos": "flight", "cameras": "sparse"}
    found = cloud_project(scene=photographed, obj=photographed | {"prompts": "clicks.tsv"})
    assert found.scenes["yard"]["cloud"] == "yard.laz" and found.objects["shed"]["photos"] == "flight"


@pytest.mark.parametrize(
    "rows, sentence",
    [
        ({"scene": {"cloud": ""}}, "scenes.tsv: scene 'yard' has neither photos nor cloud"),
        ({"obj": {"cloud": ""}}, "objects.tsv: object 'shed' has neither photos nor cloud"),
        (
            {"scene": {"photos": "flight", "cameras": "sparse", "crs": "EPSG:25832"}},
            "scene 'yard' names a crs, but its cloud lies where its cameras are; empty the cell crs",
        ),
        (
            {"scene": {"cloud": "", "photos": "flight", "control": "gcp_list.txt", "crs": "EPSG:25832"}},
            "scene 'yard' names a crs, and its control points name theirs",
        ),
        ({"obj": {"photos": "close"}}, "objects.tsv: object 'shed' has both photos and a cloud, but no cam"),
        (
            {"obj": {"scene": "", "photos": "close", "cameras": "sparse"}},
            "'shed' is a cloud and lies in no scene, .* empty the cell cloud",
        ),
        ({"obj": {"masks": "masks"}}, "'shed' is a cloud and has no photos that its masks could be for; empty that"),
        ({"obj": {"prompts": "a.tsv"}}, "'shed' is a cloud and has no photos that its prompts could be for"),
        ({"scene": {"calibration": "1 PINHOLE"}}, "'yard' is a cloud and has no photos that its calibration"),
    ],
    ids=[
        "no scene",
        "no object",
        "posed crs",
        "control crs",
        "object both",
        "alone",
        "masks",
        "prompts",
        "calibration",
    ],
)
def test_a_bad_row_with_a_cloud_is_one_sentence(cloud_project, rows, sentence):
    with pytest.raises(StageError, match=sentence):
        cloud_project(**rows)
