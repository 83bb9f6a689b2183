"""A scene and an object given as clouds, without a single photo: the whole workflow, from the tables to the report; and
what is planned where clouds are given beside photos and cameras."""

import json
import os
import re
import shutil

import laspy
import numpy as np
import pytest
import yaml
from PIL import Image
from support.cloud_files import UTM
from support.planted import errors, plant
from support.user_project import CLICKS, Project, planned

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.cloud.write_las import write_laz
from scenefuse.core.stage import read_json, value
from scenefuse.core.transforms import Sim3

ORIGIN = Sim3(1.0, np.eye(3), UTM)
"""Of the planted scene, in the coordinates of its file."""
POINTS = "point\tx\ty\tz\n"


@pytest.fixture(scope="module")
def trial():
    return plant("house", 0, coverage=0.6, object_points=12000, depth_maps=False)


@pytest.fixture(scope="module")
def project(tmp_path_factory, trial, snakemake):
    """A yard as LAZ in UTM, a house as PLY in a frame of its own, marked by points; run, and call it to run again."""
    path = tmp_path_factory.mktemp("clouds")
    write_laz(path / "yard.laz", trial.scene, UTM, "EPSG:32632")
    write_cloud(path / "house.ply", trial.object)
    rows = [f"p{k}\t{x:.3f}\t{y:.3f}\t{z:.3f}\n" for k, (x, y, z) in enumerate((trial.fiducials + UTM).tolist())]
    (path / "points.tsv").write_text(POINTS + "".join(rows))
    (path / "scenes.tsv").write_text("scene\tcloud\nyard\tyard.laz\n")
    (path / "objects.tsv").write_text("object\tscene\tcloud\tfiducials\nhouse\tyard\thouse.ply\tpoints.tsv\n")
    settings = {"scenes": "scenes.tsv", "objects": "objects.tsv", "registration": {"variants": ["full"]}}
    (path / "mine.yaml").write_text(yaml.safe_dump(settings))

    def run(*words):
        return snakemake(path, *words, config=path / "mine.yaml")

    run.path, run.first = path, run()
    assert run.first.returncode == 0, run.first.stdout[-6000:]
    return run


def test_the_house_is_found_and_fills_the_scene_in_its_own_coordinates(project, trial):
    folder = project.path / "results/objects/house"
    frames = read_json(folder / "frames.json")
    pose = Sim3.from_matrix(np.array(value(frames, "world_from_file")))
    truth = ORIGIN @ trial.scene_from_object
    scale, angle, shift = errors(pose, truth, trial.object.points.mean(0), trial.diagonal)
    assert abs(scale) < 2 and angle < 2 and shift < 0.02
    fusion = read_json(folder / "fusion.json")
    assert value(fusion, "mode") == "fill" and value(fusion, "added_points") > 500
    assert "neither side has photos" in " ".join(value(fusion, "notes"))
    before, after = (laspy.read(project.path / name) for name in ("yard.laz", "results/scenes/yard/completed.copc.laz"))
    assert after.header.parse_crs().to_epsg() == 32632
    source = np.asarray(after["source"])
    assert np.array_equal(np.sort(after.xyz[source == 0], axis=0), np.sort(before.xyz, axis=0))
    added = truth.inverse().apply(after.xyz[source == 1])
    low, high = trial.object.points.min(0), trial.object.points.max(0)
    assert ((added > low - 0.05 * (high - low)) & (added < high + 0.05 * (high - low))).all()
    assert set(read_cloud(folder / "fused.ply").fields["evidence"]) == {0}  # no photo was asked


def test_what_was_not_made_is_said_in_words(project):
    results = project.path / "results"
    text = " ".join((results / "summary/details.txt").read_text().split())
    assert "given as a cloud yard.laz" in text and "(EPSG:32632)" in text
    assert "given as a cloud house.ply" in text and "1 of 1 objects registered" in text
    assert "from the clouds alone, for no photos link" in text and "rests on shape, colours" in text
    assert "surface that none of them confirms is not looked for" in text and "photos registered" not in text
    page = (results / "summary/report.html").read_text()
    assert 'aria-label="3D view of scene yard"' in page and 'aria-label="3D view of house"' in page
    drawn = {path.name for path in (results / "objects/house/figures").glob("*.png")}
    assert {"before_after.png", "object.png"} <= drawn
    assert "missing.png" not in drawn
    assert json.loads((results / "objects/house/metrics.json").read_text())["completion"]


def test_only_a_change_of_a_cloud_reruns_its_import(project):
    assert "Nothing to be done" in project("-n").stdout
    house = project.path / "house.ply"
    before = house.read_bytes()
    write_cloud(house, Cloud(read_cloud(house).points))
    os.utime(house, (1e9, 1e9))
    rules = planned(project("-n").stdout)
    house.write_bytes(before)
    os.utime(house, (1e9, 1e9))
    assert {"import_object_cloud", "register_object", "complete_scene"} <= rules
    assert not {"import_scene_cloud", "crop_scene"} & rules


def test_a_texture_that_was_missing_or_is_another_reruns_the_import_of_its_mesh(tmp_path, snakemake):
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 1\nv 0 1 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "roof.obj").write_text(f"# roof\nmtllib roof.mtl\n{corners}usemtl m\nf 1/1 2/2 3/3 4/4\n")
    (tmp_path / "roof.mtl").write_text("newmtl m\nmap_Kd -clamp on roof.png\n")
    picture, target = tmp_path / "roof.png", "results/objects/roof/object.ply"
    (tmp_path / "scenes.tsv").write_text("scene\tcloud\nyard\troof.obj\n")
    (tmp_path / "objects.tsv").write_text("object\tscene\tcloud\nroof\tyard\troof.obj\n")
    (tmp_path / "mine.yaml").write_text("scenes: scenes.tsv\nobjects: objects.tsv\n")

    def run(*words):
        done = snakemake(tmp_path, *words, target, config=tmp_path / "mine.yaml").stdout
        return "Nothing to be done" in done, planned(done)

    run()
    assert run("-n")[0]
    for color in (255, 128):
        Image.new("RGB", (9, 9), (color, 0, 0)).save(picture)
        os.utime(picture, (1e9, 1e9))
        assert run("-n") == (False, {"import_object_cloud"})
        run()
        assert (read_cloud(tmp_path / target).colors == [color, 0, 0]).all() and run("-n")[0]


@pytest.mark.parametrize(
    "target, sentence",
    [
        ("results/scenes/yard/photos.json", "scene 'yard' is given as a cloud: nothing is made from photos of it"),
        ("results/objects/house/masks.json", "object 'house' is given as a cloud: nothing is made from photos of it"),
    ],
)
def test_what_needs_photos_is_refused_in_one_sentence(project, target, sentence):
    refused = project("-n", target)
    assert refused.returncode != 0 and sentence in refused.stdout


def test_a_cloud_that_is_not_there_is_one_sentence(project, tmp_path, snakemake):
    for name in ("objects.tsv", "mine.yaml", "house.ply", "points.tsv"):
        shutil.copy(project.path / name, tmp_path)
    (tmp_path / "scenes.tsv").write_text("scene\tcloud\nyard\tyrad.laz\n")
    refused = snakemake(tmp_path, "-n", config=tmp_path / "mine.yaml")
    assert refused.returncode != 0
    # Once, and nothing of rules that would make the same file of photos.
    assert refused.stdout.count("scenes.tsv, scene 'yard': yrad.laz in the column cloud does not exist") == 1
    assert "is given as a cloud" not in refused.stdout
    (tmp_path / "scenes.tsv").write_text("scene\tcloud\nyard\thouse.ply\n")
    (tmp_path / "points.tsv").unlink()
    refused = snakemake(tmp_path, "-n", config=tmp_path / "mine.yaml")
    assert "does not exist" in refused.stdout and "write it with a line `x y z`" in refused.stdout


def test_a_crs_that_is_none_stops_before_anything_runs(project, tmp_path, snakemake):
    for name in ("objects.tsv", "mine.yaml", "house.ply", "points.tsv", "yard.laz"):
        shutil.copy(project.path / name, tmp_path)
    (tmp_path / "scenes.tsv").write_text("scene\tcloud\tcrs\nyard\tyard.laz\tEPSG:1\n")
    refused = snakemake(tmp_path, "-n", config=tmp_path / "mine.yaml")
    assert refused.returncode != 0
    assert "scene 'yard', column crs: 'EPSG:1' names no coordinate reference system" in refused.stdout


SFM = {"map_scene_photos", "map_object_photos", "undistort_scene_photos", "undistort_object_photos", "align_models"}
STEREO = {"estimate_depth_maps", "fuse_depth_maps"}
TRAINING = {"estimate_depth_prior", "train_object_nerf", "refine_depth", "retrain_object_nerf", "make_object_cloud"}
POSED = "\tphotos\tcameras\tcloud"


def test_clouds_beside_photos_and_cameras_take_the_place_of_stereo_and_training(yard, snakemake):
    shed = "yard\tclose\tclose.json\tshed.ply\t"
    yard.objects = f"object\tscene{POSED}\tprompts\nshed\t{shed}\nhut\t{shed}clicks.tsv\n"
    plan = snakemake(yard.path, "-n", config=yard.write())
    assert plan.returncode == 0, plan.stdout[-3000:]
    rules = planned(plan.stdout)
    assert {"import_posed_scene_cloud", "import_posed_object_cloud", "find_missing", *SFM} <= rules
    assert not rules & {*STEREO, *TRAINING}
    assert re.search(r"make_masks +1\n", plan.stdout)  # of the hut, which has prompts


def test_photos_without_cameras_are_laid_on_the_scene_s_cloud_by_its_crs(yard, snakemake):
    (yard.path / "yard.ply").write_text("ply")
    yard.scenes = "scene\tphotos\tcloud\tcrs\nyard\tflight\tyard.ply\t\n"
    yard.objects = "object\tscene\tphotos\tprompts\nshed\tyard\tclose\tclicks.tsv\n"
    refused = snakemake(yard.path, "-n", config=yard.write())
    assert refused.returncode != 0
    assert "scenes.tsv, scene 'yard': yard.ply names no CRS" in refused.stdout
    (yard.path / "bad.laz").write_bytes(b"LASF cut")
    yard.scenes = yard.scenes.replace("yard.ply", "bad.laz")
    refused = snakemake(yard.path, "-n", config=yard.write())
    assert "scenes.tsv, scene 'yard': bad.laz is not a readable LAZ cloud" in refused.stdout
    yard.scenes = yard.scenes.replace("bad.laz\t", "yard.ply\tEPSG:25832")
    plan = snakemake(yard.path, "-n", "-p", config=yard.write())
    assert plan.returncode == 0, plan.stdout[-3000:]
    rules = planned(plan.stdout)
    assert {"georegister", "import_posed_scene_cloud", *SFM, *TRAINING} <= rules and not rules & STEREO
    placing = next(line for line in plan.stdout.splitlines() if "georef/georegister.py" in line)
    assert "--held False --crs EPSG:25832 --cloud yard.ply" in placing
    taking = next(line for line in plan.stdout.splitlines() if "georef/import_posed_cloud.py" in line)
    assert "--source yard.ply --georeference-json" in taking and "--crs EPSG:25832" in taking


def test_an_object_s_cloud_beside_photos_without_cameras_stops_before_anything_runs(yard, snakemake):
    yard.objects = "object\tscene\tphotos\tcloud\nshed\tyard\tclose\tshed.ply\n"
    refused = snakemake(yard.path, "-n", config=yard.write())
    assert refused.returncode != 0
    assert "objects.tsv: object 'shed' has both photos and a cloud, but no cameras" in refused.stdout


@pytest.fixture
def yard(tmp_path):
    """The yard with photos, cameras and a cloud, and files for a shed with the same."""
    project = Project(tmp_path)
    for name in ("flight", "close"):
        project.photos(name)
        (project.path / f"{name}.json").write_text("{}")
    for name, content in (("yard.ply", ""), ("shed.ply", ""), ("clicks.tsv", CLICKS)):
        (project.path / name).write_text(content)
    project.scenes = f"scene{POSED}\nyard\tflight\tflight.json\tyard.ply\n"
    return project
