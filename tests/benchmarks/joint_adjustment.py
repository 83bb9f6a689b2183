"""One bundle adjustment of the object's and the scene's models over their shared features: is the pose more exact?

PYTHONPATH=tests python tests/benchmarks/joint_adjustment.py --trials 40
"""

import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from support.photo_trials import FIRST_SEED, MEASURES, drawn, modelled, off_by, quiet
from support.photographed_place import Rows
from support.planted_photos import PhotoTrial, fitted, truth

from scenefuse.core.stage import run, value
from scenefuse.core.transforms import Array, Sim3, fit_sim3
from scenefuse.georef.align_models import MAX_ERROR_PX, AlignmentSettings, align_landmarks
from scenefuse.georef.landmarks import match_landmarks
from scenefuse.georef.reprojection import match_errors, observations
from scenefuse.sfm.colmap import Freedom, adjustment_options, drop_outliers

# Ids of the object's camera, photos and points in the joint model lie so far above those of the scene's.
ABOVE = 1_000_000
# What stays of the scene: nothing; the lens and the poses of its photos.
HELD = {"free": False, "held": True}
# Bounds of the groups by shared features.
GROUPS = {"< 40": (0, 40), "40 to 100": (40, 101), "> 100": (101, np.inf), "all": (0, np.inf)}
# The frame of the scene's cameras, and the scene's model around the object.
KINDS = ("true", "here")


@dataclass(frozen=True)
class Joint:
    """Both models as one, in the scene's frame.

    Attributes:
        model: cameras, photos and points of the scene, and the object's, their ids raised by `ABOVE`.
        object_ids: ids in it of the object's points (N,), in the order of the object's own ids.
    """

    model: pycolmap.Reconstruction
    object_ids: Rows


def joined(obj: pycolmap.Reconstruction, scene: pycolmap.Reconstruction, pose: Sim3, shared: Rows) -> Joint:
    """Both models as one, shared points merged with the observations of both sides.

    Args:
        obj, scene: the two models, which stay as they are.
        pose: scene_from_object.
        shared: (M, 2) ids of the object's and of the scene's points that are the same.
    """
    moved = pycolmap.Reconstruction(obj)
    moved.transform(pycolmap.Sim3d(pose.matrix[:3]))
    model = pycolmap.Reconstruction()
    for side, above in ((scene, 0), (moved, ABOVE)):
        _add_photos(model, side, above)
    partner = dict(shared.tolist())
    tracks = {i: (p.xyz, _track(p, 0)) for i, p in scene.points3D.items()}
    for i, point in moved.points3D.items():
        mine = _track(point, ABOVE)
        if i in partner:
            xyz, theirs = tracks[partner[i]]
            tracks[partner[i]] = ((xyz + point.xyz) / 2, theirs + mine)
        else:
            tracks[i + ABOVE] = (point.xyz, mine)
    for i, (xyz, track) in tracks.items():
        model.add_point3D_with_id(i, pycolmap.Point3D(xyz=xyz, track=pycolmap.Track(track)))
    return Joint(model, np.array([partner.get(i, i + ABOVE) for i in sorted(moved.points3D)], dtype=np.int64))


def _add_photos(model: pycolmap.Reconstruction, side: pycolmap.Reconstruction, above: int) -> None:
    """Add a side's only camera and its photos, without points."""
    for i, camera in side.cameras.items():
        params = list(camera.params)
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(
                model=camera.model_name, width=camera.width, height=camera.height, params=params, camera_id=i + above
            )
        )
    for i in sorted(side.reg_image_ids()):
        photo = side.images[i]
        image = pycolmap.Image(
            name=f"{above}/{photo.name}",
            camera_id=photo.camera_id + above,
            image_id=i + above,
            points2D=[pycolmap.Point2D(p.xy) for p in photo.points2D],
        )
        model.add_image_with_trivial_frame(image, photo.cam_from_world())


def _track(point: pycolmap.Point3D, above: int) -> list[pycolmap.TrackElement]:
    return [pycolmap.TrackElement(e.image_id + above, e.point2D_idx) for e in point.track.elements]


def adjust_jointly(model: pycolmap.Reconstruction, freedom: Freedom, held: bool) -> None:
    """Adjust a joint model in place as mapping adjusts one, and again without what does not fit.

    Args:
        model: of a `Joint`.
        freedom: what may change of the lenses.
        held: whether the scene's photos and lens stay as they are.
    """
    for _ in range(2):
        config = pycolmap.BundleAdjustmentConfig()
        for image in model.reg_image_ids():
            config.add_image(image)
            if held and image < ABOVE:
                config.set_constant_rig_from_world_pose(model.images[image].frame_id)
        if not held:
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        for camera in model.cameras:
            if held and camera < ABOVE:
                config.set_constant_cam_intrinsics(camera)
        options = adjustment_options(freedom)
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
        drop_outliers(model)


def poses(joint: Joint, trial: PhotoTrial, first: Sim3) -> dict[str, Sim3]:
    """scene_from_object by a joint model: the object's own points to where they are in it, and from there back.

    Back into the scene as it was: by its cameras ("true"), and by its points around the object ("here").
    """
    rows, x, photos = trial.obj.points()
    there, known = _positions(joint.model, joint.object_ids)
    mine = known & (trial.features.owner[rows] == "object")
    joint_from_object = fitted(x[mine], there[mine], photos[mine])
    rows, x, photos = trial.scene.points()
    there, known = _positions(joint.model, rows + 1)
    centre = first.apply(np.median(trial.obj.points()[1], axis=0))
    near = known & (np.linalg.norm(x - centre, axis=1) < trial.diagonal)
    images = sorted(trial.scene.model.reg_image_ids())
    before, after = (
        np.array([m.images[i].projection_center() for i in images]) for m in (trial.scene.model, joint.model)
    )
    return {
        "true": fit_sim3(after, before) @ joint_from_object,
        "here": fitted(there[near], x[near], photos[near]) @ joint_from_object,
    }


def _positions(model: pycolmap.Reconstruction, ids: Rows) -> tuple[Array, NDArray[np.bool_]]:
    """Where points (N,) are in a model, (N, 3), and whether they are in it."""
    known = np.array([i in model.points3D for i in ids.tolist()], dtype=bool)
    x = [model.points3D[i].xyz if k else np.zeros(3) for i, k in zip(ids.tolist(), known)]
    return np.array(x).reshape(-1, 3), known


def shared_ids(trial: PhotoTrial, pose: Sim3, count: int | None) -> Rows:
    """(M, 2) ids of points that look alike and agree with a pose; the `count` nearest to the object only, if given."""
    obj, scene = trial.obj.landmarks(), trial.scene.landmarks()
    pairs = match_landmarks(obj, scene, AlignmentSettings().max_ratio)
    seen = observations(obj, scene, pairs)
    agree = np.flatnonzero(match_errors(seen, pose) <= MAX_ERROR_PX)
    distance = np.linalg.norm(seen.x[agree] - obj.looked_at(), axis=1)
    agree = agree[np.argsort(distance)[:count]]
    ids = (np.array(sorted(side.model.points3D), dtype=np.int64) for side in (trial.obj, trial.scene))
    return np.stack([own[rows] for own, rows in zip(ids, pairs[agree].T)], axis=1)


def one(seed: int, bend: float, apart_px: float) -> dict[str, Any]:
    """A trial: mapped, aligned, adjusted jointly, compared with the truth before and after."""
    plan = replace(drawn(seed, bend), apart_px=apart_px)
    trial, choices = modelled(seed, plan)
    settings = AlignmentSettings()
    content = align_landmarks(trial.obj.landmarks(), trial.scene.landmarks(), settings, seed)
    row = {"seed": seed, "kind": plan.kind, "found": value(content, "found")}
    if not row["found"]:
        return row
    known, pose = truth(trial), Sim3.from_matrix(np.array(value(content, "scene_from_object")))
    truths = {"true": known.scene_from_object, "here": known.here}
    row |= {"shared": value(content, "shared_points"), "misfit_pct": 100 * known.misfit}
    row |= {f"lens_{name}": choice.lens.name for name, choice in zip(("object", "scene"), choices)}
    for kind, true in truths.items():
        row |= off_by(f"alone_{kind}", pose, true, known.centre, trial.diagonal)
    # Where one side's photos determine its principal point, they determine the other's over shared points.
    freedom = Freedom(principal_point=any(choice.lens.freedom.principal_point for choice in choices))
    for name, held in HELD.items():
        begin = time.perf_counter()
        shared = shared_ids(trial, pose, settings.nearest_points if held else None)
        joint = joined(trial.obj.model, trial.scene.model, pose, shared)
        adjust_jointly(joint.model, freedom, held)
        found = poses(joint, trial, pose)
        row |= {f"{name}_s": time.perf_counter() - begin, f"{name}_merged": len(shared)}
        row |= {f"{name}_wrong": int((shared[:, 0] != shared[:, 1]).sum())}
        for kind, true in truths.items():
            row |= off_by(f"{name}_{kind}", found[kind], true, known.centre, trial.diagonal)
    return row


def joint_adjustment(
    *,
    out: Path = Path("results/bench/joint_adjustment.tsv"),
    seeds: Literal["development", "published"] = "development",
    trials: int = 40,
    first: int = 0,
    bend: float = 1.0,
    apart_px: float = 0.0,
    jobs: int = 1,
) -> None:
    """Print errors of the poses that features give, and of those by an adjustment of both models as one.

    Args:
        out: every trial as a row (TSV).
        seeds: those of development, or those that nothing was tuned on.
        trials: how many.
        first: number of the first trial.
        bend: as in shared_photos.py.
        apart_px: how far off close-ups find a feature, the same in all of them, in pixels of the scene's photos.
        jobs: processes, one thread each.
    """
    begin = FIRST_SEED[seeds] + first
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=quiet) as pool:
        table = pd.DataFrame(list(pool.map(one, range(begin, begin + trials), [bend] * trials, [apart_px] * trials)))
    out.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(out, sep="\t", index=False, float_format="%.5g")
    print(summary(table))


def summary(table: pd.DataFrame) -> str:
    """The printed table."""
    found = table[table.found.astype(bool)]
    if found.empty:
        return f"none of {len(table)} trials has a pose"
    rows = {}
    for group, (least, most) in GROUPS.items():
        part = found[(found.shared >= least) & (found.shared < most)]
        for kind in KINDS:
            for name in ("alone", *HELD):
                rows[group, len(part), kind, name] = _row(part, kind, name)
    shown = pd.DataFrame(rows).T
    shown.index.names = ["shared", "trials", "against", "adjusted"]
    return "\n\n".join(
        [
            f"{len(found)} of {len(table)} trials have a pose. true: in the frame of the scene's cameras; here: against"
            "\nthe scene's model around the object. alone: no joint adjustment; free: all is adjusted; held: the"
            "\nscene's photos and lens stay. Median | 90 % of the errors, and in how many trials the error falls.",
            shown.to_string(),
            f"Median seconds: free {found.free_s.median():.1f}, held {found.held_s.median():.1f}.",
        ]
    )


def _row(part: pd.DataFrame, kind: str, name: str) -> dict[str, str]:
    cells = {}
    for measure in MEASURES:
        error, alone = (part[f"{n}_{kind}_{measure}"].abs() for n in (name, "alone"))
        cells[measure] = f"{error.median():.3f} | {error.quantile(0.9):.3f}"
        if name != "alone":
            cells[measure] += f"  {(error < alone).mean():.0%}"
    return cells


if __name__ == "__main__":
    run(joint_adjustment)
