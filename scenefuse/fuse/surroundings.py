"""Surroundings: the ground beside an object's foot, where the scene has none and close-ups show it (method F4).

A wall hides the ground at its foot from a flight, and the masks leave it out of the object's own cloud. Known ground is
continued along its planes (Furukawa and Ponce 2010: expansion), and what photos confirm of that comes in.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from scenefuse.cloud.clouds import NEIGHBOURS, Cloud, concatenate, spacing, voxel_downsample, within
from scenefuse.core.stage import threads
from scenefuse.core.transforms import Array, inside_box
from scenefuse.fuse.compare import SAME_PLACE_SPACINGS
from scenefuse.fuse.measure import NEAR, RESOLUTION, Evidence, measure, unchecked, with_evidence, with_normals
from scenefuse.fuse.missing import SPARSEST
from scenefuse.fuse.write import as_bytes
from scenefuse.geometry.depth_test import shown_in
from scenefuse.geometry.ground import fit_ground
from scenefuse.geometry.photo_check import CONFIRMING_PHOTOS, Photos
from scenefuse.photos.workspace import View


def reach_of(obj: Cloud) -> float:
    """How far from an object the ground is its surroundings: a tenth of its diagonal."""
    return 2 * NEAR * obj.diagonal


def places_on_ground(obj: Cloud, scene: Cloud, step: float, gap: float = 0.0) -> Cloud:
    """Places on the ground within reach of an object, `step` apart along x and y; none where the scene has no ground.

    Each lies on the median of the planes of the ground's points nearest to it, seen from above.

    Args:
        obj: the object in the scene's frame, z up.
        scene: what is known around it, with normals.
        step: of the places.
        gap: least distance of a place from known ground, seen from above.
    """
    low, high, reach = obj.points.min(0), obj.points.max(0), reach_of(obj)
    ground = fit_ground(scene.points, low, high, reach, RESOLUTION * obj.diagonal)
    known = np.abs(scene.known_normals).argmax(1) == 2
    known &= False if ground is None else ground.height_of(scene.points) <= ground.tolerance
    if known.sum() < NEIGHBOURS:
        return Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    points, normals = scene.points[known], scene.known_normals[known] * np.sign(scene.known_normals[known, 2:])
    sides = (np.arange(a - reach, b + reach, step) for a, b in zip(low[:2], high[:2]))
    xy = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    tree = cKDTree(points[:, :2])
    xy = xy[tree.query(xy, workers=threads())[0] >= gap]
    near = tree.query(xy, k=NEIGHBOURS, workers=threads())[1]
    fall = ((xy[:, None] - points[near][..., :2]) * normals[near][..., :2]).sum(2) / normals[near][..., 2]
    places = np.column_stack([xy, np.median(points[near][..., 2] - fall, axis=1)])
    upwards = normals[near].mean(1)
    upwards /= np.linalg.norm(upwards, axis=1, keepdims=True)
    inside = np.isfinite(cKDTree(obj.points).query(places, distance_upper_bound=reach, workers=threads())[0])
    return Cloud(places[inside], upwards[inside].astype(np.float32))


def ground_to_add(obj: Cloud, scene: Cloud, added: Cloud, photos: Photos, picture: Callable[[View], View]) -> Cloud:
    """The ground beside an object that photos confirm where nothing is, with the fields of evidence and their colours.

    Args:
        obj: the object in the scene's frame, z up.
        scene: what is left of the scene around it.
        added: the points of the object that came in.
        photos: the object's, in the scene's frame.
        picture: a view of these with its colours as pixels.
    """
    around = scene[inside_box(scene.points, obj.points.min(0), obj.points.max(0), reach_of(obj))]
    if min(len(around), len(added)) <= NEIGHBOURS:
        return unchecked(added[np.zeros(0, np.int64)])
    around, apart = with_normals(around), SAME_PLACE_SPACINGS * spacing(around.points)
    # Scans may have points as near to each other as they like; an eighth of a cell closes any gap.
    step = max(spacing(added.points), RESOLUTION * obj.diagonal / NEIGHBOURS)
    places = places_on_ground(obj, around, step, apart)
    surface = concatenate([Cloud(one.points, one.normals) for one in (around, added)])
    places = places[~within(places.points, surface.points, apart)]
    shown = _shown_in_each(places, surface, photos.views, RESOLUTION * obj.diagonal)
    enough = shown.sum(0) >= CONFIRMING_PHOTOS
    found = measure(places[enough], photos, obj.diagonal)
    ground = with_evidence(found, Evidence.NERF_ONLY)[found.surface]
    colors = _median_colors(ground.points, shown[:, enough][:, found.surface], photos.views, picture)
    return replace(ground, colors=colors)


def missing_ground(obj: Cloud, completed: Cloud, photos: tuple[Photos, Photos]) -> float | None:
    """Share without points of the ground beside an object that photos of one side show; None where they show none.

    Args:
        obj: the object in the scene's frame, z up.
        completed: the completed scene around it, with normals.
        photos: the object's and the scene's, in the scene's frame.
    """
    side = RESOLUTION * obj.diagonal
    places = places_on_ground(obj, completed, side)
    counts = [_shown_in_each(places, completed, one.views, side).sum(0) for one in photos]
    shown = places[np.maximum(*counts) >= CONFIRMING_PHOTOS]
    if not len(shown):
        return None
    apart = cKDTree(completed.points).query(shown.points, workers=threads())[0]
    return float((apart > SAME_PLACE_SPACINGS * side).mean())


def _shown_in_each(places: Cloud, surface: Cloud, views: list[View], side: float) -> NDArray[np.bool_]:
    """(V, N) whether each photo shows each place, past a surface with normals, to the side of a cell."""
    cells = voxel_downsample(Cloud(surface.points, surface.normals), side / 2)
    step = spacing(cells.points, quantile=SPARSEST)
    shown = [shown_in(places.points, places.known_normals, cells, view, step, side) for view in views]
    return np.array(shown, dtype=bool).reshape(len(views), len(places))


def _median_colors(
    points: Array, shown: NDArray[np.bool_], views: list[View], picture: Callable[[View], View]
) -> NDArray[np.uint8]:
    """(N, 3) medians of the photos that show each point; shown: (V, N)."""
    colors = np.full((*shown.shape, 3), np.nan, np.float32)
    for of_view, view, here in zip(colors, views, shown):
        rows = np.flatnonzero(here)
        inside, at, _ = view.visible(points[rows])
        if len(inside):
            of_view[rows[inside]] = picture(view).pixels[at[:, 1], at[:, 0]]
    return as_bytes(np.nanmedian(colors, axis=0))
