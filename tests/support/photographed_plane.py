"""A painted plane z = 0 photographed from above, for checks of points in photos; rays and colours are exact."""

from functools import cache
from math import cos, sin

import cv2
import numpy as np

from scenefuse.photos.workspace import View

BLANK = 1.5
"""Where x is larger, the plane has no texture."""
PANEL = 0.15
"""Half a side of a panel before the plane."""


def paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey values 0..255 of places on the plane: smooth noise of several wavelengths, none beyond x = BLANK."""
    rng = np.random.default_rng(3)
    x, y = x.astype(np.float32), y.astype(np.float32)
    grey = np.zeros_like(x)
    for _ in range(40):
        angle, wavelength, phase = rng.uniform(0, np.pi), rng.uniform(0.12, 0.8), rng.uniform(0, 6.3)
        grey += np.sin((x * cos(angle) + y * sin(angle)) * 2 * np.pi / wavelength + phase)
    return np.where(x > BLANK, 128.0, np.clip(128 + 12 * grey, 0, 255))


def photographs(
    count: int, height: float, size: int = 320, radius: float = 2.0, noise: float = 1.0, panel: float | None = None
) -> list[View]:
    """Views from a ring of cameras at a height over the plane that look at the origin; `pixels` (H, W) uint8.

    panel: height of a painted panel of 2 PANEL x 2 PANEL above the origin, if there is one.
    """
    return list(_photographs(count, height, size, radius, noise, panel))


@cache
def _photographs(
    count: int, height: float, size: int, radius: float, noise: float, panel: float | None
) -> tuple[View, ...]:
    rng = np.random.default_rng(0)
    views = []
    for k in range(count):
        turn = 2 * np.pi * k / count
        centre = np.array([radius * np.cos(turn), radius * np.sin(turn), height])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
        pose[:3, 3] = -pose[:3, :3] @ centre
        intrinsics = np.array([[size * 0.8, 0, size / 2], [0, size * 0.8, size / 2], [0, 0, 1.0]])
        # Four rays a pixel, averaged, as a sensor does.
        u, v = np.meshgrid(np.arange(2 * size) / 2 + 0.25, np.arange(2 * size) / 2 + 0.25)
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(intrinsics).T @ pose[:3, :3]
        with np.errstate(divide="ignore"):
            ground = centre + rays * (-centre[2] / rays[..., 2:])
        seen = paint(ground[..., 0], ground[..., 1])
        if panel is not None:
            before = centre + rays * ((panel - centre[2]) / rays[..., 2:])
            on_panel = (np.abs(before[..., :2]) <= PANEL).all(-1)
            seen[on_panel] = paint(before[on_panel, 1] - 3, before[on_panel, 0] - 7)
        grey = cv2.resize(np.where(rays[..., 2] < 0, seen, 255.0), (size, size), interpolation=cv2.INTER_AREA)
        pixels = np.clip(np.rint(grey + rng.normal(0, noise, grey.shape)), 0, 255).astype(np.uint8)
        views.append(View(f"{k}.png", intrinsics, pose, size, size, pixels))
    return tuple(views)
