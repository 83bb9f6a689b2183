"""The gate: a row for each reason of refusal, with both sides of its threshold; then scenes that must be refused.

`make mutants` inverts each comparison of the gate in turn and runs the rows; every such mutant must be caught.
"""

from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from support.planted import errors, plant

from scenefuse.cloud.clouds import Cloud, concatenate
from scenefuse.core.transforms import Sim3, Uncertainty
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.surface import Surface
from scenefuse.register import decision as gate
from scenefuse.register.coarse import CoarseSettings, find_hypotheses
from scenefuse.register.decision import Decision, FineSettings, Repetition, decide, unless_bent, unless_mirrored
from scenefuse.register.problem import Alignment, Constraints, Problem, ScaleSettings, estimates, prior
from scenefuse.register.refinement import refine_hypotheses
from scenefuse.register.score import (
    DISTINCT_ANGLE_DEG,
    DISTINCT_SCALE_LOG,
    DISTINCT_SHIFT,
    Hypothesis,
    Score,
    displaced_share,
)

X, Y, Z = np.eye(3)
SETTINGS = FineSettings()
DIAGONAL = 10.0
BY_CLOUDS, BY_PHOTOS = ("geometry", "near"), ("photos", "both")
EVERY = BY_CLOUDS + BY_PHOTOS


def turn(axis, degrees):
    """A turn about the origin, which is the middle of every tower."""
    return Sim3(1.0, Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix(), np.zeros(3))


def shift(*by):
    return Sim3(1.0, np.eye(3), np.array(by, float))


def tower(depth, colors=None, fin=False):
    """A tower of 4 x `depth` and 8 high about the origin, on a grid of points; a fin stands out of its right side."""
    steps, rows = np.linspace(-1, 1, 21), np.linspace(-4, 4, 41)
    sides = [[(2 * x, depth / 2 * y, z) for x in steps for y in (-1, 1) for z in rows]]
    sides += [[(2 * x, depth / 2 * y, z) for x in (-1, 1) for y in steps[1:-1] for z in rows]]
    sides += [[(x, 0.0, z) for x in np.linspace(2.2, 4.0, 10) for z in rows]] * fin
    points = np.concatenate([np.array(side).reshape(-1, 3) for side in sides])
    normals = np.where(np.abs(points[:, :1]) == 2, X, Y)
    painted = None if colors is None else np.array([colors(p) for p in points])
    return Surface(points, normals, painted, cKDTree(points), np.arange(len(points)))


def column():
    """A column of radius 2 and 8 high about the origin, on a grid of points."""
    angle, height = (side.ravel() for side in np.meshgrid(np.radians(np.arange(0, 360, 5)), np.linspace(-4, 4, 41)))
    normals = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    points = 2 * normals + height[:, None] * Z
    return Surface(points, normals, None, cKDTree(points), np.arange(len(points)))


def left_red(point):
    return (0.9, 0.1, 0.1) if point[0] < 0 else (0.1, 0.1, 0.9)


def striped(point):
    return (0.9, 0.1, 0.1) if point[2] < 0 else (0.1, 0.1, 0.9)


SQUARE, OBLONG, WITH_FIN = tower(4.0), tower(2.4), tower(4.0, fin=True)
HALF_RED, STRIPED = tower(4.0, left_red), tower(4.0, striped)
OFF_CENTRE = replace(SQUARE, points=SQUARE.points + [0, 0, 5], tree=cKDTree(SQUARE.points + [0, 0, 5]))


@dataclass(frozen=True)
class Case:
    """What a pose is like, and what the gate must say: a part of its reason for refusal, or None where it accepts.

    Attributes:
        score: what differs from a good score.
        sure: standard deviations of log scale, of the rotation (degrees) and of the shift over the diagonal; None where
            they are not known.
        axis: about which the rotation is least certain.
        rivals: other poses and their scores.
        also: what else must hold of the decision.
    """

    name: str
    reason: str | None
    score: dict[str, Any] = field(default_factory=dict)
    sure: tuple[float, float, float] | None = (0.002, 0.2, 0.001)
    axis: np.ndarray = field(default_factory=lambda: X)
    pose: Sim3 = shift(0, 0, 0)
    obj: Surface = OBLONG
    rivals: tuple[tuple[Sim3, float], ...] = ()
    ups: tuple[np.ndarray, np.ndarray] | None = None
    scales: ScaleRange = ScaleRange(1.0, 0.0)
    repetition: Repetition = Repetition()
    decided_by: tuple[str, ...] = EVERY
    also: dict[str, Any] = field(default_factory=dict)


def decided(case: Case, decided_by: str) -> Decision:
    good = {"f_score": 0.8, "precision": 0.8, "recall": 0.8, "color": 0.9, "free_space_violation": 0.05, "total": 1.0}
    best = Hypothesis(case.pose, "planted", Score(**good | case.score))
    ranked = [best, *(Hypothesis(p, "other", replace(best.score, total=total)) for p, total in case.rivals)]
    sure = None
    if case.sure is not None:
        scale, angle, step = case.sure
        sure = replace(Uncertainty.even(scale, angle, step * DIAGONAL), rotation_axis=case.axis)
    scene = Cloud(np.array([[0.0, 0, 0], [DIAGONAL, 0, 0]]))
    problem = Problem(Cloud(case.obj.points), scene, case.scales, Constraints(case.ups))
    return decide(ranked, sure, cast(Any, decided_by), case.obj, problem, SETTINGS, case.repetition)


def check(case: Case) -> None:
    """Whatever decided on the pose, the gate says what the case says."""
    for decided_by in EVERY:
        expected = case.reason if decided_by in case.decided_by else None
        found = decided(case, decided_by)
        assert found.decided_by == decided_by
        assert found.registered == (expected is None), f"{case.name}, {decided_by}: {found.reason}"
        assert expected is None or expected in found.reason, f"{case.name}, {decided_by}: {found.reason}"
        for name, value in case.also.items():
            assert _is(getattr(found, name), value), f"{case.name}, {decided_by}: {name}"


def _is(found, value):
    """Equal; of an axis, in either direction."""
    return abs(found @ value) > 0.999 if isinstance(value, np.ndarray) and found is not None else found == value


LITTLE = 1e-6
ELSEWHERE = shift(5, 0, 0)
QUARTER, HALF = turn(Z, 90), turn(Z, 180)


def sides(name, reason, least=None, most=None, decided_by=EVERY, **of):
    """Three cases: at a threshold, and a little on either side of it; `of` makes the change from a number."""
    ((field_name, change),) = of.items()
    limit, direction = (least, -1) if most is None else (most, 1)
    cases = [(f"{name}: at the threshold", limit, None), (f"{name}: inside", limit - direction * LITTLE, None)]
    cases += [(f"{name}: beyond", limit + direction * LITTLE, reason)]
    return [
        Case(title, refused, decided_by=decided_by, **{field_name: change(number)}) for title, number, refused in cases
    ]


CASES = [
    Case("a good pose", None, also={"margin": 1.0, "rival": None, "free_axis": None}),
    *sides("F-score", "the two-way F-score is 0.35, below", SETTINGS.min_f_score, decided_by=BY_CLOUDS,
           score=lambda v: {"f_score": v}),
    *sides("recall", "the object explains only 0.40", gate.MIN_RECALL, decided_by=BY_CLOUDS,
           score=lambda v: {"recall": v}),
    *sides("colours", "the colours agree by 0.50 only", gate.MIN_COLOR, decided_by=BY_CLOUDS,
           score=lambda v: {"color": v}),
    Case("no colours", None, {"color": None}),
    *sides("free space", "25% of the object would lie in free space", most=gate.MAX_CONTRADICTED,
           score=lambda v: {"free_space_violation": v}),
    *sides("displaced surfaces", "in 25% of the places that both clouds show", most=gate.MAX_CONTRADICTED,
           decided_by=BY_CLOUDS, score=lambda v: {"displaced": v}),
    Case("unknown free space", None, {"free_space_violation": None}),
    Case("free space comes first", "free space", {"free_space_violation": 0.5, "f_score": 0.1}),
    Case("upright", None, ups=(Z, Z)),
    Case("a little tilt", None, ups=(Z, Z), pose=turn(X, gate.MAX_TILT_DEG - 0.01)),
    Case("too much tilt", "would lean by 8.0 degrees", ups=(Z, Z), pose=turn(X, gate.MAX_TILT_DEG + 0.01)),
    Case("upside down", "would lean by 180.0 degrees", ups=(Z, Z), pose=turn(X, 180)),
    Case("gravity unknown", None, pose=turn(X, 180)),
    *sides("scale", "the scale is uncertain by 1.0%", most=SETTINGS.max_scale_sd_log,
           sure=lambda v: (v, 0.2, 0.001)),
    *sides("rotation", "the rotation is uncertain by 1.0 degrees", most=SETTINGS.max_rotation_sd_deg,
           sure=lambda v: (0.002, v, 0.001)),
    *sides("position", "the position is uncertain by 0.5% of the diagonal",
           most=SETTINGS.max_translation_sd_fraction, sure=lambda v: (0.002, 0.2, v)),
    Case("nothing meets", "too little of the object meets the scene", sure=None),
    Case("repeated along itself", "repeats itself every 0.7 units", repetition=Repetition(DISTINCT_SHIFT, 0.7),
         decided_by=BY_CLOUDS),
    Case("repeated, but decided", None, repetition=Repetition(0.01, None)),
    Case("a scale held at the end of nothing", None, scales=ScaleRange(1.0, 0.0)),
    Case("a scale inside its prior", None, scales=ScaleRange(np.exp(0.1), 0.12)),
    Case("a scale at the lower edge", "the scale 1 lies at the edge", scales=ScaleRange(np.exp(0.1), 0.105),
         decided_by=BY_CLOUDS),
    Case("a scale at the upper edge", "the scale 1 lies at the edge", scales=ScaleRange(np.exp(-0.1), 0.105),
         decided_by=BY_CLOUDS),
    # Rivals: the lead, and what is one.
    Case("a clear lead", None, rivals=((ELSEWHERE, 0.9),), also={"margin": 1 - 0.9}),
    Case("the least lead", None, rivals=((ELSEWHERE, 0.9599),)),
    Case("no lead", "another pose is nearly as good: the margin is 0.040", rivals=((ELSEWHERE, 0.9601),),
         decided_by=BY_CLOUDS),
    Case("the first rival counts", None, rivals=((ELSEWHERE, 0.9), (shift(0, 5, 0), 0.99)), also={"margin": 1 - 0.9}),
    Case("a rival that scores more", "the margin is -0.167", rivals=((ELSEWHERE, 1.2),), decided_by=BY_CLOUDS),
    Case("the same place", None, rivals=((shift(DISTINCT_SHIFT * DIAGONAL - LITTLE, 0, 0), 1.0),),
         also={"rival": None}),
    Case("just another place", "another pose", rivals=((shift(DISTINCT_SHIFT * DIAGONAL + LITTLE, 0, 0), 1.0),),
         decided_by=BY_CLOUDS),
    Case("another place of what repeats", "another pose", rivals=((shift(0.2, 0, 0), 1.0),),
         repetition=Repetition(0.01), decided_by=BY_CLOUDS),
    Case("the same heading", None, rivals=((turn(Z, DISTINCT_ANGLE_DEG - 0.01), 1.0),), also={"rival": None}),
    Case("just another heading", "another pose", rivals=((turn(Z, DISTINCT_ANGLE_DEG + 0.01), 1.0),),
         decided_by=BY_CLOUDS),
    Case("the same size", None, rivals=((Sim3(np.exp(DISTINCT_SCALE_LOG - LITTLE), np.eye(3), np.zeros(3)), 1.0),)),
    Case("just another size", "another pose",
         rivals=((Sim3(np.exp(DISTINCT_SCALE_LOG + LITTLE), np.eye(3), np.zeros(3)), 1.0),), decided_by=BY_CLOUDS),
    # Turns onto itself, which are no rivals.
    Case("half a turn of an oblong tower", None, rivals=((HALF, 1.0),),
         also={"rival": None, "margin": 1.0, "free_axis": Z}),
    Case("a quarter turn of an oblong tower", "another pose", rivals=((QUARTER, 1.0),), decided_by=BY_CLOUDS),
    Case("a quarter turn of a square tower", None, obj=SQUARE, rivals=((QUARTER, 1.0),), also={"free_axis": Z}),
    Case("a square tower with a fin at one side", "another pose", obj=WITH_FIN, rivals=((HALF, 1.0),),
         decided_by=BY_CLOUDS),
    Case("a square tower, red on one side", "another pose", obj=HALF_RED, rivals=((HALF, 1.0),),
         decided_by=BY_CLOUDS),
    Case("a square tower in stripes", None, obj=STRIPED, rivals=((QUARTER, 1.0),), also={"free_axis": Z}),
    Case("a turn about another place", "another pose", rivals=((shift(5, 0, 0) @ HALF, 1.0),), decided_by=BY_CLOUDS),
    Case("a turn about its middle, far from the origin", None, obj=OFF_CENTRE, rivals=((QUARTER, 1.0),)),
    Case("a turn that fits worse is no free axis", None, obj=SQUARE, rivals=((QUARTER, 0.95),),
         also={"free_axis": None, "rival": None}),
    Case("the first free axis is reported", None, obj=SQUARE, rivals=((QUARTER, 1.0), (turn(X, 180), 1.0)),
         also={"free_axis": Z}),
    Case("uncertain about the free axis", None, obj=SQUARE, rivals=((QUARTER, 1.0),), sure=(0.002, 20, 0.001), axis=-Z),
    Case("a column that was found upside down", None, obj=column(), rivals=((turn(X, 180), 1.0),),
         sure=(0.002, 20, 0.001), axis=Z, also={"free_axis": Z, "rival": None}),
    Case("uncertain about another axis", "the rotation is uncertain", obj=SQUARE, rivals=((QUARTER, 1.0),),
         sure=(0.002, 20, 0.001), axis=turn(X, 30).rotate(Z)),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_gate_accepts_up_to_each_threshold_and_refuses_beyond_with_its_reason(case):
    check(case)


def check_reported() -> None:
    """Both wordings of an accepted pose; that it turns freely is said; the rival is the one that was met."""
    case = Case("", None, obj=SQUARE, rivals=((QUARTER, 1.0), (ELSEWHERE, 0.5)))
    found = {by: decided(case, by) for by in EVERY}
    assert all(("turned about (" in found[by].reason) == (by in BY_CLOUDS) for by in EVERY)
    assert "fits as well" not in decided(replace(case, rivals=()), "geometry").reason
    rival = found["geometry"].rival
    assert rival is not None and rival.pose is ELSEWHERE and "margin 0.50" in found["geometry"].reason
    assert "agree" in found["both"].reason and "against the clouds' best fit" in found["photos"].reason
    assert "refute" in found["near"].reason
    assert gate.tilt_deg(turn(X, 30), (Z, Z)) == pytest.approx(30) and gate.tilt_deg(QUARTER, None) is None


def check_torn() -> None:
    """A model that may be bent beyond use is refused, and nothing else changes."""
    good = Decision(True, "good", "photos", 1.0, None, None)
    bent = [Uncertainty.even(0, 0, gate.MAX_BENT * DIAGONAL * factor) for factor in (0.999, 1.001)]
    assert unless_bent(good, None, DIAGONAL) is good and unless_bent(good, bent[0], DIAGONAL) is good
    torn = unless_bent(good, bent[1], DIAGONAL)
    assert not torn.registered and "10% of the diagonal" in torn.reason and "more photos" in torn.reason
    refused = replace(good, registered=False, reason="too little")
    assert unless_bent(refused, bent[1], DIAGONAL) is refused


def check_mirrored() -> None:
    """An object whose mirror image fits better by more than the margin is refused, and nothing else changes."""
    good = Decision(True, "good", "geometry", 1.0, None, None)
    best = Hypothesis(shift(0, 0, 0), "planted", Score(0.8, 0.8, 0.8, 0.9, 0.05, 0.5))
    least, more = (
        replace(best, score=replace(best.score, total=0.5 / (1 - SETTINGS.min_margin) * factor))
        for factor in (1, 1.001)
    )
    assert unless_mirrored(good, best, least, SETTINGS) is good
    refused = unless_mirrored(good, best, more, SETTINGS)
    assert not refused.registered and "left-handed; negate the x" in refused.reason
    bad = replace(good, registered=False, reason="too little")
    assert unless_mirrored(bad, best, more, SETTINGS) is bad


def test_an_object_whose_mirror_image_fits_better_is_refused_with_what_to_do():
    check_mirrored()


def test_an_accepted_pose_is_reported_with_what_decided_and_what_stays_open():
    check_reported()


def test_a_pose_is_refused_where_the_objects_own_model_may_be_bent_beyond_use():
    check_torn()


# Less work than by default: only the decision counts here.
COARSE = replace(CoarseSettings(), ransac_samples=5000, feature_scale_steps=1, scale_steps=5, candidates=6, keep=3)
FINE = replace(SETTINGS, voxel_fraction=0.02, turn_steps=2)


@pytest.fixture(scope="module")
def house():
    return plant("house", 5, ground=False, noise=0.005, object_points=3000, density_ratio=1.0)


def registered(obj, scene, up=None, starts=None, alignment=None, up_in_scene=Z):
    """The outcome of the registration of an object in a scene, from given poses or from all that the search finds."""
    ups = None if up is None else (up, up_in_scene)
    scales = prior(estimates(obj, scene, ups), ScaleSettings())
    problem = Problem(obj, scene, scales, Constraints(ups, None, alignment), 0)
    starts = starts or [(h.pose, h.source) for h in find_hypotheses(problem, COARSE)]
    return refine_hypotheses(problem, starts, FINE)


def at_truth(outcome, trial, truth=None):
    """Whether the best pose is the true one."""
    centre = trial.object.points.mean(0)
    scale, angle, off = errors(outcome.ranked[0].pose, truth or trial.scene_from_object, centre, trial.diagonal)
    return abs(scale) < 2 and angle < 2 and off < 0.02


def mirrored(cloud):
    """The mirror image of a cloud."""
    flip = np.array([-1.0, 1, 1])
    return replace(cloud, points=cloud.points * flip, normals=cloud.normals * flip.astype(np.float32))


@pytest.mark.slow
def test_a_mirror_image_of_the_object_is_refused(house):
    outcome = registered(mirrored(house.object), house.scene, house.up_in_object * [-1, 1, 1])
    assert not outcome.decision.registered


@pytest.mark.slow
@pytest.mark.parametrize("is_mirrored", [False, True])
def test_the_mirror_image_of_a_nearly_symmetric_object_is_named_as_that(is_mirrored):
    trial = plant("wall", 3, ground=False, noise=0.005, object_points=4000, density_ratio=1.0)
    flip = np.array([-1.0, 1, 1]) if is_mirrored else np.ones(3)
    obj = mirrored(trial.object) if is_mirrored else trial.object
    # The wall's own plane of symmetry lies across its length.
    across = trial.scene_from_object.rotation.T @ X
    laid = np.eye(3) - 2 * np.outer(across, across) if is_mirrored else np.eye(3)
    middle, truth = trial.object.points.mean(0), trial.scene_from_object
    rotation = truth.rotation @ laid @ np.diag(flip)
    start = Sim3(truth.scale, rotation, truth.apply(middle) - truth.scale * rotation @ (middle * flip))
    decision = registered(obj, trial.scene, trial.up_in_object * flip, [(start, "planted")]).decision
    assert decision.registered != is_mirrored, decision.reason
    assert ("mirror image" in decision.reason) == is_mirrored


@pytest.mark.slow
def test_an_object_that_lies_upside_down_in_the_scene_is_refused_where_gravity_is_known_and_found_elsewhere(house):
    middle = house.scene.points.mean(0)
    over = shift(*middle) @ turn(X, 180) @ shift(*-middle)
    lying, truth = house.scene.transformed(over), over @ house.scene_from_object
    with_gravity = registered(house.object, lying, house.up_in_object)
    assert not with_gravity.decision.registered
    sure = Alignment(truth, Uncertainty.even(1e-4, 0.01, 1e-4))
    by_photos = registered(house.object, lying, house.up_in_object, [(truth, "planted")], sure).decision
    assert not by_photos.registered and "would lean by 1" in by_photos.reason
    without = registered(house.object, lying, None, [(truth, "planted")])
    assert without.decision.registered and at_truth(without, house, truth)


@pytest.mark.slow
def test_from_half_a_turn_off_the_true_pose_is_found(house):
    centre = house.scene_from_object.apply(house.object.points.mean(0))
    turned = shift(*centre) @ HALF @ shift(*-centre) @ house.scene_from_object
    outcome = registered(house.object, house.scene, house.up_in_object, [(turned, "planted")])
    assert outcome.decision.registered and at_truth(outcome, house)


@pytest.mark.slow
def test_an_object_that_the_scene_does_not_have_is_refused(house):
    other = plant("sculpture", 7, ground=False, noise=0.005, object_points=3000, density_ratio=1.0).scene
    decision = registered(house.object, other, house.up_in_object).decision
    assert not decision.registered and ("F-score" in decision.reason or "explains" in decision.reason)


def test_surfaces_that_lie_behind_each_other_are_displaced_and_those_that_meet_are_not():
    """The oblong tower in the square one: its ends meet, its long sides lie 0.8 inside."""
    tau, alone = 0.2, turn(X, 0)
    assert displaced_share(OBLONG, OBLONG, alone, tau) == 0
    assert displaced_share(SQUARE, OBLONG, alone, tau) == pytest.approx(0.5, abs=0.15)
    assert displaced_share(OBLONG, SQUARE, shift(0, 50, 0), tau) is None
    # Normals on the wrong side displace nothing that meets.
    assert displaced_share(OBLONG, replace(OBLONG, normals=-OBLONG.normals), alone, tau) == 0


@pytest.mark.slow
def test_an_object_with_a_copy_beside_it_is_refused(house):
    scene, aside, truth = house.scene, shift(0.9 * house.diagonal, 0, 0), house.scene_from_object
    starts, both = [(truth, "one"), (aside @ truth, "other")], concatenate([scene, scene.transformed(aside)])
    decision = registered(house.object, both, house.up_in_object, starts).decision
    assert not decision.registered
    assert registered(house.object, scene, house.up_in_object, starts[:1]).decision.registered
