"""Camera poses of an object's photos without SfM: from matches and a depth network, averaged and adjusted together."""

import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, atomic_directory, quantity, setting, write_json
from scenefuse.core.transforms import Sim3, fit_sim3, rotation_angle_deg, rotation_between
from scenefuse.nerf.prior.training import prepare_torch
from scenefuse.photos.workspace import View, Workspace, read_workspace
from scenefuse.poses.bundle_adjustment import AdjustedBundle, adjust_bundle, link_tracks
from scenefuse.poses.correspondences import PhotoFeatures, find_features, find_pairs
from scenefuse.poses.pair_scales import learn_pair_scales
from scenefuse.poses.pose_graph import average_poses, largest_component, spanning_tree_poses
from scenefuse.sfm.adjustment import TOLERANCE
from scenefuse.sfm.gravity import estimate_up
from scenefuse.sfm.lens import HELD, KNOWN, STRAIGHT, choose_lens, describe_lens

Array = NDArray[np.float64]
Content = dict[str, Any]

# Width at which the depth network sees the photos: scales need no detail.
NETWORK_WIDTH_PX = 64


@dataclass(frozen=True)
class PoseSettings:
    """How poses are found without SfM."""

    refine_focal: bool = setting(True)
    """Whether the focal length, and the principal point where the photos determine it, are refined together with the
    poses; false where they were calibrated."""
    feature_width_px: int = 960
    """Width at which features are found in the photos, pixels."""
    features: int = 2000
    """Most features of a photo."""
    min_matches: int = 30
    """Fewest matches that make a pair of photos."""
    steps: int = 150
    """Training steps of the depth network, each over all photos."""


@dataclass(frozen=True)
class FoundPoses:
    """Poses of the V photos that pairs join, in the frame of their pose graph, after each step.

    Attributes:
        views: the photos.
        features: of each.
        pairs: number of pairs, and of those that agree with the averaged poses.
        depth_disagreement: median relative disagreement of the depths of a photo's pairs.
        tree: (V, 4, 4) poses along the spanning tree.
        averaged: (V, 4, 4) poses averaged over all pairs.
        adjusted: bundle adjustment of these.
        seen: (V,) bool, True for the photos with enough observations in the end.
    """

    views: list[View]
    features: list[PhotoFeatures]
    pairs: tuple[int, int]
    depth_disagreement: float
    tree: Array
    averaged: Array
    adjusted: AdjustedBundle
    seen: NDArray[np.bool_]


def find_poses(*, workspace: Path, posed: Path, report: Path, settings: PoseSettings, seed: int) -> None:
    """Give the photos of a workspace other poses than SfM's (method N11); the training stages read the result instead.

    Only the workspace's photos and intrinsics are used. SIFT matches give every pair of photos its relative pose up to
    the baseline's length (essential matrix); a depth network trained on these photos, from scratch, gives the lengths;
    poses along the spanning tree of the best pairs are averaged over all pairs; and all poses, matched points and, if
    set, the focal length are adjusted together. Where the workspace has poses of SfM, the result is brought into their
    frame by one similarity, because masks and registration count in that frame, and the remaining error of the
    trajectory is reported; otherwise it gets its own frame: z up, the median depth 1.

    Args:
        workspace: undistorted COLMAP workspace of the object; without SfM: any poses, no points.
        posed: output, workspace with the same photos, PINHOLE cameras, poses, points and their tracks.
        report: output JSON; holds `up_in_camera_frame` like that of the undistorted photos.
        settings: of the search.
        seed: of the network's weights.

    Raises:
        StageError: fewer than three photos share enough matches.
    """
    start = time.monotonic()
    device = prepare_torch(seed)
    given = read_workspace(workspace)
    found = find(_read_photos(given), settings, device)
    object_from_graph = _frame(found, has_sfm=len(given.points) > 0)
    model = _model(found, object_from_graph)
    choice = choose_lens(model, STRAIGHT if settings.refine_focal else (KNOWN,))
    if choice.lens not in (HELD, KNOWN):
        model = choice.lens.fit(model, TOLERANCE)
    with atomic_directory(posed) as folder:
        left_out = shutil.ignore_patterns("sparse", ".snakemake_timestamp")
        shutil.copytree(workspace, folder, ignore=left_out, dirs_exist_ok=True)
        (folder / "sparse").mkdir()
        model.write(folder / "sparse")
    content = _report(given, found, object_from_graph) | describe_lens(choice, model)
    write_json(report, content | {"seconds": quantity(round(time.monotonic() - start, 1), "s")})
    print(f"poses of {content['photos_with_pose']['value']} photos", flush=True)


def find(views: list[View], settings: PoseSettings, device: torch.device) -> FoundPoses:
    """Poses of the photos (H, W, 3) RGB that matches join, whatever poses they have.

    Raises:
        StageError: fewer than three photos share enough matches.
    """
    large = [_at_width(view, settings.feature_width_px) for view in views]
    features = [find_features(view.pixels, view.intrinsics, settings.features) for view in large]
    pairs = list(find_pairs(features, settings.min_matches))
    together = largest_component(len(views), pairs)
    print(f"{len(pairs)} pairs join {len(together)} of {len(views)} photos", flush=True)
    _check(len(together), len(views), settings.min_matches)
    place = {int(photo): index for index, photo in enumerate(together)}
    pairs = [replace(p, first=place[p.first], second=place[p.second]) for p in pairs if p.first in place]
    joined, features = [views[photo] for photo in together], [features[photo] for photo in together]
    small = [_at_width(view, NETWORK_WIDTH_PX) for view in joined]
    lengths, disagreement = learn_pair_scales(small, features, pairs, settings.steps, device)
    tree = spanning_tree_poses(len(joined), pairs, lengths)
    averaged, agree = average_poses(tree, pairs, lengths)
    sound = [pair for pair, good in zip(pairs, agree) if good]
    group = largest_component(len(joined), sound)
    _check(len(group), len(joined), settings.min_matches)
    sound = [pair for pair in sound if pair.first in group]
    adjusted = adjust_bundle(averaged, link_tracks(features, sound), settings.refine_focal)
    seen = np.bincount(adjusted.tracks.photo, minlength=len(joined)) >= settings.min_matches
    _check(int(seen.sum()), len(joined), settings.min_matches)
    return FoundPoses(joined, features, (len(pairs), len(sound)), disagreement, tree, averaged, adjusted, seen)


def _read_photos(workspace: Workspace) -> list[View]:
    """The workspace's views with their photos."""
    if len({(view.width, view.height) for view in workspace.views}) > 1:
        raise StageError(
            f"the photos in {workspace.folder}/images have different sizes, which this source of poses does not take;"
            " use photos of one camera at one size (with features.camera_mode: single), or stage1.pose_source: sfm"
        )
    return [workspace.rgb(view) for view in workspace.views]


def _report(given: Workspace, found: FoundPoses, object_from_graph: Sim3) -> Content:
    """What was found and, where there are poses of SfM, how far from these each step came."""
    adjusted, seen = found.adjusted, found.seen
    posed = {view.name for view, good in zip(found.views, seen) if good}
    rotations, centres = adjusted.graph_from_cam[seen, :3, :3], adjusted.graph_from_cam[seen, :3, 3]
    content = {
        "photos_with_pose": quantity(len(posed), "1"),
        "not_registered": quantity([view.name for view in given.views if view.name not in posed], ""),
        "pairs": quantity(found.pairs[0], "1"),
        "pairs_that_agree": quantity(found.pairs[1], "1"),
        "depth_disagreement": quantity(found.depth_disagreement, "1"),
        "points": quantity(len(adjusted.points), "1"),
        "reprojection_error": quantity(adjusted.error_px, "px"),
        "focal_scale": quantity(adjusted.focal_scale, "1"),
        "up_in_camera_frame": quantity(object_from_graph.rotate(estimate_up(rotations, centres)[0]), "1"),
        "frame": quantity("sfm" if len(given.points) else "own", ""),
    }
    if len(given.points):
        reference = np.array([view.world_from_cam for view in found.views])[seen]
        steps = {"tree": found.tree, "averaged": found.averaged, "adjusted": adjusted.graph_from_cam}
        for name, poses in steps.items():
            content |= trajectory_error(name, poses[seen], reference)
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


def _at_width(view: View, width_px: int) -> View:
    """The photo at most this wide."""
    share = min(1.0, width_px / view.width)
    return view.resized(round(view.width * share), round(view.height * share))


def _check(joined: int, photos: int, min_matches: int) -> None:
    if joined < 3:
        raise StageError(
            f"only {joined} of {photos} photos share {min_matches} matches with another; poses without SfM "
            "need at least 3: take photos closer to each other, or set object.stage1.pose_source to sfm"
        )


def _frame(found: FoundPoses, has_sfm: bool) -> Sim3:
    """object_from_graph: SfM's frame where there is one, else z up and a median depth of 1."""
    adjusted, tracks = found.adjusted, found.adjusted.tracks
    poses = adjusted.graph_from_cam[found.seen]
    if has_sfm:
        known = np.array([view.centre for view in found.views])[found.seen]
        try:
            return fit_sim3(poses[:, :3, 3], known)
        except ValueError as error:
            raise StageError(
                f"the poses cannot be brought into SfM's frame: {error}; walk around the object instead of past it, "
                "or set object.stage1.pose_source to sfm"
            ) from None
    up, _ = estimate_up(poses[:, :3, :3], poses[:, :3, 3])
    offset = adjusted.points[tracks.point] - adjusted.graph_from_cam[tracks.photo, :3, 3]
    depth = np.median((offset * adjusted.graph_from_cam[tracks.photo, :3, 2]).sum(1))
    middle = np.median(adjusted.points, axis=0)
    turn = Sim3(1.0 / float(depth), rotation_between(up, np.array([0.0, 0.0, 1.0])), np.zeros(3))
    return Sim3(turn.scale, turn.rotation, -turn.apply(middle))


def _model(found: FoundPoses, object_from_graph: Sim3) -> pycolmap.Reconstruction:
    """A COLMAP model of the photos that are `seen`; photos of one calibration share a camera."""
    model, adjusted, tracks = pycolmap.Reconstruction(), found.adjusted, found.adjusted.tracks
    members: list[list[pycolmap.TrackElement]] = [[] for _ in adjusted.points]
    cameras: dict[tuple[float, ...], int] = {}
    for index in np.flatnonzero(found.seen):
        number, view = int(index) + 1, found.views[index]
        scale, k = adjusted.focal_scale, view.intrinsics
        params = k[0, 0] * scale, k[1, 1] * scale, k[0, 2], k[1, 2]
        if params not in cameras:
            cameras[params] = len(cameras) + 1
            size = {"width": view.width, "height": view.height, "camera_id": cameras[params]}
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(model="PINHOLE", params=params, **size)  # type: ignore[arg-type]
            )
        rows = np.flatnonzero(tracks.photo == index)
        in_photo = np.column_stack([found.features[index].rays[tracks.row[rows]], np.ones(len(rows))])
        pixels = (in_photo @ k.T)[:, :2]
        pose = adjusted.graph_from_cam[index]
        rotation = (object_from_graph.rotation @ pose[:3, :3]).T
        centre = object_from_graph.apply(pose[:3, 3])
        image = pycolmap.Image(
            name=view.name,
            camera_id=cameras[params],
            image_id=number,
            points2D=pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels]),
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre))
        for place, row in enumerate(rows):
            members[tracks.point[row]].append(pycolmap.TrackElement(number, place))
    for point, track in zip(object_from_graph.apply(adjusted.points), members):
        if len(track) >= 2:
            model.add_point3D(point, pycolmap.Track(track), np.zeros(3, np.uint8))
    return model
