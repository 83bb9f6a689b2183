"""A figure on a plinth, seen from below by half of the photos, which do not see its feet."""

from dataclasses import replace

import numpy as np
import pytest

from scenefuse.geometry.consistency import compare
from scenefuse.mvs.sparse_depths import sparse_depths
from scenefuse.nerf.volume import find_volume, hidden_pixels, silhouettes
from scenefuse.photos.views import Views

WIDTH, HEIGHT, FOCAL = 200, 160, 220.0
FIGURE = np.array([[-0.3, -0.3, 0.0], [0.3, 0.3, 1.0]])
PLINTH = np.array([[-0.7, -0.7, -0.8], [0.7, 0.7, 0.0]])
CELLS = 64


def enter(box, centre, rays):
    """Distance (N,) along rays (N, 3) from a centre to a box, infinite for those that miss it."""
    with np.errstate(divide="ignore"):
        first, second = (box[0] - centre) / rays, (box[1] - centre) / rays
    near, far = np.minimum(first, second).max(1), np.maximum(first, second).min(1)
    return np.where((near < far) & (near > 0), near, np.inf)


def looking(centre, target=(0, 0, 0.2)):
    """Camera-to-world pose (4, 4)."""
    ahead = np.array(target) - centre
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    return np.vstack([np.column_stack([right, np.cross(ahead, right), ahead, centre]), [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def figure():
    """The photos, and the true depth (V, H, W) of the plinth where it is seen."""
    k = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    around = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    heights = np.where(np.arange(16) % 2, 1.2, -0.6)
    poses = np.stack([looking(np.array([3 * np.cos(a), 3 * np.sin(a), h])) for a, h in zip(around, heights)])
    v, u = np.indices((HEIGHT, WIDTH)) + 0.5
    ahead = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1).reshape(-1, 3)
    mattes, plinths, points, tracks, rng = [], [], [], [], np.random.default_rng(0)
    for pose in poses:
        rays = ahead @ pose[:3, :3].T
        of_figure, of_plinth = (enter(box, pose[:3, 3], rays) for box in (FIGURE, PLINTH))
        mattes.append(np.where((of_figure < of_plinth) & (of_figure < np.inf), 255, 0).reshape(HEIGHT, WIDTH))
        plinth = np.where(of_plinth <= of_figure, of_plinth, np.inf)
        plinths.append(plinth.reshape(HEIGHT, WIDTH))
        seen = np.minimum(of_figure, of_plinth)
        chosen = rng.choice(np.flatnonzero(np.isfinite(seen)), 600, replace=False)
        tracks.append(np.arange(600) + 600 * len(tracks))
        points.append(pose[:3, 3] + seen[chosen, None] * rays[chosen])
    count = len(poses)
    images = np.zeros((count, HEIGHT, WIDTH, 3), np.uint8)
    names, intrinsics = [f"{i}.png" for i in range(count)], np.repeat(k[None], count, 0)
    mattes, beyond, held_out = np.array(mattes, np.uint8), np.zeros(images.shape[:3], bool), np.zeros(count, bool)
    views = Views(names, images, mattes, beyond, intrinsics, poses, held_out, np.concatenate(points), tracks)
    return views, np.stack(plinths)


def hull_of(views, covered):
    """The hull's volume, and the centres of its cells."""
    outlines = silhouettes(views.masks, covered, views.intrinsics, views.object_from_cam, views.sizes)
    volume = find_volume(outlines, CELLS, 0.04)
    cells = volume.nerf_from_object.inverse().apply((np.argwhere(volume.hull) + 0.5) / CELLS)
    return volume, outlines, cells


def test_what_stands_beside_the_object_has_its_depth(figure):
    views, plinths = figure
    covered = sparse_depths(views)
    known = np.isfinite(covered) & np.isfinite(plinths)
    assert known.sum() > 0.6 * np.isfinite(plinths).sum()
    assert np.median(np.abs(covered - plinths)[known] / plinths[known]) < 1e-3
    assert (np.abs(covered - plinths)[known] < 0.02 * plinths[known]).mean() > 0.95


@pytest.mark.slow
def test_feet_that_some_photos_cannot_see_stay_in_the_hull_and_the_plinth_does_not_join_it(figure):
    views, plinths = figure
    cut = hull_of(views, None)[2]
    assert cut[:, 2].min() > 0.06
    volume, outlines, cells = hull_of(views, sparse_depths(views))
    side = 1 / volume.nerf_from_object.scale / CELLS
    corners = (np.abs(cells[:, :2]) > 0.2).all(1)
    assert cells[corners, 2].min() < side
    # One of sixteen photos may err: the figure's sides bulge to what the other fifteen leave.
    assert np.abs(cells[cells[:, 2] > 2 * side, :2]).max() < 0.3 + 9 * side
    # Nothing of the plinth, though all photos from above have some of it behind the figure.
    assert (cells[:, 2] < -3 * side).mean() < 0.005
    hidden = hidden_pixels(volume, outlines)
    assert hidden[::2].any((1, 2)).all() and not (hidden & views.masks).any()
    assert np.isfinite(plinths[hidden]).mean() > 0.95


def test_points_of_the_feet_may_lie_beside_the_masks_of_photos_that_cannot_see_them(figure):
    views, _ = figure
    feet = np.array([[0.3, 0.0, 0.03], [0.3, 0.1, 0.03], [0.3, -0.1, 0.04]])
    nothing = np.zeros(views.masks.shape, np.float32)
    given = feet, 1, nothing, views.masks, views.intrinsics, views.object_from_cam, 0.01
    off, hidden = compare(*given).off_mask, compare(*given, sparse_depths(views)).off_mask
    # Eight photos are taken from below; triangles do not reach all the way to the mask.
    assert (off == 8).all() and (hidden <= 2).all()
    # A point in the air is off the masks all the same.
    air = feet + [0.5, 0, 0.6]
    given = air, *given[1:]
    assert (compare(*given, sparse_depths(views)).off_mask > 5).all()


@pytest.mark.slow
def test_what_hides_the_object_without_points_of_its_own_is_told_by_those_of_the_object(figure):
    """A bush before the lower half of the figure, in six photos; nothing of it is triangulated."""
    views, _ = figure
    rng = np.random.default_rng(1)
    points = rng.uniform(*FIGURE, (3000, 3))
    side = rng.integers(0, 2, len(points))
    points[np.arange(len(points)), side] = FIGURE[rng.integers(0, 2, len(points)), side]
    bush = np.arange(len(views.names)) % 3 == 0
    mattes, tracks = views.mattes.copy(), []
    for k in range(len(views.names)):
        rows, pixels, depth = views.view(k).visible(points)
        if bush[k]:
            mattes[k, int(views.view(k).project(np.array([[0, 0, 0.5]]))[0][0, 1]) :] = 0
        pose = views.object_from_cam[k]
        rays = points[rows] - pose[:3, 3]
        front = enter(FIGURE, pose[:3, 3], rays) > 1 - 1e-6
        tracks.append(rows[front & (mattes[k, pixels[:, 1], pixels[:, 0]] > 0)])
    hiding = replace(views, mattes=mattes, sparse=points, tracks=tracks)
    assert hull_of(hiding, None)[2][:, 2].min() > 0.35
    volume, outlines, cells = hull_of(hiding, sparse_depths(hiding))
    assert cells[:, 2].min() < 0.1 and np.abs(cells[:, :2]).max() < 0.45
    hidden = hidden_pixels(volume, outlines).any((1, 2))
    assert hidden[bush].all()
    # Off the object, and before it, the photos still say that nothing is there.
    air, before = np.array([[0.9, 0.0, 0.3]]), 0.5 * views.object_from_cam[:1, :3, 3]
    nothing = np.zeros(views.masks.shape, np.float32)
    for place in (air, before):
        given = place, 1, nothing, hiding.masks, views.intrinsics, views.object_from_cam, 0.01, sparse_depths(hiding)
        assert compare(*given).off_mask >= compare(*given[:-1]).off_mask - 1


def test_too_few_points_beside_the_object_say_nothing(figure):
    views, _ = figure
    alone = replace(views, sparse=views.sparse[:2], tracks=[np.arange(2)] * len(views.names))
    assert np.isinf(sparse_depths(alone)).all()


@pytest.mark.slow
def test_what_lies_beyond_a_smaller_photo_is_neither_off_its_mask_nor_empty(figure):
    views, _ = figure
    narrow = (np.arange(WIDTH) >= WIDTH // 2) & (np.arange(len(views.names)) % 3 == 0)[:, None]
    beyond = np.repeat(narrow[:, None], HEIGHT, axis=1)
    lower = replace(views, mattes=np.where(beyond, 0, views.mattes))
    smaller = replace(lower, beyond=beyond)
    whole, carved, known = (hull_of(v, None) for v in (views, lower, smaller))
    widths = [np.ptp(cells[:, 0]) for _, _, cells in (whole, carved, known)]
    assert widths[1] < 0.8 * widths[0] < widths[2]
    assert hidden_pixels(*known[:2])[beyond].all() and not hidden_pixels(*carved[:2]).any()
    middle = np.array([[0.0, 0.0, 0.3]])
    nothing = np.zeros(views.masks.shape, np.float32)
    given = middle, 1, nothing, smaller.masks, views.intrinsics, views.object_from_cam, 0.01
    assert compare(*given).off_mask > 0 == compare(*given, sparse_depths(smaller)).off_mask


@pytest.mark.slow
def test_many_details_of_a_part_do_not_cut_off_the_rest():
    k = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    v, u = np.indices((HEIGHT, WIDTH)) + 0.5
    ahead = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1).reshape(-1, 3)
    poses, masks = [], []
    for count, distance, target in ((10, 3.0, 0.5), (24, 1.1, 0.85)):
        for turn in np.arange(count) * 2 * np.pi / count:
            centre = np.array([distance * np.cos(turn), distance * np.sin(turn), 1.2])
            poses.append(looking(centre, (0, 0, target)))
            masks.append(np.isfinite(enter(FIGURE, centre, ahead @ poses[-1][:3, :3].T)).reshape(HEIGHT, WIDTH))
    outlines = silhouettes(np.array(masks), None, np.repeat(k[None], len(poses), 0), np.array(poses))
    volume = find_volume(outlines, CELLS, 0.04)
    cells = volume.nerf_from_object.inverse().apply((np.argwhere(volume.hull) + 0.5) / CELLS)
    assert cells[:, 2].min() < 0.05 and cells[:, 2].max() > 0.95
