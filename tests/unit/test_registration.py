"""Registration on planted trials: the truth is found, or the object is refused."""

from dataclasses import replace

import numpy as np
import pytest
from planted import errors, plant
from scenefuse.registration.evidence import Alignment, Evidence
from scenefuse.registration.features import match, ransac_similarities
from scenefuse.registration.refine import ScaleRange, Uncertainty, refine_planes, refine_points, uncertainty
from scenefuse.registration.upright import upright_hypotheses
from scipy.spatial.transform import Rotation

from scenefuse.io.clouds import Cloud, write_cloud
from scenefuse.io.settings import build, read_settings
from scenefuse.registration.coarse import CoarseSettings, find_hypotheses, register_coarsely
from scenefuse.registration.fine import FineSettings, refine_hypotheses, register_finely, scale_ledger
from scenefuse.registration.frame_ledger import round_trip, write_frame_ledger
from scenefuse.registration.scale import estimate_scale, estimates, prior_centre
from scenefuse.registration.score import color_agreement, pair, score
from scenefuse.registration.surface import prepare
from scenefuse.registration.verify import tilt_deg
from scenefuse.stage import StageError, quantity, read_json, value, write_json
from scenefuse.transforms import Sim3

Z = np.array([0.0, 0.0, 1.0])
SHIPPED = read_settings(None)["registration"]
COARSE, FINE = build(CoarseSettings, SHIPPED["coarse"]), build(FineSettings, SHIPPED["fine"])


# Little work, where only the course of the computation matters.
LITTLE = (
    replace(COARSE, ransac_samples=5000, feature_scale_steps=1, scale_steps=3, yaw_steps=8, candidates=4, keep=2),
    replace(FINE, turn_steps=6, fine_voxel_fraction=0.02),
)


@pytest.fixture(scope="module")
def house():
    return plant("house", 5, ground=False, noise=0.005, object_points=6000, density_ratio=1.0)


def register(trial, scene=None, settings=(COARSE, FINE), seed=0):
    scene = trial.scene if scene is None else scene
    ups = (trial.up_in_object, Z)
    prior = ScaleRange(prior_centre(estimates(trial.object, scene, ups)), 0.5)
    found = find_hypotheses(trial.object, scene, prior, ups, settings[0], seed)
    return refine_hypotheses(
        trial.object,
        scene,
        [(h.pose, h.source) for h in found],
        prior,
        Evidence(ups, trial.free_space),
        settings[1],
        seed,
    )


@pytest.mark.parametrize("name", ["house", "balloon"])
def test_a_planted_pose_is_found_and_accepted(name):
    trial = plant(name, 5, ground=False, noise=0.005, object_points=6000, density_ratio=1.0)
    outcome = register(trial)
    scale, angle, shift = errors(
        outcome.ranked[0].pose, trial.scene_from_object, trial.object.points.mean(0), trial.diagonal
    )
    assert outcome.decision.registered, outcome.decision.reason
    assert abs(scale) < 2 and angle < 2 and shift < 0.01


def test_another_object_is_refused(house):
    other = plant("sculpture", 7, ground=False, noise=0.005, density_ratio=1.0).scene
    decision = register(house, other, LITTLE).decision
    assert not decision.registered
    assert "F-score" in decision.reason or "explains" in decision.reason


def test_two_runs_agree_bit_for_bit(house):
    first, second = register(house, settings=LITTLE), register(house, settings=LITTLE)
    assert [h.pose.matrix.tobytes() for h in first.ranked] == [h.pose.matrix.tobytes() for h in second.ranked]


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
    right, wrong = (score(obj, scene, p, 0.3, 2.0, truth.scale) for p in (truth, turned))
    assert right.f_score > wrong.f_score and right.total > wrong.total
    assert right.color > 0.9 > wrong.color


def test_refinement_recovers_a_disturbed_similarity(house):
    obj, scene = surfaces(house, 0.15)
    truth, centre = house.scene_from_object, house.object.points.mean(0)
    turn = Rotation.from_rotvec(np.radians([3, -2, 4])).as_matrix()
    middle = truth.apply(centre)
    start = Sim3(1.04, turn, middle - 1.04 * turn @ middle + 0.2) @ truth
    prior = ScaleRange(truth.scale, 0.2)
    pose = refine_points(obj, scene, start, prior, (0.7, 0.25), 25)
    pose = refine_planes(obj, scene, pose, prior, 0.25, 10, 0.3)
    scale, angle, shift = errors(pose, truth, centre, house.diagonal)
    assert abs(scale) < 1 and angle < 1 and shift < 0.005


def test_what_the_scene_does_not_show_does_not_shrink_the_object():
    trial = plant("gate", 5, coverage=0.35, ground=False, noise=0.005, object_points=6000, density_ratio=1.0)
    truth, tau = trial.scene_from_object, 0.02 * trial.diagonal
    obj, scene = surfaces(trial, tau / 2)
    pose = refine_planes(obj, scene, truth, ScaleRange(truth.scale, 0.5), tau, 60, 0.0)
    assert abs(errors(pose, truth, trial.object.points.mean(0), trial.diagonal)[0]) < 0.3


def test_a_prior_of_no_width_holds_the_scale(house):
    obj, scene = surfaces(house, 0.2)
    held = ScaleRange(house.scene_from_object.scale * 1.1, 0.0)
    pose = refine_points(obj, scene, house.scene_from_object, held, (0.5, 0.3), 5)
    pose = refine_planes(obj, scene, pose, held, 0.3, 5, 0.3)
    assert pose.scale == held.centre


def test_upright_sweep_proposes_the_true_yaw_and_scale(house):
    obj, scene = surfaces(house, 0.35)
    truth = house.scene_from_object
    proposed = upright_hypotheses(
        obj, scene, house.up_in_object, ScaleRange(truth.scale * 1.1, 0.3), 11, 24, 0.6, 2.0, 8
    )
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


def test_tilt_is_the_angle_between_the_ups():
    turn = Rotation.from_rotvec([np.radians(30), 0, 0]).as_matrix()
    assert tilt_deg(Sim3(2.0, turn, np.zeros(3)), (Z, Z)) == pytest.approx(30)


def test_stages_write_their_files_and_refuse_honestly(tmp_path, house):
    write_cloud(tmp_path / "object.ply", house.object)
    write_cloud(tmp_path / "crop.ply", house.scene)
    write_json(tmp_path / "crop.json", {"up_in_scene": quantity(Z, ""), "diagonal": quantity(1.0, "m")})
    write_json(tmp_path / "cameras.json", {"up_in_camera_frame": quantity(house.up_in_object, "")})
    files = {"object": tmp_path / "object.ply", "crop": tmp_path / "crop.ply", "crop_report": tmp_path / "crop.json"}
    scale, coarse, fine = (tmp_path / f"{n}.json" for n in ("scale", "coarse", "fine"))
    estimate_scale(**files, cameras=tmp_path / "cameras.json", report=scale, method="rms", width_log=0.35)
    assert value(read_json(scale), "width_log") == 0.0
    paper = {"recipe": "paper", "seed": 0}
    from dataclasses import replace

    settings = replace(COARSE, ransac_samples=20000)
    register_coarsely(**files, scale=scale, report=coarse, **paper, settings=settings)
    register_finely(
        **files,
        scale=scale,
        coarse=coarse,
        fine=fine,
        picture=tmp_path / "fine.png",
        **paper,
        voxel_fraction=0.04,
        settings=FINE,
    )
    content = read_json(fine)
    assert value(content, "status") == "registered" and value(content, "tilt_deg") is None
    matrix = np.array(value(content, "scene_from_object"))
    assert Sim3.from_matrix(matrix).scale == pytest.approx(value(content, "scale"))
    assert (tmp_path / "fine.png").stat().st_size > 1000


def test_frame_ledger_inverts_every_transform(tmp_path):
    pose = Sim3(2.5, Rotation.random(random_state=1).as_matrix(), np.array([4e5, 5e6, 100.0]))
    write_json(tmp_path / "o.json", {"nerf_from_object": quantity(np.diag([0.5, 0.5, 0.5, 1.0]), "")})
    write_json(
        tmp_path / "f.json", {"scene_from_object": quantity(pose.matrix, ""), "status": quantity("registered", "")}
    )
    write_frame_ledger(object_report=tmp_path / "o.json", fine=tmp_path / "f.json", frames=tmp_path / "frames.json")
    ledger = read_json(tmp_path / "frames.json")
    assert np.allclose(value(ledger, "scene_from_nerf"), (pose @ Sim3(2.0, np.eye(3), np.zeros(3))).matrix)
    assert value(ledger, "world_from_scene") is None
    assert round_trip(pose) < 1e-8
    write_json(tmp_path / "f.json", {"scene_from_object": quantity(np.diag([1.0, 2, 3, 1]), "")})
    with pytest.raises(StageError, match="not a similarity"):
        write_frame_ledger(object_report=tmp_path / "o.json", fine=tmp_path / "f.json", frames=tmp_path / "x.json")


def test_a_scale_at_the_edge_of_its_prior_is_refused(house):
    truth = house.scene_from_object
    prior = ScaleRange(truth.scale * np.exp(-0.3), 0.1)
    outcome = refine_hypotheses(
        house.object,
        house.scene,
        [(truth, "planted")],
        prior,
        Evidence(),
        replace(FINE, turn_steps=2, min_f_score=0.0),
        0,
    )
    assert not outcome.decision.registered


def test_a_balloon_without_colours_has_a_free_axis_and_is_no_rival_to_itself():
    def egg(seed):
        points = np.random.default_rng(seed).normal(size=(4000, 3))
        return Cloud(points / np.linalg.norm(points, axis=1, keepdims=True) * [1, 1, 1.6])

    turned = Sim3(1.0, Rotation.from_euler("z", 70, degrees=True).as_matrix(), np.zeros(3))
    poses = [(Sim3.identity(), "one"), (turned, "other")]
    settings = replace(FINE, turn_steps=6, fine_voxel_fraction=0.02, score_fraction=0.04)
    outcome = refine_hypotheses(egg(0), egg(1), poses, ScaleRange(1.0, 0.2), Evidence((Z, Z)), settings, 0)
    assert outcome.decision.registered, outcome.decision.reason
    assert abs(outcome.decision.free_axis @ Z) > 0.99


def shared(pose: Sim3) -> Alignment:
    return Alignment(pose, Uncertainty.even(0.005, 0.3, 0.02), 40, None)


def test_photos_that_agree_settle_the_pose(house):
    truth = house.scene_from_object
    prior = ScaleRange(truth.scale, 0.3)
    settings = replace(LITTLE[1], min_margin=1.0)
    alone, linked = (
        refine_hypotheses(house.object, house.scene, [(truth, "planted")], prior, evidence, settings, 0).decision
        for evidence in (Evidence(), Evidence(alignment=shared(truth)))
    )
    assert not alone.registered and "margin" in alone.reason
    assert linked.registered and linked.decided_by == "both"


def test_the_surer_of_photos_and_clouds_has_the_last_word(house):
    truth = house.scene_from_object
    prior = ScaleRange(truth.scale, 0.3)
    near = Sim3(1.004, np.eye(3), np.zeros(3)) @ truth
    for sd, won in ((1e-4, True), (0.02, False)):
        alignment = Alignment(near, Uncertainty.even(sd, 100 * sd, 10 * sd), 40, None)
        evidence = Evidence((house.up_in_object, Z), None, alignment)
        outcome = refine_hypotheses(house.object, house.scene, [(truth, "planted")], prior, evidence, LITTLE[1], 0)
        assert outcome.decision.decided_by == "both"
        assert (outcome.ranked[0].pose.scale == near.scale) == won


def test_photos_at_whose_pose_the_clouds_lie_worse_must_be_that_much_surer(house):
    truth = house.scene_from_object
    beside = Sim3(1.0, np.eye(3), np.array([0.03 * house.diagonal, 0, 0])) @ truth
    prior, centre = ScaleRange(truth.scale, 0.3), house.object.points.mean(0)
    alone = refine_hypotheses(house.object, house.scene, [(truth, "planted")], prior, Evidence(), LITTLE[1], 0)
    for share, by_photos in ((0.9, False), (0.05, True)):
        sd = share * alone.spread.size(house.scene.diagonal) * house.scene.diagonal
        evidence = Evidence(None, None, Alignment(beside, Uncertainty.even(0.0, 0.0, sd), 40, None))
        outcome = refine_hypotheses(house.object, house.scene, [(truth, "planted")], prior, evidence, LITTLE[1], 0)
        assert outcome.decision.decided_by == "both"
        assert (errors(outcome.ranked[0].pose, truth, centre, house.diagonal)[2] > 0.02) == by_photos


def test_photos_overrule_geometry_and_clouds_do_not_carry_their_pose_off(house):
    truth, centre = house.scene_from_object, house.object.points.mean(0)
    half_turn, middle = np.diag([-1.0, -1.0, 1.0]), truth.apply(centre)
    turned = Sim3(1.0, half_turn, middle - half_turn @ middle) @ truth
    prior = ScaleRange(truth.scale, 0.3)
    evidence = Evidence((house.up_in_object, Z), None, shared(truth))
    outcome = refine_hypotheses(
        house.object, house.scene, [(turned, "planted")], prior, evidence, replace(LITTLE[1], turn_steps=1), 0
    )
    assert outcome.decision.registered and outcome.decision.decided_by == "photos"
    scale, angle, shift = errors(outcome.ranked[0].pose, truth, centre, house.diagonal)
    assert abs(scale) < 2 and angle < 2 and shift < 0.01


def test_an_object_where_the_cameras_saw_through_is_refused(house):
    truth = house.scene_from_object
    assert house.free_space.blocked_share(truth.apply(house.object.points)) < 0.05
    lifted = Sim3(truth.scale, truth.rotation, truth.translation + [0, 0, 0.5 * house.diagonal])
    assert house.free_space.blocked_share(lifted.apply(house.object.points)) > 0.5
    evidence = Evidence((house.up_in_object, Z), house.free_space, shared(lifted))
    prior = ScaleRange(truth.scale, 0.3)
    outcome = refine_hypotheses(house.object, house.scene, [(lifted, "planted")], prior, evidence, LITTLE[1], 0)
    assert not outcome.decision.registered and "saw through" in outcome.decision.reason


def test_spread_of_a_pose_grows_with_noise():
    def spread(noise):
        trial = plant("urn", 3, ground=False, noise=noise, object_points=6000, density_ratio=1.0)
        obj, scene = surfaces(trial, 0.01 * trial.diagonal)
        truth = trial.scene_from_object
        return uncertainty([(obj, scene)], truth, ScaleRange(truth.scale, 0.2), 0.02 * trial.diagonal, 0.0, 10, 0)

    fine, rough = spread(0.002), spread(0.01)
    assert fine.scale_sd_log < rough.scale_sd_log
    assert fine.covariance.shape == (7, 7) and np.allclose(fine.covariance, fine.covariance.T)


def test_scale_ledger_names_every_estimate_and_the_winner(house):
    outcome = register(house, settings=LITTLE)
    prior = {"ledger": quantity([{"name": "rms", "scale": 1.0, "used": False}], "")}
    alignment = shared(house.scene_from_object)
    rows = scale_ledger(prior, alignment, outcome.ranked[0], outcome.spread, outcome.decision)
    assert [r["name"] for r in rows] == ["rms", "shared points", "clouds"]
    assert rows[-1]["use"].startswith("won") and rows[-1]["scale"] == outcome.ranked[0].pose.scale
