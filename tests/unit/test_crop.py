"""The crop keeps the object and nothing else."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from support.planted import plant

from scenefuse.cloud import tiled_cloud
from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud, write_cloud
from scenefuse.cloud.tiled_cloud import write_tiled
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.crop.crop_cloud import CropSettings, crop_cloud
from scenefuse.crop.crop_scene import CropInputs, crop_scene
from scenefuse.crop.marked import count, read_masked_views, vote
from scenefuse.geometry.ground import fit_ground

Z = np.array([0.0, 0.0, 1.0])
SETTINGS = CropSettings()


@pytest.mark.parametrize("slope", [0.0, 0.15])
def test_ground_goes_and_the_object_stays(slope):
    trial = plant("house", 2, noise=0.002, slope=slope, object_points=4000, density_ratio=1.0)
    own = np.arange(len(trial.scene)) < 3000
    keep = crop_cloud(trial.scene, trial.fiducials, Z, SETTINGS).keep
    above = trial.scene.points[:, 2] > slope * trial.scene.points[:, 0] + 1.0
    assert keep[own & above].mean() > 0.98
    assert (keep & ~own).sum() < 0.05 * keep.sum()


def test_a_tree_inside_the_box_is_left_out():
    trial = plant("house", 2, noise=0.002, object_points=4000, density_ratio=1.0)
    rng = np.random.default_rng(0)
    tree = trial.fiducials.max(0) * [1, 1, 0] + [0.9, 0.9, 3.0] + rng.normal(0, 0.15, (60, 3))
    scene = concatenate([Cloud(trial.scene.points), Cloud(tree)])
    keep = crop_cloud(scene, trial.fiducials, Z, replace(SETTINGS, margin=0.2)).keep
    assert not keep[-60:].any()


def test_the_papers_crop_is_all_that_lies_in_the_least_box_of_the_fiducials():
    trial = plant("house", 2, noise=0.002, object_points=4000, density_ratio=1.0)
    points, marks = trial.scene.points, trial.fiducials
    settings = replace(SETTINGS, margin=0.3, minimal=True)
    cut = crop_cloud(trial.scene, marks, Z, settings)
    inside = ((points >= marks.min(0)) & (points <= marks.max(0))).all(1)
    assert inside.any() and (cut.keep == inside).all() and not cut.on_ground.any() and cut.ground is None
    assert (crop_cloud(trial.scene, marks, Z, replace(settings, minimal=False)).keep != inside).any()


@pytest.mark.slow
def test_without_ground_nothing_is_removed_and_that_is_said():
    trial = plant("sculpture", 1, ground=False, noise=0.002, object_points=4000, density_ratio=1.0)
    cut = crop_cloud(trial.scene, trial.fiducials, Z, SETTINGS)
    assert cut.ground is None and cut.keep.mean() > 0.97
    assert "no ground" in cut.notes[0]


def test_parts_far_from_every_fiducial_are_kept_and_that_is_said(monkeypatch):
    trial = plant("sculpture", 1, ground=False, noise=0.002, object_points=4000, density_ratio=1.0)
    low, high = trial.scene.points.min(0), trial.scene.points.max(0)
    far = low + (high - low) * np.array([[-9, -9, -9], [9, -9, -9], [-9, 9, -9], [9, 9, 9]])
    monkeypatch.setattr("scenefuse.crop.crop_cloud.MIN_PART_SHARE", 1.1)
    cut = crop_cloud(trial.scene, far, Z, SETTINGS)
    assert cut.keep.all() and "no part in the box lies near a fiducial" in cut.notes[1]


def test_ground_is_a_height_field_with_the_planted_slope():
    rng = np.random.default_rng(0)
    points = rng.uniform(-10, 10, (5000, 3))
    points[:, 2] = 0.1 * points[:, 0] - 0.2 * points[:, 1] + 3
    ground = fit_ground(points, np.array([-3.0, -3, 0]), np.array([3.0, 3, 9]), 4.0, 0.1)
    assert ground.height(np.array([[1.0, 2.0]]))[0] == pytest.approx(0.1 - 0.4 + 3, abs=0.05)


def test_stage_writes_the_crop_and_its_box(tmp_path):
    trial = plant("house", 2, noise=0.002, object_points=4000, density_ratio=1.0)
    files = stage_files(tmp_path, trial, trial.fiducials)
    crop_scene(**files, settings=SETTINGS)
    report = read_json(files["report"])
    assert value(report, "crop_points") == len(read_cloud(files["crop"])) > 2500
    assert report["diagonal"]["unit"] == "scene units"
    write_json(tmp_path / "georeference.json", {"length_unit": quantity("m", "")})
    georeferenced = replace(files["inputs"], georeference_json=tmp_path / "georeference.json")
    crop_scene(**files | {"inputs": georeferenced}, settings=SETTINGS)
    assert read_json(files["report"])["diagonal"]["unit"] == "m"
    crop_scene(**files, settings=replace(SETTINGS, whole_scene=True))
    assert len(read_cloud(files["crop"])) == len(trial.scene)
    assert value(read_json(files["report"]), "mode") == "none"


def test_the_crop_of_a_large_scene_is_that_of_the_part_around_the_marks(tmp_path, monkeypatch):
    trial = plant("house", 2, noise=0.002, object_points=4000, density_ratio=1.0)
    files = stage_files(tmp_path, trial, trial.fiducials)
    crop_scene(**files, settings=SETTINGS)
    alone, report = read_cloud(files["crop"]), read_json(files["report"])
    far = np.random.default_rng(0).uniform(-1, 1, (60000, 3)) * 40 * trial.diagonal * [1, 1, 0.001]
    far = far[(np.abs(far[:, :2]) > 4 * trial.diagonal).any(1)]
    scene = concatenate([Cloud(far), Cloud(trial.scene.points)])
    monkeypatch.setattr(tiled_cloud, "WHOLE", 2000)
    monkeypatch.setattr(tiled_cloud, "TILE", 500)
    write_tiled(files["inputs"].scene, lambda: [scene], len(scene), scene.points)
    crop_scene(**files, settings=SETTINGS)
    found = read_cloud(files["crop"])
    same = np.isin(found.points[:, 0], alone.points[:, 0]).sum()
    assert same > 0.99 * max(len(found), len(alone))
    assert value(read_json(files["report"]), "scene_points") == len(scene) > value(report, "scene_points")


def test_a_large_scene_without_any_mark_is_one_sentence(tmp_path, monkeypatch):
    trial = plant("house", 2, noise=0.002, object_points=4000, density_ratio=1.0)
    monkeypatch.setattr("scenefuse.crop.crop_scene.MAX_WHOLE_POINTS", 1000)
    with pytest.raises(StageError, match="nothing marks the object, and the scene has .* mark it"):
        crop_scene(**stage_files(tmp_path, trial, trial.fiducials), settings=replace(SETTINGS, whole_scene=True))


def test_bad_fiducials_end_in_one_sentence(tmp_path):
    trial = plant("house", 2, noise=0.002, object_points=4000, density_ratio=1.0)
    cases = [
        (trial.fiducials[:3], "at least 4"),
        (trial.fiducials + [500, 0, 0], "nearest scene point"),
        (trial.fiducials[:1] + 0.05 * np.eye(4, 3), "a fiducial or mask may not lie on it"),
    ]
    for fiducials, sentence in cases:
        files = stage_files(tmp_path, trial, fiducials)
        with pytest.raises(StageError, match=sentence):
            crop_scene(**files, settings=SETTINGS)
        assert not files["crop"].exists()


@pytest.fixture(scope="module")
def orbit(tmp_path_factory):
    """A planted house with its masks, seen by 12 cameras around it in the object's own frame."""
    folder = tmp_path_factory.mktemp("orbit")
    trial = plant("house", 2, noise=0.002, object_points=20000, density_ratio=0.5)
    object_from_scene = trial.scene_from_object.inverse()
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=320, height=240, params=[250, 250, 160, 120], camera_id=1)
    )
    (folder / "masks").mkdir()
    middle = trial.fiducials.mean(0)
    sparse, tracks = trial.object.points[:400], [[] for _ in range(400)]
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, 12, endpoint=False)):
        centre = middle + 1.4 * trial.diagonal * np.array([np.cos(angle), np.sin(angle), 0.3])
        z = (middle - centre) / np.linalg.norm(middle - centre)
        x = np.cross(z, Z) / np.linalg.norm(np.cross(z, Z))
        in_object = np.stack([x, np.cross(z, x), z]) @ trial.scene_from_object.rotation
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(in_object), -in_object @ object_from_scene.apply(centre))
        seen = trial.object.points @ in_object.T + pose.translation
        pixels = 250 * seen[:, :2] / seen[:, 2:] + [160, 120]
        image = pycolmap.Image(
            name=f"{k}.jpg", camera_id=1, image_id=k + 1, points2D=[pycolmap.Point2D(p) for p in pixels[:400]]
        )
        model.add_image_with_trivial_frame(image, pose)
        for row, track in enumerate(tracks):
            track.append(pycolmap.TrackElement(k + 1, row))
        u, v = pixels.astype(int).T
        mask = np.zeros((240, 320), np.uint8)
        mask[v, u] = 255
        cv2.imwrite(str(folder / f"masks/{k}.png"), cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)))
    for point, track in zip(sparse, tracks):
        model.add_point3D(point, pycolmap.Track(track), np.zeros(3, np.uint8))
    (folder / "undistorted/sparse").mkdir(parents=True)
    model.write(folder / "undistorted/sparse")
    write_cloud(folder / "dense.ply", trial.scene)
    pose = quantity(trial.scene_from_object.matrix, "")
    write_json(folder / "alignment.json", {"found": quantity(True, ""), "scene_from_object": pose})
    return folder, trial


def own_points(trial):
    """How many of the scene's points, its first ones, are the object's."""
    return int(10000 * trial.coverage)


def test_masks_vote_for_the_object_and_against_what_is_around_it(orbit):
    folder, trial = orbit
    own = np.arange(len(trial.scene)) < own_points(trial)
    photos = read_masked_views(folder / "undistorted", folder / "masks", 0.8)
    voted, other = vote(trial.scene.points, photos, trial.scene_from_object, 0.8)
    assert voted[own].mean() > 0.95 and other[own].mean() < 0.02
    low, high = trial.fiducials.min(0) - 0.05 * trial.diagonal, trial.fiducials.max(0) + 0.05 * trial.diagonal
    outside = ~own & ((trial.scene.points < low) | (trial.scene.points > high))[:, :2].any(1)
    assert outside.sum() > 1000 and voted[outside].sum() == 0
    reach = 0.2 * trial.diagonal
    beside = outside & ((trial.scene.points > low - reach) & (trial.scene.points < high + reach)).all(1)
    assert beside.sum() > 1000 and other[beside].mean() > 0.8
    there = trial.scene_from_object.apply(photos.own)
    assert len(there) > 300 and ((there > low) & (there < high))[:, :2].all()
    # Through a wrong similarity the masks meet other points, or none.
    moved = Sim3(1.0, np.eye(3), np.array([0.5 * trial.diagonal, 0, 0])) @ trial.scene_from_object
    wrong, _ = vote(trial.scene.points, photos, moved, 0.8)
    assert wrong[own].mean() < 0.6


def test_what_shines_through_a_hole_far_behind_the_object_is_not_the_object(orbit, tmp_path):
    """Three photos from one side: what lies behind the house is inside all their masks."""
    folder, trial = orbit
    (tmp_path / "masks").mkdir()
    for k in (11, 0, 1):
        shutil.copy(folder / f"masks/{k}.png", tmp_path / "masks")
    middle = trial.fiducials.mean(0)
    behind = middle - [0.8 * trial.diagonal, 0, 0] + np.random.default_rng(0).normal(0, 0.004, (50, 3)) * trial.diagonal
    on_it = np.array([middle, middle + 0.02 * trial.diagonal])
    both = np.concatenate([behind, on_it])
    photos = read_masked_views(folder / "undistorted", tmp_path / "masks", 0.8)
    voted, _ = vote(both, photos, trial.scene_from_object, 0.8)
    _, shown, inside = count(trial.scene_from_object.inverse().apply(behind), photos.views, 2)
    assert ((inside == 3) & (shown == 3)).mean() > 0.8
    assert not voted[:50].any()


@pytest.mark.slow
def test_what_hides_the_object_takes_no_vote_from_it(orbit):
    """A fence between some of the cameras and the house; their masks show no house."""
    folder, trial = orbit
    views = read_masked_views(folder / "undistorted", folder / "masks", 0.8).views
    middle, size = trial.fiducials.mean(0), trial.diagonal
    rng = np.random.default_rng(0)
    y, z = rng.uniform(-2 * size, 2 * size, 200000), rng.uniform(-size, size, 200000)
    fence = middle + np.stack([np.full(200000, 0.7 * size), y, z], axis=1)
    blind = []
    for view in views:
        hidden = trial.scene_from_object.apply(view.centre)[0] > middle[0] + 0.7 * size
        blind.append(replace(view, pixels=np.zeros_like(view.pixels)) if hidden else view)
    assert sum(not view.pixels.any() for view in blind) == 3
    points = trial.scene.points
    facing = np.flatnonzero(points[: own_points(trial), 0] > middle[0] + 0.2 * size)
    assert len(facing) > 100
    shares = []
    for scene in (np.concatenate([points, fence]), points):
        _, shown, inside = count(trial.scene_from_object.inverse().apply(scene), blind, 2)
        shares.append(np.mean((shown >= 3)[facing] & (inside >= 0.8 * shown)[facing]))
    assert shares[0] > 0.8 and shares[1] < 0.4


@pytest.mark.slow
def test_stage_crops_by_masks_as_by_clicks(orbit, tmp_path):
    folder, trial = orbit
    files = stage_files(tmp_path, trial, trial.fiducials)
    crop_scene(**files, settings=SETTINGS)
    clicked = read_cloud(files["crop"]).points
    files |= {"inputs": masked(files["inputs"], folder, folder / "alignment.json")}
    crop_scene(**files, settings=SETTINGS)
    voted, report = read_cloud(files["crop"]).points, read_json(files["report"])
    both = len({*map(tuple, clicked)} & {*map(tuple, voted)})
    assert both > 0.9 * max(len(clicked), len(voted))
    assert value(report, "mode") == "masks"
    assert value(report, "fiducials") == [] and value(report, "ground_points") > 0


def test_without_fiducials_and_without_an_alignment_the_sentence_names_both_ways_out(orbit, tmp_path):
    folder, trial = orbit
    files = stage_files(tmp_path, trial, trial.fiducials)
    files |= {"inputs": masked(files["inputs"], folder, tmp_path / "alignment.json")}
    not_found = {"found": quantity(False, ""), "reason": quantity("only 3 of 90 matched points agree", "")}
    write_json(tmp_path / "alignment.json", not_found)
    with pytest.raises(StageError, match=r"only 3 of 90 .* column fiducials .* or add photos"):
        crop_scene(**files, settings=SETTINGS)
    far = Sim3(1.0, np.eye(3), np.array([500.0, 0, 0])) @ trial.scene_from_object
    elsewhere = {"found": quantity(True, ""), "scene_from_object": quantity(far.matrix, "")}
    write_json(tmp_path / "alignment.json", elsewhere)
    with pytest.raises(StageError, match="only 0 scene points are left in the box of .*masks"):
        crop_scene(**files, settings=SETTINGS)
    assert not files["crop"].exists()


@pytest.mark.slow
def test_masks_come_before_fiducials_which_then_check_them(orbit, tmp_path):
    folder, trial = orbit
    files = stage_files(tmp_path, trial, trial.fiducials)
    both = replace(masked(files["inputs"], folder, folder / "alignment.json"), fiducials=files["inputs"].fiducials)
    crop_scene(**files | {"inputs": both}, settings=SETTINGS)
    report = read_json(files["report"])
    assert value(report, "mode") == "masks" and len(value(report, "fiducials")) == len(trial.fiducials)
    assert not any("outside the box" in note for note in value(report, "notes"))
    crop_scene(**files | {"inputs": both}, settings=replace(SETTINGS, mode="fiducials"))
    assert value(read_json(files["report"]), "mode") == "fiducials"
    away = trial.fiducials + [0, 0, 0.8 * trial.diagonal]
    stray = np.concatenate([trial.fiducials[:4], away[:1]])
    crop_scene(**stage_files(tmp_path, trial, stray) | {"inputs": both}, settings=SETTINGS)
    assert value(read_json(files["report"]), "notes")[1].endswith("lie outside the box: p4")
    with pytest.raises(StageError, match="all 5 marks of .* lie outside the box that marks the object"):
        crop_scene(**stage_files(tmp_path, trial, away[:5]) | {"inputs": both}, settings=SETTINGS)


def test_without_masks_the_object_s_own_cloud_marks_it_through_the_alignment(orbit, tmp_path):
    folder, trial = orbit
    files = stage_files(tmp_path, trial, trial.fiducials)
    crop_scene(**files, settings=SETTINGS)
    clicked = read_cloud(files["crop"]).points
    write_cloud(tmp_path / "object.ply", trial.object)
    alone = replace(files["inputs"], fiducials=None, cloud=tmp_path / "object.ply")
    linked = replace(alone, alignment_json=folder / "alignment.json")
    crop_scene(**files | {"inputs": linked}, settings=SETTINGS)
    own = read_cloud(files["crop"]).points
    assert value(read_json(files["report"]), "mode") == "cloud"
    assert len({*map(tuple, clicked)} & {*map(tuple, own)}) > 0.9 * max(len(clicked), len(own))
    not_found = {"found": quantity(False, ""), "reason": quantity("only 3 of 90 matched points agree", "")}
    write_json(tmp_path / "alignment.json", not_found)
    crop_scene(**files | {"inputs": replace(alone, alignment_json=tmp_path / "alignment.json")}, settings=SETTINGS)
    assert value(read_json(files["report"]), "mode") == "none"  # the whole scene


def test_without_an_alignment_the_fiducials_mark_the_object_and_that_is_said(orbit, tmp_path):
    folder, trial = orbit
    files = stage_files(tmp_path, trial, trial.fiducials)
    not_found = {"found": quantity(False, ""), "reason": quantity("only 3 of 90 matched points agree", "")}
    write_json(tmp_path / "alignment.json", not_found)
    inputs = replace(masked(files["inputs"], folder, tmp_path / "alignment.json"), fiducials=files["inputs"].fiducials)
    crop_scene(**files | {"inputs": inputs}, settings=SETTINGS)
    report = read_json(files["report"])
    assert value(report, "mode") == "fiducials" and "only 3 of 90" in value(report, "notes")[0]


def stage_files(folder, trial, fiducials):
    lines = [f"p{k}\t{x}\t{y}\t{z}" for k, (x, y, z) in enumerate(fiducials)]
    (folder / "fiducials.tsv").write_text("point\tx\ty\tz\n" + "\n".join(lines) + "\n")
    write_cloud(folder / "dense.ply", trial.scene)
    inputs = CropInputs(scene=folder / "dense.ply", sparse=folder, fiducials=folder / "fiducials.tsv")
    return {"inputs": inputs, "crop": folder / "crop.ply", "report": folder / "crop.json"}


def masked(inputs, folder, alignment_json):
    """The inputs with the masks of `orbit` in place of the fiducials."""
    marks = {"alignment_json": alignment_json, "workspace": folder / "undistorted", "masks": folder / "masks"}
    return replace(inputs, fiducials=None, **marks)


def test_an_object_that_nothing_links_with_its_scene_is_to_be_clicked_there(orbit, tmp_path):
    folder, trial = orbit
    files, alignment = stage_files(tmp_path, trial, trial.fiducials), tmp_path / "shed/alignment.json"
    write_json(alignment, {"found": quantity(False, ""), "reason": quantity("nothing is alike", "")})
    inputs = masked(files["inputs"], folder, alignment)
    with pytest.raises(
        StageError, match=r"nothing is alike; .*: if one .* click on it there \(scenefuse pick --object shed,"
    ):
        crop_scene(**files | {"inputs": inputs}, settings=SETTINGS)


def test_a_mask_of_another_size_is_one_sentence(orbit, tmp_path):
    folder, _ = orbit
    shutil.copytree(folder / "masks", tmp_path / "masks")
    cv2.imwrite(str(tmp_path / "masks/3.png"), np.full((120, 160), 255, np.uint8))
    with pytest.raises(StageError, match="3.png is 160 x 120 pixels, but its camera is made for 320 x 240"):
        read_masked_views(folder / "undistorted", tmp_path / "masks", 0.8)
