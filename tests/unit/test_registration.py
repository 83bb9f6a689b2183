"""Registration on planted trials: the truth is found, or the object is refused."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from support.planted import errors, plant

from scenefuse.cloud.clouds import Cloud, write_cloud
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import Sim3, Uncertainty
from scenefuse.fuse.write import frame_ledger
from scenefuse.geometry.depth_test import read_free_space
from scenefuse.geometry.icp import ScaleRange, refine_planes, refine_points
from scenefuse.geometry.surface import pair, prepare
from scenefuse.paper.register_as_paper import register_as_paper
from scenefuse.photos.pictures import write_depth
from scenefuse.register.coarse import (
    CoarseSettings,
    find_hypotheses,
    match,
    ransac_similarities,
    upright_candidates,
)
from scenefuse.register.decision import FineSettings
from scenefuse.register.likelihood import COMMON_ERROR, common_error
from scenefuse.register.problem import (
    Alignment,
    Constraints,
    Inputs,
    Problem,
    ScaleSettings,
    comparable,
    estimates,
    prior,
)
from scenefuse.register.refinement import refine_hypotheses
from scenefuse.register.register_object import register_object
from scenefuse.register.score import color_agreement, score
from scenefuse.two_clouds import find

Z = np.array([0.0, 0.0, 1.0])
COARSE, FINE = CoarseSettings(), FineSettings()


# Little work, where only the course of the computation matters.
LITTLE = (
    replace(COARSE, ransac_samples=5000, feature_scale_steps=1, scale_steps=3, yaw_steps=8, candidates=4, keep=2),
    replace(FINE, turn_steps=2, voxel_fraction=0.02),
)
UNTURNED = replace(LITTLE[1], turn_steps=1)


@pytest.fixture(scope="module")
def house():
    return plant("house", 5, ground=False, noise=0.005, object_points=3000, density_ratio=1.0)


def refined(trial, start, *, evidence=None, settings=UNTURNED):
    """The outcome of the fine registration of a trial from one pose, by default without turned copies of it."""
    scales = ScaleRange(trial.scene_from_object.scale, 0.3)
    problem = Problem(trial.object, trial.scene, scales, evidence or Constraints())
    return refine_hypotheses(problem, [(start, "planted")], settings)


@pytest.fixture(scope="module")
def by_clouds(house):
    """The house by its clouds alone, from the true pose."""
    return refined(house, house.scene_from_object, settings=LITTLE[1])


@pytest.mark.slow
def test_a_planted_pose_is_found_and_accepted():
    trial = plant("balloon", 5, ground=False, noise=0.005, object_points=2000, density_ratio=1.0)
    ups = (trial.up_in_object, Z)
    scales = prior(estimates(trial.object, trial.scene, ups), ScaleSettings())
    problem = Problem(trial.object, trial.scene, scales, Constraints(ups, trial.free_space))
    starts = [(h.pose, h.source) for h in find_hypotheses(problem, COARSE)]
    outcome = refine_hypotheses(problem, starts, FINE)
    scale, angle, shift = errors(
        outcome.ranked[0].pose, trial.scene_from_object, trial.object.points.mean(0), trial.diagonal
    )
    assert outcome.decision.registered, outcome.decision.reason
    assert abs(scale) < 2 and angle < 2 and shift < 0.01


def test_rms_scale_of_a_scaled_copy_has_the_right_direction():
    points = np.random.default_rng(0).normal(size=(500, 3))
    found = estimates(Cloud(points), Cloud(3.0 * points + 5), None)
    assert found[0].name == "rms" and found[0].scale == pytest.approx(3.0)
    assert all(e.scale == pytest.approx(3.0, rel=0.02) for e in found)


def test_gravity_adds_footprint_and_height_to_the_ledger(house):
    ledger = {e.name: e.scale for e in estimates(house.object, house.scene, (house.up_in_object, Z))}
    assert set(ledger) == {"rms", "rms_even", "footprint", "height"}
    assert ledger["footprint"] == pytest.approx(house.scene_from_object.scale, rel=0.25)


def surfaces(trial, voxel):
    scale = trial.scene_from_object.scale
    return prepare(trial.object, voxel / scale, 0, 5000), prepare(trial.scene, voxel, 0, 5000)


def test_the_true_pose_scores_higher_than_a_turned_one(house):
    obj, scene = surfaces(house, 0.2)
    truth = house.scene_from_object
    centre = truth.apply(house.object.points.mean(0))
    half_turn = np.diag([-1.0, -1.0, 1.0])
    turned = Sim3(1.0, half_turn, centre - half_turn @ centre) @ truth
    right, wrong = (score(obj, scene, p, 0.3, truth.scale) for p in (truth, turned))
    assert right.f_score > wrong.f_score and right.total > wrong.total
    assert right.color > 0.9 > wrong.color


def test_an_object_that_is_small_beside_a_voxel_of_a_wide_scene_has_no_hypothesis(house):
    problem = Problem(house.object, house.scene, ScaleRange(1e-3 * house.scene_from_object.scale, 0.1))
    assert find_hypotheses(problem, CoarseSettings(ransac_samples=1000, feature_scale_steps=1)) == []


def test_refinement_recovers_a_disturbed_similarity(house):
    obj, scene = surfaces(house, 0.15)
    truth, centre = house.scene_from_object, house.object.points.mean(0)
    turn = Rotation.from_rotvec(np.radians([3, -2, 4])).as_matrix()
    middle = truth.apply(centre)
    start = Sim3(1.04, turn, middle - 1.04 * turn @ middle + 0.2) @ truth
    scales = ScaleRange(truth.scale, 0.2)
    pose = refine_points(obj, scene, start, scales, (0.7, 0.25))
    pose = refine_planes(obj, scene, pose, scales, 0.25, 0.3, 10)
    scale, angle, shift = errors(pose, truth, centre, house.diagonal)
    assert abs(scale) < 1 and angle < 1 and shift < 0.005


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_refinement_does_not_depend_on_the_unit_of_the_scene(house, unit):
    poses = []
    for factor in (1.0, unit):
        into, tau = Sim3(factor, np.eye(3), np.zeros(3)), 0.02 * house.diagonal * factor
        truth = into @ house.scene_from_object
        trial = replace(house, scene=house.scene.transformed(into), scene_from_object=truth)
        start = Sim3(1.0, np.eye(3), np.array([0.4 * tau, 0, 0])) @ truth
        pose = refine_planes(*surfaces(trial, tau / 2), start, ScaleRange(truth.scale, 0.1), tau)
        poses.append(into.inverse() @ pose)
    scale, angle, shift = errors(poses[1], poses[0], house.object.points.mean(0), house.diagonal)
    assert abs(scale) < 0.02 and angle < 0.02 and shift < 2e-4


def test_what_the_scene_does_not_show_does_not_shrink_the_object():
    trial = plant("gate", 5, coverage=0.35, ground=False, noise=0.005, object_points=6000, density_ratio=1.0)
    truth, tau = trial.scene_from_object, 0.02 * trial.diagonal
    obj, scene = surfaces(trial, tau / 2)
    pose = refine_planes(obj, scene, truth, ScaleRange(truth.scale, 0.5), tau, 0.0)
    assert abs(errors(pose, truth, trial.object.points.mean(0), trial.diagonal)[0]) < 0.3


def test_a_prior_of_no_width_holds_the_scale(house):
    obj, scene = surfaces(house, 0.2)
    held = ScaleRange(house.scene_from_object.scale * 1.1, 0.0)
    pose = refine_points(obj, scene, house.scene_from_object, held, (0.5, 0.3))
    pose = refine_planes(obj, scene, pose, held, 0.3, 0.3, 5)
    assert pose.scale == held.centre


def test_upright_sweep_proposes_the_true_yaw_and_scale(house):
    obj, scene = surfaces(house, 0.35)
    truth = house.scene_from_object
    scales = ScaleRange(truth.scale * 1.1, 0.3)
    proposed = upright_candidates(obj, scene, house.up_in_object, scales, 11, 24, 0.6, 8)
    centre = house.object.points.mean(0)
    found = [errors(p, truth, centre, house.diagonal) for p in proposed]
    assert any(abs(scale) < 6 and angle < 12 and shift < 0.06 for scale, angle, shift in found)


def test_ransac_finds_a_similarity_among_false_matches():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(60, 3))
    truth = Sim3(2.0, Rotation.random(random_state=3).as_matrix(), np.array([1.0, 2.0, 3.0]))
    y = truth.apply(x)
    y[30:] = rng.normal(scale=2.0, size=(30, 3)) + truth.translation
    best = ransac_similarities(x, y, ScaleRange(1.7, 0.35), 0.05, 20000, 3, 0, None, 10.0)[0]
    assert np.allclose(best.matrix, truth.matrix, atol=1e-6)


def test_at_a_known_scale_matches_are_as_rough_as_at_an_unknown_one():
    x = np.random.default_rng(1).normal(size=(3, 3))
    for longer, count in ((1.08, 1), (1.15, 0)):
        found = ransac_similarities(x, longer * x, ScaleRange(1.0, 0.0), 0.05, 500, 1, 0, None, 10.0)
        assert len(found) == count and all(pose.scale == 1.0 for pose in found)


def test_mutual_matches_are_each_others_nearest():
    a = np.array([[0.0, 0.0], [5.0, 0.0], [5.2, 0.0]])
    b = np.array([[5.1, 0.0], [0.1, 0.0]])
    assert [0, 1] in match(a, b).tolist() and len(match(a, b)) == 2


def test_color_agreement_ignores_gain_and_bias_but_not_place(house):
    cloud = house.object
    darker = Cloud(cloud.points, cloud.normals, (cloud.colors * 0.6 + 20).astype(np.uint8))
    a, b = prepare(cloud, 0.01, 0, 4000), prepare(darker, 0.01, 0, 4000)
    pairs = pair(a, b, Sim3.identity(), 0.1)
    assert color_agreement(a, b, pairs) > 0.99
    shuffled = Cloud(cloud.points, cloud.normals, np.random.default_rng(0).permutation(cloud.colors))
    assert color_agreement(a, prepare(shuffled, 0.01, 0, 4000), pairs) < 0.3


def test_colours_do_not_count_where_only_one_cloud_has_some(house, monkeypatch):
    """The other's are how bright a laser's echoes are."""
    grey = [replace(c, colors=np.repeat(c.colors[:, :1], 3, axis=1)) for c in (house.object, house.scene)]
    for odd in ((house.object, grey[1]), (grey[0], house.scene)):
        assert all(cloud.colors is None for cloud in comparable(*odd))
    for alike in ((house.object, house.scene), tuple(grey)):
        assert comparable(*alike) == alike
    monkeypatch.setattr(find, "find_hypotheses", lambda problem, settings: [])
    searched = find.search(house.object, grey[1], find.RegistrationSettings(), 0, None, None).problem
    assert searched.object.colors is None and searched.scene.colors is None


@pytest.mark.parametrize(("of_object", "of_scene", "used"), [
    ("headings", "GPS", True), ("image up", "GPS", False), ("headings", "few headings", False), (None, None, True),
])  # fmt: skip
def test_gravity_counts_only_where_it_was_measured_on_both_sides(tmp_path, of_object, of_scene, used):
    cues = [{} if cue is None else {"up_cue": quantity(cue, "")} for cue in (of_object, of_scene)]
    write_json(tmp_path / "undistorted.json", cues[0] | {"up_in_camera_frame": quantity([0, 0.0, 2.0], "1")})
    write_json(tmp_path / "crop.json", cues[1])
    inputs = Inputs(
        tmp_path / "object.ply", tmp_path / "crop.ply", tmp_path / "crop.json", tmp_path / "undistorted.json"
    )
    assert (inputs.ups() is not None) == used


def stage_inputs(folder, obj, scene, up_in_object=None):
    """The files of two clouds as the stages read them; gravity is known when the object's up is given."""
    write_cloud(folder / "object.ply", obj)
    write_cloud(folder / "crop.ply", scene)
    write_json(folder / "crop.json", {"diagonal": quantity(1.0, "m")})
    write_json(folder / "undistorted.json", {"up_in_camera_frame": quantity(up_in_object, "")})
    return Inputs(folder / "object.ply", folder / "crop.ply", folder / "crop.json", folder / "undistorted.json")


def registered(inputs, folder):
    """Register an object as the workflow does, with few candidates; writes scale.json, coarse.json and fine.json."""
    reports = {"scale_report": "scale.json", "coarse_report": "coarse.json", "report": "fine.json"}
    settings = {"scale": ScaleSettings(), "coarse": LITTLE[0], "settings": LITTLE[1]}
    register_object(inputs=inputs, **{key: folder / name for key, name in reports.items()}, seed=0, **settings)


@pytest.mark.slow
def test_the_stage_registers_and_reports_its_scale_and_hypotheses(tmp_path, house):
    inputs = stage_inputs(tmp_path, house.object, house.scene, house.up_in_object)
    registered(inputs, tmp_path)
    assert value(read_json(tmp_path / "scale.json"), "width_log") == 0.5
    assert value(read_json(tmp_path / "coarse.json"), "gravity_used")
    content = read_json(tmp_path / "fine.json")
    assert value(content, "status") == "registered" and value(content, "tilt_deg") < 5
    assert content["translation_sd"]["unit"] == "m" and value(content, "free_space_violation") is None


def test_the_papers_recipe_writes_the_same_files_and_is_called_ungated(tmp_path, house):
    inputs = stage_inputs(tmp_path, house.object, house.scene)
    scale, coarse, fine = (tmp_path / f"{name}.json" for name in ("scale", "coarse", "fine"))
    register_as_paper(
        inputs=inputs, scale_report=scale, coarse_report=coarse, report=fine, picture=tmp_path / "fine.png", seed=0
    )
    assert value(read_json(scale), "width_log") == 0.0 and value(read_json(scale), "method") == "rms"
    assert len(value(read_json(coarse), "hypotheses")) == 1
    content = read_json(fine)
    assert value(content, "status") == "ungated" and value(content, "reason") == "the paper's recipe has no gate"
    assert value(content, "tilt_deg") is None and value(content, "margin") is None
    matrix = np.array(value(content, "scene_from_object"))
    assert Sim3.from_matrix(matrix).scale == pytest.approx(value(content, "scale"))
    assert value(content, "scale") == pytest.approx(value(read_json(scale), "scale"))
    assert (tmp_path / "fine.png").stat().st_size > 1000


def plate(size, seed=0):
    """Points on a horizontal rectangle, without any thickness."""
    return Cloud(np.random.default_rng(seed).uniform(-0.5, 0.5, (3000, 3)) * [*size, 0.0])


@pytest.mark.parametrize("scene_thickness", [0.0, 1e-9, 0.3])
def test_a_flat_object_keeps_a_sane_scale_prior(scene_thickness):
    flat, rough = plate((4, 3)), np.random.default_rng(1).uniform(-1, 1, 3000) * scene_thickness
    scene = plate((8, 6), 1).points
    scene[:, 2] += rough
    for ups in (None, (Z, Z)):
        found = estimates(flat, Cloud(scene), ups)
        assert all(0.5 < e.scale < 8 for e in found)
        assert prior(found, ScaleSettings()).centre == pytest.approx(2.0, rel=0.1)


def test_a_flat_object_ends_in_a_decision(tmp_path):
    inputs = stage_inputs(tmp_path, plate((4, 3)), plate((8, 6), 1), Z)
    registered(inputs, tmp_path)
    assert value(read_json(tmp_path / "fine.json"), "status") in ("registered", "unregistered")


@pytest.mark.parametrize("size, where", [((4, 0), "along one line"), ((0, 0), "in one place")])
def test_a_line_and_a_point_are_one_sentence(tmp_path, house, size, where):
    for inputs in (
        stage_inputs(tmp_path, plate(size), house.scene),
        stage_inputs(tmp_path, house.object, plate(size)),
    ):
        with pytest.raises(StageError, match=f"all 3000 points of .*ply lie {where}"):
            registered(inputs, tmp_path)
    assert not [name for name in ("scale", "coarse", "fine") if (tmp_path / f"{name}.json").exists()]


def test_frame_ledger_chains_its_transforms(tmp_path):
    pose = Sim3(2.5, Rotation.random(random_state=1).as_matrix(), np.array([4e5, 5e6, 100.0]))
    write_json(tmp_path / "o.json", {"nerf_from_object": quantity(np.diag([0.5, 0.5, 0.5, 1.0]), "")})
    ledger = frame_ledger(pose, tmp_path / "o.json", None)
    assert np.allclose(value(ledger, "scene_from_nerf"), (pose @ Sim3(2.0, np.eye(3), np.zeros(3))).matrix)
    assert value(ledger, "world_from_scene") is None
    write_json(tmp_path / "o.json", {"nerf_from_object": quantity(np.diag([1.0, 2, 3, 1]), "")})
    with pytest.raises(StageError, match=r"nerf_from_object in .*o\.json is not a similarity.*rerun its stage"):
        frame_ledger(pose, tmp_path / "o.json", None)


@pytest.mark.slow
def test_a_scale_at_the_edge_of_its_prior_is_refused(house):
    truth = house.scene_from_object
    scales = ScaleRange(truth.scale * np.exp(-0.3), 0.1)
    settings = replace(UNTURNED, min_f_score=0.0)
    problem = Problem(house.object, house.scene, scales)
    assert "at the edge" in refine_hypotheses(problem, [(truth, "planted")], settings).decision.reason


@pytest.mark.slow
def test_a_balloon_without_colours_has_a_free_axis_and_is_no_rival_to_itself():
    def egg(seed):
        points = np.random.default_rng(seed).normal(size=(2000, 3))
        return Cloud(points / np.linalg.norm(points, axis=1, keepdims=True) * [1, 1, 1.6])

    turned = Sim3(1.0, Rotation.from_euler("z", 70, degrees=True).as_matrix(), np.zeros(3))
    poses = [(Sim3.identity(), "one"), (turned, "other")]
    settings = replace(FINE, turn_steps=6, voxel_fraction=0.02, score_fraction=0.04)
    outcome = refine_hypotheses(Problem(egg(0), egg(1), ScaleRange(1.0, 0.2), Constraints((Z, Z))), poses, settings)
    assert outcome.decision.registered, outcome.decision.reason
    assert abs(outcome.decision.free_axis @ Z) > 0.99


def shared(pose: Sim3) -> Alignment:
    return Alignment(pose, Uncertainty.even(0.005, 0.3, 0.02))


@pytest.mark.slow
def test_photos_that_agree_settle_the_pose(house, by_clouds):
    truth = house.scene_from_object
    settings = replace(LITTLE[1], min_margin=1.0)
    linked = refined(house, truth, evidence=Constraints(alignment=shared(truth)), settings=settings).decision
    assert by_clouds.decision.margin < 1.0
    assert linked.registered and linked.decided_by == "both"


@pytest.mark.slow
def test_of_photos_and_clouds_that_agree_the_less_uncertain_gives_the_pose(house):
    truth = house.scene_from_object
    near = Sim3(1.004, np.eye(3), np.zeros(3)) @ truth
    for sd, by_photos in ((1e-4, True), (0.02, False)):
        alignment = Alignment(near, Uncertainty.even(sd, 100 * sd, 10 * sd))
        outcome = refined(house, truth, evidence=Constraints((house.up_in_object, Z), None, alignment))
        assert outcome.decision.decided_by == "both"
        assert (outcome.ranked[0].pose.scale == near.scale) == by_photos


@pytest.mark.slow
def test_clouds_that_fit_as_well_at_the_pose_of_the_photos_are_as_uncertain_as_they_differ(house, by_clouds):
    truth, alone = house.scene_from_object, by_clouds
    apart = 4 * alone.uncertainty.translation_sd
    beside = Sim3(1.0, np.eye(3), np.array([apart, 0, 0])) @ truth
    # Half as certain as the clouds say, and yet less uncertain than what both differ by.
    sure = Uncertainty.even(*2 * alone.uncertainty.deviations)
    outcome = refined(house, truth, evidence=Constraints(None, None, Alignment(beside, sure)))
    assert outcome.ranked[0].pose is beside and outcome.uncertainty is sure
    # The photos are so uncertain that the difference is theirs.
    unsure = Uncertainty.even(*9 * alone.uncertainty.deviations)
    outcome = refined(house, truth, evidence=Constraints(None, None, Alignment(beside, unsure)))
    assert outcome.ranked[0].pose is not beside
    np.testing.assert_allclose(outcome.uncertainty.deviations, alone.uncertainty.deviations)


@pytest.mark.slow
def test_what_surfaces_have_wrong_alike_is_a_share_of_their_scatter_and_only_of_poses_by_clouds(house, by_clouds):
    truth, sigma = house.scene_from_object, 0.003 * house.scene.diagonal
    obj, scene = surfaces(house, 0.02)
    rng = np.random.default_rng(0)
    off = truth.apply(obj.points) + truth.rotate(obj.normals) * rng.normal(0, sigma, (len(obj), 1))
    scene = replace(scene, points=off)
    covariance = common_error(obj, scene, truth, ScaleRange(truth.scale, 0.3), 5 * sigma)
    shift = np.sqrt(np.diag(covariance)[3:6])
    np.testing.assert_allclose(shift, COMMON_ERROR * sigma, rtol=0.1)
    radius = truth.scale * np.linalg.norm(obj.points - obj.points.mean(0), axis=1)
    np.testing.assert_allclose(np.sqrt(covariance[6, 6]) * np.sqrt((radius**2).mean()), shift[0])
    assert common_error(obj, scene, truth, ScaleRange(truth.scale, 0.0), 5 * sigma)[6, 6] == 0
    assert (by_clouds.stated.deviations > by_clouds.uncertainty.deviations).all()
    sure = Alignment(truth, Uncertainty.even(1e-5, 1e-3, 1e-4))
    by_photos = refined(house, truth, evidence=Constraints(alignment=sure))
    assert by_photos.ranked[0].pose is truth and by_photos.stated is by_photos.uncertainty


@pytest.mark.slow
def test_photos_at_whose_pose_the_clouds_lie_worse_must_be_that_much_less_uncertain(house, by_clouds):
    truth = house.scene_from_object
    beside = Sim3(1.0, np.eye(3), np.array([0.025 * house.diagonal, 0, 0])) @ truth
    centre, alone = house.object.points.mean(0), by_clouds
    for share, by_photos in ((0.9, False), (0.05, True)):
        sd = share * alone.uncertainty.size(house.scene.diagonal) * house.scene.diagonal
        evidence = Constraints(None, None, Alignment(beside, Uncertainty.even(0.0, 0.0, sd)))
        outcome = refined(house, truth, evidence=evidence)
        assert outcome.decision.decided_by == "both"
        assert (errors(outcome.ranked[0].pose, truth, centre, house.diagonal)[2] > 0.02) == by_photos


@pytest.mark.slow
def test_photos_overrule_geometry_and_clouds_do_not_carry_their_pose_off(house):
    truth, centre = house.scene_from_object, house.object.points.mean(0)
    half_turn, middle = np.diag([-1.0, -1.0, 1.0]), truth.apply(centre)
    turned = Sim3(1.0, half_turn, middle - half_turn @ middle) @ truth
    evidence = Constraints((house.up_in_object, Z), None, shared(truth))
    outcome = refined(house, turned, evidence=evidence)
    assert outcome.decision.registered and outcome.decision.decided_by == "photos"
    scale, angle, shift = errors(outcome.ranked[0].pose, truth, centre, house.diagonal)
    assert abs(scale) < 2 and angle < 2 and shift < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("lift", "registered"), [(0.05, True), (0.3, False)])
def test_a_pose_of_photos_that_the_scene_refutes_gives_way_to_a_near_one_that_the_clouds_find(house, lift, registered):
    truth, up = house.scene_from_object, lift * house.diagonal
    lifted = Sim3(truth.scale, truth.rotation, truth.translation + [0, 0, up])
    empty = SimpleNamespace(
        violation=lambda points: float(points[:, 2].min() > house.scene.points[:, 2].min() + up / 2)
    )
    sure = Alignment(lifted, Uncertainty.even(1e-4, 0.01, 1e-4))  # of models that are bent
    outcome = refined(house, truth, evidence=Constraints((house.up_in_object, Z), empty, sure))
    assert outcome.decision.registered == registered, outcome.decision.reason
    assert outcome.decision.decided_by == ("near" if registered else "photos")
    if registered:
        centre = house.object.points.mean(0)
        scale, angle, shift = errors(outcome.ranked[0].pose, truth, centre, house.diagonal)
        assert abs(scale) < 2 and angle < 2 and shift < 0.02


@pytest.mark.slow
def test_an_object_in_the_scenes_free_space_is_refused(house):
    truth = house.scene_from_object
    assert house.free_space.violation(truth.apply(house.object.points)) < 0.05
    lifted = Sim3(truth.scale, truth.rotation, truth.translation + [0, 0, 0.5 * house.diagonal])
    assert house.free_space.violation(lifted.apply(house.object.points)) > 0.5
    decision = refined(
        house, lifted, evidence=Constraints((house.up_in_object, Z), house.free_space, shared(lifted))
    ).decision
    assert not decision.registered and "free space" in decision.reason


def test_free_space_is_read_from_the_depth_maps_of_a_workspace(tmp_path, house):
    model = pycolmap.Reconstruction()
    for k, view in enumerate(house.free_space.views, 1):
        (fx, fy), (cx, cy) = np.diag(view.intrinsics)[:2], view.intrinsics[:2, 2]
        # The photos are twice as large as the depth maps.
        size, params = (2 * view.width, 2 * view.height), [2 * fx, 2 * fy, 2 * cx, 2 * cy]
        camera = pycolmap.Camera(model="PINHOLE", width=size[0], height=size[1], params=params, camera_id=k)
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{k}.jpg", camera_id=k, image_id=k)
        pose = view.cam_from_world
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3]))
        write_depth(tmp_path / f"depth/{k % 2}/depth_maps/{k}.jpg.bin", view.pixels)
    (tmp_path / "sparse").mkdir()
    model.write(tmp_path / "sparse")
    chunks, truth = (tmp_path / "depth/0", tmp_path / "depth/1"), house.scene_from_object
    found = read_free_space(tmp_path, chunks, house.scene.points, 5, house.free_space.tolerance)
    assert len(found.views) == min(5, len(house.free_space.views))
    lifted = Sim3(truth.scale, truth.rotation, truth.translation + [0, 0, 0.5 * house.diagonal])
    assert found.violation(truth.apply(house.object.points)) < 0.05
    assert found.violation(lifted.apply(house.object.points)) > 0.5
    assert read_free_space(tmp_path, (tmp_path / "none",), house.scene.points, 5, 1.0) is None
