"""Camera poses of an object's photos without SfM: from matches and a depth network, closed and refined together."""

import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.depth.train_depth import device, prepare_torch
from scenefuse.poses.baselines import ScaleTraining, learn_lengths
from scenefuse.poses.bundle_adjustment import Refined, link, refine
from scenefuse.poses.correspondences import Features, find_features, find_pairs
from scenefuse.poses.pose_graph import chain, close, largest_group
from scenefuse.sfm.gravity import estimate_up
from scenefuse.stage import StageError, atomic_directory, quantity, setting, write_json
from scenefuse.transforms import Sim3, fit_sim3, rotation_angle_deg, rotation_between

Array = NDArray[np.float64]
Content = dict[str, Any]


@dataclass(frozen=True)
class PoseSettings:
    """How poses are found without SfM."""

    feature_width_px: int = setting(960, unit="px", least=64)
    """Width at which features are found in the photos, pixels."""
    features: int = setting(2000, least=50)
    """Most features of a photo."""
    max_ratio: float = setting(0.8, above=0, most=1)
    """A match's distance over that of the next best feature."""
    max_epipolar_px: float = setting(1, unit="px", above=0)
    """Largest distance of a match from its epipolar line, pixels."""
    min_matches: int = setting(30, least=8)
    """Fewest matches that make a pair of photos."""
    min_angle_deg: float = setting(1.5, unit="degrees", above=0, most=30)
    """Two rays that meet under a smaller angle have no depth, degrees."""
    network_width_px: int = setting(64, unit="px", least=32)
    """Width at which the depth network sees the photos, pixels."""
    steps: int = setting(150, least=0)
    """Training steps of the depth network, each over all photos."""
    learning_rate: float = setting(0.005, above=0)
    """Maximum learning rate of Adam."""
    smoothness_weight: float = setting(0.001, least=0)
    """Weight of the edge-aware smoothness of disparity."""
    refine_focal: bool = setting(True)
    """Whether the focal length is refined together with the poses."""


@dataclass(frozen=True)
class Workspace:
    """The V photos of an undistorted workspace, in name order.

    Attributes:
        names: file names.
        images: (H, W, 3) uint8 RGB each.
        cameras: PINHOLE camera of each photo.
        intrinsics: (V, 3, 3), pixels of `images`.
        object_from_cam: (V, 4, 4) poses of SfM, or None when the workspace was made without SfM (it has no points).
    """

    names: list[str]
    images: list[NDArray[np.uint8]]
    cameras: list[pycolmap.Camera]
    intrinsics: Array
    object_from_cam: Array | None


def find_poses(
    *,
    cameras: Path,
    posed: Path,
    report: Path,
    settings: PoseSettings,
    seed: int,
) -> None:
    """Give the photos of a workspace other poses than SfM's (method N11); the training stages read the result instead.

    Only the workspace's photos and intrinsics are used. SIFT matches give every pair of photos its relative pose up to
    the baseline's length (essential matrix); a depth network trained on these photos, from scratch, gives the lengths;
    the chain of the best pairs is closed over all pairs; and all poses, matched points and (if asked) the focal length
    are refined together. Where the workspace has poses of SfM, the result is brought into their frame by one
    similarity, because masks and registration count in that frame, and the error of the trajectory that is left is
    reported; else it gets its own frame: z up, the median depth 1.

    Args:
        cameras: undistorted COLMAP workspace of the object; without SfM: any poses, no points.
        posed: output, workspace with the same photos, PINHOLE cameras, poses, points and their tracks.
        report: output JSON; holds `up_in_camera_frame` like that of the cameras stage.
        settings: of the search.
        seed: of the network's weights.

    Raises:
        StageError: fewer than three photos share enough matches.
    """
    start = time.monotonic()
    prepare_torch(seed)
    with atomic_directory(posed) as folder:
        shutil.copytree(
            cameras, folder, ignore=shutil.ignore_patterns("sparse", ".snakemake_timestamp"), dirs_exist_ok=True
        )
        (folder / "sparse").mkdir()
        content = _find(read_workspace(cameras), folder / "sparse", settings)
    write_json(report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    print(f"poses of {content['photos_with_pose']['value']} photos", flush=True)


def read_workspace(cameras: Path) -> Workspace:
    """Photos and cameras of an undistorted COLMAP workspace."""
    model = pycolmap.Reconstruction(cameras / "sparse")
    images = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    of_photo = [model.cameras[image.camera_id] for image in images]
    pictures = [cv2.imread(str(cameras / "images" / image.name), cv2.IMREAD_COLOR) for image in images]
    for image, picture in zip(images, pictures):
        if picture is None:
            raise StageError(f"{cameras}/images/{image.name} cannot be read; rerun the cameras stage")
    if len({picture.shape for picture in pictures if picture is not None}) > 1:
        raise StageError(f"the photos in {cameras}/images have different sizes; use photos of one camera at one size")
    return Workspace(
        [image.name for image in images],
        [np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8) for picture in pictures if picture is not None],
        of_photo,
        np.array([camera.calibration_matrix() for camera in of_photo]),
        np.array([_matrix(image.cam_from_world().inverse()) for image in images]) if model.points3D else None,
    )


def _find(workspace: Workspace, folder: Path, settings: PoseSettings) -> Content:
    large, of_large = _resized(workspace, settings.feature_width_px)
    features = [find_features(image, k, settings.features) for image, k in zip(large, of_large)]
    limits = (settings.max_ratio, settings.max_epipolar_px, settings.min_matches, settings.min_angle_deg)
    pairs = list(find_pairs(features, *limits))
    together = largest_group(len(features), pairs)
    print(f"{len(pairs)} pairs join {len(together)} of {len(features)} photos", flush=True)
    _check(together, features, settings.min_matches)
    place = {int(photo): index for index, photo in enumerate(together)}
    pairs = [replace(p, first=place[p.first], second=place[p.second]) for p in pairs if p.first in place]
    joined = _only(workspace, together)
    features = [features[photo] for photo in together]
    small, of_small = _resized(joined, settings.network_width_px)
    training = ScaleTraining(settings.steps, settings.learning_rate, settings.smoothness_weight)
    lengths, disagreement = learn_lengths(small, of_small, features, pairs, training, device())
    first = chain(len(together), pairs, lengths)
    closed, agree = close(first, pairs, lengths)
    sound = [pair for pair, good in zip(pairs, agree) if good]
    group = largest_group(len(together), sound)
    _check(group, features, settings.min_matches)
    sound = [pair for pair in sound if pair.first in group]
    refined = refine(closed, link(features, sound), settings.refine_focal)
    seen = np.bincount(refined.tracks.photo, minlength=len(together)) >= settings.min_matches
    _check(np.flatnonzero(seen), features, settings.min_matches)
    object_from_chain = _frame(refined, seen, joined.object_from_cam)
    _write_model(folder, joined, features, refined, seen, object_from_chain)
    posed = {joined.names[index] for index in np.flatnonzero(seen)}
    content = {
        "photos_with_pose": quantity(len(posed), "1"),
        "not_registered": quantity([name for name in workspace.names if name not in posed], ""),
        "pairs": quantity(len(pairs), "1"),
        "pairs_that_agree": quantity(len(sound), "1"),
        "depth_disagreement": quantity(disagreement, "1"),
        "points": quantity(len(refined.points), "1"),
        "reprojection_error": quantity(refined.error_px, "px"),
        "focal_scale": quantity(refined.focal_scale, "1"),
        "up_in_camera_frame": quantity(_up(object_from_chain, refined.object_from_cam[seen]), "1"),
        "frame": quantity("sfm" if joined.object_from_cam is not None else "own", ""),
    }
    if joined.object_from_cam is not None:
        steps = {"chain": first, "closed": closed, "refined": refined.object_from_cam}
        for name, poses in steps.items():
            content |= trajectory_error(name, poses[seen], joined.object_from_cam[seen])
    return content


def trajectory_error(name: str, poses: Array, reference: Array) -> Content:
    """Errors of (V, 4, 4) poses against others after a similarity fitted to the centres; nothing when they coincide."""
    centres, target = poses[:, :3, 3], reference[:, :3, 3]
    try:
        placed = fit_sim3(centres, target)
    except ValueError:
        return {}
    error = np.linalg.norm(placed.apply(centres) - target, axis=1)
    turned = placed.rotation @ poses[:, :3, :3] @ reference[:, :3, :3].swapaxes(1, 2)
    extent = float(np.linalg.norm(np.ptp(target, axis=0)))
    return {
        f"trajectory_error_{name}_over_extent": quantity(float(np.sqrt(np.mean(error**2))) / extent, "1"),
        f"rotation_error_{name}_deg": quantity(float(np.median([rotation_angle_deg(r) for r in turned])), "deg"),
    }


def _resized(workspace: Workspace, width_px: int) -> tuple[list[NDArray[np.uint8]], Array]:
    """The photos at most this wide, and their intrinsics."""
    images, intrinsics = [], []
    for image, k in zip(workspace.images, workspace.intrinsics):
        height, width = image.shape[:2]
        share = min(1.0, width_px / width)
        size = (round(width * share), round(height * share))
        images.append(np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8))
        intrinsics.append(np.diag([size[0] / width, size[1] / height, 1.0]) @ k)
    return images, np.array(intrinsics)


def _only(workspace: Workspace, rows: NDArray[np.int64]) -> Workspace:
    known = workspace.object_from_cam
    return Workspace(
        [workspace.names[row] for row in rows],
        [workspace.images[row] for row in rows],
        [workspace.cameras[row] for row in rows],
        workspace.intrinsics[rows],
        None if known is None else known[rows],
    )


def _check(joined: NDArray[np.int64], features: list[Features], min_matches: int) -> None:
    if len(joined) < 3:
        raise StageError(
            f"only {len(joined)} of {len(features)} photos share {min_matches} matches with another; poses without SfM "
            "need at least 3: take photos closer to each other, or set object.stage1.pose_source to sfm"
        )


def _frame(refined: Refined, seen: NDArray[np.bool_], known: Array | None) -> Sim3:
    """object_from_chain: SfM's frame where there is one, else z up and a median depth of 1."""
    poses = refined.object_from_cam[seen]
    if known is not None:
        try:
            return fit_sim3(poses[:, :3, 3], known[seen, :3, 3])
        except ValueError as error:
            raise StageError(
                f"the poses cannot be brought into SfM's frame: {error}; walk around the object instead of past it, "
                "or set object.stage1.pose_source to sfm"
            ) from None
    up, _ = estimate_up(poses[:, :3, :3], poses[:, :3, 3])
    offset = refined.points[refined.tracks.point] - refined.object_from_cam[refined.tracks.photo, :3, 3]
    depth = np.median((offset * refined.object_from_cam[refined.tracks.photo, :3, 2]).sum(1))
    middle = np.median(refined.points, axis=0)
    turn = Sim3(1.0 / float(depth), rotation_between(up, np.array([0.0, 0.0, 1.0])), np.zeros(3))
    return Sim3(turn.scale, turn.rotation, -turn.apply(middle))


def _up(object_from_chain: Sim3, poses: Array) -> Array:
    """(3,) the direction opposite to gravity in the object's frame."""
    return object_from_chain.rotate(estimate_up(poses[:, :3, :3], poses[:, :3, 3])[0])


def _write_model(
    folder: Path,
    workspace: Workspace,
    features: list[Features],
    refined: Refined,
    seen: NDArray[np.bool_],
    object_from_chain: Sim3,
) -> None:
    """A COLMAP model of the photos that are `seen`, one camera each."""
    model, tracks = pycolmap.Reconstruction(), refined.tracks
    members: list[list[pycolmap.TrackElement]] = [[] for _ in refined.points]
    for index in np.flatnonzero(seen):
        number, given = int(index) + 1, workspace.cameras[index]
        fx, fy, cx, cy = given.params
        params = [fx * refined.focal_scale, fy * refined.focal_scale, cx, cy]
        size = {"width": given.width, "height": given.height}
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="PINHOLE", params=params, camera_id=number, **size)  # type: ignore[arg-type]
        )
        rows = np.flatnonzero(tracks.photo == index)
        in_photo = np.column_stack([features[index].rays[tracks.row[rows]], np.ones(len(rows))])
        pixels = (in_photo @ workspace.intrinsics[index].T)[:, :2]
        pose = refined.object_from_cam[index]
        rotation = (object_from_chain.rotation @ pose[:3, :3]).T
        centre = object_from_chain.apply(pose[:3, 3])
        image = pycolmap.Image(
            name=workspace.names[index],
            camera_id=number,
            image_id=number,
            points2D=pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels]),
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre))
        for place, row in enumerate(rows):
            members[tracks.point[row]].append(pycolmap.TrackElement(number, place))
    for point, track in zip(object_from_chain.apply(refined.points), members):
        if len(track) >= 2:
            model.add_point3D(point, pycolmap.Track(track), np.zeros(3, np.uint8))
    model.write(folder)


def _matrix(pose: pycolmap.Rigid3d) -> Array:
    matrix = np.eye(4)
    matrix[:3] = pose.matrix()
    return matrix
