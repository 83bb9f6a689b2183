"""Poses without SfM: two-view depths by hand, a planted orbit of points, and photos of a planted textured room."""

import json

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Sim3
from scenefuse.nerf.prior.inputs import depth_photos
from scenefuse.photos.views import load_views
from scenefuse.photos.workspace import View
from scenefuse.poses.bundle_adjustment import adjust_bundle, link_tracks
from scenefuse.poses.correspondences import PhotoFeatures, TwoViewPair, find_pairs, match, two_view_depths
from scenefuse.poses.find_poses import PoseSettings, find_poses, trajectory_error
from scenefuse.poses.pair_scales import learn_pair_scales
from scenefuse.poses.pose_graph import average_poses, largest_component, spanning_tree_poses

FOCAL, WIDTH, HEIGHT = 300.0, 320, 240
INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
SETTINGS = PoseSettings(feature_width_px=320, features=1500, min_matches=20, steps=20)


@pytest.fixture(autouse=True)
def one_thread(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def orbit(count: int, turn: float = 2 * np.pi) -> np.ndarray:
    """(count, 4, 4) poses of cameras four units from the origin, looking at it, at two heights in turn."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index, angle in enumerate(turn * np.arange(count) / count):
        centre = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.0 + 0.8 * (index % 2)])
        z = -centre / np.linalg.norm(centre)
        x = np.cross(z, [0, 0, 1.0]) / np.linalg.norm(np.cross(z, [0, 0, 1.0]))
        poses[index, :3, :3], poses[index, :3, 3] = np.stack([x, np.cross(z, x), z], 1), centre
    return poses


def planted_features(poses: np.ndarray, focal_given: float, noise_px: float) -> list[PhotoFeatures]:
    """Features of 800 points on a sphere, each seen by the cameras in front of it, with descriptors of their own."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(800, 3))
    points *= rng.uniform(0.8, 1.2, (800, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    descriptors = rng.normal(size=(800, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    features = []
    for pose in poses:
        seen = np.flatnonzero(((pose[:3, 3] - points) * points).sum(1) > 0.3)
        in_cam = (points[seen] - pose[:3, 3]) @ pose[:3, :3]
        pixels = FOCAL * in_cam[:, :2] / in_cam[:, 2:] + rng.normal(0, noise_px, (len(seen), 2))
        features.append(PhotoFeatures(pixels, pixels / focal_given, descriptors[seen], focal_given))
    return features


def errors(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    content = trajectory_error("x", found, true)
    return content["trajectory_error_x_over_extent"]["value"], content["rotation_error_x_deg"]["value"]


def test_two_view_depths_by_hand():
    # a point 2 ahead of the first camera; the second stands 1 to the right and sees it at 45 degrees: angle atan(1/2)
    turned = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
    ahead = np.array([[0.0, 0.0]])
    depths, angle = two_view_depths(ahead, np.array([[-0.5, 0.0]]), np.eye(3), np.array([-1.0, 0, 0]))
    assert depths[0] == pytest.approx([2.0, 2.0]) and angle[0] == pytest.approx(np.degrees(np.arctan(0.5)))
    # a second camera that looks along the first one's x axis, from (-3, 0, 2): the point is 3 ahead of it
    depths, angle = two_view_depths(ahead, ahead, turned, -turned @ np.array([-3.0, 0, 2.0]))
    assert depths[0] == pytest.approx([2.0, 3.0]) and angle[0] == pytest.approx(90.0)


def test_matches_are_mutual_and_distinct():
    first, second = np.eye(4, dtype=np.float32)[:3], np.eye(4, dtype=np.float32)[[2, 0, 3]]
    assert match(first, second).tolist() == [[0, 1], [2, 0]]
    twins = np.eye(4, dtype=np.float32)[[0, 0, 2]]
    assert match(first, twins).tolist() == [[2, 2]]


def test_a_planted_orbit_is_averaged_and_adjusted_with_its_focal_length():
    true = orbit(16)
    features = planted_features(true, 0.96 * FOCAL, 0.3)
    pairs = list(find_pairs(features, 30, 1.5))
    assert len(largest_component(16, pairs)) == 16
    lengths = np.array([np.linalg.norm(true[p.first, :3, 3] - true[p.second, :3, 3]) for p in pairs])
    lengths *= np.exp(np.random.default_rng(1).normal(0, 0.05, len(pairs)))
    # a pair that is plainly wrong, as repeated texture makes them
    worst = int(np.argmin([len(p.rows) for p in pairs]))
    wrong = pairs[worst]
    pairs[worst] = TwoViewPair(wrong.first, wrong.second, wrong.rows, wrong.rotation.T, -wrong.direction, wrong.depths)
    first = spanning_tree_poses(16, pairs, lengths)
    averaged, agree = average_poses(first, pairs, lengths)
    adjusted = adjust_bundle(
        averaged, link_tracks(features, [p for p, good in zip(pairs, agree) if good]), refine_focal=True
    )
    before, after, best = (errors(poses, true) for poses in (first, averaged, adjusted.graph_from_cam))
    assert not agree[worst] and agree.mean() > 0.8
    assert after[0] < before[0] and best[0] < 0.1 * after[0]
    assert best[0] < 0.002 and best[1] < np.degrees(1 / FOCAL)  # a pixel
    assert adjusted.focal_scale == pytest.approx(1 / 0.96, rel=0.005)
    assert 0.3 < adjusted.error_px < 0.6  # two coordinates with a deviation of 0.3 each
    fixed = adjust_bundle(
        averaged, link_tracks(features, [p for p, good in zip(pairs, agree) if good]), refine_focal=False
    )
    assert fixed.focal_scale == 1.0 and errors(fixed.graph_from_cam, true)[0] > best[0]


def test_the_network_finds_the_lengths_that_make_depths_agree():
    true = orbit(6, 1.5)
    features = planted_features(true, FOCAL, 0.0)
    pairs = list(find_pairs(features, 30))
    images = [np.random.default_rng(k).integers(0, 255, (48, 64, 3)).astype(np.uint8) for k in range(6)]
    small = np.diag([0.2, 0.2, 1.0]) @ np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    torch.manual_seed(0)
    views = [View(f"{k}", small, np.eye(4), 64, 48, image) for k, image in enumerate(images)]
    lengths, disagreement = learn_pair_scales(views, features, pairs, 40, torch.device("cpu"))
    true_lengths = np.array([np.linalg.norm(true[p.first, :3, 3] - true[p.second, :3, 3]) for p in pairs])
    ratio = lengths / true_lengths
    assert np.std(ratio) / np.mean(ratio) < 0.03 and disagreement < 0.05


def room(folder, count: int, known: bool) -> np.ndarray:
    """Photos of a textured sphere on a textured floor, in a workspace with true poses and a point, or with none."""
    rng = np.random.default_rng(3)
    texture = cv2.resize(rng.integers(0, 255, (128, 256, 3)).astype(np.uint8), None, fx=4, fy=4).astype(np.float32)
    true = orbit(count, 2.4)
    (folder / "images").mkdir(parents=True)
    (folder / "sparse").mkdir()
    model = pycolmap.Reconstruction()
    params = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    camera = pycolmap.Camera(model="PINHOLE", width=WIDTH, height=HEIGHT, params=params, camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    v, u = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij")
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1)
    for index, pose in enumerate(true):
        d, c = rays @ pose[:3, :3].T, pose[:3, 3]
        a, b, e = (d**2).sum(-1), d @ c, c @ c - 1.0
        ball = b**2 - a * e > 0
        depth = np.where(
            ball, (-b - np.sqrt(np.maximum(b**2 - a * e, 0))) / a, (-1.0 - c[2]) / np.minimum(d[..., 2], -1e-3)
        )
        x, y, z = np.moveaxis(c + d * depth[..., None], -1, 0)
        column = np.where(ball, (np.arctan2(y, x) / (2 * np.pi) + 0.5) * 1024, x * 100 % 1024)
        row = np.where(ball, (np.arcsin(np.clip(z, -1, 1)) / np.pi + 0.5) * 512, y * 100 % 512)
        photo = cv2.remap(texture, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)
        cv2.imwrite(str(folder / "images" / f"{index:02d}.png"), photo.astype(np.uint8))
        image = pycolmap.Image(name=f"{index:02d}.png", camera_id=1, image_id=index + 1)
        placed = np.linalg.inv(pose) if known else np.eye(4)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(placed[:3]))
    if known:
        model.add_point3D(np.zeros(3), pycolmap.Track(), np.zeros(3, np.uint8))
    model.write(folder / "sparse")
    return true


def _find(tmp_path):
    find_poses(
        workspace=tmp_path / "undistorted",
        posed=tmp_path / "poses",
        report=tmp_path / "poses.json",
        settings=SETTINGS,
        seed=0,
    )
    return json.loads((tmp_path / "poses.json").read_text()), pycolmap.Reconstruction(tmp_path / "poses/sparse")


def _poses(model: pycolmap.Reconstruction) -> np.ndarray:
    images = sorted(model.images.values(), key=lambda image: image.name)
    return np.array([np.vstack([i.cam_from_world().inverse().matrix(), [0, 0, 0, 1]]) for i in images])


@pytest.mark.parametrize("known", [True, False])
def test_photos_of_a_planted_room_give_their_poses(tmp_path, known):
    true = room(tmp_path / "undistorted", 10, known)
    report, model = _find(tmp_path)
    found = _poses(model)
    up = np.array(report["up_in_camera_frame"]["value"])
    assert up @ [0, 0, 1] > 0.99  # the room's cameras stand above its floor, and the own frame has z up
    assert report["photos_with_pose"]["value"] == 10 and report["not_registered"]["value"] == []
    off, turned = errors(found, true)
    assert off < 0.005 and turned < 0.3
    points = np.array([p.xyz for p in model.points3D.values()])
    assert len(points) > 300
    if known:
        # in the frame of the poses that the workspace came with
        assert report["frame"]["value"] == "sfm"
        assert np.abs(found[:, :3, 3] - true[:, :3, 3]).max() < 0.05
        steps = [report[f"trajectory_error_{name}_over_extent"]["value"] for name in ("tree", "averaged", "adjusted")]
        assert steps[2] == pytest.approx(off, abs=1e-6) and steps[2] < steps[1]
        radius = np.linalg.norm(points, axis=1)
        assert np.median(np.minimum(np.abs(radius - 1), np.abs(points[:, 2] + 1))) < 0.01
    else:
        assert report["frame"]["value"] == "own" and "trajectory_error_adjusted_over_extent" not in report
        (tmp_path / "masks").mkdir()
        for name in sorted(path.stem for path in (tmp_path / "poses/images").iterdir())[1:]:
            cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), np.full((HEIGHT, WIDTH), 255, np.uint8))
        views = load_views(tmp_path / "poses", tmp_path / "masks", 160, 0)
        # what the training stages read: these poses, the refined focal length, and points that project where seen
        assert np.allclose(views.object_from_cam, found[1:]) and len(views.sparse) == len(points)
        assert views.intrinsics[0, 0, 0] == pytest.approx(0.5 * FOCAL, rel=0.01)
        assert depth_photos(views, 4, torch.device("cpu")).near > 0.3  # of a median depth of 1


def test_photos_without_matches_and_unreadable_photos_are_one_sentence(tmp_path):
    room(tmp_path / "undistorted", 4, False)
    for path in (tmp_path / "undistorted/images").iterdir():
        cv2.imwrite(str(path), np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    with pytest.raises(StageError, match="only 1 of 4 photos share 20 matches with another"):
        _find(tmp_path)
    (tmp_path / "undistorted/images/01.png").unlink()
    with pytest.raises(StageError, match="01.png does not exist"):
        _find(tmp_path)


def test_an_error_of_the_trajectory_ignores_the_frame():
    true = orbit(8)
    moved = Sim3(3.0, true[2, :3, :3], np.array([1.0, 2.0, 3.0]))
    found = true.copy()
    found[:, :3, :3], found[:, :3, 3] = moved.rotation @ true[:, :3, :3], moved.apply(true[:, :3, 3])
    assert errors(found, true) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert trajectory_error("x", np.tile(np.eye(4), (8, 1, 1)), true) == {}
