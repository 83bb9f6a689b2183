"""Each photo of an object localised in the scene by itself: a similarity from camera centres."""

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.core.transforms import Array, Sim3, fit_sim3_robust
from scenefuse.register.shared_features.landmarks import Landmarks

# Matches, and inliers, that localise a photo.
MIN_LOCALISED = 10
# RANSAC's inlier distance of the camera centres, as a share of their distance from the object.
CENTRE_SHARE = 0.05
# Camera centres along a line fix no similarity: least ratio of the second to the first singular value.
MIN_BREADTH = 0.05


@dataclass(frozen=True)
class Centres:
    """The similarity from the object's photos, each localised in the scene by its own.

    Attributes:
        pose: scene_from_object that fits the camera centres, or None.
        photos: names of the photos that it rests on.
    """

    pose: Sim3 | None
    photos: list[str]


def localise(
    obj: Landmarks, scene: Landmarks, pairs: NDArray[np.int64], pose: Sim3, max_error_px: float, seed: int
) -> Centres:
    """Localise each photo of the object in the scene by its own matches, and fit a similarity to the camera centres.

    Args:
        obj: the object's points and cameras.
        scene: the scene's.
        pairs: (M, 2) all matches, right or wrong.
        pose: scene_from_object, which says only how many pixels of the object's photos a pixel of the scene's is.
        max_error_px: largest reprojection error of an inlier, in pixels of the coarser photos.
        seed: of RANSAC.
    """
    partner = np.full(len(obj.points), -1)
    partner[pairs[:, 0]] = pairs[:, 1]
    target = np.repeat(partner, np.diff(obj.start))
    coarser = np.median(scene.pixel_size(pairs[:, 1]) / (pose.scale * obj.pixel_size(pairs[:, 0])))
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = max_error_px * max(1.0, float(coarser))
    options.ransac.random_seed = seed
    own, found, names = [], [], []
    for view, name in enumerate(obj.photos):
        rows = np.flatnonzero((obj.seen_in == view) & (target >= 0))
        if len(rows) < MIN_LOCALISED:
            continue
        focal = float(obj.focal[view])
        # Observations are free of distortion already: a pinhole with its principal point at 0 sees them.
        camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[focal, 0, 0])
        answer = pycolmap.estimate_and_refine_absolute_pose(
            focal * obj.rays[rows], scene.points[target[rows]], camera, estimation_options=options
        )
        if answer is None or answer["num_inliers"] < MIN_LOCALISED:
            continue
        own.append(_centre(obj.cam_from_model[view]))
        found.append(_centre(answer["cam_from_world"].matrix()))
        names.append(name)
    if len(own) < 3:
        return Centres(None, names)
    centres = np.array(own)
    spread = np.linalg.svd(centres - centres.mean(0), compute_uv=False)
    if spread[1] < MIN_BREADTH * spread[0]:
        return Centres(None, names)
    distance = float(np.median(np.linalg.norm(centres - np.median(obj.points, axis=0), axis=1)))
    try:
        fitted, inliers = fit_sim3_robust(centres, np.array(found), CENTRE_SHARE * pose.scale * distance, seed)
    except ValueError:
        return Centres(None, names)
    return Centres(fitted, [name for name, ok in zip(names, inliers) if ok])


def _centre(cam_from_model: Array) -> Array:
    return -cam_from_model[:, :3].T @ cam_from_model[:, 3]
