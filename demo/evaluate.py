"""The evaluation of the demo: how far a scene is from the truth, and an object's depth maps, cloud, registration and
fusion. Only this reads the truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from demo import truth
from scenefuse.cloud.clouds import Cloud, read_cloud, sampled, sampled_rows
from scenefuse.cloud.tiled_cloud import TiledCloud, open_cloud
from scenefuse.core.stage import quantity, read_json, value, write_json
from scenefuse.core.transforms import Array, Sim3, box_around
from scenefuse.fuse.write import after_fusion
from scenefuse.geometry.visual_hull import mask_iou
from scenefuse.mvs.undistort import undistort_picture
from scenefuse.photos.geodesy import LocalFrame, scene_frame
from scenefuse.photos.pictures import read_depth, read_gray
from scenefuse.photos.workspace import read_cameras, read_views

# Photos whose depth maps are compared, spread evenly.
COMPARED_PHOTOS = 8
# How far around the object's true box a scene's points count as its own, as a share of its diagonal: farther off than
# any stray point that a person would take for a part of it.
MARGIN = 0.05


def evaluate_scene(
    *,
    model: Path,
    georeference_json: Path,
    cloud: Path,
    truth_scene: Path,
    report: Path,
    seed: int,
    samples: int = truth.SAMPLES,
) -> None:
    """Compare a scene of the demo with its truth: cameras, georeferencing, dense cloud.

    The terrain counted for coverage is the surface of terrain and clutter inside the mapped area that at least three
    photos of the flight see; a sample is covered when the cloud has a point within three ground sampling distances.

    Args:
        model: georeferenced COLMAP model.
        georeference_json: its JSON; with an origin in it, the georeferencing itself is measured too.
        cloud: dense cloud in the model's frame, PLY.
        truth_scene: the flight's truth folder.
        report: output JSON; holds `truth_from_scene` (4x4), which the objects' evaluation reads.
        seed: of the drawing.
        samples: points drawn from the true surface, and from the cloud for its distances to the truth.

    Raises:
        StageError: the truth is missing, or knows fewer than three of the model's photos.
    """
    cameras = truth.read_cameras(truth_scene / "cameras.json")
    content = read_json(truth_scene / "cameras.json")
    meshes = [truth.read_mesh(truth_scene / "meshes" / f"{name}.ply") for name in ["world", *content["objects"]]]
    posed = truth.read_posed(model, cameras)
    fit = truth.fit_cameras(posed, cameras)
    georeference_error = _georeference_error(read_json(georeference_json), content, posed, cameras)
    result = {
        **truth.camera_results(fit, len(cameras.names)),
        "georeference_error_median": quantity(georeference_error, "m"),
        "georeference_scale_error_pct": quantity(100 * abs(fit.truth_from_model.scale - 1), "%"),
        **_cloud_results(open_cloud(cloud), fit.truth_from_model, content, meshes, cameras, samples, seed),
        "truth_from_scene": quantity(fit.truth_from_model.matrix, "m"),
    }
    write_json(report, result)
    truth.print_results(result)


def _cloud_results(
    cloud: TiledCloud,
    truth_from_cloud: Sim3,
    content: dict[str, Any],
    meshes: list[truth.Mesh],
    cameras: truth.Cameras,
    samples: int,
    seed: int,
) -> dict[str, Any]:
    """Distance of the cloud from the true surface, and the share of the terrain it covers."""
    gsd = float(value(content, "ground_sampling_distance"))
    scene = truth.cast_together(meshes)
    drawn = sampled_rows(len(cloud), samples, seed)
    to_truth = truth.distances(scene, truth_from_cloud.apply(cloud.rows(drawn).points))
    low, high = (np.array(corner) for corner in value(content, "mapped_area"))
    ground = truth.sample_surface(within(meshes[0], low, high), samples, seed)
    seen = truth.visible(scene, cameras, ground, truth.HIDDEN)[1].sum(0) >= 3
    covered = _covered(ground[seen], cloud, truth_from_cloud, 3 * gsd)
    return {
        "ground_sampling_distance": quantity(gsd, "m"),
        "cloud_distance_median": quantity(float(np.median(to_truth)), "m"),
        "cloud_distance_90": quantity(float(np.quantile(to_truth, 0.9)), "m"),
        "terrain_covered": quantity(float(covered.mean()), "1"),
    }


def _covered(ground: Array, cloud: TiledCloud, truth_from_cloud: Sim3, reach: float) -> NDArray[np.bool_]:
    """(M,) which of (M, 3) samples of the ground, in the truth's frame, have a point of the cloud within reach."""
    found = np.zeros(len(ground), dtype=bool)
    for _, part in cloud.parts():
        points = truth_from_cloud.apply(part.points)
        near = ((ground >= points.min(0) - reach) & (ground <= points.max(0) + reach)).all(1) & ~found
        found[near] = truth.nearest(ground[near], points) <= reach
    return found


def _georeference_error(
    report: dict[str, Any], content: dict[str, Any], posed: truth.Posed, cameras: truth.Cameras
) -> float | None:
    """Median distance of the georeferenced cameras from the true ones, nothing fitted; None without an origin."""
    frame = scene_frame(report)
    if not isinstance(frame, LocalFrame) or value(report, "origin_altitude_m") is None:
        return None
    latitude, longitude, altitude = value(content, "origin")
    true_frame = LocalFrame(latitude, longitude, altitude)
    expected = frame.apply(true_frame.inverse(cameras.centres[[true for _, true in posed]]))
    centres = np.array([view.centre for view, _ in posed])
    return float(np.median(np.linalg.norm(centres - expected, axis=1)))


def within(mesh: truth.Mesh, low: Array, high: Array) -> truth.Mesh:
    """The triangles whose middle lies in a rectangle on the ground."""
    middles = mesh.vertices[mesh.triangles].mean(1)[:, :2]
    return truth.Mesh(mesh.vertices, mesh.triangles[((middles >= low) & (middles <= high)).all(1)])


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
    mesh: truth.Mesh
    rest: truth.Mesh
    everything: Any
    orbit: truth.Cameras
    posed: truth.Posed
    fit: truth.CameraFit
    surface: Array
    seen: NDArray[np.bool_]


def read_object_truth(workspace: Path, truth_scene: Path, truth_object: Path, samples: int, seed: int) -> ObjectTruth:
    """The truth of an object and the poses of its model in it; arguments and errors as in `evaluate_object`."""
    orbit = truth.read_cameras(truth_object / "cameras.json")
    extent = read_json(truth_object / "cameras.json")["object"]
    mesh, rest = truth.read_mesh(truth_object / "mesh.ply"), truth.read_mesh(truth_scene / "meshes" / "world.ply")
    others = [
        truth.read_mesh(path)
        for path in sorted((truth_scene / "meshes").glob("*.ply"))
        if path.stem not in ("world", truth_object.name)
    ]
    everything = truth.cast_together([mesh, rest, *others])
    posed = truth.read_posed(workspace / "sparse", orbit)
    surface = truth.sample_surface(mesh, samples, seed)
    return ObjectTruth(
        float(value(extent, "diagonal")),
        np.array(value(extent, "middle")),
        mesh,
        rest,
        everything,
        orbit,
        posed,
        truth.fit_cameras(posed, orbit),
        surface,
        np.asarray(truth.visible(everything, orbit, surface, truth.HIDDEN)[1].any(0)),
    )


def depth_results(stages: list[Path], known: ObjectTruth, max_photos: int = COMPARED_PHOTOS) -> dict[str, Any]:
    """Depth errors of every stage over pixels that truly show the object; a missing depth is outside the 1 %."""
    posed, truth_from_object = known.posed, known.fit.truth_from_model
    chosen = np.unique(np.linspace(0, len(posed) - 1, min(max_photos, len(posed))).astype(int))
    result: dict[str, Any] = {}
    for stage in stages:
        errors, pixels = [np.empty(0)], 0
        for view in (posed[k][0] for k in chosen):
            path = stage / "depth_maps" / f"{view.name}.bin"
            if not path.is_file():
                continue
            depth = read_depth(path)
            size = depth.shape[1], depth.shape[0]
            true, hit = truth.true_depth(known.everything, view, truth_from_object, size)
            on_object = hit == 0
            pixels += int(on_object.sum())
            valid = on_object & (depth > 0)
            errors.append(np.abs(depth[valid] * truth_from_object.scale - true[valid]) / known.diagonal)
        error = np.concatenate(errors)
        result |= {
            f"{stage.name}_depth_error": quantity(float(np.median(error)) if len(error) else None, "diagonals"),
            f"{stage.name}_depth_within_1pct": quantity(float((error <= 0.01).sum()) / pixels if pixels else None, "1"),
        }
    return result


def cloud_results(points: Array, known: ObjectTruth, samples: int, seed: int) -> dict[str, Any]:
    """Accuracy, F-scores, precision and recall of the object's cloud (N, 3), in the truth's frame."""
    to_mesh = truth.distances(known.mesh.caster(), sampled(points, samples, seed)) / known.diagonal
    to_cloud = truth.nearest(known.surface[known.seen], points) / known.diagonal
    result = {
        "cloud_accuracy_median": quantity(100 * float(np.median(to_mesh)), "% of the diagonal"),
        "cloud_accuracy_90": quantity(100 * float(np.quantile(to_mesh, 0.9)), "% of the diagonal"),
    }
    for ending, scores in truth.scores_at(to_mesh, to_cloud, 1.0).items():
        result |= {f"cloud_{name}_{ending}": quantity(score, "1") for name, score in scores.items()}
    return result


def around_object(points: Array, known: ObjectTruth) -> NDArray[np.bool_]:
    """(N,) points of a scene (N, 3), in the truth's frame, in an object's box and nearer to it than to the rest.

    The box is that of the object's true surface, widened by MARGIN of its diagonal. The ground and clutter around the
    object thus count neither for nor against a cloud.
    """
    low, high, margin = known.surface.min(0), known.surface.max(0), MARGIN * known.diagonal
    near = ((points >= low - margin) & (points <= high + margin)).all(1)
    inside = np.flatnonzero(near)
    if len(inside):
        own, other = (truth.distances(mesh.caster(), points[inside]) for mesh in (known.mesh, known.rest))
        near[inside] = own < other
    return near


def scene_scores(points: Array, known: ObjectTruth, surface: Array) -> dict[str, dict[str, float]]:
    """F-score, precision and recall of a scene around the object, at every threshold; see `scores_at`.

    Args:
        points: (N, 3) the scene's points in the truth's frame.
        known: the object as it truly is.
        surface: (M, 3) what is to be found of the object's surface.
    """
    points = points[around_object(points, known)]
    to_mesh = truth.distances(known.mesh.caster(), points) if len(points) else np.empty(0, dtype=np.float32)
    return truth.scores_at(to_mesh, truth.nearest(surface, points), known.diagonal)


def surface_to_find(known: ObjectTruth, flight: truth.Cameras) -> Array:
    """(M, 3) what of the object's true surface any photo of its orbit or of the flight sees, in the truth's frame."""
    return known.surface[known.seen | truth.visible(known.everything, flight, known.surface, truth.HIDDEN)[1].any(0)]


@dataclass(frozen=True)
class EvaluationInputs:
    """What is compared, and the truth."""

    workspace: Path
    """COLMAP workspace whose poses are compared: the undistorted one, or with poses found without SfM."""
    sparse: Path
    """COLMAP model of its photos as they were taken."""
    undistorted: Path
    """COLMAP workspace of its undistorted photos, in which the masks were made."""
    cloud: Path
    """The object's cloud in its own frame."""
    variants: list[Path]
    """fine.json of every variant, in a folder named for it; `full` first gives the main results."""
    scene_json: Path
    """What `evaluate_scene` wrote."""
    truth_scene: Path
    """The flight's truth folder."""
    truth_object: Path
    """The orbit's truth folder."""
    masks: Path | None = None
    """Folder of masks of the undistorted photos, where there are some."""
    stages: tuple[Path, ...] = ()
    """Folders that hold depth_maps/, in order; none where the cloud was given."""
    scene: Path | None = None
    """Scene cloud before fusion, scene frame."""
    fused: Path | None = None
    """What fusion added, and the object's surroundings; absent when nothing was fused."""
    checked: Path | None = None
    """What fusion changed in the scene; as `fused`."""


def evaluate_object(*, inputs: EvaluationInputs, report: Path, seed: int, samples: int = truth.SAMPLES) -> None:
    """Compare an object with its truth: masks, cameras, depth after each stage, cloud, registration, completed scene.

    Definitions (method G8). Every length is over the diagonal of the object's true bounding box; F-score, precision and
    recall are at 0.25, 0.5, 1 and 2 % of it (`_025pct`, `_05pct`, `_1pct`, `_2pct`). The surface to be found is what of
    the object's true surface any photo of its orbit sees; for `scene_*`, any photo of the orbit or of the flight.
    `cloud_*` is the object's cloud, placed by its own cameras; `placed_*` is that cloud where a registration puts it;
    `scene_*_before` and `scene_*_after` are the scene around the object before and after fusion: its points in the
    object's true box, widened by 5 %, nearer to the object than to the terrain and the clutter. The error of each
    variant is that of its scene_from_object against the one that follows from the true cameras on both sides.

    Args:
        inputs: see EvaluationInputs.
        report: output JSON.
        seed: of the drawing.
        samples: points drawn from the true surface, and from a cloud for its distances to the truth.

    Raises:
        StageError: a truth file is missing, or knows fewer than three of the model's photos.
    """
    known = read_object_truth(inputs.workspace, inputs.truth_scene, inputs.truth_object, samples, seed)
    truth_from_scene = Sim3.from_matrix(np.array(value(read_json(inputs.scene_json), "truth_from_scene")))
    points = read_cloud(inputs.cloud).points
    result: dict[str, Any] = {
        "diagonal": quantity(known.diagonal, "m"),
        **({} if inputs.masks is None else _mask_results(inputs, inputs.masks)),
        **truth.camera_results(known.fit, len(known.orbit.names)),
        **depth_results(list(inputs.stages), known),
        **cloud_results(known.fit.truth_from_model.apply(points), known, samples, seed),
    }

    def errors_of(path: Path) -> dict[str, Any]:
        return _registration_results(read_json(path), known, truth_from_scene, points, samples, seed)

    variants = {path.parent.name: errors_of(path) for path in inputs.variants}
    result |= next(iter(variants.values()), {})
    flight = truth.read_cameras(inputs.truth_scene / "cameras.json")
    surface = surface_to_find(known, flight)
    for when, cloud in _around_object(inputs, known, truth_from_scene).items():
        for ending, scores in scene_scores(truth_from_scene.apply(cloud.points), known, surface).items():
            result |= {f"scene_{name}_{when}_{ending}": quantity(score, "1") for name, score in scores.items()}
    result["variants"] = variants
    write_json(report, result)
    truth.print_results(result)


def _around_object(inputs: EvaluationInputs, known: ObjectTruth, truth_from_scene: Sim3) -> dict[str, Cloud]:
    """The scene around the object before fusion, and after it, where there is one."""
    if inputs.scene is None:
        return {}
    scene, margin = open_cloud(inputs.scene), 2 * MARGIN * known.diagonal
    low, high = known.surface.min(0) - margin, known.surface.max(0) + margin
    box = box_around(low, high, truth_from_scene.inverse())
    found = {"before": scene.near(*box)[1]}
    if inputs.fused is not None and inputs.checked is not None:
        found["after"] = after_fusion(scene, inputs.checked, inputs.fused, *box)
    return found


def _mask_results(inputs: EvaluationInputs, masks: Path) -> dict[str, Any]:
    """IoU of every mask; the true mask takes the way of its photo, through the model's own camera, into the mask's."""
    ious: list[float] = []
    taken = read_cameras(inputs.sparse)
    for view in read_views(inputs.undistorted / "sparse"):
        path = masks / f"{Path(view.name).stem}.png"
        if not path.is_file():
            continue
        true = undistort_picture(read_gray(inputs.truth_object / "masks" / path.name), taken[view.name], view)
        ious.append(mask_iou(read_gray(path) > 127, true > 127))
    return {
        "mask_iou_mean": quantity(float(np.mean(ious)) if ious else None, "1"),
        "mask_iou_min": quantity(min(ious, default=None), "1"),
    }


def _registration_results(
    fine: dict[str, Any], known: ObjectTruth, truth_from_scene: Sim3, points: Array, samples: int, seed: int
) -> dict[str, Any]:
    """Errors of one registration of the cloud's points (N, 3), own frame; empty values where it holds no transform."""
    matrix = fine.get("scene_from_object", {}).get("value")
    result = {"status": quantity(fine.get("status", {}).get("value"), "")}
    if matrix is None:
        errors = ("scale_error_pct", "rotation_error_deg", "translation_error_over_diagonal")
        return result | {
            key: quantity(None, "") for key in (*errors, *(f"placed_f_score_{e}" for e in truth.THRESHOLDS))
        }
    estimated, truth_from_object = Sim3.from_matrix(np.array(matrix)), known.fit.truth_from_model
    true = truth_from_scene.inverse() @ truth_from_object
    middle = truth_from_object.inverse().apply(known.middle)
    error = truth.registration_error(estimated, true, middle, known.diagonal / truth_from_scene.scale)
    placed = (truth_from_scene @ estimated).apply(points)
    to_mesh = truth.distances(known.mesh.caster(), sampled(placed, samples, seed))
    scores = truth.scores_at(to_mesh, truth.nearest(known.surface[known.seen], placed), known.diagonal)
    return result | {
        "scale_error_pct": quantity(error.scale_pct, "%"),
        "rotation_error_deg": quantity(error.rotation_deg, "deg"),
        "translation_error_over_diagonal": quantity(error.translation_over_diagonal, "1"),
        **{f"placed_f_score_{ending}": quantity(score["f_score"], "1") for ending, score in scores.items()},
    }
