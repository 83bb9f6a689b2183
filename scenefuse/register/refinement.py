"""From coarse poses to one decision: refine, turn, polish, shift, rank, compare with the alignment, decide."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scenefuse.core.transforms import Array, Sim3, Uncertainty
from scenefuse.geometry.icp import refine_planes, refine_points
from scenefuse.geometry.surface import SCORE_FRACTION, Surface, prepare, with_grid, with_queries
from scenefuse.register.coarse import Candidate
from scenefuse.register.decision import (
    MAX_CONTRADICTED,
    DecidedBy,
    Decision,
    FineSettings,
    Repetition,
    decide,
    unless_bent,
    unless_mirrored,
)
from scenefuse.register.likelihood import certified, common_error, with_bending
from scenefuse.register.problem import SURFACE_POINTS, Problem
from scenefuse.register.repetition import multiples, shifted, shifts_onto_itself, undecided_shift
from scenefuse.register.score import (
    DISTINCT_ANGLE_DEG,
    DISTINCT_SHIFT,
    Hypothesis,
    Score,
    best_distinct,
    displaced_share,
    score,
)

# First pairing distance, as a share of the diagonal: of poses that differ by less, one finds the other.
START_FRACTION = DISTINCT_SHIFT
# Hypotheses that are polished, and copies of the best that are.
POLISHED_POSES = 4
# The coarse search stays inside the scale prior; what it found at a bound may go on by this much (natural logarithm).
# With 0.12 a planted gate ended at the edge.
PRIOR_SLACK_LOG = 0.15
# A refined pose beyond the alignment's uncertainty, which does not know how the models are bent, is near up to so many
# times that.
MAX_BENDING_FACTOR = 2.0


@dataclass(frozen=True)
class Outcome:
    """The refined hypotheses, best first, the decision on the first, and its uncertainty.

    Attributes:
        ranked: the hypotheses.
        decision: on the first.
        uncertainty: of the first, on the clouds as they are; the gate counts it.
        common_error: (7, 7) of `common_error`, where the pose is the clouds'; None where it is the
            alignment's.
    """

    ranked: list[Hypothesis]
    decision: Decision
    uncertainty: Uncertainty | None
    common_error: Array | None = None

    @property
    def stated(self) -> Uncertainty | None:
        """The uncertainty with what the clouds have wrong alike."""
        if self.uncertainty is None or self.common_error is None:
            return self.uncertainty
        return Uncertainty.of(self.uncertainty.covariance + self.common_error)

    def unless_bent(self, bending: Array | None, diagonal: float) -> "Outcome":
        """Refused where the object's model may be bent too far, by its covariance (7, 7); see `unless_bent`."""
        if self.uncertainty is None or bending is None:
            return self
        bent = with_bending(self.uncertainty, self.ranked[0].pose, bending, None)
        return replace(self, decision=unless_bent(self.decision, bent, diagonal))


def refine_hypotheses(problem: Problem, candidates: Sequence[Candidate], settings: FineSettings) -> Outcome:
    """Refine coarse poses into one, and decide whether it may be used (method R8, R9, R12, R15).

    Two-way Tukey-weighted similarity ICP of every candidate; point-to-plane and colour polish of the best; turned
    copies of what is best then, and shifted ones where the object repeats itself; ranking by the two-way F-score, the
    agreement of colours and free space; comparison with the alignment from shared features, which replaces the clouds'
    pose where they differ; the most likely pose and its uncertainty; the gate.

    Args:
        problem: the clouds and what is known.
        candidates: poses scene_from_object, each with its source; one or more.
        settings: see FineSettings.
    """
    work = _prepare(problem, candidates[0][0].scale, settings)
    refined = work.best_first([work.refine(pose, source) for pose, source in candidates])
    polished = work.best_first([work.polish(h) for h in refined[:POLISHED_POSES]])
    # About a rough pose, whose axis is not exact, copies would slide past the rivals.
    polished = work.best_first([*polished, *(work.polish(h) for h in work.turned(polished[0]))])
    polished = work.best_first([*polished, *work.shifted(polished[0])])
    (best, *others), uncertainty, decided_by = work.compared_with_photos(polished)
    displaced = displaced_share(*work.scored, best.pose, settings.score_fraction * problem.scene.diagonal)
    ranked = [replace(best, score=replace(best.score, displaced=displaced)), *others]
    shape = with_queries(work.obj, SURFACE_POINTS // 10, problem.seed)
    decision = decide(ranked, uncertainty, decided_by, shape, work.problem, settings, work.repetition(ranked[0].pose))
    if decision.registered and decided_by in ("geometry", "near"):
        decision = unless_mirrored(decision, ranked[0], work.mirror_image(ranked[0].pose), settings)
    pose, alignment = ranked[0].pose, problem.known.alignment
    by_photos = alignment is not None and pose is alignment.pose
    common = None if by_photos else common_error(*work.scored, pose, problem.scales, work.narrow)
    return Outcome(ranked, decision, uncertainty, common)


def _prepare(problem: Problem, scale: float, settings: FineSettings) -> "_Work":
    """Thin and index both clouds for poses of about this scale."""
    diagonal, fraction, seed = problem.scene.diagonal, settings.voxel_fraction, problem.seed
    obj, scene = problem.surfaces(scale, fraction, SURFACE_POINTS)
    cell, reach = 2 * fraction * diagonal, 2 * START_FRACTION * diagonal
    return _Work(
        replace(problem, scales=problem.scales.widened(PRIOR_SLACK_LOG)),
        settings,
        obj,
        (
            with_queries(with_grid(obj, cell / scale, reach / scale), SURFACE_POINTS // 10, seed),
            with_queries(with_grid(scene, cell, reach), SURFACE_POINTS // 10, seed),
        ),
        (with_queries(obj, SURFACE_POINTS // 4, seed), with_queries(scene, SURFACE_POINTS // 4, seed)),
        _shifts(problem, obj, fraction * diagonal / scale),
    )


def _shifts(problem: Problem, obj: Surface, spacing: float) -> list[Array]:
    """The shifts (3,) by which the object, thinned to a spacing, repeats itself; the scale may be wrong yet, and the
    spacing too large to tell."""
    # Fine enough at any scale: a quarter of the distance within which points agree, on the object's own diagonal.
    own = SCORE_FRACTION / 4 * problem.object.diagonal
    if own < spacing:
        obj, spacing = prepare(problem.object, own, problem.seed, SURFACE_POINTS), own
    return shifts_onto_itself(with_queries(obj, SURFACE_POINTS // 10, problem.seed), spacing)


@dataclass(frozen=True)
class _Work:
    """Both clouds, prepared once, and the steps of the refinement on them.

    Attributes:
        problem: with the prior of the scale widened.
        settings: of the fine registration.
        obj: the object's surface, thinned.
        searched: object and scene with few query points and grids of nearest points, for refinement and ranking.
        scored: the same with more query points and trees, for the polish and the final score.
        shifts: (3,) each, by which the object repeats itself, in its own frame.
    """

    problem: Problem
    settings: FineSettings
    obj: Surface
    searched: tuple[Surface, Surface]
    scored: tuple[Surface, Surface]
    shifts: list[Array]

    @property
    def centre(self) -> Array:
        """(3,) centre of the object, in its own frame."""
        return self.obj.points.mean(0)

    @property
    def narrow(self) -> float:
        """Last pairing distance, scene units."""
        return SCORE_FRACTION * self.problem.scene.diagonal

    def best_first(self, hypotheses: list[Hypothesis], angle_deg: float = DISTINCT_ANGLE_DEG) -> list[Hypothesis]:
        """Ranked by score, one of each valley."""
        diagonal = self.problem.scene.diagonal
        same = self.same_shift(min(h.pose.scale for h in hypotheses))
        return best_distinct(hypotheses, self.centre, diagonal, len(hypotheses), angle_deg, same)

    def same_shift(self, scale: float) -> float:
        """Poses whose shift differs by less are one, as a share of the diagonal; at most half the shortest period."""
        periods = [scale * float(np.linalg.norm(shift)) / self.problem.scene.diagonal for shift in self.shifts]
        return min([DISTINCT_SHIFT, *(period / 2 for period in periods)])

    def refine(self, pose: Sim3, source: str, first: float = START_FRACTION) -> Hypothesis:
        """The bottom of the valley that a pose lies in, by pairs within `first` of the diagonal, and ever less."""
        reaches = first * self.problem.scene.diagonal, self.narrow
        pose = refine_points(*self.searched, pose, self.problem.scales, reaches)
        return Hypothesis(pose, source, self._score(pose, self.searched))

    def turned(self, best: Hypothesis) -> list[Hypothesis]:
        """The best of a pose's turned copies, refined."""
        ups = self.problem.known.ups
        copies = turned_copies(best.pose, self.obj, None if ups is None else ups[1], self.settings.turn_steps)
        scored = [Hypothesis(pose, "turned", self._score(pose, self.searched)) for pose in copies]
        # Nearer copies would slide back to the pose that they are made of.
        apart = [h for h in self.best_first([best, *scored], 3 * DISTINCT_ANGLE_DEG) if h.source == "turned"]
        return [self.refine(h.pose, "turned") for h in apart[:POLISHED_POSES]]

    def shifted(self, best: Hypothesis) -> list[Hypothesis]:
        """The best of a pose's copies shifted along the object's repetition, polished."""
        poses = [shifted(best.pose, step) for shift in self.shifts for step in multiples(self.obj, shift)]
        scored = [Hypothesis(pose, "shifted", self._score(pose, self.searched)) for pose in poses]
        return [self.polish(h) for h in sorted(scored, key=lambda h: -h.score.total)[:POLISHED_POSES]]

    def mirror_image(self, pose: Sim3) -> Hypothesis:
        """The best pose of the object's mirror image near a pose, mirrored across its principal planes and turned.

        Axes that are left-handed make an object its mirror image; one that is nearly symmetric fits that way too.
        """
        ups, (searched, scene), (scored, _) = self.problem.known.ups, self.searched, self.scored
        known = replace(self.problem.known, ups=None if ups is None else (_flipped(ups[0]), ups[1]))
        obj, few, more = (_mirrored(surface) for surface in (self.obj, searched, scored))
        image = replace(
            self,
            problem=replace(self.problem, known=known),
            obj=obj,
            searched=(few, scene),
            scored=(more, self.scored[1]),
            shifts=[_flipped(shift) for shift in self.shifts],
        )
        found = []
        for axis in np.linalg.svd(self.obj.points - self.centre, full_matrices=False)[2]:
            # The mirror image across this plane, laid on the object.
            rotation = pose.rotation @ _flipped(np.eye(3) - 2 * np.outer(axis, axis))
            shift = 2 * pose.scale * pose.rotation @ axis * (axis @ self.centre)
            start = Sim3(pose.scale, rotation, pose.translation + shift)
            found.append(image.refine(start, "mirrored"))
        best = image.best_first(found)[0]
        return image.polish(image.best_first([best, *image.turned(best)])[0])

    def repetition(self, pose: Sim3) -> Repetition:
        """What the object's repetition leaves open of a pose."""
        if not self.shifts:
            return Repetition()
        tau, free_space = self.settings.score_fraction * self.problem.scene.diagonal, self.problem.known.free_space
        period = undecided_shift(*self.scored, pose, self.shifts, tau, self.settings.min_margin, free_space)
        return Repetition(self.same_shift(pose.scale), period)

    def polish(self, h: Hypothesis) -> Hypothesis:
        """The hypothesis after the last refinement, by planes and colours."""
        pose = refine_planes(*self.scored, h.pose, self.problem.scales, self.narrow)
        return Hypothesis(pose, h.source, self._score(pose, self.scored))

    def most_likely(self, ranked: list[Hypothesis]) -> tuple[list[Hypothesis], Uncertainty | None]:
        """The ranking with its first replaced by the most likely pose near it, and how uncertain that is."""
        problem, best, diagonal = self.problem, ranked[0], self.problem.scene.diagonal
        spacing = self.settings.voxel_fraction * diagonal
        found = certified(*self.scored, best.pose, problem.scales, spacing, diagonal, problem.seed)
        if found is None:
            return ranked, None
        return [Hypothesis(found[0], best.source, self._score(found[0], self.scored)), *ranked[1:]], found[1]

    def compared_with_photos(self, ranked: list[Hypothesis]) -> tuple[list[Hypothesis], Uncertainty | None, DecidedBy]:
        """The ranking after the alignment from shared features, the uncertainty of its first, and what decided.

        Where the alignment differs from the clouds' pose, its own is refined on the clouds. Of the refined pose and the
        alignment's own the less uncertain one is taken; the worse the clouds score at the alignment's pose, the less
        uncertain that must be. Where they score as well there, what they differ by beyond the alignment's uncertainty
        counts as theirs: surfaces err common_error, which their scatter does not show. A refinement that leaves the
        alignment's valley is dropped, unless it stays near and the scene's photos refute the alignment's own pose: both
        models may be bent. Then it has to pass as a pose that no photos support.
        """
        alignment, diagonal = self.problem.known.alignment, self.problem.scene.diagonal
        if alignment is None:
            return *self.most_likely(ranked), "geometry"
        agree = alignment.agrees(ranked[0].pose, self.centre, diagonal)
        if not agree:
            ranked = [self.polish(self.refine(alignment.pose, "photos", SCORE_FRACTION)), *ranked]
        ranked, own = self.most_likely(ranked)
        by_photos = Hypothesis(alignment.pose, "photos", self._score(alignment.pose, self.scored))
        worth = min(1.0, by_photos.score.total / max(ranked[0].score.total, 1e-12))
        strays = not alignment.agrees(ranked[0].pose, self.centre, diagonal)
        near = alignment.agrees(ranked[0].pose, self.centre, diagonal, MAX_BENDING_FACTOR)
        if strays and near and _refuted(by_photos) and not _refuted(ranked[0]):
            return ranked, own, "near"
        if own is not None and worth > 1 - self.settings.min_margin:
            own = own.unless_apart(ranked[0].pose, alignment.pose, self.centre, alignment.uncertainty)
        if strays or own is None or alignment.uncertainty.size(diagonal) < worth * own.size(diagonal):
            ranked, own = [by_photos, *ranked], alignment.uncertainty
        return ranked, own, "both" if agree else "photos"

    def _score(self, pose: Sim3, surfaces: tuple[Surface, Surface]) -> Score:
        """How well a pose explains both clouds."""
        tau = self.settings.score_fraction * self.problem.scene.diagonal
        return score(*surfaces, pose, tau, self.problem.scales.centre, self.problem.known.free_space)


def _flipped(vectors: Array) -> Array:
    """Vectors (..., 3) mirrored across the y-z plane."""
    return vectors * [-1.0, 1.0, 1.0]


def _mirrored(surface: Surface) -> Surface:
    """The mirror image of a surface."""
    points = _flipped(surface.points)
    return replace(
        surface, points=points, normals=_flipped(surface.normals), tree=cKDTree(points), grid=None, slopes=[]
    )


def _refuted(h: Hypothesis) -> bool:
    """Whether a pose puts too much of the object where the scene's photos see something behind it."""
    violation = h.score.free_space_violation
    return violation is not None and violation > MAX_CONTRADICTED


def turned_copies(pose: Sim3, obj: Surface, up_in_scene: Array | None, steps: int) -> list[Sim3]:
    """The pose turned about the object's centre in `steps` steps of a full circle, the pose itself left out.

    The axis is the vertical; where it is not known, each of the object's principal axes.
    """
    centre = pose.apply(obj.points.mean(0))
    principal = np.linalg.svd(pose.rotate(obj.points - obj.points.mean(0)), full_matrices=False)[2]
    axes = principal if up_in_scene is None else up_in_scene[None]
    copies = []
    for axis in axes:
        for angle in np.arange(1, steps) * 2 * np.pi / steps:
            rotation = Rotation.from_rotvec(angle * axis).as_matrix()
            copies.append(Sim3(1.0, rotation, centre - rotation @ centre) @ pose)
    return copies
