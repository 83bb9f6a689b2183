"""Views project as COLMAP does, and a workspace is read whole or refused with a sentence."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest

from scenefuse.core.stage import StageError
from scenefuse.photos.workspace import View, read_model, read_workspace, write_model

POINTS = np.array([[0.1, -0.2, 4.0], [0.4, 0.3, 5.0], [-0.5, 0.1, 6.0], [0.0, 0.0, -3.0], [9.0, 0.0, 4.0]])


@pytest.fixture
def folder(tmp_path):
    """Two photos, out of name order, of five points; the last is in no photo, the fourth is behind both cameras."""
    (tmp_path / "images").mkdir()
    (tmp_path / "sparse").mkdir()
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=80, height=60, params=[70, 72, 41, 29])
    )
    ids = [model.add_point3D(p, pycolmap.Track(), np.zeros(3, np.uint8)) for p in POINTS[:3]]
    for k, name in enumerate(("b.png", "a.png"), 1):
        turn = pycolmap.Rotation3d(np.array([0.0, np.sin(0.05 * k), 0.0, np.cos(0.05 * k)]))
        image = pycolmap.Image(name=name, camera_id=1, image_id=k)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D([10.0 * j, 5.0 * k]) for j in range(3)])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(turn, np.array([0.1 * k, 0.0, 0.2])))
        for j, point in enumerate(ids[: k + 1]):
            model.add_observation(point, pycolmap.TrackElement(k, j))
        cv2.imwrite(str(tmp_path / "images" / name), np.full((60, 80, 3), 40 * k, np.uint8))
    model.write_binary(tmp_path / "sparse")
    return tmp_path


def test_a_view_projects_as_colmap_does(folder):
    workspace, model = read_workspace(folder), pycolmap.Reconstruction(folder / "sparse")
    for view in workspace.views:
        image = next(i for i in model.images.values() if i.name == view.name)
        expected = np.array([image.project_point(p) for p in POINTS[:3]])
        pixels, depth = view.project(POINTS)
        np.testing.assert_allclose(pixels[:3], expected)
        assert (depth[:3] > 0).all() and depth[3] < 0
        homogeneous = np.column_stack([POINTS[:3], np.ones(3)]) @ view.projection.T
        np.testing.assert_allclose(homogeneous[:, :2] / homogeneous[:, 2:], expected)
        np.testing.assert_allclose(view.centre, image.projection_center())
        np.testing.assert_allclose(view.world_from_cam @ view.cam_from_world, np.eye(4), atol=1e-12)


def test_only_points_in_the_frame_are_visible(folder):
    view = read_workspace(folder).views[0]
    rows, pixels, depth = view.visible(POINTS)
    assert rows.tolist() == [0, 1, 2] and (depth > 0).all()
    np.testing.assert_array_equal(pixels, np.floor(view.project(POINTS[:3])[0]))


def test_a_workspace_is_in_the_order_of_names_with_what_each_photo_observes(folder):
    workspace = read_workspace(folder)
    assert [view.name for view in workspace.views] == ["a.png", "b.png"]
    np.testing.assert_allclose(workspace.points, POINTS[:3])
    assert [rows.tolist() for rows in workspace.seen] == [[0, 1, 2], [0, 1]]
    assert workspace.seen_at[0].tolist() == [[0, 10], [10, 10], [20, 10]]
    assert (workspace.rgb(workspace.views[0]).pixels == 80).all() and workspace.gray(
        workspace.views[1]
    ).pixels.max() == 40


def test_a_smaller_view_sees_the_same(folder):
    view = read_workspace(folder).rgb(read_workspace(folder).views[0])
    small = view.at_most(40)
    assert (small.width, small.height, small.pixels.shape) == (40, 30, (30, 40, 3))
    np.testing.assert_allclose(small.project(POINTS[:3])[0], view.project(POINTS[:3])[0] / 2)
    assert view.at_most(400) is view


def test_what_cannot_be_read_is_named(folder):
    workspace = read_workspace(folder)
    (folder / "images/a.png").unlink()
    with pytest.raises(StageError, match=r"images/a.png does not exist"):
        workspace.gray(workspace.views[0])
    cv2.imwrite(str(folder / "images/b.png"), np.zeros((30, 40, 3), np.uint8))
    with pytest.raises(StageError, match="40 x 30 pixels, but its camera is made for 80 x 60"):
        workspace.rgb(workspace.views[1])
    (folder / "sparse/images.bin").write_bytes(b"12")
    with pytest.raises(StageError, match="sparse is not a readable COLMAP model"):
        read_workspace(folder)


def test_a_model_with_distortion_is_no_workspace(folder):
    model = pycolmap.Reconstruction(folder / "sparse")
    model.cameras[1] = pycolmap.Camera(
        camera_id=1, model="SIMPLE_RADIAL", width=80, height=60, params=[70, 40, 30, 0.1]
    )
    model.write_binary(folder / "sparse")
    with pytest.raises(StageError, match="undistort the photos first"):
        read_workspace(folder)


def test_views_are_values():
    view = View("x", np.eye(3), np.eye(4), 4, 3)
    assert replace(view, name="y").name == "y" and view.pixels is None


def test_a_written_model_is_read_back_and_shares_its_cameras(folder, tmp_path):
    views = read_workspace(folder).views
    views.append(replace(views[0], name="c.png", width=40))
    (tmp_path / "again/sparse").mkdir(parents=True)
    write_model(tmp_path / "again/sparse", views)
    again = read_workspace(tmp_path / "again").views
    assert [(v.name, v.width, v.height) for v in again] == [("a.png", 80, 60), ("b.png", 80, 60), ("c.png", 40, 60)]
    for view, before in zip(again, views):
        np.testing.assert_allclose(view.cam_from_world, before.cam_from_world, atol=1e-12)
        np.testing.assert_array_equal(view.intrinsics, before.intrinsics)
    assert pycolmap.Reconstruction(tmp_path / "again/sparse").num_cameras() == 2


def test_cameras_that_are_cut_short_are_an_error(folder):
    path = folder / "sparse/cameras.bin"
    path.write_bytes(path.read_bytes()[:-16])
    with pytest.raises(StageError, match=r"sparse is not a readable COLMAP model \(cameras\.bin is cut short"):
        read_model(folder / "sparse")


def test_points_that_are_cut_short_are_an_error_before_they_take_memory(folder):
    path = folder / "sparse/points3D.bin"
    assert read_model(folder / "sparse").num_points3D() == 3
    whole = path.read_bytes()
    for damaged in (whole[:-1], whole[:20], whole[:51] + b"\xff" * 8 + whole[59:]):
        path.write_bytes(damaged)
        with pytest.raises(StageError, match=r"\(points3D\.bin is cut short\)"):
            read_model(folder / "sparse")
