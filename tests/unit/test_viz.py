"""The renderer, the sheets and the figures of planted clouds."""

import cv2
import numpy as np
import pycolmap
import pytest
from support.changed_scene import write_changes

from scenefuse.cloud.clouds import Cloud, read_cloud, write_cloud
from scenefuse.core.stage import StageError, quantity, write_json
from scenefuse.core.transforms import Sim3
from scenefuse.photos.pictures import write_depth
from scenefuse.photos.sheets import draw_scale, draw_sheet, round_below
from scenefuse.photos.workspace import read_views
from scenefuse.report.figures import FigureInputs, draw_lone_object, draw_object, most_changed
from scenefuse.report.page import view_section
from scenefuse.report.render import Camera, brightened, camera_at, orbit_camera, point_radii, render
from scenefuse.report.scene_figures import draw_scene, view_scene
from scenefuse.report.view import Shown, read_view

GREEN, RED, BLUE = (0, 200, 0), (220, 0, 0), (0, 0, 220)


def plane(z, color, size=1.0, count=60):
    x, y = np.meshgrid(*[np.linspace(-size, size, count)] * 2)
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)
    return Cloud(points, None, np.tile(np.uint8(color), (len(points), 1)))


def join(*clouds):
    return Cloud(np.concatenate([c.points for c in clouds]), None, np.concatenate([c.colors for c in clouds]))


def test_projection_of_a_pinhole_camera_by_hand():
    camera = Camera(np.eye(3), np.array([0.0, 0.0, -2.0]), 100.0, 64, 48)
    pixels, depth = camera.project([[0.0, 0.0, 0.0], [0.4, -0.2, 2.0]])
    np.testing.assert_allclose(pixels, [[32, 24], [32 + 100 * 0.4 / 4, 24 - 100 * 0.2 / 4]])
    np.testing.assert_allclose(depth, [2, 4])


def test_projection_of_an_orthographic_camera_ignores_depth():
    camera = Camera(np.eye(3), np.zeros(3), 10.0, 64, 48, orthographic=True)
    pixels, _ = camera.project([[1.0, 2.0, 1.0], [1.0, 2.0, 9.0]])
    np.testing.assert_allclose(pixels, [[42, 44], [42, 44]])


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("elevation", [90.0, 20.0, -30.0])
def test_orbit_camera_frames_the_points_up_to_the_margin(orthographic, elevation):
    points = np.random.default_rng(0).uniform([-3, 4, 0], [1, 9, 2], (500, 3))
    camera = orbit_camera(points, 70.0, elevation, (200, 150), orthographic=orthographic, margin=0.1)
    pixels, depth = camera.project(points)
    assert (depth > 0).all()
    # The outermost point touches the margin of a tenth on each side: 0.8 of the half image.
    assert (np.abs(pixels - [100, 75]) / [100, 75]).max() == pytest.approx(0.8)


def test_a_camera_at_a_place_stays_there_and_frames_the_points_up_to_the_margin():
    points, place = np.random.default_rng(0).uniform([-3, 4, 0], [1, 9, 2], (500, 3)), np.array([6.0, -8.0, 1.5])
    camera = camera_at(place, points, (200, 150), margin=0.1)
    pixels, depth = camera.project(points)
    assert (depth > 0).all() and np.array_equal(camera.centre, place)
    assert (np.abs(pixels - [100, 75]) / [100, 75]).max() == pytest.approx(0.8)


@pytest.mark.parametrize("has_north", [True, False])
def test_a_map_has_a_scale_bar_of_a_round_length_and_an_arrow_where_north_is_known(has_north):
    sheet = draw_sheet("a", "b", [[("from above", np.full((300, 400, 3), 255, np.uint8))]])
    draw_scale(sheet.axes[0], 7.0, "m", has_north)
    (bar,) = sheet.axes[0].lines
    assert np.ptp(bar.get_xdata()) == pytest.approx(7 * 10)  # a quarter of the picture is 14.3 m
    said = {text.get_text(): text for text in sheet.axes[0].texts}
    assert "10 m" in said and ("N" in said) == has_north
    if has_north:  # the arrow points from the letter to the upper edge
        assert said["N"].xy[1] < said["N"].xyann[1] and said["N"].xy[0] == said["N"].xyann[0]
    assert [round_below(value) for value in (0.9, 1.0, 4.9, 5.1, 30.0)] == [0.5, 1, 2, 5, 20]


def test_text_of_a_sheet_of_larger_pictures_is_larger_and_its_pictures_keep_their_pixels():
    for size in ((400, 300), (800, 600)):
        picture = np.full((size[1], size[0], 3), 255, np.uint8)
        sheet = draw_sheet("a", "b", [[("c", picture)]], size)
        assert sheet.dpi == size[0] / 4
        assert sheet.axes[0].get_window_extent().size == pytest.approx(size, abs=1)


def test_a_place_of_a_sheet_without_picture_and_caption_has_no_frame():
    sheet = draw_sheet("a", "b", [[("seen", np.zeros((3, 4, 3), np.uint8)), ("lacking", None), ("", None)]])
    assert [axes.get_visible() for axes in sheet.axes] == [True, True, False]


def test_clouds_that_are_dark_together_are_drawn_brighter_by_one_factor():
    dark, darker = plane(0.0, (40, 20, 30)), plane(1.0, (20, 10, 15))
    bright = [cloud.colors[0] for cloud in brightened(dark, darker)]
    assert 120 < bright[0].max() <= 255 and np.abs(bright[0] - 2.0 * bright[1]).max() <= 2
    # A white wall beside a dark ground sets how far: its colour stays.
    for light, dim in ((plane(0.0, (250, 250, 250)), darker), (plane(0.0, (150, 150, 150), count=5), dark[[]])):
        assert brightened(light, dim)[0].colors[0].max() <= 255
        assert np.abs(brightened(light, dim)[0].colors[0] - light.colors[0].astype(int)).max() <= 5


@pytest.mark.parametrize("front", [-1.0, 1.0])
def test_the_large_picture_shows_the_front_of_what_was_added(front):
    y, z = (a.ravel() for a in np.meshgrid(*[np.linspace(-1, 1, 60)] * 2))
    points, normals = np.stack([0 * y, y, z], axis=1), np.tile([front, 0.0, 0.0], (len(y), 1))
    wall = Cloud(points, normals.astype("f4"), np.full((len(y), 3), 90, np.uint8))
    before, after = ((cloud, np.full(len(cloud), 0.05)) for cloud in (wall[z > 0.8], wall))
    assert most_changed([before, after], points) == (0.0 if front > 0 else 180.0)


def test_the_nearer_surface_hides_the_farther_one_and_holes_stay_background():
    camera = orbit_camera(plane(0, RED).points, 0.0, 90.0, (80, 80), orthographic=True, margin=0.0)
    near = plane(0.5, RED)
    hole = near[np.abs(near.points[:, :2]).max(1) > 0.4]
    image = render(join(hole, plane(0.0, GREEN)), camera, 0.03, eye_dome=0.0)
    np.testing.assert_array_equal(image[40, 40], GREEN)
    np.testing.assert_array_equal(image[40, 10], RED)
    alone = render(hole, camera, 0.03)
    assert (alone[40, 40] == 255).all()


def test_eye_dome_darkens_the_farther_side_of_a_step_only():
    left = plane(1.0, GREEN)
    scene = join(left[left.points[:, 0] < 0], plane(0.0, GREEN))
    camera = orbit_camera(plane(0, RED).points, 0.0, 90.0, (80, 80), orthographic=True)
    image = render(scene, camera, 0.03)[40, :, 1]
    assert image[20] == 200 and image[65] == 200
    assert image.min() < 150


@pytest.mark.parametrize("orthographic", [False, True])
def test_a_surface_seen_from_behind_is_grey(orthographic):
    # In its own colours a facade, whose back no photo saw, would show mirrored.
    base = plane(0, RED)
    cloud = Cloud(base.points, np.tile(np.float32([0, 0, 1]), (len(base), 1)), base.colors)
    for elevation, is_red in ((90.0, True), (-89.5, False)):
        camera = orbit_camera(cloud.points, 0.0, elevation, (40, 40), orthographic=orthographic)
        pixel = render(cloud, camera, 0.03, eye_dome=0)[20, 20].astype(int)
        assert (np.ptp(pixel) > 50) == is_red and pixel.max() < 250


def test_points_behind_the_camera_and_an_empty_cloud_draw_nothing():
    camera = Camera(np.eye(3), np.array([0.0, 0.0, 5.0]), 50.0, 20, 10)
    assert (render(plane(0, RED), camera, 0.1) == 255).all()
    assert (render(plane(0, RED)[np.zeros(3600, dtype=bool)], camera, 0.1) == 255).all()


def test_radii_follow_the_local_spacing():
    dense, sparse = plane(0, RED), plane(0, RED, size=8.0, count=40)
    sparse = sparse[np.abs(sparse.points[:, :2]).max(1) > 1.2]
    radii = point_radii(np.concatenate([dense.points, sparse.points]), factor=1.0, limit=20.0)
    assert np.median(radii[: len(dense)]) == pytest.approx(2 / 59, rel=1e-4)
    assert np.median(radii[len(dense) :]) == pytest.approx(16 / 39, rel=1e-4)


def test_dense_points_that_come_in_leave_the_discs_of_a_sparse_scene_as_they_are():
    sparse, dense = plane(0, RED, size=8.0, count=40), plane(0, RED, size=1.0, count=200)
    around = sparse[np.abs(sparse.points[:, :2]).max(1) > 1.2]
    points = np.concatenate([around.points, dense.points])
    source = np.repeat(np.array([0, 1], np.uint8), [len(around), len(dense)])
    discs = point_radii(points, source=source)
    np.testing.assert_allclose(np.median(discs[: len(around)]), np.median(point_radii(sparse.points)), rtol=1e-4)
    assert np.median(point_radii(points)[: len(around)]) < 0.5 * np.median(discs[: len(around)])


@pytest.mark.parametrize("height", [0.3, 50.0])
def test_a_stray_point_is_hardly_larger_than_those_of_the_surface(height):
    points = np.concatenate([plane(0, RED).points, [[0.0, 0.0, height]]])
    assert point_radii(points, factor=1.0)[-1] <= 1.5 * 2 / 59


def test_a_scene_point_among_dense_ones_does_not_hide_them():
    fine = plane(0.0, GREEN, count=120)
    coarse = plane(0.01, RED, size=8.0, count=40)
    cloud = join(fine, coarse)
    camera = orbit_camera(fine.points, 0.0, 90.0, (200, 200), orthographic=True, margin=0.0)
    image = render(cloud, camera, point_radii(cloud.points, limit=20.0), eye_dome=0.0)
    assert (image[..., 0] > 150).mean() < 0.02


def test_random_points_make_a_closed_surface_at_full_density():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (20_000, 3)) * [1, 1, 0]
    cloud = Cloud(points, np.tile(np.float32([0, 0, 1]), (20_000, 1)), np.tile(np.uint8(GREEN), (20_000, 1)))
    for elevation in (90.0, 35.0):
        camera = orbit_camera(points, 0.0, elevation, (200, 200), orthographic=True, margin=0.0)
        image = render(cloud, camera, point_radii(points))
        inside = camera.project(points[np.abs(points).max(1) < 0.9])[0].astype(int)
        seen = image[inside[:, 1], inside[:, 0]]
        assert (seen[:, 2] < 100).mean() > 0.98


def test_discs_lie_in_the_surface():
    flat = Cloud(np.zeros((1, 3)), np.float32([[0, 0, 1]]), np.uint8([GREEN]))
    covered = []
    for elevation in (90.0, 45.0, 5.0):
        camera = orbit_camera(box_surface(50, 0).points, 0.0, elevation, (200, 200), orthographic=True)
        covered.append(int((render(flat, camera, 0.5).min(2) < 250).sum()))
    assert covered[1] / covered[0] == pytest.approx(np.sin(np.pi / 4), rel=0.05)
    # Seen edge-on it keeps two thirds of its width.
    assert 0.55 < covered[2] / covered[0] < 0.75
    facing = render(Cloud(flat.points, None, flat.colors), camera, 0.5)
    assert (facing.min(2) < 250).sum() == pytest.approx(covered[0], rel=0.3)


def box_surface(count, seed):
    """Points on the surface of a box 2 x 1 x 1 that stands on z = 0, coloured by side."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, 3))
    side = rng.integers(0, 3, count)
    points[np.arange(count), side] = rng.choice([-1.0, 1.0], count)
    colors = np.array([RED, GREEN, BLUE], dtype=np.uint8)[side]
    return Cloud((points * [1.0, 0.5, 0.5]) + [0, 0, 0.5], None, colors)


@pytest.fixture(autouse=True, scope="module")
def small_pictures():
    with pytest.MonkeyPatch.context() as patch:
        for module in ("figures", "scene_figures"):
            patch.setattr(f"scenefuse.report.{module}.TILE_PX", (160, 120))
        yield


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Everything the figures read, for a box whose lower half the scene misses."""
    folder = tmp_path_factory.mktemp("capture")
    whole = box_surface(6000, 0)
    half = whole[whole.points[:, 2] > 0.5]
    ground = plane(0.0, (120, 120, 120), size=4.0, count=80)
    scene = join(ground, half)
    added = whole[whole.points[:, 2] <= 0.5]
    fused = join(scene, added)
    source = np.repeat(np.uint8([0, 1]), [len(scene), len(added)])
    pose = Sim3(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]))
    write_cloud(folder / "dense.ply", scene)
    write_cloud(folder / "completed.ply", Cloud(fused.points, None, fused.colors, {"source": source}))
    write_changes(folder, scene, added)
    write_cloud(folder / "box/registration/full/crop.ply", half)
    write_cloud(folder / "object.ply", whole.transformed(pose.inverse()))
    top = np.stack([*(a.ravel() for a in np.meshgrid(np.linspace(-0.5, 0.5, 20), [-0.1, 0, 0.1])), np.ones(60)], axis=1)
    kinds = np.where(top[:, 0] < 0, 1, 2).astype(np.uint8)
    write_cloud(folder / "missing.ply", Cloud(top, None, None, {"missing": kinds}))
    write_json(folder / "missing.json", {"missing": quantity(0.1, "")})
    (folder / "next_photos.csv").write_text(
        "station,photo,local_x_m,local_y_m,local_z_m\n1,1,3,0,3\n1,2,3,1,3\n1,3,3,2,3\n"
    )
    write_json(folder / "crop.json", {"diagonal": quantity(2.4, "m")})
    model = pycolmap.Reconstruction()
    pinhole = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[60, 60, 32, 24], camera_id=1)
    model.add_camera_with_trivial_rig(pinhole)
    (folder / "undistorted/images").mkdir(parents=True)
    (folder / "undistorted/sparse").mkdir()
    (folder / "masks").mkdir()
    for k in range(4):
        camera = orbit_camera(whole.points, 90.0 * k, 20.0, (64, 48))
        pose_of_camera = pycolmap.Rigid3d(
            pycolmap.Rotation3d(camera.cam_from_world), -camera.cam_from_world @ camera.centre
        )
        image = pycolmap.Image(name=f"{k}.png", camera_id=1, image_id=k + 1)
        model.add_image_with_trivial_frame(image, pose_of_camera)
        picture = render(whole, camera, 0.05)
        cv2.imwrite(str(folder / f"undistorted/images/{k}.png"), picture)
        cv2.imwrite(str(folder / f"masks/{k}.png"), (picture.min(2) < 255).astype(np.uint8) * 255)
        write_depth(folder / f"stage1/depth_maps/{k}.png.bin", np.full((24, 32), 3.0, dtype=np.float32))
    model.write(folder / "undistorted/sparse")
    for stage in (2, 3, 4):
        (folder / f"stage{stage}").mkdir()
    return folder


POSE = Sim3(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]))
REGISTERED = {
    "status": quantity("registered", ""),
    "reason": quantity("both agree", ""),
    "scene_from_object": quantity(POSE.matrix, ""),
}


def draw(capture, fine, figures):
    write_json(capture / "fine.json", fine)
    inputs = FigureInputs(
        name="box",
        scene=capture / "dense.ply",
        fused=capture / "fused.ply",
        checked=capture / "checked.ply",
        crop=capture / "box/registration/full/crop.ply",
        crop_json=capture / "crop.json",
        object_cloud=capture / "object.ply",
        fine_json=capture / "fine.json",
        missing=capture / "missing.ply",
        missing_json=capture / "missing.json",
        next_photos=capture / "next_photos.csv",
        workspace=capture / "undistorted",
        masks=capture / "masks",
        stages=[capture / f"stage{stage}" for stage in (1, 2, 3, 4)],
    )
    draw_object(inputs=inputs, figures=figures)


@pytest.fixture(scope="module")
def figures(capture, tmp_path_factory):
    """The figures of the box, registered; only to be read."""
    folder = tmp_path_factory.mktemp("drawn") / "figures"
    draw(capture, REGISTERED, folder)
    return folder


def test_an_object_by_itself_is_drawn_and_can_be_turned(capture, tmp_path):
    stages = tuple(capture / f"stage{stage}" for stage in (1, 2, 3, 4))
    places = {"object_cloud": capture / "object.ply", "workspace": capture / "undistorted", "masks": capture / "masks"}
    write_json(tmp_path / "sparse.json", {"length_unit": quantity("m", "")})
    places["sparse_json"] = tmp_path / "sparse.json"
    draw_lone_object(name="box", **places, stages=stages, figures=tmp_path / "figures")
    assert read_view(tmp_path / "figures").unit == "m"
    assert {p.name for p in (tmp_path / "figures").iterdir()} == {"object.png", "view.ply", "view.json"}
    view = read_view(tmp_path / "figures")
    assert len(view.cloud) == 6000 and not view.cloud.fields["shown"].any()
    section = view_section("object-box", "box", view)
    assert '<fieldset class="when" hidden>' in section and '<fieldset class="colour">' in section


@pytest.mark.slow
def test_figures_show_what_was_added(figures):
    names = {
        "missing.png",
        "before_after.png",
        "object.png",
        "before.png",
        "after.png",
    }
    assert {p.name for p in figures.iterdir()} == names | {"view.ply", "view.json"}
    before, after = (cv2.imread(str(figures / f"{n}.png")).astype(float) for n in ("before", "after"))
    assert (np.abs(before - after).max(2) > 40).mean() > 0.02
    colors = cv2.cvtColor(cv2.imread(str(figures / "missing.png")), cv2.COLOR_BGR2RGB).astype(int)
    for first, last in ((0, 1), (1, 2)):  # red, yellow
        assert (colors[..., first] - colors[..., last] > 70).sum() > 50


@pytest.mark.slow
def test_stations_are_named_by_where_they_stand_if_north_is_known(capture, tmp_path, monkeypatch):
    labels = list[str]()

    def sheet(title, note, rows, **options):
        labels.extend(caption for row in rows for caption, _ in row)
        return draw_sheet(title, note, rows, **options)

    monkeypatch.setattr("scenefuse.report.figures.draw_sheet", sheet)
    table, plain = capture / "next_photos.csv", (capture / "next_photos.csv").read_text()
    draw(capture, REGISTERED, tmp_path / "plain")
    table.write_text(plain.replace("photo,", "photo,longitude_deg,").replace("1,2,3,1,3", "1,2,8.5,3,1,3"))
    draw(capture, REGISTERED, tmp_path / "placed")
    table.write_text(plain)
    assert [label for label in labels if "station 1" in label] == [
        "from station 1, 3.2 m away, 3 m up",
        "from station 1, 3.2 m east of it, 3 m up",
    ]


@pytest.mark.slow
def test_an_object_that_lacks_nothing_is_drawn(capture, tmp_path):
    kept = {name: (capture / name).read_bytes() for name in ("missing.ply", "missing.json", "next_photos.csv")}
    write_cloud(capture / "missing.ply", Cloud(np.zeros((0, 3)), None, None, {"missing": np.zeros(0, np.uint8)}))
    write_json(capture / "missing.json", {"missing": quantity(0.0, "")})
    (capture / "next_photos.csv").write_text("station,photo\n")
    draw(capture, REGISTERED, tmp_path / "figures")
    assert (tmp_path / "figures/missing.png").is_file()
    for name, content in kept.items():
        (capture / name).write_bytes(content)


def test_the_3d_view_holds_the_scene_before_and_what_was_added(figures):
    view = read_view(figures)
    shown, source = view.cloud.fields["shown"], view.cloud.fields["source"]
    assert set(shown) == {Shown.BOTH, Shown.AFTER}
    np.testing.assert_array_equal(source == 1, shown == Shown.AFTER)
    assert (view.cloud.points[shown == Shown.AFTER][:, 2] <= 0.5 + 1e-9).all()
    assert view.after_points - view.before_points == (shown == Shown.AFTER).sum()
    assert (view.unit, view.sources[1]) == ("m", "added from box")
    np.testing.assert_allclose([view.low, view.high], [[-1, -0.5, 0], [1, 0.5, 1]], atol=0.05)


def test_the_3d_view_of_a_scene_names_its_objects_and_leaves_stray_points_out(capture, tmp_path):
    scene, fused = read_cloud(capture / "dense.ply"), read_cloud(capture / "completed.ply")
    far = Cloud(np.array([[900.0, 0, 0]]), None, np.uint8([RED]))
    write_cloud(tmp_path / "dense.ply", join(scene, far))
    about = {"sources": quantity({"0": "scene", "1": "box"}, ""), "scene_points": quantity(len(scene), "points")}
    write_json(tmp_path / "completed.json", about)
    write_json(tmp_path / "georeference.json", {"length_unit": quantity("m", "")})
    jsons = {"completed_json": tmp_path / "completed.json", "georeference_json": tmp_path / "georeference.json"}
    dense = tmp_path / "dense.ply"
    view_scene(dense=dense, completed=capture / "completed.ply", **jsons, folder=tmp_path / "view")
    view = read_view(tmp_path / "view")
    assert (view.sources, view.unit) == ({0: "scene", 1: "box"}, "m")
    assert view.cloud.points.max() < 10 and len(view.cloud) == len(fused)


def test_the_3d_view_of_a_large_scene_shows_one_in_so_many_points_and_all_of_an_object(capture, tmp_path, monkeypatch):
    monkeypatch.setattr("scenefuse.report.scene_figures.MAX_DRAWN", 2000)
    scene, fused = read_cloud(capture / "dense.ply"), read_cloud(capture / "completed.ply")
    about = {"sources": quantity({"0": "scene", "1": "box"}, ""), "scene_points": quantity(len(scene), "points")}
    write_json(tmp_path / "completed.json", about)
    write_json(tmp_path / "georeference.json", {"length_unit": quantity("m", "")})
    jsons = {"completed_json": tmp_path / "completed.json", "georeference_json": tmp_path / "georeference.json"}
    view_scene(dense=capture / "dense.ply", completed=capture / "completed.ply", **jsons, folder=tmp_path / "view")
    view = read_view(tmp_path / "view")
    shown, source = view.cloud.fields["shown"], view.cloud.fields["source"]
    # The same points of the scene before and after, so that none seems to come or go.
    assert (source == 1).sum() == (shown == Shown.AFTER).sum() == len(fused) - len(scene)
    every = -(-len(scene) // 2000)
    assert set(shown) == {Shown.BOTH, Shown.AFTER} and (shown == Shown.BOTH).sum() == pytest.approx(
        len(scene) / every, rel=0.1
    )
    assert (view.before_points, view.after_points) == (len(scene), len(fused))


@pytest.mark.slow
def test_a_refused_object_without_a_pose_still_gets_its_figures(capture, tmp_path):
    fine = {"status": quantity("unregistered", ""), "reason": quantity("two poses fit equally well", "")}
    draw(capture, fine, tmp_path / "figures")
    assert (tmp_path / "figures/before_after.png").is_file()
    assert read_view(tmp_path / "figures") is None


def test_an_object_far_from_the_scene_is_named(capture, tmp_path):
    pose = Sim3(2.0, np.eye(3), np.array([500.0, 0, 0]))
    fine = {"status": quantity("registered", ""), "scene_from_object": quantity(pose.matrix, "")}
    with pytest.raises(StageError, match="no points around box"):
        draw(capture, fine, tmp_path / "figures")
    assert not (tmp_path / "figures").exists()


def test_scene_figure_with_a_failed_object(capture, tmp_path):
    figure = tmp_path / "scene.png"
    objects = [capture / "box", capture / "failed"]
    files = {"dense": capture / "dense.ply", "georeferenced": capture / "undistorted/sparse"}
    draw_scene(name="demo", **files, objects=objects, failed=("failed",), figure=figure)
    picture = cv2.imread(str(figure)).astype(int)
    # Camera markers are red on a grey scene.
    assert ((picture[..., 2] > 180) & (picture[..., 1] < 70)).sum() > 50
    with pytest.raises(StageError, match="failed/registration/full/crop.ply"):
        draw_scene(name="demo", **files, objects=objects, figure=figure)


def test_the_scene_s_sheet_has_an_arrow_to_the_north_in_a_crs_only(capture, tmp_path):
    figure, about = tmp_path / "scene.png", tmp_path / "georeference.json"

    def drawn(crs):
        place = {"crs": quantity(crs, ""), "origin_in_crs": quantity([4e5, 5e6, 0.0], "m")}
        write_json(about, {"length_unit": quantity("m", ""), **place})
        draw_scene(name="demo", dense=capture / "dense.ply", georeference_json=about, objects=[], figure=figure)
        return (cv2.imread(str(figure)) < 40).all(2).sum()

    # A cloud whose file names no CRS has one that is null.
    assert drawn("EPSG:25832") > drawn(None) + 20
    # South Africa's coordinates count to the west and to the south.
    assert drawn("EPSG:2048") == drawn(None)


def test_the_scene_s_sheet_shows_the_errors_of_cameras_in_their_colour(capture, tmp_path):
    model = capture / "undistorted/sparse"
    names = [view.name for view in read_views(model)]
    table = tmp_path / "residuals.tsv"

    def blue(up_m):
        rows = [f"position\t{name}\t1.0\t1.0\t{up_m if k else -9.0}" for k, name in enumerate(names)]
        table.write_text("\n".join(["kind\tname\teast_m\tnorth_m\tup_m", *rows]))
        draw_scene(
            name="demo", dense=capture / "dense.ply", georeferenced=model, residuals=table, objects=[],
            figure=tmp_path / "scene.png",
        )  # fmt: skip
        picture = cv2.imread(str(tmp_path / "scene.png")).astype(int)
        errors = picture[picture.shape[0] // 2 :, picture.shape[1] // 2 :]
        return ((errors[..., 0] - errors[..., 2]) > 60).sum()

    # All cameras too low (blue) but for the first, which sets the range of colours both times; then too high (red).
    assert blue(-8.0) > 2 * blue(8.0) > 0
