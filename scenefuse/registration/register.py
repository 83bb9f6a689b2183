"""Registration on its own: two clouds in, a decision, a transform and a picture out; the workflow's steps in memory."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from scenefuse.io.clouds import Cloud, read_cloud, write_cloud, write_laz
from scenefuse.io.formats import las_crs
from scenefuse.io.settings import build, read_settings
from scenefuse.metrics.registration import MetricSettings, registration_metrics
from scenefuse.registration.coarse import CoarseSettings, find_hypotheses
from scenefuse.registration.crop.crop_scene import CropSettings, crop_marked
from scenefuse.registration.evidence import Evidence
from scenefuse.registration.fine import FineSettings, Outcome, refine_hypotheses, spread_quantities
from scenefuse.registration.picture import draw_alignment
from scenefuse.registration.refine import ScaleRange
from scenefuse.registration.scale import estimates, prior
from scenefuse.registration.verify import tilt_deg
from scenefuse.sfm.fiducials import ScenePoints, read_points
from scenefuse.stage import StageError, quantity, write_json
from scenefuse.transforms import Array, Sim3

# Clouds with more points are thinned at random for the search, which looks at far fewer; files are written in full.
MOST_POINTS = 500_000
REGISTERED, UNREGISTERED = 0, 3


@dataclass(frozen=True)
class Registration:
    """What came out.

    Attributes:
        registered: whether the pose may be used.
        reason: one sentence why, or why not.
        scene_from_object: the best pose found, between the clouds' own coordinates; None where nothing gave a pose.
        outcome: refined hypotheses and decision, relative to `origins`; None where nothing gave a pose.
        origins: the (3,) points subtracted from the object's and the scene's coordinates.
        scales: the scale prior.
        agreement: fitness, RMSE and normals at the best pose; see `registration_metrics`.
    """

    registered: bool
    reason: str
    scene_from_object: Sim3 | None
    outcome: Outcome | None
    origins: tuple[Array, Array]
    scales: ScaleRange
    agreement: dict[str, dict[str, Any]]


def register_clouds(
    obj: Cloud,
    scene: Cloud,
    settings: Mapping[str, Any],
    seed: int,
    *,
    ups: tuple[Array, Array] | None = None,
    scales: ScaleRange | None = None,
) -> Registration:
    """Find where an object lies in a scene: scale, coarse and fine registration as in the workflow, and the gate.

    Args:
        obj: the object, any frame and unit.
        scene: the scene's points around it (see `cut_scene`), any frame and unit; far origins lose no precision.
        settings: all settings, as `scenefuse.io.settings.read_settings` returns them.
        seed: of all random choices.
        ups: up directions in the object's and in the scene's frame; None where one of them is not known.
        scales: scene units per object unit; None to estimate them from both extents.

    Raises:
        StageError: too few points, or all in one place, on either side.
    """
    wanted, least = settings["registration"], settings["registration"]["crop"]["min_points"]
    for name, cloud in (("object", obj), ("scene", scene)):
        if len(cloud) < least or cloud.diagonal == 0:
            raise StageError(f"the {name} has only {len(cloud)} different points; {least} or more are needed")
    if "paper" in (wanted["coarse"]["recipe"], wanted["fine"]["recipe"]):
        raise StageError("the paper's recipe refuses nothing and is run by the workflow only; set `recipe: default`")
    origins = np.floor(obj.points.mean(0)), np.floor(scene.points.mean(0))
    near_obj, near_scene = (
        _at_most(replace(cloud, points=cloud.points - origin), MOST_POINTS, seed)
        for cloud, origin in zip((obj, scene), origins)
    )
    if scales is None:
        scale = wanted["scale"]
        scales = prior(estimates(near_obj, near_scene, ups), scale["method"], scale["width_log"])
    found = find_hypotheses(near_obj, near_scene, scales, ups, build(CoarseSettings, wanted["coarse"]), seed)
    if not found:
        return Registration(False, "neither features nor gravity gave a pose", None, None, origins, scales, {})
    poses = [(hypothesis.pose, hypothesis.source) for hypothesis in found]
    fine = build(FineSettings, wanted["fine"])
    outcome = refine_hypotheses(near_obj, near_scene, poses, scales, Evidence(ups), fine, seed)
    pose, measures = outcome.ranked[0].pose, build(MetricSettings, settings["metrics"])
    tau = measures.tau_fraction * near_scene.diagonal
    agreement = registration_metrics(near_obj, near_scene, pose, tau, near_scene.diagonal, "scene units", measures)
    whole = Sim3(1.0, np.eye(3), origins[1]) @ pose @ Sim3(1.0, np.eye(3), -origins[0])
    return Registration(
        outcome.decision.registered, outcome.decision.reason, whole, outcome, origins, scales, agreement
    )


def cut_scene(
    scene: Cloud,
    settings: Mapping[str, Any],
    up_in_scene: Array | None = None,
    fiducials: Path | None = None,
    box: Array | None = None,
) -> tuple[Cloud, str]:
    """The part of a scene in which the object is looked for, and what it is in words.

    Args:
        scene: the whole scene.
        settings: all settings.
        up_in_scene: opposite to gravity; without it, no ground is removed around fiducials.
        fiducials: file of at least four points on the object in the scene's coordinates: tab-separated with the header
            `point x y z` (TSV), or any cloud file.
        box: (6,) least x, y, z and greatest x, y, z.

    Raises:
        StageError: bad fiducials, or an empty box.
    """
    if box is not None:
        inside = (scene.points >= box[:3]) & (scene.points <= box[3:])
        part = scene[np.flatnonzero(inside.all(1))]
        if not len(part):
            raise StageError("no scene point lies in the crop box; give least x y z, then greatest x y z")
        return part, f"the crop box, {len(part)} of {len(scene)} points"
    if fiducials is None:
        return scene, f"the whole scene, {len(scene)} points, as if it showed little but the object"
    names, marks = _fiducials(fiducials)
    crop = build(CropSettings, settings["registration"]["crop"])
    if up_in_scene is None:
        crop, up_in_scene = replace(crop, remove_ground=False), np.array([0.0, 0.0, 1.0])
    origin = np.floor(marks.mean(0))
    near = replace(scene, points=scene.points - origin)
    cut = crop_marked(near, names, marks - origin, up_in_scene, crop, fiducials)
    ground = "the ground removed" if cut.ground is not None else "no ground removed"
    return scene[cut.keep], f"around {len(marks)} fiducials, {cut.keep.sum()} of {len(scene)} points, {ground}"


def register(
    *,
    object: Path,
    scene: Path,
    out: Path = Path("registered"),
    format: Literal["ply", "laz", "las"] = "ply",
    up_object: tuple[float, float, float] | None = None,
    up_scene: tuple[float, float, float] | None = None,
    scale: float | None = None,
    scale_range: tuple[float, float] | None = None,
    fiducials: Path | None = None,
    crop_box: tuple[float, float, float, float, float, float] | None = None,
    config: Path | None = None,
    seed: int | None = None,
) -> int:
    """Find the place, size and orientation of one point cloud in another, or refuse.

    Reads PLY, LAS, LAZ, E57, PCD, XYZ, PTS, TXT, ASC and CSV. Exit status: 0 registered, 3 unregistered, 1 bad input.
    docs/register.md says how to read what it writes.

    Args:
        object: cloud of the object, in any frame and unit.
        scene: cloud that shows the object.
        out: folder for transform.json, picture.png and, if registered, object_in_scene.
        format: of object_in_scene, which has the object's points in the scene's coordinates.
        up_object: direction opposite to gravity in the object's coordinates, where it is known.
        up_scene: the same in the scene's: 0 0 1 if z is up.
        scale: scene units per object unit, where it is known.
        scale_range: least and greatest scale, where it is roughly known.
        fiducials: file of at least four points on the object in the scene's coordinates: rows of x y z, or any cloud.
        crop_box: least x y z and greatest x y z of the part of the scene to look in.
        config: YAML of settings that differ from the shipped ones, with the keys of config/config.yaml.
        seed: of all random choices; the config's if not given.
    """
    start = time.perf_counter()
    settings = read_settings(config)
    seed = settings["seed"] if seed is None else seed
    scales = _scales(scale, scale_range)
    if fiducials is not None and crop_box is not None:
        raise StageError("both --fiducials and --crop-box are given; give one")
    if out.exists() and not out.is_dir():
        raise StageError(f"--out {out} is a file; give a folder")
    if up_object is not None and up_scene is None:
        raise StageError("--up-object needs --up-scene as well; it is 0 0 1 if the scene's z is up")
    ups = _unit("--up-object", up_object), _unit("--up-scene", up_scene)
    known = (ups[0], ups[1]) if ups[0] is not None and ups[1] is not None else None
    cloud, whole = read_cloud(object), read_cloud(scene)
    box = None if crop_box is None else np.array(crop_box)
    part, searched = cut_scene(whole, settings, ups[1], fiducials, box)
    found = register_clouds(cloud, part, settings, seed, ups=known, scales=scales)
    written = [out / "transform.json"]
    for ending in ("ply", "laz", "las"):
        (out / f"object_in_scene.{ending}").unlink(missing_ok=True)
    (out / "picture.png").unlink(missing_ok=True)
    if found.scene_from_object is not None:
        written.append(out / "picture.png")
        draw_alignment(written[-1], cloud, part, found.scene_from_object, seed)
        if found.registered:
            written.append(out / f"object_in_scene.{format}")
            _write(written[-1], cloud.transformed(found.scene_from_object), las_crs(scene))
    seconds = time.perf_counter() - start
    files = {"object": object, "scene": scene, "object_points": len(cloud), "scene_points": len(whole)}
    write_json(
        written[0],
        report(found, known)
        | {
            "searched": quantity(searched, ""),
            "inputs": quantity(files, ""),
            "seed": quantity(seed, ""),
            "seconds": quantity(seconds, "s"),
        },
    )
    print("\n".join(summary(found, searched, known) + [f"written    {', '.join(map(str, written))}"]), flush=True)
    return REGISTERED if found.registered else UNREGISTERED


def report(found: Registration, ups: tuple[Array, Array] | None) -> dict[str, Any]:
    """The content of transform.json: names, values and units as in the workflow's fine.json and metrics.json."""
    content = {
        "status": quantity("registered" if found.registered else "unregistered", ""),
        "reason": quantity(found.reason, ""),
    }
    pose, outcome = found.scene_from_object, found.outcome
    if pose is not None and outcome is not None:
        best, decision = outcome.ranked[0], outcome.decision
        unit = "scene units per object unit"
        content |= {
            "scene_from_object": quantity(pose.matrix, ""),
            "scale": quantity(pose.scale, unit),
            "scale_prior": quantity([found.scales.clamp(0.0), found.scales.clamp(np.inf)], unit),
            "f_score": quantity(best.score.f_score, "1"),
            "precision": quantity(best.score.precision, "1"),
            "recall": quantity(best.score.recall, "1"),
            "color_agreement": quantity(best.score.color, "1"),
            "score": quantity(best.score.total, "1"),
            "margin": quantity(decision.margin, "1"),
            "free_axis": quantity(decision.free_axis, ""),
            **spread_quantities(outcome.spread, "scene units"),
            "tilt_deg": quantity(tilt_deg(best.pose, ups), "degrees"),
            "gravity_used": quantity(ups is not None, ""),
            "agreement": found.agreement,
        }
    return content


def summary(found: Registration, searched: str, ups: tuple[Array, Array] | None) -> list[str]:
    """The decision in four lines."""
    lines = [f"{'registered' if found.registered else 'unregistered'}: {found.reason}"]
    low, high = found.scales.clamp(0.0), found.scales.clamp(np.inf)
    held = f"held at {low:.6g}" if found.scales.width == 0 else f"searched from {low:.4g} to {high:.4g}"
    scale = (
        "" if found.scene_from_object is None else f"{found.scene_from_object.scale:.6g} scene units per object unit, "
    )
    lines.append(f"scale      {scale}{held}")
    lines.append(f"searched   {searched}; gravity {'known' if ups is not None else 'not known'} on both sides")
    if found.agreement:
        near, back, rmse, share, tau = (
            found.agreement[name]["value"]
            for name in ("fitness_source", "fitness_target", "inlier_rmse", "inlier_rmse_over_diagonal", "tau")
        )
        off = "" if rmse is None else f", which lie {rmse:.3g} apart (RMS; {100 * share:.2g} % of the scene part)"
        lines.append(
            f"agreement  {near:.0%} of the object and {back:.0%} of the scene part have a partner within {tau:.3g}{off}"
        )
    return lines


def _scales(scale: float | None, scale_range: tuple[float, float] | None) -> ScaleRange | None:
    if scale is not None and scale_range is not None:
        raise StageError("both --scale and --scale-range are given; give one")
    if scale is None and scale_range is None:
        return None
    low, high = (scale, scale) if scale is not None else scale_range  # type: ignore[misc]
    if not 0 < low <= high < np.inf:
        raise StageError(f"a scale has to be positive, and a range's least must come first; not {low:g} {high:g}")
    return ScaleRange(float(np.sqrt(low * high)), float(np.log(high / low) / 2))


def _unit(flag: str, direction: tuple[float, float, float] | None) -> Array | None:
    if direction is None:
        return None
    length = float(np.linalg.norm(direction))
    if not 0 < length < np.inf:
        raise StageError(f"{flag} needs a direction; {' '.join(map(str, direction))} is none")
    return np.array(direction) / length


def _fiducials(path: Path) -> tuple[list[str], Array]:
    """Names and positions (F, 3) of marked points in the scene's coordinates."""
    if path.suffix.lower() != ".tsv":
        points = read_cloud(path).points
        return [str(number) for number in range(1, len(points) + 1)], points
    marked = read_points(path)
    if not isinstance(marked, ScenePoints):
        raise StageError(f"{path} holds clicks in photos; without photos, give points as 'point x y z'")
    return marked.points, marked.positions


def _at_most(cloud: Cloud, most: int, seed: int) -> Cloud:
    if len(cloud) <= most:
        return cloud
    return cloud[np.sort(np.random.default_rng(seed).permutation(len(cloud))[:most])]


def _write(path: Path, cloud: Cloud, crs: str | None) -> None:
    if path.suffix == ".ply":
        write_cloud(path, cloud)
        return
    origin = np.floor(cloud.points.min(0))
    write_laz(path, replace(cloud, points=cloud.points - origin), origin, crs)
