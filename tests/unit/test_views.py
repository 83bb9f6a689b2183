"""Views of an object, as its training stages read them, from a planted workspace with masks; and which views match."""

import cv2
import numpy as np
import pycolmap
import pytest

from scenefuse.core.stage import StageError
from scenefuse.geometry.visual_hull import Outline, count_silhouettes
from scenefuse.mvs.sparse_depths import select_views
from scenefuse.nerf.depth_prior import crop_to_object
from scenefuse.photos.views import load_views, scales
from scenefuse.photos.workspace import View, read_workspace

WIDTH, HEIGHT, FOCAL = 80, 60, 70.0
POINTS = np.random.default_rng(0).uniform([-1, -1, 9], [1, 1, 11], (40, 3))
# Left of the points, straight before them, and two on the right; no two see them from the same angle.
SHIFTS = (-2.0, 0.0, 1.0, 8.0)


@pytest.fixture
def folder(tmp_path):
    """Four photos that look along +z from beside each other, each observing every point, the first one twice."""
    return planted(tmp_path, upright=())


def planted(tmp_path, upright):
    """The photos; those `upright` are taken with the camera turned by a quarter."""
    for name in ("images", "sparse", "masks"):
        (tmp_path / name).mkdir()
    model = pycolmap.Reconstruction()
    for number, (width, height) in enumerate([(WIDTH, HEIGHT), (HEIGHT, WIDTH)], 1):
        params = [FOCAL, FOCAL, width / 2, height / 2]
        camera = pycolmap.Camera(camera_id=number, model="PINHOLE", width=width, height=height, params=params)
        model.add_camera_with_trivial_rig(camera)
    ids = [model.add_point3D(p, pycolmap.Track(), np.zeros(3, np.uint8)) for p in POINTS]
    for k, shift in enumerate(SHIFTS, 1):
        image = pycolmap.Image(name=f"{k}.png", camera_id=2 if k in upright else 1, image_id=k)
        width, height = (HEIGHT, WIDTH) if k in upright else (WIDTH, HEIGHT)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D([float(j), 5.0]) for j in range(len(ids) + 1)])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-shift, 0, 0])))
        for j, point in enumerate([*ids, ids[0]]):
            model.add_observation(point, pycolmap.TrackElement(k, j))
        cv2.imwrite(str(tmp_path / "images" / f"{k}.png"), np.full((height, width, 3), (10, 20, 40 * k), np.uint8))
        mask = np.zeros((height, width), np.uint8)
        mask[:, width // 2 :] = 255
        cv2.imwrite(str(tmp_path / "masks" / f"{k}.png"), mask)
    model.write_binary(tmp_path / "sparse")
    return tmp_path


def test_views_are_the_photos_with_masks_scaled_with_their_cameras(folder):
    (folder / "masks" / "2.png").unlink()
    views = load_views(folder, folder / "masks", width_px=40, hold_out_every=0)
    assert views.names == ["1.png", "3.png", "4.png"] and not views.held_out.any()
    assert views.images.shape == (3, 30, 40, 3) and (views.images[1] == (120, 20, 10)).all()
    assert views.masks[0, :, 20:].all() and not views.masks[0, :, :20].any()
    np.testing.assert_allclose(views.intrinsics[0], [[35, 0, 20], [0, 35, 15], [0, 0, 1]])
    np.testing.assert_allclose(views.object_from_cam[:, :3, 3], [[s, 0, 0] for s in (-2, 1, 8)])
    np.testing.assert_array_equal(views.sparse, POINTS)
    # A point that a photo observes twice counts once.
    assert [t.tolist() for t in views.tracks] == [list(range(len(POINTS)))] * 3


def test_a_view_of_views_projects_as_its_photo(folder):
    view = load_views(folder, folder / "masks", width_px=40, hold_out_every=0).view(2)
    whole = read_workspace(folder).views[2]
    np.testing.assert_allclose(view.project(POINTS)[0], whole.project(POINTS)[0] / 2)
    assert view.pixels.shape == (view.height, view.width, 3)


def test_upright_photos_lie_on_pictures_that_hold_them_all(tmp_path):
    folder = planted(tmp_path, upright=(2, 3))
    views = load_views(folder, folder / "masks", width_px=40, hold_out_every=0)
    assert views.images.shape == (4, 40, 40, 3) and views.sizes.tolist() == [[30, 40], [40, 30], [40, 30], [30, 40]]
    assert (views.images[1] == (80, 20, 10)).all() and not views.masks[views.beyond].any()
    assert views.masks[1, :, 15:30].all() and views.beyond[1, :, 30:].all() and not views.beyond[1, :, :30].any()
    for index, whole in enumerate(read_workspace(folder).views):
        view = views.view(index)
        assert (view.width, view.height) == (whole.width / 2, whole.height / 2)
        np.testing.assert_allclose(view.project(POINTS)[0], whole.project(POINTS)[0] / 2)
    some = views.select(np.array([3, 1]))
    assert some.names == ["4.png", "2.png"] and some.sizes.tolist() == [[30, 40], [40, 30]]


def test_maps_of_a_cut_upright_photo_have_its_own_size(tmp_path):
    folder = planted(tmp_path, upright=(2, 3))
    crops = crop_to_object(load_views(folder, folder / "masks", 40, 0), 40)
    on_canvas = np.full(crops.views.masks.shape[1:], 7, np.float32)
    whole = [crops.paste(index, on_canvas) for index in range(4)]
    assert [part.shape for part in whole] == [(30, 40), (40, 30), (40, 30), (30, 40)]
    # The mask is the right half; what the canvas shows beside the photo is beyond it.
    for part in whole:
        half = part.shape[1] // 2
        assert (part[:, half:] == 7).all() and not part[:, :half].any()


def test_one_odd_photo_does_not_set_the_size_of_all():
    def views(*sizes):
        return [View(f"{k}", np.eye(3), np.eye(4), width, height) for k, (width, height) in enumerate(sizes)]

    strip = _scaled_sizes(views(*[(1600, 1200)] * 5, (1600, 300)), 800)
    assert strip == [(800, 600)] * 5 + [(800, 150)]
    assert _scaled_sizes(views(*[(640, 480)] * 5, (4000, 3000)), 800) == [(640, 480)] * 6
    mixed = views((1280, 852), (852, 1280), (1280, 852), (768, 511))
    first = _scaled_sizes(mixed, 800)
    assert _scaled_sizes(mixed, max(width for width, _ in first)) == first and first[1] == first[0][::-1]


def _scaled_sizes(views, width_px):
    return [(round(v.width * s), round(v.height * s)) for v, s in zip(views, scales(views, width_px))]


def test_a_photo_whose_mask_is_smaller_than_a_pixel_is_left_out(folder):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[30, 41] = 255
    cv2.imwrite(str(folder / "masks" / "2.png"), mask)
    views = load_views(folder, folder / "masks", width_px=40, hold_out_every=3)
    assert views.names == ["1.png", "3.png", "4.png"] and views.held_out.tolist() == [False, True, False]
    assert views.masks.any((1, 2)).all() and (views.images[1] == (120, 20, 10)).all() and len(views.tracks) == 3


def test_held_out_photos_are_every_nth_or_listed(folder):
    assert load_views(folder, folder / "masks", 40, 2).held_out.tolist() == [False, True, False, True]
    (folder / "held_out.txt").write_text("4.png\n1.png\n")
    assert load_views(folder, folder / "masks", 40, 2).held_out.tolist() == [True, False, False, True]


def test_views_without_usable_masks_are_an_error_in_one_sentence(folder):
    cv2.imwrite(str(folder / "masks" / "2.png"), np.zeros((HEIGHT + 1, WIDTH), np.uint8))
    with pytest.raises(StageError, match="2.png is .* but its camera is made for .*; rerun the masks"):
        load_views(folder, folder / "masks", 40, 0)
    with pytest.raises(StageError, match="no photo in .* has a mask"):
        load_views(folder, folder / "images" / "none", 40, 0)


def test_a_workspace_of_some_views_keeps_what_they_observe(folder):
    whole = read_workspace(folder)
    part = whole.subset([3, 1])
    assert [view.name for view in part.views] == ["4.png", "2.png"] and len(part.points) == len(POINTS)
    np.testing.assert_array_equal(part.seen_at[0], whole.seen_at[3])


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_silhouettes_count_the_photos_that_frame_a_point_and_those_that_have_it_off_the_mask(precision):
    k = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    right = np.zeros((HEIGHT, WIDTH), bool)
    right[:, WIDTH // 2 :] = True
    behind = np.diag([-1.0, 1, -1, 1])
    views = [View("a", k, np.eye(4), WIDTH, HEIGHT, right), View("b", k, np.eye(4), WIDTH, HEIGHT, ~right)]
    views += [View("c", k, behind, WIDTH, HEIGHT, right)]
    points = np.array([[0.5, 0, 5], [-0.5, 0, 5], [9, 0, 5], [0.5, 0, -5], [0, 0, 5]], precision)
    found = count_silhouettes(points, map(Outline, views))
    assert found.shown.tolist() == [2, 2, 0, 1, 2] and found.missed.tolist() == [1, 1, 0, 1, 1]
    assert not found.hidden.any() and not found.open.any()
    # Something stands before the left half of the first photo, four away; the third point is in no picture.
    before = np.where(right, np.inf, np.float32(4))
    found = count_silhouettes(points, [Outline(views[0], before)])
    assert found.shown.tolist() == [1, 0, 0, 0, 1] and found.missed.tolist() == [0] * 5
    assert found.hidden.tolist() == [0, 1, 0, 0, 0] and not found.open.any()
    nearer = points * np.array([0.7, 1, 0.7], precision)
    found = count_silhouettes(nearer, [Outline(views[0], before)])
    assert found.shown.tolist() == [1, 1, 0, 0, 1] and found.missed.tolist() == [0, 1, 0, 0, 0]
    # The object's own surface, four away: a point one behind it is open within one and a half, not within a half.
    surface = np.full(right.shape, np.float32(4))
    deep = [count_silhouettes(points[:1], [Outline(views[0], surface)], reach).open.tolist() for reach in (1.5, 0.5)]
    assert deep == [[1], [0]]


def test_sources_are_views_of_good_angles_the_best_first(folder):
    selected = select_views(read_workspace(folder), sources=2, min_angle_deg=2.0)
    # From the second photo the first lies 11 degrees aside, the third 6, the fourth 39.
    assert [view.name for view in selected["2.png"].sources] == ["1.png", "3.png"]
    assert selected["2.png"].near < POINTS[:, 2].min() < POINTS[:, 2].max() < selected["2.png"].far
    narrow = select_views(read_workspace(folder), sources=2, min_angle_deg=8.0)
    assert [view.name for view in narrow["2.png"].sources] == ["1.png", "4.png"]
    with pytest.raises(StageError, match="shares points with another at 80.0 degrees"):
        select_views(read_workspace(folder), sources=2, min_angle_deg=80.0)
