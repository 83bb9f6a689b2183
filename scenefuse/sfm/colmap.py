"""COLMAP's long calls, which a signal can end, its databases, and its bundle adjustment with robust weights."""

import contextlib
import sqlite3
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap

from scenefuse.core.stage import StageError, threads

# He et al. 2026: iterations of a global bundle adjustment, and of the linear solver within one.
ITERATIONS, LINEAR_SOLVER_ITERATIONS = 100, 200
# Relative gain that ends an adjustment which only compares or repeats.
ROUGH_TOLERANCE = 1e-7
# Observations with a larger error are dropped, as COLMAP's mapper does.
MAX_REPROJECTION_ERROR_PX = pycolmap.IncrementalMapperOptions().filter_max_reproj_error
# The smallest model that has a shape.
MIN_PHOTOS = 3
# Reprojection error at which an observation loses half its weight (Cauchy; Triggs et al. 1999).
ROBUST_PX = 1.0


@dataclass(frozen=True)
class Freedom:
    """What an adjustment may change of the cameras, besides their poses.

    Attributes:
        lens: focal length and distortion; False where they are known.
        principal_point: the principal point too.
    """

    lens: bool = True
    principal_point: bool = False


def adjust(model: pycolmap.Reconstruction, freedom: Freedom, tolerance: float = 0.0) -> None:
    """Adjust poses, points and the free part of the lenses of a model in place, by Cauchy-weighted errors."""
    cancellable(pycolmap.bundle_adjustment, model, adjustment_options(freedom, tolerance))


def adjustment_options(freedom: Freedom, tolerance: float = 0.0) -> pycolmap.BundleAdjustmentOptions:
    """COLMAP's options of an adjustment; a relative gain of 0 ends none before its iterations do (He et al. 2026)."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = freedom.lens
    options.refine_principal_point = freedom.lens and freedom.principal_point
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
    outcome: dict[str, Any] = {}

    def work() -> None:
        try:
            outcome["result"] = function(*args, cancellation_token=token, **kwargs)
        except BaseException as error:
            outcome["error"] = error

    worker = threading.Thread(target=work)
    worker.start()
    try:
        while worker.is_alive():
            worker.join(0.2)
    except BaseException:
        token.cancel()
        worker.join()
        raise
    if "error" in outcome:
        raise outcome["error"]
    return outcome["result"]


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
