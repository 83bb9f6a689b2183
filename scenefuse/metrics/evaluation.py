"""The demo's scene and objects judged against the demo's truth; nothing else in the project reads the truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from scenefuse.demo.cameras import Cameras, read_cameras, visible
from scenefuse.io.clouds import read_cloud
from scenefuse.io.maps import read_depth
from scenefuse.metrics.truth import (
    CameraFit,
    Mesh,
    PosedModel,
    belongs_to_object,
    cast_together,
    distances,
    f_score,
    fit_cameras,
    mask_iou,
    nearest,
    read_mesh,
    read_posed,
    registration_error,
    sample_surface,
    true_depth,
)
from scenefuse.sfm.geodesy import LocalFrame
from scenefuse.stage import StageError, quantity, read_json, value, write_json
from scenefuse.transforms import Array, Sim3

# A sampled point counts as hidden when a surface lies farther than this before it, metres.
_HIDDEN = 0.02


def evaluate_scene(
    *,
    model: Path,
    georeference: Path,
    cloud: Path,
    truth: Path,
    evaluation: Path,
    samples: int,
    seed: int,
) -> None:
    """Judge a scene of the demo: cameras, georeferencing, dense cloud.

    The terrain counted for coverage is the surface of terrain and clutter inside the mapped area that at least three
    photos of the flight see; a sample is covered when the cloud has a point within three ground sampling distances.

    Args:
        model: georeferenced COLMAP model.
        georeference: its JSON; with an origin in it, the georeferencing itself is judged too.
        cloud: dense cloud in the model's frame, PLY.
        truth: the flight's truth folder.
        evaluation: output JSON; holds `truth_from_scene` (4x4), which the objects' evaluation reads.
        samples: points drawn from the true surface, and from the cloud for its distances to the truth.
        seed: of the drawing.

    Raises:
        StageError: the truth is missing, or knows fewer than three of the model's photos.
    """
    cameras = read_cameras(truth / "cameras.json")
    content = read_json(truth / "cameras.json")
    gsd = float(value(content, "ground_sampling_distance"))
    names = ["world", *content["objects"]]
    meshes = [read_mesh(truth / "meshes" / f"{name}.ply") for name in names]
    scene = cast_together(meshes)
    posed = read_posed(model, cameras)
    fit = fit_cameras(posed, cameras)
    points = fit.truth_from_model.apply(read_cloud(cloud).points)
    to_truth = distances(scene, _draw(points, samples, seed))
    low, high = (np.array(corner) for corner in value(content, "mapped_area"))
    ground = sample_surface(_within(meshes[0], low, high), samples, seed)
    seen = visible(scene, cameras, ground, _HIDDEN)[1].sum(0) >= 3
    covered = nearest(ground[seen], points) <= 3 * gsd
    result = {
        **_camera_results(fit, len(cameras.names)),
        "georeference_error_median": quantity(
            _georeference_error(read_json(georeference), content, posed, cameras), "m"
        ),
        "georeference_scale_error_pct": quantity(100 * abs(fit.truth_from_model.scale - 1), "%"),
        "ground_sampling_distance": quantity(gsd, "m"),
        "cloud_distance_median": quantity(float(np.median(to_truth)), "m"),
        "cloud_distance_90": quantity(float(np.quantile(to_truth, 0.9)), "m"),
        "cloud_distance_median_over_gsd": quantity(float(np.median(to_truth)) / gsd, "1"),
        "terrain_covered": quantity(float(covered.mean()), "1"),
        "truth_from_scene": quantity(fit.truth_from_model.matrix, "m"),
    }
    write_json(evaluation, result)
    _print(result)


@dataclass(frozen=True)
class ObjectTruth:
    """An object of the demo as it truly is, and the photos of its model placed in the truth; lengths in metres.

    Attributes:
        diagonal: of its bounding box.
        middle: (3,) of its bounding box.
        mesh: its surface.
        rest: terrain and clutter.
        everything: ray caster of the object, as mesh 0, and all else that stands there.
        orbit: the true cameras.
        posed: the photos of its model.
        fit: of their cameras to the true ones.
        surface: (N, 3) points spread over its surface.
        seen: (N,) those that any photo of the orbit sees.
    """

    diagonal: float
    middle: Array
    mesh: Mesh
    rest: Mesh
    everything: Any
    orbit: Cameras
    posed: PosedModel
    fit: CameraFit
    surface: Array
    seen: NDArray[np.bool_]


def read_object_truth(cameras: Path, truth_scene: Path, truth_object: Path, samples: int, seed: int) -> ObjectTruth:
    """The truth of an object and the poses of its model in it; arguments and errors as in `evaluate_object`."""
    orbit = read_cameras(truth_object / "cameras.json")
    extent = read_json(truth_object / "cameras.json")["object"]
    mesh, rest = read_mesh(truth_object / "mesh.ply"), read_mesh(truth_scene / "meshes" / "world.ply")
    others = [
        read_mesh(path)
        for path in sorted((truth_scene / "meshes").glob("*.ply"))
        if path.stem not in ("world", truth_object.name)
    ]
    everything = cast_together([mesh, rest, *others])
    posed = read_posed(cameras / "sparse", orbit)
    surface = sample_surface(mesh, samples, seed)
    return ObjectTruth(
        float(value(extent, "diagonal")),
        np.array(value(extent, "middle")),
        mesh,
        rest,
        everything,
        orbit,
        posed,
        fit_cameras(posed, orbit),
        surface,
        np.asarray(visible(everything, orbit, surface, _HIDDEN)[1].any(0)),
    )


def evaluate_object(
    *,
    cameras: Path,
    masks: Path,
    stages: list[Path],
    cloud: Path,
    variants: list[Path],
    alignment: Path | None,
    before: Path | None,
    after: Path | None,
    scene_evaluation: Path,
    truth_scene: Path,
    truth_object: Path,
    evaluation: Path,
    max_photos: int,
    samples: int,
    seed: int,
) -> None:
    """Judge an object of the demo: masks, cameras, depth after each stage, cloud, registration, completed scene.

    Definitions. Every length is over the diagonal of the object's true bounding box. The surface to be found is what
    of the object's true surface any photo of its orbit sees (for the scene's scores: any photo of the orbit or of the
    flight). `scene_f_score_before` and `_after` compare clouds in the scene's frame; of a cloud, the points count that
    lie in the object's true box, widened by 5 %, nearer to the object than to the terrain and the clutter. The error of
    each variant is that of its scene_from_object against the one that follows from the true cameras on both sides.

    Args:
        cameras: the object's undistorted COLMAP workspace.
        masks: folder of masks of its photos.
        stages: folders that hold depth_maps/, in order; empty for none.
        cloud: the object's cloud in its own frame.
        variants: fine.json of every variant, in a folder named for it; `full` first gives the main results.
        alignment: JSON of the alignment from shared features, judged like a variant, or nothing.
        before: scene cloud before fusion, scene frame; the whole scene or the object's surroundings.
        after: the same after fusion; absent when nothing was fused.
        scene_evaluation: what `evaluate_scene` wrote.
        truth_scene: the flight's truth folder.
        truth_object: the orbit's truth folder.
        evaluation: output JSON.
        max_photos: photos whose depth maps are judged, spread evenly.
        samples: points drawn from the true surface, and from a cloud for its distances to the truth.
        seed: of the drawing.

    Raises:
        StageError: a truth file is missing, or knows fewer than three of the model's photos.
    """
    known = read_object_truth(cameras, truth_scene, truth_object, samples, seed)
    orbit, mesh, diagonal = known.orbit, known.mesh, known.diagonal
    truth_from_object = known.fit.truth_from_model
    truth_from_scene = Sim3.from_matrix(np.array(value(read_json(scene_evaluation), "truth_from_scene")))

    flight = read_cameras(truth_scene / "cameras.json")
    by_any = known.seen | visible(known.everything, flight, known.surface, _HIDDEN)[1].any(0)
    to_find = known.surface[known.seen]
    object_points = read_cloud(cloud).points
    result: dict[str, Any] = {
        "diagonal": quantity(diagonal, "m"),
        **_mask_results(masks, known.posed, truth_object / "masks", orbit),
        **_camera_results(known.fit, len(orbit.names)),
        "camera_position_over_diagonal": quantity(float(np.median(known.fit.position)) / diagonal, "1"),
        **depth_results(stages, known, max_photos),
        **cloud_results(truth_from_object.apply(object_points), known, samples, seed),
    }
    true = truth_from_scene.inverse() @ truth_from_object
    middle_in_object = truth_from_object.inverse().apply(known.middle)
    scene_diagonal = diagonal / truth_from_scene.scale

    def judged(path: Path) -> dict[str, Any]:
        return _variant_results(
            read_json(path), true, middle_in_object, scene_diagonal, truth_from_scene, object_points, mesh,
            to_find, diagonal, samples, seed,
        )  # fmt: skip

    variant_results = {path.parent.name: judged(path) for path in variants}
    result |= next(iter(variant_results.values()), {})
    if alignment is not None:
        result |= {f"witness_{name}": entry for name, entry in judged(alignment).items() if name != "status"}
    result |= _scene_results(before, after, truth_from_scene, mesh, known.rest, known.surface[by_any], diagonal)
    result |= {"tau": quantity(0.01 * diagonal, "m"), "variants": variant_results}
    write_json(evaluation, result)
    _print(result)


def _camera_results(fit: CameraFit, total: int) -> dict[str, Any]:
    return {
        "registered_share": quantity(len(fit.position) / total, "1"),
        "camera_position_median": quantity(float(np.median(fit.position)), "m"),
        "camera_position_max": quantity(float(fit.position.max()), "m"),
        "camera_rotation_median_deg": quantity(float(np.median(fit.rotation_deg)), "degrees"),
        "camera_rotation_max_deg": quantity(float(fit.rotation_deg.max()), "degrees"),
    }


def _georeference_error(
    report: dict[str, Any], truth: dict[str, Any], posed: PosedModel, cameras: Cameras
) -> float | None:
    """Median distance of the georeferenced cameras from the true ones, nothing fitted; None without an origin."""
    keys = ("origin_latitude_deg", "origin_longitude_deg", "origin_altitude_m")
    if not all(key in report and value(report, key) is not None for key in keys):
        return None
    true_frame = LocalFrame(*(float(v) for v in value(truth, "origin")))
    scene_frame = LocalFrame(*(float(value(report, key)) for key in keys))
    expected = scene_frame.apply(true_frame.inverse(cameras.centres[posed.true]))
    return float(np.median(np.linalg.norm(posed.centres - expected, axis=1)))


def _mask_results(masks: Path, posed: PosedModel, true_masks: Path, orbit: Cameras) -> dict[str, Any]:
    """IoU of every mask; the true mask is brought into the undistorted photo by the two pinhole cameras."""
    scores = {}
    for k, name in enumerate(posed.names):
        mask = cv2.imread(str(masks / f"{Path(name).stem}.png"), cv2.IMREAD_GRAYSCALE)
        true = cv2.imread(str(true_masks / f"{Path(name).stem}.png"), cv2.IMREAD_GRAYSCALE)
        if true is None:
            raise StageError(f"{true_masks} has no mask for {name}; render the demo again")
        if mask is None:
            continue
        half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
        warp = half @ posed.intrinsics[k] @ np.linalg.inv(half @ orbit.intrinsics)
        warped = cv2.warpPerspective(true, warp, mask.shape[::-1], flags=cv2.INTER_LINEAR)
        scores[name] = mask_iou(mask > 127, warped > 127)
    ious = list(scores.values())
    return {
        "mask_iou_mean": quantity(float(np.mean(ious)) if ious else None, "1"),
        "mask_iou_min": quantity(min(ious, default=None), "1"),
        "mask_iou_worst": quantity(min(scores, key=lambda n: scores[n], default=None), ""),
        "masks_missing": quantity(len(posed.names) - len(ious), "1"),
    }


def depth_results(stages: list[Path], known: ObjectTruth, max_photos: int) -> dict[str, Any]:
    """Depth errors of every stage over pixels that truly show the object; a missing depth is outside the 1 %."""
    posed, truth_from_object = known.posed, known.fit.truth_from_model
    chosen = np.unique(np.linspace(0, len(posed.names) - 1, min(max_photos, len(posed.names))).astype(int))
    result: dict[str, Any] = {}
    for stage in stages:
        errors, pixels = [np.empty(0)], 0
        for k in chosen:
            path = stage / "depth_maps" / f"{posed.names[k]}.bin"
            if not path.is_file():
                continue
            depth = read_depth(path)
            size = depth.shape[1], depth.shape[0]
            true, hit = true_depth(known.everything, posed, int(k), truth_from_object, size)
            on_object = hit == 0
            pixels += int(on_object.sum())
            valid = on_object & (depth > 0)
            errors.append(np.abs(depth[valid] * truth_from_object.scale - true[valid]) / known.diagonal)
        error = np.concatenate(errors)
        result |= {
            f"{stage.name}_depth_error": quantity(float(np.median(error)) if len(error) else None, "diagonals"),
            f"{stage.name}_depth_within_1pct": quantity(float((error <= 0.01).sum()) / pixels if pixels else None, "1"),
            f"{stage.name}_depth_present": quantity(len(error) / pixels if pixels else None, "1"),
        }
    return result


def cloud_results(points: Array, known: ObjectTruth, samples: int, seed: int) -> dict[str, Any]:
    """Accuracy, completeness and F-scores of the object's cloud, in the truth's frame."""
    to_mesh = distances(known.mesh.caster(), _draw(points, samples, seed)) / known.diagonal
    to_cloud = nearest(known.surface[known.seen], points) / known.diagonal
    result = {
        "cloud_accuracy_median": quantity(100 * float(np.median(to_mesh)), "% of the diagonal"),
        "cloud_accuracy_90": quantity(100 * float(np.quantile(to_mesh, 0.9)), "% of the diagonal"),
    }
    for percent, label in ((0.5, "05"), (1.0, "1")):
        precision, recall, score = f_score(to_mesh, to_cloud, percent / 100)
        result[f"cloud_precision_{label}pct"] = quantity(precision, "1")
        result[f"cloud_completeness_{label}pct"] = quantity(recall, "1")
        result[f"cloud_f_score_{label}pct"] = quantity(score, "1")
    return result


def _variant_results(
    fine: dict[str, Any],
    true: Sim3,
    middle_in_object: Array,
    scene_diagonal: float,
    truth_from_scene: Sim3,
    points: Array,
    mesh: Mesh,
    surface: Array,
    diagonal: float,
    samples: int,
    seed: int,
) -> dict[str, Any]:
    """Errors of one variant's registration; empty values where it holds no transform."""
    matrix = fine.get("scene_from_object", {}).get("value")
    result = {"status": quantity(fine.get("status", {}).get("value"), "")}
    if matrix is None:
        for key in ("scale_error_pct", "rotation_error_deg", "translation_error_over_diagonal", "object_f_score"):
            result[key] = quantity(None, "")
        return result
    estimated = Sim3.from_matrix(np.array(matrix))
    error = registration_error(estimated, true, middle_in_object, scene_diagonal)
    placed = (truth_from_scene @ estimated).apply(points)
    to_mesh = distances(mesh.caster(), _draw(placed, samples, seed))
    score = f_score(to_mesh, nearest(surface, placed), 0.01 * diagonal)[2]
    return result | {
        "scale_error_pct": quantity(error.scale_pct, "%"),
        "rotation_error_deg": quantity(error.rotation_deg, "degrees"),
        "translation_error_over_diagonal": quantity(error.translation_over_diagonal, "1"),
        "object_f_score": quantity(score, "1"),
    }


def _scene_results(
    before: Path | None,
    after: Path | None,
    truth_from_scene: Sim3,
    mesh: Mesh,
    rest: Mesh,
    surface: Array,
    diagonal: float,
) -> dict[str, Any]:
    """F-score, precision and recall of the scene around the object before and after fusion, at 1 % and 2 %."""
    result: dict[str, Any] = {}
    to_object, to_rest = mesh.caster(), rest.caster()
    low, high = surface.min(0), surface.max(0)
    for label, path in (("before", before), ("after", after)):
        if path is None:
            continue
        points = truth_from_scene.apply(read_cloud(path).points)
        near = ((points >= low - 0.05 * diagonal) & (points <= high + 0.05 * diagonal)).all(1)
        points = points[near]
        own = distances(to_object, points) if len(points) else np.empty(0, dtype=np.float32)
        other = distances(to_rest, points) if len(points) else np.empty(0, dtype=np.float32)
        claims = belongs_to_object(points, own, other, low, high, 0.05 * diagonal)
        to_cloud = nearest(surface, points[claims])
        for share, suffix in ((0.01, ""), (0.02, "_2pct")):
            precision, recall, score = f_score(own[claims], to_cloud, share * diagonal)
            result[f"scene_f_score_{label}{suffix}"] = quantity(score, "1")
            result[f"scene_precision_{label}{suffix}"] = quantity(precision, "1")
            result[f"scene_recall_{label}{suffix}"] = quantity(recall, "1")
    return result


def _within(mesh: Mesh, low: Array, high: Array) -> Mesh:
    """The triangles whose middle lies in a rectangle on the ground."""
    middles = mesh.vertices[mesh.triangles].mean(1)[:, :2]
    return Mesh(mesh.vertices, mesh.triangles[((middles >= low) & (middles <= high)).all(1)])


def _draw(points: Array, count: int, seed: int) -> NDArray[np.float64]:
    """At most `count` of (N, 3) points, drawn evenly."""
    if len(points) <= count:
        return points
    return points[np.random.default_rng(seed).choice(len(points), count, replace=False)]


def _print(result: dict[str, Any]) -> None:
    for name, entry in result.items():
        if isinstance(entry.get("value"), float | int):
            print(f"{name}: {entry['value']:.5g} {entry['unit']}", flush=True)
