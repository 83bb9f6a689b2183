"""A picture of an alignment: the object on the scene crop from three sides."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.cloud.clouds import Cloud
from scenefuse.core.stage import atomic_file
from scenefuse.core.transforms import Array, Sim3
from scenefuse.photos.pictures import write_picture

SIDE_PX = 460
# An object that is more times as large as the part of the scene is not shown whole.
MAX_SIZE_RATIO = 3.0
SCENE_RGB, OBJECT_RGB = (60, 60, 60), (214, 92, 30)


def draw_alignment(
    path: Path, cloud: Cloud, scene: Cloud, scene_from_object: Sim3, seed: int, most: int = 15000
) -> None:
    """Write a PNG: top, front and side views; above in two colours (scene grey, object orange), below as measured."""
    rng = np.random.default_rng(seed)
    thin = [c[np.sort(rng.permutation(len(c))[:most])] for c in (cloud, scene)]
    obj, ground = thin[0].transformed(scene_from_object), thin[1]
    # Strays at either side do not count, and neither does an object where the pose is absurd.
    low, high = np.percentile(ground.points, [0.5, 99.5], axis=0)
    own = np.percentile(obj.points, [0.5, 99.5], axis=0)
    if (np.ptp(own, axis=0) <= MAX_SIZE_RATIO * (high - low).max()).all():
        low, high = np.minimum(low, own[0]), np.maximum(high, own[1])
    middle, half = (low + high) / 2, 0.62 * max(float((high - low).max()), 1e-9)
    points = np.concatenate([ground.points, obj.points]) - middle
    flat = np.concatenate([np.tile(SCENE_RGB, (len(ground), 1)), np.tile(OBJECT_RGB, (len(obj), 1))])
    real = np.concatenate([_colors(ground, SCENE_RGB), _colors(obj, OBJECT_RGB)])
    views = [(0, 1, 2), (0, 2, -2), (1, 2, 1)]
    rows = [np.concatenate([_splat(points, colors, view, half) for view in views], axis=1) for colors in (flat, real)]
    with atomic_file(path) as temporary:
        write_picture(temporary, np.concatenate(rows))


def _splat(points: Array, colors: NDArray[np.int64], view: tuple[int, int, int], half: float) -> NDArray[np.uint8]:
    """Nearest points last, on white; view = (right axis, up axis, depth axis, negative when looked along it)."""
    right, up, depth = view
    nearness = points[:, 1] * -1 if depth == -2 else points[:, abs(depth)]
    image = np.full((SIDE_PX, SIDE_PX, 3), 255, np.uint8)
    columns = ((points[:, right] / half + 1) / 2 * SIDE_PX).astype(int)
    rows = ((1 - points[:, up] / half) / 2 * SIDE_PX).astype(int)
    inside = (columns > 0) & (columns < SIDE_PX - 1) & (rows > 0) & (rows < SIDE_PX - 1)
    order = np.argsort(nearness[inside], kind="stable")
    columns, rows, colors = columns[inside][order], rows[inside][order], colors[inside][order]
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        image[rows + dv, columns + du] = colors
    return image


def _colors(cloud: Cloud, otherwise: tuple[int, int, int]) -> NDArray[np.int64]:
    if cloud.colors is None:
        return np.tile(otherwise, (len(cloud), 1))
    return cloud.colors.astype(np.int64)
