"""A planted ball for masks from clicks: sparse points on it and around it, photos on a circle."""

from pathlib import Path

import numpy as np

from scenefuse.marks.photo_clicks import PhotoClicks
from scenefuse.masks.prompts import NO_PIXELS
from scenefuse.photos.workspace import View, Workspace

WIDTH, HEIGHT, FOCAL, PHOTOS = 120, 90, 110.0, 12
INTRINSICS = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def planted_view(k):
    """A camera on a circle, five away from the unit ball at the origin, with the true mask as its photo."""
    angle = 2 * np.pi * k / PHOTOS
    position = np.array([5 * np.cos(angle), 5 * np.sin(angle), 0.0])
    forward = -position / 5
    right = np.cross(forward, [0, 0, 1.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    # All pixels that the ball touches: its limb holds many points.
    ball = np.hypot(u - WIDTH / 2, v - HEIGHT / 2) < FOCAL / np.sqrt(24) + 1
    pixels = np.where(ball[..., None], [190, 60, 50], [70, 130, 60]).astype(np.uint8)
    return View(f"f{k:02}.png", INTRINSICS, pose, WIDTH, HEIGHT, pixels)


def true_mask(view):
    return view.pixels[..., 0] > 100


def photos_of_a_ball():
    """Each photo sees the points of the ball that face it, and those of a distant shell that the ball does not hide."""
    generator = np.random.default_rng(0)
    sphere = generator.normal(size=(1200, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    points = np.concatenate([sphere[:600], 12 * sphere[600:]])
    views = [planted_view(k) for k in range(PHOTOS)]
    seen, seen_at = [], []
    for view in views:
        rows, at, _ = view.visible(points)
        facing = ((points[rows] - view.centre) * points[rows]).sum(1) < 0
        own = rows < 600
        keep = np.where(own, facing, ~true_mask(view)[at[:, 1], at[:, 0]])
        seen.append(rows[keep])
        seen_at.append(view.project(points[rows[keep]])[0])
    return Workspace(Path(), views, points, seen, seen_at)


def clicks(inside, outside=(), box=None):
    pixels = np.array([*inside, *outside], float).reshape(-1, 2)
    return PhotoClicks(pixels, np.arange(len(pixels)) < len(inside), None if box is None else np.array(box, float))


MIDDLE = (60.0, 45.0)


class BallNetwork:
    """SAM 2 that answers with the true mask, of photo f06 with a corner beside, and remembers its prompts."""

    def __init__(self, photos):
        self.known, self.prompts = photos.views, []

    def encode(self, image):
        return next(view for view in self.known if view.pixels is image)

    def masks(self, view, size, points_px, box, outside_px=NO_PIXELS):
        self.prompts.append((view.name, points_px, box, outside_px))
        mask = true_mask(view)
        if view.name == "f06.png":
            mask = mask.copy()
            mask[:8, :8] = True
        return [mask] * 3, np.full(3, 0.1 if view.name == "f06.png" else 0.9)
