"""Points by coarse stereo beside the sparse ones: where an object has hardly a feature, they propagate its masks from
photo to photo, and say where it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scenefuse.core.stage import StageError
from scenefuse.core.transforms import Array
from scenefuse.geometry.consistency import back_project
from scenefuse.geometry.depth_test import CONFIRMING_PHOTOS
from scenefuse.mvs.dense_cloud import DenseCloudSettings
from scenefuse.mvs.plane_sweep import DepthMapSettings, estimate_depth
from scenefuse.mvs.sparse_depths import MIN_SHARED_POINTS, own_points, select_views
from scenefuse.photos.views import Views
from scenefuse.photos.workspace import Rows, View, Workspace

# As coarse as masks need it: points next to an outline do not vote.
STEREO = DepthMapSettings(max_image_size_px=200, sources=4, planes=64, window_px=5, min_score=0.6)
# Photos of that size get a point in each square of so many pixels in which they see none.
CELL_PX = 3
FEW_POINTS = (
    f"fewer than {MIN_SHARED_POINTS} SfM points are on the object, so hardly a feature: points by coarse stereo are"
    " used too"
)

DepthMap = NDArray[np.float32]


def with_stereo_points(photos: Workspace) -> Workspace:
    """Photos with more points: one where three depth maps of coarse stereo agree, and no point is yet (method K1).

    Args:
        photos: views with RGB pixels, sparse points and who observes them.
    """
    small = [gray(view).at_most(STEREO.max_image_size_px) for view in photos.views]
    try:
        chosen = select_views(replace(photos, views=small), STEREO.sources, STEREO.min_angle_deg)
    except StageError:
        print("no points by stereo: no two photos share enough points from different places", flush=True)
        return photos
    depths = {
        name: estimate_depth(one.view, one.sources, one.near, one.far, STEREO, "cpu").depth
        for name, one in chosen.items()
    }
    maps = [(view, depths[view.name]) for view in small if view.name in depths]
    points = photos.points
    for view, depth in maps:
        new = _new_points(view, depth, points)
        agree = np.zeros(len(new), dtype=np.int64)
        for other in maps:
            agree[_shown(*other, new)] += 1
        points = np.concatenate([points, new[agree >= CONFIRMING_PHOTOS]])
    count = len(photos.points)
    print(f"{len(points) - count} points by stereo beside {count} sparse ones", flush=True)
    seen, seen_at = list(photos.seen), list(photos.seen_at)
    for k, (view, one) in enumerate(zip(photos.views, small)):
        if one.name in depths:
            rows = count + _shown(one, depths[one.name], points[count:])
            seen[k] = np.concatenate([seen[k], rows])
            seen_at[k] = np.concatenate([seen_at[k], view.project(points[rows])[0]])
    return replace(photos, points=points, seen=seen, seen_at=seen_at, by_stereo=len(points) - count)


def gray(view: View) -> View:
    """An RGB photo in grey, (H, W) float32 in 0..1."""
    return replace(view, pixels=view.pixels.mean(axis=2, dtype=np.float32) / np.float32(255))


def _new_points(view: View, depth: DepthMap, known: Array) -> Array:
    """(N, 3) points of a depth map (H, W), of each cell that shows none of the known ones (P, 3) the one nearest to its
    middle."""
    shown, cells = _shown(view, depth, known), -(-view.width // CELL_PX)
    taken = (view.project(known[shown])[0] // CELL_PX).astype(np.int64) @ [1, cells]
    v, u = np.nonzero(depth > 0)
    off = np.abs(u % CELL_PX - CELL_PX // 2) + np.abs(v % CELL_PX - CELL_PX // 2)
    order = np.argsort(off, kind="stable")
    v, u = v[order], u[order]
    cell, first = np.unique(u // CELL_PX + cells * (v // CELL_PX), return_index=True)
    first = first[~np.isin(cell, taken)]
    away = depth[v[first], u[first]].astype(np.float64)
    return back_project(away, view.intrinsics, view.world_from_cam, v[first], u[first])


def _shown(view: View, depth: DepthMap, points: Array) -> Rows:
    """Rows (K,) of points (N, 3) that lie on a depth map (H, W)."""
    rows, pixels, away = view.visible(points)
    there = depth[pixels[:, 1], pixels[:, 0]]
    return rows[np.abs(away - there) <= DenseCloudSettings.max_depth_error * there]


def with_enough_points(views: Views) -> Views:
    """An object's photos with points by stereo where fewer than MIN_SHARED_POINTS of the sparse ones are on it."""
    return views if np.count_nonzero(own_points(views)) >= MIN_SHARED_POINTS else with_stereo(views)


def with_stereo(views: Views) -> Views:
    """An object's photos with points by stereo beside the sparse ones (`with_stereo_points`)."""
    shown = [views.view(index) for index in range(len(views.names))]
    at = [view.project(views.sparse[rows])[0] for view, rows in zip(shown, views.tracks)]
    more = with_stereo_points(Workspace(Path(), shown, views.sparse, views.tracks, at))
    return replace(views, sparse=more.points, tracks=[np.unique(rows) for rows in more.seen])
