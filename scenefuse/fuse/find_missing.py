"""What an object still lacks after fusion, and the photos that would close most of it."""

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.cloud.clouds import Cloud, read_cloud, voxel_downsample, write_cloud
from scenefuse.cloud.crs import has_place
from scenefuse.cloud.readers.columns import AT_ONCE
from scenefuse.cloud.tiled_cloud import open_cloud
from scenefuse.core.machine import use_threads
from scenefuse.core.stage import atomic_file, quantity, read_json, threads, value, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.fuse.fuse_object import photos_of
from scenefuse.fuse.measure import RESOLUTION, with_normals
from scenefuse.fuse.missing import NEAR, Lack, Missing, Plan, find_missing_surface, plan_stations, reach_of_stations
from scenefuse.fuse.surroundings import missing_ground
from scenefuse.fuse.write import added_by, read_changes, together
from scenefuse.geometry.photo_check import Photos
from scenefuse.photos.geodesy import GridFrame, LocalFrame, compass, scene_frame
from scenefuse.photos.workspace import View, with_mask

POSITION = ("longitude_deg", "latitude_deg", "altitude_m")


@dataclass(frozen=True)
class MissingInputs:
    """What the search for missing surface reads."""

    object: Path
    """Object cloud (PLY) in its own frame."""
    scene: Path
    """Dense scene cloud (PLY)."""
    fused: Path
    """PLY of the fusion: what it added."""
    checked: Path
    """PLY of the fusion: what it changed in the scene."""
    fusion_json: Path
    """JSON of the fusion: where the object settled in the scene."""
    georeference_json: Path
    """JSON with `crs` and the scene's origin, if it has one."""
    object_workspace: Path | None = None
    """The object's undistorted COLMAP workspace; without it nothing is looked for."""
    scene_workspace: Path | None = None
    """The scene's, in the frame of its cloud, where it has photos."""
    masks: Path | None = None
    """Folder of the object's masks, {photo}.png; without them only points of the object's cloud are looked at."""


@dataclass(frozen=True)
class MissingOutputs:
    """What it writes."""

    missing: Path
    """PLY, scene frame: the middles of the missing cells, `missing` 1 never seen, 2 untextured, 3 contradicted."""
    next_photos: Path
    """CSV, a row for each photo that would help: where to stand and where to look."""
    geojson: Path
    """GeoJSON of the same, WGS84; without features where the scene is not georeferenced."""
    report: Path
    """JSON: shares of the object's surface, what the photos would close, notes."""


def find_missing(*, inputs: MissingInputs, outputs: MissingOutputs) -> None:
    """Find the surface of a fused object that no photo confirms, and the camera positions that would show most of it
    (method F5, F6); of an unregistered object, and of one without photos, nothing is written but the reason.

    Args:
        inputs: see MissingInputs.
        outputs: see MissingOutputs.
    """
    use_threads(threads())
    fusion = read_json(inputs.fusion_json)
    if value(fusion, "status") != "fused" or inputs.object_workspace is None:
        nothing = Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32), None, {"missing": np.zeros(0, np.uint8)})
        write_cloud(outputs.missing, nothing)
        _write_table(outputs.next_photos, [])
        _write_geojson(outputs.geojson, [])
        status, reason = "unregistered", value(fusion, "reason")
        if value(fusion, "status") == "fused":
            status, reason = (
                "not_looked_for",
                "the object has no photos: surface that none of them confirms is not looked for",
            )
        write_json(outputs.report, {"status": quantity(status, ""), "reason": quantity(reason, "")})
        return
    obj, photos, masks = _in_scene(
        inputs, inputs.object_workspace, Sim3.from_matrix(np.array(value(fusion, "scene_from_object")))
    )
    cameras = masks or photos[0].views
    views = photos[0].views + photos[1].views
    near, around_it = _surroundings(inputs, obj, views, reach_of_stations(obj, cameras) if cameras else 0.0)
    missing = find_missing_surface(obj, near, photos, masks)
    plan = plan_stations(missing, obj, around_it, cameras)
    write_cloud(outputs.missing, missing.cells)
    georeference = read_json(inputs.georeference_json)
    gps_higher = float(value(georeference, "gps_shift")[2]) if "gps_shift" in georeference else 0.0
    if "heights" in georeference and value(georeference, "heights") == "relative":
        gps_higher = np.nan
    unit = value(georeference, "length_unit")
    # Stray points lie below an object's foot.
    foot = float(np.percentile(obj.points[:, 2], 0.5))
    rows = photo_rows(plan, foot, scene_frame(georeference), gps_higher, unit)
    _write_table(outputs.next_photos, rows)
    _write_geojson(outputs.geojson, rows)
    content = _report(missing, plan) | {
        "ground_missing": quantity(missing_ground(obj, near, photos), "of the ground beside it that photos show"),
        "cell": quantity(missing.side, unit),
        "of": quantity("its surface" if masks else "what its own cloud holds", ""),
    }
    write_json(outputs.report, content)


def _surroundings(inputs: MissingInputs, obj: Cloud, views: list[View], reach: float) -> tuple[Cloud, Cloud]:
    """The scene after fusion within a diagonal of the object, with normals; and the same as far as `reach`. `views` are
    the photos of both.

    What is farther off is thinned to a quarter of a camera's clearance, without normals, part by part.
    """
    scene, changes, added = open_cloud(inputs.scene), read_changes(inputs.checked), added_by(inputs.fused)
    low, high, beside = obj.points.min(0), obj.points.max(0), obj.diagonal
    near = with_normals(together(changes.left_of(*scene.near(low - beside, high + beside)), added), views)
    tiles, far = scene.touching(low - reach, high + reach), [near.points]
    for some in np.array_split(tiles, 1 + np.diff(scene.starts)[tiles].sum() // AT_ONCE):
        points = changes.left_of(*scene.read(some)).points
        outside = ((points < low - beside) | (points > high + beside)).any(1)
        far.append(voxel_downsample(Cloud(points[outside]), NEAR * obj.diagonal / 4).points)
    normals = np.zeros((sum(map(len, far)), 3), np.float32)
    normals[: len(near)] = near.normals
    return near, Cloud(np.concatenate(far), normals)


def _in_scene(inputs: MissingInputs, workspace: Path, pose: Sim3) -> tuple[Cloud, tuple[Photos, Photos], list[View]]:
    """The object's cloud, the photos of both sides, and the object's masks, all in the scene's frame."""
    own = read_cloud(inputs.object)
    photos = photos_of(workspace, own.points, pose), photos_of(inputs.scene_workspace, pose.apply(own.points))
    obj = with_normals(own.transformed(pose), photos[0].views + photos[1].views)
    if inputs.masks is None:
        return obj, photos, []
    views = [(view, inputs.masks / f"{Path(view.name).stem}.png") for view in photos[0].views]
    return obj, photos, [_silhouette(view, path) for view, path in views if path.is_file()]


def _silhouette(view: View, path: Path) -> View:
    """The view with its mask, its longer side four pixels to a cell of the object's surface."""
    small = with_mask(view, path).at_most(round(4 / RESOLUTION))
    return replace(small, pixels=small.pixels > 127)


def _report(missing: Missing, plan: Plan) -> dict[str, Any]:
    """Shares of the object's surface, and what the stations would close, with units."""
    shares = {kind.name.lower(): missing.share(kind) for kind in Lack}
    return {
        "status": quantity("found", ""),
        "missing": quantity(sum(shares.values()), "of the object's surface"),
        "plain": quantity(missing.plain, "of the object's surface"),
        **{name: quantity(share, "of the object's surface") for name, share in shares.items()},
        "stations": quantity(len(plan.stations), ""),
        "stations_show": quantity(sum(station.shows for station in plan.stations), "of never seen and contradicted"),
        "reachable": quantity(plan.reachable, "of never seen and contradicted"),
        "notes": quantity(list(missing.notes), ""),
    }


def photo_rows(
    plan: Plan, foot: float, frame: LocalFrame | GridFrame | None, gps_higher: float = 0.0, unit: str = "m"
) -> list[dict[str, Any]]:
    """A row for each photo; heading clockwise from north (from y without georeferencing), pitch above level.

    Args:
        plan: the stations.
        foot: height of the object's lowest part.
        frame: where the scene lies; None where nothing says it.
        gps_higher: metres by which the flight's GPS counts heights higher than the scene; NaN where it counts none.
        unit: of the scene's lengths.
    """
    rows, unit = [], unit.replace(" ", "_")
    for number, station in enumerate(plan.stations, 1):
        for view in station.photos:
            east, north, up = view.cam_from_world[2, :3]
            row: dict[str, Any] = {"station": number, "photo": int(view.name)}
            if frame is not None and has_place(frame.crs):
                there = frame.inverse(np.stack([view.centre, view.centre + [east, north, 0]]))
                latitude, longitude, altitude = there[0]
                north, east = (there[1] - there[0])[:2] * [1, np.cos(np.radians(latitude))]
                row |= {"longitude_deg": round(longitude, 8), "latitude_deg": round(latitude, 8)}
                row |= {"altitude_m": round(altitude + gps_higher, 3)} if np.isfinite(gps_higher) else {}
            row[f"above_foot_{unit}"] = float(f"{view.centre[2] - foot:.4g}")
            row["heading_deg"] = round(float(np.degrees(np.arctan2(east, north))) % 360, 1)
            row |= {"looking": compass(row["heading_deg"])} if frame is not None and frame.crs is not None else {}
            row["pitch_deg"] = round(float(np.degrees(np.arcsin(np.clip(up, -1, 1)))), 1)
            # Said once: the three photos show it together.
            row["station_shows_percent_of_missing"] = round(100 * station.shows, 1) if view is station.photos[0] else ""
            rows.append(row | {f"local_{axis}_{unit}": float(f"{at:.7g}") for axis, at in zip("xyz", view.centre)})
    return rows


def _write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    """CSV of the photos; a heading alone where there are none."""
    columns = list(rows[0]) if rows else ["station", "photo"]
    with atomic_file(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


def _write_geojson(path: Path, rows: list[dict[str, Any]]) -> None:
    """RFC 7946: points with longitude, latitude, height; no features where the scene is not georeferenced."""
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [row[k] for k in POSITION if k in row]},
            "properties": {k: v for k, v in row.items() if k not in POSITION and not k.startswith("local_")},
        }
        for row in rows
        if POSITION[0] in row
    ]
    write_json(path, {"type": "FeatureCollection", "features": features})
