"""Errors against truth: planted values come back."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pycolmap
import pytest
from support.changed_scene import write_changes

from demo import truth as tr
from demo.evaluate import (
    EvaluationInputs,
    around_object,
    evaluate_object,
    evaluate_scene,
    read_object_truth,
    scene_scores,
)
from demo.truth import Cameras, cameras_json, f_score, pinhole, scores_at
from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3, look_at, rotation_between
from scenefuse.geometry.visual_hull import mask_iou
from scenefuse.photos.pictures import read_gray, write_depth

TRUTH_FROM_OBJECT = Sim3(
    2.5, rotation_between(np.array([0, 0, 1.0]), np.array([0.3, -0.5, 0.8])), np.array([3.0, 1, 2])
)
TRUTH_FROM_SCENE = Sim3(
    1.01, rotation_between(np.array([0, 0, 1.0]), np.array([0.01, 0.02, 1.0])), np.array([0.4, 0, -1])
)


def box_mesh(low, high) -> tr.Mesh:
    mesh = o3d.geometry.TriangleMesh.create_box(*(np.array(high) - low).tolist()).translate(low)
    return tr.Mesh(np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.triangles, dtype=np.int32))


def ring(count: int, distance: float, height: float) -> Cameras:
    angle = 2 * np.pi * np.arange(count) / count
    centres = np.stack([distance * np.cos(angle), distance * np.sin(angle), height + 0.3 * np.cos(3 * angle)], axis=1)
    rotations = np.array([look_at(c, np.array([0, 0, 0.5]), np.array([0, 0, 1.0])) for c in centres])
    return Cameras([f"p_{k}.jpg" for k in range(count)], pinhole(90.0, 96, 72), 96, 72, rotations, centres)


def model_of(cameras: Cameras, model_from_truth: Sim3, folder: Path) -> None:
    reconstruction = pycolmap.Reconstruction()
    lens = cameras.camera
    camera = pycolmap.Camera(model="OPENCV", width=lens.width, height=lens.height, params=lens.params, camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    for index, name in enumerate(cameras.names):
        rotation = cameras.cam_from_world[index] @ model_from_truth.rotation.T
        centre = model_from_truth.apply(cameras.centres[index])
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
        image = pycolmap.Image(name=name, camera_id=1, image_id=index + 1)
        reconstruction.add_image_with_trivial_frame(image, pose)
    folder.mkdir(parents=True)
    reconstruction.write(folder)


def write_mesh(path: Path, mesh: tr.Mesh) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    legacy = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(float)), o3d.utility.Vector3iVector(mesh.triangles)
    )
    o3d.io.write_triangle_mesh(str(path), legacy)


@pytest.fixture(scope="module")
def planted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Truth, and a perfect reconstruction of it, in two other frames: a box of 2 x 1 x 1 m on a plate."""
    root = tmp_path_factory.mktemp("planted")
    thing, plate = box_mesh([-1, -0.5, 0], [1, 0.5, 1]), box_mesh([-6, -6, -0.5], [6, 6, 0])
    orbit, flight = ring(8, 5.0, 2.5), ring(7, 9.0, 9.0)
    extent = {"middle": quantity([0, 0, 0.5], "m"), "diagonal": quantity(6**0.5, "m")}
    write_json(root / "truth/thing/cameras.json", cameras_json(orbit) | {"object": extent})
    write_mesh(root / "truth/thing/mesh.ply", thing)
    write_mesh(root / "truth/scene/meshes/world.ply", plate)
    write_mesh(root / "truth/scene/meshes/thing.ply", thing)
    write_json(
        root / "truth/scene/cameras.json",
        cameras_json(flight)
        | {
            "origin": quantity([47.5, 8.5, 430.0], ""),
            "ground_sampling_distance": quantity(0.1, "m"),
            "mapped_area": quantity([[-5, -5], [5, 5]], "m"),
            "objects": {"thing": extent},
        },
    )
    object_from_truth, scene_from_truth = TRUTH_FROM_OBJECT.inverse(), TRUTH_FROM_SCENE.inverse()
    model_of(orbit, object_from_truth, root / "undistorted/sparse")
    model_of(flight, scene_from_truth, root / "scene")
    write_json(root / "georeference.json", {"status": quantity("none", "")})
    caster = tr.cast_together([thing, plate])
    posed = tr.read_posed(root / "undistorted/sparse", orbit)
    (root / "masks").mkdir()
    (root / "truth/thing/masks").mkdir()
    for view, _ in posed:
        name = view.name
        depth, hit = tr.true_depth(caster, view, TRUTH_FROM_OBJECT, (96, 72))
        mask = (hit == 0).astype(np.uint8) * 255
        cv2.imwrite(str(root / f"masks/{Path(name).stem}.png"), mask)
        cv2.imwrite(str(root / f"truth/thing/masks/{Path(name).stem}.png"), mask)
        finite = np.where(np.isfinite(depth), depth, 0)
        write_depth(root / f"stage1/depth_maps/{name}.bin", (finite / TRUTH_FROM_OBJECT.scale).astype(np.float32))
        write_depth(root / f"stage2/depth_maps/{name}.bin", (1.1 * finite / TRUTH_FROM_OBJECT.scale).astype(np.float32))
    surface = tr.sample_surface(thing, 30000, 1)
    ground = tr.sample_surface(plate, 60000, 2)
    write_cloud(root / "object.ply", Cloud(object_from_truth.apply(surface)))
    half = surface[surface[:, 0] < 0]
    before = Cloud(scene_from_truth.apply(np.concatenate([half, ground])))
    write_cloud(root / "before.ply", before)
    write_changes(root, before, Cloud(scene_from_truth.apply(surface[surface[:, 0] >= 0])))
    exact = scene_from_truth @ TRUTH_FROM_OBJECT
    wrong = Sim3(exact.scale * 1.02, exact.rotation, exact.translation)
    for variant, transform in (("full", exact), ("no_scale", wrong)):
        content = {"status": quantity("registered", ""), "scene_from_object": quantity(transform.matrix, "")}
        write_json(root / variant / "fine.json", content)
    write_json(
        root / "no_crop/fine.json", {"status": quantity("unregistered", ""), "scene_from_object": quantity(None, "")}
    )
    return root


def scene_of(root: Path, out: Path) -> None:
    evaluate_scene(
        model=root / "scene", georeference_json=root / "georeference.json", cloud=root / "before.ply",
        truth_scene=root / "truth/scene", report=out, seed=0,
        samples=20000,
    )  # fmt: skip


def test_a_perfect_scene_has_no_errors(planted: Path, tmp_path: Path) -> None:
    scene_of(planted, tmp_path / "s.json")
    result = read_json(tmp_path / "s.json")
    assert value(result, "registered_share") == 1.0
    assert value(result, "camera_position_max") < 1e-6
    assert value(result, "camera_rotation_max_deg") < 1e-4
    assert value(result, "cloud_distance_median") < 1e-4
    assert value(result, "terrain_covered") > 0.99
    assert value(result, "georeference_error_median") is None
    assert np.allclose(value(result, "truth_from_scene"), TRUTH_FROM_SCENE.matrix, atol=1e-6)


def test_georeferencing_is_measured_with_nothing_fitted(planted: Path, tmp_path: Path) -> None:
    origin = {"origin_latitude_deg": 47.5, "origin_longitude_deg": 8.5, "origin_altitude_m": 428.0}
    write_json(tmp_path / "g.json", {k: quantity(v, "") for k, v in origin.items()})
    model_of(ring(7, 9.0, 9.0), Sim3.identity(), tmp_path / "model")
    evaluate_scene(
        model=tmp_path / "model", georeference_json=tmp_path / "g.json", cloud=planted / "before.ply",
        truth_scene=planted / "truth/scene", report=tmp_path / "s.json", seed=0,
        samples=2000,
    )  # fmt: skip
    assert value(read_json(tmp_path / "s.json"), "georeference_error_median") == pytest.approx(2.0, abs=1e-3)


def object_of(planted: Path, folder: Path, **other: Path) -> dict:
    """The evaluation of the planted object, some of its inputs replaced."""
    scene_of(planted, folder / "s.json")
    inputs = EvaluationInputs(
        workspace=planted / "undistorted",
        sparse=planted / "undistorted/sparse",
        undistorted=planted / "undistorted",
        masks=planted / "masks",
        stages=[planted / "stage1", planted / "stage2"],
        cloud=planted / "object.ply",
        variants=[planted / name / "fine.json" for name in ("full", "no_scale", "no_crop")],
        scene=planted / "before.ply",
        fused=planted / "fused.ply",
        checked=planted / "checked.ply",
        scene_json=folder / "s.json",
        truth_scene=planted / "truth/scene",
        truth_object=planted / "truth/thing",
    )
    evaluate_object(inputs=replace(inputs, **other), report=folder / "o.json", seed=0, samples=20000)
    return read_json(folder / "o.json")


def test_masks_of_distorted_photos_are_compared_where_undistortion_moves_them(planted: Path, tmp_path: Path) -> None:
    orbit = replace(
        ring(8, 5.0, 2.5),
        intrinsics=pinhole(90.0, 96, 72, (0.06, -0.05)),
        distortion=np.array([-0.15, 0.04, 0.01, -0.008]),
    )
    truth, mesh = tmp_path / "thing", tr.read_mesh(planted / "truth/thing/mesh.ply")
    write_json(truth / "cameras.json", read_json(planted / "truth/thing/cameras.json") | cameras_json(orbit))
    write_mesh(truth / "mesh.ply", mesh)
    (truth / "masks").mkdir()
    in_cam, unmoved = np.column_stack([orbit.rays(1), np.ones(96 * 72)]), []
    for name, pose, centre in zip(orbit.names, orbit.cam_from_world, orbit.centres):
        rays = np.column_stack([np.broadcast_to(centre, in_cam.shape), in_cam @ pose]).astype(np.float32)
        hit = np.isfinite(mesh.caster().cast_rays(o3d.core.Tensor.from_numpy(rays))["t_hit"].numpy()).reshape(72, 96)
        cv2.imwrite(str(truth / f"masks/{Path(name).stem}.png"), hit.astype(np.uint8) * 255)
        unmoved.append(mask_iou(hit, read_gray(planted / f"masks/{Path(name).stem}.png") > 127))
    model_of(orbit, TRUTH_FROM_OBJECT.inverse(), tmp_path / "sparse")
    result = object_of(planted, tmp_path, truth_object=truth, sparse=tmp_path / "sparse")
    assert max(unmoved) < 0.8 and value(result, "mask_iou_min") > 0.93
    assert value(result, "cloud_recall_1pct") > 0.97


def test_a_perfect_object_and_a_planted_scale_error(planted: Path, tmp_path: Path) -> None:
    result = object_of(planted, tmp_path)
    assert value(result, "mask_iou_min") == 1.0
    assert value(result, "stage1_depth_error") < 1e-5
    # 10 % of a depth of about 5 m, over a diagonal of 2.45 m.
    assert 0.12 < value(result, "stage2_depth_error") < 0.3
    assert value(result, "stage1_depth_within_1pct") > 0.999
    assert value(result, "stage2_depth_within_1pct") == 0.0
    assert value(result, "cloud_accuracy_90") < 0.01
    assert value(result, "cloud_recall_1pct") > 0.97
    assert value(result, "placed_f_score_1pct") > 0.98
    assert value(result, "rotation_error_deg") < 1e-4
    assert value(result["variants"]["no_scale"], "scale_error_pct") == pytest.approx(2.0, abs=1e-4)
    assert value(result["variants"]["no_crop"], "placed_f_score_025pct") is None
    # 2 % of scale, about a point 1.5 m away, moves the box by 2 to 5 cm: 0.25 % of its diagonal is 6 mm, 2 % is 5 cm.
    scaled = [value(result["variants"]["no_scale"], f"placed_f_score_{e}") for e in ("025pct", "05pct", "1pct", "2pct")]
    assert scaled == sorted(scaled) and scaled[0] < 0.1 and scaled[-1] > 0.8
    assert value(result, "scene_f_score_before_1pct") < 0.75 < 0.97 < value(result, "scene_f_score_after_1pct")
    assert value(result, "scene_precision_before_1pct") > 0.99
    # Half of the box is there: recall is one half where the threshold is above the cloud's spacing, and less below it.
    assert value(result, "scene_recall_before_025pct") < 0.3
    for ending in ("1pct", "2pct"):
        assert value(result, f"scene_recall_before_{ending}") == pytest.approx(0.5, abs=0.05)


def test_scores_at_each_threshold_by_hand() -> None:
    found = scores_at(np.array([0.02, 0.04, 0.09, 0.3]), np.array([0.02, 0.3, 0.3, 0.3]), 10.0)
    assert list(found) == ["025pct", "05pct", "1pct", "2pct"]
    assert [scores["precision"] for scores in found.values()] == [0.25, 0.5, 0.75, 0.75]
    assert [scores["recall"] for scores in found.values()] == [0.25] * 4
    assert found["05pct"]["f_score"] == pytest.approx(2 * 0.5 * 0.25 / 0.75)


def test_a_scene_is_scored_by_its_points_on_the_object_alone(planted: Path) -> None:
    known = read_object_truth(
        planted / "undistorted", planted / "truth/scene", planted / "truth/thing", samples=5000, seed=0
    )
    clouds = [read_cloud(planted / name).points for name in ("before.ply", "fused.ply")]
    scene = TRUTH_FROM_SCENE.apply(np.concatenate(clouds))
    beside = np.array([[1.1, 0, 0.5], [1.3, 0, 0.5], [0.0, 0.9, 0.02]])  # near the box; outside; on the ground
    assert around_object(beside, known).tolist() == [True, False, False]
    assert scene_scores(scene, known, known.surface)["1pct"]["precision"] > 0.999
    spoiled = scene_scores(np.concatenate([scene, np.repeat(beside[:1], 30000, axis=0)]), known, known.surface)
    assert spoiled["1pct"]["precision"] == pytest.approx(0.5, abs=0.05)
    assert scene_scores(np.empty((0, 3)), known, known.surface)["2pct"]["f_score"] == 0.0


def test_f_score_by_hand() -> None:
    precision, recall, score = f_score(np.array([0.1, 0.1, 0.3, 0.3]), np.array([0.1, 0.9, 0.9, 0.9]), 0.2)
    assert (precision, recall) == (0.5, 0.25)
    assert score == pytest.approx(2 * 0.5 * 0.25 / 0.75)
    assert f_score(np.empty(0), np.array([np.inf]), 0.2) == (0.0, 0.0, 0.0)


def test_registration_error_by_hand() -> None:
    turn = rotation_between(np.array([1.0, 0, 0]), np.array([np.cos(0.1), np.sin(0.1), 0]))
    true, estimated = Sim3(2.0, np.eye(3), np.zeros(3)), Sim3(2.1, turn, np.array([0.0, 0, 0.5]))
    error = tr.registration_error(estimated, true, np.zeros(3), 10.0)
    assert error.scale_pct == pytest.approx(5.0)
    assert error.rotation_deg == pytest.approx(np.degrees(0.1))
    assert error.translation_over_diagonal == pytest.approx(0.05)


def test_one_lost_camera_does_not_spoil_the_fit(tmp_path: Path) -> None:
    cameras = ring(9, 5.0, 2.0)
    model_of(cameras, TRUTH_FROM_OBJECT.inverse(), tmp_path / "model")
    posed = tr.read_posed(tmp_path / "model", cameras)
    lost, true = posed[4]
    pose = lost.cam_from_world.copy()
    pose[:3, 3] -= pose[:3, :3] @ np.full(3, 3.0)
    posed[4] = replace(lost, cam_from_world=pose), true
    fit = tr.fit_cameras(posed, cameras)
    assert fit.truth_from_model.scale == pytest.approx(2.5, abs=1e-6)
    assert np.median(fit.position) < 1e-6 and fit.position.max() > 5.0


def test_samples_lie_on_the_mesh_and_spread_by_area() -> None:
    mesh = box_mesh([0, 0, 0], [10, 1, 1])
    points = tr.sample_surface(mesh, 20000, 0)
    assert tr.distances(mesh.caster(), points).max() < 1e-4
    ends = (points[:, 0] < 1e-6) | (points[:, 0] > 10 - 1e-6)
    assert ends.mean() == pytest.approx(2 / 42, abs=0.01)
    assert np.array_equal(points, tr.sample_surface(mesh, 20000, 0))


def test_bad_input_is_named(planted: Path, tmp_path: Path) -> None:
    with pytest.raises(StageError, match="does not exist; render the demo again"):
        tr.read_mesh(tmp_path / "none.ply")
    with pytest.raises(StageError, match="only 0 posed photos"):
        other = ring(4, 5.0, 2.0)
        tr.read_posed(
            planted / "scene", Cameras(["x.jpg"] * 4, other.intrinsics, 96, 72, other.cam_from_world, other.centres)
        )
    (tmp_path / "cameras.json").write_text(json.dumps({"photos": {}}))
    with pytest.raises(StageError, match="is not a truth file"):
        scene_of_bad = tmp_path
        evaluate_scene(
            model=planted / "scene", georeference_json=planted / "georeference.json", cloud=planted / "before.ply",
            truth_scene=scene_of_bad, report=tmp_path / "s.json", seed=0,
        samples=10,
        )  # fmt: skip
