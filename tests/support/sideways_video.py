"""A textured wall filmed by a camera that moves sideways: the simplest video to learn depth and motion from."""

import numpy as np

from scenefuse.photos.views import Views

WIDTH, HEIGHT, FOCAL, DISTANCE, STEP = 64, 48, 58.0, 3.0, 0.15
# By how many columns the wall moves from one frame to the next.
SHIFT_PX = FOCAL * STEP / DISTANCE


def sideways_video(count: int = 10, step: float = STEP) -> Views:
    """Frames of a wall 3 away, all of it object, without SfM points; the fifth is held out."""
    v, u = np.meshgrid(np.arange(HEIGHT) + 0.5, np.arange(WIDTH) + 0.5, indexing="ij")
    images, poses = [], np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = step * np.arange(count)
    for centre in poses[:, 0, 3]:
        x, y = (u - WIDTH / 2) / FOCAL * DISTANCE + centre, (v - HEIGHT / 2) / FOCAL * DISTANCE
        red, green = np.sin(2.1 * x + 0.7 * y) + np.sin(3.3 * y - 1.1 * x), np.sin(2.7 * y - x) + np.sin(1.9 * x)
        blue = np.sin(2.3 * x + 1.7 * y + 1) + np.sin(1.3 * y)
        images.append((127.5 + 57 * np.stack([red, green, blue], -1)).astype(np.uint8))
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    held_out = np.arange(count) == 4
    nothing = np.zeros((0, 3)), [np.zeros(0, np.int64)] * count
    mattes = np.full((count, HEIGHT, WIDTH), 255, np.uint8)
    names = [f"{index:03d}.jpg" for index in range(count)]
    k = np.repeat(intrinsics[None], count, 0)
    return Views(names, np.stack(images), mattes, mattes == 0, k, poses, held_out, *nothing)
