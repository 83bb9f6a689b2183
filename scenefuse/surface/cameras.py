"""The cameras of a scene and of its objects together in the scene's frame, for who textures or draws elsewhere."""

import os
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj

from scenefuse.cloud.crs import has_place, plane, unit_m
from scenefuse.core.stage import atomic_directory, read_json, write_json
from scenefuse.core.transforms import Array
from scenefuse.photos.geodesy import GridFrame, LocalFrame, scene_frame
from scenefuse.photos.workspace import View, write_model
from scenefuse.surface.gltf import map_about
from scenefuse.surface.make_surface import SurfaceInputs, placed_views

# Cameras of OpenGL and nerfstudio look along -z, with y up.
OPENGL_FROM_OPENCV = np.diag([1.0, -1, -1, 1])


def export_cameras(
    *, scene_workspace: Path | None = None, objects: list[Path], georeference_json: Path | None = None, folder: Path
) -> None:
    """Write all cameras as a COLMAP model, as transforms.json (nerfstudio) and as cameras.xml (Metashape).

    They are those of undistorted photos, named by their paths: in the model from the folder of `objects/` and
    `scenes/`, in transforms.json from its own; in cameras.xml by their names alone. Objects without photos or without
    a place in the scene have no cameras there.

    Args:
        scene_workspace: the scene's undistorted COLMAP workspace, where it has photos.
        objects: result folders of its objects.
        georeference_json: JSON of the scene, for its place in the world.
        folder: output.
    """
    found = [] if scene_workspace is None else placed_views(SurfaceInputs(Path(), None, None, scene_workspace))
    for path in objects:
        own = path / "undistorted"
        if own.is_dir():
            found += placed_views(SurfaceInputs(path / "fused.ply", path / "fusion.json", own))
    if not found:
        print("no cameras: neither the scene nor an object with a place in it has photos", flush=True)
    root = folder.resolve().parents[2]
    frames, views = list[dict[str, Any]](), []
    for workspace, view in found:
        photo = (workspace / "images" / view.name).resolve()
        views.append(replace(view, name=os.path.relpath(photo, root)))
        k = view.intrinsics
        lens = {"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "w": view.width, "h": view.height}
        pose = (view.world_from_cam @ OPENGL_FROM_OPENCV).tolist()
        frames.append({"file_path": os.path.relpath(photo, folder.resolve()), **lens, "transform_matrix": pose})
    with atomic_directory(folder) as output:
        write_model(output, views)
        write_json(output / "transforms.json", {"camera_model": "PINHOLE", "frames": frames})
        frame = None if georeference_json is None else scene_frame(read_json(georeference_json))
        ET.ElementTree(_metashape(views, frame)).write(output / "cameras.xml", encoding="utf-8", xml_declaration=True)


def _metashape(views: list[View], frame: LocalFrame | GridFrame | None) -> ET.Element:
    """What Metashape's "Import Cameras" reads: a sensor a camera, poses in the scene's frame, and that on the Earth."""
    document = ET.Element("document", version="2.0.0")
    chunk = ET.SubElement(document, "chunk", label="scenefuse", enabled="true")
    sensors, cameras = ET.SubElement(chunk, "sensors"), ET.SubElement(chunk, "cameras")
    for number, view in enumerate(views):
        label, key = Path(view.name).stem, str(number)
        size = {"width": str(view.width), "height": str(view.height)}
        sensor = ET.SubElement(sensors, "sensor", id=key, label=label, type="frame")
        ET.SubElement(sensor, "resolution", size)
        calibration = ET.SubElement(sensor, "calibration", {"type": "frame", "class": "adjusted"})
        ET.SubElement(calibration, "resolution", size)
        k = view.intrinsics
        lens = {"f": k[1, 1], "b1": k[0, 0] - k[1, 1], "cx": k[0, 2] - view.width / 2, "cy": k[1, 2] - view.height / 2}
        for name, number_px in lens.items():
            ET.SubElement(calibration, name).text = repr(float(number_px))
        camera = ET.SubElement(cameras, "camera", id=key, sensor_id=key, label=label, enabled="true")
        ET.SubElement(camera, "transform").text = _numbers(view.world_from_cam)
    if views and frame is not None and frame.crs is not None and has_place(frame.crs):
        crs = pyproj.CRS.from_user_input(frame.crs)
        earth = _earth_from_scene(frame, crs, np.mean([view.centre for view in views], axis=0))
        scale = float(np.cbrt(np.linalg.det(earth[:3, :3])))
        transform = ET.SubElement(chunk, "transform")
        ET.SubElement(transform, "rotation").text = _numbers(earth[:3, :3] / scale)
        ET.SubElement(transform, "translation").text = _numbers(earth[:3, 3])
        ET.SubElement(transform, "scale").text = repr(scale)
        # Its heights lie above the ellipsoid: those of a geoid would be computed once more.
        ET.SubElement(chunk, "reference").text = plane(crs).to_wkt("WKT1_GDAL")
    return document


def _earth_from_scene(frame: LocalFrame | GridFrame, crs: pyproj.CRS, about: Array) -> Array:
    """(4, 4) from a scene's frame in a CRS to Earth-centred coordinates (m) on that CRS's own datum, which Metashape
    takes them to be on; right at a place (3,) of the scene."""
    grid = plane(crs).source_crs if plane(crs).is_bound else plane(crs)
    assert grid is not None and grid.geodetic_crs is not None
    axes = pyproj.CRS.from_epsg(4978).to_json_dict()["coordinate_system"]
    datum = grid.geodetic_crs.to_json_dict() | {"type": "GeodeticCRS", "coordinate_system": axes}
    datum.pop("id", None)
    to_earth = pyproj.Transformer.from_crs(grid.to_3d(), pyproj.CRS.from_json_dict(datum), always_xy=True)
    return map_about(about, lambda points: to_earth.transform(*(frame.in_crs(points) * [1, 1, unit_m(crs)]).T))


def _numbers(values: Array) -> str:
    """Numbers as XML holds them, row after row."""
    return " ".join(repr(float(number)) for number in np.ravel(values))
