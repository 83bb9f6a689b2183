"""The labelled clicks of single photos, in pixels of the undistorted photo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.marks.clicks import Click, Clicks, in_photos
from scenefuse.marks.triangulation import model_pixel
from scenefuse.photos.workspace import View, images_by_name, ray_through, read_model

if TYPE_CHECKING:
    import pycolmap

# Clicks inside that make a mask by themselves: fewer may be on one part of the object only.
SUFFICIENT_CLICKS = 3


@dataclass(frozen=True)
class PhotoClicks:
    """What a person clicked in one photo.

    Attributes:
        pixels: (N, 2) of the undistorted photo.
        inside: (N,) True on the object, False off it.
        box: (2, 2) corners of a box around the object, upper left first; None where there is none.
        original: (N, 2) the same pixels in the original photo, as a person knows them; None where it is the same photo.
    """

    pixels: Array = field(default_factory=lambda: np.zeros((0, 2)))
    inside: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    box: Array | None = None
    original: Array | None = None

    @property
    def on(self) -> Array:
        """(N, 2) pixels clicked inside."""
        return self.pixels[self.inside]

    @property
    def off(self) -> Array:
        """(N, 2) pixels clicked outside."""
        return self.pixels[~self.inside]

    @property
    def prompt(self) -> bool:
        """Whether they say where the object is: one inside, or a box."""
        return bool(self.inside.any()) or self.box is not None

    @property
    def enough(self) -> bool:
        """Whether they say what the object is without any other photo: a box, or three inside."""
        return int(self.inside.sum()) >= SUFFICIENT_CLICKS or self.box is not None

    def only(self, keep: NDArray[np.bool_]) -> PhotoClicks:
        """The clicks of the rows (N,) to keep, and the box."""
        original = None if self.original is None else self.original[keep]
        return replace(self, pixels=self.pixels[keep], inside=self.inside[keep], original=original)

    def named(self, row: int) -> str:
        """A click in words."""
        x, y = (self.pixels if self.original is None else self.original)[row]
        return f"the click {'inside' if self.inside[row] else 'outside'} at ({x:g}, {y:g})"


def clicks_per_photo(
    labels: Clicks, sparse: Path, views: list[View], sizes: Mapping[str, tuple[int, int]] | None
) -> tuple[dict[int, PhotoClicks], list[str]]:
    """The clicks of each clicked photo, by its row in `views`, in pixels of the undistorted photo.

    Args:
        labels: the table, of labels, in pixels of the original photos.
        sparse: COLMAP model of the photos before undistortion.
        views: undistorted photos.
        sizes: photo name -> (width, height) of the photos clicked in, of all photos, also those without a camera; None
            where these are not known, and photos have the size of their cameras.

    Returns:
        The clicks, and a sentence for each photo whose clicks are left out: it is not used, has no camera, or their
        places are cut away when it is undistorted.

    Raises:
        StageError: a click outside its photo, a box that is not two corners, no click inside and no box in a photo with
            a camera.
    """
    images = images_by_name(read_model(sparse))
    rows = {view.name: k for k, view in enumerate(views)}
    lost: dict[str, list[Click]] = {}
    found: dict[int, list[tuple[Click, Array]]] = {}
    for click in in_photos(labels.rows, [*images, *(sizes or ())], labels.path):
        photo = click.photo
        if photo in images and photo in rows:
            view = views[rows[photo]]
            undistorted = _undistorted(labels.path, click, images[photo], view, sizes)
            beyond = ((undistorted < 0) | (undistorted > [view.width, view.height])).any()
            if not np.isfinite(undistorted).all() or (sizes is not None and beyond):
                lost.setdefault(f"{photo}, whose edge is cut away there when it is undistorted", []).append(click)
            else:
                found.setdefault(rows[photo], []).append((click, undistorted))
        elif sizes is None or photo in sizes:
            why = ", or is none of the photos" if sizes is None else ""
            lost.setdefault(f"{photo}, which has no camera (it could not be registered{why})", []).append(click)
        else:
            unused = f"{photo}, which is not among the photos that are used: renamed since, or left out by"
            lost.setdefault(f"{unused} object.frames (max_frames, frame_step)", []).append(click)
    left_out = [
        f"{clicks[0]} is in {place}" if len(clicks) == 1 else f"{len(clicks)} clicks, {clicks[0]} first, are in {place}"
        for place, clicks in lost.items()
    ]
    clicked = {k: of_photo(labels.path, views[k].name, clicks) for k, clicks in sorted(found.items())}
    if not any(clicks.prompt for clicks in clicked.values()):
        if left_out:
            raise StageError(
                f"{labels.path} has no other click inside: {'; '.join(left_out)}; click in one of the {len(images)}"
                f" photos with a camera ({', '.join(sorted(images)[:3])}, ...)"
            )
        raise StageError(f"{labels.path} holds only clicks outside the object; add a few inside it, or a box around it")
    return clicked, left_out


def _undistorted(
    path: Path, click: Click, image: pycolmap.Image, view: View, sizes: Mapping[str, tuple[int, int]] | None
) -> Array:
    """A click (2,) in pixels of the undistorted photo, perhaps beyond its edge, NaN beyond what the lens shows;
    a corner of a box is moved into it. StageError where it lies outside the original."""
    camera = image.camera
    assert camera is not None
    pixel = model_pixel(path, click, image, sizes)
    undistorted: Array = (view.intrinsics @ [*ray_through(camera, pixel), 1.0])[:2]
    if click.label != "box":
        return undistorted
    whole = np.array([view.width, view.height])
    same_share = pixel * whole / [camera.width, camera.height]
    return np.clip(np.where(np.isfinite(undistorted), undistorted, same_share), 0, whole - 1e-3)


def of_photo(path: Path, photo: str, clicks: list[tuple[Click, Array]]) -> PhotoClicks:
    """The clicks of one photo with their pixels in a copy of it. Its two box corners are sorted."""
    corners = np.array([pixel for click, pixel in clicks if click.label == "box"]).reshape(-1, 2)
    if len(corners) not in (0, 2) or (len(corners) and (np.ptp(corners, axis=0) < 2).any()):
        raise StageError(f"{path}: a box in {photo} needs two opposite corners, apart by 2 px; it has {len(corners)}")
    others = [(click, pixel) for click, pixel in clicks if click.label != "box"]
    return PhotoClicks(
        np.array([pixel for _, pixel in others]).reshape(-1, 2),
        np.array([click.label == "inside" for click, _ in others], dtype=bool),
        np.stack([corners.min(0), corners.max(0)]) if len(corners) else None,
        original=np.array([click.pixel for click, _ in others]).reshape(-1, 2),
    )
