"""An object's cameras: undistorted frames with PINHOLE cameras, and which way is up in their frame."""

import shutil
from pathlib import Path

import numpy as np
import pycolmap

from scenefuse.sfm.georeference import camera_poses
from scenefuse.sfm.gravity import estimate_up, roll_spread_deg
from scenefuse.sfm.mapping import describe
from scenefuse.sfm.photos import read_photos
from scenefuse.sfm.undistort import UndistortSettings, describe_workspace, write_workspace
from scenefuse.stage import atomic_directory, manifest, quantity, write_json


def undistort_object(
    *, folder: Path, photos: Path, sparse: Path, cameras: Path, report: Path, settings: UndistortSettings
) -> None:
    """Undistort an object's frames and record its cameras.

    Args:
        folder: folder of frames.
        photos: JSON list of them.
        sparse: COLMAP model of the frames; its world is the object's camera frame.
        cameras: output, COLMAP workspace with images/ and sparse/ (PINHOLE).
        report: output, JSON: up direction, share of frames registered, reprojection error, hashes of all files.
        settings: size and quality of undistorted frames.
    """
    model = pycolmap.Reconstruction(sparse)
    _, rotations, centres = camera_poses(model)
    up, cue = estimate_up(rotations, centres)
    with atomic_directory(cameras) as temporary:
        write_workspace(folder, sparse, temporary, settings)
        shutil.rmtree(temporary / "stereo", ignore_errors=True)
    summary = describe(model, [p.name for p in read_photos(photos)])
    workspace = describe_workspace(cameras)
    roll_deg = roll_spread_deg(rotations, up)
    print(f"up in the camera frame: {np.round(up, 3)} from {cue}, median roll {roll_deg:.2f} deg", flush=True)
    kept = ("registered", "total", "registered_share", "mean_reprojection_error_px", "points", "not_registered")
    content = {
        "up_in_camera_frame": quantity(up, "1"),
        "up_cue": quantity(cue, ""),
        "camera_roll_median_deg": quantity(roll_deg, "deg"),
        **{name: summary[name] for name in kept},
        "sizes_px": workspace["sizes_px"],
        "focal_px": workspace["focal_px"],
        "files": quantity(manifest(cameras), ""),
    }
    write_json(report, content)
