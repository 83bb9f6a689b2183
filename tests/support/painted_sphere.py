"""A small sphere with a painted surface, photographed from all around: what NeRF tests and benchmarks train on."""

import numpy as np
import torch

from scenefuse.nerf.rays import PhotoTensors
from scenefuse.nerf.volume import cube_from_cameras, silhouettes, tight_cube, visual_hull

RADIUS, CENTER = 1.5, np.array([4.0, -2.0, 1.0])


def sphere_views(count=12, size=48, arc=2 * np.pi, waves=5.0):
    """Photos of `size` pixels of a painted sphere from an arc: images, masks, intrinsics, poses, true depths."""
    focal = float(size)
    k = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    v, u = np.indices((size, size)) + 0.5
    rays = np.stack([(u - size / 2) / focal, (v - size / 2) / focal, np.ones_like(u)], -1)
    images, masks, poses, depths = [], [], [], []
    for i in range(count):
        angle, height = arc * i / count, (-0.5, 0.6, 1.5)[i % 3]
        position = CENTER + 5.0 * np.array([np.cos(angle), np.sin(angle), height]) / np.hypot(1, height)
        z = (CENTER - position) / np.linalg.norm(CENTER - position)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z], axis=1)
        d = rays @ rotation.T
        offset = position - CENTER
        a, b, c = (d**2).sum(-1), d @ offset, offset @ offset - RADIUS**2
        root = b**2 - a * c
        depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0)
        normal = (position + d * depth[..., None] - CENTER) / RADIUS
        image = 0.5 + 0.4 * np.sin(normal * waves + np.array([0.0, 1.0, 2.0]))
        images.append((image * (root > 0)[..., None] * 255).astype(np.uint8))
        masks.append(root > 0)
        poses.append(np.vstack([np.column_stack([rotation, position]), [0, 0, 0, 1]]))
        depths.append(depth)
    return np.stack(images), np.stack(masks), np.repeat(k[None], count, 0), np.stack(poses), np.stack(depths)


def sphere_volume(sphere, cells=32):
    """The cube around the sphere and its visual hull, (cells, cells, cells)."""
    _, masks, k, poses, _ = sphere
    outlines = silhouettes(masks, None, k, poses)
    first = cube_from_cameras([outline.view for outline in outlines])
    cube = tight_cube(visual_hull(outlines, first, 32, 0.0), first, 0.05)
    return cube, visual_hull(outlines, cube, cells, 0.0)


def photos_of(sphere, cube, prior=0.0):
    """The photos as training takes them, with true depths as prior or none."""
    images, masks, k, poses, depths = sphere
    known = depths * cube.scale * (1.0 if prior else 0.0)
    return PhotoTensors(
        torch.from_numpy(images),
        torch.from_numpy(masks),
        torch.from_numpy(masks.astype(np.uint8) * 255),
        torch.from_numpy(k.astype(np.float32)),
        torch.from_numpy(poses[:, :3, :3].astype(np.float32)),
        torch.from_numpy(cube.apply(poses[:, :3, 3]).astype(np.float32)),
        torch.from_numpy(known.astype(np.float32)),
        torch.from_numpy((known > 0).astype(np.float32)),
    )
