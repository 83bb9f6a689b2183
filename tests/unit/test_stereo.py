"""Stereo on a planted card before a wall: where it measures, where it must not, and what other depth maps veto."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from scenefuse.geometry.consistency import DepthMap, neighbours, vote
from scenefuse.mvs.plane_sweep import DepthMapSettings, estimate_depth
from scenefuse.photos.workspace import View

WIDTH, HEIGHT, FOCAL = 200, 160, 180.0
CARD, WALL = 8.0, 11.0
HALF = (1.5, 1.2)
CENTRES = [(0, 0), (1.0, 0.1), (-1.0, -0.1), (0.1, 1.0), (-0.1, -1.0), (0.8, -0.7), (-0.8, 0.7)]
SETTINGS = DepthMapSettings(planes=64, window_px=5)
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])


def texture(seed, low, high):
    """(800, 800) of speckles between two grey values, blurred to about three pixels of a photo."""
    noise = np.random.default_rng(seed).random((800, 800)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 2.0)
    noise = (noise - noise.mean()) / noise.std()
    return (low + high) / 2 + np.clip(noise, -2, 2) * (high - low) / 4


def photos(card, wall, noise=0.0):
    """Views of the card before the wall, (H, W) grey in 0..1, and which pixels of the first one show the card."""
    views, on_card = [], None
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    for k, centre in enumerate(CENTRES):
        layers = []
        for depth, picture in ((CARD, card), (WALL, wall)):
            x = centre[0] + (u - WIDTH / 2) / FOCAL * depth
            y = centre[1] + (v - HEIGHT / 2) / FOCAL * depth
            place = [((c + 10) * 40).astype(np.float32) for c in (x, y)]
            layers.append(cv2.remap(picture, *place, cv2.INTER_LINEAR))
            if depth == CARD:
                inside = (np.abs(x) < HALF[0]) & (np.abs(y) < HALF[1])
        photo = np.where(inside, *layers)
        photo = photo + noise / 255 * np.random.default_rng(k).normal(size=photo.shape)
        photo = np.round(np.clip(photo, 0, 1) * 255).astype(np.float32) / 255
        pose = np.eye(4)
        pose[:2, 3] = -np.array(centre)
        views.append(View(f"{k}", K, pose, WIDTH, HEIGHT, photo))
        on_card = inside if k == 0 else on_card
    return views, on_card


def depth_of(views):
    return estimate_depth(views[0], views[1:], 6.0, 14.0, SETTINGS, "cpu")


def grown(mask, px):
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * px + 1, 2 * px + 1), np.uint8)) > 0


def inner(px=12):
    """Pixels away from the photo's border."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[px:-px, px:-px] = True
    return mask


def test_an_edge_is_not_fattened():
    views, card = photos(texture(0, 0.05, 0.35), texture(1, 0.55, 0.75))
    depth = depth_of(views).depth
    beside = grown(card, 6) & ~grown(card, 1)
    fat = (depth > 0) & (depth < (CARD + WALL) / 2)
    assert fat[beside].mean() < 0.02
    assert (np.abs(depth - CARD) < 0.2)[card].mean() > 0.9


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_blank_wall_gets_no_depth_beside_a_card_that_keeps_its_own(noise):
    views, card = photos(texture(0, 0.05, 0.35), np.full((800, 800), 0.9, np.float32), noise)
    depth = depth_of(views).depth
    assert (depth > 0)[inner() & ~grown(card, 2)].mean() < 0.005
    assert (np.abs(depth - CARD) < 0.2)[card].mean() > 0.9


def test_a_wall_with_nothing_but_shading_gets_no_depth():
    shade = 0.6 + 0.3 * np.sin(2 * np.pi * np.arange(800, dtype=np.float32) / 240)
    views, card = photos(texture(0, 0.05, 0.35), np.tile(shade, (800, 1)), noise=1.0)
    assert (depth_of(views).depth > 0)[inner() & ~grown(card, 2)].mean() < 0.02


def test_the_glow_of_an_edge_is_no_texture_of_the_blank_wall_behind_it():
    views, card = photos(texture(0, 0.05, 0.35), np.full((800, 800), 0.9, np.float32))
    glowing = [0.9 * view.pixels + 0.1 * cv2.GaussianBlur(view.pixels, (0, 0), 2) for view in views]
    views = [replace(v, pixels=np.round(255 * g).astype(np.float32) / 255) for v, g in zip(views, glowing)]
    depth = depth_of(views).depth
    assert (depth > 0)[grown(card, 6) & ~grown(card, 1)].mean() < 0.005
    assert (np.abs(depth - CARD) < 0.2)[card].mean() > 0.9


def test_a_textured_wall_keeps_its_depth():
    views, card = photos(texture(0, 0.05, 0.35), texture(1, 0.55, 0.65), noise=1.0)
    estimate = depth_of(views)
    wall = inner() & ~grown(card, 12)
    assert (np.abs(estimate.depth - WALL) < 0.2)[wall].mean() > 0.95
    angle = np.degrees(np.arccos(np.clip(-estimate.normals[..., 2], -1, 1)))
    assert np.quantile(angle[wall & (estimate.depth > 0)], 0.9) < 8


@pytest.mark.parametrize("near", [1.0, 0.6])
def test_something_right_before_the_camera_costs_no_depth_behind_it(near):
    """A plant, or a fence: at its depth most of each photo lies outside the others, and 20 planes are far apart."""
    views, card = photos(texture(0, 0.05, 0.35), texture(1, 0.55, 0.65), noise=1.0)
    depth = estimate_depth(views[0], views[1:], near, 14.0, replace(SETTINGS, planes=20), "cpu").depth
    assert (np.abs(depth - CARD) < 0.2)[card].mean() > 0.9
    assert (np.abs(depth - WALL) < 0.2)[inner() & ~grown(card, 12)].mean() > 0.9


LIMITS = {"max_depth_error": 0.01, "max_reprojection_px": 2.0, "max_normal_error_deg": 30.0}


def with_depths(planted, depths):
    return replace(planted, view=replace(planted.view, pixels=depths.astype(np.float32)))


def planted_maps():
    """Maps of the card before the wall with their true depths; they face the cameras, in a grey of each photo's own."""
    views, _ = photos(texture(0, 0.05, 0.35), texture(1, 0.55, 0.75))
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    maps = []
    for k, view in enumerate(views):
        x = view.centre[0] + (u - WIDTH / 2) / FOCAL * CARD
        y = view.centre[1] + (v - HEIGHT / 2) / FOCAL * CARD
        card = (np.abs(x) < HALF[0]) & (np.abs(y) < HALF[1])
        normals, colors = np.zeros((HEIGHT, WIDTH, 3), np.float32), np.full((HEIGHT, WIDTH, 3), 10 * k, np.uint8)
        normals[..., 2] = -1
        maps.append(with_depths(DepthMap(view, normals, colors), np.where(card, CARD, WALL)))
    return maps


def test_depth_maps_confirm_what_is_there_and_see_through_what_floats():
    maps = planted_maps()
    floating = np.zeros((HEIGHT, WIDTH), bool)
    floating[20:30, 20:30] = True
    first = with_depths(maps[0], np.where(floating, CARD, maps[0].view.pixels))
    votes = vote(first, maps[1:], **LIMITS)
    assert (votes.through > votes.agree)[floating].all()
    solid = inner(40) & ~floating
    assert (votes.agree > votes.through)[solid].mean() > 0.999
    # What others cannot see is no vote against it: the wall just behind the card's edge.
    assert votes.through[~floating].max() == 0


def test_a_place_has_the_mean_of_the_maps_that_agree_on_it_and_no_map_agrees_on_a_surface_that_faces_elsewhere():
    first, *others = planted_maps()
    farther = [with_depths(m, 1.005 * m.view.pixels) for m in others[:2]]
    wall = np.zeros((HEIGHT, WIDTH), bool)
    wall[10:30, 80:120] = True
    votes = vote(first, farther, **LIMITS)
    assert (votes.agree[wall] == 2).all()
    mean = votes.mean[wall]
    assert np.allclose(mean, [WALL * (1 + 2 * 0.005 / 3), 0, 0, -1, 10, 10, 10], rtol=2e-4)
    turned = [replace(m, normals=np.roll(m.normals, 1, axis=2)) for m in farther]
    votes = vote(first, turned, **LIMITS)
    assert not votes.agree.any() and not votes.through[wall].any()
    assert np.array_equal(votes.mean[..., 0], first.view.pixels)


def test_a_photo_is_judged_by_those_that_it_was_matched_with_and_that_were_matched_with_it():
    assert neighbours({"a": ["b", "lost"], "b": [], "c": ["a"]}) == {"a": ["b", "c"], "b": ["a"], "c": ["a"]}
