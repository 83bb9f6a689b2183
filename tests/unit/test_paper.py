"""The paper's recipe calls Open3D with the paper's numbers."""

from types import SimpleNamespace

import numpy as np
import open3d as o3d
import pytest
from support.planted import plant

from scenefuse.cloud.clouds import Cloud, write_cloud
from scenefuse.core.stage import quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3, rotation_angle_deg, rotation_between
from scenefuse.geometry.icp import ScaleRange
from scenefuse.paper.register_as_paper import paper_coarse, paper_fine, register_as_paper
from scenefuse.register.problem import Constraints, Inputs, Problem

SCALE = 2.5


@pytest.fixture
def clouds():
    """The upper half of an ellipsoid in its own unit and in the scene's, where it is 2.5 times as large."""
    points = np.random.default_rng(0).normal(size=(2, 3000, 3))
    points *= [3, 2, 1] / np.linalg.norm(points, axis=2, keepdims=True)
    points[..., 2] = np.abs(points[..., 2])
    return Cloud(points[0]), Cloud(SCALE * points[1])


@pytest.fixture
def calls(monkeypatch):
    """The arguments that Open3D's registration functions are called with; each finds that nothing has to move."""
    recorded = {}
    for name in ("registration_ransac_based_on_feature_matching", "registration_icp"):

        def record(*args, name=name):
            recorded[name] = args
            return SimpleNamespace(transformation=np.eye(4))

        monkeypatch.setattr(o3d.pipelines.registration, name, record)
    return recorded


def diagonal(points):
    return np.linalg.norm(np.ptp(points, axis=0))


def thinned(points, voxel):
    return np.asarray(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(voxel).points)


def test_ransac_runs_on_voxels_of_4_percent_with_the_papers_distance_samples_and_confidence(clouds, calls):
    obj, scene = clouds
    voxel = 0.04 * diagonal(scene.points)
    pose, _ = paper_coarse(Problem(obj, scene, ScaleRange(SCALE, 0.0), Constraints(), seed=0))
    args, registration = calls.pop("registration_ransac_based_on_feature_matching"), o3d.pipelines.registration
    assert not calls and pose.scale == SCALE
    source, target, _, _, mutual, distance, estimation, points, checkers, criteria = args
    assert np.allclose(source.points, thinned(SCALE * obj.points, voxel))
    assert np.allclose(target.points, thinned(scene.points, voxel))
    assert mutual and points == 3 and not estimation.with_scaling
    assert distance == pytest.approx(1.5 * voxel)
    limits = {type(checker): checker for checker in checkers}
    assert limits[registration.CorrespondenceCheckerBasedOnDistance].distance_threshold == pytest.approx(1.5 * voxel)
    assert limits[registration.CorrespondenceCheckerBasedOnEdgeLength].similarity_threshold == 0.9
    assert (criteria.max_iteration, criteria.confidence) == (4_000_000, 0.999)


def test_icp_pairs_points_within_two_fifths_of_a_voxel_for_35_iterations_and_holds_the_scale(clouds, calls):
    obj, scene = clouds
    voxel, start = 0.04 * diagonal(scene.points), Sim3(SCALE, np.eye(3), np.array([0.1, 0.0, 0.0]))
    assert np.array_equal(paper_fine(obj, scene, start).matrix, start.matrix)
    source, target, distance, first, estimation, criteria = calls.pop("registration_icp")
    assert not calls
    assert np.allclose(source.points, thinned(start.apply(obj.points), voxel / 2))
    assert np.allclose(target.points, thinned(scene.points, voxel / 2))
    assert distance == pytest.approx(0.4 * voxel) and np.array_equal(first, np.eye(4))
    assert criteria.max_iteration == 35 and not estimation.with_scaling


@pytest.fixture
def copied():
    """A house in its own unit, and a turned, larger copy of it made of other points, with scene_from_object."""
    house = plant("house", 0, coverage=1.0, object_points=8000, depth_maps=False).object.points
    turn = rotation_between(np.array([1.0, 0.0, 0.0]), np.array([0.6, 0.8, 0.0]))
    pose = Sim3(SCALE, turn, np.array([4.0, -2.0, 1.0]))
    return Cloud(house[::2]), Cloud(pose.apply(house[1::2])), pose


def test_the_papers_recipe_finds_the_pose_of_a_copy(copied):
    obj, scene, pose = copied
    found, _ = paper_coarse(Problem(obj, scene, ScaleRange(pose.scale, 0.0), Constraints(), seed=0))
    found = paper_fine(obj, scene, found)
    assert rotation_angle_deg(found.rotation @ pose.rotation.T) < 3
    off = np.linalg.norm(found.apply(obj.points) - pose.apply(obj.points), axis=1)
    assert off.max() < 0.03 * diagonal(scene.points)


def test_the_ratio_of_whole_clouds_is_held(copied, tmp_path):
    obj, scene, pose = copied
    write_cloud(tmp_path / "object.ply", obj)
    write_cloud(tmp_path / "crop.ply", scene)
    write_json(tmp_path / "crop.json", {"diagonal": quantity(1.0, "m")})
    reports = {name: tmp_path / f"{name}.json" for name in ("scale_report", "coarse_report", "report")}
    inputs = Inputs(tmp_path / "object.ply", tmp_path / "crop.ply", tmp_path / "crop.json")
    register_as_paper(inputs=inputs, **reports, seed=0)
    said, fine = read_json(reports["scale_report"]), read_json(reports["report"])
    ledger = {row["name"]: row for row in value(said, "ledger")}
    assert value(said, "method") == "rms"
    assert value(said, "scale") == ledger["rms"]["scale"] == pytest.approx(value(fine, "scale"))
    assert ledger["rms"]["scale"] == pytest.approx(pose.scale, rel=0.02)


@pytest.mark.parametrize(("shapes", "notes"), [("alike", 0), ("unlike", 1)])
def test_the_note_says_when_open3d_has_too_few_mutual_matches(clouds, calls, shapes, notes):
    obj, scene = clouds
    if shapes == "unlike":
        x, y = np.meshgrid(np.linspace(0, 9, 60), np.linspace(0, 9, 60))
        obj = Cloud(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
    assert len(paper_coarse(Problem(obj, scene, ScaleRange(SCALE, 0.0), Constraints(), seed=0))[1]) == notes
