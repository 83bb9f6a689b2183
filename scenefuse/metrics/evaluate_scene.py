"""The demo's scene compared with the demo's truth; only the evaluation reads the truth."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import sampled_rows
from scenefuse.cloud.tiled_cloud import TiledCloud, open_cloud
from scenefuse.core.stage import quantity, read_json, value, write_json
from scenefuse.core.transforms import Array, Sim3
from scenefuse.metrics.truth import (
    HIDDEN,
    SAMPLES,
    Cameras,
    Mesh,
    Posed,
    camera_results,
    cast_together,
    distances,
    fit_cameras,
    nearest,
    print_results,
    read_cameras,
    read_mesh,
    read_posed,
    sample_surface,
    visible,
)
from scenefuse.photos.geodesy import LocalFrame, scene_frame


def evaluate_scene(
    *,
    model: Path,
    georeference_json: Path,
    cloud: Path,
    truth: Path,
    report: Path,
    seed: int,
    samples: int = SAMPLES,
) -> None:
    """Compare a scene of the demo with its truth: cameras, georeferencing, dense cloud.

    The terrain counted for coverage is the surface of terrain and clutter inside the mapped area that at least three
    photos of the flight see; a sample is covered when the cloud has a point within three ground sampling distances.

    Args:
        model: georeferenced COLMAP model.
        georeference_json: its JSON; with an origin in it, the georeferencing itself is measured too.
        cloud: dense cloud in the model's frame, PLY.
        truth: the flight's truth folder.
        report: output JSON; holds `truth_from_scene` (4x4), which the objects' evaluation reads.
        seed: of the drawing.
        samples: points drawn from the true surface, and from the cloud for its distances to the truth.

    Raises:
        StageError: the truth is missing, or knows fewer than three of the model's photos.
    """
    cameras = read_cameras(truth / "cameras.json")
    content = read_json(truth / "cameras.json")
    meshes = [read_mesh(truth / "meshes" / f"{name}.ply") for name in ["world", *content["objects"]]]
    posed = read_posed(model, cameras)
    fit = fit_cameras(posed, cameras)
    georeference_error = _georeference_error(read_json(georeference_json), content, posed, cameras)
    result = {
        **camera_results(fit, len(cameras.names)),
        "georeference_error_median": quantity(georeference_error, "m"),
        "georeference_scale_error_pct": quantity(100 * abs(fit.truth_from_model.scale - 1), "%"),
        **_cloud_results(open_cloud(cloud), fit.truth_from_model, content, meshes, cameras, samples, seed),
        "truth_from_scene": quantity(fit.truth_from_model.matrix, "m"),
    }
    write_json(report, result)
    print_results(result)


def _cloud_results(
    cloud: TiledCloud, truth_from_cloud: Sim3, content: dict[str, Any], meshes: list[Mesh], cameras: Cameras,
    samples: int, seed: int,
) -> dict[str, Any]:  # fmt: skip
    """Distance of the cloud from the true surface, and the share of the terrain it covers."""
    gsd = float(value(content, "ground_sampling_distance"))
    scene = cast_together(meshes)
    drawn = sampled_rows(len(cloud), samples, seed)
    to_truth = distances(scene, truth_from_cloud.apply(cloud.rows(drawn).points))
    low, high = (np.array(corner) for corner in value(content, "mapped_area"))
    ground = sample_surface(within(meshes[0], low, high), samples, seed)
    seen = visible(scene, cameras, ground, HIDDEN)[1].sum(0) >= 3
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
        found[near] = nearest(ground[near], points) <= reach
    return found


def _georeference_error(report: dict[str, Any], truth: dict[str, Any], posed: Posed, cameras: Cameras) -> float | None:
    """Median distance of the georeferenced cameras from the true ones, nothing fitted; None without an origin."""
    frame = scene_frame(report)
    if not isinstance(frame, LocalFrame) or value(report, "origin_altitude_m") is None:
        return None
    latitude, longitude, altitude = value(truth, "origin")
    true_frame = LocalFrame(latitude, longitude, altitude)
    expected = frame.apply(true_frame.inverse(cameras.centres[[true for _, true in posed]]))
    centres = np.array([view.centre for view, _ in posed])
    return float(np.median(np.linalg.norm(centres - expected, axis=1)))


def within(mesh: Mesh, low: Array, high: Array) -> Mesh:
    """The triangles whose middle lies in a rectangle on the ground."""
    middles = mesh.vertices[mesh.triangles].mean(1)[:, :2]
    return Mesh(mesh.vertices, mesh.triangles[((middles >= low) & (middles <= high)).all(1)])
