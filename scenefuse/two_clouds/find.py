"""Registration of two clouds in memory: a decision and a transform, by the steps of the workflow."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.cloud.cloud_file import EVERYWHERE, normals_fault
from scenefuse.cloud.clouds import Cloud, read_cloud, sampled_rows
from scenefuse.cloud.import_cloud import MIN_POINTS
from scenefuse.cloud.readers.text import TEXTS
from scenefuse.core.settings import build, read_settings
from scenefuse.core.stage import StageError, quantity
from scenefuse.core.transforms import MAX_DEVIATIONS, UP, Array, Sim3, uncertainty_quantities
from scenefuse.crop.crop_cloud import CropSettings
from scenefuse.crop.crop_scene import around_marks, crop_marked
from scenefuse.geometry.icp import ScaleRange
from scenefuse.geometry.surface import SCORE_FRACTION, with_queries
from scenefuse.marks.clicks import ScenePoints, read_points
from scenefuse.register.coarse import CoarseSettings, find_hypotheses
from scenefuse.register.decision import FineSettings, tilt_deg
from scenefuse.register.likelihood import certified, common_error
from scenefuse.register.problem import (
    SURFACE_POINTS,
    Constraints,
    Problem,
    ScaleSettings,
    check_extent,
    comparable,
    estimates,
    prior,
)
from scenefuse.register.refinement import Outcome, refine_hypotheses
from scenefuse.register.register_object import pose_quantities, rests_on
from scenefuse.register.score import DISTINCT_SHIFT, AgreementSettings, Hypothesis, lead, registration_metrics, score
from scenefuse.two_clouds.places import MAX_PLACES, likely_places

# Clouds with more points are thinned at random for the search, which looks at far fewer; files are written in full.
SEARCHED_POINTS = 500_000
# How many times as large as the scene's part that shows it an object may be, and as that part's spacing it has to be.
MAX_SIZE_RATIO = 10.0
Direction = tuple[float, float, float]


@dataclass(frozen=True)
class RegistrationSettings:
    """Settings of all steps."""

    crop: CropSettings = CropSettings()
    coarse: CoarseSettings = CoarseSettings()
    fine: FineSettings = FineSettings()

    @classmethod
    def read(cls, path: Path | None) -> tuple["RegistrationSettings", int]:
        """The shipped settings with those of a YAML file laid over them, and the seed; StageError for a bad file."""
        content = read_settings(path)
        parts = content["registration"]
        return cls(
            build(CropSettings, parts["crop"]),
            fine=build(FineSettings, parts["fine"]),
        ), content["seed"]


@dataclass(frozen=True)
class Known:
    """What is known beforehand of the object's place in the scene."""

    up_object: Direction | None = None
    """Direction opposite to gravity in the object's coordinates."""
    up_scene: Direction | None = None
    """The same in the scene's: 0 0 1 if z is up."""
    scale: float | None = None
    """Scene units per object unit."""
    scale_range: tuple[float, float] | None = None
    """Least and greatest scale."""
    fiducials: Path | None = None
    """File of at least four points on the object in the scene's coordinates: rows of x y z, or any cloud."""
    crop_box: tuple[float, float, float, float, float, float] | None = None
    """Least x y z and greatest x y z of the part of the scene to look in."""

    def check(self) -> None:
        """StageError where two of these exclude each other, or one lacks its partner."""
        if self.fiducials is not None and self.crop_box is not None:
            raise StageError("both --fiducials and --crop-box are given; give one")
        if self.scale is not None and self.scale_range is not None:
            raise StageError("both --scale and --scale-range are given; give one")
        if self.up_object is not None and self.up_scene is None:
            raise StageError("--up-object needs --up-scene as well; it is 0 0 1 if the scene's z is up")

    def ups(self) -> tuple[Array | None, Array | None]:
        """Unit up directions (3,) in the object's and in the scene's coordinates."""
        return _unit("--up-object", self.up_object), _unit("--up-scene", self.up_scene)

    def scales(self) -> ScaleRange | None:
        """Bounds of the scale, or None where nothing is known of it."""
        if self.scale is None and self.scale_range is None:
            return None
        low, high = self.scale_range or (self.scale, self.scale)
        if low is None or high is None or not 0 < low <= high < np.inf:
            raise StageError(f"a scale has to be positive, and a range's least must come first; not {low:g} {high:g}")
        return ScaleRange(float(np.sqrt(low * high)), float(np.log(high / low) / 2))


@dataclass(frozen=True)
class Registration:
    """What came out.

    Attributes:
        outcome: refined hypotheses and decision, relative to `origins`; None where nothing gave a pose.
        origins: the (3,) points subtracted from the object's and the scene's coordinates.
        scales: the scale prior.
        agreement: fitness, RMSE and normals at the best pose; see `registration_metrics`.
        unit: of the scene's lengths.
        fitting_scale: at which the clouds fit best, and its standard deviation, where one that was held is off by more
            than four of these.
        sides_estimated: whether normals are inwards, and the sides of both clouds' were estimated.
    """

    outcome: Outcome | None
    origins: tuple[Array, Array]
    scales: ScaleRange
    agreement: dict[str, dict[str, Any]]
    unit: str = "scene units"
    fitting_scale: tuple[float, float] | None = None
    sides_estimated: bool = False

    @property
    def registered(self) -> bool:
        """Whether the pose may be used."""
        return self.outcome is not None and self.outcome.decision.registered

    @property
    def reason(self) -> str:
        """One sentence why, or why not."""
        return "neither features nor gravity gave a pose" if self.outcome is None else self.outcome.decision.reason

    @property
    def scene_from_object(self) -> Sim3 | None:
        """The best pose found, between the clouds' own coordinates; None where nothing gave a pose."""
        if self.outcome is None:
            return None
        from_object, to_scene = (Sim3(1.0, np.eye(3), shift) for shift in (-self.origins[0], self.origins[1]))
        return to_scene @ self.outcome.ranked[0].pose @ from_object

    @property
    def total(self) -> float:
        """The score that poses are ranked by; 0 where nothing gave a pose."""
        return 0.0 if self.outcome is None else self.outcome.ranked[0].score.total


@dataclass(frozen=True)
class Search:
    """What the coarse registration found.

    Attributes:
        problem: both clouds relative to `origins`, and what is known of the pose.
        origins: the (3,) points subtracted from the object's and the scene's coordinates.
        hypotheses: distinct poses, best first; none where nothing gave one.
    """

    problem: Problem
    origins: tuple[Array, Array]
    hypotheses: list[Hypothesis]

    @property
    def total(self) -> float:
        """The score of the best pose; 0 where nothing gave one."""
        return self.hypotheses[0].score.total if self.hypotheses else 0.0


def search(
    obj: Cloud,
    scene: Cloud,
    settings: RegistrationSettings,
    seed: int,
    ups: tuple[Array, Array] | None,
    scales: ScaleRange | None,
) -> Search:
    """The coarse registration; arguments and errors as of `find_in_scene`."""
    for name, cloud in (("the object", obj), ("the scene", scene)):
        _check_points(cloud, name)
    origins = np.floor(obj.points.mean(0)), np.floor(scene.points.mean(0))
    near_obj, near_scene = (_searched(cloud, at, seed) for cloud, at in zip((obj, scene), origins))
    if scales is None:
        scales = prior(estimates(near_obj, near_scene, ups), ScaleSettings())
    problem = Problem(*comparable(near_obj, near_scene), scales, Constraints(ups), seed)
    return Search(problem, origins, find_hypotheses(problem, settings.coarse))


def refined(found: Search, settings: RegistrationSettings, unit: str) -> Registration:
    """The fine registration of what a search found, and the decision."""
    starts = [(hypothesis.pose, hypothesis.source) for hypothesis in found.hypotheses]
    outcome = refine_hypotheses(found.problem, starts, settings.fine) if starts else None
    fitting = None
    if outcome is not None and outcome.decision.registered and found.problem.scales.width == 0:
        fitting = _fitting_scale(found.problem, outcome.ranked[0].pose, settings.fine.voxel_fraction)
    return Registration(outcome, found.origins, found.problem.scales, {}, unit, fitting)


def _fitting_scale(problem: Problem, pose: Sim3, fraction: float) -> tuple[float, float] | None:
    """See `Registration`; of a pose whose scale was held, by points that are a fraction of the diagonal apart."""
    free, diagonal = ScaleRange(pose.scale, ScaleSettings().width_log), problem.scene.diagonal
    surfaces = problem.surfaces(pose.scale, fraction, SURFACE_POINTS)
    obj, scene = (with_queries(surface, SURFACE_POINTS // 4, problem.seed) for surface in surfaces)
    found = certified(obj, scene, pose, free, fraction * diagonal, diagonal, problem.seed)
    if found is None:
        return None
    common = common_error(obj, scene, found[0], free, SCORE_FRACTION * diagonal)
    deviation = float(np.sqrt(found[1].covariance[6, 6] + common[6, 6]))
    off = abs(np.log(found[0].scale / pose.scale)) > MAX_DEVIATIONS * deviation
    return (found[0].scale, found[0].scale * deviation) if off else None


def with_agreement(found: Registration, obj: Cloud, scene: Cloud, seed: int) -> Registration:
    """A registration with how well both clouds agree at its pose."""
    if found.outcome is None:
        return found
    near_obj, near_scene = (_searched(cloud, at, seed) for cloud, at in zip((obj, scene), found.origins))
    tau, diagonal = AgreementSettings().tau_fraction * near_scene.diagonal, near_scene.diagonal
    pose = found.outcome.ranked[0].pose
    return replace(found, agreement=registration_metrics(near_obj, near_scene, pose, tau, diagonal, found.unit))


def find_in_scene(
    obj: Cloud,
    scene: Cloud,
    settings: RegistrationSettings,
    seed: int,
    *,
    ups: tuple[Array, Array] | None = None,
    up_in_scene: Array | None = None,
    scales: ScaleRange | None = None,
    unit: str = "scene units",
    marked: bool = False,
    estimate_sides: bool = False,
    progress: Callable[[str], None] = lambda line: None,
) -> tuple[Registration, Cloud, list[tuple[float, Array]]]:
    """Find where an object lies in a scene that may be thirty times as wide (method R16).

    It is searched in the whole scene, as if that showed little else, and in each of `likely_places`; the best coarse
    poses are refined. The best has to lead over those elsewhere as over other poses. Scale, coarse and fine
    registration and the gate are those of the workflow. Where that finds nothing, and most normals of the object or of
    the part of the scene that is most like it face its middle, as on a mesh turned inside out, it is searched again
    with the sides of all estimated.

    Args:
        obj: the object, any frame and unit.
        scene: the scene's points, or a part of them (see `cut_scene`), any frame and unit; far origins lose no
            precision.
        settings: of all steps.
        seed: of all random choices.
        ups: up directions in the object's and in the scene's frame; None where one of them is not known.
        up_in_scene: unit vector (3,), opposite to gravity; None where it is not known.
        scales: scene units per object unit; None to estimate them from both extents.
        unit: what the scene's lengths are counted in, for the report.
        marked: the points are those around fiducials: no parts of it are tried.
        estimate_sides: the normals of neither are used.
        progress: called with a line before each step that takes long.

    Returns:
        The best registration, the part of the scene that it was found in, and the places where it was tried, the best
        first: the score and the corners (2, 3) of the part of the scene.

    Raises:
        StageError: too few different points, or all in one place or along one line, on either side.
    """
    progress("searching all of it")

    def usable(cloud: Cloud) -> Cloud:
        return replace(cloud, normals=None) if estimate_sides else cloud

    searched = [(search(usable(obj), usable(scene), settings, seed, ups, scales), scene)]
    likely = [] if marked else likely_places(obj, scene, up_in_scene, settings.crop, seed, MAX_PLACES)
    # At a known scale the object may be far larger than a part; grids of nearest points would be as well.
    smallest = 0.0 if scales is None else scales.centre * obj.diagonal / MAX_SIZE_RATIO
    parts = [part for part in (scene[rows] for rows in likely) if part.diagonal > smallest]
    for number, part in enumerate(parts, 1):
        progress(f"searching part {number} of {len(parts)} that look like the object")
        with contextlib.suppress(StageError):  # too few different points there
            searched.append((search(usable(obj), usable(part), settings, seed, ups, scales), part))
    # The refinement of a pose does not catch up with one that is twice as good.
    least = max(there.total for there, _ in searched) / 2
    best = sorted((one for one in searched if one[0].total >= least), key=lambda one: -one[0].total)
    tried = list[tuple[Registration, Cloud]]()
    kept = best[: settings.coarse.keep]
    for number, (there, part) in enumerate(kept, 1):
        progress(f"refining the poses found: place {number} of {len(kept)}")
        tried.append((refined(there, settings, unit), part))
    found, part = max(tried, key=lambda one: (one[0].registered, one[0].total))
    if len(tried) > 1:
        others = [(there, one) for (there, _), (one, _) in zip(kept, tried)]
        found = _unless_elsewhere(found, others, obj, settings.fine)
    if not found.registered and not estimate_sides and (_is_inward(obj) or _is_inward(part)):
        progress("most normals face inwards: again, with their sides estimated")
        other, where, places = find_in_scene(
            obj, scene, settings, seed, ups=ups, up_in_scene=up_in_scene, scales=scales, unit=unit, marked=marked,
            estimate_sides=True, progress=progress,
        )  # fmt: skip
        if other.registered:
            return replace(other, sides_estimated=True), where, places
    ranked = sorted((one for one in tried if one[1] is not scene), key=lambda one: -one[0].total)
    places = [(one.total, np.stack([there.points.min(0), there.points.max(0)])) for one, there in ranked]
    return with_agreement(found, obj, part, seed), part, places


def _is_inward(cloud: Cloud) -> bool:
    """Whether most normals face the middle."""
    off, normals = cloud.points - cloud.points.mean(0), cloud.normals
    return normals is not None and bool(((off * normals).sum(1) < 0).mean() > 0.5)


def total_at_scale(there: Search, found: Registration, scale: float) -> float:
    """The score of the best pose in a part of a scene, by distances and areas of the object at a scale: the part's own
    are of the box around it, which is the larger the more it is turned."""
    if found.outcome is None:
        return 0.0
    problem, pose, across = there.problem, found.outcome.ranked[0].pose, scale * there.problem.object.diagonal
    fraction = SCORE_FRACTION / 2 * across / problem.scene.diagonal
    surfaces = problem.surfaces(pose.scale, fraction, SURFACE_POINTS)
    return score(*surfaces, pose, SCORE_FRACTION * across, scale).total


def _unless_elsewhere(
    found: Registration, tried: list[tuple[Search, Registration]], obj: Cloud, settings: FineSettings
) -> Registration:
    """A registration, or a refusal where the object fits another of the places tried nearly as well."""
    pose, outcome = found.scene_from_object, found.outcome
    if pose is None or outcome is None:
        return found
    decision = outcome.decision
    if not decision.registered:
        shown = outcome.ranked[0].score.precision
        reason = f"the best place shows {shown:.0%} of the object, which may not be in this scene: {decision.reason}"
        return replace(found, outcome=replace(outcome, decision=replace(decision, reason=reason)))
    middle, size = obj.points.mean(0), pose.scale * obj.diagonal
    elsewhere = [
        (total_at_scale(there, other, pose.scale), at)
        for there, other in tried
        if other.scene_from_object is not None
        and np.linalg.norm((at := other.scene_from_object.apply(middle)) - pose.apply(middle)) > DISTINCT_SHIFT * size
    ]
    if not elsewhere:
        return found
    total, place = max(elsewhere, key=lambda one: one[0])
    own = next(total_at_scale(there, one, pose.scale) for there, one in tried if one is found)
    decision = replace(decision, margin=min(decision.margin, lead(own, total)))
    if decision.margin < settings.min_margin:
        where = " ".join(f"{x:.10g}" for x in place)
        short = f"the margin is {decision.margin:.3f}, below {settings.min_margin:.3f}"
        decision = replace(decision, registered=False, reason=f"another place is nearly as good, at ({where}): {short}")
    return replace(found, outcome=replace(outcome, decision=decision))


def _check_points(cloud: Cloud, name: str) -> None:
    """StageError where a cloud has too few different points, or where they span no surface."""
    sample = np.unique(cloud.points[:: max(1, len(cloud) // SEARCHED_POINTS)], axis=0)
    different = len(sample) if len(sample) >= MIN_POINTS else len(np.unique(cloud.points, axis=0))
    if different < MIN_POINTS:
        among = "" if different == len(cloud) else f" among its {len(cloud)} points"
        raise StageError(f"{name} has only {different} different positions{among}; {MIN_POINTS} or more are needed")
    check_extent(cloud, name)


def search_box(settings: CropSettings, fiducials: Path | None = None, box: Array | None = None) -> tuple[Array, Array]:
    """Corners (3,) of the part of a scene that `cut_scene` with the same arguments depends on."""
    if box is not None:
        return box[:3], box[3:]
    if fiducials is None:
        return EVERYWHERE
    return around_marks(_fiducials(fiducials)[1], settings)


def cut_scene(
    scene: Cloud,
    settings: CropSettings,
    up_in_scene: Array | None = None,
    fiducials: Path | None = None,
    boxed: bool = False,
    total: int | None = None,
) -> tuple[Cloud, str]:
    """The part of a scene in which the object is looked for, and what it is in words.

    Args:
        scene: the whole scene, or what of it lies in `search_box`; of a crop box no more.
        settings: of the crop.
        up_in_scene: opposite to gravity; without it, no ground is removed around fiducials.
        fiducials: file of at least four points on the object in the scene's coordinates: tab-separated with the header
            `point x y z` (TSV), or any cloud file.
        boxed: whether a crop box is given.
        total: points of the whole scene, where this is a part.

    Raises:
        StageError: bad fiducials.
    """
    total = len(scene) if total is None else total
    if fiducials is None:
        said = f"the crop box, {len(scene)} points in a scene of {total}"
        return scene, said if boxed else f"the whole scene, {total} points"
    names, marks = _fiducials(fiducials)
    if up_in_scene is None:
        settings, up_in_scene = replace(settings, remove_ground=False), UP
    origin = np.floor(marks.mean(0))
    near = replace(scene, points=scene.points - origin)
    cut = crop_marked(near, names, marks - origin, up_in_scene, settings, fiducials)
    ground = "the ground removed" if cut.on_ground.any() else "no ground removed"
    kept = f"{cut.keep.sum()} points in a scene of {total}"
    said = "; ".join([f"around {len(marks)} fiducials, {kept}, {ground}", *cut.notes])
    return scene[cut.keep], said


def report(found: Registration, ups: tuple[Array, Array] | None) -> dict[str, Any]:
    """The content of transform.json: names, values and units as in the workflow's fine.json and metrics.json."""
    content = {
        "status": quantity("registered" if found.registered else "unregistered", ""),
        "reason": quantity(found.reason, ""),
    }
    pose, outcome = found.scene_from_object, found.outcome
    if pose is not None and outcome is not None:
        best, decision = outcome.ranked[0], outcome.decision
        content |= pose_quantities(best) | {
            "scene_from_object": quantity(pose.matrix, ""),
            "scale": quantity(pose.scale, f"{found.unit} per object unit"),
            "margin": quantity(decision.margin, "1"),
            "free_axis": quantity(decision.free_axis, ""),
            **uncertainty_quantities(outcome.stated, found.unit),
            "tilt_deg": quantity(tilt_deg(best.pose, ups), "deg"),
            "gravity_used": quantity(ups is not None, ""),
            "agreement": found.agreement,
        }
    return content


def evidence_of(found: Registration, ups: tuple[Array, Array] | None) -> str:
    """What a decision without photos rests on."""
    by = ["shape"] if found.outcome is None else rests_on(found.outcome.ranked[0], Constraints(ups))
    return f"the clouds alone, by {', '.join(by)}"


def summary(found: Registration, searched: str, ups: tuple[Array, Array] | None) -> list[str]:
    """The decision in five lines."""
    lines = [f"{'registered' if found.registered else 'unregistered'}: {found.reason}"]
    low, high = found.scales.clamp(0.0), found.scales.clamp(np.inf)
    held = f"held at {low:.6g}" if found.scales.width == 0 else f"started from {low:.4g} to {high:.4g}"
    pose = found.scene_from_object
    scale = "" if pose is None else f"{pose.scale:.6g} {found.unit} per object unit, "
    lines.append(f"scale      {scale}{held}")
    lines.append(f"evidence   {evidence_of(found, ups)}")
    lines.append(f"searched   {searched}; gravity {'known' if ups is not None else 'not known'} on both sides")
    if found.agreement:
        near, back, rmse, share, tau = (
            found.agreement[name]["value"]
            for name in ("fitness_source", "fitness", "inlier_rmse", "inlier_rmse_over_diagonal", "tau")
        )
        off = "" if rmse is None else f", which lie {rmse:.3g} apart (RMS; {100 * share:.2g} % of the scene part)"
        lines.append(
            f"agreement  {near:.0%} of the object and {back:.0%} of the scene part have a partner within {tau:.3g}{off}"
        )
    return lines


def _unit(flag: str, direction: Direction | None) -> Array | None:
    if direction is None:
        return None
    length = float(np.linalg.norm(direction))
    if not 0 < length < np.inf:
        raise StageError(f"{flag} needs a direction; {' '.join(map(str, direction))} is none")
    return np.array(direction) / length


def _fiducials(path: Path) -> tuple[list[str], Array]:
    """Names and positions (F, 3) of marked points in the scene's coordinates."""
    marked = None
    if path.suffix.lower() in (".tsv", *TEXTS):
        try:
            marked = read_points(path)
        except StageError:
            if path.suffix.lower() not in TEXTS:
                raise
    if marked is None:
        points = read_cloud(path).points
        return [str(number) for number in range(1, len(points) + 1)], points
    if not isinstance(marked, ScenePoints):
        raise StageError(f"{path} holds clicks in photos; without photos, give points as 'point x y z'")
    return marked.points, marked.positions


def _searched(cloud: Cloud, origin: Array, seed: int) -> Cloud:
    """A cloud about an origin (3,), of not too many points, without normals that say nothing: they are estimated."""
    cloud = cloud[np.sort(sampled_rows(len(cloud), SEARCHED_POINTS, seed))]
    normals = None if normals_fault(cloud) else cloud.normals
    return replace(cloud, points=cloud.points - origin, normals=normals)
