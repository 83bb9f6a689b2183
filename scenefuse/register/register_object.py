"""The registration of an object in its scene: the stage, its reports and its picture (method R10, R11)."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.stage import atomic_file, quantity, write_json
from scenefuse.core.transforms import Array, Sim3, uncertainty_quantities
from scenefuse.geometry.depth_test import FreeSpace, read_free_space
from scenefuse.geometry.surface import SAMPLED_POINTS, SCORE_FRACTION
from scenefuse.photos.pictures import write_picture
from scenefuse.register.coarse import CoarseSettings, coarse_quantities, hypotheses_or_centres
from scenefuse.register.decision import FineSettings, tilt_deg
from scenefuse.register.likelihood import with_bending
from scenefuse.register.problem import (
    Constraints,
    Inputs,
    Problem,
    ScaleSettings,
    comparable,
    estimates,
    prior,
    read_alignment,
    scale_quantities,
)
from scenefuse.register.refinement import Outcome, refine_hypotheses
from scenefuse.register.score import Hypothesis

# Photos whose depth maps give the free space; more look from sides that these have seen.
FREE_SPACE_PHOTOS = 12
# Side of each of the picture's six views.
SIDE_PX = 460


@dataclass(frozen=True)
class ConstraintFiles:
    """Files of what is known beside the clouds."""

    alignment_json: Path | None = None
    """JSON of the alignment from shared features."""
    workspace: Path | None = None
    """Undistorted COLMAP workspace of the scene; with `depth` it gives the free space."""
    depth: tuple[Path, ...] = ()
    """Folders of the scene's depth maps."""
    object_spread: Path | None = None
    """NPZ: how far the object's sparse model may be bent."""
    scene_spread: Path | None = None
    """The same of the scene's."""

    def bending(self, pose: Sim3, centre: Array) -> tuple[Array | None, Array | None]:
        """(7, 7) covariances of both models around the object's centre (3,), None where they are not known."""
        from scenefuse.georef.spread import read_spread

        places = ((self.object_spread, centre), (self.scene_spread, pose.apply(centre)))
        of_object, of_scene = (None if path is None else read_spread(path).covariance_at(at) for path, at in places)
        return of_object, of_scene

    def free_space(self, scene: Cloud) -> FreeSpace | None:
        """The free space around a scene crop, or None without depth maps."""
        if self.workspace is None:
            return None
        tolerance = SCORE_FRACTION * scene.diagonal
        return read_free_space(self.workspace, self.depth, scene.points, FREE_SPACE_PHOTOS, tolerance)


def register_object(
    *,
    inputs: Inputs,
    known: ConstraintFiles = ConstraintFiles(),
    scale_report: Path,
    coarse_report: Path,
    report: Path,
    picture: Path | None = None,
    seed: int,
    scale: ScaleSettings,
    coarse: CoarseSettings,
    settings: FineSettings,
) -> None:
    """Find where an object lies in its scene, or reject every pose with a reason.

    The scale first, from the clouds' extents, as a prior with a width (method R1 to R3). Then hypotheses: similarity
    RANSAC on FPFH matches over a pyramid of voxels (R3, R4, R6) and, where gravity is known on both sides, a sweep of
    yaw, scale and shift by correlation; each is briefly refined and scored both ways (R9). They are refined into one
    pose, and that is registered or rejected (R8, R9, R12).

    Args:
        inputs: the two clouds and their reports.
        known: what is known beside the clouds.
        scale_report: output JSON: `scale`, `width_log` and the `ledger` of all estimates.
        coarse_report: output JSON with `hypotheses`, best first, and the best `scene_from_object`.
        report: output JSON: `status`, `reason`, `scene_from_object`, `scale`, scores, every hypothesis.
        picture: output PNG, the object on the scene crop from three sides.
        seed: of all random choices.
        scale: see ScaleSettings.
        coarse: see CoarseSettings.
        settings: see FineSettings.

    Raises:
        StageError: a cloud's points lie in one place or along one line.
    """
    (obj, scene), ups = inputs.clouds(), inputs.ups()
    ledger = estimates(obj, scene, ups)
    problem = Problem(*comparable(obj, scene), prior(ledger, scale), Constraints(ups), seed)
    write_json(scale_report, scale_quantities(ledger, problem.scales, scale.method))
    found, notes = hypotheses_or_centres(problem, coarse)
    write_json(coarse_report, coarse_quantities(found, ups is not None, notes))
    alignment = read_alignment(known.alignment_json) if settings.use_alignment else None
    problem = replace(problem, known=Constraints(ups, known.free_space(scene), alignment))
    outcome = refine_hypotheses(problem, [(hypothesis.pose, hypothesis.source) for hypothesis in found], settings)
    bending = known.bending(outcome.ranked[0].pose, obj.points.mean(0))
    outcome = outcome.unless_bent(bending[0], scene.diagonal)
    if picture is not None:
        draw_alignment(picture, obj, scene, outcome.ranked[0].pose, seed)
    write_json(report, _report(outcome, problem) | _stated(outcome, bending, inputs.length_unit()))


def _report(outcome: Outcome, problem: Problem) -> dict[str, Any]:
    """The stage JSON; the decision is printed."""
    best, decision = outcome.ranked[0], outcome.decision
    status = "registered" if decision.registered else "unregistered"
    print(f"{status}: {decision.reason}", flush=True)
    return {
        "status": quantity(status, ""),
        "reason": quantity(decision.reason, ""),
        **pose_quantities(best),
        "decided_by": quantity(decision.decided_by, ""),
        "rests_on": quantity(rests_on(best, problem.known), ""),
        "margin": quantity(decision.margin, "1"),
        "free_axis": quantity(decision.free_axis, ""),
        "tilt_deg": quantity(tilt_deg(best.pose, problem.known.ups), "deg"),
        "rival": quantity(None if decision.rival is None else decision.rival.as_json(), ""),
        "hypotheses": quantity([h.as_json() for h in outcome.ranked], ""),
    }


def rests_on(best: Hypothesis, known: Constraints) -> list[str]:
    """What a decision on a pose rests on."""
    used = {
        "shape": True,
        "colours": best.score.color is not None,
        "gravity": known.ups is not None,
        "free space": known.free_space is not None,
        "shared features": known.alignment is not None,
    }
    return [name for name, there in used.items() if there]


def _stated(outcome: Outcome, bending: tuple[Array | None, Array | None], length: str) -> dict[str, Any]:
    """The standard deviations of the pose: against the world, with what the clouds may have wrong alike, and how far
    either model may be bent (covariances of object and scene); and on the scene as it is, which the gate counts."""
    on_scene, stated = outcome.uncertainty, outcome.stated
    total = None if stated is None else with_bending(stated, outcome.ranked[0].pose, *bending)
    known = [name for name, of in zip(("object", "scene"), bending) if of is not None]
    return {
        **uncertainty_quantities(total, length),
        "on_scene": quantity(uncertainty_quantities(on_scene, length), ""),
        "bending_known_of": quantity(known, ""),
    }


def pose_quantities(best: Hypothesis) -> dict[str, Any]:
    """A pose, its source and its scores as a stage JSON holds them."""
    units = {"scene_from_object": "", "scale": "scene units per object unit", "source": ""}
    return {name: quantity(number, units.get(name, "1")) for name, number in best.as_json().items()}


def draw_alignment(path: Path, cloud: Cloud, scene: Cloud, scene_from_object: Sim3, seed: int) -> None:
    """Write a PNG: top, front and side views; above in two colours (scene grey, object orange), below as measured."""
    rng = np.random.default_rng(seed)
    obj, ground = (c[np.sort(rng.permutation(len(c))[:SAMPLED_POINTS])] for c in (cloud, scene))
    obj = obj.transformed(scene_from_object)
    # Strays at either side do not count.
    ends = np.array([np.percentile(each.points, [0.5, 99.5], axis=0) for each in (obj, ground)])
    low, high = ends[:, 0].min(0), ends[:, 1].max(0)
    points, half = np.concatenate([ground.points, obj.points]) - (low + high) / 2, 0.62 * float((high - low).max())
    flat, real = [], []
    for each, color in ((ground, (60, 60, 60)), (obj, (214, 92, 30))):
        flat.append(np.tile(color, (len(each), 1)))
        real.append(flat[-1] if each.colors is None else each.colors)
    views = (0, 1), (0, 2), (1, 2)
    rows = [
        np.concatenate([_splat(points, np.concatenate(colors), *axes, half) for axes in views], axis=1)
        for colors in (flat, real)
    ]
    with atomic_file(path) as temporary:
        write_picture(temporary, np.concatenate(rows))


def _splat(points: Array, colors: NDArray[Any], right: int, up: int, half: float) -> NDArray[np.uint8]:
    """Points with two axes to the right and up, the nearest drawn last, on white."""
    order = np.argsort(points @ np.cross(*np.eye(3)[[right, up]]), kind="stable")
    at = np.stack([1 - points[order, up] / half, points[order, right] / half + 1]) / 2 * SIDE_PX
    inside = ((at > 0) & (at < SIDE_PX - 1)).all(0)
    rows, columns = at[:, inside].astype(int)
    image = np.full((SIDE_PX, SIDE_PX, 3), 255, np.uint8)
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        image[rows + dv, columns + du] = colors[order][inside]
    return image
