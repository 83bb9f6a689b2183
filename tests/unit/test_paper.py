"""The paper's recipe calls Open3D with the paper's numbers."""

from types import SimpleNamespace

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial.transform import Rotation
from support.planted import plant

from scenefuse.cloud.clouds import Cloud, write_cloud
from scenefuse.core.stage import quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3, rotation_angle_deg, rotation_between
from scenefuse.geometry.icp import ScaleRange
from scenefuse.paper import register_as_paper as paper
from scenefuse.paper.register_as_paper import agreeing, matched_scale, paper_coarse, paper_fine, register_as_paper
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


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_scale_of_matches_is_that_of_a_copy(copied, seed):
    obj, scene, pose = copied
    scale, notes = matched_scale(obj, scene, seed)
    assert scale == pytest.approx(pose.scale, rel=0.05) and "mutual matches agree" in notes[0]


def test_the_scale_of_matches_does_not_go_by_the_size_of_what_is_there(copied):
    obj, scene, pose = copied
    turned = obj.points - obj.points.mean(0)
    part = obj[np.flatnonzero(turned[:, 0] < np.quantile(turned[:, 0], 0.4))]
    ratio = diagonal(scene.points) / diagonal(part.points)
    assert abs(np.log(ratio / pose.scale)) > 0.15  # what the diagonals say
    scale, _ = matched_scale(part, scene, 0)
    assert scale == pytest.approx(pose.scale, rel=0.1)


def test_matches_that_agree_are_told_from_those_that_only_lie_near():
    rng = np.random.default_rng(0)
    source = rng.uniform(-0.5, 0.5, (200, 3))
    pose = Sim3(0.8, Rotation.from_euler("xyz", [40, 20, -70], degrees=True).as_matrix(), np.array([0.1, 0.2, 0.3]))
    target = pose.apply(source)
    wrong = rng.random(200) < 0.7
    target[wrong] = target[rng.permutation(200)[: wrong.sum()]]
    found = agreeing(source, target, 0.01, 0)
    assert np.array_equal(found, np.linalg.norm(pose.apply(source) - target, axis=1) <= 0.01)


def test_matches_along_one_line_agree_on_nothing(monkeypatch):
    monkeypatch.setattr(paper, "RANSAC_SAMPLES", 100)
    line = np.outer(np.arange(9.0), [1, 2, 3])
    assert not agreeing(line, 1.1 * line, 0.1, 0).any()


@pytest.mark.parametrize(("right", "draws"), [(3, 3), (90, 1)])
def test_no_more_samples_are_drawn_than_the_paper_has_and_fewer_where_many_matches_agree(monkeypatch, right, draws):
    """Three matches of a hundred ask for 250,000 samples."""
    monkeypatch.setattr(paper, "RANSAC_SAMPLES", 40_000)
    rng, drawn = np.random.default_rng(0), []

    class Counted:
        def integers(self, *arguments):
            drawn.append(arguments)
            return rng.integers(*arguments)

    source, target = rng.uniform(-0.5, 0.5, (2, 100, 3))
    target[:right] = 0.8 * source[:right]
    monkeypatch.setattr(np.random, "default_rng", lambda seed: Counted())
    agreeing(source, target, 0.02, 0)
    assert len(drawn) == draws


def test_too_few_matches_give_no_scale_and_say_so(copied, capsys, monkeypatch):
    monkeypatch.setattr(paper, "RANSAC_SAMPLES", 20_000)
    ball = np.random.default_rng(0).normal(size=(30, 3))
    scale, notes = matched_scale(Cloud(ball / np.linalg.norm(ball, axis=1, keepdims=True)), copied[1], 0)
    assert scale is None and "too few: the scale is the RMS ratio of the whole clouds" in notes[0]
    assert "mutual matches agree" in capsys.readouterr().out


def test_the_papers_recipe_finds_the_pose_of_a_copy(copied):
    obj, scene, pose = copied
    found, _ = paper_coarse(Problem(obj, scene, ScaleRange(pose.scale, 0.0), Constraints(), seed=0))
    found = paper_fine(obj, scene, found)
    assert rotation_angle_deg(found.rotation @ pose.rotation.T) < 3
    off = np.linalg.norm(found.apply(obj.points) - pose.apply(obj.points), axis=1)
    assert off.max() < 0.03 * diagonal(scene.points)


def test_scale_by_matches_is_held_and_the_ratio_of_whole_clouds_stands_beside_it(copied, tmp_path):
    obj, scene, pose = copied
    write_cloud(tmp_path / "object.ply", obj)
    write_cloud(tmp_path / "crop.ply", scene)
    write_json(tmp_path / "crop.json", {"diagonal": quantity(1.0, "m")})
    reports = {name: tmp_path / f"{name}.json" for name in ("scale_report", "coarse_report", "report")}
    inputs = Inputs(tmp_path / "object.ply", tmp_path / "crop.ply", tmp_path / "crop.json")
    register_as_paper(inputs=inputs, **reports, scale="ransac_svd", seed=0)
    said, fine = read_json(reports["scale_report"]), read_json(reports["report"])
    ledger = {row["name"]: row for row in value(said, "ledger")}
    assert value(said, "method") == "ransac_svd" and ledger["ransac_svd"]["used"] and not ledger["rms"]["used"]
    assert value(said, "scale") == ledger["ransac_svd"]["scale"] == pytest.approx(value(fine, "scale"))
    assert ledger["rms"]["scale"] == pytest.approx(pose.scale, rel=0.02)


@pytest.mark.parametrize(("shapes", "notes"), [("alike", 0), ("unlike", 1)])
def test_the_note_says_when_open3d_has_too_few_mutual_matches(clouds, calls, shapes, notes):
    obj, scene = clouds
    if shapes == "unlike":
        x, y = np.meshgrid(np.linspace(0, 9, 60), np.linspace(0, 9, 60))
        obj = Cloud(np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))
    assert len(paper_coarse(Problem(obj, scene, ScaleRange(SCALE, 0.0), Constraints(), seed=0))[1]) == notes
