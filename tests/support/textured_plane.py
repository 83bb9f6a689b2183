"""A slanted, textured square photographed along an arc, with its true depths."""

import math
from dataclasses import replace

import cv2
import numpy as np

from scenefuse.geometry.consistency import back_project
from scenefuse.photos.views import Views


def _texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    red = np.sin(5.1 * x + 1.3 * y) + np.sin(11.0 * x - 7.0 * y)
    green = np.sin(4.3 * y - 2.0 * x) + np.sin(9.0 * y + 8.0 * x)
    blue = np.sin(6.0 * x * 1.1 + 3.7 * y + 1.0) + np.sin(13.0 * y)
    return (127.5 + 55.0 * np.stack([red, green, blue], -1)).astype(np.uint8)


def plane_views(
    count: int = 8, width: int = 64, height: int = 48, held_out: int = 1, distances: tuple[float, ...] = (3.0,)
) -> tuple[Views, np.ndarray]:
    """A slanted textured square, z = 3 + 0.3 x in the object frame, seen by cameras along an arc, in turns from these
    distances; with true depths."""
    focal = 0.9 * width
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    v, u = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    rays = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)], -1)
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.9, 0.9, (150, 2))
    sparse = np.column_stack([xy, 3.0 + 0.3 * xy[:, 0]])
    images, masks, poses, depths, tracks = [], [], [], [], []
    for row, angle in enumerate(np.linspace(-0.4, 0.4, count)):
        rotation = np.array([[math.cos(angle), 0, -math.sin(angle)], [0, 1, 0], [math.sin(angle), 0, math.cos(angle)]])
        centre = np.array([0, 0, 3.0]) - distances[row % len(distances)] * rotation[:, 2]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, centre
        directions = rays @ rotation.T
        depth = (3.0 + 0.3 * centre[0] - centre[2]) / (directions[..., 2] - 0.3 * directions[..., 0])
        points = centre + directions * depth[..., None]
        mask = (np.abs(points[..., 0]) < 1) & (np.abs(points[..., 1]) < 1)
        images.append(np.where(mask[..., None], _texture(points[..., 0], points[..., 1]), 90).astype(np.uint8))
        masks.append(mask)
        poses.append(pose)
        depths.append(np.where(mask, depth, 0.0))
        tracks.append(np.arange(150))
    held = np.zeros(count, bool)
    held[count // 2 : count // 2 + held_out] = True
    names = [f"{i:03d}.jpg" for i in range(count)]
    k = np.repeat(intrinsics[None], count, 0)
    mattes = np.stack(masks).astype(np.uint8) * 255
    views = Views(
        names, np.stack(images), mattes, np.zeros(mattes.shape, bool), k, np.stack(poses), held, sparse, tracks
    )
    return views, np.stack(depths)


def speckled(views, truth):
    """The same views of the plane, painted with fine speckles."""
    speckles = cv2.GaussianBlur(np.random.default_rng(0).random((400, 400)).astype(np.float32), (0, 0), 2.0)
    speckles = (speckles - speckles.min()) / np.ptp(speckles) * 255
    images = []
    for depth, k, pose in zip(truth, views.intrinsics, views.object_from_cam):
        rows, columns = np.indices(depth.shape).reshape(2, -1)
        points = back_project(depth.ravel().astype(np.float64), k, pose, rows, columns).reshape(*depth.shape, 3)
        place = ((points[..., :2] + 1) * 199.5).astype(np.float32)
        images.append(cv2.remap(speckles, place[..., 0], place[..., 1], cv2.INTER_LINEAR).astype(np.uint8))
    return replace(views, images=np.repeat(np.stack(images)[..., None], 3, axis=3))


def wrong_depths(truth, share=0.05):
    """True depths with a smooth error of up to a share of them."""
    waves = np.sin(np.arange(truth.shape[2]) / 15)[None, None] * np.cos(np.arange(truth.shape[1]) / 12)[None, :, None]
    return (truth * (1 + share * waves)).astype(np.float32)
