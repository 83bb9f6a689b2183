"""Photos without lens distortion, as dense reconstruction and training want them."""

from dataclasses import dataclass
from pathlib import Path

import pycolmap

from scenefuse.sfm.interrupt import cancellable
from scenefuse.stage import StageError, atomic_directory, manifest, quantity, setting, threads, write_json


@dataclass(frozen=True)
class UndistortSettings:
    """Size and quality of undistorted photos."""

    max_size_px: int = setting(2000, unit="px", least=0)
    """Longest side of an undistorted photo; larger ones are scaled down (method M4)."""
    jpeg_quality: int = setting(97, least=0)
    """Quality of undistorted JPEG files, 1 to 100."""


def undistort_photos(*, folder: Path, sparse: Path, dense: Path, report: Path, settings: UndistortSettings) -> None:
    """Write a COLMAP workspace: undistorted photos with PINHOLE cameras.

    Args:
        folder: folder of the original photos.
        sparse: COLMAP model of them.
        dense: output, workspace with images/, sparse/ and stereo/.
        report: output, JSON: sizes and the hashes of all files.
        settings: size and quality.

    Raises:
        StageError: a photo of the model is missing in the folder.
    """
    with atomic_directory(dense) as temporary:
        write_workspace(folder, sparse, temporary, settings)
    content = describe_workspace(dense)
    print(f"{content['photos']['value']} undistorted photos", flush=True)
    write_json(report, {**content, "files": quantity(manifest(dense), "")})


def write_workspace(folder: Path, sparse: Path, output: Path, settings: UndistortSettings) -> None:
    """Undistort into an existing empty folder."""
    model = pycolmap.Reconstruction(sparse)
    missing = [i.name for i in model.images.values() if i.has_pose and not (folder / i.name).is_file()]
    if missing:
        raise StageError(
            f"{len(missing)} photos of the model {sparse} are missing in {folder}, {missing[0]} for one; "
            f"put them back, or rerun from the photo list"
        )
    cancellable(
        pycolmap.undistort_images,
        output,
        sparse,
        folder,
        undistort_options=pycolmap.UndistortCameraOptions(max_image_size=settings.max_size_px),
        jpeg_quality=settings.jpeg_quality,
        num_threads=threads(),
    )
    for script in output.glob("run-colmap-*.sh"):
        script.unlink()


def describe_workspace(workspace: Path) -> dict[str, dict[str, object]]:
    """Photos, their sizes and focal lengths in an undistorted workspace, as quantities."""
    model = pycolmap.Reconstruction(workspace / "sparse")
    cameras = [c for _, c in sorted(model.cameras.items())]
    return {
        "photos": quantity(model.num_reg_images(), "1"),
        "sizes_px": quantity(sorted({(c.width, c.height) for c in cameras}), "px"),
        "focal_px": quantity([round(float(c.mean_focal_length()), 3) for c in cameras], "px"),
        "points": quantity(model.num_points3D(), "1"),
    }
