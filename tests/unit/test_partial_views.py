"""Photos that show a part of the object only: a long facade, many photos of a statue's head, a mask that lacks it; and
a thin pole, a wall along which photos look, cameras in the coordinates of a map."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from scenefuse.core.transforms import Sim3
from scenefuse.crop.marked import Masked, vote
from scenefuse.geometry.ground import Ground
from scenefuse.geometry.photo_check import covering, moved_view, showing
from scenefuse.geometry.visual_hull import Box, Hull, Outline, least_framing, mask_iou, silhouette
from scenefuse.masks.grabcut import first_cuts
from scenefuse.masks.segmentation import MaskSettings, score_masks
from scenefuse.masks.target import target_from_points, upright_box
from scenefuse.mvs.photo_refinement import choose_sources
from scenefuse.nerf.volume import find_volume
from scenefuse.photos.workspace import View, Workspace

CELLS = 64
FACADE = [((-15.0, 0.0, 0.0), (15.0, 1.0, 9.0))]
STATUE = [((-0.3, -0.3, 0.0), (0.3, 0.3, 1.5)), ((-0.2, -0.2, 1.5), (0.2, 0.2, 1.9))]


def photo(name, centre, target, degrees, boxes, width=160, height=120):
    """A photo of boxes, with its true mask."""
    focal = width / 2 / np.tan(np.radians(degrees) / 2)
    z = (np.array(target) - centre) / np.linalg.norm(np.array(target) - centre)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z])
    pose[:3, 3] = -pose[:3, :3] @ np.array(centre)
    lens = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 3) @ np.linalg.inv(lens).T @ pose[:3, :3]
    hit = np.zeros(len(rays), bool)
    for low, high in boxes:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (np.array(low) - centre) / rays, (np.array(high) - centre) / rays
        hit |= np.maximum(np.minimum(a, b).max(1), 0) < np.maximum(a, b).min(1)
    return View(name, lens, pose, width, height, hit.reshape(height, width))


def along_a_facade():
    return [
        photo(f"{x:+05.1f}{z}", (x, -10.0, 1.7), (x, 0.0, z), 40, FACADE)
        for x in np.arange(-15, 15.1, 1.0)
        for z in (2, 7)
    ]


def around_a_statue(whole, heads):
    return [
        *(photo(f"a{k}", ring(k, whole, 4.0, 1.6), (0, 0, 0.95), 65, STATUE) for k in range(whole)),
        *(photo(f"b{k}", ring(k, heads, 1.2, 1.8), (0, 0, 1.7), 40, STATUE) for k in range(heads)),
    ]


def ring(k, count, radius, height):
    angle = 2 * np.pi * k / count
    return radius * np.cos(angle), radius * np.sin(angle), height


def surface(boxes, count=1500):
    rng, points = np.random.default_rng(0), []
    for low, high in boxes:
        some, face = rng.uniform(low, high, (count, 3)), rng.integers(0, 3, count)
        side = np.where(rng.random(count) < 0.5, np.array(low)[face], np.array(high)[face])
        some[np.arange(count), face] = side
        points.append(some)
    return np.concatenate(points)


def target(boxes):
    own = surface(boxes)
    grow = 0.15 * np.linalg.norm(np.ptp(own, axis=0))
    box, ground = (
        Box(np.eye(3, 4), own.min(0) - grow, own.max(0) + grow),
        Ground(np.full(6, -0.01) * [1, 0, 0, 0, 0, 0], np.zeros(2)),
    )
    return SimpleNamespace(box=box, ground=ground, sparse=own, kind=np.ones(len(own), np.int8))


def share_in(volume, points):
    """Share of points in the hull, or in a cell beside it."""
    unit = volume.nerf_from_object.apply(points)
    inside = ((unit >= 0) & (unit < 1)).all(1)
    cells = np.clip((unit * CELLS).astype(int), 0, CELLS - 1)
    return (inside & ndimage.binary_dilation(volume.hull)[tuple(cells.T)]).mean()


CAPTURES = {"facade": (FACADE, along_a_facade), "statue": (STATUE, lambda: around_a_statue(16, 60))}


@pytest.mark.slow
@pytest.mark.parametrize("name", CAPTURES)
def test_photos_of_a_part_lose_nothing_of_the_object(name):
    boxes, photos = CAPTURES[name][0], CAPTURES[name][1]()
    scored = score_masks([view.pixels for view in photos], target(boxes), photos, MaskSettings(hull_voxels=128))
    assert not scored.dropped
    volume = find_volume([Outline(view) for view in photos], CELLS, 0.04, own=surface(boxes))
    front = surface(boxes)
    front = front[front[:, 1] < 0.1] if name == "facade" else front
    assert share_in(volume, front) > 0.97
    assert 1 / volume.nerf_from_object.scale < 2.5 * np.ptp(front, axis=0).max()


@pytest.mark.parametrize("name", CAPTURES)
def test_points_of_a_scene_that_few_photos_frame_are_the_objects(name):
    boxes, photos = CAPTURES[name][0], CAPTURES[name][1]()
    own = surface(boxes, 300)
    # What one side hides from another is left to the photos: here the points that most of them show.
    voted, _ = vote(own, Masked(photos, own), Sim3.identity(), 0.8)
    front = own[:, 1] < 0.1 if name == "facade" else np.abs(own[:, :2]).max(1) > 0.19
    assert voted[front].mean() > 0.7
    lower = front & (own[:, 2] < 0.6 * own[:, 2].max())
    assert voted[lower].mean() > 0.7


def test_one_mask_that_lacks_the_head_takes_it_from_no_object():
    photos = around_a_statue(18, 0)
    headless = photo("a0", ring(0, 18, 4.0, 1.6), (0, 0, 0.95), 65, STATUE[:1]).pixels
    photos[0] = replace(photos[0], pixels=headless)
    volume = find_volume([Outline(view) for view in photos], CELLS, 0.04, own=surface(STATUE))
    head = surface(STATUE)[-1500:]
    assert share_in(volume, head[head[:, 2] > 1.6]) > 0.95


def test_masks_of_a_thin_pole_agree_with_their_hull():
    pole = [((-0.05, -0.05, 0.0), (0.05, 0.05, 6.0))]
    photos = [photo(f"{k}", ring(k, 12, 6.0, 2.0), (0, 0, 3), 65, pole, 320, 400) for k in range(12)]
    scored = score_masks([view.pixels for view in photos], target(pole), photos, MaskSettings(hull_voxels=80))
    assert not scored.dropped


def test_a_hull_of_a_wall_has_no_holes_where_the_photo_is_near():
    along = photo("", (-12.0, -2.0, 1.7), (-4, 0, 3), 60, FACADE, 640, 480)
    cells = np.meshgrid(*(np.arange(low + 0.25, high, 0.5) for low, high in zip(*FACADE[0])), indexing="ij")
    hull = Hull(np.stack(cells, axis=-1).reshape(-1, 3), 0.5)
    assert mask_iou(along.pixels, silhouette(hull, along)) > 0.95


def test_grabcut_is_not_misled_by_the_ends_of_a_wall_that_lie_behind_the_camera():
    along = photo("", (-12.0, -2.0, 1.7), (-6, 0, 3), 60, FACADE, 160, 120)
    colours = np.where(along.pixels[..., None], [170, 90, 60], [60, 120, 180])
    colours = np.clip(colours + np.random.default_rng(0).normal(0, 12, colours.shape), 0, 255).astype(np.uint8)
    corners = np.array([[x, y, z] for x in (-15, 15) for y in (0, 1) for z in (0, 9.0)])
    nothing = np.zeros((0, 3)), [np.zeros(0, np.int64)], [np.zeros((0, 2))]
    photos = Workspace(Path(), [replace(along, pixels=colours)], *nothing)
    found = first_cuts(target_from_points(corners, photos, np.array([0, 0, 1.0]), 0), photos, 160, {})
    assert mask_iou(found[0], along.pixels) > 0.95


@pytest.mark.slow
def test_masks_agree_as_well_where_cameras_are_in_the_coordinates_of_a_map():
    photos, own, up = around_a_statue(12, 0), surface(STATUE), np.array([0, 0, 1.0])
    scores, corners = [], []
    for at in (np.zeros(3), np.array([456_789.0, 5_432_100.0, 300.0])):
        views = [moved_view(view, Sim3(1.0, np.eye(3), at)) for view in photos]
        box = upright_box(own + at, up, 0.15)
        ground = Ground(np.array([at[2], 0, 0, 0, 0, 0]), np.zeros(2))
        there = SimpleNamespace(box=box, ground=ground, sparse=own + at, kind=np.ones(len(own), np.int8))
        scored = score_masks([view.pixels for view in views], there, views, MaskSettings(hull_voxels=80))
        scores.append(list(scored.scores.values()))
        corners.append(box.to_object(np.array([box.low, box.high])) - at)
    np.testing.assert_allclose(scores[1], scores[0], atol=0.01)
    np.testing.assert_allclose(corners[1], corners[0], atol=1e-3)


def test_how_many_photos_frame_a_place():
    photos, own = around_a_statue(16, 60), surface(STATUE)
    assert least_framing(photos, own) == 4
    assert least_framing(photos[:16], own) == least_framing(photos[:16], own[:5]) == 4
    assert least_framing(photos, own[:5]) == 7  # of few points nothing is known


def test_photos_that_are_asked_together_have_all_of_a_facade():
    photos, points = along_a_facade(), surface(FACADE)
    points = points[points[:, 1] < 0.1]
    shown = np.zeros((len(photos), len(points)), bool)
    for row, view in zip(shown, photos):
        row[view.visible(points)[0]] = True
    centres = np.array([view.centre for view in photos])
    chosen = covering(shown, centres, points, 36)
    often = shown.sum(0) >= 6
    assert len(chosen) == 36 and (shown[chosen].sum(0)[often] >= 3).all()
    # Where all photos have all of it, directions decide: none is far from one that was chosen.
    ring = [photo(f"{k}", ring_of(k, 40), (0, 0, 0.95), 65, STATUE).centre for k in range(40)]
    chosen = covering(np.ones((40, len(points)), bool), np.array(ring), np.zeros((len(points), 3)), 20)
    assert np.abs(np.subtract.outer(np.arange(40), chosen)).min(1).max() <= 1


def test_close_ups_of_parts_are_compared_rather_than_many_photos_of_the_whole():
    def camera(name, centre, height, degrees):
        return photo(name, centre, (0, 0, height), degrees, [], 80, 60)

    heights = (0.3, 0.75, 1.2, 1.65)
    whole = [camera(f"a{k}", ring(k, 70, 8.0, 2.0), 0.95, 30) for k in range(70)]
    parts = [camera(f"b{k}", ring(k, 20, 2.0, heights[k // 20]), heights[k // 20], 20) for k in range(80)]
    chosen = showing([*whole, *parts], surface(STATUE), 64)
    assert (chosen >= 70).mean() > 0.5
    # A part that no close-up shows is left to the others.
    chosen = showing([*whole, *parts[:60]], surface(STATUE), 64)
    assert (chosen >= 70).any() and (chosen < 70).sum() > 20


def ring_of(k, count):
    return ring(k, count, 4.0, 1.6)


def test_depths_are_refined_with_photos_that_show_the_same_place():
    """A wall whose photos are taken along it: the farthest ones of eight must still show what the photo shows."""
    photos = [photo(f"{x:.1f}", (x, -10.0, 4.0), (x, 0.0, 4.0), 40, FACADE) for x in np.arange(-15, 15.1, 0.75)]
    depths = np.stack([np.where(view.pixels, 10.0, 0).astype(np.float32) for view in photos])
    views = SimpleNamespace(
        view=lambda k: photos[k],
        intrinsics=np.stack([view.intrinsics for view in photos]),
        sizes=np.array([[120, 160]]),
        object_from_cam=np.stack([view.world_from_cam for view in photos]),
    )
    poses = views.object_from_cam
    for index, chosen in enumerate(choose_sources(views, depths)):
        apart = np.abs(poses[chosen, 0, 3] - poses[index, 0, 3])
        # A photo shows 7.3 m of the wall, and 15 degrees beside it are 2.7 m.
        assert apart.max() < 7 and np.abs(apart - 2.7).min() < 0.5
