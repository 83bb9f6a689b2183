"""The cameras of a scene and of its objects together in the scene's frame, for who textures or draws elsewhere."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scenefuse.core.stage import StageError, atomic_directory, write_json
from scenefuse.photos.workspace import write_model
from scenefuse.surface.make_surface import SurfaceInputs, placed_views

# Cameras of OpenGL and nerfstudio look along -z, with y up.
OPENGL_FROM_OPENCV = np.diag([1.0, -1, -1, 1])


def export_cameras(*, scene_workspace: Path | None = None, objects: list[Path], folder: Path) -> None:
    """Write all cameras as a COLMAP model and as transforms.json (nerfstudio), of undistorted photos.

    Photos are named by their paths: in the model from the folder of `objects/` and `scenes/`, in transforms.json from
    its own. Objects without photos or without a place in the scene have no cameras there.

    Args:
        scene_workspace: the scene's undistorted COLMAP workspace, where it has photos.
        objects: result folders of its objects.
        folder: output.

    Raises:
        StageError: neither the scene nor an object in it has photos.
    """
    found = [] if scene_workspace is None else placed_views(SurfaceInputs(Path(), None, None, scene_workspace))
    for path in objects:
        own = path / "undistorted"
        if own.is_dir():
            found += placed_views(SurfaceInputs(path / "fused.ply", path / "fusion.json", own))
    if not found:
        raise StageError("neither the scene nor an object in it has photos: there are no cameras to export")
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
