"""COLMAP's long calls, which a signal can end, its databases, its bundle adjustment with robust weights, and how many
of the verified matches a model explains: which of two models is right, and which photos stand wrong in one.

A photo that stands in a wrong place has a small reprojection error there, for what contradicts it is no longer part of
the model; its matches still are.
"""

import contextlib
import sqlite3
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from scenefuse.core.stage import StageError, threads
from scenefuse.core.transforms import FIXING_POINTS

# He et al. 2026: iterations of a global bundle adjustment, and of the linear solver within one.
ITERATIONS, LINEAR_SOLVER_ITERATIONS = 100, 200
# Relative gain that ends an adjustment. All iterations take three times as long and move cameras by a hundredth of
# their errors.
ADJUSTMENT_TOLERANCE = 1e-6
# Observations with a larger error are dropped, as COLMAP's mapper does.
MAX_REPROJECTION_ERROR_PX = pycolmap.IncrementalMapperOptions().filter_max_reproj_error
# The smallest model that has a shape.
MIN_PHOTOS = FIXING_POINTS
# Reprojection error at which an observation loses half its weight (Cauchy; Triggs et al. 1999).
ROBUST_PX = 1.0
# Matches that chance hardly gives a pair: as many as COLMAP needs to place a photo. Between leaves, guided matching
# along a wrong epipolar line finds 15 to 20.
STRONG_PAIR = pycolmap.IncrementalMapperOptions().abs_pose_min_num_inliers
# Share of the matches of a photo's strong pairs that the model explains where the photo stands right. A sculpture alike
# from two sides leaves 0.76; in models with a group of frames in wrong places some had 0.28 to 0.66.
MIN_EXPLAINED = 0.7


@dataclass(frozen=True)
class Freedom:
    """What an adjustment may change of the cameras, besides their poses.

    Attributes:
        lens: focal length and distortion; False where they are known.
        principal_point: the principal point.
    """

    lens: bool = True
    principal_point: bool = False


def adjust(model: pycolmap.Reconstruction, freedom: Freedom, tolerance: float = ADJUSTMENT_TOLERANCE) -> None:
    """Adjust poses, points and the free part of the lenses of a model in place, by Cauchy-weighted errors, until an
    iteration gains less than this share of the cost."""
    cancellable(pycolmap.bundle_adjustment, model, adjustment_options(freedom, tolerance))


def adjustment_options(freedom: Freedom, tolerance: float = ADJUSTMENT_TOLERANCE) -> pycolmap.BundleAdjustmentOptions:
    """COLMAP's options of an adjustment; `tolerance`: the relative gain that ends it."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = freedom.lens
    options.refine_principal_point = freedom.principal_point
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = ROBUST_PX
    solver = options.ceres.solver_options
    solver.max_num_iterations = ITERATIONS
    solver.max_linear_solver_iterations = LINEAR_SOLVER_ITERATIONS
    solver.function_tolerance = tolerance
    solver.gradient_tolerance = solver.parameter_tolerance = 0.0
    solver.num_threads = threads()
    return options


def drop_outliers(model: pycolmap.Reconstruction) -> None:
    """Drop observations with large errors or behind the camera, and points whose rays hardly spread."""
    observations = pycolmap.ObservationManager(model)
    min_angle_deg = pycolmap.IncrementalMapperOptions().filter_min_tri_angle
    observations.filter_all_points3D(MAX_REPROJECTION_ERROR_PX, min_tri_angle=min_angle_deg)
    observations.filter_observations_with_negative_depth()
    model.update_point_3d_errors()


def cancellable(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call a long pycolmap function so that a signal ends it: it runs beside the main thread and is cancelled.

    A handler for SIGTERM only runs in the main thread, and only between two Python instructions.
    """
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1) as pool:
        job = pool.submit(function, *args, cancellation_token=token, **kwargs)
        try:
            # Until Python 3.13, a join that a signal's exception leaves takes the thread for ended.
            while not wait([job], 0.2).done:
                pass
        except BaseException:
            token.cancel()
            raise
        return job.result()


def require_database(path: Path) -> None:
    """Raise StageError where a COLMAP database is missing or damaged; COLMAP does not say which file it means."""
    if not path.is_file():
        raise StageError(f"{path} does not exist; run the stage that writes it first")
    try:
        with contextlib.closing(sqlite3.connect(path.absolute().as_uri() + "?immutable=1", uri=True)) as database:
            wrong = database.execute("PRAGMA quick_check(1)").fetchone()[0]
    except sqlite3.DatabaseError as error:
        wrong = str(error)
    if wrong != "ok":
        raise StageError(f"{path} is damaged ({wrong}); delete it and run again")


@dataclass(frozen=True)
class Explained:
    """What a model says of each verified pair.

    Attributes:
        pairs: (P, 2) numbers of photos.
        matches: (P,) verified matches.
        explained: (P,) of these, how many lie on the epipolar lines of the model; 0 where a photo is not in it.
        placed: (P,) whether both photos are in the model.
    """

    pairs: NDArray[np.int64]
    matches: NDArray[np.int64]
    explained: NDArray[np.int64]
    placed: NDArray[np.bool_]

    @property
    def total(self) -> int:
        """Matches that the model explains."""
        return int(self.explained.sum())

    def can_grow(self) -> bool:
        """Whether a photo outside the model has as many matches with its photos as COLMAP needs to place one."""
        inside = np.isin(self.pairs, self.pairs[self.placed])
        one = inside.sum(1) == 1
        outside = np.bincount(self.pairs[one][~inside[one]], self.matches[one])
        return bool((outside >= STRONG_PAIR).any())

    def shares(self) -> dict[int, float]:
        """Share of each photo's matches, in strong pairs of the model's photos, that the model explains."""
        strong = (self.matches >= STRONG_PAIR) & self.placed
        shares = {}
        for photo in np.unique(self.pairs[strong]):
            own = strong & (self.pairs == photo).any(1)
            shares[int(photo)] = float(self.explained[own].sum() / self.matches[own].sum())
        return shares


def explained_matches(model: pycolmap.Reconstruction, database: Path) -> Explained:
    """Compare the verified matches of a COLMAP database with the epipolar geometry of a model (Sampson's error).

    Args:
        model: the model; photos are those of the database, by their numbers.
        database: COLMAP database with verified matches.
    """
    with pycolmap.Database.open(database) as opened:
        ids, _ = opened.read_two_view_geometry_num_inliers()
        pairs = np.array([pycolmap.pair_id_to_image_pair(i) for i in ids], dtype=np.int64).reshape(-1, 2)
        inside = set(model.reg_image_ids())
        placed: NDArray[np.bool_] = np.asarray(np.isin(pairs, list(inside)).all(axis=1))
        rays = {i: _rays(model, i, np.asarray(opened.read_keypoints(i))[:, :2]) for i in inside}
        matches, explained = np.zeros(len(pairs), np.int64), np.zeros(len(pairs), np.int64)
        for k, (a, b) in enumerate(pairs.tolist()):
            found = np.asarray(opened.read_two_view_geometry(a, b).inlier_matches, dtype=np.int64).reshape(-1, 2)
            matches[k] = len(found)
            if placed[k]:
                off = _sampson(model, a, b, rays[a][found[:, 0]], rays[b][found[:, 1]])
                explained[k] = np.count_nonzero(off <= MAX_REPROJECTION_ERROR_PX)
    return Explained(pairs, matches, explained, placed)


def doubtful_photos(model: pycolmap.Reconstruction, found: Explained) -> dict[str, float]:
    """Photos of a model that may stand in wrong places, by name, with the share of their matches that it explains.

    Each has too small a share: where that lies at a wrong neighbour, the neighbour's own share is hardly touched.
    """
    shares = {model.images[i].name: share for i, share in found.shares().items()}
    return {name: round(share, 3) for name, share in sorted(shares.items()) if share < MIN_EXPLAINED}


def _rays(model: pycolmap.Reconstruction, photo: int, pixels: NDArray[np.floating]) -> NDArray[np.float64]:
    """(N, 3) viewing rays of pixels in a photo's camera, with z 1."""
    flat = np.asarray(model.cameras[model.images[photo].camera_id].cam_from_img(pixels.astype(np.float64)))
    return np.column_stack([flat.reshape(-1, 2), np.ones(len(pixels))])


def _sampson(
    model: pycolmap.Reconstruction, one: int, other: int, x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(N,) distances in pixels of matched rays x (N, 3) and y (N, 3) to the epipolar lines of two photos of a model."""
    images = model.images[one], model.images[other]
    moved = images[1].cam_from_world() * images[0].cam_from_world().inverse()
    essential = np.cross(moved.translation, moved.rotation.matrix(), axisb=0, axisc=0)  # [t]x R
    lines, back = x @ essential.T, y @ essential
    slope = np.sqrt((lines[:, :2] ** 2).sum(1) + (back[:, :2] ** 2).sum(1))
    focal = np.mean([model.cameras[image.camera_id].mean_focal_length() for image in images])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(focal * np.abs((y * lines).sum(1)) / slope)
