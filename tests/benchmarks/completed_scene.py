"""The completed scene of a finished demo against truth, for every way to fuse, and the harm that a bad object does.

make demo, then PYTHONPATH=. python tests/benchmarks/completed_scene.py --results results
The same with --harm True: displaced and scaled objects, and a bad object in a perfect scene; with --certificate True:
whether what the run wrote about its added points, class and standard deviation, is true; with --cost True: seconds and
memory of the fusion where a million points of the scene lie near the object.

A quarter of an object's masks wrong needs its stages to run again: see spoil_masks.py.
"""

import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import open3d as o3d
import pandas as pd
from scipy.spatial import cKDTree

from demo.evaluate import (
    ObjectTruth,
    around_object,
    read_object_truth,
    scene_scores,
    surface_to_find,
)
from demo.truth import THRESHOLDS, read_cameras, registration_error
from scenefuse.cloud.clouds import Cloud, concatenate, read_cloud, spacing
from scenefuse.core.stage import StageError, read_json, run, threads, value
from scenefuse.core.transforms import Array, Sim3, Uncertainty
from scenefuse.fuse.fuse_object import uncertainty_on_scene
from scenefuse.fuse.measure import Evidence
from scenefuse.fuse.modes import FusionSettings, around, fuse_by_distance, fuse_by_evidence
from scenefuse.fuse.write import Source, together
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS
from scenefuse.geometry.icp import step_to_planes
from scenefuse.geometry.photo_check import moved_photos, read_photos
from scenefuse.photos.workspace import read_workspace

# Points drawn on the true surface, as the workflow's evaluation draws them.
SAMPLES = 60000
# Harm, over the diagonal: the object's shift, its noise, how far a third of a bad one is moved; and its wrong scales.
SHIFT, NOISE, MOVED = 0.02, 0.01, 0.1
SCALES = (1.03, 1 / 1.03)
# Points that are aligned to the true surface, and steps in which they are.
ALIGNED, ALIGNMENTS = 20_000, 20
# Of the scene near the object, to time the fusion.
COST_POINTS = (1_000_000, 10_000_000)
# Rows that are no fusion.
BEFORE, ALONE = "scene before", "object alone"
F_SCORES = [f"f_score_{ending}" for ending in THRESHOLDS]


@dataclass(frozen=True)
class Case:
    """An object of a finished demo, the scene that it is added to, and the truth.

    Attributes:
        name: the object's.
        object: its cloud, in its own frame.
        scene: the whole scene.
        crop: the scene's points on the object.
        pose: scene_from_object.
        uncertainty: of the pose on the scene, as the registration states it.
        truth_from_scene: from the scene's evaluation.
        known: the object as it truly is.
        surface: (M, 3) what is to be found of its surface, in the truth's frame.
        results: the run's folder: photos and cameras are in objects/NAME/undistorted and scenes/demo/undistorted.
    """

    name: str
    object: Cloud
    scene: Cloud
    crop: Cloud
    pose: Sim3
    uncertainty: Uncertainty | None
    truth_from_scene: Sim3
    known: ObjectTruth
    surface: Array
    results: Path

    @property
    def diagonal(self) -> float:
        """The object's true diagonal in the scene's unit."""
        return self.known.diagonal / self.truth_from_scene.scale

    @property
    def true_pose(self) -> Sim3:
        """scene_from_object by the true cameras on both sides."""
        return self.truth_from_scene.inverse() @ self.known.fit.truth_from_model

    @property
    def shift(self) -> float:
        """How far the pose puts the object's middle from its true place, over the diagonal."""
        middle = self.known.fit.truth_from_model.inverse().apply(self.known.middle)
        return registration_error(self.pose, self.true_pose, middle, self.diagonal).translation_over_diagonal


def fuse(case: Case, settings: FusionSettings) -> Cloud:
    """The completed scene. All calls of the library's fusion go through here."""
    if settings.mode == "evidence":
        placed = case.object.transformed(case.pose)
        own = read_photos(read_workspace(case.results / "objects" / case.name / "undistorted"), case.object.points)
        theirs = read_photos(read_workspace(case.results / "scenes/demo/undistorted"), placed.points)
        photos = moved_photos(own, case.pose), theirs
        fused, _ = fuse_by_evidence(placed, case.scene, *photos, settings, case.uncertainty)
    else:
        fused = fuse_by_distance(case.object, case.scene, case.crop, case.pose, settings)
    return together(fused.kept, fused.added)


def fusions(modes: tuple[str, ...]) -> dict[str, FusionSettings]:
    """Every mode that there is, or those wanted, by the name of its row."""
    found = {}
    for mode in get_args(get_type_hints(FusionSettings)["mode"]):
        found[mode] = FusionSettings(mode=mode)
        if mode == "evidence":
            found |= {f"evidence, {u}": FusionSettings(mode=mode, unconfirmed=u) for u in ("none", "all")}
    if unknown := set(modes) - set(found):
        raise StageError(f"there are no rows {sorted(unknown)}; there are {', '.join(found)}")
    return {name: settings for name, settings in found.items() if not modes or name in modes}


def read_case(results: Path, name: str, scene: Cloud) -> Case:
    """One object of a finished demo; `scene` is the run's dense cloud."""
    folder, truth = results / "objects" / name, results / "demo/demo/truth"
    known = read_object_truth(folder / "undistorted", truth / "scene", truth / name, SAMPLES, seed=0)
    fine = read_json(folder / "registration/full/fine.json")
    if value(fine, "scene_from_object") is None:
        raise StageError(f"{folder}: not registered ({value(fine, 'reason')}); run the demo again, or leave it out")
    return Case(
        name,
        read_cloud(folder / "object.ply"),
        scene,
        read_cloud(folder / "registration/full/crop.ply"),
        Sim3.from_matrix(np.array(value(fine, "scene_from_object"))),
        uncertainty_on_scene(fine),
        Sim3.from_matrix(np.array(value(read_json(results / "scenes/demo/truth.json"), "truth_from_scene"))),
        known,
        surface_to_find(known, read_cameras(truth / "scene/cameras.json")),
        results,
    )


def scores(case: Case, cloud: Cloud) -> dict[str, float]:
    """F-score, precision and recall of a cloud in the scene's frame around the object, at each threshold."""
    found = scene_scores(case.truth_from_scene.apply(cloud.points), case.known, case.surface)
    return {f"{name}_{end}": score for end, of_end in found.items() for name, score in of_end.items()}


def completed_rows(case: Case, modes: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """The rows of the first table."""
    yield {"cloud": BEFORE, **scores(case, case.scene)}
    for name, settings in fusions(modes).items():
        yield {"cloud": name, **scores(case, fuse(case, settings))}
    yield {"cloud": ALONE, **scores(case, case.object.transformed(case.pose))}


def harmed(case: Case) -> Iterator[tuple[str, Case]]:
    """What may go wrong with an object, each as a case of its own; first the object as it is."""
    yield "nothing", case
    for axis in range(3):
        for sign in (1, -1):
            yield f"displaced by {100 * SHIFT:g} %", replace(case, pose=displaced(case, axis, sign))
    for factor in SCALES:
        yield "scaled by 3 %", replace(case, pose=scaled(case, factor))
    yield "bad object, perfect scene", perfect_scene(replace(case, object=bad_object(case)))


def displaced(case: Case, axis: int, sign: int) -> Sim3:
    """The pose moved along an axis of the object's frame."""
    shift = sign * SHIFT * case.diagonal * case.pose.rotation[:, axis]
    return replace(case.pose, translation=case.pose.translation + shift)


def scaled(case: Case, factor: float) -> Sim3:
    """The pose with the object larger or smaller about its middle."""
    low, high = (np.percentile(case.object.points, q, axis=0) for q in (1, 99))
    middle = case.pose.apply((low + high) / 2)
    return Sim3(factor * case.pose.scale, case.pose.rotation, middle + factor * (case.pose.translation - middle))


def bad_object(case: Case) -> Cloud:
    """The object with noise, the third of it at one end of its first axis moved sideways."""
    points, size = case.object.points, case.diagonal / case.pose.scale
    moved = points + np.random.default_rng(0).normal(0, NOISE * size, points.shape)
    moved[points[:, 0] > np.quantile(points[:, 0], 2 / 3), 1] += MOVED * size
    return replace(case.object, points=moved)


def perfect_scene(case: Case) -> Case:
    """The scene's points on the object replaced by points of its true surface, the object at its true pose.

    Colours are those of the object's cloud (before it was spoilt), which are nearest.
    """
    scene_from_truth = case.truth_from_scene.inverse()
    caster = case.known.mesh.caster()
    closest = caster.compute_closest_points(o3d.core.Tensor.from_numpy(case.surface.astype(np.float32)), threads())
    normals = scene_from_truth.rotate(closest["primitive_normals"].numpy()).astype(np.float32)
    good = read_cloud(case.results / "objects" / case.name / "object.ply")
    colors = None
    if good.colors is not None:
        placed = case.known.fit.truth_from_model.apply(good.points)
        colors = good.colors[cKDTree(placed).query(case.surface, workers=threads())[1]]
    perfect = Cloud(scene_from_truth.apply(case.surface), normals, colors)
    own = around_object(case.truth_from_scene.apply(case.scene.points), case.known)
    whole = concatenate([case.scene[~own], perfect])
    return replace(case, scene=whole, crop=perfect, pose=case.true_pose)


def harm_rows(case: Case, modes: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """The rows of the second table: scores of the completed scene minus those of the scene before."""
    for wrong, spoilt in harmed(case):
        before = scores(spoilt, spoilt.scene)
        for name, settings in fusions(modes).items():
            after = scores(spoilt, fuse(spoilt, settings))
            yield {"wrong": wrong, "cloud": name, **{key: after[key] - before[key] for key in after}}


def certificate_rows(case: Case) -> Iterator[dict[str, Any]]:
    """The row of the third table: what fused.ply says of the points it added, beside their true errors.

    Errors are vectors to the true surface. For `deviation`, an error within the object's frame, the added points are
    aligned to the truth by their surface; `shift_pct` is how far this moves them from where the object's cameras put
    them: the model's own bending, which belongs to the pose. `by_cameras` is without this alignment. `in_world` are
    errors in the scene, aligned to the truth by its cameras, within `world_deviation`: the scene's bending is in
    neither. A surface has no place along itself: an axis counts where the surface faces it within 45 degrees.
    """
    folder = case.results / "objects" / case.name
    fused = read_cloud(folder / "fused.ply")
    settled = Sim3.from_matrix(np.array(value(read_json(folder / "fusion.json"), "scene_from_object")))
    truth_from_scene = case.known.fit.truth_from_model @ settled.inverse()
    added = fused[fused.fields["source"] == Source.OBJECT]
    measured = (added.fields["evidence"] == Evidence.MEASURED) & (added.fields["photos"] >= CONFIRMING_PHOTOS)
    placed = truth_from_scene.apply(added.points[measured])
    aligned = surface_alignment(placed, case.known)
    points, bounds = aligned.apply(placed), 2 * truth_from_scene.scale * added.fields["deviation"][measured]
    errors, in_world = _to_surface(points, case.known), case.truth_from_scene
    world = in_world.apply(added.points[measured])
    world_bounds = 2 * in_world.scale * added.fields["world_deviation"][measured]
    whole = case.known.fit.truth_from_model.apply(case.object.points)
    plain = added.fields["evidence"] == Evidence.PLAIN
    yield {
        "added": len(added),
        "measured": float(measured.mean()),
        "plain": float(plain.mean()),
        "plain_within_1pct": _share_near(truth_from_scene.apply(added.points[plain]), case.known),
        "deviation_median_over_diagonal": float(np.median(bounds)) / 2 / case.known.diagonal,
        "shift_pct": 100 * float(np.linalg.norm(points.mean(0) - placed.mean(0))) / case.known.diagonal,
        **{f"{axis}_within_2_sd": share for axis, share in zip("xyz", _within(points, bounds, case.known))},
        **{f"{axis}_by_cameras": share for axis, share in zip("xyz", _within(placed, bounds, case.known))},
        **{f"{axis}_in_world": share for axis, share in zip("xyz", _within(world, world_bounds, case.known))},
        "distance_within_2_sd": float((np.linalg.norm(errors, axis=1) <= bounds).mean()),
        "added_within_1pct": float((np.linalg.norm(errors, axis=1) <= 0.01 * case.known.diagonal).mean()),
        "object_within_1pct": _share_near(whole, case.known),
    }


def cost_rows(case: Case) -> Iterator[dict[str, Any]]:
    """The rows of the fourth table: the fusion with the scene near the object as it is, and with COST_POINTS there."""
    near = around(case.scene, case.object.transformed(case.pose))
    own, step = case.scene[near], spacing(case.scene.points[near])
    for count in (None, *COST_POINTS):
        scene = case.scene
        if count is not None:
            rng = np.random.default_rng(0)
            dense = own[rng.integers(0, len(own), count)]
            dense = replace(dense, points=dense.points + rng.normal(0, 0.3 * step, dense.points.shape))
            scene = concatenate([case.scene[~near], dense])
        start = time.perf_counter()
        completed = fuse(replace(case, scene=scene), FusionSettings())
        seconds = time.perf_counter() - start
        yield {
            "scene_points_near": int(around(scene, case.object.transformed(case.pose)).sum()),
            "object_points": len(case.object),
            "seconds": seconds,
            "peak_gb_so_far": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
            **scores(case, completed),
        }


def _to_surface(points: Array, known: ObjectTruth) -> Array:
    """(N, 3) vectors from the true surface to points in the truth's frame."""
    query = o3d.core.Tensor.from_numpy(points.astype(np.float32))
    return points - known.mesh.caster().compute_closest_points(query, threads())["points"].numpy()


def _normals_there(points: Array, known: ObjectTruth) -> Array:
    """(N, 3) unit normals of the true surface where it is nearest to points."""
    query = o3d.core.Tensor.from_numpy(points.astype(np.float32))
    return known.mesh.caster().compute_closest_points(query, threads())["primitive_normals"].numpy()


def _within(points: Array, bounds: Array, known: ObjectTruth) -> list[float]:
    """Along x, y, z: the share of points (N, 3) that are off the true surface by no more than bounds (N,)."""
    off, faces = np.abs(_to_surface(points, known)), np.abs(_normals_there(points, known)) > np.sqrt(0.5)
    return [float((off[faces[:, axis], axis] <= bounds[faces[:, axis]]).mean()) for axis in range(3)]


def surface_alignment(points: Array, known: ObjectTruth) -> Sim3:
    """The similarity that lays points (N, 3) on the true surface, robustly; points already near it.

    Point to plane (Chen and Medioni 1992), with Huber's weights at one and a half median distances.
    """
    points, found = points[:: max(1, len(points) // ALIGNED)], Sim3.identity()
    for _ in range(ALIGNMENTS):
        moved = found.apply(points)
        normals = _normals_there(moved, known)
        off = (_to_surface(moved, known) * normals).sum(1)
        # Rows of shorter normals and distances weigh less.
        weights = 1 / np.sqrt(np.maximum(1, np.abs(off) / (1.5 * np.median(np.abs(off)))))
        found = step_to_planes(found, moved, normals * weights[:, None], off * weights)
    return found


def _share_near(points: Array, known: ObjectTruth) -> float:
    """Share of the points within 1 % of the diagonal of the true surface."""
    return float((np.linalg.norm(_to_surface(points, known), axis=1) <= 0.01 * known.diagonal).mean())


def completed_scene(
    *,
    results: tuple[Path, ...] = (Path("results"),),
    objects: tuple[str, ...] = (),
    harm: bool = False,
    certificate: bool = False,
    cost: bool = False,
    object: Path | None = None,
    modes: tuple[str, ...] = (),
) -> None:
    """Print the scene's F-scores around each object against truth, before and after every kind of fusion.

    All numbers go to bench/completed_scene.tsv (or completed_scene_harm.tsv, ...) in the first results folder.

    Args:
        results: folders of finished demos; several give mean and standard deviation.
        objects: which; all that the demo has without it.
        harm: print the second table instead: what a wrong pose or a bad object changes.
        certificate: print the third table instead: whether the added points are as exact as they say.
        cost: print the fourth table instead: seconds and memory of the fusion.
        object: a cloud in the object's own frame that takes the place of the only one of `objects`.
        modes: which rows of the first two tables, by their names; all without it.

    Raises:
        StageError: a folder holds no finished demo, or a cloud is given for several objects.
    """
    rows: list[dict[str, Any]] = []
    kind = "_harm" if harm else "_certificate" if certificate else "_cost" if cost else ""
    rows_of: dict[str, Callable[[Case], Iterator[dict[str, Any]]]] = {
        "": partial(completed_rows, modes=modes),
        "_harm": partial(harm_rows, modes=modes),
        "_certificate": certificate_rows,
        "_cost": cost_rows,
    }
    for folder in results:
        for case in read_cases(folder, objects, object):
            for row in rows_of[kind](case):
                rows.append({"run": str(folder), "object": case.name, "shift_over_diagonal": case.shift, **row})
                print(f"{folder}, {case.name}: {row.get('wrong', '')} {row.get('cloud', kind[1:])}", flush=True)
    table = pd.DataFrame(rows)
    out = results[0] / f"bench/completed_scene{kind}.tsv"
    out.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(out, sep="\t", index=False, float_format="%.5f")
    print({"": summary, "_harm": harm_summary, "_certificate": certificate_summary}.get(kind, cost_summary)(table))


def read_cases(results: Path, objects: tuple[str, ...], cloud: Path | None) -> Iterator[Case]:
    """The objects of a finished demo."""
    truth = results / "demo/demo/truth"
    if not (results / "scenes/demo/truth.json").is_file():
        raise StageError(f"{results} holds no finished demo (scenes/demo/truth.json); run make demo first")
    names = objects or sorted(path.parent.name for path in truth.glob("*/mesh.ply"))
    if cloud is not None and len(names) != 1:
        raise StageError(f"--object {cloud} is one object's cloud; name that object with --objects")
    scene = read_cloud(results / "scenes/demo/dense.ply")
    for name in names:
        case = read_case(results, name, scene)
        yield case if cloud is None else replace(case, object=read_cloud(cloud))


def summary(table: pd.DataFrame) -> str:
    """F-scores of every row; and, at worst over the thresholds, how far it is above the better of its two sources."""
    runs, heads = table["run"].nunique(), "".join(f"{f'{100 * share:g} %':>16}" for share in THRESHOLDS.values())
    lines = [f"F-score at a share of the diagonal, {runs} run{'s' if runs > 1 else ''} (mean ± standard deviation)"]
    for name, part in table.groupby("object", sort=False):
        shift = f"{name}, {100 * part['shift_over_diagonal'].mean():.2f} % from its true place"
        lines += ["", f"{shift:40s}{heads}   over the better source"]
        scores = part.set_index(["run", "cloud"])[F_SCORES]
        better = np.maximum(scores.xs(BEFORE, level="cloud"), scores.xs(ALONE, level="cloud"))
        for cloud in part["cloud"].unique():
            own = scores.xs(cloud, level="cloud")
            over = "" if cloud in (BEFORE, ALONE) else f"{(own - better).mean().min():+25.3f}"
            lines.append(f"{cloud:40s}" + "".join(_mean(own[column]) for column in F_SCORES) + over)
    return "\n".join(lines)


def harm_summary(table: pd.DataFrame) -> str:
    """The least of the changes of F, over directions, scales and runs."""
    heads = "".join(f"{f'{100 * share:g} %':>9}" for share in THRESHOLDS.values())
    lines = ["F-score of the completed scene minus that of the scene before, at worst"]
    for (name, wrong), part in table.groupby(["object", "wrong"], sort=False):
        lines += ["", f"{f'{name}, wrong: {wrong}':48s}{heads}"]
        for cloud, changes in part.groupby("cloud", sort=False)[F_SCORES]:
            lines.append(f"  {cloud:46s}" + "".join(f"{change:+9.3f}" for change in changes.min()))
    return "\n".join(lines)


def certificate_summary(table: pd.DataFrame) -> str:
    """A column for each object, the mean over the runs."""
    means = table.drop(columns=["run"]).groupby("object", sort=False).mean()
    return "Added points, as fused.ply certifies them\n" + means.T.to_string(float_format=lambda x: f"{x:.5g}")


def cost_summary(table: pd.DataFrame) -> str:
    """All rows."""
    return table.drop(columns=["run", "shift_over_diagonal"]).to_string(index=False, float_format=lambda x: f"{x:.3g}")


def _mean(values: pd.Series) -> str:
    """A cell: mean, and standard deviation over several runs."""
    return f"{f'{values.mean():.3f}' + (f' ± {values.std():.3f}' if len(values) > 1 else ''):>16}"


if __name__ == "__main__":
    run(completed_scene)
