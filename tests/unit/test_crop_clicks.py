"""A few clicks in one photo of the scene find the object there."""

from dataclasses import replace

import numpy as np
import pytest

from scenefuse.cloud import tiled_cloud
from scenefuse.cloud.clouds import Cloud, read_cloud
from scenefuse.cloud.tiled_cloud import write_tiled
from scenefuse.core.stage import StageError, read_json, value
from scenefuse.core.transforms import look_at
from scenefuse.crop.crop_cloud import CropSettings
from scenefuse.crop.crop_scene import CropInputs, crop_scene
from scenefuse.crop.marked import SceneClicks, crop_grown
from scenefuse.marks.clicks import read_points
from scenefuse.photos.workspace import View, write_model

SIZE = np.array([6.0, 4.0, 3.0])
"""Of the shed, which stands about the origin of the yard."""


def shell(size, middle, count, seed):
    """Points on the faces of an upright box, without its bottom."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    side = np.array([(0, -0.5), (0, 0.5), (1, -0.5), (1, 0.5), (2, 0.5)])[rng.integers(0, 5, count)]
    points[np.arange(count), side[:, 0].astype(int)] = side[:, 1]
    return points * size + middle


def ground(seed):
    return np.random.default_rng(seed).uniform([-20, -20, 0], [20, 20, 0.02], (40000, 3))


YARD = np.concatenate([shell(SIZE, [0, 0, 1.5], 9000, 0), ground(1)])
OWN = np.arange(len(YARD)) < 9000
EYE = np.array([12.0, -18.0, 14.0])
CORNERS = [(-2.8, -2, 2.8), (2.8, -2, 2.8), (2.8, -2, 0.3), (3, 1.8, 2.8), (0, 0, 3)]
"""Where somebody clicks: on the roof, and on the two walls that the photo shows."""


def photo(eye=EYE, name="drone 1.jpg"):
    pose = np.eye(4)
    pose[:3, :3] = look_at(eye, np.zeros(3), np.array([0, 0, 1.0]))
    pose[:3, 3] = -pose[:3, :3] @ eye
    return View(name, np.array([[700, 0, 400], [0, 700, 300], [0, 0, 1.0]]), pose, 800, 600)


@pytest.fixture
def crop(tmp_path):
    """Crop a scene by rows (label, point in the scene or pixel); what is kept, and the report."""

    def run(rows, points=YARD, view=None, **settings):
        view = view or photo()
        lines = [
            f"{label}\t{view.name}\t{x:.1f}\t{y:.1f}"
            for label, at in rows
            for x, y in [at if len(at) == 2 else view.project(np.array([at], float))[0][0]]
        ]
        (tmp_path / "clicks.tsv").write_text("label\tphoto\tx_px\ty_px\n" + "\n".join(lines) + "\n")
        (tmp_path / "sparse").mkdir(exist_ok=True)
        write_model(tmp_path / "sparse", [view, photo(EYE * [-1, 1, 1], "drone 2.jpg")])
        write_tiled(tmp_path / "dense.ply", lambda: [Cloud(points)], len(points), points)
        inputs = CropInputs(scene=tmp_path / "dense.ply", sparse=tmp_path / "sparse", fiducials=tmp_path / "clicks.tsv")
        report = tmp_path / "crop.json"
        crop_scene(inputs=inputs, crop=tmp_path / "crop.ply", report=report, settings=CropSettings(**settings))
        kept = {tuple(p) for p in np.round(read_cloud(tmp_path / "crop.ply").points, 4)}
        return np.array([tuple(p) in kept for p in np.round(points, 4)]), read_json(report)

    return run


def inside(*points):
    return [("inside", point) for point in points]


@pytest.mark.slow
def test_five_clicks_in_one_photo_cut_out_all_sides_of_the_object(crop):
    kept, report = crop(inside(*CORNERS))
    # The walls away from the camera too; points in the ground's thickness go with the ground.
    assert kept[OWN].mean() > 0.9 and kept[~OWN].sum() < 0.02 * kept.sum()
    hidden = OWN & (YARD[:, 1] > 1.99) & (YARD[:, 2] > 0.5)
    assert hidden.sum() > 1000 and kept[hidden].mean() > 0.99
    assert value(report, "mode") == "clicks" and len(value(report, "fiducials")) == 5
    # Not by the clicks' own box alone: from the roof it grows down to the foot.
    roof = crop(inside((-2, -1.5, 3), (2, -1.5, 3), (2, 1.5, 3), (-2, 1.5, 3)))[0]
    assert roof[OWN].mean() > 0.9 and roof[~OWN].sum() < 0.02 * roof.sum()
    # The paper's crop is a box of points; clicks in one photo have none, and are grown all the same.
    assert (crop(inside(*CORNERS), minimal=True)[0] == kept).all()


def test_clicks_have_the_depth_of_the_nearest_surface(crop):
    report = crop(inside(*CORNERS))[1]
    np.testing.assert_allclose(value(report, "fiducials"), CORNERS, atol=0.35)


def test_a_stray_point_before_the_surface_does_not_say_where_a_click_is(crop):
    stray = EYE + 0.4 * (np.array(CORNERS[0]) - EYE)
    clicks = [("inside", corner) for corner in CORNERS]
    kept, report = crop(clicks, np.concatenate([YARD, stray[None]]))
    without, plain = crop(clicks)
    assert value(report, "box_low") == pytest.approx(value(plain, "box_low"), abs=0.05)
    assert kept[:-1][OWN].sum() == without[OWN].sum()


def test_clicks_on_an_object_of_few_points_are_not_of_the_dense_ground_behind_it(crop):
    """A drone shows walls obliquely: here with an eighth of the ground's points per area, a third as near."""
    own, lawn = (
        shell(SIZE, [0, 0, 1.5], 2000, 0),
        np.random.default_rng(1).uniform([-8, -8, 0], [8, 8, 0.02], (58000, 3)),
    )
    kept, report = crop(inside(*CORNERS), np.concatenate([own, lawn]))
    assert np.linalg.norm(np.subtract(value(report, "fiducials"), CORNERS), axis=1).max() < 1
    assert kept[:2000].mean() > 0.9 and kept[2000:].sum() < 0.02 * kept.sum()


def test_in_a_large_scene_clicks_find_the_object_in_the_tiles_along_their_rays(crop, monkeypatch):
    # Ground like the yard's as far as one sees, and a roof behind the photo's back.
    far = np.random.default_rng(5).uniform([-50, -50, 0], [50, 50, 0.02], (250_000, 3))
    far = far[(np.abs(far[:, :2]) > 20).any(1)]
    points = np.concatenate([YARD, far, shell(SIZE, EYE + [4, -6, 3], 3000, 6)])
    monkeypatch.setattr(tiled_cloud, "WHOLE", 2000)
    monkeypatch.setattr(tiled_cloud, "TILE", 1000)
    whole, read = tiled_cloud.TiledCloud.read, []
    monkeypatch.setattr(tiled_cloud.TiledCloud, "read", lambda *tiles: read.append(len(tiles[1])) or whole(*tiles))
    kept, report = crop(inside(*CORNERS), points)
    assert kept[: len(YARD)][OWN].mean() > 0.9 and kept.sum() < 1.02 * kept[: len(YARD)][OWN].sum()
    np.testing.assert_allclose(value(report, "fiducials"), CORNERS, atol=0.35)
    assert max(read) < 0.7 * len(points) / 1000


BESIDE = np.concatenate([YARD, shell([4, 4, 2.5], [5.0, 0, 1.25], 6000, 2)])


@pytest.mark.slow
def test_clicks_outside_or_a_box_leave_out_what_touches_the_object(crop):
    other = np.arange(len(BESIDE)) >= len(YARD)
    on_roof = inside((-2.8, -2, 2.8), (2.8, -2, 2.8), (-2.8, -2, 0.4), (0, 0, 3))
    assert crop(on_roof, BESIDE)[0][other].mean() > 0.5
    told = [("outside", (5, -2, 1.0)), ("outside", (5, 0, 2.5)), ("outside", (3.3, 1.8, 2.5))]
    kept = crop(on_roof + told, BESIDE)[0]
    assert kept[other].mean() < 0.15 and kept[: len(OWN)][OWN].mean() > 0.7
    view = photo(np.array([0.0, -0.1, 25.0]))
    corners = view.project(np.array([[-3.3, -2.3, 3.0], [3.2, 2.3, 3.0]]))[0]
    kept = crop([*on_roof, *(("box", tuple(c)) for c in corners)], BESIDE, view)[0]
    # A fifth of the other is the wall that they share.
    assert kept[other].mean() < 0.3 and kept[: len(OWN)][OWN].mean() > 0.85


def test_a_box_that_ends_at_the_photo_s_edge_does_not_end_the_object_there(crop):
    eye, pose = 0.55 * EYE, np.eye(4)
    pose[:3, :3] = look_at(eye, np.array([5, 3.5, 0]), np.array([0, 0, 1.0]))
    pose[:3, 3] = -pose[:3, :3] @ eye
    view = replace(photo(), cam_from_world=pose)
    shown, clicks = view.project(YARD[OWN])[0], inside((2.8, -2, 0.3), (3, 1.8, 2.8), (1, -2, 1.5), (0, 1, 3))
    assert 0.6 < len(view.visible(YARD[OWN])[0]) / 9000 < 0.7  # beyond its left edge
    corners = (0.0, shown[:, 1].min() - 3), tuple(shown.max(0) + 3)
    kept, _ = crop([*clicks, *(("box", corner) for corner in corners)], YARD[::2], view)
    assert kept[:4500].mean() > 0.9


def test_from_a_dense_roof_the_crop_grows_down_walls_of_few_points():
    """A drone that looks straight down shows a wall with a tenth of a roof's points per area."""
    rng, walls = np.random.default_rng(0), shell(SIZE, [0, 0, 1.5], 840, 0)
    roof = np.c_[rng.uniform([-3, -2], [3, 2], (2400, 2)), np.full(2400, 3.0)]
    points = np.concatenate([walls[walls[:, 2] < 2.99], roof, rng.uniform([-9, -9, 0], [9, 9, 0.02], (32400, 3))])
    corners = np.array([(-2, -1.5, 3), (2, -1.5, 3), (2, 1.5, 3), (-2, 1.5, 3)])
    cut = crop_grown(Cloud(points), corners, CropSettings(), np.zeros(len(points), bool))
    assert cut.keep[points[:, 2] > 0.3].mean() > 0.98 and cut.keep[points[:, 2] < 0.02].mean() < 0.01


@pytest.mark.slow
def test_what_is_connected_with_something_much_larger_is_the_box_of_the_clicks_and_that_is_said(crop):
    row = np.concatenate([YARD, shell([30, 4, 3], [18, 0, 1.5], 40000, 3)])
    kept, report = crop(inside((-2.8, -2, 2.8), (-0.5, -2, 2.8), (-2.8, -2, 0.4), (-1, 0, 3)), row)
    assert "reaches more than 3 times as far" in value(report, "notes")[0]
    assert row[kept, 0].max() < 1.5


def test_a_click_on_the_sky_is_left_out_and_named_and_too_few_are_an_error(crop):
    report = crop(inside(*CORNERS, (700.0, 2.0)), view=photo(np.array([12.0, -18.0, 4.0])))[1]
    assert value(report, "notes")[0].startswith("the click inside (700, 2) in drone 1.jpg")
    with pytest.raises(StageError, match=r"2 clicks inside .* 3 are needed \(the click inside \(700, 2\)"):
        crop(inside(*CORNERS[:2], (700.0, 2.0)), view=photo(np.array([12.0, -18.0, 4.0])))


def test_a_click_in_a_scene_photo_without_a_camera_is_left_out_and_named(crop, monkeypatch):
    def with_lost(path):
        marked = read_points(path)
        return replace(marked, rows=(*marked.rows[:-1], replace(marked.rows[-1], photo="drone 3.jpg")))

    monkeypatch.setattr("scenefuse.crop.crop_scene.read_points", with_lost)
    note = value(crop(inside(*CORNERS, (1, -2, 1.5)))[1], "notes")[0]
    assert "is in drone 3.jpg, which has no camera (it could not be registered, or is none of the photos)" in note
    with pytest.raises(StageError, match=r"2 clicks inside .* 3 are needed \(.* drone 3\.jpg, which has no camera"):
        crop(inside(*CORNERS[:3]))


@pytest.mark.parametrize(
    "rows, sentence",
    [
        (inside((900.0, 10.0)), r"lies outside drone 1\.jpg, which has 800 x 600"),
        ([("outside", (400.0, 300.0))], "holds only clicks outside"),
        ([("box", (400.0, 300.0))], "a box in drone 1.jpg needs two opposite corners"),
    ],
)
def test_bad_clicks_in_the_scene_are_one_sentence(crop, rows, sentence):
    with pytest.raises(StageError, match=sentence):
        crop(rows)


@pytest.mark.parametrize("count, noise", [(4000, 0.005), (60000, 0.03)], ids=["sparse", "dense and noisy"])
def test_clicks_outside_on_the_ground_beside_a_wall_leave_the_wall(count, noise):
    """Who clicks on a house's ends and on the ground before it has no click on the wall's foot."""
    rng = np.random.default_rng(0)
    wall = rng.uniform([0, 0, 0], [10, 0, 6], (count, 3))
    ground = np.c_[rng.uniform([-5, -8], [15, 0], (count, 2)), rng.normal(0, noise, count)]
    ends = np.array([[0, 0, 0.1], [10, 0, 0.1], [0, 0, 6], [10, 0, 6]])
    other = SceneClicks([], ends, np.array([[5, -0.7, 0.0], [2.5, -0.7, 0.0]]), [], []).other(
        np.concatenate([wall, ground])
    )
    assert other[:count].mean() < 0.08 and (np.linalg.norm(ground - [5, -0.7, 0], axis=1) < 1)[other[count:]].any()
    assert other[count:][np.linalg.norm(ground - [5, -0.7, 0], axis=1) < 0.6].all()


def test_clicks_where_the_photo_shows_nothing_of_the_scene_are_an_error(crop):
    level = photo(np.array([0, -30.0, 1]))
    with pytest.raises(StageError, match="has 0 clicks inside the object that meet points of the scene"):
        crop([("inside", (x, 3.0)) for x in (100, 300, 500, 700)], view=level)
