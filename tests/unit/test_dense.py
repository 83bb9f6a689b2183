"""Stereo and fusion on a planted scene: a bumpy, textured surface of known depth seen by five cameras."""

import tempfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from scenefuse.cloud import clouds
from scenefuse.cloud.clouds import read_cloud
from scenefuse.core.stage import StageError, quantity, read_json, value, write_json
from scenefuse.core.transforms import look_at
from scenefuse.geometry.matcher import Matcher
from scenefuse.mvs.dense_cloud import DenseCloudSettings, fuse_depth_maps
from scenefuse.mvs.depth_maps import estimate_depth_maps
from scenefuse.mvs.plane_sweep import DepthMapSettings
from scenefuse.photos.pictures import read_depth, read_normals, write_depth, write_normals
from scenefuse.photos.workspace import View, write_model

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
DEPTH = DepthMapSettings(
    backend="torch", max_image_size_px=160, sources=4, min_angle_deg=1.0, best_sources=2, planes=48, window_px=5
)
FUSION = DenseCloudSettings(max_normal_error_deg=20)


def surface(x, y):
    """Height over the plane z = 10 in front of the first camera; a plane z = 10 + 0.3 x - 0.2 y."""
    return 10 + 0.3 * x - 0.2 * y


def depth_of(centre):
    """(H, W) exact depths of the plane from a camera that looks along +z from (x, y, 0), pixel centres at +0.5."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    a, b = (u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL
    return (10 + 0.3 * centre[0] - 0.2 * centre[1]) / (1 - 0.3 * a + 0.2 * b), a, b


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workspace")
    (folder / "images").mkdir()
    (folder / "sparse").mkdir()
    noise = np.random.default_rng(0).random((400, 400)).astype(np.float32)
    texture = sum(cv2.GaussianBlur(noise, (0, 0), s) * s for s in (1.5, 3.0))
    texture = (texture - texture.min()) / np.ptp(texture)
    centres = [(0, 0), (1.2, 0), (-1.2, 0.1), (0, 1.2), (0.1, -1.2)]
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2], camera_id=1
    )
    model.add_camera_with_trivial_rig(camera)
    points = np.random.default_rng(1).uniform(-3, 3, (200, 2))
    points = np.column_stack([points, surface(*points.T)])
    tracks = [[] for _ in points]
    for k, centre in enumerate(centres, 1):
        depth, a, b = depth_of(centre)
        x, y = centre[0] + a * depth, centre[1] + b * depth
        to_texture = [((c + 10) * 20 - 0.5).astype(np.float32) for c in (x, y)]
        photo = cv2.remap(texture, *to_texture, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        cv2.imwrite(str(folder / "images" / f"{k}.png"), np.clip(photo * 255, 0, 255).astype(np.uint8))
        x_in_cam = points - [*centre, 0]
        pixels = FOCAL * x_in_cam[:, :2] / x_in_cam[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        rows = np.flatnonzero(((pixels > 0) & (pixels < [WIDTH, HEIGHT])).all(1))
        image = pycolmap.Image(
            name=f"{k}.png", camera_id=1, image_id=k, points2D=[pycolmap.Point2D(p) for p in pixels[rows]]
        )
        model.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(np.column_stack([np.eye(3), [-centre[0], -centre[1], 0]]))
        )
        for j, row in enumerate(rows):
            tracks[row].append(pycolmap.TrackElement(k, j))
    for point, track in zip(points, tracks):
        if len(track) > 1:
            model.add_point3D(point, pycolmap.Track(track), np.zeros(3, np.uint8))
    model.write_binary(folder / "sparse")
    return folder


@pytest.fixture(scope="module")
def maps(workspace, tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    for chunk in range(2):
        estimate_depth_maps(
            workspace=workspace,
            chunk=chunk,
            chunks=2,
            settings=DEPTH,
            seed=0,
            depth=folder / f"{chunk}",
            report=folder / f"{chunk}.json",
        )
    return folder


# Those of the object's and of the scene's stereo; the kernel is compiled for each, which takes ten seconds.
@pytest.mark.slow
@pytest.mark.parametrize("window", [5, pytest.param(7, marks=pytest.mark.slow)])
def test_matching_kernel_scores_as_its_twin(window):
    rng = np.random.default_rng(0)
    intrinsics = np.array([[60, 0, 35], [0, 60, 25], [0, 0, 1.0]])
    poses = np.repeat(np.eye(4)[None], 4, axis=0)
    poses[:, 0, 3], poses[:, 1, 3] = (0, 1, -2, 9), 0.1
    sizes = [(50, 70), (50, 70), (50, 70), (40, 80)]
    pixels = [cv2.GaussianBlur(rng.random(size, np.float32), (0, 0), 1) for size in sizes]
    photos = [View("", intrinsics, p, s[1], s[0], g) for p, s, g in zip(poses, sizes, pixels)]
    matcher = Matcher(photos[0], photos[1:], 2, window, "cpu")
    # From behind the camera to far in front of it, some places beside the source photos.
    inverse = torch.linspace(-0.3, 0.5, 5)[:, None, None] + torch.from_numpy(0.05 * rng.random((5, 50, 70), np.float32))
    twin = torch.full((2, *inverse.shape), -0.5)
    for source in matcher.sources:
        matcher.keep_best(inverse, twin, *source)
    assert (twin == -0.5).any() and (twin > 0).any()
    assert (matcher.score(inverse) - twin.mean(0)).abs().max() < 2e-4


def test_depth_and_normals_of_a_slanted_plane(maps):
    depth = read_depth(maps / "0" / "depth_maps" / "1.png.bin")
    normals = read_normals(maps / "0" / "normal_maps" / "1.png.bin")
    truth, _, _ = depth_of((0, 0))
    inner = np.s_[15:-15, 15:-15]
    assert (depth[inner] > 0).mean() > 0.98
    error = np.abs(depth - truth)[inner][depth[inner] > 0]
    # One source pixel of disparity at the largest baseline is 10 * 10 / (150 * 1.2) = 0.55 in depth.
    assert np.median(error) < 0.03
    towards_camera = np.array([0.3, -0.2, -1]) / np.linalg.norm([0.3, -0.2, -1])
    angle = np.degrees(np.arccos(np.clip((normals[inner] @ towards_camera)[depth[inner] > 0], -1, 1)))
    assert np.median(angle) < 1.5


def test_normal_maps_are_in_the_order_of_colmap(tmp_path):
    # COLMAP's own script of reading: (width, height, channels) in Fortran's order, transposed.
    normals = np.random.default_rng(0).random((4, 5, 3), np.float32)
    write_normals(tmp_path / "n.bin", normals)
    header, values = (tmp_path / "n.bin").read_bytes()[:6], (tmp_path / "n.bin").read_bytes()[6:]
    assert header == b"5&4&3&"
    planes = np.frombuffer(values, np.float32).reshape((5, 4, 3), order="F")
    assert np.array_equal(np.transpose(planes, (1, 0, 2)), normals)
    assert np.array_equal(read_normals(tmp_path / "n.bin"), normals)


def test_chunks_share_out_the_photos(maps):
    names = [sorted(p.name for p in (maps / f"{k}" / "depth_maps").iterdir()) for k in range(2)]
    assert names == [["1.png.bin", "3.png.bin", "5.png.bin"], ["2.png.bin", "4.png.bin"]]
    report = read_json(maps / "1.json")
    assert value(report, "backend") == "torch"
    assert set(report["photos"]) == {"2.png", "4.png"}
    assert report["photos"]["2.png"]["near"] < 9 < 11 < report["photos"]["2.png"]["far"]


def test_fused_cloud_lies_on_the_surface_without_a_half_pixel_shift(workspace, maps, tmp_path):
    cloud_path, report_path = tmp_path / "dense.ply", tmp_path / "dense.json"
    write_json(tmp_path / "georeference.json", {"length_unit": quantity("m", "")})
    fuse_depth_maps(
        workspace=workspace,
        depth=[maps / "0", maps / "1"],
        depth_json=[maps / "0.json", maps / "1.json"],
        georeference_json=tmp_path / "georeference.json",
        settings=FUSION,
        cloud=cloud_path,
        report=report_path,
    )
    cloud = read_cloud(cloud_path)
    report = read_json(report_path)
    assert len(cloud) == value(report, "points") > 3000 and report["spacing"]["unit"] == "m"
    assert value(report, "fused_share") > 0.1 and value(report, "notes") == []
    assert cloud.fields["views"].min() >= 3
    x, y, z = cloud.points.T
    signed = (z - surface(x, y)) / np.sqrt(1 + 0.3**2 + 0.2**2)
    # A pixel is 0.067 wide here; half of it on this slope would show as a bias of 0.003 (0.3 * 0.033 - 0.2 * 0.033).
    assert np.abs(np.median(signed)) < 0.0025
    assert np.median(np.abs(signed)) < 0.02
    angle = np.degrees(np.arccos(np.clip(cloud.normals @ np.array([0.3, -0.2, -1]) / np.sqrt(1.13), -1, 1)))
    assert np.quantile(angle, 0.9) < 3


def test_a_cloud_of_few_of_the_measured_pixels_is_noted(workspace, maps, tmp_path):
    fuse_depth_maps(
        workspace=workspace,
        depth=[maps / "0", maps / "1"],
        depth_json=[maps / "0.json", maps / "1.json"],
        settings=replace(FUSION, max_reprojection_px=0.05, max_depth_error=2e-5),
        cloud=tmp_path / "dense.ply",
        report=tmp_path / "dense.json",
    )
    report = read_json(tmp_path / "dense.json")
    assert 0 < value(report, "fused_share") < 0.01
    assert "of the pixels with a depth are in the cloud" in value(report, "notes")[0]


def cloud_of_ground(folder, eyes_and_targets, noise=0.0):
    """The cloud of depth maps of the ground z = 0, off by a share, from some cameras that look at some places."""
    rng, lens, views = np.random.default_rng(0), np.array([[75.0, 0, 40], [0, 75, 30], [0, 0, 1]]), []
    v, u = np.mgrid[:60, :80] + 0.5
    for part in ("images", "sparse", "maps"):
        (folder / part).mkdir(parents=True)
    for k, (eye, target) in enumerate(eyes_and_targets):
        pose = np.eye(4)
        pose[:3, :3] = look_at(eye, target, [0, 1, 0.01])
        pose[:3, 3] = -pose[:3, :3] @ eye
        views.append(View(f"{k:02d}.png", lens, pose, 80, 60))
        falls = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(lens).T @ pose[:3, 2]
        depth = np.where(falls < -0.02, eye[2] / np.maximum(-falls, 0.02), 0)
        depth = (depth * (1 + noise * rng.normal(size=depth.shape))).astype(np.float32)
        cv2.imwrite(str(folder / "images" / views[-1].name), np.full((60, 80, 3), 90, np.uint8))
        write_depth(folder / "maps/depth_maps" / f"{views[-1].name}.bin", depth)
        normals = np.tile(pose[:3, 2].astype(np.float32), (60, 80, 1))
        write_normals(folder / "maps/normal_maps" / f"{views[-1].name}.bin", normals)
    write_model(folder / "sparse", views)
    photos = {view.name: {"sources": [other.name for other in views if other is not view]} for view in views}
    said = {key: quantity("", "") for key in ("backend", "device", "reason")}
    write_json(folder / "maps.json", said | {"photos": photos})
    fuse_depth_maps(
        workspace=folder,
        depth=[folder / "maps"],
        depth_json=[folder / "maps.json"],
        settings=DenseCloudSettings(),
        cloud=folder / "dense.ply",
        report=folder / "dense.json",
    )
    return read_cloud(folder / "dense.ply")


def test_a_high_flight_stays_beside_a_low_one(tmp_path):
    # The photos of one flight have pixels ten times as large as those of the other.
    shifts = [(0, 0), (0.1, 0), (0, 0.1), (-0.1, 0), (0, -0.1)]
    eyes = [np.array([x * height, y * height, height]) for height in (2.0, 20.0) for x, y in shifts]
    cloud = cloud_of_ground(tmp_path, [(eye, eye * [1, 1, 0]) for eye in eyes])
    assert set(cloud.fields) == {"views"}
    apart = np.abs(cloud.points[:, :2]).max(1)
    assert (apart < 0.5).sum() > 1000 and ((apart > 2) & (apart < 7)).sum() > 1000
    # Nearly all pixels are confirmed; a coarse one that confirms a hundred points is one.
    assert 0.9 < value(read_json(tmp_path / "dense.json"), "fused_share") <= 1


def test_a_high_flight_makes_the_points_of_a_low_one_no_less_exact(tmp_path):
    def error(heights):
        shifts = [(0, 0), (0.1, 0), (0, 0.1), (-0.1, 0), (0, -0.1)]
        eyes = [np.array([x * height, y * height, height]) for height in heights for x, y in shifts]
        folder = tmp_path / f"{len(heights)}"
        cloud = cloud_of_ground(folder, [(eye, eye * [1, 1, 0]) for eye in eyes], noise=0.002)
        return np.sqrt((cloud.points[np.abs(cloud.points[:, :2]).max(1) < 0.5, 2] ** 2).mean())

    assert error((2.0, 20.0)) < 1.5 * error((2.0,))


def test_oblique_photos_take_no_points_from_those_from_above(tmp_path):
    # Their near parts are finer than these, and their far parts coarser.
    above = [(np.array([x, y, 4.0]), np.array([x, y, 0])) for x in (-0.6, 0, 0.6) for y in (2.0, 5.0)]
    oblique = [(np.array([x, -4.0, 1.2]), np.array([x, -1.5, 0])) for x in (-0.2, 0, 0.2)]

    def far_off(cloud):
        return ((np.abs(cloud.points[:, 0]) < 1) & (cloud.points[:, 1] > 1) & (cloud.points[:, 1] < 5)).sum()

    alone, both = (cloud_of_ground(tmp_path / f"{k}", cameras) for k, cameras in enumerate((above, above + oblique)))
    assert len(both) > len(alone) and far_off(both) > 0.9 * far_off(alone)


def test_a_point_far_from_all_others_is_found_in_clouds_of_any_size(monkeypatch):
    points = np.random.default_rng(0).uniform(0, [100, 20, 1], (5000, 3))
    points[7] = [50, 90, 0]
    whole = clouds.near_others(points)
    monkeypatch.setattr(clouds, "AT_ONCE", 400)
    assert not whole[7] and whole.mean() > 0.99 and np.array_equal(clouds.near_others(points), whole)


@pytest.fixture
def patch_match(monkeypatch):
    """Stands in for COLMAP's patch-match, which needs CUDA: a flat map for every photo listed; the folders it ran in.

    Like COLMAP it makes no folders, and the system's temporary folder is on another file system where there is one.
    """
    folders = []

    def stereo(folder, _format, _option, options, cancellation_token):
        folders.append(folder)
        names = (folder / "stereo" / "patch-match.cfg").read_text().splitlines()[::2]
        for name in names:
            for part in ("depth_maps", "normal_maps", "consistency_graphs"):
                assert (folder / "stereo" / part / name).parent.is_dir()
            shape = (options.max_image_size * HEIGHT // WIDTH, options.max_image_size)
            write_depth(folder / "stereo" / "depth_maps" / f"{name}.geometric.bin", np.full(shape, 5, np.float32))
            normals = np.zeros((*shape, 3), np.float32)
            write_normals(folder / "stereo" / "normal_maps" / f"{name}.geometric.bin", normals)

    monkeypatch.setattr(pycolmap, "has_cuda", True)
    monkeypatch.setattr(pycolmap, "patch_match_stereo", stereo)
    if Path("/dev/shm").is_dir():
        monkeypatch.setattr(tempfile, "tempdir", "/dev/shm")
    return folders


def test_maps_of_patch_match_reach_their_place_from_subfolders_without_leaving_the_file_system(
    workspace, patch_match, tmp_path
):
    walks = tmp_path / "workspace"
    (walks / "sparse").mkdir(parents=True)
    model = pycolmap.Reconstruction(workspace / "sparse")
    for key, image in model.images.items():
        image.name = f"walk{key % 2}/{image.name}"
    model.write_binary(walks / "sparse")
    estimate_depth_maps(
        workspace=walks, chunk=0, chunks=2, settings=replace(DEPTH, backend="colmap", max_image_size_px=80), seed=0,
        depth=tmp_path / "depth" / "0", report=tmp_path / "depth" / "0.json",
    )  # fmt: skip
    assert read_depth(tmp_path / "depth/0/depth_maps/walk0/2.png.bin").shape == (60, 80)
    report = read_json(tmp_path / "depth/0.json")
    names = ["walk0/2.png", "walk1/1.png", "walk1/5.png"]
    assert value(report, "backend") == "colmap" and sorted(report["photos"]) == names
    assert read_normals(tmp_path / "depth/0/normal_maps/walk1/5.png.bin").shape == (60, 80, 3)
    # The temporary workspace lay beside the maps, and is gone.
    assert all(folder.is_relative_to(tmp_path / "depth") and not folder.exists() for folder in patch_match)
    assert sorted(p.name for p in (tmp_path / "depth").iterdir()) == ["0", "0.json"]


def test_a_photo_without_a_map_of_patch_match_is_named(workspace, patch_match, monkeypatch, tmp_path):
    monkeypatch.setattr(pycolmap, "patch_match_stereo", lambda *_, **__: None)
    with pytest.raises(StageError, match="patch-match left no 1.png.geometric.bin in depth_maps"):
        estimate_depth_maps(
            workspace=workspace, chunk=0, chunks=1, settings=replace(DEPTH, backend="colmap"), seed=0,
            depth=tmp_path / "depth", report=tmp_path / "depth.json",
        )  # fmt: skip
    assert not list(tmp_path.iterdir())


def test_errors_are_sentences(workspace, maps, tmp_path):
    outputs = {"depth": tmp_path / "d", "report": tmp_path / "d.json"}
    common = {"workspace": workspace, "settings": DEPTH, "seed": 0}
    with pytest.raises(StageError, match="chunk 2 of 2 does not exist"):
        estimate_depth_maps(chunk=2, chunks=2, **common, **outputs)
    if not pycolmap.has_cuda:
        with pytest.raises(StageError, match="needs CUDA"):
            estimate_depth_maps(
                chunk=0, chunks=1, **(common | {"settings": replace(DEPTH, backend="colmap")}), **outputs
            )
    with pytest.raises(StageError, match="not a readable COLMAP model"):
        estimate_depth_maps(chunk=0, chunks=1, **(common | {"workspace": tmp_path}), **outputs)
    fusion = {"workspace": workspace, "settings": FUSION, "cloud": tmp_path / "c.ply", "report": tmp_path / "c.json"}
    with pytest.raises(StageError, match="no depth maps in"):
        fuse_depth_maps(depth=[tmp_path], depth_json=[], **fusion)
    strict = replace(FUSION, min_photos=6)
    with pytest.raises(StageError, match="no point is seen alike by 6 photos"):
        fuse_depth_maps(
            depth=[maps / "0", maps / "1"],
            depth_json=[maps / "0.json", maps / "1.json"],
            **(fusion | {"settings": strict}),
        )
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["depth", "normal"])
def test_a_map_that_is_cut_short_is_an_error_that_names_it_and_its_stage(tmp_path, kind):
    path = tmp_path / "stage4" / f"{kind}_maps" / "walk/1.png.bin"
    pixels = np.ones((4, 5), np.float32)
    write_depth(path, pixels) if kind == "depth" else write_normals(path, np.dstack([pixels] * 3))
    read = read_depth if kind == "depth" else read_normals
    assert (read(path) == 1).all()
    path.write_bytes(path.read_bytes()[:-12])
    with pytest.raises(StageError, match=rf"{path} is cut short or damaged .*; delete {tmp_path}/stage4 and run again"):
        read(path)
