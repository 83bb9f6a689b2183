"""Registration on its own: two files in, a decision, a transform in the files' own coordinates, an exit status."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.cloud_files import UTM, write_e57
from support.planted import errors, plant
from support.registered_pair import registered_at_once

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.cloud.readers.las import las_crs
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.core.transforms import Sim3
from scenefuse.register.coarse import CoarseSettings
from scenefuse.register.decision import FineSettings
from scenefuse.two_clouds.find import Known, RegistrationSettings, find_in_scene
from scenefuse.two_clouds.register import register

ROOT = Path(__file__).resolve().parents[2]
# Less work than shipped, where only the course of the computation matters.
LITTLE = RegistrationSettings(
    coarse=CoarseSettings(ransac_samples=5000, feature_scale_steps=1, scale_steps=9, candidates=4, keep=2),
    fine=FineSettings(voxel_fraction=0.012, turn_steps=2),
)


@pytest.fixture(scope="module")
def house():
    return plant("house", 5, ground=False, noise=0.005, object_points=3000, density_ratio=1.0)


def in_files(content, trial, shift):
    """The errors of a transform.json against the truth of a trial whose scene was moved by `shift`."""
    truth = Sim3(1.0, np.eye(3), shift) @ trial.scene_from_object
    found = Sim3.from_matrix(np.array(value(content, "scene_from_object")))
    return errors(found, truth, trial.object.points.mean(0), trial.diagonal)


@pytest.mark.slow
def test_a_house_in_e57_is_found_in_a_scene_in_laz_at_utm_coordinates(tmp_path, house, capsys, monkeypatch):
    monkeypatch.setattr(RegistrationSettings, "read", lambda path: (LITTLE, 0))
    middle = house.object.points.mean(0)
    still = np.array([1.0, 0, 0, 0])
    write_e57(tmp_path / "house.e57", [(house.object.points - middle, house.object.colors, still, middle)])
    write_laz(tmp_path / "scene.laz", house.scene, UTM, "EPSG:32632")
    out = tmp_path / "out"
    files = {"object": tmp_path / "house.e57", "scene": tmp_path / "scene.laz"}
    assert register(**files, out=out, format="laz") == 0
    content = read_json(out / "transform.json")
    scale, angle, shift = in_files(content, house, UTM)
    assert abs(scale) < 2 and angle < 2 and shift < 0.01
    assert value(content, "status") == "registered" and value(content["agreement"], "fitness") > 0.85
    pose = Sim3.from_matrix(np.array(value(content, "scene_from_object")))
    placed = read_cloud(out / "object_in_scene.laz")
    expected = pose.apply(read_cloud(tmp_path / "house.e57").points)
    assert np.abs(placed.points - expected).max() <= 0.5e-3 + 1e-6
    assert las_crs(out / "object_in_scene.laz").to_epsg() == 32632
    assert (content["scale"]["unit"], content["agreement"]["tau"]["unit"]) == ("m per object unit", "m")
    assert (out / "picture.png").stat().st_size > 1000
    captured = capsys.readouterr()
    steps = captured.err.splitlines()
    assert "searching all of it" in steps[0] and "refining" in steps[-1]
    printed = captured.out.strip().splitlines()
    assert len(printed) == 6 and printed[0].startswith("registered: ") and "whole scene" in printed[3]


def test_a_note_says_that_the_object_s_own_crs_is_not_used(tmp_path, house, capsys, monkeypatch):
    write_laz(tmp_path / "house.laz", house.object, UTM, "EPSG:32633")
    write_laz(tmp_path / "scene.laz", house.scene, UTM, "EPSG:32632")
    registered_at_once(monkeypatch, house.scene_from_object)
    assert register(object=tmp_path / "house.laz", scene=tmp_path / "scene.laz", out=tmp_path / "out") == 0
    (note,) = value(read_json(tmp_path / "out/transform.json"), "notes")
    assert "house.laz is in WGS 84 / UTM zone 33N, which is not used" in note and "UTM zone 32N" in note
    assert note in capsys.readouterr().out


def test_colours_are_evidence_only_where_they_were_compared(tmp_path, house, monkeypatch):
    white = replace(house.scene, colors=np.full_like(house.scene.colors, 255))
    write_cloud(tmp_path / "house.ply", house.object)
    write_cloud(tmp_path / "scene.ply", white)
    registered_at_once(monkeypatch, house.scene_from_object)
    assert register(object=tmp_path / "house.ply", scene=tmp_path / "scene.ply", out=tmp_path / "out") == 0
    assert value(read_json(tmp_path / "out/transform.json"), "evidence") == "the clouds alone, by shape"


@pytest.mark.slow
def test_fiducials_gravity_and_a_known_scale_in_text_and_ply(tmp_path, monkeypatch):
    monkeypatch.setattr(RegistrationSettings, "read", lambda path: (LITTLE, 0))
    trial = plant("house", 5, noise=0.005, object_points=3000, density_ratio=1.0)
    write_cloud(tmp_path / "scene.ply", Cloud(trial.scene.points + UTM, None, trial.scene.colors))
    rows = np.hstack([trial.object.points, trial.object.colors])
    np.savetxt(tmp_path / "house.xyz", rows, header="X Y Z R G B", comments="//", fmt=["%.9g"] * 3 + ["%d"] * 3)
    np.savetxt(tmp_path / "marks.txt", trial.fiducials + UTM, fmt="%.4f")
    out, true = tmp_path / "out", trial.scene_from_object.scale
    files = {"object": tmp_path / "house.xyz", "scene": tmp_path / "scene.ply"}
    known = Known(
        up_object=tuple(trial.up_in_object), up_scene=(0.0, 0.0, 1.0), scale=true, fiducials=tmp_path / "marks.txt"
    )
    assert register(**files, known=known, out=out) == 0
    content = read_json(out / "transform.json")
    scale, angle, shift = in_files(content, trial, UTM)
    assert abs(scale) < 1e-6 and angle < 2 and shift < 0.01
    assert "8 fiducials" in value(content, "searched") and "ground removed" in value(content, "searched")
    assert value(content, "tilt_deg") < 5
    assert not any("fit best" in note for note in value(content, "notes"))
    # Held 4 % off, as by a wrong scale bar.
    assert register(**files, known=replace(known, scale=1.04 * true), out=tmp_path / "off") == 0
    (note,) = [note for note in value(read_json(tmp_path / "off/transform.json"), "notes") if "fit best" in note]
    assert float(note.split("fit best at ")[1].split(",")[0]) == pytest.approx(true, rel=0.015)
    with pytest.raises(StageError, match="at a scale of 1000 the object would be .* across, and the searched part"):
        register(**files, known=replace(known, scale=1000.0), out=tmp_path / "other")
    placed = read_cloud(out / "object_in_scene.ply").points
    pose = Sim3.from_matrix(np.array(value(content, "scene_from_object")))
    assert np.abs(placed - pose.apply(read_cloud(tmp_path / "house.xyz").points)).max() < 1e-8


@pytest.mark.process
def test_another_shape_is_refused_with_status_three_and_no_object_is_left(tmp_path, house):
    write_cloud(tmp_path / "house.ply", house.object)
    other = plant("sculpture", 7, ground=False, noise=0.005, density_ratio=1.0).scene
    write_cloud(tmp_path / "scene.ply", other)
    out = tmp_path / "out"
    out.mkdir()
    (out / "object_in_scene.laz").write_text("of an earlier run")
    command = [sys.executable, ROOT / "scripts/register.py", "--object", "house.ply", "--scene", "scene.ply"]
    command += ["--out", "out", "--seed", "1"]
    done = subprocess.run(list(map(str, command)), cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 3, done.stderr
    assert done.stdout.startswith("unregistered: ")
    assert "draw a box around the object in out/crop_box.html" in done.stdout
    exchanged = "house.ply has more points than scene.ply: if it is the scene, exchange the two" in done.stdout
    assert exchanged == (len(house.object) > len(other))
    content = read_json(out / "transform.json")
    assert value(content, "status") == "unregistered" and value(content, "reason") in done.stdout
    assert sorted(p.name for p in out.iterdir()) == ["crop_box.html", "picture.png", "transform.json"]


@pytest.mark.slow
def test_two_runs_agree_bit_for_bit_and_origins_far_away_change_nothing(house):
    # Coordinates of few binary digits, so that moving them rounds nothing.
    near = Cloud(np.round(house.scene.points * 2**16) / 2**16, house.scene.normals, house.scene.colors)
    far = Cloud(near.points + UTM, near.normals, near.colors)
    here, there = (find_in_scene(house.object, scene, LITTLE, 0, marked=True)[0] for scene in (near, far))
    poses = [[h.pose.matrix.tobytes() for h in found.outcome.ranked] for found in (here, there)]
    assert poses[0] == poses[1]
    shift = there.scene_from_object.translation - here.scene_from_object.translation
    assert np.abs(shift - UTM).max() < 1e-8


def test_the_transform_is_kept_when_the_object_cannot_be_written(tmp_path, house, monkeypatch):
    def full_disk(path, cloud):
        raise StageError(f"{path} could not be written")

    write_cloud(tmp_path / "scene.ply", house.scene)
    write_cloud(tmp_path / "house.ply", house.object)
    monkeypatch.setattr("scenefuse.two_clouds.register.write_cloud", full_disk)
    registered_at_once(monkeypatch, house.scene_from_object)
    with pytest.raises(StageError, match="could not be written"):
        register(object=tmp_path / "house.ply", scene=tmp_path / "scene.ply", out=tmp_path / "out")
    # What was found is not lost, and nothing says that all is there.
    assert np.allclose(np.loadtxt(tmp_path / "out/transform.txt"), house.scene_from_object.matrix)
    assert not (tmp_path / "out/transform.json").exists()


def test_a_column_with_a_space_in_its_name_is_written(tmp_path, house, monkeypatch):
    write_cloud(tmp_path / "scene.ply", house.scene)
    columns = np.column_stack([house.object.points, np.arange(len(house.object))])
    header = "x,y,z,scan angle"
    np.savetxt(tmp_path / "house.csv", columns, header=header, comments="", delimiter=",", fmt="%.9g")
    registered_at_once(monkeypatch, house.scene_from_object)
    files = {"object": tmp_path / "house.csv", "scene": tmp_path / "scene.ply"}
    assert register(**files, out=tmp_path / "out") == 0
    placed = read_cloud(tmp_path / "out/object_in_scene.ply")
    assert np.array_equal(placed.fields["scan_angle"], np.arange(len(house.object)))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"scale": -1.0}, "a scale has to be positive"),
        ({"scale": 1e-6}, "its points .* apart; correct --scale or --scale-range"),
        ({"scale": 1.0, "scale_range": (1.0, 2.0)}, "give one"),
        ({"up_object": (0.0, 0.0, 1.0)}, "--up-scene"),
        ({"up_scene": (0.0, 0.0, 0.0)}, "needs a direction"),
        (
            {"crop_box": (90.0, 90.0, 90.0, 91.0, 91.0, 91.0)},
            "^0 scene points lie .*, of what lies from about .* to .* in",
        ),
        (
            {"crop_box": (-1.0, -1.0, 0.0, 1.0, 1.0, 3.0)},
            r"^1?\d?\d scene points lie in the crop box, 200 are",
        ),
        ({"seed": -1}, "--seed: -1 is less than the minimum of 0; correct it"),
        ({"fiducials": Path("three.txt")}, "at least 4"),
        ({"fiducials": Path("same.txt")}, "gives 1 fiducials; .* at least 4 different points"),
        ({"fiducials": Path("far.txt")}, "nearest scene point"),
        ({"fiducials": Path("clicks.tsv")}, "clicks in photos"),
        (
            {"config": Path("typo.yaml")},
            "registration.fine: 'max_scale_sd' is unknown; did you mean 'max_scale_sd_",
        ),
        ({"config": Path("none.yaml")}, "cannot be read"),
        ({"object": Path("few.ply")}, "the object has only 3 different positions; 200 or more"),
        ({"object": Path("repeated.ply")}, "the object has only 3 different positions among its 5000 points; 200"),
        ({"object": Path("line.ply")}, "all 500 points of the object lie along one line"),
        ({"out": Path("three.txt")}, "is a file"),
        (
            {"scene": Path("elsewhere.laz")},
            "elsewhere.laz, the middle of its points: .* does not lie in WGS 84 / UTM zone 32N",
        ),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, monkeypatch, house, options, words):
    monkeypatch.chdir(tmp_path)
    write_cloud(Path("scene.ply"), house.scene)
    write_laz(Path("elsewhere.laz"), house.scene, np.zeros(3), "EPSG:32632")
    write_cloud(Path("few.ply"), Cloud(np.eye(3)))
    write_cloud(Path("repeated.ply"), Cloud(np.eye(3)[np.arange(5000) % 3]))
    write_cloud(Path("line.ply"), Cloud(np.outer(np.arange(500.0), [1, 2, 3])))
    Path("three.txt").write_text("0 0 0\n1 0 0\n0 1 0\n")
    np.savetxt("far.txt", np.eye(4, 3) + 1000)
    np.savetxt("same.txt", np.ones((4, 3)))
    Path("clicks.tsv").write_text("point\tphoto\tx_px\ty_px\na\tb.jpg\t1\t1\n")
    Path("typo.yaml").write_text("registration: {fine: {max_scale_sd: 0.1}}")
    files = {"object": Path("scene.ply"), "scene": Path("scene.ply")}
    others = {name: option for name, option in options.items() if name in ("object", "scene", "config", "out", "seed")}
    known = Known(**{name: option for name, option in options.items() if name not in others})
    with pytest.raises(StageError, match=words):
        register(**(files | others), known=known)
    assert not Path("registered").exists()
