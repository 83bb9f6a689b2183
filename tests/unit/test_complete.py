"""`scenefuse complete` and `run`: what they make, start and say; Snakemake is a stand-in here."""

import fcntl
import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from support.user_project import CLICKS, Project, film

from scenefuse import command_line, complete
from scenefuse.cloud.clouds import Cloud, write_cloud
from scenefuse.core.settings import read_differences
from scenefuse.core.stage import StageError
from scenefuse.core.tables import read_table
from scenefuse.new_project import init
from scenefuse.report.forecast import seconds_left

SUMMARY = """
import pathlib
summary = pathlib.Path("results/summary")
summary.mkdir(parents=True)
(summary / "scenes.tsv").write_text("scene\\nflight\\n")
(summary / "objects.tsv").write_text("object\\tstatus\\nclose\\tregistered\\n")
(summary / "report.html").touch()
"""


@pytest.fixture
def two_folders(tmp_path, monkeypatch):
    """The working directory, with photos in flight/ and close/, and no screen."""
    project = Project(tmp_path)
    project.photos("flight")
    project.photos("close")
    (tmp_path / "clicks.tsv").write_text(CLICKS)
    (tmp_path / "notes.txt").write_text("a;b;c\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(complete, "has_screen", lambda: False)
    return tmp_path


@pytest.fixture
def workflow(monkeypatch):
    """Let a Python program run in Snakemake's place."""

    def use(program: str) -> None:
        monkeypatch.setattr(complete, "snakemake_command", lambda words, files: [sys.executable, "-c", program])

    return use


def run(*objects: str, **options) -> None:
    complete.complete(Path("flight"), Path(objects[0]), tuple(map(Path, objects[1:])), **options)


def test_two_folders_and_clicks_become_a_project_and_its_run(two_folders, workflow, capsys):
    workflow(
        f"{SUMMARY}\nprint('time: about 3 min on 2 cores')\nprint('Select jobs ...')\nprint('Job 3: close: masks')"
    )
    run("close", prompts=(Path("clicks.tsv"),), cores=2)
    said = capsys.readouterr().out.splitlines()
    row = read_table(Path("flight_completed/config/objects.tsv"), "object")["close"]
    assert row["photos"] == str(two_folders / "close") and row["prompts"] == str(two_folders / "clicks.tsv")
    assert "Running on 2 cores; all that Snakemake says: flight_completed/results/logs/run.log" in said
    assert "Time: about 3 min on 2 cores" in said and "Select jobs ..." not in said
    assert any(line.endswith("close: masks; about 1 min left") for line in said)
    assert said[-3:] == [
        "Result: 1 of 1 objects completed",
        "Report: flight_completed/results/summary/report.html",
        "Next:   open the result in CloudCompare or QGIS",
    ]


def test_the_same_command_goes_on_and_other_folders_are_another_project(two_folders, workflow, capsys):
    workflow(SUMMARY)
    run("close", prompts=(Path("clicks.tsv"),))
    workflow("")
    run("close")
    assert "Going on with flight_completed" in (said := capsys.readouterr().out) and "preset" not in said
    run("close", preset="draft")
    said = capsys.readouterr().out
    assert "--preset draft is left out: the settings of this project are in flight_completed/config/config.yaml" in said
    Project(two_folders).photos("shed")
    with pytest.raises(StageError, match=r"another project \(objects: close\); .*; to add shed to these, give "):
        run("shed")
    # Photos that were moved: what was computed of them is not lost.
    Path("moved").mkdir()
    moved = Path("close").rename("moved/close")
    with pytest.raises(StageError, match=r"where these have moved, correct flight_completed/config/objects\.tsv"):
        run("moved/close")
    table = Path("flight_completed/config/objects.tsv")
    table.write_text(table.read_text().replace(str(two_folders / "close"), str(moved.resolve())))
    run("moved/close")


def test_more_objects_are_added_by_a_command_that_names_the_others_too(two_folders, workflow):
    workflow(SUMMARY)
    run("close", prompts=(Path("clicks.tsv"),))
    Project(two_folders).photos("shed")
    workflow("")
    run("close", "shed", prompts=(Path("clicks.tsv"), Path("clicks.tsv")))
    rows = read_table(Path("flight_completed/config/objects.tsv"), "object")
    assert [row["photos"] for row in rows.values()] == [str(two_folders / name) for name in ("close", "shed")]


def test_a_user_s_comments_stay_in_a_table_that_gets_an_object(two_folders, workflow):
    Project(two_folders).photos("shed")
    workflow(SUMMARY)
    run("close", prompts=(Path("clicks.tsv"),))
    table = Path("flight_completed/config/objects.tsv")
    comments = '# barn\tflight\tits roof is gone\n"# ""new"", as a spreadsheet quotes it"\n'
    table.write_text(table.read_text() + comments)
    workflow("")
    run("close", "shed", prompts=(Path("clicks.tsv"),) * 2)
    assert comments in table.read_text() and len(read_table(table, "object")) == 2


def test_clicks_are_of_the_objects_with_photos_beside_one_that_is_a_cloud(two_folders, workflow):
    Path("wall.xyz").write_text("1 2 3\n4 5 6\n7 8 10\n")
    workflow(SUMMARY)
    run("wall.xyz", "close", prompts=(Path("clicks.tsv"),))
    rows = read_table(Path("flight_completed/config/objects.tsv"), "object")
    assert rows["close"]["prompts"] == str(two_folders / "clicks.tsv") and not rows["wall"]["prompts"]


def test_settings_of_which_every_line_is_a_comment_are_not_given_to_snakemake(two_folders, monkeypatch):
    given: list[list[str]] = []
    monkeypatch.setattr(complete, "snakemake_command", lambda words, _: given.append(words) or ["true"])
    monkeypatch.setattr(complete, "closing_lines", str)
    for _ in range(2):
        run("close", prompts=(Path("clicks.tsv"),))
        Path("flight_completed/config/config.yaml").write_text("# gpu: 1\n")
    assert [words.count("--configfile") for words in given] == [1, 0]


def test_a_second_run_in_the_same_project_is_refused_and_leaves_the_first_ones_log(two_folders, workflow):
    workflow(SUMMARY)
    run("close", prompts=(Path("clicks.tsv"),))
    log = Path("flight_completed/results/logs/run.log")
    log.write_text("of the first\n")
    workflow("")
    with open(log, "a") as first:
        fcntl.flock(first, fcntl.LOCK_EX)
        with pytest.raises(StageError, match="another run works in flight_completed; wait until it ends, or stop it"):
            run("close")
    assert log.read_text() == "of the first\n"
    run("close")


def test_without_a_screen_an_object_without_clicks_is_one_sentence(two_folders, monkeypatch):
    monkeypatch.setattr(sys.stdin, "isatty", lambda: False)
    with pytest.raises(
        StageError, match="close has no clicks yet, and there is no screen to click on; give .*README.md says"
    ):
        run("close")
    # The header alone, which the page leaves when a click is undone, is none.
    (two_folders / "flight_completed/config/close_prompts.tsv").write_text(CLICKS.splitlines()[0])
    with pytest.raises(StageError, match="close has no clicks yet"):
        run("close")


def test_masks_take_the_place_of_clicks(two_folders, workflow):
    workflow(SUMMARY)
    (two_folders / "drawn").mkdir()
    run("close", masks=(Path("drawn"),))
    table = Path("flight_completed/config/objects.tsv")
    assert read_table(table, "object")["close"]["masks"]
    # And clicks that of masks, which would go before them.
    workflow("")
    run("close", prompts=(Path("clicks.tsv"),))
    row = read_table(table, "object")["close"]
    assert row["prompts"] == str(two_folders / "clicks.tsv") and not row["masks"]


def test_a_cloud_with_its_cameras_needs_no_clicks(two_folders, workflow):
    workflow(SUMMARY)
    run("close", prompts=(Path("clicks.tsv"),))
    table = Path("flight_completed/config/objects.tsv")
    row = read_table(table, "object")["close"] | {"cameras": "cameras", "cloud": "close.ply", "prompts": ""}
    table.write_text("\t".join(row) + "\n" + "\t".join(row.values()) + "\n")
    workflow("")
    run("close")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (
            {"prompts": (Path("clicks.tsv"), Path("clicks.tsv"))},
            "--prompts names 2 for 1 objects with photos; give one",
        ),
        ({"prompts": (Path("notes.txt"),)}, "notes.txt has to begin with the tab-separated header"),
        ({"masks": (Path("nowhere"),)}, "nowhere does not exist; correct --masks"),
        ({"cores": 0}, "--cores 0 cannot be had; give 1 to"),
        ({"cores": 9999}, "--cores 9999 cannot be had; give 1 to"),
        ({"out": Path("close")}, "the project close would lie among its photos in close"),
    ],
)
def test_what_cannot_be_used_is_one_sentence_before_anything_is_made(two_folders, options, sentence):
    with pytest.raises(StageError, match=sentence):
        run("close", **options)
    assert not list(two_folders.rglob("objects.tsv"))


def test_a_scene_may_be_a_video(two_folders, workflow):
    workflow(SUMMARY.replace("parents=True", "parents=True, exist_ok=True"))
    film(two_folders / "flown.MP4")
    for _ in range(2):  # The same command goes on.
        complete.complete(Path("flown.MP4"), Path("close"), prompts=(Path("clicks.tsv"),))
    row = read_table(Path("flown_completed/config/scenes.tsv"), "scene")["flown"]
    assert row["photos"] == str(two_folders / "flown.MP4") and not row["cloud"]


def test_the_frames_to_click_in_are_those_of_the_video_that_is_there(two_folders, monkeypatch):
    film(two_folders / "walk.mp4")
    made: list[str] = []
    monkeypatch.setattr(complete, "snakemake_command", lambda words, _: made.append(words[-1]) or ["true"])
    for count in (1, 2):
        with pytest.raises(StageError, match="walk has no clicks yet"):
            run("walk.mp4")
        assert made == ["results/objects/walk/photos.json"] * count
        Path("flight_completed", made[0]).parent.mkdir(parents=True, exist_ok=True)
        Path("flight_completed", made[0]).write_text("{}")


def test_a_folder_without_photos_of_its_own_is_one_sentence(two_folders):
    for name in ("empty", "filmed", "tiles"):
        (two_folders / name).mkdir()
    for file in ("filmed/clip.MP4", "tiles/2.laz", "tiles/1.laz"):
        Path(file).touch()
    Path("notes.txt").write_text("Flight of 12 May\nwindy\n")
    write_cloud(Path("none.ply"), Cloud(np.zeros((0, 3))))
    Path("page.ply").write_text("<html>")
    Project(two_folders).photos("one", 1)
    Project(two_folders).photos("flight/shed", 4)
    with pytest.raises(StageError, match="two objects would be called 'close'; give each once"):
        run("close", "close")
    for folder, sentence in (
        ("empty", "the photo folder empty holds no photos"),
        ("filmed", r"filmed holds no photos; .*\(or give a video itself: filmed/clip.MP4\)"),
        ("tiles", r"tiles holds no photos; if its files \(1.laz, ...\) are clouds, merge and give one"),
        ("notes.txt", r"notes.txt is not a readable TXT cloud \(none of its first lines holds three numbers"),
        ("none.ply", "none.ply holds no points; look at what wrote it"),
        ("page.ply", "page.ply is not a readable PLY cloud"),
        ("one", "one holds 1 photo; 5 or more are needed"),
        ("flight", "flight is given as the scene and as an object"),
        ("flight/shed", "flight/shed lies in .*flight, whose photos in folders below count too; move it elsewhere"),
    ):
        with pytest.raises(StageError, match=sentence):
            run(folder)
    assert not (two_folders / "flight_completed").exists()


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        (
            "failed: close: masks: too few clicks [x.log]\\nWorkflowError:\\nAt least one",
            "^close: masks: too few clicks",
        ),
        ("WorkflowError in file x, line 3:\\nno rows", "^no rows; all that Snakemake says: flight_completed"),
        (
            "ProtectedOutputException in rule a in file x, line 3:\\nWrite-protected output files for rule a:\\n"
            "    output: b.ply\\nRemoving",
            "^Write-protected output files for rule a: output: b.ply; all that",
        ),
        ("error: the disk is full", "^the disk is full"),
        (
            "another run works in this folder; wait until it ends, or stop it\\nLockException:\\nError: Directory"
            " cannot be locked, in the following directory:\\n/yard",
            "^another run works in this folder; wait until it ends, or stop it;",
        ),
        ("", "^Snakemake ended early"),
    ],
)
def test_a_run_that_fails_says_why_in_one_sentence(two_folders, workflow, said, sentence):
    workflow(f"print('{said}'); raise SystemExit(1)")
    with pytest.raises(StageError, match=sentence):
        run("close", prompts=(Path("clicks.tsv"),))


def test_an_interrupt_ends_snakemake_once_in_its_own_way_and_its_jobs(two_folders, workflow, monkeypatch):
    workflow(
        "import os, signal, pathlib, sys\n"
        "signal.signal(signal.SIGINT, lambda *_: None)\n"
        "job = os.fork()\n"
        "if not job:\n"
        "    signal.signal(signal.SIGINT, lambda *_: os._exit(3))\n"
        "    print('Job 1: a', flush=True)\n"
        "    signal.pause()\n"
        "pathlib.Path('ended').write_text(str(os.waitstatus_to_exitcode(os.waitpid(job, 0)[1])))\n"
        "sys.exit(1)"
    )

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(complete, "report_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run("close", prompts=(Path("clicks.tsv"),))
    assert Path("flight_completed/ended").read_text() == "3"


def test_the_time_left_follows_what_jobs_took_so_far(tmp_path):
    forecast = {f"{name}.tsv": 100.0 for name in "abcd"}
    assert seconds_left(forecast, tmp_path, 0, 2) == pytest.approx(1.15 * 400 / 2)
    for name in "ab":
        (tmp_path / f"{name}.tsv").write_text("s\tcpu_time\n9\t300\n")
    os.utime(tmp_path / "b.tsv", (50, 50))  # of a run before
    (tmp_path / "c.tsv").touch()  # being written
    # One of four is done and took three times its forecast, so that all takes half as long again.
    assert seconds_left(forecast, tmp_path, 100, 2) == pytest.approx(1.15 * 1.5 * 300 / 2)


def started(monkeypatch, *words: str) -> list[str]:
    """The words that `scenefuse run` hands to Snakemake."""
    given: list[list[str]] = []
    monkeypatch.setattr(os, "execv", lambda _, command: given.append(command))
    monkeypatch.setattr(sys, "argv", ["scenefuse", "run", *words])
    command_line.main()
    return given[0][5:]


def test_run_takes_all_cores_unless_somebody_says_how_many(two_folders, monkeypatch):
    init(Path("yard"), scene=Path("flight"))
    monkeypatch.chdir("yard")
    own = ["--configfile", "config/config.yaml"]
    assert started(monkeypatch, "-n") == ["-n", *own, "--cores", "all"]
    for words in (["--cores", "3"], ["-c3"], ["--profile", "slurm"], ["--jobs=9"]):
        assert started(monkeypatch, *words) == [*words, *own]
    Path("config/config.yaml").write_text("# gpu: auto\n\n")
    assert started(monkeypatch, "-n") == ["-n", "--cores", "all"]


@pytest.mark.parametrize("words", [["--directory", "yard"], ["-d", "yard"], ["--directory=yard"]])
def test_run_in_another_folder_reads_the_settings_of_the_project_there(two_folders, monkeypatch, words):
    for name in ("yard", "here"):
        init(Path(name), scene=Path("flight"))
    shutil.copytree("here/config", "config")
    own = ["--configfile", "yard/config/config.yaml"]
    assert started(monkeypatch, *words) == [*words, *own, "--cores", "all"]


def test_a_folder_that_is_misspelled_is_no_project_of_the_demo(two_folders, monkeypatch):
    init(Path("yard"), scene=Path("flight"))
    monkeypatch.chdir("yard")
    with pytest.raises(SystemExit, match=r"there is no config/scenes.tsv here \(.*/yrad\)"):
        started(monkeypatch, "--directory", "../yrad")


def test_the_help_of_run_is_one_screen(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["scenefuse", "run", "--help"])
    command_line.main()
    said = capsys.readouterr().out
    assert "--cores N" in said and "python -m snakemake --help" in said and len(said.splitlines()) < 24


def test_init_ends_with_the_next_command_by_its_real_names_and_says_how_many_photos_are_few(two_folders, capsys):
    Project(two_folders).photos("many", 30)
    init(Path("yard"), scene=Path("many"), objects=(Path("close"),))
    said = capsys.readouterr().out
    assert "next: cd yard && scenefuse pick --object close " in said
    assert "many: the scene, 30 photos\n" in said and "close: an object, 5 photos, which is few: every part" in said
    init(Path("few"), scene=Path("close"), objects=())
    assert capsys.readouterr().out.startswith(
        "close: the scene, 5 photos, which is few: every part has to be in three or more\n"
    )
    init(Path("bare"))
    assert "next: cd bare, and fill in both tables in config/ " in capsys.readouterr().out
    with pytest.raises(StageError, match="close holds photos, and the project would lie among them; give a folder of"):
        init(Path("close"))
    assert "`scenefuse pick --object close`" in Path("yard/README.md").read_text()


def test_folders_in_other_scripts_have_names_of_their_own(two_folders):
    for name in ("房子", "Дом 1", "Сарай 1", "Größe"):
        Project(two_folders).photos(name)
    init(Path("yard"), scene=Path("flight"), objects=(Path("房子"), Path("Дом 1"), Path("Сарай 1"), Path("Größe")))
    assert list(read_table(Path("yard/config/objects.tsv"), "object"))[::3] == ["i8s34n", "Gro_e"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("seed: 1\nobject:\n  nerf:\n    widht: 3\n", "line 4, object.nerf: 'widht' is unknown; did you mean 'width'"),
        ("seed: 1\nobject: { nerf: { width: x } }\n", "line 2, object.nerf.width: 'x' is not of type 'integer'"),
        ("registration:\n  variants: [full, 3]\n", "line 2, registration.variants.1: 3 is not of type"),
        (
            "scene:\n  # fast: true\nseed: 1\n",
            "line 1, scene: nothing stands .* below it; remove the line, or fill it in",
        ),
        ("seed: 1\nregistration:\n  crop:\n    margin: .nan\n", "line 4, registration.crop.margin: nan is not of type"),
        (
            f"registration:\n  crop:\n    margin: 1{400 * '0'}\n",
            "line 3, registration.crop.margin: 10{400} is not of type",
        ),
        ("registration: {crop: {margin: -.inf}}", "line 1, registration.crop.margin: -inf is not of type"),
        (
            "object: {seed: 1}\nseed: 1\nobject:\n  nerf: {}\n",
            r" is no YAML \(line 3: the key 'object' stands in line 1 already",
        ),
        (
            "object:\n  nerf:\n    levels: 8\n    levels: 9\n",
            r" is no YAML \(line 4: the key 'levels' stands in line 3",
        ),
        ("seed: 1\nobject: {\n", r" is no YAML \(line 3: expected the node content"),
    ],
)
def test_an_error_in_settings_names_its_file_and_line(tmp_path, text, sentence):
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(StageError, match=f"mine.yaml,? ?{sentence}".replace(",? ? is", " is")):
        read_differences(tmp_path / "mine.yaml")


def test_a_job_that_fails_is_told_at_once_with_its_error(tmp_path, capsys):
    log = tmp_path / "results/logs/import_object_cloud/ten.log"
    log.parent.mkdir(parents=True)
    log.write_text("python import_object_cloud.py\nerror: ten.xyz has only 10 points\n")
    complete.report_step(tmp_path, "Logfile results/logs/import_object_cloud/ten.log:", 0.0, 2)
    assert capsys.readouterr().out.endswith(f" ten failed: ten.xyz has only 10 points [{log}]\n")
    log.write_text("python import_object_cloud.py\n")
    complete.report_step(tmp_path, "Logfile results/logs/import_object_cloud/ten.log:", 0.0, 2)
    assert "ended without a message" in capsys.readouterr().out
